"""The margin of vehicles that respond with a lag: closed forms, the spectrum, a simulation, and limits of the model."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from gains.core.errors import BadModelError, InfeasibleError
from gains.core.requirement import Requirement
from gains.delay.constant import delay_margin
from gains.delay.rightmost import rightmost_root
from gains.design.design import design
from gains.design.required import requirement_with
from gains.formation.model import FormationModel
from gains.performance.response import Response, continuous_margin, formation_loop, sampled_margin
from gains.performance.string_stability import string_peak
from gains.sampled.multirate import Timing

GAINS = (-2.1 * np.eye(2), 0.6 * np.eye(2), 2.0 * np.eye(2))
PAIR = FormationModel((-1, 0))
K = PAIR.overlapping_gain(*GAINS)
TIMING = Timing(0.02, 0.02)
RESPONSES = [Response(0.08, 1.67), Response(0.15, 2.0), Response(0.3, 0.5), Response(0.15, 0.0)]


def crossing_margin(response: Response) -> float:
    """The follower's margin, less than the leader's, on a frequency grid: least phase over frequency at gain 1."""
    omega = np.geomspace(0.05, 50.0, 2_000_001)
    s = 1j * omega
    lag, gain = response.lag_s, response.velocity_gain_1_s
    answer = (s + gain) / (lag * s**2 + s + gain)
    loop = answer * (2.1 * s + 2.0) / s**2
    beyond = np.flatnonzero(np.diff(np.sign(np.abs(loop) - 1.0)))
    phases = (np.angle(loop[beyond]) + math.pi) % (2.0 * math.pi)
    return float((phases / omega[beyond]).min())


@pytest.mark.parametrize("response", RESPONSES)
def test_continuous_margin_is_the_transfer_functions_least_phase_over_frequency(response: Response) -> None:
    assert continuous_margin(PAIR, K, [response] * 2) == pytest.approx(
        crossing_margin(response), rel=1e-5
    )  # the grid's cell: 3e-6


@pytest.mark.parametrize("response", RESPONSES)
def test_rightmost_root_crosses_the_axis_at_the_margin(response: Response) -> None:
    margin_s = continuous_margin(PAIR, K, [response] * 2)
    A, B, K_all = formation_loop(PAIR, K, [response] * 2)
    for factor, stable in ((0.99, True), (1.01, False)):
        root = rightmost_root([(A, 0.0), (B @ K_all, factor * margin_s)])
        assert (root.real < 0.0) == stable


def grows(response: Response, delay_s: float, period_s: float) -> bool:
    """Whether a follower's error grows in a step by step simulation with held commands that act late."""
    lag, g = response.lag_s, response.velocity_gain_1_s
    A = np.array([[0, -1, 0, 0], [0, 0, 1, 0], [0, 0, -1 / lag, g / lag], [0, 0, -1, 0]])  # e^p, e^v, a, d
    steps = 10
    h = period_s / steps
    generator = np.zeros((5, 5))
    generator[:4, :4], generator[:4, 4] = h * A, h * np.array([0.0, 0.0, 1 / lag, 1.0])
    Phi, G = (M := expm(generator))[:4, :4], M[:4, 4]
    late = round(delay_s / h)
    x = np.eye(4)[0]
    commands: list[float] = [0.0] * (late // steps + 2)
    size: list[float] = []
    for k in range(round(60.0 / h)):
        if k % steps == 0:
            commands.append(float(2.0 * x[0] - 2.1 * x[1]))
        sent = (k - late) // steps
        command = commands[late // steps + 2 + sent] if k >= late else 0.0
        x = Phi @ x + G * command
        size.append(abs(x[0]))
    half = len(size) // 2
    return max(size[half:]) > max(size[half // 2 : half])


@pytest.mark.parametrize("response", RESPONSES)
def test_a_simulated_follower_diverges_only_beyond_the_sampled_margin(response: Response) -> None:
    period_s = 0.02
    margin_s = sampled_margin(PAIR, K, [response] * 2, timing=Timing(period_s, period_s))
    assert not grows(response, 0.97 * margin_s, period_s)
    assert grows(response, 1.03 * margin_s, period_s)


def test_a_very_short_lag_leaves_the_margin_of_immediate_responses() -> None:
    at_once = delay_margin(*PAIR.ground_loop(*GAINS))
    assert continuous_margin(PAIR, K, [Response(1e-5, 0.0)] * 2) == pytest.approx(at_once, abs=2e-5)


def test_a_lag_costs_about_its_length() -> None:
    without = continuous_margin(PAIR, K, [Response(1e-5, 0.0)] * 2)
    assert without - continuous_margin(PAIR, K, [Response(0.02, 0.0)] * 2) == pytest.approx(0.02, rel=0.05)


def test_a_trees_margin_is_the_least_of_its_vehicles() -> None:
    tree = FormationModel((-1, 0, 1, 0, 3))
    of = [RESPONSES[0], *RESPONSES]
    each = [sampled_margin(PAIR, K, [response] * 2, timing=TIMING) for response in RESPONSES]
    together = sampled_margin(tree, tree.overlapping_gain(*GAINS), of, timing=TIMING)
    assert together == pytest.approx(min(each), rel=1e-9)


def test_coupled_vehicles_with_different_responses_have_a_common_margin() -> None:
    # the leader also feels the follower's spacing error, so that no vehicle's loop stands alone
    coupled = K.copy()
    coupled[PAIR.input_slice(0), PAIR.spacing_slice(1)] = -0.4 * np.eye(2)
    of = [Response(0.3, 1.0), Response(0.1, 2.0)]
    A, B, K_all = formation_loop(PAIR, coupled, of)
    margin_s = continuous_margin(PAIR, coupled, of)
    for factor, stable in ((0.99, True), (1.01, False)):
        assert (rightmost_root([(A, 0.0), (B @ K_all, factor * margin_s)]).real < 0.0) == stable


def test_a_response_for_each_vehicle_is_wanted() -> None:
    with pytest.raises(BadModelError, match="1 responses"):
        formation_loop(PAIR, K, [Response(0.1, 1.0)])


def test_a_gain_of_another_formation_is_refused() -> None:
    with pytest.raises(BadModelError, match=r"K has shape \(4, 6\); wanted \(6, 10\)"):
        formation_loop(FormationModel((-1, 0, 1)), K, [Response(0.1, 1.0)] * 3)


@pytest.mark.slow(first=4)
@pytest.mark.parametrize("response", RESPONSES[:2])
@pytest.mark.parametrize("timing", [Timing(0.02, 0.02), Timing(0.02, 0.1), Timing(0.05, 0.03)], ids=str)
def test_a_design_for_a_response_has_the_margin_asked_for(response: Response, timing: Timing) -> None:
    model, wanted = FormationModel((-1, 0)), Requirement(delay_margin_s=0.4, string_peak_max=1.0)
    found = design(model, requirement_with(wanted, response, timing=timing), period_s=timing.held_s)
    margin_s = sampled_margin(
        model, model.overlapping_gain(found.K1, found.K2, found.K3), [response] * 2, timing=timing
    )
    assert margin_s == pytest.approx(0.4, abs=1e-7)
    assert found.delay_margin_s > 0.4


def test_refusing_a_margin_that_no_gains_have_names_the_response() -> None:
    with pytest.raises(InfeasibleError, match=r"lag_s = 0\.15"):
        requirement_with(Requirement(delay_margin_s=29.9), Response(0.15, 2.0), timing=TIMING)


@pytest.mark.parametrize("delay_s", [0.0, 0.2])
@pytest.mark.parametrize("front_1_s", [0.6, 1.6])  # errors shrink, errors grow
def test_string_growth_tends_to_that_of_immediate_responses(front_1_s: float, delay_s: float) -> None:
    gains = (GAINS[0], front_1_s * np.eye(2), GAINS[2])
    at_once = string_peak(gains, delay_s)
    answer = Response(1e-6, 0.0).transfer
    assert string_peak(gains, delay_s, answer=answer) == pytest.approx(at_once, rel=1e-4)


def test_lag_makes_spacing_errors_grow_as_an_equal_delay_does() -> None:
    gains = (GAINS[0], 1.6 * np.eye(2), GAINS[2])  # more of the velocity in front: errors grow
    with_lag = string_peak(gains, 0.2, answer=Response(0.05, 0.0).transfer)
    assert with_lag == pytest.approx(string_peak(gains, 0.25), rel=0.02)
    assert with_lag > 1.05 * string_peak(gains, 0.2)


def test_a_constant_set_point_is_reached_by_any_response() -> None:
    for response in RESPONSES:
        assert response.transfer(np.zeros(1)).tolist() == [1.0]


@pytest.mark.parametrize(("lag_s", "gain"), [(0.0, 1.0), (math.nan, 1.0), (0.1, -1.0), (0.1, math.inf)])
def test_a_response_out_of_range_is_refused(lag_s: float, gain: float) -> None:
    with pytest.raises(BadModelError):
        Response(lag_s, gain)
