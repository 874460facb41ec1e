"""α and the growth of spacing errors at a loop delay, that expected of a scenario's links or one measured in flight.

What a design says of them without delay says little of a flight: `gains.performance.flown_loop` has the loop as it is
flown.
"""

from math import inf

import numpy as np

from gains.core.requirement import plain
from gains.performance.flown_loop import ALPHA_KEPT, FlownLoop
from gains.performance.response import Response
from gains.performance.scalar_gains import ScalarGains
from gcs.plan.design import Design, FiguresAtDelay, FiguresAtExpectedDelay
from scenarios.schema import Jitter, Link, Scenario


def expected_loop_delay_s(scenario: Scenario) -> float:
    """The loop delay (s) to be expected of the slowest links, at the slowest of their delay points.

    Up and down with the mean of their jitter, and half of the shorter period of telemetry and control: on average the
    first command computed from a state waits that long, from none to a whole period as the phases of vehicle and
    station happen to be. On board the state of the slowest link up may be needed on the slowest link down.
    """
    links = [scenario.link_of(vehicle.system_id) for vehicle in scenario.vehicles]
    if scenario.control.loop == "onboard":
        around_s = max(_mean_delay_s(up) for up, _ in links) + max(_mean_delay_s(down) for _, down in links)
    else:
        around_s = max(_mean_delay_s(up) + _mean_delay_s(down) for up, down in links)
    return around_s + 0.5 / max(scenario.rates.telemetry_hz, scenario.rates.control_hz)


def _mean_delay_s(link: Link) -> float:
    constant_s = max((point.delay_s for point in link.delay_points), default=link.delay_s)
    return constant_s + (_mean_jitter_s(link.jitter) if link.jitter is not None else 0.0)


def _mean_jitter_s(jitter: Jitter) -> float:
    match jitter.distribution:
        case "exponential":
            return jitter.scale_s or 0.0
        case "gamma":
            return (jitter.scale_s or 0.0) * (jitter.shape or 0.0)
        case "trace":
            return float(np.mean(jitter.trace_s or (0.0,)))
        case _:
            return 0.0


def with_figures_at_delay(design: Design, scenario: Scenario) -> Design:
    """The design with `at_loop_delay`: the figures at the expected loop delay, and how much delay leaves them whole.

    Gains on a pattern have none of it: there errors do not run down a chain.
    """
    loops = _flown_loops(design)
    if not loops:
        return design
    requirement = design.requirement
    peak = (requirement and requirement.string_peak_max) or 1.0
    # of different vehicles the one that leaves least
    alpha = (requirement and requirement.alpha) or ALPHA_KEPT * min(loop.alpha(0.0) for loop in loops)
    flown = figures_at(design, expected_loop_delay_s(scenario))
    kept = FiguresAtExpectedDelay(
        loop_delay_s=flown.loop_delay_s,
        alpha=flown.alpha,
        string_peak=flown.string_peak,
        alpha_kept=alpha,
        alpha_kept_to_s=plain(min(loop.alpha_limit_s(alpha) for loop in loops)),
        string_peak_kept=peak,
        string_peak_kept_to_s=plain(min(loop.string_limit_s(peak) for loop in loops)),
    )
    return design.model_copy(update={"at_loop_delay": kept})


def figures_at(design: Design, delay_s: float | None, gain_set: int = 0) -> FiguresAtDelay:
    """Loop delay, α and string peak of a design's gain set at a loop delay (s); None where unknown or unbounded."""
    loops = [] if delay_s is None else _flown_loops(design, gain_set)
    if not loops or delay_s is None:
        return FiguresAtDelay(loop_delay_s=delay_s)
    return FiguresAtDelay(
        loop_delay_s=delay_s,
        alpha=min(loop.alpha(delay_s) for loop in loops),
        string_peak=plain(max(loop.string_peak(delay_s) for loop in loops)),
    )


def _flown_loops(design: Design, gain_set: int = 0) -> list[FlownLoop]:
    """The loops of the followers of an inclusion design, one for each way in which vehicles answer; else none."""
    gains = design.inclusion_gains
    if gains is None or design.vehicles < 2:
        return []
    share, margin_s = 1.0, design.delay_margin_s
    if design.schedule:
        entry = design.schedule[gain_set]
        share, margin_s = entry.streamed_share, entry.delay_margin_s
        gains = entry.K1_1_s or gains[0], entry.K2_1_s or gains[1], entry.K3_1_s2 or gains[2]
    own, front, spacing = (gain[0][0] for gain in gains)
    if not (own < 0.0 < spacing):
        return []
    answers = {(v.lag_s, v.velocity_gain_1_s) for v in (design.response.vehicles if design.response else ())}
    return [
        FlownLoop(
            ScalarGains(-own, front * share, spacing, 0.0),
            delay_margin_s=inf if margin_s is None else margin_s,
            period_s=design.period_s,
            loop=design.loop,
            step_s=1.0 / design.onboard.rate_hz if design.onboard else 0.0,
            response=None if answer is None else Response(*answer),
        )
        for answer in sorted(answers) or [None]
    ]
