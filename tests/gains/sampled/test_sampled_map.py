"""The one-period map against a simulation that does not use it, and against SciPy."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from gains.core.arrays import matrix_exponentials
from gains.core.errors import BadModelError
from gains.sampled.constant import growth_rate, period_map, spectral_radius

Matrix = NDArray[np.float64]

FOLLOWER = (np.array([[0.0, -1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, -1.0]]))
TWO_INPUTS = (
    np.array([[-0.3, 1.0, 0.2], [-2.0, 0.1, 0.0], [0.5, 0.0, -1.0]]),
    np.array([[0.0, 1.0], [1.0, 0.0], [0.3, -0.4]]),
    np.array([[0.4, -0.8, 0.1], [-0.5, 0.2, 0.3]]),
)


def integrated(A: Matrix, push: Matrix, x: Matrix, begin_s: float, until_s: float) -> Matrix:
    def derivative(_t: float, y: Matrix) -> Matrix:
        return A @ y + push

    return solve_ivp(derivative, (begin_s, until_s), x, rtol=1e-10, atol=1e-12).y[:, -1]


def flown(
    loop: tuple[Matrix, Matrix, Matrix], x0: Matrix, *, period_s: float, delay_s: float, periods: int
) -> list[Matrix]:
    """States at the sampling instants: the plant integrated from event to event, commands in a list of (instant, u)."""
    A, B, K = loop
    samples, commands = [x0], [(-np.inf, np.zeros(B.shape[1]))]
    for k in range(periods):
        start_s, end_s = k * period_s, (k + 1) * period_s
        commands.append((start_s + delay_s, K @ samples[-1]))
        inner = [instant for instant, _ in commands if start_s + 1e-9 < instant < end_s - 1e-9]
        x = samples[-1]
        for begin_s, until_s in zip([start_s, *inner], [*inner, end_s], strict=True):
            u = [command for instant, command in commands if instant <= begin_s + 1e-9][-1]
            x = integrated(A, B @ u, x, begin_s, until_s)
        samples.append(x)
    return samples


@pytest.mark.parametrize("loop", [FOLLOWER, TWO_INPUTS], ids=["follower", "two inputs"])
@pytest.mark.parametrize("delay_periods", [0.0, 0.3, 1.0, 2.0, 2.75])
def test_map_predicts_what_is_flown(loop: tuple[Matrix, Matrix, Matrix], delay_periods: float) -> None:
    period_s = 0.2
    Phi = period_map(*loop, period_s=period_s, delay_s=delay_periods * period_s)
    x0 = np.array([1.0, -0.5, 0.3])[: len(loop[0])]
    state = np.concatenate([x0, np.zeros(len(Phi) - len(x0))])
    for sample in flown(loop, x0, period_s=period_s, delay_s=delay_periods * period_s, periods=12):
        # the integrator's tolerance over a dozen periods
        assert state[: len(x0)] == pytest.approx(sample, abs=1e-8)
        state = Phi @ state


@pytest.mark.parametrize(("delay_periods", "kept"), [(0.0, 0), (0.5, 1), (1.0, 1), (3.0, 3), (3.2, 4)])
def test_map_keeps_no_more_commands_than_the_delay_needs(delay_periods: float, kept: int) -> None:
    A, B, K = TWO_INPUTS
    assert len(period_map(A, B, K, period_s=0.02, delay_s=delay_periods * 0.02)) == 3 + 2 * kept


def test_whole_periods_are_recognised_despite_rounding() -> None:
    # 3 * 0.02 / 0.02 is 3.0000000000000004 or 2.9999999999999996 depending on the order of operations
    assert len(period_map(*FOLLOWER, period_s=0.02, delay_s=0.02 + 0.02 + 0.02)) == 2 + 3


def test_a_chains_spectral_radius_is_that_of_its_worst_member() -> None:
    # 12 identical followers: the eigenvalues of the whole map are wrong in the second digit
    n = 12
    A = np.kron(np.eye(n), FOLLOWER[0]) + np.kron(np.eye(n, k=-1), [[0.0, 1.0], [0.0, 0.0]])
    B, K = np.kron(np.eye(n), FOLLOWER[1]), np.kron(np.eye(n), FOLLOWER[2])
    alone = spectral_radius(*FOLLOWER, period_s=0.1, delay_s=0.23)
    assert spectral_radius(A, B, K, period_s=0.1, delay_s=0.23) == pytest.approx(alone, rel=1e-14)


def test_growth_rate_is_that_of_the_radius() -> None:
    # a leader x' = u, u = -x, held for 0.5 s: x shrinks by half in a period
    assert growth_rate([[0.0]], [[1.0]], [[-1.0]], period_s=0.5, delay_s=0.0) == pytest.approx(2.0 * np.log(0.5))
    # deadbeat: x is zero after one period, up to a rounding error of 1e-16
    assert growth_rate([[0.0]], [[1.0]], [[-2.0]], period_s=0.5, delay_s=0.0) < 2.0 * np.log(1e-15)


@pytest.mark.parametrize("size", [0.0, 1e-3, 1.0, 30.0])
def test_exponentials_are_those_of_scipy(size: float) -> None:
    generator, times = size * np.random.default_rng(3).normal(size=(4, 4)), np.linspace(0.0, 2.0, 20)
    # relative to the norm; eight squarings at the largest lose three digits
    for ours, theirs in zip(
        matrix_exponentials(generator, times), expm(times[:, np.newaxis, np.newaxis] * generator), strict=True
    ):
        assert np.abs(ours - theirs).max() <= 1e-11 * np.abs(theirs).max()


def test_what_an_exponential_adds_to_one_keeps_its_digits() -> None:
    times = np.array([1e-14, 1e-6, 0.3, 40.0])
    [[ours]] = matrix_exponentials(np.array([[-0.7]]), times, less_one=True).T
    assert ours == pytest.approx(np.expm1(-0.7 * times), rel=1e-13)


@pytest.mark.parametrize(
    ("A", "B", "K", "message"),
    [
        ([[0.0, 1.0]], [[1.0]], [[1.0]], r"A has shape \(1, 2\)"),
        ([[0.0]], [[1.0], [1.0]], [[1.0]], r"B has shape \(2, 1\); 1 rows"),
        ([[0.0]], [[1.0]], [[1.0, 2.0]], r"K has shape \(1, 2\); \(1, 1\)"),
        ([[0.0]], [[1.0]], [[np.inf]], "K has entries that are not finite"),
    ],
)
def test_wrong_loops_are_named(A: Matrix, B: Matrix, K: Matrix, message: str) -> None:
    with pytest.raises(BadModelError, match=message):
        period_map(A, B, K, period_s=0.02, delay_s=0.0)


@pytest.mark.parametrize(
    ("period_s", "delay_s", "message"), [(0.0, 0.0, "period_s is 0"), (0.1, -0.1, "delay_s is"), (np.nan, 0.0, "nan")]
)
def test_wrong_times_are_named(period_s: float, delay_s: float, message: str) -> None:
    with pytest.raises(BadModelError, match=message):
        spectral_radius(*FOLLOWER, period_s=period_s, delay_s=delay_s)
