"""The largest period that one block of the sampled and held loop of `gains.sampled.constant` takes."""

from math import inf

import numpy as np

from gains.core._bracketing import Functions, bracketed_roots, may_reach_zero, peaks
from gains.core.arrays import FloatArray
from gains.core.errors import GainsError
from gains.delay._loci import factor_rank
from gains.sampled._loop import HeldPlant

# periods looked at in one go, and goes before giving up
_CHUNK, _CHUNKS = 256, 200
# growth of the period from one look to the next, and its largest step in periods of the fastest oscillation
_RATIO, _STEP = 1.03, 0.02
# e^{A T} is zero to rounding where its slowest motion has decayed by e^-40, and hides the rest where one has grown by
# e^30
_DECAYED, _GROWN = 40.0, 30.0
# a double eigenvalue of the map, as of an undamped plant sampled once a turn, is known to sqrt(eps)
_TOUCH = 1e-7


def block_period_limit(A: FloatArray, BK: FloatArray) -> float:
    """The least T (s) at which e^{A T} + int_0^T e^{A s} ds B K has spectral radius one.

    0 if A + B K is not Hurwitz, `inf` if there is none.
    """
    loop_roots = np.linalg.eigvals(A + BK).astype(np.complex128)
    if float(loop_roots.real.max()) >= 0.0:
        return 0.0
    if not BK.any():
        return inf
    plant = HeldPlant(A, *factor_rank(BK), period_s=1.0)

    def log_radius(period_s: FloatArray) -> FloatArray:
        states, hold = plant.transition(period_s)
        return np.log(np.maximum(np.abs(np.linalg.eigvals(states + hold @ plant.K)).max(axis=1), 1e-300))

    # below this the held loop and the continuous one differ by less than the damping of any mode
    start_s = 1e-3 * float((-loop_roots.real).min()) / (float(np.linalg.norm(A) + np.linalg.norm(BK)) ** 2)
    end_s, decays = last_period(A)
    for _ in range(_CHUNKS):
        periods_s = next_periods(start_s, end_s, A)
        periods_s, logs = with_peaks(log_radius, periods_s, log_radius(periods_s))
        above = np.flatnonzero(logs >= 0.0)
        if above.size > 0 and above[0] > 0:
            i = above[:1]
            return float(bracketed_roots(log_radius, periods_s[i - 1], periods_s[i], logs[i - 1], logs[i])[0])
        if above.size > 0:
            return start_s
        start_s = float(periods_s[-1])
        if start_s >= end_s:
            break
    if decays and start_s >= end_s:
        return inf
    raise GainsError(
        f"the loop is stable up to a period of {start_s} s and no limit was found; is A meant to be that slow?"
    )


def last_period(A: FloatArray) -> tuple[float, bool]:
    """The period (s) up to which a march says something, and whether all motions of the plant have died out there.

    From then on the loop no longer depends on the period.
    """
    slowest = float(np.linalg.eigvals(A).real.max())
    if slowest == 0.0:
        return inf, False
    return (_DECAYED / -slowest, True) if slowest < 0.0 else (_GROWN / slowest, False)


def next_periods(start_s: float, end_s: float, A: FloatArray) -> FloatArray:
    """Ascending periods from `start_s`, geometric until the steps would skip an oscillation of the plant; to the end
    or as many as are looked at in one go."""
    fastest = float(np.abs(np.linalg.eigvals(A).imag).max())
    largest_step_s = 2.0 * np.pi * _STEP / fastest if fastest > 0.0 else inf
    periods_s = [start_s]
    while len(periods_s) <= _CHUNK and periods_s[-1] < end_s:
        periods_s.append(min(periods_s[-1] + min((_RATIO - 1.0) * periods_s[-1], largest_step_s), end_s))
    return np.array(periods_s)


def with_peaks(log_radius: Functions, periods_s: FloatArray, logs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The samples with those local maxima of the radius below one added that may reach it, located.

    One that comes as near to one as can be told has the logarithm zero: it touches.
    """
    at = np.flatnonzero(may_reach_zero(periods_s, logs[:, np.newaxis]))
    if at.size == 0:
        return periods_s, logs
    peaks_s = peaks(log_radius, periods_s[at], periods_s[at + 2])
    heights = log_radius(peaks_s)
    heights = np.where(np.abs(heights) < _TOUCH, 0.0, heights)
    order = np.argsort(np.concatenate([periods_s, peaks_s]))
    return np.concatenate([periods_s, peaks_s])[order], np.concatenate([logs, heights])[order]
