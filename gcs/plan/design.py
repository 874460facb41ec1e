"""The record of a design: gains, margins and figures, for design.json, the flight plan and the printed tables.

`gcs.plan.planner.flight_plan` makes it; each stage adds its part to a copy. `gcs.runs.files` reads it back from a run.
"""

from collections.abc import Sequence
from math import inf, nan
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field

from gains.core.arrays import FloatArray
from gains.core.requirement import Requirement, plain
from gains.core.semidefinite import SolverFacts
from gains.performance.response import Response
from gcs.published import Published
from scenarios.schema import GainBlock

Matrix = tuple[tuple[float, ...], ...]


Margin = Annotated[Annotated[float, Field(ge=0)] | None, AfterValidator(plain)]
"""A delay margin in s; None if no delay makes the loop unstable, or if it is unknown."""


class BlockMargin(Published):
    """Continuous delay margin of one diagonal block, and the frequency of instability there; None without a limit."""

    delay_margin_s: Margin
    crossing_rad_s: float | None


class TradeOffPoint(Published):
    """The largest α that gains with this delay margin can have."""

    delay_margin_s: float
    alpha: float


class Behaviour(Published):
    """The fields of `gains.performance.behaviour.Behaviour`; None for values that are not finite."""

    decay_rate_1_s: float
    damping: float | None
    decay_rate_delayed_1_s: float | None
    damping_delayed: float | None
    string_peak: float | None
    string_peak_delayed: float | None
    delay_s: float


class Proof(Published):
    """P of the Lyapunov function, the α that it proves, and the eigenvalues that were checked.

    The proof is `gains.performance.robust.Certificate` for inclusion gains, and `gains.design.dk_iteration.DecayProof`
    for gains on a pattern.
    """

    P: Matrix
    alpha: float
    P_eigenvalue_min: float
    s_procedure_eigenvalue_max: float | None = None
    inequality_eigenvalue_max: float | None = None


class GainSet(Published):
    """One entry of the gain schedule: its gains, or its share of the streamed command, and its figures."""

    streamed_share: float = 1.0
    time_scale: float = 1.0
    blocks: tuple[GainBlock, ...] = ()
    K1_1_s: Matrix | None = None
    K2_1_s: Matrix | None = None
    K3_1_s2: Matrix | None = None
    alpha: float | None = None
    decay_rate_1_s: float | None = None
    delay_margin_s: Margin
    delay_margin_continuous_s: Margin = None


class VehicleResponse(Published):
    """How one vehicle responds to set-points, as in `gains.performance.response.Response`."""

    system_id: int
    model: str = "lag"
    lag_s: float
    velocity_gain_1_s: float
    dead_time_s: float = 0.0
    natural_frequency_rad_s: float | None = None
    damping: float | None = None
    misfit: float | None = None
    """Share of the velocity (rms) in the manoeuvre that the response does not explain; None for a given response."""

    @property
    def response(self) -> Response:
        return Response(self.lag_s, self.velocity_gain_1_s, self.dead_time_s, self.natural_frequency_rad_s)


class ResponsePart(Published):
    """How the vehicles respond to set-points, and the margin of the same gains if they responded at once."""

    source: str
    model: str = ""
    vehicles: tuple[VehicleResponse, ...] = ()
    """Empty until the responses are known."""
    delay_margin_at_once_s: Margin = None
    string_peak: float | None = None


class OnboardPart(Published):
    """Rates of the loop on board, and the margins if the station closed every loop with the same gains."""

    rate_hz: float
    sensor_hz: float
    ground_delay_margin_s: Margin
    ground_delay_margin_continuous_s: Margin


class WindowAt(Published):
    """Range of loop delays (s) in which a loop with prediction is stable; the upper end is None without a limit."""

    assumed_delay_s: float
    mismatch_window_s: tuple[float, Margin]
    mismatch_window_continuous_s: tuple[float, Margin]
    jump_s: float | None = None
    """How early or late set-points may act, varying in any way, at a constant age of telemetry; None if not proved."""


class PredictionPart(Published):
    """The mismatch window of the fastest gains, and the same at other assumed delays."""

    assumed_delay_s: float | None = None
    """None if the station assumes the measured delay; there is then no single window."""
    mismatch_window_s: tuple[float, Margin] | None = None
    mismatch_window_continuous_s: tuple[float, Margin] | None = None
    jump_s: float | None = None
    windows: tuple[WindowAt, ...] = ()
    assumes: str = ""
    """What the prediction assumes about the set-points sent."""


class FiguresAtDelay(Published):
    """α and the growth of spacing errors at a loop delay; None where unknown or unbounded."""

    loop_delay_s: float | None
    alpha: float | None = None
    discrete: bool = False
    """Whether α is that of the loop in discrete time: half a hold as delay would call this loop unstable. The growth of
    spacing errors is then unknown."""
    has_string_verdict: bool = True
    """Whether the formation has chains of identical followers; otherwise no string peak is defined."""
    string_peak: float | None = None


class FiguresAtExpectedDelay(FiguresAtDelay):
    """The figures at the loop delay of the scenario's links, and the delays up to which they keep a limit."""

    alpha_kept: float | None = None
    """The limit on α. None with prediction or feed-forward, for which these fields are not computed."""
    alpha_kept_to_s: float | None = None
    """None if α is kept at every loop delay; the same for `string_peak_kept_to_s`."""
    string_peak_kept: float | None = None
    string_peak_kept_to_s: float | None = None
    delays_differ: bool = False
    """Whether only the slowest vehicle has this loop delay. The figures are computed as if all vehicles had it."""


class VehicleSpread(Published):
    """The root mean square of one follower's true spacing error, and of its reported one."""

    system_id: int
    spacing_error_rms_m: float
    reported_rms_m: float


class PredictedSpread(Published):
    """The steady-state spread of spacing errors at a loop delay, from disturbances and navigation errors."""

    loop_delay_s: float
    decay_rate_1_s: float
    vehicles: tuple[VehicleSpread, ...]


class WholeFigures(Published):
    """α for disturbances of the whole formation at once, where the design's own α is for one follower."""

    alpha: float
    loop_delay_s: float
    alpha_at_loop_delay: float


class CriteriaPart(Published):
    """The values that a design reaches for all criteria, requested or not; None where one is not defined."""

    at_delay_s: float
    """Loop delay of the figures at a delay: the requested one, or that of the scenario's links."""
    damping: float
    natural_frequency_rad_s: float
    alpha_at_delay: float
    decay_rate_at_delay_1_s: float
    spacing_gain_s2: float | None
    noise_gain: float | None
    weight: tuple[float, float] = (1.0, 1.0)
    discrete: bool = False
    """Whether decay and α at the delay are those of the loop in discrete time."""
    alpha_bound: float | None = None
    """Upper bound on the α of any controller at the delay. Only `gcs design` computes this and the fields below."""
    delays_jumping_s: tuple[float, float] | None = None
    """Range around `at_delay_s` in which the loop delay may jump in any way."""
    delays_covered_by: str | None = None
    delays_covered_to_s: float | None = None


class CodeRecord(Published):
    """A file of the user's own code that a scenario names."""

    file: str
    sha256: str


class GainsAtDelay(Published):
    """Gains at a loop delay, with or without prediction, and their figures there; only known fields are set.

    A candidate for a measured link, a point of a front, or one side of a comparison with and without prediction.
    """

    method: Literal["inclusion", "graph-lqr"] = "inclusion"
    prediction: bool
    maximised: str = ""
    gains: Literal["fastest", "least", "own"] = "own"
    """The `fastest` at the delay, the `least` with prediction that decay as fast, or the scenario's `own`."""
    refused: str = ""
    """Why there are no gains; the figures are then unknown."""
    K1: float | None = None
    K2: float | None = None
    K3: float | None = None
    tolerated: float | None = None
    loop_delay_s: float = nan
    ratio: float | None = None
    """Ratio of the delay to the longest one without prediction."""
    alpha: float | None = None
    alpha_design: float | None = None
    decay_rate_1_s: float | None = None
    decay_rate_half_way_1_s: float | None = None
    """Decay at the worse of the two delays half-way to the ends of the tolerated range."""
    string_peak: float | None = None
    spacing_gain_s2: float | None = None
    noise_gain: float | None = None
    stable_s: tuple[float, Margin] | None = None
    headroom: float | None = None
    is_efficient: bool = False
    K: tuple[tuple[float, ...], ...] = ()


class LinkPart(Published):
    """The loop delays over measured links and, once gains are chosen for them, the reason for the choice."""

    source: str
    vehicles: tuple[int, ...]
    loop_delay_s_least: float
    loop_delay_s_p50: float
    loop_delay_s_worst: float
    headroom: float
    lost_share: float = 0.0
    """Largest share of datagrams lost on any vehicle's up link; the down link is assumed to lose as many."""
    maximised: str = ""
    chosen: str = ""
    candidates: tuple[GainsAtDelay, ...] = ()


class OwnMargins(Published):
    """The margins that apply to one vehicle's loop delay, one for each gain set; None without a limit."""

    system_id: int
    delay_margins_s: tuple[Margin, ...]


class Design(Published):
    """The gains of a scenario, their margins and other figures, and the proofs; fields as published in design.json.

    Only the sampled margin is required. A field that a method does not give or an older file lacks keeps its default
    and is not written. The first margin of the schedule is that of the design.
    """

    K1_1_s: Matrix | None = None
    K2_1_s: Matrix | None = None
    K3_1_s2: Matrix | None = None
    feed_forward: float = 0.0
    K: Matrix | None = None
    links: tuple[tuple[int, int], ...] = ()
    alpha: float | None = None
    decay_rate_1_s: float | None = None
    delay_margin_s: Margin
    delay_margin_continuous_s: Margin = None
    margin_over_links: bool = False
    """Whether the sampled margin is the one over the scenario's links, because vehicles share a loop with different
    loop delays. The continuous margin never is."""
    own_margins: tuple[OwnMargins, ...] = ()
    """Margins of the vehicles to which those of the schedule do not apply."""
    period_s: float = 0.0
    vehicles: int = 0
    leader: BlockMargin | None = None
    follower: BlockMargin | None = None
    behaviour: Behaviour | None = None
    certificate: Proof | None = None
    cost_loss: float | None = None
    subgraphs: int = 0
    subgraphs_smallest: int = 0
    solver: SolverFacts | None = None
    requirement: Requirement | None = None
    trade_off: tuple[TradeOffPoint, ...] = ()
    method: str = ""
    loop: Literal["ground", "onboard"] = "ground"
    pattern: str = ""
    blocks: tuple[GainBlock, ...] = ()
    schedule: tuple[GainSet, ...] = ()
    response: ResponsePart | None = None
    onboard: OnboardPart | None = None
    prediction: PredictionPart | None = None
    at_loop_delay: FiguresAtExpectedDelay | None = None
    whole: WholeFigures | None = None
    """Only `gcs design` computes this and `spread`."""
    spread: PredictedSpread | None = None
    criteria: CriteriaPart | None = None
    margin_unknown: str = ""
    """Why no delay margin could be computed; the margins are then None. Empty if they are known."""
    code: tuple[CodeRecord, ...] = ()
    for_link: LinkPart | None = None

    @property
    def inclusion_gains(self) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """K1, K2 and K3 of a design by inclusion, (2, 2) each; None for a design on a pattern."""
        if self.K1_1_s is None or self.K2_1_s is None or self.K3_1_s2 is None:
            return None
        return np.array(self.K1_1_s), np.array(self.K2_1_s), np.array(self.K3_1_s2)

    @property
    def responses(self) -> dict[int, Response]:
        """The vehicles' responses by system id; empty if they are unknown or immediate."""
        return {own.system_id: own.response for own in self.response.vehicles} if self.response is not None else {}

    @property
    def margins_s(self) -> tuple[float, ...]:
        """The delay margins of the gain schedule; infinite where there is no limit, NaN where it is unknown."""
        every = [entry.delay_margin_s for entry in self.schedule] or [self.delay_margin_s]
        if self.margin_unknown:
            return (nan,) * len(every)
        return tuple(inf if margin_s is None else margin_s for margin_s in every)

    def margin_of(self, system_id: int) -> float | None:
        """The delay margin (s) of a vehicle with the fastest gains; None without a limit."""
        own = {each.system_id: each.delay_margins_s[0] for each in self.own_margins}
        return own.get(system_id, self.delay_margin_s)

    def with_schedule(self, schedule: tuple[GainSet, ...], **parts: Published | str) -> Self:
        """The design with another schedule, whose first entry gives the design's margins, and with other parts."""
        first = schedule[0]
        margins = {"delay_margin_s": first.delay_margin_s, "delay_margin_continuous_s": first.delay_margin_continuous_s}
        return self.model_copy(update=margins | {"schedule": schedule} | parts)

    def with_margins(
        self, sampled_s: Sequence[float], continuous_s: Sequence[float | None], **parts: Published | str
    ) -> Self:
        """The design with other margins of the gain schedule, and with other parts."""
        every = (
            entry.model_copy(update={"delay_margin_s": plain(sampled), "delay_margin_continuous_s": plain(late)})
            for entry, sampled, late in zip(self.schedule, sampled_s, continuous_s, strict=True)
        )
        return self.with_schedule(tuple(every), **parts)
