"""Whole flights in virtual time: vehicles, links and station with real MAVLink bytes on one clock."""

import gc
import io
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from gains.sampled.constant import growth_rate
from gcs.control.phases import Phase
from gcs.control.tick import Event, Mode, TickArray
from gcs.drive.lockstep import START_NS, Sent, fly_lockstep
from gcs.link import mavlink
from gcs.plan.design import Design
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.runs.summary import summarise
from gcs.runs.summary_record import Summary
from gcs.station.station import Station
from gcs.views.report import print_flight
from scenarios.files import load
from scenarios.schema import FixedGains, Limits, Monitor, Scenario
from sim_vehicles.drive.fleet import Fleet
from tests.support.known import known
from tests.support.paths import SCENARIOS

S = 1_000_000_000


def planned(name: str, **changes: Any) -> tuple[FlightPlan, Design]:
    scenario = load(SCENARIOS / f"{name}.toml").model_copy(update=changes)
    design, plan = flight_plan(scenario)
    return plan, design


def flown(plan: FlightPlan, design: Design, station: Station | None = None, **kwargs: Any) -> tuple[TickArray, Summary]:
    station = station or Station(plan, start_ns=START_NS)
    ticks = np.concatenate(list(fly_lockstep(plan, station=station, **kwargs)))
    events = [*station.events, Event(time_s=0.0, kind="end", text=station.end_reason)]
    return ticks, summarise(plan.scenario, design, ticks, events)


class Without:
    """The vehicles of a scenario, with the links of some of them cut from `from_ns` until `until_ns`."""

    def __init__(self, scenario: Scenario, cut: set[int], *, from_ns: int, until_ns: int = 2**62) -> None:
        self.fleet = Fleet(scenario, START_NS)
        self.cut = cut
        self.from_ns, self.until_ns = from_ns, until_ns

    @property
    def next_event_ns(self) -> int:
        return self.fleet.next_event_ns

    def step(self, received: Sent, now_ns: int) -> Sent:
        return self._passed(self.fleet.step(self._passed(received), now_ns))

    def _passed(self, datagrams: Sent) -> Sent:
        return [d for d in datagrams if d[0] not in self.cut or not self.from_ns <= d[2] < self.until_ns]


@pytest.mark.parametrize("name", ["triangle5", "triangle5_scattered", "chain3", "chain20", "chain3_bidirectional"])
def test_formation_settles_below_one_percent_of_the_spacing(name: str) -> None:
    plan, design = planned(name)
    _, summary = flown(plan, design)
    assert (summary.verdict, summary.reason) == ("stable", "completed: duration reached")
    spacing = {v.system_id: np.hypot(*v.offset_ne_m) for v in plan.scenario.vehicles if v.offset_ne_m}
    for vehicle in summary.vehicles[1:]:
        assert known(vehicle.spacing_error_final_m) < 0.01 * spacing[vehicle.system_id]
    assert known(summary.settling_time_s) < plan.scenario.duration_s / 2
    assert summary.control is not None
    assert summary.control.deadline_misses == 0
    assert {vehicle.mode_final for vehicle in summary.vehicles} == {"NOMINAL"}


def test_a_flight_too_short_to_settle_reports_its_remaining_errors() -> None:
    plan, design = planned("triangle5", duration_s=0.4)
    _, summary = flown(plan, design)
    assert (summary.verdict, summary.reason) == ("unstable", "completed: duration reached")
    output = io.StringIO()
    print_flight(summary, Console(file=output, width=200))
    [verdict] = [line for line in output.getvalue().splitlines() if line.startswith("verdict")]
    most_m = max(known(vehicle.spacing_error_max_m) for vehicle in summary.vehicles[1:])
    left_m = max(known(vehicle.spacing_error_final_m) for vehicle in summary.vehicles[1:])
    reason = f"not settled in 0.4 s; final spacing error {left_m:.2f} m, largest {most_m:.2f} m"
    assert verdict == f"verdict  unstable: {reason}"


def test_formation_follows_the_turns() -> None:
    plan, design = planned("triangle5_turns")
    ticks, summary = flown(plan, design)
    assert summary.verdict == "stable"
    for at_s, heading_deg in ((24.0, -60.0), (49.0, 0.0), (74.0, 60.0)):
        rows = ticks[np.abs(ticks["time_s"] - at_s) < 0.009]
        assert rows.size == 5
        heading = np.degrees(np.arctan2(rows["velocity_east_m_s"], rows["velocity_north_m_s"]))
        assert heading == pytest.approx(np.full(5, heading_deg), abs=0.1)


def test_above_the_margin_the_formation_breaks_leaving_vehicles_in_failsafe() -> None:
    plan, design = planned("triangle5")
    scenario = plan.scenario.with_link_delay(up_s=0.4, down_s=0.4)
    plan = replace(plan, scenario=scenario)
    ticks, summary = flown(plan, design)
    assert summary.verdict == "unstable"
    assert summary.reason.startswith("broken: spacing error of vehicle")
    assert known(summary.headroom_min) < 0
    assert set(ticks[-5:]["mode"]) == {Mode.FAILSAFE}
    assert not ticks[-5:]["commanded"].any()


def dominant_growth_1_s(ticks: TickArray, system_id: int) -> float:
    """Growth rate of a follower's spacing error: slope of the log of its peaks after the first 10 s."""
    rows = ticks[(ticks["system_id"] == system_id) & (ticks["time_s"] > 10.0)]
    error = rows["spacing_error_east_m"]
    peaks = np.flatnonzero((np.abs(error[1:-1]) >= np.abs(error[:-2])) & (np.abs(error[1:-1]) > np.abs(error[2:]))) + 1
    return float(np.polyfit(rows["time_s"][peaks], np.log(np.abs(error[peaks])), 1)[0])


@pytest.mark.parametrize("link_delay_s", [0.130, 0.140, 0.145])
def test_errors_grow_and_decay_as_the_sampled_model_says(link_delay_s: float) -> None:
    """Two independent ways: the slope of the flown error, and the lifted map at the loop delay that was measured."""
    plan, design = planned("chain3", duration_s=40.0, monitor=Monitor(act=False))
    scenario = plan.scenario.with_link_delay(up_s=link_delay_s, down_s=link_delay_s)
    ticks, _ = flown(replace(plan, scenario=scenario), design)
    own = ticks[(ticks["system_id"] == 2) & ticks["commanded"]]
    delay_s = float(np.median(own["loop_delay_s"]))
    A, B = np.array([[0.0, -1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    assert design.inclusion_gains is not None
    own, _, spacing = design.inclusion_gains
    K = np.array([[spacing[0][0], own[0][0]]])
    predicted = growth_rate(A, B, K, period_s=0.02, delay_s=delay_s)
    # 1 ms of drift of the sampling instants over the flight moves the rate by 0.01 /s.
    assert dominant_growth_1_s(ticks, 2) == pytest.approx(predicted, abs=0.02)


def test_loop_delay_is_the_links_plus_waiting() -> None:
    plan, design = planned("triangle5", duration_s=5.0)
    ticks, _ = flown(plan, design)
    own = ticks[ticks["commanded"]]
    true_sample_ns = np.round(own["sample_ns"] / 1e3) * 1e3
    assert own["rtt_s"][np.isfinite(own["rtt_s"])] == pytest.approx(0.04, abs=1e-8)
    # A drift of 20 ppm is learnt within a second: 20 µs.
    assert own["down_delay_s"] == pytest.approx(0.02, abs=2e-5)
    waiting = own["due_ns"] - true_sample_ns - 20_000_000
    assert (waiting >= -20_000).all()
    assert (waiting <= 20_020_000).all()
    assert own["loop_delay_s"] == pytest.approx(0.04 + waiting * 1e-9, abs=2e-5)


def test_asymmetric_links_give_the_same_loop_delay() -> None:
    """The clock offset is then wrong by half the asymmetry, which cancels between telemetry and command."""
    plan, design = planned("chain3", duration_s=3.0)
    medians: list[float] = []
    for up_s, down_s in ((0.05, 0.05), (0.09, 0.01)):
        scenario = plan.scenario.with_link_delay(up_s=up_s, down_s=down_s)
        ticks, _ = flown(replace(plan, scenario=scenario), design)
        medians.append(float(np.median(ticks[ticks["commanded"]]["loop_delay_s"])) - up_s - down_s)
    assert all(0.0 <= waiting <= 0.02 for waiting in medians)


def test_flights_are_the_same_to_the_last_bit() -> None:
    plan, design = planned("chain3", duration_s=2.0)
    first, second = (flown(plan, design)[0].tobytes() for _ in range(2))
    assert first == second


def test_a_lost_vehicle_is_named_and_flown_around() -> None:
    plan, design = planned("triangle5", duration_s=20.0)
    vehicles = Without(plan.scenario, {2}, from_ns=START_NS + 6 * S)
    station = Station(plan, start_ns=START_NS)
    ticks, summary = flown(plan, design, station, vehicles=vehicles)
    assert (summary.verdict, summary.reason) == ("aborted", "lost: vehicles 2")
    assert [e.system_id for e in station.events if e.text == "is lost"] == [2]
    last = {int(row["system_id"]): row for row in ticks[ticks["time_s"] <= 20.0][-5:]}
    assert last[2]["mode"] == Mode.LOST
    assert not last[2]["commanded"]
    gap = [last[1][name] - last[3][name] for name in ("north_m", "east_m")]
    # Vehicle 3 stays where it was, two spacings from the leader; 91 m/s times 20 ms apart in sampling instant.
    assert gap == pytest.approx([2 * 121.92, -2 * 121.92], abs=2.0)
    assert all(last[k]["mode"] == Mode.NOMINAL for k in (1, 3, 4, 5))


def test_coupled_formation_keeps_its_places_around_a_lost_vehicle() -> None:
    plan, design = planned("chain3_bidirectional", duration_s=20.0)
    assert not plan.separable
    vehicles = Without(plan.scenario, {2}, from_ns=START_NS + 8 * S)
    ticks, _ = flown(plan, design, vehicles=vehicles)
    last = {int(row["system_id"]): row for row in ticks[ticks["time_s"] <= 20.0][-3:]}
    gap = [last[1][name] - last[3][name] for name in ("north_m", "east_m")]
    # two spacings, as with vehicle 2 between them; 91 m/s times 20 ms apart in sampling instant
    assert gap == pytest.approx([2 * 121.92, -2 * 121.92], abs=2.0)
    assert last[2]["mode"] == Mode.LOST


def test_a_vehicle_that_is_heard_again_is_taken_back() -> None:
    plan, design = planned("triangle5", duration_s=25.0)
    vehicles = Without(plan.scenario, {3}, from_ns=START_NS + 6 * S, until_ns=START_NS + 11 * S)
    ticks, summary = flown(plan, design, vehicles=vehicles)
    assert summary.verdict == "stable"
    modes = ticks[ticks["system_id"] == 3]["mode"]
    assert {Mode.LOST, Mode.FAILSAFE, Mode.NOMINAL} <= set(modes.tolist())
    assert modes[ticks[ticks["system_id"] == 3]["time_s"] < 25.0][-1] == Mode.NOMINAL


def test_all_vehicles_lost_aborts() -> None:
    plan, design = planned("chain3")
    _, summary = flown(plan, design, vehicles=Without(plan.scenario, {1, 2, 3}, from_ns=START_NS + 6 * S))
    assert (summary.verdict, summary.reason) == ("aborted", "lost: all vehicles")


def test_a_vehicle_that_never_answers_is_named_and_nothing_flies() -> None:
    plan, design = planned("chain3")
    ticks, summary = flown(plan, design, vehicles=Without(plan.scenario, {2}, from_ns=0))
    assert (summary.verdict, summary.reason) == ("aborted", "not ready: vehicle 2 not heard")
    assert not ticks["commanded"].any()


def test_a_new_station_takes_flying_vehicles_back() -> None:
    plan, design = planned("triangle5", duration_s=15.0)
    fleet = Fleet(plan.scenario, START_NS)
    first = Station(plan, start_ns=START_NS)
    now_ns = START_NS
    for rows in fly_lockstep(plan, station=first, vehicles=fleet):
        now_ns = int(rows["due_ns"][0])
        if rows["time_s"][0] > 5.0:
            break  # the station is gone
    unheard = fleet.step([], now_ns + 5 * S)
    frames = [frame for _, data, _ in unheard for frame in mavlink.decode(data, Counter())]
    texts = [(frame.system_id, frame.fields[1]) for frame in frames if frame.msg_id == mavlink.STATUSTEXT]
    said = {system_id for system_id, text in texts if b"failsafe" in text}
    assert said == {1, 2, 3, 4, 5}
    second = Station(plan, start_ns=now_ns + 5 * S)
    _, summary = flown(plan, design, second, vehicles=fleet)
    assert summary.verdict == "stable"


def test_interrupted_flight_leaves_the_vehicles_holding() -> None:
    plan, _ = planned("chain3")
    station = Station(plan, start_ns=START_NS)
    for rows in fly_lockstep(plan, station=station):
        if rows["time_s"][0] > 3.0:
            station.request_stop("interrupted: SIGINT")
    assert station.phase is Phase.ENDED
    assert station.end_reason == "interrupted: SIGINT"
    assert all(vehicle.custom_mode == 5 for vehicle in station.vehicles)


def test_given_gains_without_margin_are_flown_and_break() -> None:
    scenario = load(SCENARIOS / "chain3.toml")
    control = scenario.control.model_copy(
        update={"delay_margin_s": None, "gains": FixedGains(K1=-20.0, K2=0.0, K3=150.0)}
    )
    plan, design = planned("chain3", control=control, monitor=Monitor(act=False), limits=Limits())
    assert design.margins_s[0] < 0.05  # exceeded by 40 ms of link delay and the waiting of at least one vehicle
    _, summary = flown(plan, design)
    assert max(known(v.loop_delay_s.p50) for v in summary.vehicles) > design.margins_s[0]
    assert (summary.verdict, summary.settling_time_s) == ("unstable", None)
    # limits hold the errors in a cycle so small that they count as settled
    _, limited = flown(*planned("chain3", control=control, monitor=Monitor(act=False)))
    assert limited.settling_time_s is not None
    assert (limited.verdict, limited.reason) == ("unstable", "completed: duration reached")
    output = io.StringIO()
    print_flight(limited, Console(file=output, width=200))
    assert "errors are small after" in output.getvalue()
    assert "but the loop delay is past the margin" in output.getvalue()


def test_slow_error_growth_past_the_margin_is_not_stable() -> None:
    links = load(SCENARIOS / "thesis_delay.toml").with_link_delay(up_s=0.55, down_s=0.55).links
    _, summary = flown(*planned("thesis_delay", links=links))
    assert known(summary.headroom_end) < 0.0
    assert summary.verdict == "unstable"


FIXED_WING = (
    "chain3",
    "chain3_bidirectional",
    "chain20",
    "delay_ramp",
    "radio57600",
    "thesis_delay",
    "thesis_gains",
    "triangle5",
    "triangle5_turns",
    "wifi_bursts",
)


@pytest.mark.parametrize("name", FIXED_WING)
def test_shipped_scenarios_ask_nothing_beyond_what_their_aircraft_can_do(name: str) -> None:
    """Commands stay below 3 g from the first tick on, and turns below the turn rate; so limits change nothing."""
    plan, design = planned(name)
    scenario = plan.scenario
    limits, courses = scenario.limits, scenario.nominal_velocity
    assert limits.acceleration_max_m_s2 is not None
    assert limits.turn_rate_max_rad_s is not None
    assert limits.acceleration_max_m_s2 <= 3.0 * 9.81
    # the largest commands are those of the start, and of a turn where there is one
    until_s = courses[-1].from_s + 3.0 if len(courses) > 1 else 4.0
    plan = replace(plan, scenario=scenario.model_copy(update={"duration_s": until_s}))
    ticks, _ = flown(plan, design)
    own = ticks[ticks["commanded"]]
    command = own["command_north_m_s2"] + 1j * own["command_east_m_s2"]
    velocity = own["velocity_north_m_s"] + 1j * own["velocity_east_m_s"]
    assert np.abs(command).max() < limits.acceleration_max_m_s2
    assert np.abs((command / velocity).imag).max() < limits.turn_rate_max_rad_s
    without, _ = flown(replace(plan, scenario=plan.scenario.model_copy(update={"limits": Limits()})), design)
    for error in ("spacing_error_north_m", "spacing_error_east_m"):
        assert np.nanmax(np.abs(ticks[error] - without[error])) < 1e-2


def test_a_wide_start_flown_at_three_g_comes_together() -> None:
    """Without limits the gains ask for 93 g."""
    plan, design = planned("triangle5_scattered")
    ticks, summary = flown(plan, design)
    own = ticks[ticks["commanded"]]
    size = np.hypot(own["command_north_m_s2"], own["command_east_m_s2"])
    assert size.max() == pytest.approx(29.4, abs=1e-3)
    speed = np.hypot(own["velocity_north_m_s"], own["velocity_east_m_s"])
    assert 60.0 - 1e-3 < speed.min() < speed.max() < 130.0 + 1e-3
    assert summary.verdict == "stable"
    assert 7.0 < known(summary.settling_time_s) < 9.0


@pytest.mark.parametrize(
    ("limit_m", "acts", "reason"),
    [
        (10.0, True, "broken: spacing error of vehicle 5 is 10.3 m, limit 10 m"),
        (300.0, True, "completed: duration reached"),
        (300.0, False, "broken: spacing error of vehicle 5 is 301 m, limit 300 m"),
    ],
)
def test_a_tight_limit_or_passive_monitor_breaks_triangle5_above_margin(
    limit_m: float, acts: bool, reason: str
) -> None:
    """Given time to change to slower gains, the monitor saves it, as scenarios/triangle5.toml says at its limit."""
    plan, design = planned("triangle5", monitor=Monitor(act=acts))
    late = plan.scenario.with_link_delay(up_s=0.4, down_s=0.4)
    safety = late.safety.model_copy(update={"spacing_error_limit_m": limit_m})
    ticks, summary = flown(replace(plan, scenario=late.model_copy(update={"safety": safety})), design)
    assert summary.reason == reason
    saved = limit_m == 300.0 and acts
    assert summary.verdict == ("stable" if saved else "unstable")
    if saved:
        error = np.hypot(ticks["spacing_error_north_m"], ticks["spacing_error_east_m"])
        assert np.nanmax(error) == pytest.approx(29.0, abs=1.0)
        assert 11.0 < known(summary.settling_time_s) < 15.0


@pytest.mark.parametrize("name", ["triangle5", "copters5"])
def test_flights_make_no_garbage_to_collect(name: str) -> None:
    """In real time garbage collection is off. It is rare in a campaign, which flies thousands in one process."""
    plan, _ = planned(name, duration_s=1.0)

    def stations_left() -> int:
        return sum(type(one) is Station for one in gc.get_objects())  # isinstance would follow weak references

    assert sum(1 for _ in fly_lockstep(plan)) > 1  # the first flight of a process may compile kernels
    gc.collect()  # stations of other tests may be left
    before = stations_left()
    gc.disable()
    try:
        flight = fly_lockstep(plan)
        for _, _ in zip(flight, range(50), strict=False):
            pass
        assert gc.collect() == 0
        assert sum(1 for _ in flight) > 1
        del flight
        assert stations_left() == before
    finally:
        gc.enable()
