"""Known delays and one unknown delay: x'(t) = sum_i A_i x(t - d_i - k_i tau) with d_i in seconds and k_i whole.

The loci are those of `_commensurate`, but the known delays make them depend on the frequency through e^{-j omega d_i}.
The crossing frequencies therefore come from a sweep, not from algebra; it resolves the rotation of e^{-j omega d_i} and
refines extrema near one. The argument principle counts the roots that are unstable at tau = 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import pi

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import ComplexArray, FloatArray, IntArray
from gains.core.errors import BadModelError, DisagreementError
from gains.core.structure import Block, balanced, distinct_blocks, is_singular_for_any_delay
from gains.delay._commensurate import column_space, companion_loci
from gains.delay._crossings import Crossing, DelayedTerm
from gains.delay._loci import swept_crossings
from gains.delay._windows import BlockAnalysis, block_analysis, without_zero, zero_passage

# a loop without delay whose skew part is below this share of its norm is symmetric
_SYMMETRIC = 1e-12
# rotation (rad) of e^{-j omega d} between neighbouring frequencies, and frequencies per decade: of a sweep, of a count
_TURN, _COUNT_TURN = 0.1, 0.5
_POINTS_PER_DECADE, _COUNT_GRID, _DECADES = 60, 20, 9
# more frequencies than this take more than a few seconds
_MOST_POINTS = 60_000
# the Hurwitz reference for counting roots is this far left of the axis, relative to the norm
_SHIFT = 0.02
# relative offsets of extra points around a frequency at which roots are near the axis
_BESIDE = np.logspace(-7.0, -1.0, 7)
# entries in a stack of matrices: 3 MB
_LARGEST_STACK = 200_000
# largest phase change (rad) of the determinant between neighbouring frequencies, largest deviation from the change that
# its slopes predict, and how often intervals may be halved to meet both
_MOST_TURN, _MISSED, _HALVINGS = 1.0, 0.2, 40
# the slope is a difference over this share of the gap between frequencies, which amplifies rounding a thousandfold
_SLOPE_STEP = 1e-3
# least frequency of a count if there is a root at zero, as a share of the highest
_LEAST_FREQUENCY = 1e-7


def analyse_mixed_block(block: Block, terms: Sequence[DelayedTerm], leave_out_zero: bool) -> BlockAnalysis:
    """Analyse one block of x'(t) = sum A x(t - known_s - multiple tau), with the delays of `terms`.

    `unstable` counts the roots at tau = 0, with the known delays. The crossing frequencies come from a sweep: a search,
    not a proof. Raises BadModelError if the known delays are so long that the sweep would be too large, and
    DisagreementError if a root is too close to the imaginary axis at tau = 0 to be counted.
    """
    known_s, multiples = np.array([t.known_s for t in terms]), np.array([t.multiple for t in terms])
    parts = _Parts(np.array(balanced(*block.matrices)), known_s, multiples)
    delayed = [replace(term, matrix=matrix) for term, matrix in zip(terms, parts.matrices, strict=True)]
    passage = zero_passage(parts.matrices, known_s, multiples) if leave_out_zero else None
    if passage is None and is_singular_for_any_delay(parts.matrices):
        return BlockAnalysis(block.copies, delayed, fixed_on_axis=True)
    unstable = _unstable_roots(parts, passage is not None)
    found = without_zero(_crossings(parts), passage, parts.highest())
    return block_analysis(block.copies, delayed, found, unstable, passage)


def count_unstable_roots(
    terms: Sequence[tuple[ArrayLike, float]], *, leave_out_zero: bool = False, beside: Sequence[float] = ()
) -> int:
    """The number of roots of x'(t) = sum A x(t - d) with positive real part, by the argument principle.

    `terms` are pairs (A, d): a real matrix (n, n) in 1/s and its delay in s. With `leave_out_zero` the simple root at
    s = 0 of a block whose matrices have a singular sum is not counted. `beside` are frequencies (rad/s) at which roots
    are known to be near the imaginary axis and the grid is refined: two roots at one place change the phase by a whole
    turn between two points, which looks like no change. Exceptions as for `analyse_mixed_block`.
    """
    delays_s, count = np.array([delay_s for _, delay_s in terms]), 0
    for block in distinct_blocks(*(np.asarray(matrix, dtype=np.float64) for matrix, _ in terms)):
        parts = _Parts(np.array(balanced(*block.matrices)), delays_s, np.zeros(len(terms), dtype=np.intp))
        at_zero = leave_out_zero and is_singular_for_any_delay(parts.matrices)
        count += block.copies * _unstable_roots(parts, at_zero, beside)
    return count


@dataclass(frozen=True, eq=False)
class _Parts:
    """Terms of one block: `matrices` (terms, n, n), `known_s` (terms,), `multiples` (terms,)."""

    matrices: FloatArray
    known_s: FloatArray
    multiples: IntArray

    @property
    def size(self) -> int:
        return self.matrices.shape[1]

    @property
    def degree(self) -> int:
        late = np.array([bool(matrix.any()) for matrix in self.matrices])
        return int(self.multiples[late].max(initial=0))

    def at(self, omega: FloatArray) -> ComplexArray:
        """The sum of A_i e^{-j omega d_i} for each multiple 0, ..., m, shape (frequencies, m + 1, n, n)."""
        turned = np.exp(-1j * omega[:, np.newaxis] * self.known_s)[:, :, np.newaxis, np.newaxis] * self.matrices
        return np.stack([turned[:, self.multiples == k].sum(axis=1) for k in range(self.degree + 1)], axis=1)

    def sum_at(self, omega: FloatArray) -> ComplexArray:
        """The sum of all A_i e^{-j omega d_i}, shape (frequencies, n, n)."""
        turned = np.exp(-1j * np.outer(omega, self.known_s))
        return np.asarray(np.tensordot(turned, self.matrices, axes=1), np.complex128)

    def highest(self) -> float:
        """Bound (rad/s) on every root on the imaginary axis, from spectral norms."""
        at_once = (self.known_s == 0.0) & (self.multiples == 0)
        now = self.matrices[at_once].sum(axis=0)
        return 1.01 * float(np.linalg.norm((now - now.T) / 2.0, 2) + self.norms[~at_once].sum())

    @cached_property
    def norms(self) -> FloatArray:
        return np.linalg.norm(self.matrices, 2, axis=(1, 2))

    def frequencies(self, highest: float, turn: float = _TURN, per_decade: int = _POINTS_PER_DECADE) -> FloatArray:
        """Frequencies up to `highest` that resolve the rotation of e^{-j omega d}; BadModelError if too many."""
        longest_s = float(self.known_s.max())
        points = highest * longest_s / turn
        if points > _MOST_POINTS:
            raise BadModelError(
                f"the longest known delay is {longest_s} s, which takes {points:.3g} frequencies; "
                f"at most {_MOST_POINTS} are wanted"
            )
        turning = np.linspace(0.0, highest, int(points) + 3 * per_decade)
        decades = highest * np.logspace(-_DECADES, 0.0, _DECADES * per_decade)
        # offset from poles of the resolvent on the axis at round numbers
        return np.union1d(turning[1:], decades) * (1.0 + 1e-9)


def _crossings(parts: _Parts) -> list[Crossing]:
    if parts.degree == 0:
        return []
    loci = companion_loci(parts.at, column_space(list(parts.matrices[parts.multiples > 0])))
    found = swept_crossings(loci, parts.frequencies(1.1 * parts.highest()))
    return [Crossing(each.omega, each.delay_s, each.outward, roots=2) for each in found]


def _unstable_roots(parts: _Parts, at_zero: bool, beside: Sequence[float] = ()) -> int:
    """Number of roots with positive real part at tau = 0: winding of det M(j omega) / det(j omega I - H).

    M(s) = sI - A(s). H is the loop without delay, shifted left until it is Hurwitz, so the quotient is analytic in the
    right half plane and its phase changes little. Above the bound on crossings, the eigenvalues s of A have imaginary
    parts below omega, so the angle of j omega - s stays in (0, pi) and the phase is known directly. If `at_zero`, a
    simple root at zero is divided out. The phase is summed over steps short enough to be predicted by its slope.
    """
    highest = parts.highest()
    hurwitz = np.linalg.eigvals(parts.matrices.sum(axis=0))
    zero = _SYMMETRIC * float(parts.norms.sum())
    if highest <= zero:  # a symmetric matrix and no delay: all roots are real
        others = np.arange(hurwitz.size) != np.argmin(np.abs(hurwitz)) if at_zero else slice(None)
        return int(np.count_nonzero(hurwitz[others].real > zero))
    hurwitz = hurwitz - max(0.0, float(hurwitz.real.max()) + _SHIFT * (highest + float(np.abs(hurwitz).max())))
    # M(j omega) = M(0) (I + E) with the norm of E below 1 / 4n up to `still`: the phase hardly changes there
    slowest = float(np.linalg.svd(parts.matrices.sum(axis=0), compute_uv=False)[-1])
    still = min(0.5 * highest, slowest / (4.0 * parts.size * (1.0 + float(parts.known_s @ parts.norms))))
    # with a root at zero, the determinant is real up to the least frequency, and below it only rounding
    omega: FloatArray = parts.frequencies(highest, _COUNT_TURN, _COUNT_GRID)
    phase: FloatArray
    slope: FloatArray
    omega = omega[omega > (_LEAST_FREQUENCY * highest if at_zero else still)]
    near = np.outer(np.array(beside), np.concatenate([1.0 - _BESIDE, [1.0], 1.0 + _BESIDE])).ravel()
    omega = np.union1d(omega, near[(near > omega.min(initial=np.inf)) & (near < omega.max(initial=0.0))])
    omega = omega if at_zero else np.append(0.0, omega)
    phase, slope = _turning(parts, hurwitz, omega, np.diff(omega, append=(1.0 + _SLOPE_STEP) * highest))
    for _ in range(_HALVINGS):
        expected = np.diff(omega) * (slope[1:] + slope[:-1]) / 2.0
        missed = np.angle(np.exp(1j * (np.diff(phase) - expected)))
        coarse = np.flatnonzero((np.abs(missed) > _MISSED) | (np.abs(expected) > _MOST_TURN))
        if coarse.size == 0:
            break
        between = (omega[coarse] + omega[coarse + 1]) / 2.0
        at_between = _turning(parts, hurwitz, between, omega[coarse + 1] - between)
        omega = np.insert(omega, coarse + 1, between)
        phase, slope = (np.insert(old, coarse + 1, new) for old, new in zip((phase, slope), at_between, strict=True))
    else:
        raise DisagreementError("a root is too close to the imaginary axis at tau = 0 to count it on either side")
    angles = np.angle(1j * omega[[0, -1], np.newaxis] - hurwitz).sum(axis=1)
    turned = float((expected + missed).sum()) + float(angles[1] - angles[0])
    last = np.linalg.eigvals(parts.sum_at(omega[-1:])[0])
    beyond = float(np.angle(1j * omega[-1] - last).sum())
    return round((beyond - turned) / pi - (0.5 if at_zero else 0.0))


def _turning(parts: _Parts, hurwitz: ComplexArray, omega: FloatArray, gap: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The phase of det M(j omega) / prod (j omega - hurwitz), modulo 2 pi, and its derivative by omega.

    The derivative is a difference quotient over a small part of the `gap` to the next frequency: a second determinant
    takes a third of the time of the inverse in tr(M^{-1} M').
    """
    step = _SLOPE_STEP * gap
    phases = _phase(parts, hurwitz, omega), _phase(parts, hurwitz, omega + step)
    return phases[0], np.angle(np.exp(1j * (phases[1] - phases[0]))) / step


def _phase(parts: _Parts, hurwitz: ComplexArray, omega: FloatArray) -> FloatArray:
    signs: list[ComplexArray] = []
    for share in np.array_split(omega, max(1, omega.size * parts.size**2 // _LARGEST_STACK)):
        matrix = -parts.sum_at(share)
        np.einsum("kii->ki", matrix)[:] += 1j * share[:, np.newaxis]
        # at a root the matrix is singular to rounding and its sign is 0; the neighbouring points decide
        signs.append(np.linalg.slogdet(matrix)[0])
    return np.angle(np.concatenate(signs)) - np.angle(1j * omega[:, np.newaxis] - hurwitz).sum(axis=1)
