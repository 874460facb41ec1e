"""The expected loop delay of jittery links against flights."""

import numpy as np
import pytest

from gcs import fly_virtual
from gcs.drive.flown import fly_plan
from gcs.plan.expected_delay import (
    effective_loop_delays_s,
    expected_loop_delay_s,
    planned_loop_delays_s,
    setpoint_gaps,
)
from gcs.plan.planner import flight_plan
from gcs.preflight.check import check
from gcs.stress.free_response import effective_delays_s
from scenarios.files import load, with_loop, with_profile
from scenarios.keys.link import Jitter, Link, Links, LossBursts, VehicleLinks
from scenarios.keys.part import Prediction
from scenarios.schema import Scenario
from scenarios.shipped import FOLDER
from tests.support.known import known


def calm_chain() -> Scenario:
    scenario = load(FOLDER / "chain3.toml").with_calm_monitor()
    control = scenario.control.model_copy(update={"delay_margin_s": 1.0})
    return scenario.model_copy(update={"control": control, "duration_s": 15.0})


def over(jitter: Jitter, delay_s: float) -> Scenario:
    link = Link(delay_s=delay_s, jitter=jitter)
    return calm_chain().model_copy(update={"links": Links(up=link, down=link)})


@pytest.mark.parametrize(
    "scenario",
    [
        over(Jitter(distribution="uniform", scale_s=0.05), 0.005),
        over(Jitter(distribution="normal", scale_s=0.02), 0.05),
        with_profile(calm_chain(), "lte", FOLDER / "chain3.toml"),
    ],
    ids=["uniform", "normal", "lte"],
)
def test_expected_and_p99_loop_delay_are_those_of_flights(scenario: Scenario) -> None:
    flown = fly_virtual(scenario).summary
    slowest_s, latest_s = (max(getattr(own.loop_delay_s, at) for own in flown.vehicles) for at in ("p50", "p99"))
    # 450 down delays and three phases: 2 % of standard error
    assert expected_loop_delay_s(scenario) == pytest.approx(slowest_s, rel=0.05)
    assert check(flight_plan(scenario)[1]).loop_delay_s_p99 == pytest.approx(latest_s, rel=0.1)


@pytest.mark.parametrize("prediction", ["off", "measured"])
@pytest.mark.parametrize("name", ["chain3", "thesis_delay"], ids=["on the ground", "on board"])
def test_p99_headroom_is_that_of_flights(name: str, prediction: Prediction) -> None:
    scenario = load(FOLDER / f"{name}.toml").with_calm_monitor()
    control = scenario.control.model_copy(update={"prediction": prediction})
    link = Link(delay_s=0.05, jitter=Jitter(distribution="uniform", scale_s=0.05))
    changed = {"control": control, "links": Links(up=link, down=link), "duration_s": 20.0}
    scenario = scenario.model_copy(update=changed)
    flown = fly_virtual(scenario).ticks
    flown = flown[flown["time_s"] > 5.0]
    late = [np.quantile(flown["headroom"][flown["system_id"] == own], 0.01) for own in (1, 2, 3)]
    expected = check(flight_plan(scenario)[1])
    assert expected.headroom_p99 == pytest.approx(min(late), abs=0.05)
    assert (expected.headroom_p99 or 0.0) < (expected.headroom or 0.0) - 0.02  # the median tells nothing of jitter


def test_jitter_cut_off_at_zero_lengthens_the_expected_delay() -> None:
    assert expected_loop_delay_s(over(Jitter(distribution="uniform", scale_s=0.05), 0.005)) > 0.04


@pytest.mark.parametrize(
    ("name", "expected_s"),
    [("thesis_delay", [0.05, 0.1, 0.1]), ("chain3", [0.05, 0.05, 0.15])],
    ids=["neighbours' states", "nothing is streamed"],
)
def test_on_board_the_slowest_state_that_a_command_needs_counts(name: str, expected_s: list[float]) -> None:
    fast, slow = Link(delay_s=0.02), Link(delay_s=0.07)
    links = Links(up=fast, down=fast, vehicles=(VehicleLinks(system_id=3, up=slow, down=slow),))
    file = FOLDER / f"{name}.toml"
    scenario = with_loop(load(file), "onboard", file).model_copy(update={"links": links, "duration_s": 10.0})
    assert list(planned_loop_delays_s(flight_plan(scenario)[1]).values()) == pytest.approx(expected_s)
    flown_s = [own.loop_delay_s.p50 for own in fly_virtual(scenario).summary.vehicles]
    assert flown_s == pytest.approx(expected_s, abs=0.01)  # half a period, depending on the phases


def test_on_board_states_of_different_instants_are_waited_for() -> None:
    """With slow telemetry the result depends on the phases at which vehicles report, which differ between flights."""
    scenario = load(FOLDER / "thesis_delay.toml").with_calm_monitor()
    slow = scenario.model_copy(
        update={"rates": scenario.rates.model_copy(update={"telemetry_hz": 5.0}), "duration_s": 10.0}
    )
    flights = [fly_virtual(slow.model_copy(update={"seed": seed})).summary.vehicles for seed in range(1, 5)]
    flown_s = np.mean([[known(own.loop_delay_s.p50) for own in flight] for flight in flights], axis=0)
    expected_s = [*planned_loop_delays_s(flight_plan(slow)[1]).values()]
    assert expected_s == pytest.approx(flown_s.tolist(), rel=0.1)
    # the vehicle in the middle needs both others: 32 ms more with 3,000 draws of their phases
    assert expected_s[1] - expected_s[0] == pytest.approx(0.032, abs=0.005)


@pytest.mark.parametrize("telemetry_hz", [50.0, 10.0])
def test_where_datagrams_are_lost_older_commands_keep_acting(telemetry_hz: float) -> None:
    calm = calm_chain()
    link = Link(delay_s=0.03, loss_probability=0.3)
    rates = calm.rates.model_copy(update={"telemetry_hz": telemetry_hz})
    scenario = calm.model_copy(update={"links": Links(up=link, down=link), "rates": rates, "duration_s": 60.0})
    plan = flight_plan(scenario)[1]
    flight = fly_plan(plan, with_truth=True)
    rows = flight.ticks[(flight.ticks["time_s"] > 2.0) & (flight.ticks["time_s"] < 58.0)]
    flown_s = effective_delays_s(plan, rows, flight, plan.formation.system_ids)
    [expected_s] = set(effective_loop_delays_s(plan).values())
    # half a period, depending on the phases; one vehicle is in failsafe now and then
    assert expected_s == pytest.approx(np.median([*flown_s.values()]), abs=0.01)
    assert expected_s > 1.04 * expected_loop_delay_s(scenario)
    assert check(plan).vehicles[1].link_delay_left_s == pytest.approx(plan.delay_margin_s - expected_s)


@pytest.mark.parametrize(("control_hz", "telemetry_hz"), [(20.0, 7.0), (50.0, 50.0)])
def test_late_datagrams_count_as_lost_ones(control_hz: float, telemetry_hz: float) -> None:
    calm = calm_chain()
    slow, fast = (Jitter(distribution="exponential", scale_s=scale_s) for scale_s in (0.15, 0.05))
    changed = {
        "links": Links(up=Link(delay_s=0.02, jitter=slow), down=Link(delay_s=0.02, jitter=fast)),
        "rates": calm.rates.model_copy(update={"control_hz": control_hz, "telemetry_hz": telemetry_hz}),
        "duration_s": 100.0,
    }
    plan = flight_plan(calm.model_copy(update=changed))[1]
    flight = fly_plan(plan, with_truth=True)
    rows = flight.ticks[(flight.ticks["time_s"] > 2.0) & (flight.ticks["time_s"] < 98.0)]
    flown_s = effective_delays_s(plan, rows, flight, plan.formation.system_ids)
    [expected_s] = set(effective_loop_delays_s(plan).values())
    assert expected_s == pytest.approx(np.mean([*flown_s.values()]), rel=0.06)
    assert expected_s > 1.05 * expected_loop_delay_s(plan.scenario)  # the median


def losing(down: Link, **control: object) -> Scenario:
    """A flight at 5 Hz, where a lost set-point matters, without a limit on how long set-points may stay away."""
    calm = calm_chain()
    rates = calm.rates.model_copy(update={"control_hz": 5.0, "telemetry_hz": 5.0})
    safety = calm.safety.model_copy(update={"setpoint_timeout_s": 100.0, "heartbeat_timeout_s": 100.0})
    changed = {
        "links": Links(up=Link(delay_s=0.02), down=down),
        "rates": rates,
        "safety": safety,
        "control": calm.control.model_copy(update={"delay_margin_s": 0.4, **control}),
        "duration_s": 60.0,
    }
    return calm.model_copy(update=changed)


@pytest.mark.parametrize("prediction", ["off", "measured", 0.14])
def test_a_gate_fails_where_lost_set_points_break_the_flight(prediction: Prediction) -> None:
    scenario = losing(Link(delay_s=0.02, loss_probability=0.75), prediction=prediction)
    found = check(flight_plan(scenario)[1])
    assert found.effective_headroom is not None
    assert found.effective_headroom < 0.0 < (found.headroom_p99 or 0.0)
    assert fly_virtual(scenario).summary.verdict != "stable"


def test_corrupt_datagrams_count_as_lost_ones() -> None:
    lost, corrupt = (
        effective_loop_delays_s(flight_plan(losing(down))[1])
        for down in (Link(delay_s=0.02, loss_probability=0.5), Link(delay_s=0.02, corrupt_probability=0.5))
    )
    assert corrupt == lost


def test_failsafes_are_expected_where_set_points_stay_away() -> None:
    """At 5 Hz, a timeout of 0.5 s passes when two set-points in a row are lost."""
    scenario = losing(Link(delay_s=0.02, loss_probability=0.5))
    scenario = scenario.model_copy(
        update={"safety": scenario.safety.model_copy(update={"setpoint_timeout_s": 0.5}), "seed": 3}
    )
    flown = fly_virtual(scenario)
    events = [event for event in flown.events if "set-points stopped" in str(event)]
    # one for each run of two or more lost set-points
    assert check(flight_plan(scenario)[1]).setpoint_gaps == pytest.approx(3 * 60.0 * 5.0 * 0.5**3, rel=0.1)
    assert len(events) > 0


def test_gaps_as_long_as_the_timeout_count_half() -> None:
    """So do gaps that the smallest jitter makes longer or shorter."""
    jitter = Jitter(distribution="uniform", scale_s=1e-6)
    constant, shaken = (losing(Link(delay_s=0.02, jitter=own)) for own in (None, jitter))
    safety = constant.safety.model_copy(update={"setpoint_timeout_s": 1.0 / constant.rates.control_hz})
    sent = 3 * constant.duration_s * constant.rates.control_hz
    for scenario in (constant, shaken):
        expected = setpoint_gaps(scenario.model_copy(update={"safety": safety}))
        assert expected == pytest.approx(0.5 * sent, rel=0.03)  # 5000 gaps are drawn


def test_states_lost_in_bursts_lengthen_the_p99_loop_delay() -> None:
    """With independent losses, states would be at most 0.14 s late for 99 % of the set-points."""
    bursts = LossBursts(to_bad_probability=0.02, to_good_probability=0.2)
    link = Link(delay_s=0.05, loss_bursts=bursts)
    scenario = calm_chain().model_copy(update={"links": Links(up=link, down=link), "duration_s": 120.0})
    flown = fly_virtual(scenario).summary
    late_s = np.mean([known(own.loop_delay_s.p99) for own in flown.vehicles])
    expected_s = check(flight_plan(scenario)[1]).loop_delay_s_p99
    assert expected_s == pytest.approx(late_s, rel=0.15)
    assert expected_s > 0.2


def test_a_given_delay_is_off_by_the_wait_for_ticks() -> None:
    """The wait is unknown before a flight and constant during it."""
    calm = calm_chain()
    rates = calm.rates.model_copy(update={"telemetry_hz": 10.0, "control_hz": 10.0})
    control = calm.control.model_copy(update={"prediction": 1.0, "delay_margin_s": 0.4})
    scenario = calm.model_copy(update={"rates": rates, "control": control}).with_link_delay(up_s=0.45, down_s=0.45)
    found = check(flight_plan(scenario)[1])
    flights = [fly_virtual(scenario.model_copy(update={"seed": seed})).summary for seed in range(1, 5)]
    least = [own.headroom_min or 0.0 for flight in flights for own in flight.vehicles]
    assert min(least) == pytest.approx(found.headroom_p99, abs=0.05)
    assert (found.headroom_p99 or 0.0) < (found.headroom or 0.0) - 0.2
