"""The onboard loop over MAVLink in virtual time: gains are uploaded, own terms act at once, the station's late."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gcs.control.tick import Mode, TickArray
from gcs.drive.flown import fly_plan, median_delays_s
from gcs.drive.lockstep import START_NS, fly_lockstep
from gcs.link.upload import float32
from gcs.plan.design import Design
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.loops import plan_loops
from gcs.plan.onboard import own_parameters
from gcs.plan.planner import flight_plan
from gcs.runs.grade import true_loop_delays_s
from gcs.runs.summary import summarise
from gcs.station.station import Station
from gcs.stress.axes import at_coordinates
from gcs.stress.free_response import fly_calm, response_paired
from gcs.stress.growth import fit_growth, motion_of
from gcs.stress.measure import fly_trial
from gcs.stress.study import NoOnset, Study, find_onset
from gcs.stress.trial import CRITICAL, Outcome, Trial, sparse_gain
from scenarios.errors import ScenarioError
from scenarios.files import dump, load, parse, with_loop
from scenarios.keys.link import Link, Outage, VehicleLinks
from scenarios.schema import FixedGains, Limits, Scenario
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.links.truth import ACTED, SAMPLED, MemoryRecorder
from sim_vehicles.vehicles.double_integrator import DoubleIntegrator
from tests.support.known import known
from tests.support.paths import SCENARIOS
from tests.support.truth import instants

THESIS = SCENARIOS / "thesis_delay.toml"


def delayed(total_s: float, **update: Any) -> Scenario:
    """thesis_delay with a link delay, up + down."""
    return load(THESIS).with_link_delay(up_s=total_s / 2.0, down_s=total_s / 2.0).model_copy(update=update)


@cache
def thesis() -> tuple[Design, FlightPlan]:
    """Design and plan of thesis_delay; neither depends on links and duration."""
    return flight_plan(load(THESIS))


def flown(scenario: Scenario) -> FlightPlan:
    """The plan of thesis_delay with some other links, seed or duration."""
    return replace(thesis()[1], scenario=scenario)


def onboard(name: str, **update: Any) -> Scenario:
    """A scenario of the ground loop, flown on board."""
    return with_loop(load(SCENARIOS / f"{name}.toml"), "onboard", THESIS).model_copy(update=update)


def vehicle(fleet: Fleet, system_id: int) -> DoubleIntegrator:
    found = fleet.vehicle(system_id).craft
    assert isinstance(found, DoubleIntegrator)
    return found


@pytest.mark.slow(first=2)
@pytest.mark.parametrize(("link_delay_s", "verdict"), [(0.17, "stable"), (0.9, "stable"), (1.1, "unstable")])
def test_the_source_breaks_beyond_the_computed_margin_not_its_own(link_delay_s: float, verdict: str) -> None:
    scenario = delayed(link_delay_s)
    flight = fly_plan(flown(scenario))
    summary = summarise(scenario, thesis()[0], flight.ticks, flight.events)
    assert summary.verdict == verdict
    assert summary.loop == "onboard"
    assert summary.delay_margin_continuous_s == pytest.approx(1.00796, abs=1e-5)
    assert summary.delay_margin_s == pytest.approx(1.00216, abs=1e-5)
    waiting_s = known(summary.loop_delay_s.p50) - link_delay_s
    assert 0.0 < waiting_s < 1.0 / 50.0


def test_the_acting_monitor_streams_less_and_holds_beyond_the_margin() -> None:
    scenario = delayed(1.1)
    acting = scenario.monitor.model_copy(update={"act": True})
    plan = flown(scenario.model_copy(update={"monitor": acting}))
    assert [entry.streamed_share for entry in thesis()[0].schedule] == [1.0, 0.5, 0.25]
    assert list(plan.margins_s) == sorted(plan.margins_s)
    ticks = fly_plan(plan).ticks
    assert set(ticks["gain_set"][(ticks["time_s"] > 5.0) & (ticks["time_s"] < 100.0)]) == {1}
    late = ticks[(ticks["time_s"] > 60.0) & (ticks["time_s"] < 100.0)]
    assert np.nanmax(np.hypot(late["spacing_error_north_m"], late["spacing_error_east_m"])) < 0.1


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_vehicles_hold_their_gains_as_float32_before_they_are_armed(loss: float) -> None:
    lossy = Link(delay_s=0.05, loss_probability=loss)
    scenario = delayed(0.1, duration_s=0.1)
    scenario = scenario.model_copy(update={"links": scenario.links.model_copy(update={"up": lossy, "down": lossy})})
    plan = flown(scenario)
    fleet = Fleet(plan.scenario, START_NS)
    for _ in fly_lockstep(plan, vehicles=fleet):
        for row, system_id in enumerate(plan.formation.system_ids):
            own = vehicle(fleet, system_id)
            if own.flight.armed:
                wanted = own_parameters(plan.formation, plan.gain, row)
                assert {name: own.parameters[name] for name in wanted} == {n: float32(v) for n, v in wanted.items()}
    assert all(vehicle(fleet, system_id).flight.armed for system_id in (1, 2, 3))


def test_a_gain_not_taken_ends_the_start_with_nothing_armed() -> None:
    plan = flown(delayed(0.1))
    fleet, broken = Fleet(plan.scenario, START_NS), plan.gain.copy()
    broken[2, 2] = 2e4  # more than the vehicle accepts
    station = Station(replace(plan, gain=broken), start_ns=START_NS)
    assert list(fly_lockstep(station.plan, station=station, vehicles=fleet))
    assert station.end_reason.startswith("refused: vehicle 2 holds 0 in parameter FORM_KP_NN after 20000")
    assert not vehicle(fleet, 2).flight.armed
    assert fleet.vehicle(2).counters["refused_parameter_value"] > 0


def test_flights_repeat_to_the_last_bit_and_seeds_move_sensors() -> None:
    def ticks(seed: int) -> bytes:
        calm = {"seed": seed, "duration_s": 2.0, "clocks": {"offset_max_s": 0.0, "drift_max_ppm": 0.0}}
        data = delayed(0.1).model_dump() | calm
        return fly_plan(flown(Scenario.model_validate(data))).ticks.tobytes()

    assert ticks(1) == ticks(1) != ticks(2)


def test_without_set_points_vehicles_keep_their_places_by_own_sensors() -> None:
    plan = flown(delayed(0.17, duration_s=3.0))
    fleet = Fleet(plan.scenario, START_NS)
    now_ns = START_NS
    for ticks in fly_lockstep(plan, vehicles=fleet):
        now_ns = int(ticks["sent_ns"][0])
        if ticks["time_s"][0] > 2.5:
            break
    for _ in range(600):  # the station is gone
        now_ns += 100_000_000
        fleet.step((), now_ns)
    offsets = plan.formation.offset_ne_m
    states = [fleet.state(system_id, now_ns) for system_id in (1, 2, 3)]
    for k in (1, 2):
        ahead, own = states[k - 1], states[k]
        error = (own.north_m - ahead.north_m - offsets[k, 0], own.east_m - ahead.east_m - offsets[k, 1])
        assert np.hypot(*error) < 0.1  # noise of the sensor: 0.05 m, filtered
        assert vehicle(fleet, k + 1).flight.failsafe


def test_an_asymmetric_link_shows_an_error_that_is_not_there() -> None:
    """The sensor on board keeps the place; the station sees the vehicle where it was half the asymmetry ago."""
    scenario = onboard("chain3", duration_s=15.0)
    one_sided = VehicleLinks(system_id=3, up=Link(delay_s=0.16), down=Link(delay_s=0.02))
    links = scenario.links.model_copy(update={"vehicles": (one_sided,)})
    plan = flight_plan(scenario.model_copy(update={"links": links}))[1]
    fleet = Fleet(plan.scenario, START_NS)
    ticks = np.concatenate(list(fly_lockstep(plan, vehicles=fleet)))
    last = ticks[(ticks["system_id"] == 3) & (ticks["time_s"] < 15.0)][-1]
    speed_m_s = np.hypot(*scenario.nominal_velocity_at(15.0))
    shown_m = np.hypot(last["spacing_error_north_m"], last["spacing_error_east_m"])
    assert shown_m == pytest.approx(0.07 * speed_m_s, rel=1e-3)
    now_ns = int(last["sent_ns"]) + 500_000_000
    fleet.step((), now_ns)
    ahead, own = (fleet.state(system_id, now_ns) for system_id in (2, 3))
    north_m, east_m = plan.formation.offset_ne_m[2]
    assert np.hypot(own.north_m - ahead.north_m - north_m, own.east_m - ahead.east_m - east_m) < 0.01


@pytest.mark.parametrize("act", [False, True])
def test_when_one_is_lost_all_keep_place_by_own_loops(act: bool) -> None:
    """Vehicle 2, which the others act on and which acts on them, is not heard and hears nothing for six seconds."""
    gone = Link(delay_s=0.085, outages=(Outage(from_s=8.0, until_s=14.0),))
    scenario = delayed(0.17, duration_s=25.0)
    links = scenario.links.model_copy(update={"vehicles": (VehicleLinks(system_id=2, up=gone, down=gone),)})
    monitor = scenario.monitor.model_copy(update={"act": act})
    flight = fly_plan(flown(scenario.model_copy(update={"links": links, "monitor": monitor})))
    told = [event.text for event in flight.events if event.kind == "vehicle"]
    assert told[3:] == ["is lost", "is heard again", "is in failsafe"]
    later = flight.ticks[(flight.ticks["time_s"] > 7.0) & (flight.ticks["time_s"] < 25.0)]
    # noise of the sensor: 0.05 m, filtered
    assert np.nanmax(np.hypot(later["spacing_error_north_m"], later["spacing_error_east_m"])) < 0.1
    assert set(later["mode"][later["time_s"] > 24.0]) == {Mode.NOMINAL}


@pytest.mark.parametrize("name", ["thesis_delay", "chain3"])
def test_loop_delays_measured_are_those_of_the_truth(name: str) -> None:
    """From the sample of the oldest state that was needed to the instant at which the set-point acts."""
    scenario = load(THESIS) if name == "thesis_delay" else onboard(name)
    still = scenario.clocks.model_copy(update={"drift_max_ppm": 0.0})
    if name == "chain3":  # a design for the loop on board needs nothing of others
        gains = FixedGains(K1=-3.4, K2=0.6, K3=5.6)
        needy = scenario.control.model_copy(update={"gains": gains, "delay_margin_s": None})
        scenario = scenario.model_copy(update={"control": needy})
    _, plan = flight_plan(scenario.model_copy(update={"duration_s": 3.0, "clocks": still}))
    recorder = MemoryRecorder()
    ticks = np.concatenate(list(fly_lockstep(plan, vehicles=Fleet(plan.scenario, START_NS, recorder=recorder))))
    truth = recorder.records
    sampled, acted = instants(truth, SAMPLED), instants(truth, ACTED)
    true_s = true_loop_delays_s(ticks, truth)
    # whose states are needed; with none, when its own v_d comes is all that is late
    needed = {1: (1, 2), 2: (1, 2, 3), 3: (1, 2)} if name == "thesis_delay" else {1: (1,), 2: (1,), 3: (2,)}
    graded = Counter[int]()
    for k in np.flatnonzero(ticks["commanded"] & (ticks["time_s"] > 1.0)):
        row, same = ticks[k], ticks[ticks["tick"] == ticks["tick"][k]]
        system_id, newest = int(row["system_id"]), {int(o["system_id"]): int(o["sample_boot_ms"]) for o in same}
        since_ns = min(sampled[other, newest[other]] for other in needed[system_id])
        until_ns = acted.get((system_id, int(row["key_ms"])))
        if until_ns is not None:
            graded[system_id] += 1
            assert row["loop_delay_s"] == pytest.approx((until_ns - since_ns) * 1e-9, abs=1e-6)
            assert true_s[k] == (until_ns - since_ns) * 1e-9  # the same as gcs grade finds it
    assert set(graded) == {1, 2, 3}


def probed(plan: FlightPlan, link_delay_s: float) -> Any:
    scenario = plan.scenario.with_link_delay(up_s=link_delay_s / 2.0, down_s=link_delay_s / 2.0)
    return fly_trial(Trial(scenario, sparse_gain(plan.gain), plan.delay_margin_s, "probe", CRITICAL))


def test_growth_either_side_of_the_margin_matches_the_sampled_model() -> None:
    _, plan = thesis()
    outcomes = [probed(plan, part * plan.delay_margin_s) for part in (0.5, 0.95, 1.05)]
    assert [outcome.verdict for outcome in outcomes] == ["stable", "stable", "unstable"]
    for outcome in outcomes:
        assert outcome.error is None
        assert outcome.growth_1_s == pytest.approx(outcome.predicted_growth_1_s, abs=2e-4)


def test_clocks_apart_leave_growth_and_loop_delays_as_they_are() -> None:
    """The model assumes simultaneous steps of all vehicles. Two flights with random clocks are subtracted."""
    still = load(THESIS).clocks.model_copy(update={"drift_max_ppm": 0.0})
    plan = flown(delayed(1.0, clocks=still))
    calm = fly_calm(plan, None)
    response = response_paired(plan, calm, (1, 2, 3), amplitude=1.0, folder=None)
    delays_s = response.loop_delays_s(response.errors, (1, 2, 3))
    assert delays_s == pytest.approx(median_delays_s(response.errors, (1, 2, 3)), abs=1e-6)
    found = fit_growth(motion_of(response.errors, (1, 2, 3), period_s=0.02), start_s=4.2, modes=7)
    [loop] = plan_loops(plan)
    assert found is not None
    # a step of 10 ms that is early or late: 0.00006 1/s here, a part in seven thousand of the margin
    assert found.growth_1_s == pytest.approx(loop.growth_at_1_s(delays_s), abs=1e-4)


def test_the_search_says_no_delay_breaks_a_leader_follower_formation() -> None:
    design, plan = flight_plan(onboard("chain3"))
    assert design.delay_margin_s is None
    with pytest.raises(NoOnset, match="the margin has no limit; in 5 flights with 0 to 2 s of link delay") as caught:
        find_onset(Study(plan), lambda trials: [fly_trial(trial) for trial in trials], tolerance=1e-4)
    assert caught.value.as_predicted  # growth rates within a part in ten thousand of those predicted


def test_flights_that_contradict_a_margin_without_limit_are_reported() -> None:
    _, plan = flight_plan(onboard("chain3"))

    def half_as_fast(trials: Sequence[Trial]) -> list[Outcome]:
        return [replace(fly_trial(trial), growth_1_s=-0.86) for trial in trials[:1]]

    with pytest.raises(NoOnset, match=r"decay at 0\.86000 1/s or faster, predicted 1\.69363") as caught:
        find_onset(Study(plan), half_as_fast, tolerance=0.02)
    assert not caught.value.as_predicted


def test_rates_on_board_stay_multiples_of_a_varied_control_rate() -> None:
    """They are the lowest multiples that are no slower than those of the file, 100 and 50 Hz."""
    scenario = at_coordinates(load(THESIS), {"rate": 20.0})
    assert (scenario.onboard.rate_hz, scenario.onboard.sensor_hz) == (120.0, 60.0)
    assert parse(dump(scenario), THESIS) == scenario


def test_ticks_of_the_opened_formation_keep_the_wider_spacing() -> None:
    """The vehicles' own spacing stays as it was uploaded; the rest is streamed."""
    _, plan = flight_plan(onboard("chain3", duration_s=25.0, limits=Limits()))
    station = Station(plan, start_ns=START_NS)
    rows: list[TickArray] = []
    for ticks in fly_lockstep(plan, station=station):
        station._monitor.opening = 1.5  # noqa: SLF001
        rows.append(ticks)
    last = rows[-60]
    gap = np.hypot(last["north_m"][1] - last["north_m"][0], last["east_m"][1] - last["east_m"][0])
    # positions are of two instants up to a period apart, 1.8 m of flight
    assert gap == pytest.approx(1.5 * np.hypot(*plan.formation.offset_ne_m[1]), abs=2.0)


BAD = {
    "sensor_hz = 50.0": ("sensor_hz = 75.0", "onboard.sensor_hz", "a whole multiple of rates.control_hz = 50"),
    "rate_hz = 100.0": ("rate_hz = 75.0", "onboard.rate_hz", "a whole multiple of onboard.sensor_hz = 50"),
}


@pytest.mark.parametrize("good", BAD)
def test_what_onboard_loops_cannot_fly_is_refused_in_one_line(good: str) -> None:
    bad, key, wanted = BAD[good]
    with pytest.raises(ScenarioError) as caught:
        parse(THESIS.read_text().replace(good, bad), Path("x.toml"))
    assert key in str(caught.value)
    assert wanted in str(caught.value)


def test_vehicles_with_an_autopilot_have_no_such_loop() -> None:
    with pytest.raises(ScenarioError, match=r"control\.loop: read 'onboard', wanted ground, with dynamics autopilot"):
        onboard("copters5")
