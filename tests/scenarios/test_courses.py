"""Smooth courses: bounds, waypoints, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from scenarios.errors import ScenarioError
from scenarios.files import dump, parse
from scenarios.smooth import Bounds, course_by_steps, course_by_waypoints
from tests.support.paths import SCENARIOS

PATROL = (SCENARIOS / "patrol.toml").read_text(encoding="utf-8")
POINTS = ((0.0, 0.0), (400.0, 0.0), (850.0, 450.0), (850.0, 1000.0))


@pytest.mark.parametrize("bounds", [Bounds(4.0), Bounds(4.0, 3.0), Bounds(40.0, 1.0)])
def test_changes_of_velocity_reach_but_keep_their_bounds(bounds: Bounds) -> None:
    course = course_by_steps(bounds, ((0.0, (25.0, 0.0)), (5.0, (0.0, 15.0))))
    [change] = course.changes
    step_s = change.duration_s / 4000.0
    times_s = np.arange(change.from_s, change.until_s + step_s, step_s)
    velocity = np.array([course.at(time_s).velocity_ne_m_s for time_s in times_s])
    acceleration = np.gradient(velocity, step_s, axis=0)
    jerk = np.gradient(acceleration, step_s, axis=0)
    used = np.hypot(*acceleration.T).max() / bounds.acceleration_m_s2
    if bounds.jerk_m_s3 is not None:
        used = max(used, np.hypot(*jerk[2:-2].T).max() / bounds.jerk_m_s3)
    # finite differences over a 4000th of the change, which lasts 1.0001 times as long as necessary
    assert used == pytest.approx(1.0, abs=1e-3)
    assert velocity[-1] == pytest.approx([0.0, 15.0], abs=1e-9)


def test_waypoints_are_rounded_and_the_last_is_met() -> None:
    course = course_by_waypoints(Bounds(4.0, 3.0), POINTS, 25.0)
    step_s = course.end_s / 20_000
    middle_s = (np.arange(20_000) + 0.5) * step_s
    path = np.cumsum([course.at(time_s).velocity_ne_m_s for time_s in middle_s], axis=0) * step_s
    # the midpoint rule errs by step² / 24 times the change of acceleration: micrometres
    assert path[-1] == pytest.approx(POINTS[-1], abs=1e-3)
    for corner in POINTS[1:-1]:
        assert 5.0 < np.hypot(*(path - corner).T).min() < 60.0  # inside of the corner, not far from it


REFUSED = {
    "no speed": ("speed_m_s = 25.0\n", "", "course.speed_m_s: read nothing", "with course.waypoints_ne_m"),
    "short legs": ("acceleration_max_m_s2 = 4.0", "acceleration_max_m_s2 = 0.4", "waypoints", "longer legs"),
    "turning back": ("[850, 450], [850, 1000]", "[0, 0]", "course.waypoints_ne_m", "longer legs"),
    "one place": ("[400, 0], [850, 450], [850, 1000]]", "]", "course.waypoints_ne_m", "two places"),
    "no course": ("waypoints_ne_m = [[0, 0], [400, 0], [850, 450], [850, 1000]]\nspeed_m_s = 25.0\n", "",
                  "nominal_velocity", "at least one entry"),
    "leader's offset": ("{ system_id = 5, off", "{ system_id = 1, off", "formation_changes[0].offsets[3]", "once"),
    "on board": ("[control]", '[control]\nloop = "onboard"', "course.offsets", "fixed, with loop onboard"),
    "another's turns": ('offsets = "heading"', 'offsets = "heading"\nleader = "external"', "course.leader", "station"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_courses_that_cannot_be_flown_are_refused(case: str) -> None:
    before, after, key, wanted = REFUSED[case]
    assert before in PATROL
    with pytest.raises(ScenarioError) as error:
        parse(PATROL.replace(before, after, 1), Path("p.toml"))
    assert key in str(error.value)
    assert wanted in str(error.value).split("wanted", 1)[1]
    assert "\n" not in str(error.value)


def test_overlapping_changes_of_velocity_or_formation_are_refused() -> None:
    chain = (SCENARIOS / "chain3.toml").read_text(encoding="utf-8")
    smooth = chain.replace("[limits]", "[course]\nacceleration_max_m_s2 = 5.0\n\n[limits]", 1)
    turns = "".join(
        f"[[nominal_velocity]]\nfrom_s = {from_s}\nvelocity_ne_m_s = {velocity}\n\n"
        for from_s, velocity in ((5, [0.0, 91.44]), (9, [91.44, 0.0]))
    )
    with pytest.raises(ScenarioError, match=r"nominal_velocity\[2\].from_s: .* when the change before is over"):
        parse(smooth.replace("[[vehicles]]", f"{turns}[[vehicles]]", 1), Path("c.toml"))
    change = (
        "[[formation_changes]]\nat_s = {}\nduration_s = 5.0\noffsets = [{{ system_id = 2, offset_ne_m = [-9, 9] }}]\n"
    )
    with pytest.raises(ScenarioError, match=r"formation_changes\[1\].at_s: .* at least 7"):
        parse(chain + change.format(2.0) + change.format(6.9), Path("c.toml"))


def test_a_manoeuvring_scenario_is_written_and_read_back() -> None:
    scenario = parse(PATROL, Path("p.toml"))
    assert parse(dump(scenario), Path("p.toml")) == scenario
