"""String stability: how much a spacing error grows from one vehicle to the next, at the worst frequency.

Each follower repeats the motion of the vehicle in front through one transfer function Γ(s). A loop that is stable for
each vehicle may still amplify errors down the chain unless |Γ(jω)| ≤ 1 at every frequency.
"""

from collections.abc import Callable
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gains.core._bracketing import highest
from gains.core.arrays import ComplexArray, FloatArray, spectral_norms
from gains.core.errors import BadModelError
from gains.formation.model import FormationModel

Gains = tuple[FloatArray, FloatArray, FloatArray]
"""K1, K2 and K3, each of shape (axes, axes)."""
Transfer = Callable[[FloatArray], ComplexArray]
"""Maps frequencies (k,) in rad/s to the values (k,) of a transfer function."""

# Grid of a sweep for a peak: frequencies per decade, and decades below and above a given frequency.
_POINTS_PER_DECADE, _DECADES_BELOW, _DECADES_ABOVE = 300, 4, 2


def string_peak(
    gains: Gains,
    delay_s: float,
    *,
    front_delay_s: float | None = None,
    answer: Transfer = np.ones_like,
    feed_forward: float = 0.0,
) -> float:
    """Return the largest singular value of Γ(jω) over ω, at least |Γ(0)| = 1.

    Γ takes the velocity error of the vehicle in front to the follower's own and, for gains that act on every axis
    alike, also the spacing error in front to the follower's own. If a vehicle's own errors are delayed by a, and the
    velocity error of the vehicle in front by b::

        Γ(s) = (s² I − (s K1 − K3) h e^{−sa})^{-1} ((s K2 e^{−sb} + K3 e^{−sa}) h + s² k_ff I)

    a is `delay_s` and b is `front_delay_s`, by default the same, as when a ground station closes every loop. h(jω) is
    `answer`, from commanded to real acceleration; k_ff is `feed_forward`, the added share of the command in front.

    |1 / (s² + s + 1)| peaks at 2 / √3:

    >>> round(string_peak((np.array([[-1.0]]), np.array([[0.0]]), np.array([[1.0]])), 0.0), 4)
    1.1547
    """
    identity = np.eye(gains[0].shape[0])
    own, front, spacing = gains
    if all(np.array_equal(gain, gain[0, 0] * identity) for gain in gains):  # one axis stands for all
        own, front, spacing, identity = own[:1, :1], front[:1, :1], spacing[:1, :1], identity[:1, :1]
    behind_s = delay_s if front_delay_s is None else front_delay_s

    def growth(omega: FloatArray) -> NDArray[Any]:
        s, h = 1j * omega, answer(omega)
        at_once, late = ((h * np.exp(-s * delay))[:, None, None] for delay in (delay_s, behind_s))
        s = s[:, None, None]
        loop, entry = s**2 * identity - (s * own - spacing) * at_once, s * front * late + spacing * at_once
        if feed_forward:
            entry = entry + s**2 * feed_forward * identity
        if len(identity) == 1:
            return (entry / loop)[:, 0, 0]
        return spectral_norms(np.linalg.solve(loop, entry))

    near = float(np.linalg.norm(own, 2) + np.sqrt(np.linalg.norm(spacing, 2)))
    return max(1.0, largest_magnitude(growth, near_rad_s=near or 1.0))


def formation_string_peak(formation: FormationModel, K: FloatArray) -> float | None:
    """Return the largest |E_i / E_j| over frequencies, for a follower i of a follower j, if the leader is disturbed.

    E are spacing errors without delay, on the first axis. K (inputs, states) may have any pattern; with that of a
    leader-follower tree the result is `string_peak` where that exceeds 1. None if no follower follows another.

    >>> chain = FormationModel((-1, 0, 1), axes=1)
    >>> K = chain.overlapping_gain([[-1.0]], [[0.0]], [[1.0]])
    >>> round(formation_string_peak(chain, K), 4)
    1.1547
    """
    single, narrow = formation.narrowed(K)
    pairs = [(i, single.predecessors[i]) for i in single.followers if single.predecessors[i] > 0]
    if not pairs:
        return None
    closed_loop = single.A + single.B @ narrow
    behind, ahead = ([single.spacing_slice(pair[k]).start for pair in pairs] for k in (0, 1))

    def growth(omega: FloatArray) -> FloatArray:
        shifted = 1j * omega[:, None, None] * np.eye(single.states) - closed_loop
        error = np.abs(np.linalg.solve(shifted, single.B[:, :1])[..., 0])
        return (error[:, behind] / error[:, ahead]).max(axis=1)

    return largest_magnitude(growth, near_rad_s=float(np.abs(np.linalg.eigvals(closed_loop)).max()))


def largest_magnitude(response: Callable[[FloatArray], NDArray[Any]], *, near_rad_s: float) -> float:
    """Return the largest magnitude of a frequency response, from a sweep whose maxima are refined.

    `response` maps frequencies (k,) to values (k,). The sweep goes from four decades below `near_rad_s`, a frequency
    near which the response changes, to two above. BadModelError if `near_rad_s` is not a positive finite number.

    >>> round(largest_magnitude(lambda omega: omega / (1 - omega**2 + 1j * omega), near_rad_s=3.0), 9)  # at 1 rad/s
    1.0
    """
    if not (isfinite(near_rad_s) and near_rad_s > 0.0):
        raise BadModelError(f"near_rad_s is {near_rad_s}; a positive frequency is wanted")
    decades = _DECADES_BELOW + _DECADES_ABOVE
    omega = near_rad_s * np.logspace(-_DECADES_BELOW, _DECADES_ABOVE, decades * _POINTS_PER_DECADE)
    return highest(lambda at: np.abs(response(at)), omega)[1]
