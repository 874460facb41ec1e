"""Stability radii: eigenvalues confirm a disturbance of that size, and no smaller one is found."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gains.formation.model import FormationModel
from gains.performance.disturbed import DisturbedFormation
from gains.performance.flown import FlownFormation, FlownTiming
from gains.performance.radii import SectorLoop, Worst
from gains.performance.robust import robustness
from gains.sampled._loop import HeldPlant

TRIANGLE = FormationModel((-1, 0, 1, 0, 3), axes=1)
GAIN = TRIANGLE.overlapping_gain([[-3.408]], [[0.6309]], [[5.6081]])
T = 0.02
PAIR = FormationModel((-1, 0), axes=1)


def sector(delay_s: float, vehicles: int, model: FormationModel = TRIANGLE) -> SectorLoop:
    flown = DisturbedFormation(model, model.A, model.B, GAIN[: model.inputs, : model.states], T, delay_s)
    return SectorLoop(flown, tuple(range(2 * vehicles - 1)))


def filtered(worst: Worst, z: complex) -> NDArray[np.complex128]:
    """The worst disturbance at a point of the unit circle."""

    def passed(coefficients: tuple[float, ...]) -> NDArray[np.complex128]:
        c = np.array(coefficients or [1.0] * len(worst.direction), dtype=np.complex128)
        return np.where(c == 1.0, 1.0, (c + 1.0 / z) / (1.0 + c / z))

    return worst.radius_1_s * passed(worst.all_pass_out)[:, np.newaxis] * worst.direction * passed(worst.all_pass_in)


def growth_1_s(loop: SectorLoop, disturbance: NDArray[Any]) -> float:
    """Growth rate of the loop with a constant w = Δ e, real or complex; from eigenvalues."""
    flown, chosen = loop.formation, list(loop.errors)
    F = flown.period_map().astype(np.complex128)
    size = len(flown.A)
    acts = np.eye(size)[:, chosen]
    held = HeldPlant(flown.A, acts, acts.T, T).transition(np.array([T]))[1][0]
    F[:size, chosen] += held @ disturbance
    return float(np.log(np.abs(np.linalg.eigvals(F)).max())) / T


@pytest.mark.parametrize("vehicles", [2, 5])
@pytest.mark.parametrize("delay_s", [0.0, 0.057, 0.2])
def test_worst_filter_of_the_complex_radius_leaves_the_loop_undamped(delay_s: float, vehicles: int) -> None:
    loop = sector(delay_s, vehicles)
    worst = loop.complex_radius()
    found = filtered(worst, np.exp(1j * worst.frequency_rad_s * T))
    assert np.linalg.norm(found, 2) == pytest.approx(worst.radius_1_s, rel=1e-9)
    assert growth_1_s(loop, found) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("followers", [1, 2])
@pytest.mark.parametrize("delay_s", [0.057, 0.2])
def test_worst_constant_of_the_real_radius_leaves_the_loop_undamped(delay_s: float, followers: int) -> None:
    # with two alike behind the leader, two singular values meet at the worst frequency
    model = FormationModel((-1, *[0] * followers), axes=1)
    K = model.overlapping_gain([[-3.408]], [[0.6309]], [[5.6081]])
    flown = DisturbedFormation(model, model.A, model.B, K, T, delay_s)
    loop = SectorLoop(flown, tuple(range(model.states)))
    worst = loop.real_radius()
    assert np.linalg.norm(worst.direction, 2) == pytest.approx(1.0, rel=1e-9)
    # the minimum over γ is flat: γ is known to the root of rounding
    assert growth_1_s(loop, worst.radius_1_s * worst.direction) == pytest.approx(0.0, abs=1e-6)
    assert worst.radius_1_s >= loop.complex_radius().radius_1_s


def test_no_constant_disturbance_below_the_real_radius_is_found() -> None:
    loop, rng = sector(0.2, 2, PAIR), np.random.default_rng(1)
    size = 0.995 * loop.real_radius().radius_1_s
    growths: list[float] = []
    for _ in range(3):  # uphill from random starts
        x, best = rng.normal(size=(3, 3)), -np.inf
        for _ in range(300):
            trial = x + rng.normal(size=(3, 3)) * 0.15
            trial /= np.linalg.norm(trial, 2)
            if (growth := growth_1_s(loop, size * trial)) > best:
                x, best = trial, growth
        growths.append(best)
    assert max(growths) < 0.0
    assert max(growths) > -0.1  # the search came near: without disturbance errors decay at 1.6 1/s


@pytest.mark.parametrize("case", [(1, 0, 0.0), (1, 0, 1.4), (2, 2, 0.0), (2, 2, 0.3), (2, 1, 0.3)])
def test_real_radius_of_one_error_is_the_least_unstable_constant(case: tuple[int, int, float]) -> None:
    vehicles, error, delay_s = case
    model = FormationModel((-1, 0)[:vehicles], axes=1)
    K = model.overlapping_gain([[-1.0]], [[0.0]], [[0.5]])
    loop = SectorLoop(DisturbedFormation(model, model.A, model.B, K, T, delay_s), (error,))
    worst = loop.real_radius()
    assert growth_1_s(loop, worst.radius_1_s * worst.direction) == pytest.approx(0.0, abs=1e-9)
    smaller = np.linspace(-0.999, 0.999, 200) * worst.radius_1_s
    assert max(growth_1_s(loop, np.array([[size]])) for size in smaller) < 0.0


def test_one_follower_has_the_robustness_bound_and_the_whole_less() -> None:
    alpha = robustness(-3.408, 0.6309, 5.6081)
    # sampling at 50 Hz moves it by less than half a period times the frequency, squared
    assert sector(0.0, 2).complex_radius().radius_1_s == pytest.approx(alpha, rel=1e-3)
    assert sector(0.0, 5).complex_radius().radius_1_s == pytest.approx(0.508, abs=5e-4)


def test_sampled_radius_is_that_of_the_continuous_model_except_sampling() -> None:
    flown = FlownFormation(PAIR, GAIN[:2, :3], FlownTiming(0.3, T))
    assert sector(0.15, 2).complex_radius().radius_1_s == pytest.approx(flown.alpha(0.15), rel=5e-3)


def test_a_constant_coupling_of_two_axes_reaches_the_complex_radius() -> None:
    loop = sector(0.2, 2)
    worst = loop.complex_radius()
    found = filtered(worst, np.exp(1j * worst.frequency_rad_s * T))
    both = FormationModel(TRIANGLE.predecessors, axes=2)
    flown = DisturbedFormation(both, both.A, both.B, np.kron(GAIN, np.eye(2)).astype(np.float64), T, 0.2)
    coupling = np.kron(found.real, np.eye(2)) + np.kron(found.imag, np.array([[0.0, -1.0], [1.0, 0.0]]))
    assert np.linalg.norm(coupling, 2) == pytest.approx(worst.radius_1_s, rel=1e-9)
    assert growth_1_s(SectorLoop(flown, tuple(range(6))), coupling) == pytest.approx(0.0, abs=1e-9)
