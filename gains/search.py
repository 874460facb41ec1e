"""The exact trade-off between robustness and delay margin of one follower, as a two-dimensional search.

Gains are numbers that act on every axis alike, u_i = −k1 e_i^v + k2 e_j^v + k3 e_i^p, and all feedback is late. The
delay margin depends on (k1, k3) alone and the gains of a given margin form a curve with an explicit equation
(`gains_of_margin`), so the search runs along that curve and over k2. Nothing here is random, and no frequency grid
decides a margin. The designs found are checked by the functions of `gains.delay`, `gains.sampled` and `gains.robust`,
which share no formula with this file.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# Points of the first, coarse scan along the curve and over k2, of the later ones, and of both over the spare margin.
# A round keeps ±2 cells about the best point, so the window halves; 18 rounds leave 1e-5 of it (k2 begins five
# rounds later: 1e-4), and α, flat at its maximum, is then exact to about 1e-9.
_ROUNDS_ALL_FRONT = 5
_SCAN_FIRST, _SCAN_NEXT, _SCAN_SPARE, _ROUNDS = (25, 17), (9, 9), 9, 18
# Frequencies of the first look at a response, and of each closer look between the neighbours of the least one. Three of
# those, and a parabola through the last, bring σ_min to about 1e-10 of itself.
_FREQUENCIES, _FREQUENCIES_CLOSER, _CLOSER_LOOKS = 40, 9, 3
# The angle of the crossing, as a share of the one at which k3 = 0 in the continuous loop. The sampled loop's share goes
# a little above 1; what lies beyond k3 = 0 is discarded.
_SHARE_MIN, _SHARE_MAX = 0.02, 1.3
# |k2| is sought up to this multiple of k1. The optimum of α is near k1.
_FRONT_MAX = 2.0
# Without delay the sampled leader moves by the factor 1 − k1 T a period. At k1 T = 2 it is unstable with no delay at
# all; this keeps the factor above −0.8.
_OWN_STEP_MAX = 1.8
# α is exact to about this, so an α asked for is aimed at from above by it, and no finer root is sought.
_ALPHA_RESOLUTION = 1e-9
# Gains of exactly a margin that is short against the period are so high that few are good or usable, and a larger
# margin comes with a larger α. Up to this margin in periods, one larger by up to so many periods is looked at too.
_SHORT_MARGIN, _SPARE_MAX = 2.0, 2.0
# Where the search for a margin begins, and where it ends: α is then below 1e-4 and the loop of no use to anyone.
_MARGIN_FIRST_S, _MARGIN_MAX_S = 0.3, 75.0
# About ten steps find a margin. Only where it is short against the period is α too rough for that, to about 1e-5.
_ROOT_STEPS = 30


@dataclass(frozen=True)
class ScalarGains:
    """Gains of u_i = −k1 e_i^v + k2 e_j^v + k3 e_i^p (1/s, 1/s, 1/s²) and the α they have."""

    k1: float
    k2: float
    k3: float
    alpha: float


def gains_of_margin(share: FloatArray, delay_margin_s: FloatArray, period_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the (k1, k3) whose follower loop has a root on the stability limit at exactly the given delay.

    Continuous loop (period 0): s² + (k1 s + k3) e^{−sτ} = 0 at s = jω is linear in the gains and gives
    k1 = ω sin ωτ, k3 = ω² cos ωτ, with 0 < ωτ < π/2. Inverse of the closed form of the source's loop with all
    feedback late, τ = atan(k1 ω / k3) / ω, ω² = (k1² + √(k1⁴ + 4 k3²)) / 2.

    Sampled loop with period T and zero-order hold: with τ = (l + f) T, 0 ≤ f < 1, the command computed from the sample
    at t_k acts from t_k + τ. Over one period the velocity and spacing answer u with

        G_v(z) = T z^{−l−1} (f + (1 − f) z) / (z − 1)
        G_p(z) = −(T G_v + T² z^{−l−1} (f − f²/2 + (1 − f)² z / 2)) / (z − 1)

    and 1 = −k1 G_v + k3 G_p at z = e^{jωT} is again linear in the gains.

    Parameters
    ----------
    share
        ω (τ + T/2) / (π/2), of any shape, in (0, 1.3).
    delay_margin_s, period_s
        τ, of any shape that fits that of `share`, and T; T = 0 for the continuous loop.

    Returns
    -------
    tuple
        k1 and k3. Only those with k1 > 0, k3 > 0 and, sampled, k1 T < 2 (stable without delay)
        are gains of that margin.

    Examples
    --------
    A crossing at ω = π/4 with a margin of 1 s:

    >>> import numpy as np
    >>> from gains.delay import delay_margin
    >>> from gains.search import gains_of_margin
    >>> k1, k3 = gains_of_margin(np.array(0.5), np.array(1.0), 0.0)
    >>> round(delay_margin([[0, -1], [0, 0]], [[0, 0], [k3, -k1]]), 6)
    1.0
    """
    if period_s == 0:
        angle = share * np.pi / 2
        return angle * np.sin(angle) / delay_margin_s, angle**2 * np.cos(angle) / delay_margin_s**2
    # A delay given as a multiple of the period must not lose a period to rounding.
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


def front_gain_limit(k1: FloatArray, k3: FloatArray, delay_s: FloatArray, string_peak_max: float) -> FloatArray:
    """Return the largest |k2| with which spacing errors grow by at most `string_peak_max` from vehicle to vehicle.

    The spacing error of a vehicle follows that of the vehicle in front with
    Γ(s) = (k2 s + k3) e^{−sτ} / (s² + (k1 s + k3) e^{−sτ}). |Γ(jω)| ≤ L for all ω is

        k2² ≤ L² (ω² − 2 (k3 cos ωτ + k1 ω sin ωτ) + k1²) + (L² − 1) k3² / ω²     for all ω > 0,

    without delay and with L = 1: k2² ≤ k1² − 2 k3.

    Returns
    -------
    array
        Of the shape of `k1`; NaN where no k2 will do.

    Examples
    --------
    Without delay √(k1² − 2 k3):

    >>> import numpy as np
    >>> from gains.search import front_gain_limit
    >>> front_gain_limit(np.array([2.0]), np.array([1.0]), np.array([0.0]), 1.0).round(6).tolist()
    [1.414214]
    """
    # Above ω = 2 k1 + √(2 k3) the bound grows with ω for every delay: ω² outgrows 2 (k3 + k1 ω).
    highest = 2 * np.max(np.abs(k1)) + np.sqrt(2 * np.max(np.abs(k3)))
    at_rest = k1**2 - 2 * k3 if string_peak_max == 1 else np.full_like(k1, np.inf)
    k1, k3, delay_s = k1[..., None], k3[..., None], delay_s[..., None]

    def bound(omega: FloatArray) -> FloatArray:
        lag = omega * delay_s
        flat = omega**2 - 2 * (k3 * np.cos(lag) + k1 * omega * np.sin(lag)) + k1**2
        return string_peak_max**2 * flat + (string_peak_max**2 - 1) * (k3 / omega) ** 2

    omega = np.broadcast_to(np.linspace(0, highest, 97)[1:], (*k1.shape[:-1], 96))
    square, at = _with_least_inside(bound(omega))
    for _ in range(_CLOSER_LOOKS):
        omega = _between_neighbours(omega, at)
        square, at = _with_least_inside(bound(omega))
    least = np.minimum(square.min(axis=-1), at_rest)
    return np.sqrt(np.where(least >= 0, least, np.nan))


def least_singular_value(k1: FloatArray, k2: FloatArray, k3: FloatArray, omega: FloatArray) -> FloatArray:
    """Return σ_min(jωI − A_cl) of the follower subsystem (3.25, 3.26) for each gain and frequency (broadcast).

    σ_min² is the least root of λ³ − c2 λ² + c1 λ − c0, whose coefficients are the sums of the squared 1×1, 2×2 and 3×3
    minors of jωI − A_cl. Newton's iteration from λ = 0 rises to it without overshoot, because all roots are real.

    Examples
    --------
    The same as of `gains.robust.subsystem_loop` with K1 = −k1, K2 = k2, K3 = k3:

    >>> import numpy as np
    >>> from gains.robust import subsystem_loop
    >>> from gains.search import least_singular_value
    >>> least = np.linalg.svd(1j * np.eye(3) - subsystem_loop(-3, 2, 2), compute_uv=False)[-1]
    >>> found = least_singular_value(np.array(3.0), np.array(2.0), np.array(2.0), np.array(1.0))
    >>> round(float(found), 6) == round(float(least), 6)
    True
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
    """Return α for W = I, the least of σ_min(jωI − A_cl) over ω, for each of the gains (broadcast).

    Examples
    --------
    The same as `gains.robust.robustness`, for many gains at a time:

    >>> import numpy as np
    >>> from gains.robust import robustness
    >>> from gains.search import alpha_of
    >>> alpha_of(np.array([3.0, 2.0]), np.array([2.0, 1.0]), np.array([2.0, 1.0])).round(6).tolist()
    [0.532094, 0.39909]
    >>> round(robustness(-3, 2, 2), 6), round(robustness(-2, 1, 1), 6)
    (0.532094, 0.39909)
    """
    k1, k2, k3 = (gain[..., None] for gain in np.broadcast_arrays(k1, k2, k3))
    slow, fast = min(1.0, np.sqrt(k3.min()), k1.min()), max(1.0, np.sqrt(k3.max()), k1.max())
    omega = np.broadcast_to(
        np.concatenate([[0.0], np.geomspace(slow / 10, 3 * fast, _FREQUENCIES)]), (*k1.shape[:-1], _FREQUENCIES + 1)
    )
    sigma, at = _with_least_inside(least_singular_value(k1, k2, k3, omega))
    for _ in range(_CLOSER_LOOKS):
        omega = _between_neighbours(omega, at)
        sigma, at = _with_least_inside(least_singular_value(k1, k2, k3, omega))
    before, middle, after = (np.take_along_axis(sigma, at + step, -1)[..., 0] for step in (-1, 0, 1))
    bend, slope = before - 2 * middle + after, (after - before) / 2
    vertex = middle - np.where(bend > 0, slope**2 / (2 * np.where(bend > 0, bend, 1.0)), 0.0)
    # At an end of the range (ω = 0) the parabola is not between its points and the least sample counts.
    inside = (bend > 0) & (np.abs(slope) <= bend)
    return np.where(inside, vertex, sigma.min(axis=-1))


def largest_alpha(delay_margin_s: float, period_s: float, string_peak_max: float | None = None) -> ScalarGains | None:
    """Return the gains of largest α among those with at least the given delay margin, None if there are none.

    Parameters
    ----------
    delay_margin_s
        Margin of the loop with all feedback late, sampled with `period_s`, or continuous if `period_s` is 0.
    period_s
        Period of sample and hold.
    string_peak_max
        Largest growth of spacing errors from vehicle to vehicle, both without delay and with half the margin as loop
        delay (plus half a period for the hold); not limited if None.

    Examples
    --------
    The gains found have the margin asked for:

    >>> from gains.delay import delay_margin
    >>> from gains.search import largest_alpha
    >>> gains = largest_alpha(0.3, 0.0)
    >>> round(delay_margin([[0, -1], [0, 0]], [[0, 0], [gains.k3, -gains.k1]]), 6)
    0.3
    """
    # Axes of the scan: share of the crossing angle, k2 as a share of its limit, margin left over in periods.
    spare_max = _SPARE_MAX if delay_margin_s <= _SHORT_MARGIN * period_s else 0.0
    bounds = ((_SHARE_MIN, _SHARE_MAX), (-1.0, 1.0), (0.0, spare_max))
    windows, best = bounds, None
    for turn in range(_ROUNDS):
        points = (*(_SCAN_FIRST if turn == 0 else _SCAN_NEXT), _SCAN_SPARE if spare_max else 1)
        grids = [np.linspace(*window, count) for window, count in zip(windows, points, strict=True)]
        found = _best_of_grid(grids[0], grids[1], grids[2], delay_margin_s, period_s, string_peak_max)
        if found is not None and (best is None or found[0].alpha > best[0].alpha):
            best = found
        if best is None:
            return None
        narrowed = [
            _narrowed(window, centre, count, ends)
            for window, centre, count, ends in zip(windows, best[1], points, bounds, strict=True)
        ]
        # High gains make α nearly the same for every k2, and the best k2 of a coarse scan of the rest means nothing.
        windows = (narrowed[0], narrowed[1] if turn >= _ROUNDS_ALL_FRONT else bounds[1], narrowed[2])
    assert best is not None
    return best[0]


def largest_margin(
    alpha: float, period_s: float, string_peak_max: float | None = None
) -> tuple[float, ScalarGains] | None:
    """Return the largest delay margin (s) at which α can be reached, and the gains; None if no margin is left.

    The largest α falls as the margin grows, so this is its inverse, by false position with halved ends (Illinois).

    Examples
    --------
    The way back: the α that is reached at a margin is reached at no longer one.

    >>> from gains.search import largest_alpha, largest_margin
    >>> margin_s, _ = largest_margin(largest_alpha(0.3, 0.02).alpha, 0.02)
    >>> round(margin_s, 4)
    0.3
    """

    def excess_at(margin_s: float) -> tuple[float, ScalarGains | None]:
        gains = largest_alpha(margin_s, period_s, string_peak_max)
        return (gains.alpha if gains else 0.0) - alpha - _ALPHA_RESOLUTION, gains

    # Double the margin until α is lost, or halve it until α is there; below two periods the last half is all of it.
    low, high, best = 0.0, _MARGIN_FIRST_S, None
    f_low, (f_high, gains) = 0.0, excess_at(high)
    while f_high >= 0 and high < _MARGIN_MAX_S:
        low, f_low, best, high = high, f_high, gains, 2 * high
        f_high, gains = excess_at(high)
    while best is None:
        low = high / 2 if high > 2 * period_s else 0.0
        f_low, gains = excess_at(low)
        if f_low >= 0:
            best = gains
        elif low == 0.0:
            return None
        else:
            high, f_high = low, f_low

    # The ends' values are halved when the other end moved twice in a row, so that both ends close in.
    excess, moved = f_low, 0
    for _ in range(_ROOT_STEPS):
        if excess <= _ALPHA_RESOLUTION or f_high >= 0:
            break
        middle = low + (high - low) * min(max(f_low / (f_low - f_high), 0.01), 0.99)
        f_middle, gains = excess_at(middle)
        if gains is not None and f_middle >= 0:
            low, best, excess, f_low = middle, gains, f_middle, f_middle
            f_high = f_high / 2 if moved > 0 else f_high
            moved = 1
        else:
            high, f_high = middle, f_middle
            f_low = f_low / 2 if moved < 0 else f_low
            moved = -1
    return low, best


def _best_of_grid(
    share: FloatArray,
    front: FloatArray,
    spare: FloatArray,
    delay_margin_s: float,
    period_s: float,
    string_peak_max: float | None,
) -> tuple[ScalarGains, tuple[float, float, float]] | None:
    """The gains of largest α on the grid and their (share, front, spare); None if no gains on it can be used."""
    share, spare = (grid.ravel() for grid in np.meshgrid(share, spare))
    margin_s = delay_margin_s + spare * period_s
    k1, k3 = gains_of_margin(share, margin_s, period_s)
    limit = _front_limit(k1, k3, (margin_s + period_s) / 2, string_peak_max)
    usable = (k1 > 0) & (k3 > 0) & (k1 * period_s <= _OWN_STEP_MAX) & np.isfinite(limit)
    if not usable.any():
        return None
    k1, k3, limit, share, spare = (grid[usable] for grid in (k1, k3, limit, share, spare))
    k2 = limit[:, None] * front
    alpha = alpha_of(k1[:, None], k2, k3[:, None])
    i, j = np.unravel_index(int(np.argmax(alpha)), alpha.shape)
    gains = ScalarGains(float(k1[i]), float(k2[i, j]), float(k3[i]), float(alpha[i, j]))
    return gains, (float(share[i]), float(front[j]), float(spare[i]))


def _front_limit(k1: FloatArray, k3: FloatArray, delay_s: FloatArray, string_peak_max: float | None) -> FloatArray:
    """Largest |k2| to try: a multiple of k1, less where spacing errors would grow, NaN where they grow in any case."""
    limit = _FRONT_MAX * k1
    if string_peak_max is None:
        return limit
    for delay in (np.zeros_like(delay_s), delay_s):
        limit = np.minimum(limit, front_gain_limit(k1, k3, delay, string_peak_max))
    return limit


def _with_least_inside(values: FloatArray) -> tuple[FloatArray, NDArray[np.intp]]:
    """The values and, along their last axis, the index of the least one, moved off the ends."""
    return values, np.clip(np.argmin(values, axis=-1, keepdims=True), 1, values.shape[-1] - 2)


def _between_neighbours(omega: FloatArray, at: NDArray[np.intp]) -> FloatArray:
    """Finer frequencies between the neighbours of those at the index, along the last axis."""
    low, high = np.take_along_axis(omega, at - 1, -1), np.take_along_axis(omega, at + 1, -1)
    return low + (high - low) * np.linspace(0, 1, _FREQUENCIES_CLOSER)


def _narrowed(
    window: tuple[float, float], centre: float, points: int, bounds: tuple[float, float]
) -> tuple[float, float]:
    reach = 2 * (window[1] - window[0]) / max(points - 1, 1)
    return max(bounds[0], centre - reach), min(bounds[1], centre + reach)
