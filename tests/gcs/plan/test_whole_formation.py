"""α of the whole formation, which is computed for 2 to 50 vehicles."""

import pytest

from gcs.plan.disturbed import with_spread
from gcs.plan.planner import flight_plan
from gcs.studies.benchmark import with_vehicles, without_solver
from scenarios.files import load
from tests.support.paths import SCENARIOS


@pytest.mark.parametrize(("vehicles", "known"), [(1, False), (20, True), (51, False)])
def test_a_lone_vehicle_or_large_formation_has_no_formation_alpha(vehicles: int, known: bool) -> None:
    design, plan = flight_plan(without_solver(with_vehicles(load(SCENARIOS / "triangle5.toml"), vehicles), 1.0))
    assert (with_spread(design, plan).whole is not None) == known
