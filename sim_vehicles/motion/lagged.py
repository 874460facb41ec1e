"""Response of a multicopter's acceleration to the one its velocity loop wants: limits, dead time, lag or second order.

    lag                 lag a'(t) = w(t) - a(t)
    lag with dead time  lag a'(t) = w(t - T) - a(t)
    second order        a'' / omega_n^2 + lag a' = w - a

on each axis, north and east. |w| is clipped to the acceleration limit, then the rate of w to the jerk limit. Within a
step w is held at its mean. The plain lag without a jerk limit is in `sim_vehicles.motion.copter`.
"""

import math
from typing import NamedTuple

from scenarios import schema

Vector = tuple[float, float]
_Line = tuple[tuple[float, float, float], ...]


class Inner(NamedTuple):
    """Internal state of a response besides velocity and acceleration."""

    aimed_m_s2: Vector = (0.0, 0.0)
    """The acceleration aimed at, within the limits."""
    jerk_m_s3: Vector = (0.0, 0.0)
    """a' of a second-order response."""
    line: _Line = ()
    """Delay line: the accelerations aimed at in the last dead time, oldest first, as (duration in s, north, east)."""


def inner_of(settings: schema.Autopilot) -> Inner | None:
    """The internal state of a response at rest; None for a plain lag without a jerk limit."""
    if not (settings.dead_time_s or settings.natural_frequency_rad_s or settings.jerk_max_m_s3):
        return None
    return Inner(line=((settings.dead_time_s, 0.0, 0.0),) if settings.dead_time_s else ())


def longest_step_s(settings: schema.Autopilot, usual_s: float) -> float:
    """The longest integration step: an acceleration that is aimed at in a step must not act within that step."""
    fastest_s = math.inf if settings.natural_frequency_rad_s is None else 0.3 / settings.natural_frequency_rad_s
    return max(min(usual_s, settings.dead_time_s or usual_s, fastest_s, settings.lag_s), 1e-3)


def followed(
    inner: Inner, wanted_m_s2: Vector, acceleration_m_s2: Vector, settings: schema.Autopilot, h: float
) -> tuple[Inner, Vector, Vector]:
    """Internal state and acceleration after a step, and the mean acceleration during it."""
    north, east = wanted_m_s2
    over = math.hypot(north, east) / settings.acceleration_max_m_s2
    if over > 1.0:
        north, east = north / over, east / over
    was_north, was_east = inner.aimed_m_s2
    if settings.jerk_max_m_s3 is not None:
        far = math.hypot(north - was_north, east - was_east) / (settings.jerk_max_m_s3 * h)
        if far > 1.0:
            north, east = was_north + (north - was_north) / far, was_east + (east - was_east) / far
    line, acting = inner.line, (north, east)
    if line:
        line, acting = _shifted((*line, (h, north, east)), h)
    a, jerk, mean = acceleration_m_s2, inner.jerk_m_s3, (0.0, 0.0)
    if settings.natural_frequency_rad_s is None:
        left = math.exp(-h / settings.lag_s)
        gone = settings.lag_s * (1.0 - left) / h
        after = acting[0] + (a[0] - acting[0]) * left, acting[1] + (a[1] - acting[1]) * left
        mean = acting[0] + (a[0] - acting[0]) * gone, acting[1] + (a[1] - acting[1]) * gone
    else:
        axes = [_second_order(x, j, to, settings, h) for x, j, to in zip(a, jerk, acting, strict=True)]
        (north_a, north_j, north_mean), (east_a, east_j, east_mean) = axes
        after, jerk, mean = (north_a, east_a), (north_j, east_j), (north_mean, east_mean)
    return Inner((north, east), jerk, line), after, mean


def _second_order(a: float, jerk: float, to: float, settings: schema.Autopilot, h: float) -> tuple[float, float, float]:
    """a, a' and the mean of a after a step, for a constant input: RK4, whose error at 0.3 rad a step is 2e-5."""
    square = (settings.natural_frequency_rad_s or 0.0) ** 2

    def curve(a: float, jerk: float) -> float:
        return square * (to - a - settings.lag_s * jerk)

    half = 0.5 * h
    c1 = curve(a, jerk)
    a2, j2 = a + half * jerk, jerk + half * c1
    c2 = curve(a2, j2)
    a3, j3 = a + half * j2, jerk + half * c2
    c3 = curve(a3, j3)
    a4, j4 = a + h * j3, jerk + h * c3
    c4 = curve(a4, j4)
    after = a + h / 6.0 * (jerk + 2.0 * (j2 + j3) + j4)
    return after, jerk + h / 6.0 * (c1 + 2.0 * (c2 + c3) + c4), (a + 2.0 * (a2 + a3) + a4) / 6.0


def _shifted(line: _Line, h: float) -> tuple[_Line, Vector]:
    """The delay line without its oldest `h` seconds, and the mean acceleration over those."""
    north = east = 0.0
    left_s, first = h, 0
    while first < len(line):
        duration_s, one_north, one_east = line[first]
        taken_s = min(duration_s, left_s)
        north += taken_s * one_north
        east += taken_s * one_east
        left_s -= taken_s
        if duration_s > taken_s + 1e-12:
            rest = ((duration_s - taken_s, one_north, one_east), *line[first + 1 :])
            return rest, (north / h, east / h)
        first += 1
    return (), (north / h, east / h)
