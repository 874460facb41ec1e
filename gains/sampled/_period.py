"""All sampling periods at which the sampled and held loop is stable without further delay.

A loop may become stable again at periods beyond its first limit, or be stable only at long periods (an oscillator
pushed at the right instants), so the march through the periods continues past the first limit.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from gains.core._bracketing import Functions, bracketed_roots, may_reach_zero, peaks
from gains.core.arrays import ComplexArray, FloatArray
from gains.sampled._loop import HeldPlant, held_blocks
from gains.sampled.constant import checked_loop

# windows are listed up to this many times the first limit or, if there is none, ten time constants
_HORIZON = 20.0
# periods in one step of the march, and in total: a march through very many oscillations of the plant stops there
_CHUNK, _MOST_PERIODS = 256, 40_000
# ratio of neighbouring periods, and their largest distance in periods of the plant's fastest oscillation
_RATIO, _STEP = 1.03, 0.02
# e^{A T} is zero to rounding once its slowest motion has decayed by e^-40; a motion that has grown by e^30 hides the
# others
_DECAYED, _GROWN = 40.0, 30.0
# a motion of the plant that is this slow beside its norm is an integrator, or so far away that e^{A T} is rounding
_STILL = 1e-12
# a double eigenvalue of the map, as of an undamped plant sampled once a turn, is known to sqrt(eps)
_TOUCH = 1e-7
# squared radii below this are rounding
_LEAST = 1e-15


@dataclass(frozen=True)
class PeriodCrossing:
    """A period `period_s` at which eigenvalues e^{+-j omega T} of the one-period map are on the unit circle.

    `direction` is +1 when they leave the unit circle as the period grows, -1 when they enter it, 0 when they touch it
    and return, as where an undamped plant oscillates once per period and no sample sees it move.
    """

    omega_rad_s: float
    period_s: float
    direction: int


@dataclass(frozen=True)
class PeriodAnalysis:
    """Open windows of stable periods, complete up to `complete_to_s`, and the crossings that bound them.

    `limit_s` is the end of the window that begins at 0, or 0 if none does. `unstable_roots_at_zero_period` counts
    eigenvalues of A + B K with positive real part.
    """

    stable_intervals_s: tuple[tuple[float, float], ...]
    limit_s: float
    crossings: tuple[PeriodCrossing, ...]
    unstable_roots_at_zero_period: int
    complete_to_s: float


def analyse_period(A: ArrayLike, B: ArrayLike, K: ArrayLike) -> PeriodAnalysis:
    """Stable sampling periods of the loop x' = A x + B u, u = K x sampled and held.

    Windows are listed up to twenty times the first limit: farther for a stable plant, less far if an unstable motion
    hides the others. Found by a march: a search, not a proof. BadModelError names a matrix that does not fit.
    """
    plant, entry, feedback = checked_loop(A, B, K)
    loop_roots = np.linalg.eigvals(plant + entry @ feedback).astype(np.complex128)
    blocks = held_blocks(plant, entry, feedback, period_s=1.0)
    wanted_s, forgets = _horizon(plant, entry @ feedback, min(_first_limit(block) for block in blocks))
    crossings: list[PeriodCrossing] = []
    reached_s = wanted_s
    for block in blocks:
        steps = list(_marched(block, wanted_s))
        crossings += [crossing for found, _ in steps for crossing in found]
        reached_s = min(reached_s, steps[-1][1])
    crossings = sorted((c for c in crossings if c.period_s < reached_s), key=lambda crossing: crossing.period_s)
    # once e^{A T} has decayed to zero, nothing depends on the period any more
    end_s = inf if forgets and reached_s == wanted_s else reached_s
    edges_s = [0.0, *(crossing.period_s for crossing in crossings), end_s]
    windows = tuple(window for window in pairwise(edges_s) if _is_stable(blocks, window, reached_s))
    return PeriodAnalysis(
        stable_intervals_s=windows,
        limit_s=next((end_s for start_s, end_s in windows if start_s == 0.0), 0.0),
        crossings=tuple(crossings),
        unstable_roots_at_zero_period=int(np.count_nonzero(loop_roots.real > 0.0)),
        complete_to_s=end_s,
    )


def _first_limit(block: HeldPlant) -> float:
    """The least period (s) at which the block loses stability; 0 if A + B K is not Hurwitz, `inf` if none is found."""
    if float(np.linalg.eigvals(block.A + block.B @ block.K).real.max()) >= 0.0:
        return 0.0
    return next((found[0].period_s for found, _ in _marched(block, _last_period(block.A)[0]) if found), inf)


def _horizon(A: FloatArray, BK: FloatArray, limit_s: float) -> tuple[float, bool]:
    """Longest period (s) to search, and whether e^{A T} has decayed to zero there."""
    rate = float(np.linalg.norm(A) + np.linalg.norm(BK))
    horizon_s = _HORIZON * (limit_s if 0.0 < limit_s < inf else 10.0 / rate if rate > 0.0 else 1.0)
    last_s, decays = _last_period(A)
    return (max(horizon_s, last_s), True) if decays else (min(horizon_s, last_s), False)


def _last_period(A: FloatArray) -> tuple[float, bool]:
    """The period (s) beyond which nothing new appears, and whether all motions of the plant have decayed there."""
    slowest = float(np.linalg.eigvals(A).real.max())
    if abs(slowest) <= _STILL * float(np.linalg.norm(A)):
        return inf, False
    return (_DECAYED / -slowest, True) if slowest < 0.0 else (_GROWN / slowest, False)


def _is_stable(blocks: list[HeldPlant], window: tuple[float, float], last_s: float) -> bool:
    start_s, end_s = window[0], min(window[1], last_s)
    middle = np.array([(start_s + end_s) / 2.0])
    return end_s > start_s * (1.0 + 1e-12) and all(_log_radius(block, middle)[0] < 0.0 for block in blocks)


def _changes(block: HeldPlant, periods_s: FloatArray) -> ComplexArray:
    """Eigenvalues of the one-period map less one at each period (k,), shape (k, n)."""
    states, hold = block.transition(periods_s, less_one=True)
    return np.linalg.eigvals(states + hold @ block.K).astype(np.complex128)


def _log_radius(block: HeldPlant, periods_s: FloatArray) -> FloatArray:
    """Logarithm of the spectral radius of the one-period map at each period (k,): half that of |1 + z|^2."""
    z = _changes(block, periods_s)
    return 0.5 * np.log1p(np.maximum((2.0 * z.real + np.abs(z) ** 2).max(axis=1), _LEAST - 1.0))


def _marched(block: HeldPlant, horizon_s: float) -> Iterator[tuple[list[PeriodCrossing], float]]:
    """For each step of the march: crossings of one block's spectral radius through one, and the period (s) reached."""

    log_radius = partial(_log_radius, block)

    def crossing(period_s: float, direction: int) -> PeriodCrossing:
        eigenvalues = 1.0 + _changes(block, np.array([period_s]))[0]
        angle = abs(float(np.angle(eigenvalues[np.argmax(np.abs(eigenvalues))])))
        return PeriodCrossing(angle / period_s, period_s, direction)

    rate = float(np.linalg.norm(block.A) + np.linalg.norm(block.B @ block.K))
    start_s, looked_at = 1e-5 / rate if rate > 0.0 else horizon_s, 0
    while start_s < horizon_s and looked_at < _MOST_PERIODS:
        periods_s = _next_periods(start_s, horizon_s, block.A)
        looked_at, start_s = looked_at + periods_s.size, float(periods_s[-1])
        periods_s, logs = _with_peaks(log_radius, periods_s, log_radius(periods_s))
        # dips into stability between two periods
        periods_s, negative = _with_peaks(lambda at_s: -log_radius(at_s), periods_s, -logs)
        touches_s, off = periods_s[negative == 0.0], negative != 0.0
        periods_s, logs = periods_s[off], -negative[off]
        at = np.flatnonzero(np.sign(logs[1:]) != np.sign(logs[:-1]))
        roots_s = bracketed_roots(log_radius, periods_s[at], periods_s[at + 1], logs[at], logs[at + 1])
        ways = np.sign(logs[at + 1]).astype(int).tolist()
        found = [crossing(touch_s, 0) for touch_s in touches_s.tolist()]
        found += [crossing(root_s, way) for root_s, way in zip(roots_s.tolist(), ways, strict=True)]
        yield sorted(found, key=lambda each: each.period_s), min(start_s, horizon_s)
    if looked_at == 0:
        yield [], horizon_s


def _next_periods(start_s: float, end_s: float, A: FloatArray) -> FloatArray:
    """Ascending periods for one step of the march: geometric until they would skip an oscillation of the plant."""
    fastest = float(np.abs(np.linalg.eigvals(A).imag).max())
    largest_step_s = 2.0 * np.pi * _STEP / fastest if fastest > 0.0 else inf
    periods_s = [start_s]
    while len(periods_s) <= _CHUNK and periods_s[-1] < end_s:
        periods_s.append(min(periods_s[-1] + min((_RATIO - 1.0) * periods_s[-1], largest_step_s), end_s))
    return np.array(periods_s)


def _with_peaks(log_radius: Functions, periods_s: FloatArray, logs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The samples, with the local maxima below zero that may reach it located and added.

    A maximum that cannot be distinguished from zero is set to zero: the radius touches one.
    """
    at = np.flatnonzero(may_reach_zero(periods_s, logs[:, np.newaxis]))
    if at.size == 0:
        return periods_s, logs
    peaks_s = peaks(log_radius, periods_s[at], periods_s[at + 2])
    heights = log_radius(peaks_s)
    heights = np.where(np.abs(heights) < _TOUCH, 0.0, heights)
    order = np.argsort(np.concatenate([periods_s, peaks_s]))
    return np.concatenate([periods_s, peaks_s])[order], np.concatenate([logs, heights])[order]
