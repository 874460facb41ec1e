"""Partition of a pattern's links into complete bipartite subgraphs, and the expanded gain."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gains.core.errors import BadModelError, DisagreementError
from gains.formation.bipartite import (
    LARGEST_SEARCH_LINKS,
    Subgraph,
    expanded_gain,
    partition_by_input,
    smallest_partition,
    verify_expansion,
)
from gains.formation.model import FormationModel
from gains.formation.pattern import (
    Pattern,
    Plant,
    all_to_all,
    bidirectional,
    formation_plant,
    leader_follower,
    with_links,
)

CHAIN = FormationModel((-1, 0, 1))
small_blocks = st.tuples(st.integers(1, 4), st.integers(1, 4)).flatmap(lambda shape: arrays(np.bool_, shape))


def pattern_of(blocks: np.ndarray) -> Pattern:
    return Pattern(blocks, (1,) * blocks.shape[0], (2,) * blocks.shape[1])


def size_and_rank(pattern: Pattern) -> tuple[int, int]:
    """The size of the partition found, and the rank of the pattern, which bounds that of every partition from below."""
    return len(smallest_partition(pattern)), int(np.linalg.matrix_rank(pattern.blocks.astype(float)))


def fewest_by_brute_force(blocks: np.ndarray) -> int:
    """Least number of 0/1 matrices of rank one that sum up to the pattern: dynamic programming over sets of links."""
    rows, columns = blocks.shape
    products: list[int] = []
    for left in range(1, 2**rows):
        for right in range(1, 2**columns):
            cells = [(i, j) for i in range(rows) if left >> i & 1 for j in range(columns) if right >> j & 1]
            if all(blocks[cell] for cell in cells):
                products.append(sum(1 << (i * columns + j) for i, j in cells))
    goal = sum(1 << int(i * columns + j) for i, j in np.argwhere(blocks))
    reached, count = {0}, 0
    while goal not in reached:
        # the lowest link left must be in one of the products: it is enough to try those
        reached = {
            done | product
            for done in reached
            for product in products
            if not done & product and product & -(goal & ~done) & (goal & ~done)
        }
        count += 1
    return count


def test_leader_follower_pattern_by_input_is_that_of_the_source() -> None:
    # (4.6), (4.7): {K11}, {K21, K22}, {K32, K33}; K̄ is 6×16, φ2 is 16×10 and stacks x1, x1, x2, x2, x3
    partition = partition_by_input(leader_follower(CHAIN))
    expanded = expanded_gain(leader_follower(CHAIN), partition)
    assert [graph.links for graph in partition] == [((0, 0),), ((1, 0), (1, 1)), ((2, 1), (2, 2))]
    assert expanded.mask.shape == (6, 16)
    assert np.array_equal(expanded.phi1, np.eye(6))
    x1, x2, x3 = np.split(np.arange(10.0), [2, 6])
    assert np.array_equal(expanded.phi2 @ np.arange(10.0), np.concatenate([x1, x1, x2, x2, x3]))


def test_no_partition_of_a_chain_is_smaller_than_by_input() -> None:
    for formation in (CHAIN, FormationModel((-1, *range(59)))):
        pattern = leader_follower(formation)
        assert size_and_rank(pattern) == (formation.vehicles, formation.vehicles)
        assert len(partition_by_input(pattern)) == formation.vehicles


def test_a_smaller_partition_is_found_where_it_exists() -> None:
    # vehicles 1, 2 and 3 use the same two outputs: one subgraph in place of three
    blocks = np.array([[1, 0, 0], [1, 1, 0], [1, 1, 0], [1, 1, 0], [0, 0, 1]])
    partition = smallest_partition(pattern_of(blocks))
    assert len(partition_by_input(pattern_of(blocks))) == 5
    assert len(partition) == 3
    assert smallest_partition(all_to_all(CHAIN)) == (Subgraph((0, 1, 2), (0, 1, 2)),)


@settings(deadline=None)
@given(small_blocks)
def test_partition_is_the_smallest_of_all(blocks: np.ndarray) -> None:
    partition = smallest_partition(pattern_of(blocks))
    assert len(partition) == fewest_by_brute_force(blocks)


@settings(deadline=None, max_examples=25)
@given(arrays(np.bool_, (9, 9)))
def test_every_link_is_in_exactly_one_subgraph(blocks: np.ndarray) -> None:
    for partition in (partition_by_input(pattern_of(blocks)), smallest_partition(pattern_of(blocks))):
        links = sorted(link for graph in partition for link in graph.links)
        assert links == list(pattern_of(blocks).links)


def test_beyond_the_search_only_the_rank_proves_a_partition_smallest() -> None:
    # every pair of eight outputs is used by one of 28 inputs: one subgraph for each output makes 8, which is the rank
    pairs = np.zeros((28, 8), dtype=bool)
    for row, pair in enumerate(combinations(range(8), 2)):
        pairs[row, list(pair)] = True
    assert pairs.sum() > LARGEST_SEARCH_LINKS
    assert size_and_rank(pattern_of(pairs)) == (8, 8)
    # 20 inputs that use everything but one of 20 outputs each: 20 again
    assert size_and_rank(pattern_of(~np.eye(20, dtype=bool))) == (20, 20)
    # the overlap of two squares counts twice in the rank's sum of products, which a partition must not do
    overlap = np.kron(np.array([[1, 1, 0, 0], [1, 1, 1, 0], [0, 1, 1, 1], [0, 0, 1, 1]]), np.eye(5)) > 0
    overlap[:, 0] = True
    assert overlap.sum() > LARGEST_SEARCH_LINKS
    assert size_and_rank(pattern_of(overlap)) == (20, 20)


@settings(deadline=None)
@given(small_blocks, st.integers(0, 2**32 - 1))
def test_expanding_and_contracting_gives_the_gain_back(blocks: np.ndarray, seed: int) -> None:
    pattern = pattern_of(blocks)
    rng = np.random.default_rng(seed)
    K = rng.standard_normal(pattern.mask.shape) * pattern.mask
    n = 5
    plant = Plant(*(rng.standard_normal(shape) for shape in ((n, n), (n, pattern.inputs), (pattern.outputs, n))))
    for partition in (partition_by_input(pattern), smallest_partition(pattern)):
        if not partition:
            continue
        expanded = expanded_gain(pattern, partition)
        assert np.array_equal(expanded.phi1 @ expanded.expand(K) @ expanded.phi2, K)
        assert verify_expansion(plant, expanded, K) <= 1e-12


def test_modes_of_the_expanded_loop_are_those_of_the_formation() -> None:
    pattern = with_links(bidirectional(CHAIN), [(2, 0)])
    K = np.random.default_rng(3).standard_normal(pattern.mask.shape) * pattern.mask
    plant = formation_plant(CHAIN)
    expanded = expanded_gain(pattern, smallest_partition(pattern))
    modes = np.linalg.eigvals(expanded.expand_plant(plant).closed_loop(expanded.expand(K)))
    wanted = np.linalg.eigvals(plant.closed_loop(K))
    # simple eigenvalues of a 10×10 matrix of norm 10: some hundred times the rounding
    assert np.abs(np.sort_complex(modes) - np.sort_complex(wanted)).max() < 1e-12


def test_partitions_that_do_not_fit_are_refused_with_the_link() -> None:
    pattern = leader_follower(CHAIN)
    graphs = partition_by_input(pattern)
    for subgraphs, message in (
        (graphs[:2], r"link \(2, 1\) is not in any subgraph"),
        ((*graphs, Subgraph((0,), (1,))), r"link \(0, 1\) is not in the pattern"),
        ((*graphs, Subgraph((2,), (2,))), r"link \(2, 2\) is in more than one"),
    ):
        with pytest.raises(BadModelError, match=message):
            expanded_gain(pattern, subgraphs)


def test_loops_that_differ_are_refused() -> None:
    pattern = leader_follower(CHAIN)
    expanded = expanded_gain(pattern, partition_by_input(pattern))
    with pytest.raises(DisagreementError, match="differ"):
        verify_expansion(formation_plant(CHAIN), replace(expanded, phi2=2 * expanded.phi2), 1.0 * pattern.mask)
