"""When a double integrator obeys set-points: arming, modes, the start of the flight, the failsafe.

on the launcher ──first set-point or take-off, armed, GUIDED──► flying (GUIDED) ◄──commanded──► flying (LOITER, BRAKE)
                                                                      │                             │
                                   set-points or station's heartbeat stop             station's heartbeat stops
                                                                      ▼                             ▼
                                          failsafe: LOITER, CRITICAL, until GUIDED or LOITER is commanded

LOITER and BRAKE both hold the course: ground stations send either for "hold".
"""

from scenarios.kernel import Cell, Record, at_row, kernel
from scenarios.schema import NS_PER_S, Safety
from sim_vehicles.services.clock import NEVER_NS
from sim_vehicles.services.hot import Place
from sim_vehicles.services.mavlink import ACCEPTED, DENIED, MODE_BRAKE, MODE_GUIDED, MODE_LOITER, MODE_STABILIZE

MODE_NAMES = {MODE_STABILIZE: "STABILIZE", MODE_GUIDED: "GUIDED", MODE_LOITER: "LOITER", MODE_BRAKE: "BRAKE"}


_STOPPED = ("", "set-points", "station heartbeat")
"""Name of the stream that stopped, by its number in the record; 0 means no failsafe."""


@kernel
def takes_setpoints(vehicle: Record) -> bool:
    """Whether the vehicle flies and obeys set-points."""
    return vehicle.flying and vehicle.armed and vehicle.mode == vehicle.guided_mode and vehicle.stopped == 0


@kernel
def note_setpoint(vehicle: Record, now_ns: int) -> None:
    """Restart the timeout of set-points."""
    if now_ns > vehicle.setpoint_ns or vehicle.setpoint_ns == NEVER_NS:
        vehicle.setpoint_ns = now_ns
    set_deadline(vehicle)


@kernel
def note_heartbeat(vehicle: Record, now_ns: int) -> None:
    """Restart the timeout of the station's heartbeats."""
    vehicle.heartbeat_ns = max(vehicle.heartbeat_ns, now_ns)
    set_deadline(vehicle)


@kernel
def set_deadline(vehicle: Record) -> None:
    vehicle.deadline_ns = vehicle.alarm_ns
    if not vehicle.flying or vehicle.stopped != 0:
        return
    if vehicle.heartbeat_timeout_ns != NEVER_NS:
        vehicle.deadline_ns = min(vehicle.deadline_ns, vehicle.heartbeat_ns + vehicle.heartbeat_timeout_ns)
    if vehicle.mode == vehicle.guided_mode and vehicle.setpoint_ns != NEVER_NS:  # a hold needs no set-points
        vehicle.deadline_ns = min(vehicle.deadline_ns, vehicle.setpoint_ns + vehicle.setpoint_timeout_ns)


_note_setpoint_at, _note_heartbeat_at = at_row(note_setpoint), at_row(note_heartbeat)
set_deadline_at = at_row(set_deadline)


class FlightMode:
    """The mode of one vehicle. Every method takes the time at which its event happens."""

    armed = Cell[bool]()
    mode = Cell[int]()
    flying = Cell[bool]()
    deadline_ns = Cell[int]()
    """When the failsafe begins unless the station is heard first."""
    _stopped = Cell[int]()
    _setpoint_ns = Cell[int]()
    _setpoint_timeout_ns = Cell[int]()
    _heartbeat_ns = Cell[int]()
    _heartbeat_timeout_ns = Cell[int]()
    _guided_mode = Cell[int]()

    def __init__(self, safety: Safety, place: Place) -> None:
        self._vehicles, self._columns, self._row = place
        self.mode, self._guided_mode = MODE_STABILIZE, MODE_GUIDED
        self._setpoint_timeout_ns = round(safety.setpoint_timeout_s * NS_PER_S)
        self._heartbeat_timeout_ns = round(safety.heartbeat_timeout_s * NS_PER_S)

    @property
    def failsafe(self) -> str:
        """Which stream stopped; empty outside the failsafe."""
        return _STOPPED[self._stopped]

    def set_timeouts(self, setpoint_s: float, heartbeat_s: float, now_ns: int) -> None:
        """Set how long the station may be silent; both timers restart if that changes."""
        timeouts_ns = round(setpoint_s * NS_PER_S), round(heartbeat_s * NS_PER_S)
        if timeouts_ns != (self._setpoint_timeout_ns, self._heartbeat_timeout_ns):
            self._setpoint_timeout_ns, self._heartbeat_timeout_ns = timeouts_ns
            self._setpoint_ns = self._heartbeat_ns = now_ns
            self._set_deadline()

    def hear_heartbeat(self, now_ns: int) -> None:
        _note_heartbeat_at(self._vehicles, self._row, now_ns)

    def accept_setpoint(self, now_ns: int) -> str:
        """Accept a set-point; the first begins the flight. Returns the reason if it is ignored, else ""."""
        if self.failsafe:
            return "ignored_in_failsafe"
        if not self.armed:
            return "ignored_not_armed"
        if self.mode != MODE_GUIDED:
            return "ignored_not_guided"
        if not self.flying:
            self.flying = True
            self._heartbeat_ns = now_ns  # time before the flight does not count as silence
        _note_setpoint_at(self._vehicles, self._row, now_ns)
        return ""

    def take_off(self, now_ns: int) -> int:
        """Begin the flight on command; returns the MAV_RESULT. The first set-point starts the set-point timeout."""
        if self.flying or not self.armed or self.mode != MODE_GUIDED:
            return DENIED
        self.flying = True
        self._heartbeat_ns, self._setpoint_ns = now_ns, NEVER_NS
        self._set_deadline()
        return ACCEPTED

    def arm(self, wanted: bool) -> int:
        """Arm or disarm; returns the MAV_RESULT. In flight it never disarms, not even if forced: it would fall."""
        if not wanted and self.flying:
            return DENIED
        self.armed = wanted
        return ACCEPTED

    def set_mode(self, mode: int, now_ns: int) -> int:
        """Change the mode on command; returns the MAV_RESULT. A mode command also ends the failsafe.

        Both timers restart when the mode changes or the failsafe ends, so that whoever takes over has the full time.
        """
        if mode not in MODE_NAMES or (self.flying and mode == MODE_STABILIZE):
            return DENIED
        if mode != self.mode or self.failsafe:
            self.mode = mode
            self._stopped = 0
            self._setpoint_ns = self._heartbeat_ns = now_ns
            self._set_deadline()
        return ACCEPTED

    def fail(self) -> None:
        """Enter the failsafe; called at the deadline."""
        assert self.flying
        setpoints_stopped = (
            self.mode == MODE_GUIDED and self.deadline_ns == self._setpoint_ns + self._setpoint_timeout_ns
        )
        self._stopped = 1 if setpoints_stopped else 2
        self.mode = MODE_LOITER
        self._set_deadline()

    def _set_deadline(self) -> None:
        set_deadline_at(self._vehicles, self._row)
