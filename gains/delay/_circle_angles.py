"""Angles theta = omega tau at which a loop with delays tau, 2 tau, ... may have roots on the imaginary axis.

A(theta) = sum_k A_k e^{-j k theta} has n eigenvalues s, however many delays there are. Where one of them is j omega,
tau = theta / omega is critical. A matrix pencil gives a finite list of angles that contains every crossing. Where the
pencil is too large or too ill-conditioned, a grid on the unit circle with refined extrema and Newton's method finds
them.
"""

from collections.abc import Sequence
from math import pi

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import ComplexArray, FloatArray
from gains.delay._loci import Loci, highest_frequency, near_unit_extrema

# the pencil's companion matrix takes 0.1 s at this size; larger problems are left to the grid
_LARGEST_PENCIL = 450
# the polynomial in cos(theta) is expanded here: outside [-1, 1], and at no special value
_EXPANSION = 1.3717
# grid angles on the upper half of the unit circle: at least this many, and this many per turn of the longest delay. The
# grid ends a little beyond pi, so that it brackets a crossing at pi itself.
_ANGLES, _ANGLES_A_TURN, PAST_HALF = 400, 40, 1.01 * pi
# Newton's method starts at grid angles whose first step is at most this many grid steps; each step doubles the digits
_REACH, _NEWTON_STEPS = 1.5, 3
# below this share of the highest frequency a root may be one that passes zero, which a look this far (rad) beside tells
_SLOW, _BESIDE = 1e-6, 0.05
# a local extremum of a real part is refined when its sample is this close to the axis, relative to the norm
_NEAR_AXIS = 0.1


def at_angle(terms: Sequence[FloatArray], theta: FloatArray) -> ComplexArray:
    """sum_k A_k e^{-j k theta}, shape (angles, n, n)."""
    turns = np.exp(-1j * theta[:, np.newaxis] * np.arange(len(terms)))
    return np.tensordot(turns, np.array(terms), axes=1)


def norm_of(terms: Sequence[FloatArray]) -> float:
    """Sum of the Frobenius norms, a bound of every eigenvalue of A(theta)."""
    return sum(float(np.linalg.norm(matrix)) for matrix in terms)


def circle_loci(terms: Sequence[FloatArray]) -> Loci:
    """theta (k,) -> e^{s / scale} for the eigenvalues s of A(theta), scale the sum of the norms.

    The modulus is one on the axis. As |s| / scale <= 1, the frequency can be read from the angle.
    """
    scale = norm_of(terms)

    def loci(theta: FloatArray) -> ComplexArray:
        return np.exp(np.linalg.eigvals(at_angle(terms, theta)) / scale).astype(np.complex128)

    return loci


def circle_points(terms: Sequence[FloatArray]) -> FloatArray:
    """Grid angles, and the extrema at which a real part comes near the axis and turns back."""
    theta = _grid_angles(terms)
    return np.union1d(theta, near_unit_extrema(circle_loci(terms), theta, near=_NEAR_AXIS))


def passes_zero(terms: Sequence[FloatArray], theta: float, omega: float) -> bool:
    """Whether a root at the frequency omega >= 0 is one that passes s = 0, which no finite delay brings about.

    An eigenvalue of A(theta) that passes zero is slow at this angle only; the slow motions of a loop are slow at the
    angles beside it too.
    """
    if omega > _SLOW * highest_frequency(terms):
        return False
    beside = np.abs(np.linalg.eigvals(at_angle(terms, np.array([theta - _BESIDE, theta + _BESIDE]))))
    return bool(beside.min() > 1e3 * omega)


def _grid_angles(terms: Sequence[FloatArray]) -> FloatArray:
    return np.linspace(1e-9, PAST_HALF, max(_ANGLES, _ANGLES_A_TURN * len(terms)))


def candidate_angles(terms: Sequence[FloatArray]) -> FloatArray:
    """Angles that come near every crossing, ascending.

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
    return np.sort(np.concatenate([_pencil_angles(terms), theta[(theta > 0.0) & (theta < PAST_HALF)]]))


def _roots_and_slopes(terms: Sequence[FloatArray], theta: FloatArray) -> tuple[ComplexArray, FloatArray]:
    """Eigenvalues s of A(theta), shape (angles, n), and d(Re s) / d theta: zero where an eigenvalue is defective."""
    roots, right = np.linalg.eig(at_angle(terms, theta))
    k = np.arange(len(terms))
    change = np.tensordot(-1j * k * np.exp(-1j * theta[:, np.newaxis] * k), np.array(terms), axes=1)
    try:
        slopes = np.real(np.einsum("tii->ti", np.linalg.solve(right, change @ right)))
    except np.linalg.LinAlgError:
        slopes = np.zeros(roots.shape)
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
    """The equations of `_pencil_angles` at one c as a matrix (n^2, n^2) that acts on the entries of R and S'."""
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
    """A basis of the symmetric (sign 1) or skew (-1) matrices, one for each index pair in `at`."""
    count = np.arange(at[0].size)
    basis = np.zeros((at[0].size, n, n))
    basis[count, at[1], at[0]] = sign
    basis[count, at[0], at[1]] = 1.0
    return basis


def _plus(matrix: FloatArray, X: FloatArray) -> FloatArray:
    return matrix @ X + X @ matrix.T


def _minus(matrix: FloatArray, X: FloatArray) -> FloatArray:
    return matrix @ X - X @ matrix.T
