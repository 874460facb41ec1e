"""The states that vehicles reported, kept long enough to bring two of them to one instant."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

HISTORY = 128
"""Reports kept for each vehicle: 2.6 s at 50 Hz, which bridges links whose delays differ by that much."""
_NEVER_NS = np.iinfo(np.int64).min // 4


class StateHistory:
    """Newest reported states of n vehicles, each a planar position and velocity at an instant of the station's clock.

    Instants are in ns; positions (n, 2) in m and velocities (n, 2) in m/s, north and east. A vehicle that has reported
    nothing has NaN there.
    """

    def __init__(self, vehicles: int) -> None:
        self._rows = np.arange(vehicles)
        self._time_ns = np.full((vehicles, HISTORY), _NEVER_NS, dtype=np.int64)
        self._state = np.full((vehicles, HISTORY, 4), np.nan)
        self._newest = [-1] * vehicles
        self._newest_ns = [_NEVER_NS] * vehicles

    def add(self, vehicle: int, time_ns: int, state: tuple[float, float, float, float]) -> bool:
        """Take in a report (north, east in m, then in m/s); one not newer than the newest is left out: False."""
        if time_ns <= self._newest_ns[vehicle]:
            return False
        slot = (self._newest[vehicle] + 1) % HISTORY
        self._newest[vehicle] = slot
        self._newest_ns[vehicle] = time_ns
        self._time_ns[vehicle, slot] = time_ns
        self._state[vehicle, slot] = state
        return True

    def forget(self, vehicle: int) -> None:
        """Drop what a vehicle reported, as when its clock has jumped."""
        self._time_ns[vehicle] = _NEVER_NS
        self._state[vehicle] = np.nan
        self._newest[vehicle], self._newest_ns[vehicle] = -1, _NEVER_NS

    def newest(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Instants (n,), positions (n, 2) and velocities (n, 2) of the newest reports."""
        state = self._state[self._rows, self._newest]
        return self._time_ns[self._rows, self._newest], state[:, :2], state[:, 2:]

    def at(self, vehicles: IntArray, time_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities (m, 2) of the given vehicles (m,), each at its given instant (m,).

        Between two reports: the cubic through both positions and velocities, which is exact for a constant
        acceleration. After the newest one and before the oldest: straight on with that report's velocity.
        """
        times = self._time_ns[vehicles]
        behind = time_ns[:, None] - times  # age of each report at the wanted instant
        before = np.where(behind >= 0, behind, np.iinfo(np.int64).max).argmin(axis=1)
        after = np.where(behind < 0, behind, _NEVER_NS * 2).argmax(axis=1)
        rows = self._rows[: len(vehicles)]
        has_before = (behind[rows, before] >= 0) & (times[rows, before] != _NEVER_NS)
        has_after = (behind[rows, after] < 0) & (times[rows, after] != _NEVER_NS)
        start = np.where(has_before, before, after)
        stop = np.where(has_after, after, start)
        a, b = self._state[vehicles, start], self._state[vehicles, stop]
        since_s = behind[rows, start].astype(np.float64)[:, None] * 1e-9
        span_s = (times[rows, stop] - times[rows, start]).astype(np.float64)[:, None] * 1e-9
        straight = (a[:, :2] + a[:, 2:] * since_s, a[:, 2:])
        between = (span_s > 0).ravel()
        if not between.any():
            return straight
        position, velocity = _hermite(a, b, since_s, np.where(span_s > 0, span_s, 1.0))
        pick = between[:, None]
        return np.where(pick, position, straight[0]), np.where(pick, velocity, straight[1])


def _hermite(a: FloatArray, b: FloatArray, since_s: FloatArray, span_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cubic Hermite interpolation of (position, velocity) rows between states a and b that lie span_s apart."""
    x = since_s / span_s
    p0, v0, p1, v1 = a[:, :2], a[:, 2:] * span_s, b[:, :2], b[:, 2:] * span_s
    rise = p1 - p0
    c2 = 3 * rise - 2 * v0 - v1
    c3 = v0 + v1 - 2 * rise
    return p0 + x * (v0 + x * (c2 + x * c3)), (v0 + x * (2 * c2 + 3 * x * c3)) / span_s
