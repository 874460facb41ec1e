"""Curves of solutions (omega, alpha, beta) of det(j omega I - A0 - A1 e^{-j alpha} - A2 e^{-j beta}) = 0, omega > 0.

These are two real equations in three unknowns. Starting points come from a grid of alpha and a grid of beta. A
predictor along the tangent and a Newton corrector then follow each curve until it closes or omega reaches zero.
"""

from math import pi

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray
from gains.delay._loci import unit_crossings, with_extrema

# angles in the grid of starting points, and angles of the other delay searched at each
_SEED_ANGLES, _SEARCH_ANGLES = 48, 160
# a local extremum of a real part is refined when it is closer to the axis than this, relative to the norm
_NEAR_AXIS = 0.1
# longest and shortest step along a curve: angles in radians, frequency in units of the norm
_STEP, _LEAST_STEP = 0.05, 1e-5
# limit on steps along one curve: some hundred turns around the torus
_MOST_STEPS = 20_000
# a curve ends where the frequency is this small relative to the norm, because delays grow without bound there
_LOWEST = 1e-4
# a starting point is on a known curve if it is within these distances (in steps) of one of its points and of a segment
_ON_CURVE, _SAME_CURVE = 1.5, 0.05


def crossing_solutions(A0: FloatArray, A1: FloatArray, A2: FloatArray) -> list[FloatArray]:
    """The curves of one block that pass through the starting points of the grids.

    Each is an array (k, 3) of omega in rad/s and alpha and beta in rad, the angles unwrapped.
    """
    scale = sum(float(np.linalg.norm(matrix)) for matrix in (A0, A1, A2))
    if scale == 0.0:
        return []
    terms = np.array([A0, A1, A2]) / scale
    curves: list[FloatArray] = []
    # shifted away from round angles, where the curves of symmetric loops meet
    for angle in ((np.arange(_SEED_ANGLES) + 0.37) * (2.0 * pi / _SEED_ANGLES)).tolist():
        # a grid of beta as well: a curve that A2 does not affect has a single alpha, which no grid hits
        swapped = [start[[0, 2, 1]] for start in _solutions_at(terms[[0, 2, 1]], angle)]
        for start in [*_solutions_at(terms, angle), *swapped]:
            if not any(_passes(curve, start) for curve in curves):
                curves.append(_followed(terms, start))
    return [curve * np.array([scale, 1.0, 1.0]) for curve in curves if len(curve) > 1]


def at_delay(
    matrices: tuple[FloatArray, ...], point: FloatArray, *, which: int, delay_s: float, turns: int
) -> FloatArray | None:
    """The solution near a point (omega, alpha, beta) at which one delay equals `delay_s`; None if none is near.

    That delay is (angle + 2 pi turns) / omega, where the angle is alpha for `which` = 0 and beta for `which` = 1.
    """
    scale = sum(float(np.linalg.norm(matrix)) for matrix in matrices)
    terms, units = np.array(matrices) / scale, np.array([scale, 1.0, 1.0])
    here, of_delay = point / units, np.zeros(3)
    of_delay[[0, 1 + which]] = -delay_s * scale, 1.0
    for _ in range(20):
        value, slopes = _equation(terms, here)
        missed = np.array([value.real, value.imag, of_delay @ here + 2.0 * pi * turns])
        if np.abs(missed).max() < 1e-14 * max(1.0, float(np.abs(here).max())):
            return here * units
        step = np.linalg.lstsq(np.vstack([slopes, of_delay]), missed, rcond=1e-10)[0]
        if float(np.linalg.norm(step)) > 2.0 * _STEP:
            return None
        here = here - step
    return None


def _solutions_at(terms: FloatArray, alpha: float) -> list[FloatArray]:
    """Solutions with omega > 0 at one alpha: where an eigenvalue of A(beta) crosses the imaginary axis."""
    now = terms[0] + terms[1] * np.exp(-1j * alpha)

    def loci(beta: FloatArray) -> ComplexArray:
        # e^s has modulus one on the axis, and as |s| <= 1 its angle is the frequency
        matrices = now + terms[2] * np.exp(-1j * beta)[:, np.newaxis, np.newaxis]
        return np.exp(np.linalg.eigvals(matrices)).astype(np.complex128)

    beta = with_extrema(loci, np.linspace(1e-9, 2.0 * pi, _SEARCH_ANGLES), near=_NEAR_AXIS)
    points = [np.array([np.angle(crossing.locus), alpha, crossing.omega]) for crossing in unit_crossings(loci, beta)]
    return [_corrected(terms, point) for point in points if point[0] > _LOWEST]


def _followed(terms: FloatArray, start: FloatArray) -> FloatArray:
    """The whole curve through a point, shape (k, 3): once around if it is closed, otherwise from end to end."""
    forward, closed = _walked(terms, start, 1.0)
    if closed:
        return forward
    backward, _ = _walked(terms, start, -1.0)
    return np.concatenate([backward[:0:-1], forward])


def _walked(terms: FloatArray, start: FloatArray, sign: float) -> tuple[FloatArray, bool]:
    """Points along the curve from a start in one direction, and whether they return to it."""
    points, step = [start], _STEP
    direction = sign * _tangent(terms, start)
    for _ in range(_MOST_STEPS):
        point = _corrected(terms, points[-1] + step * direction)
        tangent = _tangent(terms, point)
        tangent *= 1.0 if tangent @ direction >= 0.0 else -1.0
        moved = float(np.linalg.norm(point - points[-1]))
        # the corrector jumped, or the bend is sharper than the step can follow
        bad = moved > 1.5 * step or moved < 0.3 * step or float(tangent @ direction) < 0.9
        # steps also get shorter near the end of the curve at zero frequency
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
    """The least singular value u*M v of the characteristic matrix M, and its derivatives (2, 3), real and imaginary.

    u and v are its singular vectors. The derivatives by omega, alpha and beta are j u*v, j e^{-j alpha} u*A1 v and
    j e^{-j beta} u*A2 v.
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
    """`reference` with whole turns added to its angles to bring it closest to `point`."""
    turns = np.round((point[1:] - reference[1:]) / (2.0 * pi))
    return reference + np.array([0.0, *(2.0 * pi * turns)])


def _distance(reference: FloatArray, before: FloatArray, after: FloatArray) -> float:
    """Distance of a point from the segment between two points, modulo whole turns."""
    point = _nearest_turn(reference, after)
    along = after - before
    share = float(np.clip((point - before) @ along / max(float(along @ along), 1e-300), 0.0, 1.0))
    # an arc of radius about one deviates from its chord by an eighth of the squared step
    sagitta = float(along @ along) / 8.0
    return max(float(np.linalg.norm(point - before - share * along)) - sagitta, 0.0)


def _passes(curve: FloatArray, point: FloatArray) -> bool:
    """Whether a curve passes through a point, modulo whole turns."""
    difference = curve - point
    difference[:, 1:] -= 2.0 * pi * np.round(difference[:, 1:] / (2.0 * pi))
    near = np.flatnonzero(np.linalg.norm(difference, axis=1) < _ON_CURVE * _STEP)
    return any(
        _distance(point, curve[i], curve[j]) < _SAME_CURVE * _STEP
        for i in near.tolist()
        for j in (i - 1, i + 1)
        if 0 <= j < len(curve)
    )
