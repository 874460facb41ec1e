"""α and the growth of spacing errors with delay, as a user sees them: in design, table and summary."""

import io
from typing import Literal, cast

import numpy as np
import pytest
from rich.console import Console

from gains.performance.flown import FlownFormation, FlownTiming
from gcs.drive.flown import fly_plan
from gcs.plan.at_delay import figures_at
from gcs.plan.design import Design, FiguresAtDelay
from gcs.plan.expected_delay import expected_loop_delay_s
from gcs.plan.planner import flight_plan
from gcs.runs.files import by_vehicle
from gcs.runs.summary import summarise
from gcs.views.report import print_design
from gcs.views.table import FlightState, plain_line
from scenarios.files import load, with_loop
from scenarios.keys.link import DelayPoint, Jitter, Link, Links, VehicleLinks
from scenarios.schema import Rates
from tests.support.known import known
from tests.support.paths import ROOT

TRIANGLE = load(ROOT / "scenarios/triangle5.toml")
TWO_WAY = load(ROOT / "scenarios/chain3_bidirectional.toml")


def test_a_design_reports_alpha_and_growth_at_its_links_delay() -> None:
    late = TRIANGLE.with_link_delay(up_s=0.12, down_s=0.12)
    flown = flight_plan(late)[0].at_loop_delay
    assert flown is not None
    assert flown.alpha_kept_to_s is not None
    assert flown.loop_delay_s == pytest.approx(0.25)
    assert flown.alpha == pytest.approx(0.312, abs=5e-4)
    assert flown.string_peak == pytest.approx(2.49, abs=5e-3)
    assert flown.string_peak_kept == 1.0
    assert flown.string_peak_kept_to_s == pytest.approx(0.1607, abs=1e-4)
    assert 0.15 < flown.alpha_kept_to_s < 0.17
    beyond = flight_plan(TRIANGLE.with_link_delay(up_s=0.2, down_s=0.2))[0].at_loop_delay
    assert beyond is not None
    assert (beyond.alpha, beyond.string_peak) == (0.0, None)


def test_a_slower_gain_set_is_judged_as_a_slowed_design() -> None:
    design, _ = flight_plan(TRIANGLE)
    # slowed down by 2, everything but the hold takes twice the time: 2 (0.2 + 0.01) - 0.01
    fast, slow = figures_at(design, TRIANGLE, 0.2), figures_at(design, TRIANGLE, 0.41, gain_set=1)
    assert fast.string_peak is not None
    assert slow.string_peak == pytest.approx(fast.string_peak, rel=1e-6)
    minimal = Design(delay_margin_s=0.3)
    assert figures_at(minimal, TRIANGLE, 0.1) == FiguresAtDelay(loop_delay_s=0.1, has_string_verdict=False)


def test_the_expected_loop_delay_is_that_of_the_slowest_links() -> None:
    assert expected_loop_delay_s(TRIANGLE) == pytest.approx(0.05)
    gamma = Jitter(distribution="gamma", scale_s=0.01, shape=2.0)
    ramp = (DelayPoint(at_s=0.0, delay_s=0.0), DelayPoint(at_s=9.0, delay_s=0.1))
    links = Links(
        up=Link(delay_s=0.03, jitter=gamma),
        down=Link(delay_s=0.01),
        vehicles=(VehicleLinks(system_id=2, down=Link(delay_points=ramp)),),
    )
    slow = TRIANGLE.model_copy(update={"links": links, "rates": Rates(telemetry_hz=10.0)})
    # the wait is half the shorter period, that of control: repeated commands count as the first from their state
    # the median of this jitter is 16.8 ms; with the wait, the sum is less skewed
    assert expected_loop_delay_s(slow) == pytest.approx(0.03 + 0.0168 + 0.1 + 0.01, abs=0.002)


def test_table_and_summary_show_alpha_and_growth_at_measured_delay() -> None:
    late = TRIANGLE.with_link_delay(up_s=0.09, down_s=0.09).model_copy(update={"duration_s": 6.0})
    calm = late.model_copy(update={"monitor": late.monitor.model_copy(update={"act": False})})
    design, plan = flight_plan(calm)
    flight = fly_plan(plan)
    figures = summarise(calm, design, flight.ticks, flight.events).at_loop_delay
    own = flight.ticks["loop_delay_s"][flight.ticks["commanded"]].reshape(-1, 5)
    assert figures.loop_delay_s == pytest.approx(np.nanmedian(own, axis=0).max(), abs=1e-9)
    assert figures == figures_at(design, calm, figures.loop_delay_s)
    assert 0.5 < known(figures.alpha) < 0.81
    assert 1.0 < known(figures.string_peak) < 1.4
    state = FlightState(calm, design)
    rows = flight.ticks.reshape(-1, 5)
    state.add(rows[(rows["time_s"][:, 0] > 3.0) & (rows["time_s"][:, 0] < 5.9)], [])
    assert f"alpha {figures.alpha:.2f}" in plain_line(state)
    assert f"errors grow at most {figures.string_peak:.1f}" in plain_line(state)


def test_alpha_is_that_of_the_slowest_vehicles_own_gains() -> None:
    links = Links(vehicles=(VehicleLinks(system_id=4, down=Link(delay_s=0.45)),))
    safety = TRIANGLE.safety.model_copy(update={"spacing_error_limit_m": 300.0})
    slow = TRIANGLE.model_copy(update={"links": links, "safety": safety, "duration_s": 20.0})
    design, plan = flight_plan(slow)
    flight = fly_plan(plan)
    sets = {key: own["gain_set"][own["commanded"]] for key, own in by_vehicle(flight.ticks).items()}
    longest = {key: int(np.bincount(own).argmax()) for key, own in sets.items()}
    assert longest[4] > 0  # its own delay has made it change to slower gains, and no other vehicle
    assert {longest[key] for key in (1, 2, 3, 5)} == {0}
    figures = summarise(slow, design, flight.ticks, flight.events).at_loop_delay
    assert figures == figures_at(design, slow, figures.loop_delay_s, longest[4])
    assert known(figures.alpha) > 0.1


def test_general_pattern_gains_have_formation_alpha_and_no_string_verdict() -> None:
    late = TWO_WAY.with_link_delay(up_s=0.1, down_s=0.1)
    design, plan = flight_plan(late)
    figures = design.at_loop_delay
    assert figures is not None
    assert figures.alpha is not None
    assert figures.alpha_kept_to_s is not None
    assert figures.loop_delay_s == pytest.approx(0.21)
    assert (figures.has_string_verdict, figures.string_peak, figures.string_peak_kept) == (False, None, None)
    assert figures.alpha < 0.99 * (design.alpha or 0.0)
    assert 0.15 < figures.alpha_kept_to_s < 0.21
    # σ_min on a plain grid, of both axes
    omega = np.linspace(0.0, 6.0, 6001)[:, None, None]
    matrix = 1j * omega * np.eye(10) - plan.model.A - plan.model.B @ plan.gain * np.exp(-1j * omega * (0.21 + 0.01))
    assert figures.alpha == pytest.approx(np.linalg.svd(matrix, compute_uv=False).min(), rel=1e-5)
    console = Console(file=io.StringIO(), width=200)
    print_design(design, console)
    text = cast("io.StringIO", console.file).getvalue()
    assert (
        f"{figures.alpha:.4f} of the whole formation at the 210.0 ms of loop delay that the scenario's links give"
        in text
    )
    assert "no verdict: with gains on a general pattern errors do not propagate along a chain" in text


@pytest.mark.parametrize("loop", ["ground", "onboard"])
def test_general_pattern_gain_sets_have_the_alpha_of_flown_gains(
    loop: Literal["ground", "onboard"],
) -> None:
    scenario = with_loop(TWO_WAY, loop, ROOT)
    design, plan = flight_plan(scenario)
    for gain_set, (K, margin_s) in enumerate(zip(plan.gains, plan.margins_s, strict=True)):
        step_s = 1.0 / scenario.onboard.rate_hz if loop == "onboard" else 0.0
        own = FlownFormation(plan.model, K, FlownTiming(margin_s, 0.02, loop, step_s))
        found = figures_at(design, scenario, 0.15, gain_set).alpha
        assert found == pytest.approx(own.alpha(0.15), rel=1e-6)  # own gains are flown as float32


def test_general_pattern_flights_report_alpha_at_the_measured_delay() -> None:
    short = TWO_WAY.model_copy(update={"duration_s": 4.0})
    design, plan = flight_plan(short)
    flight = fly_plan(plan)
    figures = summarise(short, design, flight.ticks, flight.events).at_loop_delay
    assert figures == figures_at(design, short, figures.loop_delay_s)
    assert 0.6 < known(figures.alpha) < (design.alpha or 0.0)
    state = FlightState(short, design)
    rows = flight.ticks.reshape(-1, 3)
    state.add(rows[rows["time_s"][:, 0] > 2.0], [])
    assert f"alpha {figures.alpha:.2f}" in plain_line(state)
    assert "errors grow" not in plain_line(state)


def test_a_design_says_that_spacing_errors_do_not_grow() -> None:
    console = Console(file=io.StringIO(), width=200)
    print_design(flight_plan(TRIANGLE)[0], console)
    text = cast("io.StringIO", console.file).getvalue()
    assert "that the scenario's links give, where spacing errors do not grow from vehicle to vehicle\n" in text
    assert "; up to 160.7 ms spacing errors do not grow\n" in text
    assert "1.00 times" not in text
