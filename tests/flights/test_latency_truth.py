"""Measured latencies against what the emulated links and vehicles recorded, in virtual time, over a grid of links."""

from functools import cache

import numpy as np
import pytest

from gcs.control.tick import Event, TickArray
from gcs.drive.lockstep import START_NS, fly_lockstep
from gcs.link import mavlink
from gcs.plan.design import Design
from gcs.plan.planner import flight_plan
from gcs.runs.grade import Truth, graded, true_loop_delays_s, true_round_trips
from gcs.runs.summary import summarise
from gcs.station.station import Station
from scenarios.files import load
from scenarios.keys.link import Jitter, Link, Links, Outage
from scenarios.schema import Clocks, FixedGains, Monitor, Safety
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.links.truth import DTYPE, LINK_DOWN, LINK_UP, SAMPLED, MemoryRecorder
from sim_vehicles.services.clock import BootClock
from tests.support.known import known
from tests.support.paths import SCENARIOS

CHAIN = load(SCENARIOS / "chain3.toml")
WEAK = FixedGains(K1=-0.05, K2=0.0, K3=0.001)
"""A loop with a margin of many seconds, so that any link can be flown."""
JITTER = Jitter(distribution="uniform", scale_s=0.01)
GRID = {
    "0.2 ms": (Link(delay_s=0.0001), Link(delay_s=0.0001), 20.0),
    "40 ms": (Link(delay_s=0.02), Link(delay_s=0.02), 20.0),
    "asymmetric": (Link(delay_s=0.09), Link(delay_s=0.01), 20.0),
    "5 s": (Link(delay_s=2.5), Link(delay_s=2.5), 20.0),
    "5 s, 30 % loss": (Link(delay_s=2.5, loss_probability=0.3), Link(delay_s=2.5, loss_probability=0.3), 20.0),
    "30 % loss": (Link(delay_s=0.05, loss_probability=0.3), Link(delay_s=0.05, loss_probability=0.3), 20.0),
    "drift 300 ppm": (Link(delay_s=0.05), Link(delay_s=0.02), 300.0),
    "bunches": (
        # Nothing overtakes, so what comes late comes together with all behind it.
        Link(delay_s=0.02, jitter=Jitter(distribution="exponential", scale_s=0.05)),
        Link(delay_s=0.02, jitter=Jitter(distribution="exponential", scale_s=0.05)),
        20.0,
    ),
    "outage": (Link(delay_s=0.02, outages=(Outage(from_s=3.0, until_s=4.2),)), Link(delay_s=0.02), 20.0),
    "reordering": (
        Link(delay_s=0.05, jitter=JITTER, reordering=True, duplicate_probability=0.05),
        Link(delay_s=0.05, jitter=JITTER, reordering=True),
        20.0,
    ),
}
CONSTANT = [name for name in GRID if name not in ("reordering", "bunches")]


@cache
def flown(name: str) -> tuple[TickArray, Truth]:
    up, down, drift_ppm = GRID[name]
    scenario = CHAIN.model_copy(
        update={
            "duration_s": 20.0 if name.startswith("5 s") else 8.0,
            "control": CHAIN.control.model_copy(update={"gains": WEAK}),
            "links": Links(up=up, down=down),
            "clocks": Clocks(drift_max_ppm=drift_ppm),
            "monitor": Monitor(act=False),
            "safety": Safety(setpoint_timeout_s=30.0, heartbeat_timeout_s=30.0),
        }
    )
    _, plan = flight_plan(scenario)
    recorder = MemoryRecorder()
    station, fleet = Station(plan, start_ns=START_NS), Fleet(scenario, START_NS, recorder=recorder)
    ticks = np.concatenate(list(fly_lockstep(plan, station=station, vehicles=fleet)))
    assert station.end_reason == "completed: duration reached"
    return ticks, recorder.records


@pytest.mark.parametrize("name", [name for name in GRID if name != "bunches"])
def test_round_trips_are_those_of_the_links_to_the_microsecond(name: str) -> None:
    ticks, truth = flown(name)
    for system_id in (1, 2, 3):
        measured = ticks["rtt_s"][(ticks["system_id"] == system_id) & np.isfinite(ticks["rtt_s"])]
        _, real = true_round_trips(truth, system_id)
        assert measured.size > 20
        assert np.abs(measured[:, None] - real[None, :]).min(axis=1).max() < 1e-6


def test_replies_that_arrive_together_count_as_they_were_sent() -> None:
    """The second request overtakes the first, and replies arrive together: gcs grade once matched the wrong ones."""
    truth = np.zeros(4, DTYPE)
    truth["system_id"], truth["key"] = 1, mavlink.TIMESYNC
    truth["kind"] = LINK_DOWN, LINK_DOWN, LINK_UP, LINK_UP
    truth["entered_ns"], truth["due_ns"] = (0, 10, 20, 30), (30, 20, 50, 50)
    due_ns, trips_s = true_round_trips(truth, 1)
    assert due_ns.tolist() == [50, 50]
    assert trips_s.tolist() == pytest.approx([40e-9, 50e-9])


@pytest.mark.parametrize("name", [name for name in GRID if name != "reordering"])
def test_every_round_trip_is_in_the_ticks(name: str) -> None:
    """The round trips of all replies, except the last few of a flight."""
    ticks, truth = flown(name)
    for system_id in (1, 2, 3):
        measured = ticks["rtt_s"][(ticks["system_id"] == system_id) & np.isfinite(ticks["rtt_s"])]
        due_ns, real = true_round_trips(truth, system_id)
        real = real[due_ns <= ticks["sent_ns"][-1]]
        off_s = np.abs(measured[:, None] - real).min(axis=0)
        assert (off_s[:-3] < 1e-6).all()
        assert measured.size >= real.size - 3


@pytest.mark.parametrize("name", CONSTANT)
def test_loop_delay_over_constant_links_is_exact_to_the_microsecond(name: str) -> None:
    ticks, truth = flown(name)
    grade = graded(ticks["loop_delay_s"], true_loop_delays_s(ticks, truth))
    assert grade.samples > 700
    assert known(grade.error_p50_s) < 1e-6
    # Two clocks' rates are told apart only after a second; until then drift counts: 300 ppm of some 0.2 s.
    assert known(grade.error_max_s) < 1e-4


def test_with_jitter_loop_delay_errs_at_most_by_the_jitter() -> None:
    """The down delay is that of the newest exchange; the set-point's own is known to nobody when it is sent."""
    ticks, truth = flown("reordering")
    grade = graded(ticks["loop_delay_s"], true_loop_delays_s(ticks, truth))
    assert grade.samples > 700
    assert (
        1e-3 < known(grade.error_p50_s) < known(grade.error_max_s) < 0.02 + 0.01
    )  # jitter, and the clock's own error by it


@pytest.mark.parametrize("name", GRID)
def test_instants_and_one_way_delays_are_never_outside_their_bounds(name: str) -> None:
    ticks, truth = flown(name)
    sampled, ups = truth[truth["kind"] == SAMPLED], truth[(truth["kind"] == LINK_UP) & (truth["key"] == 32)]
    when = {(s, k): t for s, k, t in zip(*(sampled[n].tolist() for n in ("system_id", "key", "time_ns")), strict=True)}
    rows = ticks[np.isfinite(ticks["sample_bound_s"]) & (ticks["sample_ns"] > 0)]
    true_ns = np.array([when[int(row["system_id"]), int(row["sample_boot_ms"])] for row in rows])
    assert rows.size > 700
    assert (np.abs(rows["sample_ns"] - true_ns) * 1e-9 <= rows["sample_bound_s"]).all()
    # A state enters its link when it is sampled, so that its way up ends when the link says.
    ups_s = {
        (s, entered): (due - entered) * 1e-9
        for s, entered, due in sorted(ups[["system_id", "entered_ns", "due_ns"]].tolist(), reverse=True)
    }
    real_s = np.array([ups_s[int(s), int(t)] for s, t in zip(rows["system_id"], true_ns, strict=True)])
    assert (np.abs(rows["up_delay_s"] - real_s) <= rows["sample_bound_s"] + 1e-9).all()


@pytest.mark.parametrize("name", GRID)
def test_clock_offsets_are_never_outside_their_bounds(name: str) -> None:
    ticks, _ = flown(name)
    for system_id in (1, 2, 3):
        clock = BootClock.draw(Clocks(drift_max_ppm=GRID[name][2]), CHAIN.seed, system_id, START_NS)
        rows = ticks[(ticks["system_id"] == system_id) & np.isfinite(ticks["clock_offset_s"])]
        true_s = np.array([(clock.boot_ns(sent) - sent) * 1e-9 for sent in rows["sent_ns"].tolist()])
        assert rows.size > 200
        assert (np.abs(rows["clock_offset_s"] - true_s) <= rows["clock_offset_bound_s"]).all()


@pytest.mark.parametrize("name", ["drift 300 ppm", "asymmetric"])
def test_clock_skew_is_that_of_its_time_stamps(name: str) -> None:
    ticks, truth = flown(name)
    events = [Event(time_s=8.0, kind="end", text="completed: duration reached")]
    summary = summarise(CHAIN, Design(delay_margin_s=1.0), ticks, events)
    for vehicle in summary.vehicles:
        own = truth[(truth["kind"] == SAMPLED) & (truth["system_id"] == vehicle.system_id)]
        slope, _ = np.polyfit((own["time_ns"] - own["time_ns"][0]) * 1e-9, own["key"] * 1e-3, 1)
        # stamps are whole milliseconds, over 8 s and more
        assert known(vehicle.clock.skew_ppm) == pytest.approx(1e6 * (slope - 1.0), abs=30.0)
        assert abs(known(vehicle.clock.skew_ppm) - 1e6 * (slope - 1.0)) < known(vehicle.clock.skew_bound_ppm)


def test_despite_reordering_loss_and_duplicates_are_those_of_the_links() -> None:
    ticks, truth = flown("reordering")
    last = ticks[ticks["tick"] == ticks["tick"].max()]
    up = truth[truth["kind"] == LINK_UP]
    for row in last:
        own = up[up["system_id"] == row["system_id"]]
        doubled = int((own["fate"] & 1 != 0).sum())
        # Frames still under way at the end, or newer ones that came before, differ by what one jitter holds.
        assert int(row["duplicate"]) == pytest.approx(doubled, abs=3)
        assert int(row["lost"]) <= 5


def test_an_unknown_is_none_and_not_zero() -> None:
    nothing = graded(np.full(3, np.nan), np.zeros(3))
    assert nothing.status == "unknown"
    assert (nothing.error_p50_s, nothing.error_p99_s, nothing.error_max_s) == (None, None, None)
