"""Loss, lateness and duplication from MAVLink's 8-bit sequence numbers."""

_WINDOW = 128
NEW, LATE, DUPLICATE = 0, 1, 2


class SequenceCounter:
    """Counts frames of one sender: received, lost, late (came after a newer one) and duplicate.

    The difference to the newest number is taken as signed (-128..127), so a swapped pair is one late frame and not 254
    lost ones; a late frame is taken back from the lost ones. Losses of 128 frames and more in a row are undercounted:
    the number does not hold more.
    """

    __slots__ = ("_newest", "_seen", "duplicate", "late", "lost", "received")

    def __init__(self) -> None:
        self.received = self.lost = self.late = self.duplicate = 0
        self._newest = -1
        self._seen = 0  # bit k: the number `newest - k` has come

    def add(self, sequence: int) -> int:
        """Count a frame; NEW if it is newer than all before it, LATE, or DUPLICATE."""
        self.received += 1
        if self._newest < 0:
            self._newest = sequence
            self._seen = 1
            return NEW
        ahead = (sequence - self._newest) & 0xFF
        if 0 < ahead < _WINDOW:
            self.lost += ahead - 1
            self._seen = (self._seen << ahead | 1) & ((1 << _WINDOW) - 1)
            self._newest = sequence
            return NEW
        bit = 1 << (-ahead & 0xFF)
        if self._seen & bit:
            self.duplicate += 1
            return DUPLICATE
        self.late += 1
        self.lost = max(0, self.lost - 1)
        self._seen |= bit
        return LATE

    def restart(self) -> None:
        """The sender has begun anew: its next frame is its newest."""
        self._newest = -1
