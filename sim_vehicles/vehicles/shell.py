"""The MAVLink system of every simulated vehicle: datagrams and times in, frames and times out.

The shell reads datagrams, obeys one station, answers TIMESYNC, commands and requests, and reports on a schedule. The
`Craft` in it knows how the vehicle moves and which set-points and modes it accepts. Everything happens at its exact
time, however late `step` is called.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from scenarios import schema
from scenarios.kernel import Cell
from scenarios.networks import wire_id
from sim_vehicles.links.truth import SAMPLED, Recorder, rows_of
from sim_vehicles.motion.double_integrator import State
from sim_vehicles.services import frames, mavlink
from sim_vehicles.services.authority import Authority
from sim_vehicles.services.clock import BootClock
from sim_vehicles.services.frames import FRAME_BYTES
from sim_vehicles.services.hot import COUNTED, Place, new_place
from sim_vehicles.services.messages import EXTRA, ParameterSet, SetMode
from sim_vehicles.services.parameters import Parameters
from sim_vehicles.services.schedule import Schedule
from sim_vehicles.services.services import Services
from sim_vehicles.services.sitl import backdating_ns
from sim_vehicles.vehicles.plain import MOVE_FIRST, SILENT, hear_at, report_at

TIMESYNC_INTERVAL_US = 10_000_000
HEARTBEAT_INTERVAL_US = 1_000_000
LONGEST_HISTORY = 1000
"""Maximum number of unread changes kept: a hostile sender can cause any number of them."""

Answer = tuple[int, str]
"""The MAV_RESULT of a command, and the STATUSTEXT sent with it, "" for none."""


class Change(NamedTuple):
    """An event for people to read, such as "failsafe: set-points stopped"."""

    time_ns: int
    system_id: int
    text: str


class Radio:
    """State shared by the shell and the craft: the clock, the counters, the frames sent, and the changes.

    `counters` counts received messages: `heartbeats`, `commands`, `timesync_requests`, `timesync_replies`, `setpoints`,
    and by reason those not obeyed: `refused_...` are invalid, `ignored_...` are valid but not for this vehicle, or not
    now. Counts made by kernels stay in the vehicle's record until `take_counts` adds them.
    """

    def __init__(
        self,
        scenario: schema.Scenario,
        own: schema.Vehicle,
        start_ns: int,
        recorder: Recorder | None = None,
        place: Place | None = None,
    ) -> None:
        self.place = place or new_place()
        for name, number in (("system_id", own.system_id), ("wire_id", wire_id(own.system_id))):
            self.place.columns[name][self.place.row] = number
        self.system_id = own.system_id
        self.start_ns = start_ns
        self.counters: Counter[str] = Counter()
        self.changes: deque[Change] = deque(maxlen=LONGEST_HISTORY)
        """The newest at the end; a reader may clear it."""
        self.clock = BootClock.draw(scenario.clocks, scenario.seed, own.system_id, start_ns)
        self.schedule = Schedule(self.clock, self.place)
        self.encoder = mavlink.Encoder(self.place)
        self.recorder = recorder
        self.truth_rows = rows_of(recorder)
        self.out: list[tuple[bytes, int]] = []
        """Frames sent in this step, with their times."""

    def take_counts(self) -> Counter[str]:
        """The counters, with what kernels have counted."""
        _, columns, row = self.place
        for name in COUNTED:
            if count := columns[name][row]:
                self.counters[name] += count
                columns[name][row] = 0
        return self.counters

    def send(self, frame: bytes, time_ns: int) -> None:
        self.out.append((frame, time_ns))

    def send_text(self, time_ns: int, text: str, severity: int = mavlink.SEVERITY_CRITICAL) -> None:
        """Send a STATUSTEXT."""
        self.send(self.encoder.statustext(severity, text), time_ns)

    def note_change(self, time_ns: int, text: str) -> None:
        """Record a change, for whoever runs the simulation."""
        self.changes.append(Change(time_ns, self.system_id, text))

    def record(self, kind: int, boot_ms: int, time_ns: int) -> None:
        """Record in the truth log that a set-point has ACTED, or that the state in a position report was SAMPLED."""
        if self.recorder is not None:
            self.recorder.add((kind, self.system_id, boot_ms & frames.UINT32, time_ns, time_ns, time_ns))

    def set_clock(self, clock: BootClock, time_ns: int) -> None:
        self.clock = clock
        self.schedule.set_clock(clock, time_ns)


class Craft(Protocol):
    """The craft in a shell. Calls are in order of time; `acts_at` says when a message that arrives late acts."""

    parameters: Parameters
    version: tuple[int, int, int]
    """The version that AUTOPILOT_VERSION reports."""
    is_plain: bool
    """Whether its set-points act at once, and it reports its true state. Then kernels run its common events, see
    `plain`."""
    version_1_first: bool
    """Whether it speaks MAVLink 1 until it hears MAVLink 2, as PX4 does."""
    intervals_us: Mapping[int, int]
    """The messages it can report besides heartbeats, each with its default interval, 0 for none."""
    reports_from_ns: int
    """Before this time it sends heartbeats only."""

    @property
    def deadline_ns(self) -> int: ...  # of the next event that is not a report

    def happen(self, time_ns: int) -> None: ...
    def state_at(self, time_ns: int) -> State: ...
    def acts_at(self, time_ns: int) -> int: ...
    def move(self, time_ns: int) -> None: ...  # to a time, if that is not past
    def hear_heartbeat(self, time_ns: int) -> None: ...

    def take_setpoint(self, setpoint: mavlink.Setpoint, time_ns: int) -> str: ...  # the counter to increment
    def command(self, command: mavlink.Command, time_ns: int) -> Answer | None: ...  # None: it is not about flying
    def change_mode(self, mode: int | None, time_ns: int) -> Answer: ...  # None: an unknown one
    def parameters_set(self, time_ns: int) -> None: ...
    def report(self, message_id: int, time_ns: int, boot_ms: int) -> bytes | None: ...  # None: nothing to send yet


Flown = TypeVar("Flown", bound=Craft, covariant=True)  # noqa: PLC0105 - the type of the craft inside


class Shell(Generic[Flown]):
    """A vehicle as seen over its link. `experiment` is the text of its parameter SCENARIO."""

    _asked_ts1 = Cell[int]()
    _version_1 = Cell[bool]()

    def __init__(
        self, scenario: schema.Scenario, radio: Radio, craft: Flown, *, signed: bool = False, experiment: str = ""
    ) -> None:
        self.system_id = radio.system_id
        self.craft = craft
        self.radio = radio
        _, self._columns, self._row = radio.place
        self.changes = radio.changes
        self.authority = Authority(radio.place, scenario.safety.heartbeat_timeout_s)
        self._version_1 = craft.version_1_first and not signed  # MAVLink 1 cannot be signed
        self._frames = np.zeros((2, FRAME_BYTES), np.uint8)
        """A datagram, and the frame that a kernel makes."""
        self._backdating_ns = backdating_ns(scenario, radio.system_id)
        from_ns = craft.reports_from_ns
        self._schedule = schedule = radio.schedule
        schedule.add_once(frames.HEARTBEAT, radio.start_ns)  # so that a station finds it at once
        schedule.set_interval(frames.TIMESYNC, TIMESYNC_INTERVAL_US, from_ns)
        intervals_us = {**dict.fromkeys(EXTRA, 0), frames.HEARTBEAT: HEARTBEAT_INTERVAL_US, **craft.intervals_us}
        for message_id, interval_us in intervals_us.items():
            begin_ns = radio.start_ns if message_id == frames.HEARTBEAT else from_ns
            schedule.set_interval(message_id, interval_us, begin_ns)
        self.services = Services(
            radio.encoder, schedule, craft.parameters, craft.version, intervals_us, from_ns, experiment
        )

    @property
    def counters(self) -> Counter[str]:
        return self.radio.take_counts()

    @property
    def next_event_ns(self) -> int:
        """When the vehicle next acts if nothing arrives."""
        scheduled_ns, deadline_ns = self._schedule.next_ns, self.craft.deadline_ns
        return deadline_ns if deadline_ns < scheduled_ns else scheduled_ns

    def step(self, datagrams: Iterable[tuple[bytes, int]], now_ns: int) -> list[tuple[bytes, int]]:
        """Run until now; takes the datagrams that arrive and returns those sent, with times, in order of time.

        A datagram whose time has passed acts at once. One that arrives at the time of a scheduled event is handled
        first: a set-point on the deadline is in time.
        """
        self.radio.out = out = []
        for data, time_ns in datagrams:
            self._run(time_ns)
            self._receive(data, time_ns)
        self._run(now_ns + 1)
        return out

    def _run(self, end_ns: int) -> None:
        """Run everything due before `end_ns`; at equal times the deadline first, so that reports show its effect."""
        schedule, craft = self._schedule, self.craft
        while True:
            deadline_ns, scheduled_ns = craft.deadline_ns, schedule.next_ns
            if deadline_ns <= scheduled_ns:
                if deadline_ns >= end_ns:
                    return
                craft.happen(deadline_ns)
            elif scheduled_ns >= end_ns:
                return
            elif not (craft.is_plain and self._runs_plainly(report_at, scheduled_ns)):
                self._report(*schedule.pop())

    def _report(self, time_ns: int, message_id: int, boot_ms: int) -> None:
        if self._version_1 and message_id != frames.HEARTBEAT:
            return  # no station that wants it has been heard yet
        radio, craft = self.radio, self.craft
        craft.acts_at(time_ns)
        if message_id == frames.TIMESYNC:
            self._asked_ts1 = radio.clock.boot_ns(time_ns)
            frame = radio.encoder.timesync(0, self._asked_ts1)
        elif message_id == frames.PARAMETER_VALUE:
            frame = self.services.next_parameter(time_ns)
        else:
            own = craft.report(message_id, time_ns, boot_ms)
            if own is None:
                return
            frame = mavlink.in_version_1(own) if self._version_1 else own
            if message_id == frames.LOCAL_POSITION:
                radio.record(SAMPLED, boot_ms, time_ns)
        radio.send(frame, time_ns)

    def _runs_plainly(self, run: Callable[..., int], time_ns: int, *heard: Any) -> bool:
        """Run an event of a plain craft, a report or what is heard, in a kernel; False if it takes Python."""
        radio, (vehicles, _, row) = self.radio, self.radio.place
        arguments = vehicles, row, *heard, self._frames, radio.truth_rows
        size = run(*arguments)
        if size == MOVE_FIRST:
            self.craft.move(self.craft.acts_at(time_ns))
            size = run(*arguments)
        if size > SILENT:
            radio.send(self._frames[1, :size].tobytes(), time_ns)
        return size >= SILENT

    def _receive(self, data: bytes, time_ns: int) -> None:
        if self.craft.is_plain and len(data) <= FRAME_BYTES:
            received = np.frombuffer(data, np.uint8)
            if self._runs_plainly(hear_at, time_ns, received, time_ns):
                return
        counters, authority = self.radio.counters, self.authority
        for source, message in mavlink.read_datagram(data, counters):
            self._version_1 = False
            if isinstance(message, mavlink.Heartbeat):
                self._take_heartbeat(source, message, time_ns)
            elif isinstance(message, mavlink.Timesync):
                self._take_timesync(message, time_ns)
            elif not mavlink.is_for(message, self.radio.encoder.wire_id):
                counters["ignored_not_addressed"] += 1
            elif authority.obeys(source, message, time_ns):
                self._obey(message, self.craft.acts_at(time_ns))
            elif text := authority.refusal(source, counters):
                # No COMMAND_ACK: the station could not tell it from the answer to an equal command of its own.
                self.radio.note_change(time_ns, text)
                self.radio.send_text(time_ns, text, mavlink.SEVERITY_WARNING)

    def _take_heartbeat(self, source: int, heartbeat: mavlink.Heartbeat, time_ns: int) -> None:
        if heartbeat.type != frames.STATION_TYPE:
            self.radio.counters["ignored_heartbeat"] += 1
        elif not self.authority.hears(source, time_ns):
            self.radio.counters["ignored_not_the_station"] += 1
        else:
            self.radio.counters["heartbeats"] += 1
            self.craft.hear_heartbeat(time_ns)

    def _take_timesync(self, message: mavlink.Timesync, time_ns: int) -> None:
        if message.target_system not in (0, self.radio.encoder.wire_id):
            self.radio.counters["ignored_not_addressed"] += 1
        elif message.tc1 == 0:
            self.radio.counters["timesync_requests"] += 1
            # Never 0, even at boot: that would make the reply a request.
            tc1 = self.radio.clock.boot_ns(time_ns) - next(self._backdating_ns, 0) or 1
            self.radio.send(self.radio.encoder.timesync(tc1, message.ts1), time_ns)
        else:  # an unrequested reply is for another vehicle, or a duplicate
            asked = message.ts1 == self._asked_ts1
            self.radio.counters["timesync_replies" if asked else "ignored_timesync_reply"] += 1

    def _obey(self, message: mavlink.Asked, time_ns: int) -> None:
        if isinstance(message, mavlink.Setpoint):
            self.radio.counters[self.craft.take_setpoint(message, time_ns)] += 1
        elif isinstance(message, mavlink.Command):
            self._take_command(message, time_ns)
        elif isinstance(message, SetMode):
            mode = message.custom_mode if message.base_mode & mavlink.BASE_MODE_CUSTOM else None
            if text := self.craft.change_mode(mode, time_ns)[1]:
                self.radio.send_text(time_ns, text)
        else:
            for frame in self.services.answer(message, self.radio.counters, time_ns):
                self.radio.send(frame, time_ns)
            if isinstance(message, ParameterSet):
                self.craft.parameters_set(time_ns)

    def _take_command(self, command: mavlink.Command, time_ns: int) -> None:
        """Obey a command. The acknowledgement is sent before the messages that the command causes."""
        self.radio.counters["commands"] += 1
        radio, answer = self.radio, self.craft.command(command, time_ns)
        result, more = self.services.command(command, time_ns) if answer is None else (answer[0], [])
        radio.send(radio.encoder.command_ack(command.command, result, command.source), time_ns)
        for message in more:
            radio.send(radio.encoder.pack(message), time_ns)
        if answer is not None and answer[1]:
            radio.send_text(time_ns, answer[1])
