"""ArduPilot and PX4 multicopters as data.

Taken from the sources of ArduCopter (mode_guided.cpp, GCS_MAVLink_Copter.cpp) and PX4 (mavlink_receiver.cpp,
Commander.cpp, offboardCheck.cpp).
"""

from gcs.link import mavlink
from gcs.link.kinds import Kind, packed

HAS_LANDED, WAS_DISARMED = "has landed and is not armed again", "was disarmed and is not armed again"
ARDUPILOT, PX4 = 3, 12
"""Values of MAV_AUTOPILOT."""
_MULTICOPTERS = {2: "quadrotor", 3: "coaxial", 4: "helicopter", 13: "hexarotor", 14: "octorotor", 15: "tricopter"}
_NOT_YET_KNOWN, _FIXED_WING = 0, 1

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
    failsafe_mode=packed(4, 3),  # of COM_OBL_RC_ACT; other modes let its pilot steer, or mean a low battery
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
