"""How a formation behaves inside its delay margin: block by block, with and without delay, and down the chain.

A leader-follower tree is block triangular: whatever its size, its roots are those of the leader's block and of one
follower's block, and errors pass from vehicle to vehicle by one transfer function.

Source: Sahoo 2012 (see `gains.formation`), eq. (2.11) with the gains (3.26).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gains.delay import analyse_delay
from gains.rightmost import rightmost_root
from gains.robust import subsystem_loop

FloatArray = NDArray[np.float64]
Gains = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class BlockMargin:
    """Continuous delay margin of one diagonal block of the loop and the frequency at which it is lost."""

    delay_margin_s: float
    crossing_rad_s: float


@dataclass(frozen=True)
class Behaviour:
    """How the loop behaves inside its margin: what α and the margin do not say.

    Attributes
    ----------
    decay_rate_1_s, damping
        −Re of the rightmost root of the whole formation, and the least damping ratio −Re s / |s|, without delay.
    decay_rate_delayed_1_s, damping_delayed
        Decay rate, and damping ratio of the follower's rightmost root, at the delay `delay_s`.
    string_peak, string_peak_delayed
        Largest growth of a spacing error from one vehicle to the next, over all frequencies, without delay and at
        `delay_s`; down a chain of n followers errors grow by its (n − 1)th power at most.
    delay_s
        The constant delay of the figures with delay: half the sampled margin, plus half a period for the hold.
    """

    decay_rate_1_s: float
    damping: float
    decay_rate_delayed_1_s: float
    damping_delayed: float
    string_peak: float
    string_peak_delayed: float
    delay_s: float


def leader_block(gains: Gains) -> tuple[FloatArray, FloatArray]:
    return np.zeros_like(gains[0]), gains[0]


def follower_block(gains: Gains) -> tuple[FloatArray, FloatArray]:
    """(A0, A1) of (e_i^p, e_i^v): e_i^p' = −e_i^v, e_i^v' = K3 e_i^p + K1 e_i^v, the latter late."""
    own, _, spacing = gains
    zero, identity = np.zeros_like(own), np.eye(own.shape[0])
    return np.block([[zero, -identity], [zero, zero]]), np.block([[zero, zero], [spacing, own]])


def block_margin(A0: FloatArray, A1: FloatArray) -> BlockMargin:
    analysis = analyse_delay(A0, A1, horizon_s=1e-300)
    first = min(analysis.crossings, key=lambda crossing: abs(crossing.delay_s - analysis.delay_margin_s), default=None)
    return BlockMargin(analysis.delay_margin_s, first.omega_rad_s if first else float("nan"))


def behaviour(gains: Gains, delay_s: float) -> Behaviour:
    roots = np.linalg.eigvals(subsystem_loop(*gains))
    late = [rightmost_root([(A0, 0.0), (A1, delay_s)]) for A0, A1 in (leader_block(gains), follower_block(gains))]
    return Behaviour(
        decay_rate_1_s=float(-roots.real.max()),
        damping=float((-roots.real / np.abs(roots)).min()),
        decay_rate_delayed_1_s=float(-max(root.real for root in late)),
        damping_delayed=float(-late[1].real / abs(late[1])),
        string_peak=string_peak(gains, 0.0),
        string_peak_delayed=string_peak(gains, delay_s),
        delay_s=delay_s,
    )


def string_peak(gains: Gains, delay_s: float) -> float:
    """Return the largest singular value of Γ(jω) over ω, at least |Γ(0)| = 1.

    Γ(s) = (s² I − (s K1 − K3) e^{−sτ})^{-1} (s K2 + K3) e^{−sτ} takes the velocity error of the vehicle in front to the
    own one, and for gains that act on every axis alike also the spacing error in front to the own one.
    """
    own, front, spacing = gains
    fastest = float(np.linalg.norm(own, 2) + np.sqrt(np.linalg.norm(spacing, 2)) + 1 / (delay_s + 1))
    omega = np.geomspace(1e-4 * fastest, 10 * fastest, 500)
    peak = 1.0
    for _ in range(2):
        s = 1j * omega[:, None, None]
        late = np.exp(-s * delay_s)
        loop = s**2 * np.eye(own.shape[0]) - (s * own - spacing) * late
        growth = np.linalg.norm(np.linalg.solve(loop, (s * front + spacing) * late), ord=2, axis=(1, 2))
        at = int(np.argmax(growth))
        peak = max(peak, float(growth[at]))
        omega = np.linspace(omega[max(at - 1, 0)], omega[min(at + 1, omega.size - 1)], 100)
    return peak
