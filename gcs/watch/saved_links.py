"""Makes a link profile from observed links: their one-way delays in order, and runs of lost datagrams.

Up delays are those of position reports and TIMESYNC replies, from the vehicle's time stamps. Down delays are those of
TIMESYNC requests; each stands for all datagrams until the next exchange. Both depend on the estimated offset of the
vehicle's clock, which exchanges show only to within half a round trip. Its error adds to one direction what it takes
from the other, so their sum is right. The least delays are equal both ways, unless the bounds of the clock exclude it.

Losses up are counted from sequence numbers, as in a flight. Losses down, and whether datagrams overtake others there,
cannot be observed here and are assumed to be the same.
"""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from gains.core.arrays import FloatArray
from gcs.errors import InputError
from gcs.link import mavlink
from gcs.link.clocks import boot_ns_of, to_station_ns
from gcs.watch.links import Watch, WatchedVehicle
from scenarios.keys.link import TRACE_DELAYS, Jitter, Link, LossBursts
from scenarios.keys.profile import Latency, LinkProfile, Measured
from scenarios.link_files import dump_profile

_SETTLED = 20
"""Exchanges after which a clock is known well enough for one-way delays."""
_BOOT_ROUNDING_S = 0.0005
"""Mean truncation of `time_boot_ms`. It lengthens every delay of a position report, so it is subtracted."""
_LEAST = 10
"""Fewest delays each way that suffice for a profile."""


class _OneVehicle:
    def __init__(self) -> None:
        self.up_s: list[float] = []
        self.down_s: list[float] = []
        self.bound_s = 0.0
        self.frames = self.lost = self.late = 0
        self.runs: list[int] = []
        """Length of each run of lost frames."""
        self.exchanges = 0
        self.boot_ms: int | None = None
        """Stamp of the newest position."""

    def count(self, lost: int) -> None:
        """Take in the number of frames lost so far. A late frame lowers it and shortens the newest run."""
        more, self.lost = lost - self.lost, lost
        if more > 0:
            self.runs.append(more)
        while more < 0 and self.runs:
            left = self.runs.pop() + more
            self.runs.extend([left] if left > 0 else [])
            more = min(left, 0)


class LinkRecorder:
    """Keeps each vehicle's delays and losses from the frames that a `Watch` has taken in.

    These are the autopilots' frames: cameras and gimbals share a vehicle's id but number their frames separately.
    """

    def __init__(self) -> None:
        self._seen: dict[int, _OneVehicle] = {}

    def note(self, vehicle: WatchedVehicle, frame: mavlink.Frame, received_ns: int) -> None:
        own = self._seen.setdefault(frame.system_id, _OneVehicle())
        own.frames += 1
        own.count(vehicle.remote.frames.lost)
        own.late = vehicle.remote.frames.late
        clock, exchanges = vehicle.remote.clock, len(vehicle.rtt_s)
        if exchanges > own.exchanges:
            own.exchanges = exchanges
            if exchanges > _SETTLED and clock.down_ns is not None:
                own.down_s.append(clock.down_ns * 1e-9)
                own.bound_s = max(own.bound_s, clock.down_bound_ns * 1e-9)
        if exchanges <= _SETTLED or not clock.samples or clock.exchange_due:
            return  # the clock is unknown, or may have jumped
        if frame.msg_id == mavlink.LOCAL_POSITION_NED:
            if frame.fields[0] == own.boot_ms:
                return  # an old state, sent once more
            own.boot_ms = frame.fields[0]
            sampled_ns = to_station_ns(clock.estimate, boot_ns_of(clock.estimate, frame.fields[0], received_ns))
            own.up_s.append(max(0.0, (received_ns - sampled_ns) * 1e-9 - _BOOT_ROUNDING_S))
        elif frame.msg_id == mavlink.TIMESYNC and frame.fields[0] != 0:
            own.up_s.append(max(0.0, (received_ns - to_station_ns(clock.estimate, frame.fields[0])) * 1e-9))

    @property
    def measured(self) -> list[int]:
        """The vehicles with enough delays for a profile."""
        return sorted(k for k, own in self._seen.items() if len(own.up_s) >= _LEAST and len(own.down_s) >= _LEAST)

    def profile(self, source: str, *, only: int | None = None, option: str = "--save-links") -> LinkProfile:
        """The links of all vehicles, their delays concatenated, or of one. Raises InputError if there are too few."""
        seen = [self._seen[k] for k in self.measured if only in (None, k)]
        if not seen:
            wanted = f"{_LEAST} delays each way of a vehicle, after its first {_SETTLED} TIMESYNC exchanges"
            raise InputError(f"{option}: read {sum(len(own.down_s) for own in self._seen.values())}, wanted {wanted}")
        up, down = (np.concatenate([getattr(own, name) for own in seen]) for name in ("up_s", "down_s"))
        each = max(1, round(len(up) / len(down)))
        lost, received = [run for own in seen for run in own.runs], sum(own.frames for own in seen)
        loss = None
        if lost:  # Gilbert's model, with bursts of the same mean length and frequency as the runs
            # each datagram of a burst ends it with probability r, so it lasts 1 / r; each good one begins one with p
            to_bad, to_good = len(lost) / max(received, len(lost)), len(lost) / sum(lost)
            loss = LossBursts(to_bad_probability=to_bad, to_good_probability=to_good)
        bound_s, reordering = max(own.bound_s for own in seen), any(own.late for own in seen)
        return LinkProfile(
            source=source,
            licence="of whoever measured it",
            up=_link(up, loss, reordering=reordering),
            down=_link(np.repeat(down, each), loss, reordering=reordering),
            measured=Measured(up=_latency(up, bound_s, lost), down=_latency(down, bound_s, [])),
        )


def recorded(frames: Iterable[tuple[int, mavlink.Frame]]) -> LinkRecorder:
    """The delays and losses of the links in a log of any tool."""
    watch, recorder = Watch(), LinkRecorder()
    for time_ns, frame in frames:
        if (vehicle := watch.take(frame, time_ns)) is not None:
            recorder.note(vehicle, frame, time_ns)
    return recorder


def save(profile: LinkProfile, file: Path) -> None:
    """Write a profile for `links.profile` or --links."""
    assert profile.measured is not None
    head = (
        f"# Links measured by gcs: {profile.measured.up.datagrams} delays up, {profile.measured.down.datagrams} down.\n"
    )
    file.write_text(head + dump_profile(profile), encoding="utf-8")


def describe(profile: LinkProfile) -> list[str]:
    """The latencies of a measured profile in the terms of RFC 7679 and RFC 5481, one line for each direction."""
    measured = profile.measured
    assert measured is not None
    return [
        f"{name:8} one-way delay {1e3 * of.delay_s_min:.2f} ms least, {1e3 * of.delay_s_p50:.2f} p50, "
        f"{1e3 * of.delay_s_p99:.2f} p99, calibration error {1e3 * of.calibration_error_s:.2f}; "
        f"PDV p99 {1e3 * of.variation_s_p99:.2f}, IPDV p99 {1e3 * of.variation_next_s_p99:.2f}"
        + (f"; {of.lost} lost in {of.loss_runs} runs, the longest {of.loss_run_longest}" if of.lost else "")
        for name, of in (("up", measured.up), ("down", measured.down))
    ]


def _link(delays_s: FloatArray, loss: LossBursts | None, *, reordering: bool) -> Link:
    """A link whose datagrams have these delays, in order; with `reordering` they may overtake others."""
    trace = tuple(round(delay_s, 6) for delay_s in delays_s[:TRACE_DELAYS].tolist())
    return Link(jitter=Jitter(distribution="trace", trace_s=trace), loss_bursts=loss, reordering=reordering)


def _latency(delays_s: FloatArray, bound_s: float, runs: list[int]) -> Latency:
    p50, p99 = np.percentile(delays_s, [50, 99]).tolist()
    least = float(delays_s.min())
    figures = Counter(lost=sum(runs), loss_runs=len(runs), loss_run_longest=max(runs, default=0))
    return Latency(
        datagrams=len(delays_s),
        delay_s_min=round(least, 6),
        delay_s_p50=round(p50, 6),
        delay_s_p99=round(p99, 6),
        calibration_error_s=round(bound_s, 6),
        variation_s_p99=round(p99 - least, 6),
        variation_next_s_p99=round(float(np.percentile(np.abs(np.diff(delays_s)), 99)), 6),
        **figures,
    )
