"""The error model against the source's own matrices and against the motion of the vehicles themselves."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gains.core.errors import BadModelError
from gains.formation.model import FormationModel

EYE = np.eye(2)


def trees(max_vehicles: int = 12) -> st.SearchStrategy[tuple[int, ...]]:
    """Predecessors of a random tree in which every vehicle comes after the one it follows."""
    followers = st.integers(0, max_vehicles - 1).flatmap(
        lambda count: st.tuples(*(st.integers(0, i) for i in range(count)))
    )
    return followers.map(lambda front: (-1, *front))


def test_three_in_a_row_give_the_printed_matrices() -> None:
    """(2.12) of the source, block by block, in the order (e1v, e2p, e2v, e3p, e3v)."""
    formation = FormationModel((-1, 0, 1))
    A = [[0, 0, 0, 0, 0], [1, 0, -1, 0, 0], [0, 0, 0, 0, 0], [0, 0, 1, 0, -1], [0, 0, 0, 0, 0]]
    B = [[1, 0, 0], [0, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 1]]
    np.testing.assert_array_equal(formation.A, np.kron(A, EYE))
    np.testing.assert_array_equal(formation.B, np.kron(B, EYE))


def test_gain_has_the_printed_pattern_for_three_in_a_row() -> None:
    """K_M of (3.19): [K1 0 0 0 0; K2 K3 K1 0 0; 0 0 K2 K3 K1], with gains that couple the axes."""
    K1, K2, K3 = np.array([[-1.0, 0.1], [0.2, -2.0]]), np.array([[3.0, 0.3], [0.4, 4.0]]), np.diag([5.0, 6.0])
    O = np.zeros((2, 2))  # noqa: E741 - reads as the zero block of the printed matrix
    wanted = np.block([[K1, O, O, O, O], [K2, K3, K1, O, O], [O, O, K2, K3, K1]])
    np.testing.assert_array_equal(FormationModel((-1, 0, 1)).overlapping_gain(K1, K2, K3), wanted)


def test_two_platoons_share_the_leader() -> None:
    """The source's triangle of five: vehicles 1, 2 in one platoon and 3, 4 in the other, both led by vehicle 0."""
    formation = FormationModel((-1, 0, 1, 0, 3))
    assert (formation.states, formation.inputs) == (18, 10)
    for first, second in ((1, 2), (3, 4)):
        np.testing.assert_array_equal(formation.A[formation.spacing_slice(first), formation.velocity_slice(0)], EYE)
        np.testing.assert_array_equal(
            formation.A[formation.spacing_slice(second), formation.velocity_slice(first)], EYE
        )


@settings(max_examples=50, deadline=None)
@given(trees(), st.integers(0, 2**32 - 1))
def test_errors_of_moving_vehicles_obey_the_model(predecessors: tuple[int, ...], seed: int) -> None:
    """Errors built from positions and velocities (2.10) have the derivative A e + B u, whatever the tree."""
    formation = FormationModel(predecessors)
    rng = np.random.default_rng(seed)
    count = formation.vehicles
    position, velocity, command, spacing = rng.normal(size=(4, count, 2))
    nominal = rng.normal(size=2)

    def errors(position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        e = np.empty(formation.states)
        for i in range(count):
            e[formation.velocity_slice(i)] = velocity[i] - nominal
        for i in formation.followers:
            e[formation.spacing_slice(i)] = position[predecessors[i]] - position[i] - spacing[i]
        return e

    e = errors(position, velocity)
    # Errors are linear in positions and velocities, so the difference quotient over one second is the derivative.
    derivative = errors(position + velocity, velocity + command) - e
    # Sums of a few numbers of size 1: rounding only.
    np.testing.assert_allclose(formation.A @ e + formation.B @ command.ravel(), derivative, atol=1e-13)


def test_ground_loop_delays_all_feedback() -> None:
    formation = FormationModel((-1, 0, 0))
    K1, K2, K3 = -2 * EYE, EYE, 3 * EYE
    A0, A1 = formation.ground_loop(K1, K2, K3)
    np.testing.assert_array_equal(A0, formation.A)
    np.testing.assert_array_equal(A1, formation.B @ formation.overlapping_gain(K1, K2, K3))


def test_negative_k1_and_positive_k3_stabilise() -> None:
    """The sign that the docstring states: s² + k1 s + k3 for K1 = −k1, K3 = +k3; 3 and 2 give roots −1 and −2."""
    A0, A1 = FormationModel((-1, 0)).ground_loop(-3 * EYE, EYE, 2 * EYE)
    roots = np.sort(np.linalg.eigvals(A0 + A1).real)
    # Simple roots of well separated size; each appears twice for the two axes, hence the square root of rounding.
    np.testing.assert_allclose(roots, [-3, -3, -2, -2, -1, -1], atol=1e-7)


def test_an_array_is_taken_as_well_as_a_tuple() -> None:
    assert FormationModel(np.array([-1, 0, 1])) == FormationModel((-1, 0, 1))  # pyrefly: ignore[bad-argument-type]


@pytest.mark.parametrize(
    ("predecessors", "message"),
    [
        ((), "one number for each vehicle"),
        ((0, -1), "vehicle 0 follows vehicle 0"),
        ((-1, -1), "vehicle 1 is a second leader"),
        ((-1, 2, 0), "vehicle 1 follows vehicle 2"),
        ((-1, 1), "vehicle 1 follows vehicle 1"),
        ((-1, -2), "vehicle 1 follows vehicle -2"),
        ((-1.0, 0.5), "whole numbers"),
    ],
)
def test_predecessors_that_form_no_tree_are_refused(predecessors: tuple[int, ...], message: str) -> None:
    with pytest.raises(BadModelError, match=message):
        FormationModel(predecessors)


@pytest.mark.parametrize(
    ("gain", "message"),
    [
        (np.eye(3), r"K2 has shape \(3, 3\); wanted \(2, 2\)"),
        (np.nan * EYE, "K2 .* not finite"),
        ("x", "K2 has entries of type <U1; real numbers"),
    ],
)
def test_a_gain_of_the_wrong_form_is_refused_by_name(gain: np.ndarray, message: str) -> None:
    with pytest.raises(BadModelError, match=message):
        FormationModel((-1, 0)).overlapping_gain(-EYE, gain, EYE)


def test_the_leader_has_no_spacing_error() -> None:
    with pytest.raises(BadModelError, match="leader"):
        FormationModel((-1, 0)).spacing_slice(0)


@pytest.mark.parametrize("axes", [1, 2])
def test_feedback_is_the_product_of_b_and_k(axes: int) -> None:
    model = FormationModel((-1, 0, 0, 2), axes)
    K = np.random.default_rng(1).standard_normal((model.inputs, model.states))
    assert np.array_equal(model.feedback(K), model.B @ K)
