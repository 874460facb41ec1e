"""Chooses gains for measured links: finds the loop delay and its spread, and the best gains for these.

The measured one-way delays and losses of each vehicle are resampled at the scenario's rates. Two designs are
compared: gains without prediction, at the worst loop delay, and gains with prediction over the median delay, at the
worse of the least and the worst delay. Either must keep the wanted headroom.
"""

from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np

from gains.core.errors import GainsError
from gains.core.requirement import Criteria, Requirement
from gains.criteria.figures import LoopFigures
from gains.criteria.predicted import PredictedFigures
from gains.design.for_delay import criteria_gains
from gains.design.front import Aim
from gains.design.predicted import predicted_gains
from gains.performance.flown import FlownLoop, FlownTiming
from gains.performance.response import Response
from gains.performance.scalar_gains import PAIR, ScalarGains
from gcs.errors import InputError
from gcs.plan.design import GainsAtDelay, LinkPart
from gcs.plan.expected_delay import drawn_loop_delays_s
from gcs.plan.flight_plan import given_response, loop_timing
from gcs.plan.given import with_given
from gcs.watch.rebuild_report import find_log
from gcs.watch.saved_links import LinkRecorder, recorded
from gcs.watch.tlog import read_tlog
from scenarios.keys.part import PREDICTION_MAX_S
from scenarios.schema import FixedGains, Scenario

OPTION = "--links-of"
LEAST_SHARE = 0.2
"""Prediction must tolerate a mismatch to either side of at least this share of the delay, and of at least a control
period, because delays in flight will differ from those measured."""


def delays_of(recorder: LinkRecorder, source: str, scenario: Scenario) -> LinkPart:
    """The loop delays that a scenario would have over measured links; `source` says where these are from.

    The slowest vehicle's median and, around it, the widest spread of any vehicle to its 1st and to its 99th percentile.
    """
    spreads: list[list[float]] = []
    lost_share = 0.0
    for system_id in recorder.measured:
        profile = recorder.profile(source, only=system_id)
        if (loss := profile.up.loss_bursts) is not None:
            lost_share = max(lost_share, loss.to_bad_probability / (loss.to_bad_probability + loss.to_good_probability))
        drawn_s = drawn_loop_delays_s(scenario, profile.up, profile.down)
        spreads.append(np.percentile(drawn_s[np.isfinite(drawn_s)], [1.0, 50.0, 99.0]).tolist())
    median_s = max(middle_s for _, middle_s, _ in spreads)
    shorter_s = max(middle_s - low_s for low_s, middle_s, _ in spreads)
    longer_s = max(high_s - middle_s for _, middle_s, high_s in spreads)
    return LinkPart(
        source=source,
        vehicles=tuple(recorder.measured),
        loop_delay_s_least=max(0.0, median_s - shorter_s),
        loop_delay_s_p50=median_s,
        loop_delay_s_worst=median_s + longer_s,
        headroom=scenario.control.link_headroom,
        lost_share=lost_share,
    )


def for_measured_links(scenario: Scenario, run_or_file: Path) -> tuple[Scenario, LinkPart]:
    """The scenario with the best gains for the links in a run's folder or a telemetry log, and the reasons for them.

    Raises InputError if the log shows too little, or no gains tolerate the delays.
    """
    log_file = find_log(run_or_file).log_file
    recorder = recorded(read_tlog(log_file).frames)
    if not recorder.measured:  # this raises the error that says what is missing
        recorder.profile(str(log_file), option=f"{OPTION}: {log_file}")
    return best_for(scenario, delays_of(recorder, str(run_or_file), scenario))


def best_for(scenario: Scenario, delays: LinkPart) -> tuple[Scenario, LinkPart]:
    """The scenario with the best gains for these delays, and the reasons. Raises InputError if none tolerate them."""
    criteria = scenario.control.criteria
    aim: Aim = "alpha_at_delay"
    if criteria is not None and criteria.maximise == "decay_rate_1_s":
        aim = "decay_rate_at_delay_1_s"
    candidates = tuple(_candidate(scenario, delays, aim, predicted=predicted) for predicted in (False, True))
    figure = "alpha" if aim == "alpha_at_delay" else "decay_rate_1_s"
    fit = [own for own in candidates if not own.refused]
    if not fit:
        reasons = "; ".join(f"{_name(own)}: {own.refused}" for own in candidates)
        worst = f"a loop delay of {1e3 * delays.loop_delay_s_worst:.1f} ms"
        raise InputError(f"control.for_link: read {worst} from {delays.source}, wanted one that gains take: {reasons}")
    best = max(fit, key=lambda own: getattr(own, figure))
    others = [own for own in candidates if own is not best]
    against = [own.refused or f"{getattr(own, figure):.4g} {_name(own)}" for own in others]
    chosen = f"{_name(best)}: {figure} {getattr(best, figure):.4g} at the worst delay, against {'; '.join(against)}"
    part = delays.model_copy(update={"maximised": figure, "chosen": chosen, "candidates": candidates})
    assert best.K1 is not None
    assert best.K2 is not None
    assert best.K3 is not None
    gains = FixedGains(K1=best.K1, K2=best.K2, K3=best.K3)
    return with_given(scenario, gains=gains, prediction="measured" if best.prediction else "off"), part


def _name(own: GainsAtDelay) -> str:
    return "with prediction" if own.prediction else "without prediction"


def _candidate(scenario: Scenario, delays: LinkPart, aim: Aim, *, predicted: bool) -> GainsAtDelay:
    control, period_s, response = scenario.control, loop_timing(scenario).held_s, given_response(scenario)
    criteria = Criteria(**control.criteria.model_dump()) if control.criteria is not None else Criteria()
    middle_s, spare = delays.loop_delay_s_p50, 1.0 - delays.headroom
    ends_s = least_s, worst_s = delays.loop_delay_s_least, delays.loop_delay_s_worst
    around_s = max(worst_s - middle_s, middle_s - least_s)
    window_s = max(around_s / spare, LEAST_SHARE * middle_s, period_s)
    if predicted:
        window = max(0.0, middle_s - window_s), middle_s + window_s
        criteria = replace(criteria, at_delay_s=middle_s, maximise=aim, delays_s=window, delay_rate=0.0)
    else:
        criteria = replace(criteria, at_delay_s=worst_s, maximise=aim)
    if predicted and middle_s > PREDICTION_MAX_S:
        return GainsAtDelay(prediction=True, refused=f"the station predicts over at most {PREDICTION_MAX_S:g} s")
    try:
        margin_s = None if predicted else worst_s / spare
        wanted = Requirement(margin_s, string_peak_max=control.string_peak_max, criteria=criteria)
        if predicted:
            gains = predicted_gains(wanted, period_s, ends_s, response)
        else:
            gains = criteria_gains(wanted, period_s, response)
    except GainsError as error:
        return GainsAtDelay(prediction=predicted, refused=str(error))
    return evaluated(gains, period_s, middle_s if predicted else None, ends_s, response)


def evaluated(
    gains: ScalarGains,
    period_s: float,
    assumed_s: float | None,
    ends_s: tuple[float, float],
    response: Response | None = None,
) -> GainsAtDelay:
    """Gains with their exact figures: with prediction at the worse end of the delays, without it at the longer end."""
    K, responses = gains.K, None if response is None else (response, response)
    if assumed_s is not None:
        figures = PredictedFigures(PAIR, K, period_s, assumed_s, ends_s, chain=True, response=response)
        least_s, most_s = figures.window_s
        shorter = (assumed_s - ends_s[0]) / (assumed_s - least_s) if least_s > 0.0 else 0.0
        headroom = 1.0 - max(shorter, (ends_s[1] - assumed_s) / (most_s - assumed_s))
    else:
        timing = FlownTiming(inf, period_s)
        chain = FlownLoop(gains, timing, response)
        figures = LoopFigures(PAIR, K, timing, ends_s[1], responses=responses, chain=chain)
        least_s, most_s = 0.0, figures.delay_margin_s
        headroom = 1.0 - ends_s[1] / most_s
    return GainsAtDelay(
        prediction=assumed_s is not None,
        K1=-gains.k1,
        K2=gains.k2,
        K3=gains.k3,
        alpha=figures.alpha_at_delay,
        decay_rate_1_s=figures.decay_rate_at_delay_1_s,
        string_peak=figures.string_peak,
        spacing_gain_s2=figures.spacing_gain_max_s2,
        noise_gain=figures.noise_gain_max,
        stable_s=(least_s, most_s),
        headroom=headroom,
    )
