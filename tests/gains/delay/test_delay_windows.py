"""Windows of stability where counting is delicate: tangent, multiple, opposite and fixed roots, many windows."""

from math import acos, inf, pi, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gains.core.errors import BadModelError
from gains.core.structure import without_fixed_roots
from gains.delay.constant import Crossing, analyse_delay, delay_margin
from gains.delay.rightmost import rightmost_root
from gains.delay.sweep import frequency_sweep_margin

Matrix = NDArray[np.float64]
Pair = tuple[Matrix, Matrix]


def second_order(damping: float, stiffness: float, delayed: float) -> Pair:
    """s^2 + damping s + stiffness + delayed e^{-s tau}."""
    return np.array([[0.0, 1.0], [-stiffness, -damping]]), np.array([[0.0, 0.0], [-delayed, 0.0]])


def side_by_side(first: Pair, second: Pair, *, seed: int) -> Pair:
    """Two loops in one state vector, mixed by a random rotation so that no splitting into blocks tells them apart."""
    size = len(first[0]) + len(second[0])
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(size, size)))
    mixed: list[Matrix] = []
    for a, b in zip(first, second, strict=True):
        both = np.zeros((size, size))
        both[: len(a), : len(a)], both[len(a) :, len(a) :] = a, b
        mixed.append(rotation @ both @ rotation.T)
    return mixed[0], mixed[1]


def in_faster_time(pair: Pair, factor: float) -> Pair:
    return factor * pair[0], factor * pair[1]


@settings(deadline=None)
@given(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_scalar_margin_is_the_closed_form(a: float, b: float) -> None:
    # j w = a + b e^{-j w tau}: w^2 = b^2 - a^2, cos(w tau) = -a / b; next to a boundary rounding decides
    if min(abs(a + b), abs(a - b)) < 1e-3:
        return
    if a + b > 0.0:
        expected = 0.0
    elif abs(b) < -a:
        expected = inf
    else:
        expected = acos(-a / b) / sqrt(b * b - a * a)
    # acos loses half the digits near its ends, here at most 1e-16 / sqrt(1e-3)
    assert delay_margin([[a]], [[b]]) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_all_late_margin_follows_from_the_eigenvalues(seed: int) -> None:
    # x' = A1 x(t - tau): s = lambda e^{-s tau} crosses at omega = |lambda|, tau = (|arg lambda| - pi/2) / |lambda|
    rng = np.random.default_rng(seed)
    A1 = rng.normal(size=(5, 5)) - 3.0 * np.eye(5)
    eigenvalues = np.linalg.eigvals(A1)
    expected = float(np.min((np.abs(np.angle(eigenvalues)) - pi / 2.0) / np.abs(eigenvalues)))
    # 1e-10: eigenvalues of a random matrix of 5 states lose up to three digits
    assert delay_margin(np.zeros((5, 5)), A1) == pytest.approx(max(expected, 0.0), rel=1e-10)


@pytest.mark.parametrize("excess", [1e-2, 1e-4, 1e-6, 1e-8, 1e-10])
def test_near_tangent_crossings_are_both_found(excess: float) -> None:
    # s^2 + s + 1 + c e^{-s tau}: modulus c at omega^2 = (1 +- sqrt(4 c^2 - 3)) / 2, which merge at c = sqrt(3) / 2
    c = sqrt(0.75) * (1.0 + excess)
    omega = np.sqrt((1.0 + np.array([-1.0, 1.0]) * sqrt(4.0 * c * c - 3.0)) / 2.0)
    delays = np.angle(-c / (1.0 - omega**2 + 1j * omega)) % (2.0 * pi) / omega
    A0, A1 = second_order(1.0, 1.0, c)
    analysis = analyse_delay(A0, A1, horizon_s=50.0)
    found = sorted((crossing.omega_rad_s, crossing.delay_s, crossing.direction) for crossing in analysis.crossings)
    # the two frequencies are sqrt(excess) apart and known to 1e-15 / sqrt(excess)
    tolerance = 1e-14 / sqrt(excess)
    assert [pair[:2] for pair in found] == [
        pytest.approx(pair, rel=tolerance) for pair in zip(omega, delays, strict=True)
    ]
    assert [pair[2] for pair in found] == [-1, 1]
    assert frequency_sweep_margin(A0, A1) == pytest.approx(analysis.delay_margin_s, rel=tolerance)


def test_no_crossing_just_short_of_tangency() -> None:
    A0, A1 = second_order(1.0, 1.0, sqrt(0.75) * (1.0 - 1e-10))
    assert analyse_delay(A0, A1).delay_independent


def test_a_touch_of_the_axis_ends_the_margin() -> None:
    # s^2 + 1.2 s + 1 + 0.96 e^{-s tau} touches at omega^2 = 0.28; rounding may make two crossings or one touch of it
    omega = sqrt(0.28)
    delay_s = float(np.angle(-0.96 / (1.0 - 0.28 + 1.2j * omega)) % (2.0 * pi)) / omega
    analysis = analyse_delay(*second_order(1.2, 1.0, 0.96), horizon_s=100.0)
    # a double root is known to sqrt(eps)
    assert analysis.delay_margin_s == pytest.approx(delay_s, rel=1e-6)
    assert sum(crossing.direction for crossing in analysis.crossings) == 0
    # the second touch is one turn later
    assert analysis.stable_intervals_s[1][1] == pytest.approx(delay_s + 2.0 * pi / omega, rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_opposite_crossings_at_one_frequency_are_both_found(seed: int) -> None:
    # s^2 + 0.1 s + 1 - 0.4 e^{-s tau} crosses twice, in opposite directions; run faster, its lower frequency is the
    # slower copy's upper one
    slow = second_order(0.1, 1.0, -0.4)
    lower, upper = sorted(crossing.omega_rad_s for crossing in analyse_delay(*slow).crossings)
    fast = in_faster_time(slow, upper / lower)
    alone = sorted(
        (crossing.delay_s, crossing.omega_rad_s, crossing.direction)
        for pair in (slow, fast)
        for crossing in analyse_delay(*pair).crossings
    )
    together = analyse_delay(*side_by_side(slow, fast, seed=seed))
    found = [(crossing.delay_s, crossing.omega_rad_s, crossing.direction) for crossing in together.crossings]
    # two roots at one point of the axis cost a digit or two
    assert found == [pytest.approx(crossing, rel=1e-10) for crossing in alone]


@pytest.mark.parametrize("seed", range(3))
def test_double_crossings_are_counted_twice(seed: int) -> None:
    loop = second_order(0.3, 1.0, 0.8)
    alone, twice = analyse_delay(*loop), analyse_delay(*side_by_side(loop, loop, seed=seed))
    assert len(twice.crossings) == 2 * len(alone.crossings)
    for window, expected in zip(twice.stable_intervals_s, alone.stable_intervals_s, strict=True):
        assert window == pytest.approx(expected, rel=1e-10)


def test_many_windows_are_those_of_the_rightmost_root() -> None:
    # lightly damped, stabilised and destabilised in turn
    A0, A1 = second_order(0.05, 1.0, 0.2)
    windows = analyse_delay(A0, A1).stable_intervals_s
    assert len(windows) >= 4
    ends = [0.0, *(end for window in windows for end in window)]
    for before, after in zip(ends, [*ends[1:], ends[-1] + 0.5], strict=True):
        middle_s = (before + after) / 2.0
        stable = any(start < middle_s < end for start, end in windows)
        if after - before > 1e-6:
            assert (rightmost_root([(A0, 0.0), (A1, middle_s)]).real < 0.0) == stable


def test_listing_may_stop_at_a_horizon() -> None:
    A0, A1 = second_order(0.05, 1.0, 0.2)
    everything = analyse_delay(A0, A1)
    up_to_8 = analyse_delay(A0, A1, horizon_s=8.0)
    assert up_to_8.stable_intervals_s == tuple(w for w in everything.stable_intervals_s if w[0] <= 8.0)
    assert (everything.complete_to_s, up_to_8.complete_to_s) == (inf, 8.0)


# a pair on the axis at zero delay leaves it to the left in the first case, to the right in the second
@pytest.mark.parametrize("delayed", [-0.4, 0.4])
def test_pair_on_axis_is_unstable_only_if_it_moves_right(delayed: float) -> None:
    A0, A1 = second_order(0.0, 1.0, delayed)
    # s^2 + 1 - k e^{-s tau} has its next root on the axis at s^2 = -1 - k, tau = pi / sqrt(1 + k)
    assert delay_margin(A0, A1) == pytest.approx(pi / sqrt(1.4) if delayed < 0.0 else 0.0, rel=1e-13)
    assert delay_margin(A0, A1) == analyse_delay(A0, A1).delay_margin_s


def test_unstable_loop_has_no_margin_and_says_how_many_roots() -> None:
    # x'' = 2 x, and a delayed term too weak to matter: one real unstable root
    A0, A1 = second_order(0.0, -2.0, 0.1)
    analysis = analyse_delay(A0, A1)
    assert (analysis.delay_margin_s, analysis.unstable_roots_at_zero_delay) == (0.0, 1)
    assert analysis.stable_intervals_s == ()


def test_root_at_zero_for_every_delay_means_never_asymptotically_stable() -> None:
    laplacian = np.array([[1.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    analysis = analyse_delay(np.zeros((3, 3)), -laplacian)
    assert (analysis.stable_intervals_s, analysis.delay_margin_s) == ((), 0.0)


def test_consensus_without_its_common_value_takes_the_published_delay() -> None:
    # s + lambda e^{-s tau} for each eigenvalue: pi / (2 lambda_max), 3 for a path of three
    laplacian = np.array([[1.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    moving, _ = without_fixed_roots(np.zeros((3, 3)), -laplacian)
    assert delay_margin(*moving) == pytest.approx(pi / 6.0, rel=1e-13)


@pytest.mark.parametrize("seed", range(3))
def test_undamped_motion_out_of_the_loops_reach_means_never_stable(seed: int) -> None:
    oscillator = (np.array([[0.0, 1.0], [-4.0, 0.0]]), np.zeros((2, 2)))
    assert analyse_delay(*side_by_side(oscillator, second_order(1.0, 1.0, 0.5), seed=seed)).stable_intervals_s == ()


def test_block_without_delay_is_judged_by_its_eigenvalues() -> None:
    assert analyse_delay(-np.eye(2), np.zeros((2, 2))).delay_independent
    assert delay_margin(np.diag([-1.0, 0.1]), np.zeros((2, 2))) == 0.0
    assert delay_margin([[0.0]], [[0.0]]) == 0.0


def test_crossing_says_where_when_and_which_way() -> None:
    [crossing] = analyse_delay([[0.0]], [[-2.0]]).crossings
    assert crossing == Crossing(omega_rad_s=2.0, delay_s=pi / 4.0, direction=1, roots=2)


@pytest.mark.parametrize("horizon_s", [0.0, -1.0, float("nan")])
def test_horizon_must_be_positive(horizon_s: float) -> None:
    with pytest.raises(BadModelError, match="horizon_s is"):
        analyse_delay([[0.0]], [[-1.0]], horizon_s=horizon_s)
