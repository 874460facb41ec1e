"""Smooth courses: the nominal velocity as a function of time, from steps or waypoints and bounds on their changes.

Every change follows s(x) = 10 x³ - 15 x⁴ + 6 x⁵ from 0 to 1, x being the fraction of its duration. s' and s'' are zero
at both ends, so accelerations begin and end without a step.
"""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from math import atan2, cos, dist, hypot, remainder, sin, sqrt, tau
from typing import NamedTuple

Vector = tuple[float, float]
_SAMPLES = 400
"""Points of a change at which its acceleration and jerk are evaluated to find the largest."""
_SPARE = 1.0001
"""Factor on the duration of a change: between these points values exceed the largest by less than 1 in 10 000."""


def smooth_step(x: float) -> tuple[float, float, float]:
    """s(x) and its first two derivatives; 0 before x = 0, and 1 after x = 1.

    >>> smooth_step(0.5), smooth_step(1.5)
    ((0.5, 1.875, 0.0), (1.0, 0.0, 0.0))
    """
    if x <= 0.0 or x >= 1.0:
        return float(x >= 1.0), 0.0, 0.0
    rest = 1.0 - x
    return x**3 * (10.0 - 15.0 * x + 6.0 * x * x), 30.0 * (x * rest) ** 2, 60.0 * x * rest * (1.0 - 2.0 * x)


class Heading(NamedTuple):
    """The nominal velocity at one time in polar form, with derivatives. The heading is clockwise from north."""

    speed_m_s: float
    speed_rate_m_s2: float
    heading_rad: float
    turn_rate_rad_s: float
    turn_acceleration_rad_s2: float

    @property
    def velocity_ne_m_s(self) -> Vector:
        return self.speed_m_s * cos(self.heading_rad), self.speed_m_s * sin(self.heading_rad)

    @property
    def acceleration_ne_m_s2(self) -> Vector:
        """The derivative of the velocity."""
        along, across = self.speed_rate_m_s2, self.speed_m_s * self.turn_rate_rad_s
        north, east = cos(self.heading_rad), sin(self.heading_rad)
        return along * north - across * east, along * east + across * north


class Change(NamedTuple):
    """One change of the nominal velocity."""

    from_s: float
    duration_s: float
    before: Heading
    turn_rad: float
    gain_m_s: float

    @property
    def until_s(self) -> float:
        return self.from_s + self.duration_s

    def at(self, time_s: float) -> Heading:
        """The nominal velocity at a time from `from_s` on; constant after the change."""
        whole_s = self.duration_s or 1.0
        s, ds, dds = smooth_step((time_s - self.from_s) / whole_s) if self.duration_s else (1.0, 0.0, 0.0)
        return Heading(
            self.before.speed_m_s + s * self.gain_m_s,
            ds * self.gain_m_s / whole_s,
            self.before.heading_rad + s * self.turn_rad,
            ds * self.turn_rad / whole_s,
            dds * self.turn_rad / whole_s**2,
        )

    def largest(self) -> tuple[float, float]:
        """The largest acceleration (m/s²) and jerk (m/s³) of the change, whose duration must not be zero."""
        most_m_s2 = most_m_s3 = 0.0
        for k in range(_SAMPLES + 1):
            x = k / _SAMPLES
            _, _, dds = smooth_step(x)
            at = self.at(self.from_s + x * self.duration_s)
            speed, rate, turn = at.speed_m_s, at.speed_rate_m_s2, at.turn_rate_rad_s
            most_m_s2 = max(most_m_s2, hypot(rate, speed * turn))
            along = dds * self.gain_m_s / self.duration_s**2 - speed * turn**2
            most_m_s3 = max(most_m_s3, hypot(along, 2.0 * rate * turn + speed * at.turn_acceleration_rad_s2))
        return most_m_s2, most_m_s3


class SmoothCourse:
    """The nominal velocity over time, its changes in order."""

    def __init__(self, start: Heading, changes: Sequence[Change], *, end_s: float | None = None) -> None:
        self.changes = tuple(changes)
        self.end_s = end_s if end_s is not None else max((change.until_s for change in changes), default=0.0)
        """When the last waypoint is reached, or the last change is over."""
        self._start = start
        self._from_s = [change.from_s for change in changes]

    def at(self, time_s: float) -> Heading:
        """The nominal velocity at a scenario time; before time zero it is that at zero."""
        k = bisect_right(self._from_s, time_s) - 1
        return self._start if k < 0 else self.changes[k].at(time_s)


class Bounds(NamedTuple):
    """Bounds on changes of the nominal velocity; None is no bound."""

    acceleration_m_s2: float
    jerk_m_s3: float | None = None


class TooShortError(ValueError):
    """A leg of waypoints is too short for the turns at its ends; `leg` counts from 0."""

    def __init__(self, leg: int, length_m: float, needed_m: float) -> None:
        super().__init__(f"leg {leg + 1} of {length_m:.1f} m, whose turns need {needed_m:.1f} m")
        self.leg = leg


def change_of(before: Heading, after_ne_m_s: Vector, from_s: float, bounds: Bounds) -> Change:
    """The shortest change to another velocity that keeps the bounds, turning the shorter way.

    Over a duration T, every acceleration is proportional to 1 / T and every jerk to 1 / T².
    """
    heading_rad = atan2(after_ne_m_s[1], after_ne_m_s[0])
    turn_rad = remainder(heading_rad - before.heading_rad, tau)
    change = Change(from_s, 1.0, before, turn_rad, hypot(*after_ne_m_s) - before.speed_m_s)
    acceleration_m_s2, jerk_m_s3 = change.largest()
    duration_s = acceleration_m_s2 / bounds.acceleration_m_s2
    if bounds.jerk_m_s3 is not None:
        duration_s = max(duration_s, sqrt(jerk_m_s3 / bounds.jerk_m_s3))
    return change._replace(duration_s=_SPARE * duration_s)


def heading_of(velocity_ne_m_s: Vector) -> Heading:
    """A constant velocity."""
    north, east = velocity_ne_m_s
    return Heading(hypot(north, east), 0.0, atan2(east, north), 0.0, 0.0)


def tangent_m(turn: Change) -> float:
    """Distance from a waypoint to the start, and to the end, of a turn at constant speed.

    The turn is symmetric, so its chord halves the angle: tangent = chord / (2 cos(turn / 2)). The chord is the integral
    of V cos(heading - middle heading), here by Simpson's rule.
    """
    n = 200
    weights = [1.0 if k in (0, n) else 4.0 if k % 2 else 2.0 for k in range(n + 1)]
    along = [cos(turn.turn_rad * (smooth_step(k / n)[0] - 0.5)) for k in range(n + 1)]
    mean = sum(w * a for w, a in zip(weights, along, strict=True)) / (3.0 * n)
    chord_m = turn.before.speed_m_s * turn.duration_s * mean
    half = cos(turn.turn_rad / 2.0)
    return chord_m / (2.0 * half) if half > 1e-9 else float("inf")


@lru_cache(maxsize=64)
def course_by_steps(bounds: Bounds, steps: tuple[tuple[float, Vector], ...]) -> SmoothCourse:
    """The course through velocities, each with the time at which the change to it begins."""
    start = before = heading_of(steps[0][1])
    changes: list[Change] = []
    for from_s, velocity in steps[1:]:
        changes.append(change_of(before, velocity, from_s, bounds))
        before = changes[-1].at(changes[-1].until_s)
    return SmoothCourse(start, changes)


@lru_cache(maxsize=64)
def course_by_waypoints(bounds: Bounds, points: tuple[Vector, ...], speed_m_s: float) -> SmoothCourse:
    """The course along waypoints at one speed; raises TooShortError if a leg is too short for its turns."""
    headings = [heading_of(velocity) for velocity in _velocities(points, speed_m_s)]
    lengths_m = [dist(a, b) for a, b in pairwise(points)]
    turns = [change_of(a, b.velocity_ne_m_s, 0.0, bounds) for a, b in pairwise(headings)]
    used_m = [0.0, *(tangent_m(turn) for turn in turns), 0.0]
    changes: list[Change] = []
    time_s, before = 0.0, headings[0]
    for leg, length_m in enumerate(lengths_m):
        needed_m = used_m[leg] + used_m[leg + 1]
        if needed_m > length_m:
            raise TooShortError(leg, length_m, needed_m)
        time_s += (length_m - needed_m) / speed_m_s
        if leg < len(turns):
            changes.append(turns[leg]._replace(from_s=time_s, before=before))
            time_s = changes[-1].until_s
            before = changes[-1].at(time_s)
    return SmoothCourse(headings[0], changes, end_s=time_s)


def _velocities(points: Sequence[Vector], speed_m_s: float) -> Iterator[Vector]:
    for a, b in pairwise(points):
        length_m = dist(a, b)
        yield (b[0] - a[0]) * speed_m_s / length_m, (b[1] - a[1]) * speed_m_s / length_m
