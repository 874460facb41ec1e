"""Counts lost, late and duplicate frames by MAVLink's 8-bit sequence numbers."""

import numpy as np

from scenarios.kernel import Cell, Columns, Record, Records, at_row, kernel
from scenarios.schema import NS_PER_S

_KEPT = 128
"""How far back the counter remembers which frames arrived. Farther back, a replayed frame would be used again."""
NEW, LATE, DUPLICATE = 0, 1, 2
_STEADY_NS = NS_PER_S // 2
"""A pause longer than this says nothing about the rate."""
_RATE_NS = NS_PER_S
"""The frame rate is measured over intervals of this length; each interval of age multiplies a weight by `_OLDER`. To
count the losses of a minute's outage correctly, the rate must be known to about half a per cent despite jitter."""
_OLDER = 0.9
_AHEAD, _LEAST_AHEAD = 127, 32
"""A frame may be this many numbers newer than its time suggests, because the newest one may itself have been late. The
farther frames have recently been overtaken, the smaller this allowance, down to `_LEAST_AHEAD`."""
_MOST = 0xFFFFFFFF
"""The largest count that the tick record holds. Without this limit, a log whose clock jumps by centuries exceeds it."""
_FORGET = 1.0 / 512
_RUN, _RUN_STEP = 8, 4
"""`_RUN` late frames in a row, each at most `_RUN_STEP` newer than the last, are new after all: an earlier, very late
frame was mistaken for a new one."""


COUNTER = np.dtype(
    [
        ("received", "i8"), ("lost", "i8"), ("late", "i8"), ("duplicate", "i8"),
        ("last", "i8"),  # sequence number of the last frame
        ("newest", "i8"), ("newest_ns", "i8"),  # newest frame: its number, wraps undone (-1: none yet), and its time
        ("seen", "u8"), ("seen_before", "u8"),  # bit k is set if frame newest - k, or newest - 64 - k, has arrived
        ("run", "i8"),  # late frames in a row, each a little newer than the last
        ("lag", "f8"),  # by how many numbers frames have recently been overtaken
        ("rate_hz", "f8"), ("rate_count", "i8"), ("rate_ns", "i8"), ("steady_frames", "f8"), ("steady_ns", "f8"),
    ],
    align=True,
)  # fmt: skip
"""The count of one sender's frames."""


@kernel
def count(counter: Record, sequence: int, time_ns: int) -> int:
    """Count a frame received at a time: NEW if it is newer than all before it, else LATE or DUPLICATE."""
    counter.received += 1
    step = (sequence - counter.last) & 0xFF
    counter.last = sequence
    if counter.newest < 0:
        counter.newest, counter.newest_ns = sequence, time_ns
        counter.rate_count, counter.rate_ns = sequence, time_ns
        counter.seen = 1
        return NEW
    since_ns = max(0, time_ns - counter.newest_ns)  # in a log the clock may have been set back
    passed = int(min(counter.rate_hz * since_ns, float(_MOST * NS_PER_S))) // NS_PER_S
    most = passed + max(_LEAST_AHEAD, _AHEAD - int(counter.lag))
    ahead = most - ((most - sequence + counter.newest) & 0xFF)
    if ahead <= 0 and 0 < step <= _RUN_STEP:
        counter.run += 1
        if counter.run == _RUN:
            counter.lost -= ahead + 255  # whether any of these are lost is unknown
            ahead += 256
    else:
        counter.run = 0
    counter.lag = max(counter.lag * (1.0 - _FORGET), float(-ahead))
    if ahead > 0:
        counter.lost = min(counter.lost + ahead - 1, _MOST)
        _see_next(counter, ahead)
        _note_rate(counter, time_ns)
        counter.newest_ns = time_ns
        return NEW
    back = -ahead
    seen, place = counter.seen, back
    if back >= 64:
        seen, place = counter.seen_before, back - 64
    bit = np.uint64(1) << np.uint64(place) if back < _KEPT else np.uint64(0)
    if seen & bit:
        counter.duplicate += 1
        return DUPLICATE
    counter.late += 1
    counter.lost = max(0, counter.lost - 1)
    if back >= 64:
        counter.seen_before |= bit
    else:
        counter.seen |= bit
    return LATE


@kernel
def restart(counter: Record) -> None:
    """Treat the next frame as the first: the sender has restarted."""
    counter.newest = -1
    counter.newest_ns = counter.rate_ns = counter.rate_count = counter.run = counter.last = 0
    counter.seen = counter.seen_before = 0
    counter.rate_hz = counter.lag = counter.steady_frames = counter.steady_ns = 0.0


@kernel
def _see_next(counter: Record, ahead: int) -> None:
    """Record the arrival of the frame that is `ahead` numbers newer than the newest."""
    counter.newest += ahead
    if ahead >= _KEPT:
        counter.seen = counter.seen_before = 0
    elif ahead >= 64:
        counter.seen_before = counter.seen << np.uint64(ahead - 64)
        counter.seen = 0
    else:
        carried = counter.seen >> np.uint64(64 - ahead)
        counter.seen_before = counter.seen_before << np.uint64(ahead) | carried
        counter.seen = counter.seen << np.uint64(ahead)
    counter.seen |= np.uint64(1)


@kernel
def _note_rate(counter: Record, time_ns: int) -> None:
    """Update the sender's frame rate, leaving out intervals with a pause."""
    steady = time_ns - counter.newest_ns < _STEADY_NS
    since_ns = time_ns - counter.rate_ns
    if steady and since_ns < _RATE_NS:
        return
    if steady:
        counter.steady_frames = _OLDER * counter.steady_frames + (counter.newest - counter.rate_count)
        counter.steady_ns = _OLDER * counter.steady_ns + since_ns
        counter.rate_hz = counter.steady_frames / counter.steady_ns * NS_PER_S
    counter.rate_count, counter.rate_ns = counter.newest, time_ns


_count_at, _restart_at = at_row(count), at_row(restart)


def new_counters(n: int) -> Records:
    """Counters (of `COUNTER`) for n senders that have sent nothing yet."""
    counters = np.zeros(n, COUNTER)
    counters["newest"] = -1
    return counters


class SequenceCounter:
    """Counts the frames of one sender: received, lost, late (received after a newer one) and duplicate.

    A sequence number holds 8 bits of the count; time gives the rest. A frame can be only slightly newer than the frame
    rate suggests; one that seems newer than that is an old one. So a swapped pair is one late frame, not 254 lost ones,
    and all losses of a minute's outage are counted. A frame overtaken by more than 223 others is miscounted. A late
    frame is no longer counted as lost once it arrives.
    """

    received = Cell[int]()
    lost = Cell[int]()
    late = Cell[int]()
    duplicate = Cell[int]()

    def __init__(self, counters: Records = None, row: int = 0) -> None:
        """A view of one row of an array of `COUNTER`, by default of an array of its own."""
        self._counters, self._row = new_counters(1) if counters is None else counters, row
        self._columns = Columns(self._counters)

    def add(self, sequence: int, time_ns: int) -> int:
        """Count a frame received at a time: NEW if it is newer than all before it, else LATE or DUPLICATE."""
        return _count_at(self._counters, self._row, sequence, time_ns)

    def restart(self) -> None:
        """Treat the next frame as the first: the sender has restarted."""
        _restart_at(self._counters, self._row)
