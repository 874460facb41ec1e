"""The spread of errors under gusts and noise: two ways that share no algebra, and known answers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.formation.model import FormationModel
from gains.performance.disturbed import DisturbedFormation, Gusts, Sensing
from gains.performance.response import Response, formation_loop, pushed_states
from gains.sampled._loop import HeldPlant, held_entry

CHAIN = FormationModel((-1, 0, 1), axes=1)
GAIN = CHAIN.overlapping_gain([[-3.408]], [[0.631]], [[5.608]])
EVERYTHING = Sensing(0.5, 0.1, 0.3, 0.05, bias_time_s=5.0)


OLDER = np.array([[[0, 0, 0], [0.3, 0, 0], [0.1, 0.45, 0]], [[0, 0, 0], [0.25, 0, 0], [0.2, 0.4, 0]]])


def spread_by_frequency(flown: DisturbedFormation) -> FloatArray:
    """Standard deviations of the errors, true and reported: the spectra of all sources, integrated, without F and P."""
    model, gusts, sensing, T = flown.model, flown.gusts, flown.sensing, flown.period_s
    assert gusts is not None
    n, states = len(flown.A), model.states
    entry = np.vstack([model.B, np.zeros((n - states, model.inputs))])
    if n > states:  # of a vehicle's two states, acceleration and velocity still to be reached, a push lowers the second
        entry[states + 1 :: 2] = -np.eye(model.vehicles)
    if gusts.common:
        entry = entry @ np.ones((model.inputs, 1))
    count = entry.shape[1]
    A = np.zeros((n + count, n + count))
    A[:n, :n], A[:n, n:], A[n:, n:] = flown.A, entry, -np.eye(count) / gusts.correlation_s
    white = np.zeros_like(A)
    white[n:, n:] = np.eye(count) * 2.0 * gusts.deviation_m_s2**2 / gusts.correlation_s

    def density(s: float) -> FloatArray:
        return expm(A * s) @ white @ expm(A.T * s)

    pushed: FloatArray = quad_vec(density, 0.0, T, epsabs=1e-17, epsrel=1e-12)[0]
    # from errors of positions and velocities to those of e
    of_positions, of_velocities = np.zeros((states, model.vehicles)), np.zeros((states, model.vehicles))
    for i in range(model.vehicles):
        of_velocities[model.velocity_slice(i), i] = 1.0
        if i > 0:
            of_positions[model.spacing_slice(i), [i, model.predecessors[i]]] = -1.0, 1.0
    variance, plant = np.zeros((2, states)), HeldPlant(A, np.pad(flown.B, ((0, count), (0, 0))), 0.0 * A, T)
    fades = np.exp(-T / sensing.bias_time_s)
    for part in np.array_split(np.arange(12_000), 6):
        z = np.exp(2j * np.pi * (part + 0.5) / 12_000)[:, np.newaxis, np.newaxis]
        closed = flown.closed(z)
        told = (closed @ (z * np.eye(n + count) - expm(A * T)) - np.eye(n + count))[:, :, :states]
        noise = np.hstack([sensing.position_noise_m * of_positions, sensing.velocity_noise_m_s * of_velocities])
        bias = np.hstack([sensing.position_bias_m * of_positions, sensing.velocity_bias_m_s * of_velocities])
        power = (closed @ pushed * closed.conj()).sum(axis=2).real[:, :states]
        heard, shown = told @ noise, noise + 0.0 * z
        if flown.older is not None:  # of others, part of the noise comes a period later
            for i, k in np.argwhere(flown.older[0] > 0.0):
                ahead = [of_positions[:, k] * flown.older[0, i, k], of_velocities[:, k] * flown.older[1, i, k]]
                columns = [k, model.vehicles + k]
                older = np.stack(ahead, axis=1) * (sensing.position_noise_m, sensing.velocity_noise_m_s)
                commanded = held_entry(plant, z, flown.delay_s)[:, :, [i]] @ flown.K[[i], :states] @ older
                heard[:, :, columns] += closed @ commanded * (1.0 / z - 1.0)
                if k == model.predecessors[i]:
                    own = model.spacing_slice(i)
                    shown[:, own, columns] += older[own] * (1.0 / z - 1.0)
        drift = told @ bias * (1.0 - fades**2) ** 0.5 / (z - fades)
        for one, direct in ((0, 0.0), (1, 1.0)):
            of_noise = heard[:, :states] + direct * shown
            of_bias = drift[:, :states] + direct * bias * (1.0 - fades**2) ** 0.5 / (z - fades)
            variance[one] += (power + (np.abs(of_noise) ** 2 + np.abs(of_bias) ** 2).sum(axis=2)).sum(axis=0) / 12_000
    return np.sqrt(variance)


@pytest.mark.parametrize("common", [False, True])
@pytest.mark.parametrize("assumed_s", [None, 0.15, 0.057])
@pytest.mark.parametrize("delay_s", [0.0, 0.05, 0.157, 0.25])
def test_lyapunov_equation_and_spectrum_give_the_same_spread(
    delay_s: float, assumed_s: float | None, common: bool
) -> None:
    flown = DisturbedFormation(
        CHAIN, CHAIN.A, CHAIN.B, GAIN, 0.02, delay_s, Gusts(0.5, 2.0, common), EVERYTHING, assumed_s=assumed_s
    )
    # rounding, amplified by sums over 12,000 frequencies
    spread = flown.spread()
    assert spread_by_frequency(flown) == pytest.approx(np.stack([spread.true, spread.reported]), rel=1e-9)


def test_vehicles_with_different_loop_delays_have_one_spread_both_ways() -> None:
    late_s = np.array([0.03, 0.157, 0.0])
    flown = DisturbedFormation(CHAIN, CHAIN.A, CHAIN.B, GAIN, 0.02, late_s, Gusts(0.5, 2.0), EVERYTHING, older=OLDER)
    spread = flown.spread()
    assert spread_by_frequency(flown) == pytest.approx(np.stack([spread.true, spread.reported]), rel=1e-9)
    alike = replace(flown, delay_s=np.full(3, 0.157)).spread()
    assert alike.true == pytest.approx(replace(flown, delay_s=0.157).spread().true, rel=1e-12)
    assert alike.true[1] == pytest.approx(spread.true[1], rel=0.2)  # vehicle 2, whose own loop is as late


@pytest.mark.parametrize("delay_s", [0.0, 0.157])
def test_noise_averaged_between_reports_gives_the_same_spread_both_ways(delay_s: float) -> None:
    flown = DisturbedFormation(CHAIN, CHAIN.A, CHAIN.B, GAIN, 0.02, delay_s, Gusts(0.5, 2.0), EVERYTHING, older=OLDER)
    spread = flown.spread()
    assert spread_by_frequency(flown) == pytest.approx(np.stack([spread.true, spread.reported]), rel=1e-9)
    assert spread.reported[4] < replace(flown, older=None).spread().reported[4]


def test_vehicles_with_a_lag_have_the_same_spread_both_ways() -> None:
    loop = formation_loop(CHAIN, GAIN / 3.0, [Response(0.15, 2.0)] * 3)
    pushed = pushed_states(CHAIN, [Response(0.15, 2.0)] * 3)
    flown = DisturbedFormation(CHAIN, *loop, 0.02, 0.06, Gusts(0.5, 2.0), EVERYTHING, pushed=pushed)
    spread = flown.spread()
    assert spread_by_frequency(flown) == pytest.approx(np.stack([spread.true, spread.reported]), rel=1e-9)


def test_noise_on_one_integrator_has_the_textbook_variance() -> None:
    leader, pole = FormationModel((-1,), axes=1), 1.0 - 0.3 * 0.1
    flown = DisturbedFormation(leader, leader.A, leader.B, np.array([[-0.3]]), 0.1, 0.0, sensing=Sensing(0.0, 2.0))
    # x_{k+1} = 0.97 x_k - 0.03 noise
    true = (1.0 - pole) * 2.0 / (1.0 - pole**2) ** 0.5
    assert flown.spread().true[0] == pytest.approx(true, rel=1e-12)
    assert flown.spread().reported[0] == pytest.approx((true**2 + 4.0) ** 0.5, rel=1e-12)


def test_steady_wind_moves_the_errors_until_commands_hold_it() -> None:
    flown = DisturbedFormation(CHAIN, CHAIN.A, CHAIN.B, GAIN, 0.02, 0.1, wind_m_s2=np.array([0.1]))
    mean = flown.spread().mean
    assert pytest.approx(-0.1 * np.ones(3), rel=1e-9) == GAIN @ mean
    assert mean[[0, 2, 4]] == pytest.approx(0.1 / 3.408 * np.ones(3), rel=1e-9)


def test_a_loop_past_its_margin_has_no_spread() -> None:
    flown = DisturbedFormation(CHAIN, CHAIN.A, CHAIN.B, GAIN, 0.02, 0.4, Gusts(0.5, 2.0))
    with pytest.raises(BadModelError, match=r"not stable at 0\.4 s"):
        flown.spread()


def test_prediction_reduces_the_effect_of_noise_at_long_delays() -> None:
    without, predicted = (
        DisturbedFormation(CHAIN, CHAIN.A, CHAIN.B, GAIN, 0.02, 0.25, sensing=EVERYTHING, assumed_s=assumed_s).spread()
        for assumed_s in (None, 0.25)
    )
    assert predicted.true[4] < 0.5 * without.true[4]
