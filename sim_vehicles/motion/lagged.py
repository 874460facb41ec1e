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

import numpy as np
from numpy.typing import NDArray

from scenarios import schema
from scenarios.hypot import hypot
from scenarios.kernel import kernel

Line = NDArray[np.complex128]
"""Delay line (n, 2): accelerations, oldest first, each behind its duration in s."""


class Limits(NamedTuple):
    """What the motion depends on besides the target: see `scenarios.keys.autopilot`. An omitted limit is infinite."""

    lag_s: float
    acceleration_max_m_s2: float
    speed_max_m_s: float
    climb_max_m_s: float
    drag_1_m: float
    jerk_max_m_s3: float
    stiffness_1_s2: float
    """The square of the natural frequency; 0 for a response of first order."""


class Inner(NamedTuple):
    """Internal state of a response besides velocity and acceleration."""

    line: Line
    """The accelerations aimed at in the last dead time."""
    aimed_m_s2: complex = 0j
    """The acceleration aimed at, within the limits."""
    jerk_m_s3: complex = 0j
    """a' of a second-order response."""


def limits_of(settings: schema.Autopilot) -> Limits:
    own, stiffness_1_s2 = settings, (settings.natural_frequency_rad_s or 0.0) ** 2
    return Limits(
        own.lag_s, own.acceleration_max_m_s2, own.speed_max_m_s, own.climb_max_m_s, own.drag_1_m,
        own.jerk_max_m_s3 or math.inf, stiffness_1_s2,
    )  # fmt: skip


def inner_of(settings: schema.Autopilot) -> Inner | None:
    """The internal state of a response at rest; None for a plain lag without a jerk limit."""
    if not (settings.dead_time_s or settings.natural_frequency_rad_s or settings.jerk_max_m_s3):
        return None
    return Inner(np.array([[settings.dead_time_s, 0j]] if settings.dead_time_s else np.empty((0, 2)), np.complex128))


def longest_step_s(settings: schema.Autopilot, usual_s: float) -> float:
    """The longest integration step: an acceleration that is aimed at in a step must not act within that step."""
    fastest_s = math.inf if settings.natural_frequency_rad_s is None else 0.3 / settings.natural_frequency_rad_s
    return max(min(usual_s, settings.dead_time_s or usual_s, fastest_s, settings.lag_s), 1e-3)


@kernel
def aimed_at(wanted_m_s2: complex, before_m_s2: complex, limits: Limits, h: float) -> complex:
    """The wanted acceleration, within the limits of acceleration and of jerk since `before_m_s2`, a step earlier."""
    aimed = wanted_m_s2
    over = length(aimed) / limits.acceleration_max_m_s2
    if over > 1.0:
        aimed /= over
    change = aimed - before_m_s2
    far = length(change) / (limits.jerk_max_m_s3 * h)
    return before_m_s2 + change / far if far > 1.0 else aimed


@kernel
def followed(a: complex, jerk: complex, to: complex, limits: Limits, h: float) -> tuple[complex, complex, complex]:
    """a, a' and the mean of a after a step, for a constant input: by RK4, whose error at 0.3 rad a step is 2e-5."""
    square = limits.stiffness_1_s2
    if square == 0.0:
        left = math.exp(-h / limits.lag_s)
        gone = limits.lag_s * (1.0 - left) / h
        return to + (a - to) * left, jerk, to + (a - to) * gone
    half, lag_s = 0.5 * h, limits.lag_s
    c1 = square * (to - a - lag_s * jerk)
    a2, j2 = a + half * jerk, jerk + half * c1
    c2 = square * (to - a2 - lag_s * j2)
    a3, j3 = a + half * j2, jerk + half * c2
    c3 = square * (to - a3 - lag_s * j3)
    a4, j4 = a + h * j3, jerk + h * c3
    c4 = square * (to - a4 - lag_s * j4)
    after = a + h / 6.0 * (jerk + 2.0 * (j2 + j3) + j4)
    return after, jerk + h / 6.0 * (c1 + 2.0 * (c2 + c3) + c4), (a + 2.0 * (a2 + a3) + a4) / 6.0


@kernel
def shifted(line: Line, first: int, end: int, h: float) -> tuple[int, complex]:
    """Take the oldest `h` seconds from the delay line in these rows; returns its new first row, and the mean taken."""
    gained, left_s = 0j, h
    for row in range(first, end):
        duration_s = line[row, 0].real
        taken_s = min(duration_s, left_s)
        gained += taken_s * line[row, 1]
        left_s -= taken_s
        if duration_s > taken_s + 1e-12:
            line[row, 0] = duration_s - taken_s
            return row, gained / h
    return end, gained / h


@kernel
def length(vector: complex) -> float:
    """The length of a vector; `abs` would depend on the C library."""
    return hypot(vector.real, vector.imag)
