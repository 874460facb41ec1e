"""What must hold in every flight of the soak, whatever is flown and whatever goes wrong.

Each check yields, in words, what it found broken. A tolerance follows from theory, and a comment says how. Where theory
promises nothing (a clock that was set, a random link), nothing is checked.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from gcs.control.limits import LARGEST_COMMAND_M_S2
from gcs.control.tick import CLOCK_JUMPED, Mode
from gcs.drive.flown import margins_of
from gcs.runs.grade import true_loop_delays_s
from gcs.runs.summary import summarise
from scenarios.keys.link import Link
from scenarios.schema import Scenario
from sim_vehicles.links.truth import ACTED, SAMPLED
from tests.soak.soak_flight import Flown, Stretch
from tests.support.truth import instants

ALWAYS = ("time_s", "due_ns", "sent_ns")
WHEN_COMMANDED = (
    "telemetry_age_s", "north_m", "east_m", "velocity_north_m_s", "velocity_east_m_s", "velocity_error_north_m_s",
    "velocity_error_east_m_s", "command_north_m_s2", "command_east_m_s2", "up_delay_s", "sample_bound_s",
)  # fmt: skip
OF_CLOCKS = ("clock_offset_s", "clock_offset_bound_s")
"""Known of every commanded vehicle; after its clock was set, only from the next exchange on."""
COUNTS = ("received", "late", "duplicate")
"""These never decrease; `lost` does when a frame arrives late."""
ROUNDING_SHARE = 1e-6
"""Fraction by which a limit may be exceeded: float32 on the wire rounds by 6e-8."""


@dataclass(frozen=True)
class Broken:
    """An invariant that does not hold."""

    invariant: str
    text: str


def checked(flown: Flown) -> Iterator[Broken]:
    """Everything that does not hold in a flight."""
    limit = flown.plan.scenario.limits.acceleration_max_m_s2 or LARGEST_COMMAND_M_S2
    for asked in flown.set_points:
        if asked.acceleration_m_s2 > limit * (1.0 + ROUNDING_SHARE) or math.isinf(asked.velocity_m_s):
            yield Broken("commands within limits", f"{asked} on the wire, limit {limit:g} m/s²")
            break
    sampled = instants(flown.truth, SAMPLED)
    for stretch in flown.stretches:
        commands = np.hypot(stretch.ticks["command_north_m_s2"], stretch.ticks["command_east_m_s2"])
        if (commands > limit * (1.0 + ROUNDING_SHARE)).any():
            yield Broken("commands within limits", f"{np.nanmax(commands):g} m/s² in the ticks, limit {limit:g}")
    for stretch, after in zip(flown.stretches, [*flown.stretches[1:], None], strict=True):
        yield from _rows_complete(flown, stretch)
        yield from _commands_explained(flown, stretch)
        yield from _repetitions_true(flown, stretch)
        yield from _clocks_bounded(flown, stretch, sampled)
        yield from _loop_delay_true(flown, stretch, until_ns=2**62 if after is None else after.start_ns)
        yield from _ends_true(flown, stretch)
        yield from _jumps_true(flown, stretch)


def _rows_complete(flown: Flown, stretch: Stretch) -> Iterator[Broken]:
    """No tick is missing, each has a row for every vehicle, and each row has the values that are always known."""

    def incomplete(text: str) -> Broken:
        return Broken("rows complete", text)

    plan, ticks = flown.plan, stretch.ticks
    ids = np.array(plan.formation.system_ids)
    period_ns = round(1e9 / plan.scenario.rates.control_hz)
    if ticks.shape[1] != len(ids) or (ticks["system_id"] != ids).any():
        yield incomplete(f"the rows of a tick are not those of vehicles {ids.tolist()}")
        return
    if (np.diff(ticks["tick"][:, 0]) != 1).any() or (np.diff(ticks["due_ns"][:, 0]) != period_ns).any():
        yield incomplete("ticks are missing")
    for name in ("tick", *ALWAYS):
        if (ticks[name] != ticks[name][:, :1]).any():
            yield incomplete(f"{name} differs between the rows of a tick")
    for name in ALWAYS:
        if not np.isfinite(ticks[name]).all():
            yield incomplete(f"{name} is not finite")
    for name in COUNTS:
        if (np.diff(ticks[name].astype(np.int64), axis=0) < 0).any():
            yield incomplete(f"{name} decreases")
    if not np.isin(ticks["mode"], [int(mode) for mode in Mode]).all():
        yield incomplete("a mode that does not exist")


def _commands_explained(flown: Flown, stretch: Stretch) -> Iterator[Broken]:
    """The state of every commanded vehicle is known, and no other vehicle has a command."""

    def incomplete(text: str) -> Broken:
        return Broken("rows complete", text)

    ticks = stretch.ticks
    commanded = ticks[ticks["commanded"]]
    for name in WHEN_COMMANDED:
        if not np.isfinite(commanded[name]).all():
            k = int(np.flatnonzero(~np.isfinite(commanded[name]))[0])
            yield incomplete(f"{name} = {commanded[name][k]} at {commanded['time_s'][k]:.3f} s, while commanded")
    never_set = commanded[~np.isin(commanded["system_id"], list(flown.steps_ns))]
    for name in OF_CLOCKS:
        if not np.isfinite(never_set[name]).all():
            yield incomplete(f"{name} is unknown for a commanded vehicle whose clock was never set")
    if np.isfinite(ticks["command_north_m_s2"][~ticks["commanded"]]).any():
        yield incomplete("a command where none was sent")


def _repetitions_true(flown: Flown, stretch: Stretch) -> Iterator[Broken]:
    """A set-point is repeated only until a newer state arrives, for less than a telemetry period."""
    rates, ticks = flown.plan.scenario.rates, stretch.ticks
    repeated_s = ticks["repeated_s"]
    # the period is rounded to a whole ns
    if not ((repeated_s >= 0.0) & (repeated_s < 1.0 / rates.telemetry_hz + 1e-9)).all():
        yield Broken("repetitions", f"{repeated_s.min():g} to {repeated_s.max():g} s of {1.0 / rates.telemetry_hz:g} s")
    elif rates.telemetry_hz >= rates.control_hz and repeated_s.any():
        yield Broken("repetitions", "though telemetry is no slower than control")
    newer = np.diff(ticks["sample_boot_ms"].astype(np.int64), axis=0) != 0
    if flown.plan.scenario.control.loop == "ground" and repeated_s[1:][newer & ticks["commanded"][1:]].any():
        yield Broken("repetitions", "of a set-point from a state that was not used before")


def _clocks_bounded(flown: Flown, stretch: Stretch, sampled: dict[tuple[int, int], int]) -> Iterator[Broken]:
    """Clock offsets and sampling instants are within their bounds of the truth, for clocks that were never set.

    The only tolerance is a microsecond for the rounding of stamps: the bounds follow from each exchange alone.
    """
    for row, system_id in enumerate(flown.plan.formation.system_ids):
        rows = stretch.ticks[:, row]
        rows = rows[rows["sent_ns"] < flown.steps_ns.get(system_id, 2**62)]
        known = rows[np.isfinite(rows["clock_offset_bound_s"])]
        clock = flown.clocks[system_id]
        true_s = np.array([(clock.boot_ns(t) - t) * 1e-9 for t in known["sent_ns"].tolist()])
        beyond_s = np.abs(known["clock_offset_s"] - true_s) - known["clock_offset_bound_s"]
        # float64 resolves 1e-10 s in 1e6 s
        if beyond_s.size and beyond_s.max() > 1e-6:
            k = int(beyond_s.argmax())
            text = (
                f"offset of vehicle {system_id} is {beyond_s[k]:.3g} s beyond its bound at {known['time_s'][k]:.3f} s"
            )
            yield Broken("clock bounds", text)
        used = rows[np.isfinite(rows["sample_bound_s"]) & (rows["sample_ns"] > 0)]
        keys = [(system_id, boot_ms) for boot_ms in used["sample_boot_ms"].tolist()]
        if any(key not in sampled for key in keys):
            yield Broken("clock bounds", f"vehicle {system_id} never sampled a state that was used")
            continue
        off_s = np.abs(used["sample_ns"] - np.array([sampled[key] for key in keys], dtype=np.int64)) * 1e-9
        if off_s.size and (off_s - used["sample_bound_s"]).max() > 1e-6:
            k = int((off_s - used["sample_bound_s"]).argmax())
            text = f"sample of vehicle {system_id} off by {off_s[k]:.3g} s, bound {used['sample_bound_s'][k]:.3g} s"
            yield Broken("clock bounds", f"{text}, at {used['time_s'][k]:.3f} s")


def _loop_delay_true(flown: Flown, stretch: Stretch, *, until_ns: int) -> Iterator[Broken]:
    """Where no delay varies, the measured loop delay is the true one.

    The error of the clock offset cancels. What remains is the drift between exchange and sample, until the line fitted
    to the exchanges has found the drift: a second, and as long as five exchanges take. With loops on board the state
    used may be another vehicle's, whose clock has a different error: then the bounds hold.
    """
    scenario = flown.plan.scenario
    if not _constant_delays(scenario) or scenario.control.execute_at:  # holds change by whole ms
        return
    ticks = stretch.ticks.ravel()
    truth = flown.truth
    known = (truth["time_ns"] >= stretch.start_ns) & (truth["time_ns"] < until_ns)
    # a set-point's key is its time since its station's start: one that acts earlier is from the previous station
    known &= (truth["kind"] != ACTED) | (truth["time_ns"] >= stretch.start_ns + truth["key"].astype(np.int64) * 10**6)
    age_s = ticks["loop_delay_s"] + ticks["repeated_s"]
    error_s = np.abs(age_s - true_loop_delays_s(ticks, truth[known]))
    if scenario.control.loop == "onboard":
        error_s -= np.repeat(np.nanmax(stretch.ticks["sample_bound_s"], axis=1, initial=0.0), len(scenario.vehicles))
        error_s -= ticks["down_bound_s"]
    first_step_ns = min(flown.steps_ns.values(), default=2**62)
    error_s = error_s[ticks["sent_ns"] < first_step_ns]
    rates = scenario.rates
    gap_s = 3.0 + 10.0 / min(rates.timesync_hz, rates.control_hz) + 2.0 * _longest_round_trip_s(scenario)
    longest_s = gap_s + sum(min(fault_s, 10.0) for fault_s in _silences_s(flown))
    tolerance_s = 2e-6 + 1e-6 * scenario.clocks.drift_max_ppm * longest_s
    known = np.isfinite(error_s)
    if known.any() and error_s[known].max() > tolerance_s:
        k = int(np.nanargmax(error_s))
        text = f"off by {error_s[k]:.3g} s (tolerance {tolerance_s:.2g} s) of vehicle {ticks['system_id'][k]}"
        yield Broken("loop delay", f"{text} at {ticks['time_s'][k]:.3f} s")


def _silences_s(flown: Flown) -> list[float]:
    outages = [o.until_s - o.from_s for link in _links(flown.plan.scenario) for o in link.outages]
    return [*outages, *flown.silences_s]


def _constant_delays(scenario: Scenario) -> bool:
    return all(link.jitter is None and not link.delay_points and link.channel is None for link in _links(scenario))


def _links(scenario: Scenario) -> list[Link]:
    return [link for vehicle in scenario.vehicles for link in scenario.link_of(vehicle.system_id)]


def _longest_round_trip_s(scenario: Scenario) -> float:
    return max(up.delay_s + down.delay_s for up, down in (scenario.link_of(v.system_id) for v in scenario.vehicles))


def _jumps_true(flown: Flown, stretch: Stretch) -> Iterator[Broken]:
    """Where no delay varies, no clock is reported to have jumped that was not set."""
    if not _constant_delays(flown.plan.scenario) or flown.plan.scenario.clocks.drift_max_ppm > 400.0:
        return
    for event in stretch.station.events:
        if event.text == CLOCK_JUMPED and event.system_id not in flown.steps_ns:
            yield Broken("clock jumps", f"vehicle {event.system_id} at {event.time_s:.3f} s, whose clock was not set")


def _ends_true(flown: Flown, stretch: Stretch) -> Iterator[Broken]:
    """The reported end is true: collisions, and settled or not. The summary can be written as JSON."""
    scenario = flown.plan.scenario
    log = stretch.flight()
    design = margins_of(stretch.station.plan)
    summary = summarise(scenario, design, log.ticks, log.events)
    summary.to_json()
    if stretch.replaced or not stretch.states_at_end:
        return
    for system_id, state in stretch.states_at_end.items():
        if not np.isfinite(state).all():
            yield Broken("states finite", f"vehicle {system_id}: {state}")
            return
    reason = stretch.station.end_reason
    at_end = stretch.ticks[stretch.ticks["due_ns"][:, 0] == stretch.ended_ns][0]
    place = {v.system_id: np.array(stretch.states_at_end[v.system_id][:2]) for v in scenario.vehicles}
    away_m = _extrapolated_m(flown, stretch, at_end)
    if "have collided" in reason:
        one, two = (int(word) for word in reason.split("vehicles ")[1].split(" have")[0].split(" and "))
        true_m = float(np.hypot(*(place[one] - place[two])))
        allowed_m = scenario.safety.collision_distance_m + away_m[one] + away_m[two]
        if true_m > allowed_m:
            yield Broken("collision", f"{reason}, in truth {true_m:.2f} m (tolerance {allowed_m:.2f} m)")
    if _was_opened(stretch):
        return
    errors = dict(_true_errors_m(stretch, scenario, place, away_m, at_end))
    if reason.startswith("broken: spacing"):
        system_id = int(reason.split("vehicle ")[1].split()[0])
        true_m, off_m = errors[system_id]
        if true_m + off_m < scenario.safety.spacing_error_limit_m:
            yield Broken("verdict", f"{reason}; in truth {true_m:.2f} m (± {off_m:.2f} m)")
    if reason.startswith("completed") and errors:  # one vehicle alone has settled by its velocity
        fraction = scenario.safety.settled_fraction
        bands_m = {v.system_id: fraction * math.hypot(*v.offset_ne_m) for v in scenario.vehicles if v.offset_ne_m}
        beyond = [i for i, (true_m, off_m) in errors.items() if true_m - off_m > bands_m[i]]
        within = all(true_m + off_m < bands_m[i] for i, (true_m, off_m) in errors.items())
        if (summary.verdict == "stable" and beyond) or (summary.verdict == "unstable" and within):
            text = {
                i: f"{true_m:.3f} ± {off_m:.3f} m, band {bands_m[i]:.3f} m" for i, (true_m, off_m) in errors.items()
            }
            yield Broken("verdict", f"{summary.verdict}; errors in truth at the end: {text}")


def _true_errors_m(
    stretch: Stretch, scenario: Scenario, place: dict[int, Any], away_m: dict[int, float], at_end: np.ndarray[Any, Any]
) -> Iterator[tuple[int, tuple[float, float]]]:
    """True spacing errors of the followers when the end was decided, and how far from them measured ones may be.

    The measured error refers to the instant of the newest state. It may differ by the position errors of both vehicles
    and by their relative motion since.
    """
    age_s = {int(row["system_id"]): float(row["telemetry_age_s"]) for row in at_end}
    for v in scenario.vehicles:
        if v.follows is not None and v.offset_ne_m is not None:
            own, ahead = stretch.states_at_end[v.system_id], stretch.states_at_end[v.follows]
            error = place[v.system_id] - place[v.follows] - np.array(v.offset_ne_m)
            apart_m_s = math.hypot(own[2] - ahead[2], own[3] - ahead[3])
            off_m = 2.0 * (away_m[v.system_id] + away_m[v.follows]) + apart_m_s * age_s[v.system_id]
            yield v.system_id, (float(np.hypot(*error)), off_m if math.isfinite(off_m) else math.inf)


def _was_opened(stretch: Stretch) -> bool:
    """Whether a vehicle was in trouble: the station may then have opened the formation to a larger spacing."""
    flown = stretch.ticks[stretch.ticks["time_s"] >= 0.0]
    return bool(np.isin(flown["mode"], [Mode.CRITICAL, Mode.FAILSAFE, Mode.LOST]).any())


def _extrapolated_m(flown: Flown, stretch: Stretch, at_end: np.ndarray[Any, Any]) -> dict[int, float]:
    """How far each vehicle can be from its newest state extrapolated with its velocity.

    With accelerations of at most A since a state of age T: twice A T² / 2, plus the speed times the error of T. A
    covers the largest command, and what a vehicle does by itself: its own loop, and reaching a velocity.
    """
    scenario, ticks = flown.plan.scenario, stretch.ticks
    sent = np.hypot(ticks["command_north_m_s2"], ticks["command_east_m_s2"])
    speed = np.hypot(ticks["velocity_north_m_s"], ticks["velocity_east_m_s"])
    fastest = float(np.nanmax(speed, initial=0.0)) + max(
        (math.hypot(*state[2:]) for state in stretch.states_at_end.values()), default=0.0
    )
    strongest = float(np.nanmax(sent, initial=0.0)) + 2.0 * fastest
    if scenario.dynamics == "autopilot":
        strongest = scenario.autopilot.acceleration_max_m_s2
    elif scenario.control.loop == "onboard":
        strongest = scenario.limits.acceleration_max_m_s2 or 20_000.0
    found: dict[int, float] = {}
    for row in at_end:
        age_s = float(row["telemetry_age_s"]) + float(row["sample_bound_s"])
        wrong_m = fastest * float(row["sample_bound_s"]) + 0.01
        found[int(row["system_id"])] = strongest * age_s**2 + wrong_m if math.isfinite(age_s) else math.inf
    return found
