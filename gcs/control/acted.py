"""Which set-points acted: those that a vehicle reports as its active target, POSITION_TARGET_LOCAL_NED.

The prediction assumes that every set-point acts, each a delivery delay after it was due. One that was lost never does:
the vehicle holds the one before. A vehicle that reports its active target says which one it holds at an instant. A
report carries the vehicle's own time, not the key of a set-point, so it is recognised by its values, float32 on both
ways: those of ArduPilot by the acceleration, as the velocity grows with it; those of PX4 by the velocity, as the
acceleration is that of its velocity loop; those of our own vehicles, which report an acceleration only, by that.

The *age* of a report is its instant minus the time at which the recognised set-point was due. If none is lost it lies
between the delivery delay and a control period more. So set-points that are older than the least age lately, and newer
than the one recognised, were lost, or are late by as much. They are replaced by the recognised one. No assumed delay
enters: a delay mismatch changes nothing.

A vehicle that reports nothing but an acceleration reports what it does. If that is none of the accelerations sent, but
a smaller one, the vehicle clips. Set-points under way are then assumed to be clipped to the same size, until it is seen
to do more.
"""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterable
from math import inf, isfinite
from typing import Any, NamedTuple, Protocol

from gcs.link.mavlink import VELOCITY_IGNORED

_SAME = 1e-6
"""Values this close, relatively, are the same: float32 resolves 6e-8."""
_AGES = 16
"""The least age is that of the last reports: with half of all set-points lost, one of them is as young as can be."""
_EARLY = 0.05
"""A set-point counts as lost from the least age on, less this share of a period: clocks err by as much."""
_VELOCITY, _ACCELERATION, _TYPE_MASK = slice(4, 6), slice(7, 9), 12
"""North and east among the fields of SET_POSITION_TARGET_LOCAL_NED and of POSITION_TARGET_LOCAL_NED."""


class Alterable(Protocol):
    """A history of set-points: `gcs.control.prediction.CommandHistory`."""

    def alter(self, due_ns: int, by_m_s2: complex) -> None: ...


class _SetPoint(NamedTuple):
    velocity: complex
    acceleration: complex


def _vector(fields: tuple[Any, ...], place: slice) -> complex:
    return complex(*fields[place])


def _same(a: complex, b: complex) -> bool:
    return abs(a - b) <= _SAME * (1.0 + abs(b))


class ActiveTargets:
    """The set-points sent to one vehicle, and what its reports say of them; corrects the history of its prediction."""

    def __init__(self, history: Alterable, *, period_ns: int, held_ns: int) -> None:
        self._history, self._period_ns, self._held_ns = history, period_ns, held_ns
        self._due_ns: list[int] = []
        self._sent: list[_SetPoint] = []
        self._off: list[complex] = []
        """What the acceleration of each is corrected by."""
        self._ages_ns = deque[int](maxlen=_AGES)
        self._largest_m_s2 = inf
        """The size to which the vehicle clips."""

    def sent(self, due_ns: int, fields: tuple[Any, ...]) -> None:
        """Remember a set-point as it was sent, after `history` has."""
        self._due_ns.append(due_ns)
        self._sent.append(_SetPoint(_vector(fields, _VELOCITY), _vector(fields, _ACCELERATION)))
        self._off.append(0j)
        self._clip([len(self._sent) - 1])
        old = bisect_left(self._due_ns, due_ns - 9 * self._held_ns)
        if 2 * old > len(self._sent):
            del self._due_ns[:old], self._sent[:old], self._off[:old]

    def reported(self, at_ns: int, fields: tuple[Any, ...]) -> None:
        """Take in the fields of a report, of an instant on the station's clock."""
        acceleration = _vector(fields, _ACCELERATION)
        velocity = None if fields[_TYPE_MASK] & VELOCITY_IGNORED else _vector(fields, _VELOCITY)
        expected, least_age_ns = self._expected(at_ns), min(self._ages_ns, default=0)
        oldest = bisect_left(self._due_ns, at_ns - least_age_ns - self._held_ns)
        newest = bisect_right(self._due_ns, at_ns)
        places = *range(expected, oldest - 1, -1), *range(expected + 1, newest)
        active = self._recognised(places, velocity, acceleration)
        if active is not None:
            self._ages_ns.append(at_ns - self._due_ns[active])
            expected = self._expected(at_ns)
            held = self._sent[active].acceleration
            self._correct(active, 0j)
            for lost in range(active + 1, expected + 1):
                self._correct(lost, held - self._sent[lost].acceleration)
            if self._largest_m_s2 < inf:
                if abs(held) > self._largest_m_s2:
                    self._largest_m_s2 = inf  # what limited it, such as its speed, no longer does
                self._clip(range(max(active, expected) + 1, len(self._sent)))
        elif velocity is None and self._ages_ns and expected >= 0 and isfinite(abs(acceleration)):
            self._correct(expected, acceleration - self._sent[expected].acceleration)
            if 0.0 < abs(acceleration) < abs(self._sent[expected].acceleration):
                self._largest_m_s2 = abs(acceleration)
            self._clip(range(expected + 1, len(self._sent)))

    def _expected(self, at_ns: int) -> int:
        """The set-point that acts at an instant if none is lost."""
        least_age_ns = min(self._ages_ns, default=0)
        return bisect_right(self._due_ns, at_ns - least_age_ns + round(_EARLY * self._period_ns)) - 1

    def _recognised(self, places: Iterable[int], velocity: complex | None, acceleration: complex) -> int | None:
        """The first of these set-points that has the values reported."""
        for place in places:
            sent = self._sent[place]
            if _same(acceleration, sent.acceleration) or (velocity is not None and _same(velocity, sent.velocity)):
                return place
        return None

    def _clip(self, places: Iterable[int]) -> None:
        for place in places:
            wanted = self._sent[place].acceleration
            over = abs(wanted) / self._largest_m_s2
            self._correct(place, wanted / over - wanted if over > 1.0 else 0j)

    def _correct(self, place: int, off: complex) -> None:
        if off != self._off[place]:
            self._history.alter(self._due_ns[place], off - self._off[place])
            self._off[place] = off
