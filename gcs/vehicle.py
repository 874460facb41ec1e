"""The station's picture of one vehicle, and its conversation with it: rates, clock, mode, arming."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gcs import mavlink
from gcs.clocks import LEAST_SAMPLES, VehicleClock
from gcs.sequence import SequenceCounter

Address = tuple[str, int]

ARM_DISARM = 400
SET_MODE = 176
SET_MESSAGE_INTERVAL = 511

ARMED = 0x80
CUSTOM_MODE_ENABLED = 1.0
GUIDED = 4
HOLD = 5
STATE_CRITICAL = 5

RESULTS = ("ACCEPTED", "TEMPORARILY_REJECTED", "DENIED", "UNSUPPORTED", "FAILED", "IN_PROGRESS", "CANCELLED")
_ACCEPTED, _IN_PROGRESS = 0, 5
_NS = 1_000_000_000


@dataclass
class _Command:
    """A COMMAND_LONG that waits for its COMMAND_ACK."""

    command: int
    parameters: tuple[float, ...]
    sent_ns: int
    confirmation: int = 0


class RemoteVehicle:
    """What is known of one vehicle; `converse` brings it to the state the station wants."""

    def __init__(self, system_id: int, *, telemetry_hz: float, report: Callable[[str, str], None]) -> None:
        self.system_id = system_id
        self.address: Address | None = None
        self.heard_ns = 0  # newest valid frame
        self.frames = SequenceCounter()
        self.clock = VehicleClock()
        self.armed = False
        self.custom_mode = -1
        self.critical = False
        self.wanted_mode: int | None = GUIDED
        self.rates_set = False
        self._telemetry_interval_us = 1e6 / telemetry_hz
        self._report = report
        self._sequence = 0
        self._command: _Command | None = None
        self._not_before_ns = 0
        self._acknowledged_ns = 0

    @property
    def guided(self) -> bool:
        return self.armed and self.custom_mode == GUIDED

    @property
    def ready(self) -> bool:
        return self.guided and self.rates_set and self.clock.estimate.samples >= LEAST_SAMPLES

    @property
    def missing(self) -> str:
        """What keeps it from being ready, in words."""
        if self.address is None:
            return "not heard"
        if not self.rates_set:
            return "does not accept the telemetry rate"
        if self.clock.estimate.samples < LEAST_SAMPLES:
            return "does not answer TIMESYNC"
        if self.custom_mode != GUIDED:
            return "does not enter GUIDED"
        return "" if self.armed else "does not arm"

    def encode(self, msg_id: int, fields: tuple[Any, ...]) -> bytes:
        """A frame to this vehicle; each vehicle sees a sequence of its own, so it can count losses."""
        self._sequence = (self._sequence + 1) & 0xFF
        return mavlink.encode(msg_id, fields, sequence=self._sequence)

    def heartbeat(self, fields: tuple[Any, ...], now_ns: int) -> None:
        """Take in a HEARTBEAT. One sent before the vehicle took a command in does not undo what its ACK said."""
        if now_ns - self._acknowledged_ns < _NS + 2 * (self.clock.rtt_ns or 0):
            return
        custom_mode, _, _, base_mode, system_status, _ = fields
        was_guided = self.guided
        self.custom_mode, self.armed = custom_mode, bool(base_mode & ARMED)
        critical = system_status == STATE_CRITICAL
        if critical and not self.critical:
            self._report("vehicle", "is in failsafe")
        elif was_guided and not self.guided and not critical:
            self._report("vehicle", "left GUIDED")
        self.critical = critical

    def acknowledge(self, fields: tuple[Any, ...], now_ns: int) -> None:
        """Take in a COMMAND_ACK."""
        command, result = fields[0], fields[1]
        waiting = self._command
        if waiting is None or waiting.command != command:
            return
        if result == _IN_PROGRESS:
            waiting.sent_ns = now_ns
            return
        self._command = None
        if result != _ACCEPTED:
            name = RESULTS[result] if result < len(RESULTS) else str(result)
            self._report("vehicle", f"answered {name} to command {command}")
            self._not_before_ns = now_ns + _NS
            return
        if command == SET_MESSAGE_INTERVAL:
            self.rates_set = True
        elif command == SET_MODE:
            self.custom_mode = int(waiting.parameters[1])
            self.critical = False
            self._acknowledged_ns = now_ns
        elif command == ARM_DISARM:
            self.armed = waiting.parameters[0] == 1.0
            self._acknowledged_ns = now_ns

    def converse(self, now_ns: int) -> bytes | None:
        """The next frame that brings the vehicle to the wanted state, if one is due.

        One command is in flight at a time (an ACK carries no request id); it is sent again, with the confirmation
        raised, when three round trips or 1 s have passed without an answer.
        """
        if self.address is None or now_ns < self._not_before_ns:
            return None
        waiting = self._command
        if waiting is not None:
            if now_ns - waiting.sent_ns < max(_NS, 3 * (self.clock.rtt_ns or 0)):
                return None
            waiting.sent_ns = now_ns
            waiting.confirmation = (waiting.confirmation + 1) & 0xFF
            if waiting.command == SET_MODE and waiting.parameters[1] != self.wanted_mode:
                self._command = waiting = None
        if waiting is None:
            wanted = self._wanted()
            if wanted is None:
                return None
            waiting = self._command = _Command(*wanted, sent_ns=now_ns)
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
        if self.wanted_mode is None:
            return None
        if self.wanted_mode == GUIDED and not self.rates_set:
            return SET_MESSAGE_INTERVAL, (float(mavlink.LOCAL_POSITION_NED), self._telemetry_interval_us)
        if self.custom_mode != self.wanted_mode:
            return SET_MODE, (CUSTOM_MODE_ENABLED, float(self.wanted_mode))
        if self.wanted_mode == GUIDED and not self.armed:
            return ARM_DISARM, (1.0,)
        return None

    def forget_rates(self) -> None:
        """The vehicle seems to have started anew: its rates have to be set again."""
        self.rates_set = False
        self._command = None
