"""H∞ and H2 gains of loops with delay: published values, and second ways that share no formula with the first."""

import numpy as np
import pytest
from numpy.typing import NDArray

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.core.semidefinite import Unknown, positive_definite_solution
from gains.criteria.figures import LoopFigures
from gains.criteria.norms import noise_gain, peak_gain
from gains.delay.rightmost import rightmost_root
from gains.formation.model import FormationModel
from gains.performance.flown import FlownTiming
from gains.sampled._loop import settled_covariance
from gains.sampled.constant import period_map

PAIR = FormationModel((-1, 0), axes=1)
K = PAIR.overlapping_gain([[-3.408]], [[0.631]], [[5.608]])
GRID = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 4000)])
Terms = list[tuple[list[list[float]], float]]


def loop_gain(terms: Terms, B: FloatArray, C: FloatArray, D: FloatArray | None = None) -> float:
    def characteristic(omega: FloatArray) -> NDArray[np.complex128]:
        s = 1j * omega[:, None, None]
        late = sum(np.array(matrix) * np.exp(-s * delay_s) for matrix, delay_s in terms)
        return (s * np.eye(len(B)) - late).astype(np.complex128)

    return peak_gain(characteristic, B, C, GRID, D=D)


# models and values: H∞-gain examples of the DDE library of PIETOOLS (CyberneticSCL), each to the digits it is known to
SCALAR = np.eye(1)
FIRST: Terms = [([[-2.0, 0.0], [0.0, -0.9]], 0.0), ([[-1.0, 0.0], [-1.0, -1.0]], 0.846)]
SECOND: Terms = [([[0.0, 1.0], [-2.0, 0.1]], 0.0), ([[0.0, 0.0], [1.0, 0.0]], 0.846)]
TWO: Terms = [([[0.0, 1.0], [-1.0, 0.1]], 0.0), ([[0.0, 0.0], [-1.0, 0.0]], 0.5), ([[0.0, 0.0], [1.0, 0.0]], 1.0)]
ENTRY, FRONT = np.array([[-0.5], [1.0]]), np.array([[1.0, 0.0]])


@pytest.mark.parametrize(("delay_s", "published"), [(0.5, 2.0), (1.5, 25.9077)])
def test_published_gain_of_a_scalar_loop_with_delay(delay_s: float, published: float) -> None:
    assert loop_gain([([[-1.0]], delay_s)], SCALAR, SCALAR, SCALAR) == pytest.approx(published, rel=5e-6)


@pytest.mark.parametrize(
    ("terms", "B", "C", "published"),
    [(FIRST, ENTRY, FRONT, 0.23644), (SECOND, np.eye(2), np.array([[0.0, 1.0]]), 2.8666), (TWO, ENTRY, FRONT, 4.97845)],
)
def test_published_gain_of_loops_with_one_or_two_delays(
    terms: Terms, B: FloatArray, C: FloatArray, published: float
) -> None:
    # to the last digit given
    assert loop_gain(terms, B, C) == pytest.approx(published, rel=2e-5)


def test_spacing_gain_is_the_inverse_of_the_least_destabilising_feedback() -> None:
    figures = LoopFigures(PAIR, K, FlownTiming(np.inf, 0.02), 0.15)
    gain, late_s = figures.spacing_gain_max_s2, 0.16
    C = np.array([[0.0, 1.0, 0.0]])
    assert gain > 0.0

    def abscissa(size: float) -> float:
        # w = size e^{jφ} u y with the worst direction; complex on one axis, real on two
        omega = np.linspace(0.0, 12.0, 6001)
        s = 1j * omega[:, None, None]
        responses = C @ np.linalg.solve(s * np.eye(3) - PAIR.A - PAIR.B @ K * np.exp(-s * late_s), PAIR.B + 0j)
        at = int(np.argmax(np.linalg.norm(responses, axis=(1, 2))))
        worst = responses[at].conj().T / np.linalg.norm(responses[at])
        now = PAIR.A + 0j + PAIR.B @ (size * worst) @ C
        real = np.block([[now.real, -now.imag], [now.imag, now.real]])
        return rightmost_root([(real, 0.0), (np.kron(np.eye(2), PAIR.B @ K), late_s)]).real

    # the spectrum of the delay equation, which knows no frequency response
    assert abscissa(1.001 / gain) > 0.0 > abscissa(0.999 / gain)


def test_spacing_gain_without_delay_is_that_of_bounded_real_lemma() -> None:
    figures = LoopFigures(PAIR, K, FlownTiming(np.inf, 0.02))
    C, A, B = np.array([[0.0, 1.0, 0.0]]), PAIR.A + PAIR.B @ K, PAIR.B

    def is_proved(gain: float) -> bool:
        def inequalities(unknowns: list[FloatArray]) -> list[FloatArray]:
            P, scale = unknowns
            corner = A.T @ P + P @ A + scale[0, 0] * C.T @ C
            return [P, scale, -np.block([[corner, P @ B], [B.T @ P, -(gain**2) * scale[0, 0] * np.eye(2)]])]

        return positive_definite_solution([Unknown(3), Unknown(1)], inequalities) is not None  # type: ignore[arg-type]

    gain = figures.spacing_gain_max_s2
    assert is_proved(1.001 * gain)
    assert not is_proved(0.999 * gain)


@pytest.mark.parametrize("delay_s", [0.0, 0.15, 0.205])
def test_noise_gain_is_that_of_a_simulated_loop(delay_s: float) -> None:
    found = noise_gain(PAIR.A, PAIR.B, K, period_s=0.02, delay_s=delay_s)
    lifted = period_map(PAIR.A, PAIR.B, K, period_s=0.02, delay_s=delay_s)
    # the response of both commands to one sample of noise in each state, summed over time
    still = period_map(PAIR.A, PAIR.B, 1e-9 * K, period_s=0.02, delay_s=delay_s)[:, :3]
    state, energy = (lifted[:, :3] - still) / (1.0 - 1e-9), (K**2).sum(axis=1)
    for _ in range(2500):
        energy = energy + ((K @ state[:3]) ** 2).sum(axis=1)
        state = lifted @ state
    assert found == pytest.approx(float(energy.max() ** 0.5), rel=1e-6)


def test_published_h2_norm_of_an_optimal_loop() -> None:
    """7.748 of example 7 of Scherer, Gahinet and Chilali (1997), whose model and value are python-control's example."""
    from scipy.linalg import expm, solve_continuous_are

    A, B = np.array([[0.0, 10.0, 2.0], [-1.0, 1.0, 0.0], [0.0, 2.0, -5.0]]), np.array([[0.0], [1.0], [0.0]])
    entry, outputs, seen, through = np.array([[1.0], [0.0], [1.0]]), np.diag([0.0, 1.0, 1.0]), B.T, 2.0
    F = -B.T @ solve_continuous_are(A, B, outputs, np.eye(1))
    Y = solve_continuous_are(A.T, seen.T, entry @ entry.T, np.array([[through**2]]), s=through * entry)
    L = (Y @ seen.T + through * entry) / through**2
    loop, noise = np.block([[A, B @ F], [L @ seen, A + B @ F - L @ seen]]), np.vstack([entry, L * through])
    # the map and the noise of a period of any length have the covariance of the continuous loop (Van Loan)
    hamiltonian = np.block([[-loop, noise @ noise.T], [np.zeros((6, 6)), loop.T]])
    exponential: FloatArray = expm(0.02 * hamiltonian).astype(np.float64)
    step = exponential[6:, 6:].T
    covariance = settled_covariance(step, step @ exponential[:6, 6:])
    assert covariance is not None
    power = np.trace(outputs @ covariance[:3, :3]) + (F @ covariance[3:, 3:] @ F.T).item()
    assert power**0.5 == pytest.approx(7.748350599360575, rel=1e-9)


def test_unstable_loop_has_no_gains() -> None:
    figures = LoopFigures(PAIR, K, FlownTiming(np.inf, 0.02), 0.35)
    assert figures.spacing_gain_max_s2 == figures.noise_gain_max == np.inf
    assert figures.alpha_at_delay == 0.0
    assert noise_gain(PAIR.A, PAIR.B, K, period_s=0.02, delay_s=0.35) == np.inf


def test_noise_gain_is_infinite_without_asymptotic_stability() -> None:
    # x+ = -x; and a state that grows by itself, which noise does not reach
    assert noise_gain(np.zeros((1, 1)), np.eye(1), -4.0 * np.eye(1), period_s=0.5, delay_s=0.0) == np.inf
    A, B, alone = np.diag([1.0, 0.0]), np.array([[0.0], [1.0]]), np.array([[0.0, -1.0]])
    assert noise_gain(A, B, alone, period_s=0.5, delay_s=0.0) == np.inf
    for times in ({"period_s": -0.5, "delay_s": 0.0}, {"period_s": 0.5, "delay_s": -0.1}):
        with pytest.raises(BadModelError, match="seconds"):
            noise_gain(A, B, alone, **times)
