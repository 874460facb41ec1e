"""Schedule of a vehicle's reports, on whole milliseconds of its own boot clock.

A state sampled on a whole millisecond needs no rounding in time_boot_ms. Periodic reports fall on multiples of the
period since boot, rounded up to the next millisecond, so requesting the same rate again does not shift them.

The reports of `REPORTS` are scheduled in the vehicle's record, all other messages in a heap.
"""

import heapq

from scenarios.kernel import Cell, Record, at_row, kernel
from sim_vehicles.services.clock import NEVER_NS, NS_PER_MS, BootClock, host_ns
from sim_vehicles.services.hot import REPORTS, Place

US_PER_MS = 1000
ONCE = 0


@kernel
def period_ms(interval_us: int, number: int) -> int:
    """Boot time in ms at which period `number` ends."""
    return -(-number * interval_us // US_PER_MS)


@kernel
def schedule_report(vehicle: Record, k: int, number: int) -> None:
    """Schedule report k for the end of period `number`, or for never if it has no period."""
    vehicle.due_ns[k] = NEVER_NS
    if vehicle.interval_us[k] != 0:
        vehicle.number[k] = number
        vehicle.due_ms[k] = period_ms(vehicle.interval_us[k], number)
        vehicle.due_ns[k] = host_ns(
            vehicle.clock_start_ns, vehicle.clock_offset_ns, vehicle.clock_drift_ppb, vehicle.due_ms[k] * NS_PER_MS
        )
    vehicle.report = 0
    for other in range(1, len(vehicle.due_ns)):
        if vehicle.due_ns[other] < vehicle.due_ns[vehicle.report]:
            vehicle.report = other
    vehicle.report_ns = vehicle.due_ns[vehicle.report]


_schedule_report_at = at_row(schedule_report)


class Schedule:
    """Due times of a vehicle's periodic messages, and of messages requested once."""

    _report = Cell[int]()
    _report_ns = Cell[int]()
    _other_ns = Cell[int]()

    def __init__(self, clock: BootClock, place: Place) -> None:
        self._vehicles, self._columns, self._row = place
        self._report_at, self._other_at = self._columns["report_ns"], self._columns["other_ns"]
        self._queue: list[tuple[int, int, int, int]] = []
        """(host time, message id, boot time in ms, number of the period), earliest first; the number may be ONCE."""
        self._interval_us: dict[int, int] = {}
        self._from_ns: dict[int, int] = {}
        """When each message became periodic."""
        self._use(clock)

    @property
    def next_ns(self) -> int:
        """Host time of the next message."""
        report_ns, other_ns = self._report_at[self._row], self._other_at[self._row]
        return report_ns if report_ns < other_ns else other_ns

    def interval_us(self, message_id: int) -> int:
        """The period of a message, 0 if it is not sent periodically."""
        return self._interval_us.get(message_id, 0)

    def set_interval(self, message_id: int, interval_us: int, now_ns: int) -> None:
        """Send a message periodically, first at its first due time after now; 0 stops it."""
        self._interval_us[message_id] = interval_us
        self._from_ns[message_id] = now_ns
        number = self._clock.boot_ns(now_ns) // (interval_us * 1000) + 1 if interval_us else 0
        if message_id in REPORTS:
            k = REPORTS.index(message_id)
            self._columns["interval_us"][self._row, k] = interval_us
            _schedule_report_at(self._vehicles, self._row, k, number)
            return
        self._queue = [entry for entry in self._queue if entry[1] != message_id or entry[3] == ONCE]
        heapq.heapify(self._queue)
        if interval_us:
            heapq.heappush(self._queue, self._entry(message_id, interval_us, number))
        self._note_next()

    def set_clock(self, clock: BootClock, now_ns: int) -> None:
        """Continue with another clock: everything scheduled is kept, at times of the new clock."""
        singles = [entry for entry in self._queue if entry[3] == ONCE]
        self._queue = []
        self._use(clock)
        for message_id, interval_us in self._interval_us.items():
            self.set_interval(message_id, interval_us, max(now_ns, self._from_ns[message_id]))
        for due_ns, message_id, _, _ in singles:
            self.add_once(message_id, due_ns)

    def add_once(self, message_id: int, now_ns: int) -> None:
        """Send a message once, at the next whole millisecond of boot time, which may be now."""
        boot_ms = -(-self._clock.boot_ns(now_ns) // NS_PER_MS)
        entry = (max(now_ns, self._clock.host_ns(boot_ms * NS_PER_MS)), message_id, boot_ms, ONCE)
        if entry not in self._queue:  # two requests within a millisecond are answered once, so the queue stays short
            heapq.heappush(self._queue, entry)
            self._note_next()

    def pop(self) -> tuple[int, int, int]:
        """Remove and return the next message: (host time, message id, boot time in ms)."""
        k = self._report
        boot_ms, number = self._columns["due_ms"][self._row, k], self._columns["number"][self._row, k]
        report = self._report_ns, REPORTS[k], boot_ms, number
        if not self._queue or report < self._queue[0]:
            _schedule_report_at(self._vehicles, self._row, k, number + 1)
            return report[:3]
        due_ns, message_id, boot_ms, number = self._queue[0]
        if number == ONCE:
            heapq.heappop(self._queue)
        else:
            heapq.heapreplace(self._queue, self._entry(message_id, self._interval_us[message_id], number + 1))
        self._note_next()
        return due_ns, message_id, boot_ms

    def _use(self, clock: BootClock) -> None:
        self._clock = clock
        for name in ("start_ns", "offset_ns", "drift_ppb"):
            self._columns[f"clock_{name}"][self._row] = getattr(clock, name)

    def _note_next(self) -> None:
        self._other_ns = self._queue[0][0] if self._queue else NEVER_NS

    def _entry(self, message_id: int, interval_us: int, number: int) -> tuple[int, int, int, int]:
        boot_ms = period_ms(interval_us, number)
        return self._clock.host_ns(boot_ms * NS_PER_MS), message_id, boot_ms, number
