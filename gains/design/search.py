"""The exact trade-off between robustness, delay margin and decay rate of one follower, as a two-dimensional search.

The search runs along the curve of all (k1, k3) with a given margin (`gains.performance.scalar_gains`) and over k2. It
is deterministic, and no frequency grid decides a margin. `gains.design.design` checks its results with methods that
share no formula with it.
"""

import numpy as np

from gains.core._bracketing import met_end
from gains.core.arrays import FloatArray
from gains.core.requirement import UNLIMITED, ChainLimit
from gains.performance.scalar_gains import (
    ScalarGains,
    alpha_of,
    decay_rate_of,
    front_gain_range,
    gains_of_margin,
    onboard_front_gain_limit,
)

# Points along the curve and over k2 in the first scan and in later ones; points over the spare margin. A round halves
# the window: 18 leave 1e-5 of it (1e-4 for k2, five rounds behind), and α, flat at its maximum, is exact to 1e-9.
_ROUNDS_ALL_FRONT = 5
_SCAN_FIRST, _SCAN_NEXT, _SCAN_SPARE, _ROUNDS = (25, 17), (9, 9), 9, 18
# Range of the crossing angle, as a share of the angle at which k3 = 0 in the continuous loop; it exceeds 1 if sampled.
_SHARE_MIN, _SHARE_MAX = 0.02, 1.3
# |k2| is searched up to this multiple of k1; the optimum of α is near k1. A range of k2 whose ends cross by at most
# this share of k1 is a single point, as with full feed-forward.
_FRONT_MAX, _SLIVER = 2.0, 1e-9
# Limit on k1 T: without delay the sampled leader's error changes by 1 − k1 T per period, kept above −0.8 by this.
_OWN_STEP_MAX = 1.8
# Accuracy of α. The search aims above a required α by this, and seeks no finer root.
_ALPHA_RESOLUTION = 1e-9
# If the margin is short relative to the period, few of its high gains are usable, and a longer margin may have a larger
# α. Up to the first number of periods, margins longer by up to the second are therefore searched too.
_SHORT_MARGIN, _SPARE_MAX = 2.0, 2.0
# The search for a margin begins at the first and ends at the second, where α is below 1e-4 and useless.
_MARGIN_FIRST_S, _MARGIN_MAX_S = 0.3, 75.0
# Points along the curve in the search for the fastest decay; rounds, each keeping ±1 cell, to 1e-13 of the curve.
_SCAN_FASTEST, _ROUNDS_FASTEST = 33, 12


def largest_alpha(
    delay_margin_s: float, period_s: float, limit: ChainLimit = UNLIMITED, decay_rate_1_s: float = 0.0
) -> ScalarGains | None:
    """Return the gains with the largest α among those with at least the given delay margin, None if there are none.

    The margin is that of the loop with all feedback late, sampled and held every `period_s`, or continuous if that is
    0. Spacing errors grow from vehicle to vehicle by at most `limit`, both without delay and with half the margin as
    loop delay (plus half a period for the hold), or on board at every delay. The continuous loop without delay decays
    at least at `decay_rate_1_s`. α is that of the loop with the feed-forward in `limit`.
    """
    # Axes of the scan: share of the crossing angle, k2 as a share of its limit, margin left over in periods.
    shares = (_SHARE_MIN, _SHARE_MAX)
    if decay_rate_1_s > 0.0:
        fast = _fast_shares(decay_rate_1_s, delay_margin_s, period_s, limit)
        if fast is None:
            return None
        shares = fast
    spare_max = _spare_max(delay_margin_s, period_s)
    bounds = (shares, (-1.0, 1.0), (0.0, spare_max))
    windows, best = bounds, None
    for turn in range(_ROUNDS):
        points = (*(_SCAN_FIRST if turn == 0 else _SCAN_NEXT), _SCAN_SPARE if spare_max else 1)
        grids = [np.linspace(*window, count) for window, count in zip(windows, points, strict=True)]
        found = _best_of_grid(grids, delay_margin_s, period_s, limit, decay_rate_1_s)
        if found is not None and (best is None or found[0].alpha > best[0].alpha):
            best = found
        if best is None:
            return None
        narrowed = [
            _narrowed(window, centre, count, ends)
            for window, centre, count, ends in zip(windows, best[1], points, bounds, strict=True)
        ]
        # High gains make α nearly independent of k2, so the best k2 of a scan that is coarse in the rest means nothing.
        windows = (narrowed[0], narrowed[1] if turn >= _ROUNDS_ALL_FRONT else bounds[1], narrowed[2])
    assert best is not None
    return best[0]


def largest_margin(
    alpha: float, period_s: float, limit: ChainLimit = UNLIMITED, decay_rate_1_s: float = 0.0
) -> tuple[float, ScalarGains] | None:
    """Return the largest delay margin (s) at which α can be reached, and the gains; None if there is none.

    The largest α falls as the margin grows; this is the inverse, by false position.
    """

    def excess(margin_s: float) -> float:
        gains = largest_alpha(margin_s, period_s, limit, decay_rate_1_s)
        return (gains.alpha if gains else 0.0) - alpha - _ALPHA_RESOLUTION

    # Double the margin until α is lost, or halve it until α is reached; below two periods, try 0 next.
    low, high = 0.0, _MARGIN_FIRST_S
    f_low, f_high = -1.0, excess(high)
    while f_high >= 0 and high < _MARGIN_MAX_S:
        low, f_low, high = high, f_high, 2 * high
        f_high = excess(high)
    while f_low < 0:
        low = high / 2 if high > 2 * period_s else 0.0
        f_low = excess(low)
        if f_low < 0 and low == 0.0:
            return None
        if f_low < 0:
            high, f_high = low, f_low
    margin_s = met_end(excess, (low, f_low), (high, f_high), resolution=_ALPHA_RESOLUTION)
    gains = largest_alpha(margin_s, period_s, limit, decay_rate_1_s)
    assert gains is not None
    return margin_s, gains


def fastest_decay(delay_margin_s: float, period_s: float, limit: ChainLimit = UNLIMITED) -> float:
    """Return the largest decay rate (1/s), without delay, of gains with a margin; 0 if no gains have the margin.

    Arguments as for `largest_alpha`.
    """
    return _fastest(delay_margin_s, period_s, limit)[0]


def _fastest(delay_margin_s: float, period_s: float, limit: ChainLimit) -> tuple[float, float]:
    """The largest decay rate at a margin and the share of the crossing angle at which it occurs.

    Along the curve the decay rate rises to that share (critical damping, or the last usable share) and then falls.
    """
    low, high = _SHARE_MIN, _SHARE_MAX
    rate, share = 0.0, (low + high) / 2
    for _ in range(_ROUNDS_FASTEST):
        shares = np.linspace(low, high, _SCAN_FASTEST)
        rates = _decay_rates(shares, delay_margin_s, period_s, limit)
        at = int(np.argmax(rates))
        rate, share = float(rates[at]), float(shares[at])
        low, high = float(shares[max(at - 1, 0)]), float(shares[min(at + 1, shares.size - 1)])
    return rate, share


def _fast_shares(
    decay_rate_1_s: float, delay_margin_s: float, period_s: float, limit: ChainLimit
) -> tuple[float, float] | None:
    """Range of shares of the crossing angle in which gains with a margin decay this fast; None if none do."""
    rate, share = _fastest(delay_margin_s, period_s, limit)
    if rate < decay_rate_1_s:
        return None

    def last_fast(end: float) -> float:
        """The last share that is fast enough, going from the fastest one towards an end."""
        fast, slow = share, end
        for _ in range(_ROUNDS_FASTEST):
            shares = np.linspace(fast, slow, _SCAN_FASTEST)
            rates = _decay_rates(shares, delay_margin_s, period_s, limit)
            count = int(np.argmin(rates >= decay_rate_1_s)) or shares.size
            fast, slow = float(shares[count - 1]), float(shares[min(count, shares.size - 1)])
        return fast

    return last_fast(_SHARE_MIN), last_fast(_SHARE_MAX)


def _decay_rates(share: FloatArray, delay_margin_s: float, period_s: float, limit: ChainLimit) -> FloatArray:
    """The decay rate at each share, maximised over the spare margin; 0 where no gains are usable."""
    spare_max = _spare_max(delay_margin_s, period_s)
    spare = np.linspace(0.0, spare_max, _SCAN_SPARE if spare_max else 1)[:, None]
    k1, k3, _, most = _usable_gains(share, delay_margin_s + spare * period_s, period_s, limit)
    return np.where(np.isfinite(most), decay_rate_of(k1, k3), 0.0).max(axis=0)


def _spare_max(delay_margin_s: float, period_s: float) -> float:
    """How far beyond the wanted margin to search, in periods."""
    return _SPARE_MAX if delay_margin_s <= _SHORT_MARGIN * period_s else 0.0


def _usable_gains(
    share: FloatArray, margin_s: FloatArray, period_s: float, limit: ChainLimit
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """k1 and k3 at each share and margin (broadcast), and the least and largest k2, NaN where they are not usable."""
    share, margin_s = np.broadcast_arrays(share, margin_s)
    k1, k3 = gains_of_margin(share, margin_s, period_s)
    least, most = _front_range(k1, k3, (margin_s + period_s) / 2, limit)
    usable = (k1 > 0) & (k3 > 0) & (k1 * period_s <= _OWN_STEP_MAX) & (least <= most + _SLIVER * k1)
    return k1, k3, np.where(usable, least, np.nan), np.where(usable, most, np.nan)


def _best_of_grid(
    grids: list[FloatArray], delay_margin_s: float, period_s: float, limit: ChainLimit, decay_rate_1_s: float
) -> tuple[ScalarGains, tuple[float, float, float]] | None:
    """The gains with the largest α on the grids of share, front and spare, and their place; None if none is usable."""
    front = grids[1]
    share, spare = (grid.ravel() for grid in np.meshgrid(grids[0], grids[2]))
    k1, k3, least, most = _usable_gains(share, delay_margin_s + spare * period_s, period_s, limit)
    usable = np.isfinite(most)
    if decay_rate_1_s > 0.0:
        usable &= np.where(usable, decay_rate_of(k1, k3), 0.0) >= decay_rate_1_s
    if not usable.any():
        return None
    k1, k3, least, most, share, spare = (grid[usable] for grid in (k1, k3, least, most, share, spare))
    k2 = ((least + most) / 2)[:, None] + ((most - least) / 2)[:, None] * front
    alpha = alpha_of(k1[:, None], k2 - limit.feed_forward * k1[:, None], k3[:, None])
    i, j = np.unravel_index(int(np.argmax(alpha)), alpha.shape)
    gains = ScalarGains(float(k1[i]), float(k2[i, j]) + 0.0, float(k3[i]), float(alpha[i, j]))
    return gains, (float(share[i]), float(front[j]), float(spare[i]))


def _front_range(
    k1: FloatArray, k3: FloatArray, delay_s: FloatArray, limit: ChainLimit
) -> tuple[FloatArray, FloatArray]:
    """The least and the largest k2 to try: multiples of k1, reduced where spacing errors would grow beyond the limit.

    Where they do at every k2, the least is above the largest, or both are NaN.
    """
    least, most = -_FRONT_MAX * k1, _FRONT_MAX * k1
    if limit.peak is None:
        return least, most
    if limit.loop == "onboard":
        most = np.minimum(most, onboard_front_gain_limit(k1, k3, limit.peak))
        return -most, most
    for delay in (np.zeros_like(delay_s), delay_s):
        low, high = front_gain_range(k1, k3, delay, limit.peak, limit.feed_forward)
        least, most = np.maximum(least, low), np.minimum(most, high)
    return least, most


def _narrowed(
    window: tuple[float, float], centre: float, points: int, bounds: tuple[float, float]
) -> tuple[float, float]:
    reach = 2 * (window[1] - window[0]) / max(points - 1, 1)
    return max(bounds[0], centre - reach), min(bounds[1], centre + reach)
