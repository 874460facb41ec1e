"""Loss, lateness and duplication from MAVLink's 8-bit sequence numbers."""

from scenarios.schema import NS_PER_S

_KEPT = 128
"""How far back the sequence counter remembers which frames arrived."""
_SEEN = (1 << _KEPT) - 1
NEW, LATE, DUPLICATE = 0, 1, 2
_NO_DOUBT = 100.0 * NS_PER_S
"""While fewer than 100 frames are expected, the next number is the next frame."""
_STEADY_NS = NS_PER_S // 2
"""A pause longer than this says nothing about the rate."""
_RATE_NS = NS_PER_S
"""The rate is measured over intervals of this length, each weighted less than the next by the factor below. To count
the losses of a minute's outage correctly, the rate must be known to about half a per cent, whatever the jitter."""
_OLDER = 0.9
_AHEAD, _LEAST_AHEAD = 127, 32
"""A frame may be this much newer than its time suggests, because the newest one may itself have been late. The farther
frames have lately been overtaken, the smaller this allowance is, down to the second figure."""
_MOST = 0xFFFFFFFF
"""The largest count that the tick record holds: a log whose clock jumps by centuries seems to have lost more."""
_FORGET = 1.0 / 512
_RUN, _RUN_STEP = 8, 4
"""This many late frames in a row, each newer than the last by at most the second figure, are new after all: an
earlier, very late frame was taken for a new one."""


class SequenceCounter:
    """Counts the frames of one sender: received, lost, late (received after a newer one) and duplicate.

    A sequence number holds 8 bits of the count; time gives the rest. A frame can be only slightly newer than the frame
    rate suggests; one that seems newer than that is an old one. So a swapped pair is one late frame, not 254 lost ones,
    and the losses of an outage of a minute are counted in full. A frame overtaken by more than 223 others is
    miscounted. A late frame no longer counts as lost.
    """

    __slots__ = (
        "_lag", "_last", "_newest", "_newest_ns", "_rate_count", "_rate_hz", "_rate_ns", "_run", "_seen",
        "_steady_frames", "_steady_ns", "duplicate", "late", "lost", "received",
    )  # fmt: skip

    def __init__(self) -> None:
        self.received = self.lost = self.late = self.duplicate = 0
        self.restart()

    def add(self, sequence: int, time_ns: int) -> int:
        """Count a frame received at a time: NEW if it is newer than all before it, else LATE or DUPLICATE."""
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
            # A short cut: most frames are simply the next one. The general case below gives the same.
            self._lag *= 1.0 - _FORGET
            self._seen = (self._seen << 1 | 1) & _SEEN
            self._newest += 1
            if since_ns >= _STEADY_NS or time_ns - self._rate_ns >= _RATE_NS:
                self._note_rate(time_ns)
            self._newest_ns = time_ns
            return NEW
        passed = int(expected) // NS_PER_S
        most = passed + max(_LEAST_AHEAD, _AHEAD - int(self._lag))
        ahead = most - ((most - sequence + self._newest) & 0xFF)
        if ahead <= 0 and 0 < step <= _RUN_STEP:
            self._run += 1
            if self._run == _RUN:
                self.lost -= ahead + 255  # nobody knows whether any of these are lost
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
        """Take the next frame as the first: the sender has restarted."""
        self._newest = -1
        self._newest_ns = self._rate_ns = self._rate_count = self._run = self._last = 0
        self._seen = 0  # bit k: frame number `newest - k` has arrived
        self._rate_hz = self._lag = self._steady_frames = self._steady_ns = 0.0

    def _note_rate(self, time_ns: int) -> None:
        """Update the rate of frames sent, from times without a pause."""
        steady = time_ns - self._newest_ns < _STEADY_NS
        since_ns = time_ns - self._rate_ns
        if steady and since_ns < _RATE_NS:
            return
        if steady:
            self._steady_frames = _OLDER * self._steady_frames + (self._newest - self._rate_count)
            self._steady_ns = _OLDER * self._steady_ns + since_ns
            self._rate_hz = self._steady_frames / self._steady_ns * NS_PER_S
        self._rate_count, self._rate_ns = self._newest, time_ns
