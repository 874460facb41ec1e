"""Start-up of one vehicle with an autopilot: its kind, estimator, rates, take-off and the origin of its local frame.

The origin's latitude and longitude come from GPS_GLOBAL_ORIGIN; from HOME_POSITION, which gives the home position in
both frames; or from a GLOBAL_POSITION_INT and the newest LOCAL_POSITION_NED.
"""

from math import cos, degrees, isfinite, nan, radians
from typing import Any

from gcs.autopilot.kinds import HAS_LANDED, WAS_DISARMED, kind_of
from gcs.autopilot.vehicle_limits import ReportedLimits
from gcs.link import mavlink
from gcs.link.kinds import ARM_DISARM, SET_MESSAGE_INTERVAL, TAKE_OFF, UNRECOGNISED, Kind, Step, mode_command
from gcs.link.startup import OPTIONAL, Startup, message_rates
from gcs.link.vehicle import ARMED

EARTH_RADIUS_M = 6_378_137.0
_SLOW_US = 200_000.0
_TAKEN_OFF_FRACTION = 0.95
"""A take-off is complete at this fraction of the commanded altitude."""
_TAKE_OFF_S, _SLOWEST_CLIMB_M_S = 15.0, 0.5
"""Timeout of a take-off: this long plus the climb at this rate. Then it is commanded again or, if the vehicle has left
the ground, set-points lead it to its altitude."""
_LEFT_GROUND_M = 2.0
_ARM = ARM_DISARM, (1.0,)
_POSITION_FLAGS, _CONSTANT_POSITION = 0x08 | 0x10, 0x80
"""Estimator flags: horizontal position known, relative and absolute; position only assumed. The bits are the same in
EKF_STATUS_REPORT and ESTIMATOR_STATUS."""
_STANDBY = 3
"""MAV_STATE of a vehicle on the ground; ArduCopter reports it there even while armed."""
_OLD_MS = 1000
"""Age beyond which a reported altitude is updated from the height in the local frame."""
_HAS_FLOWN_M, _FLIES_M = 1.0, 2.0
"""An armed vehicle above the first altitude has flown. One that has landed flies again above the second, which leaves
more room for barometer drift."""

Degrees = tuple[float, float]
"""Latitude and longitude."""


class AutopilotStartup(Startup):
    """Start-up of one vehicle, which takes off to `altitude_m`.

    A vehicle that has been in the air and is back on the ground, or that somebody has disarmed, is never armed again:
    people may be near it. Its pilot may arm it again and, if it has landed, must also fly the take-off.
    """

    def __init__(self, *, altitude_m: float, telemetry_hz: float, target_hz: float = 0.0) -> None:
        self.kind = UNRECOGNISED
        self.altitude_m = altitude_m
        self.relative_altitude_m: float | None = None
        self.airborne = False
        self.origin: Degrees | None = None
        self.origin_altitude_m = 0.0
        """Above sea level; valid only once the origin is known."""
        self.limits = ReportedLimits()
        self._armed = self._standby = self._has_flown = self._restarted = False
        self._text = ""
        """The last text received; cleared by armed heartbeats."""
        self._origin_reported = False
        self._sea_level_m = 0.0
        self._flags: int | None = None
        self._local: tuple[int, float, float, float, float, float] | None = None
        """Newest local position: boot time in ms, north, east, down, and velocities north and east."""
        self._reported: tuple[int, float] | None = None
        """Boot time in ms of the newest altitude, and the altitude at which the local frame has its zero."""
        self._took_off_ns: int | None = None
        self._asked_hz = {mavlink.LOCAL_POSITION_NED: telemetry_hz, OPTIONAL: target_hz}
        self._rates: dict[float, float] = {}
        self._accepted: set[float] = set()

    def recognise(self, autopilot: int, vehicle_type: int) -> Kind:
        if self.kind is not UNRECOGNISED or self.refusal:
            return self.kind
        found = kind_of(autopilot, vehicle_type)
        if not isinstance(found, Kind):
            self.refusal = found or ""
            return self.kind
        self.kind = found
        self._rates = {
            **message_rates(self._asked_hz),
            float(mavlink.GLOBAL_POSITION_INT): _SLOW_US,
            float(found.estimator_message): 2.0 * _SLOW_US,
            float(mavlink.GPS_GLOBAL_ORIGIN): 5.0 * _SLOW_US,
        }
        return found

    def take(self, msg_id: int, fields: tuple[Any, ...]) -> None:
        match msg_id:
            case mavlink.HEARTBEAT:
                self._heartbeat(fields)
            case mavlink.PARAM_VALUE:
                self.limits.take(fields)
            case mavlink.LOCAL_POSITION_NED:
                self._local = fields[:6]
                self._update_altitude()
            case mavlink.GLOBAL_POSITION_INT:
                self._global(fields)
            case mavlink.EKF_STATUS_REPORT:
                self._flags = fields[5]
            case mavlink.ESTIMATOR_STATUS:
                self._flags = fields[9]
            case mavlink.GPS_GLOBAL_ORIGIN:
                self.origin, self._origin_reported = (fields[0] * 1e-7, fields[1] * 1e-7), True
                self.origin_altitude_m = fields[2] * 1e-3
            case mavlink.HOME_POSITION if not (self._origin_reported or self.airborne) and isfinite(sum(fields[3:6])):
                self.origin = shifted((fields[0] * 1e-7, fields[1] * 1e-7), -fields[3], -fields[4])
                self.origin_altitude_m = fields[2] * 1e-3 + fields[5]
            case _:
                pass

    def _heartbeat(self, fields: tuple[Any, ...]) -> None:
        _, _, _, base_mode, system_status, _ = fields
        self._armed, self._standby = bool(base_mode & ARMED), system_status == _STANDBY
        if self._armed:
            self.arming_refusals, self._text = 0, ""
        self._forget_old_frame()
        self._restarted = False
        self._judge_ground()

    def _forget_old_frame(self) -> None:
        """Forget the origin of the local frame after a restart; of an armed vehicle, only the clock has jumped."""
        if self._restarted and not self._armed:
            self.origin, self._origin_reported = None, False

    def _judge_ground(self) -> None:
        """Decide from the newest heartbeat and altitude whether the vehicle has taken off or landed."""
        above_home_m = self.relative_altitude_m or 0.0
        self._has_flown |= self._armed and above_home_m > _HAS_FLOWN_M
        if self._has_flown and (not self._armed or self._standby):
            self.stays_disarmed = HAS_LANDED
        elif self._armed and (above_home_m > _FLIES_M or not self._has_flown):
            self.stays_disarmed = ""

    def _update_altitude(self) -> None:
        """Update an old altitude from the local frame: with one that stays the same, a climb would never end."""
        if self._local is not None and self._reported is not None and self._local[0] - self._reported[0] > _OLD_MS:
            self.relative_altitude_m = self._reported[1] - self._local[3]
            self._judge_ground()

    def _global(self, fields: tuple[Any, ...]) -> None:
        boot_ms, latitude, longitude, altitude_mm, relative_mm = fields[:5]
        if latitude == longitude == 0:
            return  # sent before a position is known
        self.relative_altitude_m = relative_mm * 1e-3
        self._judge_ground()
        self._sea_level_m = (altitude_mm - relative_mm) * 1e-3
        if self._local is not None:
            self._reported = boot_ms, relative_mm * 1e-3 + self._local[3]
        if self._local is not None and not self._origin_reported and not self.airborne:
            local_ms, north, east, down, v_north, v_east = self._local
            since_s = (boot_ms - local_ms) * 1e-3
            place = latitude * 1e-7, longitude * 1e-7
            if abs(since_s) < 1.0:
                self.origin = shifted(place, -north - v_north * since_s, -east - v_east * since_s)
                self.origin_altitude_m = altitude_mm * 1e-3 + down

    def accepted(self, command: int, parameters: tuple[float, ...], now_ns: int) -> None:
        if command == SET_MESSAGE_INTERVAL:
            self._accepted.add(parameters[0])
        elif command == TAKE_OFF:
            self._took_off_ns = now_ns

    def refused(self, command: int, parameters: tuple[float, ...], now_ns: int, *, repeated: bool) -> None:
        """Accept a refused rate of the origin, which other messages contain too, or of the optional active target.

        Refusals to arm are counted. A vehicle that refuses a resent take-off command is already taking off: its first
        answer was lost.
        """
        if command == SET_MESSAGE_INTERVAL and parameters[0] in (mavlink.GPS_GLOBAL_ORIGIN, OPTIONAL):
            self._accepted.add(parameters[0])
        elif command == ARM_DISARM:
            self.arming_refusals += 1
        elif command == TAKE_OFF and repeated:
            self._took_off_ns = now_ns

    def is_news(self, text: str) -> bool:
        """Whether a text is new: a disarmed vehicle keeps repeating why it does not arm."""
        known, self._text = not self._armed and text == self._text, text
        return not known

    @property
    def is_halfway_up(self) -> bool:
        return (self.relative_altitude_m or 0.0) >= 0.5 * self.altitude_m

    def disarmed(self) -> None:
        self.stays_disarmed, self._took_off_ns = self.stays_disarmed or WAS_DISARMED, None

    def begin_anew(self) -> None:
        self._accepted.clear()
        self._took_off_ns, self._restarted = None, True
        self._forget_old_frame()

    def next_parameter(self, now_ns: int, *, target_system: int, rtt_ns: int) -> tuple[int, tuple[Any, ...]] | None:
        """The request that is due for its limits, which are only read: setting them is up to the owner."""
        return self.limits.next(self.kind, now_ns, target_system=target_system, rtt_ns=rtt_ns)

    def next(self, *, custom_mode: int, armed: bool, clock_known: bool, now_ns: int) -> Step:
        """The next step of the start-up; a vehicle found in the air continues from there.

        All need rates, clock and position. ArduCopter then becomes guided, is armed and takes off; PX4 is armed, takes
        off and becomes guided (OFFBOARD) once set-points arrive. One that stays disarmed gets no mode or arming
        command.
        """
        if self.kind is UNRECOGNISED:
            return Step(self.refusal or "sends no heartbeat of an autopilot")
        patience_ns = (_TAKE_OFF_S + self.altitude_m / _SLOWEST_CLIMB_M_S) * 1e9
        took_off = self._took_off_ns is not None and now_ns - self._took_off_ns < patience_ns
        # A vehicle found in the air takes set-points at once; during a take-off, they would end the climb too early.
        enough_m = _TAKEN_OFF_FRACTION * self.altitude_m if took_off else _LEFT_GROUND_M
        is_up = self.airborne or (self.relative_altitude_m or 0.0) > enough_m
        self.airborne = armed and is_up and not self.stays_disarmed
        due = next(((m, us) for m, us in self._rates.items() if m not in self._accepted), None)
        if lacks := self._lacks(due, clock_known=clock_known):
            return Step(lacks, None if due is None else (SET_MESSAGE_INTERVAL, due))
        guided = custom_mode == self.kind.guided_mode
        if not guided and (self.kind.guided_first or self.airborne):
            return Step(f"does not enter {self.kind.guided_name}", mode_command(self.kind, self.kind.guided_mode))
        if not armed:
            why = f": {self._text}" if self._text else ""
            refused = f", refused {self.arming_refusals} times{why}" if self.arming_refusals else ""
            return Step(f"does not arm{refused}", _ARM)
        if not took_off and not self.airborne:
            # PX4 would fly to a finite latitude, longitude and yaw; NaN keeps the present ones.
            above_sea = 0.0, 0.0, 0.0, nan, nan, nan, self.altitude_m + self._sea_level_m
            above_home = (0.0,) * 6 + (self.altitude_m,)
            return Step("does not take off", (TAKE_OFF, above_sea if self.kind.altitude_above_sea else above_home))
        climbs = f"climbs to {self.altitude_m:g} m, is at {self.relative_altitude_m or 0.0:.1f} m"
        return Step("" if self.airborne else climbs)

    def _lacks(self, due: tuple[float, float] | None, *, clock_known: bool) -> str:
        """What the vehicle lacks before it may be guided and armed; empty if nothing. `due` is a rate not accepted."""
        flags = self._flags
        has_position = (flags or 0) & (_POSITION_FLAGS | _CONSTANT_POSITION) == _POSITION_FLAGS
        lacks = (
            (f"does not accept the rate of message {due[0] if due else 0:.0f}", due is not None),
            (self.stays_disarmed, self.stays_disarmed != ""),
            ("does not answer TIMESYNC", not clock_known),
            (f"sends no estimator status (message {self.kind.estimator_message})", flags is None),
            (f"has no position yet (estimator flags 0x{flags or 0:x})", not has_position),
            ("sends no LOCAL_POSITION_NED", self._local is None),
            ("sends no GLOBAL_POSITION_INT", self.relative_altitude_m is None),
            ("does not say where its local origin is", self.origin is None),
        )
        return next((text for text, lacking in lacks if lacking), "")


def shifted(place: Degrees, north_m: float, east_m: float) -> Degrees:
    """The position `north_m` and `east_m` from another, on a flat earth."""
    latitude, longitude = place
    return (
        latitude + degrees(north_m / EARTH_RADIUS_M),
        longitude + degrees(east_m / EARTH_RADIUS_M / cos(radians(latitude))),
    )


def between(start: Degrees, end: Degrees) -> tuple[float, float]:
    """The displacement north and east from `start` to `end` in m, on a flat earth."""
    north = radians(end[0] - start[0]) * EARTH_RADIUS_M
    return north, radians(end[1] - start[1]) * EARTH_RADIUS_M * cos(radians(start[0]))
