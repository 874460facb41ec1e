"""The centralised LQR, a yardstick for decentralised designs, and the ratios of the designs' costs."""

import numpy as np
import pytest
from scipy import linalg

from gains.core.errors import BadModelError, InfeasibleError
from gains.design.lqr import Weights, centralised_lqr
from gains.formation.model import FormationModel
from gains.formation.pattern import Plant, formation_plant
from gcs.studies.compare_cost import DesignCost, ratios

CHAIN = formation_plant(FormationModel((-1, 0, 1), axes=1))


def test_centralised_lqr_is_stationary_at_the_lyapunov_equations_cost() -> None:
    weights = Weights(np.eye(CHAIN.states), np.eye(3))

    def cost(K: np.ndarray) -> float:
        closed = CHAIN.A + CHAIN.B @ K
        assert np.linalg.eigvals(closed).real.max() < 0.0
        return float(np.trace(linalg.solve_continuous_lyapunov(closed.T, -(weights.Q + K.T @ weights.R @ K))))

    K, least = centralised_lqr(CHAIN, weights)
    assert cost(K) == pytest.approx(least, rel=1e-10)
    rng = np.random.default_rng(3)
    assert all(cost(K + 1e-2 * rng.normal(size=K.shape)) > least for _ in range(20))


_FITTING = "of shape .*: a symmetric, positive .*definite matrix of 3 rows is wanted"


@pytest.mark.parametrize("name", ["Q", "R"])
@pytest.mark.parametrize(
    ("wrong", "wanted"),
    [
        (np.eye(2), _FITTING),
        (np.triu(np.ones((3, 3))), _FITTING),
        (-np.eye(3), _FITTING),
        (np.diag([1.0, 1.0, -1e-9]), _FITTING),
        (np.full((3, 3), np.nan), "has entries that are not finite"),
    ],
)
def test_weights_of_the_wrong_form_are_refused_by_name(name: str, wrong: np.ndarray, wanted: str) -> None:
    plant = Plant(-np.eye(3), np.eye(3))
    weights = Weights(np.eye(3), np.eye(3))._replace(**{name: wrong})
    with pytest.raises(BadModelError, match=f"{name},? {wanted}"):
        centralised_lqr(plant, weights)


@pytest.mark.parametrize("A", [np.array([[0.0, 1.0], [-1.0, 0.0]]), np.diag([0.0, -1.0]), np.zeros((2, 2))])
def test_modes_on_the_axis_without_weight_are_refused(A: np.ndarray) -> None:
    plant = Plant(A, np.array([[1.0], [1.0]]))
    with pytest.raises(InfeasibleError, match="imaginary axis"):
        centralised_lqr(plant, Weights(np.zeros((2, 2)), np.eye(1)))


def test_ratios_are_against_inclusion_of_five_vehicles() -> None:
    costs = [DesignCost("centralised LQR", 200, 3.0, 1), DesignCost("inclusion", 5, 0.2, 3)]
    assert ratios(costs) == pytest.approx([15.0, 1.0])


def test_weights_may_be_nested_lists() -> None:
    plant = Plant([[0.0]], [[1.0]])
    assert centralised_lqr(plant, Weights([[4.0]], [[1.0]]))[0] == pytest.approx(np.array([[-2.0]]))  # pyrefly: ignore[bad-argument-type]
