"""Round trips and clock offsets from TIMESYNC, for every vehicle at once.

One exchange gives RTT = t_receive - t_send and offset = t_remote - (t_send + t_receive) / 2. The offset is wrong by
half of what the way up was slower than the way down, at most RTT / 2. Exchanges with a short round trip say most, so
the estimate is a straight line through the window's offsets, weighted by 1 / (RTT - least RTT + 0.2 ms)^2: it works at
any RTT and follows the drift of the vehicle's clock.

For a loop closed over the ground an error of the offset cancels: it makes the telemetry look older by what it makes the
command look younger.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

WINDOW = 128
"""Exchanges kept for each vehicle: 13 s at 10 Hz, over which a drifting clock is straight to a few µs."""
LEAST_SAMPLES = 5
"""Exchanges wanted before a clock counts as known."""
REQUEST_LIFETIME_NS = 20_000_000_000
DRIFT_BOUND = 1e-3
"""Rate difference of two clocks beyond which a change of offset is a jump, not drift."""
_WEIGHT_FLOOR_NS = 200_000.0
_EVERY_SAMPLE = 32
_ESTIMATE_EVERY = 4
"""Past the first samples the line is drawn anew only at each fourth: in between it is followed, which costs nothing."""


@dataclass(frozen=True)
class ClockEstimate:
    """Offset of one vehicle's boot clock against the station's, at `reference_ns` of the station's clock."""

    samples: int
    offset_ns: int
    skew: float
    bound_ns: int
    reference_ns: int

    def to_station_ns(self, boot_ns: int) -> int:
        """The station's time at an instant of the vehicle's boot clock."""
        first = boot_ns - self.offset_ns
        return first - round(self.skew * (first - self.reference_ns))


UNKNOWN = ClockEstimate(samples=0, offset_ns=0, skew=0.0, bound_ns=0, reference_ns=0)


class VehicleClock:
    """TIMESYNC exchanges with one vehicle, and what they say of its clock and its link."""

    def __init__(self) -> None:
        self.estimate = UNKNOWN
        self.jumps = 0
        self.rtt_ns: int | None = None
        """Round trip of the newest exchange."""
        self.down_ns: int | None = None
        """One-way delay station to vehicle of the newest exchange, by the estimated offset."""
        self.unmatched = 0
        self._pending: dict[int, None] = {}
        self._count = 0
        self._sent_ns: NDArray[np.int64] = np.zeros(WINDOW, dtype=np.int64)
        self._rtt_ns: NDArray[np.int64] = np.zeros(WINDOW, dtype=np.int64)
        self._offset_ns: NDArray[np.int64] = np.zeros(WINDOW, dtype=np.int64)

    def request(self, now_ns: int) -> int:
        """Note a request sent now; returns its ts1, which is unique among those waiting."""
        while now_ns in self._pending:
            now_ns += 1
        self._pending[now_ns] = None
        oldest = next(iter(self._pending))
        if now_ns - oldest > REQUEST_LIFETIME_NS:
            del self._pending[oldest]
        return now_ns

    def reply(self, *, tc1_ns: int, ts1_ns: int, received_ns: int) -> int | None:
        """Take a reply in; returns the round trip in ns, or None if it answers nothing that was asked."""
        if ts1_ns not in self._pending or received_ns < ts1_ns:
            self.unmatched += 1
            return None
        del self._pending[ts1_ns]
        rtt = received_ns - ts1_ns
        middle = ts1_ns + rtt // 2
        offset = tc1_ns - middle
        if self._contradicts(offset, rtt, middle):
            self.jumps += 1
            self._count = 0
        slot = self._count % WINDOW
        self._sent_ns[slot], self._rtt_ns[slot], self._offset_ns[slot] = middle, rtt, offset
        self._count += 1
        if self._count <= _EVERY_SAMPLE or self._count % _ESTIMATE_EVERY == 0:
            self.estimate = self._estimated(middle)
        self.rtt_ns = rtt
        self.down_ns = self.estimate.to_station_ns(tc1_ns) - ts1_ns
        return rtt

    def _contradicts(self, offset_ns: int, rtt_ns: int, at_ns: int) -> bool:
        """Whether the offset differs from the estimate by more than both errors and drift can explain."""
        known = self.estimate
        if self._count < LEAST_SAMPLES:
            return False
        passed = at_ns - known.reference_ns
        expected = known.offset_ns + known.skew * passed
        return abs(offset_ns - expected) > rtt_ns / 2 + known.bound_ns + DRIFT_BOUND * abs(passed)

    def _estimated(self, now_ns: int) -> ClockEstimate:
        n = min(self._count, WINDOW)
        rtt = self._rtt_ns[:n]
        least = int(rtt.min())
        weight = 1.0 / (rtt - least + _WEIGHT_FLOOR_NS) ** 2
        weight /= weight.sum()
        t = (self._sent_ns[:n] - now_ns).astype(float)
        base = int(self._offset_ns[(self._count - 1) % WINDOW])
        y = (self._offset_ns[:n] - base).astype(float)
        # Sums of products, not `@`: BLAS adds in an order of each processor's own, and flights are the same on all.
        t_mean, y_mean = (weight * t).sum(), (weight * y).sum()
        t -= t_mean
        spread = (weight * t * t).sum()
        # A slope from a short stretch would be noise: below 0.3 s (rms) of history the clock is taken as drift-free.
        skew = float((weight * t * (y - y_mean)).sum() / spread) if spread > 0.09e18 else 0.0
        offset = base + round(y_mean - skew * t_mean)
        return ClockEstimate(
            samples=n, offset_ns=offset, skew=skew, bound_ns=least // 2 + 1, reference_ns=now_ns
        )  # fmt: skip
