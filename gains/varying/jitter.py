"""Stability bounds that cover the delay of a real link: constant, slowly varying or jumping.

The margin for constant delays is exact but says nothing about varying delays; the bounds for varying delays are proved
but smaller. For an observed delay (mean, spread, rate of change) `bound_covering` tries the bounds from the least to
the most demanding and returns the first that covers it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import inf, isfinite, nan, sqrt
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from gains.core._bracketing import highest
from gains.core.arrays import ComplexArray, FloatArray, spectral_norms
from gains.core.errors import BadModelError
from gains.core.semidefinite import Unknown, positive_definite_solution
from gains.core.structure import balanced, distinct_blocks, seconds, square_matrices
from gains.delay._loci import factor_rank, highest_frequency
from gains.delay.constant import analyse_delay
from gains.varying.bounds import varying_delay_bound

Cover = Literal["constant", "rate", "spread", "any", "none"]

# numbers of frequencies at which the scaling is chosen, the gain is evaluated, and the same in a search for gains
_FREQUENCIES_SCALING, _FREQUENCIES_GAIN, _FREQUENCIES_ROUGH = 60, 4000, 600
# bisections of the gain reached by a scaling; the gain is evaluated again afterwards, so few are enough
_HALVINGS = 12
# the peak of the gain is found by a search; the true peak may be higher by this share
_GRID_ERROR = 1e-3


@dataclass(frozen=True)
class CoveringBound:
    """The bound that proves the loop stable under an observed jitter."""

    cover: Cover
    """"constant": the delay does not vary and lies in a window of the exact analysis. "rate": bounded rate of change,
    delays from 0 up to `bound_s`. "spread": variation within ±(`bound_s` - mean) of the mean, at the observed rate.
    "any": any variation from 0 up to `bound_s`. "none": no bound covers it; the loop may still be stable."""
    bound_s: float
    """The largest delay that this bound covers, nan for "none"."""


def bound_covering(A0: ArrayLike, A1: ArrayLike, *, mean_s: float, spread_s: float, rate: float) -> CoveringBound:
    """The least demanding bound that proves x'(t) = A0 x(t) + A1 x(t - tau(t)) stable under an observed jitter.

    The effective delay is within `spread_s` of `mean_s`, and |d delay / dt| is at most `rate` (s/s): inf for a delay
    that jumps from message to message, as with queued datagrams. The delay of a sampled and held loop is a sawtooth of
    rate 1 with jumps. A0 and A1 as for `gains.varying.bounds.varying_delay_bound`. BadModelError if the matrices do not
    fit, a block is too large, or the jitter is negative, not a number, or has a spread above the mean.

    x'(t) = -x(t - tau(t)) tolerates a constant delay near pi / 2, but not one that jumps:

    >>> [bound_covering([[0]], [[-1]], mean_s=1.4, spread_s=spread_s, rate=inf).cover for spread_s in (0.0, 0.15)]
    ['constant', 'none']
    """
    _check(mean_s, spread_s, rate)
    window = analyse_delay(A0, A1).window_around(mean_s)

    def bounds() -> Iterator[CoveringBound]:
        if isfinite(rate):
            yield CoveringBound("rate", varying_delay_bound(A0, A1, rate=rate))
        if window:
            yield CoveringBound("spread", mean_s + spread_bound(A0, A1, mean_s=mean_s, rate=rate))
        yield CoveringBound("any", varying_delay_bound(A0, A1, rate=inf))

    uncovered = CoveringBound("none", nan)
    if spread_s == 0.0:
        return CoveringBound("constant", window[1]) if window else uncovered
    return next((bound for bound in bounds() if mean_s + spread_s <= bound.bound_s), uncovered)


def spread_bound(A0: ArrayLike, A1: ArrayLike, *, mean_s: float, rate: float = inf, scaled: bool = True) -> float:
    """The spread (s) that the loop tolerates on both sides of a constant delay, however the delay varies within it.

    A0 and A1 are real matrices (n, n) in 1/s. `rate` is the largest tau'(t), inf if the delay may jump upwards. Jumps
    downwards do not count, so the sawtooth of a sampled and held loop has rate 1. The result is at most the mean, and 0
    if the loop is unstable at the mean delay. BadModelError if the matrices do not fit, the mean is negative or not
    finite, or the rate is negative.

    With A1 = B C and G(s) = C s (sI - A0 - A1 e^{-s mean})^{-1} B the loop is stable for a spread below 1 / (g max over
    omega of ||D G(j omega) D^{-1}||), for any D; g = 1 if the rate is at most 1, else sqrt(7/4) (proof in
    docs/explanation/delay-margin.md). The maximum is searched on a fine grid and refined, with a part in a thousand
    allowed for what is missed: a search, not a proof. If `scaled` is False, D = I and the grid is coarse, as a search
    needs it.

    About 0.5 s, x'(t) = -x(t - tau(t)) has |omega / (j omega + e^{-j omega / 2})| of at most 1.59:

    >>> [round(spread_bound([[0]], [[-1]], mean_s=0.5, rate=rate), 2) for rate in (1.0, inf)]
    [0.5, 0.47]
    """
    _check(mean_s, 0.0, rate)
    if analyse_delay(A0, A1).window_around(mean_s) is None:
        return 0.0
    gain = 1.0 if rate <= 1.0 else sqrt(7.0 / 4.0)
    blocks = distinct_blocks(*square_matrices(A0=A0, A1=A1))
    admitted_s = min(_spread_of_block(balanced(*block.matrices), mean_s, scaled=scaled) for block in blocks) / gain
    return min(admitted_s, mean_s)


def _check(mean_s: float, spread_s: float, rate: float) -> None:
    seconds("mean_s", mean_s)
    if not 0.0 <= spread_s <= mean_s:
        raise BadModelError(f"spread_s is {spread_s}; 0 to the mean delay of {mean_s} s is wanted")
    if not rate >= 0.0:
        raise BadModelError(f"rate is {rate}; a number >= 0 is wanted, inf for jumps")


def _spread_of_block(matrices: tuple[FloatArray, ...], mean_s: float, *, scaled: bool) -> float:
    """The reciprocal of the block's largest gain about the mean delay."""
    now, late = matrices
    B, C = factor_rank(late)
    r = B.shape[1]
    if r == 0:
        return inf
    top = highest_frequency((now, late))
    coarse = top * np.logspace(-3.0, 2.0, _FREQUENCIES_SCALING)
    D = _scaling(_loop_gains(now, late, B, C, mean_s, coarse)) if scaled and r > 1 else np.eye(r)
    count = _FREQUENCIES_GAIN if scaled else _FREQUENCIES_ROUGH
    fine = np.union1d(top * np.logspace(-4.0, 3.0, count), np.linspace(0.0, top, count))
    inverse = np.linalg.inv(D)

    def gain(omega: FloatArray) -> FloatArray:
        return spectral_norms(D @ _loop_gains(now, late, B, C, mean_s, omega) @ inverse)

    # near the margin a peak is far narrower than the grid; at high frequencies the gain tends to that of C B
    largest = max(highest(gain, fine)[1], float(np.linalg.norm(D @ C @ B @ inverse, 2)))
    return 1.0 / (largest * (1.0 + _GRID_ERROR))


def _loop_gains(
    now: FloatArray, late: FloatArray, B: FloatArray, C: FloatArray, mean_s: float, omega: FloatArray
) -> ComplexArray:
    s = 1j * omega[:, np.newaxis, np.newaxis]
    characteristic = s * np.eye(now.shape[0]) - now - late * np.exp(-s * mean_s)
    return C @ np.linalg.solve(characteristic, s * B)


def _scaling(loops: ComplexArray) -> FloatArray:
    """D that makes the largest ||D G D^{-1}|| over the given loops nearly as small as possible."""
    r = loops.shape[1]
    # a complex Hermitian matrix is positive definite if its real form, of twice the size, is
    real = np.concatenate(
        [np.concatenate([loops.real, -loops.imag], axis=2), np.concatenate([loops.imag, loops.real], axis=2)], axis=1
    )
    upper = float(spectral_norms(loops).max())
    lower = float(np.abs(np.linalg.eigvals(loops)).max())
    best = np.eye(r)
    for _ in range(_HALVINGS):
        gain = (lower + upper) / 2.0
        P = _scaling_for(real, gain)
        if P is None:
            lower = gain
        else:
            upper, best = gain, np.linalg.cholesky(P).T.astype(np.float64)
    return best


def _scaling_for(real: FloatArray, gain: float) -> FloatArray | None:
    """P > 0 with G*PG < gain^2 P for all loops in their real form (k, 2r, 2r), None if none is found."""
    both = np.eye(2)

    def inequalities(unknowns: Sequence[FloatArray]) -> list[FloatArray]:
        twice = np.kron(both, unknowns[0])
        return [unknowns[0], *(gain * gain * twice - real.swapaxes(1, 2) @ twice @ real)]

    found = positive_definite_solution([Unknown(real.shape[1] // 2)], inequalities)
    return None if found is None else found[0]
