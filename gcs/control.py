"""The control law u = K e of the whole formation, computed from states reported at different instants.

For the leader-follower pattern u_i = K1 e_i^v + K2 e_(i-1)^v + K3 e_i^p, and u_1 = K1 e_1^v for the leader (thesis eqs.
2.10 and 3.25); any other gain matrix K is flown by the same code.

All errors that enter u_i are formed at one instant: that of vehicle i's newest state, to which the states of the others
are brought. So the loop around vehicle i is late by vehicle i's own link only, and a slow link ahead of it cannot take
its margin.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gains.formation import FormationModel
from gcs.telemetry import FloatArray, IntArray, StateHistory

LARGEST_COMMAND_M_S2 = 1e4
"""Limit on what is sent when the scenario sets none; beyond it a command is a fault, not a manoeuvre."""


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


@dataclass(frozen=True)
class FeedbackLaw:
    """u = K e as a sum over pairs of vehicles: u_i = sum over k of G_ik (x_k - x*_k).

    x_k = (position, velocity) of vehicle k and x*_k = (place in the formation, v_d). Pairs are sorted by i, and every
    vehicle that flies has the pair (i, i) and, if somebody is ahead of it, the pair (i, one ahead).
    """

    to: IntArray
    """(pairs,) the commanded vehicle i."""
    source: IntArray
    """(pairs,) the vehicle k whose state is used."""
    gain: FloatArray
    """(sets, pairs, 2, 4) the blocks G_ik of each set of the gain schedule."""
    first: IntArray
    """(flying,) index of the first pair of each vehicle that flies."""
    follower: IntArray
    """(followers,) vehicles with one ahead."""
    own_pair: IntArray
    """(followers,) index of their pair (i, i)."""
    ahead_pair: IntArray
    """(followers,) index of their pair (i, one ahead)."""
    place_ne_m: FloatArray
    """(n, 2) wanted positions relative to the leader."""


def feedback_law(formation: Formation, gains: tuple[FloatArray, ...], lost: NDArray[np.bool_]) -> FeedbackLaw:
    """The law of a schedule of gain matrices K, flown around lost vehicles.

    Each K is (inputs, states) in the order of `gains.formation.FormationModel`.

    The nearest vehicle ahead that is left stands in for a lost one: spacing is kept to it, two spacings away, and its
    velocity error is used. What nobody ahead can stand in for, and the spacing error of a lost vehicle itself, drops
    out. A vehicle with nobody left ahead keeps the nominal velocity, as the leader does.
    """
    model = FormationModel(tuple(formation.predecessor.tolist()))
    stand_in: list[int] = []
    for row, ahead in enumerate(formation.predecessor.tolist()):
        stand_in.append(row if not lost[row] else stand_in[ahead] if ahead >= 0 else -1)
    K = np.stack(gains)
    in_front = [stand_in[ahead] if ahead >= 0 else -1 for ahead in formation.predecessor.tolist()]
    blocks: dict[tuple[int, int], FloatArray] = {}

    def block(i: int, k: int) -> FloatArray:
        return blocks.setdefault((i, k), np.zeros((len(gains), 2, 4)))

    for i in np.flatnonzero(~lost).tolist():
        block(i, i)
        if in_front[i] >= 0:
            block(i, in_front[i])
        rows = K[:, model.input_slice(i)]
        used = {(column + 2) // 4 for column in np.flatnonzero(rows.any(axis=(0, 1))).tolist()}
        for j in sorted(used):
            on_velocity = rows[:, :, model.velocity_slice(j)]
            if on_velocity.any() and stand_in[j] >= 0:
                block(i, stand_in[j])[:, :, 2:] += on_velocity
            on_spacing = rows[:, :, model.spacing_slice(j)] if j > 0 else on_velocity[:, :, :0]
            if on_spacing.any() and not lost[j] and in_front[j] >= 0:
                # e_j^p = Z_ahead - Z_j - d
                block(i, in_front[j])[:, :, :2] += on_spacing
                block(i, j)[:, :, :2] -= on_spacing
    return _law(blocks, [k if not gone else -1 for k, gone in zip(in_front, lost, strict=True)], formation.place_ne_m())


def _law(blocks: dict[tuple[int, int], FloatArray], in_front: list[int], place_ne_m: FloatArray) -> FeedbackLaw:
    pairs = sorted(blocks)
    index = {pair: k for k, pair in enumerate(pairs)}
    to = np.array([i for i, _ in pairs], dtype=np.int64)
    followers = [i for i, ahead in enumerate(in_front) if ahead >= 0]
    return FeedbackLaw(
        to=to,
        source=np.array([k for _, k in pairs], dtype=np.int64),
        gain=np.stack([blocks[pair] for pair in pairs], axis=1) if pairs else np.zeros((1, 0, 2, 4)),
        first=np.flatnonzero(np.diff(to, prepend=-1)),
        follower=np.array(followers, dtype=np.int64),
        own_pair=np.array([index[i, i] for i in followers], dtype=np.int64),
        ahead_pair=np.array([index[i, in_front[i]] for i in followers], dtype=np.int64),
        place_ne_m=place_ne_m,
    )


@dataclass(frozen=True)
class FormationControl:
    """What the law saw and wants: rows of vehicles, columns north and east; NaN where unknown or lost."""

    sample_ns: IntArray
    position_m: FloatArray
    velocity_m_s: FloatArray
    spacing_error_m: FloatArray
    velocity_error_m_s: FloatArray
    command_m_s2: FloatArray


def blended_gain(law: FeedbackLaw, flown: IntArray, former: IntArray, share: FloatArray) -> FloatArray:
    """The blocks (pairs, 2, 4) with which each vehicle is flown now.

    `flown` and `former` (n,) are sets of the schedule, `share` (n,) is how much of the set flown is blended in, 0 to 1.
    """
    pair = np.arange(len(law.to))
    mix = share[law.to][:, None, None]
    return mix * law.gain[flown[law.to], pair] + (1.0 - mix) * law.gain[former[law.to], pair]


def formation_control(
    history: StateHistory,
    law: FeedbackLaw,
    gain: FloatArray,
    *,
    nominal_velocity_m_s: tuple[float, float],
    limit_m_s2: float,
    opening: float = 1.0,
) -> FormationControl:
    """Errors and commands of every vehicle from the newest reported states.

    `gain` (pairs, 2, 4) are the law's blocks as flown now. `opening` is a factor on the formation's spacing.
    A vehicle whose law uses an unknown state has a NaN command; nothing is to be sent for it. A command longer than
    `limit_m_s2` is shortened to it.
    """
    sample_ns, position, velocity = history.newest()
    # (pairs, 4): what each vehicle sees of the others at its own instant, against where they should be
    seen = history.at(law.source, sample_ns[law.to])
    place = opening * law.place_ne_m
    seen[:, :2] -= place[law.source]
    seen[:, 2:] -= nominal_velocity_m_s
    spacing_error = np.full_like(position, np.nan)
    spacing_error[law.follower] = seen[law.ahead_pair, :2] - seen[law.own_pair, :2]
    command = np.full_like(position, np.nan)
    if law.to.size:
        # Positions are taken against the vehicle's own: sums of large numbers would lose digits.
        seen[:, :2] -= (position - place)[law.to]
        command[law.to[law.first]] = np.add.reduceat((gain @ seen[:, :, None])[:, :, 0], law.first)
    size = np.hypot(command[:, 0], command[:, 1])
    command *= (limit_m_s2 / np.maximum(size, limit_m_s2))[:, None]
    return FormationControl(sample_ns, position, velocity, spacing_error, velocity - nominal_velocity_m_s, command)


def nearest_vehicle(control: FormationControl, now_ns: int) -> tuple[FloatArray, IntArray]:
    """Distance (n,) in m of each vehicle to the one nearest to it, and that one's row; NaN where unknown.

    Positions are brought to `now_ns` along the reported velocities.
    """
    age_s = (now_ns - control.sample_ns).astype(np.float64)[:, None] * 1e-9
    position = control.position_m + control.velocity_m_s * age_s
    north, east = position[:, 0], position[:, 1]
    square = (north[:, None] - north) ** 2 + (east[:, None] - east) ** 2
    np.fill_diagonal(square, np.inf)
    square[np.isnan(square)] = np.inf
    other = square.argmin(axis=1)
    nearest = np.sqrt(square[np.arange(len(other)), other])
    return np.where(np.isfinite(nearest), nearest, np.nan), other
