"""The control law u = K e of the whole formation, computed from states reported at different instants.

In the leader-follower pattern u_i = K1 e_i^v + K2 e_(i-1)^v + K3 e_i^p, and u_1 = K1 e_1^v for the leader (thesis eqs.
2.10 and 3.25); the same code flies any other gain matrix K.

All errors in u_i are formed at one instant, that of vehicle i's newest state; the states of the others are interpolated
or extrapolated to it. So only vehicle i's own link delays the loop around it: a slow link of a vehicle ahead does not
use up its margin.
"""

from collections.abc import Sequence
from math import inf, nan, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray
from gcs.control.history import Instants, Reports, States
from gcs.plan.formation import Formation
from scenarios.kernel import Array, Records, array_kernel

Vector = tuple[float, float]
LOST = -2
"""Stands for the vehicle ahead in the row of a lost vehicle."""


class FeedbackLaw(NamedTuple):
    """u_i = sum over its terms of G_ik (x_k - x*_k), x_k = (position, velocity), x*_k = (place in formation, v_d).

    Positions are relative to vehicle i, so its own term contains velocity only. The laws of n vehicles have m terms in
    all, in vehicle order; a lost vehicle has none. All fields are arrays, for kernels.
    """

    begin: NDArray[np.int64]
    """Index of each vehicle's first term, followed by m, (n + 1,)."""
    to: NDArray[np.int64]
    """The vehicle i that each term commands, (m,)."""
    source: NDArray[np.int64]
    """The vehicle k whose state it uses, (m,)."""
    offset_ne_m: FloatArray
    """The desired position of k relative to i, (m, 2)."""
    gains: FloatArray
    """The block G_ik (2, 4) of each set of the gain schedule, in row-major order: command (north, east) from position
    and velocity (north, east), (m, sets, 8)."""
    ahead: NDArray[np.int64]
    """The vehicle to which spacing is kept, one of the sources; -1 if there is none, LOST for a lost vehicle, (n,)."""

    @property
    def flown(self) -> NDArray[np.bool_]:
        """Which vehicles are not lost, (n,)."""
        return self.ahead != LOST

    @property
    def needed(self) -> NDArray[np.bool_]:
        """Which terms have a nonzero gain: a command depends on the states of these only, (m,)."""
        return np.logical_or.reduce(self.gains, axis=(1, 2))


def feedback_law(
    formation: Formation, gains: tuple[FloatArray, ...], lost: Sequence[bool], returning: Sequence[bool] | None = None
) -> FeedbackLaw:
    """The law for a schedule of gain matrices K, without the lost vehicles.

    Each K is (inputs, states) in the order of `gains.formation.model.FormationModel`.

    The nearest remaining vehicle ahead replaces a lost one: spacing is kept to it, at the sum of both offsets, and its
    velocity error is used. Terms without a replacement, and the spacing error of the lost vehicle, are omitted. A
    vehicle with nobody left ahead keeps the nominal velocity, as the leader does. A vehicle `returning` to its place
    flies its own law, while the others treat it as lost.
    """
    model = formation.model
    without = [one or other for one, other in zip(lost, returning or lost, strict=True)]
    K = np.stack(gains)
    ahead = np.full(model.vehicles, LOST)
    blocks: dict[tuple[int, int], FloatArray] = {}

    def block(i: int, k: int) -> FloatArray:
        return blocks.setdefault((i, k), np.zeros((len(gains), 2, 4)))

    of_most = _stand_ins(model.predecessors, without)
    for i in (row for row, away in enumerate(lost) if not away):
        gone, (stand_in, front) = without, of_most
        if without[i]:
            gone = [away and row != i for row, away in enumerate(without)]
            stand_in, front = _stand_ins(model.predecessors, gone)
        ahead[i] = front[i]
        block(i, i)
        if front[i] >= 0:
            block(i, front[i])
        rows = K[:, model.input_slice(i)]
        used = {(column + 2) // 4 for column in np.flatnonzero(rows.any(axis=(0, 1))).tolist()}
        for j in sorted(used):
            on_velocity = rows[:, :, model.velocity_slice(j)]
            if on_velocity.any() and stand_in[j] >= 0:
                block(i, stand_in[j])[:, :, 2:] += on_velocity
            on_spacing = rows[:, :, model.spacing_slice(j)] if j > 0 else on_velocity[:, :, :0]
            if on_spacing.any() and not gone[j] and front[j] >= 0:
                # e_j^p = Z_ahead - Z_j - d
                block(i, front[j])[:, :, :2] += on_spacing
                block(i, j)[:, :, :2] -= on_spacing
    place, keys = formation.place_ne_m(), sorted(blocks)
    to, source = np.array(keys, np.int64).reshape(-1, 2).T.copy()
    by_term = np.array([blocks[key] for key in keys]).reshape(-1, len(gains), 8)
    begin = np.searchsorted(to, np.arange(model.vehicles + 1))
    return FeedbackLaw(begin, to, source, place[source] - place[to], by_term, ahead)


def _stand_ins(predecessors: Sequence[int], gone: Sequence[bool]) -> tuple[list[int], list[int]]:
    """The replacement of each vehicle (itself if not gone) and of the one in front of each; -1 for none."""
    stand_in: list[int] = []
    for row, ahead in enumerate(predecessors):
        stand_in.append(row if not gone[row] else stand_in[ahead] if ahead >= 0 else -1)
    return stand_in, [stand_in[ahead] if ahead >= 0 else -1 for ahead in predecessors]


BLEND = np.dtype([("flown", "i8"), ("former", "i8"), ("share", "f8")])
"""The gains of one vehicle: `share` of the set `flown`, and 1 - `share` of the set `former`."""
CONTROL = np.dtype(
    [
        ("sample_ns", "i8"),  # instant of its newest state, station clock; 0 while there is none
        ("state", "f8", (4,)),  # see `gcs.control.history.State`
        ("spacing_error_m", "f8", (2,)),
        ("velocity_error_m_s", "f8", (2,)),
        ("command_m_s2", "f8", (2,)),
        ("used_ns", "i8"),  # instant of the errors behind the command; with the loop on the ground `sample_ns`
        ("assumed_s", "f8"),  # the loop delay over which the errors were predicted; 0 without prediction
        ("acts_ns", "i8"),  # when the command is assumed to act: the errors are predicted to then; 0 without prediction
    ]
)
"""State, errors and command of one vehicle, north and east; NaN where unknown or lost."""


def unblended(vehicles: int) -> Records:
    """An array of BLEND in which every vehicle flies the first set of gains."""
    blends = np.zeros(vehicles, BLEND)
    blends["share"] = 1.0
    return blends


class TickInputs(NamedTuple):
    """Inputs of a control tick that are common to all vehicles."""

    due_ns: int
    time_s: float
    """Scenario time."""
    nominal_velocity_m_s: Vector
    opening: float = 1.0
    """Factor on the formation's spacing."""


def formation_control(history: Reports, law: FeedbackLaw, blends: Records, now: TickInputs) -> Records:
    """Errors and commands of every vehicle (n, CONTROL) from the newest reported states.

    `blends` holds the gains of each vehicle. A command that depends on an unknown state is NaN and must not be sent. No
    limit is applied here.
    """
    times_ns, states = history.every_newest()
    seen = history.every_at(law.source, times_ns.take(law.to))
    return _controls(law, times_ns, states, seen, blends, now)


def commands_at(states: States, law: FeedbackLaw, times_ns: Instants, blends: Records, now: TickInputs) -> FloatArray:
    """The command (n, 2) of each vehicle, from the errors at its own instant."""
    own = states.every_at(np.arange(len(times_ns)), times_ns)
    seen, others = own[law.to], (law.source != law.to).nonzero()[0]
    seen[others] = states.every_at(law.source[others], times_ns[law.to[others]])
    return commands_of(law, own, seen, blends, now)


def commands_of(law: FeedbackLaw, own: FloatArray, seen: FloatArray, blends: Records, now: TickInputs) -> FloatArray:
    """The command (n, 2) of each vehicle, from its own state (n, 4) and the states that the law's terms use (m, 4)."""
    return _controls(law, np.ones(len(own), np.int64), own, seen, blends, now)["command_m_s2"]


def _controls(
    law: FeedbackLaw, times_ns: Instants, own: FloatArray, seen: FloatArray, blends: Records, now: TickInputs
) -> Records:
    controls = np.empty(len(own), CONTROL)
    control_all(controls, law, times_ns, own, seen, blends, *now.nominal_velocity_m_s, now.opening)
    return controls


@array_kernel
def control_all(
    controls: Records, law: FeedbackLaw, times_ns: Array, states: Array, seen: Array, blends: Records,
    nominal_north: float, nominal_east: float, opening: float,
) -> None:  # fmt: skip
    """Fill in `controls`: the command of each vehicle is the sum of G_ik (x_k - x*_k) over its terms."""
    g = np.empty(8)
    for row in range(len(controls)):
        control, state, flown = controls[row], states[row], law.ahead[row] != LOST
        control.sample_ns = control.used_ns = times_ns[row]
        control.assumed_s, control.acts_ns = 0.0, 0
        for k in range(4):
            control.state[k] = state[k]
        control.velocity_error_m_s[0], control.velocity_error_m_s[1] = state[2] - nominal_north, state[3] - nominal_east
        control.spacing_error_m[0] = control.spacing_error_m[1] = nan
        command_north = command_east = 0.0 if flown else nan
        share, first, former = blends[row].share, blends[row].flown, blends[row].former
        for term in range(law.begin[row], law.begin[row + 1]):
            source = law.source[term]
            other = state if source == row else seen[term]
            # Positions are relative to the vehicle's own: sums of large numbers would lose precision.
            x = other[0] - state[0] - opening * law.offset_ne_m[term, 0]
            y = other[1] - state[1] - opening * law.offset_ne_m[term, 1]
            v_north, v_east = other[2] - nominal_north, other[3] - nominal_east
            for k in range(8):
                g[k] = law.gains[term, first, k]
                if share < 1.0:
                    g[k] = share * g[k] + (1.0 - share) * law.gains[term, former, k]
            command_north += g[0] * x + g[1] * y + g[2] * v_north + g[3] * v_east
            command_east += g[4] * x + g[5] * y + g[6] * v_north + g[7] * v_east
            if source == law.ahead[row]:
                control.spacing_error_m[0], control.spacing_error_m[1] = x, y
        control.command_m_s2[0], control.command_m_s2[1] = command_north, command_east


class Nearest(NamedTuple):
    """Distances to nearest neighbours."""

    distance_m: FloatArray
    """From each vehicle to its nearest neighbour, (n,); NaN while unknown."""
    two: tuple[int, int]
    """The closest pair."""


_ROUNDED_UP = 1.0 + 1e-9
"""Allowance for rounding when two squared distances are compared."""


@array_kernel
def nearest(controls: Records, now_ns: int, down_m: Array) -> Nearest:
    """Distances to nearest neighbours, with positions extrapolated to `now_ns` along the reported velocities.

    `down_m` holds the vehicles' down positions if they fly at different altitudes; if it is empty, distances are
    horizontal.
    """
    n = len(controls)
    north, east, near = np.empty(n), np.empty(n), np.full(n, inf)
    for row in range(n):
        state, age_s = controls[row].state, (now_ns - controls[row].sample_ns) * 1e-9
        north[row], east[row] = state[0] + state[2] * age_s, state[1] + state[3] * age_s
    least, one, two = inf, 0, 0
    along = north if np.ptp(north) > np.ptp(east) else east  # the sort axis: along it, distant vehicles are skipped
    order = np.argsort(along, kind="mergesort")  # compiles in half the time of the default
    for place in range(n):
        row = order[place]
        for way in (-1, 1):
            k = place + way
            while 0 <= k < n:
                other = order[k]
                apart = along[row] - along[other]
                if apart * apart > near[row] * _ROUNDED_UP:
                    break
                x, y = north[row] - north[other], east[row] - east[other]
                square = x * x + y * y
                if len(down_m):
                    level, below = sqrt(square), down_m[row] - down_m[other]
                    square = level * level + below * below
                near[row] = min(near[row], square)
                pair = min(row, other), max(row, other)
                if square < least or (square == least and pair < (one, two)):
                    least, (one, two) = square, pair
                k += way
    for row in range(n):
        near[row] = sqrt(near[row]) if near[row] < inf else nan
    return Nearest(near, (one, two))
