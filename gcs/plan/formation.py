"""The scenario's formation: who follows whom, and at which offset."""

from dataclasses import dataclass

import numpy as np

from gains.core.arrays import FloatArray
from gains.formation.model import FormationModel
from scenarios.schema import Scenario


@dataclass(frozen=True)
class Formation:
    """The vehicles of a formation, each listed after the one it follows."""

    system_ids: tuple[int, ...]
    model: FormationModel
    """Who follows whom, and the resulting error model."""
    offset_ne_m: FloatArray
    """Wanted position relative to the vehicle in front when the flight begins, (n, 2); zero for the leader."""

    def row(self, system_id: int) -> int:
        return self.system_ids.index(system_id)

    def place_ne_m(self) -> FloatArray:
        """Wanted positions relative to the leader, (n, 2)."""
        place = self.offset_ne_m.copy()
        for i in self.model.followers:
            place[i] += place[self.model.predecessors[i]]
        return place


def plan_formation(scenario: Scenario) -> Formation:
    """The scenario's formation, its vehicles in `leader_first` order."""
    ordered = scenario.leader_first()
    row = {vehicle.system_id: k for k, vehicle in enumerate(ordered)}
    model = FormationModel(tuple(-1 if v.follows is None else row[v.follows] for v in ordered))
    offset_m = np.array([v.offset_ne_m or (0.0, 0.0) for v in ordered])
    if scenario.course.offsets != "fixed":  # they turn with the course
        north, east = scenario.nominal_velocity_at(0.0)
        offset_m = offset_m @ np.array([[north, east], [-east, north]]) / np.hypot(north, east)
    return Formation(tuple(row), model, offset_m)
