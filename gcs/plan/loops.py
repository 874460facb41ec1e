"""The loops of a formation, each stable or not by itself, and how close their expected loop delays are to instability.

In a leader-follower tree every vehicle closes its own loop, and only its own link matters. Vehicles that also hear
those behind them share a loop. Its margin assumes one loop delay for all. If links differ, the margin says little: the
loop may break far below it or stay stable far above it. Its growth at the loop delays of all its vehicles decides.
"""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from functools import cache
from math import inf, isnan, nan

from gains.performance.response import formation_loop, response_states
from gains.sampled.coupled_block import CoupledBlock, coupled_blocks
from gcs.plan.expected_delay import planned_loop_delays_s
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.mismatch import Window
from scenarios.keys.own import BUILT_IN

_STEP, _STEPS = 0.1, 100
"""Size, as a share of the margin, and number of the steps that search for a shared loop's edge of stability."""
_BY_COUNT, _BY_GROWTH = 1.0 / 512.0, 1e-6
"""Accuracy of that edge, as a share of a step: by counted roots, which bisect, and by growth rates, which converge."""
_MOST_BY_GROWTH, _MOST_SHARING = 6, 20
"""Most vehicles in a shared loop whose edge of stability is found: by growth rates, which takes seconds, and at all."""


def is_modelled(plan: FlightPlan) -> bool:
    """Whether the models of `plan_loops` describe the flights. They do not for a law without a stated K or the
    user's own dynamics, for which they tell only which vehicles are coupled."""
    return not isnan(plan.delay_margin_s) and plan.scenario.dynamics in BUILT_IN


def plan_loops(plan: FlightPlan) -> list[CoupledBlock]:
    """The coupled blocks of a plan, with the vehicles' responses if they are known.

    A leader flown by somebody else has none: the station closes no loop over its links.
    """
    responses = plan.responses_in_order if is_modelled(plan) else None
    blocks = coupled_blocks(
        plan.model,
        plan.gain,
        plan.formation.system_ids,
        timing=plan.timing,
        onboard=plan.onboard,
        assumed_s=plan.assumed_s,
        responding=None if responses is None else formation_loop(plan.model, plan.gain, responses),
        response_states=() if responses is None else response_states(plan.model, responses),
    )
    return [block for block in blocks if plan.scenario.external_id not in block.system_ids]


def loop_of(plan: FlightPlan, system_id: int) -> CoupledBlock:
    """The loop that contains a vehicle."""
    return next(block for block in plan_loops(plan) if system_id in block.system_ids)


def growth_1_s(block: CoupledBlock, loop_delay_s: Mapping[int, float]) -> float:
    """The growth rate (1/s) of a loop at expected loop delays (s)."""
    return block.growth_at_1_s(loop_delay_s, _ages_s(block, loop_delay_s))


def _ages_s(block: CoupledBlock, loop_delay_s: Mapping[int, float]) -> dict[int, float]:
    """The ages of states at the control tick: half the link delay, plus the mean wait for the tick."""
    return {own: (at_s + block.timing.faster_s / 2.0) / 2.0 for own, at_s in loop_delay_s.items()}


def _is_stable(block: CoupledBlock, loop_delay_s: Mapping[int, float]) -> bool:
    """Whether a loop is predicted to be stable at expected loop delays, by counting its roots.

    In flights with three vehicles this was right to 0.2 % of the delay on the ground, and to 0.02 % on board.
    """
    return block.is_stable_at(loop_delay_s, _ages_s(block, loop_delay_s))


def _sign(block: CoupledBlock, loop_delay_s: Mapping[int, float]) -> float:
    """The sign of the growth rate, by counting roots."""
    return -1.0 if _is_stable(block, loop_delay_s) else 1.0


def growth_of(plan: FlightPlan, system_id: int) -> Callable[[float], float]:
    """The predicted growth rate (1/s) of a vehicle's loop, as a function of its loop delay (s); other links stay."""
    block, expected_s = loop_of(plan, system_id), planned_loop_delays_s(plan)
    return lambda delay_s: growth_1_s(block, expected_s | {system_id: delay_s})


def window_of(plan: FlightPlan, system_id: int, *, quick: bool = False) -> Window:
    """Range of one vehicle's loop delays in which its loop is predicted stable; if not `is_modelled`, up to the margin.

    The links of all other vehicles stay as they are in the scenario. If a shared loop is unstable over the scenario's
    links, shorter delays of this vehicle are searched; the result is (0, 0) if none makes it stable. The growth is
    zero at the ends, which agree with flights to 0.1 %; if `quick`, or for many vehicles, roots are counted instead.
    """
    block = loop_of(plan, system_id)
    if not is_modelled(plan):
        return 0.0, plan.delay_margin_s
    if len(block.system_ids) == 1:
        return block.window_s()
    if block.margin_s() == inf:
        return 0.0, inf
    expected_s = planned_loop_delays_s(plan)
    counted = quick or len(block.system_ids) > _MOST_BY_GROWTH
    resolution = _BY_COUNT if counted else _BY_GROWTH

    @cache
    def growth(delay_s: float) -> float:
        delays_s = expected_s | {system_id: delay_s}
        return _sign(block, delays_s) if counted else growth_1_s(block, delays_s)

    now_s, step_s = expected_s[system_id], _STEP * block.margin_s()
    stable, shorter_s = growth(now_s) < 0.0, 0.0
    if plan.assumed_s is not None or not stable:
        shorter_s = _edge_s(growth, now_s, -step_s, end_s=0.0, resolution=resolution)
    if not stable:
        return 0.0, shorter_s
    return shorter_s, _edge_s(growth, now_s, step_s, end_s=inf, resolution=resolution)


def _edge_s(
    growth: Callable[[float], float], at_s: float, step_s: float, *, end_s: float, resolution: float = _BY_COUNT
) -> float:
    """The delay at which growth, or its sign alone, changes from the one at `at_s`; `end_s` if it does not."""
    from scipy.optimize import brentq

    stable = growth(at_s) < 0.0
    for _ in range(_STEPS):
        inner_s, at_s = at_s, max(0.0, at_s + step_s)
        if (growth(at_s) < 0.0) != stable:
            return float(brentq(growth, inner_s, at_s, xtol=resolution * abs(step_s)))
        if at_s == 0.0:
            break
    return end_s


def unstable_over_links(plan: FlightPlan, *, but: int | None = None) -> list[int]:
    """The vehicles whose loops are predicted to be unstable over the scenario's links, except the loop of `but`."""
    expected_s = planned_loop_delays_s(plan)
    loops = plan_loops(plan) if is_modelled(plan) else []
    unstable = [each for each in loops if but not in each.system_ids and not _is_stable(each, expected_s)]
    return [own for block in unstable for own in block.system_ids]


def links_differ(plan: FlightPlan, block: CoupledBlock) -> bool:
    """Whether vehicles share this loop over different links: a model of each delay then says more than one margin.

    Always false with prediction, without a model, and for more vehicles than are searched.
    """
    is_searched = plan.scenario.control.prediction == "off" and is_modelled(plan)
    if not is_searched or not 1 < len(block.system_ids) <= _MOST_SHARING:
        return False
    delays_s = planned_loop_delays_s(plan)
    return len({delays_s[own] for own in block.system_ids}) > 1


def link_delays_left_s(plan: FlightPlan, now_s: Mapping[int, float]) -> dict[int, float]:
    """How much more delay (s) each vehicle's link can take, all others as in the scenario; NaN where unknown.

    `now_s` are the effective loop delays. The result is unknown for a large shared loop, and for one on board, where an
    up link also delays the commands of others.
    """
    windows, left_s = dict[Hashable, Window](), dict[int, float]()
    for block in plan_loops(plan):
        for system_id in block.system_ids:
            alone = len(block.system_ids) == 1
            key = block.kind if alone else system_id
            known = alone or (block.extrapolated is not None and len(block.system_ids) <= _MOST_SHARING)
            if key not in windows:
                windows[key] = window_of(plan, system_id) if known else (0.0, nan)
            left_s[system_id] = windows[key][1] - now_s[system_id]
    return left_s


def plan_over_links(plan: FlightPlan) -> FlightPlan:
    """The plan with its margins over the scenario's links, of the formation and of single vehicles.

    Returns the plan itself where they are the margins for equal delays, or where no model predicts its loops yet.
    """
    delays_s = planned_loop_delays_s(plan)
    known = plan.response_is_known and is_modelled(plan) and plan.scenario.control.prediction == "off"
    if not known or len(set(delays_s.values())) == 1:
        return plan
    every = [_over_links(replace(plan, gain=K)) for K in plan.gains]
    own_s = {row: tuple(margins_s[row] for _, margins_s in every) for row in every[0][1]}
    shared_s = [formation_s for formation_s, _ in every if formation_s is not None]
    if not shared_s and all(own[0] <= plan.delay_margin_s for own in own_s.values()):
        return plan
    if shared_s:
        plan = plan.with_margins(tuple(shared_s), plan.responses)
    return replace(plan, own_margins_s={**plan.own_margins_s, **own_s})


def _over_links(plan: FlightPlan) -> tuple[float | None, dict[int, float]]:
    """The margin (s) over the scenario's links of the formation, and those of single vehicles by row.

    The formation's is that of its least stable loop, at its slowest vehicle; None if no loop is shared over different
    links, and the margin for equal delays applies. Single vehicles have one of their own only if all feedback is late:
    a slow link then uses up the margin of its own loop, not the smallest of all loops.
    """
    delays_s, least_s, any_differs = planned_loop_delays_s(plan), inf, False
    own_s, known_s = dict[int, float](), dict[Hashable, float]()
    for block in plan_loops(plan):
        differs = links_differ(plan, block)
        if differs:
            slowest_s = max(delays_s[own] for own in block.system_ids)
            margin_s = slowest_s * breaking_factor(plan, block)
            found = _shared_margins_s(plan, block, margin_s) if plan.all_late else {}
        else:
            if block.kind not in known_s:
                known_s[block.kind] = block.margin_s()
            margin_s = known_s[block.kind]
            alike = len({delays_s[own] for own in block.system_ids}) == 1
            found = dict.fromkeys(block.system_ids, margin_s) if plan.all_late and alike else {}
        least_s, any_differs = min(least_s, margin_s), any_differs or differs
        own_s |= {plan.formation.row(own): own_margin_s for own, own_margin_s in found.items()}
    return least_s if any_differs else None, own_s


def _shared_margins_s(plan: FlightPlan, block: CoupledBlock, margin_s: float) -> dict[int, float]:
    """Margins (s) of single vehicles in a loop shared over different links, all other links as in the scenario.

    The slowest vehicle keeps the margin of its loop over these links if that is smaller, and all vehicles keep it if
    the links already exceed it.
    """
    delays_s = planned_loop_delays_s(plan)
    slowest = max(block.system_ids, key=delays_s.__getitem__)
    if margin_s <= delays_s[slowest]:
        return dict.fromkeys(block.system_ids, margin_s)
    own_s = {own: window_of(plan, own, quick=True)[1] for own in block.system_ids}
    return own_s | {slowest: min(margin_s, own_s[slowest])}


def unlimited(plan: FlightPlan) -> dict[int, tuple[float, ...]]:
    """Infinite margins, by row, for the vehicles without any delayed feedback; empty if none has delayed feedback.

    With loops on the ground, only a leader flown by somebody else has no feedback: the station commands nothing.
    """
    row, leader = plan.formation.row, plan.scenario.external_id
    if plan.onboard is None:
        return {} if leader is None else {row(leader): (inf,) * len(plan.gains)}
    blocks = plan_loops(plan)
    late = [block for block in blocks if block.has_late_terms]
    at_once = [own for block in blocks if not block.has_late_terms for own in block.system_ids]
    return {row(own): (inf,) * len(plan.gains) for own in at_once} if late else {}


def breaking_factor(plan: FlightPlan, block: CoupledBlock) -> float:
    """The factor on its expected loop delays at which a shared loop breaks; 0 if no shorter delays make it stable."""
    expected_s = planned_loop_delays_s(plan)
    own_s = {own: expected_s[own] for own in block.system_ids}
    if block.margin_s() == inf:
        return inf

    @cache
    def growth(factor: float) -> float:
        return _sign(block, {own: factor * at_s for own, at_s in own_s.items()})

    stable, step = growth(1.0) < 0.0, _STEP * block.margin_s() / max(own_s.values())
    return _edge_s(growth, 1.0, step if stable else -step, end_s=inf if stable else 0.0)
