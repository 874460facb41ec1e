"""The value that a scenario's design reaches for every criterion."""

from dataclasses import replace
from math import inf

import numpy as np

from gains.core.errors import BadModelError
from gains.core.requirement import plain
from gains.criteria.bound import alpha_bound
from gains.criteria.figures import LoopFigures
from gains.formation.model import FormationModel
from gains.varying.jitter import bound_covering
from gcs.plan.at_delay import flown_timing
from gcs.plan.design import CriteriaPart, Design
from gcs.plan.expected_delay import expected_loop_delay_s
from gcs.plan.formation import plan_formation
from scenarios.schema import Scenario

_QUICK_STATES = 12
"""Maximum number of states per axis for which criteria are computed before a flight; with more they take too long."""


def with_criteria(design: Design, scenario: Scenario, *, most_states: float = _QUICK_STATES) -> Design:
    """The design with its quick `criteria`; unchanged if it is unstable or too large, or `_figures` is None."""
    try:
        found = _found(design, scenario, most_states)
    except BadModelError:
        # the gains are so large that the delay spans too many cycles of the loop
        return design
    return design if found is None else design.model_copy(update={"criteria": found})


def _found(design: Design, scenario: Scenario, most_states: float) -> CriteriaPart | None:
    figures = _figures(design, scenario)
    if figures is None or figures.model.states > most_states or figures.decay_rate_1_s <= 0.0:
        return None
    spacing_gain_s2 = plain(figures.spacing_gain_max_s2)
    delay_s = figures.delay_s or 0.0
    if figures.timing.all_late and figures.is_stable_at_delay != (delay_s < figures.delay_margin_s):
        # at this slow rate, half a hold as delay misjudges stability
        figures, spacing_gain_s2 = replace(figures, discrete=True), None
    return CriteriaPart(
        at_delay_s=delay_s,
        damping=figures.damping_min,
        natural_frequency_rad_s=figures.natural_frequency_max_rad_s,
        alpha_at_delay=figures.alpha_at_delay,
        decay_rate_at_delay_1_s=figures.decay_rate_at_delay_1_s,
        spacing_gain_s2=spacing_gain_s2,
        noise_gain=plain(figures.noise_gain_max) if figures.timing.all_late else None,
        weight=figures.weight or (1.0, 1.0),
        discrete=figures.discrete,
    )


def with_bounds(design: Design, scenario: Scenario) -> Design:
    """The design with the slow criteria as well: the bound on α for any controller, and those of varying delays."""
    design = with_criteria(design, scenario, most_states=inf) if design.criteria is None else design
    figures, found = _figures(design, scenario), design.criteria
    if figures is None or found is None or not figures.timing.all_late:
        return design
    more: dict[str, object] = {}
    period_s, keys = figures.timing.period_s, scenario.control.criteria
    if figures.weight is None and figures.responses is None and not figures.discrete:
        # if the vehicle in front does not hear the one behind, the bound for the follower alone holds for both
        tree = design.inclusion_gains is not None
        keep = slice(1, None) if tree else slice(None)
        A, B = figures.model.A[keep, keep], figures.model.B[keep, keep]
        more["alpha_bound"] = alpha_bound(A, B, found.at_delay_s + period_s / 2.0)
    if figures.responses is None and figures.decay_rate_at_delay_1_s > 0.0:
        spread_s = figures.proved_spread_s(found.at_delay_s, inf)
        more["delays_jumping_s"] = max(found.at_delay_s - spread_s, 0.0), found.at_delay_s + spread_s
    if keys is not None and keys.delays_s is not None:
        low_s, high_s = keys.delays_s
        rate = inf if keys.delay_rate is None else keys.delay_rate
        more |= _cover(figures, low_s, high_s, rate)
    return design.model_copy(update={"criteria": found.model_copy(update=more)})


def _cover(figures: LoopFigures, low_s: float, high_s: float, rate: float) -> dict[str, object]:
    """Names the bound that proves stability for all delays from `low_s` to `high_s`, and the delay up to which it does.

    If delays of more than two vehicles vary, only the spread bound is tried: other bounds take minutes to compute.
    """
    hold_s, middle_s, spread_s = figures.timing.period_s / 2.0, (low_s + high_s) / 2.0, (high_s - low_s) / 2.0
    if figures.model.vehicles > 2 and rate > 0.0:
        proved_s = figures.proved_spread_s(middle_s, rate)
        is_covered = proved_s >= spread_s
        return {
            "delays_covered_by": "spread" if is_covered else "none",
            "delays_covered_to_s": middle_s + proved_s if is_covered else None,
        }
    A0, A1, varies_s = figures.model.A, figures.model.B @ figures.K, spread_s if rate > 0.0 else 0.0
    cover = bound_covering(A0, A1, mean_s=middle_s + hold_s, spread_s=varies_s, rate=rate)
    return {"delays_covered_by": cover.cover, "delays_covered_to_s": plain(cover.bound_s - hold_s)}


def _figures(design: Design, scenario: Scenario) -> LoopFigures | None:
    """Figures of a design's fastest gains on one axis; None with prediction, feed-forward, one vehicle or no margin."""
    if design.prediction is not None or design.feed_forward or design.vehicles < 2 or design.margin_unknown:
        return None
    known = [own.response for own in design.response.vehicles] if design.response else []
    formation = plan_formation(scenario).model
    if design.inclusion_gains is not None:
        pair = FormationModel((-1, 0), axes=1)
        model, gain = pair, pair.overlapping_gain(*([[block[0][0]]] for block in design.inclusion_gains))
        responses = (max(known, key=lambda own: own.lag_s),) * 2 if known else None
    else:
        model, gain = formation.narrowed(np.array(design.K))
        responses = tuple(known) if known else None
    keys = scenario.control.criteria
    expected_s = design.at_loop_delay.loop_delay_s if design.at_loop_delay else None
    delay_s = (keys and keys.at_delay_s) or expected_s or expected_loop_delay_s(scenario)
    weight, discrete = (keys.weight, keys.discrete) if keys else (None, False)
    return LoopFigures(model, gain, flown_timing(design), delay_s, weight, responses, discrete=discrete)
