"""The decentralised overlapping control law, for the whole formation at once.

u_i = K1 e_i^v + K2 e_(i-1)^v + K3 e_i^p, and u_1 = K1 e_1^v for the leader (thesis eqs. 2.10 and 3.25).

Each e_i is formed at one instant: that of vehicle i's newest state. The state of the vehicle in front is brought to it.
So the loop around vehicle i is late by vehicle i's own link only, and a slow link ahead of it cannot take its margin.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcs.telemetry import FloatArray, IntArray, StateHistory

LARGEST_COMMAND_M_S2 = 1e4
"""Limit on what is sent when the scenario sets none; beyond it a command is a fault, not a manoeuvre."""


@dataclass(frozen=True)
class Gains:
    """K1 (own velocity error), K2 (velocity error of the vehicle in front), K3 (spacing error), each (2, 2)."""

    K1: FloatArray
    K2: FloatArray
    K3: FloatArray


@dataclass(frozen=True)
class Formation:
    """Who follows whom, in an order in which every vehicle comes after the one it follows.

    `predecessor` (n,) holds rows, -1 for one that follows nobody; `offset_ne_m` (n, 2) is the wanted position relative
    to the predecessor, zero where there is none.
    """

    system_ids: tuple[int, ...]
    predecessor: IntArray
    offset_ne_m: FloatArray


@dataclass(frozen=True)
class FormationControl:
    """What the control law saw and wants: rows of vehicles, columns north and east."""

    sample_ns: IntArray
    position_m: FloatArray
    velocity_m_s: FloatArray
    spacing_error_m: FloatArray
    velocity_error_m_s: FloatArray
    command_m_s2: FloatArray


def without(formation: Formation, lost: NDArray[np.bool_]) -> Formation:
    """The formation flown around lost vehicles: followers take the nearest vehicle ahead that is left.

    Offsets add up, so everybody keeps its place. A follower with nobody left ahead keeps the nominal velocity, as a
    leader does.
    """
    predecessor, offset = formation.predecessor.copy(), formation.offset_ne_m.copy()
    for row in range(len(predecessor)):  # predecessors first, so theirs are already flown around
        ahead = predecessor[row]
        if ahead >= 0 and lost[ahead]:
            offset[row] += offset[ahead]
            predecessor[row] = predecessor[ahead]
            if predecessor[row] < 0:
                offset[row] = 0.0
    return Formation(formation.system_ids, predecessor, offset)


def overlapping_control(
    history: StateHistory,
    formation: Formation,
    gains: Gains,
    *,
    nominal_velocity_m_s: tuple[float, float],
    limit_m_s2: float,
) -> FormationControl:
    """Errors and commands of every vehicle from the newest reported states.

    A row whose own or predecessor's state is unknown has NaN errors and a NaN command; nothing is to be sent for it.
    A command longer than `limit_m_s2` is shortened to it.
    """
    sample_ns, position, velocity = history.newest()
    velocity_error = velocity - nominal_velocity_m_s
    follower = np.flatnonzero(formation.predecessor >= 0)
    ahead = formation.predecessor[follower]
    ahead_position, ahead_velocity = history.at(ahead, sample_ns[follower])
    spacing_error = np.full_like(position, np.nan)
    # e^p = Z_(i-1) - Z_i - d with d = -offset
    spacing_error[follower] = ahead_position - position[follower] + formation.offset_ne_m[follower]
    command = velocity_error @ gains.K1.T
    command[follower] += (ahead_velocity - nominal_velocity_m_s) @ gains.K2.T
    command[follower] += spacing_error[follower] @ gains.K3.T
    size = np.hypot(command[:, 0], command[:, 1])
    command *= np.where(size > limit_m_s2, limit_m_s2 / np.maximum(size, limit_m_s2), 1.0)[:, None]
    return FormationControl(sample_ns, position, velocity, spacing_error, velocity_error, command)
