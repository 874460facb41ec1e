"""The control law u = K e of the whole formation, computed from states reported at different instants.

For the leader-follower pattern u_i = K1 e_i^v + K2 e_(i-1)^v + K3 e_i^p, and u_1 = K1 e_1^v for the leader (thesis eqs.
2.10 and 3.25); any other gain matrix K is flown by the same code.

All errors in u_i are formed at one instant, that of vehicle i's newest state; the states of the others are brought to
it. The loop around vehicle i is therefore delayed by vehicle i's own link only; a slow link ahead does not use up its
margin.
"""

from collections.abc import Sequence
from math import nan
from typing import NamedTuple

import numpy as np

from gains.core.arrays import FloatArray
from gcs.control.history import Report, Reports, State, States
from gcs.plan.formation import Formation

Gain = tuple[float, float, float, float, float, float, float, float]
"""A block G (2, 4), row by row: command (north, east) from position and velocity (north, east)."""


class Term(NamedTuple):
    """What one vehicle's state contributes to the command of another."""

    source: int
    """The vehicle k whose state is used."""
    offset_ne_m: tuple[float, float]
    """Its wanted position relative to the commanded vehicle."""
    gains: tuple[Gain, ...]
    """The block of each set of the gain schedule."""


class VehicleLaw(NamedTuple):
    """u_i = sum over its terms of G_ik (x_k - x*_k), x_k = (position, velocity), x*_k = (place in formation, v_d).

    Positions are relative to the vehicle's own, so its own term has velocity only.
    """

    terms: tuple[Term, ...]
    ahead: int
    """The vehicle that spacing is kept to, one of the terms; -1 if there is none."""


FeedbackLaw = tuple[VehicleLaw | None, ...]
"""The law of each vehicle; None if it is lost."""


def feedback_law(
    formation: Formation, gains: tuple[FloatArray, ...], lost: Sequence[bool], returning: Sequence[bool] | None = None
) -> FeedbackLaw:
    """The law for a schedule of gain matrices K, without the lost vehicles.

    Each K is (inputs, states) in the order of `gains.formation.model.FormationModel`.

    The nearest remaining vehicle ahead stands in for a lost one: spacing is kept to it, at the sum of both offsets, and
    its velocity error is used. Terms without a stand-in, and the spacing error of the lost vehicle, are omitted. A
    vehicle with nobody left ahead keeps the nominal velocity, as the leader does. One that is `returning` to its place
    flies its own law, while the others do without it, as if it were lost.
    """
    model = formation.model
    without = [one or other for one, other in zip(lost, returning or lost, strict=True)]
    K = np.stack(gains)
    in_front = [-1] * model.vehicles
    blocks: dict[tuple[int, int], FloatArray] = {}

    def block(i: int, k: int) -> FloatArray:
        return blocks.setdefault((i, k), np.zeros((len(gains), 2, 4)))

    of_most = _stand_ins(model.predecessors, without)
    for i in (row for row, away in enumerate(lost) if not away):
        gone, (stand_in, front) = without, of_most
        if without[i]:
            gone = [away and row != i for row, away in enumerate(without)]
            stand_in, front = _stand_ins(model.predecessors, gone)
        in_front[i] = front[i]
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
    place = formation.place_ne_m()

    def offset(i: int, k: int) -> tuple[float, float]:
        north, east = (place[k] - place[i]).tolist()
        return north, east

    def law(i: int) -> VehicleLaw:
        sources = sorted(k for to, k in blocks if to == i)
        terms = tuple(Term(k, offset(i, k), tuple(tuple(G.ravel().tolist()) for G in blocks[i, k])) for k in sources)
        return VehicleLaw(terms, in_front[i])

    return tuple(None if lost[i] else law(i) for i in range(len(in_front)))


def _stand_ins(predecessors: Sequence[int], gone: Sequence[bool]) -> tuple[list[int], list[int]]:
    """Which vehicle is flown with in place of each, and in place of the one in front of each; -1 for none."""
    stand_in: list[int] = []
    for row, ahead in enumerate(predecessors):
        stand_in.append(row if not gone[row] else stand_in[ahead] if ahead >= 0 else -1)
    return stand_in, [stand_in[ahead] if ahead >= 0 else -1 for ahead in predecessors]


class Blend(NamedTuple):
    """The gains of one vehicle: `share` of the set `flown`, and 1 - `share` of the set `former`."""

    flown: int = 0
    former: int = 0
    share: float = 1.0


class VehicleControl(NamedTuple):
    """State, errors and command of one vehicle, north and east; NaN where unknown or lost."""

    sample_ns: int
    """Instant of its newest state, station clock; 0 while there is none."""
    state: State
    spacing_error_m: tuple[float, float]
    velocity_error_m_s: tuple[float, float]
    command_m_s2: tuple[float, float]
    used_ns: int
    """Instant of the errors from which the command was computed: `sample_ns` with the loop on the ground."""
    assumed_s: float = 0.0
    """The loop delay over which the errors were predicted; 0 without prediction."""
    acts_ns: int = 0
    """When the command is assumed to act, to which instant the errors were predicted; 0 without prediction."""


_UNKNOWN = VehicleControl(0, (nan, nan, nan, nan), (nan, nan), (nan, nan), (nan, nan), 0)


def formation_control(
    history: Reports,
    law: FeedbackLaw,
    blends: Sequence[Blend],
    *,
    nominal_velocity_m_s: tuple[float, float],
    opening: float = 1.0,
) -> list[VehicleControl]:
    """Errors and commands of every vehicle from the newest reported states.

    `blends` holds the gains of each vehicle, `opening` is a factor on the formation's spacing. If a law needs an
    unknown state its command is NaN and must not be sent. No limit is applied here.
    """
    controls: list[VehicleControl] = []
    for row, (own, blend) in enumerate(zip(law, blends, strict=True)):
        newest = history.newest(row)
        if newest is None:
            controls.append(_UNKNOWN)
            continue
        sample_ns, state = newest
        spacing_error = command = nan, nan
        if own is not None:
            spacing_error, command = _followed(history, own, row, newest, blend, nominal_velocity_m_s, opening)
        velocity_error = state[2] - nominal_velocity_m_s[0], state[3] - nominal_velocity_m_s[1]
        controls.append(VehicleControl(sample_ns, state, spacing_error, velocity_error, command, sample_ns))
    return controls


def command_at(
    history: States,
    law: VehicleLaw,
    row: int,
    instant_ns: int,
    blend: Blend,
    nominal_velocity_m_s: tuple[float, float],
    opening: float,
) -> tuple[float, float]:
    """The command of one vehicle from the errors at a given instant."""
    state = history.at(row, instant_ns) or _UNKNOWN.state
    _, command = _followed(history, law, row, (instant_ns, state), blend, nominal_velocity_m_s, opening)
    return command


def _followed(
    history: States,
    law: VehicleLaw,
    row: int,
    newest: Report,
    blend: Blend,
    nominal_velocity_m_s: tuple[float, float],
    opening: float,
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Spacing error and command of one vehicle: the sum of G_ik (x_k - x*_k) at the instant of its given state."""
    sample_ns, own = newest
    north, east, _, _ = own
    nominal_north, nominal_east = nominal_velocity_m_s
    command_north = command_east = 0.0
    spacing_error = nan, nan
    flown, former, share = blend
    for source, (offset_north, offset_east), gains in law.terms:
        other = own if source == row else history.at(source, sample_ns) or _UNKNOWN.state
        # Positions are relative to the vehicle's own: sums of large numbers would lose digits.
        x, y = other[0] - north - opening * offset_north, other[1] - east - opening * offset_east
        v_north, v_east = other[2] - nominal_north, other[3] - nominal_east
        g = gains[flown] if share >= 1.0 else _blended(gains[flown], gains[former], share)
        command_north += g[0] * x + g[1] * y + g[2] * v_north + g[3] * v_east
        command_east += g[4] * x + g[5] * y + g[6] * v_north + g[7] * v_east
        if source == law.ahead:
            spacing_error = x, y
    return spacing_error, (command_north, command_east)


def _blended(new: Gain, old: Gain, share: float) -> Gain:
    a, b, c, d, e, f, g, h = (share * one + (1.0 - share) * other for one, other in zip(new, old, strict=True))
    return a, b, c, d, e, f, g, h


def distances_m(controls: Sequence[VehicleControl], now_ns: int, down_m: Sequence[float] | None = None) -> FloatArray:
    """Distances (n, n) between vehicles in m; NaN where unknown and on the diagonal.

    Positions are brought to `now_ns` along the reported velocities. `down_m` holds the vehicles' positions down if they
    fly at different altitudes; without it, distances are horizontal.
    """
    age_s = (now_ns - np.array([control.sample_ns for control in controls])) * 1e-9
    north, east, v_north, v_east = np.array([control.state for control in controls]).T
    north, east = north + v_north * age_s, east + v_east * age_s
    square, more = north[:, None] - north, east[:, None] - east
    square *= square  # in place: these are the largest arrays of a tick
    more *= more
    square += more
    distance = np.sqrt(square, out=square)
    if down_m is not None:
        below = np.array(down_m)
        distance = np.sqrt(distance * distance + np.square(below[:, None] - below))
    distance.flat[:: len(controls) + 1] = nan  # the diagonal
    return distance
