"""The fast path of a station: a step and a control tick in one kernel each, if nothing in them needs Python.

It takes the common datagrams of `gcs.station.reception`, sends requests and heartbeats, and does a control tick of a
formation whose loop the station closes without prediction: in flight, if every vehicle is heard, guided and nominal;
before and after the flight, while the station only waits for answers. These steps call the same kernels as the steps in
Python, which take over wherever a fast step stops.
"""

from math import inf, isfinite, isnan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray
from gcs.control.history import every_at, every_newest
from gcs.control.law import CONTROL, FeedbackLaw, control_all, nearest
from gcs.control.limits import LARGEST_COMMAND_M_S2, any_beyond, shorten
from gcs.control.loop_delay import longest_repetition_ns, repeated_s
from gcs.control.loops import accelerations
from gcs.link.clocks import LEAST_SAMPLES
from gcs.link.mavlink import (
    HEARTBEAT_EXTRA,
    SET_POINT,
    TIMESYNC_FRAME_BYTES,
    encode_timesync,
    same_frames,
    set_point_frames,
)
from gcs.link.vehicle import SILENCE_S, ask, heard
from gcs.plan.flight_plan import FlightPlan
from gcs.station.breakage import SURELY_WITHIN
from gcs.station.modes import Policy
from gcs.station.monitor import Seen, Watched, judge, settle
from gcs.station.reception import ANSWER, NEWS_OF_A_FRAME, Now, Tables, take_common, take_fresh
from gcs.station.tick_rows import Judged, fill
from scenarios.kernel import Array, Record, Records, array_kernel, kernel
from scenarios.schema import NS_PER_S
from scenarios.sockets import Bytes, Ints

HEARTBEAT_NS = 1_000_000_000
SCHEDULE = np.dtype(
    [
        ("now_ns", "i8"), ("next_tick_ns", "i8"), ("next_heartbeat_ns", "i8"),
        ("next_requests_ns", "i8"), ("next_timesync_ns", "i8"),  # the next wake-up for requests, and the next request
        ("timesync_row", "i8"),  # the vehicle to which the next request goes
        ("tick_count", "i8"),
        ("tick", "i8"), ("due_ns", "i8"), ("time_s", "f8"),  # of the last tick done by a kernel: see `Tick`
        ("start_ns", "i8"), ("period_ns", "i8"), ("timesync_spacing_ns", "i8"), ("requests_apart_ns", "i8"),
    ]
)  # fmt: skip
"""The station's timetable: when each periodic task is next due."""
DONE, WITH_TICK, NOT_TAKEN, NOT_DONE, NOT_JUDGED = range(5)
"""Outcome of a step: done; done with a tick; only some of its datagrams processed; all of them processed, but nothing
else done; done except for the rows of its tick, because the formation may be broken."""


class TickLimits(NamedTuple):
    """Limits and parameters of a tick."""

    acceleration_m_s2: float
    silence_ns: int
    repetition_ns: int
    separable: bool
    spacing_m: float
    collision_m: float
    has_slots: bool


def limits_of(plan: FlightPlan) -> TickLimits:
    """The limits and parameters of a plan's ticks."""
    scenario, safety = plan.scenario, plan.scenario.safety
    return TickLimits(
        scenario.limits.acceleration_max_m_s2 or LARGEST_COMMAND_M_S2, round(SILENCE_S * NS_PER_S),
        longest_repetition_ns(scenario.rates), plan.separable,
        SURELY_WITHIN * safety.spacing_error_limit_m, safety.collision_distance_m, scenario.has_altitude_slots,
    )  # fmt: skip


class Sending(NamedTuple):
    """Frames to vehicles: frame k is the first `sizes[k]` bytes of `frames[k]` and goes to the vehicle `rows[k]`."""

    frames: Bytes
    sizes: Ints
    rows: Ints


class Scratch(NamedTuple):
    """Buffers for the results of a fast tick for n vehicles."""

    controls: Records
    """Of `gcs.control.law.CONTROL`."""
    points: Records
    """Of `gcs.link.mavlink.SET_POINT`."""
    rtt_s: FloatArray
    silent: NDArray[np.bool_]
    followed: NDArray[np.bool_]
    """Which vehicles follow the control law in this tick."""
    nothing: Sending
    """No frames."""


def new_scratch(n: int) -> Scratch:
    nothing = Sending(np.empty((0, 0), np.uint8), np.empty(0, np.int64), np.empty(0, np.int64))
    return Scratch(
        np.zeros(n, CONTROL), np.zeros(n, SET_POINT), np.zeros(n), np.zeros(n, np.bool_), np.zeros(n, np.bool_), nothing
    )


class FastPathData(NamedTuple):
    """All data of n vehicles on which fast steps work."""

    schedule: Records
    """Of SCHEDULE, (1,)."""
    coming: Records
    """Of COMING, (1,)."""
    limits: TickLimits
    tables: Tables
    row_of: Ints
    law: FeedbackLaw
    blends: Records
    watched: Watched
    policy: Policy
    guided: NDArray[np.bool_]
    critical: NDArray[np.bool_]
    shorter_s: FloatArray
    used_s: FloatArray
    repeated_ns: Ints
    system_ids: Ints
    targets: Ints
    heartbeat: Bytes
    scratch: Scratch


COMING = np.dtype(
    [
        ("flying", "?"),
        ("velocity_ne_m_s", "f8", (2,)),  # nominal
        ("zero_ns", "i8"), ("before_s", "f8"),  # `Journal.zero`
        ("since_ns", "i8"),  # when the phase began
        # Python does the ticks from these times on: station clock in ns, seconds of the phase, and scenario time
        ("quiet_until_ns", "f8"), ("longest_s", "f8"), ("steady_until_s", "f8"),
        ("clock_row", "i8"),  # and the ticks after the clock of this vehicle has become known; -1 for none
    ],
    align=True,
)  # fmt: skip
"""What fast steps need to know of the coming ticks; `Station.look_ahead` fills it in."""


@array_kernel
def fast_step(
    data: FastPathData,
    stream: Bytes,
    table: Ints,
    queued_ns: Ints,
) -> tuple[int, int, Sending, Sending, Sending]:
    """Do a step, or as much of it as needs no Python, at the schedule's `now_ns`.

    Stream, table and `queued_ns` are those of `Arrivals`. Returns the outcome, how many datagrams were processed, and
    the frames to send, in order; requests come last. `fast_rows` completes a tick.
    """
    schedule, tables = data.schedule[0], data.tables
    nothing, taken = data.scratch.nothing, 0
    if NEWS_OF_A_FRAME * table.shape[1] > len(tables.news):
        return NOT_TAKEN, taken, nothing, nothing, nothing
    now = Now(schedule.now_ns, schedule.start_ns, schedule.period_ns, False)
    taken = take_common(tables, stream, table, queued_ns, 0, data.row_of, now)
    if taken < table.shape[1]:
        return NOT_TAKEN, taken, nothing, nothing, nothing
    for place in range(tables.news_count[0]):
        if tables.news[place].kind != ANSWER:
            return NOT_DONE, taken, nothing, nothing, nothing
    if schedule.now_ns >= schedule.next_tick_ns:
        if not _is_calm(data):
            return NOT_DONE, taken, nothing, nothing, nothing
        answers = _answered(tables, nothing)
        return WITH_TICK, taken, answers, _command(data), nothing
    answers = _answered(tables, nothing)
    heartbeats = requests = nothing
    links = tables.links
    if schedule.now_ns >= schedule.next_heartbeat_ns:
        schedule.next_heartbeat_ns = schedule.now_ns + HEARTBEAT_NS
        to = heard(links, links.first_at_port)
        frames = same_frames(data.heartbeat, HEARTBEAT_EXTRA, to, links.sequence)
        heartbeats = Sending(frames, np.full(len(to), frames.shape[1]), to)
    if schedule.now_ns >= schedule.next_requests_ns:
        frames, sizes, to = requested(data.schedule, links, tables.clocks, tables.pending_ns)
        requests = Sending(frames, sizes, to)
    return DONE, taken, answers, heartbeats, requests


@array_kernel
def _answered(tables: Tables, nothing: Sending) -> Sending:
    """Answers to the vehicles' requests, which are the only news."""
    count = tables.news_count[0]
    if not count:
        return nothing
    frames, sizes, rows = (
        np.zeros((count, TIMESYNC_FRAME_BYTES), np.uint8),
        np.empty(count, np.int64),
        np.empty(count, np.int64),
    )
    for place in range(count):
        news = tables.news[place]
        link = tables.links[news.row]
        link.sequence = (link.sequence + 1) & 0xFF
        frame, rows[place] = frames[place], news.row
        sizes[place] = encode_timesync(frame, news.value_ns, news.sent_ns, link.target, link.sequence)
    tables.news_count[0] = 0
    return Sending(frames, sizes, rows)


@array_kernel
def requested(schedules: Records, known: Records, clocks: Records, pending_ns: Array) -> tuple[Bytes, Ints, Ints]:
    """Make TIMESYNC requests to the vehicles whose turn it is; returns the result of `ask`."""
    schedule = schedules[0]
    due = max(0, (schedule.now_ns - schedule.next_timesync_ns) // schedule.timesync_spacing_ns + 1)
    first = schedule.timesync_row
    schedule.timesync_row = (first + due) % len(known)
    schedule.next_timesync_ns += due * schedule.timesync_spacing_ns
    schedule.next_requests_ns = max(schedule.next_timesync_ns, schedule.next_requests_ns + schedule.requests_apart_ns)
    return ask(known, clocks, pending_ns, first, due, schedule.now_ns)


@kernel
def _time_s(data: FastPathData) -> float:
    """The scenario time of the next tick, as `Journal.scenario_time_s`."""
    return (data.schedule[0].next_tick_ns - data.coming[0].zero_ns) / NS_PER_S - data.coming[0].before_s


@kernel
def _is_calm(data: FastPathData) -> bool:
    """Whether no Python is due, and the monitor only has to record delays and times; if so, it records them."""
    limits, silent, judged, coming = data.limits, data.scratch.silent, data.watched.judged[0], data.coming[0]
    due_ns, time_s = data.schedule[0].next_tick_ns, _time_s(data)
    if due_ns >= coming.quiet_until_ns or time_s >= coming.steady_until_s:
        return False
    if (due_ns - coming.since_ns) / NS_PER_S >= coming.longest_s:
        return False
    if coming.clock_row >= 0 and data.tables.clocks[coming.clock_row].samples >= LEAST_SAMPLES:
        return False
    for row in range(len(silent)):
        silent[row] = data.schedule[0].now_ns - data.tables.telemetry_ns[row] > limits.silence_ns
    seen = Seen(time_s, coming.flying, silent, data.guided, data.critical, data.used_s)
    if judge(data.watched, seen, data.policy, limits.separable) > 0:
        data.watched.judged[0] = judged
        return False
    settle(data.watched)
    return True


@array_kernel
def fast_set_points(data: FastPathData) -> tuple[bool, Sending]:
    """Make the set-points of the tick due now. If it needs Python, nothing is done and False is returned."""
    if not _is_calm(data):
        return False, data.scratch.nothing
    return True, _command(data)


@array_kernel
def _command(data: FastPathData) -> Sending:
    """The set-points of the tick due now."""
    schedule, limits, tables, law = data.schedule[0], data.limits, data.tables, data.law
    controls, points, due_ns = data.scratch.controls, data.scratch.points, schedule.next_tick_ns
    schedule.tick, schedule.due_ns, schedule.time_s = schedule.tick_count, due_ns, _time_s(data)
    ticks = 1 + (schedule.now_ns - due_ns) // schedule.period_ns  # missed ticks are skipped
    schedule.next_tick_ns = due_ns + ticks * schedule.period_ns
    schedule.tick_count += ticks
    times_ns, states = every_newest(tables.reports, tables.report_counts)
    seen = every_at(tables.reports, tables.report_counts, law.source, times_ns[law.to])
    north_m_s, east_m_s = data.coming[0].velocity_ne_m_s
    control_all(controls, law, times_ns, states, seen, data.blends, north_m_s, east_m_s, 1.0)
    shorten(controls.command_m_s2, limits.acceleration_m_s2)
    followed = commanded(controls, data.watched.states.released, data.coming[0].flying)
    for row in range(len(followed)):
        data.scratch.followed[row] = followed[row]
    accelerations(points, controls, followed)
    shorten(points.acceleration_ne_m_s2, limits.acceleration_m_s2)
    to = heard(tables.links, points.sent)
    frames = set_point_frames(points, to, tables.links.sequence, data.targets, _key_ms(schedule, due_ns))
    rtt_s = take_fresh(tables.fresh_ns, tables.fresh_counts)
    for row in range(len(rtt_s)):
        data.scratch.rtt_s[row] = rtt_s[row]
    return Sending(frames, np.full(len(to), frames.shape[1]), to)


@kernel
def _key_ms(schedule: Record, due_ns: int) -> int:
    """The `time_boot_ms` of the set-points of a tick."""
    return (due_ns - schedule.start_ns) // 1_000_000 & 0xFFFFFFFF


@array_kernel
def fast_rows(data: FastPathData, sent_ns: Ints, rows: Records) -> bool:
    """Fill in the rows of the tick just done, whose set-points were sent at `sent_ns`.

    Does nothing and returns False if the formation may be broken.
    """
    schedule, limits, tables, controls = data.schedule[0], data.limits, data.tables, data.scratch.controls
    repeated = repeated_s(data.repeated_ns, limits.repetition_ns, controls.used_ns, schedule.due_ns)
    down_m = np.empty(len(controls) if limits.has_slots else 0)
    for row in range(len(down_m)):
        down_m[row] = tables.reported[row].down_m
    near_m, _ = nearest(controls, schedule.due_ns, down_m)
    closest_m = inf
    for row in range(len(near_m)):
        closest_m = closest_m if isnan(near_m[row]) else min(closest_m, near_m[row])
    if data.coming[0].flying and (
        closest_m < limits.collision_m or any_beyond(controls.spacing_error_m, limits.spacing_m)
    ):
        return False
    states = data.watched.states
    judged = Judged(
        data.system_ids, states.mode, states.gain_set, controls, tables.reported, data.scratch.rtt_s,
        data.scratch.followed, data.shorter_s, data.watched.margins_s, repeated,
    )  # fmt: skip
    fill(
        rows, data.used_s, tables.links, tables.clocks, tables.counters, judged, near_m, sent_ns,
        schedule.tick, schedule.time_s, schedule.due_ns, _key_ms(schedule, schedule.due_ns),
    )  # fmt: skip
    return True


@array_kernel
def commanded(controls: Records, released: Array, flying: bool) -> NDArray[np.bool_]:
    """Which vehicles follow the control law: in flight, not released, with a finite command."""
    found = np.empty(len(controls), np.bool_)
    for row in range(len(controls)):
        command = controls[row].command_m_s2
        found[row] = flying and not released[row] and isfinite(command[0]) and isfinite(command[1])
    return found
