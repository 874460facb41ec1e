"""Motion of a multicopter: its acceleration follows the commanded one with a lag, within limits.

    w = a_set + g (v_set - v),  |w| clipped to the limit;   lag a' = w - a,   v' = a,   p' = v

on each axis, north and east; g = 0 if the set-point has no velocity. The air decelerates it by drag |v| v. Between
set-points v_set integrates a_set if the autopilot does so. The climb rate follows its command with a lag of its own.
RK4 integrates in steps of at most 10 ms. Vectors in the plane are complex numbers, north + j east.
"""

import math
from typing import NamedTuple

from scenarios import schema
from sim_vehicles.motion.lagged import Inner, followed, length, longest_step_s

LONGEST_STEP_S = 0.01
CLIMB_LAG_S = 0.3
CLIMB_GAIN_1_S = 0.8
"""Gain from remaining height to climb rate in a take-off."""
PLACE_GAIN_1_S = 0.3
"""Gain from remaining distance to speed in a flight to a place."""
YAW_RATE_MAX_RAD_S = 1.5


class Motion(NamedTuple):
    """Position, velocity and acceleration; the altitude is above the initial ground."""

    place_m: complex
    velocity_m_s: complex = 0j
    acceleration_m_s2: complex = 0j
    altitude_m: float = 0.0
    climb_m_s: float = 0.0
    yaw_rad: float = 0.0
    inner: Inner | None = None
    """Internal state of its response; None for a plain lag without a jerk limit."""


class Target(NamedTuple):
    """The target that the autopilot steers to. Its velocity integrates `growth` times its acceleration."""

    acceleration_m_s2: complex = 0j
    velocity_m_s: complex = 0j
    velocity_gain_1_s: float = 0.0
    growth: float = 0.0
    climb_m_s: float = 0.0
    altitude_m: float | None = None
    """Climb or sink to this altitude."""
    yaw_rad: float | None = None
    yaw_rate_rad_s: float = 0.0
    """Turn to `yaw_rad`; without one, turn at this rate."""
    place_m: complex | None = None
    """Fly to this place; the velocity follows from the remaining distance."""


def advance(motion: Motion, target: Target, limits: schema.Autopilot, duration_s: float) -> tuple[Motion, Target]:
    """The motion and the target after `duration_s`; the target's velocity changes by then."""
    longest_s = LONGEST_STEP_S if motion.inner is None else longest_step_s(limits, LONGEST_STEP_S)
    steps = max(1, math.ceil(duration_s / longest_s))
    h = duration_s / steps
    for _ in range(steps):
        if target.place_m is not None:  # the velocity that leads to the place
            way_m = target.place_m - motion.place_m
            gain = min(PLACE_GAIN_1_S, limits.speed_max_m_s / max(length(way_m), 1e-9))
            target = target._replace(velocity_m_s=gain * way_m)
        motion = _step(motion, target, limits, h)
        target = target._replace(velocity_m_s=target.velocity_m_s + target.growth * h * target.acceleration_m_s2)
    return motion, target


def pushed(
    motion: Motion, target: Target, limits: schema.Autopilot, piece: tuple[float, float, float, float, float]
) -> tuple[Motion, Target]:
    """As `advance`, over an interval of constant push, a `Piece` of `air`."""
    t, half_m_s, carried_m = piece[0], complex(*piece[1:3]), complex(*piece[3:])
    motion, target = advance(motion._replace(velocity_m_s=motion.velocity_m_s + half_m_s), target, limits, t)
    place_m, velocity_m_s = motion.place_m + carried_m, motion.velocity_m_s + half_m_s
    return motion._replace(place_m=place_m, velocity_m_s=velocity_m_s), target


def _step(motion: Motion, target: Target, limits: schema.Autopilot, h: float) -> Motion:
    if motion.inner is not None:
        return _step_remembering(motion, motion.inner, target, limits, h)
    place, v, a, half = motion.place_m, motion.velocity_m_s, motion.acceleration_m_s2, 0.5 * h
    # v' = a and lag a' = w - a; the position is the integral of the velocity
    j1 = _jerk(v, a, target, limits, 0.0)
    a2, v2 = a + half * j1, v + half * a
    j2 = _jerk(v2, a2, target, limits, half)
    a3, v3 = a + half * j2, v + half * a2
    j3 = _jerk(v3, a3, target, limits, half)
    a4, v4 = a + h * j3, v + h * a3
    j4 = _jerk(v4, a4, target, limits, h)
    sixth = h / 6.0
    place += sixth * (v + 2.0 * (v2 + v3) + v4)
    v += sixth * (a + 2.0 * (a2 + a3) + a4)
    a += sixth * (j1 + 2.0 * (j2 + j3) + j4)
    return _after(motion, place, v, a, target, limits, h)


def _after(
    motion: Motion, place: complex, v: complex, a: complex, target: Target, limits: schema.Autopilot, h: float
) -> Motion:
    """The motion after a step, its speed reduced by drag and limited, with the new altitude and yaw."""
    speed = length(v)
    if limits.drag_1_m:  # speed' = -drag speed^2
        left = 1.0 / (1.0 + limits.drag_1_m * speed * h)
        v, speed = left * v, left * speed
    if speed > limits.speed_max_m_s:
        v = v * limits.speed_max_m_s / speed
    altitude, climb = _climbed(motion.altitude_m, motion.climb_m_s, target, limits, h)
    return Motion(place, v, a, altitude, climb, _turned(motion.yaw_rad, target, h), motion.inner)


def _step_remembering(motion: Motion, inner: Inner, target: Target, limits: schema.Autopilot, h: float) -> Motion:
    """A step of a response with internal state: the acceleration wanted in mid-step is held throughout the step."""
    v, a, half = motion.velocity_m_s, motion.acceleration_m_s2, 0.5 * h
    inner, a, mean = followed(inner, _wanted(v, target, half, half * a), a, limits, h)
    after = v + h * mean
    return _after(motion, motion.place_m + half * (v + after), after, a, target, limits, h)._replace(inner=inner)


def _wanted(v: complex, target: Target, since_s: float, gained: complex = 0j) -> complex:
    """The acceleration wanted, before any limit, `since_s` into a step in which the velocity has `gained` on v."""
    w = target.acceleration_m_s2
    if target.velocity_gain_1_s:
        w += target.velocity_gain_1_s * (target.velocity_m_s + target.growth * since_s * w - v - gained)
    return w


def _jerk(v: complex, a: complex, target: Target, limits: schema.Autopilot, since_s: float) -> complex:
    w = _wanted(v, target, since_s)
    size = length(w)
    if size > limits.acceleration_max_m_s2:
        w = w * limits.acceleration_max_m_s2 / size
    return (w - a) / limits.lag_s


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


def pair(vector: complex) -> tuple[float, float]:
    """North and east of a vector."""
    return vector.real, vector.imag
