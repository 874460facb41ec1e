"""Responses found from the manoeuvre against the ones that were simulated."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from gains.core.arrays import FloatArray
from gains.performance.response import Response
from gcs.autopilot.identify import LONGEST_S, MISFIT_MAX, PROFILE, identify, manoeuvre_m_s2, step_velocity

AMPLITUDE, DOWN_S = 1.5, 0.037
ACTED_S = np.array([at_s + DOWN_S for at_s, _ in PROFILE])
CHANGE = AMPLITUDE * np.array([size for _, size in PROFILE])


def velocity_of(response: Response, sample_s: FloatArray, *, limit_m_s2: float = math.inf) -> FloatArray:
    """Velocity of the vehicle in the manoeuvre by an ODE solver, its wanted acceleration limited if told so."""
    lag, gain = response.lag_s, response.velocity_gain_1_s

    def rates(t: float, x: FloatArray) -> list[float]:
        u = manoeuvre_m_s2(t - DOWN_S, AMPLITUDE)[0] if t >= DOWN_S else 0.0
        wanted = max(-limit_m_s2, min(limit_m_s2, u + gain * x[2]))
        return [x[1], (wanted - x[1]) / lag, u - x[1]]

    return solve_ivp(rates, (0.0, LONGEST_S), [0.0] * 3, t_eval=sample_s, max_step=2e-3, rtol=1e-9, atol=1e-10).y[0]


@given(lag_s=st.floats(0.03, 1.0), gain=st.floats(0.0, 5.0))
def test_step_velocity_is_that_of_the_differential_equation(lag_s: float, gain: float) -> None:
    t = np.array([0.05, 0.4, 1.3, 4.0])

    def rates(_: float, x: FloatArray) -> list[float]:
        return [x[1], (1.0 + gain * x[2] - x[1]) / lag_s, 1.0 - x[1]]

    expected = solve_ivp(rates, (0.0, 4.0), [0.0] * 3, t_eval=t, rtol=1e-9, atol=1e-11).y[0]
    assert step_velocity(Response(lag_s, gain), t) == pytest.approx(expected, abs=1e-6)
    assert step_velocity(Response(lag_s, gain), -t).tolist() == [0.0] * 4


def standard_errors(response: Response, sample_s: FloatArray, noise_m_s: float) -> list[float]:
    """Those that no unbiased estimate of lag and gain can fall below (Cramer and Rao)."""
    lag, gain = response.lag_s, response.velocity_gain_1_s
    slopes = [
        (velocity_of(Response(lag * 1.01, gain), sample_s) - velocity_of(response, sample_s)) / (0.01 * lag),
        (velocity_of(Response(lag, gain * 1.01), sample_s) - velocity_of(response, sample_s)) / (0.01 * gain),
    ]
    J = np.stack([slope - slope.mean() for slope in slopes], axis=1)
    return np.sqrt(np.diag(noise_m_s**2 * np.linalg.inv(J.T @ J))).tolist()


@pytest.mark.parametrize(
    "response", [Response(0.08, 1.67), Response(0.3, 2.0), Response(0.15, 4.0), Response(0.5, 0.3)]
)
def test_lag_and_gain_are_found_through_noise_and_drift(response: Response) -> None:
    sample_s = np.arange(0.003, LONGEST_S, 0.02)
    noise = np.random.default_rng(3).normal(0.0, 0.03, sample_s.size)
    found = identify(ACTED_S, CHANGE, sample_s, velocity_of(response, sample_s) + 0.2 + noise)
    assert found is not None
    lag_error_s, gain_error_1_s = standard_errors(response, sample_s, 0.03)
    assert abs(found.response.lag_s - response.lag_s) < 3.0 * lag_error_s < 0.03
    assert abs(found.response.velocity_gain_1_s - response.velocity_gain_1_s) < 3.0 * gain_error_1_s
    assert found.misfit < 0.06


def test_no_velocity_feedback_is_identified_as_next_to_none() -> None:
    sample_s = np.arange(0.0, LONGEST_S, 0.02)
    found = identify(ACTED_S, CHANGE, sample_s, velocity_of(Response(0.2, 0.0), sample_s))
    assert found is not None
    assert found.response.lag_s == pytest.approx(0.2, rel=0.05)
    assert found.response.velocity_gain_1_s < 0.06


def test_losses_leave_the_same_response() -> None:
    sample_s = np.sort(np.random.default_rng(5).choice(np.arange(0.0, LONGEST_S, 0.02), 120, replace=False))
    found = identify(ACTED_S, CHANGE, sample_s, velocity_of(Response(0.15, 2.0), sample_s))
    assert found is not None
    assert found.response.lag_s == pytest.approx(0.15, rel=1e-3)


def test_one_that_does_not_follow_is_no_response() -> None:
    sample_s = np.arange(0.0, LONGEST_S, 0.02)
    cut = velocity_of(Response(0.15, 0.1), sample_s, limit_m_s2=0.3)
    found = identify(ACTED_S, CHANGE, sample_s, cut)
    assert found is not None
    assert found.misfit > MISFIT_MAX


@settings(max_examples=30)
@given(st.lists(st.floats(-50.0, 50.0), min_size=0, max_size=120))
def test_whatever_is_reported_is_a_fit_or_none(velocity: list[float]) -> None:
    sample_s = np.linspace(0.0, LONGEST_S, len(velocity))
    found = identify(ACTED_S, CHANGE, sample_s, np.array(velocity))
    assert found is None or (math.isfinite(found.misfit) and found.response.lag_s > 0.0)


def test_the_manoeuvre_ends_where_it_began_and_at_rest() -> None:
    t = np.arange(0.0, LONGEST_S, 1e-3)
    velocity = np.cumsum([manoeuvre_m_s2(s, AMPLITUDE)[0] for s in t.tolist()]) * 1e-3
    assert velocity[-1] == pytest.approx(0.0, abs=0.01)
    assert float(velocity.sum()) * 1e-3 == pytest.approx(0.0, abs=0.01)
