"""Motion of a multicopter: its acceleration follows the commanded one with a lag, within limits.

    w = a_set + g (v_set - v),  |w| clipped to the limit;   lag a' = w - a,   v' = a,   p' = v

on each axis, north and east; g = 0 if the set-point has no velocity. The air decelerates it by drag |v| v. Between
set-points v_set integrates a_set if the autopilot does so. The climb rate follows its command with a lag of its own.
RK4 integrates in steps of at most 10 ms.
"""

import math
from typing import NamedTuple

from scenarios import schema
from sim_vehicles.motion.lagged import Inner, followed, longest_step_s

LONGEST_STEP_S = 0.01
CLIMB_LAG_S = 0.3
CLIMB_GAIN_1_S = 0.8
"""Gain from remaining height to climb rate in a take-off."""
PLACE_GAIN_1_S = 0.3
"""Gain from remaining distance to speed in a flight to a place."""
YAW_RATE_MAX_RAD_S = 1.5


class Motion(NamedTuple):
    """Position, velocity and acceleration; the altitude is above the initial ground."""

    north_m: float
    east_m: float
    velocity_north_m_s: float = 0.0
    velocity_east_m_s: float = 0.0
    acceleration_north_m_s2: float = 0.0
    acceleration_east_m_s2: float = 0.0
    altitude_m: float = 0.0
    climb_m_s: float = 0.0
    yaw_rad: float = 0.0
    inner: Inner | None = None
    """Internal state of its response; None for a plain lag without a jerk limit."""


class Target(NamedTuple):
    """The target that the autopilot steers to. Its velocity integrates `growth` times its acceleration."""

    acceleration_north_m_s2: float = 0.0
    acceleration_east_m_s2: float = 0.0
    velocity_north_m_s: float = 0.0
    velocity_east_m_s: float = 0.0
    velocity_gain_1_s: float = 0.0
    growth: float = 0.0
    climb_m_s: float = 0.0
    altitude_m: float | None = None
    """Climb or sink to this altitude."""
    yaw_rad: float | None = None
    yaw_rate_rad_s: float = 0.0
    """Turn to `yaw_rad`; without one, turn at this rate."""
    place_ne_m: tuple[float, float] | None = None
    """Fly to this place; the velocity follows from the remaining distance."""


def advance(motion: Motion, target: Target, limits: schema.Autopilot, duration_s: float) -> tuple[Motion, Target]:
    """The motion and the target after `duration_s`; the target's velocity changes by then."""
    longest_s = LONGEST_STEP_S if motion.inner is None else longest_step_s(limits, LONGEST_STEP_S)
    steps = max(1, math.ceil(duration_s / longest_s))
    h = duration_s / steps
    for _ in range(steps):
        if target.place_ne_m is not None:  # the velocity that leads to the place
            north, east = target.place_ne_m[0] - motion.north_m, target.place_ne_m[1] - motion.east_m
            gain = min(PLACE_GAIN_1_S, limits.speed_max_m_s / max(math.hypot(north, east), 1e-9))
            target = target._replace(velocity_north_m_s=gain * north, velocity_east_m_s=gain * east)
        motion = _step(motion, target, limits, h)
        grown = target.growth * h
        target = target._replace(
            velocity_north_m_s=target.velocity_north_m_s + grown * target.acceleration_north_m_s2,
            velocity_east_m_s=target.velocity_east_m_s + grown * target.acceleration_east_m_s2,
        )
    return motion, target


def pushed(
    motion: Motion, target: Target, limits: schema.Autopilot, piece: tuple[float, float, float, float, float]
) -> tuple[Motion, Target]:
    """As `advance`, over an interval of constant push, a `Piece` of `air`."""
    t, half_north, half_east, north, east = piece
    motion, target = advance(_shifted(motion, 0.0, 0.0, half_north, half_east), target, limits, t)
    return _shifted(motion, north, east, half_north, half_east), target


def _shifted(motion: Motion, north_m: float, east_m: float, north_m_s: float, east_m_s: float) -> Motion:
    """The motion with these changes of position and velocity."""
    return motion._replace(
        north_m=motion.north_m + north_m,
        east_m=motion.east_m + east_m,
        velocity_north_m_s=motion.velocity_north_m_s + north_m_s,
        velocity_east_m_s=motion.velocity_east_m_s + east_m_s,
    )


def _step(motion: Motion, target: Target, limits: schema.Autopilot, h: float) -> Motion:
    if motion.inner is not None:
        return _step_remembering(motion, motion.inner, target, limits, h)
    north, east, v_n, v_e, a_n, a_e, *_ = motion
    half = 0.5 * h
    # v' = a and lag a' = w - a; the position is the integral of the velocity
    j1n, j1e = _jerk(v_n, v_e, a_n, a_e, target, limits, 0.0)
    a2n, a2e, v2n, v2e = a_n + half * j1n, a_e + half * j1e, v_n + half * a_n, v_e + half * a_e
    j2n, j2e = _jerk(v2n, v2e, a2n, a2e, target, limits, half)
    a3n, a3e, v3n, v3e = a_n + half * j2n, a_e + half * j2e, v_n + half * a2n, v_e + half * a2e
    j3n, j3e = _jerk(v3n, v3e, a3n, a3e, target, limits, half)
    a4n, a4e, v4n, v4e = a_n + h * j3n, a_e + h * j3e, v_n + h * a3n, v_e + h * a3e
    j4n, j4e = _jerk(v4n, v4e, a4n, a4e, target, limits, h)
    sixth = h / 6.0
    north += sixth * (v_n + 2.0 * (v2n + v3n) + v4n)
    east += sixth * (v_e + 2.0 * (v2e + v3e) + v4e)
    v_n += sixth * (a_n + 2.0 * (a2n + a3n) + a4n)
    v_e += sixth * (a_e + 2.0 * (a2e + a3e) + a4e)
    a_n += sixth * (j1n + 2.0 * (j2n + j3n) + j4n)
    a_e += sixth * (j1e + 2.0 * (j2e + j3e) + j4e)
    return _after(motion, (north, east, v_n, v_e, a_n, a_e), target, limits, h)


def _after(motion: Motion, plane: tuple[float, ...], target: Target, limits: schema.Autopilot, h: float) -> Motion:
    """The motion after a step: `plane` with its speed reduced by drag and limited, and the new altitude and yaw."""
    north, east, v_n, v_e, a_n, a_e = plane
    speed = math.hypot(v_n, v_e)
    if limits.drag_1_m:  # speed' = -drag speed^2
        left = 1.0 / (1.0 + limits.drag_1_m * speed * h)
        v_n, v_e, speed = left * v_n, left * v_e, left * speed
    if speed > limits.speed_max_m_s:
        v_n, v_e = v_n * limits.speed_max_m_s / speed, v_e * limits.speed_max_m_s / speed
    altitude, climb = _climbed(motion.altitude_m, motion.climb_m_s, target, limits, h)
    yaw_rad = _turned(motion.yaw_rad, target, h)
    return Motion(north, east, v_n, v_e, a_n, a_e, altitude, climb, yaw_rad, motion.inner)


def _step_remembering(motion: Motion, inner: Inner, target: Target, limits: schema.Autopilot, h: float) -> Motion:
    """A step of a response with internal state: the acceleration wanted in mid-step is held throughout the step."""
    north, east, v_n, v_e, a_n, a_e, *_ = motion
    half, gain = 0.5 * h, target.velocity_gain_1_s
    w_n, w_e = target.acceleration_north_m_s2, target.acceleration_east_m_s2
    if gain:
        grown = target.growth * half
        w_n, w_e = (
            w_n + gain * (target.velocity_north_m_s + grown * w_n - v_n - half * a_n),
            w_e + gain * (target.velocity_east_m_s + grown * w_e - v_e - half * a_e),
        )
    inner, (a_n, a_e), (mean_n, mean_e) = followed(inner, (w_n, w_e), (a_n, a_e), limits, h)
    after_n, after_e = v_n + h * mean_n, v_e + h * mean_e
    north, east = north + half * (v_n + after_n), east + half * (v_e + after_e)
    moved = _after(motion, (north, east, after_n, after_e, a_n, a_e), target, limits, h)
    return moved._replace(inner=inner)


def _jerk(
    v_n: float, v_e: float, a_n: float, a_e: float, target: Target, limits: schema.Autopilot, since_s: float
) -> tuple[float, float]:
    gain, grown = target.velocity_gain_1_s, target.growth * since_s
    w_n, w_e = target.acceleration_north_m_s2, target.acceleration_east_m_s2
    if gain:
        w_n, w_e = (
            w_n + gain * (target.velocity_north_m_s + grown * w_n - v_n),
            w_e + gain * (target.velocity_east_m_s + grown * w_e - v_e),
        )
    size = math.hypot(w_n, w_e)
    if size > limits.acceleration_max_m_s2:
        w_n, w_e = w_n * limits.acceleration_max_m_s2 / size, w_e * limits.acceleration_max_m_s2 / size
    return (w_n - a_n) / limits.lag_s, (w_e - a_e) / limits.lag_s


def _climbed(altitude: float, climb: float, target: Target, limits: schema.Autopilot, h: float) -> tuple[float, float]:
    """Altitude and climb rate a step later: exact for the climb rate commanded at the start of the step."""
    wanted = target.climb_m_s
    if target.altitude_m is not None:
        wanted = CLIMB_GAIN_1_S * (target.altitude_m - altitude)
    wanted = max(-limits.climb_max_m_s, min(limits.climb_max_m_s, wanted))
    left = math.exp(-h / CLIMB_LAG_S)
    return altitude + wanted * h + (climb - wanted) * CLIMB_LAG_S * (1.0 - left), wanted + (climb - wanted) * left


def _turned(yaw_rad: float, target: Target, h: float) -> float:
    """The yaw a step later, from -pi to pi; it turns the shorter way."""
    turn = target.yaw_rate_rad_s * h
    if target.yaw_rad is not None:
        turn = math.remainder(target.yaw_rad - yaw_rad, math.tau)
    largest = YAW_RATE_MAX_RAD_S * h
    return math.remainder(yaw_rad + max(-largest, min(largest, turn)), math.tau)
