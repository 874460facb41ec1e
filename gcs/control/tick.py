"""The tick record: one row per vehicle and control tick, the contract between control, recording, reports and tests.

An `Event` records what happens between ticks.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

CLOCK_JUMPED = "its clock jumped"
"""Text of the event that reports a clock jump."""
NOT_CONFIRMED = "not confirmed"
"""Kind of the event that names the vehicles that did not confirm, at the end, that they hold or land."""
GAIN_SET = "gain set "
"""STATUSTEXT that announces a vehicle's new gain set: after the vehicle's name and before the number of the set."""
TickArray = NDArray[Any]
"""A structured array of dtype TICK: one row for each vehicle."""


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that happened in a flight: one line of events.jsonl. `time_s` is scenario time."""

    time_s: float
    kind: str
    system_id: int | None = None
    text: str
    counts: dict[str, int] | None = None
    """Number of occurrences of each thing named in the text; None if the event counts nothing."""

    @property
    def about(self) -> list[int]:
        """The vehicle that the event concerns, as a list; empty if it concerns none."""
        return [] if self.system_id is None else [self.system_id]


class Mode(IntEnum):
    """The station's judgement of one vehicle."""

    WAITING = 0  # not heard, or not yet ready to fly
    NOMINAL = 1  # flying, loop delay well below the margin
    CAUTION = 2  # flying, little headroom left
    CRITICAL = 3  # flying, next to no headroom left: the station acts
    FAILSAFE = 4  # heard, but it takes no set-points
    LOST = 5  # not heard
    RECOVERING = 6  # flying, its gains on the way back to faster ones


SEVERITY = {
    Mode.WAITING: 6,
    Mode.NOMINAL: 6,
    Mode.RECOVERING: 5,
    Mode.CAUTION: 4,
    Mode.LOST: 3,
    Mode.CRITICAL: 2,
    Mode.FAILSAFE: 1,
}
"""MAV_SEVERITY of a change to each mode: 6 info, 5 notice, 4 warning, 3 error, 2 critical, 1 alert."""
TICK = np.dtype(
    [
        ("tick", "<i8"),  # number of the control tick, from 0; a missing number is a skipped tick
        ("time_s", "<f8"),  # scenario time; below 0 before the formation is flown
        ("due_ns", "<i8"),  # when the tick was due, station clock
        ("sent_ns", "<i8"),  # when the vehicle's set-point, or else the tick's last datagram, went to the kernel
        ("key_ms", "<u4"),  # time_boot_ms of its set-points: joins this log with the vehicles' own
        ("system_id", "<u2"),  # the vehicle that the row is about
        ("mode", "u1"),  # its mode, as a number
        ("gain_set", "u1"),  # index in the gain schedule; 0 is the fastest
        ("commanded", "?"),  # a set-point was sent to this vehicle
        ("sample_boot_ms", "<u4"),  # time_boot_ms of the newest state used
        ("sample_ns", "<i8"),  # the same instant on the station's clock, estimated
        ("telemetry_age_s", "<f8"),  # sent_ns - sample_ns; NaN while the vehicle's clock is unknown
        ("north_m", "<f8"),  # newest state, local NED
        ("east_m", "<f8"),
        ("down_m", "<f8"),
        ("velocity_north_m_s", "<f8"),
        ("velocity_east_m_s", "<f8"),
        ("velocity_down_m_s", "<f8"),
        ("spacing_error_north_m", "<f8"),  # e^p at the instant of the newest state; NaN for the leader
        ("spacing_error_east_m", "<f8"),
        ("velocity_error_north_m_s", "<f8"),  # e^v
        ("velocity_error_east_m_s", "<f8"),
        ("command_north_m_s2", "<f8"),  # set-point, acceleration; NaN when none was sent
        ("command_east_m_s2", "<f8"),
        ("nearest_m", "<f8"),  # distance to the nearest other vehicle, at the tick's instant; NaN while unknown
        ("queue_s", "<f8"),  # time from the kernel's receive stamp of the newest state until the station read it
        ("up_delay_s", "<f8"),  # one-way delay of the newest state: from sample_ns to the kernel's receive stamp
        ("sample_bound_s", "<f8"),  # largest error of sample_ns, telemetry_age_s and up_delay_s (gcs/link/clocks.py)
        ("down_delay_s", "<f8"),  # newest one-way delay to the vehicle, plus the time it holds set-points; or NaN
        ("down_bound_s", "<f8"),  # largest error of down_delay_s
        ("loop_delay_s", "<f8"),  # age of the state used + down_delay_s - repeated_s; onboard: of the oldest one used
        ("loop_delay_bound_s", "<f8"),  # largest error of loop_delay_s due to clocks
        ("repeated_s", "<f8"),  # how long set-points have repeated one state because telemetry is slower
        ("assumed_delay_s", "<f8"),  # loop delay over which the vehicle was predicted; 0 without prediction
        ("delay_margin_s", "<f8"),  # longest loop delay that the gains flown tolerate, as known then; infinite: any
        ("headroom", "<f8"),  # 1 - loop delay / margin; predicted: 1 - mismatch of set-point / distance to window's end
        ("rtt_s", "<f8"),  # a completed TIMESYNC round trip that is in no earlier row; NaN if there is none
        ("clock_offset_s", "<f8"),  # vehicle's boot clock minus station clock, at sent_ns
        ("clock_offset_bound_s", "<f8"),  # largest error of clock_offset_s
        ("received", "<u4"),  # frames from this vehicle so far: received, lost, late (overtaken), duplicate
        ("lost", "<u4"),
        ("late", "<u4"),
        ("duplicate", "<u4"),
    ]
)


def in_sequence(ticks: Sequence[TickArray]) -> TickArray:
    """The rows of ticks, concatenated. Numpy copies bytes 20 times faster than records."""
    return np.concatenate([rows.view(np.uint8) for rows in ticks]).view(TICK)


def chosen(rows: TickArray, which: NDArray[Any]) -> TickArray:
    """Records selected by a mask or by indices: a view if they are equally spaced, else copied as bytes."""
    places = which.nonzero()[0] if which.dtype == bool else which
    steps = np.diff(places)
    if steps.size and steps[0] > 0 and (steps == steps[0]).all():
        return rows[places[0] : places[-1] + 1 : steps[0]]
    return np.ascontiguousarray(rows).view(np.dtype((np.void, rows.itemsize)))[which].view(rows.dtype)
