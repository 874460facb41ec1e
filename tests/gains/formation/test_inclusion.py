"""Inclusion: the conditions for any tree, and what they promise: same motion, same spectrum."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from gains.core.errors import BadModelError
from gains.formation.inclusion import contracted_gain, expand, expanded_gain, modified_gain, verify_inclusion
from gains.formation.model import FormationModel

EYE = np.eye(2)
GAINS = (-3.0 * EYE, 2.0 * EYE, 5.0 * EYE)
# The conditions compare sums of at most a few products of the gains above: rounding only.
ROUNDING = 1e-13

trees = st.lists(st.integers(0, 10**6), max_size=9).map(lambda picks: (-1, *(p % (i + 1) for i, p in enumerate(picks))))


def test_three_in_a_row_give_the_printed_expansion() -> None:
    """(3.11), (3.12): x~ = (e1v, e1v, e2p, e2v, e2v, e3p, e3v), u~ = (u1, u1, u2, u2, u3); (3.13) disjoint blocks."""
    expansion = expand(FormationModel((-1, 0, 1)))
    V = np.zeros((7, 5))
    V[np.arange(7), [0, 0, 1, 2, 2, 3, 4]] = 1
    R = np.zeros((5, 3))
    R[np.arange(5), [0, 0, 1, 1, 2]] = 1
    np.testing.assert_array_equal(expansion.V.toarray(), np.kron(V, EYE))
    np.testing.assert_array_equal(expansion.R.toarray(), np.kron(R, EYE))
    block_A = np.array([[0, 0, 0], [1, 0, -1], [0, 0, 0]])
    block_B = np.array([[1, 0], [0, 0], [0, 1]])
    A, B = np.zeros((7, 7)), np.zeros((7, 5))
    A[1:4, 1:4] = A[4:, 4:] = block_A
    B[0, 0], B[1:4, 1:3], B[4:, 3:] = 1, block_B, block_B
    np.testing.assert_array_equal(expansion.A.toarray(), np.kron(A, EYE))
    np.testing.assert_array_equal(expansion.B.toarray(), np.kron(B, EYE))


def test_contracted_gain_has_the_printed_pattern() -> None:
    """K_M of (3.19) for three in a row, with gains that couple the axes."""
    K1, K2, K3 = np.array([[-1.0, 0.1], [0.2, -2.0]]), np.array([[3.0, 0.3], [0.4, 4.0]]), np.diag([5.0, 6.0])
    formation = FormationModel((-1, 0, 1))
    gain = contracted_gain(expand(formation), modified_gain(formation, expanded_gain(formation, K1, K2, K3)))
    O = np.zeros((2, 2))  # noqa: E741 - reads as the zero block of the printed matrix
    wanted = np.block([[K1, O, O, O, O], [K2, K3, K1, O, O], [O, O, K2, K3, K1]])
    np.testing.assert_allclose(gain, wanted, atol=ROUNDING)


@pytest.mark.parametrize("restriction", ["a", "b"])
@settings(max_examples=40, deadline=None)
@given(predecessors=trees)
def test_every_condition_holds_for_any_tree(restriction: Literal["a", "b"], predecessors: tuple[int, ...]) -> None:
    formation = FormationModel(predecessors)
    expansion = expand(formation, restriction)
    K_expanded = modified_gain(formation, expanded_gain(formation, *GAINS))
    K = contracted_gain(expansion, K_expanded)
    loop = (expansion, formation.A, formation.B)
    assert verify_inclusion(*loop, K=K, K_expanded=K_expanded, tolerance=ROUNDING) <= 10.0 * ROUNDING
    assert abs(expansion.A @ expansion.V - expansion.V @ formation.A).max() == 0.0
    np.testing.assert_allclose(K, formation.overlapping_gain(*GAINS), atol=ROUNDING)


@settings(max_examples=15, deadline=None)
@given(trees, st.floats(0.1, 2.0))
def test_expanded_motion_contracts_to_the_original(predecessors: tuple[int, ...], time_s: float) -> None:
    """U e^{A~ t} V = e^{A t}: the definition (3.5) that the conditions ensure, in open and in closed loop."""
    formation = FormationModel(predecessors)
    expansion = expand(formation)
    K_expanded = modified_gain(formation, expanded_gain(formation, *GAINS))
    K = contracted_gain(expansion, K_expanded)
    for original, expanded in (
        (formation.A, expansion.A.toarray()),
        (formation.A + formation.B @ K, (expansion.A + expansion.B @ K_expanded).toarray()),
    ):
        motion = expansion.U.toarray() @ expm(expanded * time_s) @ expansion.V.toarray()
        # expm of entries up to 10 over up to ten cascaded vehicles: about 1e-11 of the largest entry.
        np.testing.assert_allclose(motion, expm(original * time_s), atol=1e-9 * max(1.0, abs(motion).max()))


@settings(max_examples=25, deadline=None)
@given(trees, st.complex_numbers(min_magnitude=0.5, max_magnitude=9))
def test_closed_loop_spectrum_is_part_of_the_expanded_one(predecessors: tuple[int, ...], s: complex) -> None:
    """(sI − A~ − B~K~) V = V (sI − A − BK): an eigenvector v of the original loop gives V v of the expanded one.

    Eigenvalues themselves are not compared: those of equal followers in a chain are defective.
    """
    formation = FormationModel(predecessors)
    expansion = expand(formation)
    K_expanded = modified_gain(formation, expanded_gain(formation, *GAINS))
    closed = formation.A + formation.B @ contracted_gain(expansion, K_expanded)
    closed_expanded = (expansion.A + expansion.B @ K_expanded).toarray()
    V = expansion.V.toarray()
    left = (s * np.eye(len(closed_expanded)) - closed_expanded) @ V
    np.testing.assert_allclose(left, V @ (s * np.eye(len(closed)) - closed), atol=ROUNDING * 10)


def test_eigenvalues_of_one_follower_are_among_the_expanded_ones() -> None:
    """Without equal followers the spectrum is well conditioned and can be compared number by number."""
    formation = FormationModel((-1, 0))
    expansion = expand(formation)
    K_expanded = modified_gain(formation, expanded_gain(formation, *GAINS))
    closed = formation.A + formation.B @ contracted_gain(expansion, K_expanded)
    expanded = np.linalg.eigvals((expansion.A + expansion.B @ K_expanded).toarray())
    for root in np.linalg.eigvals(closed):
        # The two axes make every root double but not defective; the leader's copy makes −3 fourfold: 1e-16^(1/2).
        assert np.abs(expanded - root).min() < 1e-7


def test_unmodified_gain_is_refused_because_copies_disagree() -> None:
    formation = FormationModel((-1, 0, 1))
    expansion, K_expanded = expand(formation), expanded_gain(formation, *GAINS)
    K = contracted_gain(expansion, K_expanded)
    with pytest.raises(BadModelError, match=r"K~V = RK .*copies of an input"):
        verify_inclusion(expansion, formation.A, formation.B, K=K, K_expanded=K_expanded)


def test_wrong_map_is_refused_by_name() -> None:
    formation = FormationModel((-1, 0, 1))
    expansion = expand(formation)
    K_expanded = modified_gain(formation, expanded_gain(formation, *GAINS))
    K = contracted_gain(expansion, K_expanded)
    for changed, condition in (
        (replace(expansion, U=2 * expansion.U), "UV = I"),
        (replace(expansion, Q=2 * expansion.Q), "QR = I"),
        (replace(expansion, A=2 * expansion.A), "A~V = VA"),
        (replace(expansion, B=2 * expansion.B), "B~R = VB"),
    ):
        with pytest.raises(BadModelError, match=condition):
            verify_inclusion(changed, formation.A, formation.B, K=K, K_expanded=K_expanded)
    with pytest.raises(BadModelError, match=r"K~V = RK|K = QK~V"):
        verify_inclusion(expansion, formation.A, formation.B, K=2 * K, K_expanded=K_expanded)


def test_two_hundred_vehicles_are_verified_with_sparse_matrices() -> None:
    """A chain of 200: few entries a row, so it takes milliseconds; dense matrices would hold a million."""
    formation = FormationModel(tuple(range(-1, 199)))
    expansion = expand(formation)
    K_expanded = modified_gain(formation, expanded_gain(formation, *GAINS))
    K = contracted_gain(expansion, K_expanded)
    verify_inclusion(expansion, formation.A, formation.B, K=K, K_expanded=K_expanded)
    assert max(matrix.nnz for matrix in (expansion.A, expansion.B, K_expanded)) < 5000


def test_restriction_of_another_type_is_refused() -> None:
    with pytest.raises(BadModelError, match="'c'"):
        expand(FormationModel((-1, 0)), "c")  # pyrefly: ignore[bad-argument-type]
