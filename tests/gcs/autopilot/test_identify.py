"""Responses found from the manoeuvre against the ones that were simulated."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gains.performance.response import Response
from gcs.autopilot.identify import (
    LONGEST_S,
    MISFIT_MAX,
    Flown,
    Identified,
    amplitude_m_s2,
    identify,
    manoeuvre_m_s2,
    run_up,
)
from gcs.plan.flight_plan import at_once
from scenarios.schema import Autopilot
from sim_vehicles.motion.copter import Motion, Target, advance
from sim_vehicles.motion.lagged import inner_of

PERIOD_S, FIRST_S, COMMANDS = 0.02, 0.003, round(LONGEST_S / 0.02)
MODELS = [
    Response(0.15, 2.0),
    Response(0.4, 0.3),
    Response(0.066, 1.88, 0.048),
    Response(0.11, 1.71, 0.0, 14.0),
]


def flown(response: Response, rate_hz: float, *, noise_m_s: float = 0.0, square: bool = False, **limits: Any) -> Flown:
    """The manoeuvre of a simulated copter, which shares no code with the identification."""
    autopilot = Autopilot(
        lag_s=response.lag_s,
        velocity_gain_1_s=response.velocity_gain_1_s,
        dead_time_s=response.dead_time_s,
        natural_frequency_rad_s=response.natural_frequency_rad_s,
        **limits,
    )
    motion, velocity, sample_s = Motion(0j, inner=inner_of(autopilot)), 0j, np.arange(FIRST_S, 6.0, 1 / rate_hz)
    commands, velocities = list[float](), list[float]()
    for k in range(COMMANDS):
        at_s = k * PERIOD_S
        commands.append(math.copysign(2.0, math.sin(2 * at_s)) if square else manoeuvre_m_s2(at_s, amplitude_m_s2(3.0)))
        target = Target(complex(commands[-1]), velocity, autopilot.velocity_gain_1_s, growth=1.0)
        for sample in sample_s[(sample_s >= at_s) & (sample_s < at_s + PERIOD_S)].tolist():
            velocities.append(advance(motion, target, autopilot, sample - at_s)[0].velocity_m_s.real)
        motion, target = advance(motion, target, autopilot, PERIOD_S)
        velocity = target.velocity_m_s
    noise = np.random.default_rng(3).normal(0.0, noise_m_s, sample_s.size)
    return Flown(PERIOD_S, np.array(commands), sample_s, np.array(velocities) + 0.2 + noise)


def found(seen: Flown) -> Identified | None:
    return at_once(identify(seen))


@pytest.mark.parametrize("response", MODELS)
@pytest.mark.parametrize("rate_hz", [50.0, 10.0])
def test_model_and_response_are_found_from_10_hz_on(response: Response, rate_hz: float) -> None:
    seen = found(flown(response, rate_hz))
    assert seen is not None
    assert seen.response.model == response.model
    assert seen.response.lag_s == pytest.approx(response.lag_s, rel=0.01)
    assert seen.response.velocity_gain_1_s == pytest.approx(response.velocity_gain_1_s, rel=0.01)
    assert seen.response.dead_time_s == pytest.approx(response.dead_time_s, abs=5e-4)
    assert seen.misfit < 1e-3


@pytest.mark.parametrize("response", MODELS)
def test_noise_of_a_centimetre_a_second_chooses_no_richer_model(response: Response) -> None:
    noisy = flown(response, 50.0, noise_m_s=0.01)
    seen = found(noisy)
    assert seen is not None
    assert (seen.response.model == "lag") == (response.model == "lag")
    # the total delay of commands at the crossover is found better than its split into lag and dead time
    late_s, known_s = (r.lag_s + r.dead_time_s for r in (seen.response, response))
    assert late_s == pytest.approx(known_s, rel=0.05)
    assert seen.misfit == pytest.approx(0.01 / noisy.velocity_m_s.std(), rel=0.1)  # the noise, and nothing else


def test_no_velocity_feedback_is_identified_as_next_to_none() -> None:
    seen = found(flown(Response(0.2, 0.0001), 50.0))
    assert seen is not None
    assert seen.response.lag_s == pytest.approx(0.2, rel=0.05)
    assert seen.response.velocity_gain_1_s < 0.06


def test_losses_leave_the_same_response() -> None:
    whole = flown(MODELS[2], 50.0)
    kept = np.sort(np.random.default_rng(5).choice(whole.sample_s.size, 60, replace=False))
    seen = found(Flown(PERIOD_S, whole.command_m_s2, whole.sample_s[kept], whole.velocity_m_s[kept]))
    assert seen is not None
    assert seen.response.dead_time_s == pytest.approx(0.048, abs=1e-3)


def test_jerk_limit_of_5_bends_squares_but_not_the_manoeuvre() -> None:
    free, limited = found(flown(MODELS[2], 50.0)), found(flown(MODELS[2], 50.0, jerk_max_m_s3=5.0))
    assert free is not None
    assert limited is not None
    assert limited.response.lag_s == pytest.approx(free.response.lag_s, rel=0.02)
    square = found(flown(MODELS[2], 50.0, square=True, jerk_max_m_s3=5.0))
    assert square is not None
    assert square.misfit > 10.0 * limited.misfit


def test_a_vehicle_that_does_not_follow_shows_a_large_misfit() -> None:
    seen = found(flown(Response(0.15, 0.1), 50.0, acceleration_max_m_s2=0.2))
    assert seen is not None
    assert seen.misfit > MISFIT_MAX


@settings(max_examples=10, deadline=None)
@given(st.lists(st.floats(-50.0, 50.0), min_size=0, max_size=80))
def test_whatever_is_reported_is_a_fit_or_none(velocity: list[float]) -> None:
    seen = flown(MODELS[0], 1.0)
    sample_s = np.linspace(0.0, LONGEST_S, len(velocity))
    fit = found(Flown(PERIOD_S, seen.command_m_s2, sample_s, np.array(velocity)))
    assert fit is None or (math.isfinite(fit.misfit) and fit.response.lag_s > 0.0)


def test_manoeuvre_is_smooth_and_returns_to_its_first_velocity() -> None:
    amplitude = amplitude_m_s2(3.0)
    acceleration = np.array([manoeuvre_m_s2(s, amplitude) for s in np.arange(0.0, LONGEST_S, 1e-3).tolist()])
    velocity = np.cumsum(acceleration) * 1e-3
    assert velocity[-1] == pytest.approx(0.0, abs=0.01)
    assert 0.0 < float(velocity.sum()) * 1e-3 < 3.0  # metres to one side
    assert np.abs(np.diff(acceleration)).max() * 1e3 < 2.55  # half of the 5 m/s^3 of PSC_JERK_XY
    assert np.abs(acceleration).max() < 1.0
    assert amplitude_m_s2(0.5) == 0.25


def test_run_up_ends_at_the_wanted_velocity_within_half_limit() -> None:
    for limit_m_s2, most_m_s2 in ((3.0, 1.5), (1.0, 0.5), (None, 1.5)):
        ramp = run_up((3.0, -4.0), limit_m_s2)
        each = np.array([ramp.acceleration_m_s2(s) for s in np.arange(0.0, ramp.duration_s, 1e-3).tolist()])
        assert each.sum(axis=0) * 1e-3 == pytest.approx([3.0, -4.0], abs=1e-3)
        assert np.hypot(*each.T).max() == pytest.approx(most_m_s2, rel=1e-5)
        assert not each[-2500:].any()  # the velocity settles
    assert run_up((0.1, 0.1), 3.0).duration_s == 0.0
