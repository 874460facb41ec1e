"""Splitting into strongly connected blocks, balancing, and removing roots fixed at zero."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.core.structure import (
    balanced,
    distinct_blocks,
    square_matrices,
    strongly_connected_blocks,
    without_fixed_roots,
)

sparse_matrices = st.integers(1, 9).flatmap(
    lambda n: arrays(np.float64, (n, n), elements=st.sampled_from([0.0, 0.0, 0.0, 0.0, 1.0]))
)


def as_sets(blocks: list[np.ndarray]) -> set[frozenset[int]]:
    return {frozenset(block.tolist()) for block in blocks}


@settings(deadline=None)
@given(sparse_matrices)
def test_blocks_are_the_components_networkx_finds(matrix: FloatArray) -> None:
    graph = nx.from_numpy_array(matrix.T, create_using=nx.DiGraph)
    expected = {frozenset(component) for component in nx.strongly_connected_components(graph)}
    assert as_sets(strongly_connected_blocks(matrix)) == expected


@settings(deadline=None)
@given(sparse_matrices)
def test_drivers_come_before_the_driven(matrix: FloatArray) -> None:
    blocks = strongly_connected_blocks(matrix)
    place = {state: k for k, block in enumerate(blocks) for state in block.tolist()}
    assert all(place[int(j)] <= place[int(i)] for i, j in np.argwhere(matrix))


def test_large_models_split_as_small_ones_do() -> None:
    # 30 blocks of 3 states in a random order: beyond the size at which the method changes
    rng = np.random.default_rng(5)
    matrix = np.kron(np.tril(np.ones((30, 30))), np.ones((3, 3)))
    order = rng.permutation(90)
    blocks = strongly_connected_blocks(matrix[np.ix_(order, order)])
    assert [sorted(order[block].tolist()) for block in blocks] == [[3 * k, 3 * k + 1, 3 * k + 2] for k in range(30)]


def test_union_of_patterns_decides() -> None:
    forth, back = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0, 0.0], [1.0, 0.0]])
    assert [block.tolist() for block in strongly_connected_blocks(forth)] == [[1], [0]]
    assert [block.tolist() for block in strongly_connected_blocks(forth, back)] == [[0, 1]]


def test_equal_blocks_are_listed_once() -> None:
    A0 = np.kron(np.eye(3), [[0.0, 1.0], [-1.0, 0.0]])
    A1 = np.kron(np.diag([1.0, 1.0, 2.0]), [[0.0, 0.0], [-0.0, -1.0]])
    own, late = [[0.0, 1.0], [-1.0, 0.0]], [[0.0, 0.0], [0.0, -1.0]]
    found = [(block.copies, *(matrix.tolist() for matrix in block.matrices)) for block in distinct_blocks(A0, A1)]
    assert found == [(2, own, late), (1, own, [[0.0, 0.0], [0.0, -2.0]])]


def test_balancing_is_an_exact_similarity() -> None:
    rng = np.random.default_rng(1)
    scale = np.array([1e-6, 1.0, 1e5, 3.0])
    A, B = (rng.normal(size=(4, 4)) * scale / scale[:, np.newaxis] for _ in range(2))
    A_balanced, B_balanced = balanced(A, B)
    ratio = A_balanced / A
    # powers of two, the same for both matrices
    assert np.array_equal(ratio, B_balanced / B)
    assert np.array_equal(np.exp2(np.round(np.log2(ratio))), ratio)
    # the rows spread over 11 decades before balancing
    norms = np.abs(A_balanced).sum(axis=1)
    assert norms.max() / norms.min() < 30.0


def test_consensus_loses_its_common_value_only() -> None:
    laplacian = np.array([[2.0, -1.0, -1.0], [-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
    (A0, A1), gone = without_fixed_roots(np.zeros((3, 3)), -laplacian)
    assert gone == 1
    assert not A0.any()
    # eigenvalues 0, 1, 3 of the Laplacian; 1e-14 is rounding
    assert np.sort(np.linalg.eigvals(-A1).real) == pytest.approx([1.0, 3.0], rel=1e-14)


def test_formation_at_constant_velocity_loses_position_and_velocity() -> None:
    laplacian = np.array([[1.0, -1.0], [-1.0, 1.0]])
    A0 = np.kron([[0.0, 1.0], [0.0, 0.0]], np.eye(2))
    A1 = np.kron([[0.0, 0.0], [-1.0, -1.0]], laplacian)
    reduced, gone = without_fixed_roots(A0, A1)
    assert gone == 2
    # one relative motion is left: s^2 + 2 s + 2
    assert np.poly(reduced[0] + reduced[1]) == pytest.approx([1.0, 2.0, 2.0], rel=1e-14)


@pytest.mark.parametrize(
    ("matrices", "message"),
    [
        ({"A0": [[1.0, 2.0]]}, r"A0 has shape \(1, 2\); a square matrix"),
        ({"A0": [[1.0]], "A1": np.eye(2)}, r"A1 has shape \(2, 2\); 1x1 is wanted"),
        ({"A0": [[np.nan]]}, "A0 has entries that are not finite"),
        ({"A0": [[1.0], [1.0, 2.0]]}, "A0 is ragged"),
        ({"A0": [[1j]]}, "A0 has entries of type complex128; real numbers"),
        ({"A0": []}, r"A0 has shape \(0,\); a matrix with at least one"),
    ],
)
def test_wrong_matrices_are_named(matrices: dict[str, FloatArray], message: str) -> None:
    with pytest.raises(BadModelError, match=message):
        square_matrices(**matrices)


def test_fixed_roots_go_block_by_block_and_others_stay() -> None:
    # two rings of consensus, the second driven by the first, and a lag: two common values go
    ring = np.array([[-2.0, 1.0, 1.0], [1.0, -2.0, 1.0], [1.0, 1.0, -2.0]])
    A1 = np.zeros((7, 7))
    A1[:3, :3], A1[3:6, 3:6], A1[3, 0] = ring, 2.0 * ring, 0.5
    A0 = np.diag([0.0] * 6 + [-1.0])
    (now, late), gone = without_fixed_roots(A0, A1)
    assert gone == 2
    kept = np.sort(np.linalg.eigvals(now + late).real)
    # eigenvalues of a ring of three: 0, -3, -3; double ones are known to half the digits
    assert kept == pytest.approx([-6.0, -6.0, -3.0, -3.0, -1.0], abs=1e-7)


def test_matrices_without_fixed_roots_come_back_as_they_were() -> None:
    A0, A1 = np.array([[-1.0, 0.0], [5.0, 0.0]]), np.array([[0.0, 0.0], [0.0, -2.0]])
    (now, late), gone = without_fixed_roots(A0, A1)
    assert gone == 0
    assert np.array_equal(now, A0)
    assert np.array_equal(late, A1)


def test_integrator_that_nobody_feeds_back_stays() -> None:
    # without it nothing is left of its block; with it the loop is not stable
    _, gone = without_fixed_roots(np.array([[-1.0, 0.0], [1.0, 0.0]]), np.zeros((2, 2)))
    assert gone == 0
