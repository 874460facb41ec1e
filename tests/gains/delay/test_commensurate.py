"""Delays that are multiples of one unknown: published loops, closed forms, and the rightmost root as the judge."""

import json
from math import inf, pi, sqrt
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gains.core.errors import BadModelError
from gains.core.structure import distinct_blocks
from gains.delay._commensurate import _roots_and_slopes
from gains.delay._crossings import DelayedTerm
from gains.delay._mixed import analyse_mixed_block
from gains.delay._windows import DelayAnalysis, combined_analysis
from gains.delay.constant import analyse_delay
from gains.delay.rightmost import rightmost_root
from gains.delay.sweep import circle_sweep_margin
from tests.support.paths import DATA

Matrix = NDArray[np.float64]
BENCHMARKS: list[dict[str, Any]] = json.loads((DATA / "delay_benchmarks.json").read_text())


def benchmark(name: str) -> dict[str, Any]:
    [entry] = [entry for entry in BENCHMARKS if entry["name"] == name]
    return entry


def random_terms(seed: int) -> list[Matrix]:
    """2 to 4 matrices of 1 to 5 states, the late ones of rank one for every third seed."""
    rng = np.random.default_rng(seed)
    n, late = int(rng.integers(1, 6)), int(rng.integers(1, 4))
    if seed % 3 == 0:
        entry = rng.normal(size=(n, 1))
        terms = [rng.normal(size=(n, n)), *(entry @ rng.normal(size=(1, n)) for _ in range(late))]
    else:
        terms = [rng.normal(size=(n, n)) for _ in range(late + 1)]
    rightmost = float(np.linalg.eigvals(sum(terms[1:], terms[0])).real.max())
    terms[0] = terms[0] - (rightmost + rng.uniform(-0.2, 0.6)) * np.eye(n)
    return terms


def test_published_window_of_two_delays() -> None:
    entry = benchmark("two_commensurate_delays_2x2")
    [window] = analyse_delay(*entry["A"]).stable_intervals_s
    # the benchmark's delays are tau / 2 and tau; its figures have 14 digits
    assert np.array(window) * 2.0 == pytest.approx(np.array(entry["computed"]), rel=1e-12)


def test_published_spring_network_with_three_delays() -> None:
    entry = benchmark("spring_network_n3_h2h3h")
    analysis = analyse_delay(*entry["A"])
    [(start_s, end_s)] = analysis.stable_intervals_s
    assert end_s == pytest.approx(entry["computed"][0], rel=1e-12)
    for delay_s in entry["classification"]["stable"]:
        assert start_s < delay_s < end_s
    for delay_s in entry["classification"]["unstable"]:
        assert not start_s < delay_s < end_s
    # unstable without delay: the loop is stable only within this window of delays
    assert analysis.unstable_roots_at_zero_delay == 2


def test_one_late_matrix_is_the_single_delay_test() -> None:
    A0, A1 = np.array([[0.0, 1.0], [-2.0, 0.1]]), np.array([[0.0, 0.0], [1.0, 0.0]])
    single, multiple = analyse_delay(A0, A1), analyse_delay(A0, np.zeros((2, 2)), A1)
    for window, expected in zip(multiple.stable_intervals_s, single.stable_intervals_s, strict=True):
        assert np.array(window) * 2.0 == pytest.approx(np.array(expected), rel=1e-13)


def test_scalar_with_two_delays_is_the_closed_form() -> None:
    # s = -a (z + z^2), z = e^{-s tau}: on the axis cos + cos 2 = 0, theta = pi/3, omega = a (sin + sin 2) = a sqrt(3)
    for a in (0.5, 1.0, 40.0):
        margin_s = analyse_delay([[0.0]], [[-a]], [[-a]]).delay_margin_s
        assert margin_s == pytest.approx(pi / (3.0 * sqrt(3.0) * a), rel=1e-13)


@pytest.mark.parametrize("seed", range(60))
def test_windows_are_those_of_the_rightmost_root(seed: int) -> None:
    terms = random_terms(seed)
    windows = analyse_delay(*terms, horizon_s=4.0).stable_intervals_s
    for delay_s in np.random.default_rng(seed).uniform(0.02, 4.0, 4).tolist():
        # next to an end the sign of the rightmost root is a matter of rounding
        if min((abs(delay_s - end) for window in windows for end in window), default=inf) > 1e-6:
            stable = any(start < delay_s < end for start, end in windows)
            root = rightmost_root([(matrix, k * delay_s) for k, matrix in enumerate(terms)])
            assert (root.real < 0.0) == stable


@pytest.mark.parametrize("seed", range(40))
def test_sweep_along_the_circle_agrees(seed: int) -> None:
    terms = random_terms(seed)
    # crossings are well conditioned here; a missed one is off by far more
    assert circle_sweep_margin(terms) == pytest.approx(analyse_delay(*terms).delay_margin_s, rel=1e-9)


@pytest.mark.parametrize("seed", range(10))
def test_margin_scales_with_time_and_does_not_depend_on_coordinates(seed: int) -> None:
    terms = random_terms(seed)
    margin_s = analyse_delay(*terms).delay_margin_s
    assert analyse_delay(*[310.0 * matrix for matrix in terms]).delay_margin_s == pytest.approx(margin_s / 310.0)
    T = np.random.default_rng(seed).normal(size=terms[0].shape) + 3.0 * np.eye(len(terms[0]))
    turned = [np.linalg.solve(T, matrix @ T) for matrix in terms]
    # a similarity of condition number up to some hundreds costs that many roundings
    assert analyse_delay(*turned).delay_margin_s == pytest.approx(margin_s, rel=1e-8)


def test_margin_of_a_large_block_is_where_its_root_crosses() -> None:
    rng = np.random.default_rng(3)
    size = 21
    terms = [rng.normal(size=(size, size)) for _ in range(3)]
    terms[0] = terms[0] - (float(np.linalg.eigvals(sum(terms[1:], terms[0])).real.max()) + 0.5) * np.eye(size)
    margin_s = analyse_delay(*terms, horizon_s=1e-300).delay_margin_s
    # the rightmost root is known to 1e-12 and moves by some 1 / s per second
    for share, stable in ((1.0 - 1e-9, True), (1.0 + 1e-9, False)):
        root = rightmost_root([(matrix, k * share * margin_s) for k, matrix in enumerate(terms)])
        assert (root.real < 0.0) == stable


def test_followers_one_behind_the_other_are_one_block() -> None:
    terms = [np.diag([0.0, 0.0]), np.array([[-1.0, 0.0], [1.0, -1.0]]), np.array([[-1.0, 0.0], [0.5, -1.0]])]
    assert analyse_delay(*terms).delay_margin_s == pytest.approx(pi / (3.0 * sqrt(3.0)), rel=1e-13)


def test_root_at_zero_for_every_delay_is_never_stable() -> None:
    analysis = analyse_delay([[-2.0]], [[1.0]], [[1.0]])
    assert (analysis.stable_intervals_s, analysis.delay_margin_s) == ((), 0.0)


@pytest.mark.parametrize(
    ("matrices", "message"),
    [
        ([[[1.0]]] * 4000, "a product of at most 3000"),
        ([[[1.0]], np.eye(2)], "1x1 is wanted"),
    ],
)
def test_wrong_terms_are_named(matrices: list[Matrix], message: str) -> None:
    with pytest.raises(BadModelError, match=message):
        analyse_delay(*matrices)


def analyse_mixed(terms: list[DelayedTerm], horizon_s: float | None = None) -> DelayAnalysis:
    blocks = distinct_blocks(*(term.matrix for term in terms))
    return combined_analysis([analyse_mixed_block(block, terms, False) for block in blocks], horizon_s)


def test_a_known_delay_beside_the_unknown_shortens_the_margin() -> None:
    # x' = -x(t - 0.1 - tau): pi / 2 less what is known
    analysis = analyse_mixed([DelayedTerm(np.array([[-1.0]]), 0.1, 1)])
    assert analysis.delay_margin_s == pytest.approx(pi / 2.0 - 0.1, rel=1e-12)


@pytest.mark.parametrize("seed", range(25))
def test_windows_beside_known_delays_are_those_of_the_rightmost_root(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, step = int(rng.integers(1, 4)), int(rng.integers(1, 3))
    matrices = [rng.normal(size=(n, n)) for _ in range(4)]
    rightmost = float(np.linalg.eigvals(sum(matrices[1:], matrices[0])).real.max())
    matrices[0] = matrices[0] - (rightmost + rng.uniform(-0.2, 1.6)) * np.eye(n)
    known_s, steps = (0.0, float(rng.uniform(0.0, 2.0)), 0.0, float(rng.uniform(0.0, 1.0))), (0, 0, 1, step)
    analysis = analyse_mixed([DelayedTerm(*term) for term in zip(matrices, known_s, steps, strict=True)], horizon_s=4.0)
    for delay_s in (0.0, *rng.uniform(0.01, 4.0, 3).tolist()):
        windows = analysis.stable_intervals_s
        if delay_s > 0.0 and min((abs(delay_s - end) for window in windows for end in window), default=inf) < 1e-6:
            continue
        delays = [known + k * delay_s for known, k in zip(known_s, steps, strict=True)]
        stable = any(start <= delay_s < end for start, end in windows)
        assert (rightmost_root(list(zip(matrices, delays, strict=True))).real < 0.0) == stable


def test_unstable_roots_are_counted_with_the_known_delay() -> None:
    # x' = -x(t - d): a pair crosses at d = pi/2 and the next at 5 pi/2
    for known_s, roots in ((1.0, 0), (3.0, 2), (9.0, 4)):
        terms = [DelayedTerm(np.array([[-1.0]]), known_s, 0), DelayedTerm(np.array([[0.001]]), 0.0, 1)]
        assert analyse_mixed(terms, horizon_s=1e-3).unstable_roots_at_zero_delay == roots


def test_a_known_delay_that_is_too_long_is_named() -> None:
    with pytest.raises(BadModelError, match="longest known delay"):
        analyse_mixed([DelayedTerm(np.array([[-1e6]]), 1e3, 1)])


@pytest.mark.parametrize("horizon_s", [0.0, -1.0, float("nan")])
def test_horizon_must_be_positive(horizon_s: float) -> None:
    with pytest.raises(BadModelError, match="horizon_s is"):
        analyse_delay([[0.0]], [[-1.0]], horizon_s=horizon_s)


def unstable_roots(terms: list[tuple[Matrix, float]]) -> int:
    """By the argument principle for det(sI - sum A e^{-s tau}) along the axis, sampled until it turns little."""
    n, bound = len(terms[0][0]), sum(float(np.linalg.norm(matrix)) for matrix, _ in terms)

    def value(omega: Matrix) -> np.ndarray[tuple[int], np.dtype[np.complex128]]:
        matrix = 1j * omega[:, None, None] * np.eye(n)
        for A, delay_s in terms:
            matrix = matrix - np.exp(-1j * omega * delay_s)[:, None, None] * A
        return np.linalg.slogdet(matrix)[0] * np.exp(-1j * n * np.angle(1j * omega + bound))

    longest_s = max(delay_s for _, delay_s in terms)
    near = np.linspace(0.0, bound, int(200 + 20 * bound * longest_s))
    omega = np.unique(np.concatenate([near, bound * np.logspace(-9.0, 6.0, 900)]))
    values = value(omega)
    for _ in range(50):
        coarse = np.flatnonzero(np.abs(np.angle(values[1:] / values[:-1])) > 0.3)
        if coarse.size == 0:
            break
        between = (omega[coarse] + omega[coarse + 1]) / 2.0
        omega, values = np.insert(omega, coarse + 1, between), np.insert(values, coarse + 1, value(between))
    return round(float(np.angle(values[-1]) - np.angle(values[1:] / values[:-1]).sum()) / np.pi)


@pytest.mark.parametrize(
    ("states", "multiples", "acts_at_once"),
    [
        # the pencil of many multiples is ill-conditioned: margins of scalar loops were once too long, or contradicted
        (1, (4, 38), True),
        (1, (23, 45), True),
        # odd multiples, nothing at once: at a quarter turn all roots are on the axis, in opposite directions
        (3, (5, 11), False),
        (4, (1, 3), False),
        # too large for the companion matrix of each frequency
        (6, (3, 8), True),
        (12, (3, 5), True),
    ],
)
@pytest.mark.parametrize("seed", range(3))
def test_roots_of_many_multiples_are_counted(
    states: int, multiples: tuple[int, int], acts_at_once: bool, seed: int
) -> None:
    rng = np.random.default_rng([seed, states, *multiples])
    late = [rng.normal(size=(states, states)) / np.sqrt(states) for _ in multiples]
    # shifted by -1, about as many loops are stable as unstable
    now = (rng.normal(size=(states, states)) / np.sqrt(states) - np.eye(states)) * acts_at_once
    terms = [now, *(np.zeros_like(now) for _ in range(max(multiples)))]
    for multiple, matrix in zip(multiples, late, strict=True):
        terms[multiple] = matrix
    found = analyse_delay(*terms, horizon_s=1e-3)
    for tau_s in (0.11, 0.37, 0.83, 1.31):
        entered = sum(
            crossing.direction
            * crossing.roots
            * (1 + int((tau_s - crossing.delay_s) * crossing.omega_rad_s / 2 / np.pi))
            for crossing in found.crossings
            if crossing.delay_s < tau_s
        )
        delayed = [(matrix, multiple * tau_s) for matrix, multiple in zip(late, multiples, strict=True)]
        assert found.unstable_roots_at_zero_delay + entered == unstable_roots([(now, 0.0), *delayed])


def test_a_pair_on_the_axis_beside_zero_leaves_no_margin() -> None:
    # det M(s) = s (s^2 + c e^{-s tau}): no root is left to be taken for noise of the one at zero
    now = np.array([[0.0, 0.0, -0.10632528972641878], [0.0, 0.0, 0.0], [0.0, 0.6401019196602797, 0.0]])
    late = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.7418610417423701], [-0.318665534371544, 0.0, 0.0]])
    for between in (0, 3):
        analysis = analyse_delay(now, *[np.zeros((3, 3))] * between, late, leave_out_zero=True)
        assert (analysis.delay_margin_s, analysis.roots_fixed_at_zero) == (0.0, 1)
        found = {round(crossing.omega_rad_s, 6) for crossing in analysis.crossings}
        assert found == {
            round(sqrt(0.7418610417423701 * 0.6401019196602797 - 0.318665534371544 * 0.10632528972641878), 6)
        }


def test_a_defective_angle_leaves_slopes_at_other_angles_unchanged() -> None:
    # at the angle 0 three states form one Jordan block, whose eigenvectors are exactly parallel; elsewhere the terms
    # D e^{-j theta} - D e^{-2 j theta} separate its eigenvalues
    chain, parts = np.zeros((4, 4)), np.diag([1.0, 2.0, 3.0, -1.0])
    chain[0, 1] = chain[1, 2] = 1.0
    theta = np.array([1.0, 2.0])
    shift = np.exp(-1j * theta) * -1j - np.exp(-2j * theta) * -2j
    _, slopes = _roots_and_slopes([chain, parts, -parts], np.append(0.0, theta))
    expected = np.multiply.outer(shift.real, np.diag(parts))
    assert np.sort(slopes[1:], axis=1) == pytest.approx(np.sort(expected, axis=1), rel=1e-9)
