"""Runs the common events of plain vehicles in kernels: the station's set-points, heartbeats and TIMESYNC, and reports.

The set-points of a plain craft act at once, and it reports its true state (`Craft.is_plain`). If its links are plain,
too (`Link.plain`), a kernel runs its events in order of time, as `Shell` does, and stops before one that takes Python.
"""

from math import cos, nan, pi, sin

from scenarios.kernel import Record, Records, kernel
from scenarios.sockets import Bytes, Ints
from sim_vehicles.links.links import row_of
from sim_vehicles.links.queue import copy_bytes, enter, free, new_entry, ready, record_datagram, take, take_in
from sim_vehicles.links.truth import ACTED, LINK_DOWN, LINK_UP, PASSED, SAMPLED, can_record, note
from sim_vehicles.motion.copter import ALTITUDE, CLIMB, YAW, Target, fly_to, is_led, set_target, within_half_a_turn
from sim_vehicles.motion.double_integrator import Command, advance_to, set_command, state_of
from sim_vehicles.services.clock import NEVER_NS, boot_ns
from sim_vehicles.services.earth import ORIGIN_ALTITUDE_M, degrees
from sim_vehicles.services.frames import (
    AUTOPILOT,
    FRAME_BYTES,
    GLOBAL_POSITION,
    HEARTBEAT,
    LOCAL_NED,
    LOCAL_POSITION,
    PAYLOAD,
    SETPOINT,
    STATION_TYPE,
    TIMESYNC,
    UINT32,
    Frame,
    frequent_message,
    global_position,
    heartbeat,
    local_position,
    read_float,
    read_int64,
    read_uint16,
    timesync,
)
from sim_vehicles.services.hot import REPORTS
from sim_vehicles.services.mavlink import MODE_GUIDED
from sim_vehicles.services.schedule import schedule_report
from sim_vehicles.vehicles.flight_mode import note_heartbeat, note_setpoint, takes_setpoints
from sim_vehicles.vehicles.setpoints import (
    ABSURD,
    ACCELERATION,
    AXES,
    FORCE_SET,
    VELOCITY_ACCELERATION,
    YAW_IGNORED,
    YAW_RATE_IGNORED,
)

NEEDS_PYTHON, MOVE_FIRST, SILENT = -2, -1, 0
"""Returned in place of a frame's size. NEEDS_PYTHON, MOVE_FIRST: nothing was done; the event takes Python, or the
craft must move first. SILENT: done, with no frame to send."""
_NO_TURN = YAW_IGNORED | YAW_RATE_IGNORED
_SETPOINT_BYTES, _HEARTBEAT_BYTES = 53, 9
"""Sizes of complete payloads: common set-points and heartbeats do not end in zeros."""


@kernel
def _must_move(vehicle: Record, time_ns: int) -> bool:
    """Whether the craft must move to the time of an event first: kernels do not know what pushes it."""
    return vehicle.pushed and vehicle.flying and time_ns > vehicle.state_ns


@kernel
def _move(vehicle: Record, time_ns: int) -> None:
    if vehicle.copter:
        fly_to(vehicle, time_ns)
    else:
        advance_to(vehicle, time_ns)


@kernel
def hear(vehicle: Record, frame: Frame, size: int, time_ns: int, answer: Frame, truth: Records) -> int:
    """Act on a datagram that arrives; returns the size of the answer, SILENT, NEEDS_PYTHON or MOVE_FIRST."""
    number = NEEDS_PYTHON if vehicle.version_1 else frequent_message(frame, size)
    if number == SETPOINT:
        return _take_setpoint(vehicle, frame, time_ns, truth)
    if number == HEARTBEAT:
        return _take_heartbeat(vehicle, frame, time_ns)
    return _take_timesync(vehicle, frame, time_ns, answer) if number == TIMESYNC else NEEDS_PYTHON


@kernel
def _take_setpoint(vehicle: Record, frame: Frame, time_ns: int, truth: Records) -> int:
    """Fly the acceleration that the station commands in flight or, of a copter, velocity and acceleration."""
    if frame[1] != _SETPOINT_BYTES or frame[5] != vehicle.station or not takes_setpoints(vehicle):
        return NEEDS_PYTHON
    mask, component = read_uint16(frame, PAYLOAD + 48), frame[PAYLOAD + 51]
    judged, counted = AXES | FORCE_SET, ACCELERATION
    if vehicle.copter:
        judged, counted = judged | _NO_TURN, VELOCITY_ACCELERATION | _NO_TURN
    if mask & judged != counted or frame[PAYLOAD + 52] != LOCAL_NED or (vehicle.copter and is_led(vehicle)):
        return NEEDS_PYTHON
    if frame[PAYLOAD + 50] != vehicle.wire_id or component not in (0, AUTOPILOT):
        return NEEDS_PYTHON
    north, east = read_float(frame, PAYLOAD + 28), read_float(frame, PAYLOAD + 32)
    down, velocity, climb = read_float(frame, PAYLOAD + 36), 0j, 0.0
    if vehicle.copter:
        velocity = complex(read_float(frame, PAYLOAD + 16), read_float(frame, PAYLOAD + 20))
        climb = -read_float(frame, PAYLOAD + 24)
    size = abs(north) + abs(east) + abs(down) + abs(velocity.real) + abs(velocity.imag) + abs(climb)
    if not size <= ABSURD:  # also if NaN
        return NEEDS_PYTHON
    acts_ns = max(time_ns, vehicle.state_ns)
    if _must_move(vehicle, acts_ns):
        return MOVE_FIRST
    vehicle.heard_ns = vehicle.commanded_ns = time_ns
    note_setpoint(vehicle, acts_ns)
    _move(vehicle, acts_ns)
    if vehicle.copter:
        acceleration, gain, growth = complex(north, east), vehicle.velocity_gain_1_s, vehicle.growth
        set_target(vehicle, Target(acceleration, velocity, gain, growth, climb, nan, nan, 0.0, complex(nan, nan)))
    else:
        set_command(vehicle, Command(north, east, 0.0, 0.0, 0.0))
    vehicle.setpoints += 1
    key = read_int64(frame, PAYLOAD, 4)  # its sender's time_boot_ms
    note(truth, ACTED, vehicle.system_id, key, acts_ns, acts_ns, acts_ns, PASSED, 0)
    return SILENT


@kernel
def _take_heartbeat(vehicle: Record, frame: Frame, time_ns: int) -> int:
    if frame[1] != _HEARTBEAT_BYTES or frame[5] != vehicle.station or frame[PAYLOAD + 4] != STATION_TYPE:
        return NEEDS_PYTHON
    vehicle.heard_ns = time_ns
    note_heartbeat(vehicle, max(time_ns, vehicle.state_ns))
    vehicle.heartbeats += 1
    return SILENT


@kernel
def _take_timesync(vehicle: Record, frame: Frame, time_ns: int, answer: Frame) -> int:
    """Answer a TIMESYNC request to this vehicle or to all, or take in the reply to its own."""
    size = int(frame[1])
    target = frame[PAYLOAD + 16] if size > 16 else 0
    if target not in (0, vehicle.wire_id):
        return NEEDS_PYTHON
    ts1 = read_int64(frame, PAYLOAD + 8, min(max(size - 8, 0), 8))
    if read_int64(frame, PAYLOAD + 0, min(size, 8)) != 0:
        if ts1 != vehicle.asked_ts1:
            return NEEDS_PYTHON
        vehicle.timesync_replies += 1
        return SILENT
    tc1 = boot_ns(vehicle.clock_start_ns, vehicle.clock_offset_ns, vehicle.clock_drift_ppb, time_ns)
    vehicle.timesync_requests += 1
    return timesync(vehicle, answer, tc1 or 1, ts1)  # never 0, even at boot: that would make the reply a request


@kernel
def _flown(vehicle: Record) -> tuple[float, float, float, float, float, float, float]:
    """Position north and east, altitude; velocity north, east and down; and yaw."""
    if vehicle.copter:
        own = vehicle.motion
        return own[0], own[1], own[ALTITUDE], own[2], own[3], -own[CLIMB], own[YAW]
    north, east, yaw, speed = state_of(vehicle)
    return north, east, vehicle.altitude_m, speed * cos(yaw), speed * sin(yaw), 0.0, within_half_a_turn(yaw)


@kernel
def _status(vehicle: Record, number: int, frame: Frame, time_ns: int) -> int:
    """Make a TIMESYNC request or a HEARTBEAT."""
    mode, critical = vehicle.mode, vehicle.stopped != 0
    if number == HEARTBEAT:
        guided = mode == MODE_GUIDED and not vehicle.copter
        return heartbeat(vehicle, frame, mode, vehicle.autopilot, vehicle.armed, guided, vehicle.flying, critical)
    clock = vehicle.clock_start_ns, vehicle.clock_offset_ns, vehicle.clock_drift_ppb
    vehicle.asked_ts1 = boot_ns(clock[0], clock[1], clock[2], time_ns)
    return timesync(vehicle, frame, 0, vehicle.asked_ts1)


@kernel
def report(vehicle: Record, frame: Frame, truth: Records) -> int:
    """Make the next report, before any other event, and schedule the one after it; returns as `hear`."""
    k, time_ns, boot_ms = vehicle.report, vehicle.report_ns, vehicle.due_ms[vehicle.report]
    has_position = REPORTS[k] == LOCAL_POSITION or REPORTS[k] == GLOBAL_POSITION
    if vehicle.version_1 or (has_position and time_ns < vehicle.ready_ns):
        return NEEDS_PYTHON
    if has_position or vehicle.copter:
        if _must_move(vehicle, time_ns):
            return MOVE_FIRST
        _move(vehicle, time_ns)
    north, east, altitude_m, v_north, v_east, v_down, heading = _flown(vehicle)
    if REPORTS[k] == GLOBAL_POSITION and not -pi < heading < pi:
        return NEEDS_PYTHON
    schedule_report(vehicle, k, vehicle.number[k] + 1)
    if not has_position:
        return _status(vehicle, REPORTS[k], frame, time_ns)
    if REPORTS[k] == LOCAL_POSITION:
        note(truth, SAMPLED, vehicle.system_id, boot_ms & UINT32, time_ns, time_ns, time_ns, PASSED, 0)
        origin = vehicle.origin_neu_m
        north, east, down = north - origin[0], east - origin[1], -altitude_m
        if vehicle.copter:
            down = origin[2] - altitude_m  # not for others: 0 - 0 has another sign bit than -0, and that is sent
        return local_position(vehicle, frame, boot_ms, north, east, down, v_north, v_east, v_down)
    latitude_deg, longitude_deg = degrees(north, east)
    altitude_m += ORIGIN_ALTITUDE_M
    return global_position(
        vehicle, frame, boot_ms, latitude_deg, longitude_deg, altitude_m, v_north, v_east, v_down, heading
    )  # fmt: skip


@kernel
def hear_at(vehicles: Records, row: int, data: Bytes, time_ns: int, frames: Bytes, truth: Records) -> int:
    """As `hear`; `frames` has room for the datagram and for the answer. NEEDS_PYTHON if `truth` has no room."""
    if not can_record(truth):
        return NEEDS_PYTHON
    copy_bytes(frames[0], 0, data, 0, len(data))
    return hear(vehicles[row], frames[0], len(data), time_ns, frames[1], truth)


@kernel
def report_at(vehicles: Records, row: int, frames: Bytes, truth: Records) -> int:
    """As `report`, into the second of `frames`; NEEDS_PYTHON if another message is due by then or `truth` is full."""
    vehicle = vehicles[row]
    return (
        report(vehicle, frames[1], truth)
        if can_record(truth) and vehicle.report_ns < vehicle.other_ns
        else NEEDS_PYTHON
    )


@kernel
def run(
    vehicle: Record, up: Record, down: Record, entries: Records, frames: Bytes, draws: Records, truth: Records,
    now_ns: int,
) -> bool:  # fmt: skip
    """Run a plain vehicle until now; False if it stops before an event that takes Python. `draws`: of its up link."""
    while True:
        acts_ns = min(vehicle.deadline_ns, vehicle.report_ns, vehicle.other_ns)
        vehicle.acts_ns = acts_ns
        time_ns = min(acts_ns, down.next_due_ns)
        if time_ns > now_ns:
            return True
        if not ready(up, entries, truth):
            return False
        entry, size = new_entry(entries), NEEDS_PYTHON
        if down.next_due_ns == time_ns:
            arrived = entries[down.first]
            size = hear(vehicle, frames[down.first], arrived.size, time_ns, frames[entry], truth)
            if size >= SILENT:
                record_datagram(truth, down, arrived, frames[down.first], time_ns, time_ns, arrived.fate)
                take(down, entries)
        elif vehicle.report_ns < min(vehicle.deadline_ns, vehicle.other_ns):
            size = report(vehicle, frames[entry], truth)
        if size > SILENT:
            entries[entry].size = size
            enter(up, entries, frames, draws, truth, entry, time_ns)
        else:
            free(entries, entry)
        if size < SILENT:
            return False


@kernel
def leaves_ns(vehicle: Record, up: Record, down: Record) -> int:
    """The earliest time at which a datagram of the vehicle can leave its up link."""
    acts_ns = min(vehicle.acts_ns, down.next_due_ns)
    if acts_ns <= NEVER_NS - up.least_delay_ns:
        acts_ns += up.least_delay_ns
    return min(acts_ns, up.next_due_ns)


@kernel
def _enter_all(
    links: Records, entries: Records, frames: Bytes, draws: Records, truth: Records,
    data: Bytes, received: Ints, first: int,
) -> int:  # fmt: skip
    """Let datagrams from `first` on enter their down links; returns the first that cannot, or their number.

    The rows of `received` are start and end of each datagram in `data`, the vehicle's row, and the time.
    """
    for k in range(first, received.shape[1]):
        begin, size, row = received[0, k], received[1, k] - received[0, k], row_of(received[2, k], LINK_DOWN)
        link = links[row]
        if not link.plain or size > FRAME_BYTES or not ready(link, entries, truth):
            return k
        entry = take_in(entries, frames, data, begin, size)
        enter(link, entries, frames, draws[row], truth, entry, received[3, k])
    return received.shape[1]


@kernel
def run_at(
    vehicles: Records, links: Records, entries: Records, frames: Bytes, draws: Records, truth: Records,
    row: int, now_ns: int,
) -> bool:  # fmt: skip
    """Run the plain vehicle in a row until now; False if it stops before an event that takes Python."""
    up, down = row_of(row, LINK_UP), row_of(row, LINK_DOWN)
    return run(vehicles[row], links[up], links[down], entries, frames, draws[up], truth, now_ns)


@kernel
def _run_all(
    vehicles: Records, links: Records, entries: Records, frames: Bytes, draws: Records, truth: Records,
    waiting: Ints, now_ns: int,
) -> int:  # fmt: skip
    """Run until now each plain vehicle that may have a datagram leave by now, up to an event that takes Python.

    Returns how many vehicles are left to Python; `waiting` holds (when their next datagram can leave, row) of each.
    """
    count = 0
    for row in range(len(vehicles)):
        vehicle = vehicles[row]
        first_ns = leaves_ns(vehicle, links[row_of(row, LINK_UP)], links[row_of(row, LINK_DOWN)])
        if first_ns > now_ns:
            continue
        if not vehicle.plain or not run_at(vehicles, links, entries, frames, draws, truth, row, now_ns):
            waiting[count, 0], waiting[count, 1] = first_ns, row
            count += 1
    return count


@kernel
def leave_all(
    vehicles: Records, links: Records, entries: Records, frames: Bytes, truth: Records,
    leaving: Ints, data: Bytes, now_ns: int,
) -> int:  # fmt: skip
    """Take datagrams that leave their up links by now; returns how many.

    Those for which `leaving` has no column or `truth` no row are left to the next call.

    The rows of `leaving` are start and end of each datagram in `data`, the vehicle's row, and the time.
    """
    count = end = 0
    for row in range(len(vehicles)):
        link = links[row_of(row, LINK_UP)]
        while link.next_due_ns <= now_ns and link.under_way > 0:
            if count == leaving.shape[1] or not can_record(truth):
                return count
            entry = take(link, entries)
            begin, end = end, end + entries[entry].size
            copy_bytes(data, begin, frames[entry], 0, entries[entry].size)
            leaving[0, count], leaving[1, count], leaving[2, count] = begin, end, row
            leaving[3, count] = due_ns = entries[entry].due_ns
            record_datagram(truth, link, entries[entry], frames[entry], now_ns, due_ns, entries[entry].fate)
            count += 1
    return count


@kernel
def next_leaving_ns(vehicles: Records, links: Records) -> int:
    """The earliest time at which a datagram of any vehicle can leave."""
    first_ns = NEVER_NS
    for row in range(len(vehicles)):
        up, down = links[row_of(row, LINK_UP)], links[row_of(row, LINK_DOWN)]
        first_ns = min(first_ns, leaves_ns(vehicles[row], up, down))
    return first_ns


@kernel
def step_all(
    vehicles: Records, links: Records, entries: Records, frames: Bytes, draws: Records, truth: Records,
    data: Bytes, received: Ints, waiting: Ints, leaving: Ints, leaving_data: Bytes, first: int, now_ns: int,
) -> tuple[int, int, int]:  # fmt: skip
    """Let datagrams from `first` on enter, run the vehicles until now, and take what leaves by now.

    Returns the results of `_enter_all`, `_run_all` and `leave_all`. If not all could enter, nothing else is done yet;
    if vehicles wait, nothing leaves yet.
    """
    entered = _enter_all(links, entries, frames, draws, truth, data, received, first)
    if entered < received.shape[1]:
        return entered, 0, 0
    waits = _run_all(vehicles, links, entries, frames, draws, truth, waiting, now_ns)
    if waits:
        return entered, waits, 0
    return entered, 0, leave_all(vehicles, links, entries, frames, truth, leaving, leaving_data, now_ns)
