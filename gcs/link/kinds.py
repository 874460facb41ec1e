"""What the station knows of each kind of autopilot, as data, and what it tells a vehicle next, as one pure function.

Read in the sources of ArduCopter (mode_guided.cpp, GCS_MAVLink_Copter.cpp) and PX4 (mavlink_receiver.cpp,
Commander.cpp, offboardCheck.cpp).
"""

from dataclasses import dataclass
from enum import Enum
from math import nan
from typing import NamedTuple

from gcs.link import mavlink

SET_MODE = 176
ARM_DISARM = 400
TAKE_OFF = 22
SET_MESSAGE_INTERVAL = 511
REQUEST_MESSAGE = 512
CUSTOM_MODE_ENABLED = 1.0

ARDUPILOT, PX4 = 3, 12
"""MAV_AUTOPILOT"""
_MULTICOPTERS = {2: "quadrotor", 3: "coaxial", 4: "helicopter", 13: "hexarotor", 14: "octorotor", 15: "tricopter"}
_NOT_YET_KNOWN, _FIXED_WING = 0, 1

_POSITION_FLAGS, _CONSTANT_POSITION = 0x08 | 0x10, 0x80
"""Estimator flags: horizontal position, relative and absolute, and that it only pretends to have one. The same bits in
EKF_STATUS_REPORT and ESTIMATOR_STATUS."""


class Goal(Enum):
    """What the station wants of a vehicle."""

    FLY = "take set-points"
    END = "hold or land by itself"


@dataclass(frozen=True)
class Kind:
    """One kind of vehicle."""

    name: str
    guided_mode: int
    """HEARTBEAT.custom_mode in which it takes set-points,"""
    hold_mode: int
    """and in which it stays where it is, without a pilot."""
    land_mode: int
    take_off_mode: int = -1
    """In which it takes off, if that is not the guided one; it then holds."""
    guided_name: str = "GUIDED"
    estimator_message: int = 0
    """Tells whether it has a position."""
    guided_first: bool = True
    """Guided on the ground, before it is armed; otherwise only in the air, while set-points come."""
    altitude_above_sea: bool = False
    """The altitude of a take-off command is above sea level, not above home."""
    stays_guided: bool = False
    """Without set-points it stays guided, and stops: if it leaves, that is somebody's will, or its own for another
    reason."""
    velocity_grows: bool = False
    """Its velocity target grows with the acceleration between two set-points."""
    timesync_backdated_ns: int = 0
    """Most by which it dates its TIMESYNC replies back."""
    packed_modes: bool = False
    """Modes have a main and a sub number, which DO_SET_MODE takes apart and HEARTBEAT packed."""


def _packed(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


LAUNCHED = Kind("launched UAV", guided_mode=4, hold_mode=5, land_mode=5)
"""What scenarios without autopilots fly."""
ARDUCOPTER = Kind(
    "ArduCopter",
    guided_mode=4,
    hold_mode=17,  # BRAKE: LOITER would ask the pilot's sticks
    land_mode=9,
    estimator_message=mavlink.EKF_STATUS_REPORT,
    stays_guided=True,
    velocity_grows=True,
    timesync_backdated_ns=5_000_000,  # by what the bytes would take on a serial port: 3.5 ms at its 57600 baud
)
PX4_COPTER = Kind(
    "PX4 multicopter",
    guided_mode=_packed(6),
    hold_mode=_packed(4, 3),
    land_mode=_packed(4, 6),
    take_off_mode=_packed(4, 2),
    guided_name="OFFBOARD",
    estimator_message=mavlink.ESTIMATOR_STATUS,
    guided_first=False,
    altitude_above_sea=True,
    packed_modes=True,
)


def kind_of(autopilot: int, vehicle_type: int) -> Kind | str | None:
    """The kind of vehicle that a HEARTBEAT shows, or why it cannot be flown; None if it does not know yet itself."""
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


def mode_command(kind: Kind, custom_mode: int) -> tuple[int, tuple[float, ...]]:
    """DO_SET_MODE with its parameters."""
    if not kind.packed_modes:
        return SET_MODE, (CUSTOM_MODE_ENABLED, float(custom_mode))
    return SET_MODE, (CUSTOM_MODE_ENABLED, float(custom_mode >> 16 & 0xFF), float(custom_mode >> 24))


def commanded_mode(kind: Kind, parameters: tuple[float, ...]) -> int:
    """The custom mode that such a command asks for."""
    return _packed(int(parameters[1]), int(parameters[2])) if kind.packed_modes else int(parameters[1])


class Seen(NamedTuple):
    """What is known of a vehicle that is being started."""

    interval_due: tuple[float, float] | None
    """The next message (id, interval in µs) whose rate it has still to accept; None if it has accepted all."""
    clock_known: bool
    position_heard: bool
    estimator_flags: int | None
    origin_known: bool
    custom_mode: int
    armed: bool
    took_off: bool
    airborne: bool
    relative_altitude_m: float | None
    sea_level_m: float
    """Altitude of its home above sea level; only with a relative altitude."""


class Step(NamedTuple):
    """What is missing, "" if nothing, and the command (with parameters) that may bring it; None to wait."""

    missing: str
    command: tuple[int, tuple[float, ...]] | None = None


def next_step(kind: Kind, seen: Seen, *, altitude_m: float) -> Step:
    """The next step of the start-up, from what is seen alone: a vehicle found in the air goes on from there.

    Rates, clock, position, and then: ArduCopter guided, armed, taken off; PX4 armed, taken off, offboard while
    set-points already come.
    """
    if seen.interval_due is not None:
        text = f"does not accept the rate of message {seen.interval_due[0]:.0f}"
        return Step(text, (SET_MESSAGE_INTERVAL, seen.interval_due))
    if waiting := _waits_for(kind, seen):
        return Step(waiting)
    guided = seen.custom_mode == kind.guided_mode
    if not guided and (kind.guided_first or seen.airborne):
        return Step(f"does not enter {kind.guided_name}", mode_command(kind, kind.guided_mode))
    if not seen.armed:
        return Step("does not arm", (ARM_DISARM, (1.0,)))
    if not seen.took_off and not seen.airborne:
        # PX4 would take off towards a latitude, longitude and yaw that are numbers; NaN is where it stands.
        where = (0.0, 0.0, 0.0, nan, nan, nan, altitude_m + seen.sea_level_m)
        return Step("does not take off", (TAKE_OFF, where if kind.altitude_above_sea else (0.0,) * 6 + (altitude_m,)))
    climbs = f"climbs to {altitude_m:g} m, is at {seen.relative_altitude_m or 0.0:.1f} m"
    return Step("" if seen.airborne else climbs)


def _waits_for(kind: Kind, seen: Seen) -> str:
    """What the vehicle has to get by itself."""
    flags = seen.estimator_flags
    if not seen.clock_known:
        return "does not answer TIMESYNC"
    if flags is None:
        return f"sends no estimator status (message {kind.estimator_message})"
    if flags & _POSITION_FLAGS != _POSITION_FLAGS or flags & _CONSTANT_POSITION:
        return f"has no position yet (estimator flags 0x{flags:x})"
    if not seen.position_heard:
        return "sends no LOCAL_POSITION_NED"
    if seen.relative_altitude_m is None:
        return "sends no GLOBAL_POSITION_INT"
    return "" if seen.origin_known else "does not say where its local origin is"
