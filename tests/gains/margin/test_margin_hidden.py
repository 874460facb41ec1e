"""Loops that margin tools get wrong, with answers known in closed form; and random loops on which three methods agree.

The random part takes a seeded sample. All thousand: MARGIN_SYSTEMS=1000 pytest
tests/gains/margin/test_margin_hidden.py -n auto
"""

import json
import os
from math import acos, atan, inf, isfinite, pi, sqrt

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from gains.delay.constant import analyse_delay, delay_margin
from gains.delay.rightmost import rightmost_root
from gains.delay.sweep import circle_sweep_margin, frequency_sweep_margin
from gains.margin.loop_margin import LoopAtGivenDelays, loop_margin
from gains.margin.model_file import parse_model
from gains.margin.opinions import checked_delay_margin
from gains.varying.bounds import varying_delay_bound
from gains.varying.jitter import spread_bound
from gcs.cli.margin import margin_fields

Matrix = NDArray[np.float64]
Pair = tuple[Matrix, Matrix]

SYSTEMS = int(os.environ.get("MARGIN_SYSTEMS", "60"))
# a group stays well below the time limit of a test
GROUPS = max(20, SYSTEMS // 5)


def result_of(A0: ArrayLike, A1: ArrayLike) -> dict[str, object]:
    """The fields that `gcs margin` reports for a pair that it reads from JSON text."""
    text = f'{{"A0": {np.asarray(A0).tolist()}, "A1": {np.asarray(A1).tolist()}}}'
    return margin_fields(loop_margin(parse_model(text)))


def second_order(damping: float, stiffness: float, delayed: float) -> Pair:
    """s^2 + damping s + stiffness + delayed e^{-s tau}."""
    return np.array([[0.0, 1.0], [-stiffness, -damping]]), np.array([[0.0, 0.0], [-delayed, 0.0]])


def rotated(A0: Matrix, A1: Matrix, *, seed: int) -> Pair:
    """The same loop in coordinates that leave no entry zero: one block."""
    Q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=A0.shape))
    return Q @ A0 @ Q.T, Q @ A1 @ Q.T


def scalar_margin_s(a: float, b: float) -> float:
    """s = a + b e^{-s tau}."""
    if a + b >= 0.0:
        return 0.0
    return inf if abs(b) <= -a else acos(-a / b) / sqrt(b * b - a * a)


@pytest.mark.parametrize("k", [0.4, 0.1, 0.02, 0.004])
def test_all_windows_of_an_undamped_oscillator_are_listed(k: float) -> None:
    # s^2 + 1 - k e^{-s tau} is stable for 2 n pi / sqrt(1 - k) < tau < (2 n + 1) pi / sqrt(1 + k): Abdallah, Dorato,
    # Benitez-Read and Byrne 1993
    expected = [(2 * n * pi / sqrt(1.0 - k), (2 * n + 1) * pi / sqrt(1.0 + k)) for n in range(1000)]
    expected = [list(window) for window in expected if window[0] < window[1]]
    assert len(expected) >= 1
    windows = result_of(*second_order(0.0, 1.0, -k))["stable_intervals_s"]
    assert isinstance(windows, list)
    # two crossings with well-separated frequencies, known to 14 digits
    assert np.array(windows) == pytest.approx(np.array(expected), rel=1e-12)


@pytest.mark.parametrize("excess", [1e-4, 1e-8, 1e-12, 1e-15])
def test_near_tangent_crossings_are_neither_missed_nor_a_contradiction(excess: float) -> None:
    c = sqrt(0.75) * (1.0 + excess)
    omega = sqrt((1.0 - sqrt(max(4.0 * c * c - 3.0, 0.0))) / 2.0), sqrt((1.0 + sqrt(max(4.0 * c * c - 3.0, 0.0))) / 2.0)
    first_s = min(float(np.angle(-c / (1.0 - w * w + 1j * w)) % (2.0 * pi)) / w for w in omega)
    # a double root is known to sqrt(eps)
    assert result_of(*second_order(1.0, 1.0, c))["delay_margin_s"] == pytest.approx(first_s, rel=3e-7)


def test_just_short_of_tangency_is_independent_of_delay() -> None:
    assert result_of(*second_order(1.0, 1.0, sqrt(0.75) * (1.0 - 1e-9)))["delay_independent"] is True


@pytest.mark.parametrize("size", [3, 12, 20])
def test_all_late_symmetric_block_takes_a_quarter_turn(size: int) -> None:
    # A0 = 0: s + lambda e^{-s tau}, pi / (2 lambda_max)
    eigenvalues = np.linspace(0.5, 3.0, size)
    A0, A1 = rotated(np.zeros((size, size)), -np.diag(eigenvalues), seed=size)
    # a block of 20 loses two to three digits in the rotation and the n^2 x n^2 eigenvalue problem
    assert delay_margin(A0, A1) == pytest.approx(pi / 6.0, rel=1e-12)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("size", [6, 14, 20])
def test_scalar_loops_mixed_in_one_block_have_their_least_margin(size: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-1.5, 0.5, size), rng.uniform(-3.0, -0.6, size)
    A0, A1 = rotated(np.diag(a), np.diag(b), seed=seed)
    expected = min(scalar_margin_s(*pair) for pair in zip(a.tolist(), b.tolist(), strict=True))
    assert 0.0 < expected < inf
    assert delay_margin(A0, A1) == pytest.approx(expected, rel=1e-11)


def test_a_late_part_of_rank_one_has_the_closed_form() -> None:
    # a chain of 11 lags and one integrator around which the feedback is late: rank one in 12 states;
    # k e^{-s tau} = s (s T + 1)^11 has its margin at the gain crossover in closed form once k is chosen for omega = 1
    lag_s, n = 0.02, 12
    k = (1.0 + lag_s**2) ** 5.5
    A0 = np.diag([0.0] + [-1.0 / lag_s] * 11) + np.diag([1.0 / lag_s] * 11, -1)
    A1 = np.zeros((n, n))
    A1[0, -1] = -k
    expected = pi / 2.0 - 11.0 * atan(lag_s)
    assert result_of(A0, A1)["delay_margin_s"] == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("size", [3, 8, 12])
def test_consensus_has_the_margin_of_the_motion_that_decays(size: int) -> None:
    # A0 + A1 singular: a ring without a pinned vehicle, s + lambda e^{-s tau}, lambda_max of the Laplacian
    shift = np.roll(np.eye(size), 1, axis=1)
    laplacian = 2.0 * np.eye(size) - shift - shift.T
    result = result_of(np.zeros((size, size)), -laplacian)
    largest = float(np.linalg.eigvalsh(laplacian).max())
    assert result["delay_margin_s"] == pytest.approx(pi / (2.0 * largest), rel=1e-11)
    assert result["roots_fixed_at_zero"] == 1


@pytest.mark.parametrize("decades", [6, 10])
def test_unlike_units_are_no_equilibrium(decades: int) -> None:
    # states in units that differ by up to twice as many decades: some states were once removed as equilibria
    rng = np.random.default_rng(8)
    free, A1 = rng.normal(size=(12, 12)), rng.normal(size=(12, 12))
    A0 = free - (np.linalg.eigvals(free + A1).real.max() + 0.3) * np.eye(12)
    unit = 10.0 ** rng.uniform(-decades, decades, 12)
    result = result_of(A0 * unit[:, None] / unit, A1 * unit[:, None] / unit)
    assert result["roots_fixed_at_zero"] == 0
    # the similarity itself rounds each entry
    assert result["delay_margin_s"] == pytest.approx(delay_margin(A0, A1), rel=1e-10)


@pytest.mark.parametrize("slow", [1e-6, 1e-9, 1e-14])
def test_slow_motion_beside_a_fast_one_has_the_closed_form(slow: float) -> None:
    # s (s + 1e3) + slow e^{-s tau} (s + 1e3) - slow / 2: to first order in slow s = slow (5e-4 - e^{-s tau})
    result = result_of([[-1e3, 0.5], [slow, 0.0]], [[0.0, 0.0], [0.0, -slow]])
    expected = scalar_margin_s(5e-4 * slow, -slow)
    assert (result["roots_fixed_at_zero"], result["notes"]) == (0, [])
    assert result["delay_margin_s"] == pytest.approx(expected, rel=3.0 * slow + 1e-12)


def test_formation_at_constant_velocity_has_two_roots_at_zero() -> None:
    # x'' = -L (x + x') all late: per eigenvalue the follower's closed form with k1 = k3 = lambda
    size = 5
    shift = np.roll(np.eye(size), 1, axis=1)
    laplacian = 2.0 * np.eye(size) - shift - shift.T
    zero, identity = np.zeros((size, size)), np.eye(size)
    result = result_of(np.block([[zero, identity], [zero, zero]]), np.block([[zero, zero], [-laplacian, -laplacian]]))
    margins_s: list[float] = []
    for k in np.linalg.eigvalsh(laplacian)[1:].tolist():
        omega = sqrt((k**2 + sqrt(k**4 + 4.0 * k**2)) / 2.0)
        margins_s.append(atan(omega) / omega)
    # double eigenvalues of the ring, in one block
    assert result["delay_margin_s"] == pytest.approx(min(margins_s), rel=1e-9)
    assert result["roots_fixed_at_zero"] == 2


def test_a_zero_root_without_equilibrium_is_left_out_and_reported() -> None:
    # s + 1 - e^{-s tau}: A0 + A1 = 0 while neither vanishes; |s + 1| > 1 in the right half plane
    result = result_of([[-1.0]], [[1.0]])
    assert (result["stable_intervals_s"], result["roots_fixed_at_zero"]) == ([[0.0, None]], 1)
    # s - 1 + e^{-s tau}: a second root passes zero at tau = 1, where s - 1 + 1 - s tau + ... has a double one
    result = result_of([[1.0]], [[-1.0]])
    assert result["stable_intervals_s"] == [[0.0, pytest.approx(1.0, rel=1e-14)]]
    assert result["checked_by"] == ["root count"]


@pytest.mark.parametrize("delay_s", [0.5, 1.2])
def test_given_delays_leave_out_roots_fixed_at_zero(delay_s: float) -> None:
    # s - 1 + e^{-s tau}: the second real root passes zero at tau = 1
    text = f'{{"terms": [{{"A": [[1]], "delay": 0}}, {{"A": [[-1]], "delay": {delay_s}}}]}}'
    result = margin_fields(loop_margin(parse_model(text)))
    assert (result["stable"], result["roots_fixed_at_zero"]) == (delay_s < 1.0, 1)
    assert "1 root stays at 0" in str(result["notes"])


def test_given_delays_report_the_rightmost_of_two_unstable_roots() -> None:
    # beside the zero root of x' = 0.5 x - 0.5 y, y' = the same negated, is the pair 0.9 +- 50j, driven and driving
    root, pair = np.array([[1.0, -1.0], [-1.0, 1.0]]) / 2.0, np.array([[0.9, 50.0], [-50.0, 0.9]])
    whole = np.block([[root, np.zeros((2, 2))], [np.zeros((2, 2)), pair]])
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(4, 4)))[0]
    terms = [{"A": (turn @ whole @ turn.T - 3.0 * np.eye(4)).tolist(), "delay": 0.0}]
    found = loop_margin(parse_model(json.dumps({"terms": [*terms, {"A": (3.0 * np.eye(4)).tolist(), "delay": 1e-9}]})))
    assert isinstance(found, LoopAtGivenDelays)
    assert found.rightmost_root == pytest.approx(1.0, rel=1e-6)
    assert found.roots_fixed_at_zero == 1


@pytest.mark.parametrize("gain", [1.0, 3.0, 1e-6, 1e6])
def test_roots_on_the_axis_at_given_delays_are_unstable(gain: float) -> None:
    text = f'{{"terms": [{{"A": [[-{gain!r}]], "delay": {pi / (2.0 * gain)!r}}}]}}'
    assert margin_fields(loop_margin(parse_model(text)))["stable"] is False


def test_a_loop_marginal_at_no_delay_says_so() -> None:
    # s^2 + 1 - 0.1 e^{-s tau}: +- 0.949j at tau = 0, left of the axis at once; a damped loop says nothing
    result = result_of([[0.0, 1.0], [-1.0, 0.0]], [[0.0, 0.0], [0.1, 0.0]])
    assert str(result["stable_intervals_s"]).startswith("[[0.0, ")
    assert result["notes"] == ["at tau = 0 itself roots are on the imaginary axis: stable only beyond it"]
    assert result_of([[0.0, 1.0], [-1.0, -1.0]], [[0.0, 0.0], [0.1, 0.0]])["notes"] == []


def test_a_formation_that_drifts_is_not_called_an_equilibrium() -> None:
    laplacian = np.array([[1.0, -1.0], [-1.0, 1.0]])
    free, acts = np.kron([[0.0, 1.0], [0.0, 0.0]], np.eye(2)), np.kron([[0.0, 0.0], [-1.0, -1.0]], laplacian)
    result = result_of(free, acts)
    assert result["roots_fixed_at_zero"] == 2
    assert "equilibrium" not in str(result["notes"])
    assert "grow with time" in str(result["notes"])


def test_an_integrator_without_feedback_is_stable_at_no_delay() -> None:
    result = result_of([[0.0, 0.0], [1.0, -1.0]], [[0.0, 0.0], [0.0, -0.5]])
    assert (result["stable_intervals_s"], result["delay_margin_s"]) == ([], 0.0)
    assert result["notes"] == ["a root stays at 0 at every delay, so the loop is asymptotically stable at none"]


@pytest.mark.parametrize("followers", [6, 40])
def test_defective_chain_has_the_margin_of_one_follower(followers: int) -> None:
    one0, one1 = np.array([[0.0, -1.0], [0.0, 0.0]]), np.array([[0.0, 0.0], [1.0, -1.0]])
    link = np.kron(np.eye(followers, k=-1), [[0.0, 1.0], [0.0, 0.0]])
    A0, A1 = np.kron(np.eye(followers), one0) + link, np.kron(np.eye(followers), one1)
    omega = sqrt((1.0 + sqrt(5.0)) / 2.0)
    assert result_of(A0, A1)["delay_margin_s"] == pytest.approx(atan(omega) / omega, rel=1e-13)


@pytest.mark.parametrize("size", [1, 3, 8])
def test_a_loop_at_the_edge_of_independence_has_no_limit(size: int) -> None:
    # A0 = A1: s + a (1 + e^{-s tau}); A0 - A1 is singular, so a locus has modulus one at zero frequency;
    # rounding once turned this into a crossing at 1e16 s
    A0, A1 = rotated(-np.diag(np.linspace(0.3, 2.0, size)), -np.diag(np.linspace(0.3, 2.0, size)), seed=size)
    assert analyse_delay(A0, A1).delay_independent
    assert frequency_sweep_margin(A0, A1) == circle_sweep_margin([A0, A1]) == inf


@pytest.mark.parametrize("slow", [1e-4, 1e-8, 1e-12])
def test_fast_motion_beside_slow_motion_sets_the_margin(slow: float) -> None:
    # 1 / slow turns of the fast root in a turn of the slow one were once all listed, until memory was full
    A0, A1 = np.diag([0.0, 0.0]), -np.diag([slow, 100.0])
    assert analyse_delay(A0, A1).stable_intervals_s == ((0.0, pytest.approx(pi / 200.0, rel=1e-14)),)
    # and alone, the slow one has its own limit
    assert delay_margin([[0.0]], [[-slow]]) == pytest.approx(pi / (2.0 * slow), rel=1e-14)


def test_a_delay_within_its_window_stabilises_an_unstable_loop() -> None:
    # s^2 - 0.1 s + 2 - e^{-s tau}: |(2 - w^2)^2 + 0.01 w^2| = 1; the lower crossing stabilises, the upper does not
    A0, A1 = np.array([[0.0, 1.0], [-2.0, 0.1]]), np.array([[0.0, 0.0], [1.0, 0.0]])
    half = (4.0 - 0.01) / 2.0
    omega = sqrt(half - sqrt(half * half - 3.0)), sqrt(half + sqrt(half * half - 3.0))
    begin_s, end_s = sorted(float(np.angle(1.0 / (2.0 - w * w - 0.1j * w)) % (2.0 * pi)) / w for w in omega)
    result = result_of(A0, A1)
    assert result["delay_margin_s"] == 0.0
    assert result["unstable_roots_at_zero_delay"] == 2
    assert np.array(result["stable_intervals_s"]) == pytest.approx(np.array([[begin_s, end_s]]), rel=1e-12)


def random_loop(seed: int) -> Pair:
    """A loop of 1 to 6 states with delayed feedback of random rank, sparse or full, mostly stable without delay."""
    rng = np.random.default_rng([seed, 11])
    n = int(rng.integers(1, 7))
    rank = int(rng.integers(1, n + 1))
    A0 = rng.normal(size=(n, n)) * (rng.random((n, n)) < rng.uniform(0.4, 1.0))
    A1 = rng.normal(size=(n, rank)) @ rng.normal(size=(rank, n)) * rng.uniform(0.3, 2.0)
    rightmost = float(np.linalg.eigvals(A0 + A1).real.max())
    return A0 - (rightmost + rng.uniform(-0.1, 0.8)) * np.eye(n), A1


def check_opinions_agree(A0: Matrix, A1: Matrix) -> float:
    """Exact, frequency sweep and rightmost root agree (or it raises), and so does the sweep along the circle."""
    margin_s = checked_delay_margin(A0, A1)
    swept_s = circle_sweep_margin([A0, A1])
    assert swept_s == margin_s or abs(swept_s - margin_s) < 1e-8 * margin_s
    windows = analyse_delay(A0, A1, horizon_s=3.0).stable_intervals_s
    for delay_s in (0.31, 1.07, 2.9):
        if min((abs(delay_s - end) for window in windows for end in window), default=inf) > 1e-6:
            stable = any(start < delay_s < end for start, end in windows)
            assert (rightmost_root([(A0, 0.0), (A1, delay_s)]).real < 0.0) == stable
    return margin_s


def check_transformations(A0: Matrix, A1: Matrix, margin_s: float, seed: int) -> None:
    """The margin scales with time, and does not depend on the order of states or on coordinates."""
    rng = np.random.default_rng(seed)
    factor, order = float(10.0 ** rng.uniform(-4.0, 4.0)), rng.permutation(len(A0))
    # eigenvalues of small random matrices lose a few digits, a similarity some more
    assert delay_margin(factor * A0, factor * A1) == pytest.approx(margin_s / factor, rel=1e-8)
    assert delay_margin(A0[np.ix_(order, order)], A1[np.ix_(order, order)]) == pytest.approx(margin_s, rel=1e-8)
    T = rng.normal(size=A0.shape) + 3.0 * np.eye(len(A0))
    turned = [np.linalg.solve(T, matrix @ T) for matrix in (A0, A1)]
    assert delay_margin(*turned) == pytest.approx(margin_s, rel=1e-6)


def check_lower_bounds(A0: Matrix, A1: Matrix, margin_s: float, seed: int) -> None:
    """Bounds for varying delays never exceed the exact margin; the more a delay may do, the lower they are."""
    # bisections end at the exact margin at most: no tolerance is needed
    assert varying_delay_bound(A0, A1, rate=inf) <= margin_s
    if len(A0) > 3 or seed % 4 != 0:
        return
    # each is the end of a bisection to a part in 10^4
    rates = [varying_delay_bound(A0, A1, rate=rate) for rate in (inf, 0.6, 0.0)]
    assert rates[0] <= rates[1] * 1.0003
    assert rates[1] <= rates[2] * 1.0003
    assert rates[2] <= margin_s
    if isfinite(margin_s):
        mean_s = 0.6 * margin_s
        assert mean_s + spread_bound(A0, A1, mean_s=mean_s) <= margin_s


@pytest.mark.parametrize("group", range(GROUPS))
def test_three_methods_agree_on_random_loops(group: int) -> None:
    verdicts: list[float] = []
    for seed in range(group, SYSTEMS, GROUPS):
        A0, A1 = random_loop(seed)
        margin_s = check_opinions_agree(A0, A1)
        check_transformations(A0, A1, margin_s, seed)
        if seed < SYSTEMS // (15 if os.environ.get("SLOW_TESTS") == "1" else 60):  # each takes seconds
            check_lower_bounds(A0, A1, margin_s, seed)
        verdicts.append(margin_s)
    assert verdicts


def test_sample_of_random_loops_has_every_verdict() -> None:
    margins = [delay_margin(*random_loop(seed)) for seed in range(60)]
    assert sum(margin == 0.0 for margin in margins) >= 3
    assert sum(margin == inf for margin in margins) >= 3
    assert sum(0.0 < margin < inf for margin in margins) >= 20
