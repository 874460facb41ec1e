"""The station's picture of one vehicle, and its conversation with it: rates, clock, mode, arming."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gcs.link import mavlink
from gcs.link.clocks import LEAST_SAMPLES, VehicleClock
from gcs.link.datagram import Address
from gcs.link.kinds import (
    ARM_DISARM,
    LAUNCHED,
    SET_MESSAGE_INTERVAL,
    SET_MODE,
    TAKE_OFF,
    Goal,
    Kind,
    Step,
    commanded_mode,
    mode_command,
)
from gcs.link.sequence import DUPLICATE, LATE, NEW, SequenceCounter
from gcs.link.startup import Startup
from gcs.link.upload import Upload

ARMED = 0x80
STATE_CRITICAL = 5

_TOLD = {LATE: "its frames arrive out of order", DUPLICATE: "frames of it arrive more than once"}
RESULTS = ("ACCEPTED", "TEMPORARILY_REJECTED", "DENIED", "UNSUPPORTED", "FAILED", "IN_PROGRESS", "CANCELLED")
_ACCEPTED, _IN_PROGRESS = 0, 5
_NS = 1_000_000_000
_FORGET_NUMBERS_NS = 3 * _NS
SILENCE_S = 1.5
"""A vehicle whose telemetry has not come for this long is lost: it gets no more set-points and is flown around. One of
which nothing has come may be found at another address."""


_SILENT_NS = 3 * _NS
"""A vehicle is not ready to begin when nothing has come for this long, heartbeats neither."""


@dataclass
class _Command:
    """A COMMAND_LONG that waits for its COMMAND_ACK."""

    command: int
    parameters: tuple[float, ...]
    sent_ns: int
    confirmation: int = 0


class RemoteVehicle:
    """What is known of one vehicle; `converse` brings it to the state the station wants.

    A vehicle with an autopilot has a `startup`; `land` says how it is to end. One with a loop of its own has an
    `upload`, its parameters, without which it is not armed.
    """

    def __init__(
        self,
        system_id: int,
        *,
        telemetry_hz: float,
        report: Callable[[str, str], None],
        startup: Startup | None = None,
        land: bool = False,
        upload: Upload | None = None,
    ) -> None:
        self.system_id = system_id
        self.address: Address | None = None
        self.heard_ns = 0  # newest valid frame
        self.heartbeat_ns = 0  # newest heartbeat
        self.frames = SequenceCounter()
        self.newest = True
        """Whether the frame last taken in was sent after all before it."""
        self.clock = VehicleClock()
        self.armed = False
        self.custom_mode = -1
        self.critical = False
        self.goal: Goal | None = Goal.FLY
        """None: it is left to itself."""
        self.taken_over = False
        """Whether a vehicle with an autopilot is flown by its pilot, or by itself for a reason of its own. Only its own
        report that it is guided ends that; until then it is asked for telemetry, and commanded nothing."""
        self.startup = startup
        self.upload = upload
        self.first_heard_ns: int | None = None
        self._has_been_guided = self._take_off_told = False
        self._doubtful_ns = 0
        """When the first heartbeat came after a long silence. Its number does not show whether it is an old one."""
        self.rates_set = False
        self._land = land
        self._now_ns = 0
        self._telemetry_interval_us = round(1e6 / telemetry_hz)  # vehicles take whole numbers
        self._report = report
        self._sequence = 0
        self._command: _Command | None = None
        self._not_before_ns = 0
        self._told = {NEW}
        """What has been told of the order of its frames."""
        self._outdated: list[tuple[int, int, bool]] = []
        """Mode and arming before each of the last commands that changed them, and when the ACK came: what a heartbeat
        may still report that was made before the command was carried out."""

    @property
    def kind(self) -> Kind:
        return LAUNCHED if self.startup is None else self.startup.kind or LAUNCHED

    @property
    def end_mode(self) -> int:
        """The mode it is to end in."""
        return self.kind.land_mode if self._land else self.kind.hold_mode

    @property
    def ended(self) -> bool:
        """Whether it is seen to hold or land, or is told nothing: it never took off, or is somebody else's."""
        if self.startup is not None and (self.startup.kind is None or not self.armed):
            return True
        return self.taken_over or self.custom_mode == self.end_mode

    @property
    def guided(self) -> bool:
        return self.armed and self.custom_mode == self.kind.guided_mode and not self.taken_over

    @property
    def ready(self) -> bool:
        return not self.missing

    @property
    def silent(self) -> bool:
        """Whether it was heard, but nothing of it for some seconds."""
        return self.address is not None and self._now_ns - self.heard_ns > _SILENT_NS

    @property
    def missing(self) -> str:
        """What keeps it from being ready, in words."""
        if self.address is None or self.silent:
            return "not heard" if self.address is None else "is silent"
        if self.taken_over:
            left = "left" if self._has_been_guided else "is armed and not in"
            return f"{left} {self.kind.guided_name}: flown by its pilot or by itself"
        if self.startup is not None:
            return self._next(self.startup).missing
        if self.refused and self.upload is not None:
            return self.upload.refusal
        waits = (
            ("does not accept the telemetry rate", not self.rates_set),
            ("does not answer TIMESYNC", self.clock.estimate.samples < LEAST_SAMPLES),
            ("" if self.upload is None else self.upload.missing, not self._uploaded),
            ("does not enter GUIDED", self.custom_mode != self.kind.guided_mode),
            ("does not arm", not self.armed),
        )
        return next((text for text, waiting in waits if waiting), "")

    @property
    def refused(self) -> bool:
        """Whether it holds other parameters than it was told, and so is not to be flown."""
        return self.upload is not None and self.upload.refusal != ""

    @property
    def _uploaded(self) -> bool:
        return self.upload is None or self.upload.done

    def encode(self, msg_id: int, fields: tuple[Any, ...]) -> bytes:
        """A frame to this vehicle; each vehicle sees a sequence of its own, so it can count losses."""
        self._sequence = (self._sequence + 1) & 0xFF
        return mavlink.encode(msg_id, fields, sequence=self._sequence)

    def is_elsewhere(self, address: Address, received_ns: int) -> bool:
        """Whether the vehicle is known to speak from another address, and has not been silent."""
        return self.address not in {None, address} and received_ns - self.heard_ns <= SILENCE_S * _NS

    def may_speak_from(self, address: Address, msg_id: int, received_ns: int) -> bool:
        """Whether a frame from an address can be this vehicle's: its first heartbeat, or one after silence, sets it."""
        if self.address == address:
            return True
        return msg_id == mavlink.HEARTBEAT and not self.is_elsewhere(address, received_ns)

    def is_replay(self, frame: mavlink.Frame, now_ns: int) -> bool:
        """Whether a frame has been heard before, or is a heartbeat that a newer frame has overtaken.

        Links that reorder and repeat do that all the time: it is counted in `frames`, and told once of each.
        A vehicle that was started anew numbers its frames anew: after some time without a good heartbeat any is taken.
        """
        heartbeat = frame.msg_id == mavlink.HEARTBEAT
        order = self.frames.add(frame.sequence, now_ns)
        if order not in self._told:
            self._told.add(order)
            self._report("link", _TOLD[order])
        self.newest = order == NEW
        if heartbeat and now_ns - self.heartbeat_ns > _FORGET_NUMBERS_NS:
            self._doubtful_ns = now_ns
        replayed = order == DUPLICATE or (heartbeat and order == LATE)
        if replayed and heartbeat and now_ns - self.heartbeat_ns > _FORGET_NUMBERS_NS:
            self.frames.restart()
            return False
        if heartbeat and not replayed:
            self.heartbeat_ns = now_ns
        return replayed

    def heartbeat(self, fields: tuple[Any, ...], now_ns: int) -> None:
        """Take in a HEARTBEAT. One made before the vehicle carried a command out does not undo what its ACK said."""
        custom_mode, vehicle_type, autopilot, base_mode, system_status, _ = fields
        armed, critical = bool(base_mode & ARMED), system_status == STATE_CRITICAL
        recent_ns = now_ns - _NS - 2 * (self.clock.rtt_ns or 0)
        self._outdated = [before for before in self._outdated if before[0] > recent_ns]
        if any((custom_mode, armed) == (mode, was_armed) for _, mode, was_armed in self._outdated):
            return
        was_guided = self.guided
        if self.startup is not None:
            self.startup.heartbeat(autopilot, vehicle_type)
            self.clock.backdated_ns = self.kind.timesync_backdated_ns
            self._see_pilot(custom_mode, now_ns, armed=armed, critical=critical)
        self.custom_mode, self.armed = custom_mode, armed
        if critical and not self.critical:
            self._report("vehicle", "is in failsafe")
        elif was_guided and not self.guided and not critical:
            self._report("vehicle", f"left {self.kind.guided_name}")
        self.critical = critical

    def _see_pilot(self, mode: int, now_ns: int, *, armed: bool, critical: bool) -> None:
        """Notice from a reported mode that a vehicle is in other hands, or is given back.

        A mode that none of our commands leads to is somebody's will, but for a failsafe that the vehicle reports. On
        the ground, before it is armed, modes are set up by whoever stands there.
        """
        kind, before = self.kind, self.custom_mode
        if mode == kind.guided_mode:
            self._has_been_guided = True
            self.taken_over = self.taken_over and now_ns - self._doubtful_ns < _FORGET_NUMBERS_NS
        elif mode == before or self.taken_over or (self.goal is Goal.END and mode == self.end_mode):
            return
        elif before == kind.guided_mode:
            self.taken_over = kind.stays_guided or not critical
        elif before < 0:
            self.taken_over = armed and not critical and mode not in (kind.hold_mode, kind.take_off_mode)
        elif (armed or self.armed) and not critical:
            self.taken_over = not self._takes_off_by(mode)
        if self.taken_over:
            self._command = None  # sent again, it would take the vehicle back

    def _takes_off_by(self, mode: int) -> bool:
        """Whether a mode is one that a take-off goes through, and it does: it begins with one, and holds at its top."""
        startup, kind = self.startup, self.kind
        if startup is None or kind.guided_first or self._has_been_guided:
            return False
        if mode == kind.take_off_mode:
            return self._take_off_told
        return mode == kind.hold_mode and self.custom_mode == kind.take_off_mode and startup.is_half_way_up

    def acknowledge(self, fields: tuple[Any, ...], now_ns: int) -> None:
        """Take in a COMMAND_ACK."""
        command, result, *_, target_system, _ = fields
        waiting = self._command
        if waiting is None or waiting.command != command or target_system not in (0, mavlink.STATION_SYSTEM_ID):
            return
        if result == _IN_PROGRESS:
            waiting.sent_ns = now_ns
            return
        self._command = None
        if result != _ACCEPTED:
            name = RESULTS[result] if result < len(RESULTS) else str(result)
            self._report("vehicle", f"answered {name} to command {command}")
            if self.startup is not None:
                repeated = waiting.confirmation > 0
                self.startup.refused(command, waiting.parameters, now_ns, repeated=repeated)
            self._not_before_ns = now_ns + _NS
            return
        if self.startup is not None:
            self.startup.accepted(command, waiting.parameters, now_ns)
        if command == SET_MESSAGE_INTERVAL:
            self.rates_set = self.startup is None or self.startup.rates_set
        elif command == SET_MODE:
            self._outdated.append((now_ns, self.custom_mode, self.armed))
            self.custom_mode = commanded_mode(self.kind, waiting.parameters)
            self.critical = False
        elif command == ARM_DISARM:
            self._outdated.append((now_ns, self.custom_mode, self.armed))
            self.armed = waiting.parameters[0] == 1.0

    def converse(self, now_ns: int) -> bytes | None:
        """The next frame that brings the vehicle to the wanted state, if one is due: a command, else a parameter.

        One command is in flight at a time (an ACK carries no request id); it is sent again, with the confirmation
        raised, when three round trips or 1 s have passed without an answer.
        """
        self._now_ns = now_ns
        if self.address is None:
            return None
        frame = self._next_command(now_ns)
        if frame is None and self.upload is not None and self.goal is Goal.FLY:
            due = self.upload.next(now_ns, target_system=self.system_id, rtt_ns=self.clock.rtt_ns or 0)
            return None if due is None else self.encode(*due)
        return frame

    def _next_command(self, now_ns: int) -> bytes | None:
        """The next COMMAND_LONG, if one is due."""
        if now_ns < self._not_before_ns:
            return None
        waiting = self._command
        if waiting is not None:
            if now_ns - waiting.sent_ns < max(_NS, 3 * (self.clock.rtt_ns or 0)):
                return None
            waiting.sent_ns = now_ns
            waiting.confirmation = (waiting.confirmation + 1) & 0xFF
            if waiting.command == SET_MODE and (waiting.command, waiting.parameters) != self._wanted():
                self._command = waiting = None
        if waiting is None:
            wanted = self._wanted()
            if wanted is None:
                return None
            waiting = self._command = _Command(*wanted, sent_ns=now_ns)
            self._take_off_told = self._take_off_told or waiting.command == TAKE_OFF
        return self.encode(
            mavlink.COMMAND_LONG,
            mavlink.command_long(
                waiting.command,
                target_system=self.system_id,
                confirmation=waiting.confirmation,
                parameters=waiting.parameters,
            ),
        )

    def _wanted(self) -> tuple[int, tuple[float, ...]] | None:
        if self.goal is None:
            return None
        if self.goal is Goal.END:
            return None if self.ended else mode_command(self.kind, self.end_mode)
        if self.startup is not None:
            command = self._next(self.startup).command
            return command if command is None or not self.taken_over or command[0] == SET_MESSAGE_INTERVAL else None
        if not self.rates_set:
            return SET_MESSAGE_INTERVAL, (float(mavlink.LOCAL_POSITION_NED), self._telemetry_interval_us)
        if self.custom_mode != self.kind.guided_mode:
            return mode_command(self.kind, self.kind.guided_mode)
        return (ARM_DISARM, (1.0,)) if self._uploaded and not self.armed else None

    def _next(self, startup: Startup) -> Step:
        return startup.next(
            custom_mode=self.custom_mode,
            armed=self.armed,
            clock_known=self.clock.estimate.samples >= LEAST_SAMPLES,
            now_ns=self._now_ns,
        )

    def forget_rates(self) -> None:
        """The vehicle seems to have started anew: its rates have to be set again.

        Who flies it is another matter: a clock that has only slipped does not give it back.
        """
        self.rates_set = False
        if self.startup is not None:
            self.startup.forget_rates()
        if self.upload is not None:
            self.upload.begin_anew()
        self._command = None
