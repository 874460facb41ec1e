"""`gcs capacity`: why a formation fails, loops on board at any rate, and studies that are resumed."""

import json
from pathlib import Path

import pytest

from gcs.errors import InputError
from gcs.studies.capacity import LOADS_FILE, capacity, fly_loaded, loads_of, write_result
from scenarios.files import load, with_loop
from scenarios.schema import Scenario
from tests.support.paths import SCENARIOS
from tests.support.processes import gcs

RADIO = SCENARIOS / "radio57600.toml"


@pytest.fixture
def short() -> Scenario:
    return load(RADIO).model_copy(update={"duration_s": 6.0})


def test_loop_on_board_flies_at_rates_not_dividing_its_sensors(short: Scenario) -> None:
    onboard = with_loop(short, "onboard", RADIO)
    assert onboard.onboard.sensor_hz % 20.0 != 0.0
    found = fly_loaded(onboard, 20.0, 2)
    assert found.loop_delay_p50_s is not None


def test_an_early_end_is_reported_in_the_stations_words(short: Scenario) -> None:
    safety = short.safety.model_copy(update={"spacing_error_limit_m": 1.0})  # every second vehicle begins 2 m off
    found = fly_loaded(short.model_copy(update={"safety": safety}), 10.0, 2)
    assert found.reason.startswith("not formed: vehicle 2 is 2 m from its place")


def test_resumed_study_flies_nothing_again(tmp_path: Path, short: Scenario) -> None:
    first = loads_of(tmp_path, short, resume=False)
    left: list[int] = []
    found = capacity(short, rates_hz=[10.0], most=3, seeds=1, seconds=6.0, store=first, ended=left.append)
    write_result(tmp_path, found)
    first.close()
    assert left == sorted(left, reverse=True)
    assert left[-1] == 0
    stored = (tmp_path / LOADS_FILE).read_bytes()
    (tmp_path / LOADS_FILE).write_bytes(stored + stored[:40])  # a kill cut the last line short
    again = loads_of(tmp_path, short, resume=True)
    assert capacity(short, rates_hz=[10.0], most=3, seeds=1, seconds=6.0, store=again) == found
    again.close()
    assert (tmp_path / LOADS_FILE).read_bytes() == stored + stored[:40] + b"\n"
    assert json.loads((tmp_path / "capacity.json").read_text())["schema_version"] == 1


def test_links_of_a_profile_replace_those_of_the_scenario() -> None:
    """radio57600 loses 0.5 % of its datagrams each way, lte 0.1 %."""
    options = ["--rates", "10", "--most", "2", "--seeds", "1", "--json"]
    [found] = json.loads(gcs("capacity", "radio57600", "--links", "lte", *options).stdout)["capacities"]
    assert 0.0005 < found["most"]["lost_up"] < 0.002


def test_study_of_another_scenario_is_not_resumed(tmp_path: Path, short: Scenario) -> None:
    loads_of(tmp_path, short, resume=False).close()
    with pytest.raises(InputError, match="another scenario"):
        loads_of(tmp_path, short.model_copy(update={"seed": 99}), resume=True)
