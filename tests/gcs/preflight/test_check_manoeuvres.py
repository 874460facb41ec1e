"""What `gcs check` says of a formation that manoeuvres."""

import pytest

from gcs.plan.loops import plan_loops
from gcs.plan.planner import flight_plan, over_own_links
from gcs.preflight.check import check
from scenarios.files import load
from scenarios.keys.course import Course
from scenarios.keys.link import Link, Links, VehicleLinks
from scenarios.schema import Control, FixedGains, Limits
from tests.support.paths import SCENARIOS

GAINS = Control(gains=FixedGains(K1=-1.6, K2=0.8, K3=0.5))
PATROL = load(SCENARIOS / "patrol.toml").model_copy(update={"control": GAINS})


def test_a_check_reports_the_course_and_the_closest_places() -> None:
    found = check(flight_plan(PATROL)[1])
    assert found.course is not None
    assert found.course.length_m == pytest.approx(25.0 * found.course.duration_s)
    assert found.course.acceleration_max_m_s2 == pytest.approx(4.0, rel=2e-4)  # changes last 1.0001 times as long
    assert (found.closest_m, found.closest_s) == (pytest.approx(15.0), pytest.approx(28.0))
    assert [motion.beyond for motion in found.planned] == [()] * 5


def test_vehicles_that_cannot_fly_the_plan_are_named() -> None:
    limits = Limits(speed_min_m_s=14.0, speed_max_m_s=30.0, acceleration_max_m_s2=7.0)
    found = check(flight_plan(PATROL.model_copy(update={"limits": limits}))[1])
    beyond = {motion.system_id: motion.beyond for motion in found.planned if motion.beyond}
    # the last vehicles of both platoons fly farthest out
    assert beyond.keys() >= {3, 5}
    assert beyond[5] == ("speed_max_m_s", "acceleration_max_m_s2")


def test_the_links_of_an_external_leader_judge_nothing() -> None:
    """The station closes no loop over them: such a flight settled with 87 % of headroom."""
    slow = Link(delay_s=0.7)
    links = Links(
        up=Link(delay_s=0.02), down=Link(delay_s=0.02), vehicles=(VehicleLinks(system_id=1, up=slow, down=slow),)
    )
    chain = load(SCENARIOS / "chain3.toml").model_copy(update={"links": links, "course": Course(leader="external")})
    design, plan = over_own_links(*flight_plan(chain))
    found = check(plan)
    leader, *followers = found.vehicles
    assert (leader.expected_loop_delay_s, leader.headroom, leader.link_delay_left_s) == (None, None, None)
    assert [own.expected_loop_delay_s for own in followers] == pytest.approx([0.05, 0.05])
    assert found.headroom == found.effective_headroom == pytest.approx(1.0 - 0.05 / 0.3)
    assert (found.headroom_p99 or 0.0) > 0.75
    assert design.at_loop_delay is not None
    assert design.at_loop_delay.loop_delay_s == pytest.approx(0.05)
    assert (design.margin_of(1), design.margin_of(2)) == (None, pytest.approx(0.3))  # as gcs monitor judges them
    assert [loop.system_ids for loop in plan_loops(plan)] == [(2,), (3,)]
