"""The station's state of one vehicle and its conversation with it: heartbeats, pilots, commands."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gcs.link import mavlink
from gcs.link.clocks import (
    LEAST_SAMPLES,
    UNKNOWN,
    Clocks,
    VehicleClock,
    answers,
    boot_ns_of,
    estimate_of,
    new_clocks,
    note_sent,
    request,
    to_station_ns,
)
from gcs.link.datagram import Address, Block, Outbox
from gcs.link.kinds import (
    ARM_DISARM,
    SET_MESSAGE_INTERVAL,
    SET_MODE,
    TAKE_OFF,
    UNRECOGNISED,
    Command,
    Goal,
    Step,
    commanded_mode,
    mode_command,
)
from gcs.link.mavlink import TIMESYNC_FRAME_BYTES, encode_timesync
from gcs.link.sequence import DUPLICATE, LATE, NEW, SequenceCounter, new_counters
from gcs.link.startup import OPTIONAL, WITHOUT_TARGET, Startup
from scenarios.kernel import Array, Cell, Columns, Record, Records, array_kernel, kernel
from scenarios.networks import wire_id
from scenarios.schema import NS_PER_S

ARMED = 0x80
_MOST_NAMED = 10
STATE_CRITICAL = 5
_LONGEST_HOLD_NS = 5 * NS_PER_S
"""The longest plausible hold of a set-point: vehicles forget a lag that exceeds a new one by more than this."""

_ORDER_TEXT = {LATE: "its frames arrive out of order", DUPLICATE: "its frames arrive more than once"}
RESULTS = ("ACCEPTED", "TEMPORARILY_REJECTED", "DENIED", "UNSUPPORTED", "FAILED", "IN_PROGRESS", "CANCELLED")
_ACCEPTED, _IN_PROGRESS = 0, 5
FORGET_NUMBERS_NS = 3 * NS_PER_S
SILENCE_S = 1.5
"""A vehicle without telemetry for this long is lost: it gets no more set-points, and the others fly without it. One
that sends nothing at all for this long may come back from another address."""
MAVLINK_1 = "speaks MAVLink 1, wanted MAVLink 2; on an ArduPilot, set SERIALn_PROTOCOL to 2"
_SILENT_NS = 3 * NS_PER_S
"""A vehicle that sends nothing for this long, not even heartbeats, is not ready."""


LINK = np.dtype(
    [
        ("address", "i8"),  # from which it sends; 0: not heard yet
        ("heard_ns", "i8"),  # when the newest valid frame arrived
        ("first_heard_ns", "i8"),  # when the first one arrived, or 0
        ("launched", "?"),  # it has no autopilot: only changes of its heartbeats matter, and it has no global position
        ("heartbeat_ns", "i8"),  # when the newest heartbeat arrived
        ("heartbeat", "i8"),  # `heartbeat_state` of a heartbeat that would change nothing; 0: none
        ("newest", "?"),  # the last frame processed was sent after all the others
        ("orders_reported", "i8"),  # frame-order faults already reported, as bits 1 << LATE and 1 << DUPLICATE
        ("left_out", "?"),  # see `RemoteVehicle`
        ("sequence", "i8"),  # of the last frame sent to it
        ("first_at_port", "?"),  # heartbeats are sent to it: no vehicle before it in the table sends from its port
        ("target", "i8"),  # its MAVLink system id if others at its port would answer its TIMESYNC too; else 0
        ("lag_ms", "i8"),  # reported lag after which held set-points act
        ("lag_jumps", "i8"),  # clock jumps counted when it was reported; -1: never reported
        ("local_ms", "i8"),  # time_boot_ms of its newest LOCAL_POSITION_NED
        ("local", "f8", (6,)),  # position and velocity in it
        ("local_is_new", "?"),  # it has not yet been passed to the start-up
    ],
    align=True,
)
"""Per-vehicle state that every received or sent frame may change."""


_KIND = 0xFFFF << 32
"""Bits of `heartbeat_state`: the kinds of vehicle and autopilot."""


@kernel
def heartbeat_state(heartbeat: int) -> int:
    """The state in the first 8 bytes of a heartbeat: custom mode, kinds, and whether it is armed or critical.

    The other bits follow from these, or are not used.
    """
    return heartbeat & 0x80FFFFFFFFFFFF | (heartbeat >> 56 & 0xFF == STATE_CRITICAL) << 56


class Links(NamedTuple):
    """The links to n vehicles."""

    known: Records
    """Of LINK, (n,)."""
    clocks: Clocks
    counters: Records

    @property
    def to(self) -> NDArray[np.int64]:
        """The address of each vehicle."""
        return self.known["address"]


def new_links(n: int) -> Links:
    """Links over which nothing has been received yet."""
    known = np.zeros(n, LINK)
    known["newest"], known["lag_jumps"] = True, -1
    return Links(known, new_clocks(n), new_counters(n))


def note_ports(known: Records, wire_ids: NDArray[np.int64]) -> None:
    """Note which vehicles share a port, after the address of one has changed."""
    _, first, port, sharing = np.unique(known["address"], return_index=True, return_inverse=True, return_counts=True)
    known["first_at_port"] = False
    known["first_at_port"][first] = True
    known["target"] = np.where(sharing[port] > 1, wire_ids, 0)


def set_points_to(links: Links, points: Records, targets: NDArray[np.int64], key_ms: int) -> Block:
    """Set-points, as of `gcs.link.mavlink.set_point_frames`, to those marked `sent` whose vehicle has been heard."""
    rows = heard(links.known, points["sent"])
    frames = mavlink.set_point_frames(points, rows, links.known["sequence"], targets, key_ms)
    return Block(frames, np.full(len(rows), frames.shape[1]), rows, links.to)


def heartbeats_to(links: Links) -> Block:
    """A HEARTBEAT from the station to each port from which vehicles have been heard."""
    rows = heard(links.known, links.known["first_at_port"])
    frames = mavlink.same_frames(HEARTBEAT, mavlink.HEARTBEAT_EXTRA, rows, links.known["sequence"])
    return Block(frames, np.full(len(rows), frames.shape[1]), rows, links.to)


def note_requests(links: Links, outbox: Outbox, sent_ns: NDArray[np.int64]) -> None:
    """Record the send times of the TIMESYNC requests among a step's datagrams: round trips are measured from them."""
    place = 0
    for part in outbox.parts:
        count = len(part.rows) if isinstance(part, Block) else 1
        if isinstance(part, Block) and count and part.frames[0, 7] == mavlink.TIMESYNC:
            note_sent(links.clocks.known, links.clocks.pending_ns, part.rows, sent_ns[place : place + count])
        place += count


@array_kernel
def heard(known: Records, wanted: Array) -> NDArray[np.int64]:
    """The wanted rows whose vehicles have been heard."""
    rows, found = np.empty(len(known), np.int64), 0
    for row in range(len(known)):
        if wanted[row] and known[row].address:
            rows[found] = row
            found += 1
    return rows[:found]


@array_kernel
def ask(
    known: Records, clocks: Records, pending_ns: Array, first: int, count: int, now_ns: int
) -> tuple[Array, Array, Array]:
    """Make TIMESYNC requests to `count` vehicles from `first` on, round robin: frames, their sizes and the rows."""
    frames = np.zeros((count, TIMESYNC_FRAME_BYTES), np.uint8)
    sizes, rows, place = np.empty(count, np.int64), np.empty(count, np.int64), 0
    for turn in range(first, first + count):
        row = turn % len(known)
        if not known[row].address:
            continue
        if now_ns - known[row].heard_ns > SILENCE_S * NS_PER_S:
            clocks[row].unanswered = 0  # it sends nothing at all, which counts as silence
        rows[place] = row
        known[row].sequence = (known[row].sequence + 1) & 0xFF
        ts1_ns = request(clocks[row], pending_ns[row], now_ns)
        sizes[place] = encode_timesync(frames[place], 0, ts1_ns, known[row].target, known[row].sequence)
        place += 1
    return frames[:place], sizes[:place], rows[:place]


@kernel
def delivery_ns(link: Record, clock: Record, key_ms: int, sent_ns: int) -> int:
    """Time from `sent_ns` until the set-point with the stamp `key_ms` acts: the delay down, or longer if it is held.

    A held set-point acts when the vehicle's clock shows its stamp plus the reported lag. `key_ms` is 0 if the stamp is
    unknown. The result is UNKNOWN while the delay down is, or if the vehicle no longer answers.
    """
    if not answers(clock, sent_ns):
        return UNKNOWN
    if clock.down_ns == UNKNOWN or not key_ms or link.lag_jumps != clock.jumps or not clock.samples:
        return clock.down_ns
    known = estimate_of(clock)
    boot_ns = boot_ns_of(known, (key_ms + link.lag_ms) & 0xFFFFFFFF, sent_ns)
    return max(clock.down_ns, to_station_ns(known, boot_ns) - sent_ns)


@kernel
def _delivery_at_ns(known: Records, clocks: Records, row: int, key_ms: int, sent_ns: int) -> int:
    return delivery_ns(known[row], clocks[row], key_ms, sent_ns)


HEARTBEAT = np.frombuffer(mavlink.encode(mavlink.HEARTBEAT, mavlink.heartbeat(), sequence=0), np.uint8)
Report = Callable[[str, str, int], None]
"""Callback that takes an event: its kind, its text and the system id of the vehicle."""


def ignored(kind: str, text: str, system_id: int) -> None:
    """A `Report` that drops every event."""


@dataclass
class _Waiting:
    """A COMMAND_LONG whose COMMAND_ACK is awaited."""

    command: int
    parameters: tuple[float, ...]
    sent_ns: int
    confirmation: int = 0


class RemoteVehicle:
    """The state of one vehicle; `next_frame` gives the frames that bring it to the state the station wants.

    `startup` does what depends on the kind of vehicle. At the end the vehicle lands if `land` is set, else it holds.
    State that every frame may change is in a row of `links`.
    """

    address = Cell[Address | None](0)
    """From which it sends; None until it is heard."""
    heard_ns = Cell[int]()
    """When the newest valid frame arrived."""
    first_heard_ns = Cell[int | None](0)
    newest = Cell[bool]()
    """Whether the last frame processed was sent after all the others."""
    left_out = Cell[bool]()
    """Whether the formation flies without it because it did not become ready in time."""
    heartbeat_ns = Cell[int]()
    """When the newest heartbeat arrived."""
    _launched, _heartbeat = Cell[bool](), Cell[int]()
    _local_ms, _local_is_new = Cell[int](), Cell[bool]()
    _orders_reported, _sequence, _lag_ms, _lag_jumps = Cell[int](), Cell[int](), Cell[int](), Cell[int]()
    _target = Cell[int]()

    def __init__(
        self,
        system_id: int,
        *,
        startup: Startup,
        report: Report = ignored,
        land: bool = False,
        external: bool = False,
        holds: bool = False,
        links: Links | None = None,
        row: int = 0,
    ) -> None:
        self.system_id, self.wire_id = system_id, wire_id(system_id)
        self._holds = holds
        """Whether it holds set-points, so that its `LAG_MS` counts."""
        self.external = external
        """Whether it is planned that somebody else flies it. It takes part in the formation and its mode does not
        matter; the station only requests messages from it."""
        self._links, self._row = links or new_links(1), row
        self._columns = Columns(self._links.known)
        self.frames = SequenceCounter(self._links.counters, row)
        self.clock = VehicleClock(self._links.clocks, row)
        self.armed = False
        self.custom_mode = -1
        self.critical = False
        self.goal: Goal | None = Goal.FLY
        """None: the vehicle is left alone."""
        self.taken_over = False
        """Whether a pilot, or the autopilot on its own account, flies the vehicle. This ends only when the vehicle
        reports the guided mode; until then the station requests telemetry and commands nothing else."""
        self.startup = startup
        self.kind = startup.kind
        self._launched = not self.kind.piloted
        self.has_been_guided = self._take_off_sent = False
        self._doubtful_ns = 0
        """When the first heartbeat after a long silence arrived. Its sequence number does not reveal a replay."""
        self.unusable = ""
        """Why its newest frames cannot be used; empty if they can."""
        self._land = land
        self._now_ns = 0
        self._report = report
        self._command: _Waiting | None = None
        self._settled = False
        """Whether the vehicle takes set-points and lacks nothing: no command is due until it reports otherwise."""
        self._earlier = 0, 0
        """A command that was sent more than once, and how many answers to its copies may still arrive."""
        self._unanswered_ns = 0
        """When the last ARM or TAKE_OFF was sent whose result is unknown; 0 if there is none."""
        self._not_before_ns = 0
        self._outdated: list[tuple[int, int, bool]] = []
        """For each recent command that changed mode or arming: the time of its ACK, and mode and arming before it. A
        heartbeat sent before the command was executed still reports those."""

    @property
    def end_mode(self) -> int:
        return self.kind.land_mode if self._land else self.kind.hold_mode

    @property
    def ended(self) -> bool:
        """Whether the vehicle holds or lands, or must not be told to: it is not armed, or somebody else flies it.

        False while the result of an ARM or TAKE_OFF is unknown.
        """
        if self.external or self.taken_over or self.startup.stranger:
            return True
        if self.kind.piloted and (self.kind is UNRECOGNISED or not (self.armed or self._unanswered_ns)):
            return True
        return self.custom_mode == self.end_mode and not self._unanswered_ns

    @property
    def guided(self) -> bool:
        """Whether it takes part in the flight: armed in its guided mode, or flown by somebody else as planned."""
        return self.external or (self.armed and self.custom_mode == self.kind.guided_mode and not self.taken_over)

    @property
    def idle(self) -> bool:
        """Whether `next_frame` has nothing to send until the vehicle sends a message."""
        return self._settled and self.goal is Goal.FLY and not self.kind.piloted  # autopilots are asked for limits

    @property
    def quiet_until_ns(self) -> float:
        """The time until which `next_frame` sends nothing and the vehicle cannot become `silent`.

        Valid if its parameters are uploaded and it sends only what kernels handle. 0: unknown; infinity: not heard yet.
        """
        waiting = self._command
        if self.address is None:
            return inf
        works = not self.idle and not self.awaits_clock
        if waiting is None and works and (self.goal is Goal.FLY or self._wanted() is not None):
            return 0
        return min(inf if waiting is None else waiting.sent_ns + NS_PER_S, self.heard_ns + _SILENT_NS)

    @property
    def awaits_message(self) -> bool:
        """Whether it cannot become ready before it sends something that kernels do not handle."""
        return not self.left_out and (self.address is None or self._next_step().command is not None)

    @property
    def awaits_clock(self) -> bool:
        """Whether it lacks only answers to TIMESYNC, and is sent nothing else until it has them; never an autopilot."""
        if self.clock.samples >= LEAST_SAMPLES or self.kind.piloted or self.left_out or self.goal is not Goal.FLY:
            return False
        return self.guided and self._next_step().command is None

    @property
    def ready(self) -> bool:
        return not self.missing

    @property
    def silent(self) -> bool:
        """Whether the vehicle was heard before, but not in the last seconds."""
        return self.address is not None and self._now_ns - self.heard_ns > _SILENT_NS

    @property
    def missing(self) -> str:
        """Why the vehicle is not ready or, at the end, has not ended, in words; empty if it is or has."""
        if self.address is None:
            return self.unusable or "not heard"
        if self.silent:
            return "is silent"
        if self.goal is Goal.END:
            return "" if self.ended else f"does not {'land' if self._land else 'hold'}"
        if self.taken_over and not self.startup.stays_disarmed:
            left = "left" if self.has_been_guided else "is armed and not in"
            return f"{left} {self.kind.guided_name}: flown by its pilot or its autopilot"
        missing = self._next_step().missing
        return missing and (self.unusable or missing)

    def encode(self, msg_id: int, fields: tuple[Any, ...]) -> bytes:
        """A frame to this vehicle. Each vehicle gets its own sequence numbers, by which it can count losses."""
        self._sequence = (self._sequence + 1) & 0xFF
        return mavlink.encode(msg_id, fields, sequence=self._sequence)

    def send(self, msg_id: int, fields: tuple[Any, ...], outgoing: Outbox) -> None:
        """Queue a frame to the vehicle, if its address is known."""
        if self.address is not None:
            outgoing.append((self.encode(msg_id, fields), self.address))

    def send_timesync(self, tc1_ns: int, ts1_ns: int, outgoing: Outbox) -> None:
        """Queue a TIMESYNC: a request if tc1 is 0, else the answer to the request with this ts1."""
        if self.address is not None:
            frame = np.zeros(TIMESYNC_FRAME_BYTES, np.uint8)
            self._sequence = (self._sequence + 1) & 0xFF
            size = encode_timesync(frame, tc1_ns, ts1_ns, self._target, self._sequence)
            outgoing.append((frame[:size].tobytes(), self.address))

    def is_elsewhere(self, address: Address, received_ns: int) -> bool:
        """Whether the vehicle sends from another address and has been heard recently."""
        return self.address not in {None, address} and received_ns - self.heard_ns <= SILENCE_S * NS_PER_S

    def accepts_address(self, address: Address, msg_id: int, received_ns: int) -> bool:
        """Whether a frame from a new address may be from this vehicle: only a heartbeat, at first or after silence."""
        return msg_id == mavlink.HEARTBEAT and not self.is_elsewhere(address, received_ns)

    def is_replay(self, frame: mavlink.Frame, now_ns: int) -> bool:
        """Whether a frame was received before, or is a heartbeat that a newer frame has overtaken.

        Links that reorder or repeat frames cause this all the time: it is counted in `frames` and reported once.
        A restarted vehicle restarts its numbers, so FORGET_NUMBERS_NS after the last valid heartbeat any is accepted.
        """
        heartbeat = frame.msg_id == mavlink.HEARTBEAT
        order = self.frames.add(frame.sequence, now_ns)
        if order != NEW and not self._orders_reported >> order & 1:
            self._orders_reported |= 1 << order
            self.report_order(order)
        self.newest = order == NEW
        if heartbeat and now_ns - self.heartbeat_ns > FORGET_NUMBERS_NS:
            self._doubtful_ns = now_ns
        replayed = order == DUPLICATE or (heartbeat and order == LATE)
        if replayed and heartbeat and now_ns - self.heartbeat_ns > FORGET_NUMBERS_NS:
            self.frames.restart()
            return False
        if heartbeat and not replayed:
            self.heartbeat_ns = now_ns
        return replayed

    def pass_to_startup(self, msg_id: int, fields: tuple[Any, ...]) -> None:
        """Pass a message to the start-up, after the position that kernels have stored and not passed on."""
        self._pass_position()
        self._settled &= not self.kind.piloted
        self.startup.take(msg_id, fields)

    def _pass_position(self) -> None:
        if self._local_is_new:
            self._local_is_new = False
            local: list[float] = self._links.known["local"][self._row].tolist()
            self.startup.take(mavlink.LOCAL_POSITION_NED, (self._local_ms, *local))

    def report_order(self, order: int) -> None:
        """Report that its frames arrive LATE or DUPLICATE."""
        self._report("link", _ORDER_TEXT[order], self.system_id)

    def named_int(self, fields: tuple[Any, ...], key_ms: int, now_ns: int) -> bool:
        """Process a NAMED_VALUE_INT: it may report the lag after which the vehicle's held set-points act.

        The lag includes the clock offset. Returns False for an impossible one: a set-point stamped now would be held
        too long.
        """
        _, value, name = fields
        if not self._holds or name.rstrip(b"\0") != b"LAG_MS":
            return True
        before = self._lag_ms, self._lag_jumps
        self._lag_ms, self._lag_jumps = value, self.clock.jumps
        possible = (self.delivery_ns(key_ms, now_ns) or 0) - (self.clock.down_ns or 0) <= _LONGEST_HOLD_NS
        if not possible:
            self._lag_ms, self._lag_jumps = before
        return possible

    def delivery_ns(self, key_ms: int, sent_ns: int) -> int | None:
        """Time from `sent_ns` until the set-point with this stamp acts; None while unknown."""
        found_ns = _delivery_at_ns(self._links.known, self._links.clocks.known, self._row, key_ms, sent_ns)
        return None if found_ns == UNKNOWN else found_ns

    def heartbeat(self, fields: tuple[Any, ...], now_ns: int) -> None:
        """Process a HEARTBEAT. One sent before the vehicle executed a command does not undo what the ACK reported."""
        self._settled = False
        custom_mode, vehicle_type, autopilot, base_mode, system_status, _ = fields
        armed, critical = bool(base_mode & ARMED), system_status == STATE_CRITICAL
        recent_ns = now_ns - NS_PER_S - 2 * (self.clock.rtt_ns or 0)
        self._outdated = [before for before in self._outdated if before[0] > recent_ns]
        if any((custom_mode, armed) == (mode, was_armed) for _, mode, was_armed in self._outdated):
            return
        was_guided = self.guided
        self.kind = self.startup.recognise(autopilot, vehicle_type)
        if self.kind.piloted:
            self.clock.expected_error_ns = self.kind.timesync_error_ns
            self._see_pilot(custom_mode, now_ns, armed=armed, critical=critical)
            if self.armed and not armed:
                self.startup.disarmed()
        if self._unanswered_ns < recent_ns:
            self._unanswered_ns = 0
        self.custom_mode, self.armed = custom_mode, armed
        if critical and not self.critical:
            self._report("vehicle", "is in failsafe", self.system_id)
        elif was_guided and not self.guided and not critical:
            self._report("vehicle", f"left {self.kind.guided_name}" if armed else "was disarmed", self.system_id)
        self.critical = critical
        self._expect(vehicle_type << 32 | autopilot << 40)

    def _see_pilot(self, mode: int, now_ns: int, *, armed: bool, critical: bool) -> None:
        """Detect from a reported mode or arming that somebody else has taken the vehicle over, or handed it back.

        A mode to which no command of the station leads is somebody's choice, unless the vehicle enters it when
        set-points stop. A reported failsafe is not enough: its pilot may steer it, or it may fly home on a low battery.
        On the ground, before arming, anybody may set any mode. Whoever arms a vehicle flies it, unless it holds: then
        it waits for its take-off.
        """
        kind, before = self.kind, self.custom_mode
        if self.external:
            return
        if mode == kind.guided_mode:
            self.has_been_guided = True
            self.taken_over = self.taken_over and now_ns - self._doubtful_ns < FORGET_NUMBERS_NS
        elif self.taken_over or (self.goal is Goal.END and mode == self.end_mode):
            return
        elif before < 0:
            self.taken_over = armed and mode not in (kind.hold_mode, kind.take_off_mode)
        elif mode == before:
            self.taken_over = armed and not (self.armed or self._unanswered_ns or mode == kind.hold_mode)
        elif armed or self.armed or before == kind.guided_mode:
            self.taken_over = not (self._takes_off_by(mode) or (critical and mode == kind.failsafe_mode))
        if self.taken_over:
            self._command = None  # resending it would take the vehicle back

    def _takes_off_by(self, mode: int) -> bool:
        """Whether a mode belongs to the commanded take-off: first the take-off mode, then hold at the top."""
        kind = self.kind
        if kind.guided_first or self.has_been_guided:
            return False
        if mode == kind.take_off_mode:
            return self._take_off_sent
        return mode == kind.hold_mode and self.custom_mode == kind.take_off_mode and self.startup.is_halfway_up

    def acknowledge(self, fields: tuple[Any, ...], now_ns: int) -> None:
        command, result, *_, target_system, _ = fields
        waiting = self._command
        if waiting is None or waiting.command != command or target_system not in (0, mavlink.STATION_SYSTEM_ID):
            return
        if result == _IN_PROGRESS:
            waiting.sent_ns = now_ns
            return
        self._settled = False
        earlier, answers = self._earlier
        if earlier == command and answers > 0 and now_ns - waiting.sent_ns < (self.clock.rtt_ns or 0):
            self._earlier = earlier, answers - 1  # too soon for an answer to this request
            return
        self._command, self._unanswered_ns = None, 0
        self._earlier = command, waiting.confirmation
        if result != _ACCEPTED:
            name = RESULTS[result] if result < len(RESULTS) else str(result)
            if command == SET_MESSAGE_INTERVAL and waiting.parameters[0] == OPTIONAL:
                self._report("vehicle", WITHOUT_TARGET, self.system_id)
            elif command != ARM_DISARM or not self.startup.arming_refusals:  # repeated refusals are only counted
                self._report("vehicle", f"answered {name} to command {command}", self.system_id)
            self.startup.refused(command, waiting.parameters, now_ns, repeated=waiting.confirmation > 0)
            self._not_before_ns = now_ns + NS_PER_S
            return
        if command == ARM_DISARM and self.startup.arming_refusals > 1:
            self._report("vehicle", f"arms after {self.startup.arming_refusals} refusals", self.system_id)
        self.startup.accepted(command, waiting.parameters, now_ns)
        if command in (SET_MODE, ARM_DISARM):
            self._outdated.append((now_ns, self.custom_mode, self.armed))
        if command == SET_MODE:
            self.custom_mode = commanded_mode(self.kind, waiting.parameters)
            self.critical = False
        elif command == ARM_DISARM:
            self.armed = waiting.parameters[0] == 1.0
        self._expect(self._heartbeat & _KIND)

    def _expect(self, kind: int) -> None:
        """Record the `heartbeat_state` that would change nothing, given its bits of `_KIND`."""
        self._heartbeat = self.custom_mode | kind | self.armed << 55 | self.critical << 56

    def next_frame(self, now_ns: int) -> bytes | None:
        """The frame that is due to bring the vehicle to the wanted state, if any: a command, else a parameter.

        One command at a time awaits its ACK, which carries no request id. After three round trips, and at least 1 s,
        without an answer the command is resent with its confirmation counter raised. Several answers may then arrive:
        one that arrives within a round trip of the next request with the same command does not answer that request.
        """
        self._now_ns = now_ns
        if self.address is None or self.idle:
            return None
        settled = self._settled and self.goal is Goal.FLY
        if settled:  # the start-up sees every position, as when it is asked for its next step
            self._pass_position()
        frame = None if settled else self._next_command(now_ns)
        if frame is None and self.goal is Goal.FLY:
            rtt_ns, due = self.clock.rtt_ns or 0, None
            if not self.external:
                due = self.startup.next_parameter(now_ns, target_system=self.wire_id, rtt_ns=rtt_ns)
            idle = due is None and self._command is None and self.guided
            self._settled = settled or (idle and not self._next_step().missing)
            return None if due is None else self.encode(*due)
        return frame

    def final_command(self) -> bytes | None:
        """The command to hold or land, from a station that cannot wait for the answer; None if none is needed."""
        if self.address is None or self.ended:
            return None
        command, parameters = mode_command(self.kind, self.end_mode)
        fields = mavlink.command_long(command, target_system=self.wire_id, confirmation=0, parameters=parameters)
        return self.encode(mavlink.COMMAND_LONG, fields)

    def _next_command(self, now_ns: int) -> bytes | None:
        if now_ns < self._not_before_ns:
            return None
        waiting = self._command
        if waiting is not None:
            if now_ns - waiting.sent_ns < max(NS_PER_S, 3 * (self.clock.rtt_ns or 0)):
                return None
            waiting.sent_ns = now_ns
            waiting.confirmation = (waiting.confirmation + 1) & 0xFF
            self._earlier = 0, 0  # an answer to an earlier request would have arrived
            revocable = waiting.command in (SET_MODE, ARM_DISARM) or self.startup.stays_disarmed
            if revocable and (waiting.command, waiting.parameters) != self._wanted():
                self._command = waiting = None
        if waiting is None:
            wanted = self._wanted()
            if wanted is None:
                return None
            waiting = self._command = _Waiting(*wanted, sent_ns=now_ns)
            self._take_off_sent = self._take_off_sent or waiting.command == TAKE_OFF
        if waiting.command in (ARM_DISARM, TAKE_OFF):
            self._unanswered_ns = now_ns
        return self.encode(
            mavlink.COMMAND_LONG,
            mavlink.command_long(
                waiting.command,
                target_system=self.wire_id,
                confirmation=waiting.confirmation,
                parameters=waiting.parameters,
            ),
        )

    def _wanted(self) -> Command | None:
        if self.goal is None:
            return None
        if self.goal is Goal.END:
            return None if self.ended else mode_command(self.kind, self.end_mode)
        command = self._next_step().command
        return command if command is None or not self.taken_over or command[0] == SET_MESSAGE_INTERVAL else None

    def _next_step(self) -> Step:
        """The next step of the start-up. Mode and arming of a vehicle flown by somebody else are left to its pilot."""
        self._pass_position()
        step = self.startup.next(
            custom_mode=self.kind.guided_mode if self.external else self.custom_mode,
            armed=self.armed or self.external,
            clock_known=self.clock.samples >= LEAST_SAMPLES,
            now_ns=self._now_ns,
        )
        asks = step.command is not None and step.command[0] == SET_MESSAGE_INTERVAL
        return Step(step.missing) if self.external and not asks else step

    def end(self, *, alone: bool = False) -> None:
        """Let it hold or land from now on, or leave it alone. A pending command is dropped, unless it sets a mode: its
        ACK does not name the mode, and could be taken for that of the next mode command."""
        self.goal = None if alone else Goal.END
        if self._command is not None and self._command.command != SET_MODE:
            self._command = None

    def begin_anew(self) -> None:
        """Set rates and parameters again: the vehicle seems to have restarted.

        A vehicle that was taken over stays taken over: perhaps only its clock has slipped.
        """
        self.startup.begin_anew()
        self._command, self._settled = None, False


def in_words(what: str, vehicles: Sequence[RemoteVehicle]) -> str:
    """A line that begins with `what` and lists what vehicles lack; empty if there are none. At most ten are named."""
    named = [f"vehicle {v.system_id} {v.missing}" for v in vehicles[:_MOST_NAMED]]
    named += [f"{len(vehicles) - _MOST_NAMED} others"] if len(vehicles) > _MOST_NAMED else []
    return what + "; ".join(named) if vehicles else ""


def refusals(vehicles: Sequence[RemoteVehicle]) -> str:
    """Which vehicles must not be flown, and why; empty if all may."""
    return in_words("refused: ", [vehicle for vehicle in vehicles if vehicle.startup.refusal])
