"""Each value of the tick record is in the column of its name."""

from math import inf, nan

import numpy as np
import pytest

from gcs.control.law import CONTROL
from gcs.control.tick import TICK, Mode
from gcs.link.clocks import ClockEstimate
from gcs.link.startup import LaunchedStartup
from gcs.link.vehicle import Links, RemoteVehicle, new_links
from gcs.station.reception import new_reported
from gcs.station.tick_rows import Judged, Tick, tick_rows

S = 1_000_000_000


def two_vehicles() -> tuple[Links, RemoteVehicle]:
    """The links of two vehicles, and the second vehicle."""
    links = new_links(2)
    return links, RemoteVehicle(7, startup=LaunchedStartup(50.0), links=links, row=1)


def test_every_column_holds_what_its_name_says() -> None:
    links, vehicle = two_vehicles()
    estimate = ClockEstimate(samples=9, offset_ns=3 * S, skew=0.0, bound_ns=5000, reference_ns=10 * S)
    links.clocks.known[list(estimate._fields)][1] = estimate
    vehicle.clock.down_ns, vehicle.clock.down_bound_ns = 30_000_000, 4000
    vehicle.clock.loop_bound_ns = 6000.0
    for sequence in (1, 2, 5, 4, 4):
        vehicle.frames.add(sequence, 0)
    controls, reported = np.zeros(2, CONTROL), new_reported(2)
    controls[1] = 10 * S, (1.0, 2.0, 3.0, 4.0), (5.0, 6.0), (7.0, 8.0), (9.0, 10.0), 10 * S, 0.1, 10 * S + 110_000_000
    reported[1] = 13_000, -100.0, 0.5, 0.001, 10 * S + 25_000_000, 3e-6
    judged = Judged(
        system_id=np.array([6, 7]), mode=np.array([0, Mode.CAUTION.value]), gain_set=np.array([0, 1]),
        controls=controls, reported=reported, rtt_s=np.array([nan, 0.07]), commanded=np.array([False, True]),
        shorter_s=np.array([(inf, 0.2)] * 2), longer_s=np.array([(0.2, 0.3)] * 2), repeated_s=np.array([0.0, 0.01]),
    )  # fmt: skip
    tick = Tick(11, 0.22, 10 * S + 40_000_000, 220, judged, set_point_indices=np.array([0, 1]))
    rows, used_s = tick_rows(tick, judged, links, np.array([nan, 121.5]), np.array([0, 10 * S + 50_000_000]))
    expected = {
        "tick": 11, "time_s": 0.22, "due_ns": 10 * S + 40_000_000, "sent_ns": 10 * S + 50_000_000, "key_ms": 220,
        "system_id": 7, "mode": 2, "gain_set": 1, "commanded": True,
        "sample_boot_ms": 13_000, "sample_ns": 10 * S, "telemetry_age_s": 0.05,
        "north_m": 1.0, "east_m": 2.0, "down_m": -100.0,
        "velocity_north_m_s": 3.0, "velocity_east_m_s": 4.0, "velocity_down_m_s": 0.5,
        "spacing_error_north_m": 5.0, "spacing_error_east_m": 6.0,
        "velocity_error_north_m_s": 7.0, "velocity_error_east_m_s": 8.0,
        "command_north_m_s2": 9.0, "command_east_m_s2": 10.0,
        "nearest_m": 121.5, "queue_s": 0.001, "up_delay_s": 0.025, "sample_bound_s": 3e-6, "down_delay_s": 0.03,
        "down_bound_s": 4e-6, "loop_delay_s": 0.07, "loop_delay_bound_s": 6e-6, "repeated_s": 0.01,
        "assumed_delay_s": 0.1, "delay_margin_s": 0.4, "headroom": 0.85,
        "rtt_s": 0.07, "clock_offset_s": 3.0, "clock_offset_bound_s": 55e-6,  # 5 µs, and 0.1 % of 50 ms
        "received": 5, "lost": 1, "late": 1, "duplicate": 1,
    }  # fmt: skip
    assert list(expected) == list(TICK.names or ())
    found = {name: rows[1][name].item() for name in expected}
    assert all(np.isclose(found[name], expected[name], rtol=1e-12) for name in expected), found
    assert used_s[1] == pytest.approx(0.045)  # acts 0.03 s earlier than assumed, where 0.2 s are tolerated


def test_what_is_not_known_is_not_a_number() -> None:
    links, _ = two_vehicles()
    controls = np.zeros(2, CONTROL)
    for name in ("state", "spacing_error_m", "velocity_error_m_s", "command_m_s2"):
        controls[name] = nan
    zeros = np.zeros(2, np.int64)
    judged = Judged(
        system_id=np.array([6, 7]), mode=zeros, gain_set=zeros, controls=controls, reported=new_reported(2),
        rtt_s=np.full(2, nan), commanded=np.zeros(2, np.bool_), shorter_s=np.full((2, 1), inf),
        longer_s=np.full((2, 1), 0.4), repeated_s=np.zeros(2),
    )  # fmt: skip
    tick = Tick(0, -1.0, S, 0, judged, set_point_indices=np.array([-1, -1]))
    rows, used_s = tick_rows(tick, judged, links, np.full(2, nan), np.full(2, S))
    unknown = {name for name in TICK.names or () if rows[name].dtype.kind == "f" and np.isnan(rows[name][1])}
    floats = {name for name in TICK.names or () if TICK[name].kind == "f"}
    assert unknown == floats - {"time_s", "repeated_s", "assumed_delay_s", "delay_margin_s"}
    assert np.isnan(used_s).all()
