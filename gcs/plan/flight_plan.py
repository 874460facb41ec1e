"""The flight plan: formation, gains, the vehicles' responses, and the delay margins of the gains with them."""

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf
from typing import Any, Literal, TypeVar

import numpy as np

from gains.core.arrays import FloatArray
from gains.formation.model import FormationModel
from gains.performance.lone_margin import lone_margin
from gains.performance.response import Response, sampled_margin
from gains.sampled.multirate import Timing
from gains.sampled.onboard import OnboardTiming
from gcs.plan.formation import Formation
from gcs.plan.mismatch import TABULATED_S, Predicted, Tolerated, distances, tabulated, window
from scenarios.schema import Scenario

Found = TypeVar("Found")


@dataclass(frozen=True)
class Responses:
    """The response of each vehicle by system id, and whether it was given or identified."""

    source: Literal["given", "identified"]
    of: Mapping[int, Response]
    misfit: Mapping[int, float] = field(default_factory=dict[int, float])
    """The share of each vehicle's velocity that its identified response does not explain."""

    def in_order(self, system_ids: Sequence[int]) -> tuple[Response, ...]:
        """The responses of these vehicles.

        A vehicle that was left out of the flight has none. The response of the last vehicle flown stands in for it,
        which reduces no margin: on a tree, all followers have the same gains.
        """
        flown = [system_id for system_id in system_ids if system_id in self.of]
        return tuple(self.of[system_id if system_id in self.of else flown[-1]] for system_id in system_ids)


@dataclass(frozen=True)
class FlightPlan:
    """The plan that the station flies: the formation, the gains and their margins."""

    scenario: Scenario
    formation: Formation
    gain: FloatArray
    """K of u = K e, rows and columns in the order of `gains.formation.model.FormationModel`."""
    delay_margin_s: float
    """NaN where it is unknown."""
    slower: tuple[tuple[FloatArray, float], ...] = ()
    """The rest of the gain schedule: gain matrices and their delay margins, in ascending order of the margin."""
    separable: bool = True
    """Whether every vehicle closes its own loop with its own margin, as in a leader-follower tree."""
    responses: Responses | None = None
    """The vehicles' responses; None if they are immediate, or not yet known."""
    around_loss: tuple[FloatArray, ...] = ()
    """Flown instead of `gains` while a vehicle is lost; empty if `gains` can stay. A leader-follower tree stays stable
    when the nearest vehicle ahead stands in for a lost one. Gains on another pattern may need all of their terms, so
    inclusion gains of the same delay margin replace them; the step in the commands is accepted."""
    own_margins_s: Mapping[int, tuple[float, ...]] = field(default_factory=dict[int, tuple[float, ...]])
    """Delay margins (s) with each of the gains, by row, of single vehicles to which the formation's margins do not
    apply; infinite if none of their feedback is delayed."""
    law: Callable[..., Any] | None = None
    """The scenario's own control law (`gcs.plan.own_law.Law`), which is flown instead of `gains`."""

    @cached_property
    def gains(self) -> tuple[FloatArray, ...]:
        """The gain schedule, fastest first."""
        return (self.gain, *(gain for gain, _ in self.slower))

    @cached_property
    def margins_s(self) -> tuple[float, ...]:
        return (self.delay_margin_s, *(margin_s for _, margin_s in self.slower))

    @cached_property
    def tolerance(self) -> Callable[[float], Tolerated]:
        """How far the loop delay may be from the assumed delay (s), as a function of the latter."""
        prediction = self.scenario.control.prediction
        if prediction == "off":
            without = Tolerated((inf,) * len(self.margins_s), self.margins_s)
            return lambda _: without

        every = [self.predicted(K) for K in self.gains]
        if isinstance(prediction, str):
            return tabulated([[window(own, at_s) for at_s in TABULATED_S] for own in every])
        ends = [distances(window(own, prediction), prediction) for own in every]
        fixed = Tolerated(tuple(shorter for shorter, _ in ends), tuple(longer for _, longer in ends))
        return lambda _: fixed

    def tolerance_of(self, row: int, assumed_s: float) -> Tolerated:
        """The tolerance for one vehicle."""
        own_s = self.own_margins_s.get(row)
        return self.tolerance(assumed_s) if own_s is None else Tolerated((inf,) * len(own_s), own_s)

    @property
    def responses_in_order(self) -> tuple[Response, ...] | None:
        """The vehicles' responses in the model's order; None if they are immediate or unknown."""
        return None if self.responses is None else self.responses.in_order(self.formation.system_ids)

    def predicted(self, K: FloatArray) -> Predicted:
        """The predicted formation with one of the gains."""
        return Predicted(self.model, K.tobytes(), self.timing, self.responses_in_order, self.onboard)

    @property
    def assumed_s(self) -> float | None:
        """The given loop delay over which the station predicts; None without prediction, or if it is measured."""
        prediction = self.scenario.control.prediction
        return None if isinstance(prediction, str) else prediction

    @property
    def model(self) -> FormationModel:
        return self.formation.model

    @property
    def timing(self) -> Timing:
        """The periods of control and telemetry."""
        return loop_timing(self.scenario)

    @property
    def onboard(self) -> OnboardTiming | None:
        """The timing of the onboard loop; None if the station closes every loop."""
        return onboard_timing(self.scenario)

    @property
    def all_late(self) -> bool:
        """Whether all feedback acts after the loop delay: x' = A x + B K x(t - tau).

        With a loop on board, a vehicle's own errors act at once. With prediction, predicted states are fed back.
        """
        return self.onboard is None and self.scenario.control.prediction == "off"

    @property
    def response_is_known(self) -> bool:
        """Whether the vehicles' response is known: immediate, given or, of autopilots in flight, identified."""
        return self.responses is not None or not self.scenario.starts_on_ground

    def with_margins(self, margins_s: tuple[float, ...], responses: Responses | None) -> "FlightPlan":
        """The plan with the margins that the same gains have on vehicles with these responses."""
        slower = tuple((gain, s) for (gain, _), s in zip(self.slower, margins_s[1:], strict=True))
        return replace(self, delay_margin_s=margins_s[0], slower=slower, responses=responses)


def loop_timing(scenario: Scenario) -> Timing:
    """The periods at which states and commands of a scenario are sent."""
    return Timing(1.0 / scenario.rates.control_hz, 1.0 / scenario.rates.telemetry_hz)


def onboard_timing(scenario: Scenario) -> OnboardTiming | None:
    """The timing of the onboard loop; None if the station closes every loop."""
    if scenario.control.loop != "onboard":
        return None
    own, control_hz = scenario.onboard, scenario.rates.control_hz
    return OnboardTiming(
        1.0 / control_hz,
        steps=round(own.rate_hz / control_hz),
        steps_per_sample=round(own.rate_hz / own.sensor_hz),
        telemetry_s=1.0 / scenario.rates.telemetry_hz,
    )


def given_response(scenario: Scenario) -> Response | None:
    """The response that the scenario gives, the same for all its vehicles; None if it gives none."""
    return None if scenario.response is None else Response(**scenario.response.model_dump())


def given_responses(scenario: Scenario) -> Responses | None:
    """The response that the scenario gives, assigned to each vehicle; None if it gives none."""
    given = given_response(scenario)
    return None if given is None else Responses("given", {own.system_id: given for own in scenario.vehicles})


def at_once(steps: Generator[None, None, Found]) -> Found:
    """Run at once all steps of a computation that a flight spreads over control ticks, and return its result."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value


def margin_steps(plan: FlightPlan, responses: Responses) -> Generator[None, None, list[float]]:
    """The margin (s) of each of the plan's gains, computed in steps.

    If every vehicle closes its own loop and both axes are alike, a step is the margin of one vehicle, some
    milliseconds (`gains.performance.lone_margin`). Otherwise a step is `sampled_margin` of all vehicles together.
    """
    of, margins_s = responses.in_order(plan.formation.system_ids), list[float]()
    for K in plan.gains:
        own = own_gains(plan, K)
        if own is None:
            margins_s.append(sampled_margin(plan.model, K, of, timing=plan.timing))
            yield
            continue
        margins_s.append(np.inf)
        for (k1, k3), response in zip(own, of, strict=True):
            margins_s[-1] = min(margins_s[-1], lone_margin(k1, k3, response, period_s=plan.timing.held_s))
            yield
    return margins_s


def own_gains(plan: FlightPlan, K: FloatArray) -> list[tuple[float, float]] | None:
    """k1 and k3 of each vehicle's own loop; None unless loops are separate, at one rate and alike on both axes."""
    model, found = plan.model, list[tuple[float, float]]()
    if not plan.separable or plan.timing.commands > 1:
        return None
    for i in range(model.vehicles):
        on_velocity = K[model.input_slice(i), model.velocity_slice(i)]
        on_spacing = K[model.input_slice(i), model.spacing_slice(i)] if i else 0.0 * on_velocity
        if not all(np.array_equal(block, block[0, 0] * np.eye(model.axes)) for block in (on_velocity, on_spacing)):
            return None
        found.append((-float(on_velocity[0, 0]), float(on_spacing[0, 0])))
    return found
