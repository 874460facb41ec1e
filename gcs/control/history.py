"""Recent states reported by the vehicles, kept long enough to bring any two of them to one instant."""

from collections.abc import Sequence
from math import nan
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray
from scenarios.kernel import Records, array_kernel, kernel

State = tuple[float, float, float, float]
"""Position north and east in m, velocity north and east in m/s."""
Report = tuple[int, State]
"""A state with its instant on the station's clock in ns."""
Instants = NDArray[np.int64]

HISTORY = 128
"""Reports kept for each vehicle: 2.6 s at 50 Hz, enough for links whose delays differ by that much."""
REPORT = np.dtype([("time_ns", "i8"), ("state", "f8", (4,))], align=True)
_UNKNOWN = (nan, nan, nan, nan)


class States(Protocol):
    """States of vehicles at any instant. A subclass need only define `at`."""

    def at(self, vehicle: int, time_ns: int) -> State | None:
        """The state of a vehicle at an instant; None if it has reported nothing."""
        ...

    def every_at(self, vehicles: NDArray[np.int64], times_ns: Instants) -> FloatArray:
        """The states (m, 4) of m vehicles, each at its own instant; NaN where nothing was reported."""
        each = zip(vehicles.tolist(), times_ns.tolist(), strict=True)
        return np.array([self.at(vehicle, time_ns) or _UNKNOWN for vehicle, time_ns in each]).reshape(-1, 4)


class Reports(States, Protocol):
    """Newest reports of vehicles, and their states at any instant."""

    def newest(self, vehicle: int) -> Report | None:
        """The newest report of a vehicle; None if it has reported nothing."""
        ...

    def every_newest(self) -> tuple[Instants, FloatArray]:
        """Instant and state (n, 4) of the newest report of each vehicle; 0 and NaN where there is none."""
        ...


class StateHistory:
    """The newest reports of n vehicles."""

    def __init__(self, vehicles: int) -> None:
        self.reports: Records = np.zeros((vehicles, HISTORY), REPORT)
        """A ring buffer for each vehicle."""
        self.counts = np.zeros(vehicles, np.int64)
        """Number of reports accepted from each vehicle."""
        self._times_ns, self._states = self.reports["time_ns"].data, self.reports["state"].data

    def add(self, vehicle: int, time_ns: int, state: State) -> bool:
        """Add a report; returns False if it is not newer than the newest, and ignores it."""
        return add_report(self.reports, self.counts, vehicle, time_ns, *state)

    def forget(self, vehicle: int) -> None:
        """Drop a vehicle's reports, for example after its clock has jumped."""
        self.counts[vehicle] = 0

    def of(self, vehicles: Sequence[int]) -> "StateHistory":
        """A copy with only some of the vehicles, whose rows are renumbered from 0."""
        some = StateHistory(len(vehicles))
        some.reports[:], some.counts[:] = self.reports[[*vehicles]], self.counts[[*vehicles]]
        return some

    @property
    def complete(self) -> bool:
        return bool(self.counts.all())

    def newest(self, vehicle: int) -> Report | None:
        count = self.counts.item(vehicle)
        if not count:
            return None
        k, states = (count - 1) % HISTORY, self._states
        north, east, v_north, v_east = (states[vehicle, k, part] for part in range(4))
        return self._times_ns[vehicle, k], (north, east, v_north, v_east)

    def every_newest(self) -> tuple[Instants, FloatArray]:
        return every_newest(self.reports, self.counts)

    def at(self, vehicle: int, time_ns: int) -> State | None:
        """The state of a vehicle at an instant; None if it has reported nothing. See `state_at`."""
        return state_at(self.reports, self.counts, vehicle, time_ns) if self.counts[vehicle] else None

    def every_at(self, vehicles: NDArray[np.int64], times_ns: Instants) -> FloatArray:
        return every_at(self.reports, self.counts, vehicles, times_ns)


@kernel
def add_report(
    reports: Records, counts: NDArray[np.int64], row: int,
    time_ns: int, north: float, east: float, v_north: float, v_east: float,
) -> bool:  # fmt: skip
    """See `StateHistory.add`."""
    count = counts[row]
    if count and time_ns <= reports[row, (count - 1) % HISTORY].time_ns:
        return False
    report = reports[row, count % HISTORY]
    report.time_ns = time_ns
    report.state[0], report.state[1], report.state[2], report.state[3] = north, east, v_north, v_east
    counts[row] = count + 1
    return True


@kernel
def state_at(reports: Records, counts: NDArray[np.int64], row: int, time_ns: int) -> State:
    """The state at an instant of a vehicle that has reported at least one.

    Between two reports, the position is a cubic through both positions and velocities, and the velocity is linear; both
    are exact for a constant acceleration. The cubic's slope is not used as velocity: it would contain timing errors of
    the reports, as when a clock estimate moves, and the rounding of positions. After the newest report and before the
    oldest, the state is extrapolated with that report's velocity.
    """
    count = counts[row]
    after = reports[row, (count - 1) % HISTORY]
    if time_ns < after.time_ns:
        for k in range(2, min(count, HISTORY) + 1):  # usually one or two steps
            before = reports[row, (count - k) % HISTORY]
            if before.time_ns <= time_ns:
                return _between(before.time_ns, before.state, after.time_ns, after.state, time_ns)
            after = before
    newest, since_s = after.state, (time_ns - after.time_ns) * 1e-9
    return newest[0] + newest[2] * since_s, newest[1] + newest[3] * since_s, newest[2], newest[3]


@kernel
def _between(a_ns: int, a: FloatArray, b_ns: int, b: FloatArray, time_ns: int) -> State:
    """Cubic Hermite interpolation of position, linear interpolation of velocity."""
    span_s = (b_ns - a_ns) * 1e-9
    x = (time_ns - a_ns) * 1e-9 / span_s
    v0, v1, rise = a[2] * span_s, b[2] * span_s, b[0] - a[0]
    w0, w1, rise_east = a[3] * span_s, b[3] * span_s, b[1] - a[1]
    c2, c3 = 3.0 * rise - 2.0 * v0 - v1, v0 + v1 - 2.0 * rise
    d2, d3 = 3.0 * rise_east - 2.0 * w0 - w1, w0 + w1 - 2.0 * rise_east
    return (
        a[0] + x * (v0 + x * (c2 + x * c3)),
        a[1] + x * (w0 + x * (d2 + x * d3)),
        a[2] + x * (b[2] - a[2]),
        a[3] + x * (b[3] - a[3]),
    )


@array_kernel
def every_newest(reports: Records, counts: NDArray[np.int64]) -> tuple[Instants, FloatArray]:
    times_ns, states = np.zeros(len(counts), np.int64), np.full((len(counts), 4), nan)
    for row in range(len(counts)):
        if counts[row]:
            report = reports[row, (counts[row] - 1) % HISTORY]
            times_ns[row] = report.time_ns
            for k in range(4):
                states[row, k] = report.state[k]
    return times_ns, states


@array_kernel
def every_at(
    reports: Records, counts: NDArray[np.int64], vehicles: NDArray[np.int64], times_ns: Instants
) -> FloatArray:
    states = np.full((len(vehicles), 4), nan)
    for place in range(len(vehicles)):
        if counts[vehicles[place]]:
            north, east, v_north, v_east = state_at(reports, counts, vehicles[place], times_ns[place])
            states[place, 0], states[place, 1], states[place, 2], states[place, 3] = north, east, v_north, v_east
    return states
