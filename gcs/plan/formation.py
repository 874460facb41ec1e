"""The scenario's formation as arrays: who follows whom, and at which distance."""

from dataclasses import dataclass

import numpy as np

from gains.core.arrays import FloatArray, IntArray
from scenarios.schema import Scenario


@dataclass(frozen=True)
class Formation:
    """Who follows whom, in an order in which every vehicle comes after the one it follows.

    `predecessor` (n,) holds rows, -1 for the leader; `offset_ne_m` (n, 2) is the wanted position relative to the
    predecessor, zero for the leader.
    """

    system_ids: tuple[int, ...]
    predecessor: IntArray
    offset_ne_m: FloatArray

    def place_ne_m(self) -> FloatArray:
        """Wanted positions relative to the leader, (n, 2)."""
        place = self.offset_ne_m.copy()
        for row, ahead in enumerate(self.predecessor.tolist()):
            if ahead >= 0:
                place[row] += place[ahead]
        return place


def plan_formation(scenario: Scenario) -> Formation:
    """The scenario's formation as arrays, vehicles in `leader_first` order."""
    ordered = scenario.leader_first()
    row = {vehicle.system_id: k for k, vehicle in enumerate(ordered)}
    return Formation(
        system_ids=tuple(row),
        predecessor=np.array([-1 if v.follows is None else row[v.follows] for v in ordered], dtype=np.int64),
        offset_ne_m=np.array([v.offset_ne_m or (0.0, 0.0) for v in ordered]),
    )
