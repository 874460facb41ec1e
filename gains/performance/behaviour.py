"""Behaviour of a formation inside its delay margin: block by block, with and without delay, and down the chain.

For a leader-follower tree of any size, the roots are those of the leader's block and of one follower's block, and
errors pass from vehicle to vehicle through one transfer function.

Source: Sahoo 2012 (see `gains.formation.model`), eq. (2.11) with the gains (3.26).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import FloatArray
from gains.delay.constant import analyse_delay
from gains.delay.rightmost import rightmost_root
from gains.formation.model import FormationModel
from gains.performance.robust import subsystem_loop
from gains.performance.string_stability import Gains, string_peak


@dataclass(frozen=True)
class BlockMargin:
    """Continuous delay margin of one diagonal block of the loop and the frequency at which it is lost."""

    delay_margin_s: float
    crossing_rad_s: float


@dataclass(frozen=True)
class Behaviour:
    """Decay, damping and growth of errors of a loop inside its margin."""

    decay_rate_1_s: float
    damping: float
    """−Re s of the rightmost root of the whole formation, and the least damping ratio −Re s / |s|, without delay."""
    decay_rate_delayed_1_s: float
    damping_delayed: float
    """Decay rate, and damping ratio of the follower's rightmost root, at the delay `delay_s`."""
    string_peak: float
    string_peak_delayed: float
    """Largest growth of a spacing error from one vehicle to the next, over all frequencies, without delay and at
    `delay_s`; down a chain of n followers errors grow at most by its (n − 1)th power."""
    delay_s: float
    """The constant delay of the delayed figures; `gains.design.design` uses half the sampled margin plus half a period
    for the hold."""


def diagonal_blocks(gains: Gains) -> list[tuple[FloatArray, FloatArray]]:
    """(A0, A1) of e' = A0 e + A1 e(t − τ) for the leader, e_0^v, and for a follower, (e_i^p, e_i^v).

    K2 couples the two and appears in neither.
    """
    axes = len(gains[0])
    A0, A1 = FormationModel((-1, 0), axes).ground_loop(*gains)
    return [(A0[place, place], A1[place, place]) for place in (slice(axes), slice(axes, None))]


def block_margin(A0: ArrayLike, A1: ArrayLike) -> BlockMargin:
    """Return the margin of x'(t) = A0 x(t) + A1 x(t − τ) and the frequency of the crossing at its end.

    The frequency is NaN if there is no crossing. Arguments as for `gains.delay.constant.analyse_delay`.
    """
    analysis = analyse_delay(A0, A1, horizon_s=1e-300)
    first = min(analysis.crossings, key=lambda crossing: abs(crossing.delay_s - analysis.delay_margin_s), default=None)
    return BlockMargin(analysis.delay_margin_s, first.omega_rad_s if first else float("nan"))


def behaviour(
    gains: Gains, delay_s: float, *, own_delay_s: float | None = None, feed_forward: float = 0.0
) -> Behaviour:
    """Return the behaviour of a formation whose leader and followers have the gains K1, K2 and K3.

    For the delayed figures, all feedback is late by the constant `delay_s`, except that a vehicle's own errors are late
    by `own_delay_s` if that is given. Followers add the share `feed_forward` of the command in front.

    The leader's root is −1; the follower's loop s² + s + 1 has damping 1/2:

    >>> found = behaviour((np.array([[-1.0]]), np.array([[0.0]]), np.array([[1.0]])), delay_s=0.3)
    >>> round(found.decay_rate_1_s, 6), round(found.damping, 6)
    (0.5, 0.5)
    """
    roots = np.linalg.eigvals(subsystem_loop(*gains))
    own_s = delay_s if own_delay_s is None else own_delay_s
    late = [rightmost_root([(A0, 0.0), (A1, own_s)]) for A0, A1 in diagonal_blocks(gains)]
    return Behaviour(
        decay_rate_1_s=float(-roots.real.max()),
        damping=min(_damping(root) for root in roots.tolist()),
        decay_rate_delayed_1_s=float(-max(root.real for root in late)),
        damping_delayed=_damping(late[1]),
        string_peak=string_peak(gains, 0.0, feed_forward=feed_forward),
        string_peak_delayed=string_peak(gains, own_s, front_delay_s=delay_s, feed_forward=feed_forward),
        delay_s=delay_s,
    )


def _damping(root: complex) -> float:
    """Damping ratio −Re s / |s|; 0 for a root at zero."""
    return -root.real / abs(root) if root else 0.0
