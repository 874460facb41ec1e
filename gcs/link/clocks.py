"""Round trip and clock offset of one vehicle, from its TIMESYNC exchanges.

One exchange gives RTT = t_receive - t_send and offset = t_remote - (t_send + t_receive) / 2. The error of this offset
is half the difference between the delays down and up, at most RTT / 2. The estimate is a straight line. Its slope is
fitted to the offsets of the window, weighted by 1 / (RTT - least RTT + 0.2 ms)^2. The previous slope is kept if jitter
may have tilted the new one by more than the uncertainty of the previous one.

The line lies midway between two limits: the lower by the quickest way up, the upper by the quickest way down. With
jitter these are rarely ways of one exchange. While exchanges are few, the first states count as ways up, too:
`time_boot_ms` is rounded down, so no state is sampled before its stamp or after its reception. If the quickest ways of
the window are slower than those behind the previous line, by more than its drift explains, that line is extrapolated.
One wrong stamp can set a limit. Where stamps err, the estimate is the weighted mean of the offsets instead, kept within
the known error of the stamps from the midpoint.

The bound of the error does not depend on that line. The vehicle read its clock after the request left and before the
reply arrived, so t_remote - t_receive <= offset <= t_remote - t_send. Between exchanges these limits move apart by
DRIFT_BOUND. The line is kept between them, and the bound is the distance to the farther one. It holds for any delay,
loss and asymmetry as long as the clock drifts by less than DRIFT_BOUND and has not jumped since the newest exchange.

Limits that contradict each other show that the clock has jumped, or that replies carry wrong stamps: an autopilot may
backdate them by the time that their bytes take on a serial port, and a simulator's clock slips. A contradiction by
more than STAMPS_OFF_NS is a jump. A smaller one is in doubt; until it is decided, the bound covers the limits from
before it and since. If later exchanges fit the limits from before, the contradiction was an error of stamps:
`stamp_error_ns` is the largest seen so far, and later contradictions up to that size do not count. The eighth doubtful
exchange in a row is a jump.

A jump shorter than a round trip may not contradict the limits. But exchanges then lie farther from the line than their
round trips, the earlier residuals and the known error of the stamps explain. Such exchanges are doubtful, too; the
third in a row that is off by more than STAMPS_OFF_NS is a jump.

An error that is the same in all stamps cannot be seen: it looks like an asymmetric link. `expected_error_ns` holds what
is known beforehand of the errors of a kind of vehicle. The bound includes the largest error that exchanges have shown
and the least round trip: the exchange that showed it may itself have been off by that much.

Telemetry shows a jump sooner: a state cannot have been sampled after it was received, nor before one that was sent
earlier. Such a state is refused, and an exchange is due at once to decide. A state ahead of its reception by no more
than the bound is taken to have been sampled when it was received. An overtaken state may predate a jump: it proves
nothing, and after a jump it is refused.

In a loop closed on the ground, the error of the offset cancels from the loop delay, see `gcs.control.loop_delay`.
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
DOUBTS, SMALL_DOUBTS = 3, 8
"""This many doubtful exchanges in a row are a jump: those off by more than STAMPS_OFF_NS, and all others. With two
fifths of all replies off, eight in a row that exceed all before are rarer than once in a thousand first doubts."""
STAMPS_OFF_NS = 20_000_000
"""The largest plausible error of a reply's stamp: 115 bytes at 57600 baud."""
_SETTLED = 32
"""Before this many exchanges a small jump cannot be told from errors of stamps, whose size is not yet known."""
_UNUSUAL = 1.5
"""An exchange this many times farther from the line than any in the window is an outlier, not jitter."""
_READING_NS = 1000
"""Resolution of the stamps: those of a telemetry log are whole microseconds."""
_BOOT_MS_NS = 1_000_000
_WRAP_NS = _BOOT_MS_NS << 32
"""time_boot_ms wraps after this, 49.7 days; a clock set back to before its boot wraps too."""
_DOUBTFUL_NS = 10_000
"""An exchange this close to the line is never doubtful."""
_FLOOR_NS = 200_000.0  # queueing too short to tell good exchanges from bad ones
_TILT = 100e-6
"""An upper bound of how much the rates of two crystals differ."""
_WANDER = 10e-6
"""How far the rate of a crystal changes with its temperature."""
_EVERY_SAMPLE = 32
_ESTIMATE_EVERY = 5
"""After the first samples the line is fitted at every fifth only, to save time, and extrapolated in between."""
_Floats = NDArray[np.float64]
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


class _Limits(NamedTuple):
    """Limits of the offset, each with the time at which it holds; in between they move apart by DRIFT_BOUND."""

    low_ns: int
    low_at_ns: int
    high_ns: int
    high_at_ns: int

    def gap_ns(self, other: "_Limits") -> float:
        """By how much these limits exclude others, whatever the drift in between; 0 or less if they do not."""
        return max(
            other.low_ns - self.high_ns - DRIFT_BOUND * abs(other.low_at_ns - self.high_at_ns),
            self.low_ns - other.high_ns - DRIFT_BOUND * abs(other.high_at_ns - self.low_at_ns),
        )

    def joined(self, other: "_Limits", *, tighter: bool) -> "_Limits":
        """The tighter or the wider of both, compared at the newer time."""
        pick_low, pick_high = (max, min) if tighter else (min, max)
        low_at_ns, high_at_ns = max(self.low_at_ns, other.low_at_ns), max(self.high_at_ns, other.high_at_ns)
        low_ns = pick_low(self.low_at(low_at_ns), other.low_at(low_at_ns))
        high_ns = pick_high(self.high_at(high_at_ns), other.high_at(high_at_ns))
        return _Limits(low_ns, low_at_ns, high_ns, high_at_ns)

    def low_at(self, time_ns: int) -> int:
        return self.low_ns - round(DRIFT_BOUND * abs(time_ns - self.low_at_ns))

    def high_at(self, time_ns: int) -> int:
        return self.high_ns + round(DRIFT_BOUND * abs(time_ns - self.high_at_ns))


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
        self.loop_bound_ns = 0.0
        """The largest error that the clocks bring into a loop delay: age of the newest state plus `down_ns`."""
        self.unmatched = 0
        self.expected_error_ns = 0
        """The largest error of stamps that is usual for this kind of vehicle."""
        self.stamp_error_ns = 0.0
        """The largest error of stamps that contradictions between exchanges have shown."""
        self.lost = False
        """Whether the clock is known to have jumped, but not yet by how much."""
        self.asked_ns = 0
        """When the last request was sent."""
        self._doubtful_state = False
        self._newest_boot_ns = _LONG_AGO_NS
        """Boot time of the newest accepted state since the last jump."""
        self._pending: dict[int, None] = {}
        self._count = 0
        self._sent_ns, self._rtt_ns, self._offset_ns = (np.zeros(WINDOW, dtype=np.int64) for _ in range(3))
        self._state_low_ns, self._state_at_ns = _LONG_AGO_NS, 0
        """Lower limit of the offset by the quickest of the first states, and when that was received."""
        self._least_ns = self._unusual_ns = 0
        """Least round trip and largest residual of the window at the last fit."""
        self._ways_ns, self._fitted_ns = float(LATEST_NS), _LONG_AGO_NS
        """Quickest way up plus quickest way down behind the line; when it was fitted."""
        self._tilt = _TILT
        """The largest error of the line's rate."""
        self._known = _Limits(0, 0, 0, 0)
        """Limits of the offset."""
        self._doubtful: _Limits | None = None
        """Those since the first doubtful exchange, until it is decided whether the clock has jumped."""
        self._doubtful_gap_ns = 0.0
        """The largest contradiction of these."""
        self._ahead_ns = 0.0
        """The most by which a state since the newest exchange was sampled after it was received, beyond the bound."""
        self._held_back_ns = 0
        """The same within the bound: such a state is taken to have been sampled when it was received."""
        self._since_ns = -1
        """When the first exchange since the last jump was requested."""
        self._doubts = self._doubts_in_a_row = self._doubted_ns = 0
        """How many exchanges were doubtful, how many of these in a row, and the residual of the first."""

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

    def station_ns(self, boot_ms: int, received_ns: int) -> int | None:
        """The station's time of a time_boot_ms, not used to judge the clock; None while the clock is unknown."""
        if self.estimate.samples == 0:
            return None
        return min(received_ns, self.estimate.to_station_ns(self.boot_ns(boot_ms, received_ns)))

    def sampled_ns(self, boot_ms: int, received_ns: int, *, newest: bool) -> int | None:
        """The station's time at which a state was sampled; None if it is unknown or impossible.

        `newest` says that its sequence number shows that it was sent after all states received before.
        """
        known = self.estimate
        if known.samples == 0:
            return None
        boot_ns = self.boot_ns(boot_ms, received_ns)
        sample_ns = known.to_station_ns(boot_ns)
        ahead_ns = sample_ns - received_ns
        if ahead_ns > 0:
            beyond_ns = ahead_ns - known.bound_at_ns(sample_ns) - _BOOT_MS_NS
            if beyond_ns > 0.0:
                self._is_ahead(beyond_ns, received_ns, newest=newest)
                return None
            self._held_back_ns = max(self._held_back_ns, ahead_ns)
            sample_ns = received_ns
        if newest and boot_ns < self._newest_boot_ns:
            self._doubtful_state = True  # or a replay too old for sequence numbers to show: the exchange decides
            return None
        if not newest and sample_ns < self._since_ns:
            return None  # of the clock before a jump that an exchange has shown: its instant is unknown
        self._newest_boot_ns = max(boot_ns, self._newest_boot_ns)
        if newest and self._count < _EVERY_SAMPLE and boot_ns - received_ns > self._state_low_ns:
            self._state_low_ns, self._state_at_ns = boot_ns - received_ns, received_ns
        return sample_ns

    def _is_ahead(self, beyond_ns: float, received_ns: int, *, newest: bool) -> None:
        """Note a state from the future. An overtaken one may bear a stamp from before a jump: it proves nothing."""
        if newest and beyond_ns > STAMPS_OFF_NS:
            self.lost, self._since_ns, self._count = True, received_ns, 0
            self.estimate = UNKNOWN._replace(skew=self.estimate.skew)
        elif newest:
            self._ahead_ns, self._doubtful_state = max(beyond_ns, self._ahead_ns), True

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
        own = _Limits(tc1_ns - received_ns - _READING_NS, received_ns, tc1_ns - ts1_ns + _READING_NS, ts1_ns)
        gap_ns = self._known.gap_ns(own) if self._count else 0.0
        if self.lost or gap_ns > STAMPS_OFF_NS:
            self._jumped(ts1_ns, keep=0)
        before = self.estimate
        doubtful = self._count > 0 and self._is_doubtful(offset, rtt, middle, gap_ns)
        if self._count == 0:
            self._known = own
        elif doubtful:
            self._doubt(own, gap_ns)
        else:
            self._fit(own)
        slot = self._count % WINDOW
        self._sent_ns[slot], self._rtt_ns[slot], self._offset_ns[slot] = middle, rtt, offset
        self._count += 1
        if self._doubts_in_a_row == SMALL_DOUBTS or (self._doubts == DOUBTS and self._doubted_ns > STAMPS_OFF_NS):
            self._jumped(ts1_ns, keep=max(self._doubts_in_a_row, DOUBTS))
        if self._doubts == 0 and (self._count <= _EVERY_SAMPLE or self._count % _ESTIMATE_EVERY == 0):
            self.estimate = self._estimated(middle)
        self.estimate = self._within_limits(middle)
        self._measure_down(tc1_ns, ts1_ns, rtt, before)
        return rtt

    def _measure_down(self, tc1_ns: int, ts1_ns: int, rtt_ns: int, before: ClockEstimate) -> None:
        """The one-way delay of an exchange, and the largest error of the loop delays that it is used for.

        If the age of a state and this delay use the same offset, its error cancels. What remains is the error of the
        reply's stamp, the millisecond in which states are stamped, the change of the estimate between the two, and what
        keeps either of them from being negative.
        """
        known = self.estimate
        down_ns = known.to_station_ns(tc1_ns) - ts1_ns
        self.down_ns = min(rtt_ns, max(0, down_ns))
        self.down_bound_ns = known.bound_at_ns(ts1_ns + self.down_ns)
        changed_ns = abs(known.offset_ns - before.offset_at_ns(known.reference_ns)) if before.samples else 0
        since_ns = known.reference_ns - before.reference_ns if before.samples else 0
        self.loop_bound_ns = (
            self._stamps_off_ns() + _READING_NS + _BOOT_MS_NS
            + changed_ns + (DRIFT_BOUND + abs(known.skew)) * (since_ns + rtt_ns)
            + abs(down_ns - self.down_ns) + self._held_back_ns
        )  # fmt: skip
        self._held_back_ns = 0

    def _stamps_off_ns(self) -> float:
        """The largest error of a stamp."""
        return max(self.expected_error_ns, self.stamp_error_ns + self._least_ns if self.stamp_error_ns else 0.0)

    @property
    def _explained_ns(self) -> float:
        """Contradictions up to this are due to stamps."""
        return max(self.expected_error_ns, self.stamp_error_ns)

    def _doubt(self, own: _Limits, gap_ns: float) -> None:
        """Keep the limits of a doubtful exchange beside the known ones."""
        since = self._doubtful
        agree = since is not None and since.gap_ns(own) <= self._explained_ns
        self._doubtful = own if since is None else since.joined(own, tighter=agree)
        self._doubtful_gap_ns = max(gap_ns, self._doubtful_gap_ns)
        self._doubts_in_a_row += 1
        self._ahead_ns = 0.0

    def _fit(self, own: _Limits) -> None:
        """Narrow the limits by an exchange that fits them, which may show that earlier doubts were errors of stamps."""
        since, self._doubts_in_a_row = self._doubtful, 0
        if self._ahead_ns:
            self.stamp_error_ns, self._ahead_ns = self._explained_ns + self._ahead_ns, 0.0
        if since is not None:
            if self._doubts and since.gap_ns(own) <= self._explained_ns:
                self._doubtful = since.joined(own, tighter=True)
            else:
                self.stamp_error_ns = max(self.stamp_error_ns, self._doubtful_gap_ns)
                self._doubtful, self._doubtful_gap_ns, self._doubts, self._doubted_ns = None, 0.0, 0, 0
        self._known = self._known.joined(own, tighter=True)

    def _is_doubtful(self, offset_ns: int, rtt_ns: int, at_ns: int, gap_ns: float) -> bool:
        """Whether an exchange contradicts the limits, or is farther off the line than jitter explains; counts such.

        If one way alone became slower by x, so did the round trip, and the offset is off by x / 2.
        """
        contradicts = gap_ns > self._explained_ns
        if self._count < 2 * LEAST_SAMPLES and not contradicts:
            return False
        known = self.estimate
        off_ns = abs(offset_ns - known.offset_at_ns(at_ns))
        explained_ns = abs(rtt_ns - self._least_ns) / 2 + _UNUSUAL * self._unusual_ns + self._explained_ns
        explained_ns += DRIFT_BOUND * abs(at_ns - known.reference_ns) + _DOUBTFUL_NS
        if contradicts or off_ns > explained_ns:
            self._doubts += 1
            self._doubted_ns = off_ns if self._doubts == 1 else self._doubted_ns
            return True
        if explained_ns < self._doubted_ns:
            self._doubts = self._doubted_ns = 0
        return False

    def _jumped(self, ts1_ns: int, *, keep: int) -> None:
        """Start over with the newest exchanges.

        A change that stamps may explain is no jump while their error is not known yet: then it is taken for that error.
        """
        newest = [k % WINDOW for k in range(self._count - keep, self._count)]
        for kept in (self._sent_ns, self._rtt_ns, self._offset_ns):
            kept[:keep] = kept[newest]
        if keep == SMALL_DOUBTS and self._count - keep < _SETTLED and self._doubtful_gap_ns:
            self.stamp_error_ns = max(self.stamp_error_ns, self._doubtful_gap_ns)
        else:
            self.jumps += 1
        self._known = self._doubtful or self._known
        self.lost, self._newest_boot_ns = False, _LONG_AGO_NS
        self._doubtful, self._doubtful_gap_ns, self._ahead_ns = None, 0.0, 0.0
        self._count, self._since_ns = keep, ts1_ns
        self._ways_ns, self._tilt, self._state_low_ns = float(LATEST_NS), _TILT, _LONG_AGO_NS
        self._doubts = self._doubts_in_a_row = self._doubted_ns = 0

    def _within_limits(self, at_ns: int) -> ClockEstimate:
        """The estimate at a time: the line, moved between the limits."""
        known, since = self.estimate, self._doubtful
        limits = self._known if since is None else self._known.joined(since, tighter=False)
        low_ns, high_ns = sorted((limits.low_at(at_ns), limits.high_at(at_ns)))  # crossed by errors of stamps
        offset_ns = min(max(known.offset_at_ns(at_ns), low_ns), high_ns)
        bound_ns = max(high_ns - offset_ns, offset_ns - low_ns) + round(self._stamps_off_ns())
        return ClockEstimate(min(self._count, WINDOW), offset_ns, known.skew, bound_ns, at_ns)

    def _estimated(self, now_ns: int) -> ClockEstimate:
        n, known, ageing = min(self._count, WINDOW), self.estimate, self._tilt
        rtt, base = self._rtt_ns[:n], int(self._offset_ns[(self._count - 1) % WINDOW])
        self._least_ns = least = int(rtt.min())
        t, y = (self._sent_ns[:n] - now_ns).astype(float), (self._offset_ns[:n] - base).astype(float)
        weight = 1.0 / (rtt - least + _FLOOR_NS) ** 2
        weight /= _sum(weight)
        # Sums of products, not `@`: BLAS adds in an order that depends on the processor, and flights must not.
        t_mean = _sum(weight * t)
        weighted = weight * (t - t_mean)
        spread = _sum(weighted * t)
        # The slope of a short stretch would be noise: below 0.3 s (rms) of history the former rate is kept, at first 0.
        # So would that of exchanges which tilt the line by more than is known if they all queued on the same way.
        skew, tilt, low_ns, high_ns = known.skew, ageing, 0.0, 0.0
        if spread > 0.09e18:
            skew = min(DRIFT_BOUND, max(-DRIFT_BOUND, float(_sum(weighted * y) / spread)))
            low_ns, high_ns = _quickest(t, y, rtt, skew, ageing)
            tilt = float(_sum(np.abs(weighted) * (rtt - (high_ns - low_ns))) / (2.0 * spread))
        if tilt >= ageing:
            skew = known.skew
            low_ns, high_ns = _quickest(t, y, rtt, skew, ageing)
        state_t = self._state_at_ns - now_ns
        state_ns = self._state_low_ns - base - skew * state_t
        low_ns = state_ns if state_ns + ageing * state_t > low_ns else low_ns
        ways_ns, offset_ns = high_ns - low_ns, (low_ns + high_ns) / 2.0
        off_ns = max(0.0, self._explained_ns - (least - ways_ns) / 2.0)  # the mean errs by what its exchanges queued
        if off_ns > 0.0:
            offset_ns = min(max(float(_sum(weight * y) - skew * t_mean), offset_ns - off_ns), offset_ns + off_ns)
            ways_ns = max(ways_ns, float(least))  # this line is only as good as the quickest exchange
        # The offset is off by up to half of what the quickest ways queued; one extrapolated is off by its drift, too.
        if ways_ns > self._ways_ns + 2.0 * ageing * (now_ns - self._fitted_ns) + _FLOOR_NS:
            skew, offset_ns = known.skew, float(known.offset_at_ns(now_ns) - base)
        else:
            self._ways_ns, self._fitted_ns = ways_ns, now_ns
            self._tilt = min(ageing, tilt + _WANDER)
        self._unusual_ns = round(float(np.abs(y - skew * t - offset_ns).max()))
        return ClockEstimate(samples=n, offset_ns=base + round(offset_ns), skew=skew, bound_ns=0, reference_ns=now_ns)


def _quickest(t: _Floats, y: _Floats, rtt: NDArray[np.int64], skew: float, ageing: float) -> tuple[float, float]:
    """Limits of the offset at t = 0 by the quickest way up and the quickest down; they worsen with age."""
    offset, way, aged = y - skew * t, (0.5 + 0.5 * skew) * rtt, ageing * t
    low, high = offset - way, offset + way
    return float(low[(low + aged).argmax()]), float(high[(high - aged).argmin()])
