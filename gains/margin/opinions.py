"""Second opinions on an analysis of one unknown delay, and the error of its margin.

The first is a sweep along the unit circle (`gains.delay.sweep.circle_sweep_margin`). The second is the rightmost root
on both sides of the ends of windows. For large loops, or if a root at zero is left out, a root count by the argument
principle replaces it. None shares algebra with the analysis. A difference beyond rounding raises DisagreementError.
"""

from collections.abc import Iterator, Sequence
from math import isfinite, nan

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError, DisagreementError
from gains.core.structure import balanced, distinct_blocks, square_matrices
from gains.delay._crossings import DelayedTerm, by_multiple, crossing_errors
from gains.delay.constant import Crossing, DelayAnalysis, analyse_delay

# largest sum of n^3 over blocks of n states: a sweep takes 0.2 s there, and 0.08 s for one block of 12 states
_SWEEP_BUDGET = 14_000
# largest number of states times points in a discretised spectrum, which takes 30 ms
_SPECTRUM_BUDGET = 200
# largest turn (rad) of the longest delay at the highest frequency for a root count, which takes 0.1 s
_COUNT_BUDGET = 1000.0
# frequencies in a count at zero delay; largest number of frequencies times n^3 for n states, which takes 4 s
_COUNT_POINTS, _INVERSE_BUDGET = 400, 1e10
# the roots of a crossing are still near the axis if the delay differs by less than this angle (rad) at their frequency
_NEAR_TURN = 0.2
# the spectrum is computed at this distance inside and outside a window, relative to its end
_BESIDE = 1e-4
# a thorough check also tests these fractions of a window
_FRACTIONS = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9)
# two methods agree if they differ by less than this (relative), or by less than this many errors of the crossing; a
# missed crossing differs by far more
_AGREEMENT, _ERRORS = 1e-6, 4.0
# a rightmost root this close to the axis, relative to the norm, decides nothing
_UNDECIDED = 1e-9
# least singular value of a characteristic matrix with rows of unit length, at a root
_TOUCH = 1e-7


def checked_delay_margin(A0: ArrayLike, A1: ArrayLike) -> float:
    """`gains.delay.constant.delay_margin`, confirmed by the sweep and by the rightmost root below and above it.

    It takes a hundred times as long: use it for a design to be flown, not inside an optimisation. Arguments as for
    `gains.delay.constant.delay_margin`. Raises BadModelError unless the matrices are square, finite and of one size,
    and DisagreementError, with the result of each method, if the methods differ.

    >>> round(checked_delay_margin([[0]], [[-1]]), 6)  # x'(t) = -x(t - tau): pi / 2
    1.570796
    """
    now, late = square_matrices(A0=A0, A1=A1)
    analysis = analyse_delay(now, late, horizon_s=1e-300)
    second_opinions(analysis, [DelayedTerm(now, 0.0, 0), DelayedTerm(late, 0.0, 1)], thorough=True)
    return analysis.delay_margin_s


def second_opinions(
    analysis: DelayAnalysis, terms: Sequence[DelayedTerm], *, thorough: bool = False
) -> tuple[tuple[str, ...], float]:
    """The methods that confirm an analysis of x'(t) = sum of the terms, and the estimated error (s) of its margin.

    Only methods that take a fraction of a second are used; if `thorough`, all of them, at more delays. Raises
    DisagreementError if a method contradicts the analysis. The error of a margin of 0 or `inf` is 0.
    """
    margin_s, error_s = analysis.delay_margin_s, 0.0
    if margin_s != 0.0 and isfinite(margin_s):
        ends = [(c.omega_rad_s, margin_s) for c in analysis.crossings if c.delay_s == margin_s]
        error_s = max((by_delay_s for _, by_delay_s in crossing_errors(terms, ends)), default=0.0)
    checks: list[str] = []
    swept_s = _swept_margin(analysis, terms, thorough)
    if swept_s is not None and _agrees(analysis, swept_s, error_s, terms):
        checks.append("sweep")
        if isfinite(swept_s):
            error_s = max(error_s, abs(margin_s - swept_s))
    checks += sorted(_confirmed_beside_windows(analysis, terms, error_s, thorough))
    return tuple(checks), error_s


def _swept_margin(analysis: DelayAnalysis, terms: Sequence[DelayedTerm], thorough: bool) -> float | None:
    """The margin found by the sweep; None if it does not apply or would take too long."""
    from gains.delay.sweep import circle_sweep_margin

    # the sweep judges zero delay by eigenvalues, so it finds no margin for a loop with roots on the axis there
    on_axis = analysis.roots_fixed_at_zero > 0 or any(crossing.delay_s == 0.0 for crossing in analysis.crossings)
    if on_axis or any(term.known_s for term in terms):
        return None
    matrices = by_multiple(terms)
    sizes = [len(block.matrices[0]) for block in distinct_blocks(*matrices)]
    if not thorough and sum(size**3 for size in sizes) > _SWEEP_BUDGET:
        return None
    return circle_sweep_margin(matrices)


def _agrees(analysis: DelayAnalysis, swept_s: float, error_s: float, terms: Sequence[DelayedTerm]) -> bool:
    """Whether the sweep found the same margin; False if it missed a root on the axis, otherwise DisagreementError."""
    margin_s = analysis.delay_margin_s
    if margin_s == swept_s or abs(margin_s - swept_s) <= max(_AGREEMENT * margin_s, _ERRORS * error_s):
        return True
    # a search easily misses a touch, or a motion that is slow beside others
    if margin_s < swept_s and any(_is_root(terms, c) for c in analysis.crossings if c.delay_s == margin_s):
        return False
    raise DisagreementError(f"the exact delay margin is {margin_s} s, the sweep says {swept_s} s")


def _is_root(terms: Sequence[DelayedTerm], crossing: Crossing) -> bool:
    """Whether the characteristic matrix is singular at the crossing, to rounding."""
    parts = balanced(*(term.matrix for term in terms))
    turns = np.exp([-1j * crossing.omega_rad_s * term.delay_s(crossing.delay_s) for term in terms])
    matrix = 1j * crossing.omega_rad_s * np.eye(len(parts[0])) - np.tensordot(turns, np.array(parts), axes=1)
    rows = np.maximum(np.linalg.norm(matrix, axis=1), 1e-300)
    return bool(np.linalg.svd(matrix / rows[:, np.newaxis], compute_uv=False)[-1] < _TOUCH)


def _confirmed_beside_windows(
    analysis: DelayAnalysis, terms: Sequence[DelayedTerm], error_s: float, thorough: bool
) -> set[str]:
    """Compare the windows with the spectrum inside and outside them; return the methods that could check a delay."""
    rate = sum(float(np.linalg.norm(term.matrix)) for term in terms)
    largest = max(len(block.matrices[0]) for block in distinct_blocks(*(term.matrix for term in terms)))
    methods: set[str] = set()
    for tau_s, stable in _delays_to_look_at(analysis, rate, error_s, thorough):
        pairs = [(term.matrix, term.delay_s(tau_s)) for term in terms]
        turns = rate * max(delay_s for _, delay_s in pairs)
        if analysis.roots_fixed_at_zero or (not thorough and largest * (12.0 + turns / 2.0) > _SPECTRUM_BUDGET):
            long = turns > _COUNT_BUDGET or (_COUNT_POINTS + 10.0 * turns) * largest**3 > _INVERSE_BUDGET
            method, growth = "root count", nan if long else rate * _sign_of_growth(analysis, pairs, tau_s)
        else:
            method, growth = "rightmost root", _growth(pairs)
        if not np.isnan(growth):
            methods.add(method)
        if (growth < 0.0) != stable and abs(growth) > _UNDECIDED * rate:
            raise DisagreementError(
                f"the loop should be {'stable' if stable else 'unstable'} at {tau_s} s, but the real part of its "
                f"rightmost root there is {growth} 1/s; windows {analysis.stable_intervals_s}"
            )
    return methods


def _growth(pairs: Sequence[tuple[FloatArray, float]]) -> float:
    """Real part (1/s) of the rightmost root; nan if the delay is too long to discretise."""
    from gains.delay.rightmost import rightmost_root

    try:
        return rightmost_root(pairs).real
    except BadModelError:
        return nan


def _sign_of_growth(analysis: DelayAnalysis, pairs: Sequence[tuple[FloatArray, float]], tau_s: float) -> float:
    """1 if a count finds roots right of the axis, -1 if it finds none; nan if one is too close to the axis."""
    from gains.delay._mixed import count_unstable_roots

    # frequencies of the crossings at delays so close that their roots are still near the axis
    away = ((c.omega_rad_s, c.omega_rad_s * (tau_s - c.delay_s)) for c in analysis.crossings)
    beside = [omega for omega, turn in away if abs(float(np.angle(np.exp(1j * turn)))) < _NEAR_TURN]
    try:
        count = count_unstable_roots(pairs, leave_out_zero=analysis.roots_fixed_at_zero > 0, beside=beside)
    except DisagreementError:
        return nan
    return 1.0 if count > 0 else -1.0


def _delays_to_look_at(
    analysis: DelayAnalysis, rate: float, error_s: float, thorough: bool
) -> Iterator[tuple[float, bool]]:
    """Delays near the ends of the first two windows and inside them, each with the verdict implied by the windows."""
    windows = analysis.stable_intervals_s
    if not windows:
        # rounding may move a root on the axis to either side, so only roots off the axis count
        if analysis.unstable_roots_at_zero_delay > 0 and rate > 0.0:
            yield 0.0, False
        return
    for start_s, end_s in windows[:2]:
        if not isfinite(end_s):
            yield start_s * (1.0 + _BESIDE) if start_s > 0.0 else 1.0 / rate, True
            continue
        beside_s = max(_BESIDE * end_s, _ERRORS * error_s)
        inside_s = min(beside_s, 0.1 * (end_s - start_s))
        yield end_s - inside_s, True
        if thorough:
            yield from ((start_s + fraction * (end_s - start_s), True) for fraction in _FRACTIONS)
        following = [start for start, _ in windows if start > start_s]
        # two windows may meet at a delay where a double root only touches the axis
        if not following or following[0] > end_s + 2.0 * beside_s:
            yield end_s + beside_s, False
        if start_s > 0.0:
            yield start_s + inside_s, True
