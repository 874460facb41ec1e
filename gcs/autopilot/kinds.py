"""ArduPilot and PX4 multicopters as data, and the next step of their start-up as one pure function.

Taken from the sources of ArduCopter (mode_guided.cpp, GCS_MAVLink_Copter.cpp) and PX4 (mavlink_receiver.cpp,
Commander.cpp, offboardCheck.cpp).
"""

from math import nan
from typing import NamedTuple

from gcs.link import mavlink
from gcs.link.kinds import ARM_DISARM, SET_MESSAGE_INTERVAL, TAKE_OFF, Kind, Step, mode_command, packed

ARM = ARM_DISARM, (1.0,)
HAS_LANDED, WAS_DISARMED = "has landed and is not armed again", "was disarmed and is not armed again"
ARDUPILOT, PX4 = 3, 12
"""Values of MAV_AUTOPILOT."""
_MULTICOPTERS = {2: "quadrotor", 3: "coaxial", 4: "helicopter", 13: "hexarotor", 14: "octorotor", 15: "tricopter"}
_NOT_YET_KNOWN, _FIXED_WING = 0, 1

_POSITION_FLAGS, _CONSTANT_POSITION = 0x08 | 0x10, 0x80
"""Estimator flags: horizontal position known, relative and absolute; position only assumed. The bits are the same in
EKF_STATUS_REPORT and ESTIMATOR_STATUS."""
ARDUCOPTER = Kind(
    "ArduCopter",
    guided_mode=4,
    hold_mode=17,  # BRAKE: LOITER would follow the pilot's sticks
    land_mode=9,
    estimator_message=mavlink.EKF_STATUS_REPORT,
    velocity_grows=True,
    timesync_error_ns=5_000_000,  # stamps are backdated by the transfer time on a serial port, 3.5 ms at 57600 baud
)
PX4_COPTER = Kind(
    "PX4 multicopter",
    guided_mode=packed(6),
    hold_mode=packed(4, 3),
    land_mode=packed(4, 6),
    take_off_mode=packed(4, 2),
    failsafe_mode=packed(4, 3),  # COM_OBL_RC_ACT: others let its pilot steer, or are those of a low battery
    guided_name="OFFBOARD",
    estimator_message=mavlink.ESTIMATOR_STATUS,
    guided_first=False,
    altitude_above_sea=True,
    packed_modes=True,
)


def kind_of(autopilot: int, vehicle_type: int) -> Kind | str | None:
    """The kind of vehicle that a HEARTBEAT reports, or why it cannot be flown; None while the vehicle does not know."""
    if vehicle_type == _NOT_YET_KNOWN:
        return None  # ArduPilot before its motors are set up
    if vehicle_type == _FIXED_WING and autopilot == ARDUPILOT:
        return (
            "is an ArduPlane, which takes no velocity set-points but speed, heading and altitude "
            "(commands 43000, 43002, 43001): not supported"
        )
    if autopilot not in (ARDUPILOT, PX4) or vehicle_type not in _MULTICOPTERS:
        return f"is of type {vehicle_type} with autopilot {autopilot}, wanted a multicopter with ArduPilot or PX4"
    return ARDUCOPTER if autopilot == ARDUPILOT else PX4_COPTER


class Seen(NamedTuple):
    """Observed state of a vehicle during its start-up."""

    interval_due: tuple[float, float] | None
    """The next message (id, interval in µs) whose rate the vehicle has not yet accepted; None if all are accepted."""
    clock_known: bool
    position_heard: bool
    estimator_flags: int | None
    origin_known: bool
    custom_mode: int
    armed: bool
    stays_disarmed: str
    """Why the station must not arm it; empty if it may."""
    took_off: bool
    airborne: bool
    relative_altitude_m: float | None
    sea_level_m: float
    """Altitude of its home above sea level; valid once the relative altitude is known."""


def next_step(kind: Kind, seen: Seen, *, altitude_m: float) -> Step:
    """The next step of the start-up. It depends on `seen` alone, so a vehicle found in the air continues from there.

    All need rates, clock and position. ArduCopter then becomes guided, is armed and takes off; PX4 is armed, takes off
    and becomes guided (OFFBOARD) once set-points arrive. One that stays disarmed gets no mode or
    arming command.
    """
    if seen.interval_due is not None:
        text = f"does not accept the rate of message {seen.interval_due[0]:.0f}"
        return Step(text, (SET_MESSAGE_INTERVAL, seen.interval_due))
    if lacks := _lacks(kind, seen):
        return Step(lacks)
    guided = seen.custom_mode == kind.guided_mode
    if not guided and (kind.guided_first or seen.airborne):
        return Step(f"does not enter {kind.guided_name}", mode_command(kind, kind.guided_mode))
    if not seen.armed:
        return Step("does not arm", ARM)
    if not seen.took_off and not seen.airborne:
        # PX4 would fly to a finite latitude, longitude and yaw; NaN keeps the present ones.
        where = (0.0, 0.0, 0.0, nan, nan, nan, altitude_m + seen.sea_level_m)
        return Step("does not take off", (TAKE_OFF, where if kind.altitude_above_sea else (0.0,) * 6 + (altitude_m,)))
    climbs = f"climbs to {altitude_m:g} m, is at {seen.relative_altitude_m or 0.0:.1f} m"
    return Step("" if seen.airborne else climbs)


def _lacks(kind: Kind, seen: Seen) -> str:
    """What the vehicle lacks that no command can provide; empty if nothing."""
    flags = seen.estimator_flags
    if seen.stays_disarmed or not seen.clock_known:
        return seen.stays_disarmed or "does not answer TIMESYNC"
    if flags is None:
        return f"sends no estimator status (message {kind.estimator_message})"
    if flags & _POSITION_FLAGS != _POSITION_FLAGS or flags & _CONSTANT_POSITION:
        return f"has no position yet (estimator flags 0x{flags:x})"
    if not seen.position_heard:
        return "sends no LOCAL_POSITION_NED"
    if seen.relative_altitude_m is None:
        return "sends no GLOBAL_POSITION_INT"
    return "" if seen.origin_known else "does not say where its local origin is"
