"""Several delays that are multiples of one unknown: x'(t) = A_0 x(t) + A_1 x(t - tau) + ... + A_m x(t - m tau).

With lambda = e^{s tau} the characteristic matrix is a polynomial in 1/lambda. At each frequency the equation
det(j omega I - sum_k A_k lambda^{-k}) = 0 therefore has finitely many solutions, the eigenvalues of a block companion
matrix. They are loci like those of one delay (`_loci`): a root is on the imaginary axis where a modulus is one, and it
moves to the right where that modulus falls with the frequency, whatever the delay. The frequencies come from a pencil
and from Newton's method along the unit circle (`_circle_angles`) or, for a single delay (m = 1), from `_crossings`.

See also E. Jarlebring, "Critical delays and polynomial eigenvalue problems", arXiv:0706.1634, for the same problem as a
polynomial eigenvalue problem.
"""

from collections.abc import Callable, Sequence
from math import pi

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import ComplexArray, FloatArray
from gains.core.errors import BadModelError
from gains.core.structure import Block, balanced, distinct_blocks, is_singular_for_any_delay, square_matrices
from gains.delay._circle_angles import (
    PAST_HALF,
    at_angle,
    candidate_angles,
    circle_loci,
    circle_points,
    norm_of,
    passes_zero,
)
from gains.delay._crossings import (
    AxisCrossing,
    DelayedTerm,
    axis_crossings,
    crossings_of_loci,
    hidden_crossings,
    is_root,
    polish,
    separating_points,
)
from gains.delay._loci import Loci, UnitCrossing, highest_frequency, solved_beside_poles, unit_crossings
from gains.delay._windows import (
    BlockAnalysis,
    DelayAnalysis,
    block_analysis,
    check_horizon,
    combined_analysis,
    unstable_roots,
    zero_passage,
)

# loci are eigenvalues of many companion matrices; beyond this size of them angles are followed instead
_LARGEST_LOCI = 30
# states times the largest multiple: a sweep takes some seconds there
_LARGEST_PRODUCT = 3000
# candidates are kept this close to the imaginary axis, relative to the norm; a false one costs little
_CANDIDATE_TOLERANCE = 1e-3


def analyse_commensurate(
    matrices: Sequence[ArrayLike], *, horizon_s: float | None = None, leave_out_zero: bool = False
) -> DelayAnalysis:
    """Stability windows, critical delays and margin in tau of x'(t) = sum_k A_k x(t - k tau).

    Parameters
    ----------
    matrices
        A_0, A_1, ..., A_m, real (n, n), 1/s; A_k acts k tau late.
    horizon_s, leave_out_zero
        As of `gains.delay.constant.analyse_delay`.

    Raises
    ------
    BadModelError
        No matrix, matrices that are not square, finite and of one size, m n too large, or a horizon that is not a
        positive number.
    DisagreementError
        Crossings and eigenvalues contradict each other (a loop at the limit of double precision).

    Examples
    --------
    x'(t) = -x(t - tau) - x(t - 2 tau) is stable up to tau = pi / (3 sqrt(3)), where it oscillates at sqrt(3) rad/s:

    >>> from gains.delay._commensurate import analyse_commensurate
    >>> found = analyse_commensurate([[[0]], [[-1]], [[-1]]])
    >>> round(found.delay_margin_s, 6), round(found.crossings[0].omega_rad_s, 6)
    (0.6046, 1.732051)
    """
    check_horizon(horizon_s)
    blocks = distinct_blocks(*_checked(matrices))
    return combined_analysis([analyse_block(block, leave_out_zero) for block in blocks], horizon_s)


def analyse_block(block: Block, leave_out_zero: bool) -> BlockAnalysis:
    """One block of x'(t) = sum_k A_k x(t - k tau), its matrices being A_0, A_1, ..."""
    terms = balanced(*block.matrices)
    delayed = [DelayedTerm(matrix, 0.0, k) for k, matrix in enumerate(terms)]
    roots = np.linalg.eigvals(sum(terms, np.zeros_like(terms[0]))).astype(np.complex128)
    passage = zero_passage(terms, np.zeros(len(terms)), np.arange(len(terms))) if leave_out_zero else None
    if passage is None and _has_fixed_root(terms, roots):
        # a simple eigenvalue on the axis may be this far off by rounding
        unstable = int(np.count_nonzero(roots.real > 1e-13 * norm_of(terms)))
        return BlockAnalysis(block.copies, delayed, unstable=unstable, fixed_on_axis=True)
    found = _block_crossings(terms)
    unstable = unstable_roots(roots, found, passage)
    return block_analysis(block.copies, delayed, found, unstable, passage, highest_frequency(terms))


def _block_crossings(terms: Sequence[FloatArray]) -> list[AxisCrossing]:
    """Crossings of the imaginary axis of one block, omega > 0, ascending; theta = omega tau modulo 2 pi."""
    present = [k for k, matrix in enumerate(terms) if k > 0 and matrix.any()]
    if not present:
        return []
    if len(present) == 1:
        # one delay of k tau: its angle modulo 2 pi belongs to k angles of tau
        [k] = present
        return [
            AxisCrossing(crossing.omega, (crossing.theta + 2.0 * pi * turn) / k, crossing.direction)
            for crossing in axis_crossings(terms[0], terms[k])
            for turn in range(k)
        ]
    used = tuple(terms[: present[-1] + 1])
    highest = highest_frequency(used)
    if (len(used) - 1) * column_space(used[1:]).shape[1] > _LARGEST_LOCI:
        return _crossings_by_angle(used)

    def terms_at(omega: FloatArray) -> ComplexArray:
        return np.broadcast_to(np.array(used, dtype=np.complex128), (omega.size, len(used), *used[0].shape))

    loci = companion_loci(terms_at, column_space(used[1:]))
    found = crossings_of_loci(loci, _candidates(used, highest), highest)
    polished = [polish(used, crossing) for crossing in found if is_root(used, crossing)]
    return sorted(polished, key=lambda crossing: crossing.omega)


def _crossings_by_angle(terms: Sequence[FloatArray]) -> list[AxisCrossing]:
    """The same from the n eigenvalues s of A(theta), however many delays there are.

    With theta = omega tau, a root j omega moves right with growing tau where omega d(Re s) / d theta > 0.
    """
    loci, candidates = circle_loci(terms), candidate_angles(terms)
    counted = unit_crossings(loci, np.union1d(circle_points(terms), separating_points(candidates, PAST_HALF)))
    crossings: list[AxisCrossing] = []
    # opposite crossings at one angle are common: if all multiples are odd, all roots cross at a quarter turn
    for crossing in (*counted, *hidden_crossings(loci, candidates, counted)):
        theta, omega = crossing.omega, float(np.angle(crossing.locus)) * norm_of(terms)
        if passes_zero(terms, theta, abs(omega)):
            continue
        # angles beyond pi mirror these, with negative frequencies; outward means falling, to the left
        turn, way = (theta, -1) if omega > 0.0 else (2.0 * pi - theta, 1)
        if theta <= pi:
            locus = UnitCrossing(abs(omega), complex(np.exp(1j * turn)), way * crossing.outward)
            crossings.append(polish(terms, locus))
    return sorted(crossings, key=lambda crossing: crossing.omega)


def _has_fixed_root(terms: Sequence[FloatArray], roots: ComplexArray) -> bool:
    """Whether an eigenvalue on the imaginary axis of sum A_k (all of them: `roots`) is a root at every delay."""
    scale = norm_of(terms)
    if scale == 0.0:
        return True
    for root in roots[np.abs(roots.real) < 1e-6 * scale]:
        omega = abs(float(root.imag))
        if omega < 1e-6 * scale:
            # a defective root at zero is known to sqrt(eps) only: the singular value decides, not the eigenvalue
            if is_singular_for_any_delay(terms):
                return True
        # a determinant that vanishes at more angles than its degree vanishes at all; three unrelated angles stand for
        # them, with a tolerance far above rounding
        elif all(_least_singular(terms, omega, theta) < 1e-12 * scale for theta in (0.0, 1.0, 2.5)):
            return True
    return False


def _checked(matrices: Sequence[ArrayLike]) -> list[FloatArray]:
    if len(matrices) == 0:
        raise BadModelError("matrices is empty; at least A_0 is wanted")
    checked = square_matrices(**{f"matrices[{k}]": matrix for k, matrix in enumerate(matrices)})
    size = checked[0].shape[0] * (len(checked) - 1)
    if len(checked) > 2 and size > _LARGEST_PRODUCT:
        raise BadModelError(
            f"the longest delay is {len(checked) - 1} times their common divisor, with {checked[0].shape[0]} states; "
            f"a product of at most {_LARGEST_PRODUCT} is wanted"
        )
    return checked


def _least_singular(terms: Sequence[FloatArray], omega: float, theta: float) -> float:
    matrix = 1j * omega * np.eye(terms[0].shape[0]) - at_angle(terms, np.array([theta]))[0]
    return float(np.linalg.svd(matrix, compute_uv=False)[-1])


def companion_loci(terms_at: Callable[[FloatArray], ComplexArray], B: FloatArray) -> Loci:
    """The function omega (k,) -> all lambda (k, m r) with det(j omega I - sum_i A_i lambda^{-i}) = 0.

    The late matrices share their column space, A_i = B B'A_i with B (n, r) orthonormal, so that with
    G_i = B'A_i (j omega I - A_0)^{-1} B the condition is det(lambda^m I - sum_i lambda^{m-i} G_i) = 0.

    `terms_at` takes frequencies (k,) to A_0, ..., A_m, shape (k, m + 1, n, n).
    """
    n, rank = B.shape
    identity = np.eye(n)

    def loci(omega: FloatArray) -> ComplexArray:
        terms = terms_at(omega)
        degree = terms.shape[1] - 1
        resolvent = 1j * omega[:, np.newaxis, np.newaxis] * identity - terms[:, 0]
        loops = B.T @ terms[:, 1:] @ solved_beside_poles(resolvent, B)[:, np.newaxis]
        companion = np.zeros((omega.size, degree * rank, degree * rank), dtype=np.complex128)
        companion[:, :rank] = loops.swapaxes(1, 2).reshape(omega.size, rank, degree * rank)
        companion[:, rank:, :-rank] = np.eye((degree - 1) * rank)
        return np.linalg.eigvals(companion).astype(np.complex128)

    return loci


def column_space(late: Sequence[FloatArray]) -> FloatArray:
    """Orthonormal basis (n, r) of the sum of the column spaces of the matrices."""
    beside = np.hstack(late)
    U, singular, _ = np.linalg.svd(beside, full_matrices=False)
    return U[:, : int(np.count_nonzero(singular > beside.shape[1] * np.finfo(float).eps * singular[0]))]


def _candidates(terms: Sequence[FloatArray], highest: float) -> FloatArray:
    """Frequencies that come near every crossing, ascending."""
    theta = candidate_angles(terms)
    if theta.size == 0:
        return np.empty(0)
    roots = np.linalg.eigvals(at_angle(terms, theta))
    near_axis = np.abs(roots.real) <= _CANDIDATE_TOLERANCE * (highest + np.abs(roots))
    omega = np.unique(np.abs(roots.imag[near_axis]))
    return omega[(omega > 0.0) & (omega < 1.1 * highest)]
