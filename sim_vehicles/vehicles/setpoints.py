"""Interpretation of a set-point: which of its vectors count, and in which frame."""

import math

from sim_vehicles.services import frames
from sim_vehicles.services.mavlink import Setpoint

POSITION_AXES, VELOCITY_AXES, ACCELERATION_AXES = 0x007, 0x038, 0x1C0
AXES = POSITION_AXES | VELOCITY_AXES | ACCELERATION_AXES
VELOCITY, ACCELERATION, VELOCITY_ACCELERATION = AXES & ~VELOCITY_AXES, AXES & ~ACCELERATION_AXES, POSITION_AXES
"""The bits of AXES that are set (ignored) when only velocity, only acceleration, or both count."""
FORCE_SET, YAW_IGNORED, YAW_RATE_IGNORED = 0x200, 0x400, 0x800
LOCAL_FRAMES, BODY_FRAMES = (1, 7), (8, 9)
"""LOCAL_NED and LOCAL_OFFSET_NED, BODY_NED and BODY_OFFSET_NED: a pair is equal for velocities and accelerations."""
ABSURD = 1e4
"""A set-point with more m/s² or m/s than this is refused."""


def fault(setpoint: Setpoint) -> str:
    """Why a double integrator refuses a set-point, or an empty string. NaN counts as absurd.

    A set-point must carry the whole vector of velocity, of acceleration, or both. Yaw is ignored: the heading is the
    course.
    """
    if setpoint.frame != frames.LOCAL_NED and setpoint.frame not in BODY_FRAMES:
        return "refused_frame"
    mask = setpoint.type_mask
    counts = mask & AXES
    if counts in (VELOCITY_ACCELERATION, VELOCITY):
        if not math.hypot(*setpoint.velocity_ned_m_s) <= ABSURD:
            return "refused_absurd"
    elif counts != ACCELERATION:
        return "refused_mask"
    if counts == VELOCITY:
        return ""
    if mask & FORCE_SET:
        return "refused_mask"
    return "" if math.hypot(*setpoint.acceleration_ned_m_s2) <= ABSURD else "refused_absurd"


def to_local(setpoint: Setpoint, yaw_rad: float) -> Setpoint:
    """The set-point with its vectors in the local frame, turned by this yaw if they were in the body frame."""
    if setpoint.frame not in BODY_FRAMES:
        return setpoint
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)

    def turned(forward: float, right: float, down: float) -> tuple[float, float, float]:
        return cosine * forward - sine * right, sine * forward + cosine * right, down

    return setpoint._replace(
        velocity_ned_m_s=turned(*setpoint.velocity_ned_m_s),
        acceleration_ned_m_s2=turned(*setpoint.acceleration_ned_m_s2),
        frame=frames.LOCAL_NED,
    )
