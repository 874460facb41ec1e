"""A scenario without some of its vehicles keeps the places of the others."""

from itertools import combinations
from pathlib import Path

import pytest

from gcs.plan.course import PlannedMotion
from gcs.plan.formation import plan_formation
from scenarios.errors import ScenarioError
from scenarios.files import load
from scenarios.left_out import without
from scenarios.schema import Scenario
from scenarios.shipped import located

FILE = Path("x.toml")


def places(scenario: Scenario) -> dict[int, tuple[float, float]]:
    formation = plan_formation(scenario)
    return dict(zip(formation.system_ids, map(tuple, formation.place_ne_m().tolist()), strict=True))


def planned(scenario: Scenario, at_s: float) -> dict[int, tuple[float, float]]:
    """The places of all vehicles at `at_s`, relative to the leader's."""
    formation = plan_formation(scenario)
    moved = PlannedMotion(scenario, formation).places_ne_m(at_s)
    return dict(zip(formation.system_ids, map(tuple, moved.tolist()), strict=True))


@pytest.mark.parametrize("name", ["copters5", "triangle5", "chain20", "radio57600"])
def test_the_others_keep_their_places_whoever_is_left_out(name: str) -> None:
    scenario = load(located(name))
    ids = [vehicle.system_id for vehicle in scenario.vehicles][:6]
    whole = places(scenario)
    for gone in [*combinations(ids, 1), *combinations(ids, 2)]:
        some = without(scenario, gone, FILE)
        left = places(some)
        assert set(left) == set(whole) - set(gone)
        first = next(iter(left))
        for system_id, place in left.items():
            there = [a - b for a, b in zip(whole[system_id], whole[first], strict=True)]
            assert [a - b for a, b in zip(place, left[first], strict=True)] == pytest.approx(there, abs=1e-9)
        assert not set(gone) & {link.system_id for link in some.links.vehicles}


@pytest.mark.parametrize("gone", [[1], [2], [3], [4], [1, 3], [2, 4], [5, 1]])
def test_formation_changes_keep_their_places_whoever_is_left_out(gone: list[int]) -> None:
    # a follower takes over the offset of the vehicle that is left out, which may be the one that changes
    changes = load(located("patrol")).formation_changes
    only_3 = changes[0].model_copy(update={"offsets": changes[0].offsets[1:2]})
    for some_change in (changes, (only_3,)):
        whole = load(located("patrol")).model_copy(update={"formation_changes": some_change})
        some = without(whole, gone, FILE)
        for at_s in (0.0, 25.0, 30.0, 60.0):
            before, after = planned(whole, at_s), planned(some, at_s)
            first = next(iter(after))
            for system_id, place in after.items():
                there = [a - b for a, b in zip(before[system_id], before[first], strict=True)]
                assert [a - b for a, b in zip(place, after[first], strict=True)] == pytest.approx(there, abs=1e-9)


def test_a_leader_left_out_is_followed_by_its_first_follower() -> None:
    some = without(load(located("copters5")), [1], FILE)
    follows = {vehicle.system_id: (vehicle.follows, vehicle.offset_ne_m) for vehicle in some.vehicles}
    assert follows[2] == (None, None)
    assert follows[4] == (2, (0.0, -24.0))
    assert follows[3] == (2, (-12.0, 12.0))


@pytest.mark.parametrize(
    ("gone", "said"),
    [([9], "--without: read 9, wanted the system_id of one of its vehicles: 1, 2, 3, 4, 5"),
     ([1, 2, 3, 4, 5], "--without: read 5, wanted at least one vehicle to be left")],
)  # fmt: skip
def test_a_vehicle_that_cannot_be_left_out_is_named(gone: list[int], said: str) -> None:
    with pytest.raises(ScenarioError) as error:
        without(load(located("copters5")), gone, FILE)
    assert said in str(error.value)


def test_a_leader_flown_by_somebody_else_cannot_be_left_out() -> None:
    # its first follower would become a leader that the station commands nothing
    scenario = load(located("chain3"))
    led = scenario.model_copy(update={"course": scenario.course.model_copy(update={"leader": "external"})})
    with pytest.raises(ScenarioError, match="--without: read 1, wanted a vehicle that the station flies"):
        without(led, [1], FILE)
    assert without(led, [2], FILE).external_id == 1


def test_given_blocks_need_every_vehicle() -> None:
    scenario = load(located("thesis_gains"))
    with pytest.raises(ScenarioError):
        without(scenario, [scenario.vehicles[-1].system_id], FILE)
