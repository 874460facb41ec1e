"""Identifies the set-points that acted, from the active target that a vehicle reports (POSITION_TARGET_LOCAL_NED).

The prediction assumes that every set-point acts, one delivery delay after it was due. A lost one never acts: the
vehicle holds the previous one. A report shows which set-point the vehicle holds at an instant. It carries the vehicle's
own time and no set-point key, so set-points are matched by value, rounded to float32 as on the link. For ArduPilot the
acceleration is matched, because the reported velocity grows with it; ArduPilot stores it in cm/s², which moves about a
quarter of all values to the neighbouring float32. For PX4 the velocity is matched, because the reported acceleration is
that of its velocity loop. Our own vehicles report only the acceleration.

The *age* of a report is its instant minus the time at which the matched set-point was due. Without loss, it lies
between the delivery delay and one control period more. So a set-point that is newer than the matched one, but older
than the smallest recent age, was lost or is late; the matched one replaces it. The assumed delay is not used, so a
delay mismatch has no effect here.

A vehicle that reports only an acceleration reports the one it follows. If it was never sent, but is smaller than the
expected one and in the same direction, the vehicle clips. Set-points in flight are then assumed to be clipped to the
same magnitude until the vehicle exceeds it. An acceleration in another direction, as when a speed limit removes the
component along the velocity, says nothing about the set-points in flight.
"""

import struct
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence
from math import inf, isfinite
from typing import Any

from gcs.control.prediction import CommandHistory
from gcs.link.mavlink import VELOCITY_IGNORED

_AGES = 3
"""Set-points over which the least age is taken: few, because an increased delay looks like loss until all show it."""
_EARLY = 0.05
"""A set-point is expected to act this share of a period before it reaches the least age: clocks err by as much."""
_ASIDE = 0.02
"""Tangent of the largest angle between two accelerations that count as having the same direction."""
_ROUNDED = 2.0**-22
"""Largest relative difference of two values that count as equal: two float32 steps."""
_VELOCITY, _ACCELERATION, _TYPE_MASK = slice(4, 6), slice(7, 9), 12
"""Indices into the fields of POSITION_TARGET_LOCAL_NED."""
_ON_THE_WIRE = struct.Struct("<2f")


def _rounded(vector: Sequence[float]) -> complex:
    """North + 1j * east, rounded to float32 as on the link."""
    return complex(*_ON_THE_WIRE.unpack(_ON_THE_WIRE.pack(*vector)))


def _is_same(reported: complex, sent: complex) -> bool:
    """Whether both components of a reported vector equal those of one that was sent."""
    off = reported - sent
    return abs(off.real) <= _ROUNDED * abs(sent.real) and abs(off.imag) <= _ROUNDED * abs(sent.imag)


def _is_shortened(reported: complex, sent: complex) -> bool:
    """Whether a reported acceleration has the direction of one that was sent, but is smaller."""
    share = reported / sent if sent else 0j
    return 0.0 < share.real < 1.0 and abs(share.imag) < _ASIDE * share.real


class ActiveTargets:
    """Matches one vehicle's reports with the set-points sent to it and corrects the history of its prediction."""

    def __init__(self, history: CommandHistory, *, period_ns: int, held_ns: int) -> None:
        self._history, self._period_ns, self._held_ns = history, period_ns, held_ns
        self._due_ns: list[int] = []
        self._velocity: list[complex] = []
        self._acceleration: list[complex] = []
        self._off: list[complex] = []
        """The correction added to each acceleration."""
        self._ages_ns, self._aged_ns = deque[int](maxlen=_AGES), 0
        self._largest_m_s2 = inf
        """The magnitude to which the vehicle clips."""

    def sent(self, due_ns: int, velocity_m_s: Sequence[float], acceleration_m_s2: Sequence[float]) -> None:
        """Record a set-point as it was sent, north and east; `history` must already hold it."""
        self._due_ns.append(due_ns)
        self._velocity.append(_rounded(velocity_m_s))
        self._acceleration.append(_rounded(acceleration_m_s2))
        self._off.append(0j)
        self._clip_from(len(self._off) - 1)
        old = bisect_left(self._due_ns, due_ns - 9 * self._held_ns)
        if 2 * old > len(self._off):
            del self._due_ns[:old], self._velocity[:old], self._acceleration[:old], self._off[:old]

    def reported(self, at_ns: int, fields: tuple[Any, ...]) -> None:
        """Process the fields of a report; `at_ns` is its instant on the station's clock."""
        acceleration, only = _rounded(fields[_ACCELERATION]), bool(fields[_TYPE_MASK] & VELOCITY_IGNORED)
        expected, least_age_ns = self._expected(at_ns), min(self._ages_ns, default=0)
        oldest = bisect_left(self._due_ns, at_ns - least_age_ns - self._held_ns)
        recent = range(oldest, bisect_right(self._due_ns, at_ns))
        value, same = acceleration, [place for place in recent if _is_same(acceleration, self._acceleration[place])]
        if not same and not only:
            value = _rounded(fields[_VELOCITY])
            same = [place for place in recent if _is_same(value, self._velocity[place])]
        if len(same) == 1 and value and self._due_ns[same[0]] != self._aged_ns:
            # zeros are left out, as a stopped vehicle reports them too; repeated reports would only add growing ages
            self._aged_ns = self._due_ns[same[0]]
            self._ages_ns.append(at_ns - self._aged_ns)
            expected = self._expected(at_ns)
        if not self._ages_ns or expected < 0:
            return
        if same:
            self._hold(min(same, key=lambda place: abs(place - expected)), expected)
        elif only and isfinite(abs(acceleration)):
            self._correct(expected, acceleration - self._acceleration[expected])
            if _is_shortened(acceleration, self._acceleration[expected]):
                self._largest_m_s2 = abs(acceleration)
                self._clip_from(expected + 1)

    def _expected(self, at_ns: int) -> int:
        """The index of the set-point that acts at an instant if none is lost."""
        least_age_ns = min(self._ages_ns, default=0)
        return bisect_right(self._due_ns, at_ns - least_age_ns + round(_EARLY * self._period_ns)) - 1

    def _hold(self, active: int, expected: int) -> None:
        """The vehicle follows the set-point `active`; those after it, up to `expected`, were lost."""
        held = self._acceleration[active]
        self._correct(active, 0j)
        for lost in range(active + 1, expected + 1):
            self._correct(lost, held - self._acceleration[lost])
        if abs(held) > self._largest_m_s2:
            self._largest_m_s2 = inf  # the limit, such as a speed limit, no longer applies
            self._clip_from(max(active, expected) + 1)

    def _clip_from(self, place: int) -> None:
        """Assume that this set-point and all later ones are clipped like the last reported one."""
        for later in range(place, len(self._off)):
            wanted = self._acceleration[later]
            over = abs(wanted) / self._largest_m_s2
            self._correct(later, wanted / over - wanted if over > 1.0 else 0j)

    def _correct(self, place: int, off: complex) -> None:
        if off != self._off[place]:
            self._history.alter(self._due_ns[place], off - self._off[place])
            self._off[place] = off
