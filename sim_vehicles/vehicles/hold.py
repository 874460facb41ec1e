"""A playout buffer: holds set-points until a fixed time after their stamps, which turns jitter into constant delay.

The stamp, time_boot_ms, is in the station's clock and the arrival in the vehicle's; the offset between the two is
unknown but constant. The *lag* is the 99th percentile of the last differences arrival - stamp, offset included. A
set-point acts when the vehicle's clock shows its stamp plus the lag. One that arrives later acts at once.
"""

import heapq
from bisect import bisect_left, insort
from collections import deque
from math import ceil

from scenarios.keys.part import HELD_SHARE
from sim_vehicles.services.clock import NEVER_NS, NS_PER_MS, BootClock
from sim_vehicles.services.mavlink import Setpoint

_ARRIVALS = 500
"""Number of set-points whose 99th percentile is the lag: 10 s at 50 Hz."""
_LONGEST_MS = 5000
"""If the lag exceeds a new difference by more than this, the older stamps came from another station, or from a clock
that has been set since, and are forgotten."""


class Hold:
    """Set-points that have arrived but do not act yet. `next_ns` is when the first of them acts."""

    def __init__(self) -> None:
        self.next_ns = NEVER_NS
        self.lag_ms: int | None = None
        """A set-point acts when the vehicle's clock shows its stamp plus this. None before the first."""
        self._arrivals: deque[int] = deque()
        self._ordered: list[int] = []
        self._queue: list[tuple[int, int, Setpoint]] = []
        """(due time in ns, number, set-point), earliest first."""
        self._taken = self._newest_ms = self._newest_ns = 0

    def take(self, setpoint: Setpoint, time_ns: int, clock: BootClock) -> bool:
        """Hold a set-point that arrives now; False if it is so late that it must act at once."""
        key_ms = setpoint.time_boot_ms
        arrival_ms = -(-clock.boot_ns(time_ns) // NS_PER_MS) - key_ms
        self.lag_ms = self._lag_ms(arrival_ms)
        due_ns = clock.host_ns((key_ms + self.lag_ms) * NS_PER_MS)
        if key_ms >= self._newest_ms:  # when the lag shrinks, no set-point may overtake an earlier one
            due_ns = max(due_ns, self._newest_ns)
        if due_ns < time_ns:
            return False
        self._newest_ms, self._newest_ns = max((key_ms, due_ns), (self._newest_ms, self._newest_ns))
        heapq.heappush(self._queue, (due_ns, self._taken, setpoint))
        self._taken += 1
        self.next_ns = self._queue[0][0]
        return True

    def pop(self) -> Setpoint:
        _, _, setpoint = heapq.heappop(self._queue)
        self.next_ns = self._queue[0][0] if self._queue else NEVER_NS
        return setpoint

    def _lag_ms(self, arrival_ms: int) -> int:
        if self.lag_ms is not None and self.lag_ms - arrival_ms > _LONGEST_MS:
            self._arrivals.clear()
            self._ordered.clear()
            self._newest_ms = self._newest_ns = 0
        elif len(self._arrivals) == _ARRIVALS:
            del self._ordered[bisect_left(self._ordered, self._arrivals.popleft())]
        self._arrivals.append(arrival_ms)
        insort(self._ordered, arrival_ms)
        return self._ordered[ceil(HELD_SHARE * len(self._ordered)) - 1]
