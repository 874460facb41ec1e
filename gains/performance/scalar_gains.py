"""Formulas of one follower with scalar gains: its delay margin, growth of errors, robustness and decay.

The gains act on every axis alike, u_i = −k1 e_i^v + k2 e_j^v + k3 e_i^p + k_ff u_j, and all feedback is late. The delay
margin depends on (k1, k3) alone and the gains of a given margin form a curve with an explicit equation
(`gains_of_margin`).
"""

from dataclasses import dataclass
from math import inf

import numpy as np

from gains.core._bracketing import Functions
from gains.core.arrays import FloatArray, IntArray
from gains.formation.model import FormationModel

PAIR = FormationModel((-1, 0), axes=1)
"""A leader and its follower on one axis: with equal gains a tree of any size has the roots of these two."""
# Frequencies in the first scan of a response, and in each refinement between the neighbours of the least one. Three
# refinements, and a parabola through the last, give σ_min to about 1e-10 of itself.
_FREQUENCIES, _FREQUENCIES_CLOSER, _CLOSER_LOOKS = 40, 9, 3
# With feed-forward, frequencies reach at most this many times farther, with at most this many times as many points.
_FARTHEST, _MOST_FREQUENCIES = 10.0, 3.0


@dataclass(frozen=True)
class ScalarGains:
    """Gains of u_i = −k1 e_i^v + k2 e_j^v + k3 e_i^p (1/s, 1/s, 1/s²) and their sector bound α (1/s)."""

    k1: float
    k2: float
    k3: float
    alpha: float

    @property
    def K(self) -> FloatArray:  # noqa: N802 - the source's letter
        """K of u = K e for `PAIR`, shape (2, 3)."""
        return self.gain_of(PAIR)

    def gain_of(self, model: FormationModel) -> FloatArray:
        """K of u = K e, shape (inputs, states), of a formation of one axis whose vehicles all have these gains."""
        return model.overlapping_gain([[-self.k1]], [[self.k2]], [[self.k3]])


def gains_of_margin(share: FloatArray, delay_margin_s: FloatArray, period_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the (k1, k3) whose follower loop has a root on the stability limit at exactly the given delay.

    Continuous loop (period 0): s² + (k1 s + k3) e^{−sτ} = 0 at s = jω is linear in the gains and gives
    k1 = ω sin ωτ, k3 = ω² cos ωτ, with 0 < ωτ < π/2. This inverts the closed form of the source's loop with all
    feedback late, τ = atan(k1 ω / k3) / ω, ω² = (k1² + √(k1⁴ + 4 k3²)) / 2.

    Sampled loop with period T and zero-order hold: with τ = (l + f) T, 0 ≤ f < 1, the command computed from the sample
    at t_k acts from t_k + τ. Over one period velocity and spacing respond to u with

        G_v(z) = T z^{−l−1} (f + (1 − f) z) / (z − 1)
        G_p(z) = −(T G_v + T² z^{−l−1} (f − f²/2 + (1 − f)² z / 2)) / (z − 1)

    and 1 = −k1 G_v + k3 G_p at z = e^{jωT} is again linear in the gains. `share` is ω (τ + T/2) / (π/2) in (0, 1.3), of
    a shape that broadcasts with that of τ. Only results with k1 > 0, k3 > 0 and k1 T < 2 (stable without delay) have
    that margin.
    """
    if period_s == 0:
        angle = share * np.pi / 2
        return angle * np.sin(angle) / delay_margin_s, angle**2 * np.cos(angle) / delay_margin_s**2
    # Rounding must not take a period from a delay that is a multiple of the period.
    periods = np.floor(delay_margin_s / period_s + 1e-12)
    part = np.maximum(0.0, delay_margin_s / period_s - periods)
    z = np.exp(1j * share * (np.pi / 2) / (delay_margin_s / period_s + 0.5))
    late = z ** (-periods - 1)
    velocity = period_s * late * (part + (1 - part) * z) / (z - 1)
    within = period_s**2 * late * (part - part**2 / 2 + (1 - part) ** 2 / 2 * z)
    spacing = -(period_s * velocity + within) / (z - 1)
    # Real and imaginary part of 1 = −k1 G_v + k3 G_p by Cramer's rule.
    determinant = velocity.imag * spacing.real - velocity.real * spacing.imag
    return spacing.imag / determinant, velocity.imag / determinant


def front_gain_range(
    k1: FloatArray, k3: FloatArray, delay_s: FloatArray, string_peak_max: float, feed_forward: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return the least and the largest k2 with which spacing errors grow by at most `string_peak_max` per vehicle.

    A vehicle adds the share k_ff = `feed_forward` of the command in front. Its spacing error follows the one in front
    through Γ(s) = (k_ff s² + (k2 s + k3) e^{−sτ}) / (s² + (k1 s + k3) e^{−sτ}). |Γ(jω)| ≤ L is

        (k2 − k_ff ω sin ωτ)² ≤ L² (ω² − 2 (k3 cos ωτ + k1 ω sin ωτ) + k1²) + (L² − 1) k3² / ω²
                                + 2 k_ff k3 cos ωτ − (k_ff ω cos ωτ)²                            for all ω > 0,

    which is k2² ≤ k1² − 2 k3 without delay, with L = 1 and k_ff = 0. The results have the shape of `k1`; where no k2
    qualifies, the least is above the largest.
    """
    omega, at_rest = _frequencies_below_growth(k1, k3, feed_forward), k1**2 - 2 * (1.0 - feed_forward) * k3
    k1, k3, delay_s = k1[..., None], k3[..., None], delay_s[..., None]

    def most(omega: FloatArray, side: float) -> FloatArray:
        """The largest k2 at each frequency or, for side −1, minus the least; too small where no k2 qualifies."""
        lag = omega * delay_s
        flat = omega**2 - 2 * (k3 * np.cos(lag) + k1 * omega * np.sin(lag)) + k1**2
        square = string_peak_max**2 * flat + (string_peak_max**2 - 1) * (k3 / omega) ** 2
        if feed_forward:
            square += 2.0 * feed_forward * k3 * np.cos(lag) - (feed_forward * omega * np.cos(lag)) ** 2
        return side * feed_forward * omega * np.sin(lag) + np.copysign(np.sqrt(np.abs(square)), square)

    sides = (-1.0, 1.0) if feed_forward else (1.0,)  # without, the range is its own mirror image
    ends = [_around_least(lambda omega, side=side: most(omega, side), omega)[0].min(axis=-1) for side in sides]
    if string_peak_max == 1:
        ends = [np.minimum(end, np.copysign(np.sqrt(np.abs(at_rest)), at_rest)) for end in ends]
    return -ends[0], ends[-1]


def onboard_front_gain_limit(k1: FloatArray, k3: FloatArray, string_peak_max: float) -> FloatArray:
    """Return the largest |k2| with which spacing errors grow by at most `string_peak_max` at every delay, on board.

    A vehicle feeds back its own errors without delay, and only the velocity of the vehicle in front is late:

        Γ(s) = (k3 + k2 s e^{−sτ}) / (s² + k1 s + k3)

    With the denominator D, |Γ| ≤ L for every delay is k3 + |k2| ω ≤ L |D(jω)| for every frequency. With L = 1 only
    k2 = 0 is possible, and only if k1² ≥ 2 k3, because low frequencies require k2² + 2 k3 + 2 k2 k3 τ ≤ k1². The result
    has the shape of `k1`: NaN where no k2 qualifies.
    """
    if string_peak_max == 1.0:
        return np.where(k1**2 >= 2 * k3, 0.0, np.nan)
    omega = _frequencies_below_growth(k1, k3)
    k1, k3 = k1[..., None], k3[..., None]

    def bound(omega: FloatArray) -> FloatArray:
        size = np.sqrt((k3 - omega**2) ** 2 + (k1 * omega) ** 2)
        return (string_peak_max * size - k3) / omega

    least = _around_least(bound, omega)[0].min(axis=-1)
    return np.where(least >= 0, least, np.nan)


def least_singular_value(k1: FloatArray, k2: FloatArray, k3: FloatArray, omega: FloatArray) -> FloatArray:
    """Return σ_min(jωI − A_cl) of the follower subsystem (3.25, 3.26) for each gain and frequency (broadcast).

    σ_min² is the least root of λ³ − c2 λ² + c1 λ − c0, whose coefficients are the sums of the squared 1×1, 2×2 and 3×3
    minors of jωI − A_cl. Newton's iteration from λ = 0 rises to it without overshoot, because all roots are real.
    """
    x, a2 = omega**2, k1**2
    own = x + a2
    loop = (k3 - x) ** 2 + a2 * x
    c2 = 3 * x + 2 * a2 + 2 + k2**2 + k3**2
    c1 = loop + (k2 - k1) ** 2 + x + k3**2 + k2**2 * x + own * (own + k3**2 + 1 + x)
    c0 = own * loop
    root = c0 / c1
    for _ in range(5):
        root = root + (c0 - root * (c1 - root * (c2 - root))) / (c1 - root * (2 * c2 - 3 * root))
    return np.sqrt(root)


def alpha_of(k1: FloatArray, k2: FloatArray, k3: FloatArray) -> FloatArray:
    """Return α for W = I, the minimum of σ_min(jωI − A_cl) over ω, for each of the gains (broadcast)."""
    k1, k2, k3 = (gain[..., None] for gain in np.broadcast_arrays(k1, k2, k3))
    slow, fast = min(1.0, np.sqrt(k3.min()), k1.min()), max(1.0, np.sqrt(k3.max()), k1.max())
    omega = np.broadcast_to(
        np.concatenate([[0.0], np.geomspace(slow / 10, 3 * fast, _FREQUENCIES)]), (*k1.shape[:-1], _FREQUENCIES + 1)
    )
    sigma, at = _around_least(lambda at: least_singular_value(k1, k2, k3, at), omega)
    before, middle, after = (np.take_along_axis(sigma, at + step, -1)[..., 0] for step in (-1, 0, 1))
    bend, slope = before - 2 * middle + after, (after - before) / 2
    vertex = middle - np.where(bend > 0, slope**2 / (2 * np.where(bend > 0, bend, 1.0)), 0.0)
    # At an end of the range (ω = 0) the vertex is not between the points, and the least sample is taken.
    inside = (bend > 0) & (np.abs(slope) <= bend)
    return np.where(inside, vertex, sigma.min(axis=-1))


def decay_rate_of(k1: FloatArray, k3: FloatArray) -> FloatArray:
    """Return the decay rate (1/s) of s² + k1 s + k3, without delay; the leader, s + k1, decays no slower."""
    return k1 / 2 - np.sqrt(np.maximum(k1**2 / 4 - k3, 0.0))


def _frequencies_below_growth(k1: FloatArray, k3: FloatArray, feed_forward: float = 0.0) -> FloatArray:
    """Frequencies up to 2 k1 + √(2 k3), above which bounds on k2 grow at every delay: ω² outgrows 2 (k3 + k1 ω).

    With feed-forward, only (1 − k_ff²) ω² is left of ω², so the frequencies reach farther.
    """
    farther = min(1.0 / (1.0 - feed_forward) if feed_forward < 1.0 else inf, _FARTHEST)
    highest = farther * (2 * np.max(np.abs(k1)) + np.sqrt(2 * np.max(np.abs(k3))))
    count = round(96 * min(farther, _MOST_FREQUENCIES))
    return np.broadcast_to(np.linspace(0, highest, count + 1)[1:], (*k1.shape, count))


def _around_least(function: Functions, omega: FloatArray) -> tuple[FloatArray, IntArray]:
    """Refined values around the minimum of each row, and the index of the minimum along the last axis, off the ends."""
    values = function(omega)
    at = _index_of_least(values)
    for _ in range(_CLOSER_LOOKS):
        low, high = np.take_along_axis(omega, at - 1, -1), np.take_along_axis(omega, at + 1, -1)
        omega = low + (high - low) * np.linspace(0, 1, _FREQUENCIES_CLOSER)
        values = function(omega)
        at = _index_of_least(values)
    return values, at


def _index_of_least(values: FloatArray) -> IntArray:
    return np.clip(np.argmin(values, axis=-1, keepdims=True), 1, values.shape[-1] - 2)
