"""Stability windows from the crossings of the imaginary axis.

Every crossing belongs to an arithmetic sequence of delays, (theta + 2 pi k) / omega. The count of unstable roots starts
at its value without delay and changes at each crossing, in order of delay; the loop is stable where it is zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import gcd, inf, pi

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray, IntArray
from gains.core.errors import DisagreementError
from gains.core.structure import is_singular_for_any_delay
from gains.delay._crossings import Crossing, DelayedTerm, crossing_errors

# at most this many critical delays are listed: a near-tangent pair of crossings can have millions
_MOST_EVENTS = 200_000
# two critical delays closer together than this (relative) are the same
_SAME_DELAY = 1e-12
# if a window or gap is narrower than this (relative), the errors of the critical delays are taken into account
_NARROW = 1e-2
# the null vectors of a simple eigenvalue have at least this cosine between them; rounding is far below
_SIMPLE = 1e-6
# a crossing below this share of the highest frequency, and within this angle (rad) of its limit, is the root at zero
_BLUR, _TURN = 1e-3, 1e-3


@dataclass(frozen=True)
class DelayAnalysis:
    """Verdict on x'(t) = A0 x(t) + A1 x(t - tau) for every constant delay tau >= 0."""

    stable_intervals_s: tuple[tuple[float, float], ...]
    """The open windows of asymptotic stability; an unbounded one ends at `inf`. A window that begins at 0 includes zero
    delay itself, unless A0 + A1 has roots on the imaginary axis that move to the left as the delay grows."""
    delay_margin_s: float
    """The end of the window that begins at 0, or 0 if none does."""
    delay_independent: bool
    """Whether the loop is stable at every delay."""
    crossings: tuple[Crossing, ...]
    """In ascending order of delay."""
    unstable_roots_at_zero_delay: int
    """The number of eigenvalues of A0 + A1 with positive real part."""
    complete_to_s: float
    """The delay up to which the windows are complete: `inf` unless the caller gave a horizon or there are too many
    critical delays to list. The margin is exact in either case."""
    roots_fixed_at_zero: int = 0
    """The number of roots at s = 0 that were left out at the caller's request."""

    def window_around(self, delay_s: float) -> tuple[float, float] | None:
        """The stability window that contains a delay; None if the loop is not stable there."""
        windows = self.stable_intervals_s
        return next((w for w in windows if w[0] < delay_s < w[1] or w[0] == delay_s == 0.0), None)


@dataclass(frozen=True)
class ZeroPassage:
    """A real root passes the one that stays at s = 0, at `delay_s`: to the right (+1, unstable) or to the left (-1).

    `direction` is 0 if no root passes at a positive delay; `delay_s` is then infinite or not positive. `unit` divides
    all multiples of tau.
    """

    delay_s: float
    direction: int
    unit: int = 1

    def is_seen_as(self, crossing: Crossing, highest: float) -> bool:
        """Whether a crossing is an artefact of rounding at the root that stays at zero.

        At low frequencies the modulus of that root's locus is one to rounding, so noise may carry it across one many
        times, wherever `unit` tau is a whole turn.
        """
        omega = crossing.omega_rad_s
        apart_s = crossing.delay_s - (self.delay_s if np.isfinite(self.delay_s) else 0.0)
        return omega < _BLUR * highest and abs(float(np.angle(np.exp(1j * self.unit * omega * apart_s)))) < _TURN


@dataclass(frozen=True)
class BlockAnalysis:
    """The analysis of one block that stands for `copies` equal ones; `roots` in its crossings counts one copy.

    `fixed_at_zero`: a simple root at s = 0 was left out. `fixed_on_axis`: a root stays on the imaginary axis at every
    delay and was not left out.
    """

    copies: int
    terms: Sequence[DelayedTerm]
    crossings: Sequence[Crossing] = ()
    unstable: int = 0
    fixed_at_zero: bool = False
    fixed_on_axis: bool = False


def combined_analysis(blocks: Sequence[BlockAnalysis], horizon_s: float | None) -> DelayAnalysis:
    """The analysis of a loop, combined from those of its blocks."""
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


def first_critical_delay_s(blocks: Sequence[BlockAnalysis]) -> float:
    """The delay margin (s) of a loop, from the analyses of its blocks; the windows after it are not listed."""
    crossings = [crossing for block in blocks for crossing in block.crossings]
    leaving = any(crossing.delay_s == 0.0 and crossing.direction > 0 for crossing in crossings)
    if leaving or any(block.fixed_on_axis or block.unstable > 0 for block in blocks):
        return 0.0
    # a root that moves to the left from the axis at zero delay crosses again a period later
    return min((crossing.delay_s or 2.0 * pi / crossing.omega_rad_s for crossing in crossings), default=inf)


def _windows(
    blocks: Sequence[BlockAnalysis], crossings: Sequence[Crossing], unstable: int, horizon_s: float | None
) -> tuple[tuple[tuple[float, float], ...], float]:
    """`stability_windows`, allowing for the errors of critical delays that are too close together to order reliably.

    A multiple root is computed as several that cross near each other, perhaps in the wrong order.
    """
    try:
        found = stability_windows(crossings, unstable, horizon_s)
        edges_s = [edge_s for window in found[0] for edge_s in window]
        if all(after_s == inf or after_s - before_s > _NARROW * after_s for before_s, after_s in pairwise(edges_s)):
            return found
    except DisagreementError:
        # more roots leave the right half plane than are in it: perhaps the order is wrong
        pass
    errors: dict[tuple[float, float], tuple[float, float]] = {}
    for block in blocks:
        places = [(crossing.omega_rad_s, crossing.delay_s) for crossing in block.crossings]
        errors.update(zip(places, crossing_errors(block.terms, places), strict=True))
    blurred = [errors[crossing.omega_rad_s, crossing.delay_s] for crossing in crossings]
    return stability_windows(crossings, unstable, horizon_s, errors=blurred)


def block_analysis(
    copies: int, terms: Sequence[DelayedTerm], found: Sequence[Crossing], unstable: int, passage: ZeroPassage | None
) -> BlockAnalysis:
    """One block's analysis from its crossings and its number of unstable roots without delay.

    `passage` is the result of `zero_passage` for a root at zero that is left out, None if there is none.
    """
    crossings = list(found)
    if passage is not None and passage.direction != 0:
        crossings.append(Crossing(0.0, passage.delay_s, passage.direction, 1))
    return BlockAnalysis(copies, terms, crossings, unstable, fixed_at_zero=passage is not None)


def without_zero(found: Sequence[Crossing], passage: ZeroPassage | None, highest: float) -> list[Crossing]:
    """The crossings without those that rounding makes of a root at zero; `highest` bounds their frequencies."""
    return [crossing for crossing in found if passage is None or not passage.is_seen_as(crossing, highest)]


def unstable_roots(roots: ComplexArray, found: Sequence[Crossing], passage: ZeroPassage | None) -> int:
    """The number of roots right of the axis without delay, excluding those known to be on it."""
    # a pair that crosses at zero delay is on the axis: rounding must not put it in either half plane
    for crossing in found:
        if crossing.delay_s == 0.0:
            for sign in (1.0, -1.0):
                roots = np.delete(roots, np.argmin(np.abs(roots - sign * 1j * crossing.omega_rad_s)))
    if passage is not None:
        roots = np.delete(roots, np.argmin(np.abs(roots)))
    return sum(root.real > 0.0 for root in roots.tolist())


def stability_windows(
    crossings: Sequence[Crossing], unstable: int, horizon_s: float | None, *, errors: Sequence[tuple[float, float]] = ()
) -> tuple[tuple[tuple[float, float], ...], float]:
    """The windows without unstable roots, and the delay up to which they are complete.

    `errors` are those of each crossing's frequency (rad/s) and delay (s). If they are given, a gap between two critical
    delays within their errors is not a window.
    """
    if not crossings:
        return (((0.0, inf),) if unstable == 0 else ()), inf
    omega = np.array([crossing.omega_rad_s for crossing in crossings])
    first = np.array([crossing.delay_s for crossing in crossings])
    change = np.array([crossing.direction * crossing.roots for crossing in crossings])
    # a real root passes zero once only
    period_s = np.divide(2.0 * pi, omega, out=np.full(omega.size, inf), where=omega > 0.0)
    # roots on the axis at zero delay that leave it to the right are unstable from there on
    at_zero = first == 0.0
    unstable += int(change[at_zero & (change > 0)].sum())
    first = np.where(at_zero, period_s, first)
    wanted_s, complete_to_s = _last_delay(omega, first, change, unstable, horizon_s)
    # a window that begins by `wanted_s` ends when a root enters, within one period of the fastest entering sequence
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
        # an error of the frequency counts once for every turn
        blur = (by_delay[source] + 2.0 * pi * k / np.maximum(omega[source], 1e-300) ** 2 * by_omega[source])[order]
        wide &= np.diff(delays) > np.maximum(np.append(0.0, blur), np.append(blur, 0.0))
    known = delays[:-1] <= wanted_s
    if bool(np.any(count[wide & known] < 0)):
        raise DisagreementError(
            f"{len(crossings)} crossings take more roots out of the right half plane than are in it "
            f"({unstable} without delay): the loop is at the limit of double precision"
        )
    stable = wide & known & (count == 0)
    return tuple(zip(delays[:-1][stable].tolist(), delays[1:][stable].tolist(), strict=True)), complete_to_s


def _last_delay(
    omega: FloatArray, first: FloatArray, change: FloatArray, unstable: int, horizon_s: float | None
) -> tuple[float, float]:
    """The last delay (s) at which a listed window may begin, and the delay up to which the list is complete.

    A sequence has between (tau - first) omega / 2 pi and one more members up to tau. The count of unstable roots
    therefore has a lower bound that is linear in tau; no window lies where that bound exceeds zero.
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


def zero_passage(
    matrices: Sequence[FloatArray] | FloatArray, known_s: FloatArray, multiples: IntArray
) -> ZeroPassage | None:
    """The root that passes a block's root at s = 0; None unless s = 0 is a simple root at every delay.

    Matrix A_k of `matrices`, (n, n) in 1/s, acts with the delay d_k = known_s[k] + multiples[k] tau. With w'M(0) = 0
    and M(0) v = 0 for M(s) = sI - sum_k A_k e^{-s d_k}, the other roots near zero solve

        w'M'v + s w'(M''/2 - M' G M') v + ... = 0,   M' = I + sum_k d_k A_k,  M'' = -sum_k d_k^2 A_k,

    for any G with M(0) G M(0) = M(0). w'M'v is linear in tau, so at most one root passes zero, at one delay.
    """
    terms: FloatArray = np.array(matrices, dtype=np.float64)
    if not terms.any() or not is_singular_for_any_delay(terms):
        return None
    total = terms.sum(axis=0)
    U, singular, Vh = np.linalg.svd(total)
    w, v = U[:, -1], Vh[-1]
    if singular.size > 1 and singular[-2] <= 1e-12 * singular[0]:
        return None

    def weight(factors: FloatArray | IntArray) -> FloatArray:
        return np.tensordot(factors, terms, axes=1)

    slope_known = w @ v + w @ weight(known_s) @ v
    by_delay = float(w @ weight(multiples) @ v)
    # the root must be simple both without delay and with the known delays; two roots that stay are not handled
    if min(abs(float(w @ v)), abs(float(slope_known))) < _SIMPLE:
        return None
    unit = gcd(*multiples[terms.any(axis=(1, 2))].tolist()) or 1
    delay_s = -float(slope_known) / by_delay if by_delay != 0.0 else inf
    if abs(delay_s) * float(np.linalg.norm(terms, axis=(1, 2)).sum()) > 1e12:
        delay_s = inf  # by_delay is 0 but for rounding
    if not 0.0 < delay_s < inf:
        return ZeroPassage(delay_s, 0, unit)
    delays_s = known_s + multiples * delay_s
    first, second = np.eye(len(total)) + weight(delays_s), -weight(delays_s**2)
    kept = singular > 1e-12 * singular[0]
    inverse = -(Vh[kept].T / singular[kept]) @ U[:, kept].T
    curvature = float(w @ (second / 2.0 - first @ inverse @ first) @ v)
    if curvature == 0.0:
        return None
    return ZeroPassage(delay_s, int(np.sign(-by_delay / curvature)), unit)
