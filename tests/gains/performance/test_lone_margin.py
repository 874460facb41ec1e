"""Margins of vehicles that respond with a dead time or in second order, each by two ways that share no algebra."""

import numpy as np
import pytest

from gains.core.errors import BadModelError
from gains.formation.model import FormationModel
from gains.performance.lone_margin import lone_margin
from gains.performance.response import Response, continuous_margin, formation_loop, own_dynamics, sampled_margin
from gains.sampled._loop import HeldPlant, lifted_map, radius_of
from gains.sampled.multirate import Timing

PAIR = FormationModel((-1, 0), axes=1)
MODELS = [Response(0.125, 2.78), Response(0.066, 1.88, 0.048), Response(0.11, 1.71, 0.0, 14.0), Response(0.2, 0.0, 0.2)]
FLOWN = 1.778, 0.549, 1.430


@pytest.mark.parametrize("response", MODELS)
@pytest.mark.parametrize("period_s", [0.02, 0.1])
def test_frequency_sweep_and_spectral_radius_give_one_margin(response: Response, period_s: float) -> None:
    k1, k2, k3 = FLOWN
    K = PAIR.overlapping_gain([[-k1]], [[k2]], [[k3]])
    swept = min(lone_margin(k1, gain, response, period_s=period_s) for gain in (0.0, k3))
    spectral = sampled_margin(PAIR, K, [response] * 2, timing=Timing(period_s, period_s))
    # the approximation of a dead time at the high frequencies of steps: 5e-5 s for 0.2 s of it
    assert swept == pytest.approx(spectral, abs=6e-5)


@pytest.mark.parametrize("response", MODELS)
def test_continuous_margin_is_the_exact_transfer_functions(response: Response) -> None:
    k1, k2, k3 = FLOWN
    K = PAIR.overlapping_gain([[-k1]], [[k2]], [[k3]])
    omega = np.linspace(0.5, 6.0, 200_001)
    loop = (k1 * 1j * omega + k3) / (1j * omega) ** 2 * response.transfer(omega)
    at = int(np.abs(np.abs(loop) - 1.0).argmin())
    swept = float(np.angle(-loop[at]) % (2.0 * np.pi) / omega[at])
    assert continuous_margin(PAIR, K, [response] * 2) == pytest.approx(swept, abs=6e-5)


def test_margins_of_the_three_models_fitted_to_one_vehicle_agree() -> None:
    """With the gains of copters5 the lag alone has 497 ms, the other two 482 ms."""
    margins_s = [lone_margin(FLOWN[0], FLOWN[2], response, period_s=0.02) for response in MODELS[:3]]
    assert margins_s == pytest.approx([0.497, 0.482, 0.482], abs=1e-3)


@pytest.mark.parametrize("response", MODELS)
def test_matrices_of_a_response_have_its_transfer_function(response: Response) -> None:
    A, B = own_dynamics(response)
    for omega in (0.5, 3.0, 6.0):
        found = np.linalg.solve(1j * omega * np.eye(len(A)) - A, B)[0, 0]
        assert abs(found - response.transfer(np.array([omega]))[0]) < 1e-5


def test_dead_time_that_alone_breaks_the_loop_leaves_no_margin() -> None:
    assert lone_margin(3.0, 3.0, Response(0.2, 0.5, 0.2), period_s=0.02) == 0.0
    with pytest.raises(BadModelError, match="natural frequency"):
        Response(0.1, 1.0, 0.05, 14.0)


@pytest.mark.parametrize(
    ("k1", "response"),
    [(1.2, Response(0.1, 0.0, natural_frequency_rad_s=3.0)), (2.0913, Response(0.11629684, 5.26287, 0.17118))],
)
def test_a_leader_that_is_unstable_at_once_has_no_margin(k1: float, response: Response) -> None:
    leader = formation_loop(FormationModel((-1,), axes=1), np.array([[-k1]]), [response])
    assert radius_of(lifted_map(HeldPlant(*leader, 0.02), 0.0)) > 1.0
    assert lone_margin(k1, 0.0, response, period_s=0.02) == 0.0


@pytest.mark.parametrize(
    ("k1", "k3", "response"),
    [(4.4, 0.0, Response(0.012, 1.15)), (2.0, 1.5, Response(0.005, 0.0)), (0.5, 0.0, Response(0.002, 0.0))],
)
def test_spectral_radius_is_one_at_the_margin_for_short_lags(k1: float, k3: float, response: Response) -> None:
    A, B, K = formation_loop(PAIR, PAIR.overlapping_gain([[-k1]], [[0.0]], [[k3]]), [response] * 2)
    own = np.array([0, 1, 2]) != (1 if k3 == 0.0 else 0)  # without leader, or without spacing
    own = np.append(own, np.ones(len(A) - 3, dtype=bool))
    margin_s = lone_margin(k1, k3, response, period_s=0.25)
    plant = HeldPlant(A[np.ix_(own, own)], B[own], K[:, own], 0.25)
    before, after = (radius_of(lifted_map(plant, factor * margin_s)) for factor in (1 - 1e-4, 1 + 1e-4))
    assert before < 1.0 < after
