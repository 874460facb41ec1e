"""The graph route on the thesis's formation: fixed modes, structured LQR and the D-K type iteration."""

from itertools import pairwise

import numpy as np
import pytest

from gains.core.arrays import FloatArray
from gains.core.errors import InfeasibleError
from gains.design.dk_iteration import dk_iteration
from gains.design.lqr import Cost, CostPoint, Weights
from gains.design.structured_lqr import stabilising_gain, structured_lqr
from gains.formation.fixed_modes import check_stabilisable, fixed_modes
from gains.formation.model import FormationModel
from gains.formation.pattern import (
    Pattern,
    Plant,
    all_to_all,
    bidirectional,
    formation_plant,
    leader_follower,
    without_links,
)

CHAIN = FormationModel((-1, 0, 1))
PLANT = formation_plant(CHAIN)
WEIGHTS = Weights(np.eye(10), np.eye(6))


def cost_at(plant: Plant, pattern: Pattern, weights: Weights, K: FloatArray) -> CostPoint:
    point = Cost(plant, pattern.mask, weights).at(K)
    assert point is not None
    return point


def abscissa(matrix: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> float:
    return float(np.linalg.eigvals(matrix).real.max())


@pytest.mark.parametrize("pattern", [leader_follower(CHAIN), bidirectional(CHAIN), all_to_all(CHAIN)])
def test_formations_have_no_fixed_modes(pattern: Pattern) -> None:
    assert fixed_modes(PLANT, pattern) == ()


def test_a_missing_own_output_prevents_stability_and_is_named() -> None:
    pattern = without_links(leader_follower(CHAIN), [(2, 2)])
    with pytest.raises(InfeasibleError, match=r"\(2, 2\)"):
        check_stabilisable(PLANT, pattern)


def test_with_all_information_the_structured_optimum_is_the_centralised_one() -> None:
    result = structured_lqr(PLANT, all_to_all(CHAIN), WEIGHTS)
    assert abs(result.loss) < 1e-6  # the Riccati equation is the independent method


@pytest.mark.parametrize("pattern", [leader_follower(CHAIN), bidirectional(CHAIN)], ids=["tree", "bidirectional"])
def test_structured_optimum_is_stationary_stable_in_pattern_and_costs_more(pattern: Pattern) -> None:
    result = structured_lqr(PLANT, pattern, WEIGHTS)
    mask = pattern.mask
    assert not result.K[~mask].any()
    assert abscissa(PLANT.closed_loop(result.K)) < 0
    assert result.loss > 0
    step = np.random.default_rng(1).normal(size=result.K.shape) * mask
    step *= 1e-4 / np.linalg.norm(step)
    up, down = (cost_at(PLANT, pattern, WEIGHTS, result.K + s * step).cost for s in (1, -1))
    assert up > result.cost
    assert down > result.cost
    assert abs(up - down) < 1e-3 * (up + down - 2 * result.cost) + 1e-9 * result.cost  # flat to first order


@pytest.mark.parametrize("seed", range(4))
def test_cost_gradient_is_its_slope_with_outputs_other_than_states(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(5, 5)) - 6.0 * np.eye(5)
    plant = Plant(A, rng.normal(size=(5, 3)), rng.normal(size=(4, 5)))
    pattern = Pattern(np.array([[1, 0], [1, 1]], dtype=bool), (1, 2), (2, 2))
    weights = Weights(np.eye(5) + np.diag(rng.uniform(size=5)), np.diag(rng.uniform(1.0, 2.0, size=3)))
    K = 0.1 * rng.normal(size=(3, 4)) * pattern.mask
    gradient = cost_at(plant, pattern, weights, K).gradient
    assert not gradient[~pattern.mask].any()
    for row, column in np.argwhere(pattern.mask):
        step = np.zeros_like(K)
        step[row, column] = 1e-5
        up, down = (cost_at(plant, pattern, weights, K + s * step).cost for s in (1, -1))
        assert gradient[row, column] == pytest.approx((up - down) / 2e-5, rel=1e-5, abs=1e-7)


@pytest.mark.parametrize(
    ("predecessors", "blocks"),
    [
        ((-1, 0, 1), [[0, 0, 1], [0, 1, 0], [1, 0, 0]]),
        ((-1, 0, 1), [[1, 1, 0], [0, 0, 1], [1, 0, 0]]),
        ((-1, 0, 0), [[1, 0, 1], [1, 0, 0], [0, 1, 0]]),
    ],
)
def test_vehicles_that_steer_only_each_other_are_stabilised(
    predecessors: tuple[int, ...], blocks: list[list[int]]
) -> None:
    # three of the 1022 patterns of three vehicles, on which gains once grew until covariances overflowed
    formation = FormationModel(predecessors, axes=1)
    tree = leader_follower(formation)
    pattern = Pattern(np.array(blocks, dtype=bool), tree.input_sizes, tree.output_sizes)
    plant = formation_plant(formation)
    gain = stabilising_gain(plant, pattern, Weights(np.eye(plant.states), np.eye(3)))
    assert not gain[~pattern.mask].any()
    assert np.linalg.eigvals(plant.A + plant.B @ gain).real.max() < -1e-4


def test_a_loop_whose_eigenvalues_add_up_to_zero_is_refused() -> None:
    # no vehicle sees its own output: the trace of A + B K is 0 for every K, though no mode is fixed
    formation = FormationModel((-1, 0, 1), axes=1)
    pattern = without_links(all_to_all(formation), [(0, 0), (1, 1), (2, 2)])
    plant = formation_plant(formation)
    check_stabilisable(plant, pattern)
    assert fixed_modes(plant, pattern) == ()
    with pytest.raises(InfeasibleError, match="no static gain"):
        stabilising_gain(plant, pattern, Weights(np.eye(plant.states), np.eye(3)))


def test_dk_iteration_always_falls_and_ends_stable_in_the_pattern() -> None:
    chain = FormationModel((-1, 0), axes=1)
    pattern, plant = leader_follower(chain), formation_plant(chain)
    design = dk_iteration(plant, pattern)
    alphas = [iterate.alpha for iterate in design.iterates]
    assert all(later <= earlier + 1e-9 for earlier, later in pairwise(alphas))
    assert alphas[-1] < 0
    assert not design.K[~pattern.mask].any()
    assert abscissa(plant.closed_loop(design.K)) < 0
