"""Bounds for delays that vary: published numbers, proofs below the exact margin, and worst-case delays."""

from itertools import pairwise
from math import inf, isnan, sqrt
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gains.core.errors import BadModelError
from gains.core.semidefinite import Unknown, positive_definite_solution
from gains.delay.constant import delay_margin
from gains.varying.bounds import varying_delay_bound
from gains.varying.jitter import bound_covering, spread_bound

Matrix = NDArray[np.float64]
A0: Matrix = np.array([[-2.0, 0.0], [0.0, -0.9]])
A1: Matrix = np.array([[-1.0, 0.0], [-1.0, -1.0]])
FOLLOWER = (np.array([[0.0, -1.0], [0.0, 0.0]]), np.array([[0.0, 0.0], [1.0, -1.0]]))
# bisections end at a part in 10^4
BISECTION = 1.5e-4


@pytest.mark.slow(first=2)
@pytest.mark.parametrize(
    ("rate", "bound_s"), [(0.0, 6.059), (0.1, 4.703), (0.2, 3.834), (0.5, 2.420), (0.8, 2.137), (1.0, 2.128)]
)
def test_published_bounds_for_a_bounded_rate(rate: float, bound_s: float) -> None:
    # Seuret and Gouaisbaut 2013, 4 digits; the solver's strictness is worth less than a part in 10^3
    assert varying_delay_bound(A0, A1, rate=rate) == pytest.approx(bound_s, rel=1e-3)


def test_any_variation_is_bounded_by_the_best_scaled_small_gain() -> None:
    # at high frequency the gain is that of A1 under the best scaling, its spectral radius 1; an independent search
    # over scalings came to 0.9974, unscaled it is 1 / ||A1|| = 0.618
    assert varying_delay_bound(A0, A1, rate=inf) >= 1.0 - 2.0 * BISECTION


def test_small_gain_of_one_signal_needs_no_scaling() -> None:
    # follower: |s (s + 1) / (s^2 + s + 1)| on the axis, found on a fine grid
    omega = np.logspace(-3.0, 3.0, 200_001)
    s = 1j * omega
    largest = float(np.abs(s * (s + 1.0) / (s * s + s + 1.0)).max())
    assert varying_delay_bound(*FOLLOWER, rate=inf) >= (1.0 - 2.0 * BISECTION) / largest


def test_bounds_fall_as_the_delay_may_vary_faster() -> None:
    bounds = [varying_delay_bound(*FOLLOWER, rate=rate) for rate in (0.0, 0.3, 0.9, inf)]
    assert delay_margin(*FOLLOWER) >= bounds[0]
    assert all(more >= less * (1.0 - BISECTION) for more, less in pairwise(bounds))
    # Wirtinger's inequality comes close for a follower
    assert bounds[0] > 0.99 * delay_margin(*FOLLOWER)


def test_bounds_scale_with_time() -> None:
    for factor in (1e-4, 1e4):
        slow, fast = (varying_delay_bound(f * A0, f * A1, rate=0.5) * f for f in (1.0, factor))
        assert fast == pytest.approx(slow, rel=2.0 * BISECTION)


def test_weak_delayed_part_takes_delays_of_any_length() -> None:
    assert varying_delay_bound([[-2.0]], [[1.0]], rate=0.5) == inf
    # 1 - mu < 1/4: the functional for any length no longer proves stability
    assert varying_delay_bound([[-2.0]], [[1.0]], rate=0.8) < inf


def test_unstable_loop_has_no_bound() -> None:
    for rate in (0.1, inf):
        assert varying_delay_bound([[1.0]], [[-0.5]], rate=rate) == 0.0


def test_blocks_are_taken_one_by_one() -> None:
    both0 = np.block([[A0, np.zeros((2, 2))], [np.ones((2, 2)), FOLLOWER[0]]])
    both1 = np.block([[A1, np.zeros((2, 2))], [np.zeros((2, 2)), FOLLOWER[1]]])
    alone = min(varying_delay_bound(A0, A1, rate=0.5), varying_delay_bound(*FOLLOWER, rate=0.5))
    assert varying_delay_bound(both0, both1, rate=0.5) == alone


def flown(loop: tuple[Matrix, Matrix], delay_s: NDArray[np.float64], step_s: float) -> float:
    """Growth of x' = A0 x + A1 x(t - tau(t)) from x = 1 by Heun's method: last second over first second."""
    now, late = loop
    steps = delay_s.size
    x = np.ones((steps + 1, len(now)))

    def delayed(k: int) -> Matrix:
        at = k - delay_s[min(k, steps - 1)] / step_s
        low = int(np.floor(at))
        older, newer = x[max(low, 0)], x[min(max(low + 1, 0), k)]
        return older + (at - low) * (newer - older)

    for k in range(steps):
        slope = now @ x[k] + late @ delayed(k)
        x[k + 1] = x[k] + step_s * slope
        x[k + 1] = x[k] + step_s / 2.0 * (slope + now @ x[k + 1] + late @ delayed(k + 1))
    second = round(1.0 / step_s)
    return float(np.abs(x[-second:]).max() / np.abs(x[:second]).max())


@pytest.mark.parametrize("seed", range(3))
def test_follower_survives_jumping_delays_below_the_bound(seed: int) -> None:
    bound_s = varying_delay_bound(*FOLLOWER, rate=inf)
    rng = np.random.default_rng(seed)
    step_s = 0.01
    # a new delay every few hundredths of a second, often the largest
    delays = np.repeat(np.minimum(rng.uniform(0.0, 1.6, 1000) * bound_s, bound_s), 4)
    # forty seconds of a loop with time constants of a second or more
    assert flown(FOLLOWER, delays, step_s) < 0.5


def test_the_simulation_grows_at_a_constant_delay_beyond_the_margin() -> None:
    """So the simulation can tell stable from unstable."""
    delay_s = 1.1 * delay_margin(*FOLLOWER)
    assert flown(FOLLOWER, np.full(4000, delay_s), 0.01) > 2.0


def test_constant_delay_is_covered_by_the_exact_margin() -> None:
    verdict = bound_covering(A0, A1, mean_s=6.1, spread_s=0.0, rate=0.0)
    assert verdict.cover == "constant"
    assert verdict.bound_s == delay_margin(A0, A1)


@pytest.mark.slow(first=3)
@pytest.mark.parametrize(
    ("mean_s", "spread_s", "rate", "cover"),
    [
        (2.0, 0.3, 0.5, "rate"),
        (2.0, 0.05, inf, "spread"),
        (1.0, 1.0, inf, "any"),
        (5.0, 0.8, inf, "none"),
        (6.3, 0.0, 0.0, "none"),
        (6.3, 0.01, 0.1, "none"),
    ],
)
def test_a_jitter_is_covered_by_the_first_sufficient_bound(
    mean_s: float, spread_s: float, rate: float, cover: str
) -> None:
    verdict = bound_covering(A0, A1, mean_s=mean_s, spread_s=spread_s, rate=rate)
    assert verdict.cover == cover
    assert isnan(verdict.bound_s) if cover == "none" else mean_s + spread_s <= verdict.bound_s
    assert verdict.bound_s <= delay_margin(A0, A1) or isnan(verdict.bound_s)


@pytest.mark.parametrize(("rate", "gain"), [(0.5, 1.0), (1.0, 1.0), (1.01, sqrt(1.75)), (inf, sqrt(1.75))])
def test_spread_of_a_scalar_loop_is_the_closed_form(rate: float, gain: float) -> None:
    # x' = -x(t - mean): G = s / (s + e^{-s mean}), whose largest modulus a fine grid gives
    omega = np.logspace(-3.0, 3.0, 400_001)
    s = 1j * omega
    largest = float(np.abs(s / (s + np.exp(-s * 0.8))).max())
    # the grid of the function itself allows a part in a thousand
    found = spread_bound([[0.0]], [[-1.0]], mean_s=0.8, rate=rate)
    assert found == pytest.approx(1.0 / (gain * largest), rel=2e-3)


def test_spread_shrinks_to_nothing_at_the_margin() -> None:
    margin_s = delay_margin(*FOLLOWER)
    spreads = [spread_bound(*FOLLOWER, mean_s=share * margin_s) for share in (0.7, 0.9, 0.99, 0.999)]
    assert all(a > b for a, b in pairwise(spreads))
    assert all(
        share * margin_s + spread <= margin_s for share, spread in zip((0.7, 0.9, 0.99, 0.999), spreads, strict=True)
    )
    assert spread_bound(*FOLLOWER, mean_s=1.01 * margin_s) == 0.0


@pytest.mark.parametrize("scaled", [True, False])
@pytest.mark.parametrize("share", [1e-3, 1e-5, 1e-7])
def test_spread_near_the_margin_stays_below_it(share: float, scaled: bool) -> None:
    # a constant delay at the end of the spread is a variation too
    margin_s = delay_margin(*FOLLOWER)
    mean_s = (1.0 - share) * margin_s
    assert mean_s + spread_bound(*FOLLOWER, mean_s=mean_s, rate=1.0, scaled=scaled) <= margin_s


CELLS = 40


def integral_gain(reach: NDArray[np.int_]) -> float:
    """Gain of (T y)(t) = signed integral of y from t - reach(t) to t, |reach| <= 1, in cells of 1 / CELLS."""
    size = reach.size
    matrix = np.zeros((size, size))
    for t, back in enumerate(reach.tolist()):
        matrix[t, max(min(t, t - back), 0) : max(t, t - back)] = 1.0 if back > 0 else -1.0
    return float(np.linalg.norm(matrix, 2)) / CELLS


def worst_reach(reach: NDArray[np.int_]) -> NDArray[np.int_]:
    """The next deviation in the search: at each instant it takes the side with more of the worst signal."""
    size = reach.size
    t = np.arange(size)
    for _ in range(15):
        matrix = np.array(
            [[float(min(k, k - r) <= i < max(k, k - r)) for i in t] for k, r in enumerate(reach.tolist())]
        )
        signal = np.abs(np.linalg.svd(matrix)[2][0])
        total = np.concatenate([[0.0], np.cumsum(signal)])
        behind, ahead = total[t] - total[np.maximum(t - CELLS, 0)], total[np.minimum(t + CELLS, size)] - total[t]
        reach = np.where(behind >= ahead, CELLS, -CELLS)
    return reach


@pytest.mark.parametrize("seed", range(3))
def test_a_deviations_integral_has_at_most_the_assumed_gain(seed: int) -> None:
    rng = np.random.default_rng(seed)
    anyhow = rng.integers(-CELLS, CELLS + 1, 4 * CELLS)
    assert integral_gain(anyhow) ** 2 <= 1.75
    # the worst that the search finds exceeds the bound for slow deviations, and is near the bound for all
    assert 1.5 < integral_gain(worst_reach(anyhow)) ** 2 <= 1.75


@pytest.mark.parametrize("seed", range(3))
def test_deviation_that_overtakes_nothing_has_at_most_unit_gain(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # a sawtooth: it rises by at most one cell per cell, and falls by any amount
    reach = [0]
    for fall in np.where(rng.random(4 * CELLS) < 0.03, rng.integers(0, 2 * CELLS, 4 * CELLS), 0).tolist():
        reach.append(int(np.clip(reach[-1] + 1 - fall, -CELLS, CELLS)))
    assert integral_gain(np.array(reach)) <= 1.0


@pytest.mark.parametrize("rate", [1.0, inf])
def test_follower_survives_adverse_delays_within_its_spread(rate: float) -> None:
    mean_s, step_s = 0.6 * delay_margin(*FOLLOWER), 0.01
    spread_s = spread_bound(*FOLLOWER, mean_s=mean_s, rate=rate)
    t = np.arange(4000) * step_s
    for turn_s in (0.2, 0.5, 1.0, 2.0, 3.5, 5.0):
        # square waves for any rate; for rates up to one a sawtooth that rises at the rate one and jumps down
        deviation_s = np.sign(np.sin(2.0 * np.pi * t / turn_s)) * spread_s
        if rate == 1.0:
            deviation_s = np.minimum(t % turn_s - spread_s, spread_s)
        assert flown(FOLLOWER, mean_s + deviation_s, step_s) < 0.5, turn_s


def test_inequality_without_solution_is_not_solved() -> None:
    # X > 0 and -X > 0
    assert positive_definite_solution([Unknown(2)], lambda unknowns: [unknowns[0], -unknowns[0]]) is None


def test_lyapunov_equation_is_solved_where_it_can_be() -> None:
    stable, unstable = np.array([[-1.0, 10.0], [0.0, -2.0]]), np.array([[0.1, 1.0], [0.0, -2.0]])
    for matrix, exists in ((stable, True), (unstable, False)):
        found = positive_definite_solution(
            [Unknown(2)], lambda unknowns, A=matrix: [unknowns[0], -(A.T @ unknowns[0] + unknowns[0] @ A)]
        )
        assert (found is not None) == exists


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: varying_delay_bound(A0, A1, rate=-0.1), "rate is -0.1"),
        (lambda: varying_delay_bound(A0, A1, rate=float("nan")), "rate is nan"),
        (lambda: varying_delay_bound(np.ones((9, 9)), np.eye(9), rate=0.1), "block of 9 states"),
        (lambda: bound_covering(A0, A1, mean_s=1.0, spread_s=2.0, rate=0.0), "spread_s is 2.0"),
        (lambda: bound_covering(A0, A1, mean_s=-1.0, spread_s=0.0, rate=0.0), "mean_s is -1.0"),
        (lambda: bound_covering(A0, A1, mean_s=1.0, spread_s=0.5, rate=-1.0), "rate is -1.0"),
    ],
)
def test_wrong_questions_are_named(call: Any, message: str) -> None:
    with pytest.raises(BadModelError, match=message):
        call()
