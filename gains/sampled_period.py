"""The largest period that one block of the sampled and held loop of `gains.sampled` takes."""

from collections.abc import Callable
from math import inf

import numpy as np

from gains.delay_loci import bracketed_roots, factor_rank
from gains.errors import GainsError
from gains.sampled_loop import HeldPlant
from gains.structure import FloatArray

# periods looked at in one go, and goes before giving up
_CHUNK, _CHUNKS = 256, 200
# growth of the period from one look to the next, and its largest step in periods of the fastest oscillation
_RATIO, _STEP = 1.03, 0.02
_GOLDEN = (3.0 - 5.0**0.5) / 2.0
# a plant that grows by e to this in a period, 1 / eps, leaves nothing of the loop but rounding
_MOST_GROWTH = 36.0


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

    plant_roots = np.linalg.eigvals(A).astype(np.complex128)
    fastest = float(np.abs(plant_roots.imag).max())
    # below this the held loop and the continuous one differ by less than the damping of any mode
    start_s = 1e-3 * float((-loop_roots.real).min()) / (float(np.linalg.norm(A) + np.linalg.norm(BK)) ** 2)
    slowest = float(plant_roots.real.max())
    for _ in range(_CHUNKS):
        periods_s = next_periods(start_s, fastest, longest_period(slowest))
        logs = log_radius(periods_s)
        periods_s, logs = with_peaks(log_radius, periods_s, logs)
        above = np.flatnonzero(logs >= 0.0)
        if above.size > 0 and above[0] > 0:
            i = above[:1]
            return float(bracketed_roots(log_radius, periods_s[i - 1], periods_s[i], logs[i - 1], logs[i])[0])
        if above.size > 0:
            return start_s
        # once e^{A T} has died out the loop no longer depends on the period
        if slowest * periods_s[0] < -40.0:
            return inf
        start_s = float(periods_s[-1])
    raise GainsError(
        f"the loop is stable up to a period of {start_s} s and no limit was found; is A meant to be that slow?"
    )


def longest_period(slowest_1_s: float) -> float:
    """The period (s) up to which the map of a loop can be computed, whose plant grows with this rate at most."""
    return _MOST_GROWTH / slowest_1_s if slowest_1_s > 0.0 else inf


def next_periods(start_s: float, fastest: float, until_s: float) -> FloatArray:
    """Ascending periods from `start_s` to `until_s` or before it, so that no step skips an oscillation of the plant."""
    largest_step_s = 2.0 * np.pi * _STEP / fastest if fastest > 0.0 else inf
    periods_s = [start_s]
    while len(periods_s) <= _CHUNK and periods_s[-1] < until_s:
        step_s = min((_RATIO - 1.0) * periods_s[-1], largest_step_s)
        periods_s.append(min(periods_s[-1] + step_s, until_s))
    return np.array(periods_s)


def with_peaks(
    log_radius: Callable[[FloatArray], FloatArray], periods_s: FloatArray, logs: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The samples with the local maxima of the radius below one added, located by golden section."""
    inner = logs[1:-1]
    at = np.flatnonzero((inner >= logs[:-2]) & (inner >= logs[2:]) & (inner < 0.0))
    if at.size == 0:
        return periods_s, logs
    a, b = periods_s[at], periods_s[at + 2]
    for _ in range(45):
        c, d = a + _GOLDEN * (b - a), b - _GOLDEN * (b - a)
        to_left = log_radius(c) > log_radius(d)
        a, b = np.where(to_left, a, c), np.where(to_left, d, b)
    peaks_s = (a + b) / 2.0
    order = np.argsort(np.concatenate([periods_s, peaks_s]))
    return np.concatenate([periods_s, peaks_s])[order], np.concatenate([logs, log_radius(peaks_s)])[order]
