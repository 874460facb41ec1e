"""Crossings of the imaginary axis by roots of x'(t) = A0 x(t) + A1 x(t - tau), found without a grid.

An algebraic test gives a finite list of frequencies near every crossing. Counts of the loci of the loop (`_loci`)
between these frequencies then give the number and direction of the crossings and bracket them, however inaccurate the
list is. Newton's method on the characteristic matrix gives the last digits. Its sensitivity to rounding gives their
error, which at a multiple root is large for any method.
"""

import cmath
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import inf

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray, IntArray
from gains.core.structure import balanced, distinct_blocks
from gains.delay._loci import (
    Loci,
    UnitCrossing,
    delay_loci,
    factor_rank,
    highest_frequency,
    log_abs,
    norm_of,
    remembered,
    slope_sign,
    sweep_frequencies,
    unit_crossings,
    unit_gain_roots,
    without_limits_at_zero,
)

# largest n for eigenvalues of an n^2 x n^2 matrix: 0.3 s at n = 20, growing with the sixth power
LARGEST_ALGEBRAIC_BLOCK = 24
# candidates within this distance of the imaginary axis, relative to the norm, are kept: an m-fold eigenvalue is known
# to eps^(1/m), and a false candidate costs only one evaluation of the loci
_CANDIDATE_TOLERANCE = 1e-3
# a locus whose log modulus is this close to zero at a candidate without a counted crossing is a hidden crossing
_TOUCH = 1e-11
# largest least singular value at a crossing, relative to the sum of the norms of the terms: rounding is far below
_RESIDUAL = 1e-5
_EPS = float(np.finfo(np.float64).eps)
# a log modulus this small is zero to rounding
_ROUNDING = 2.0 * _EPS
# rad; the angle of a computed unit eigenvalue is known to a few hundred eps
_ZERO_ANGLE = 1e-11
# backward error of a crossing, in units of n eps and the norm: rounding of the matrices, a similarity, an eigenvalue
_BACKWARD = 2.0
# singular values below this, relative to the norm, belong to roots that cross at the same frequency and delay
_TOGETHER = 1e-6


@dataclass(frozen=True, eq=False)
class DelayedTerm:
    """The term A x(t - known_s - multiple * tau): `matrix` is A (n, n) in 1/s, `multiple` is whole."""

    matrix: FloatArray
    known_s: float
    multiple: int

    def delay_s(self, tau_s: float) -> float:
        """The delay (s) of this term for a value of the unknown tau."""
        return self.known_s + self.multiple * tau_s


def by_multiple(terms: Sequence[DelayedTerm]) -> list[FloatArray]:
    """A_0, A_1, ..., A_m of x' = sum_k A_k x(t - k tau), summed from terms with known_s = 0."""
    alike = [[term.matrix for term in terms if term.multiple == k] for k in range(max(t.multiple for t in terms) + 1)]
    return [sum(rest, first) for first, *rest in (each or [np.zeros_like(terms[0].matrix)] for each in alike)]


@dataclass(frozen=True)
class Crossing:
    """Roots +-j `omega_rad_s` on the imaginary axis at the delays `delay_s` + 2 pi k / `omega_rad_s`, k = 0, 1, ...

    `direction` is +1 if they move into the right half plane as the delay grows, -1 if they move out of it, 0 if they
    touch the axis and return; it is the same for every k. `roots` counts the roots that cross together: 2, times the
    number of equal blocks. At frequency 0 a single real root passes another that stays at s = 0, once, at `delay_s`.
    """

    omega_rad_s: float
    delay_s: float
    direction: int
    roots: int


def axis_crossings(A0: FloatArray, A1: FloatArray) -> list[Crossing]:
    """All crossings of the imaginary axis of one block, omega > 0, in ascending frequency.

    The root moves right exactly where the modulus of the locus falls with the frequency: with lambda(s) = e^{s tau},
    1 / (ds/dtau) = (d ln lambda / ds - tau) / s, whose real part at s = j omega is -(d ln|lambda| / d omega) / omega.
    """
    B, C = factor_rank(A1)
    if B.shape[1] == 0:
        return []
    return crossings_of_loci((A0, A1), delay_loci(A0, B, C), _near_crossings(A0, A1, B, C))


def crossings_of_loci(terms: Sequence[FloatArray], loci: Loci, places: ComplexArray) -> list[Crossing]:
    """All crossings of one block, touches included; each must have one of the `places` near it, close to the axis."""
    highest = highest_frequency(terms)
    candidates = _near_axis(places, highest)
    points = separating_points(candidates, highest)
    loci = remembered(loci, np.concatenate([points, candidates]))
    crossings = unit_crossings(loci, points, zero=_ROUNDING)
    crossings += hidden_crossings(loci, candidates, crossings)
    return polished(terms, without_limits_at_zero(loci, crossings, highest))


def _near_axis(roots: ComplexArray, highest: float) -> FloatArray:
    """Ascending frequencies of the roots that are near the imaginary axis and below the bound on crossings."""
    near = (root for root in roots.ravel().tolist() if abs(root.real) <= _CANDIDATE_TOLERANCE * (highest + abs(root)))
    return np.array(sorted({abs(root.imag) for root in near if 0.0 < abs(root.imag) < 1.1 * highest}))


def _near_crossings(A0: FloatArray, A1: FloatArray, B: FloatArray, C: FloatArray) -> ComplexArray:
    """Numbers, one of which is near every crossing of the imaginary axis; if the block is large, those of a sweep."""
    if B.shape[1] == 1:
        return unit_gain_roots(A0, B, C)
    if A0.shape[0] <= LARGEST_ALGEBRAIC_BLOCK:
        return _kronecker_roots(A0, A1)
    return (1j * sweep_frequencies(A0, A1)).astype(np.complex128)


def _kronecker_roots(A0: FloatArray, A1: FloatArray) -> ComplexArray:
    """Square roots of the eigenvalues of K- K+, where K+-X = A0 X +- A1 X'.

    With (A0 + z A1) v = j w v, |z| = 1, z = e^{-j theta}, the matrix Y = e^{j theta/2} v v* satisfies
    A0 Y + A1 Y* = j w Y; its real and imaginary parts R, S give K+ R = -w S, K- S = w R, so K- K+ R = -w^2 R.
    """
    n = A0.shape[0]
    identity = np.eye(n)
    straight = np.einsum("im,jl->ijml", A0, identity).reshape(n * n, n * n)
    crossed = np.einsum("il,jm->ijml", A1, identity).reshape(n * n, n * n)
    return np.sqrt(np.linalg.eigvals((straight - crossed) @ (straight + crossed)).astype(np.complex128))


def separating_points(candidates: FloatArray, highest: float) -> FloatArray:
    """Ascending frequencies that bracket every candidate narrowly and separate it from its neighbours."""
    ends, known = (1e-12 * highest, 1.1 * highest), candidates.tolist()
    beside = [each + way * (1e-7 * each + 1e-15 * highest) for each in known for way in (-1.0, 1.0)]
    points = {*ends, *beside, *((before + after) / 2.0 for before, after in pairwise(known))}
    return np.array(sorted(each for each in points if ends[0] <= each <= ends[1]))


def hidden_crossings(loci: Loci, candidates: FloatArray, found: list[UnitCrossing]) -> list[UnitCrossing]:
    """Crossings that leave the count of moduli unchanged: two in opposite directions at one frequency, or a touch."""
    if candidates.size == 0:
        return []
    values = loci(candidates)
    row, column = np.nonzero(np.abs(log_abs(values)) < _TOUCH)
    hidden: list[UnitCrossing] = []
    for omega, locus in zip(candidates[row].tolist(), values[row, column].tolist(), strict=True):
        known = (*found, *hidden)
        if not any(abs(c.omega - omega) < 1e-6 * omega and abs(c.locus - locus) < 1e-4 for c in known):
            hidden.append(UnitCrossing(omega=omega, locus=locus, outward=slope_sign(loci, omega, locus)))
    return hidden


def polished(terms: Sequence[FloatArray], found: Sequence[UnitCrossing]) -> list[Crossing]:
    """The crossings, each refined by `_polish`, without those that are no roots; in ascending frequency."""
    refined = [each for crossing in found if (each := _polish(terms, crossing)) is not None]
    return sorted(refined, key=lambda crossing: (crossing.omega_rad_s, crossing.delay_s))


def _polish(terms: Sequence[FloatArray], crossing: UnitCrossing) -> Crossing | None:
    """A crossing after a step of Newton's method on u*M v = 0, M = j w I - sum_k A_k e^{-j k theta}; None if no root.

    u, v are the singular vectors of the least singular value. One step suffices: the largest of 3,000, some of them at
    near-tangent crossings, was 1e-10 of the frequency, and its square is below rounding. The residual u*M v is rounded
    less than the singular value, which halves the error. If two singular values are small (roots cross together) or
    both unknowns act alike (near-tangent), the bracketed value is kept.

    There is no root if no singular value is small. Near a multiple pole of the resolvent some loci are huge. Small ones
    beside them are rounding errors, which may cross the unit circle.
    """
    omega, theta = crossing.omega, cmath.phase(crossing.locus)
    late = [matrix * cmath.exp(-1j * k * theta) for k, matrix in enumerate(terms[1:], 1)]
    M = -sum(late, terms[0])
    M.flat[:: len(M) + 1] += 1j * omega
    U, sizes, Vh = np.linalg.svd(M)
    *larger, least = sizes.tolist()
    if least > _RESIDUAL * (omega + norm_of(terms)):
        return None
    if not larger or larger[-1] >= 1e-6 * larger[0]:
        u, v = U[:, -1].conj(), Vh[-1].conj()
        turned = sum(k * matrix for k, matrix in enumerate(late, 1))
        rest, by_omega, by_theta = complex(u @ M @ v), 1j * complex(u @ v), 1j * complex(u @ turned @ v)
        determinant = (by_omega.conjugate() * by_theta).imag
        if abs(determinant) > 1e-6 * abs(by_omega) * abs(by_theta):
            step_omega = (by_theta.conjugate() * rest).imag / determinant
            if abs(step_omega) <= 1e-6 * omega:
                omega, theta = omega + step_omega, theta - (by_omega.conjugate() * rest).imag / determinant
    # a theta of -1e-17 is a crossing at zero delay, not one a whole period later
    theta = 0.0 if abs(theta) < _ZERO_ANGLE else theta % (2.0 * np.pi)
    return Crossing(omega, theta / omega, crossing.outward, roots=2)


def crossing_errors(terms: Sequence[DelayedTerm], places: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Estimated errors of the frequency omega (rad/s) and delay tau (s) of crossings, from their sensitivity.

    `places` are the pairs (omega, tau). Let u, v be the singular vectors of the least singular value of
    M(j omega, tau). A change E of M, of norm epsilon, moves the crossing by the solution of
    a d omega + b d tau = -u*E v with a = u*(dM/d omega) v, b = u*(dM/d tau) v: two real equations. Near a multiple root
    a and b become small; the estimate is capped by epsilon^(1/n), the error at the highest possible multiplicity.
    """
    blocks = [np.array(balanced(*block.matrices)) for block in distinct_blocks(*(term.matrix for term in terms))]
    multiples = np.array([term.multiple for term in terms])
    return [
        _error(blocks, np.array([term.delay_s(tau_s) for term in terms]), multiples, omega, tau_s)
        for omega, tau_s in places
    ]


def _error(
    blocks: Sequence[FloatArray], delays_s: FloatArray, multiples: IntArray, omega: float, tau_s: float
) -> tuple[float, float]:
    """The errors of one crossing, attributed to the block whose M is nearest to singular."""
    worst, least = (0.0, 0.0), inf
    for matrices in blocks:
        n = matrices.shape[1]
        turned = np.exp(-1j * omega * delays_s)[:, np.newaxis, np.newaxis] * matrices
        M = 1j * omega * np.eye(n) - turned.sum(axis=0)
        scale = omega + float(np.linalg.norm(matrices, axis=(1, 2)).sum())
        if scale == 0.0:
            continue
        singular, U, V = nearly_null(M, scale)
        if singular / scale > least:
            continue
        least = singular / scale
        by_s = np.eye(n) + np.tensordot(delays_s, turned, axes=1)
        # of the roots that cross together, take the one that moves most
        left, _, right = np.linalg.svd(U.conj().T @ by_s @ V)
        u, v = (U @ left[:, -1]).conj(), V @ right[-1].conj()
        by_omega = 1j * complex(u @ by_s @ v)
        by_tau = 1j * omega * complex(u @ np.tensordot(multiples, turned, axes=1) @ v)
        epsilon = _BACKWARD * n * _EPS * scale
        determinant = abs((by_omega.conjugate() * by_tau).imag)
        if omega == 0.0:
            # a real root passes the one at zero: its delay is a ratio of two numbers
            worst = (0.0, tau_s * epsilon / scale / max(abs(complex(u @ v)), 1e-300))
            continue
        cap = (epsilon / scale) ** (1.0 / max(n, 2))
        found = [epsilon * abs(by) / determinant if determinant > 0.0 else inf for by in (by_tau, by_omega)]
        worst = min(found[0], cap * omega), min(found[1], cap * max(tau_s, 1.0 / omega))
    return worst


def nearly_null(M: ComplexArray, scale: float) -> tuple[float, ComplexArray, ComplexArray]:
    """The least singular value of M (n, n), and the singular vectors U, V (n, k) of it and those close to it.

    If M v = 0 and u*M = 0, the last column and row of the inverse of M bordered by b and c* are multiples of v and u*,
    and its norm is at least one over the second least singular value. The inverse takes a tenth of the time of an SVD.
    """
    n = len(M)
    # no symmetry of a loop makes its singular vectors orthogonal to this border
    border = scale / np.sqrt(n) * np.exp(1j * np.arange(n) ** 2)
    bordered = np.block([[M, border[:, np.newaxis]], [border.conj(), np.zeros(1, np.complex128)]])
    try:
        inverse = np.array(np.linalg.inv(bordered), dtype=np.complex128)
    except np.linalg.LinAlgError:
        inverse = np.full_like(bordered, np.inf)
    u: ComplexArray = inverse[n, :n].conj()
    v: ComplexArray = inverse[:n, n]
    sizes = float(np.linalg.norm(u)), float(np.linalg.norm(v))
    if _TOGETHER * scale * float(np.linalg.norm(inverse)) < 1.0:
        return abs(complex(inverse[n, n])) / (sizes[0] * sizes[1]), (u / sizes[0])[:, None], (v / sizes[1])[:, None]
    U, singular, Vh = np.linalg.svd(M)
    first = min(n - 1, int(np.count_nonzero(singular > _TOGETHER * scale)))
    return float(singular[-1]), U[:, first:], Vh[first:].conj().T
