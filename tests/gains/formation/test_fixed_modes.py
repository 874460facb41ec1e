"""Fixed modes: those that random gains do not move are those that a rank test says no gain moves."""

from itertools import combinations

import numpy as np
import pytest

from gains.formation.fixed_modes import fixed_modes
from gains.formation.model import FormationModel
from gains.formation.pattern import Pattern, Plant, bidirectional, formation_plant, leader_follower, without_links
from tests.gains.formation.fixed_mode_oracle import fixed_by_rank, least_submodular


def agreed(plant: Plant, pattern: Pattern) -> int:
    """The number of fixed modes, on which both methods must agree to the bit."""
    found = {mode.mode: mode.states for mode in fixed_modes(plant, pattern)}
    assert found == fixed_by_rank(plant, pattern)
    return len(found)


def random_case(seed: int) -> tuple[Plant, Pattern]:
    """A sparse plant of whole numbers or of real ones, with vehicles of several sizes, and a pattern with few links."""
    rng = np.random.default_rng(seed)
    vehicles, states = int(rng.integers(1, 6)), int(rng.integers(2, 9))
    inputs, outputs = rng.integers(1, 3, (2, vehicles))

    def sparse(rows: int, columns: int) -> np.ndarray:
        entries = rng.integers(-2, 3, (rows, columns)) if seed % 2 else rng.normal(size=(rows, columns))
        return entries * (rng.random((rows, columns)) < 0.4)

    plant = Plant(sparse(states, states), sparse(states, inputs.sum()), sparse(outputs.sum(), states))
    return plant, Pattern(rng.random((vehicles, vehicles)) < 0.5, inputs.tolist(), outputs.tolist())


def test_random_gains_and_ranks_agree_on_modes_of_random_plants() -> None:
    counts = [agreed(*random_case(seed)) for seed in range(400)]
    # a plant with fixed modes and one without are about equally frequent
    assert 120 < sum(count > 0 for count in counts) < 280


@pytest.mark.parametrize("missing", [1, 2])
def test_both_methods_agree_on_formations_that_lack_links(missing: int) -> None:
    formation = FormationModel((-1, 0, 1, 1))
    plant = formation_plant(formation)
    for pattern in (leader_follower(formation), bidirectional(formation)):
        for links in combinations(pattern.links, missing):
            agreed(plant, without_links(pattern, links))


def test_both_methods_agree_on_components_of_many_inputs() -> None:
    # all pairs act on each other alike: differences of states stay fixed where fewer than eleven feed themselves back;
    # for twelve inputs not all subsets are tried
    plant = Plant(np.ones((12, 12)), np.eye(12))
    fed_back = (np.diag(np.arange(12) < count) for count in (9, 10, 11, 12))
    assert [agreed(plant, Pattern(blocks, (1,) * 12, (1,) * 12)) for blocks in fed_back] == [1, 1, 0, 0]
    chain = FormationModel((-1, *range(11)), axes=1)
    assert agreed(formation_plant(chain), bidirectional(chain)) == 0


def test_least_value_of_a_submodular_function_is_that_over_subsets() -> None:
    for seed in range(50):
        columns = np.random.default_rng(seed).integers(0, 2, (5, 7)).astype(float)
        price = np.random.default_rng(seed).integers(0, 2, 7)

        # a rank, less a price for each column
        def value_of(subset: frozenset[int], columns: np.ndarray = columns, price: np.ndarray = price) -> int:
            chosen = sorted(subset)
            return int(np.linalg.matrix_rank(columns[:, chosen]) if chosen else 0) - int(price[chosen].sum())

        subsets = [frozenset(chosen) for size in range(8) for chosen in combinations(range(7), size)]
        assert least_submodular(value_of, 7) == min(value_of(subset) for subset in subsets)
