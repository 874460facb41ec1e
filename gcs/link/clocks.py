"""Round trip and clock offset of one vehicle, from its TIMESYNC exchanges.

One exchange gives RTT = t_receive - t_send and offset = t_remote - (t_send + t_receive) / 2. The error of this offset
is half the difference between the delays down and up, at most RTT / 2. The estimate is a straight line over a sliding
window of exchanges. Its slope is a least-squares fit to their offsets, weighted by 1 / (RTT - least RTT + 0.2 ms)^2. If
jitter may have tilted the new slope by more than the uncertainty of the previous one, the previous slope is kept.

The level of the line is midway between two limits of the offset: the shortest delay up sets the lower, the shortest
delay down the upper. With jitter the two rarely belong to the same exchange. While exchanges are few, the first states
also count as delays up: `time_boot_ms` is rounded down, so no state is sampled before its stamp or after its reception.
If the shortest delays in the window exceed those behind the previous line by more than drift explains, the previous
line is extrapolated. A single wrong stamp can set a limit. If stamps are known to err, the level is therefore the
weighted mean of the offsets, kept within the known stamp error of the midpoint.

The error bound does not depend on that line. The vehicle read its clock after the request left and before the
reply arrived, so t_remote - t_receive <= offset <= t_remote - t_send. Between exchanges these limits move apart by
DRIFT_BOUND. The line is kept between them, and the bound is the distance to the farther one. It holds for any delay,
loss and asymmetry as long as the clock drifts by less than DRIFT_BOUND and has not jumped since the newest exchange.

Limits that contradict each other show that the clock has jumped, or that replies carry wrong stamps: an autopilot may
backdate a stamp by the time the reply spends on a serial port, and a simulator's clock slips. A contradiction by more
than STAMPS_OFF_NS is a jump. A smaller one is doubtful; until it is resolved, the bound covers the limits from before
and after it. If later exchanges fit the limits from before, the contradiction was a stamp error: `stamp_error_ns` is
the largest so far, and later contradictions up to it are ignored. The eighth doubtful exchange in a row is a jump.

A jump shorter than a round trip may not contradict the limits. But exchanges then lie farther from the line than their
round trips, the earlier residuals and the known stamp error explain. Such exchanges are doubtful, too. If the first is
off by more than STAMPS_OFF_NS, the third is a jump, unless one in between fits the line well enough to refute it.

An error common to all stamps cannot be observed: it looks like an asymmetric link. `expected_error_ns` is the stamp
error known in advance for a kind of vehicle. The bound includes the largest error that exchanges have shown plus the
least round trip, because the exchange that showed it may itself have been off by that much.

Telemetry shows a jump sooner: a state cannot have been sampled after it was received, nor before one that was sent
earlier. Such a state is refused, and an exchange is due at once to decide. A state whose stamp is ahead of its
reception by no more than the bound is taken to have been sampled when it was received. An overtaken state may predate a
jump: it proves nothing, and after a jump it is refused.

In a loop closed on the ground, the error of the offset cancels from the loop delay, see `gcs.control.loop_delay`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scenarios.kernel import Array, Cell, Columns, Record, Records, array_kernel, at_row, kernel
from scenarios.schema import DRIFT_MAX_PPM

WINDOW = 128
"""Exchanges kept for each vehicle: 13 s at 10 Hz, during which clock drift is linear to within a few µs."""
LEAST_SAMPLES = 5
"""A clock counts as known after this many exchanges."""
LATEST_NS = 1 << 62
"""Largest plausible clock reading, 146 years; a clock set back may be negative. Differences fit 64 bits."""
REQUEST_LIFETIME_NS = 20_000_000_000
MOST_PENDING = 4096
"""Maximum number of unanswered requests remembered: 20 s at 200 Hz."""
UNANSWERED, UNANSWERED_NS = 10, 2_000_000_000
"""A vehicle that leaves this many requests in a row unanswered, over this time and three round trips, does not answer.
With 30 % of the datagrams lost each way, at 10 Hz, chance does it once in 40 hours: 1 / (q p^20) requests, q = 0.7^2,
p = 1 - q."""
_LONG_AGO_NS = -(1 << 62)
DRIFT_BOUND = DRIFT_MAX_PPM * 1e-6
"""Maximum rate difference of two clocks; an offset that changes faster has jumped."""
DOUBTS, SMALL_DOUBTS = 3, 8
"""Doubtful exchanges that make a jump: if the first is off by more than STAMPS_OFF_NS, and in a row otherwise. With two
fifths of all replies off, eight in a row that exceed all before are rarer than once in a thousand first doubts."""
STAMPS_OFF_NS = 20_000_000
"""The largest plausible error of a reply's stamp: 115 bytes at 57600 baud."""
_SETTLED = 32
"""Before this many exchanges, a small jump is indistinguishable from stamp errors, whose size is not yet known."""
_UNUSUAL = 1.5
"""An exchange this many times farther from the line than any in the window is an outlier, not jitter."""
_READING_NS = 1000
"""Resolution of the stamps: those of a telemetry log are whole microseconds."""
_BOOT_MS_NS = 1_000_000
_WRAP_NS = _BOOT_MS_NS << 32
"""time_boot_ms wraps after this, 49.7 days; a clock set back to before its boot wraps too."""
_DOUBTFUL_NS = 10_000
"""An exchange this close to the line is never doubtful."""
_FLOOR_NS = 200_000.0  # queueing shorter than this does not distinguish good exchanges from bad ones
_TILT = 100e-6
"""Upper bound of the rate difference of two crystals."""
_WANDER = 10e-6
"""Change of a crystal's rate with temperature."""
_EVERY_SAMPLE = 32
_ESTIMATE_EVERY = 5
"""After the first samples, the line is fitted only at every fifth, to save time, and extrapolated in between."""
UNKNOWN = -1
"""Stands for an unknown duration."""
_Floats = NDArray[np.float64]

CLOCK = np.dtype(
    [
        # the estimate: see `ClockEstimate`
        ("samples", "i8"), ("offset_ns", "i8"), ("skew", "f8"), ("bound_ns", "i8"), ("reference_ns", "i8"),
        ("jumps", "i8"),
        ("rtt_ns", "i8"),  # round trip of the newest exchange, or UNKNOWN
        ("down_ns", "i8"),  # one-way delay from station to vehicle in it, by the estimated offset, or UNKNOWN
        ("down_bound_ns", "f8"),  # its largest error
        ("loop_bound_ns", "f8"),  # largest clock error in a loop delay, age of newest state + down_ns
        ("unmatched", "i8"),  # replies that match no request
        ("expected_error_ns", "i8"),  # largest stamp error usual for this kind of vehicle
        ("stamp_error_ns", "f8"),  # largest stamp error that contradictions between exchanges have shown
        ("lost", "?"),  # the clock is known to have jumped, but not yet by how much
        ("asked_ns", "i8"),  # when the last request was sent
        ("unanswered", "i8"), ("waits_ns", "i8"),  # requests since the newest answered one; when the first was sent
        ("doubtful_state", "?"),  # a state was refused since the newest exchange
        ("newest_boot_ns", "i8"),  # boot time of the newest accepted state since the last jump
        ("count", "i8"),  # exchanges since the last jump
        ("pending", "i8"),  # requests without a reply
        ("state_low_ns", "i8"),  # tightest lower limit of the offset from the first states
        ("state_at_ns", "i8"),  # when the state that gave it was received
        ("least_ns", "i8"),  # least round trip of the window at the last fit
        ("unusual_ns", "i8"),  # largest residual at the last fit
        ("ways_ns", "f8"),  # shortest delay up plus shortest delay down behind the line
        ("fitted_ns", "i8"),  # when the line was fitted
        ("tilt", "f8"),  # largest error of the line's rate
        ("limits", "i8", (4,)),  # of the offset: see `Limits`
        ("in_doubt", "?"),  # an exchange was doubtful, and whether the clock jumped is still undecided
        ("limits_in_doubt", "i8", (4,)),  # limits since the first doubtful exchange
        ("doubtful_gap_ns", "f8"),  # largest contradiction of the doubtful exchanges
        ("ahead_ns", "f8"),  # largest lead, beyond the bound, of a state over its reception since the newest exchange
        ("held_back_ns", "i8"),  # largest such lead within the bound: the state counts as sampled at reception
        ("since_ns", "i8"),  # when the first exchange since the last jump was requested
        ("doubts", "i8"), ("doubts_in_a_row", "i8"),  # doubtful exchanges since they were last refuted, and in a row
        ("doubted_ns", "i8"),  # residual of the first doubtful exchange
    ],
    align=True,
)  # fmt: skip
"""Clock estimate and exchange statistics of one vehicle."""
EXCHANGES = np.dtype([("sent_ns", "i8"), ("rtt_ns", "i8"), ("offset_ns", "i8")])


class ClockEstimate(NamedTuple):
    """A vehicle's boot clock minus the station's clock, at `reference_ns` of the station's clock.

    `bound_ns` is the largest error of the offset there; `bound_at_ns` gives it at other times.
    """

    samples: int
    offset_ns: int
    skew: float
    bound_ns: int
    reference_ns: int


class Limits(NamedTuple):
    """Limits of the offset, each with the time at which it holds; away from that time they widen by DRIFT_BOUND."""

    low_ns: int
    low_at_ns: int
    high_ns: int
    high_at_ns: int


@kernel
def offset_at_ns(known: ClockEstimate, time_ns: int) -> int:
    return known.offset_ns + round(known.skew * (time_ns - known.reference_ns))


@kernel
def bound_at_ns(known: ClockEstimate, time_ns: int) -> float:
    """The largest error, near a station time, of the offset or of an instant from `to_station_ns`."""
    return known.bound_ns + (DRIFT_BOUND + abs(known.skew)) * abs(time_ns - known.reference_ns)


@kernel
def to_station_ns(known: ClockEstimate, boot_ns: int) -> int:
    """The station's time at an instant of the vehicle's boot clock."""
    first = boot_ns - known.offset_ns
    return first - round(known.skew * (first - known.reference_ns))


@kernel
def estimate_of(clock: Record) -> ClockEstimate:
    return ClockEstimate(clock.samples, clock.offset_ns, clock.skew, clock.bound_ns, clock.reference_ns)


@kernel
def _limits_in(four: Array) -> Limits:
    return Limits(four[0], four[1], four[2], four[3])


@kernel
def _set_limits(four: Array, limits: Limits) -> None:
    four[0], four[1], four[2], four[3] = limits


@kernel
def _low_at(limits: Limits, time_ns: int) -> int:
    return limits.low_ns - round(DRIFT_BOUND * abs(time_ns - limits.low_at_ns))


@kernel
def _high_at(limits: Limits, time_ns: int) -> int:
    return limits.high_ns + round(DRIFT_BOUND * abs(time_ns - limits.high_at_ns))


@kernel
def _gap_ns(own: Limits, other: Limits) -> float:
    """The gap between two pairs of limits that no drift can explain; 0 or less if they are compatible."""
    return max(
        other.low_ns - own.high_ns - DRIFT_BOUND * abs(other.low_at_ns - own.high_at_ns),
        own.low_ns - other.high_ns - DRIFT_BOUND * abs(other.high_at_ns - own.low_at_ns),
    )


@kernel
def _joined(own: Limits, other: Limits, tighter: bool) -> Limits:
    """The intersection (`tighter`) or the union of two pairs of limits, compared at the newer time."""
    low_at_ns, high_at_ns = max(own.low_at_ns, other.low_at_ns), max(own.high_at_ns, other.high_at_ns)
    low_ns, other_low_ns = _low_at(own, low_at_ns), _low_at(other, low_at_ns)
    high_ns, other_high_ns = _high_at(own, high_at_ns), _high_at(other, high_at_ns)
    if tighter:
        return Limits(max(low_ns, other_low_ns), low_at_ns, min(high_ns, other_high_ns), high_at_ns)
    return Limits(min(low_ns, other_low_ns), low_at_ns, max(high_ns, other_high_ns), high_at_ns)


@kernel
def request(clock: Record, pending_ns: NDArray[np.int64], now_ns: int) -> int:
    """Record a request sent now; returns its ts1, unique among the pending requests."""
    clock.asked_ns = now_ns
    clock.waits_ns = clock.waits_ns if clock.unanswered else now_ns
    clock.unanswered += 1
    while _place(clock, pending_ns, now_ns) >= 0:
        now_ns += 1
    if clock.pending == len(pending_ns):
        _drop(clock, pending_ns, 0)
    pending_ns[clock.pending, 0] = pending_ns[clock.pending, 1] = now_ns
    clock.pending += 1
    if now_ns - pending_ns[0, 0] > REQUEST_LIFETIME_NS:
        _drop(clock, pending_ns, 0)
    return now_ns


@kernel
def answers(clock: Record, now_ns: int) -> bool:
    """Whether a vehicle still answers requests. If not, its link down may be slower than last measured, or dead."""
    waited_ns = now_ns - clock.waits_ns
    return clock.unanswered < UNANSWERED or waited_ns <= UNANSWERED_NS + 3 * clock.rtt_ns


@kernel
def note_sent(clocks: Records, pending_ns: NDArray[np.int64], rows: Array, sent_ns: Array) -> None:
    """Record when the newest requests to some vehicles were actually sent, after the step that made them."""
    for k in range(len(rows)):
        place = clocks[rows[k]].pending - 1
        if place >= 0:
            pending_ns[rows[k], place, 1] = sent_ns[k]


@kernel
def _place(clock: Record, pending_ns: NDArray[np.int64], ts1_ns: int) -> int:
    """The index of a request among the pending ones, oldest first; -1 if it is not pending."""
    for place in range(clock.pending - 1, -1, -1):
        if pending_ns[place, 0] == ts1_ns:
            return place
    return -1


@kernel
def _drop(clock: Record, pending_ns: NDArray[np.int64], place: int) -> None:
    clock.pending -= 1
    for later in range(place, clock.pending):
        pending_ns[later, 0], pending_ns[later, 1] = pending_ns[later + 1, 0], pending_ns[later + 1, 1]


@kernel
def boot_ns_of(known: ClockEstimate, boot_ms: int, near_ns: int) -> int:
    """A time_boot_ms received near a station time, as an instant of the vehicle's clock with wraps undone."""
    boot_ns = boot_ms * _BOOT_MS_NS
    if known.samples == 0:
        return boot_ns
    turns = (offset_at_ns(known, near_ns) + near_ns - boot_ns + _WRAP_NS // 2) // _WRAP_NS
    return boot_ns + turns * _WRAP_NS


@kernel
def sampled_ns(clock: Record, boot_ms: int, received_ns: int, newest: bool) -> int:
    """The station's time at which a state was sampled; UNKNOWN if it is unknown or impossible.

    `newest`: its sequence number shows that it was sent after all states received before.
    """
    known = estimate_of(clock)
    if known.samples == 0:
        return UNKNOWN
    boot_ns = boot_ns_of(known, boot_ms, received_ns)
    sample_ns = to_station_ns(known, boot_ns)
    ahead_ns = sample_ns - received_ns
    if ahead_ns > 0:
        beyond_ns = ahead_ns - bound_at_ns(known, sample_ns) - _BOOT_MS_NS
        if beyond_ns > 0.0:
            _is_ahead(clock, beyond_ns, received_ns, newest)
            return UNKNOWN
        clock.held_back_ns = max(clock.held_back_ns, ahead_ns)
        sample_ns = received_ns
    if newest and boot_ns < clock.newest_boot_ns:
        clock.doubtful_state = True  # a jump, or a replay too old for sequence numbers to detect: the exchange decides
        return UNKNOWN
    if not newest and sample_ns < clock.since_ns:
        return UNKNOWN  # stamped before a jump that an exchange has shown, so its instant is unknown
    clock.newest_boot_ns = max(boot_ns, clock.newest_boot_ns)
    if newest and clock.count < _EVERY_SAMPLE and boot_ns - received_ns > clock.state_low_ns:
        clock.state_low_ns, clock.state_at_ns = boot_ns - received_ns, received_ns
    return sample_ns


@kernel
def _is_ahead(clock: Record, beyond_ns: float, received_ns: int, newest: bool) -> None:
    """Record a state stamped in the future. An overtaken one proves nothing: its stamp may predate a jump."""
    if newest and beyond_ns > STAMPS_OFF_NS:
        clock.lost, clock.since_ns, clock.count = True, received_ns, 0
        clock.samples = clock.offset_ns = clock.bound_ns = clock.reference_ns = 0
    elif newest:
        clock.ahead_ns, clock.doubtful_state = max(beyond_ns, clock.ahead_ns), True


@kernel
def reply(
    clock: Record, exchanges: Records, pending_ns: NDArray[np.int64], tc1_ns: int, ts1_ns: int, received_ns: int
) -> int:
    """Process a reply; returns the round trip in ns, or UNKNOWN if it answers no request or its time is impossible."""
    place = _place(clock, pending_ns, ts1_ns)
    sent_ns = pending_ns[place, 1] if place >= 0 else ts1_ns
    if place < 0 or received_ns < sent_ns or tc1_ns >= LATEST_NS or tc1_ns <= -LATEST_NS:
        clock.unmatched += 1
        return UNKNOWN
    _drop(clock, pending_ns, place)
    clock.unanswered = clock.pending - place
    clock.waits_ns = pending_ns[place, 1] if clock.unanswered else 0
    rtt = received_ns - sent_ns
    clock.rtt_ns = rtt
    if sent_ns < clock.since_ns:
        return rtt  # from before a jump that a newer exchange has shown
    clock.doubtful_state = False
    middle = sent_ns + rtt // 2
    offset = tc1_ns - middle
    own = Limits(tc1_ns - received_ns - _READING_NS, received_ns, tc1_ns - sent_ns + _READING_NS, sent_ns)
    gap_ns = _gap_ns(_limits_in(clock.limits), own) if clock.count else 0.0
    if clock.lost or gap_ns > STAMPS_OFF_NS:
        _jumped(clock, exchanges, sent_ns, 0)
    before = estimate_of(clock)
    if clock.count == 0:
        _set_limits(clock.limits, own)
    elif _is_doubtful(clock, offset, rtt, middle, gap_ns):
        _doubt(clock, own, gap_ns)
    else:
        _fit(clock, own)
    newest = exchanges[clock.count % WINDOW]
    newest.sent_ns, newest.rtt_ns, newest.offset_ns = middle, rtt, offset
    clock.count += 1
    if clock.doubts_in_a_row == SMALL_DOUBTS or (clock.doubts == DOUBTS and clock.doubted_ns > STAMPS_OFF_NS):
        _jumped(clock, exchanges, sent_ns, max(clock.doubts_in_a_row, DOUBTS))
    if clock.doubts == 0 and (clock.count <= _EVERY_SAMPLE or clock.count % _ESTIMATE_EVERY == 0):
        _estimate(clock, exchanges, middle)
    _stay_within_limits(clock, middle)
    _measure_down(clock, tc1_ns, sent_ns, rtt, before)
    return rtt


@kernel
def _measure_down(clock: Record, tc1_ns: int, ts1_ns: int, rtt_ns: int, before: ClockEstimate) -> None:
    """Set the delay down of an exchange, and the largest error of the loop delays computed from it.

    If the age of a state and this delay use the same offset, its error cancels. Four errors remain: that of the
    reply's stamp, the millisecond resolution of state stamps, the change of the estimate between the two, and the
    clipping that keeps either of them from being negative.
    """
    known = estimate_of(clock)
    down_ns = to_station_ns(known, tc1_ns) - ts1_ns
    clock.down_ns = min(rtt_ns, max(0, down_ns))
    clock.down_bound_ns = bound_at_ns(known, ts1_ns + clock.down_ns)
    changed_ns = since_ns = 0
    if before.samples:
        changed_ns = abs(known.offset_ns - offset_at_ns(before, known.reference_ns))
        since_ns = known.reference_ns - before.reference_ns
    clock.loop_bound_ns = (
        _stamps_off_ns(clock) + _READING_NS + _BOOT_MS_NS
        + changed_ns + (DRIFT_BOUND + abs(known.skew)) * (since_ns + rtt_ns)
        + abs(down_ns - clock.down_ns) + clock.held_back_ns
    )  # fmt: skip
    clock.held_back_ns = 0


@kernel
def _stamps_off_ns(clock: Record) -> float:
    """The largest error of a stamp, for the error bound."""
    shown_ns = clock.stamp_error_ns + clock.least_ns if clock.stamp_error_ns else 0.0
    return max(float(clock.expected_error_ns), shown_ns)


@kernel
def _explained_ns(clock: Record) -> float:
    """The largest contradiction that is put down to stamp errors."""
    return max(float(clock.expected_error_ns), clock.stamp_error_ns)


@kernel
def _doubt(clock: Record, own: Limits, gap_ns: float) -> None:
    """Keep the limits of a doubtful exchange separate from the established ones."""
    if clock.in_doubt:
        since = _limits_in(clock.limits_in_doubt)
        _set_limits(clock.limits_in_doubt, _joined(since, own, _gap_ns(since, own) <= _explained_ns(clock)))
    else:
        _set_limits(clock.limits_in_doubt, own)
    clock.in_doubt, clock.doubtful_gap_ns = True, max(gap_ns, clock.doubtful_gap_ns)
    clock.doubts_in_a_row += 1
    clock.ahead_ns = 0.0


@kernel
def _fit(clock: Record, own: Limits) -> None:
    """Tighten the limits by an exchange that fits them. It may show that earlier doubts were stamp errors."""
    clock.doubts_in_a_row = 0
    if clock.ahead_ns:
        clock.stamp_error_ns, clock.ahead_ns = _explained_ns(clock) + clock.ahead_ns, 0.0
    if clock.in_doubt:
        since = _limits_in(clock.limits_in_doubt)
        if clock.doubts and _gap_ns(since, own) <= _explained_ns(clock):
            _set_limits(clock.limits_in_doubt, _joined(since, own, True))
        else:
            clock.stamp_error_ns = max(clock.stamp_error_ns, clock.doubtful_gap_ns)
            clock.in_doubt, clock.doubtful_gap_ns, clock.doubts, clock.doubted_ns = False, 0.0, 0, 0
    _set_limits(clock.limits, _joined(_limits_in(clock.limits), own, True))


@kernel
def _is_doubtful(clock: Record, offset_ns: int, rtt_ns: int, at_ns: int, gap_ns: float) -> bool:
    """Whether an exchange contradicts the limits or is farther off the line than jitter explains; counts it if so.

    If the delay grows by x in one direction only, the round trip grows by x and the offset is off by x / 2.
    """
    contradicts = gap_ns > _explained_ns(clock)
    if clock.count < 2 * LEAST_SAMPLES and not contradicts:
        return False
    known = estimate_of(clock)
    off_ns = abs(offset_ns - offset_at_ns(known, at_ns))
    explained_ns = abs(rtt_ns - clock.least_ns) / 2 + _UNUSUAL * clock.unusual_ns + _explained_ns(clock)
    explained_ns += DRIFT_BOUND * abs(at_ns - known.reference_ns) + _DOUBTFUL_NS
    if contradicts or off_ns > explained_ns:
        clock.doubts += 1
        clock.doubted_ns = off_ns if clock.doubts == 1 else clock.doubted_ns
        return True
    if explained_ns < clock.doubted_ns:
        clock.doubts = clock.doubted_ns = 0
    return False


@array_kernel
def _jumped(clock: Record, exchanges: Records, ts1_ns: int, keep: int) -> None:
    """Start over with the newest `keep` exchanges.

    While the stamp error is still unknown, a change that it may explain is taken for that error and not for a jump.
    """
    newest = np.empty((keep, 3), np.int64)
    for k in range(keep):
        kept = exchanges[(clock.count - keep + k) % WINDOW]
        newest[k, 0], newest[k, 1], newest[k, 2] = kept.sent_ns, kept.rtt_ns, kept.offset_ns
    for k in range(keep):
        kept = exchanges[k]
        kept.sent_ns, kept.rtt_ns, kept.offset_ns = newest[k, 0], newest[k, 1], newest[k, 2]
    if keep == SMALL_DOUBTS and clock.count - keep < _SETTLED and clock.doubtful_gap_ns:
        clock.stamp_error_ns = max(clock.stamp_error_ns, clock.doubtful_gap_ns)
    else:
        clock.jumps += 1
    if clock.in_doubt:
        _set_limits(clock.limits, _limits_in(clock.limits_in_doubt))
    clock.lost, clock.newest_boot_ns = False, _LONG_AGO_NS
    clock.in_doubt, clock.doubtful_gap_ns, clock.ahead_ns = False, 0.0, 0.0
    clock.count, clock.since_ns = keep, ts1_ns
    clock.ways_ns, clock.tilt, clock.state_low_ns = float(LATEST_NS), _TILT, _LONG_AGO_NS
    clock.doubts = clock.doubts_in_a_row = clock.doubted_ns = 0


@kernel
def _stay_within_limits(clock: Record, at_ns: int) -> None:
    """Move the estimate to a time, clip it to the limits and set its bound."""
    known, limits = estimate_of(clock), _limits_in(clock.limits)
    if clock.in_doubt:
        limits = _joined(limits, _limits_in(clock.limits_in_doubt), False)
    one_ns, other_ns = _low_at(limits, at_ns), _high_at(limits, at_ns)
    low_ns, high_ns = min(one_ns, other_ns), max(one_ns, other_ns)  # stamp errors may make them cross
    offset_ns = min(max(offset_at_ns(known, at_ns), low_ns), high_ns)
    clock.bound_ns = max(high_ns - offset_ns, offset_ns - low_ns) + round(_stamps_off_ns(clock))
    clock.samples, clock.offset_ns, clock.reference_ns = min(clock.count, WINDOW), offset_ns, at_ns


@array_kernel
def _estimate(clock: Record, exchanges: Records, now_ns: int) -> None:
    """Fit the line to the exchanges of the window."""
    n, known, ageing = min(clock.count, WINDOW), estimate_of(clock), clock.tilt
    base = exchanges[(clock.count - 1) % WINDOW].offset_ns
    rtt, t, y, weight = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    least = exchanges[0].rtt_ns
    for k in range(n):
        least = min(least, exchanges[k].rtt_ns)
    for k in range(n):
        rtt[k], t[k], y[k] = exchanges[k].rtt_ns, exchanges[k].sent_ns - now_ns, exchanges[k].offset_ns - base
        excess = exchanges[k].rtt_ns - least + _FLOOR_NS
        weight[k] = 1.0 / (excess * excess)
    clock.least_ns = least
    weight /= _sum(weight)
    t_mean = _sum(weight * t)
    weighted = weight * (t - t_mean)
    spread = _sum(weighted * t)
    # A slope fitted to a short history is noise: below 0.3 s (rms) the previous one is kept, initially 0. It is also
    # kept if queueing, in whichever directions tilt the new line most, may tilt it by more than its uncertainty.
    skew, tilt, low_ns, high_ns = known.skew, ageing, 0.0, 0.0
    if spread > 0.09e18:
        skew = min(DRIFT_BOUND, max(-DRIFT_BOUND, _sum(weighted * y) / spread))
        low_ns, high_ns = _quickest(t, y, rtt, skew, ageing)
        tilt = _sum(np.abs(weighted) * (rtt - (high_ns - low_ns))) / (2.0 * spread)
    if tilt >= ageing:
        skew = known.skew
        low_ns, high_ns = _quickest(t, y, rtt, skew, ageing)
    if clock.state_low_ns > _LONG_AGO_NS:
        state_t = clock.state_at_ns - now_ns
        state_ns = clock.state_low_ns - base - skew * state_t
        low_ns = state_ns if state_ns + ageing * state_t > low_ns else low_ns
    ways_ns, offset_ns = high_ns - low_ns, (low_ns + high_ns) / 2.0
    off_ns = max(0.0, _explained_ns(clock) - (least - ways_ns) / 2.0)  # the mean errs by the queueing of its exchanges
    if off_ns > 0.0:
        offset_ns = min(max(_sum(weight * y) - skew * t_mean, offset_ns - off_ns), offset_ns + off_ns)
        ways_ns = max(ways_ns, float(least))  # this line is only as good as the quickest exchange
    # The offset errs by up to half the queueing in the shortest delays; an extrapolated one also errs by its drift.
    if ways_ns > clock.ways_ns + 2.0 * ageing * (now_ns - clock.fitted_ns) + _FLOOR_NS:
        skew, offset_ns = known.skew, float(offset_at_ns(known, now_ns) - base)
    else:
        clock.ways_ns, clock.fitted_ns = ways_ns, now_ns
        clock.tilt = min(ageing, tilt + _WANDER)
    clock.unusual_ns = round(np.abs(y - skew * t - offset_ns).max())
    clock.samples, clock.offset_ns, clock.skew = n, base + round(offset_ns), skew
    clock.bound_ns, clock.reference_ns = 0, now_ns


@array_kernel
def _quickest(t: _Floats, y: _Floats, rtt: _Floats, skew: float, ageing: float) -> tuple[float, float]:
    """Limits of the offset at t = 0, from the shortest delay up and the shortest delay down; they widen with age."""
    offset, way, aged = y - skew * t, (0.5 + 0.5 * skew) * rtt, ageing * t
    low, high = offset - way, offset + way
    return low[(low + aged).argmax()], high[(high - aged).argmin()]


@array_kernel
def _sum(values: _Floats) -> float:
    """The sum of at most 128 values, added in numpy's order on any processor."""
    total, whole = 0.0, len(values) - len(values) % 8
    if whole:
        part = values[:8].copy()
        for k in range(8, whole):
            part[k % 8] += values[k]
        total = ((part[0] + part[1]) + (part[2] + part[3])) + ((part[4] + part[5]) + (part[6] + part[7]))
    for k in range(whole, len(values)):
        total += values[k]
    return total


_request_at, _sampled_at, _reply_at = at_row(request), at_row(sampled_ns), at_row(reply)


class Clocks(NamedTuple):
    """The clocks of n vehicles."""

    known: Records
    """Of CLOCK, (n,)."""
    exchanges: Records
    """Of EXCHANGES, (n, WINDOW): a ring buffer of the newest since the last jump."""
    pending_ns: NDArray[np.int64]
    """ts1 of the unanswered requests and their send times, (n, most, 2), oldest first."""


def new_clocks(n: int) -> Clocks:
    """Clocks without any exchange yet."""
    known = np.zeros(n, CLOCK)
    known["rtt_ns"] = known["down_ns"] = UNKNOWN
    known["newest_boot_ns"] = known["state_low_ns"] = known["fitted_ns"] = _LONG_AGO_NS
    known["ways_ns"], known["tilt"], known["since_ns"] = LATEST_NS, _TILT, -1
    return Clocks(known, np.zeros((n, WINDOW), EXCHANGES), np.zeros((n, MOST_PENDING, 2), np.int64))


class VehicleClock:
    """Clock estimate and round trip of one vehicle, from its TIMESYNC exchanges: a view of one row of `Clocks`.

    Its attributes are described by the comments in `CLOCK`; None stands for UNKNOWN.
    """

    samples = Cell[int]()
    """Exchanges behind the estimate; 0 while the clock is unknown."""
    jumps, unmatched, expected_error_ns = Cell[int](), Cell[int](), Cell[int]()
    unanswered = Cell[int]()
    rtt_ns, down_ns = Cell[int | None](UNKNOWN), Cell[int | None](UNKNOWN)
    down_bound_ns, loop_bound_ns, stamp_error_ns = Cell[float](), Cell[float](), Cell[float]()

    def __init__(self, clocks: Clocks | None = None, row: int = 0) -> None:
        self._clocks, self._row = clocks or new_clocks(1), row
        self._columns = Columns(self._clocks.known)

    @property
    def estimate(self) -> ClockEstimate:
        return ClockEstimate(*(self._columns[name][self._row] for name in ClockEstimate._fields))

    @property
    def exchange_due(self) -> bool:
        """Whether a state was refused since the newest exchange: the next exchange must not wait."""
        return bool(self._columns["lost"][self._row] or self._columns["doubtful_state"][self._row])

    def request(self, now_ns: int) -> int:
        """Record a request sent now; returns its ts1, unique among the pending requests."""
        return _request_at(self._clocks.known, self._row, self._clocks.pending_ns[self._row], now_ns)

    def station_ns(self, boot_ms: int, received_ns: int) -> int | None:
        """A time_boot_ms in station time, without using it to judge the clock; None while the clock is unknown."""
        if not self.samples:
            return None
        known = self.estimate
        return min(received_ns, to_station_ns(known, boot_ns_of(known, boot_ms, received_ns)))

    def sampled_ns(self, boot_ms: int, received_ns: int, *, newest: bool) -> int | None:
        """The station's time at which a state was sampled; None if it is unknown or impossible."""
        sample_ns = _sampled_at(self._clocks.known, self._row, boot_ms, received_ns, newest)
        return None if sample_ns == UNKNOWN else sample_ns

    def reply(self, *, tc1_ns: int, ts1_ns: int, received_ns: int) -> int | None:
        """Process a reply; returns the round trip in ns, or None if it answers no request or its time is impossible."""
        (known, exchanges, pending_ns), row = self._clocks, self._row
        rtt_ns = _reply_at(known, row, exchanges[row], pending_ns[row], tc1_ns, ts1_ns, received_ns)
        return None if rtt_ns == UNKNOWN else rtt_ns
