"""Rightmost characteristic roots of a linear system with any number of constant delays.

x'(t) = sum_k A_k x(t - tau_k) is u' = D u on functions over [-tau_max, 0]. On Chebyshev points D is a matrix whose
eigenvalues approximate the roots; Newton's method on the characteristic matrix makes the rightmost ones exact. Of the
past only C x is kept, with A_k = A_k C'C for every delayed term: few numbers if inputs are few.

This approach and others are compared in D. Breda, "Methods for numerical computation of characteristic roots for delay
differential equations: experimental comparison", Scientiae Mathematicae Japonicae Online 8 (2003), 317-328.
"""

from collections.abc import Sequence
from functools import cache
from math import ceil

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import ComplexArray, FloatArray, spectral_norms
from gains.core.errors import BadModelError
from gains.core.structure import Block, balanced, distinct_blocks, square_matrices

# enough to start Newton's method: 12 points, and one more for every two radians of |s| tau
_POINTS = 12
# larger discretisations take tens of seconds
_LARGEST_MATRIX = 1500
# roots of two discretisations this close together (relative) are the same root
_SAME = 1e-6
_EPS = float(np.finfo(np.float64).eps)


def rightmost_root(terms: Sequence[tuple[ArrayLike, float]]) -> complex:
    """The root of det(sI - sum_k A_k e^{-s tau_k}) with the largest real part (1/s), imaginary part >= 0.

    `terms` are pairs (A_k, tau_k): a real matrix (n, n) in 1/s and its delay in s, zero for a term without delay.
    Raises BadModelError if `terms` is empty, the matrices are not square, finite and of one size, a delay is negative
    or not finite, or delays exceed the time constants so far that the discretisation would be too large.

    x'(t) = -x(t - tau) has the root W(-1), Lambert's function, at tau = 1 and the roots +-j at tau = pi / 2:

    >>> from math import pi
    >>> rightmost, later = (rightmost_root([([[-1]], delay_s)]) for delay_s in (1, pi / 2))
    >>> round(rightmost.real, 6), round(rightmost.imag, 6), round(later.imag, 6)
    (-0.318132, 1.337236, 1.0)
    """
    return complex(rightmost_roots(terms, 1)[0])


def rightmost_roots(terms: Sequence[tuple[ArrayLike, float]], count: int) -> ComplexArray:
    """The `count` rightmost roots (1/s) with imaginary part >= 0, from right to left; fewer if there are fewer.

    Equation, arguments and exceptions as for `rightmost_root`. A root shared by equal blocks is listed once.

    The roots of x'(t) = -x(t - 1) are the branches of Lambert's W(-1):

    >>> rightmost_roots([([[-1]], 1.0)], 3).round(3).tolist()
    [(-0.318+1.337j), (-2.062+7.589j), (-2.653+13.949j)]
    """
    try:
        delays = np.array([float(delay_s) for _, delay_s in terms])
    except (TypeError, ValueError) as error:
        raise BadModelError("terms has an entry that is no pair; pairs (matrix, delay in s) are wanted") from error
    if delays.size == 0:
        raise BadModelError("terms is empty; at least one pair (matrix, delay) is wanted")
    if not (np.isfinite(delays).all() and (delays >= 0.0).all()):
        raise BadModelError(f"terms have the delays {delays.tolist()}; finite numbers of seconds >= 0 are wanted")
    matrices = square_matrices(**{f"terms[{k}]": matrix for k, (matrix, _) in enumerate(terms)})
    roots = [root for block in distinct_blocks(*matrices) for root in _roots_of_block(block, delays, count)]
    return np.array(sorted(roots, key=lambda root: -root.real)[:count])


def _roots_of_block(block: Block, delays: FloatArray, count: int) -> list[complex]:
    matrices = np.array(balanced(*block.matrices))
    late = np.array([bool(matrix.any()) for matrix in matrices]) & (delays > 0.0)
    if not late.any():
        found = np.linalg.eigvals(matrices.sum(axis=0)).astype(np.complex128).tolist()
        return [root for root in found if root.imag >= 0.0]
    matrices = np.concatenate([matrices[~late].sum(axis=0)[np.newaxis], matrices[late]])
    delays = np.concatenate([[0.0], delays[late]])
    approximations, _ = _pseudospectral_roots(matrices, delays, count - 1)
    upper = approximations[approximations.imag >= 0.0]
    upper = upper[np.argsort(-upper.real)]
    # the rightmost approximation need not belong to the rightmost root, so all within its error band are refined
    band = _band(delays, upper[0])
    near = int(np.count_nonzero(upper.real > upper[0].real - band))
    tried = upper[: min(near, 12) if count == 1 else 2 * count + 12].tolist()
    found = [_newton(matrices, delays, root) for root in tried]
    rightmost = max(found, key=lambda root: root.real)
    if not (rightmost.real > upper[0].real - band and _is_root(matrices, delays, rightmost)):
        return _roots_among_others(matrices, delays, count)
    # farther left, approximations may be spurious, or several may belong to one root
    return found if count == 1 else _apart(matrices, delays, found)


def _roots_among_others(matrices: FloatArray, delays: FloatArray, count: int) -> list[complex]:
    """Roots of a block with weak delayed terms, where the rightmost approximation is spurious, on ever finer grids.

    Roots right of one at r oscillate no faster than the sum of |A_k| e^{-r tau_k}, which the points must resolve. Where
    terms cancel, this bound is far too high: two finer grids that find the same rightmost root are enough.
    """
    rightmost: list[complex] = []
    while True:
        approximations, points = _pseudospectral_roots(matrices, delays, count - 1, finer=2.0 ** len(rightmost))
        upper = approximations[approximations.imag >= 0.0]
        found: list[complex] = []
        for start in upper[np.argsort(-upper.real)].tolist():
            if len(found) >= count and start.real < sorted(root.real for root in found)[-count] - _band(delays, start):
                break
            found = _apart(matrices, delays, [*found, _newton(matrices, delays, start)])
        s = max(found, key=lambda root: root.real, default=complex(np.nan))
        rightmost.append(s)
        with np.errstate(over="ignore"):
            highest = _turning(matrices, np.exp(-s.real * delays))
        enough = points >= _POINTS + np.hypot(highest, s.real) * float(delays.max()) / 2.0
        if enough or (len(rightmost) > 2 and max(abs(s - other) for other in rightmost[-3:]) <= _SAME * abs(s)):
            return found


def _band(delays: FloatArray, s: complex) -> float:
    """Error band: how far left of its root an approximation may lie."""
    return 0.05 * (abs(s) + 1.0 / float(delays.max()))


def _is_root(matrices: FloatArray, delays: FloatArray, s: complex) -> bool:
    return bool(_apart(matrices, delays, [s]))


def _apart(matrices: FloatArray, delays: FloatArray, found: Sequence[complex]) -> list[complex]:
    """Those of the numbers found that are roots, without duplicates."""
    kept: list[complex] = []
    for s in found:
        terms = np.exp(-s * delays)[:, np.newaxis, np.newaxis] * matrices
        left = np.linalg.svd(s * np.eye(matrices.shape[1]) - terms.sum(axis=0), compute_uv=False)[-1]
        size = abs(s) + float(np.abs(terms).sum())
        if left <= 1e-9 * size and all(abs(s - other) > 1e-6 * size for other in kept):
            kept.append(s)
    return kept


def _turning(matrices: FloatArray, weights: FloatArray) -> float:
    """Bound on |Im s| of the roots right of a vertical line on which |e^{-s tau_k}| equals `weights`."""
    turning = (matrices[:1] - matrices[:1].swapaxes(1, 2)) / 2.0
    return float(spectral_norms(np.concatenate([turning, matrices[1:]])) @ np.append(1.0, weights[1:]))


def _pseudospectral_roots(
    matrices: FloatArray, delays: FloatArray, further: int, finer: float = 1.0
) -> tuple[ComplexArray, int]:
    """Eigenvalues of the discretised generator, whose first rows are the equation, and its number of points.

    Each of the `further` roots to the left makes one more turn over the longest delay and takes four more points.
    """
    n, longest = matrices.shape[1], float(delays.max())
    _, singular, seen = np.linalg.svd(matrices[1:].reshape(-1, n), full_matrices=False)
    seen = seen[singular > len(matrices) * n * _EPS * singular[0]]
    # bound for roots near or right of the axis
    highest = _turning(matrices, np.ones(len(delays)))
    points = finer * (_POINTS + highest * longest / 2.0 + 4.0 * further)
    if not n + len(seen) * points <= _LARGEST_MATRIX:
        raise BadModelError(
            f"the longest delay is {longest} s and a block of {n} states may oscillate at {highest:.3g} rad/s, which "
            f"takes {points:.3g} points for each of {len(seen)} late signals; at most {_LARGEST_MATRIX} are wanted"
        )
    points = ceil(points)
    nodes, derivative = _chebyshev(points)
    derivative = derivative[1:] * (2.0 / longest)
    rows = np.array([_lagrange_row(nodes, 1.0 - 2.0 * delay / longest) for delay in delays])
    acts = np.einsum("kp,kij->ipj", rows, matrices)
    late = (acts[:, 1:] @ seen.T).reshape(n, -1)
    now = (derivative[:, :1, np.newaxis] * seen).reshape(-1, n)
    past = derivative[:, np.newaxis, 1:, np.newaxis] * np.eye(len(seen))[:, np.newaxis]
    generator = np.block([[acts[:, 0], late], [now, past.reshape(len(now), -1)]])
    return np.linalg.eigvals(generator).astype(np.complex128), points


@cache
def _chebyshev(points: int) -> tuple[FloatArray, FloatArray]:
    """Chebyshev points 1 = x_0 > ... > x_N = -1 and the differentiation matrix on them.

    The diagonal is the negative sum of its row, so that a constant has derivative zero to the last bit.
    """
    k = np.arange(points + 1)
    nodes = np.cos(np.pi * k / points)
    weights = np.where((k == 0) | (k == points), 2.0, 1.0) * (-1.0) ** k
    difference = nodes[:, np.newaxis] - nodes + np.eye(points + 1)
    derivative = np.outer(weights, 1.0 / weights) / difference
    return nodes, derivative - np.diag(derivative.sum(axis=1))


def _lagrange_row(nodes: FloatArray, at: float) -> FloatArray:
    """Values at one abscissa of the Lagrange polynomials on Chebyshev points (barycentric formula)."""
    distance = at - nodes
    hit = np.abs(distance) < 1e-14
    if hit.any():
        return hit.astype(np.float64) / np.count_nonzero(hit)
    weights = (-1.0) ** np.arange(nodes.size) / distance
    weights[[0, -1]] /= 2.0
    return weights / weights.sum()


def _newton(matrices: FloatArray, delays: FloatArray, root: complex) -> complex:
    """Best iterate of Newton's method on u*M(s)v = 0, u and v the singular vectors of the least singular value of M(s).

    Its imaginary part is made >= 0. The iteration stops if it runs away from its start, as it does from a multiple root
    or a spurious approximation.
    """
    identity = np.eye(matrices.shape[1])
    best, best_value, s = root, np.inf, root
    for _ in range(20):
        factors = np.exp(-s * delays)[:, np.newaxis, np.newaxis] * matrices
        U, singular, Vh = np.linalg.svd(s * identity - factors.sum(axis=0))
        if singular[-1] < best_value:
            best, best_value = s, float(singular[-1])
        slope = U[:, -1].conj() @ (identity + np.einsum("k,kij->ij", delays, factors)) @ Vh[-1].conj()
        if slope == 0.0:
            break
        step = complex(singular[-1] / slope)
        s -= step
        if abs(step) <= 4e-16 * abs(s) or abs(s - root) > 0.1 * (abs(root) + 1.0 / float(delays.max())):
            break
    return complex(best.real, abs(best.imag))
