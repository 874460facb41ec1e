"""`gcs bench`: its figures are measured, whatever the machine."""

import json
import time  # noqa: TID251 - figures cannot exceed the time they were measured in
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gcs.cli.main import app
from gcs.errors import InputError
from gcs.studies.benchmark import benchmark, with_vehicles
from scenarios.files import load
from tests.support.paths import SCENARIOS

TRIANGLE = SCENARIOS / "triangle5.toml"


def test_a_large_formation_is_flown_by_its_station() -> None:
    begun_s = time.perf_counter()
    result = benchmark(with_vehicles(load(TRIANGLE), 23), seconds=0.2, repeat=2)
    taken_s = time.perf_counter() - begun_s
    assert result.vehicles == 23
    assert result.ticks > 10
    assert min(result.station_s_per_tick, result.vehicles_s_per_tick, result.core_share) > 0.0
    in_turn_s = result.station_s_per_tick + result.vehicles_s_per_tick
    assert in_turn_s * result.ticks * result.flights < taken_s
    assert result.station_share_of_period == pytest.approx(result.station_s_per_tick * result.control_hz)
    assert result.tick_over_parse == result.station_s_per_tick / result.pymavlink_parse_s > 0.0
    assert result.real_time_factor >= result.real_time_factor_p50 > 0.0


def test_what_signing_costs_is_measured_in_the_same_run() -> None:
    result = benchmark(load(TRIANGLE), seconds=0.2, repeat=2, signed=True)
    assert result.signed is not None
    assert min(result.signed.to_dict().values()) > 0.5  # a figure, whatever else this machine does


def test_columns_keep_their_places_behind_one_leader() -> None:
    scenario = with_vehicles(load(TRIANGLE), 250)
    place = {vehicle.system_id: vehicle.position_ne_m for vehicle in scenario.vehicles}
    assert len(place) == 250
    assert len(set(place.values())) == 250
    for vehicle in scenario.vehicles[1:]:
        assert vehicle.follows is not None
        assert vehicle.offset_ne_m is not None
        ahead = place[vehicle.follows]
        assert tuple(a + b for a, b in zip(ahead, vehicle.offset_ne_m, strict=True)) == place[vehicle.system_id]


@pytest.mark.realtime
def test_in_real_time_latencies_are_graded_against_the_truth() -> None:
    asked = ["bench", str(TRIANGLE), "--real-time", "--one-port", "--seconds", "3", "--json"]
    result = CliRunner().invoke(app, asked)
    assert result.exit_code == 0, result.output
    grade = json.loads(result.stdout)
    assert grade["reason"].startswith("completed")
    assert grade["control"]["ticks"] + grade["control"]["deadline_misses"] >= 150
    # each state in each tick, ten round trips a second of each vehicle, each report and reply
    assert grade["loop_delay"]["samples"] > 600
    assert grade["rtt"]["samples"] > 100
    assert grade["link_delay"]["samples"] > 800
    assert grade["loop_delay"]["error_p50_s"] < 0.005


def test_a_run_without_truth_is_refused_in_one_line(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["grade", str(tmp_path)])
    assert isinstance(result.exception, InputError)
    assert "read no truth.bin" in str(result.exception)
