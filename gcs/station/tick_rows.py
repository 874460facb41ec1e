"""Fills the rows of the tick record."""

from math import nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray, IntArray
from gcs.control.loop_delay import headroom, loop_delay_s
from gcs.control.tick import TICK, TickArray
from gcs.link.clocks import UNKNOWN, bound_at_ns, estimate_of, offset_at_ns
from gcs.link.vehicle import Links, delivery_ns
from gcs.plan.mismatch import used_s
from scenarios.kernel import Array, Records, kernel

_headroom, _loop_delay_s, _used_s = kernel(headroom), kernel(loop_delay_s), kernel(used_s)


class Judged(NamedTuple):
    """Results of the monitor and the control law for n vehicles at a tick, as arrays of n."""

    system_id: NDArray[np.int64]
    mode: NDArray[np.int64]
    gain_set: NDArray[np.int64]
    controls: Records
    """Of `gcs.control.law.CONTROL`."""
    reported: Records
    """Of `gcs.station.reception.REPORTED`."""
    rtt_s: FloatArray
    """The oldest completed round trip that is in no earlier tick; NaN if there is none."""
    commanded: NDArray[np.bool_]
    shorter_s: FloatArray
    """How much shorter or longer than assumed the loop delay may be, (n, sets): see `gcs.plan.mismatch.Tolerated`."""
    longer_s: FloatArray
    repeated_s: FloatArray
    """See `gcs.control.loop_delay.repeated_s`."""


class Tick(NamedTuple):
    """One control tick of the formation, before its set-points are sent."""

    number: int
    time_s: float
    due_ns: int
    key_ms: int
    judged: Judged | None
    """None until the set-points are sent, if kernels have made them."""
    set_point_indices: IntArray
    """For each vehicle, the index of its set-point among the datagrams of the step; -1 if it was sent none."""


def tick_rows(
    tick: Tick, judged: Judged, links: Links, nearest_m: FloatArray, sent_ns: NDArray[np.int64]
) -> tuple[TickArray, FloatArray]:
    """The rows of a tick, and how much of its margin each vehicle uses, in s.

    `nearest_m` holds each vehicle's distance to its nearest neighbour, NaN while unknown, and `sent_ns` when its
    set-point was handed to the kernel. The part of the margin used is the loop delay, or with prediction the mismatch:
    see `gcs.plan.mismatch.used_s`.
    """
    rows, used = np.empty(len(sent_ns), TICK), np.empty(len(sent_ns))
    fill(rows, used, links.known, links.clocks.known, links.counters, judged, nearest_m, sent_ns, *tick[:4])
    return rows, used


@kernel
def fill(
    rows: Records, used: Array, links: Records, clocks: Records, counters: Records, judged: Judged,
    nearest_m: Array, sent_ns: Array, number: int, time_s: float, due_ns: int, key_ms: int,
) -> None:  # fmt: skip
    most_s = 0.0
    for k in range(len(rows)):
        bound_s = judged.reported[k].bound_s
        most_s = bound_s if bound_s > most_s else most_s  # skips NaN, the bound of an unknown state
    for k in range(len(rows)):
        row, control, reported = rows[k], judged.controls[k], judged.reported[k]
        clock, counter, own_ns = clocks[k], counters[k], sent_ns[k]
        row.tick, row.time_s, row.due_ns, row.sent_ns = number, time_s, due_ns, own_ns
        row.key_ms, row.system_id = key_ms, judged.system_id[k]
        row.mode, row.gain_set, row.commanded = judged.mode[k], judged.gain_set[k], judged.commanded[k]
        row.sample_boot_ms, row.sample_ns = reported.boot_ms, control.sample_ns
        known = control.sample_ns > 0
        row.telemetry_age_s = (own_ns - control.sample_ns) * 1e-9 if known else nan
        row.up_delay_s = (reported.received_ns - control.sample_ns) * 1e-9 if known else nan
        row.north_m, row.east_m, row.down_m = control.state[0], control.state[1], reported.down_m
        row.velocity_north_m_s, row.velocity_east_m_s = control.state[2], control.state[3]
        row.velocity_down_m_s = reported.velocity_down_m_s
        row.spacing_error_north_m, row.spacing_error_east_m = control.spacing_error_m[0], control.spacing_error_m[1]
        row.velocity_error_north_m_s = control.velocity_error_m_s[0]
        row.velocity_error_east_m_s = control.velocity_error_m_s[1]
        row.command_north_m_s2 = control.command_m_s2[0] if row.commanded else nan
        row.command_east_m_s2 = control.command_m_s2[1] if row.commanded else nan
        row.nearest_m, row.queue_s, row.sample_bound_s = nearest_m[k], reported.queue_s, reported.bound_s
        down_s = down_bound_s = loop_bound_s = nan
        down_ns = delivery_ns(links[k], clock, key_ms, own_ns)
        if down_ns != UNKNOWN:
            down_s, down_bound_s = down_ns * 1e-9, clock.down_bound_ns * 1e-9
            loop_bound_s = clock.loop_bound_ns * 1e-9
            if control.used_ns != control.sample_ns:  # timed by another vehicle's clock: both errors add
                loop_bound_s = most_s + down_bound_s
        row.down_delay_s, row.down_bound_s, row.loop_delay_bound_s = down_s, down_bound_s, loop_bound_s
        row.clock_offset_s = row.clock_offset_bound_s = nan
        if clock.samples:
            estimate = estimate_of(clock)
            row.clock_offset_s = offset_at_ns(estimate, own_ns) * 1e-9
            row.clock_offset_bound_s = bound_at_ns(estimate, own_ns) * 1e-9
        repeated_s = judged.repeated_s[k]
        loop_s = _loop_delay_s(control.used_ns, own_ns, down_s, repeated_s)
        margin_s = judged.longer_s[k, judged.gain_set[k]]
        # the age of a state is known, so only the set-point can be mismatched: it acts at another instant than assumed
        mismatch_s = (own_ns - control.acts_ns) * 1e-9 + down_s if control.acts_ns > 0 else loop_s
        used[k] = _used_s(judged.shorter_s[k, judged.gain_set[k]], margin_s, mismatch_s)
        row.loop_delay_s, row.repeated_s, row.rtt_s = loop_s, repeated_s, judged.rtt_s[k]
        row.assumed_delay_s, row.delay_margin_s = control.assumed_s, control.assumed_s + margin_s
        row.headroom = _headroom(used[k], margin_s) if margin_s > 0.0 else nan
        row.received, row.lost = counter.received, counter.lost
        row.late, row.duplicate = counter.late, counter.duplicate
