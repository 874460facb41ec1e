"""Overlapping gains for a formation, with their delay margin and robustness.

`design` finds the gains with the largest robustness α at a required delay margin, or with the largest delay margin at a
required α; `evaluate_gains` reports the same figures for given gains. Both check their result on the whole formation,
with methods that share no formula with the search. The required margin is that of the loop as flown, sampled and held,
with all feedback late: about half a period less than the continuous margin. Both margins are reported.

Source: Sahoo 2012 (see `gains.formation.model`), sections 3 and 5.
"""

from dataclasses import asdict, dataclass
from types import NoneType
from typing import Any, Literal, get_args, overload

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError, DisagreementError, InfeasibleError
from gains.core.requirement import ALPHA_MIN, Requirement, plain
from gains.core.structure import of_type, positive_seconds, shown
from gains.criteria.predicted import fed_forward
from gains.delay.constant import delay_margin
from gains.design.for_delay import criteria_gains
from gains.design.graph import GraphDesign, GraphMethod, assess, graph_design
from gains.design.required import required_gains
from gains.design.search import largest_alpha
from gains.formation.model import FormationModel, checked_gains
from gains.formation.pattern import Pattern, checked_pattern_gain, leader_follower
from gains.performance.behaviour import Behaviour, BlockMargin, behaviour, block_margin, diagonal_blocks
from gains.performance.robust import Certificate, certify, robustness
from gains.performance.string_stability import Gains
from gains.sampled.constant import sampled_delay_margin
from gains.sampled.onboard import OnboardTiming

PATTERN = "u_leader = K1 e_leader^v;  u_i = K1 e_i^v + K2 e_predecessor^v + K3 e_i^p"
# The certificate proves this share of α: at α itself a proof barely exists.
_CERTIFIED_SHARE = 1 - 1e-4
# Relative tolerance on a required decay rate: a double root is known to the square root of rounding.
_DECAY_ROUNDING = 1e-6
_TRADE_OFF_MARGINS_S = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)


@dataclass(frozen=True)
class TradeOffPoint:
    """Largest α (exact, W = I) at a sampled delay margin."""

    delay_margin_s: float
    alpha: float


@dataclass(frozen=True, eq=False)
class Design:
    """Gains of a formation, their figures, and the evidence for them."""

    K1: FloatArray
    K2: FloatArray
    K3: FloatArray
    """Gains on a vehicle's own velocity error (1/s), on that of the vehicle in front (1/s) and on the spacing error
    (1/s²), each of shape (axes, axes)."""
    feed_forward: float
    """Share of the command of the vehicle in front that each follower adds; it does not affect the margins."""
    alpha: float
    """Exact sector bound for W = I, `gains.performance.robust.robustness`; 0 if the loop is unstable."""
    delay_margin_s: float
    delay_margin_continuous_s: float
    """Margins of the sampled and of the continuous loop, with all feedback late."""
    period_s: float
    vehicles: int
    leader: BlockMargin
    follower: BlockMargin
    """The continuous margins of the leader's block and of a follower's block."""
    behaviour: Behaviour
    certificate: Certificate | None
    """Lyapunov proof of 0.9999 α; None if the loop is unstable, if its α is below 5e-4, or if none is found for given
    gains because they are badly scaled."""
    requirement: Requirement | None = None
    method: Literal["inclusion", "given"] = "inclusion"
    loop: Literal["ground"] = "ground"
    pattern: str = PATTERN

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists, numbers and strings, for JSON; a number that is not finite becomes None."""
        renamed = {"K1": "K1_1_s", "K2": "K2_1_s", "K3": "K3_1_s2"}
        return {renamed.get(name, name): plain(value) for name, value in asdict(self).items()}


@overload
def design(
    formation: FormationModel,
    requirement: Requirement | None = None,
    *,
    period_s: float,
    method: Literal["inclusion"] = "inclusion",
) -> Design: ...


@overload
def design(
    formation: FormationModel,
    requirement: Requirement | None = None,
    *,
    period_s: float,
    method: GraphMethod,
    pattern: Pattern | None = None,
    onboard: OnboardTiming | None = None,
) -> GraphDesign: ...


def design(
    formation: FormationModel,
    requirement: Requirement | None = None,
    *,
    period_s: float,
    method: Literal["inclusion"] | GraphMethod = "inclusion",
    pattern: Pattern | None = None,
    onboard: OnboardTiming | None = None,
) -> Design | GraphDesign:
    """Return the gains that meet the requirement and are otherwise best.

    The formation is a leader and any number of followers; a leader alone gets the same gains, with the margin of its
    own loop. The default requirement is a sampled delay margin of 0.3 s. Commands are sampled and held every
    `period_s`. `method` is the inclusion principle, or a method of the graph route (`gains.design.graph`). The graph
    route also takes an information `pattern`, by default the leader-follower pattern (4.6), and `onboard`, the timing
    of the onboard loop if that is flown.

    Raises BadModelError if the period is not positive or the method unknown; InfeasibleError if no gains meet the
    requirement, saying what can be reached; DisagreementError if the exact analysis contradicts the search.

    A leader and two followers in a chain get a delay margin of 0.3 s at 50 Hz:

    >>> found = design(FormationModel((-1, 0, 1)), Requirement(delay_margin_s=0.3), period_s=0.02)
    >>> round(found.delay_margin_s, 4), found.K1.shape
    (0.3, (2, 2))
    """
    of_type("formation", formation, FormationModel)
    of_type("requirement", requirement, Requirement, NoneType)
    of_type("pattern", pattern, Pattern, NoneType)
    of_type("onboard", onboard, OnboardTiming, NoneType)
    known = "inclusion", *get_args(GraphMethod)
    if of_type("method", method, str) not in known:
        raise BadModelError(f"method = {method!r}; wanted {', '.join(known[:-1])} or {known[-1]}")
    positive_seconds("period_s", period_s)
    if method != "inclusion":
        links = leader_follower(formation) if pattern is None else pattern
        return graph_design(formation, links, requirement, method=method, period_s=period_s, onboard=onboard)
    wanted = Requirement() if requirement is None else requirement
    gains = required_gains(wanted, period_s) if wanted.criteria is None else criteria_gains(wanted, period_s)
    identity = np.eye(formation.axes)
    matrices = 0.0 - gains.k1 * identity, gains.k2 * identity, gains.k3 * identity
    result = _assess(formation, matrices, wanted.feed_forward, period_s=period_s, requirement=wanted)
    decay = result.behaviour.decay_rate_1_s
    if (
        result.delay_margin_s < (wanted.delay_margin_s or 0.0)
        or (wanted.criteria is None and result.alpha < (wanted.alpha or 0.0))
        or decay < (1.0 - _DECAY_ROUNDING) * (wanted.decay_rate_1_s or 0.0)
    ):
        raise DisagreementError(
            f"the search found gains for {wanted}, but the exact analysis gives them delay_margin_s = "
            f"{result.delay_margin_s!r}, alpha = {result.alpha!r} and decay_rate_1_s = {decay!r}"
        )
    return result


@overload
def evaluate_gains(
    formation: FormationModel,
    gains: tuple[ArrayLike, ArrayLike, ArrayLike],
    *,
    period_s: float,
    feed_forward: float = 0.0,
) -> Design: ...


@overload
def evaluate_gains(
    formation: FormationModel, gains: ArrayLike, *, period_s: float, pattern: Pattern
) -> GraphDesign: ...


def evaluate_gains(
    formation: FormationModel, gains: Any, *, period_s: float, pattern: Pattern | None = None, feed_forward: float = 0.0
) -> Design | GraphDesign:
    """Return margins, robustness and decay of given gains.

    If the loop is unstable, α and the margins are 0 and there is no certificate. `gains` are K1, K2 and K3, each of
    shape (axes, axes), or with an information `pattern` K of u = K e, shape (inputs, states). Commands are sampled and
    held every `period_s`. With K1, K2 and K3 each follower may add the share `feed_forward` of the command of the
    vehicle in front. Raises BadModelError if a gain is not finite, has a wrong shape or does not have the pattern, if
    the share is not from 0 to 1, or if the period is not positive.

    With K1 = −1, K3 = 1 the margin is 0.711119 s, or half a period less when sampled:

    >>> found = evaluate_gains(FormationModel((-1, 0), axes=1), ([[-1]], [[0]], [[1]]), period_s=0.02)
    >>> round(found.delay_margin_continuous_s, 6), round(found.delay_margin_s, 3)
    (0.711119, 0.701)
    """
    of_type("formation", formation, FormationModel)
    Requirement(feed_forward=feed_forward)  # checks the range
    of_type("pattern", pattern, Pattern, NoneType)
    if pattern is not None:
        return assess(formation, pattern, checked_pattern_gain(pattern, gains), period_s=period_s)
    try:
        K1, K2, K3 = gains
    except (TypeError, ValueError) as error:
        raise BadModelError(f"gains is {shown(gains)}; K1, K2 and K3 are wanted") from error
    own, front, spacing = checked_gains(K1, K2, K3, formation.axes)
    return _assess(formation, (own, front, spacing), feed_forward, period_s=period_s, requirement=None)


def _assess(
    formation: FormationModel, gains: Gains, share: float, *, period_s: float, requirement: Requirement | None
) -> Design:
    """The full report on gains, given or designed to a requirement, for the whole formation.

    `share` is the feed-forward. It adds `share` K1 e_leader^v to a follower behind the leader, like a larger K2.
    """
    # scipy.sparse takes a quarter of a second to import; commands that only read a design need not wait for it.
    from gains.formation.inclusion import expand, expanded_gain, modified_gain, verify_inclusion

    A, B, K = formation.A, formation.B, formation.overlapping_gain(*gains)
    expansion, K_expanded = expand(formation), modified_gain(formation, expanded_gain(formation, *gains))
    verify_inclusion(expansion, A, B, K=K, K_expanded=K_expanded)

    flown, K_flown = (gains[0], gains[1] + share * gains[0], gains[2]), fed_forward(formation, K, share)
    alpha = robustness(*flown)
    margin_s = sampled_delay_margin(A, B, K_flown, period_s=period_s)
    continuous_s = delay_margin(A, formation.feedback(K_flown))
    leader, follower = (block_margin(*block) for block in diagonal_blocks(gains))
    blocks_s = [leader.delay_margin_s, follower.delay_margin_s][: formation.vehicles]
    if not np.isclose(continuous_s, min(blocks_s), rtol=1e-9, atol=0):
        raise DisagreementError(
            f"the formation's delay margin is {continuous_s!r}, those of its leader and followers are {blocks_s}; "
            "wanted the least of them"
        )
    return Design(
        K1=gains[0],
        K2=gains[1],
        K3=gains[2],
        feed_forward=share,
        alpha=alpha,
        delay_margin_s=margin_s,
        delay_margin_continuous_s=continuous_s,
        period_s=period_s,
        vehicles=formation.vehicles,
        leader=leader,
        follower=follower,
        behaviour=behaviour(gains, (margin_s + period_s) / 2, feed_forward=share),
        certificate=_certificate(flown, alpha, given=requirement is None),
        requirement=requirement,
        method="inclusion" if requirement else "given",
        pattern=PATTERN + (f" + {share:g} u_predecessor" if share else ""),
    )


def _certificate(gains: Gains, alpha: float, *, given: bool) -> Certificate | None:
    """Proof of α; None if α is too small, or if none is found for given gains, which may be badly scaled."""
    if alpha < ALPHA_MIN:
        return None
    try:
        return certify(*gains, _CERTIFIED_SHARE * alpha)
    except InfeasibleError:
        if given:
            return None
        raise


def trade_off(
    *,
    period_s: float,
    string_peak_max: float | None = None,
    loop: Literal["ground", "onboard"] = "ground",
    feed_forward: float = 0.0,
) -> tuple[TradeOffPoint, ...]:
    """Return the largest α at sampled delay margins from 0.05 to 1 s, omitting margins that no gains reach.

    Arguments as in `gains.core.requirement.Requirement`; commands are sampled and held every `period_s`. Raises
    BadModelError if the period is not positive or another argument is out of range.

    >>> points = trade_off(period_s=0.02)
    >>> points[0].delay_margin_s, points[-1].delay_margin_s, points[0].alpha > points[-1].alpha
    (0.05, 1.0, True)
    """
    positive_seconds("period_s", period_s)
    limit = Requirement(string_peak_max=string_peak_max, loop=loop, feed_forward=feed_forward).chain_limit
    points = ((margin_s, largest_alpha(margin_s, period_s, limit)) for margin_s in _TRADE_OFF_MARGINS_S)
    return tuple(TradeOffPoint(margin_s, gains.alpha) for margin_s, gains in points if gains is not None)
