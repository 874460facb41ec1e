"""Leaves vehicles out of a formation: the others keep their places relative to each other.

A follower of a vehicle that is left out follows the one in front of that vehicle, at the sum of both offsets. If the
leader is left out, its follower with the lowest system id leads, and the others follow that one. So the scenario
remains a complete formation, with gains, margins and figures like any other. Followers with nobody in front would
instead form groups that keep no distance from each other.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path

from scenarios.errors import ScenarioError
from scenarios.files import checked
from scenarios.keys.course import ChangedOffset, FormationChange
from scenarios.schema import Scenario, Vehicle

OPTION = "--without"


def without(scenario: Scenario, system_ids: Iterable[int], file: Path) -> Scenario:
    """The scenario without these vehicles; `file` is named in errors.

    Raises ScenarioError for a vehicle that is not in the scenario, for a leader flown by somebody else, if none is
    left, or if gains are given block by block, because these belong to the whole formation.
    """
    for system_id in dict.fromkeys(system_ids):
        known = [vehicle.system_id for vehicle in scenario.vehicles]
        if system_id not in known or len(known) == 1:
            wanted = f"the system_id of one of its vehicles: {', '.join(map(str, known))}"
            raise ScenarioError(
                file, OPTION, system_id, wanted if len(known) > 1 else "at least one vehicle to be left"
            )
        if scenario.control.blocks:
            raise ScenarioError(file, OPTION, system_id, "all vehicles, with control.blocks: they need every vehicle")
        if system_id == scenario.external_id:  # the first follower would become the leader that nobody commands
            wanted = "a vehicle that the station flies, with course.leader external"
            raise ScenarioError(file, OPTION, system_id, wanted)
        scenario = _without_one(scenario, system_id)
    return checked(scenario, file)


def _without_one(scenario: Scenario, system_id: int) -> Scenario:
    gone = next(vehicle for vehicle in scenario.vehicles if vehicle.system_id == system_id)
    behind = sorted((v for v in scenario.vehicles if v.follows == system_id), key=lambda vehicle: vehicle.system_id)
    ahead, (north_m, east_m) = gone.follows, gone.offset_ne_m or (0.0, 0.0)
    if ahead is None:
        ahead, (north_m, east_m) = behind[0].system_id, (-x for x in behind[0].offset_ne_m or (0.0, 0.0))

    def moved(vehicle: Vehicle) -> Vehicle:
        follows, offset = vehicle.follows, vehicle.offset_ne_m
        if vehicle.follows == system_id:
            own_north_m, own_east_m = offset or (0.0, 0.0)
            follows, offset = ahead, (own_north_m + north_m, own_east_m + east_m)
        if vehicle.system_id == follows:
            follows = offset = None
        hears = tuple(other for other in vehicle.hears if other not in (system_id, follows))
        return vehicle.model_copy(update={"follows": follows, "offset_ne_m": offset, "hears": hears})

    own_links = tuple(link for link in scenario.links.vehicles if link.system_id != system_id)
    return scenario.model_copy(
        update={
            "vehicles": tuple(moved(vehicle) for vehicle in scenario.vehicles if vehicle is not gone),
            "formation_changes": tuple(_changes(scenario, gone, ahead)),
            "links": scenario.links.model_copy(update={"vehicles": own_links}),
        }
    )


def _changes(scenario: Scenario, gone: Vehicle, ahead: int) -> Iterator[FormationChange]:
    """The formation changes without a vehicle whose followers then follow `ahead`.

    The offset of such a follower is the sum of two, and changes if either does.
    """
    beside, sign = (ahead, -1.0) if gone.follows is None else (gone.system_id, 1.0)
    offsets = {vehicle.system_id: vehicle.offset_ne_m or (0.0, 0.0) for vehicle in scenario.vehicles}
    left = [v for v in scenario.vehicles if v.follows is not None and v.system_id not in (gone.system_id, beside)]
    for change in scenario.formation_changes:
        listed = {changed.system_id: changed.offset_ne_m for changed in change.offsets}
        offsets |= listed
        changed = list[ChangedOffset]()
        for vehicle in left:
            share = sign if vehicle.follows == gone.system_id else 0.0
            if vehicle.system_id in listed or (share and beside in listed):
                north_m, east_m = (
                    own + share * other for own, other in zip(offsets[vehicle.system_id], offsets[beside], strict=True)
                )
                changed.append(ChangedOffset(system_id=vehicle.system_id, offset_ne_m=(north_m, east_m)))
        if changed:
            yield change.model_copy(update={"offsets": tuple(changed)})
