"""Loss, lateness and duplication from MAVLink's 8-bit sequence numbers."""

_KEPT = 128
"""Numbers behind the newest of which it is known whether they have come."""
_SEEN = (1 << _KEPT) - 1
NEW, LATE, DUPLICATE = 0, 1, 2
_NS_PER_S = 1_000_000_000
_NO_DOUBT = 100.0 * _NS_PER_S
"""With fewer frames expected than 100, the next number is the next frame."""
_STEADY_NS = _NS_PER_S // 2
"""A longer pause says nothing of the rate,"""
_RATE_NS = _NS_PER_S
"""which is measured over times like this."""
_AHEAD, _LEAST_AHEAD = 127, 32
"""A frame may be newer by so many than time lets expect, as the newest may have come late itself. The more frames have
been overtaken by, the fewer, but not less than the second figure."""
_MOST = 0xFFFFFFFF
"""What the tick record holds; a log whose clock jumps by centuries seems to have lost more."""
_FORGET = 1.0 / 512
_RUN, _RUN_STEP = 8, 4
"""Late frames in a row, each newer by no more than that than the one before, that show that they are not late."""


class SequenceCounter:
    """Counts frames of one sender: received, lost, late (came after a newer one) and duplicate.

    A number holds 8 bits of the count. The rest is told from time: a frame is not much newer than the frames' rate lets
    expect since the newest came, or else older. So a swapped pair is one late frame and not 254 lost ones, and what is
    lost in an outage of a minute is counted whole. What is overtaken by more than 223 frames is miscounted. A late
    frame is taken back from the lost ones.
    """

    __slots__ = (
        "_lag",
        "_last",
        "_newest",
        "_newest_ns",
        "_rate_count",
        "_rate_hz",
        "_rate_ns",
        "_run",
        "_seen",
        "duplicate",
        "late",
        "lost",
        "received",
    )

    def __init__(self) -> None:
        self.received = self.lost = self.late = self.duplicate = 0
        self.restart()

    def add(self, sequence: int, time_ns: int) -> int:
        """Count a frame received at a time; NEW if it is newer than all before it, LATE, or DUPLICATE."""
        self.received += 1
        step = (sequence - self._last) & 0xFF
        self._last = sequence
        if self._newest < 0:
            self._newest, self._newest_ns = sequence, time_ns
            self._rate_count, self._rate_ns = sequence, time_ns
            self._seen = 1
            return NEW
        since_ns = max(0, time_ns - self._newest_ns)  # in a log the clock may have been set back
        expected = self._rate_hz * since_ns
        if step == 1 and (sequence - self._newest) & 0xFF == 1 and self._run == 0 and expected < _NO_DOUBT:
            # the next one: what follows would come to the same, and most frames end here
            self._lag *= 1.0 - _FORGET
            self._seen = (self._seen << 1 | 1) & _SEEN
            self._newest += 1
            if since_ns >= _STEADY_NS or time_ns - self._rate_ns >= _RATE_NS:
                self._note_rate(time_ns)
            self._newest_ns = time_ns
            return NEW
        passed = int(expected) // _NS_PER_S
        most = passed + max(_LEAST_AHEAD, _AHEAD - int(self._lag))
        ahead = most - ((most - sequence + self._newest) & 0xFF)
        if ahead <= 0 and 0 < step <= _RUN_STEP:
            self._run += 1
            if self._run == _RUN:
                self.lost -= ahead + 255  # whether any of them are is not known
                ahead += 256
        else:
            self._run = 0
        self._lag = max(self._lag * (1.0 - _FORGET), -ahead)
        if ahead > 0:
            self.lost = min(self.lost + ahead - 1, _MOST)
            self._seen = (self._seen << min(ahead, _KEPT) | 1) & _SEEN
            self._newest += ahead
            self._note_rate(time_ns)
            self._newest_ns = time_ns
            return NEW
        bit = 1 << min(-ahead, _KEPT)
        if self._seen & bit:
            self.duplicate += 1
            return DUPLICATE
        self.late += 1
        self.lost = max(0, self.lost - 1)
        if -ahead < _KEPT:
            self._seen |= bit
        return LATE

    def restart(self) -> None:
        """The sender has begun anew: its next frame is its newest."""
        self._newest = -1
        self._newest_ns = self._rate_ns = self._rate_count = self._run = self._last = 0
        self._seen = 0  # bit k: the number `newest - k` has come
        self._rate_hz = self._lag = 0.0

    def _note_rate(self, time_ns: int) -> None:
        """Frames sent in a second, from the newest ones at times without a pause; rates change by command."""
        steady = time_ns - self._newest_ns < _STEADY_NS
        since_ns = time_ns - self._rate_ns
        if steady and since_ns < _RATE_NS:
            return
        if steady:
            rate_hz = (self._newest - self._rate_count) * _NS_PER_S / since_ns
            changed = abs(rate_hz - self._rate_hz) > 0.2 * rate_hz
            self._rate_hz = rate_hz if changed else self._rate_hz + 0.25 * (rate_hz - self._rate_hz)
        self._rate_count, self._rate_ns = self._newest, time_ns
