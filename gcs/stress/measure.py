"""Fly a trial and judge it: the growth rate of the loop that breaks first, and the verdict of the whole flight.

A *probe* measures the growth rate of one loop from its free response, in one flight or in two
(`gcs.stress.free_response`). An *own* trial flies the scenario's own initial states, large errors included, and gives
the verdict that `gcs fly` would give. In both, the monitor only watches: a trial tests the margin of the designed
gains, not the monitor's actions that keep a flight within it.
"""

import time  # noqa: TID251 - how long a trial takes is only reported; nothing flown depends on it
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from gains.sampled.coupled_block import CoupledBlock, critical_block
from gcs.control.tick import TickArray, chosen
from gcs.drive.flown import effective_delays_s, first_uses, fly_plan, median_ages_s, median_delays_s
from gcs.output import DISK_FULL
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.loops import is_modelled, plan_loops, plan_over_links
from gcs.runs.summary_record import rounded
from gcs.stress import free_response
from gcs.stress.axes import has_constant_links
from gcs.stress.free_response import FreeResponse
from gcs.stress.growth import FOLLOWER_MODES, Growth, envelope_growth, fit_growth, motion_of, norm_growth
from gcs.stress.trial import CRITICAL, TRACE_PERIOD_S, Outcome, Trial, plan_of, with_verdict

AMPLITUDES = (1.0, 0.03, 0.001)
"""Initial errors of a probe in m (m/s for the leader). The next is flown if errors leave the linear range too soon."""
_PILOT_S, _PILOT_PERIODS = 1.0, 6.0
_SETTLED_LOOP_DELAYS, _PREDICTED_LOOP_DELAYS = 4.0, 2.0
"""After this many loop delays, modes other than the slowest have decayed or are small enough to be fitted with it. The
second is for predicted loops, which may be at rest after four."""
_FLYING_LOOP_DELAYS = 1.0
"""For this many loop delays the station uses states of vehicles that are still on the launcher. In a loop without
delayed feedback, the fit can start after that."""
_BEGUN_LOOP_DELAYS = 2.0
"""After this many loop delays, no command depends on the start any more."""
_CALM_SHARE = 0.8
"""A disturbed flight is long enough if it stays in the linear range for this share of the calm flight's time."""
_WANTED_LOOP_DELAYS = 8.0
_WANTED_SAMPLES = 60
_WANTED_ERROR = 0.01
"""Wanted standard error as a share of the growth rate: in loops of several vehicles the other modes decay slowly."""


def fly_trial(trial: Trial, folder: Path | None = None) -> Outcome:
    """Fly a trial and judge it. An exception becomes the outcome's `error`; only a full disk is raised, as OSError.

    With `folder`, the files of its flight are kept there as `gcs fly` leaves them; a probe has one subfolder for each
    initial error flown. In real time, files are always written, but deleted again without `folder`.
    """
    began_s = time.perf_counter()
    at = dict(trial.coordinates)
    outcome = Outcome(trial.id, trial.kind, trial.scenario.seed, at, trial.real_time, trial.probe)
    try:
        measure = _own if trial.kind == "own" else _pair if _needs_pair(trial) else _probe
        outcome = measure(trial, outcome, folder)
    except Exception as error:
        if isinstance(error, OSError) and error.errno in DISK_FULL:
            raise
        outcome = replace(outcome, error=traceback.format_exc())
    return replace(outcome, elapsed_s=round(time.perf_counter() - began_s, 3))


def _needs_pair(trial: Trial) -> bool:
    """Whether the free response of a loop takes two flights; never in real time, where no two have the same delays.

    It takes two on links that vary. It also takes two if vehicles have different links, and either share a loop or the
    probed vehicle's link is the one that the campaign varies.
    """
    if trial.real_time or not has_constant_links(trial.scenario):
        return not trial.real_time
    links = {trial.scenario.link_of(vehicle.system_id) for vehicle in trial.scenario.vehicles}
    alone = _is_varied(trial.probe, dict(trial.coordinates))
    return len(links) > 1 and (alone or any(len(loop.system_ids) > 1 for loop in plan_loops(plan_of(trial))))


def _is_varied(probe: int, coordinates: Mapping[str, float]) -> bool:
    """Whether the campaign varies the delay of the probed vehicle's link alone."""
    return f"delay_{probe}" in coordinates


def _own(trial: Trial, outcome: Outcome, folder: Path | None) -> Outcome:
    plan = plan_over_links(plan_of(trial))  # with the margins of gcs fly
    flight = fly_plan(plan, real_time=trial.real_time, folder=folder)
    outcome = with_verdict(plan, flight, outcome)
    flown = chosen(flight.ticks, flight.ticks["time_s"] >= 0.0)
    delays_s = median_delays_s(flown, plan.formation.system_ids)
    ages_s = _ages_s(plan, flown)
    loop = critical_block(plan_loops(plan), delays_s, ages_s)
    loop_s, link_s, _ = _delays_of(plan, loop, delays_s, outcome)
    outcome = replace(outcome, critical=_named_vehicle(loop, delays_s, outcome), link_delay_s=link_s)
    if not _is_commanded(flown, loop):
        return outcome
    outcome = replace(outcome, loop_delay_s=round(loop_s, 9))
    outcome = _with_prediction(outcome, plan, loop, delays_s, ages_s)
    start_s = _BEGUN_LOOP_DELAYS * loop_s
    growth = envelope_growth(np.array(outcome.trace_m), period_s=TRACE_PERIOD_S, start_s=start_s)
    return outcome if growth is None else _with_fit(outcome, growth)


def _probe(trial: Trial, outcome: Outcome, folder: Path | None) -> Outcome:
    """Probe one loop in one flight, with all vehicles on the links of the loop that breaks first.

    That loop may be far down the tree, where vehicles ahead would drive it. The identical loop nearest to the leader is
    therefore probed in its place, with the links and the wait of the loop that breaks first.
    """
    base = plan_of(trial)
    pilot_s = max(_PILOT_S, _PILOT_PERIODS * base.timing.held_s)
    pilot = fly_plan(replace(base, scenario=base.scenario.model_copy(update={"duration_s": pilot_s})))
    fresh = first_uses(pilot.ticks)
    delays_s, loops = median_delays_s(fresh, base.formation.system_ids), plan_loops(base)
    critical = _loop_of(loops, delays_s, trial.probe)
    probed = next(loop for loop in loops if loop.kind == critical.kind) if trial.probe == CRITICAL else critical
    waiting_s = _delays_of(base, critical, delays_s, outcome)[2] % critical.timing.step_s
    up, down = links = base.scenario.link_of(critical.system_ids[0])
    known_s = round(waiting_s, 9) if _is_commanded(fresh, critical) else None
    outcome = replace(outcome, link_delay_s=up.delay_s + down.delay_s, waiting_s=known_s)
    named = _named_vehicle(critical, delays_s, outcome)

    def respond(amplitude: float) -> FreeResponse:
        ids, run = probed.system_ids, _folder_of(folder, amplitude)
        scenario = free_response.probe_scenario(base, ids, amplitude=amplitude, links=links, waiting_s=waiting_s)
        return free_response.response_alone(base, scenario, ids, real_time=trial.real_time, folder=run)

    return _with_response(probed, named, respond, outcome, amplitudes=_amplitudes(base))


def _pair(trial: Trial, outcome: Outcome, folder: Path | None) -> Outcome:
    """Probe the loop that breaks first on the scenario's own links, by the difference of two flights."""
    base = plan_of(trial)
    calm = free_response.fly_calm(base, _folder_of(folder, 0.0))
    delays_s = effective_delays_s(base, calm.ticks, calm, base.formation.system_ids)
    probed = _loop_of(plan_loops(base), delays_s, trial.probe, _ages_s(base, calm.ticks))
    _, link_s, waiting_s = _delays_of(base, probed, delays_s, outcome)
    past = free_response.past_limits(base.scenario, chosen(calm.ticks, calm.ticks["commanded"]))
    known_s = round(waiting_s, 9) if _is_commanded(calm.ticks, probed) else None
    outcome = replace(outcome, link_delay_s=link_s, waiting_s=known_s, past_limits=past)

    def respond(amplitude: float) -> FreeResponse:
        run = _folder_of(folder, amplitude)
        return free_response.response_paired(base, calm, probed.system_ids, amplitude=amplitude, folder=run)

    return _with_response(
        probed, _named_vehicle(probed, delays_s, outcome), respond, outcome, amplitudes=_amplitudes(base)
    )


def _amplitudes(plan: FlightPlan) -> Sequence[float]:
    """Initial errors of a probe, in order. A user's own law or an autopilot may be linear for small ones only."""
    return AMPLITUDES if is_modelled(plan) and plan.scenario.simulated_autopilot is None else AMPLITUDES[1:]


def _folder_of(folder: Path | None, amplitude: float) -> Path | None:
    return None if folder is None else folder / f"error-{amplitude:g}-m"


def _with_response(
    loop: CoupledBlock,
    critical: int,
    respond: Callable[[float], FreeResponse],
    outcome: Outcome,
    *,
    amplitudes: Sequence[float],
) -> Outcome:
    """The outcome with the growth rate of `loop`, which stands in for that of vehicle `critical`.

    The initial error is the first of `amplitudes` that does not leave the linear range too soon.
    """
    outcome = replace(outcome, probed=loop.system_ids[0], critical=critical)
    for amplitude in amplitudes:
        response = respond(amplitude)
        outcome = with_verdict(response.plan, response.flight, replace(outcome, amplitude_m=amplitude))
        outcome = _with_growth(loop, response, outcome)
        if outcome.growth_1_s is not None:
            outcome = replace(outcome, verdict="unstable" if outcome.growth_1_s > 0.0 else "stable")
        elif outcome.verdict != "aborted":
            outcome = replace(outcome, verdict="unknown")
        # both are infinite if the flights never left the linear range
        if not _left_linear_range_too_soon(outcome) or response.until_s >= _CALM_SHARE * response.calm_until_s:
            break
    return outcome


def _loop_of(
    loops: list[CoupledBlock], loop_delay_s: Mapping[int, float], probe: int, age_s: Mapping[int, float] | None = None
) -> CoupledBlock:
    """The loop of vehicle `probe`, or the one that is predicted to break first."""
    if probe == CRITICAL:
        return critical_block(loops, loop_delay_s, age_s)
    return next(loop for loop in loops if probe in loop.system_ids)


def _named_vehicle(loop: CoupledBlock, loop_delay_s: Mapping[int, float], outcome: Outcome) -> int:
    """The vehicle whose delays are reported for its loop: the one whose link alone was slowed, or the slowest."""
    if outcome.probe in loop.system_ids and _is_varied(outcome.probe, outcome.coordinates):
        return outcome.probe
    return max(loop.system_ids, key=lambda system_id: loop_delay_s[system_id])


def _is_commanded(rows: TickArray, loop: CoupledBlock) -> bool:
    """Whether these rows have commands for all vehicles of a loop; otherwise none of its delays is known."""
    return bool(np.isin(loop.system_ids, rows["system_id"][rows["commanded"]]).all())


def _delays_of(
    plan: FlightPlan, loop: CoupledBlock, loop_delay_s: Mapping[int, float], outcome: Outcome
) -> tuple[float, float, float]:
    """Loop delay, link delay (up plus down) and their difference (s) of a loop's `_named_vehicle`."""
    vehicle = _named_vehicle(loop, loop_delay_s, outcome)
    up, down = plan.scenario.link_of(vehicle)
    delay_s = loop_delay_s[vehicle]
    return delay_s, up.delay_s + down.delay_s, delay_s - up.delay_s - down.delay_s


def _ages_s(plan: FlightPlan, rows: TickArray) -> dict[int, float] | None:
    """Median ages of the states at the station; None if all vehicles have the same links, where they do not matter."""
    ids = plan.formation.system_ids
    return median_ages_s(rows, ids) if len({plan.scenario.link_of(own) for own in ids}) > 1 else None


def _with_prediction(
    outcome: Outcome,
    plan: FlightPlan,
    loop: CoupledBlock,
    loop_delay_s: Mapping[int, float],
    age_s: Mapping[int, float] | None,
) -> Outcome:
    if not is_modelled(plan):
        return outcome
    return replace(
        outcome,
        predicted_growth_1_s=rounded(loop.growth_at_1_s(loop_delay_s, age_s)),
        predicted_growth_continuous_1_s=rounded(loop.growth_continuous_at_1_s(loop_delay_s, age_s)),
    )


def _with_growth(loop: CoupledBlock, response: FreeResponse, outcome: Outcome) -> Outcome:
    """The outcome with the growth rate of the probed loop, and the rates predicted at its loop delays."""
    own = response.errors
    outcome = replace(outcome, growth_1_s=None, growth_error_1_s=None, fit_samples=None)
    if not own.size:
        return outcome
    since_s = own["time_s"] - own["time_s"][0]
    delay_s = max(response.loop_delays_s(own, loop.system_ids).values())
    settled = _FLYING_LOOP_DELAYS
    if loop.has_late_terms:
        settled = _SETTLED_LOOP_DELAYS if loop.assumed_s is None else _PREDICTED_LOOP_DELAYS
    start_s = settled * delay_s + 2.0 * loop.timing.held_s
    # one mode for each state and each delayed state; given gains may differ between north and east, or couple them
    modes = 2 * max(FOLLOWER_MODES, len(loop.A))
    motion = motion_of(own, loop.system_ids, period_s=loop.timing.held_s)
    grown = norm_growth if response.varying else partial(fit_growth, modes=modes)
    growth = grown(motion, start_s=start_s, end_s=response.until_s)
    if growth is None:
        return replace(outcome, fit_start_s=round(start_s, 6), fit_end_s=round(min(response.until_s, since_s[-1]), 6))
    window = own[(since_s >= growth.start_s) & (since_s <= growth.end_s)]
    delays_s = response.loop_delays_s(window, loop.system_ids)
    spread_s = float(np.nanpercentile(window["loop_delay_s"], 90) - np.nanmedian(window["loop_delay_s"]))
    loop_s = round(delays_s[_named_vehicle(loop, delays_s, outcome)], 9)
    outcome = replace(_with_fit(outcome, growth), loop_delay_spread_s=round(spread_s, 9))
    if response.flight.truth is not None and min(delays_s.values()) == 0.0:  # too few of its commands arrived
        return outcome
    outcome = replace(outcome, loop_delay_s=loop_s)
    return _with_prediction(outcome, response.plan, loop, delays_s, _ages_s(response.plan, window))


def _with_fit(outcome: Outcome, growth: Growth) -> Outcome:
    return replace(
        outcome,
        growth_1_s=rounded(growth.growth_1_s),
        growth_error_1_s=rounded(growth.error_1_s),
        frequency_rad_s=rounded(growth.frequency_rad_s),
        fit_start_s=round(growth.start_s, 6),
        fit_end_s=round(growth.end_s, 6),
        fit_samples=growth.samples,
    )


def _left_linear_range_too_soon(outcome: Outcome) -> bool:
    """Whether a smaller initial error would give a better fit: errors grew, and the window of the fit is too short."""
    if outcome.fit_start_s is None or outcome.fit_end_s is None:
        return False
    growth_1_s, early = outcome.growth_1_s, outcome.fit_end_s < free_response.PROBE_S / 2.0
    if growth_1_s is None:
        return early
    return growth_1_s > 0.0 and (
        (outcome.fit_samples or 0) < _WANTED_SAMPLES
        or outcome.fit_end_s - outcome.fit_start_s < _WANTED_LOOP_DELAYS * (outcome.loop_delay_s or 0.0)
        or (early and (outcome.growth_error_1_s or 0.0) > _WANTED_ERROR * growth_1_s)
    )
