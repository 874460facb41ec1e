"""Whom the vehicle obeys and when: arming, modes, the beginning of the flight, the failsafe. No bytes, no motion.

on the launcher ──first set-point or take-off, armed, GUIDED──► flying (GUIDED) ◄──commanded──► flying (LOITER, BRAKE)
                                                                      │                             │
                                   set-points or station's heartbeat stop             station's heartbeat stops
                                                                      ▼                             ▼
                                          failsafe: LOITER, CRITICAL, until GUIDED or LOITER is commanded

LOITER and BRAKE are the same here: it holds its course. Stations say either when they mean hold.
"""

from scenarios.schema import NS_PER_S, Safety
from sim_vehicles.services.clock import NEVER_NS
from sim_vehicles.services.mavlink import (
    ACCEPTED,
    BASE_MODE_ARMED,
    BASE_MODE_CUSTOM,
    BASE_MODE_GUIDED,
    DENIED,
    MODE_BRAKE,
    MODE_GUIDED,
    MODE_LOITER,
    MODE_STABILIZE,
    STATUS_ACTIVE,
    STATUS_CRITICAL,
    STATUS_STANDBY,
)

MODE_NAMES = {MODE_STABILIZE: "STABILIZE", MODE_GUIDED: "GUIDED", MODE_LOITER: "LOITER", MODE_BRAKE: "BRAKE"}


class Autopilot:
    """The modes of one vehicle; every method takes the instant at which the thing happens."""

    def __init__(self, safety: Safety) -> None:
        self.armed = False
        self.mode = MODE_STABILIZE
        self.flying = False
        self.failsafe = ""
        """Which stream stopped, empty if none."""
        self.deadline_ns = NEVER_NS
        """When the failsafe begins unless something is heard before."""
        self._setpoint_timeout_ns = round(safety.setpoint_timeout_s * NS_PER_S)
        self._heartbeat_timeout_ns = round(safety.heartbeat_timeout_s * NS_PER_S)
        self._setpoint_ns = 0
        self._heartbeat_ns = 0

    @property
    def base_mode(self) -> int:
        """HEARTBEAT.base_mode."""
        guided = BASE_MODE_GUIDED if self.mode == MODE_GUIDED else 0
        return BASE_MODE_CUSTOM | guided | (BASE_MODE_ARMED if self.armed else 0)

    @property
    def system_status(self) -> int:
        """HEARTBEAT.system_status: STANDBY on the launcher, CRITICAL in failsafe."""
        if not self.flying:
            return STATUS_STANDBY
        return STATUS_CRITICAL if self.failsafe else STATUS_ACTIVE

    def set_timeouts(self, setpoint_s: float, heartbeat_s: float, now_ns: int) -> None:
        """How long the station may be silent from now on; both timers begin anew if that is a change."""
        timeouts_ns = round(setpoint_s * NS_PER_S), round(heartbeat_s * NS_PER_S)
        if timeouts_ns != (self._setpoint_timeout_ns, self._heartbeat_timeout_ns):
            self._setpoint_timeout_ns, self._heartbeat_timeout_ns = timeouts_ns
            self._setpoint_ns = self._heartbeat_ns = now_ns
            self._set_deadline()

    def hear_heartbeat(self, now_ns: int) -> None:
        """A station's heartbeat arrived."""
        self._heartbeat_ns = max(self._heartbeat_ns, now_ns)
        self._set_deadline()

    def accept_setpoint(self, now_ns: int) -> str:
        """Take a set-point, the first one as the start of the flight: why not, or an empty string."""
        if self.failsafe:
            return "ignored_in_failsafe"
        if not self.armed:
            return "ignored_not_armed"
        if self.mode != MODE_GUIDED:
            return "ignored_not_guided"
        if not self.flying:
            self.flying = True
            self._heartbeat_ns = now_ns  # a station that was silent before the flight has its full time from here
        if now_ns > self._setpoint_ns or self._setpoint_ns == NEVER_NS:
            self._setpoint_ns = now_ns
        self._set_deadline()
        return ""

    def take_off(self, now_ns: int) -> int:
        """Begin the flight on command: the MAV_RESULT. No set-points are missed before the first."""
        if self.flying or not self.armed or self.mode != MODE_GUIDED:
            return DENIED
        self.flying = True
        self._heartbeat_ns, self._setpoint_ns = now_ns, NEVER_NS
        self._set_deadline()
        return ACCEPTED

    def arm(self, wanted: bool) -> int:
        """Arm or disarm: the MAV_RESULT. Not disarmed in flight, forced or not: it would fall."""
        if not wanted and self.flying:
            return DENIED
        self.armed = wanted
        return ACCEPTED

    def set_mode(self, mode: int, now_ns: int) -> int:
        """Change the mode on command: the MAV_RESULT. In failsafe the command is the way out.

        Both timers begin anew when the mode changes or the failsafe ends: whoever takes over has the full time.
        """
        if mode not in MODE_NAMES or (self.flying and mode == MODE_STABILIZE):
            return DENIED
        if mode != self.mode or self.failsafe:
            self.mode = mode
            self.failsafe = ""
            self._setpoint_ns = self._heartbeat_ns = now_ns
            self._set_deadline()
        return ACCEPTED

    def fail(self) -> None:
        """Enter the failsafe; to be called at the deadline."""
        assert self.flying
        setpoints_stopped = (
            self.mode == MODE_GUIDED and self.deadline_ns == self._setpoint_ns + self._setpoint_timeout_ns
        )
        self.failsafe = "set-points" if setpoints_stopped else "station heartbeat"
        self.mode = MODE_LOITER
        self._set_deadline()

    def _set_deadline(self) -> None:
        if not self.flying or self.failsafe:
            self.deadline_ns = NEVER_NS
            return
        self.deadline_ns = self._heartbeat_ns + self._heartbeat_timeout_ns
        if self.mode == MODE_GUIDED:  # a commanded hold waits for no set-points
            self.deadline_ns = min(self.deadline_ns, self._setpoint_ns + self._setpoint_timeout_ns)
