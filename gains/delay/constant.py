"""How much constant delay a linear loop x'(t) = A0 x(t) + A1 x(t - tau) takes: exact, without a grid.

The roots of det(sI - A0 - A1 e^{-s tau}) move continuously with tau and change half plane only through the imaginary
axis, at delays that come in arithmetic sequences (theta + 2 pi k) / omega. Starting from the unstable eigenvalues of
A0 + A1 and counting crossings in and out gives every window of stability. Strongly connected blocks are analysed one
by one, see `gains.core.structure`.

Methods of this kind are set side by side in E. Jarlebring and M. E. Hochstenbach, "Polynomial two-parameter eigenvalue
problems and matrix pencil methods for stability of delay-differential equations", arXiv:0809.3634. The test
used here is derived in `gains.delay._crossings`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf, pi

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import ComplexArray, FloatArray
from gains.core.errors import BadModelError, DisagreementError
from gains.core.structure import Block, balanced, distinct_blocks, is_singular_for_any_delay, square_matrices
from gains.delay._crossing_error import DelayedTerm, crossing_error
from gains.delay._crossings import AxisCrossing, axis_crossings, highest_frequency
from gains.delay._zero_root import ZeroPassage, zero_passage
from gains.delay.sweep import frequency_sweep_margin

__all__ = [
    "Crossing",
    "DelayAnalysis",
    "analyse_delay",
    "delay_margin",
    "frequency_sweep_margin",
    "stability_windows",
]

# more critical delays than this are not listed: a near-tangent pair of crossings can have millions
_MOST_EVENTS = 200_000
# two critical delays closer than this (relative) are one
_SAME_DELAY = 1e-12
# windows or gaps narrower than this (relative) are looked at again, with the errors of the critical delays
_NARROW = 1e-2


@dataclass(frozen=True)
class Crossing:
    """Roots +-j `omega_rad_s` on the imaginary axis at the delays `delay_s` + 2 pi k / `omega_rad_s`, k = 0, 1, ...

    `direction` is +1 when they go into the right half plane as the delay grows, -1 when they come out, 0 when they
    touch the axis and return; it is the same for every k. `roots` counts the roots that cross here together: 2, times
    the number of equal blocks. At the frequency 0 a real root passes s = 0 beside one that stays there: once, at
    `delay_s`, and alone.
    """

    omega_rad_s: float
    delay_s: float
    direction: int
    roots: int


@dataclass(frozen=True)
class DelayAnalysis:
    """Verdict on x'(t) = A0 x(t) + A1 x(t - tau) for every constant delay tau >= 0.

    `stable_intervals_s` are the open windows of asymptotic stability, `inf` for an unbounded one; zero delay itself
    belongs to a window that begins at 0 unless A0 + A1 has roots on the imaginary axis, which then leave it to the
    left. `delay_margin_s` is the end of the window that begins at 0, or 0 when none does. `delay_independent` is true
    when the loop is stable at every delay. `crossings` ascend by delay. `unstable_roots_at_zero_delay` counts
    eigenvalues of A0 + A1 with positive real part. The windows are complete up to `complete_to_s`, which is `inf`
    unless the caller gave a horizon or the critical delays were too many to list; the margin is exact all the same.
    `roots_fixed_at_zero` counts the roots at s = 0 that were left out on the caller's wish.
    """

    stable_intervals_s: tuple[tuple[float, float], ...]
    delay_margin_s: float
    delay_independent: bool
    crossings: tuple[Crossing, ...]
    unstable_roots_at_zero_delay: int
    complete_to_s: float
    roots_fixed_at_zero: int = 0


@dataclass(frozen=True)
class BlockAnalysis:
    """What the analysis of one block found, for all its `copies`; `roots` as of `Crossing` for one of them.

    `fixed_at_zero` says that a simple root at s = 0 was left out, `fixed_on_axis` that a root stays on the imaginary
    axis and was not.
    """

    copies: int
    terms: Sequence[DelayedTerm]
    crossings: Sequence[Crossing] = ()
    unstable: int = 0
    fixed_at_zero: bool = False
    fixed_on_axis: bool = False


def analyse_delay(
    A0: ArrayLike, A1: ArrayLike, *, horizon_s: float | None = None, leave_out_zero: bool = False
) -> DelayAnalysis:
    """Stability windows, critical delays and delay margin of x'(t) = A0 x(t) + A1 x(t - tau).

    A loop with a root that stays on the imaginary axis at every delay is asymptotically stable at none: no window,
    margin 0. A singular A0 + A1 is such a loop (s = 0). If the root is the common value of a consensus and of no
    interest, ask for `leave_out_zero`; what stands still at once and late can also be taken out of the matrices, with
    `gains.core.structure.project_out_equilibria`.

    Parameters
    ----------
    A0, A1
        Real matrices (n, n), 1/s.
    horizon_s
        List windows that begin before this delay only. By default all are listed: they are finitely many.
    leave_out_zero
        Say all of the other roots if a block has a simple root at s = 0 that stays there at every delay.

    Raises
    ------
    BadModelError
        The matrices are not square, finite and of one size, or the horizon is not a positive number.
    DisagreementError
        Crossings and eigenvalues contradict each other (a loop at the limit of double precision).

    Examples
    --------
    x'' - 0.1 x' + 2 x = x(t - tau) is stable for delays between 0.1 s and 1.7 s only:

    >>> from gains.delay.constant import analyse_delay
    >>> found = analyse_delay([[0, 1], [-2, 0.1]], [[0, 0], [1, 0]])
    >>> [(round(start_s, 4), round(end_s, 4)) for start_s, end_s in found.stable_intervals_s]
    [(0.1002, 1.7179)]
    >>> found.unstable_roots_at_zero_delay, found.delay_margin_s
    (2, 0.0)
    """
    blocks = distinct_blocks(*square_matrices(A0=A0, A1=A1))
    check_horizon(horizon_s)
    return combined_analysis([_analyse_block(block, leave_out_zero) for block in blocks], horizon_s)


def combined_analysis(blocks: Sequence[BlockAnalysis], horizon_s: float | None) -> DelayAnalysis:
    """The analysis of a loop from those of its blocks."""
    crossings = [
        replace(crossing, roots=crossing.roots * block.copies) for block in blocks for crossing in block.crossings
    ]
    crossings.sort(key=lambda crossing: (crossing.delay_s, crossing.omega_rad_s))
    unstable = sum(block.copies * block.unstable for block in blocks)
    fixed_on_axis = any(block.fixed_on_axis for block in blocks)
    intervals, complete_to_s = ((), inf) if fixed_on_axis else _windows(blocks, crossings, unstable, horizon_s)
    margin_s = next((end_s for start_s, end_s in intervals if start_s == 0.0), 0.0)
    return DelayAnalysis(
        stable_intervals_s=intervals,
        delay_margin_s=margin_s,
        delay_independent=margin_s == inf,
        crossings=tuple(crossings),
        unstable_roots_at_zero_delay=unstable,
        complete_to_s=complete_to_s,
        roots_fixed_at_zero=sum(block.copies for block in blocks if block.fixed_at_zero),
    )


def _windows(
    blocks: Sequence[BlockAnalysis], crossings: Sequence[Crossing], unstable: int, horizon_s: float | None
) -> tuple[tuple[tuple[float, float], ...], float]:
    """`stability_windows`; where critical delays are too close to be told apart, with their errors taken into account.

    A multiple root is computed as several that cross near each other, some of them perhaps in the wrong order.
    """
    try:
        found = stability_windows(crossings, unstable, horizon_s)
        edges_s = [edge_s for window in found[0] for edge_s in window]
        if all(after_s == inf or after_s - before_s > _NARROW * after_s for before_s, after_s in pairwise(edges_s)):
            return found
    except DisagreementError:
        # more roots come out than went in: perhaps the order is wrong
        pass
    errors = {
        (crossing.omega_rad_s, crossing.delay_s): crossing_error(block.terms, crossing.omega_rad_s, crossing.delay_s)
        for block in blocks
        for crossing in block.crossings
    }
    blurred = [errors[crossing.omega_rad_s, crossing.delay_s] for crossing in crossings]
    return stability_windows(crossings, unstable, horizon_s, errors=blurred)


def delay_margin(A0: ArrayLike, A1: ArrayLike) -> float:
    """The least delay (s) at which x'(t) = A0 x(t) + A1 x(t - tau) loses stability.

    `inf` if no delay does, 0 if the loop is unstable without delay. Arguments and exceptions as of `analyse_delay`.

    Examples
    --------
    x'(t) = -x(t - tau) is stable up to tau = pi / 2:

    >>> from gains.delay.constant import delay_margin
    >>> round(delay_margin([[0]], [[-1]]), 6)
    1.570796
    """
    # the first critical delay is wanted only: the shortest horizon lists the fewest windows
    return analyse_delay(A0, A1, horizon_s=1e-300).delay_margin_s


def check_horizon(horizon_s: float | None) -> None:
    """Raise BadModelError unless the horizon is a positive number of seconds, or None for all windows."""
    if horizon_s is not None and not horizon_s > 0.0:
        raise BadModelError(f"horizon_s is {horizon_s}; a positive number of seconds is wanted")


def _analyse_block(block: Block, leave_out_zero: bool) -> BlockAnalysis:
    A0, A1 = balanced(*block.matrices)
    terms = DelayedTerm(A0, 0.0, 0), DelayedTerm(A1, 0.0, 1)
    roots = np.linalg.eigvals(A0 + A1).astype(np.complex128)
    passage = zero_passage([A0, A1], np.zeros(2), np.arange(2)) if leave_out_zero else None
    if passage is None and _has_fixed_root(A0, A1, roots):
        unstable = int(np.count_nonzero(roots.real > _marginal(A0, A1)))
        return BlockAnalysis(block.copies, terms, unstable=unstable, fixed_on_axis=True)
    found = axis_crossings(A0, A1)
    unstable = unstable_roots(roots, found, passage)
    return block_analysis(block.copies, terms, found, unstable, passage, highest_frequency(A0, A1))


def block_analysis(
    copies: int,
    terms: Sequence[DelayedTerm],
    found: Sequence[AxisCrossing],
    unstable: int,
    passage: ZeroPassage | None,
    highest: float,
) -> BlockAnalysis:
    """One block's analysis from its crossings up to the frequency `highest` and its unstable roots without delay.

    `passage` is what `zero_passage` says of a root at zero that is left out, None if there is none.
    """
    crossings = [
        Crossing(crossing.omega, crossing.theta / crossing.omega, crossing.direction, 2)
        for crossing in found
        if passage is None or not passage.is_seen_at(crossing.omega, crossing.theta, highest)
    ]
    if passage is not None and passage.direction != 0:
        crossings.append(Crossing(0.0, passage.delay_s, passage.direction, 1))
    return BlockAnalysis(copies, terms, crossings, unstable, fixed_at_zero=passage is not None)


def unstable_roots(roots: ComplexArray, found: Sequence[AxisCrossing], passage: ZeroPassage | None) -> int:
    """How many of the roots without delay have a positive real part; those known to be on the axis have none."""
    # a pair that crosses at zero delay is on the axis there: rounding must not put it in either half plane
    for crossing in found:
        if crossing.theta == 0.0:
            for sign in (1.0, -1.0):
                roots = np.delete(roots, np.argmin(np.abs(roots - sign * 1j * crossing.omega)))
    if passage is not None:
        roots = np.delete(roots, np.argmin(np.abs(roots)))
    return int(np.count_nonzero(roots.real > 0.0))


def _marginal(A0: FloatArray, A1: FloatArray) -> float:
    """Largest distance (1/s) from the imaginary axis that rounding alone can give a simple eigenvalue."""
    return 1e-13 * float(np.linalg.norm(A0) + np.linalg.norm(A1))


def _has_fixed_root(A0: FloatArray, A1: FloatArray, roots: ComplexArray) -> bool:
    """Whether some j omega is a root at every delay: at omega = 0, or of the pencil for every e^{-j theta}."""
    scale = float(np.linalg.norm(A0) + np.linalg.norm(A1))
    if scale == 0.0:
        return True
    # a defective root at zero is known to sqrt(eps) only: the singular value decides, not the eigenvalue
    for root in roots[np.abs(roots.real) < 1e-6 * scale]:
        omega = abs(root.imag)
        if omega < 1e-6 * scale:
            if is_singular_for_any_delay((A0, A1)):
                return True
        elif all(_least_singular(A0 + z * A1, omega) < 1e-12 * scale for z in (1.0, 1j, -1.0)):
            return True
    return False


def _least_singular(matrix: FloatArray | ComplexArray, omega: float) -> float:
    return float(np.linalg.svd(1j * omega * np.eye(matrix.shape[0]) - matrix, compute_uv=False)[-1])


def stability_windows(
    crossings: Sequence[Crossing],
    unstable: int,
    horizon_s: float | None,
    *,
    errors: Sequence[tuple[float, float]] = (),
) -> tuple[tuple[tuple[float, float], ...], float]:
    """Windows without unstable roots, and the delay up to which they are complete.

    With the `errors` of each crossing's frequency (rad/s) and delay (s), what lies between two critical delays that may
    be one is no window.
    """
    if not crossings:
        return (((0.0, inf),) if unstable == 0 else ()), inf
    omega = np.array([crossing.omega_rad_s for crossing in crossings])
    first = np.array([crossing.delay_s for crossing in crossings])
    change = np.array([crossing.direction * crossing.roots for crossing in crossings])
    # a real root passes zero once only
    period_s = np.divide(2.0 * pi, omega, out=np.full(omega.size, inf), where=omega > 0.0)
    # roots that leave the axis at zero delay to the right are unstable from there on, to the left they always were
    at_zero = first == 0.0
    unstable += int(change[at_zero & (change > 0)].sum())
    first = np.where(at_zero, period_s, first)
    wanted_s, complete_to_s = _last_delay(omega, first, change, unstable, horizon_s)
    # a window that begins by then ends at a root that comes in, within one period of the fastest sequence that does
    entering = change >= 0 if bool(np.any(change >= 0)) else np.full(change.size, True)
    returns_s = np.where(period_s < inf, np.maximum(first, wanted_s + period_s), np.where(first < wanted_s, inf, first))
    last_s = min(float(returns_s[entering].min()), max(float(first.max()), wanted_s + float(period_s.min())))
    times = np.floor((last_s - first) / period_s).astype(np.int64) + 1 if last_s < inf else np.ones(first.size, int)
    # the first delay of every sequence is listed in any case
    times = np.maximum(times, 1)
    source = np.repeat(np.arange(first.size), times)
    k = np.arange(source.size) - np.repeat(np.cumsum(times) - times, times)
    delays = first[source] + np.where(k > 0, k * np.where(period_s < inf, period_s, 0.0)[source], 0.0)
    order = np.lexsort((-change[source], delays))
    delays = np.concatenate([[0.0], delays[order], [inf]])
    count = unstable + np.concatenate([[0], np.cumsum(change[source][order])])
    wide = np.diff(delays) > _SAME_DELAY * delays[:-1]
    if errors:
        by_omega, by_delay = np.array(errors).T
        # an error of the frequency counts once more with every turn
        blur = (by_delay[source] + 2.0 * pi * k / np.maximum(omega[source], 1e-300) ** 2 * by_omega[source])[order]
        wide &= np.diff(delays) > np.maximum(np.append(0.0, blur), np.append(blur, 0.0))
    known = delays[:-1] <= wanted_s
    if bool(np.any(count[wide & known] < 0)):
        raise DisagreementError(
            f"more roots leave the right half plane than are in it (crossings {tuple(crossings)}, "
            f"{unstable} unstable roots without delay): the loop is at the limit of double precision"
        )
    stable = wide & known & (count == 0)
    return tuple(zip(delays[:-1][stable].tolist(), delays[1:][stable].tolist(), strict=True)), complete_to_s


def _last_delay(
    omega: FloatArray, first: FloatArray, change: FloatArray, unstable: int, horizon_s: float | None
) -> tuple[float, float]:
    """The last delay (s) at which a window to be listed may begin, and the one up to which all are listed then.

    A sequence has at least (tau - first) omega / 2 pi and at most one more member up to tau, so the count of unstable
    roots has a lower bound that grows linearly with tau, and no window lies where that exceeds zero.
    """
    growth = float((change * omega).sum()) / (2.0 * pi)
    offset = unstable - float((change * omega * first).sum()) / (2.0 * pi) + float(change[change < 0].sum())
    end_s = inf if growth <= 0.0 else max(-offset / growth, 0.0)
    events_per_s = float(omega.sum()) / (2.0 * pi)
    affordable_s = _MOST_EVENTS / events_per_s if events_per_s > 0.0 else inf
    wanted_s = end_s if horizon_s is None else min(horizon_s, end_s)
    complete_to_s = inf if wanted_s >= end_s else wanted_s
    if wanted_s > affordable_s:
        wanted_s = complete_to_s = affordable_s
    return wanted_s, complete_to_s
