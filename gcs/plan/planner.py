"""Makes the design and the flight plan of a scenario: formation, gains, margins."""

from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.requirement import Criteria, Requirement, plain
from gains.criteria.predicted import fed_forward
from gains.design.design import Design as InclusionDesign
from gains.design.design import design, evaluate_gains, trade_off
from gains.design.graph import GraphDesign
from gains.design.required import requirement_with
from gains.design.time_scale import time_scaled
from gains.formation.model import FormationModel
from gains.formation.pattern import Pattern, leader_follower, overlapping, with_links, without_links
from gains.performance.response import Response, continuous_margin, sampled_margin
from gains.performance.string_stability import string_peak
from gcs.errors import InputError
from gcs.plan.at_delay import with_figures_at_delay
from gcs.plan.criteria import with_criteria
from gcs.plan.design import (
    Design,
    GainSet,
    LinkPart,
    OwnMargins,
    PredictionPart,
    ResponsePart,
    TradeOffPoint,
    VehicleResponse,
    WindowAt,
)
from gcs.plan.flight_plan import (
    FlightPlan,
    Responses,
    at_once,
    given_responses,
    loop_timing,
    margin_steps,
    onboard_timing,
)
from gcs.plan.formation import Formation, plan_formation
from gcs.plan.given import gain_blocks
from gcs.plan.loops import plan_over_links, unlimited
from gcs.plan.mismatch import assumption, continuous_window, proved_jump_s, window
from gcs.plan.onboard import onboard_plan
from gcs.plan.own_law import OWN_DYNAMICS, code_records, own_plan, with_unknown_margin
from scenarios.keys.own import BUILT_IN
from scenarios.schema import GainBlock, Scenario

_EQUATIONS = {
    "lag": "lag a' = u + g (v_s - v) - a, v_s' = u",
    "lag with dead time": "lag a' = w(t - dead time) - a, w = u + g (v_s - v), v_s' = u",
    "second order": "a'' / natural frequency^2 + lag a' = u + g (v_s - v) - a, v_s' = u",
}
MEASURED_WANTED = (
    "read measured, wanted measured links: gcs fly measures them, gcs check and design take --links-of RUN|FILE.tlog"
)
NOT_YET_KNOWN = "not yet known"
_MARGINS_AROUND_LOSS_S = 0.1, 30.0
"""Smallest and largest delay margin (s) of the gains flown around a lost vehicle."""
_REQUIRED = "delay_margin_s", "alpha", "decay_rate_1_s", "string_peak_max", "loop"
_SHOWN_S = (0.1, 0.3, 0.6, 1.0, 1.5, 3.0)
"""Assumed delays (s) at which a design shows its mismatch window, if the delay may exceed them by a period."""
_MORE = 1.1
"""If the margin at the scenario's rates falls short, a second design requires this multiple of the shortfall more."""


def flight_plan(scenario: Scenario, link: LinkPart | None = None) -> tuple[Design, FlightPlan]:
    """The design of a scenario and the plan to fly it. The design records `link`, the measured links, if given.

    Raises GainsError if the requirement cannot be met; InputError if links are unmeasured or a law or loop is refused.
    """
    if scenario.control.for_link == "measured":
        raise InputError(f"{scenario.name}: control.for_link: {MEASURED_WANTED}")
    if scenario.control.method == "python":
        design, plan = own_plan(scenario, flight_plan)
    else:
        design, plan = _gains_plan(scenario)
    if link is not None:
        design = design.model_copy(update={"for_link": link})
    if scenario.dynamics in BUILT_IN or design.margin_unknown:
        return design, plan
    if scenario.response is None:
        return with_unknown_margin(design, plan, OWN_DYNAMICS)
    return design.model_copy(update={"code": code_records(scenario)}), plan


def _gains_plan(scenario: Scenario) -> tuple[Design, FlightPlan]:
    """Design and plan of gains that are designed or given, by inclusion or on an information pattern.

    With K1 / s, K2 / s and K3 / s² the loop is s times slower and tolerates s times the delay.
    """
    formation, period_s = plan_formation(scenario), loop_timing(scenario).held_s
    model, scales, control = formation.model, scenario.monitor.time_scales, scenario.control
    responses, around_loss = given_responses(scenario), ()
    if control.method != "inclusion" or control.blocks:
        pattern = pattern_of(scenario, formation)
        first = _graph_design(scenario, formation, pattern)
        slowed = [time_scaled(model, first.K, s) for s in scales[1:]]
        found = [first, *(evaluate_gains(model, K, pattern=pattern, period_s=period_s) for K in slowed)]
        gains = [own.K for own in found]
        blocks = [gain_blocks(K, formation, pattern.links) for K in gains]
        schedule = [_entry(s, own, blocks=each) for s, own, each in zip(scales, found, blocks, strict=True)]
        ids = formation.system_ids
        parts = {"links": [(ids[i], ids[j]) for i, j in first.links], "blocks": blocks[0]}
        if control.loop != "onboard":  # inclusion gains of the same delay margin, within limits
            margin_s = float(np.clip(first.delay_margin_s, *_MARGINS_AROUND_LOSS_S))
            around = design(model, Requirement(delay_margin_s=margin_s, string_peak_max=1.0), period_s=period_s)
            K = model.overlapping_gain(around.K1, around.K2, around.K3)
            around_loss = tuple(time_scaled(model, K, s) for s in scales)
    else:
        first = _design(scenario, model, next(iter(responses.of.values())) if responses else None)
        slowed = [(first.K1 / s, first.K2 / s, first.K3 / s**2) for s in scales[1:]]
        fed = control.feed_forward
        found = [first, *(evaluate_gains(model, gain, period_s=period_s, feed_forward=fed) for gain in slowed)]
        gains = [fed_forward(model, model.overlapping_gain(own.K1, own.K2, own.K3), fed) for own in found]
        schedule = [_entry(s, own) for s, own in zip(scales, found, strict=True)]
        parts = {}
    plan = FlightPlan(
        scenario=scenario,
        formation=formation,
        gain=gains[0],
        delay_margin_s=first.delay_margin_s,
        slower=tuple((K, own.delay_margin_s) for K, own in zip(gains[1:], found[1:], strict=True)),
        separable=len(model.coupled_vehicles(gains[0])) == model.vehicles,
        around_loss=around_loss,
    )
    whole = Design.model_validate(first.to_dict() | {"schedule": schedule} | parts)
    return _flown_loop(*_with_responses(whole, plan, responses))


def over_own_links(design: Design, plan: FlightPlan) -> tuple[Design, FlightPlan]:
    """Design and plan with their margins over the scenario's links, if these differ.

    Otherwise, and for vehicles whose response is not known yet, they stay as they are.
    """
    flown = plan_over_links(plan)
    if flown is plan:
        return design, plan
    if flown.margins_s == plan.margins_s:
        return _with_own_margins(design, flown), flown
    continuous_s = [entry.delay_margin_continuous_s for entry in design.schedule]
    over_links = design.with_margins(flown.margins_s, continuous_s)
    return _with_own_margins(over_links.model_copy(update={"margin_over_links": True}), flown), flown


def _with_own_margins(design: Design, plan: FlightPlan) -> Design:
    """The design with the plan's margins of single vehicles."""
    every = zip(plan.formation.system_ids, map(plan.own_margins_s.get, range(plan.model.vehicles)), strict=True)
    own = tuple(OwnMargins(system_id=k, delay_margins_s=tuple(map(plain, own_s))) for k, own_s in every if own_s)
    return design.model_copy(update={"own_margins": own})


def with_trade_off(design: Design) -> Design:
    """The design with the best α at other delay margins, which takes longer to compute than all its other figures.

    Unchanged for gains on a pattern, for one vehicle, whose α is not a follower's, and for an unknown margin.
    """
    if design.inclusion_gains is None or design.vehicles == 1 or design.margin_unknown:
        return design
    wanted, fed = design.requirement or Requirement(), design.feed_forward
    points = trade_off(
        period_s=design.period_s, string_peak_max=wanted.string_peak_max, loop=wanted.loop, feed_forward=fed
    )
    return design.model_copy(update={"trade_off": tuple(TradeOffPoint(**asdict(point)) for point in points)})


def _flown_loop(design: Design, plan: FlightPlan) -> tuple[Design, FlightPlan]:
    """Design and plan of the loop as flown, with its figures at the loop delay, from those of the ground loop."""
    if plan.onboard is not None:
        design, plan = onboard_plan(design, plan)
    if own_s := unlimited(plan):
        plan = replace(plan, own_margins_s=own_s)
        design = _with_own_margins(design, plan)
    if plan.scenario.control.prediction != "off":
        design = design.model_copy(update={"prediction": _prediction(plan)})
    design = with_figures_at_delay(design, plan)
    return with_criteria(design, plan.scenario), plan


def _prediction(plan: FlightPlan) -> PredictionPart:
    """The mismatch windows of the fastest gains. Also computes the plan's tolerance, which takes too long in flight."""
    assumed_s = plan.assumed_s
    plan.tolerance(assumed_s or 0.0)
    # at a long assumed delay, gains for a short one tolerate almost nothing and the continuous window takes seconds
    flown = plan.predicted(plan.gain)
    fits = [at_s for at_s in _SHOWN_S if window(flown, at_s)[1] > at_s + plan.timing.held_s]
    found = {
        at_s: WindowAt(
            assumed_delay_s=at_s,
            mismatch_window_s=window(flown, at_s),
            mismatch_window_continuous_s=continuous_window(flown, at_s),
            jump_s=proved_jump_s(flown, at_s),
        )
        for at_s in sorted({assumed_s or _SHOWN_S[0], *fits})
    }
    own = dict.fromkeys(WindowAt.model_fields) if assumed_s is None else found[assumed_s].model_dump()
    return PredictionPart.model_validate(own | {"windows": tuple(found.values()), "assumes": assumption(plan.scenario)})


def _with_responses(whole: Design, plan: FlightPlan, responses: Responses | None) -> tuple[Design, FlightPlan]:
    if responses is None and not plan.response_is_known:
        whole = whole.model_copy(update={"response": ResponsePart(source=NOT_YET_KNOWN)})
    if responses is None and plan.timing.commands == 1:  # the case that the design was computed for
        return whole, plan
    if responses is not None:
        plan = plan.with_margins(tuple(at_once(margin_steps(plan, responses))), responses)
        return described(whole, plan), plan
    margins_s = tuple(sampled_margin(plan.model, K, None, timing=plan.timing) for K in plan.gains)
    continuous_s = [entry.delay_margin_continuous_s for entry in whole.schedule]
    return whole.with_margins(margins_s, continuous_s), plan.with_margins(margins_s, None)


def identified(design: Design, plan: FlightPlan) -> Design:
    """The design with the vehicles' responses, and with its sampled margins for these.

    Its other figures take a second to compute and are left out: a station in flight cannot wait for them.
    `delay_margin_at_once_s` is the margin of the same gains on vehicles that respond at once.
    """
    assert plan.responses is not None
    response = ResponsePart(
        source=plan.responses.source,
        model="; ".join(sorted({_EQUATIONS[found.model] for found in plan.responses.of.values()})),
        vehicles=tuple(
            VehicleResponse(
                system_id=system_id,
                model=found.model,
                damping=found.damping,
                misfit=plan.responses.misfit.get(system_id),
                **asdict(found),
            )
            for system_id, found in sorted(plan.responses.of.items())
        ),
        delay_margin_at_once_s=design.delay_margin_s,
    )
    known = design.with_margins(plan.margins_s, [None] * len(plan.gains), response=response)
    return known.model_copy(update={"at_loop_delay": None})


def described(design: Design, plan: FlightPlan) -> Design:
    """The design with the vehicles' responses, and with all its figures for these."""
    known = identified(design, plan)
    assert plan.responses is not None
    assert known.response is not None
    every = plan.responses.in_order(plan.formation.system_ids)
    continuous_s = [continuous_margin(plan.model, K, every) for K in plan.gains]
    response = known.response
    if (gains := design.inclusion_gains) is not None:  # inclusion gains, the same for all followers in a tree
        fed = design.feed_forward
        peaks = [string_peak(gains, 0.0, answer=answer.transfer, feed_forward=fed) for answer in set(every)]
        response = response.model_copy(update={"string_peak": max(peaks)})
    return with_figures_at_delay(known.with_margins(plan.margins_s, continuous_s, response=response), plan)


def _entry(time_scale: float, found: InclusionDesign | GraphDesign, **gains: Sequence[GainBlock]) -> GainSet:
    names = found.to_dict()
    known = {name: names[name] for name in GainSet.model_fields if name in names}
    return GainSet.model_validate({"time_scale": time_scale} | known | gains)


def _design(scenario: Scenario, model: FormationModel, response: Response | None) -> InclusionDesign:
    control, timing = scenario.control, loop_timing(scenario)
    if control.gains is not None:
        own, front, spacing = (gain * np.eye(2) for gain in (control.gains.K1, control.gains.K2, control.gains.K3))
        gains = own, front, spacing
        return evaluate_gains(model, gains, period_s=timing.held_s, feed_forward=control.feed_forward)
    wanted = _requirement(scenario)
    if wanted.criteria is None:
        return design(model, requirement_with(wanted, response, timing=timing), period_s=timing.held_s)
    return design(model, wanted, period_s=timing.held_s)


def _requirement(scenario: Scenario) -> Requirement:
    control = scenario.control
    return Requirement(
        **{name: getattr(control, name) for name in _REQUIRED},
        feed_forward=control.feed_forward if control.method == "inclusion" else 0.0,
        criteria=None if control.criteria is None else Criteria(**control.criteria.model_dump()),
    )


def _graph_design(scenario: Scenario, formation: Formation, pattern: Pattern) -> GraphDesign:
    control, timing, model = scenario.control, loop_timing(scenario), formation.model
    period_s = timing.held_s
    if control.blocks:
        return evaluate_gains(model, _given_gain(scenario, formation), pattern=pattern, period_s=period_s)
    assert control.method not in ("inclusion", "python")
    wanted, onboard = _requirement(scenario), onboard_timing(scenario)
    found = design(model, wanted, method=control.method, pattern=pattern, period_s=period_s, onboard=onboard)
    short_s = (wanted.delay_margin_s or 0.0) - sampled_margin(model, found.K, None, timing=timing)
    if onboard is None and timing.commands > 1 and short_s > 0.0:
        wanted = replace(wanted, delay_margin_s=(wanted.delay_margin_s or 0.0) + _MORE * short_s)
        found = design(model, wanted, method=control.method, pattern=pattern, period_s=period_s)
    return found


def pattern_of(scenario: Scenario, formation: Formation) -> Pattern:
    """The information pattern of a scenario: which vehicle may use whose errors."""
    row, tree = formation.row, leader_follower(formation.model)
    if scenario.control.blocks:
        none = without_links(tree, tree.links)
        return with_links(none, [(row(block.vehicle), row(block.of)) for block in scenario.control.blocks])
    if (more := scenario.control.overlap) is not None:
        tree = overlapping(formation.model, ahead=more.ahead, behind=more.behind, leader=more.leader)
    return with_links(tree, [(row(v.system_id), row(heard)) for v in scenario.vehicles for heard in v.hears])


def _given_gain(scenario: Scenario, formation: Formation) -> FloatArray:
    model, row = formation.model, formation.row
    K = np.zeros((model.inputs, model.states))
    for block in scenario.control.blocks:
        K[model.input_slice(row(block.vehicle)), model.output_slice(row(block.of))] = block.gain
    return K
