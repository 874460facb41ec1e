"""All windows of the period for which the sampled and held loop without further delay is stable.

The least period at which stability is lost is `gains.sampled.constant.sampling_period_limit`. A loop may be stable
again at longer periods, or need a long one in the first place (an oscillator pushed at the right instants), so here the
march through the periods goes on, up to a horizon.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from gains.core._bracketing import bracketed_roots
from gains.core.arrays import ComplexArray, FloatArray
from gains.core.errors import GainsError
from gains.core.structure import balanced, distinct_blocks
from gains.delay._loci import factor_rank
from gains.sampled._loop import HeldPlant
from gains.sampled._period import last_period, next_periods, with_peaks
from gains.sampled.constant import checked_loop, sampling_period_limit

# windows are listed up to this many times the first limit, or of the slowest time constant without one
_HORIZON = 20.0
# periods looked at; a march through very many oscillations of the plant stops there
_MOST_PERIODS = 40_000


@dataclass(frozen=True)
class PeriodCrossing:
    """At the period `period_s` eigenvalues e^{+-j omega T} of the one-period map are on the unit circle.

    `direction` is +1 when they leave the unit circle as the period grows, -1 when they enter it, 0 when they touch it
    and return, as at a period in which an undamped plant turns once and no sample sees it move.
    """

    omega_rad_s: float
    period_s: float
    direction: int


@dataclass(frozen=True)
class PeriodAnalysis:
    """Open windows of stable periods, complete up to `complete_to_s`, and where they begin and end.

    `limit_s` is the end of the window that begins at 0, or 0 when none does. `unstable_roots_at_zero_period` counts
    eigenvalues of A + B K with positive real part.
    """

    stable_intervals_s: tuple[tuple[float, float], ...]
    limit_s: float
    crossings: tuple[PeriodCrossing, ...]
    unstable_roots_at_zero_period: int
    complete_to_s: float


def analyse_period(A: ArrayLike, B: ArrayLike, K: ArrayLike) -> PeriodAnalysis:
    """Windows of the period of the loop x' = A x + B u, u = K x sampled and held.

    Listed up to twenty times the first limit at least. Found by a march through the periods: a search, not a proof.

    Parameters
    ----------
    A, B, K
        Real matrices (n, n), (n, p), (p, n).

    Raises
    ------
    BadModelError
        Naming the matrix, what was read and what was wanted.

    Examples
    --------
    x' = u, u = -x: x_{k+1} = (1 - T) x_k is stable up to T = 2, where it changes sign from sample to sample.

    >>> from gains.sampled._period_windows import analyse_period
    >>> found = analyse_period([[0]], [[1]], [[-1]])
    >>> round(found.limit_s, 6), [(round(c.omega_rad_s, 4), c.direction) for c in found.crossings]
    (2.0, [(1.5708, 1)])
    """
    plant, entry, feedback = checked_loop(A, B, K)
    loop_roots = np.linalg.eigvals(plant + entry @ feedback).astype(np.complex128)
    try:
        limit_s = sampling_period_limit(A, B, K)
    except GainsError:
        # no limit within its march; the windows below end at the horizon
        limit_s = inf
    blocks = [balanced(*block.matrices) for block in distinct_blocks(plant, entry @ feedback)]
    wanted_s, forgets = _horizon(plant, entry @ feedback, limit_s)
    crossings: list[PeriodCrossing] = []
    reached_s = wanted_s
    for block in blocks:
        found, block_reached_s = _block_crossings(block, wanted_s)
        crossings += found
        reached_s = min(reached_s, block_reached_s)
    crossings = sorted((c for c in crossings if c.period_s < reached_s), key=lambda crossing: crossing.period_s)
    # once e^{A T} has died out nothing depends on the period any more
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


def _horizon(A: FloatArray, BK: FloatArray, limit_s: float) -> tuple[float, bool]:
    """How far (s) to look, and whether e^{A T} has died out there."""
    rate = float(np.linalg.norm(A) + np.linalg.norm(BK))
    horizon_s = _HORIZON * (limit_s if 0.0 < limit_s < inf else 10.0 / rate if rate > 0.0 else 1.0)
    last_s, decays = last_period(A)
    return (max(horizon_s, last_s), True) if decays else (min(horizon_s, last_s), False)


def _is_stable(blocks: list[tuple[FloatArray, ...]], window: tuple[float, float], last_s: float) -> bool:
    start_s, end_s = window[0], min(window[1], last_s)
    middle_s = (start_s + end_s) / 2.0
    return end_s > start_s * (1.0 + 1e-12) and all(_radius(A, BK, middle_s) < 1.0 for A, BK in blocks)


def _eigenvalues(A: FloatArray, BK: FloatArray, periods_s: FloatArray) -> ComplexArray:
    plant = HeldPlant(A, *factor_rank(BK), period_s=1.0)
    states, hold = plant.transition(periods_s)
    return np.linalg.eigvals(states + hold @ plant.K).astype(np.complex128)


def _radius(A: FloatArray, BK: FloatArray, period_s: float) -> float:
    return float(np.abs(_eigenvalues(A, BK, np.array([period_s]))).max())


def _block_crossings(block: tuple[FloatArray, ...], horizon_s: float) -> tuple[list[PeriodCrossing], float]:
    """Periods at which the spectral radius of one block passes one, and how far the march came (s)."""
    A, BK = block

    def log_radius(periods_s: FloatArray) -> FloatArray:
        return np.log(np.maximum(np.abs(_eigenvalues(A, BK, periods_s)).max(axis=1), 1e-300))

    def minus_log_radius(periods_s: FloatArray) -> FloatArray:
        return -log_radius(periods_s)

    rate = float(np.linalg.norm(A) + np.linalg.norm(BK))
    start_s, looked_at = 1e-5 / rate if rate > 0.0 else horizon_s, 0
    found: list[PeriodCrossing] = []
    while start_s < horizon_s and looked_at < _MOST_PERIODS:
        periods_s = next_periods(start_s, horizon_s, A)
        looked_at += periods_s.size
        start_s = float(periods_s[-1])
        periods_s, logs = with_peaks(log_radius, periods_s, log_radius(periods_s))
        # dips into stability between two looks
        periods_s, negative = with_peaks(minus_log_radius, periods_s, -logs)
        logs = -negative
        touches_s = periods_s[logs == 0.0].tolist()
        found += [PeriodCrossing(_angle(A, BK, touch_s) / touch_s, touch_s, 0) for touch_s in touches_s]
        periods_s, logs = periods_s[logs != 0.0], logs[logs != 0.0]
        at = np.flatnonzero(np.sign(logs[1:]) != np.sign(logs[:-1]))
        if at.size > 0:
            roots_s = bracketed_roots(log_radius, periods_s[at], periods_s[at + 1], logs[at], logs[at + 1])
            for root_s, after in zip(roots_s.tolist(), logs[at + 1].tolist(), strict=True):
                found.append(PeriodCrossing(_angle(A, BK, root_s) / root_s, root_s, 1 if after > 0.0 else -1))
    return found, min(start_s, horizon_s)


def _angle(A: FloatArray, BK: FloatArray, period_s: float) -> float:
    """Angle (rad, 0 to pi) of the largest eigenvalue of the one-period map."""
    eigenvalues = _eigenvalues(A, BK, np.array([period_s]))[0]
    return abs(float(np.angle(eigenvalues[np.argmax(np.abs(eigenvalues))])))
