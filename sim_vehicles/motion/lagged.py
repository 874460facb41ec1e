"""Response of a multicopter's acceleration to the one its velocity loop wants: limits, dead time, lag or second order.

    lag                 lag a'(t) = w(t) - a(t)
    lag with dead time  lag a'(t) = w(t - T) - a(t)
    second order        a'' / omega_n^2 + lag a' = w - a

on each axis, in vectors that are complex numbers, north + j east. |w| is clipped to the acceleration limit, then the
rate of w to the jerk limit. Within a step w is held at its mean. The plain lag without a jerk limit is in
`sim_vehicles.motion.copter`.
"""

import math
from typing import NamedTuple

from scenarios import schema

_Line = tuple[tuple[float, complex], ...]


class Inner(NamedTuple):
    """Internal state of a response besides velocity and acceleration."""

    aimed_m_s2: complex = 0j
    """The acceleration aimed at, within the limits."""
    jerk_m_s3: complex = 0j
    """a' of a second-order response."""
    line: _Line = ()
    """Delay line: the accelerations aimed at in the last dead time, oldest first, with their durations in s."""


def inner_of(settings: schema.Autopilot) -> Inner | None:
    """The internal state of a response at rest; None for a plain lag without a jerk limit."""
    if not (settings.dead_time_s or settings.natural_frequency_rad_s or settings.jerk_max_m_s3):
        return None
    return Inner(line=((settings.dead_time_s, 0j),) if settings.dead_time_s else ())


def longest_step_s(settings: schema.Autopilot, usual_s: float) -> float:
    """The longest integration step: an acceleration that is aimed at in a step must not act within that step."""
    fastest_s = math.inf if settings.natural_frequency_rad_s is None else 0.3 / settings.natural_frequency_rad_s
    return max(min(usual_s, settings.dead_time_s or usual_s, fastest_s, settings.lag_s), 1e-3)


def followed(
    inner: Inner, wanted_m_s2: complex, acceleration_m_s2: complex, settings: schema.Autopilot, h: float
) -> tuple[Inner, complex, complex]:
    """Internal state and acceleration after a step, and the mean acceleration during it."""
    aimed = wanted_m_s2
    over = length(aimed) / settings.acceleration_max_m_s2
    if over > 1.0:
        aimed /= over
    if settings.jerk_max_m_s3 is not None:
        change = aimed - inner.aimed_m_s2
        far = length(change) / (settings.jerk_max_m_s3 * h)
        if far > 1.0:
            aimed = inner.aimed_m_s2 + change / far
    line, acting = inner.line, aimed
    if line:
        line, acting = _shifted((*line, (h, aimed)), h)
    a, jerk = acceleration_m_s2, inner.jerk_m_s3
    if settings.natural_frequency_rad_s is None:
        left = math.exp(-h / settings.lag_s)
        gone = settings.lag_s * (1.0 - left) / h
        after, mean = acting + (a - acting) * left, acting + (a - acting) * gone
    else:
        after, jerk, mean = _second_order(a, jerk, acting, settings, h)
    return Inner(aimed, jerk, line), after, mean


def _second_order(
    a: complex, jerk: complex, to: complex, settings: schema.Autopilot, h: float
) -> tuple[complex, complex, complex]:
    """a, a' and the mean of a after a step, for a constant input: RK4, whose error at 0.3 rad a step is 2e-5."""
    square = (settings.natural_frequency_rad_s or 0.0) ** 2

    def curve(a: complex, jerk: complex) -> complex:
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


def _shifted(line: _Line, h: float) -> tuple[_Line, complex]:
    """The delay line without its oldest `h` seconds, and the mean acceleration over those."""
    gained, left_s = 0j, h
    for first, (duration_s, one) in enumerate(line):
        taken_s = min(duration_s, left_s)
        gained += taken_s * one
        left_s -= taken_s
        if duration_s > taken_s + 1e-12:
            return ((duration_s - taken_s, one), *line[first + 1 :]), gained / h
    return (), gained / h


def length(vector: complex) -> float:
    """The length of a vector; that of `abs` depends on the C library."""
    return math.hypot(vector.real, vector.imag)
