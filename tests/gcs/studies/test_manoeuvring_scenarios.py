"""Studies replace a scenario's vehicles, and with them its manoeuvres."""

from gcs.preflight.faults import bad_start
from gcs.studies.benchmark import with_vehicles
from scenarios.files import load
from tests.support.paths import SCENARIOS


def test_columns_of_a_manoeuvring_scenario_fly_straight_on() -> None:
    patrol = load(SCENARIOS / "patrol.toml")
    columns = with_vehicles(patrol, 12)
    assert not columns.manoeuvres
    assert columns.nominal_velocity_at(30.0) == patrol.nominal_velocity_at(0.0)
    assert bad_start(columns) is None
