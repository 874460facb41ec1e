"""Robustness: exact bounds against each other, against certificates and against known systems."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gains.core.errors import BadModelError, InfeasibleError
from gains.performance.robust import certify, disturbance_bound, robustness, subsystem_loop

EYE = np.eye(2)


def test_normal_matrix_bound_is_its_spectrums_distance_from_the_axis() -> None:
    """For a normal A, σ_min(jωI − A) is the least |jω − λ|, so α is the least |Re λ|: here 0.25 (exact)."""
    A = np.array([[-0.25, 7.0, 0.0], [-7.0, -0.25, 0.0], [0.0, 0.0, -3.0]])
    # The level-set search stops at 1e-10 of the bound, on the safe side.
    assert disturbance_bound(A, np.eye(3)) == pytest.approx(0.25, rel=3e-10)
    assert disturbance_bound(A, np.eye(3)) <= 0.25


def test_bound_of_an_oscillator_is_its_resonance_peak() -> None:
    """x'' + 2 ζ x' + x = w seen through position: peak gain 1 / (2 ζ √(1 − ζ²)), to which the other entries add.

    With W = [1 0] and A = [[0, 1], [−1, −2ζ]] the response is [s + 2ζ, 1] / (s² + 2ζs + 1); its largest norm is found
    here on a dense grid of its closed form.
    """
    zeta = 0.01
    x = np.linspace(0.99, 1.01, 2_000_001) ** 2
    squared = (x + 4 * zeta**2 + 1) / ((1 - x) ** 2 + 4 * zeta**2 * x)
    A = np.array([[0.0, 1.0], [-1.0, -2 * zeta]])
    # Spacing of the grid 1e-8 against a peak 0.02 wide: error of the grid about 1e-13.
    assert disturbance_bound(A, np.array([[1.0, 0.0]])) == pytest.approx(squared.max() ** -0.5, rel=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.2, 30), st.floats(-30, 30), st.floats(0.05, 200))
def test_exact_bound_is_the_least_singular_value_over_all_frequencies(k1: float, k2: float, k3: float) -> None:
    """For W = I, α is the complex stability radius: no frequency of a dense grid may lie below, some must come near."""
    alpha = robustness(-k1, k2, k3)
    A = subsystem_loop(-k1, k2, k3)
    omega = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 3000)])
    sigma = np.linalg.svd(1j * omega[:, None, None] * np.eye(3) - A, compute_uv=False)[:, -1]
    assert alpha <= sigma.min() * (1 + 1e-9)
    # Steps of the grid are 0.46 %; σ_min(ω) changes by at most |Δω| because jωI has norm ω.
    at = omega[np.argmin(sigma)]
    assert alpha >= sigma.min() - 0.0024 * at - 1e-3


@pytest.mark.parametrize("gains", [(-3.5, 3.5, 6.0), (-1.0, 1.0, 1.0), (-20.0, 22.0, 216.0), (-0.7, 0.7, 0.24)])
def test_proof_and_frequency_response_agree_on_the_bound(gains: tuple[float, float, float]) -> None:
    """Two independent ways: just below the exact bound a certificate exists, just above there is none."""
    alpha = robustness(*gains)
    certificate = certify(*gains, alpha * (1 - 1e-4))
    assert certificate.P_eigenvalue_min > 0 > certificate.s_procedure_eigenvalue_max
    with pytest.raises(InfeasibleError, match="lower alpha"):
        certify(*gains, alpha * (1 + 1e-4))


def test_agreement_holds_for_coupled_axes_and_a_weight() -> None:
    K1, K2, K3 = (
        np.array([[-3.0, 0.5], [-0.4, -2.0]]),
        np.array([[1.0, 0.2], [0.0, 1.5]]),
        np.array([[4.0, 1], [0, 3.0]]),
    )
    W = np.array([[1.0, 0, 0, 0.5, 0, 0], [0, 2.0, 0, 0, 0, 0.3]])
    alpha = robustness(K1, K2, K3, W)
    assert certify(K1, K2, K3, alpha * (1 - 1e-4), W).alpha == alpha * (1 - 1e-4)
    with pytest.raises(InfeasibleError):
        certify(K1, K2, K3, alpha * (1 + 1e-4), W)


def test_certificate_of_equal_axes_proves_the_scalar_bound() -> None:
    assert robustness(-3 * EYE, 2 * EYE, 4 * EYE) == pytest.approx(robustness(-3, 2, 4), rel=3e-10)


def test_an_unstable_loop_withstands_nothing() -> None:
    assert robustness(1.0, 0.0, 1.0) == 0
    assert robustness(-1.0, 0.0, -1.0) == 0
    with pytest.raises(InfeasibleError):
        certify(1.0, 0.0, 1.0, 0.1)


def test_arguments_of_another_shape_are_refused_by_name() -> None:
    with pytest.raises(BadModelError, match=r"K2 has shape \(1, 1\)"):
        robustness(-EYE, 1.0, EYE)
    with pytest.raises(BadModelError, match=r"W has shape \(2, 2\); wanted \(any, 3\)"):
        robustness(-1.0, 1.0, 1.0, EYE)
    with pytest.raises(BadModelError, match="alpha = -1"):
        certify(-1.0, 1.0, 1.0, -1.0)
