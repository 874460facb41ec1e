"""Random loops: three independent methods agree, the margin transforms as it must, and no lower bound is above it.

`SLOW_TESTS=1 RANDOM_LOOPS=1000 python3 make.py test tests/gains/margin/test_delay_opinions.py` takes a thousand; the
default is 200.
"""

import os
from math import inf, isfinite

import numpy as np
import pytest
from numpy.typing import NDArray

from gains.core.errors import BadModelError
from gains.delay.constant import analyse_delay, delay_margin
from gains.delay.rightmost import rightmost_root
from gains.delay.sweep import frequency_sweep_margin
from gains.margin.opinions import checked_delay_margin
from gains.varying.bounds import varying_delay_bound

Matrix = NDArray[np.float64]
RANDOM_LOOPS = int(os.environ.get("RANDOM_LOOPS", "200"))
PARTS = range(RANDOM_LOOPS // 50)


def random_loop(seed: int) -> tuple[Matrix, Matrix]:
    """A loop of 1 to 5 states with delayed feedback of random rank, stable without delay two times in three."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    rank = int(rng.integers(1, n + 1))
    A0 = rng.normal(size=(n, n))
    A1 = rng.normal(size=(n, rank)) @ rng.normal(size=(rank, n))
    rightmost = float(np.linalg.eigvals(A0 + A1).real.max())
    return A0 - (rightmost + rng.uniform(-0.3, 0.6)) * np.eye(n), A1


@pytest.mark.parametrize("part", PARTS)
def test_three_opinions_agree_on_random_loops(part: int) -> None:
    margins = [checked_delay_margin(*random_loop(seed)) for seed in range(50 * part, 50 * part + 50)]
    # the sample means something only if every verdict occurs
    assert any(margin == 0.0 for margin in margins)
    assert any(margin == inf for margin in margins)
    assert sum(0.0 < margin < inf for margin in margins) > 8


@pytest.mark.parametrize("seed", range(25))
def test_windows_of_random_loops_are_those_of_the_rightmost_root(seed: int) -> None:
    A0, A1 = random_loop(1000 + seed)
    analysis = analyse_delay(A0, A1, horizon_s=6.0)
    for delay_s in np.linspace(0.05, 6.0, 7):
        nearest = min((abs(delay_s - end) for window in analysis.stable_intervals_s for end in window), default=inf)
        # next to a boundary the sign of the rightmost root is a matter of rounding
        if nearest > 1e-6:
            stable = any(start < delay_s < end for start, end in analysis.stable_intervals_s)
            assert (rightmost_root([(A0, 0.0), (A1, float(delay_s))]).real < 0.0) == stable


@pytest.mark.parametrize("part", PARTS)
def test_the_margin_alone_is_that_of_all_windows(part: int) -> None:
    for seed in range(50 * part, 50 * part + 50):
        A0, A1 = random_loop(seed)
        assert delay_margin(A0, A1) == analyse_delay(A0, A1).delay_margin_s


@pytest.mark.parametrize("part", PARTS)
def test_margin_scales_with_time(part: int) -> None:
    for seed in range(50 * part, 50 * part + 50):
        A0, A1 = random_loop(seed)
        # a factor that is no power of two changes every rounding
        assert delay_margin(7.3e3 * A0, 7.3e3 * A1) == pytest.approx(delay_margin(A0, A1) / 7.3e3, rel=1e-9), seed


@pytest.mark.parametrize("part", PARTS)
def test_margin_does_not_depend_on_coordinates(part: int) -> None:
    for seed in range(50 * part, 50 * part + 50):
        A0, A1 = random_loop(seed)
        n = len(A0)
        rng = np.random.default_rng(seed)
        order = rng.permutation(n)
        T = rng.normal(size=(n, n)) + 3.0 * np.eye(n)
        margin_s = delay_margin(A0, A1)
        permuted = delay_margin(A0[np.ix_(order, order)], A1[np.ix_(order, order)])
        assert permuted == pytest.approx(margin_s, rel=1e-9), seed
        # a similarity costs as many digits as its condition number has
        similar = [np.linalg.solve(T, matrix @ T) for matrix in (A0, A1)]
        assert delay_margin(*similar) == pytest.approx(margin_s, rel=1e-11 * np.linalg.cond(T) ** 2 + 1e-8), seed


@pytest.mark.slow(first=2)
@pytest.mark.timeout(900)  # some seconds each, a minute for the slowest of a thousand
@pytest.mark.parametrize("seed", range(RANDOM_LOOPS if RANDOM_LOOPS >= 1000 else 5))
def test_no_lower_bound_is_above_the_margin(seed: int) -> None:
    A0, A1 = random_loop(5000 + seed)
    margin_s = delay_margin(A0, A1)
    slow = varying_delay_bound(A0, A1, rate=0.1)
    any_s = varying_delay_bound(A0, A1, rate=inf)
    rounding = 1.0 + 1e-9
    assert any_s <= slow * (1.0 + 1e-3)  # both are ends of bisections
    assert any_s <= margin_s * rounding
    assert slow <= margin_s * rounding


@pytest.mark.parametrize("size", [12, 20])
def test_large_blocks_are_exact(size: int) -> None:
    rng = np.random.default_rng(size)
    A0 = rng.normal(size=(size, size))
    A1 = rng.normal(size=(size, size)) - 3.0 * np.sqrt(size) * np.eye(size)
    margin_s = delay_margin(A0, A1)
    assert isfinite(margin_s)
    assert margin_s > 0.0
    assert frequency_sweep_margin(A0, A1) == pytest.approx(margin_s, rel=1e-9)


def test_blocks_too_large_for_the_algebraic_test_are_swept() -> None:
    # a pinned ring of 31 vehicles, s + lambda e^{-s tau} for each eigenvalue: pi / (2 lambda_max)
    size = 30
    laplacian = 2.0 * np.eye(size) - np.eye(size, k=1) - np.eye(size, k=-1)
    expected = np.pi / 2.0 / float(np.linalg.eigvalsh(laplacian).max())
    assert delay_margin(np.zeros((size, size)), -laplacian) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ([], "terms is empty"),
        ([([[1.0]], -0.1)], "delays"),
        ([([[1.0]], 0.0), (np.eye(2), 1.0)], "1x1 is wanted"),
        ([([[0.0]], 0.0), ([[-1e6]], 1e3)], "points"),
    ],
)
def test_rightmost_root_names_what_is_wrong(terms: list[tuple[Matrix, float]], message: str) -> None:
    with pytest.raises(BadModelError, match=message):
        rightmost_root(terms)


def test_rightmost_root_without_delay_is_an_eigenvalue() -> None:
    assert rightmost_root([([[0.0, 1.0], [-2.0, -2.0]], 0.0)]) == pytest.approx(-1.0 + 1.0j, rel=1e-15)


def test_rightmost_root_solves_the_characteristic_equation() -> None:
    # s = -e^{-s}: s = W(-1) = -0.31813150520476413 + 1.3372357014306895 j, Lambert's function, published to 16 digits
    assert rightmost_root([([[0.0]], 0.0), ([[-1.0]], 1.0)]) == pytest.approx(
        -0.31813150520476413 + 1.3372357014306895j, rel=1e-14
    )
