"""An example of a user's control law: the leader-follower law of the thesis, with smoothly saturated commands."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcs import LawFormation

Floats = NDArray[np.float64]
K1_1_S, K2_1_S, K3_1_S2 = -7.0, 1.0, 9.0
MOST_M_S2 = 20.0


def law(t_s: float, states: Floats, formation: LawFormation, memory: dict[str, Any]) -> Floats:
    """The linear law, with each component kept within MOST_M_S2; `memory` counts how often a command saturated."""
    wanted = linear(t_s, states, formation, memory)
    memory["saturated"] = memory.get("saturated", 0) + int((np.abs(wanted) > MOST_M_S2).any())
    return MOST_M_S2 * np.tanh(wanted / MOST_M_S2)


def linear(t_s: float, states: Floats, formation: LawFormation, memory: dict[str, Any]) -> Floats:  # noqa: ARG001
    """u_i = K1 e_i^v + K2 e_(i-1)^v + K3 e_i^p, the leader u_1 = K1 e_1^v."""
    velocity, spacing = formation.velocity_error_m_s(states), formation.spacing_error_m(states)
    in_front = velocity[list(formation.predecessors[1:])]
    command = K1_1_S * velocity + K3_1_S2 * spacing
    command[1:] += K2_1_S * in_front
    return command


def matrices(formation: LawFormation) -> Floats:
    """K of the law u = K e that `linear` computes."""
    own, front, spacing = (gain * np.eye(2) for gain in (K1_1_S, K2_1_S, K3_1_S2))
    return formation.model.overlapping_gain(own, front, spacing)
