"""Exact delay margin and stability windows of a linear loop x'(t) = A0 x(t) + A1 x(t - tau), without a grid.

The roots of det(sI - A0 - A1 e^{-s tau}) move continuously with tau and change half plane only through the imaginary
axis. `_crossings` finds the crossings, `_windows` counts them; strongly connected blocks are analysed one by one, see
`gains.core.structure`. A single delay is the simplest case of `_commensurate`, which handles tau, 2 tau, ...

Methods of this kind are compared in E. Jarlebring and M. E. Hochstenbach, "Polynomial two-parameter eigenvalue
problems and matrix pencil methods for stability of delay-differential equations", arXiv:0809.3634.
"""

from numpy.typing import ArrayLike

from gains.core.errors import BadModelError
from gains.core.structure import distinct_blocks, is_number, shown, square_matrices
from gains.delay._commensurate import analyse_block
from gains.delay._crossings import Crossing
from gains.delay._windows import DelayAnalysis, combined_analysis, first_critical_delay_s

__all__ = ["Crossing", "DelayAnalysis", "analyse_delay", "delay_margin"]


def analyse_delay(
    A0: ArrayLike, A1: ArrayLike, *further: ArrayLike, horizon_s: float | None = None, leave_out_zero: bool = False
) -> DelayAnalysis:
    """Stability windows, critical delays and delay margin of x'(t) = A0 x(t) + A1 x(t - tau) + A2 x(t - 2 tau) + ...

    A0, A1 and the `further` A2, A3, ... are real matrices (n, n) in 1/s. All windows are listed (there are finitely
    many), or with `horizon_s` only those that begin before this delay.

    A loop with a root that stays on the imaginary axis at every delay is never asymptotically stable: no window,
    margin 0. If the sum of the matrices is singular, s = 0 is such a root. If it is merely the common value of a
    consensus, set `leave_out_zero`, which judges a block with a simple root at s = 0 by its other roots, or remove the
    states on which nothing acts with `gains.core.structure.without_fixed_roots`.

    Raises BadModelError unless the matrices are square, finite, of one size and not too many, and the horizon positive;
    DisagreementError if crossings and eigenvalues contradict each other (a loop at the limit of double precision).

    x'' - 0.1 x' + 2 x = x(t - tau) is stable for delays between 0.1 s and 1.7 s only:

    >>> found = analyse_delay([[0, 1], [-2, 0.1]], [[0, 0], [1, 0]])
    >>> [(round(start_s, 4), round(end_s, 4)) for start_s, end_s in found.stable_intervals_s]
    [(0.1002, 1.7179)]
    """
    blocks = distinct_blocks(*square_matrices(**{f"A{k}": matrix for k, matrix in enumerate((A0, A1, *further))}))
    if horizon_s is not None and not (is_number(horizon_s) and horizon_s > 0.0):
        raise BadModelError(f"horizon_s is {shown(horizon_s)}; a positive number of seconds is wanted")
    return combined_analysis([analyse_block(block, leave_out_zero) for block in blocks], horizon_s)


def delay_margin(A0: ArrayLike, A1: ArrayLike) -> float:
    """The least delay (s) at which x'(t) = A0 x(t) + A1 x(t - tau) loses stability.

    `inf` if no delay does, 0 if the loop is unstable without delay. Arguments and exceptions as for `analyse_delay`.

    >>> round(delay_margin([[0]], [[-1]]), 6)  # x'(t) = -x(t - tau): pi / 2
    1.570796
    """
    blocks = distinct_blocks(*square_matrices(A0=A0, A1=A1))
    return first_critical_delay_s([analyse_block(block, leave_out_zero=False) for block in blocks])
