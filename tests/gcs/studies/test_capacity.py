"""`gcs capacity`: what a slow radio carries, against arithmetic and at its limits."""

import json

import pytest
from typer.testing import CliRunner

from gcs.cli.main import app
from gcs.errors import InputError
from gcs.studies.capacity import capacity, fly_loaded, worst_load
from scenarios.files import load
from scenarios.keys.disturbance import Disturbance, Gusts, Navigation
from scenarios.schema import FixedGains, Scenario
from tests.support.paths import SCENARIOS

RADIO = SCENARIOS / "radio57600.toml"
BYTES_S = 57600 / 10


@pytest.fixture(scope="module")
def short() -> Scenario:
    return load(RADIO).model_copy(update={"duration_s": 40.0})


def test_traffic_is_counted_and_its_excess_is_lost(short: Scenario) -> None:
    light = fly_loaded(short, 10.0, 3)
    # at most a report of 40 bytes up and a set-point of 65 down in each tenth of a second (MAVLink cuts trailing zeros
    # off), heartbeats and TIMESYNC besides, and all of it in proportion to the vehicles
    assert 0.5 < light.station_bytes_s / (3 * 10.0 * (40 + 65)) < 1.1
    assert fly_loaded(short, 10.0, 2).station_bytes_s == pytest.approx(light.station_bytes_s * 2 / 3, rel=0.02)
    assert light.lost_up < 0.02
    assert light.lost_down < 0.02
    assert light.holds
    heavy = fly_loaded(short, 10.0, 8)
    assert BYTES_S < 8 * 10.0 * (40 + 65)
    assert heavy.lost_down > 0.1
    assert not heavy.holds


def test_the_largest_formation_holds_and_the_next_does_not(short: Scenario) -> None:
    [found] = capacity(short, rates_hz=[20.0], most=6, seeds=1, seconds=40.0)
    assert found.most is not None
    assert found.next is not None
    assert found.most.holds
    assert not found.next.holds
    assert found.next.vehicles == found.most.vehicles + 1
    assert fly_loaded(short, 20.0, found.most.vehicles) == found.most


def test_a_formation_is_judged_by_its_worst_losses(short: Scenario) -> None:
    alone = [fly_loaded(short.model_copy(update={"seed": short.seed + k}), 10.0, 3) for k in range(3)]
    assert all(load.holds for load in alone)
    assert len({load.lost_down for load in alone}) == 3
    assert worst_load(short, 10.0, 3, seeds=3) == min(alone, key=lambda load: load.headroom_p01 or 0.0)
    heavy = worst_load(short, 10.0, 8, seeds=3)
    assert heavy == fly_loaded(short, 10.0, 8), "the first that does not hold is enough"


def test_gusts_and_navigation_errors_use_up_nothing_of_the_links(short: Scenario) -> None:
    pushes = {
        "disturbance": Disturbance(gusts=Gusts(deviation_m_s2=0.6, correlation_time_s=2.0)),
        "navigation": Navigation(position_noise_m=0.3),
    }
    assert fly_loaded(short.model_copy(update=pushes), 10.0, 3) == fly_loaded(short, 10.0, 3)


def test_gains_that_are_unstable_at_a_rate_are_not_flown(short: Scenario) -> None:
    gains = FixedGains(K1=-30.0, K2=0.0, K3=1.0)  # 1 - 30 T is -2 at 10 Hz, and 0.4 at 50 Hz
    control = short.control.model_copy(update={"gains": gains, "alpha": None, "delay_margin_s": None})
    given = short.model_copy(update={"control": control})
    found = capacity(given, rates_hz=[10.0], most=2, seeds=1, seconds=20.0)
    assert found[0].next is None
    assert "only sampling makes unstable" in found[0].failed


def test_a_rate_without_gains_says_why(short: Scenario) -> None:
    control = short.control.model_copy(update={"alpha": 0.9})
    [found] = capacity(short.model_copy(update={"control": control}), rates_hz=[10.0], most=2)
    assert found.most is None
    assert "exclude each other" in found.failed


def test_json_holds_what_is_shown() -> None:
    result = CliRunner().invoke(app, ["capacity", str(RADIO), "--rates", "10", "--most", "2", "--json"])
    assert result.exit_code == 0, result.output
    [found] = json.loads(result.stdout)["capacities"]
    assert found["most"]["vehicles"] == 2
    assert found["most"]["loop_delay_p99_s"] < found["most"]["delay_margin_s"] == pytest.approx(0.6)
    assert found["next"] is None


def test_a_study_first_says_how_many_flights_it_has() -> None:
    result = CliRunner().invoke(app, ["capacity", str(RADIO), "--rates", "10", "--most", "2", "--seeds", "1"])
    assert result.exit_code == 0, result.output
    assert result.stderr == "flights  at most 2 formations, one flight of 180 s each\n"


@pytest.mark.parametrize("rates", ["", "ten", "0.5", "5,nan"])
def test_bad_rates_are_refused_in_one_line(rates: str) -> None:
    result = CliRunner().invoke(app, ["capacity", str(RADIO), "--rates", rates])
    assert isinstance(result.exception, InputError)
    assert str(result.exception).startswith(f"--rates: read {rates}, wanted numbers from 1 to 500")


@pytest.mark.parametrize(("name", "read"), [("thesis_delay", "control.blocks: read 7"), ("copters5", "'autopilot'")])
def test_what_it_cannot_fly_is_refused_in_one_line(name: str, read: str) -> None:
    result = CliRunner().invoke(app, ["capacity", name, "--rates", "10", "--most", "2"])
    assert isinstance(result.exception, InputError)
    assert read in str(result.exception)
