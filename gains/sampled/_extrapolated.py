"""Vehicles that share a loop over different links: the station extrapolates states that arrive over slower links.

A command of vehicle i acts tau_i after its state was sampled. The other vehicles' states that it uses are brought to
the instant of that sample. If one is older by delta_ij = max(0, a_j − a_i), where a is the age of a vehicle's newest
state at the station, it is extrapolated at constant velocity; a newer one is interpolated between reports. Hence

    u_i(t) = sum_j G_ij (p_j + delta_ij v_j, v_j)(t − tau_i − delta_ij)

in positions p and velocities v of the vehicles. The ages are those estimated by the station. An error in its estimate
of vehicle j's clock shifts j in time for the commands of all others, and back for j's own, which moves no root.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gains.core.arrays import FloatArray, IntArray
from gains.delay.rightmost import rightmost_roots
from gains.formation.model import FormationModel

_AT_ZERO = 1e-6
"""A root (1/s) this close to zero belongs to the formation's position, which is uncontrolled."""


@dataclass(frozen=True, eq=False)
class ExtrapolatedLoop:
    """x' = A x + B u, u = G x, where x holds the positions of a block's vehicles, then their other states.

    `positions` and `velocities` are the indices of each vehicle's entries in x, (vehicles, axes), `inputs` those in u.
    """

    A: FloatArray
    B: FloatArray
    G: FloatArray
    positions: IntArray
    velocities: IntArray
    inputs: IntArray

    def growth_1_s(self, delays_s: Sequence[float], ages_s: Sequence[float]) -> float:
        """Real part (1/s) of the rightmost root for the vehicles' delays tau and ages a (s)."""
        roots = rightmost_roots(self.terms(delays_s, ages_s), 1 + self.inputs.shape[1])
        return float(max(root.real for root in roots if abs(root) > _AT_ZERO))

    def terms(self, delays_s: Sequence[float], ages_s: Sequence[float]) -> list[tuple[FloatArray, float]]:
        """Pairs (A, d) of x'(t) = sum A x(t - d) for the vehicles' delays tau and ages a (s)."""
        vehicles = len(self.inputs)
        terms: list[tuple[FloatArray, float]] = [(self.A, 0.0)]
        for i in range(vehicles):
            entry = self.B[:, self.inputs[i]]
            for j in range(vehicles):
                from_position, from_velocity = (
                    entry @ self.G[np.ix_(self.inputs[i], places[j])] for places in (self.positions, self.velocities)
                )
                older_s = max(0.0, ages_s[j] - ages_s[i])
                term = np.zeros_like(self.A)
                term[:, self.positions[j]] = from_position
                term[:, self.velocities[j]] = from_velocity + older_s * from_position
                if term.any():
                    terms.append((term, delays_s[i] + older_s))
        return terms


def extrapolated_loop(
    model: FormationModel, members: Sequence[int], A: FloatArray, B: FloatArray, K: FloatArray
) -> ExtrapolatedLoop:
    """The loop e' = A e + B u, u = K e shared by members of a formation, with positions in place of spacing errors.

    e holds the errors of each member in turn, then the states of their responses.
    """
    step, at = np.arange(model.axes), 0
    spacing, velocities = dict[int, IntArray](), list[IntArray]()
    for i in members:
        if i > 0:  # the leader has no spacing error
            spacing[i] = at + step
            at += model.axes
        velocities.append(at + step)
        at += model.axes
    # x: the positions of all members, then the states of e that are not spacing errors
    others = np.setdiff1d(np.arange(len(A)), np.concatenate([*spacing.values()]))
    positions = np.arange(len(members) * model.axes).reshape(len(members), model.axes)
    place = np.zeros(len(A), int)
    place[others] = positions.size + np.arange(others.size)
    n = positions.size + others.size
    error_of = np.zeros((len(A), n))
    error_of[others, place[others]] = 1.0
    for i, rows in spacing.items():
        error_of[rows, positions[members.index(i)]] = -1.0
        if model.predecessors[i] in members:
            error_of[rows, positions[members.index(model.predecessors[i])]] = 1.0
    own_velocities = place[np.array(velocities)]
    moved, entry = np.zeros((n, n)), np.zeros((n, B.shape[1]))
    moved[np.ix_(place[others], place[others])] = A[np.ix_(others, others)]
    moved[positions, own_velocities] = 1.0
    entry[place[others]] = B[others]
    inputs = np.arange(B.shape[1]).reshape(positions.shape)
    return ExtrapolatedLoop(moved, entry, K @ error_of, positions, own_velocities, inputs)
