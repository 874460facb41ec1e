"""Mismatch windows against the spectrum of the lifted map at hundreds of delays.

By default 24 random loops; MISMATCH_LOOPS=1200 python3 make.py test tests/gains/sampled/test_mismatch_windows.py takes
1200.
"""

import os

import numpy as np
import pytest
from scipy.linalg import block_diag, solve_continuous_are

from gains import Timing, mismatch_window
from gains.core.arrays import FloatArray
from gains.sampled._loop import HeldPlant
from gains.sampled._predicted_difference import PredictedDifference
from gains.sampled.multirate import Predictor, lifted_radius

Loop = tuple[FloatArray, FloatArray, FloatArray]

LOOPS = int(os.environ.get("MISMATCH_LOOPS", "24"))


def first_order(a: float, b: float, k: float) -> Loop:
    return np.array([[a]]), np.array([[b]]), np.array([[k]])


def on_each_axis(A: list[list[float]], B: list[list[float]], gain: FloatArray) -> Loop:
    """The plant in as many axes as the gain has rows."""
    axes = np.eye(len(gain))
    return np.kron(axes, A).astype(np.float64), np.kron(axes, B).astype(np.float64), gain


def lagging(rate_1_s: float, gain: FloatArray) -> Loop:
    """p'' = a, a' = rate_1_s (u - a)."""
    A = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -rate_1_s]]
    return on_each_axis(A, [[0.0], [0.0], [rate_1_s]], gain)


def double_integrators(gain: FloatArray) -> Loop:
    return on_each_axis([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], gain)


def random_plant(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    inputs, kind = int(rng.integers(1, 3)), rng.integers(4)
    if kind == 0:
        return double_integrators(np.zeros((inputs, 2 * inputs)))[:2]
    if kind == 1:
        return lagging(rng.uniform(1.6, 10.0), np.zeros((inputs, 3 * inputs)))[:2]
    if kind == 2:
        n = int(rng.integers(1, 4))
        return rng.normal(size=(n, n)) * rng.uniform(0.1, 1.0), rng.normal(size=(n, inputs))
    return np.zeros((inputs, inputs)), np.eye(inputs)


def random_loop(rng: np.random.Generator) -> Loop:
    """A plant with the LQR gain of random weights, made weaker or stronger, and at times disturbed."""
    A, B = random_plant(rng)
    root = rng.normal(size=A.shape)
    weight = 10.0 ** rng.uniform(-1.0, 1.0) * np.eye(B.shape[1])
    value = solve_continuous_are(A, B, root @ root.T + 0.1 * np.eye(len(A)), weight)
    gain = -B.T @ value * rng.uniform(0.3, 1.5)
    disturbed = rng.normal(size=gain.shape) * np.abs(gain).mean() * 0.3 * (rng.random() < 0.3)
    return A, B, gain + disturbed


def assert_window(loop: Loop, rates: Timing, assumed_s: float, *, looks: int) -> None:
    """Stable at every delay looked at between the ends, and unstable just beyond them."""
    plant = HeldPlant(*loop, rates.common_s)

    def radius(delay_s: float) -> float:
        return lifted_radius(plant, rates, delay_s=delay_s, predictor=Predictor(plant, assumed_s))

    least_s, most_s = mismatch_window(*loop, rates, assumed_s=assumed_s)
    if least_s == most_s:
        assert radius(assumed_s) >= 1.0 - 1e-9  # rounding of a spectrum
        return

    beside_s = 1e-5 * max(assumed_s, 0.1)
    farthest_s = most_s if most_s < np.inf else 3.0 * assumed_s + 10.0 * rates.common_s
    within_s = np.linspace(least_s, farthest_s, looks + 2)[1:-1].tolist()
    assert [delay_s for delay_s in within_s if radius(delay_s) > 1.0] == []
    for end_s, beyond_s in ((least_s, least_s - beside_s), (most_s, most_s + beside_s)):
        if beyond_s >= 0.0 and end_s < np.inf:
            assert radius(beyond_s) > 1.0


@pytest.mark.parametrize("seed", range(LOOPS))
def test_every_delay_within_a_window_is_stable(seed: int) -> None:
    rng = np.random.default_rng(seed)
    loop = random_loop(rng)
    control, telemetry = (float(rng.choice(rates)) for rates in ((4, 5, 8, 10, 20), (2, 2.5, 3, 7.3, 15)))
    rates = Timing(1.0 / control, 1.0 / (control if rng.random() < 0.4 else telemetry))
    # so that the lifted map has about a hundred states at most
    assumed_s = rng.uniform(0.05, min(2.0, 40.0 * rates.common_s / rates.ticks))
    if np.linalg.eigvals(loop[0] + loop[1] @ loop[2]).real.max() < 0.0:
        assert_window(loop, rates, assumed_s, looks=90)


@pytest.mark.parametrize("seed", range(10))
def test_blocks_far_from_their_ends_do_not_change_the_window(seed: int) -> None:
    rng = np.random.default_rng(seed)
    loops = random_loop(rng), first_order(0.0, 1.0, -rng.uniform(0.02, 1.0))
    control_s = float(rng.choice([0.02, 0.05, 0.2]))
    rates, assumed_s = Timing(control_s, control_s * float(rng.choice([1.0, 1.3, 2.5, 5.0]))), rng.uniform(0.0, 3.0)
    A, B, K = (np.array(block_diag(*parts), np.float64) for parts in zip(*loops, strict=True))
    ends_s = [mismatch_window(*loop, rates, assumed_s=assumed_s) for loop in loops]
    narrowest_s = max(least_s for least_s, _ in ends_s), min(most_s for _, most_s in ends_s)
    assert mismatch_window(A, B, K, rates, assumed_s=assumed_s) == pytest.approx(narrowest_s, rel=1e-9)


@pytest.mark.parametrize("seed", range(10))
def test_maps_of_the_difference_have_the_lifted_maps_radius(seed: int) -> None:
    rng = np.random.default_rng(seed)
    control_s = float(rng.choice([0.05, 0.2]))
    rates, assumed_s = Timing(control_s, control_s * float(rng.choice([1.0, 1.3, 2.5, 5.0]))), rng.uniform(0.0, 1.5)
    plant, delays_s = HeldPlant(*random_loop(rng), rates.common_s), rng.uniform(0.0, 3.0, 5)
    maps = PredictedDifference(plant, rates, assumed_s).maps(delays_s)
    for found, delay_s in zip(np.abs(np.linalg.eigvals(maps)).max(axis=1), delays_s.tolist(), strict=True):
        lifted = lifted_radius(plant, rates, delay_s=delay_s, predictor=Predictor(plant, assumed_s))
        assert found == pytest.approx(lifted, abs=1e-9)


@pytest.mark.parametrize(
    ("loop", "hertz", "assumed_s"),
    [
        # unstable for a few milliseconds around a delay of whole periods
        (first_order(0.291, 0.51, -11.824), (5.0, 5.0), 0.856),
        (
            double_integrators(np.array([[-3.358, -5.536, -0.616, -0.073], [0.279, -0.073, -8.087, -7.857]])),
            (5.0, 5.0),
            1.383,
        ),
        (first_order(0.653, -1.599, 1.402), (8.0, 5.0), 0.602),
        (lagging(2.914, np.array([[-3.044, -6.188, -2.292]])), (4.0, 2.0), 0.432),
        # an eigenvalue comes near the unit circle long before another crosses it
        (lagging(2.973, np.array([[-1.532, -5.63, -4.056]])), (20.0, 20.0), 0.378),
    ],
)
def test_a_short_stretch_of_instability_ends_the_window(
    loop: Loop, hertz: tuple[float, float], assumed_s: float
) -> None:
    assert_window(loop, Timing(*(1.0 / rate for rate in hertz)), assumed_s, looks=300)


@pytest.mark.parametrize("followers", [2, 3, 4])
@pytest.mark.parametrize("hertz", [(10.0, 10.0), (50.0, 20.0)])
@pytest.mark.parametrize("assumed_s", [0.0, 1.0])
def test_equal_followers_in_mixed_coordinates_have_the_window_of_one(
    followers: int, hertz: tuple[float, float], assumed_s: float
) -> None:
    A, B, own = double_integrators(np.array([[-0.8, -1.5]]))
    rates = Timing(*(1.0 / rate for rate in hertz))
    alone_s = mismatch_window(A, B, own, rates, assumed_s=assumed_s)
    together = [np.kron(np.eye(followers), matrix) for matrix in (A, B, own)]
    K = together[2] + np.kron(np.eye(followers, k=-1), [[0.2, 0.5]])
    mixed = np.linalg.qr(np.random.default_rng(1).standard_normal((2 * followers, 2 * followers)))[0]
    loop = mixed @ together[0] @ mixed.T, mixed @ together[1], K @ mixed.T
    # a chain: one eigenvalue of this multiplicity, which rounding of 1e-14 spreads by its root; twice that, as the
    # gains between followers are not one
    within = 2.0 * 1e-14 ** (1.0 / followers)
    assert mismatch_window(*loop, rates, assumed_s=assumed_s) == pytest.approx(alone_s, rel=within)
