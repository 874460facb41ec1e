"""Delays that are multiples of one unknown: x'(t) = A_0 x(t) + A_1 x(t - tau) + ... + A_m x(t - m tau).

With lambda = e^{s tau} the characteristic matrix is a polynomial in 1/lambda. At each frequency its roots lambda are
the eigenvalues of a block companion matrix: loci like those of one delay (`_loci`). A root is on the imaginary axis
where a modulus is one, and it moves to the right if that modulus falls with the frequency, whatever the delay.

The frequencies come from `_crossings` for a single delay (m = 1), otherwise from angles: where an eigenvalue of
A(theta) = sum_k A_k e^{-j k theta} is j omega, tau = theta / omega is critical. A matrix pencil gives a finite list of
angles that contains every crossing. If it is too large or too ill-conditioned, a grid on the unit circle with
refined extrema and Newton's method finds them. Blocks of many states are left to `_tracked`.

See also E. Jarlebring, "Critical delays and polynomial eigenvalue problems", arXiv:0706.1634.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import pi

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray
from gains.core.errors import BadModelError
from gains.core.structure import Block, balanced, is_singular_for_any_delay
from gains.delay._crossings import (
    LARGEST_ALGEBRAIC_BLOCK,
    Crossing,
    DelayedTerm,
    axis_crossings,
    crossings_of_loci,
    hidden_crossings,
    polished,
    separating_points,
)
from gains.delay._loci import (
    Loci,
    UnitCrossing,
    highest_frequency,
    norm_of,
    solved_beside_poles,
    unit_crossings,
    with_extrema,
)
from gains.delay._tracked import UnclearError, at_angle, tracked_crossings
from gains.delay._windows import BlockAnalysis, block_analysis, unstable_roots, without_zero, zero_passage

# loci are eigenvalues of many companion matrices; if these are larger than this, the crossings are found by angle
_LARGEST_LOCI = 30
# limit on states times the largest multiple, where a sweep takes some seconds
_LARGEST_PRODUCT = 3000
# the pencil's companion matrix takes 0.1 s at this size; larger problems are left to the grid
_LARGEST_PENCIL = 450
# the polynomial in cos(theta) is expanded about this point, outside [-1, 1] and otherwise arbitrary
_EXPANSION = 1.3717
# grid angles on the upper half of the unit circle: at least this many, and this many per turn of the longest delay. The
# grid ends a little beyond pi to bracket a crossing at pi itself.
_ANGLES, _ANGLES_A_TURN, _PAST_HALF = 400, 40, 1.01 * pi
# Newton's method starts at grid angles whose first step is at most this many grid steps; each step doubles the digits
_REACH, _NEWTON_STEPS = 1.5, 3
# below this share of the highest frequency a root may be passing zero; angles this far (rad) to each side decide
_SLOW, _BESIDE = 1e-6, 0.05
# a local extremum of a real part is refined when its sample is this close to the axis, relative to the norm
_NEAR_AXIS = 0.1


def analyse_block(block: Block, leave_out_zero: bool) -> BlockAnalysis:
    """Analyse one block, with matrices A_0, A_1, ..., of x'(t) = sum_k A_k x(t - k tau); BadModelError if too large."""
    longest, states = len(block.matrices) - 1, len(block.matrices[0])
    if longest > 1 and longest * states > _LARGEST_PRODUCT:
        raise BadModelError(
            f"the longest delay is {longest} times their common divisor, with {states} states; "
            f"a product of at most {_LARGEST_PRODUCT} is wanted"
        )
    terms = balanced(*block.matrices)
    delayed = [DelayedTerm(matrix, 0.0, k) for k, matrix in enumerate(terms)]
    roots = np.linalg.eigvals(sum(terms[1:], terms[0])).astype(np.complex128)
    passage = zero_passage(terms, np.zeros(len(terms)), np.arange(len(terms))) if leave_out_zero else None
    if passage is None and _has_fixed_root(terms, roots):
        # a simple eigenvalue on the axis may be this far off by rounding
        unstable = int(np.count_nonzero(roots.real > 1e-13 * norm_of(terms)))
        return BlockAnalysis(block.copies, delayed, unstable=unstable, fixed_on_axis=True)
    found = _block_crossings(terms)
    found = found if passage is None else without_zero(found, passage, highest_frequency(terms))
    return block_analysis(block.copies, delayed, found, unstable_roots(roots, found, passage), passage)


def _block_crossings(terms: Sequence[FloatArray]) -> list[Crossing]:
    """Crossings of the imaginary axis of one block, omega > 0, ascending."""
    present = [k for k, matrix in enumerate(terms) if k > 0 and matrix.any()]
    if not present:
        return []
    used = tuple(terms[: present[-1] + 1])
    if len(terms[0]) > LARGEST_ALGEBRAIC_BLOCK and column_space(used[1:]).shape[1] > 1:
        try:
            tracked = tracked_crossings(used)
            return [c for c in tracked if not passes_zero(used, c.omega_rad_s * c.delay_s, c.omega_rad_s)]
        except UnclearError:
            return _crossings_by_angle(used)
    if len(present) == 1:
        # a single delay k tau: an angle of k tau modulo 2 pi corresponds to k angles of tau
        [k] = present
        return [
            replace(crossing, delay_s=(crossing.delay_s + 2.0 * pi * turn / crossing.omega_rad_s) / k)
            for crossing in axis_crossings(terms[0], terms[k])
            for turn in range(k)
        ]
    space = column_space(used[1:])
    if (len(used) - 1) * space.shape[1] > _LARGEST_LOCI:
        return _crossings_by_angle(used)

    def terms_at(omega: FloatArray) -> ComplexArray:
        return np.broadcast_to(np.array(used, dtype=np.complex128), (omega.size, len(used), *used[0].shape))

    places = np.linalg.eigvals(at_angle(used, _candidate_angles(used))).astype(np.complex128)
    return crossings_of_loci(used, companion_loci(terms_at, space), places)


def _crossings_by_angle(terms: Sequence[FloatArray]) -> list[Crossing]:
    """Crossings of one block from the n eigenvalues s of A(theta), for any number of delays.

    With theta = omega tau, a root j omega moves right with growing tau where omega d(Re s) / d theta > 0.
    """
    loci, candidates = circle_loci(terms), _candidate_angles(terms)
    counted = unit_crossings(loci, np.union1d(circle_points(terms), separating_points(candidates, _PAST_HALF)))
    crossings: list[UnitCrossing] = []
    # crossings in opposite directions at one angle are common: if all multiples are odd, all cross at a quarter turn
    for crossing in (*counted, *hidden_crossings(loci, candidates, counted)):
        theta, omega = crossing.omega, float(np.angle(crossing.locus)) * norm_of(terms)
        if passes_zero(terms, theta, abs(omega)):
            continue
        # angles beyond pi mirror these with negative frequencies; outward means that Re s falls: to the left
        turn, way = (theta, -1) if omega > 0.0 else (2.0 * pi - theta, 1)
        if theta <= pi:
            crossings.append(UnitCrossing(abs(omega), complex(np.exp(1j * turn)), way * crossing.outward))
    return polished(terms, crossings)


def _has_fixed_root(terms: Sequence[FloatArray], roots: ComplexArray) -> bool:
    """Whether some eigenvalue of sum A_k (all are in `roots`) is on the imaginary axis and a root at every delay."""
    scale = norm_of(terms)
    if scale == 0.0:
        return True
    for omega in (abs(root.imag) for root in roots.tolist() if abs(root.real) < 1e-6 * scale):
        if omega < 1e-6 * scale:
            # a defective root at zero is known only to sqrt(eps), so the singular value decides, not the eigenvalue
            if is_singular_for_any_delay(terms):
                return True
        # a determinant that vanishes at more angles than its degree vanishes at all angles; three unrelated ones are
        # checked, with a tolerance far above rounding
        else:
            matrices = 1j * omega * np.eye(terms[0].shape[0]) - at_angle(terms, np.array([0.0, 1.0, 2.5]))
            if np.linalg.svd(matrices, compute_uv=False)[:, -1].max() < 1e-12 * scale:
                return True
    return False


def companion_loci(terms_at: Callable[[FloatArray], ComplexArray], B: FloatArray) -> Loci:
    """A function from omega (k,) to all lambda (k, m r) with det(j omega I - sum_i A_i lambda^{-i}) = 0.

    The late matrices share a column space: A_i = B B'A_i with B (n, r) orthonormal. With
    G_i = B'A_i (j omega I - A_0)^{-1} B the condition is therefore det(lambda^m I - sum_i lambda^{m-i} G_i) = 0.

    `terms_at` maps frequencies (k,) to A_0, ..., A_m, shape (k, m + 1, n, n).
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


def circle_loci(terms: Sequence[FloatArray]) -> Loci:
    """A function from theta (k,) to e^{s / scale} for the eigenvalues s of A(theta); scale is the sum of the norms.

    The modulus is one on the axis. Because |s| / scale <= 1, the frequency can be read from the angle.
    """
    scale = norm_of(terms)

    def loci(theta: FloatArray) -> ComplexArray:
        return np.exp(np.linalg.eigvals(at_angle(terms, theta)) / scale).astype(np.complex128)

    return loci


def circle_points(terms: Sequence[FloatArray]) -> FloatArray:
    """Grid angles, and the angles of extrema at which a real part comes near the axis and turns back."""
    return with_extrema(circle_loci(terms), _grid_angles(terms), near=_NEAR_AXIS)


def passes_zero(terms: Sequence[FloatArray], theta: float, omega: float) -> bool:
    """Whether a root at the frequency omega >= 0 is an eigenvalue that passes s = 0, to which no finite delay belongs.

    An eigenvalue of A(theta) that passes zero is slow at this angle only; the slow motions of a loop are slow at the
    neighbouring angles too.
    """
    if omega == 0.0 or omega > _SLOW * highest_frequency(terms):
        return omega == 0.0
    beside = np.abs(np.linalg.eigvals(at_angle(terms, np.array([theta - _BESIDE, theta + _BESIDE]))))
    return bool(beside.min() > 1e3 * omega)


def _grid_angles(terms: Sequence[FloatArray]) -> FloatArray:
    return np.linspace(1e-9, _PAST_HALF, max(_ANGLES, _ANGLES_A_TURN * len(terms)))


def _candidate_angles(terms: Sequence[FloatArray]) -> FloatArray:
    """Ascending angles, one of which is near every crossing.

    A well-conditioned pencil (few multiples) misses none. Newton's method starts from each grid eigenvalue whose slope
    leads to the axis; it separates crossings that a count between neighbouring angles cannot.
    """
    grid = _grid_angles(terms)
    step = grid[1] - grid[0]
    roots, slopes = _roots_and_slopes(terms, grid)
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = -roots.real / slopes
    row, column = np.nonzero(np.abs(steps) < _REACH * step)
    theta, along = grid[row] + steps[row, column], roots[row, column].imag
    for _ in range(_NEWTON_STEPS):
        roots, slopes = _roots_and_slopes(terms, theta)
        nearest = np.argmin(np.abs(roots - 1j * along[:, np.newaxis]), axis=1)[:, np.newaxis]
        root, slope = (np.take_along_axis(part, nearest, 1)[:, 0] for part in (roots, slopes))
        with np.errstate(divide="ignore", invalid="ignore"):
            move = -root.real / slope
        theta, along = theta + np.where(np.abs(move) < step, move, 0.0), root.imag
    return np.sort(np.concatenate([_pencil_angles(terms), theta[(theta > 0.0) & (theta < _PAST_HALF)]]))


def _roots_and_slopes(terms: Sequence[FloatArray], theta: FloatArray) -> tuple[ComplexArray, FloatArray]:
    """Eigenvalues s of A(theta), shape (angles, n), and d(Re s) / d theta, huge for defective eigenvalues."""
    roots, right = np.linalg.eig(at_angle(terms, theta))
    slopes = np.real(np.einsum("tii->ti", solved_beside_poles(right, at_angle(terms, theta, 1) @ right)))
    return roots.astype(np.complex128), slopes.astype(np.float64)


def _pencil_angles(terms: Sequence[FloatArray]) -> FloatArray:
    """Angles theta in [0, pi] at which an eigenvalue of A(theta) may be imaginary; none if the pencil is too large.

    If A(theta) v = j omega v, X = v v* solves A X + X A* = 0. Write A = C - j sin(theta) D, where C = sum A_k
    cos(k theta) and D = sum A_k sin(k theta) / sin(theta) are polynomials in c = cos(theta), and X = R + j S. With
    S' = S sin(theta), the real part and sin(theta) times the imaginary part are

        C R + R C' + D S' - S' D' = 0,    C S' + S' C' - (1 - c^2) (D R - R D') = 0,

    a real polynomial eigenvalue problem in c of degree m + 1 with n^2 unknowns (R symmetric, S' skew).
    """
    n, degree = terms[0].shape[0], len(terms)
    if degree * n * n > _LARGEST_PENCIL:
        return np.empty(0)
    # values at Chebyshev nodes give the polynomial in powers of c - _EXPANSION
    nodes = np.cos(pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    values = np.array([_pencil_at(terms, c) for c in nodes.tolist()])
    powers = np.vander(nodes - _EXPANSION, increasing=True)
    coefficients = np.linalg.solve(powers, values.reshape(degree + 1, -1)).reshape(values.shape)
    size = n * n
    try:
        scaled = np.linalg.solve(coefficients[0], coefficients[1:].swapaxes(0, 1).reshape(size, degree * size))
    except np.linalg.LinAlgError:
        return np.empty(0)
    # in 1 / (c - _EXPANSION) the matrix polynomial is monic
    companion = np.zeros((degree * size, degree * size))
    companion[:size] = -scaled
    companion[size:, :-size] = np.eye((degree - 1) * size)
    inverse = np.linalg.eigvals(companion).astype(np.complex128)
    inverse = inverse[np.abs(inverse) > 1e-3]
    c = _EXPANSION + 1.0 / inverse
    # an eigenvalue of multiplicity q is known to eps^(1/q)
    near = (np.abs(c.imag) < 1e-3) & (np.abs(c.real) < 1.0 + 1e-3)
    return np.arccos(np.clip(c.real[near], -1.0, 1.0))


def _pencil_at(terms: Sequence[FloatArray], c: float) -> FloatArray:
    """The equations of `_pencil_angles` at one c: a matrix (n^2, n^2) that acts on the entries of R and S'."""
    n = terms[0].shape[0]
    theta, k, identity = float(np.arccos(c)), np.arange(len(terms)), np.eye(n)
    C = np.tensordot(np.cos(k * theta), np.array(terms), axes=1)
    D = np.tensordot(np.sin(k * theta) / np.sin(theta), np.array(terms), axes=1)
    # the maps C X + X C' and D X - X D', for X stacked row by row
    plus, minus = np.kron(C, identity) + np.kron(identity, C), np.kron(D, identity) - np.kron(identity, D)
    units = np.eye(n * n).reshape(n * n, n, n)
    upper, strict = (np.ravel_multi_index(np.triu_indices(n, above), (n, n)) for above in (0, 1))
    symmetric, skew = (units + sign * units.swapaxes(1, 2) for sign in (1.0, -1.0))
    R, S = symmetric.reshape(n * n, -1)[upper].T, skew.reshape(n * n, -1)[strict].T
    return np.block(
        [[(plus @ R)[upper], (minus @ S)[upper]], [-(1.0 - c * c) * (minus @ R)[strict], (plus @ S)[strict]]]
    )
