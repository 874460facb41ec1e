"""Delay margin and period limit of the sampled and held loop."""

from math import inf, pi

import numpy as np
import pytest
from numpy.typing import NDArray

from gains.delay.constant import delay_margin
from gains.sampled._crossings import block_delay_margin
from gains.sampled._period import analyse_period
from gains.sampled.constant import forget_margins, sampled_delay_margin, spectral_radius

Matrix = NDArray[np.float64]
Loop = tuple[Matrix, Matrix, Matrix]

FOLLOWER = (np.array([[0.0, -1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, -1.0]]))


def first_unstable_delay_s(loop: Loop, *, period_s: float, up_to_s: float) -> float:
    """Independent method: march in steps of a tenth of a period, then bisection on the spectral radius."""

    def unstable(delay_s: float) -> bool:
        return spectral_radius(*loop, period_s=period_s, delay_s=delay_s) >= 1.0

    lower_s = 0.0
    if unstable(0.0):
        return 0.0
    while not unstable(lower_s + 0.1 * period_s):
        lower_s += 0.1 * period_s
        if lower_s > up_to_s:
            return inf
    upper_s = lower_s + 0.1 * period_s
    # 45 halvings of a tenth of a period
    for _ in range(45):
        middle_s = (lower_s + upper_s) / 2.0
        lower_s, upper_s = (lower_s, middle_s) if unstable(middle_s) else (middle_s, upper_s)
    return lower_s


def test_a_margin_is_kept_for_the_same_loop_only() -> None:
    A, B, K = FOLLOWER
    forget_margins()
    margin_s = sampled_delay_margin(A, B, K, period_s=0.1)
    nearly_s = sampled_delay_margin(A, B, np.nextafter(K, 2.0), period_s=0.1)
    assert sampled_delay_margin(A.copy(), B.copy(), K.copy(), period_s=0.1) == margin_s
    assert (block_delay_margin.cache_info().hits, block_delay_margin.cache_info().misses) == (1, 2)
    assert nearly_s != margin_s
    assert sampled_delay_margin(A, B, K, period_s=0.2) < margin_s - 0.04


def random_loop(seed: int) -> tuple[Loop, float]:
    """A loop of 1 to 3 states and 1 or 2 inputs, stable in continuous time, and a period, perhaps too long for it."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 4))
    inputs = int(rng.integers(1, min(n, 2) + 1))
    B, K = rng.normal(size=(n, inputs)), 2.0 * rng.normal(size=(inputs, n))
    A = rng.normal(size=(n, n))
    rightmost = float(np.linalg.eigvals(A + B @ K).real.max())
    return (A - (rightmost + 0.4) * np.eye(n), B, K), float(10.0 ** rng.uniform(-1.0, 0.0))


@pytest.mark.slow(first=20)
@pytest.mark.parametrize("seed", range(60))
def test_margin_is_where_the_spectral_radius_reaches_one(seed: int) -> None:
    loop, period_s = random_loop(seed)
    margin_s = sampled_delay_margin(*loop, period_s=period_s)
    searched_s = first_unstable_delay_s(loop, period_s=period_s, up_to_s=12.0 * period_s)
    if searched_s == inf:
        assert margin_s > 12.0 * period_s
    else:
        # the radius is known to 1e-13 or so and moves by some 1 / s
        assert margin_s == pytest.approx(searched_s, rel=1e-9)


@pytest.mark.parametrize("period_s", [0.02, 0.2])
def test_follower_margin_is_exact(period_s: float) -> None:
    margin_s = sampled_delay_margin(*FOLLOWER, period_s=period_s)
    searched_s = first_unstable_delay_s(FOLLOWER, period_s=period_s, up_to_s=1.0)
    # the search stops where the eigenvalues of a map of up to 40 states stop being accurate
    assert margin_s == pytest.approx(searched_s, rel=1e-11)


@pytest.mark.parametrize("period_s", [0.2, 0.1, 0.02, 0.01, 0.001])
def test_hold_costs_half_a_period(period_s: float) -> None:
    continuous_s = delay_margin(FOLLOWER[0], FOLLOWER[1] @ FOLLOWER[2])
    error_s = sampled_delay_margin(*FOLLOWER, period_s=period_s) + period_s / 2.0 - continuous_s
    # what is left is of second order; its factor depends on where in the period the margin falls, 0.04 at most here
    assert abs(error_s) < 0.05 * period_s**2


@pytest.mark.parametrize("whole", range(6))
def test_leader_limit_at_whole_periods_is_the_closed_form(whole: int) -> None:
    # x_{k+1} = x_k - k1 T x_{k-q}: z^q (z - 1) = -k1 T on the unit circle at the angle pi / (2 q + 1) first, where
    # |z - 1| = 2 sin(pi / (2 (2 q + 1)))
    k1 = 2.0 * np.sin(pi / (2.0 * (2.0 * whole + 1.0))) / 0.1
    radius = spectral_radius([[0.0]], [[1.0]], [[-k1]], period_s=0.1, delay_s=whole * 0.1)
    # rounding in the eigenvalues of a map of up to 6 states
    assert radius == pytest.approx(1.0, abs=1e-13)


@pytest.mark.parametrize("period_s", [0.02, 0.1, 0.2, 0.37])
@pytest.mark.parametrize("whole", range(1, 6))
def test_a_margin_of_whole_periods_is_found(whole: int, period_s: float) -> None:
    # the gain above; with one period, K T = 1, the radius leaves one without a slope, by (tau / T - 1)^2 / 2
    k1 = 2.0 * np.sin(pi / (2.0 * (2.0 * whole + 1.0))) / period_s
    margin_s = sampled_delay_margin([[0.0]], [[1.0]], [[-k1]], period_s=period_s)
    assert margin_s == pytest.approx(whole * period_s, rel=1e-12)


@pytest.mark.parametrize("share", [-1e-8, -1e-12, 1e-12, 1e-8])
def test_a_margin_beside_a_whole_period_is_found(share: float) -> None:
    # K T = 1 + share: with x = tau / T - 1 the radius is about 1 + share / 2 + x / 2 below T and + x^2 / 2 above
    margin_s = sampled_delay_margin([[0.0]], [[1.0]], [[-5.0 * (1.0 + share)]], period_s=0.2)
    assert margin_s == pytest.approx(0.2, rel=2e-4)


def test_decoupled_axes_have_the_margin_of_one() -> None:
    A, B, K = (np.kron(matrix, np.eye(2)).astype(np.float64) for matrix in FOLLOWER)
    alone_s = sampled_delay_margin(*FOLLOWER, period_s=0.02)
    assert sampled_delay_margin(A, B, K, period_s=0.02) == pytest.approx(alone_s, rel=1e-14)
    # gains as printed by a solver: axes coupled by a ten-thousandth, margin changed by as little
    K[0, 1], K[1, 2] = 1e-4, -1e-4
    coupled_s = sampled_delay_margin(A, B, K, period_s=0.02)
    assert coupled_s == pytest.approx(alone_s, rel=1e-3)
    assert coupled_s == pytest.approx(first_unstable_delay_s((A, B, K), period_s=0.02, up_to_s=1.0), rel=1e-10)


@pytest.mark.parametrize("vehicles", [2, 3])
@pytest.mark.parametrize("period_s", [0.02, 0.1, 0.5])
def test_equal_followers_in_mixed_coordinates_have_the_margin_of_one(vehicles: int, period_s: float) -> None:
    # a chain, each follower driven by the one in front: one double or triple root, which rounding spreads by its root
    A, B, own = (np.kron(np.eye(vehicles), matrix) for matrix in FOLLOWER)
    K = own + np.kron(np.eye(vehicles, k=-1), [[0.2, 0.5]])
    mixed = np.linalg.qr(np.random.default_rng(1).standard_normal((2 * vehicles, 2 * vehicles)))[0]
    margin_s = sampled_delay_margin(mixed @ A @ mixed.T, mixed @ B, K @ mixed.T, period_s=period_s)
    assert margin_s == pytest.approx(sampled_delay_margin(*FOLLOWER, period_s=period_s), rel=1e-4)


@pytest.mark.parametrize(
    ("loop", "period_s", "expected_periods"),
    [
        # unstable again from 1.9994 to 2.019 periods only: the angles exist for a thirtieth of a period
        (
            (
                np.array([[-1.42325999, 0.76329032], [-0.59266798, -0.36054061]]),
                np.array([[-2.03367867], [-0.9659665]]),
                np.array([[-0.33368842, -1.00235819]]),
            ),
            1.6169892858332227,
            1.99941448,
        ),
        # the delay of a crossing changes by a third of a period within a sixteenth of one
        ((np.array([[-1.461614]]), np.array([[1.0]]), np.array([[-2.65328026]])), 0.5808172169479804, 0.97469014),
    ],
    ids=["short window", "steep"],
)
def test_crossings_near_the_period_limit_once_missed_are_found(
    loop: Loop, period_s: float, expected_periods: float
) -> None:
    margin_s = sampled_delay_margin(*loop, period_s=period_s)
    # the digits given; both were found by a fine march through the delays
    assert margin_s / period_s == pytest.approx(expected_periods, rel=1e-7)
    before, after = (spectral_radius(*loop, period_s=period_s, delay_s=margin_s * f) for f in (1.0 - 1e-6, 1.0 + 1e-6))
    assert before < 1.0 < after


def test_unstable_loop_has_no_margin() -> None:
    assert sampled_delay_margin([[1.0]], [[1.0]], [[-0.5]], period_s=0.1) == 0.0
    # too slow a period for this gain: x_{k+1} = -1.1 x_k
    assert sampled_delay_margin([[0.0]], [[1.0]], [[-21.0]], period_s=0.1) == 0.0


def test_weak_feedback_of_a_stable_plant_takes_any_delay() -> None:
    assert sampled_delay_margin([[-1.0]], [[1.0]], [[-0.5]], period_s=0.1) == inf
    assert sampled_delay_margin([[-1.0]], [[1.0]], [[0.0]], period_s=0.1) == inf


def test_margin_scales_with_time() -> None:
    A, B, K = FOLLOWER
    slow_s = sampled_delay_margin(A, B, K, period_s=0.05)
    assert sampled_delay_margin(3.7 * A, 3.7 * B, K, period_s=0.05 / 3.7) == pytest.approx(slow_s / 3.7, rel=1e-11)


def test_period_limit_of_a_leader_is_two_over_its_gain() -> None:
    # x_{k+1} = (1 - k1 T) x_k
    assert analyse_period([[0.0]], [[1.0]], [[-4.0]]).limit_s == pytest.approx(0.5, rel=1e-12)


def test_period_limit_of_a_follower_is_the_closed_form() -> None:
    # e' = -v, v' = k3 e - k1 v held for T: Jury's criterion gives 1 - k1 T + k3 T^2 / 2 < 1 and 4 - 2 k1 T > 0
    assert analyse_period(*FOLLOWER).limit_s == pytest.approx(2.0, rel=1e-12)
    assert analyse_period(FOLLOWER[0], FOLLOWER[1], [[9.0, -1.0]]).limit_s == pytest.approx(2.0 / 9.0, rel=1e-12)


@pytest.mark.parametrize("angle", np.linspace(0.1, 1.5, 15))
def test_period_limit_of_a_follower_is_unchanged_in_turned_coordinates(angle: float) -> None:
    # rounding turns two integrators into a motion too slow to be seen within 1e16 s
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    A, B, K = FOLLOWER
    assert analyse_period(turn @ A @ turn.T, turn @ B, K @ turn.T).limit_s == pytest.approx(2.0, rel=1e-10)


@pytest.mark.parametrize(("a", "b", "error"), [(3.0, 100.0, 1e-3), (20.0, 100.0, 0.1)])
def test_period_limit_of_mixed_states_is_right_to_their_rounding(a: float, b: float, error: float) -> None:
    """All entries are exact, up to 4e6: the limit is 2 s over the gain. Also 1e-11 s once counted as unstable."""
    mix, back = np.array([[1.0, a], [b, 1.0 + a * b]]), np.array([[1.0 + a * b, -a], [-b, 1.0]])
    gain = 1.0 + 2.0**-10
    A, B = back @ np.array([[0.0, 1.0], [0.0, 0.0]]) @ mix, back @ np.array([[0.0], [1.0]])
    K = np.array([[-gain, -1.0]]) @ mix
    assert analyse_period(A, B, K).limit_s == pytest.approx(2.0 / gain, rel=error)


def test_a_stable_plant_with_small_gain_has_no_period_limit() -> None:
    assert analyse_period([[-1.0]], [[1.0]], [[-0.5]]).limit_s == inf


def test_period_limit_of_an_unstable_loop_is_zero() -> None:
    assert analyse_period([[1.0]], [[1.0]], [[-0.5]]).limit_s == 0.0


@pytest.mark.parametrize("gain", [4.882, 4.8875])
def test_loop_unstable_at_few_fractions_of_a_period_has_margin(gain: float) -> None:
    # a damped oscillation, sampled less than once: its loci have modulus one at a fiftieth of all fractions
    loop = [[0.0, 1.0], [-23.0, -1.4]], [[0.0], [1.0]], gain * np.array([[-0.5, 0.6]])
    looks = np.arange(0.0, 12.0, 0.005)
    radii = [spectral_radius(*loop, period_s=1.0, delay_s=float(delay_s)) for delay_s in looks]
    first_s = float(looks[np.flatnonzero(np.array(radii) >= 1.0)[0]])
    margin_s = sampled_delay_margin(*loop, period_s=1.0)
    assert first_s - 0.005 <= margin_s <= first_s
