"""Several delays that are multiples of one unknown: x'(t) = A_0 x(t) + A_1 x(t - tau) + ... + A_m x(t - m tau).

With lambda = e^{s tau} the characteristic matrix is a polynomial in 1/lambda, so at each frequency there are finitely
many lambda with det(j omega I - sum_k A_k lambda^{-k}) = 0: the eigenvalues of a block companion matrix. They are loci
as those of one delay (`gains.delay_loci`): a root is on the imaginary axis where a modulus is one, and it goes right
where that modulus falls with the frequency, whatever the delay. Everything else is as with one delay.

The frequencies come from a pencil, see `_pencil_angles`. A sweep along the unit circle, which shares no algebra
with it, is the second opinion.

See also E. Jarlebring, "Critical delays and polynomial eigenvalue problems", arXiv:0706.1634, for the same problem as a
polynomial eigenvalue problem.
"""

from collections.abc import Callable, Sequence
from math import inf, pi

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gains.delay import Crossing, DelayAnalysis, check_horizon, stability_windows
from gains.delay_crossings import AxisCrossing, axis_crossings, crossings_of_loci, polish
from gains.delay_loci import ComplexArray, Loci, unit_crossings
from gains.delay_sweep import near_unit_extrema
from gains.errors import BadModelError
from gains.structure import FloatArray, balanced, distinct_blocks, is_singular_for_any_delay, square_matrices

# the pencil's companion matrix takes 3 s at this size; larger ones leave the frequencies to the sweep
_LARGEST_PENCIL = 1200
# a locus is an eigenvalue of a companion matrix of this size at most
_LARGEST_COMPANION = 200
# where the polynomial in cos(theta) is expanded: off [-1, 1], and no special angle
_EXPANSION = 1.3717
# a candidate is kept when it is this close to the imaginary axis, relative to the norm; a false one costs little
_CANDIDATE_TOLERANCE = 1e-3
# angles of the sweep along the upper half of the unit circle
_ANGLES = 400
# a local extremum of a real part is refined when its sample is this close to the axis, relative to the norm
_NEAR_AXIS = 0.1
# and is on the axis when it is this close to it
_ON_AXIS = 1e-9
# below this share of the highest frequency a crossing may be that of a root that passes zero, seen so far beside it
_SLOW, _BESIDE = 1e-6, 0.05


def analyse_commensurate(matrices: Sequence[ArrayLike], *, horizon_s: float | None = None) -> DelayAnalysis:
    """Stability windows, critical delays and margin in tau of x'(t) = sum_k A_k x(t - k tau).

    Parameters
    ----------
    matrices
        A_0, A_1, ..., A_m, real (n, n), 1/s; A_k acts k tau late.
    horizon_s
        As of `gains.delay.analyse_delay`.

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

    >>> from gains.commensurate import analyse_commensurate
    >>> found = analyse_commensurate([[[0]], [[-1]], [[-1]]])
    >>> round(found.delay_margin_s, 6), round(found.crossings[0].omega_rad_s, 6)
    (0.6046, 1.732051)
    """
    check_horizon(horizon_s)
    crossings: list[Crossing] = []
    unstable, fixed_on_axis = 0, False
    for block in distinct_blocks(*_checked(matrices)):
        terms = balanced(*block.matrices)
        roots = np.linalg.eigvals(sum(terms, np.zeros_like(terms[0]))).astype(np.complex128)
        if has_fixed_root(terms, roots):
            fixed_on_axis = True
            continue
        found = block_crossings(terms)
        crossings += [Crossing(c.omega, c.theta / c.omega, c.direction, 2 * block.copies) for c in found]
        unstable += block.copies * _unstable_roots(roots, found)
    crossings.sort(key=lambda crossing: (crossing.delay_s, crossing.omega_rad_s))
    intervals, complete_to_s = ((), inf) if fixed_on_axis else stability_windows(crossings, unstable, horizon_s)
    margin_s = next((end_s for start_s, end_s in intervals if start_s == 0.0), 0.0)
    return DelayAnalysis(
        stable_intervals_s=intervals,
        delay_margin_s=margin_s,
        delay_independent=margin_s == inf,
        crossings=tuple(crossings),
        unstable_roots_at_zero_delay=unstable,
        complete_to_s=complete_to_s,
    )


def circle_sweep_margin(matrices: Sequence[ArrayLike]) -> float:
    """The delay margin of `analyse_commensurate` by a sweep along the unit circle: a second opinion.

    The eigenvalues s of A(theta) = sum_k A_k e^{-j k theta} on a grid of angles; where one crosses the imaginary axis
    at j omega, tau = theta / omega is critical. Sorted real parts are continuous in the angle, so crossings are
    bracketed, and local extrema near zero are refined. It is a search, not a proof. 0 if the loop is unstable without
    delay, `inf` if no crossing is found. Arguments and exceptions as of `analyse_commensurate`.

    Examples
    --------
    The margin pi / (3 sqrt(3)) of x'(t) = -x(t - tau) - x(t - 2 tau):

    >>> from gains.commensurate import circle_sweep_margin
    >>> round(circle_sweep_margin([[[0]], [[-1]], [[-1]]]), 6)
    0.6046
    """
    blocks = distinct_blocks(*_checked(matrices))
    return min(_circle_margin(balanced(*block.matrices)) for block in blocks)


def block_crossings(terms: Sequence[FloatArray]) -> list[AxisCrossing]:
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

    def terms_at(omega: FloatArray) -> ComplexArray:
        return np.broadcast_to(np.array(used, dtype=np.complex128), (omega.size, len(used), *used[0].shape))

    loci = companion_loci(terms_at, column_space(used[1:]))
    found = crossings_of_loci(loci, _candidates(used, highest), highest)
    return sorted((polish(used, crossing) for crossing in found), key=lambda crossing: crossing.omega)


def highest_frequency(terms: Sequence[FloatArray]) -> float:
    """Bound (rad/s) of every root on the imaginary axis, whatever the delays; terms[0] acts at once."""
    turning = float(np.linalg.norm(terms[0] - terms[0].T)) / 2.0
    return turning + float(sum(np.linalg.norm(matrix) for matrix in terms[1:]))


def has_fixed_root(terms: Sequence[FloatArray], roots: ComplexArray) -> bool:
    """Whether an eigenvalue on the imaginary axis of sum A_k (all of them: `roots`) is a root at every delay."""
    scale = float(sum(np.linalg.norm(matrix) for matrix in terms))
    if scale == 0.0:
        return True
    for root in roots[np.abs(roots.real) < 1e-6 * scale]:
        omega = abs(float(root.imag))
        if omega < 1e-6 * scale:
            # a defective root at zero is known to sqrt(eps) only: the singular value decides, not the eigenvalue
            if is_singular_for_any_delay(terms):
                return True
        # a determinant that vanishes at more points of the circle than its degree vanishes identically; 3 unlike
        # angles stand for them, the tolerance being far above rounding
        elif all(_least_singular(terms, omega, theta) < 1e-12 * scale for theta in (0.0, 1.0, 2.5)):
            return True
    return False


def _checked(matrices: Sequence[ArrayLike]) -> list[FloatArray]:
    if len(matrices) == 0:
        raise BadModelError("matrices is empty; at least A_0 is wanted")
    checked = square_matrices(**{f"matrices[{k}]": matrix for k, matrix in enumerate(matrices)})
    size = checked[0].shape[0] * (len(checked) - 1)
    if len(checked) > 2 and size > _LARGEST_COMPANION:
        raise BadModelError(
            f"the longest delay is {len(checked) - 1} times their common divisor, with {checked[0].shape[0]} states; "
            f"a product of at most {_LARGEST_COMPANION} is wanted"
        )
    return checked


def _unstable_roots(roots: ComplexArray, crossings: Sequence[AxisCrossing]) -> int:
    # a pair that crosses at zero delay is on the axis there: rounding must not put it in either half plane
    for crossing in crossings:
        if crossing.theta == 0.0:
            for sign in (1.0, -1.0):
                roots = np.delete(roots, np.argmin(np.abs(roots - sign * 1j * crossing.omega)))
    return int(np.count_nonzero(roots.real > 0.0))


def _at_angle(terms: Sequence[FloatArray], theta: FloatArray) -> ComplexArray:
    """sum_k A_k e^{-j k theta}, shape (angles, n, n)."""
    turns = np.exp(-1j * theta[:, np.newaxis] * np.arange(len(terms)))
    return np.tensordot(turns, np.array(terms), axes=1)


def _least_singular(terms: Sequence[FloatArray], omega: float, theta: float) -> float:
    matrix = 1j * omega * np.eye(terms[0].shape[0]) - _at_angle(terms, np.array([theta]))[0]
    return float(np.linalg.svd(matrix, compute_uv=False)[-1])


def companion_loci(terms_at: Callable[[FloatArray], ComplexArray], B: FloatArray) -> Loci:
    """The function omega (k,) -> all lambda (k, m r) with det(j omega I - sum_i A_i lambda^{-i}) = 0.

    The late matrices share their column space, A_i = B B'A_i with B (n, r) orthonormal, so that with
    G_i = B'A_i (j omega I - A_0)^{-1} B the condition is det(lambda^m I - sum_i lambda^{m-i} G_i) = 0.

    Parameters
    ----------
    terms_at
        Frequencies (k,) to A_0, ..., A_m, shape (k, m + 1, n, n).
    B
        As above.
    """
    n, rank = B.shape
    identity = np.eye(n)

    def loci(omega: FloatArray) -> ComplexArray:
        terms = terms_at(omega)
        degree = terms.shape[1] - 1
        resolvent = 1j * omega[:, np.newaxis, np.newaxis] * identity - terms[:, 0]
        entry = np.broadcast_to(B.astype(np.complex128), (omega.size, n, rank))
        try:
            states = np.linalg.solve(resolvent, entry)
        except np.linalg.LinAlgError:
            # exactly on a pole the modulus is infinite: one step beside it is huge, which says the same
            states = np.linalg.solve(resolvent + 1e-14j * np.abs(resolvent).max() * identity, entry)
        loops = B.T @ terms[:, 1:] @ states[:, np.newaxis]
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
    if len(terms) * terms[0].shape[0] ** 2 <= _LARGEST_PENCIL:
        theta = _pencil_angles(terms)
    else:
        theta = np.array([angle for angle, _ in _circle_crossings(terms)])
    if theta.size == 0:
        return np.empty(0)
    roots = np.linalg.eigvals(_at_angle(terms, theta))
    near_axis = np.abs(roots.real) <= _CANDIDATE_TOLERANCE * (highest + np.abs(roots))
    omega = np.unique(np.abs(roots.imag[near_axis]))
    return omega[(omega > 0.0) & (omega < 1.1 * highest)]


def _pencil_angles(terms: Sequence[FloatArray]) -> FloatArray:
    """Angles theta in [0, pi] at which the spectrum of A(theta) = sum_k A_k e^{-j k theta} may touch the axis.

    A(theta) v = j omega v makes X = v v* a solution of A X + X A* = 0. With A = C - j sin(theta) D, C = sum A_k
    cos(k theta) and D = sum A_k sin(k theta) / sin(theta) polynomials in c = cos(theta), and X = R + j S, the real
    part and sin(theta) times the imaginary part are, with S' = S sin(theta),

        C R + R C' + D S' - S' D' = 0,    C S' + S' C' - (1 - c^2) (D R - R D') = 0:

    a polynomial eigenvalue problem in c with n^2 unknowns (R symmetric, S' skew) and real matrices, of degree m + 1.
    """
    n, degree = terms[0].shape[0], len(terms)
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
    """The linear map (R, S') -> both equations of `_pencil_angles` at one c, in coordinates of R and S' (n^2, n^2)."""
    n = terms[0].shape[0]
    theta = float(np.arccos(c))
    k = np.arange(len(terms))
    C = np.tensordot(np.cos(k * theta), np.array(terms), axes=1)
    D = np.tensordot(np.sin(k * theta) / np.sin(theta), np.array(terms), axes=1)
    upper, strict = np.triu_indices(n), np.triu_indices(n, 1)
    symmetric, skew = _unit_matrices(n, upper, 1.0), _unit_matrices(n, strict, -1.0)
    columns = [_plus(C, symmetric), -(1.0 - c * c) * _minus(D, symmetric), _minus(D, skew), _plus(C, skew)]
    top = np.vstack([columns[0][:, upper[0], upper[1]], columns[2][:, upper[0], upper[1]]]).T
    bottom = np.vstack([columns[1][:, strict[0], strict[1]], columns[3][:, strict[0], strict[1]]]).T
    return np.vstack([top, bottom])


def _unit_matrices(n: int, at: tuple[NDArray[np.intp], NDArray[np.intp]], sign: float) -> FloatArray:
    """A basis of symmetric (sign 1) or skew (-1) matrices, one for each place above the diagonal."""
    count = np.arange(at[0].size)
    basis = np.zeros((at[0].size, n, n))
    basis[count, at[1], at[0]] = sign
    basis[count, at[0], at[1]] = 1.0
    return basis


def _plus(matrix: FloatArray, X: FloatArray) -> FloatArray:
    return matrix @ X + X @ matrix.T


def _minus(matrix: FloatArray, X: FloatArray) -> FloatArray:
    return matrix @ X - X @ matrix.T


def _circle_crossings(terms: Sequence[FloatArray]) -> list[tuple[float, float]]:
    """Angles theta in [0, pi] and frequencies omega (either sign) with j omega an eigenvalue of A(theta)."""
    scale = sum(float(np.linalg.norm(matrix)) for matrix in terms)

    def loci(theta: FloatArray) -> ComplexArray:
        # e^{s / scale}: of modulus one on the axis, and |s| / scale <= 1 leaves the frequency in the angle
        return np.exp(np.linalg.eigvals(_at_angle(terms, theta)) / scale).astype(np.complex128)

    # a little beyond pi, so that a crossing at pi itself is inside
    theta = np.linspace(1e-9, 1.01 * pi, _ANGLES)
    theta = np.union1d(theta, near_unit_extrema(loci, theta, near=_NEAR_AXIS))
    angles = np.array([crossing.omega for crossing in unit_crossings(loci, theta)])
    # several roots may cross at nearly one angle (all of them, if nothing acts at once): take all that are on the axis
    roots = np.log(loci(angles)) * scale if angles.size > 0 else np.empty((0, 0))
    return [
        (angle, float(root.imag))
        for angle, row in zip(angles.tolist(), roots, strict=True)
        for root in row[np.abs(row.real) <= max(_ON_AXIS * scale, float(np.abs(row.real).min()))]
    ]


def _passes_zero(terms: Sequence[FloatArray], theta: float, omega: float) -> bool:
    """Whether an eigenvalue of A(theta) is slow at this angle only: it passes s = 0, which no finite delay does.

    The motions of a slow part of the loop are slow at the angles beside it too.
    """
    beside = np.abs(np.linalg.eigvals(_at_angle(terms, np.array([theta - _BESIDE, theta + _BESIDE]))))
    return bool(beside.min() > 1e3 * omega)


def _circle_margin(terms: Sequence[FloatArray]) -> float:
    if float(np.linalg.eigvals(sum(terms, np.zeros_like(terms[0]))).real.max()) >= 0.0:
        return 0.0
    if not any(matrix.any() for matrix in terms[1:]):
        return inf
    scale = highest_frequency(terms)
    margin_s = inf
    for theta, omega in _circle_crossings(terms):
        # -j omega belongs to the angle -theta
        if abs(omega) > _SLOW * scale or not _passes_zero(terms, theta, abs(omega)):
            margin_s = min(margin_s, (theta if omega > 0.0 else 2.0 * pi - theta) / abs(omega))
    return margin_s
