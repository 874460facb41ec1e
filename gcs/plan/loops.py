"""The loops of a formation, each stable or not by itself, and how close its expected loop delays are to its edge.

In a leader-follower tree every vehicle closes a loop of its own, and only its own link matters. Vehicles that also hear
those behind them share a loop. It has a margin, which is a loop delay that all have; where their links differ, it says
little: such a loop may break far below it or stand far above. What counts then is its growth at all of its loop delays.
"""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from math import inf, isnan, nan

from gains.performance.response import formation_loop, response_states
from gains.sampled.coupled_block import CoupledBlock, coupled_blocks
from gcs.plan.expected_delay import effective_loop_delays_s, planned_loop_delays_s
from gcs.plan.flight_plan import FlightPlan, onboard_timing
from gcs.plan.mismatch import Window
from scenarios.keys.own import BUILT_IN

_STEP, _STEPS = 0.1, 100
"""Steps, in margins of the whole loop, in which the edge of a shared loop is searched, and their number."""
_HALVINGS = 8
_MOST_BY_GROWTH, _MOST_SHARING = 6, 20
"""Most vehicles of a shared loop whose edge is found by its growth rate, which takes seconds, and by any way at all."""


def is_modelled(plan: FlightPlan) -> bool:
    """Whether the models of `plan_loops` describe the flights: not those of a law that is not linear, or of dynamics of
    one's own, of which they tell only which vehicles are coupled."""
    return not isnan(plan.delay_margin_s) and plan.scenario.dynamics in BUILT_IN


def plan_loops(plan: FlightPlan) -> list[CoupledBlock]:
    """The coupled blocks of a plan, with the vehicles' responses if they are known."""
    responses = plan.responses_in_order if is_modelled(plan) else None
    return coupled_blocks(
        plan.model,
        plan.gain,
        plan.formation.system_ids,
        timing=plan.timing,
        onboard=onboard_timing(plan.scenario),
        assumed_s=plan.assumed_s,
        responding=None if responses is None else formation_loop(plan.model, plan.gain, responses),
        response_states=() if responses is None else response_states(plan.model, responses),
    )


def loop_of(plan: FlightPlan, system_id: int) -> CoupledBlock:
    """The loop of a vehicle."""
    return next(block for block in plan_loops(plan) if system_id in block.system_ids)


def growth_1_s(block: CoupledBlock, loop_delay_s: Mapping[int, float]) -> float:
    """The growth at expected loop delays."""
    return block.growth_at_1_s(loop_delay_s, _ages_s(block, loop_delay_s))


def _ages_s(block: CoupledBlock, loop_delay_s: Mapping[int, float]) -> dict[int, float]:
    """The ages of states at the station: half of the link delay and of the waiting have passed."""
    return {own: (at_s + block.timing.faster_s / 2.0) / 2.0 for own, at_s in loop_delay_s.items()}


def _is_stable(plan: FlightPlan, block: CoupledBlock, loop_delay_s: Mapping[int, float]) -> bool:
    """Whether a loop is predicted to be stable at expected loop delays, by the number of its roots.

    In flights with three vehicles this was right to 0.2 % of the delay on the ground, and to 0.02 % on board.
    """
    on_board = plan.scenario.control.loop == "onboard"
    return block.is_stable_at(loop_delay_s, None if on_board else _ages_s(block, loop_delay_s))


def growth_of(plan: FlightPlan, system_id: int) -> Callable[[float], float]:
    """The growth (1/s) predicted of a vehicle's loop at its loop delay (s), with all other links as in the scenario."""
    block, expected_s = loop_of(plan, system_id), planned_loop_delays_s(plan)
    return lambda delay_s: growth_1_s(block, expected_s | {system_id: delay_s})


def window_of(plan: FlightPlan, system_id: int, *, quick: bool = False) -> Window:
    """The loop delays of one vehicle between which its loop is predicted to be stable; NaN if no model predicts it.

    The links of all other vehicles stay as they are in the scenario. In a shared loop that is unstable over them, the
    shorter delays of this vehicle are searched; (0, 0) if none makes it stable. Its ends are where the growth changes
    sign, which agrees with flights to 0.1 %; `quick` or for many vehicles, where the number of roots changes.
    """
    block = loop_of(plan, system_id)
    if not is_modelled(plan):
        return 0.0, plan.delay_margin_s
    if len(block.system_ids) == 1:
        return block.window_s()
    if block.margin_s() == inf:
        return 0.0, inf
    expected_s = planned_loop_delays_s(plan)

    def is_stable_at(delay_s: float) -> bool:
        delays_s = expected_s | {system_id: delay_s}
        if quick or len(block.system_ids) > _MOST_BY_GROWTH:
            return _is_stable(plan, block, delays_s)
        return growth_1_s(block, delays_s) < 0.0

    now_s = expected_s[system_id]
    step_s, stable = _STEP * block.margin_s(), is_stable_at(now_s)
    shorter_s = 0.0
    if plan.assumed_s is not None or not stable:
        shorter_s = _edge_s(is_stable_at, now_s, -step_s, end_s=0.0, stable=stable)
    return (shorter_s, _edge_s(is_stable_at, now_s, step_s, end_s=inf, stable=True)) if stable else (0.0, shorter_s)


def _edge_s(is_stable_at: Callable[[float], bool], at_s: float, step_s: float, *, end_s: float, stable: bool) -> float:
    """Where stability ends or, if the loop is not `stable` to begin with, begins; `end_s` if it does not."""
    for _ in range(_STEPS):
        inner_s, at_s = at_s, at_s + step_s
        at_s = max(0.0, at_s)
        if is_stable_at(at_s) != stable:
            for _ in range(_HALVINGS):
                middle_s = (inner_s + at_s) / 2.0
                inner_s, at_s = (middle_s, at_s) if is_stable_at(middle_s) == stable else (inner_s, middle_s)
            return (inner_s + at_s) / 2.0
        if at_s == 0.0:
            break
    return end_s


def unstable_over_links(plan: FlightPlan, *, but: int | None = None) -> list[int]:
    """The vehicles whose loops are predicted to be unstable over the scenario's links, outside the loop of `but`."""
    expected_s = planned_loop_delays_s(plan)
    loops = plan_loops(plan) if is_modelled(plan) else []
    unstable = [each for each in loops if but not in each.system_ids and not _is_stable(plan, each, expected_s)]
    return [own for block in unstable for own in block.system_ids]


def links_differ(plan: FlightPlan, block: CoupledBlock) -> bool:
    """Whether vehicles share this loop over links that differ, so that its margin says little, and a model knows more.

    Never with prediction, nor with more vehicles than are searched.
    """
    if plan.scenario.control.prediction != "off" or not is_modelled(plan) or len(block.system_ids) > _MOST_SHARING:
        return False
    delays_s = planned_loop_delays_s(plan)
    return len({delays_s[own] for own in block.system_ids}) > 1


def link_delays_left_s(plan: FlightPlan) -> dict[int, float]:
    """How much more delay each vehicle's link takes with all others as in the scenario: NaN where it is not known.

    In a shared loop on board it is not: a link up delays the commands of others, too.
    """
    now_s, windows, left_s = effective_loop_delays_s(plan), dict[Hashable, Window](), dict[int, float]()
    for block in plan_loops(plan):
        for system_id in block.system_ids:
            alone = len(block.system_ids) == 1
            key = block.kind if alone else system_id
            known = alone or (block.extrapolated is not None and len(block.system_ids) <= _MOST_SHARING)
            if key not in windows:
                windows[key] = window_of(plan, system_id) if known else (0.0, nan)
            left_s[system_id] = windows[key][1] - now_s[system_id]
    return left_s


def margins_over_links_s(plan: FlightPlan) -> tuple[float, ...] | None:
    """The margin (s) of each of the plan's gains over the scenario's links; None where those for equal delays serve.

    They do unless vehicles share a loop over links that differ. Then the margin counts for the slowest of them.
    """
    if plan.separable or not any(links_differ(plan, block) for block in plan_loops(plan)):
        return None
    expected_s, margins_s = planned_loop_delays_s(plan), list[float]()
    for each in (replace(plan, gain=K) for K in plan.gains):
        margins_s.append(inf)
        for block in plan_loops(each):
            differ, slowest_s = links_differ(each, block), max(expected_s[own] for own in block.system_ids)
            margins_s[-1] = min(margins_s[-1], slowest_s * breaking_factor(each, block) if differ else block.margin_s())
    return tuple(margins_s)


def plan_over_links(plan: FlightPlan) -> FlightPlan:
    """The plan with its margins over the scenario's links.

    The plan itself where those for equal delays serve, or vehicles have responses that are not known yet.
    """
    known = plan.scenario.dynamics != "autopilot" or plan.responses is not None
    margins_s = margins_over_links_s(plan) if known else None
    if margins_s is None or margins_s == plan.margins_s:
        return plan
    own_s = {**plan.own_margins_s, **_own_margins_s(plan, margins_s)}
    return replace(plan.with_margins(margins_s, plan.responses), own_margins_s=own_s)


def _own_margins_s(plan: FlightPlan, margins_s: tuple[float, ...]) -> dict[int, tuple[float, ...]]:
    """What the loop delay of each vehicle alone may be (s) with each of the plan's gains, by row.

    Only of vehicles that share a loop on the ground over links that differ, all others as in the scenario. `margins_s`
    are those of `margins_over_links_s`: the slowest vehicle keeps them if they are less, and all do if their links are
    past them.
    """
    expected_s, own_s = planned_loop_delays_s(plan), dict[int, list[float]]()
    if plan.scenario.control.loop == "onboard":
        return {}
    for each, margin_s in zip((replace(plan, gain=K) for K in plan.gains), margins_s, strict=True):
        for block in plan_loops(each):
            if not links_differ(each, block):
                continue
            slowest = max(block.system_ids, key=expected_s.__getitem__)
            for own in block.system_ids:
                found = margin_s
                if margin_s > expected_s[slowest]:
                    alone_s = window_of(each, own, quick=True)[1]
                    found = min(margin_s, alone_s) if own == slowest else alone_s
                own_s.setdefault(plan.formation.row(own), []).append(found)
    return {row: tuple(found) for row, found in own_s.items() if len(found) == len(plan.gains)}


def unlimited(plan: FlightPlan) -> dict[int, tuple[float, ...]]:
    """The margins, infinite, of the vehicles none of whose feedback is late, by row; empty if all are such."""
    row, blocks = plan.formation.row, plan_loops(plan)
    late = [block for block in blocks if block.has_late_terms]
    at_once = [own for block in blocks if not block.has_late_terms for own in block.system_ids]
    return {row(own): (inf,) * len(plan.gains) for own in at_once} if late else {}


def breaking_factor(plan: FlightPlan, block: CoupledBlock) -> float:
    """How many times its expected loop delays a loop takes that vehicles share; 0 if it is unstable at any."""
    expected_s = planned_loop_delays_s(plan)
    own_s = {own: expected_s[own] for own in block.system_ids}
    if block.margin_s() == inf:
        return inf

    def is_stable_at(factor: float) -> bool:
        return _is_stable(plan, block, {own: factor * at_s for own, at_s in own_s.items()})

    stable, step = is_stable_at(1.0), _STEP * block.margin_s() / max(own_s.values())
    return _edge_s(is_stable_at, 1.0, step if stable else -step, end_s=inf if stable else 0.0, stable=stable)
