"""The planned motion of a manoeuvring formation, and the distances it keeps."""

import numpy as np
import pytest

from gcs.plan.course import PlannedMotion, nearest_planned
from gcs.plan.formation import plan_formation
from gcs.preflight.faults import bad_start
from scenarios.files import load
from tests.support.paths import SCENARIOS

PATROL = load(SCENARIOS / "patrol.toml")
STEP_S = 1e-3


@pytest.mark.parametrize("offsets", ["heading", "fixed"])
def test_planned_velocities_and_accelerations_are_derivatives_of_places(offsets: str) -> None:
    scenario = PATROL.model_copy(update={"course": PATROL.course.model_copy(update={"offsets": offsets})})
    motion = PlannedMotion(scenario, plan_formation(scenario))
    for time_s in (12.0, 24.0, 27.3, 41.0):  # in a turn, in a change, in a change, in a turn
        for row in range(5):
            before, at, after = (motion.reference(row, time_s + k * STEP_S) for k in (-1, 0, 1))
            moved = np.subtract(after.place_m, before.place_m) / (2.0 * STEP_S)
            nominal = scenario.nominal_velocity_at(time_s)
            # central differences err by step² / 6 times the third derivative, some m/s³
            assert np.add(nominal, moved) == pytest.approx(at.velocity_m_s, abs=1e-5)
            gained = np.subtract(after.velocity_m_s, before.velocity_m_s) / (2.0 * STEP_S)
            assert gained == pytest.approx(at.acceleration_m_s2, abs=1e-5)


def test_places_keep_their_distances_while_the_formation_turns() -> None:
    motion = PlannedMotion(PATROL, plan_formation(PATROL))
    before, after = motion.places_ne_m(0.0), motion.places_ne_m(18.0)
    assert np.hypot(*(before - before[1]).T) == pytest.approx(np.hypot(*(after - after[1]).T), abs=1e-9)
    assert np.abs(before - after).max() > 10.0


def test_the_least_distance_is_that_of_the_crossing() -> None:
    nearest = nearest_planned(PATROL)
    assert nearest is not None
    assert nearest.distance_m == pytest.approx(15.0)  # one above the other
    motion, ids = PlannedMotion(PATROL, plan_formation(PATROL)), plan_formation(PATROL).system_ids
    one, two = (ids.index(system_id) for system_id in nearest.system_ids)
    place = motion.places_ne_m(nearest.time_s)
    assert np.hypot(*(place[one] - place[two])) == pytest.approx(0.0, abs=1e-6)
    assert bad_start(PATROL) is None


def test_a_crossing_at_one_altitude_is_refused_beforehand() -> None:
    level = tuple(vehicle.model_copy(update={"altitude_m": None}) for vehicle in PATROL.vehicles)
    fault = bad_start(PATROL.model_copy(update={"vehicles": level}))
    assert fault is not None
    assert "formation_changes: read places of vehicles 2 and 4 0.00 m apart at 28.0 s, wanted at least" in fault


def test_offsets_in_the_heading_frame_start_along_the_first_leg() -> None:
    course = PATROL.course.model_copy(update={"waypoints_ne_m": ((0.0, 0.0), (0.0, 900.0))})
    formation = plan_formation(PATROL.model_copy(update={"course": course, "formation_changes": ()}))
    # 40 m behind and 40 m to the right, eastbound: 40 m west and 40 m south
    assert formation.offset_ne_m[formation.row(2)] == pytest.approx([-40.0, -40.0])
