"""Crossings of the imaginary axis of large blocks: the eigenvalues of A(theta) followed along the unit circle.

For A(theta) = sum_k A_k e^{-j k theta} of more than two dozen states, an eigenvalue problem is costly. The eigenvalues
and their derivatives at few angles say, by cubic interpolation, which branches come near the axis; only there are
angles added. Newton's method on a bordered matrix, which takes factorisations only, then finds each crossing.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import inf, pi

import numpy as np
from numpy.polynomial import Polynomial

from gains.core.arrays import ComplexArray, FloatArray
from gains.delay._crossings import Crossing

# first angles: at least this many over the upper half of the circle, and this far (rad) beyond both of its ends
_ANGLES, _BEYOND = 25, 0.02
# and this many for each multiple of the delay
_ANGLES_A_TURN = 12
# intervals are halved down to this width (rad); a branch that is still unclear there touches the axis
_NARROWEST = 1e-7
# bound of the error of the interpolation, as a share of the difference of the two straight lines at the middle
_MARGIN = 1.0
# a crossing that Newton's method finds lies in its interval up to this share of the width
_OUTSIDE = 0.05
_NEWTON_STEPS = 12
# rad; an angle this close to 0 or pi is there, and one this close to 0 is 0
_SAME, _ZERO_ANGLE = 1e-9, 1e-11


class UnclearError(Exception):
    """Branches cannot be told apart, for example because eigenvalues coincide at all angles."""


@dataclass(frozen=True, eq=False)
class _Sample:
    """The eigenvalues (n,) of A(theta) and their derivatives by theta."""

    theta: float
    roots: ComplexArray
    slopes: ComplexArray


@dataclass(frozen=True)
class _Found:
    theta: float
    omega: float
    rising: int
    """Sign of the derivative by theta of the real part; 0 where the branch touches the axis."""


def tracked_crossings(terms: Sequence[FloatArray]) -> list[Crossing]:
    """Crossings omega >= 0 of x'(t) = sum_k A_k x(t - k tau), ascending; the matrices (n, n) form one block.

    Raises UnclearError where eigenvalues coincide at all angles.
    """
    stacked = np.array(terms)
    scale = float(np.linalg.norm(stacked, axis=(1, 2)).sum())
    found: list[_Found] = []
    angles = np.linspace(-_BEYOND, pi + _BEYOND, max(_ANGLES, _ANGLES_A_TURN * len(terms)))
    samples = [_sample(stacked, float(theta)) for theta in angles]
    for left, right in pairwise(samples):
        found += _between(stacked, left, right, scale)
    crossings: list[Crossing] = []
    for each in found:
        # angles below 0 and beyond pi mirror others with negative frequencies; at 0 and pi the pair is seen twice
        inside = _SAME < each.theta < pi - _SAME
        if inside or (-_SAME <= each.theta <= pi + _SAME and each.omega > 0.0):
            turn, way = (each.theta, 1) if each.omega >= 0.0 else (-each.theta, -1)
            omega, turn = abs(each.omega), turn % (2.0 * pi)
            turn = 0.0 if min(turn, 2.0 * pi - turn) < _ZERO_ANGLE else turn
            crossings.append(Crossing(omega, turn / omega if omega > 0.0 else 0.0, way * each.rising, roots=2))
    return sorted(crossings, key=lambda crossing: crossing.omega_rad_s)


def _sample(terms: FloatArray, theta: float) -> _Sample:
    matrix, change = _at(terms, theta)
    roots, right = np.linalg.eig(matrix)
    try:
        slopes = np.einsum("ij,ji->i", np.linalg.inv(right), change @ right)
    except np.linalg.LinAlgError as error:
        raise UnclearError from error
    return _Sample(theta, roots.astype(np.complex128), slopes.astype(np.complex128))


def _at(terms: FloatArray, theta: float) -> tuple[ComplexArray, ComplexArray]:
    """A(theta) and its derivative."""
    k = np.arange(len(terms))
    turns = np.exp(-1j * k * theta)
    return np.tensordot(turns, terms, axes=1), np.tensordot(-1j * k * turns, terms, axes=1)


def _between(terms: FloatArray, left: _Sample, right: _Sample, scale: float) -> Iterator[_Found]:
    """Crossings between two angles, which are halved until each branch is clear."""
    # scipy.optimize takes longer to import than a small model to analyse
    from scipy.optimize import linear_sum_assignment

    width = right.theta - left.theta
    ahead, back = left.roots + width / 2.0 * left.slopes, right.roots - width / 2.0 * right.slopes
    apart = np.abs(ahead[:, np.newaxis] - back)
    # a branch whose neighbours were mixed up is unclear, and the interval is halved
    _, partner = linear_sum_assignment(np.minimum(apart, 1e100))
    found: list[_Found] = []
    for i, j in enumerate(partner.tolist()):
        crossings = _of_branch(terms, left, right, (i, j), float(apart[i, j]), scale)
        if crossings is None:
            break
        found += crossings
    else:
        yield from found
        return
    if width < _NARROWEST:
        raise UnclearError
    middle = _sample(terms, (left.theta + right.theta) / 2.0)
    yield from _between(terms, left, middle, scale)
    yield from _between(terms, middle, right, scale)


def _of_branch(  # noqa: PLR0911 - each way to be clear ends it
    terms: FloatArray, left: _Sample, right: _Sample, branch: tuple[int, int], apart: float, scale: float
) -> list[_Found] | None:
    """Crossings of one branch in an interval; None if the interval is too wide to tell."""
    i, j = branch
    width = right.theta - left.theta
    begin, end = complex(left.roots[i]), complex(right.roots[j])
    start, finish = width * complex(left.slopes[i]), width * complex(right.slopes[j])
    reach = _MARGIN * apart
    real = _cubic(begin.real, end.real, start.real, finish.real)
    turning = [float(t.real) for t in real.deriv().roots() if abs(t.imag) < 1e-12 and 0.0 < t.real < 1.0]
    values = [begin.real, *(float(real(t)) for t in sorted(turning)), end.real]
    if min(abs(value) for value in values) > reach and all(value * values[0] > 0.0 for value in values):
        return []
    touches = width < _NARROWEST * 2.0
    if begin.real * end.real > 0.0 and not touches:
        return None
    if begin.real * end.real > 0.0:
        # closer to the axis than rounding tells: it touches, if it is on it at all
        place = min((t for t in (0.0, *turning, 1.0)), key=lambda t: abs(float(real(t))))
        if abs(float(real(place))) > 1e-11 * scale:
            return []
        omega = _cubic(begin.imag, end.imag, start.imag, finish.imag)(place)
        return [_Found(left.theta + place * width, float(omega), 0)]
    inside = [float(t.real) for t in real.roots() if abs(t.imag) < 1e-9 and -_OUTSIDE <= t.real <= 1.0 + _OUTSIDE]
    if len(inside) != 1 or apart > max(abs(begin.real), abs(end.real)):
        return None
    omega = float(_cubic(begin.imag, end.imag, start.imag, finish.imag)(inside[0]))
    crossing = _newton(terms, left.theta + inside[0] * width, omega, scale)
    if crossing is None or crossing.rising != int(np.sign(end.real - begin.real)):
        return None
    beside = max(left.theta - crossing.theta, crossing.theta - right.theta)
    return [crossing] if beside <= _OUTSIDE * width and abs(crossing.omega - omega) <= apart + 1e-9 * scale else None


def _cubic(begin: float, end: float, start: float, finish: float) -> Polynomial:
    """The cubic on [0, 1] with these values and slopes at its ends."""
    return Polynomial([begin, start, 3.0 * (end - begin) - 2.0 * start - finish, 2.0 * (begin - end) + start + finish])


def _newton(terms: FloatArray, theta: float, omega: float, scale: float) -> _Found | None:
    """The crossing near (theta, omega), by Newton's method on g in [[M, b], [c*, 0]] [v; g] = [0; 1].

    M = j omega I - A(theta) is singular exactly where g = 0, and dg = -u* dM v with u from the adjoint equation.
    """
    from scipy.linalg import lu_factor, lu_solve

    n = terms.shape[1]
    rng = np.random.default_rng(n)
    right, left = (rng.standard_normal((2, n)) + 0j) / np.sqrt(n)
    bordered = np.zeros((n + 1, n + 1), dtype=np.complex128)
    unit = np.zeros(n + 1)
    unit[n] = 1.0
    slope, step_omega, step_theta = 0j, inf, inf
    for _ in range(_NEWTON_STEPS):
        matrix, change = _at(terms, theta)
        bordered[:n, :n] = 1j * omega * np.eye(n) - matrix
        bordered[:n, n], bordered[n, :n] = left, right.conj()
        factors = lu_factor(bordered, check_finite=False)
        solution = lu_solve(factors, unit, check_finite=False)
        adjoint = lu_solve(factors, unit, trans=2, check_finite=False)
        v, g, u = solution[:n], complex(solution[n]), adjoint[:n].conj()
        by_omega, by_theta = -1j * complex(u @ v), complex(u @ (change @ v))
        slope = by_theta / complex(u @ v) if u @ v != 0.0 else 0j
        right, left = v / np.linalg.norm(v), u.conj() / np.linalg.norm(u)
        determinant = by_omega.real * by_theta.imag - by_omega.imag * by_theta.real
        if determinant == 0.0:
            return None
        step_omega = (-g.real * by_theta.imag + g.imag * by_theta.real) / determinant
        step_theta = (-g.imag * by_omega.real + g.real * by_omega.imag) / determinant
        omega, theta = omega + step_omega, theta + step_theta
        if abs(step_omega) <= 1e-14 * scale and abs(step_theta) <= 1e-14:
            break
    else:
        # rounding may keep the last steps from shrinking further
        if not (abs(step_omega) <= 1e-10 * scale and abs(step_theta) <= 1e-10):
            return None
    return _Found(theta, omega, int(np.sign(slope.real)))
