"""How ArduCopter and PX4 treat modes, arming, take-off and set-points, as data and pure functions.

From the sources: ArduCopter's mode_guided.cpp and GCS_MAVLink_Copter.cpp; PX4's mavlink_receiver.cpp, Commander.cpp and
offboardCheck.cpp.
"""

import math
from dataclasses import dataclass

from scenarios.networks import wire_id
from scenarios.schema import Autopilot
from sim_vehicles.motion.copter import Target
from sim_vehicles.services import mavlink
from sim_vehicles.services.mavlink import Command, Setpoint
from sim_vehicles.services.parameters import ARDUPILOT_SETUP, PX4_SETUP, Parameter, Parameters, fixed, timeout
from sim_vehicles.vehicles import setpoints

TEMPORARILY_REJECTED, FAILED = 1, 4
PX4_TAKEOFF_ALTITUDE = "MIS_TAKEOFF_ALT"
"""The parameter with the altitude above ground, in m, of a take-off command without an altitude."""
MOST_JERK_M_S3 = 20.0
"""Jerk limit that a vehicle without one reports: the largest that both autopilots allow."""
GROUND_DISARM_S = 10.0
"""Both autopilots disarm if they have not taken off this long after arming."""


def px4_mode(main: int, sub: int = 0) -> int:
    """HEARTBEAT.custom_mode of a PX4 mode."""
    return main << 16 | sub << 24


@dataclass(frozen=True)
class Rules:
    """Behaviour and reports of one autopilot, ArduCopter or PX4."""

    autopilot: int
    """MAV_AUTOPILOT"""
    modes: dict[int, str]
    first_mode: int
    guided_mode: int
    takeoff_mode: int
    """The mode in which a take-off is flown; a take-off command enters it unless it is the guided mode."""
    hold_mode: int
    land_mode: int
    return_mode: int
    estimator_message: int
    """The message with the estimator's flags: EKF_STATUS_REPORT or ESTIMATOR_STATUS."""
    arming_refused: int
    """The MAV_RESULT of a command that is refused because the vehicle is not ready."""
    parameters_bytewise: bool
    """Whether it sends integer parameters as their bytes."""
    version: tuple[int, int, int]
    """The version in AUTOPILOT_VERSION; stations warn of versions older than they support."""
    system_id_parameter: str
    setpoint_timeout_parameter: str
    ground_disarm_parameter: str
    setpoint_timeout_s: float
    velocity_grows: bool
    """Whether the velocity target integrates the acceleration between two set-points."""
    complains_every_s: float
    """Interval at which it reports unasked why it cannot be armed; 0 for never."""
    version_1_first: bool
    """Whether it speaks MAVLink 1 until it hears MAVLink 2 (MAV_PROTO_VER 0)."""


ARDUPILOT = Rules(
    autopilot=3,
    modes={0: "STABILIZE", 4: "GUIDED", 5: "LOITER", 6: "RTL", 9: "LAND", 17: "BRAKE"},
    first_mode=0,
    guided_mode=4,
    takeoff_mode=4,
    hold_mode=17,
    land_mode=9,
    return_mode=6,
    estimator_message=193,
    arming_refused=FAILED,
    parameters_bytewise=False,
    version=(4, 6, 0),
    system_id_parameter="SYSID_THISMAV",
    setpoint_timeout_parameter="GUID_TIMEOUT",
    ground_disarm_parameter="DISARM_DELAY",
    setpoint_timeout_s=3.0,
    velocity_grows=True,
    complains_every_s=30.0,
    version_1_first=False,
)
PX4 = Rules(
    autopilot=12,
    modes={
        px4_mode(3): "POSCTL",
        px4_mode(4, 2): "AUTO.TAKEOFF",
        px4_mode(4, 3): "AUTO.LOITER",
        px4_mode(4, 5): "AUTO.RTL",
        px4_mode(4, 6): "AUTO.LAND",
        px4_mode(6): "OFFBOARD",
    },
    first_mode=px4_mode(4, 3),
    guided_mode=px4_mode(6),
    takeoff_mode=px4_mode(4, 2),
    hold_mode=px4_mode(4, 3),
    land_mode=px4_mode(4, 6),
    return_mode=px4_mode(4, 5),
    estimator_message=230,
    arming_refused=TEMPORARILY_REJECTED,
    parameters_bytewise=True,
    version=(1, 16, 0),
    system_id_parameter="MAV_SYS_ID",
    setpoint_timeout_parameter="COM_OF_LOSS_T",
    ground_disarm_parameter="COM_DISARM_PRFLT",
    setpoint_timeout_s=1.0,
    velocity_grows=False,
    complains_every_s=0.0,
    version_1_first=True,
)
RULES = {"ardupilot": ARDUPILOT, "px4": PX4}


def parameters(rules: Rules, system_id: int, settings: Autopilot) -> Parameters:
    known = [
        fixed(rules.system_id_parameter, wire_id(system_id)),
        timeout(rules.setpoint_timeout_parameter, rules.setpoint_timeout_s),
        timeout(rules.ground_disarm_parameter, GROUND_DISARM_S),
    ]
    jerk_m_s3 = settings.jerk_max_m_s3 or MOST_JERK_M_S3
    if rules is PX4:
        known += [fixed("MPC_ACC_HOR", settings.acceleration_max_m_s2), fixed("MPC_JERK_AUTO", jerk_m_s3)]
        known += [Parameter(PX4_TAKEOFF_ALTITUDE, 2.5, 0.5, 1000.0), *PX4_SETUP]
    else:
        known += [fixed("WPNAV_ACCEL", 100.0 * settings.acceleration_max_m_s2), fixed("PSC_JERK_XY", jerk_m_s3)]
        known += ARDUPILOT_SETUP
    return Parameters(known, bytewise=rules.parameters_bytewise)


def setpoint_target(
    setpoint: Setpoint, rules: Rules, *, yaw_rad: float, velocity_gain_1_s: float
) -> tuple[str, Target]:
    """The reason not to fly a set-point, or "", and the target that it sets for a vehicle with this yaw.

    One ignored axis makes its whole vector ignored. Ignored fields may hold anything, even NaN, which some clients
    send. A refused set-point makes ArduCopter stop; PX4 ignores it.
    """
    mask = setpoint.type_mask
    velocity_counts, acceleration_counts = not mask & setpoints.VELOCITY_AXES, not mask & setpoints.ACCELERATION_AXES
    if setpoint.frame not in setpoints.LOCAL_FRAMES + setpoints.BODY_FRAMES:
        return "refused_frame", Target()
    if mask & setpoints.FORCE_SET and (acceleration_counts or rules is PX4):
        return "refused_force", Target()
    if not mask & setpoints.POSITION_AXES or not (velocity_counts or acceleration_counts):
        return "refused_mask", Target()  # flying to positions is not simulated
    setpoint = setpoints.to_local(setpoint, yaw_rad)
    acceleration = setpoint.acceleration_ned_m_s2 if acceleration_counts else (0.0, 0.0, 0.0)
    velocity = setpoint.velocity_ned_m_s if velocity_counts else (0.0, 0.0, 0.0)
    has_yaw = not mask & setpoints.YAW_IGNORED
    yaw = setpoint.yaw_rad if has_yaw else 0.0
    rate = 0.0 if mask & setpoints.YAW_RATE_IGNORED else setpoint.yaw_rate_rad_s
    if not math.hypot(*acceleration, *velocity, yaw, rate) <= setpoints.ABSURD:
        return "refused_absurd", Target()
    return "", Target(
        complex(*acceleration[:2]),
        complex(*velocity[:2]),
        velocity_gain_1_s=velocity_gain_1_s if velocity_counts else 0.0,
        growth=1.0 if velocity_counts and rules.velocity_grows else 0.0,
        climb_m_s=-velocity[2],
        yaw_rad=yaw if has_yaw else math.nan,
        yaw_rate_rad_s=rate,
    )


def commanded_mode(command: Command, rules: Rules) -> int | None:
    """The custom mode that a DO_SET_MODE asks for; None if the autopilot does not have it."""
    if not math.isfinite(command.param1 + command.param2 + command.param3):
        return None
    base, main, sub = int(command.param1), int(command.param2), int(command.param3)
    if not base & mavlink.BASE_MODE_CUSTOM:
        return None
    mode = px4_mode(main, sub) if rules is PX4 else main
    return mode if mode in rules.modes else None
