"""One trial: what it flies, what it measures, and what it does not stumble over."""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gcs.drive.flown import fly_plan
from gcs.plan.planner import flight_plan
from gcs.runs.record import DESIGN_FILE, SCENARIO_FILE, TICKS_FILE
from gcs.stress.axes import at_coordinates
from gcs.stress.free_response import probe_scenario, with_waiting
from gcs.stress.measure import fly_trial
from gcs.stress.study import Study
from gcs.stress.trial import Trial, plan_of
from scenarios.files import load
from scenarios.keys.link import Link, VehicleLinks
from scenarios.schema import Clocks, Control, GainBlock
from tests.support.fleets.stress_pair import SCENARIO, pair_plan
from tests.support.paths import SCENARIOS


def pair_trial(delay_s: float = 0.1, **changes: Any) -> Trial:
    return replace(Study(pair_plan()).trial("probe", {"delay": delay_s}, seed=7), **changes)


def study_of(name: str) -> Study:
    scenario = load(SCENARIOS / f"{name}.toml")
    calm = scenario.monitor.model_copy(update={"time_scales": (1.0,)})
    _, plan = flight_plan(scenario.model_copy(update={"monitor": calm}))
    return Study(plan)


@pytest.mark.parametrize(
    ("name", "delay_s"),
    [("chain3", 0.28), ("chain3", 0.3), ("triangle5", 0.279), ("triangle5", 0.45), ("chain20", 0.286)],
)
def test_flown_growth_is_that_of_the_sampled_model(name: str, delay_s: float) -> None:
    """Two independent ways. Fit and telemetry allow 2e-5; a millisecond of loop delay would be 8e-3."""
    outcome = fly_trial(study_of(name).trial("probe", {"delay": delay_s}, seed=4))
    assert outcome.error is None
    assert outcome.growth_1_s is not None
    assert outcome.predicted_growth_1_s is not None
    assert outcome.growth_1_s == pytest.approx(outcome.predicted_growth_1_s, abs=1e-4)
    # the half period that the continuous model takes for the hold is good to a part in a thousand
    assert outcome.predicted_growth_continuous_1_s == pytest.approx(outcome.predicted_growth_1_s, abs=2e-3)
    assert outcome.verdict == ("unstable" if outcome.growth_1_s > 0.0 else "stable")


@pytest.mark.parametrize(
    "own",
    [
        ((7.6, 0.3, -4.7, 0.0), (-0.2, 6.1, 0.0, -4.7)),  # the fit needs a mode for each state and delayed state
        ((6.5, 1.2, -4.0, -0.7), (1.2, 6.5, -0.7, -4.0)),  # the slow mode is along one diagonal, and has to be excited
    ],
)
def test_a_follower_with_coupled_axes_is_measured(
    own: tuple[tuple[float, ...], tuple[float, ...]],
) -> None:
    """With half the modes the fit is off by 6e-2; an error along the other diagonal shows a mode that is 0.7 off."""
    blocks = GainBlock(vehicle=1, of=1, gain=((-4.7, 0.0), (0.0, -6.1))), GainBlock(vehicle=2, of=2, gain=own)
    _, plan = flight_plan(SCENARIO.model_copy(update={"control": Control(blocks=blocks)}))
    outcome = fly_trial(Study(plan).trial("probe", {"delay": 0.2}, seed=4, probe=2))
    assert outcome.growth_1_s == pytest.approx(outcome.predicted_growth_1_s, abs=2e-3)


@pytest.mark.parametrize("telemetry_hz", [25.0, 100.0])
def test_growth_with_slower_telemetry_matches_the_effective_delay(telemetry_hz: float) -> None:
    """A state used at two ticks is late by two delays; the model at their median is off by 0.09."""
    study = study_of("chain3")
    rates = study.plan.scenario.rates.model_copy(update={"telemetry_hz": telemetry_hz})
    study = replace(study, plan=replace(study.plan, scenario=study.plan.scenario.model_copy(update={"rates": rates})))
    for delay_s in (0.281, 0.29):
        outcome = fly_trial(study.trial("probe", {"delay": delay_s}, seed=4))
        assert outcome.growth_1_s == pytest.approx(outcome.predicted_growth_1_s, abs=2e-3)


def test_the_leaders_loop_can_be_probed_too() -> None:
    """Its margin is larger, so it decays where the followers are near theirs."""
    outcome = fly_trial(study_of("chain3").trial("probe", {"delay": 0.285}, seed=4, probe=1))
    assert (outcome.probed, outcome.critical) == (1, 1)
    assert outcome.growth_1_s == pytest.approx(-0.94, abs=0.05)
    assert outcome.growth_1_s == pytest.approx(outcome.predicted_growth_1_s, abs=1e-3)


def test_a_probe_has_the_critical_vehicles_loop_delay() -> None:
    trial = study_of("triangle5").trial("probe", {"delay": 0.2}, seed=1)
    outcome = fly_trial(trial)
    scenario = trial.scenario.model_copy(update={"duration_s": 1.0, "clocks": Clocks(drift_max_ppm=0.0)})
    ticks = fly_plan(replace(plan_of(trial), scenario=scenario)).ticks
    own = ticks[(ticks["system_id"] == outcome.critical) & ticks["commanded"]]
    assert outcome.loop_delay_s == pytest.approx(float(np.median(own["loop_delay_s"])), abs=1e-5)
    assert outcome.waiting_s == pytest.approx((outcome.loop_delay_s or 0.0) - 0.2, abs=1e-6)


def test_vehicles_ahead_of_the_probed_one_do_not_move() -> None:
    study = study_of("chain3")
    plan = plan_of(study.trial("probe", {"delay": 0.25}, seed=4))
    links = plan.scenario.link_of(3)
    scenario = probe_scenario(plan, (3,), amplitude=1.0, links=links, waiting_s=0.013)
    ticks = fly_plan(replace(plan, scenario=scenario.model_copy(update={"duration_s": 5.0}))).ticks
    flown = ticks[ticks["time_s"] > 0.0]
    for system_id, moves in ((1, False), (2, False), (3, True)):
        own = flown[flown["system_id"] == system_id]
        largest = np.nanmax(np.hypot(own["velocity_error_north_m_s"], own["velocity_error_east_m_s"]))
        assert (largest > 0.5) if moves else (largest < 1e-3)  # rounding of positions to 1e-4 m is fed back


@given(up_ms=st.integers(0, 400), down_ms=st.integers(0, 400), waiting_us=st.integers(0, 19_999))
def test_moving_delay_between_links_keeps_waiting_and_loop_delay(up_ms: int, down_ms: int, waiting_us: int) -> None:
    period_s, waiting_s = 0.02, waiting_us * 1e-6
    up, down = with_waiting(
        Link(delay_s=up_ms * 1e-3), Link(delay_s=down_ms * 1e-3), period_s=period_s, waiting_s=waiting_s
    )
    assert min(up.delay_s, down.delay_s) >= 0.0
    waits_s = -up.delay_s % period_s  # of telemetry that is sampled at whole periods
    loop_delay_s = up.delay_s + waits_s + down.delay_s
    off_s = abs(loop_delay_s - (up_ms + down_ms) * 1e-3 - waiting_s)
    # rounding can put the arrival on either side of a tick; a link delay cannot go below zero
    assert min(off_s, abs(off_s - period_s)) < 1e-9 or down.delay_s == 0.0


def test_a_trial_is_its_inputs_wherever_it_is_made() -> None:
    trial = pair_trial()
    again = pickle.loads(pickle.dumps(trial))
    assert again == trial
    assert again.id == trial.id
    assert replace(trial, coordinates=()).id == trial.id  # only a label
    others = [pair_trial(0.11), replace(trial, probe=1), replace(trial, kind="own"), replace(trial, real_time=True)]
    others.append(replace(trial, scenario=SCENARIO.model_copy(update={"seed": 8})))
    assert len({trial.id, *(other.id for other in others)}) == 6


def test_the_same_trial_has_the_same_outcome() -> None:
    first, second = (replace(fly_trial(pair_trial()), elapsed_s=0.0) for _ in range(2))
    assert first == second


def test_fast_growth_is_measured_from_a_smaller_initial_error() -> None:
    outcome = fly_trial(pair_trial(0.5))
    assert outcome.amplitude_m is not None
    assert outcome.amplitude_m < 1.0
    assert outcome.growth_1_s == pytest.approx(outcome.predicted_growth_1_s, abs=1e-3)


def test_a_failing_trial_records_its_exception_and_does_not_raise() -> None:
    outcome = fly_trial(pair_trial(gain=((99, 0, 1.0),)))
    assert outcome.error is not None
    assert "IndexError" in outcome.error
    assert outcome.seed == 7
    assert outcome.growth_1_s is None


def test_the_monitor_does_not_act_in_a_trial() -> None:
    """Far above the margin it would release the vehicles; here the flight goes on until it breaks."""
    acting = SCENARIO.model_copy(update={"monitor": SCENARIO.monitor.model_copy(update={"act": True})})
    trial = replace(pair_trial(0.6), scenario=at_coordinates(acting, {"delay": 0.6}), kind="own")
    assert not plan_of(trial).scenario.monitor.act


def test_one_slow_link_is_the_critical_one() -> None:
    study = study_of("chain3")
    slow = VehicleLinks(system_id=3, up=Link(delay_s=0.1), down=Link(delay_s=0.12))
    scenario = study.plan.scenario
    scenario = scenario.model_copy(update={"links": scenario.links.model_copy(update={"vehicles": (slow,)})})
    outcome = fly_trial(Study(replace(study.plan, scenario=scenario)).trial("probe", {}, seed=4))
    assert outcome.critical == 3
    assert outcome.link_delay_s == pytest.approx(0.22)
    assert outcome.growth_1_s == pytest.approx(outcome.predicted_growth_1_s, abs=1e-3)


def test_a_flight_can_be_left_in_a_folder(tmp_path: Path) -> None:
    outcome = fly_trial(pair_trial(kind="own"), tmp_path / "run")
    assert outcome.error is None
    assert {SCENARIO_FILE, DESIGN_FILE, TICKS_FILE} <= {file.name for file in (tmp_path / "run").iterdir()}
    assert outcome.verdict == "stable"
    assert outcome.trace_m[0] == pytest.approx(np.hypot(10.0, 5.0), abs=2.0)
