"""Centralised designs, the yardstick of the decentralised ones, and the ratios of what designs cost."""

import numpy as np
import pytest
from scipy import linalg

from gains.core.errors import BadModelError
from gains.design.centralised import centralised_lmi
from gains.design.lqr import Weights, centralised_lqr
from gains.formation.model import FormationModel
from gains.formation.pattern import Plant, formation_plant
from gains.performance.robust import disturbance_bound
from gcs.studies.compare_cost import DesignCost, ratios

CHAIN = formation_plant(FormationModel((-1, 0, 1), axes=1))


def test_centralised_lqr_is_stationary_and_its_cost_is_that_of_the_lyapunov_equation() -> None:
    weights = Weights(np.eye(CHAIN.states), np.eye(3))

    def cost(K: np.ndarray) -> float:
        closed = CHAIN.A + CHAIN.B @ K
        assert np.linalg.eigvals(closed).real.max() < 0.0
        return float(np.trace(linalg.solve_continuous_lyapunov(closed.T, -(weights.Q + K.T @ weights.R @ K))))

    K, least = centralised_lqr(CHAIN, weights)
    assert cost(K) == pytest.approx(least, rel=1e-10)
    rng = np.random.default_rng(3)
    assert all(cost(K + 1e-2 * rng.normal(size=K.shape)) > least for _ in range(20))


def test_centralised_lmi_withstands_what_it_claims_and_no_single_gain_is_above_its_bound() -> None:
    found = centralised_lmi(CHAIN, gain_bound=30.0, lyapunov_bound=30.0)
    exact = disturbance_bound(CHAIN.A + CHAIN.B @ found.K, np.eye(CHAIN.states))
    assert 0.9 < found.alpha <= exact * (1.0 + 1e-6)
    assert np.linalg.norm(found.K, 2) <= 30.0 * 30.0
    wider = centralised_lmi(CHAIN, gain_bound=300.0, lyapunov_bound=30.0)
    assert wider.alpha > found.alpha
    # one integrator: 2 L + 1 < -Y²/γ, so L = -κ_L and Y = 1/κ_Y give α = κ_Y √(2 κ_L - 1)
    one = centralised_lmi(Plant(A=np.zeros((1, 1)), B=np.eye(1)), gain_bound=5.0, lyapunov_bound=2.0)
    assert one.alpha == pytest.approx(2.0 * np.sqrt(2.0 * 5.0 - 1.0), rel=1e-4)
    assert one.K[0, 0] == pytest.approx(-10.0, rel=1e-4)
    with pytest.raises(BadModelError, match="gain_bound = 0"):
        centralised_lmi(CHAIN, gain_bound=0, lyapunov_bound=1.0)


def test_ratios_are_against_inclusion_of_five_vehicles() -> None:
    costs = [DesignCost("centralised LQR", 200, 3.0, 1), DesignCost("inclusion", 5, 0.2, 3)]
    assert ratios(costs) == pytest.approx([15.0, 1.0])
