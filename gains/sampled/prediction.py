"""Delay-compensated control: which true delays a loop takes whose station predicts over an assumed one.

The station knows each command it has sent. It carries the newest sample on, under the commands that act after it, to
the instant at which the new command acts if the loop delay is tau^, and feeds the predicted state back:

    x^(t_k + tau^) = Phi(tau^) x_k + sum_j Gamma_j u_{k-j},   u_k = K x^(t_k + tau^),
    Phi(t) = e^{A t},   Gamma_j = int Phi(tau^ - s) B ds over [tau^ - j T, tau^ - (j - 1) T] within [0, tau^]

If tau^ is the true loop delay tau, the loop behind the delay is that without delay. What limits it is the mismatch
tau - tau^: the *mismatch window* is the interval of true delays around tau^ in which it is stable. Every control tick
predicts, so a command counts even if its sample has been used before. Loop delays are those of `multirate`.

In continuous time u(t) = K (e^{A tau^} x(t) + int_0^tau^ e^{A s} B u(t - s) ds) gives x'(t) = A x(t) + B u(t - tau)
the roots of

    det(s I - A - B K - B K e^{A tau^} (e^{-s tau} - e^{-s tau^})) = 0,

a loop with two delays, one of them known. An acceleration is not in a vehicle's telemetry: the station computes it from
its commands alone, and e^{A tau^} then carries on only what is `measured`, see `HeldPlant.carry`. Robustness and string
stability are in `gains.criteria.predicted`. Source:
Z. Artstein, "Linear systems with delayed controls: a reduction", IEEE Trans. AC 27 (1982).
"""

from collections.abc import Sequence
from functools import partial
from math import inf, isfinite

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import BoolArray, FloatArray
from gains.core.errors import BadModelError, DisagreementError
from gains.delay._crossings import DelayedTerm
from gains.delay._mixed import analyse_mixed
from gains.sampled._loop import HeldPlant, block_radius, carry, held_blocks, rate_of
from gains.sampled._mismatch import block_window
from gains.sampled._nyquist import rates_window
from gains.sampled.constant import checked_loop
from gains.sampled.multirate import Predictor, Timing, first_unstable, lifted_radius

# states of the largest lifted map that confirms an end, and how far from the end (s per s of mismatch) it is taken
_LARGEST_CHECK, _BESIDE = 60, 1e-5
# how much finer the search becomes when that contradicts it: near the limit of a loop its angles change in a period
_REFINEMENTS = (1, 4, 16)
# delays looked at in a continuous window, and in a control period; and how far the march goes: so many windows, and
# control periods more
_LOOKS_WINDOW, _LOOKS_PERIOD, _SEARCHED, _SEARCHED_PERIODS = 20, 3, 3.0, 10.0


def mismatch_window(
    A: ArrayLike,
    B: ArrayLike,
    K: ArrayLike,
    timing: Timing,
    *,
    assumed_s: float,
    measured: Sequence[bool] | None = None,
) -> tuple[float, float]:
    """The least and the largest true loop delay (s) between which the predicted loop is stable.

    0 if it is stable down to no delay, `inf` if no longer delay is found to be too long, and `assumed_s` twice if it is
    unstable without mismatch. The ends are crossings of the unit circle to about 1e-9 s, confirmed by the spectrum of
    the lifted map on either side if that is small. With a sample for every command no crossing in between is missed;
    otherwise delays in between are looked at, see `gains.sampled._nyquist`.

    A (n, n), B (n, p) and K (p, n) are real, with the feedback u = +K x; a response of the vehicles is part of A and B,
    see `gains.performance.response.formation_loop`. `assumed_s` is tau^, the (mean) loop delay over which is predicted.
    `measured` says which states are sampled, all if None; the station computes the others from its commands alone, K
    must not use them, and they must not depend on those that are sampled.
    BadModelError names an argument that does not fit; DisagreementError is raised if the eigenvalues of the lifted map
    contradict the crossings found.

    x' = u, u = -x takes 1.56 s at 50 Hz. A station that assumes 3 s takes 1.45 to 4.77 s:

    >>> [round(end_s, 3) for end_s in mismatch_window([[0]], [[1]], [[-1]], Timing(0.02, 0.02), assumed_s=3.0)]
    [1.449, 4.765]
    """
    loop, late_s = checked_loop(A, B, K), checked_assumption(assumed_s)
    plants = held_blocks(*loop, period_s=timing.common_s, measured=checked_mask(loop, measured))
    if timing.ticks > 1:
        ends_s = [rates_window(plant, timing, late_s) for plant in plants]
        window_s = max(least for least, _ in ends_s), min(most for _, most in ends_s)
        contradiction = "".join(_contradiction(plants, timing, late_s, end_s) for end_s in window_s)
        if window_s[0] < window_s[1] and contradiction:  # near the limit of the rates
            return _marched(
                plants, timing, late_s, mismatch_window_continuous(*loop, assumed_s=late_s, measured=measured)
            )
        return window_s
    # without mismatch the loop has the eigenvalues of that without delay
    if max(block_radius(plant, 0.0) for plant in plants) >= 1.0:
        return late_s, late_s
    window_s, contradiction = (0.0, inf), ""
    for refinement in _REFINEMENTS:
        ends_s = [block_window(plant, late_s, refinement) for plant in plants if plant.B.shape[1] > 0]
        window_s = max((least for least, _ in ends_s), default=0.0), min((most for _, most in ends_s), default=inf)
        contradiction = "".join(_contradiction(plants, timing, late_s, end_s) for end_s in window_s)
        if not contradiction:
            return window_s
    raise DisagreementError(contradiction)


def mismatch_window_continuous(
    A: ArrayLike, B: ArrayLike, K: ArrayLike, *, assumed_s: float, measured: Sequence[bool] | None = None
) -> tuple[float, float]:
    """The same of the continuous loop, from the analysis of its two delays. A hold counts as half a period of both.

    Exceptions as of `gains.delay._mixed.analyse_mixed`.

    x' = u, u = -x: s + 1 + e^{-s tau} - e^{-3 s} = 0.

    >>> [round(end_s, 3) for end_s in mismatch_window_continuous([[0]], [[1]], [[-1]], assumed_s=3.0)]
    [1.386, 4.873]
    """
    (plant, entry, feedback), late_s = checked_loop(A, B, K), checked_assumption(assumed_s)
    mask = checked_mask((plant, entry, feedback), measured)
    late = entry @ feedback @ carry(plant, mask, np.array([late_s]))[0]
    terms = [(plant + entry @ feedback, 0.0, 0), (late, 0.0, 1), (-late, late_s, 0)]
    windows = analyse_mixed([DelayedTerm(*term) for term in terms], horizon_s=late_s or None).stable_intervals_s
    return next((window for window in windows if window[0] <= late_s < window[1]), (late_s, late_s))


def predicted_growth_rate(
    A: ArrayLike,
    B: ArrayLike,
    K: ArrayLike,
    timing: Timing,
    *,
    assumed_s: float,
    delay_s: float,
    measured: Sequence[bool] | None = None,
) -> float:
    """Exponential rate (1/s) of the slowest motion at a true loop delay: negative when stable.

    Arguments and exceptions as of `mismatch_window`.

    x' = u, u = -x at a delay that is assumed rightly: that without delay, ln(1 - T) / T.

    >>> round(predicted_growth_rate([[0]], [[1]], [[-1]], Timing(0.5, 0.5), assumed_s=3.2, delay_s=3.2), 6)
    -1.386294
    """
    loop = checked_loop(A, B, K)
    plants = held_blocks(*loop, period_s=timing.common_s, measured=checked_mask(loop, measured))
    radius = max(_radius(plant, timing, checked_assumption(assumed_s), delay_s) for plant in plants)
    return rate_of(radius, timing.common_s)


def checked_assumption(assumed_s: float) -> float:
    """The assumed delay, or BadModelError."""
    if not (isfinite(assumed_s) and assumed_s >= 0.0):
        raise BadModelError(f"assumed_s is {assumed_s}; a number of seconds >= 0 is wanted")
    return float(assumed_s)


def checked_mask(loop: tuple[FloatArray, FloatArray, FloatArray], measured: Sequence[bool] | None) -> BoolArray | None:
    """Which states are measured (n,), None if all are; BadModelError if that does not fit the loop."""
    A, _, K = loop
    mask = None if measured is None else np.array(measured, dtype=np.bool_)
    if mask is None or mask.all():
        return None
    if mask.shape != (len(A),) or K[:, ~mask].any() or A[np.ix_(~mask, mask)].any():
        wanted = f"{len(A)} flags, with K and the states not measured independent as documented, are wanted"
        raise BadModelError(f"measured is {mask.tolist()}; {wanted}")
    return mask


def _radius(plant: HeldPlant, timing: Timing, assumed_s: float, delay_s: float) -> float:
    return lifted_radius(plant, timing, delay_s=delay_s, predictor=Predictor(plant, assumed_s))


def _contradiction(plants: Sequence[HeldPlant], timing: Timing, assumed_s: float, end_s: float) -> str:
    """What the lifted map just within the end of a window, and just beyond it, says against it; nothing if empty."""
    known_s = end_s if end_s < inf else 2.0 * assumed_s + 5.0 * timing.held_s
    periods = timing.ticks * (max(known_s, assumed_s) / timing.common_s + 2.0)
    if max(len(plant.A) + plant.B.shape[1] * periods for plant in plants) > _LARGEST_CHECK:
        return ""
    for share in (1.0 - _BESIDE, 1.0 + _BESIDE):
        at_s, within = assumed_s + share * (known_s - assumed_s), share < 1.0
        if at_s >= 0.0 and (within or 0.0 < end_s < inf):
            radius = max(_radius(plant, timing, assumed_s, at_s) for plant in plants)
            if (radius < 1.0) != within:
                return (
                    f"the mismatch window around {assumed_s} s ends at {end_s} s at a period of {timing.held_s} s, but "
                    f"the spectral radius of the lifted map at {at_s} s is {radius}"
                )
    return ""


def _marched(
    plants: Sequence[HeldPlant], timing: Timing, assumed_s: float, near_s: tuple[float, float]
) -> tuple[float, float]:
    """The window by a march of the lifted map's radius; `near_s` is that of the continuous loop."""

    def radius_aside(plant: HeldPlant, way: float, aside_s: float) -> float:
        return _radius(plant, timing, assumed_s, max(0.0, assumed_s + way * aside_s))

    period_s, ends_s = timing.common_s / timing.ticks, [0.0, inf]
    for plant in plants:
        for side, way in enumerate((-1.0, 1.0)):
            wide_s = abs(near_s[side] - assumed_s) if isfinite(near_s[side]) else 0.0
            step_s = max(period_s / _LOOKS_PERIOD, wide_s / _LOOKS_WINDOW)
            last_s = assumed_s if side == 0 else _SEARCHED * wide_s + _SEARCHED_PERIODS * period_s
            looks = [*np.arange(0.0, last_s, step_s).tolist(), last_s] if plant.K.any() else [0.0]
            found_s = first_unstable(partial(radius_aside, plant, way), looks)
            ends_s[side] = max(ends_s[0], assumed_s - found_s) if side == 0 else min(ends_s[1], assumed_s + found_s)
    return ends_s[0], ends_s[1]
