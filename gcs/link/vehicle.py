"""What the station knows of one vehicle, and its conversation with it: heartbeats, pilots, commands."""

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

_ORDER_TEXT = {LATE: "its frames arrive out of order", DUPLICATE: "its frames arrive more than once"}
_NOBODY = -1
"""In place of the number of an address."""
RESULTS = ("ACCEPTED", "TEMPORARILY_REJECTED", "DENIED", "UNSUPPORTED", "FAILED", "IN_PROGRESS", "CANCELLED")
_ACCEPTED, _IN_PROGRESS = 0, 5
FORGET_NUMBERS_NS = 3 * NS_PER_S
SILENCE_S = 1.5
"""A vehicle without telemetry for this long is lost: it is sent no more set-points, and the others fly without it. One
that sends nothing at all for this long may be accepted from another address."""
_SILENT_NS = 3 * NS_PER_S
"""A vehicle that sends nothing for this long, not even heartbeats, is not ready."""


LINK = np.dtype(
    [
        ("address", "i8"),  # place among `Links.addresses`, or _NOBODY
        ("heard_ns", "i8"),  # newest valid frame
        ("first_heard_ns", "i8"),  # first one, or 0
        ("launched", "?"),  # it has no autopilot, so that only changes of its heartbeats matter, and no global position
        ("heartbeat_ns", "i8"),  # newest heartbeat
        ("heartbeat", "u8"),  # the first 8 bytes of a heartbeat that would change nothing; 0: none
        ("newest", "?"),  # the last frame taken in was sent after all the others
        ("told", "i8"),  # bits of what was reported of the order of its frames: 1 << LATE, 1 << DUPLICATE
        ("left_out", "?"),  # see `RemoteVehicle`
        ("sequence", "i8"),  # of the last frame sent to it
        ("lag_ms", "i8"),  # the reported lag of held set-points, and how often the clock had jumped by then; -1: never
        ("lag_jumps", "i8"),
        ("local_ms", "i8"),
        ("local", "f8", (6,)),  # its newest LOCAL_POSITION_NED, and whether it has sent one since
        ("local_is_new", "?"),  # the start-up was last told of it
    ],
    align=True,
)
"""What every frame from or to one vehicle changes."""


class Links(NamedTuple):
    """The links to n vehicles."""

    known: Records
    """Of LINK, (n,)."""
    clocks: Clocks
    counters: Records
    addresses: dict[Address, int]
    """A number for each address that vehicles have sent from."""
    to: list[Address | None]
    """The address of each vehicle."""


def new_links(n: int) -> Links:
    """Links over which nothing has been heard."""
    known = np.zeros(n, LINK)
    known["address"], known["newest"], known["lag_jumps"] = _NOBODY, True, -1
    return Links(known, new_clocks(n), new_counters(n), {}, [None] * n)


def set_points_to(links: Links, points: Records, targets: NDArray[np.int64], key_ms: int) -> Block:
    """Set-points to the vehicles that are sent one and have been heard; see `gcs.link.mavlink.set_point_frames`."""
    rows = heard(links.known, points["sent"])
    frames = mavlink.set_point_frames(points, rows, links.known["sequence"], targets, key_ms)
    return Block(frames, np.full(len(rows), frames.shape[1]), rows, links.to)


def heartbeats_to(links: Links) -> Block:
    """A HEARTBEAT of the station to all vehicles that have been heard."""
    rows = heard(links.known, np.ones(len(links.to), np.bool_))
    frames = mavlink.same_frames(HEARTBEAT, mavlink.HEARTBEAT_EXTRA, rows, links.known["sequence"])
    return Block(frames, np.full(len(rows), frames.shape[1]), rows, links.to)


def note_requests(links: Links, outbox: Outbox, sent_ns: NDArray[np.int64]) -> None:
    """Note when the TIMESYNC requests among the datagrams of a step were sent: round trips count from then."""
    place = 0
    for part in outbox.parts:
        count = len(part.rows) if isinstance(part, Block) else 1
        if isinstance(part, Block) and count and part.frames[0, 7] == mavlink.TIMESYNC:
            note_sent(links.clocks.known, links.clocks.pending_ns, part.rows, sent_ns[place : place + count])
        place += count


@array_kernel
def heard(known: Records, wanted: Array) -> NDArray[np.int64]:
    """The rows that are wanted and whose vehicles have been heard."""
    rows, found = np.empty(len(known), np.int64), 0
    for row in range(len(known)):
        if wanted[row] and known[row].address != _NOBODY:
            rows[found] = row
            found += 1
    return rows[:found]


@array_kernel
def ask(
    known: Records, clocks: Records, pending_ns: Array, first: int, count: int, now_ns: int
) -> tuple[Array, Array, Array]:
    """Note the requests; returns their frames, the sizes of these and the rows."""
    frames = np.zeros((count, TIMESYNC_FRAME_BYTES), np.uint8)
    sizes, rows, place = np.empty(count, np.int64), np.empty(count, np.int64), 0
    for turn in range(first, first + count):
        row = turn % len(known)
        if known[row].address == _NOBODY:
            continue
        rows[place] = row
        known[row].sequence = (known[row].sequence + 1) & 0xFF
        ts1_ns = request(clocks[row], pending_ns[row], now_ns)
        sizes[place] = encode_timesync(frames[place], 0, ts1_ns, known[row].sequence)
        place += 1
    return frames[:place], sizes[:place], rows[:place]


@kernel
def delivery_ns(link: Record, clock: Record, key_ms: int, sent_ns: int) -> int:
    """How long after `sent_ns` the set-point with this stamp acts: it arrives, and the vehicle may hold it.

    It acts when the vehicle's clock shows its stamp plus the reported lag. `key_ms` is 0 if the stamp is unknown.
    UNKNOWN while the delay to the vehicle is.
    """
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
"""Takes an event: its kind, its text and the system id of the vehicle."""


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
    """What is known of one vehicle; `next_frame` gives the frames that bring it to the state the station wants.

    `startup` holds what depends on the kind of vehicle. At the end the vehicle lands if `land` is set, else it holds.
    What every frame changes is in a row of `links`.
    """

    heard_ns = Cell[int]()
    """When the newest valid frame came."""
    first_heard_ns = Cell[int | None](0)
    newest = Cell[bool]()
    """Whether the last frame taken in was sent after all the others."""
    left_out = Cell[bool]()
    """Whether the formation flies without it because it did not become ready in time."""
    heartbeat_ns = Cell[int]()
    """When the newest heartbeat came."""
    _launched, _heartbeat = Cell[bool](), Cell[int]()
    _local_ms, _local_is_new = Cell[int](), Cell[bool]()
    _told, _sequence, _lag_ms, _lag_jumps = Cell[int](), Cell[int](), Cell[int](), Cell[int]()

    def __init__(
        self,
        system_id: int,
        *,
        startup: Startup,
        report: Report = ignored,
        land: bool = False,
        external: bool = False,
        links: Links | None = None,
        row: int = 0,
    ) -> None:
        self.system_id, self.wire_id = system_id, wire_id(system_id)
        self.external = external
        """Whether somebody else flies it, as planned: it takes part in the formation, and its mode does not matter. It
        is asked for messages, and nothing else."""
        self._links, self._row = links or new_links(1), row
        self._columns = Columns(self._links.known)
        self.frames = SequenceCounter(self._links.counters, row)
        self.clock = VehicleClock(self._links.clocks, row)
        self.armed = False
        self.custom_mode = -1
        self.critical = False
        self.goal: Goal | None = Goal.FLY
        """None: the vehicle is left to itself."""
        self.taken_over = False
        """Whether the vehicle's pilot flies it, or its autopilot for a reason of its own. This ends only when it
        reports that it is guided; until then the station asks it for telemetry and commands nothing."""
        self.startup = startup
        self.kind = startup.kind
        self._launched = not self.kind.piloted
        self._has_been_guided = self._take_off_sent = False
        self._doubtful_ns = 0
        """When the first heartbeat after a long silence arrived. It may be a replay: its number does not show that."""
        self._land = land
        self._now_ns = 0
        self._report = report
        self._command: _Waiting | None = None
        self._settled = False
        """Whether the vehicle takes set-points and lacks nothing, so that no command is due until it says otherwise.
        One with an autopilot never counts as settled, because its start-up counts time."""
        self._earlier = 0, 0
        """A command that was sent more than once, and how many answers to its copies may still come."""
        self._unanswered_ns = 0
        """When the last ARM or TAKE_OFF was sent of which it is not known what became of it; 0 if there is none."""
        self._not_before_ns = 0
        self._outdated: list[tuple[int, int, bool]] = []
        """Time of the ACK of each recent command that changed mode or arming, with the mode and arming before it. A
        heartbeat made before the command was carried out may still report these."""

    @property
    def address(self) -> Address | None:
        return self._links.to[self._row]

    @address.setter
    def address(self, address: Address | None) -> None:
        numbers, self._links.to[self._row] = self._links.addresses, address
        number = _NOBODY if address is None else numbers.setdefault(address, len(numbers))
        self._links.known["address"][self._row] = number

    @property
    def end_mode(self) -> int:
        return self.kind.land_mode if self._land else self.kind.hold_mode

    @property
    def ended(self) -> bool:
        """Whether the vehicle holds or lands, or is not ours to end: it never took off, or somebody else flies it."""
        if self.external or self.taken_over:
            return True
        if self.kind.piloted and (self.kind is UNRECOGNISED or not (self.armed or self._unanswered_ns)):
            return True
        return self.custom_mode == self.end_mode and not self._unanswered_ns

    @property
    def guided(self) -> bool:
        """Whether it takes part in the flight: armed and in its guided mode, or flown by somebody else as planned."""
        return self.external or (self.armed and self.custom_mode == self.kind.guided_mode and not self.taken_over)

    @property
    def idle(self) -> bool:
        """Whether `next_frame` has nothing to send until the vehicle says something."""
        return self._settled and self.goal is Goal.FLY

    @property
    def quiet_until_ns(self) -> float:
        """Until when `next_frame` sends nothing and the vehicle cannot become `silent`.

        This holds if its parameters are uploaded and it says nothing unusual. 0 if unknown, infinity until it is heard.
        """
        waiting = self._command
        if self.address is None:
            return inf
        if waiting is None and not self.idle and (self.goal is Goal.FLY or self._wanted() is not None):
            return 0
        return min(inf if waiting is None else waiting.sent_ns + NS_PER_S, self.heard_ns + _SILENT_NS)

    @property
    def has_to_speak(self) -> bool:
        """Whether it cannot become ready before it says something unusual."""
        return not self.left_out and (self.address is None or self._next_step().command is not None)

    @property
    def ready(self) -> bool:
        return not self.missing

    @property
    def silent(self) -> bool:
        """Whether the vehicle was heard before, but not in the last seconds."""
        return self.address is not None and self._now_ns - self.heard_ns > _SILENT_NS

    @property
    def missing(self) -> str:
        """What keeps the vehicle from being ready or, at the end, from having ended, in words; "" if nothing does."""
        if self.address is None or self.silent:
            return "not heard" if self.address is None else "is silent"
        if self.goal is Goal.END:
            return "" if self.ended else f"does not {'land' if self._land else 'hold'}"
        if self.taken_over and not self.startup.stays_disarmed:
            left = "left" if self._has_been_guided else "is armed and not in"
            return f"{left} {self.kind.guided_name}: flown by its pilot or its autopilot"
        return self._next_step().missing

    def encode(self, msg_id: int, fields: tuple[Any, ...]) -> bytes:
        """A frame to this vehicle, numbered in a sequence of its own so that the vehicle can count losses."""
        self._sequence = (self._sequence + 1) & 0xFF
        return mavlink.encode(msg_id, fields, sequence=self._sequence)

    def send(self, msg_id: int, fields: tuple[Any, ...], outgoing: Outbox) -> None:
        """Add a frame to the datagrams to be sent, if the vehicle's address is known."""
        if self.address is not None:
            outgoing.append((self.encode(msg_id, fields), self.address))

    def is_elsewhere(self, address: Address, received_ns: int) -> bool:
        """Whether the vehicle is known to send from another address and has been heard lately."""
        return self.address not in {None, address} and received_ns - self.heard_ns <= SILENCE_S * NS_PER_S

    def may_speak_from(self, address: Address, msg_id: int, received_ns: int) -> bool:
        """Whether a frame from another address can be from this vehicle: a heartbeat, at first and after silence."""
        return msg_id == mavlink.HEARTBEAT and not self.is_elsewhere(address, received_ns)

    def is_replay(self, frame: mavlink.Frame, now_ns: int) -> bool:
        """Whether a frame was received before, or is a heartbeat that a newer frame has overtaken.

        Links that reorder or repeat frames do this all the time: it is counted in `frames` and reported once.
        A restarted vehicle numbers its frames anew, so after some time without a good heartbeat any is taken.
        """
        heartbeat = frame.msg_id == mavlink.HEARTBEAT
        order = self.frames.add(frame.sequence, now_ns)
        if order != NEW and not self._told >> order & 1:
            self._told |= 1 << order
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

    def tell_startup(self, msg_id: int, fields: tuple[Any, ...]) -> None:
        """Let the start-up take in a message; kernels tell it nothing of positions."""
        self._tell_position()
        self.startup.take(msg_id, fields)

    def _tell_position(self) -> None:
        if self._local_is_new:
            self._local_is_new = False
            local: list[float] = self._links.known["local"][self._row].tolist()
            self.startup.take(mavlink.LOCAL_POSITION_NED, (self._local_ms, *local))

    def report_order(self, order: int) -> None:
        """Report that its frames arrive LATE or are DUPLICATE."""
        self._report("link", _ORDER_TEXT[order], self.system_id)

    def named_int(self, fields: tuple[Any, ...]) -> None:
        """Take in a NAMED_VALUE_INT: the lag after which the vehicle's held set-points act."""
        _, value, name = fields
        if name.rstrip(b"\0") == b"LAG_MS":
            self._lag_ms, self._lag_jumps = value, self.clock.jumps

    def delivery_ns(self, key_ms: int, sent_ns: int) -> int | None:
        """How long after `sent_ns` the set-point with this stamp acts; None while that is unknown."""
        found_ns = _delivery_at_ns(self._links.known, self._links.clocks.known, self._row, key_ms, sent_ns)
        return None if found_ns == UNKNOWN else found_ns

    def heartbeat(self, fields: tuple[Any, ...], now_ns: int) -> None:
        """Take in a HEARTBEAT. One made before the vehicle carried out a command does not undo what its ACK said."""
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
        self._heartbeat = custom_mode | vehicle_type << 32 | autopilot << 40 | base_mode << 48 | system_status << 56

    def _see_pilot(self, mode: int, now_ns: int, *, armed: bool, critical: bool) -> None:
        """Notice from a reported mode or arming that somebody else has taken the vehicle over, or given it back.

        A mode that no command of the station leads to is somebody's choice, unless the vehicle enters it when
        set-points stop. That it reports a failsafe does not suffice: its pilot may steer it, or it flies home on a low
        battery. On the ground, before arming, anybody may set any mode. Who arms a vehicle flies it, unless it holds:
        then it waits for its take-off.
        """
        kind, before = self.kind, self.custom_mode
        if self.external:
            return
        if mode == kind.guided_mode:
            self._has_been_guided = True
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
            self._command = None  # repeating it would take the vehicle back

    def _takes_off_by(self, mode: int) -> bool:
        """Whether a mode is part of the take-off that was commanded: its own mode at first, hold at the top."""
        kind = self.kind
        if kind.guided_first or self._has_been_guided:
            return False
        if mode == kind.take_off_mode:
            return self._take_off_sent
        return mode == kind.hold_mode and self.custom_mode == kind.take_off_mode and self.startup.is_half_way_up

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
            elif command != ARM_DISARM or not self.startup.arming_refusals:  # repeated ones are counted
                self._report("vehicle", f"answered {name} to command {command}", self.system_id)
            self.startup.refused(command, waiting.parameters, now_ns, repeated=waiting.confirmation > 0)
            self._not_before_ns = now_ns + NS_PER_S
            return
        if command == ARM_DISARM and self.startup.arming_refusals > 1:
            self._report("vehicle", f"arms after {self.startup.arming_refusals} refusals", self.system_id)
        self.startup.accepted(command, waiting.parameters, now_ns)
        self._heartbeat = 0
        if command in (SET_MODE, ARM_DISARM):
            self._outdated.append((now_ns, self.custom_mode, self.armed))
        if command == SET_MODE:
            self.custom_mode = commanded_mode(self.kind, waiting.parameters)
            self.critical = False
        elif command == ARM_DISARM:
            self.armed = waiting.parameters[0] == 1.0

    def next_frame(self, now_ns: int) -> bytes | None:
        """The frame that is due to bring the vehicle to the wanted state, if any: a command, else a parameter.

        One command at a time awaits its ACK, which carries no request id. Without an answer for three round trips, and
        1 s at least, the command is sent again with its confirmation raised. Then there may be several answers:
        one that comes sooner than a round trip after the next request with the same command does not count for that.
        """
        self._now_ns = now_ns
        if self.address is None or self.idle:
            return None
        frame = self._next_command(now_ns)
        if frame is None and self.goal is Goal.FLY:
            rtt_ns, due = self.clock.rtt_ns or 0, None
            if not self.external:
                due = self.startup.next_parameter(now_ns, target_system=self.wire_id, rtt_ns=rtt_ns)
            idle = due is None and self._command is None and not self.kind.piloted
            self._settled = idle and not self._next_step().missing
            return None if due is None else self.encode(*due)
        return frame

    def _next_command(self, now_ns: int) -> bytes | None:
        if now_ns < self._not_before_ns:
            return None
        waiting = self._command
        if waiting is not None:
            if now_ns - waiting.sent_ns < max(NS_PER_S, 3 * (self.clock.rtt_ns or 0)):
                return None
            waiting.sent_ns = now_ns
            waiting.confirmation = (waiting.confirmation + 1) & 0xFF
            self._earlier = 0, 0  # an answer to an earlier request would have come
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
        """The next step of the start-up. Of a vehicle flown by somebody else, mode and arming are its pilot's."""
        self._tell_position()
        step = self.startup.next(
            custom_mode=self.kind.guided_mode if self.external else self.custom_mode,
            armed=self.armed or self.external,
            clock_known=self.clock.samples >= LEAST_SAMPLES,
            now_ns=self._now_ns,
        )
        asks = step.command is not None and step.command[0] == SET_MESSAGE_INTERVAL
        return Step(step.missing) if self.external and not asks else step

    def end(self, *, alone: bool = False) -> None:
        """Let it hold or land from now on, or leave it alone. What is not answered yet is repeated no more, but for a
        mode: an answer does not say which mode it is to."""
        self.goal = None if alone else Goal.END
        if self._command is not None and self._command.command != SET_MODE:
            self._command = None

    def begin_anew(self) -> None:
        """Set rates and parameters again: the vehicle seems to have restarted.

        A vehicle that was taken over stays so: perhaps only its clock has slipped.
        """
        self.startup.begin_anew()
        self._command, self._settled = None, False


def in_words(what: str, vehicles: Sequence[RemoteVehicle]) -> str:
    """A line that says what vehicles lack, beginning with `what`; empty if there are none. Of many, ten are named."""
    named = [f"vehicle {v.system_id} {v.missing}" for v in vehicles[:_MOST_NAMED]]
    named += [f"{len(vehicles) - _MOST_NAMED} others"] if len(vehicles) > _MOST_NAMED else []
    return what + "; ".join(named) if vehicles else ""


def refusals(vehicles: Sequence[RemoteVehicle]) -> str:
    """Which vehicles must not be flown, and why; empty if all may."""
    return in_words("refused: ", [vehicle for vehicle in vehicles if vehicle.startup.refusal])
