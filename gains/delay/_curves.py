"""Curves of solutions (omega, alpha, beta) of det(j omega I - A0 - A1 e^{-j alpha} - A2 e^{-j beta}) = 0, omega > 0.

Two real equations in three unknowns: curves on the torus of the two angles. Starting points come from a grid of alpha
and one of beta; each curve is followed by a predictor along its tangent and a Newton corrector until it closes or omega
reaches zero.
"""

from dataclasses import dataclass
from math import pi

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray
from gains.delay._loci import UnitCrossing, unit_crossings
from gains.delay.sweep import near_unit_extrema

# angles from which curves are looked for, and angles of the other delay in each search
_SEED_ANGLES, _SEARCH_ANGLES = 48, 160
# a local extremum of a real part closer to the axis than this, relative to the norm, is refined
_NEAR_AXIS = 0.1
# step along a curve, in radians and in units of the norm for the frequency; the least step before giving up
_STEP, _LEAST_STEP = 0.05, 1e-5
# steps of one curve before giving up: some hundred turns of the torus
_MOST_STEPS = 20_000
# a curve ends where the frequency is this small relative to the norm: the delays grow without bound
_LOWEST = 1e-4
# a starting point lies on a curve that has a point this close to it (in steps)
_ON_CURVE = 1.5
# and this close to the segment between two of its points
_SAME_CURVE = 0.05


@dataclass(frozen=True, eq=False)
class Curve:
    """Points along one curve: `omega` (k,) in rad/s, `alpha` and `beta` (k,) in rad, unwrapped."""

    omega: FloatArray
    alpha: FloatArray
    beta: FloatArray


def crossing_solutions(A0: FloatArray, A1: FloatArray, A2: FloatArray) -> list[Curve]:
    """All curves of solutions of one block that the grid of starting points finds."""
    scale = sum(float(np.linalg.norm(matrix)) for matrix in (A0, A1, A2))
    if scale == 0.0:
        return []
    terms = np.array([A0, A1, A2]) / scale
    curves: list[FloatArray] = []
    # an angle off the round ones, where curves of symmetric loops meet
    for angle in ((np.arange(_SEED_ANGLES) + 0.37) * (2.0 * pi / _SEED_ANGLES)).tolist():
        # from a grid of beta as well: where A2 has no part, a curve has one alpha, which no grid meets
        swapped = [start[[0, 2, 1]] for start in _solutions_at(terms[[0, 2, 1]], angle)]
        for start in [*_solutions_at(terms, angle), *swapped]:
            if not any(_passes(curve, start) for curve in curves):
                curves.append(_followed(terms, start))
    return [Curve(curve[:, 0] * scale, curve[:, 1], curve[:, 2]) for curve in curves if len(curve) > 1]


def at_delay(
    matrices: tuple[FloatArray, ...], point: FloatArray, *, which: int, delay_s: float, turns: int
) -> FloatArray | None:
    """The solution near a point (omega, alpha, beta) at which one delay is `delay_s`; None if there is none near by.

    That delay is (angle + 2 pi turns) / omega, of the angle alpha for `which` 0 and beta for 1.
    """
    scale = sum(float(np.linalg.norm(matrix)) for matrix in matrices)
    terms = np.array(matrices) / scale
    here = point / np.array([scale, 1.0, 1.0])
    wanted = delay_s * scale
    for _ in range(20):
        here[1 + which] = wanted * here[0] - 2.0 * pi * turns
        value, slopes = _equation(terms, here)
        if abs(value) < 1e-14:
            return here * np.array([scale, 1.0, 1.0])
        # the angle follows the frequency
        pair = np.stack([slopes[:, 0] + wanted * slopes[:, 1 + which], slopes[:, 2 - which]], axis=1)
        step = np.linalg.lstsq(pair, np.array([value.real, value.imag]), rcond=1e-10)[0]
        if float(np.linalg.norm(step)) > 2.0 * _STEP:
            return None
        here[0] -= step[0]
        here[2 - which] -= step[1]
    return None


def _solutions_at(terms: FloatArray, alpha: float) -> list[FloatArray]:
    """Points (omega, alpha, beta) with omega > 0 at one alpha: eigenvalues of A(beta) that cross the imaginary axis."""
    now = terms[0] + terms[1] * np.exp(-1j * alpha)

    def loci(beta: FloatArray) -> ComplexArray:
        # e^s: of modulus one on the axis, and |s| <= 1 leaves the frequency in the angle
        matrices = now + terms[2] * np.exp(-1j * beta)[:, np.newaxis, np.newaxis]
        return np.exp(np.linalg.eigvals(matrices)).astype(np.complex128)

    beta = np.linspace(1e-9, 2.0 * pi, _SEARCH_ANGLES)
    beta = np.union1d(beta, near_unit_extrema(loci, beta, near=_NEAR_AXIS))
    return [
        _corrected(terms, np.array([_frequency(crossing), alpha, crossing.omega]))
        for crossing in unit_crossings(loci, beta)
        if _frequency(crossing) > _LOWEST
    ]


def _frequency(crossing: UnitCrossing) -> float:
    return float(np.angle(crossing.locus))


def _followed(terms: FloatArray, start: FloatArray) -> FloatArray:
    """The whole curve through a point, shape (k, 3): once around if it closes, else in both directions to its ends."""
    forward, closed = _walked(terms, start, 1.0)
    if closed:
        return forward
    backward, _ = _walked(terms, start, -1.0)
    return np.concatenate([backward[:0:-1], forward])


def _walked(terms: FloatArray, start: FloatArray, sign: float) -> tuple[FloatArray, bool]:
    """Points from a start in one direction, and whether they came back to it."""
    points, step = [start], _STEP
    direction = sign * _tangent(terms, start)
    for _ in range(_MOST_STEPS):
        point = _corrected(terms, points[-1] + step * direction)
        tangent = _tangent(terms, point)
        tangent *= 1.0 if tangent @ direction >= 0.0 else -1.0
        moved = float(np.linalg.norm(point - points[-1]))
        # a corrector that jumped, or a bend sharper than the step can follow
        bad = moved > 1.5 * step or moved < 0.3 * step or float(tangent @ direction) < 0.9
        # or the end of the curve at zero frequency, which is approached
        if (bad or point[0] < _LOWEST) and step > _LEAST_STEP:
            step /= 2.0
            continue
        points.append(point)
        direction, step = tangent, min(1.5 * step, _STEP)
        if point[0] < _LOWEST:
            return np.array(points[:-1]), False
        if len(points) > 4 and _distance(start, points[-2], point) < _SAME_CURVE * _STEP:
            points[-1] = _nearest_turn(start, point)
            return np.array(points), True
    return np.array(points), False


def _equation(terms: FloatArray, point: FloatArray) -> tuple[complex, FloatArray]:
    """The least singular value of the characteristic matrix, and the derivatives (2, 3) of u*M v, real and imaginary.

    u and v are its singular vectors; u*M v is that value, and changes with omega, alpha and beta by j u*v,
    j e^{-j alpha} u*A1 v and j e^{-j beta} u*A2 v.
    """
    omega, alpha, beta = point
    first, second = terms[1] * np.exp(-1j * alpha), terms[2] * np.exp(-1j * beta)
    U, singular, Vh = np.linalg.svd(1j * omega * np.eye(terms.shape[1]) - terms[0] - first - second)
    u, v = U[:, -1].conj(), Vh[-1].conj()
    slopes = 1j * np.array([u @ v, u @ first @ v, u @ second @ v], dtype=np.complex128)
    return complex(singular[-1]), np.stack([slopes.real, slopes.imag])


def _corrected(terms: FloatArray, point: FloatArray) -> FloatArray:
    """The solution nearest to a point: Newton steps of least length."""
    for _ in range(8):
        value, slopes = _equation(terms, point)
        if abs(value) < 1e-15:
            break
        point = point - np.linalg.lstsq(slopes, np.array([value.real, value.imag]), rcond=1e-10)[0]
    return point


def _tangent(terms: FloatArray, point: FloatArray) -> FloatArray:
    _, slopes = _equation(terms, point)
    tangent = np.cross(slopes[0], slopes[1])
    return tangent / max(float(np.linalg.norm(tangent)), 1e-300)


def _nearest_turn(reference: FloatArray, point: FloatArray) -> FloatArray:
    """`reference` with whole turns added to its angles so that it is next to `point`."""
    turns = np.round((point[1:] - reference[1:]) / (2.0 * pi))
    return reference + np.array([0.0, *(2.0 * pi * turns)])


def _distance(reference: FloatArray, before: FloatArray, after: FloatArray) -> float:
    """How far a point is from the segment between two points, whole turns aside."""
    point = _nearest_turn(reference, after)
    along = after - before
    share = float(np.clip((point - before) @ along / max(float(along @ along), 1e-300), 0.0, 1.0))
    # the chord leaves a curve of radius about one by an eighth of the squared step
    sagitta = float(along @ along) / 8.0
    return max(float(np.linalg.norm(point - before - share * along)) - sagitta, 0.0)


def _passes(curve: FloatArray, point: FloatArray) -> bool:
    """Whether a curve goes through a point, whole turns aside."""
    difference = curve - point
    difference[:, 1:] -= 2.0 * pi * np.round(difference[:, 1:] / (2.0 * pi))
    near = np.flatnonzero(np.linalg.norm(difference, axis=1) < _ON_CURVE * _STEP)
    return any(
        _distance(point, curve[i], curve[j]) < _SAME_CURVE * _STEP
        for i in near.tolist()
        for j in (i - 1, i + 1)
        if 0 <= j < len(curve)
    )
