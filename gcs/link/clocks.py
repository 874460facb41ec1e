"""Round trip and clock offset of one vehicle, from its TIMESYNC exchanges.

One exchange gives RTT = t_receive - t_send and offset = t_remote - (t_send + t_receive) / 2. The error of this offset
is half the difference between the delays down and up, at most RTT / 2. Short round trips say most, so the estimate is a
straight line fitted to the offsets of the window, weighted by 1 / (RTT - least RTT + 0.2 ms)^2. It works at any RTT and
follows the drift of the vehicle's clock.

The bound of the error does not depend on that line. The vehicle read its clock after the request left and before the
reply arrived, so t_remote - t_receive <= offset <= t_remote - t_send. Between exchanges these limits move apart by
DRIFT_BOUND. The line is kept between them, and the bound is the distance to the farther one. It holds for any delay,
loss and asymmetry as long as the clock drifts by less than DRIFT_BOUND and has not jumped since the newest exchange.

Limits that contradict each other show that the clock has jumped. A jump shorter than a round trip may not contradict
them, but makes exchanges differ from the line by more than their round trips and the earlier residuals explain. The
first such exchange resets the limits; the third in a row is reported as a clock jump.

Telemetry shows a jump sooner: a state cannot have been sampled after it was received, nor before one that was sent
earlier. Such a state is refused, and an exchange is due at once to decide. An overtaken state may predate a jump: it
proves nothing, and after a jump it is refused.

The loop delay of a loop closed over the ground is free of the offset's error, see `gcs.control.loop_delay`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scenarios.schema import DRIFT_MAX_PPM

WINDOW = 128
"""Exchanges kept for each vehicle: 13 s at 10 Hz, over which a drifting clock is straight to a few µs."""
LEAST_SAMPLES = 5
"""A clock counts as known after this many exchanges."""
LATEST_NS = 1 << 62
"""Largest plausible clock reading, 146 years; a clock set back may be negative. Differences fit 64 bits."""
REQUEST_LIFETIME_NS = 20_000_000_000
_LONG_AGO_NS = -(1 << 62)
DRIFT_BOUND = DRIFT_MAX_PPM * 1e-6
"""Rate difference of two clocks beyond which a change of offset is a jump, not drift."""
DOUBTS = 3
"""This many doubtful exchanges, with none between them that fits the line, are reported as a jump."""
_UNUSUAL = 1.5
"""An exchange this many times farther from the line than any in the window is an outlier, not jitter."""
_READING_NS = 1000
"""Resolution of the stamps: those of a telemetry log are whole microseconds."""
_BOOT_MS_NS = 1_000_000
_WRAP_NS = _BOOT_MS_NS << 32
"""time_boot_ms wraps after this, 49.7 days; a clock set back to before its boot wraps too."""
_DOUBTFUL_NS = 10_000
"""An exchange this close to the line is never doubtful."""
_WEIGHT_FLOOR_NS = 200_000.0
_EVERY_SAMPLE = 32
_ESTIMATE_EVERY = 4
"""After the first samples the line is fitted at every fourth only, to save time, and extrapolated in between."""
_sum = np.add.reduce
"""np.sum, at half its cost for so few samples."""


class ClockEstimate(NamedTuple):
    """A vehicle's boot clock minus the station's clock, at `reference_ns` of the station's clock.

    `bound_ns` is the largest error of the offset there; `bound_at_ns` gives it at other times.
    """

    samples: int
    offset_ns: int
    skew: float
    bound_ns: int
    reference_ns: int

    def offset_at_ns(self, time_ns: int) -> int:
        return self.offset_ns + round(self.skew * (time_ns - self.reference_ns))

    def bound_at_ns(self, time_ns: int) -> float:
        """The largest error of the offset, or of an instant from `to_station_ns`, near a time of the station."""
        return self.bound_ns + (DRIFT_BOUND + abs(self.skew)) * abs(time_ns - self.reference_ns)

    def to_station_ns(self, boot_ns: int) -> int:
        """The station's time at an instant of the vehicle's boot clock."""
        first = boot_ns - self.offset_ns
        return first - round(self.skew * (first - self.reference_ns))


UNKNOWN = ClockEstimate(samples=0, offset_ns=0, skew=0.0, bound_ns=0, reference_ns=0)


class VehicleClock:
    """TIMESYNC exchanges with one vehicle, and what they show of its clock and its link."""

    def __init__(self) -> None:
        self.estimate = UNKNOWN
        self.jumps = 0
        self.rtt_ns: int | None = None
        """Round trip of the newest exchange."""
        self.down_ns: int | None = None
        """One-way delay from station to vehicle in the newest exchange, by the estimated offset."""
        self.down_bound_ns = 0.0
        """Its largest error."""
        self.unmatched = 0
        self.backdated_ns = 0
        """The most by which the timestamps of the vehicle's replies are too early."""
        self.lost = False
        """Whether the clock is known to have jumped, but not yet by how much."""
        self.asked_ns = 0
        """When the last request was sent."""
        self._doubtful_state = False
        self._newest_boot_ns = _LONG_AGO_NS
        """Boot time of the newest accepted state since the last jump."""
        self._pending: dict[int, None] = {}
        self._count = 0
        self._sent_ns: NDArray[np.int64] = np.zeros(WINDOW, dtype=np.int64)
        self._rtt_ns: NDArray[np.int64] = np.zeros(WINDOW, dtype=np.int64)
        self._offset_ns: NDArray[np.int64] = np.zeros(WINDOW, dtype=np.int64)
        self._least_ns = self._unusual_ns = 0
        """Least round trip and largest residual of the window at the last fit."""
        self._low_ns = self._low_at_ns = self._high_ns = self._high_at_ns = 0
        """Limits of the offset, each with the time at which it held."""
        self._since_ns = -1
        """When the first exchange since the last jump was requested."""
        self._doubts = 0
        self._doubted_ns = 0
        """Residual of the first doubtful exchange."""

    def request(self, now_ns: int) -> int:
        """Note a request sent now; returns its ts1, unique among the pending requests."""
        self.asked_ns = now_ns
        while now_ns in self._pending:
            now_ns += 1
        self._pending[now_ns] = None
        oldest = next(iter(self._pending))
        if now_ns - oldest > REQUEST_LIFETIME_NS:
            del self._pending[oldest]
        return now_ns

    @property
    def exchange_due(self) -> bool:
        """Whether a state was refused since the newest exchange, so that the next exchange must not wait."""
        return self.lost or self._doubtful_state

    def boot_ns(self, boot_ms: int, near_ns: int) -> int:
        """The instant on the vehicle's clock of a time_boot_ms received near a station time, with wraps undone."""
        boot_ns = boot_ms * _BOOT_MS_NS
        if self.estimate.samples == 0:
            return boot_ns
        turns = (self.estimate.offset_at_ns(near_ns) + near_ns - boot_ns + _WRAP_NS // 2) // _WRAP_NS
        return boot_ns + turns * _WRAP_NS

    def sampled_ns(self, boot_ms: int, received_ns: int, *, newest: bool) -> int | None:
        """The station's time at which a state was sampled; None if it is unknown or impossible.

        `newest` says that its sequence number shows that it was sent after all states received before.
        """
        known = self.estimate
        if known.samples == 0:
            return None
        boot_ns = self.boot_ns(boot_ms, received_ns)
        sample_ns = known.to_station_ns(boot_ns)
        if sample_ns - received_ns > known.bound_at_ns(sample_ns) + _BOOT_MS_NS:
            if newest:  # else it may be of the clock before a jump
                self.lost, self._since_ns, self._count = True, received_ns, 0
                self.estimate = UNKNOWN._replace(skew=known.skew)
            return None
        if newest and boot_ns < self._newest_boot_ns:
            self._doubtful_state = True  # or a replay too old for sequence numbers to show: the exchange decides
            return None
        if not newest and sample_ns < self._since_ns:
            return None  # of the clock before a jump that an exchange has shown: its instant is unknown
        self._newest_boot_ns = max(boot_ns, self._newest_boot_ns)
        return sample_ns

    def reply(self, *, tc1_ns: int, ts1_ns: int, received_ns: int) -> int | None:
        """Take in a reply; returns the round trip in ns, or None if it answers no request or its time is impossible."""
        if ts1_ns not in self._pending or received_ns < ts1_ns or abs(tc1_ns) >= LATEST_NS:
            self.unmatched += 1
            return None
        del self._pending[ts1_ns]
        rtt = self.rtt_ns = received_ns - ts1_ns
        if ts1_ns < self._since_ns:
            return rtt  # from before a jump that a newer exchange has shown
        self._doubtful_state = False
        middle = ts1_ns + rtt // 2
        offset = tc1_ns - middle
        low, high = tc1_ns - received_ns - _READING_NS, tc1_ns - ts1_ns + _READING_NS + self.backdated_ns
        if self.lost or self._contradicts(low, received_ns, high, ts1_ns):
            self._jumped(ts1_ns, keep=0)
        doubtful = self._is_doubtful(offset, rtt, middle)
        if self._count == 0 or doubtful:
            self._low_ns, self._low_at_ns, self._high_ns, self._high_at_ns = low, received_ns, high, ts1_ns
        else:
            self._narrow(low, received_ns, high, ts1_ns)
        slot = self._count % WINDOW
        self._sent_ns[slot], self._rtt_ns[slot], self._offset_ns[slot] = middle, rtt, offset
        self._count += 1
        if self._doubts == DOUBTS:
            self._jumped(ts1_ns, keep=DOUBTS)
        if self._doubts == 0 and (self._count <= _EVERY_SAMPLE or self._count % _ESTIMATE_EVERY == 0):
            self.estimate = self._estimated(middle)
        self.estimate = self._within_limits(middle)
        self.down_ns = min(rtt, max(0, self.estimate.to_station_ns(tc1_ns) - ts1_ns))
        self.down_bound_ns = self.estimate.bound_at_ns(ts1_ns + self.down_ns)
        return rtt

    def _contradicts(self, low_ns: int, low_at_ns: int, high_ns: int, high_at_ns: int) -> bool:
        """Whether new limits exclude the known ones, however the clock has drifted in between."""
        if self._count == 0:
            return False
        return (
            low_ns - self._high_ns > DRIFT_BOUND * abs(low_at_ns - self._high_at_ns)
            or self._low_ns - high_ns > DRIFT_BOUND * abs(high_at_ns - self._low_at_ns)
        )  # fmt: skip

    def _narrow(self, low_ns: int, low_at_ns: int, high_ns: int, high_at_ns: int) -> None:
        """Keep the tighter of the old and the new limits, compared at the newer time."""
        at_ns = max(low_at_ns, self._low_at_ns)
        mine, new = self._low_ns - _drift(at_ns - self._low_at_ns), low_ns - _drift(at_ns - low_at_ns)
        self._low_ns, self._low_at_ns = max(mine, new), at_ns
        at_ns = max(high_at_ns, self._high_at_ns)
        mine, new = self._high_ns + _drift(at_ns - self._high_at_ns), high_ns + _drift(at_ns - high_at_ns)
        self._high_ns, self._high_at_ns = min(mine, new), at_ns

    def _is_doubtful(self, offset_ns: int, rtt_ns: int, at_ns: int) -> bool:
        """Whether an exchange is farther off the line than jitter explains; counts such exchanges.

        If one way alone became slower by x, so did the round trip, and the offset is off by x / 2.
        """
        if self._count < 2 * LEAST_SAMPLES:
            return False
        known = self.estimate
        off_ns = abs(offset_ns - known.offset_at_ns(at_ns))
        explained_ns = (
            abs(rtt_ns - self._least_ns) / 2
            + _UNUSUAL * self._unusual_ns
            + DRIFT_BOUND * abs(at_ns - known.reference_ns)
            + _DOUBTFUL_NS
            + self.backdated_ns
        )
        if off_ns > explained_ns:
            self._doubts += 1
            self._doubted_ns = off_ns if self._doubts == 1 else self._doubted_ns
            return True
        if explained_ns < self._doubted_ns:
            self._doubts = self._doubted_ns = 0
        return False

    def _jumped(self, ts1_ns: int, *, keep: int) -> None:
        """Start over with the newest exchanges."""
        newest = [k % WINDOW for k in range(self._count - keep, self._count)]
        for kept in (self._sent_ns, self._rtt_ns, self._offset_ns):
            kept[:keep] = kept[newest]
        self.jumps += 1
        self.lost, self._newest_boot_ns = False, _LONG_AGO_NS
        self._count, self._doubts, self._doubted_ns, self._since_ns = keep, 0, 0, ts1_ns

    def _within_limits(self, at_ns: int) -> ClockEstimate:
        """The estimate at a time: the line, moved between the limits."""
        known = self.estimate
        low_ns = self._low_ns - _drift(abs(at_ns - self._low_at_ns))
        high_ns = self._high_ns + _drift(abs(at_ns - self._high_at_ns))
        offset_ns = min(max(known.offset_at_ns(at_ns), low_ns), high_ns)
        bound_ns = max(high_ns - offset_ns, offset_ns - low_ns)
        return ClockEstimate(min(self._count, WINDOW), offset_ns, known.skew, bound_ns, at_ns)

    def _estimated(self, now_ns: int) -> ClockEstimate:
        n = min(self._count, WINDOW)
        rtt = self._rtt_ns[:n]
        least = int(rtt.min())
        weight = 1.0 / (rtt - least + _WEIGHT_FLOOR_NS) ** 2
        weight /= _sum(weight)
        t = (self._sent_ns[:n] - now_ns).astype(float)
        base = int(self._offset_ns[(self._count - 1) % WINDOW])
        y = (self._offset_ns[:n] - base).astype(float)
        # Sums of products, not `@`: BLAS adds in an order that depends on the processor, and flights must not.
        t_mean, y_mean = _sum(weight * t), _sum(weight * y)
        t -= t_mean
        y -= y_mean
        weighted = weight * t
        spread = _sum(weighted * t)
        # The slope of a short stretch would be noise: below 0.3 s (rms) of history the former rate is kept, at first 0.
        skew = float(_sum(weighted * y) / spread) if spread > 0.09e18 else self.estimate.skew
        skew = min(DRIFT_BOUND, max(-DRIFT_BOUND, skew))
        self._least_ns, self._unusual_ns = least, round(float(np.abs(y - skew * t).max()))
        offset = base + round(y_mean - skew * t_mean)
        return ClockEstimate(samples=n, offset_ns=offset, skew=skew, bound_ns=0, reference_ns=now_ns)


def _drift(time_ns: int) -> int:
    """The most that a clock drifts in a time."""
    return round(DRIFT_BOUND * time_ns)
