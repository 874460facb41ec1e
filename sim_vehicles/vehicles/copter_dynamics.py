"""How a multicopter moves: its acceleration follows the commanded one with a lag, within limits.

    w = a_set + g (v_set - v),  |w| clipped to the limit;   lag a' = w - a,   v' = a,   p' = v

for north and east; g = 0 if no velocity is set. Between set-points v_set integrates a_set if the autopilot does so. The
climb rate follows its command with a lag of its own. RK4 integrates in steps of at most 10 ms.
"""

import math
from typing import NamedTuple

from scenarios import schema

LONGEST_STEP_S = 0.01
CLIMB_LAG_S = 0.3
CLIMB_GAIN_1_S = 0.8
"""Climb rate per remaining height of a take-off."""
PLACE_GAIN_1_S = 0.3
"""Speed per remaining distance of a flight to a place."""
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


class Target(NamedTuple):
    """What the autopilot steers to. The velocity target integrates `growth` times the acceleration."""

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
    """The motion after `duration_s`, and the target with its velocity by then."""
    steps = max(1, math.ceil(duration_s / LONGEST_STEP_S))
    h = duration_s / steps
    for _ in range(steps):
        if target.place_ne_m is not None:
            target = _towards(motion, target, target.place_ne_m, limits.speed_max_m_s)
        motion = _step(motion, target, limits, h)
        grown = target.growth * h
        target = target._replace(
            velocity_north_m_s=target.velocity_north_m_s + grown * target.acceleration_north_m_s2,
            velocity_east_m_s=target.velocity_east_m_s + grown * target.acceleration_east_m_s2,
        )
    return motion, target


def _step(motion: Motion, target: Target, limits: schema.Autopilot, h: float) -> Motion:
    """A Runge-Kutta step. Position, velocity and acceleration are complex numbers: north + 1j east."""
    p, v, a = (complex(*motion[k : k + 2]) for k in (0, 2, 4))
    half, sixth = 0.5 * h, h / 6.0
    j1 = _jerk(v, a, target, limits, 0.0)
    a2, v2 = a + half * j1, v + half * a
    j2 = _jerk(v2, a2, target, limits, half)
    a3, v3 = a + half * j2, v + half * a2
    j3 = _jerk(v3, a3, target, limits, half)
    a4, v4 = a + h * j3, v + h * a3
    j4 = _jerk(v4, a4, target, limits, h)
    p += sixth * (v + 2.0 * (v2 + v3) + v4)
    v += sixth * (a + 2.0 * (a2 + a3) + a4)
    a += sixth * (j1 + 2.0 * (j2 + j3) + j4)
    v = _shortened(v, limits.speed_max_m_s)
    altitude, climb = _climbed(motion.altitude_m, motion.climb_m_s, target, limits, h)
    yaw = _turned(motion.yaw_rad, target, h)
    return Motion(p.real, p.imag, v.real, v.imag, a.real, a.imag, altitude, climb, yaw)


def _jerk(v: complex, a: complex, target: Target, limits: schema.Autopilot, since_s: float) -> complex:
    """a' = (w - a) / lag, `since_s` after the velocity target was set."""
    w = complex(target.acceleration_north_m_s2, target.acceleration_east_m_s2)
    if target.velocity_gain_1_s:
        v_set = complex(target.velocity_north_m_s, target.velocity_east_m_s) + target.growth * since_s * w
        w += target.velocity_gain_1_s * (v_set - v)
    return (_shortened(w, limits.acceleration_max_m_s2) - a) / limits.lag_s


def _shortened(vector: complex, longest: float) -> complex:
    size = math.hypot(vector.real, vector.imag)
    return vector * longest / size if size > longest else vector


def _climbed(altitude: float, climb: float, target: Target, limits: schema.Autopilot, h: float) -> tuple[float, float]:
    """Altitude and climb rate a step later: exact for the climb rate commanded at the start of the step."""
    wanted = target.climb_m_s
    if target.altitude_m is not None:
        wanted = CLIMB_GAIN_1_S * (target.altitude_m - altitude)
    wanted = max(-limits.climb_max_m_s, min(limits.climb_max_m_s, wanted))
    left = math.exp(-h / CLIMB_LAG_S)
    return altitude + wanted * h + (climb - wanted) * CLIMB_LAG_S * (1.0 - left), wanted + (climb - wanted) * left


def _towards(motion: Motion, target: Target, place_ne_m: tuple[float, float], speed_max_m_s: float) -> Target:
    """The target, with the velocity that leads to a place."""
    north, east = place_ne_m[0] - motion.north_m, place_ne_m[1] - motion.east_m
    gain = min(PLACE_GAIN_1_S, speed_max_m_s / max(math.hypot(north, east), 1e-9))
    return target._replace(velocity_north_m_s=gain * north, velocity_east_m_s=gain * east)


def _turned(yaw_rad: float, target: Target, h: float) -> float:
    """The yaw a step later, from -pi to pi; it turns the shorter way."""
    turn = target.yaw_rate_rad_s * h
    if target.yaw_rad is not None:
        turn = math.remainder(target.yaw_rad - yaw_rad, math.tau)
    largest = YAW_RATE_MAX_RAD_S * h
    return math.remainder(yaw_rad + max(-largest, min(largest, turn)), math.tau)
