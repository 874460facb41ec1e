"""Functions that only other modules of `gains` call, each with an answer known by hand or from another function."""

import numpy as np
import pytest

from gains.core._bracketing import highest
from gains.core.arrays import ComplexArray, FloatArray, least_singular_values
from gains.core.structure import is_singular_for_any_delay, real_matrix
from gains.delay._crossings import DelayedTerm, crossing_errors, nearly_null, polished
from gains.delay._loci import UnitCrossing, remembered
from gains.delay._mixed import count_unstable_roots
from gains.delay._windows import ZeroPassage, zero_passage
from gains.delay.constant import delay_margin
from gains.design.dk_iteration import decay_proof
from gains.design.search import fastest_decay
from gains.performance.behaviour import block_margin, diagonal_blocks
from gains.performance.robust import subsystem_loop
from gains.performance.scalar_gains import decay_rate_of, least_singular_value


def test_a_loop_that_can_rest_is_singular_at_every_delay() -> None:
    """x'(t) = -x(t) + x(t - tau) rests at any x; a slow decay beside a fast one is no rest."""
    assert is_singular_for_any_delay([np.array([[-1]]), np.array([[1]])])
    assert not is_singular_for_any_delay([np.diag([-1e9, -1e-9])])


def test_a_pair_of_roots_is_unstable_beyond_the_margin() -> None:
    """x'(t) = -x(t - tau) at 1.5 and 2 s, on both sides of its margin of pi / 2."""
    assert [count_unstable_roots([([[-1]], delay_s)]) for delay_s in (1.5, 2.0)] == [0, 2]


def test_a_simple_crossing_is_known_to_rounding() -> None:
    [(_, delay_error_s)] = crossing_errors([DelayedTerm(np.array([[-1.0]]), 0.0, 1)], [(1.0, np.pi / 2.0)])
    assert 0.0 < delay_error_s < 1e-14


@pytest.mark.parametrize("multiple", [1, 2])
def test_one_step_squares_the_error_of_a_crossing(multiple: int) -> None:
    """s = a + b e^{-s k tau} crosses at omega^2 = b^2 - a^2, cos(k theta) = -a / b."""
    a, b = -1.0, -2.0
    terms = [np.array([[a]]), *(np.zeros((1, 1)) for _ in range(multiple - 1)), np.array([[b]])]
    omega, theta = np.sqrt(3.0), np.arccos(-a / b) / multiple
    beside = UnitCrossing((1.0 + 1e-8) * omega, complex(np.exp(1j * (theta - 1e-8))), 1)
    [found] = polished(terms, [beside])
    # the square is as small as rounding
    assert (found.omega_rad_s, found.delay_s) == pytest.approx((omega, theta / omega), rel=1e-14)
    assert polished(terms, [UnitCrossing(2.0 * omega, beside.locus, 1)]) == []


def test_loci_are_evaluated_once_at_a_frequency() -> None:
    asked: list[list[float]] = []

    def doubled(omega: FloatArray) -> ComplexArray:
        asked.append(omega.tolist())
        return (2j * omega[:, np.newaxis]).astype(np.complex128)

    loci = remembered(doubled, np.array([1.0, 2.0]))
    assert loci(np.array([2.0, 3.0, 3.0, 1.0])).tolist() == [[4j], [6j], [6j], [2j]]
    assert asked == [[1.0, 2.0], [3.0]]


@pytest.mark.parametrize("together", [1, 2])
def test_vectors_of_nearly_singular_matrices_are_those_of_their_decomposition(together: int) -> None:
    rng = np.random.default_rng(1)
    parts = rng.normal(size=(2, 30, 30)) + 1j * rng.normal(size=(2, 30, 30))
    U, Vh = (np.linalg.qr(part)[0] for part in parts)
    singular = np.append(np.linspace(1.0, 0.1, 30 - together), np.full(together, 1e-12))
    least, left, right = nearly_null(np.array((U * singular) @ Vh, dtype=np.complex128), 1.0)
    assert least == pytest.approx(1e-12, rel=1e-2)
    # the border moves the vectors by the least singular value over the gap of 0.1
    assert left @ left.conj().T == pytest.approx(U[:, -together:] @ U[:, -together:].conj().T, abs=1e-10)
    assert right @ right.conj().T == pytest.approx(Vh[-together:].conj().T @ Vh[-together:], abs=1e-10)


def test_a_root_passes_the_one_at_zero_once() -> None:
    """s = 1 - e^{-s tau} = s tau - ...: the second root at zero, at tau = 1."""
    found = zero_passage([np.array([[1.0]]), np.array([[-1.0]])], np.zeros(2), np.arange(2))
    assert found == ZeroPassage(delay_s=1.0, direction=1)


def test_a_unit_lyapunov_matrix_proves_a_unit_decay() -> None:
    """V = x'x proves that x' = -x decays like e^{-t}."""
    assert decay_proof(-np.eye(2), np.eye(2)).alpha == pytest.approx(-2.0, abs=1e-8)


def test_critical_damping_decays_fastest_at_a_margin() -> None:
    k1 = 2 * fastest_decay(0.3, 0.0)
    assert delay_margin([[0, -1], [0, 0]], [[0, 0], [k1**2 / 4, -k1]]) == pytest.approx(0.3, abs=1e-6)


def test_a_pair_falls_into_the_blocks_of_leader_and_follower() -> None:
    blocks = diagonal_blocks((np.array([[-1.0]]), np.array([[1.0]]), np.array([[1.0]])))
    assert [(A0 + A1).tolist() for A0, A1 in blocks] == [[[-1.0]], [[0.0, -1.0], [1.0, -1.0]]]


def test_a_block_crosses_the_axis_at_the_closed_form_frequency() -> None:
    """s^2 + (s + 1) e^{-s tau}: omega^2 = (1 + sqrt 5) / 2 and tau = atan(omega) / omega."""
    found, omega = block_margin([[0, -1], [0, 0]], [[0, 0], [1, -1]]), ((1 + 5**0.5) / 2) ** 0.5
    assert (found.delay_margin_s, found.crossing_rad_s) == pytest.approx((np.arctan(omega) / omega, omega), rel=1e-9)


def test_the_least_singular_value_is_that_of_the_subsystem() -> None:
    least = np.linalg.svd(1j * np.eye(3) - subsystem_loop(-3, 2, 2), compute_uv=False)[-1]
    found = least_singular_value(np.array(3.0), np.array(2.0), np.array(2.0), np.array(1.0))
    assert float(found) == pytest.approx(float(least), rel=1e-6)


def test_least_singular_values_are_made_to_ten_digits() -> None:
    """U diag(1, least) V' of rotations, from well-conditioned to singular, at every size of numbers."""
    least = np.array([1.0, 1e-2, 3e-3, 1e-5, 1e-12, 0.0])
    turned = np.array([[0.6, -0.8], [0.8, 0.6]])
    matrices = turned @ np.stack([np.diag([1.0, value]) for value in least]) @ turned
    for size in (1e-200, 1.0, 1e200):
        found = least_singular_values(size * matrices) / size
        assert found == pytest.approx(least, rel=1e-10, abs=1e-15)


def test_a_double_pole_decays_with_its_own_rate() -> None:
    assert float(decay_rate_of(np.array(2.0), np.array(1.0))) == 1.0


def test_a_maximum_between_grid_points_is_found() -> None:
    assert highest(np.sin, np.linspace(0.0, 3.0, 8))[1] == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("terms", "unstable"),
    [
        ([([[-1.0, 1.0], [1.0, -1.0]], 0.0)], 0),
        ([([[1.0, 1.0], [1.0, 1.0]], 0.0)], 1),
        ([([[-1.0]], 0.0), ([[1.0]], 0.0)], 0),
        ([([[1.0]], 0.0), ([[-1.0]], 0.5)], 0),  # s = 1 - e^{-s d} has a positive root for d > 1
        ([([[1.0]], 0.0), ([[-1.0]], 3.0)], 1),
    ],
)
def test_other_roots_are_counted_beside_one_that_stays_at_zero(
    terms: list[tuple[list[list[float]], float]], unstable: int
) -> None:
    assert count_unstable_roots(terms, leave_out_zero=True) == unstable


def test_a_matrix_that_was_passed_may_be_changed_afterwards() -> None:
    passed = np.eye(2)
    kept = real_matrix("A", passed)
    passed[0, 0] = 5.0
    assert kept.tolist() == [[1.0, 0.0], [0.0, 1.0]]
