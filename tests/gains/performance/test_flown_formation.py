"""α of a formation with gains on a general pattern and delay, by a second way that shares no formula with the first."""

from dataclasses import replace
from functools import cache
from math import inf
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from gains.core.arrays import FloatArray
from gains.design.graph import graph_design
from gains.formation.model import FormationModel
from gains.formation.pattern import bidirectional
from gains.performance.flown import FlownFormation, FlownLoop, FlownTiming
from gains.performance.response import Response, formation_loop
from gains.performance.scalar_gains import ScalarGains
from gains.sampled.constant import spectral_radius
from gains.sampled.onboard import OnboardTiming, onboard_loop

PERIOD_S = 0.02
CHAIN = FormationModel((-1, 0, 1))
ONBOARD = OnboardTiming(PERIOD_S, steps=2)
STEP_S = PERIOD_S / 2
Loop = Literal["ground", "onboard"]


@cache
def flown(loop: Loop) -> FlownFormation:
    """A chain of three that looks both ways, designed for a margin of 0.3 s in the ground loop."""
    found = graph_design(CHAIN, bidirectional(CHAIN), method="graph-lqr", period_s=PERIOD_S)
    margin_s = found.delay_margin_s
    if loop == "onboard":
        margin_s = onboard_loop(CHAIN, found.K, ONBOARD).sampled_margin_s()
    return FlownFormation(CHAIN, found.K, FlownTiming(margin_s, PERIOD_S, loop, STEP_S if loop == "onboard" else 0.0))


def sampled_growth(flight: FlownFormation, disturbance: FloatArray, delay_s: float) -> float:
    """Spectral radius, or growth rate plus one, of the loop as sampled and held: above one if it is unstable."""
    if flight.timing.loop == "ground":
        disturbed = CHAIN.A + disturbance
        return spectral_radius(disturbed, CHAIN.B, flight.K, period_s=PERIOD_S, delay_s=delay_s)
    loop = onboard_loop(CHAIN, flight.K, ONBOARD)
    return 1.0 + replace(loop, A=loop.A + disturbance).growth_1_s(delay_s)


def worst_disturbance(flight: FlownFormation, delay_s: float) -> FloatArray:
    """The real disturbance of norm 1 on north and east that is worst at the frequency of least σ_min on a grid."""
    omega = np.linspace(0.0, 12.0, 6001)
    left, sigma, right = np.linalg.svd(flight.characteristic(omega, delay_s))
    at = int(np.argmin(sigma[:, -1]))
    worst: NDArray[np.complex128] = left[at, :, -1][:, None] @ right[at, -1, :][None, :]
    # complex on one axis, it is the real [[Re, -Im], [Im, Re]] on north and east
    return np.kron(worst.real, np.eye(2)) + np.kron(worst.imag, np.array([[0.0, -1.0], [1.0, 0.0]]))


@pytest.mark.parametrize(
    ("loop", "delay_s"), [("ground", 0.1), ("ground", 0.2), ("ground", 0.27), ("onboard", 0.3), ("onboard", 1.2)]
)
def test_only_a_real_disturbance_beyond_alpha_destabilises_the_sampled_formation(loop: Loop, delay_s: float) -> None:
    flight = flown(loop)
    alpha, worst = flight.alpha(delay_s), worst_disturbance(flight, delay_s)
    assert np.linalg.norm(worst, 2) == pytest.approx(1.0)
    # the hold is a delay of half a period up to the second order of the period
    assert sampled_growth(flight, 1.02 * alpha * worst, delay_s) > 1.0
    assert sampled_growth(flight, 0.98 * alpha * worst, delay_s) < 1.0
    rng = np.random.default_rng(3)
    for _ in range(10):
        other: Any = rng.standard_normal((CHAIN.states, CHAIN.states))
        assert sampled_growth(flight, 0.98 * alpha * other / np.linalg.norm(other, 2), delay_s) < 1.0


@pytest.mark.parametrize("loop", ["ground", "onboard"])
def test_alpha_holds_to_its_limit_and_falls_before_the_margin(loop: Loop) -> None:
    flight = flown(loop)
    at_rest = flight.alpha(0.0)
    assert flight.alpha(0.97 * flight.timing.delay_margin_s) < 0.2 * at_rest
    for share in (0.99, 0.5):
        limit_s = flight.alpha_limit_s(share * at_rest)
        assert 0.0 < limit_s < flight.timing.delay_margin_s
        assert flight.alpha(limit_s) == pytest.approx(share * at_rest, rel=1e-6)
        assert min(flight.alpha(part * limit_s) for part in (0.2, 0.5, 0.8, 0.99)) >= share * at_rest
    assert flight.alpha(flight.timing.delay_margin_s) == 0.0
    assert flight.alpha_limit_s(1.01 * at_rest) == 0.0


def test_a_leader_with_one_follower_is_the_followers_loop() -> None:
    pair, gains = FormationModel((-1, 0)), ScalarGains(3.4, 0.6, 5.6, 0.0)
    K = pair.overlapping_gain(-gains.k1 * np.eye(2), gains.k2 * np.eye(2), gains.k3 * np.eye(2))
    answer = Response(0.05, 1.5)
    flown_where: list[tuple[Loop, float, float]] = [("ground", 0.0, 0.3), ("onboard", STEP_S, inf)]
    for loop, step_s, margin_s in flown_where:
        for response, responses in ((None, None), (answer, (answer, answer))):
            timing = FlownTiming(margin_s, PERIOD_S, loop, step_s)
            matrix = FlownFormation(pair, K, timing, responses)
            pair_of_one_axis = FlownLoop(gains, timing, response).pair
            for delay_s in (0.0, 0.1, 0.2):
                assert matrix.alpha(delay_s) == pytest.approx(pair_of_one_axis.alpha(delay_s), rel=1e-9)


def test_only_gains_that_couple_axes_need_the_whole_matrix() -> None:
    flight = flown("ground")
    omega = np.linspace(0.0, 5.0, 20)
    assert flight.characteristic(omega, 0.1).shape == (20, 5, 5)
    K = flight.K.copy()
    K[0, 1] = 1e-9
    coupled = replace(flight, K=K)
    assert coupled.characteristic(omega, 0.1).shape == (20, 10, 10)
    assert coupled.alpha(0.2) == pytest.approx(flight.alpha(0.2), rel=1e-7)


def test_each_vehicles_response_is_in_its_row_of_the_matrix() -> None:
    """σ_min of the formation is that of the Schur complement of the formation with its vehicles' states."""
    flight = flown("ground")
    answers = tuple(Response(lag_s, gain) for lag_s, gain in ((0.05, 0.0), (0.2, 1.0), (0.1, 2.0)))
    late = replace(flight, responses=answers)
    A, B, K = formation_loop(CHAIN, flight.K, answers)
    omega, n = np.array([0.3, 1.7, 4.0]), CHAIN.states
    s = 1j * omega[:, None, None]
    whole: Any = s * np.eye(len(A)) - A - B @ K * np.exp(-s * (0.1 + PERIOD_S / 2))
    schur = whole[:, :n, :n] - whole[:, :n, n:] @ np.linalg.solve(whole[:, n:, n:], whole[:, n:, :n])
    least = np.linalg.svd(schur, compute_uv=False)[:, -1]
    assert late.singular_value(omega, 0.1) == pytest.approx(least, rel=1e-9)
