"""Packs the rows of the tick record from what the station knows at a tick."""

import struct
from collections.abc import Sequence
from math import nan
from typing import NamedTuple

import numpy as np

from gcs.control.law import VehicleControl
from gcs.control.loop_delay import headroom, loop_delay_s
from gcs.control.tick import TICK, TickArray
from gcs.link.vehicle import RemoteVehicle
from gcs.plan.mismatch import Tolerated
from gcs.station.monitor import VehicleState

_CODES = {"<i8": "q", "<u4": "I", "<f8": "d", "|u1": "B", "|b1": "?"}
_ROW = struct.Struct("<" + "".join(_CODES[np.dtype(TICK[name]).str] for name in TICK.names or ()))


class Reported(NamedTuple):
    """What came with a vehicle's newest state."""

    boot_ms: int = 0
    down_m: float = nan
    velocity_down_m_s: float = nan
    queue_s: float = nan
    received_ns: int = 0
    """The kernel's stamp."""
    bound_s: float = nan
    """The largest error of the instant at which the state was sampled."""


class Tick(NamedTuple):
    """One control tick of the formation, before its set-points are sent. Lists have a place for each vehicle."""

    number: int
    time_s: float
    due_ns: int
    key_ms: int
    vehicles: Sequence[RemoteVehicle]
    monitored: Sequence[VehicleState]
    controls: Sequence[VehicleControl]
    reported: Sequence[Reported]
    rtt_s: Sequence[float]
    """The oldest completed round trip that no earlier tick holds; NaN if there is none."""
    commanded: Sequence[bool]
    tolerated: Sequence[Tolerated]
    """How far the loop delay may be from the assumed delay."""
    repeated_s: Sequence[float]
    """See `gcs.control.loop_delay.Repetitions`."""
    set_point_indices: Sequence[int]
    """Index of the vehicle's set-point among the datagrams of the step; -1 if it was sent none."""


def tick_rows(tick: Tick, nearest_m: Sequence[float], sent_ns: Sequence[int]) -> tuple[TickArray, list[float]]:
    """The rows of a tick, and how much of its margin each vehicle uses.

    `nearest_m` holds each vehicle's distance to the nearest other, NaN while unknown, and `sent_ns` when its set-point
    was handed to the kernel. What is used is in s, see `gcs.plan.mismatch.Tolerated.used_s`: the loop delay, or the
    mismatch with prediction.
    """
    packed: list[bytes] = []
    every_used_s: list[float] = []
    for vehicle, monitored, control, reported, rtt_s, commanded, tolerated, repeated_s, near_m, own_ns in zip(
        *tick[4:-1], nearest_m, sent_ns, strict=True
    ):
        clock, frames = vehicle.clock, vehicle.frames
        estimate = clock.estimate
        age_s = (own_ns - control.sample_ns) * 1e-9 if control.sample_ns > 0 else nan
        up_s = (reported.received_ns - control.sample_ns) * 1e-9 if control.sample_ns > 0 else nan
        down_s = down_bound_s = loop_bound_s = nan
        down_ns = vehicle.delivery_ns(tick.key_ms, own_ns)
        if down_ns is not None:
            down_s, down_bound_s = down_ns * 1e-9, clock.down_bound_ns * 1e-9
            loop_bound_s = clock.loop_bound_ns * 1e-9 if control.used_ns == control.sample_ns else nan
        offset_s = bound_s = nan
        if estimate.samples > 0:
            offset_s, bound_s = estimate.offset_at_ns(own_ns) * 1e-9, estimate.bound_at_ns(own_ns) * 1e-9
        loop_s = loop_delay_s(control.used_ns, own_ns, down_s, repeated_s)
        margin_s = tolerated.longer_s[monitored.gain_set]
        # the age of a state is known, so only a set-point that acts at another instant than assumed is a mismatch
        mismatch_s = (own_ns - control.acts_ns) * 1e-9 + down_s if control.acts_ns > 0 else loop_s
        used_s = tolerated.used_s(monitored.gain_set, mismatch_s)
        every_used_s.append(used_s)
        packed.append(
            _ROW.pack(
                tick.number, tick.time_s, tick.due_ns, own_ns, tick.key_ms, vehicle.system_id,
                monitored.mode, monitored.gain_set, commanded,
                reported.boot_ms, control.sample_ns, age_s,
                *control.state[:2], reported.down_m, *control.state[2:], reported.velocity_down_m_s,
                *control.spacing_error_m, *control.velocity_error_m_s,
                *(control.command_m_s2 if commanded else (nan, nan)),
                near_m, reported.queue_s, up_s, reported.bound_s, down_s, down_bound_s,
                loop_s, loop_bound_s, repeated_s, control.assumed_s, control.assumed_s + margin_s,
                headroom(used_s, margin_s) if margin_s > 0.0 else nan, rtt_s,
                offset_s, bound_s,
                frames.received, frames.lost, frames.late, frames.duplicate,
            )
        )  # fmt: skip
    return np.frombuffer(bytearray().join(packed), TICK), every_used_s
