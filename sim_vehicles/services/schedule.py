"""When a vehicle sends its reports: on whole milliseconds of its own boot clock.

A state sampled on a whole millisecond needs no rounding in time_boot_ms. Periodic reports fall on multiples of the
period since boot, rounded up to the next millisecond, so requesting the same rate again does not shift them.
"""

import heapq

from sim_vehicles.services.clock import NEVER_NS, NS_PER_MS, BootClock

US_PER_MS = 1000
ONCE = 0


class Schedule:
    """The next instants of a vehicle's periodic messages, and of those requested once."""

    def __init__(self, clock: BootClock) -> None:
        self._clock = clock
        self._queue: list[tuple[int, int, int, int]] = []
        """(host time, message id, boot time in ms, number of the period), earliest first; the number may be ONCE."""
        self._interval_us: dict[int, int] = {}
        self._from_ns: dict[int, int] = {}
        """When each message became periodic."""
        self.next_ns = NEVER_NS
        """Host time of the next message."""

    def interval_us(self, message_id: int) -> int:
        """The period of a message, 0 if it is not sent periodically."""
        return self._interval_us.get(message_id, 0)

    def set_interval(self, message_id: int, interval_us: int, now_ns: int) -> None:
        """Send a message periodically from the first instant after now; 0 stops it."""
        self._queue = [entry for entry in self._queue if entry[1] != message_id or entry[3] == ONCE]
        heapq.heapify(self._queue)
        self._interval_us[message_id] = interval_us
        self._from_ns[message_id] = now_ns
        if interval_us:
            number = self._clock.boot_ns(now_ns) // (interval_us * 1000) + 1
            heapq.heappush(self._queue, self._entry(message_id, interval_us, number))
        self.next_ns = self._queue[0][0] if self._queue else NEVER_NS

    def set_clock(self, clock: BootClock, now_ns: int) -> None:
        """Continue with another clock: everything scheduled is kept, at instants of the new clock."""
        singles = [(message_id, host_ns) for host_ns, message_id, _, number in self._queue if number == ONCE]
        self._clock, self._queue = clock, []
        for message_id, interval_us in self._interval_us.items():
            self.set_interval(message_id, interval_us, max(now_ns, self._from_ns[message_id]))
        for message_id, host_ns in singles:
            self.add_once(message_id, host_ns)

    def add_once(self, message_id: int, now_ns: int) -> None:
        """Send a message at the next whole millisecond, at once if now is one."""
        boot_ms = -(-self._clock.boot_ns(now_ns) // NS_PER_MS)
        entry = (max(now_ns, self._clock.host_ns(boot_ms * NS_PER_MS)), message_id, boot_ms, ONCE)
        if entry not in self._queue:  # two requests within a millisecond are answered once, so the queue stays short
            heapq.heappush(self._queue, entry)
            self.next_ns = self._queue[0][0]

    def pop(self) -> tuple[int, int, int]:
        """Remove and return the next message: (host time, message id, boot time in ms)."""
        host_ns, message_id, boot_ms, number = self._queue[0]
        if number == ONCE:
            heapq.heappop(self._queue)
        else:
            heapq.heapreplace(self._queue, self._entry(message_id, self._interval_us[message_id], number + 1))
        self.next_ns = self._queue[0][0] if self._queue else NEVER_NS
        return host_ns, message_id, boot_ms

    def _entry(self, message_id: int, interval_us: int, number: int) -> tuple[int, int, int, int]:
        boot_ms = -(-number * interval_us // US_PER_MS)
        return self._clock.host_ns(boot_ms * NS_PER_MS), message_id, boot_ms, number
