"""The states that vehicles reported, kept long enough to bring any two of them to one instant.

Scalars and plain tuples: for single reports numpy would be ten times slower.
"""

from collections import deque
from collections.abc import Sequence
from typing import Protocol

State = tuple[float, float, float, float]
"""Position north and east in m, velocity north and east in m/s."""
Report = tuple[int, State]
"""A state with its instant on the station's clock in ns."""

HISTORY = 128
"""Reports kept for each vehicle: 2.6 s at 50 Hz, enough for links whose delays differ by that much."""


class States(Protocol):
    """Where vehicles are at any instant."""

    def at(self, vehicle: int, time_ns: int) -> State | None:
        """The state of a vehicle at an instant; None if it has reported nothing."""
        ...


class Reports(States, Protocol):
    """What vehicles reported, and where they are at any instant."""

    def newest(self, vehicle: int) -> Report | None:
        """The newest report of a vehicle; None if it has reported nothing."""
        ...


class StateHistory:
    """The newest reports of n vehicles."""

    def __init__(self, vehicles: int) -> None:
        self._reports: list[deque[Report]] = [deque(maxlen=HISTORY) for _ in range(vehicles)]

    def add(self, vehicle: int, time_ns: int, state: State) -> bool:
        """Take in a report; returns False for one that is not newer than the newest, which is ignored."""
        reports = self._reports[vehicle]
        if reports and time_ns <= reports[-1][0]:
            return False
        reports.append((time_ns, state))
        return True

    def forget(self, vehicle: int) -> None:
        """Drop what a vehicle reported, for example after its clock has jumped."""
        self._reports[vehicle].clear()

    def of(self, vehicles: Sequence[int]) -> "StateHistory":
        """The same reports of some of the vehicles, whose rows count from 0 again."""
        some = StateHistory(0)
        some._reports = [self._reports[vehicle] for vehicle in vehicles]
        return some

    @property
    def complete(self) -> bool:
        return all(self._reports)

    def newest(self, vehicle: int) -> Report | None:
        reports = self._reports[vehicle]
        return reports[-1] if reports else None

    def at(self, vehicle: int, time_ns: int) -> State | None:
        """The state of a vehicle at an instant; None if it has reported nothing.

        Between two reports the position is cubic through both positions and velocities, and the velocity linear; both
        are exact for a constant acceleration. The cubic's slope is not used as velocity: it would contain errors of the
        reports' instants, as when a clock estimate moves, and the rounding of positions. After the newest report and
        before the oldest, the state is extrapolated with that report's velocity.
        """
        reports = self._reports[vehicle]
        if not reports:
            return None
        after = reports[-1]
        if time_ns < after[0]:
            for k in range(2, len(reports) + 1):  # mostly one step or two
                before = reports[-k]
                if before[0] <= time_ns:
                    return _between(before, after, time_ns)
                after = before
        north, east, v_north, v_east = after[1]
        since_s = (time_ns - after[0]) * 1e-9
        return north + v_north * since_s, east + v_east * since_s, v_north, v_east


def _between(a: Report, b: Report, time_ns: int) -> State:
    """Cubic Hermite interpolation of position, linear of velocity."""
    (a_ns, (north, east, v_north, v_east)), (b_ns, (north_b, east_b, v_north_b, v_east_b)) = a, b
    span_s = (b_ns - a_ns) * 1e-9
    x = (time_ns - a_ns) * 1e-9 / span_s
    v0, v1, rise = v_north * span_s, v_north_b * span_s, north_b - north
    w0, w1, rise_east = v_east * span_s, v_east_b * span_s, east_b - east
    c2, c3 = 3.0 * rise - 2.0 * v0 - v1, v0 + v1 - 2.0 * rise
    d2, d3 = 3.0 * rise_east - 2.0 * w0 - w1, w0 + w1 - 2.0 * rise_east
    return (
        north + x * (v0 + x * (c2 + x * c3)),
        east + x * (w0 + x * (d2 + x * d3)),
        v_north + x * (v_north_b - v_north),
        v_east + x * (v_east_b - v_east),
    )
