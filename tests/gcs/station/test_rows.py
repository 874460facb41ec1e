"""Each value of the tick record is in the column of its name."""

from math import inf
from typing import Any

import numpy as np
import pytest

from gcs.control.law import VehicleControl
from gcs.control.tick import TICK, Mode
from gcs.link.clocks import ClockEstimate
from gcs.link.startup import LaunchedStartup
from gcs.link.vehicle import RemoteVehicle
from gcs.plan.mismatch import Tolerated
from gcs.station.monitor import VehicleState
from gcs.station.tick_rows import Reported, Tick, tick_rows

S = 1_000_000_000


def test_every_column_holds_what_its_name_says() -> None:
    vehicle = RemoteVehicle(7, startup=LaunchedStartup(50.0))
    vehicle.clock.estimate = ClockEstimate(samples=9, offset_ns=3 * S, skew=0.0, bound_ns=5000, reference_ns=10 * S)
    vehicle.clock.down_ns, vehicle.clock.down_bound_ns = 30_000_000, 4000
    vehicle.clock.loop_bound_ns = 6000.0
    for sequence in (1, 2, 5, 4, 4):
        vehicle.frames.add(sequence, 0)
    control = VehicleControl(
        sample_ns=10 * S,
        state=(1.0, 2.0, 3.0, 4.0),
        spacing_error_m=(5.0, 6.0),
        velocity_error_m_s=(7.0, 8.0),
        command_m_s2=(9.0, 10.0),
        used_ns=10 * S,
        assumed_s=0.1,
        acts_ns=10 * S + 110_000_000,
    )
    monitored = VehicleState(mode=Mode.CAUTION, gain_set=1)
    reported = Reported(13_000, -100.0, 0.5, queue_s=0.001, received_ns=10 * S + 25_000_000, bound_s=3e-6)
    seen: list[Any] = [
        vehicle,
        monitored,
        control,
        reported,
        0.07,
        True,
        Tolerated((inf, 0.2), (0.2, 0.3)),
        0.01,
    ]
    tick = Tick(11, 0.22, 10 * S + 40_000_000, 220, *([each, each] for each in seen), set_point_indices=[0, 1])
    rows, used_s = tick_rows(tick, [121.5, 121.5], [10 * S + 50_000_000] * 2)
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
    for row in rows:
        found = {name: row[name].item() for name in expected}
        assert all(np.isclose(found[name], expected[name], rtol=1e-12) for name in expected), found
    assert used_s == pytest.approx([0.045, 0.045])  # acts 0.03 s earlier than assumed, where 0.2 s are tolerated


def test_what_is_not_known_is_not_a_number() -> None:
    vehicle = RemoteVehicle(7, startup=LaunchedStartup(50.0))
    nan, pair = np.nan, (np.nan, np.nan)
    nothing = VehicleControl(0, (nan, nan, nan, nan), pair, pair, pair, 0)
    seen: list[Any] = [vehicle, VehicleState(), nothing, Reported(), nan, False, Tolerated((inf,), (0.4,)), 0.0]
    rows, used_s = tick_rows(Tick(0, -1.0, S, 0, *([each] for each in seen), set_point_indices=[-1]), [nan], [S])
    unknown = {name for name in TICK.names or () if rows[name].dtype.kind == "f" and np.isnan(rows[name][0])}
    floats = {name for name in TICK.names or () if TICK[name].kind == "f"}
    assert unknown == floats - {"time_s", "repeated_s", "assumed_delay_s", "delay_margin_s"}
    assert np.isnan(used_s).all()
