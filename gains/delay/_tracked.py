"""Crossings of the imaginary axis of large blocks, by tracking the eigenvalues of A(theta) along the unit circle.

For A(theta) = sum_k A_k e^{-j k theta} with more than two dozen states, an eigenvalue problem is costly. A quintic
through the eigenvalues and their first two derivatives at a few angles approximates each branch between them, with an
error bound; angles are added only where a branch may reach the axis unseen. Newton's method on a bordered matrix, which
needs only factorisations, then finds each crossing.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import pi

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray, IntArray
from gains.delay._crossings import Crossing

# intervals per multiple of the delay on the upper half of the circle, and how far (rad) they extend past both its ends
_INTERVALS, _BEYOND = 8, 0.02
# intervals are halved down to this width (rad); a branch that is still unclear then touches the axis
_NARROWEST = 1e-7
# points in an interval, from 0 to 1, at which branches are evaluated
_PLACES = np.linspace(0.0, 1.0, 41)[:, np.newaxis]
_FREE = (_PLACES * (1.0 - _PLACES)) ** 2
# bound on the error of a quintic, in units of its difference from the cubic, if the branch has a kink inside the
# interval, where two eigenvalues avoid each other
_KINK = 3.0
# above the largest slope of t^2 (1 - t)^2, 0.19: an error may have that slope in units of its bound
_STEEP = 0.2
# relative to the norm: difference of equal eigenvalues, error of an eigenvalue, real part of one on the axis
_EQUAL, _KNOWN, _ON_AXIS = 1e-12, 1e-9, 1e-11
# two branches that converge to one crossing but are this far apart (relative to the norm) have separate crossings
_APART = 1e-7
# a crossing may lie outside its interval by this share of the width
_OUTSIDE = 0.05
# Newton's method (steps in rad, relative to the norm): most steps; size of the next step at which it is done; size of
# the last step that is accepted if rounding keeps steps from shrinking
_NEWTON_STEPS, _DONE, _DONE_BY_ROUNDING = 12, 1e-15, 1e-10
# rad; an angle within the first of 0 or pi is taken to be there, one within the second of 0 is set to 0
_SAME, _ZERO_ANGLE = 1e-9, 1e-11


class UnclearError(Exception):
    """Branches cannot be told apart, for example where eigenvalues coincide at all angles."""


@dataclass(frozen=True, eq=False)
class _Sample:
    """The eigenvalues (n,) of A(theta) and their first and second derivatives by theta."""

    theta: float
    roots: ComplexArray
    slopes: ComplexArray
    bends: ComplexArray
    vectors: ComplexArray
    """Right eigenvectors (n, n), one per column."""


@dataclass(frozen=True, eq=False)
class _Found:
    """Crossings, each an array (k,); `rising` is the sign of the derivative by theta of the real part, 0 at a touch."""

    theta: FloatArray
    omega: FloatArray
    rising: IntArray


def tracked_crossings(terms: Sequence[FloatArray]) -> list[Crossing]:
    """Crossings omega >= 0 of x'(t) = sum_k A_k x(t - k tau), ascending; the matrices (n, n) form one block.

    Raises UnclearError where eigenvalues coincide at all angles.
    """
    stacked = np.array(terms, dtype=np.complex128)
    scale = float(np.linalg.norm(stacked, axis=(1, 2)).sum())
    angles = np.linspace(-_BEYOND, pi + _BEYOND, _INTERVALS * (len(terms) - 1) + 1)
    samples = [_sample(stacked, float(theta), scale) for theta in angles]
    crossings: list[Crossing] = []
    for found in (each for left, right in pairwise(samples) for each in _between(stacked, left, right, scale)):
        for theta, omega, rising in zip(*(part.tolist() for part in vars(found).values()), strict=True):
            # angles below 0 and beyond pi mirror others with negative frequencies; at 0 and pi the pair is seen twice
            inside = _SAME < theta < pi - _SAME
            if inside or (-_SAME <= theta <= pi + _SAME and omega > 0.0):
                turn, way = (theta, 1) if omega >= 0.0 else (-theta, -1)
                turn = turn % (2.0 * pi)
                turn = 0.0 if min(turn, 2.0 * pi - turn) < _ZERO_ANGLE else turn
                delay_s = turn / abs(omega) if omega != 0.0 else 0.0
                crossings.append(Crossing(abs(omega), delay_s, way * rising, roots=2))
    return sorted(crossings, key=lambda crossing: crossing.omega_rad_s)


def _sample(terms: ComplexArray, theta: float, scale: float) -> _Sample:
    """With V^{-1} A V = diag(s), W = V^{-1} A' V and X = V^{-1} A'' V, the derivatives of s_i are W_ii and
    X_ii + 2 sum_j W_ij W_ji / (s_i - s_j).
    """
    roots, right = np.linalg.eig(at_angle(terms, theta))
    try:
        left = np.linalg.inv(right)
    except np.linalg.LinAlgError as error:
        raise UnclearError from error
    by_theta = left @ at_angle(terms, theta, 1) @ right
    gaps = roots[:, np.newaxis] - roots
    gaps[np.abs(gaps) < _EQUAL * scale] = np.inf
    coupling = 2.0 * (by_theta * by_theta.T / gaps).sum(axis=1)
    bends = np.einsum("ij,ji->i", left, at_angle(terms, theta, 2) @ right) + coupling
    return _Sample(theta, roots, np.diag(by_theta), bends, right)


def at_angle(terms: Sequence[FloatArray] | ComplexArray, theta: FloatArray | float, order: int = 0) -> ComplexArray:
    """A(theta), or its derivative of this order by theta, shape (n, n) for each angle."""
    multiples = -1j * np.arange(len(terms))
    return np.tensordot(np.exp(np.multiply.outer(theta, multiples)) * multiples**order, np.asarray(terms), axes=1)


def _between(terms: ComplexArray, left: _Sample, right: _Sample, scale: float) -> Iterator[_Found]:
    """Crossings between two angles; the interval is halved until every branch is clear."""
    found = _of_branches(terms, left, right, scale)
    if found is not None:
        yield found
        return
    if right.theta - left.theta < _NARROWEST:
        raise UnclearError
    middle = _sample(terms, (left.theta + right.theta) / 2.0, scale)
    yield from _between(terms, left, middle, scale)
    yield from _between(terms, middle, right, scale)


def _of_branches(terms: ComplexArray, left: _Sample, right: _Sample, scale: float) -> _Found | None:
    """Crossings of all branches in an interval; None if the interval is too wide to decide."""
    width = right.theta - left.theta
    partner = _partners(left.roots + width / 2.0 * left.slopes, right.roots - width / 2.0 * right.slopes)
    quintics, bound = _quintics(left, right, partner)
    real = _values(quintics, _PLACES).real
    # a branch may turn back between two points, by up to an eighth of its second difference
    turn = np.abs(np.diff(real, 2, axis=0)).max(axis=0) / 8.0
    positive, sure = real > 0.0, np.abs(real) > bound * _FREE + turn
    # eigenvalues are known at the ends
    sure[[0, -1]] = True
    # the sign at the nearest sure point before and after each point
    order = np.arange(len(real))[:, np.newaxis]
    last = np.maximum.accumulate(np.where(sure, order, 0), axis=0)
    following = np.minimum.accumulate(np.where(sure, order, len(real) - 1)[::-1], axis=0)[::-1]
    before, after = (np.take_along_axis(positive, at, axis=0) for at in (last, following))
    flips = positive[1:] != positive[:-1]
    touches = np.any(~sure & (before == after), axis=0)
    unclear = flips.sum(axis=0) != np.count_nonzero(before[1:] != before[:-1], axis=0)
    # a branch that is not steep where it crosses may cross three times
    steep = np.abs(np.gradient(real, _PLACES[:, 0], axis=0)) > _STEEP * bound
    unclear |= flips.any(axis=0) & np.any(~sure & ~steep, axis=0)
    if width < 2.0 * _NARROWEST:
        # closer to the axis than rounding can resolve: a touch, if the branch is on the axis at all
        unclear &= ~touches
        flips[:, touches] = False
        touches &= np.abs(real).min(axis=0) < _ON_AXIS * scale
    elif touches.any():
        return None
    if unclear.any():
        return None
    place, branch = np.nonzero(flips)
    begin, end = real[place, branch], real[place + 1, branch]
    at = _PLACES[place, 0] + begin / (begin - end) * (_PLACES[1, 0] - _PLACES[0, 0])
    vectors = np.where(at < 0.5, left.vectors[:, branch], right.vectors[:, partner[branch]]).T
    on_axis = _newton(terms, left.theta + at * width, _values(quintics[:, branch], at).imag, vectors, scale)
    if on_axis is None or not _belong(on_axis, quintics[:, branch], bound[branch], at, left.theta, width, scale):
        return None
    if np.any(on_axis.rising != np.sign(end - begin)):
        return None
    nearest = np.abs(real).argmin(axis=0)[touches]
    omega = np.diag(_values(quintics[:, touches], _PLACES[nearest]).imag)
    return _Found(
        np.append(on_axis.theta, left.theta + _PLACES[nearest, 0] * width),
        np.append(on_axis.omega, omega),
        np.append(on_axis.rising, np.zeros(omega.size, dtype=np.intp)),
    )


def _partners(ahead: ComplexArray, back: ComplexArray) -> IntArray:
    """Index of the partner in `back` of each eigenvalue in `ahead`, by repeatedly pairing mutual nearest neighbours."""
    apart = np.abs(ahead[:, np.newaxis] - back)
    apart = np.where(np.isfinite(apart), apart, np.finfo(np.float64).max)
    partner = np.full(len(apart), -1)
    while (partner < 0).any():
        nearest = apart.argmin(axis=1)
        mutual = np.flatnonzero((apart.argmin(axis=0)[nearest] == np.arange(len(apart))) & (partner < 0))
        partner[mutual] = nearest[mutual]
        apart[mutual], apart[:, nearest[mutual]] = np.inf, np.inf
    return partner


def _quintics(left: _Sample, right: _Sample, partner: IntArray) -> tuple[ComplexArray, FloatArray]:
    """The quintics (6, n) on [0, 1] with these values and derivatives at the ends, and the bounds (n,) of their errors.

    The error is below the bound times t^2 (1 - t)^2.
    """
    width = right.theta - left.theta
    begin, start, finish = left.roots, width * left.slopes, width * right.slopes[partner]
    rise = right.roots[partner] - begin
    # coefficients of the cubic with these values and slopes, and half the errors of its second derivatives at the ends
    square, cube = 3.0 * rise - 2.0 * start - finish, start + finish - 2.0 * rise
    at_left = (width**2 * left.bends - 2.0 * square) / 2.0
    at_right = (width**2 * right.bends[partner] - 2.0 * square - 6.0 * cube) / 2.0
    # t^2 (1 - t)^2 (at_left (1 - t) + at_right t), added to the cubic
    extra = [at_left, at_right - 3.0 * at_left, 3.0 * at_left - 2.0 * at_right, at_right - at_left]
    quintics = np.array([begin, start, square + extra[0], cube + extra[1], *extra[2:]])
    return quintics, _KINK * np.maximum(np.abs(at_left), np.abs(at_right))


def _values(quintics: ComplexArray, t: FloatArray) -> ComplexArray:
    value = quintics[-1]
    for coefficients in quintics[-2::-1]:
        value = coefficients + t * value
    return value


def _belong(
    found: _Found, quintics: ComplexArray, bound: FloatArray, at: FloatArray, begin: float, width: float, scale: float
) -> bool:
    """Whether each crossing is in the interval and on its branch, and no two branches converge to one crossing."""
    t = (found.theta - begin) / width
    predicted = _values(quintics, t)
    near = np.abs(predicted - 1j * found.omega) <= bound / 16.0 + _KNOWN * scale
    if not np.all(near & (np.abs(t - 0.5) <= 0.5 + _OUTSIDE)):
        return False
    order = np.lexsort((found.omega, found.theta))
    same = (np.diff(found.theta[order]) < _SAME) & (np.abs(np.diff(found.omega[order])) < _SAME * scale)
    return not bool(np.any(same & (np.abs(np.diff(_values(quintics, at)[order])) > _APART * scale)))


def _newton(terms: ComplexArray, theta: FloatArray, omega: FloatArray, v: ComplexArray, scale: float) -> _Found | None:
    """The crossings near theta, omega (k,) and vectors v (k, n), by Newton's method; None unless all converge.

    It solves M v = 0, c*v = 1 for v, omega and theta, M = j omega I - A(theta). With omega taken as complex, one
    factorisation gives its step a + b d(theta); d(theta) keeps omega real. At the crossing ds/d(theta) = j b.
    """
    n = v.shape[1]
    v = v / np.linalg.norm(v, axis=1, keepdims=True)
    bordered = np.zeros((theta.size, n + 1, n + 1), dtype=np.complex128)
    bordered[:, n, :n] = v.conj()
    right = np.zeros((theta.size, n + 1, 2), dtype=np.complex128)
    size, b = 0.0, np.zeros(theta.size, dtype=np.complex128)
    for _ in range(_NEWTON_STEPS):
        bordered[:, :n, :n] = 1j * omega[:, np.newaxis, np.newaxis] * np.eye(n) - at_angle(terms, theta)
        bordered[:, :n, n] = 1j * v
        right[:, :n, 0] = -(bordered[:, :n, :n] @ v[..., np.newaxis])[..., 0]
        right[:, :n, 1] = (at_angle(terms, theta, 1) @ v[..., np.newaxis])[..., 0]
        try:
            step = np.linalg.solve(bordered, right)
        except np.linalg.LinAlgError:
            return None
        a, b = step[:, n, 0], step[:, n, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            by_theta = -a.imag / b.imag
            by_omega = a.real + by_theta * b.real
            v = v + step[:, :n, 0] + by_theta[:, np.newaxis] * step[:, :n, 1]
        theta, omega = theta + by_theta, omega + by_omega
        size, before = float(np.maximum(np.abs(by_omega) / scale, np.abs(by_theta)).max(initial=0.0)), size
        # quadratic convergence: the next step is about size**3 / before**2
        if size <= _KNOWN and size**3 <= _DONE * before**2:
            return _Found(theta, omega, -np.sign(b.imag).astype(np.intp))
    # rounding may keep the last steps from shrinking
    return _Found(theta, omega, -np.sign(b.imag).astype(np.intp)) if size <= _DONE_BY_ROUNDING else None
