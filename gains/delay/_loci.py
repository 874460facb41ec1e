"""Eigenvalue loci of a delayed loop, and the frequencies at which they cross the unit circle.

x'(t) = A0 x(t) + A1 x(t - tau) with A1 = B C of rank r has the root s = j omega at the delay tau exactly when
e^{j omega tau} is an eigenvalue of the r x r loop G(j omega) = C (j omega I - A0)^{-1} B. The moduli of these loci do
not depend on tau. Sorted, they are continuous functions of the frequency however the eigenvalues are numbered, so a
crossing lies between two frequencies at which different numbers of moduli exceed one.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gains.core._bracketing import bracketed_roots, may_reach_zero, peaks
from gains.core.arrays import ComplexArray, FloatArray

Loci = Callable[[FloatArray], ComplexArray]

_EPS = float(np.finfo(np.float64).eps)
# least normal number, the floor for singular values of a zero matrix, which has no scale of its own
_LEAST = float(np.finfo(np.float64).tiny)
# peaks of the modulus are refined if the sampled log modulus is this close to zero: sampling lowers a peak by far less
_NEAR_UNIT = 1.0
# two crossings closer together than this (relative) coincide; it is below the error of a double eigenvalue, sqrt(eps)
_SAME_PLACE = 1e-10
# where crossings coincide, a locus whose log modulus is below this is on the unit circle
_ON_CIRCLE = 1e-8
# a peak of damping ratio 0.01 is 0.009 decades wide
_POINTS_PER_DECADE = 60
_DECADES = 9
# below the first share of the highest frequency, a locus that moves by less than the second per octave is at its limit
_SLOW, _FLAT = 1e-5, 1e-2


@dataclass(frozen=True)
class UnitCrossing:
    """A crossing of the unit circle: the eigenvalue `locus`, of modulus one to rounding, at the frequency `omega`.

    `outward` is +1 if its modulus falls through one as the frequency rises, -1 if it rises through one, and 0 if it
    touches one and returns.
    """

    omega: float
    locus: complex
    outward: int

    @property
    def delay_s(self) -> float:
        """The least delay >= 0 with e^{j omega delay} at the locus."""
        return float(np.angle(self.locus)) % (2.0 * np.pi) / self.omega


def factor_rank(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """B (n, r) and C (r, n), of equal norm, with B C = `matrix` to rounding; r is its numerical rank."""
    U, singular, Vh = np.linalg.svd(matrix)
    sizes = singular.tolist()
    rank = sum(size > len(matrix) * _EPS * sizes[0] for size in sizes)
    root = np.sqrt(singular[:rank])
    return U[:, :rank] * root, root[:, np.newaxis] * Vh[:rank]


def norm_of(matrices: Iterable[FloatArray]) -> float:
    """Sum of the Frobenius norms, a bound on every eigenvalue of a sum of the matrices, each turned by any phase."""
    return sum(sqrt(np.vdot(matrix, matrix)) for matrix in matrices)


def highest_frequency(terms: Sequence[FloatArray]) -> float:
    """Bound (rad/s) on every root on the imaginary axis, whatever the delays; terms[0] acts without delay."""
    return norm_of([terms[0] - terms[0].T]) / 2.0 + norm_of(terms[1:])


def sweep_frequencies(A0: FloatArray, A1: FloatArray) -> FloatArray:
    """Ascending frequencies (rad/s) up to the bound on crossing frequencies, dense around resonances."""
    highest = 1.1 * highest_frequency((A0, A1))
    grid = [highest * np.logspace(-_DECADES, 0.0, _DECADES * _POINTS_PER_DECADE)]
    roots = np.concatenate([np.linalg.eigvals(A0), np.linalg.eigvals(A0 + A1)])
    offsets = np.sinh(np.linspace(-5.0, 5.0, 41))
    for root in roots[roots.imag > 0.0]:
        width = max(abs(root.real), 1e-6 * abs(root.imag))
        grid.append(root.imag + width * offsets)
    # offset from the pole itself, where the resolvent does not exist
    omega = np.unique(np.concatenate(grid)) * (1.0 + 1e-9)
    return omega[(omega > 0.0) & (omega <= highest)]


def remembered(loci: Loci, omega: FloatArray) -> Loci:
    """The loci as a function that evaluates no frequency twice; those of `omega` (k,) are computed now, in one call."""
    known = dict(zip(omega.tolist(), loci(omega), strict=True))

    def remembering(omega: FloatArray) -> ComplexArray:
        wanted = omega.tolist()
        if new := [each for each in dict.fromkeys(wanted) if each not in known]:
            known.update(zip(new, loci(np.array(new)), strict=True))
        return np.array([known[each] for each in wanted])

    return remembering


def delay_loci(A0: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray | float = 0.0) -> Loci:
    """A function from omega (k,) to the eigenvalues (k, r) of C (j omega I - A0)^{-1} B + D."""

    def loci(omega: FloatArray) -> ComplexArray:
        resolvent = np.zeros((omega.size, *A0.shape), dtype=np.complex128) - A0
        resolvent.reshape(omega.size, -1)[:, :: len(A0) + 1] += 1j * omega[:, np.newaxis]
        loop = C @ solved_beside_poles(resolvent, B) + D
        return (loop[:, :, 0] if B.shape[1] == 1 else np.linalg.eigvals(loop)).astype(np.complex128, copy=False)

    return loci


def unit_gain_roots(A: FloatArray, B: FloatArray, C: FloatArray, D: float = 0.0) -> ComplexArray:
    """Eigenvalues (2n,) of a Hamiltonian matrix, among them all j omega with |C (j omega I - A)^{-1} B + D| = 1.

    Imaginary eigenvalues of this matrix decide whether an H-infinity norm exceeds one.
    """
    # |D| = 1 sends one solution to infinity
    rest = 1.0 - D * D if abs(1.0 - D * D) > 1e-12 else 1e-12
    corner, n = A + B @ C * (D / rest) if D else A, len(A)
    hamiltonian = np.empty((2 * n, 2 * n))
    hamiltonian[:n, :n], hamiltonian[:n, n:] = corner, B @ B.T / rest
    hamiltonian[n:, :n], hamiltonian[n:, n:] = C.T @ C / -rest, -corner.T
    return np.linalg.eigvals(hamiltonian).astype(np.complex128)


def solved_beside_poles(matrices: NDArray[Any], right: NDArray[Any]) -> NDArray[Any]:
    """X with M X = `right` for a stack of matrices M (k, n, n), huge where a matrix is singular to rounding.

    `right` is (n, r), common to all matrices, or (k, n, r).

    A resolvent is singular to rounding on a pole and near a multiple one (for a double integrator, at frequencies below
    1e-8 of its norm). Loci are infinite or large there; eps in place of a zero singular value makes them large.
    """
    try:
        return np.linalg.solve(matrices, right.astype(np.complex128))
    except np.linalg.LinAlgError:
        U, singular, Vh = np.linalg.svd(matrices)
        floor = np.maximum(_EPS * singular[:, :1], _LEAST)
        inner = (U.conj().swapaxes(1, 2) @ right) / np.maximum(singular, floor)[:, :, np.newaxis]
        return Vh.conj().swapaxes(1, 2) @ inner


def log_abs(values: ComplexArray) -> FloatArray:
    """Natural logarithms of the moduli, clipped for zero and infinity."""
    return np.log(np.minimum(np.maximum(np.abs(values), 1e-300), 1e300))


def log_moduli(values: ComplexArray) -> FloatArray:
    """`log_abs`, the largest first along the last axis."""
    return -np.sort(-log_abs(values), axis=-1)


def unit_crossings(loci: Loci, points: FloatArray, *, zero: float = 0.0) -> list[UnitCrossing]:
    """All crossings of the unit circle that change the number of moduli above one between neighbouring `points`.

    The points are ascending frequencies. They must separate crossings in opposite directions, but not crossings in the
    same direction. A log modulus of at most `zero` is taken for zero.
    """
    logs = log_moduli(loci(points))
    above = (logs > 0.0).sum(axis=1)
    crossed = [(i, rank) for i, ends in enumerate(pairwise(above.tolist())) for rank in range(min(ends), max(ends))]
    if not crossed:
        return []
    at, nth = np.array(crossed).T

    def nth_log(omega: FloatArray) -> FloatArray:
        found = log_moduli(loci(omega))[np.arange(omega.size), nth]
        return found * (np.abs(found) > zero)

    omega = bracketed_roots(nth_log, points[at], points[at + 1], logs[at, nth], logs[at + 1, nth])
    outward = np.sign(above[at] - above[at + 1])
    return _read_loci(loci, omega, outward)


def without_limits_at_zero(loci: Loci, crossings: list[UnitCrossing], highest: float) -> list[UnitCrossing]:
    """The crossings without the artefacts of rounding at a locus with modulus one at zero frequency.

    Where A0 + z A1 is singular for some |z| = 1 (z = -1 for x' = -x - x(t - tau)), a locus tends to 1/z as the
    frequency tends to zero, and its modulus differs from one by less than rounding; no finite delay belongs to it. A
    slow motion beside fast ones that does cross has a locus that still changes with the frequency.
    """

    def is_flat(crossing: UnitCrossing) -> bool:
        rows = loci(np.array([crossing.omega / 2.0, 2.0 * crossing.omega]))
        return bool(np.all(np.min(np.abs(rows - crossing.locus), axis=1) < _FLAT))

    return [crossing for crossing in crossings if crossing.omega > _SLOW * highest or not is_flat(crossing)]


def with_extrema(loci: Loci, omega: FloatArray, *, near: float = _NEAR_UNIT) -> FloatArray:
    """The frequencies, with those added at which local extrema of the sorted log moduli may reach zero.

    Extrema whose sampled log modulus is `near` or more away from zero are assumed not to reach it.
    """
    logs = log_moduli(loci(omega))
    peak, valley = may_reach_zero(omega, logs), may_reach_zero(omega, -logs)
    row, rank = np.nonzero((peak | valley) & (np.abs(logs[1:-1]) < near))
    if row.size == 0:
        return omega
    sign = np.where(peak[row, rank], 1.0, -1.0)

    def height(at: FloatArray) -> FloatArray:
        return sign * log_moduli(loci(at))[np.arange(at.size), rank]

    return np.union1d(omega, peaks(height, omega[row], omega[row + 2]))


def swept_crossings(loci: Loci, omega: FloatArray) -> list[UnitCrossing]:
    """The crossings of loci between ascending frequencies, with extrema near one refined and limits at zero removed."""
    omega = with_extrema(loci, omega)
    return without_limits_at_zero(loci, unit_crossings(loci, omega), float(omega[-1]))


def slope_sign(loci: Loci, omega: float, locus: complex) -> int:
    """+1 if the modulus of this locus falls through one at omega, -1 if it rises through one, 0 if it does neither."""
    # far above the error of a locus, far below the spacing of crossing frequencies
    step = 1e-5 * omega
    rows = loci(np.array([omega - step, omega + step]))
    before, after = (log_abs(row[np.argmin(np.abs(row - locus))]) for row in rows)
    return 0 if before * after >= 0.0 else int(np.sign(before))


def _read_loci(loci: Loci, omega: FloatArray, outward: NDArray[np.int_]) -> list[UnitCrossing]:
    """Crossings at the frequencies found, with the loci that cross at the same frequency told apart.

    Loci of equal modulus at all frequencies (symmetric formations) swap places in the sorted order from one evaluation
    to the next, so all that cross at one frequency are read from one evaluation. Where the count goes up and down at
    one frequency, by rounding or because loci cross in opposite directions, each locus is followed on its own.
    """
    places: list[list[tuple[float, int]]] = []
    for at, way in sorted(zip(omega.tolist(), outward.tolist(), strict=True)):
        if places and at - places[-1][-1][0] <= _SAME_PLACE * at:
            places[-1].append((at, way))
        else:
            places.append([(at, way)])
    centres = [sum(at for at, _ in place) / len(place) for place in places]
    crossings: list[UnitCrossing] = []
    for place, centre, row in zip(places, centres, loci(np.array(centres)), strict=True):
        from_one, ways = np.abs(log_abs(row)), {way for _, way in place}
        if len(ways) == 1 and len(place) <= row.size:
            nearest = row[np.argsort(from_one)[: len(place)]].tolist()
            crossings += [UnitCrossing(centre, locus, *ways) for locus in nearest]
        else:
            on_circle = row[from_one < _ON_CIRCLE].tolist()
            crossings += [UnitCrossing(centre, locus, slope_sign(loci, centre, locus)) for locus in on_circle]
    return crossings
