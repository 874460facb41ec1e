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
        self._newest_slot = np.zeros(vehicles, dtype=np.int64)
        self._newest_ns = [_NEVER_NS] * vehicles

    def add(self, vehicle: int, time_ns: int, state: tuple[float, float, float, float]) -> bool:
        """Take in a report (north, east in m, then in m/s); one not newer than the newest is left out: False."""
        if time_ns <= self._newest_ns[vehicle]:
            return False
        slot = (int(self._newest_slot[vehicle]) + 1) % HISTORY
        self._newest_slot[vehicle] = slot
        self._newest_ns[vehicle] = time_ns
        self._time_ns[vehicle, slot] = time_ns
        self._state[vehicle, slot] = state
        return True

    def forget(self, vehicle: int) -> None:
        """Drop what a vehicle reported, as when its clock has jumped."""
        self._time_ns[vehicle] = _NEVER_NS
        self._state[vehicle] = np.nan
        self._newest_ns[vehicle] = _NEVER_NS

    def newest(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Instants (n,), positions (n, 2) and velocities (n, 2) of the newest reports."""
        state = self._state[self._rows, self._newest_slot]
        return self._time_ns[self._rows, self._newest_slot], state[:, :2], state[:, 2:]

    def at(self, vehicles: IntArray, time_ns: IntArray) -> FloatArray:
        """States (m, 4) of the given vehicles (m,), each at its given instant (m,).

        Between two reports: the cubic through both positions and velocities, which is exact for a constant
        acceleration. After the newest one and before the oldest: straight on with that report's velocity.
        """
        newest = self._newest_slot[vehicles]
        slot, instant_ns = newest, self._time_ns[vehicles, newest]
        for _ in range(HISTORY - 1):  # back to the newest report that is not after the instant: mostly one step or two
            after = instant_ns > time_ns
            if not after.any():
                break
            slot = np.where(after, slot - 1, slot) % HISTORY
            instant_ns = self._time_ns[vehicles, slot]
        missing = (instant_ns == _NEVER_NS) & (slot != newest)  # before the oldest report: use that one
        slot = np.where(missing, slot + 1, slot) % HISTORY
        state = self._state[vehicles, slot]
        since_s = (time_ns - self._time_ns[vehicles, slot]).astype(np.float64)[:, None] * 1e-9
        result = state.copy()
        result[:, :2] += state[:, 2:] * since_s
        between = np.flatnonzero((slot != newest) & (since_s[:, 0] >= 0))
        if between.size:
            who, start = vehicles[between], slot[between]
            stop = (start + 1) % HISTORY
            span_s = (self._time_ns[who, stop] - self._time_ns[who, start]).astype(np.float64)[:, None] * 1e-9
            result[between] = _hermite(state[between], self._state[who, stop], since_s[between], span_s)
        return result


def _hermite(a: FloatArray, b: FloatArray, since_s: FloatArray, span_s: FloatArray) -> FloatArray:
    """Cubic Hermite interpolation of (position, velocity) rows between states a and b that lie span_s apart."""
    x = since_s / span_s
    p0, v0, p1, v1 = a[:, :2], a[:, 2:] * span_s, b[:, :2], b[:, 2:] * span_s
    rise = p1 - p0
    c2 = 3 * rise - 2 * v0 - v1
    c3 = v0 + v1 - 2 * rise
    return np.hstack([p0 + x * (v0 + x * (c2 + x * c3)), (v0 + x * (2 * c2 + 3 * x * c3)) / span_s])
