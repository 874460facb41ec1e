"""Motion of a multicopter: its acceleration follows the commanded one with a lag, within limits.

    w = a_set + g (v_set - v),  |w| clipped to the limit;   lag a' = w - a,   v' = a,   p' = v

on each axis, north and east; g = 0 if the set-point has no velocity. The air decelerates it by drag |v| v. Between
set-points v_set integrates a_set if the autopilot does so. The climb rate follows its command with a lag of its own.
RK4 integrates in steps of at most 10 ms. Vectors in the plane are complex numbers, north + j east.
"""

import math
from typing import NamedTuple

import numpy as np

from scenarios import schema
from scenarios.kernel import Record, at_row, kernel
from scenarios.schema import NS_PER_S
from sim_vehicles.motion.lagged import (
    Inner,
    Limits,
    Line,
    aimed_at,
    followed,
    length,
    limits_of,
    longest_step_s,
    shifted,
)

LONGEST_STEP_S = 0.01
CLIMB_LAG_S = 0.3
CLIMB_GAIN_1_S = 0.8
"""Gain from remaining height to climb rate in a take-off."""
PLACE_GAIN_1_S = 0.3
"""Gain from remaining distance to speed in a flight to a place."""
YAW_RATE_MAX_RAD_S = 1.5
ALTITUDE, CLIMB, YAW = 6, 7, 8
"""Indices of these in `motion` of a vehicle's record."""


class Motion(NamedTuple):
    """Position, velocity and acceleration; the altitude is above the ground where the vehicle started."""

    place_m: complex
    velocity_m_s: complex = 0j
    acceleration_m_s2: complex = 0j
    altitude_m: float = 0.0
    climb_m_s: float = 0.0
    yaw_rad: float = 0.0
    inner: Inner | None = None
    """Internal state of its response; None for a plain lag without a jerk limit, as in kernels."""


class Target(NamedTuple):
    """The target that the autopilot steers to. Its velocity integrates `growth` times its acceleration."""

    acceleration_m_s2: complex = 0j
    velocity_m_s: complex = 0j
    velocity_gain_1_s: float = 0.0
    growth: float = 0.0
    climb_m_s: float = 0.0
    altitude_m: float = math.nan
    """Climb or sink to this altitude, unless it is NaN."""
    yaw_rad: float = math.nan
    yaw_rate_rad_s: float = 0.0
    """Turn to `yaw_rad`; if that is NaN, turn at this rate."""
    place_m: complex = complex(math.nan, math.nan)
    """Fly to this place, unless it is NaN; the velocity follows from the remaining distance."""


def advance(motion: Motion, target: Target, settings: schema.Autopilot, duration_s: float) -> tuple[Motion, Target]:
    """The motion and the target after `duration_s`; the target's velocity changes by then."""
    inner, limits = motion.inner, limits_of(settings)
    if inner is None:
        return _advance(motion, target, limits, duration_s)
    steps = max(1, math.ceil(duration_s / longest_step_s(settings, LONGEST_STEP_S)))
    line, bare = np.concatenate((inner.line, np.zeros((steps, 2), np.complex128))), motion._replace(inner=None)
    before = inner.aimed_m_s2, inner.jerk_m_s3, line, len(inner.line)
    motion, target, aimed, jerk, first, end = _advance_remembering(
        bare, target, limits, duration_s / steps, steps, *before
    )
    return motion._replace(inner=Inner(line[first:end], aimed, jerk)), target


@kernel
def _advance_remembering(
    motion: Motion, target: Target, limits: Limits, h: float, steps: int, aimed: complex, jerk: complex, line: Line,
    end: int,
) -> tuple[Motion, Target, complex, complex, int, int]:  # fmt: skip
    """As `_advance`, for a response with internal state. `end` rows of `line` are in use, afterwards those returned."""
    first, half = 0, 0.5 * h
    for _ in range(steps):  # the acceleration wanted in mid-step is held throughout the step
        target = _aimed(motion, target, limits)
        v, a = motion.velocity_m_s, motion.acceleration_m_s2
        aimed = acting = aimed_at(_wanted(v, target, half, half * a), aimed, limits, h)
        if first < end:
            line[end, 0], line[end, 1] = h, aimed
            end += 1
            first, acting = shifted(line, first, end, h)
        a, jerk, mean = followed(a, jerk, acting, limits, h)
        after = v + h * mean
        motion = _after(motion, motion.place_m + half * (v + after), after, a, target, limits, h)
        target = _grown(target, h)
    return motion, target, aimed, jerk, first, end


@kernel
def _advance(motion: Motion, target: Target, limits: Limits, duration_s: float) -> tuple[Motion, Target]:
    steps = max(1, math.ceil(duration_s / LONGEST_STEP_S))
    h = duration_s / steps
    for _ in range(steps):
        target = _aimed(motion, target, limits)
        motion = _step(motion, target, limits, h)
        target = _grown(target, h)
    return motion, target


@kernel
def fly_to(vehicle: Record, time_ns: int) -> None:
    """Move a copter whose response has no internal state to a time, unless it is past; it moves only in flight."""
    if time_ns <= vehicle.state_ns:
        return
    if vehicle.flying:
        own, to, lim = vehicle.motion, vehicle.target, vehicle.limits
        motion = Motion(
            complex(own[0], own[1]),
            complex(own[2], own[3]),
            complex(own[4], own[5]),
            own[ALTITUDE],
            own[CLIMB],
            own[YAW],
            None,
        )
        target = Target(
            complex(to[0], to[1]), complex(to[2], to[3]), to[4], to[5], to[6], to[7], to[8], to[9],
            complex(to[10], to[11]),
        )  # fmt: skip
        limits = Limits(lim[0], lim[1], lim[2], lim[3], lim[4], lim[5], lim[6])
        motion, target = _advance(motion, target, limits, (time_ns - vehicle.state_ns) / NS_PER_S)
        set_motion(vehicle, motion)
        set_target(vehicle, target)
    vehicle.state_ns = time_ns


@kernel
def set_motion(vehicle: Record, motion: Motion) -> None:
    own = vehicle.motion
    own[0], own[1] = motion.place_m.real, motion.place_m.imag
    own[2], own[3] = motion.velocity_m_s.real, motion.velocity_m_s.imag
    own[4], own[5] = motion.acceleration_m_s2.real, motion.acceleration_m_s2.imag
    own[ALTITUDE], own[CLIMB], own[YAW] = motion.altitude_m, motion.climb_m_s, motion.yaw_rad


@kernel
def set_target(vehicle: Record, target: Target) -> None:
    own = vehicle.target
    own[0], own[1] = target.acceleration_m_s2.real, target.acceleration_m_s2.imag
    own[2], own[3] = target.velocity_m_s.real, target.velocity_m_s.imag
    own[4], own[5], own[6] = target.velocity_gain_1_s, target.growth, target.climb_m_s
    own[7], own[8], own[9] = target.altitude_m, target.yaw_rad, target.yaw_rate_rad_s
    own[10], own[11] = target.place_m.real, target.place_m.imag


@kernel
def is_led(vehicle: Record) -> bool:
    """Whether a copter's target is an altitude or a place: reaching it may change the mode."""
    return not (math.isnan(vehicle.target[7]) and math.isnan(vehicle.target[10]))


def pushed(
    motion: Motion, target: Target, settings: schema.Autopilot, piece: tuple[float, float, float, float, float]
) -> tuple[Motion, Target]:
    """As `advance`, over an interval of constant push, a `Piece` of `air`."""
    t, half_m_s, carried_m = piece[0], complex(*piece[1:3]), complex(*piece[3:])
    motion, target = advance(motion._replace(velocity_m_s=motion.velocity_m_s + half_m_s), target, settings, t)
    place_m, velocity_m_s = motion.place_m + carried_m, motion.velocity_m_s + half_m_s
    return motion._replace(place_m=place_m, velocity_m_s=velocity_m_s), target


@kernel
def _aimed(motion: Motion, target: Target, limits: Limits) -> Target:
    """The target with the velocity that leads to its place, if it has one."""
    if math.isnan(target.place_m.real):
        return target
    way_m = target.place_m - motion.place_m
    gain = min(PLACE_GAIN_1_S, limits.speed_max_m_s / max(length(way_m), 1e-9))
    return _with_velocity(target, gain * way_m)


@kernel
def _grown(target: Target, h: float) -> Target:
    """The target a step later."""
    return _with_velocity(target, target.velocity_m_s + target.growth * h * target.acceleration_m_s2)


@kernel
def _with_velocity(target: Target, velocity_m_s: complex) -> Target:
    return Target(
        target.acceleration_m_s2, velocity_m_s, target.velocity_gain_1_s, target.growth, target.climb_m_s,
        target.altitude_m, target.yaw_rad, target.yaw_rate_rad_s, target.place_m,
    )  # fmt: skip


@kernel
def _step(motion: Motion, target: Target, limits: Limits, h: float) -> Motion:
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


@kernel
def _after(motion: Motion, place: complex, v: complex, a: complex, target: Target, limits: Limits, h: float) -> Motion:
    """The motion after a step, its speed reduced by drag and limited, with the new altitude and yaw."""
    speed = length(v)
    if limits.drag_1_m != 0.0:  # speed' = -drag speed^2
        left = 1.0 / (1.0 + limits.drag_1_m * speed * h)
        v, speed = left * v, left * speed
    if speed > limits.speed_max_m_s:
        v = v * limits.speed_max_m_s / speed
    altitude, climb = _climbed(motion.altitude_m, motion.climb_m_s, target, limits, h)
    return Motion(place, v, a, altitude, climb, _turned(motion.yaw_rad, target, h), None)


@kernel
def _wanted(v: complex, target: Target, since_s: float, gained: complex) -> complex:
    """The acceleration wanted, before any limit, `since_s` into a step in which the velocity has `gained` on v."""
    w = target.acceleration_m_s2
    if target.velocity_gain_1_s != 0.0:
        w += target.velocity_gain_1_s * (target.velocity_m_s + target.growth * since_s * w - v - gained)
    return w


@kernel
def _jerk(v: complex, a: complex, target: Target, limits: Limits, since_s: float) -> complex:
    w = _wanted(v, target, since_s, 0j)
    size = length(w)
    if size > limits.acceleration_max_m_s2:
        w = w * limits.acceleration_max_m_s2 / size
    return (w - a) / limits.lag_s


@kernel
def _climbed(altitude: float, climb: float, target: Target, limits: Limits, h: float) -> tuple[float, float]:
    """Altitude and climb rate a step later: exact for the climb rate commanded at the start of the step."""
    wanted = target.climb_m_s
    if not math.isnan(target.altitude_m):
        wanted = CLIMB_GAIN_1_S * (target.altitude_m - altitude)
    wanted = max(-limits.climb_max_m_s, min(limits.climb_max_m_s, wanted))
    left = math.exp(-h / CLIMB_LAG_S)
    return altitude + wanted * h + (climb - wanted) * CLIMB_LAG_S * (1.0 - left), wanted + (climb - wanted) * left


@kernel
def _turned(yaw_rad: float, target: Target, h: float) -> float:
    """The yaw a step later, from -pi to pi; it turns the shorter way."""
    turn = target.yaw_rate_rad_s * h
    if not math.isnan(target.yaw_rad):
        turn = within_half_a_turn(target.yaw_rad - yaw_rad)
    largest = YAW_RATE_MAX_RAD_S * h
    return within_half_a_turn(yaw_rad + max(-largest, min(largest, turn)))


@kernel
def within_half_a_turn(angle: float) -> float:
    """`math.remainder(angle, tau)`, which Numba lacks, to the same bits except the sign of exactly half a turn."""
    over = abs(angle) % math.tau
    return math.copysign(1.0, angle) * (over if over <= math.tau - over else over - math.tau)


fly_to_at = at_row(fly_to)


def pair(vector: complex) -> tuple[float, float]:
    """North and east of a vector."""
    return vector.real, vector.imag
