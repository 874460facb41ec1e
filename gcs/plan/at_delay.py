"""α and the growth of spacing errors at a loop delay: the one expected over a scenario's links, or one measured.

A design's figures without delay say little about a flight; `gains.performance.flown` computes those at a loop delay.
Gains on a pattern other than a leader-follower tree have only an α: errors run both ways, and no growth from vehicle to
vehicle is defined.
"""

from math import inf

import numpy as np

from gains.core.requirement import plain
from gains.criteria.predicted import PredictedFigures
from gains.design.time_scale import time_scaled
from gains.performance.flown import ALPHA_KEPT, FlownFormation, FlownLoop, FlownTiming
from gains.performance.scalar_gains import PAIR, ScalarGains
from gains.sampled.onboard import own_part
from gcs.plan.design import Design, FiguresAtDelay, FiguresAtExpectedDelay, GainSet
from gcs.plan.expected_delay import planned_loop_delays_s
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.formation import plan_formation
from scenarios.schema import Scenario


def with_figures_at_delay(design: Design, plan: FlightPlan) -> Design:
    """The design with `at_loop_delay`: the figures at the expected loop delay, and the delays up to which they hold."""
    scenario = plan.scenario
    delays_s = planned_loop_delays_s(plan).values()
    figures = figures_at(design, scenario, max(delays_s)).model_dump() | {
        "delays_differ": min(delays_s) < max(delays_s)
    }
    if figures["alpha"] is None:
        return design
    if not _is_predicted(design):
        flown, chains = _flown(design, scenario)
        requirement = design.requirement
        peak = ((requirement and requirement.string_peak_max) or 1.0) if chains else None
        # if vehicles differ, the smallest value counts
        alpha = (requirement and requirement.alpha) or ALPHA_KEPT * min(formation.alpha(0.0) for formation in flown)
        figures |= {
            "alpha_kept": alpha,
            "alpha_kept_to_s": plain(min(formation.alpha_limit_s(alpha) for formation in flown)),
            "string_peak_kept": peak,
            "string_peak_kept_to_s": plain(min(loop.string_limit_s(peak) for loop in chains)) if peak else None,
        }
    return design.model_copy(update={"at_loop_delay": FiguresAtExpectedDelay(**figures)})


def figures_at(design: Design, scenario: Scenario, delay_s: float | None, gain_set: int = 0) -> FiguresAtDelay:
    """α and the string peak of a design's gain set at a loop delay (s)."""
    unknown = FiguresAtDelay(loop_delay_s=delay_s, has_string_verdict=False)
    if delay_s is None or design.vehicles < 2 or design.margin_unknown:
        return unknown
    discrete = False
    if _is_predicted(design):
        followers = _predicted_followers(design, delay_s, gain_set)
        alphas, peaks = [own.alpha_at_delay for own in followers], [own.string_peak for own in followers]
    else:
        flown, chains = _flown(design, scenario, gain_set)
        alphas, peaks = [own.alpha(delay_s) for own in flown], [own.string_peak(delay_s) for own in chains]
        if discrete := any(own.timing.is_misjudged(delay_s) for own in flown):
            peaks = []
    if not alphas:
        return unknown
    return FiguresAtDelay(
        loop_delay_s=delay_s,
        alpha=min(alphas),
        discrete=discrete,
        has_string_verdict=bool(peaks),
        string_peak=plain(max(peaks)) if peaks else None,
    )


def _is_predicted(design: Design) -> bool:
    """Whether the loop predicts or feeds forward; `gains.criteria.predicted` then has its figures."""
    return design.prediction is not None or design.feed_forward > 0.0


def _predicted_followers(design: Design, delay_s: float, gain_set: int) -> list[PredictedFigures]:
    """One follower's figures for each response, if predicted or fed forward; only for inclusion gains on the ground."""
    if design.inclusion_gains is None or design.onboard is not None:
        return []
    assumed_s = 0.0
    if design.prediction is not None:
        fixed_s = design.prediction.assumed_delay_s
        assumed_s = delay_s if fixed_s is None else fixed_s
    return [
        PredictedFigures(
            PAIR,
            chain.gains.K,
            design.period_s,
            assumed_s,
            (delay_s,),
            chain=True,
            response=chain.response,
            feed_forward=design.feed_forward,
        )
        for chain in _follower_loops(design, _gain_set(design, gain_set))
    ]


def _flown(design: Design, scenario: Scenario, gain_set: int = 0) -> tuple[list[FlownFormation], list[FlownLoop]]:
    """The formations that have an α, and the loops of followers in a leader-follower tree; either may be empty."""
    entry = _gain_set(design, gain_set)
    if design.inclusion_gains is not None:
        chains = _follower_loops(design, entry)
        return [chain.pair for chain in chains], chains
    return [_flown_formation(design, entry, scenario)] if design.K is not None else [], []


def _gain_set(design: Design, place: int) -> GainSet:
    return design.schedule[place] if design.schedule else GainSet(delay_margin_s=design.delay_margin_s)


def _follower_loops(design: Design, entry: GainSet) -> list[FlownLoop]:
    """The loops of the followers of an inclusion design, one for each response that vehicles have."""
    gains = entry.K1_1_s or design.K1_1_s, entry.K2_1_s or design.K2_1_s, entry.K3_1_s2 or design.K3_1_s2
    own, front, spacing = (0.0 if gain is None else gain[0][0] for gain in gains)
    if not (own < 0.0 < spacing):
        return []
    scalar = ScalarGains(-own, front * entry.streamed_share, spacing, 0.0)
    timing = flown_timing(design, entry)
    return [FlownLoop(scalar, timing, answer) for answer in set(design.responses.values()) or [None]]


def _flown_formation(design: Design, entry: GainSet, scenario: Scenario) -> FlownFormation:
    """The formation with the gains of one entry of a graph design's schedule."""
    formation = plan_formation(scenario)
    model, first = formation.model, np.array(design.K)
    scaled = time_scaled(model, first, entry.time_scale)
    own = own_part(model, scaled)
    answers = design.responses
    return FlownFormation(
        model,
        own + entry.streamed_share * (scaled - own),
        flown_timing(design, entry),
        tuple(answers[system_id] for system_id in formation.system_ids) if answers else None,
    )


def flown_timing(design: Design, entry: GainSet | None = None) -> FlownTiming:
    """The timing of a design's loop, with the margins of an entry of its schedule if one is given."""
    step_s = 1.0 / design.onboard.rate_hz if design.onboard is not None else 0.0
    margins_s = (None, None) if entry is None else (entry.delay_margin_s, entry.delay_margin_continuous_s)
    sampled_s, continuous_s = (inf if margin_s is None else margin_s for margin_s in margins_s)
    return FlownTiming(sampled_s, design.period_s, design.loop, step_s, continuous_s)
