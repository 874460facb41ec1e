"""Stability bounds for a varying delay tau(t) in x'(t) = A0 x(t) + A1 x(t - tau(t)).

No exact bound is known. `varying_delay_bound` proves a smaller one, which never exceeds the margin for constant delays:

* |tau'| <= mu, 0 <= tau(t) <= h: a Lyapunov-Krasovskii functional and Wirtinger's inequality. A. Seuret and
  F. Gouaisbaut, "Wirtinger-based integral inequality: application to time-delay systems", Automatica 49(9), 2013,
  whose published bounds this reproduces.
* Any variation: the small-gain theorem for v(t) = x(t) - x(t - tau(t)), the integral of x' over the delay, whose gain
  from x' is at most h.

For a delay that stays near its mean, `gains.varying.jitter` may prove more.
"""

from collections.abc import Callable, Sequence
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.core.semidefinite import Unknown, positive_definite_solution
from gains.core.structure import balanced, distinct_blocks, is_number, shown, square_matrices
from gains.delay._loci import factor_rank
from gains.delay.constant import delay_margin

# bisection stops at this relative accuracy
_ACCURACY = 1e-4
# upper end of the bisection, in time constants 1 / (||A0|| + ||A1||), unless the margin for constant delays is less
_LONGEST = 1e3
# states of one block; the number of unknowns grows with the square and the work with the sixth power
_LARGEST_BLOCK = 8


def varying_delay_bound(A0: ArrayLike, A1: ArrayLike, *, rate: float) -> float:
    """A delay h (s) such that the loop is stable for every tau(t) in [0, h] with |tau'(t)| <= `rate`.

    An infinite `rate` admits any variation, jumps included; the result is then the better of the small-gain bound and
    of a functional that does not use the rate. `inf` if a functional proves stability at any length of delay, 0 if the
    loop is unstable without delay. The functional found at the bound proves every shorter delay too. Finite bounds are
    sought up to 1000 / (||A0|| + ||A1||). A0 and A1 are real matrices (n, n) in 1/s with up to 8 states in a strongly
    connected block, `rate` is mu >= 0; BadModelError otherwise.

    For this loop the 2013 paper gives 6.059 s for a constant delay; the exact margin is 6.1726 s:

    >>> round(varying_delay_bound([[-2, 0], [0, -0.9]], [[-1, 0], [-1, -1]], rate=0.0), 2)
    6.06
    """
    if not (is_number(rate) and rate >= 0.0):
        raise BadModelError(f"rate is {shown(rate)}; a number >= 0 is wanted, inf for any variation")
    blocks = distinct_blocks(*square_matrices(A0=A0, A1=A1))
    largest = max(len(block.matrices[0]) for block in blocks)
    if largest > _LARGEST_BLOCK:
        raise BadModelError(
            f"the loop has a strongly connected block of {largest} states; at most {_LARGEST_BLOCK} are wanted"
        )
    bounds_s: list[float] = []
    for block in blocks:
        now, late = balanced(*block.matrices)
        # scale time so that the numbers are near one
        unit = float(np.linalg.norm(now) + np.linalg.norm(late)) or 1.0
        bounds_s.append(_varying_bound_of_block(now / unit, late / unit, rate) / unit)
    return min(bounds_s)


def _bisected(proved: Callable[[float], bool], upper: float) -> float:
    """The largest number up to `upper`, to a part in 10^4, at which `proved` holds; 0 if none is found."""
    if upper <= 0.0:
        return 0.0
    if proved(upper):
        return upper
    lower, step = 0.0, upper
    while lower == 0.0 and step > 1e-6 * upper:
        step /= 2.0
        lower = step if proved(step) else 0.0
    higher = min(2.0 * lower, upper)
    while lower > 0.0 and higher - lower > _ACCURACY * lower:
        middle = (lower + higher) / 2.0
        lower, higher = (middle, higher) if proved(middle) else (lower, middle)
    return lower


def _varying_bound_of_block(now: FloatArray, late: FloatArray, rate: float) -> float:
    margin_s = delay_margin(now, late)
    if not late.any():
        return margin_s
    upper = min(margin_s, _LONGEST)
    if upper > 0.0 and _is_independent_of_length(now, late, rate):
        return inf
    bound_s = _bisected(lambda delay_s: _varying_functional_exists(now, late, delay_s, rate), upper)
    return max(bound_s, _small_gain_of_block(now, late, upper)) if rate == inf else bound_s


def _he(matrix: FloatArray) -> FloatArray:
    return matrix + matrix.T


def _is_independent_of_length(now: FloatArray, late: FloatArray, rate: float) -> bool:
    """Whether V = x'Px + int over the delay of x'Qx proves stability for |tau'| <= rate < 1 at any length of delay.

    The condition is -[[A0'P + P A0 + Q, P A1], [A1'P, -(1 - mu) Q]] > 0.
    """
    if rate >= 1.0:
        return False
    n = now.shape[0]

    def inequalities(unknowns: Sequence[FloatArray]) -> Sequence[FloatArray]:
        P, Q = unknowns
        corner = P @ late
        return [-np.block([[_he(P @ now) + Q, corner], [corner.T, -(1.0 - rate) * Q]]), P, Q]

    return positive_definite_solution([Unknown(n), Unknown(n)], inequalities) is not None


def _varying_functional_exists(now: FloatArray, late: FloatArray, h: float, rate: float) -> bool:
    """Whether the inequalities of Seuret and Gouaisbaut 2013 hold for 0 <= tau <= h, |tau'| <= rate.

    V = z'Pz + int_{t-tau}^t x'Qx + int_{t-h}^t x'Sx + h int int x''R x', z = (x, int_{t-tau}^t x, int_{t-h}^{t-tau} x).
    For an infinite rate Q = 0 and z = (x, int_{t-h}^t x), so that tau' does not appear. The derivative of V is a
    quadratic form in (x(t), x(t-tau), x(t-h), and the means of x over the two parts), affine in tau and tau', so the
    corners of their range suffice. The reciprocally convex X joins the two integrals of R.
    """
    n = now.shape[0]
    x, x_tau, x_h, mean_1, mean_2 = (np.eye(5 * n)[k * n : (k + 1) * n] for k in range(5))
    speed = now @ x + late @ x_tau
    near = np.vstack([x - x_tau, x + x_tau - 2.0 * mean_1])
    far = np.vstack([x_tau - x_h, x_tau + x_h - 2.0 * mean_2])
    both = np.vstack([near, far])
    any_rate = rate == inf
    rates = (0.0,) if any_rate or rate == 0.0 else (-rate, rate)

    def inequalities(unknowns: Sequence[FloatArray]) -> Sequence[FloatArray]:
        P, S, R, X = unknowns[:4]
        # the parts of the integral of R that come from Jensen's and Wirtinger's inequalities
        weight = np.kron(np.diag([1.0, 3.0]), R)
        joint = np.block([[weight, X], [X.T, weight]])
        results: list[FloatArray] = [P, S, R, joint.astype(np.float64)]
        if not any_rate:
            results.append(unknowns[4])
        for tau in (0.0, h):
            for slope in rates:
                state = np.vstack([x, tau * mean_1, (h - tau) * mean_2])
                change = np.vstack([speed, x - (1.0 - slope) * x_tau, (1.0 - slope) * x_tau - x_h])
                if any_rate:
                    state = np.vstack([x, tau * mean_1 + (h - tau) * mean_2])
                    change = np.vstack([speed, x - x_h])
                derivative = _he(state.T @ P @ change) + x.T @ S @ x - x_h.T @ S @ x_h
                derivative += h * h * speed.T @ R @ speed - both.T @ joint @ both
                if not any_rate:
                    Q = unknowns[4]
                    derivative += x.T @ Q @ x - (1.0 - slope) * x_tau.T @ Q @ x_tau
                results.append(-derivative)
        return results

    shapes = [Unknown((2 if any_rate else 3) * n), Unknown(n), Unknown(n), Unknown(2 * n, 2 * n)]
    return positive_definite_solution(shapes if any_rate else [*shapes, Unknown(n)], inequalities) is not None


def _small_gain_of_block(now: FloatArray, late: FloatArray, upper: float) -> float:
    """A delay h up to `upper` such that the block is stable for every tau(t) in [0, h] with any variation.

    h = 1 / min over D of max over omega of ||D C j omega (j omega I - A0 - A1)^{-1} B D^{-1}||, A1 = B C of full rank;
    D is a full matrix because the delay acts on all signals alike. The bounded real lemma with the unknown P = D'D
    finds and proves the minimum.
    """
    total, (B, C) = now + late, factor_rank(late)
    n, r = B.shape
    outputs = C @ np.hstack([total, B])

    def proved(h: float) -> bool:
        """Bounded real lemma for sqrt(P) C s (sI - A)^{-1} B sqrt(P)^{-1} with the bound 1/h."""

        def inequalities(unknowns: Sequence[FloatArray]) -> Sequence[FloatArray]:
            X, P = unknowns
            storage = np.block([[_he(X @ total), X @ B], [B.T @ X, -P]])
            return [-(storage + h * h * outputs.T @ P @ outputs), P]

        return positive_definite_solution([Unknown(n), Unknown(r)], inequalities) is not None

    return _bisected(proved, upper)
