"""Some flights of the soak break no invariant, and the soak notices a broken one.

`python3 make.py soak --flights 10000 --seed 1` flies more. Each test flies a part, so that they share the processors.
"""

import re
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel

from gcs.plan.planner import flight_plan
from scenarios import files, schema
from scenarios.schema import Clocks, Control, FixedGains, Limits, Rates, Scenario
from tests.soak.__main__ import fly_all, soak
from tests.soak.soak_checks import checked
from tests.soak.soak_experiments import Experiment, experiment, whole
from tests.soak.soak_flight import Flown, fly
from tests.soak.soak_judge import judge
from tests.support.paths import ROOT, SCENARIOS

SEED, PARTS, FLIGHTS = 20, 14, 3
UNDRAWN = {"FormationChange", "ChangedOffset", "Sector", "Criteria", "CodeFile"}
"""Parts that only tests of their own fly: the invariants expect errors of one shape that decay, and quick designs."""


@pytest.mark.slow(first=2)
@pytest.mark.parametrize("part", range(PARTS))
def test_random_flights_break_no_invariant(part: int) -> None:
    found = {number: judge(experiment(SEED, number)).broken for number in range(part * FLIGHTS, (part + 1) * FLIGHTS)}
    assert {number: list(broken) for number, broken in found.items()} == {number: [] for number in found}


def short_scenario(gains: FixedGains, telemetry_hz: float = 50.0) -> Scenario:
    scenario = files.load(SCENARIOS / "chain3.toml")
    changes = {
        "duration_s": 2.0,
        "control": Control(gains=gains),
        "limits": Limits(acceleration_max_m_s2=400.0),
        "rates": Rates(telemetry_hz=telemetry_hz),
    }
    return scenario.model_copy(update=changes)


@cache
def calm_flight(telemetry_hz: float = 50.0) -> Flown:
    scenario = short_scenario(FixedGains(K1=-3.4, K2=0.6, K3=5.6), telemetry_hz)
    return fly(Experiment(scenario), flight_plan(scenario)[1])


@pytest.mark.parametrize(
    ("column", "value", "invariant"),
    [
        ("loop_delay_s", 0.05, "loop delay"),
        ("clock_offset_s", 7.0, "clock bounds"),
        ("sample_ns", 10**9, "clock bounds"),
        ("command_north_m_s2", 401.0, "commands within limits"),
        ("command_east_m_s2", float("nan"), "rows complete"),
        ("late", 7, "rows complete"),
        ("tick", 3, "rows complete"),
    ],
)
def test_a_wrong_value_in_one_row_is_seen(column: str, value: float, invariant: str) -> None:
    flown = calm_flight()
    assert list(checked(flown)) == []
    [stretch] = flown.stretches
    ticks = stretch.ticks.copy()
    ticks[column][len(ticks) // 2, 1] = value
    broken = list(checked(replace(flown, stretches=[replace(stretch, ticks=ticks)])))
    assert [one.invariant for one in broken] == [invariant]


@pytest.mark.parametrize(("telemetry_hz", "wrong_s"), [(50.0, 0.001), (10.0, 0.11), (10.0, 0.04)])
def test_a_false_repetition_is_seen(telemetry_hz: float, wrong_s: float) -> None:
    flown = calm_flight(telemetry_hz)
    assert list(checked(flown)) == []
    [stretch] = flown.stretches
    ticks = stretch.ticks.copy()
    newer = np.flatnonzero(np.diff(ticks["sample_boot_ms"][:, 1]) != 0) + 1
    ticks["repeated_s"][newer[len(newer) // 2], 1] = wrong_s
    broken = {one.invariant for one in checked(replace(flown, stretches=[replace(stretch, ticks=ticks)]))}
    assert broken == {"repetitions", "loop delay"}


def test_an_unstable_loop_is_refused_unless_flying_it_is_allowed() -> None:
    scenario = short_scenario(FixedGains(K1=3.0, K2=0.6, K3=5.6))
    refused = judge(Experiment(scenario))
    assert refused.refused.startswith("control.gains: read a loop that is unstable without any delay")
    flown = judge(Experiment(scenario, allow_unstable=True))
    assert (flown.refused, flown.broken) == ("", ())
    assert flown.ended


@pytest.mark.parametrize(
    "reason", ["broken: vehicles 1 and 2 have collided, 0.3 m apart", "completed: duration reached"]
)
def test_a_false_reason_of_the_end_is_seen(reason: str) -> None:
    """Vehicles in their places have not collided, and vehicles far from their places have not settled."""
    flown = calm_flight()
    [stretch] = flown.stretches
    states = dict(stretch.states_at_end)
    if reason.startswith("completed"):
        ticks = stretch.ticks.copy()
        for axis in ("north", "east"):
            ticks[f"spacing_error_{axis}_m"][:, 1:] = 0.0
        states[2] = (states[2][0] + 50.0, *states[2][1:])
        stretch = replace(stretch, ticks=ticks)
    said = stretch.station.end_reason
    stretch.station.end_reason = reason
    broken = list(checked(replace(flown, stretches=[replace(stretch, states_at_end=states)])))
    stretch.station.end_reason = said
    assert [one.invariant for one in broken] == ["verdict" if reason.startswith("completed") else "collision"]


def test_a_key_that_the_soak_does_not_draw_is_named() -> None:
    with pytest.raises(AssertionError, match=r"Clocks differ in the keys \['drift_max_ppm'\]"):
        whole(Clocks, offset_max_s=1.0)


def test_every_part_of_the_schema_is_drawn() -> None:
    """The keys of a part that no flight has would never be checked."""

    def parts(value: object) -> set[str]:
        if isinstance(value, BaseModel):
            return {type(value).__name__}.union(*(parts(getattr(value, name)) for name in type(value).model_fields))
        return set().union(*(parts(one) for one in value)) if isinstance(value, tuple) else set()

    drawn = set().union(*(parts(experiment(SEED, number).scenario) for number in range(PARTS * FLIGHTS)))
    assert drawn | UNDRAWN == {one.__name__ for one in schema.Part.__subclasses__()}


def test_an_experiment_is_read_back_as_it_was_saved(tmp_path: Path) -> None:
    for number in range(20):
        drawn = experiment(SEED, number)
        file = tmp_path / f"{number}.toml"
        drawn.save(file)
        assert Experiment.load(file) == drawn
        assert files.load(file) == drawn.scenario


def test_two_workers_fly_what_one_flies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    numbers = range(18, 22)  # short flights
    assert soak(fly_all(SEED, numbers, 1), len(numbers), SEED, tmp_path) == 0
    one = capsys.readouterr().out
    command = [sys.executable, "-m", "tests.soak", "--first", "18", "--flights", "4", "--seed", str(SEED)]
    two = subprocess.run([*command, "--workers", "2"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert re.sub(r"in \d+ s", "", one) == re.sub(r"in \d+ s", "", two)
    assert "4 flights" in one
