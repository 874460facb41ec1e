"""The acceleration of a simulated multicopter against the transfer functions of its response models."""

import math

import numpy as np
import pytest

from gains.performance.response import Response
from scenarios.schema import Autopilot
from sim_vehicles.motion.copter import Motion, Target, advance
from sim_vehicles.motion.lagged import inner_of

MODELS = [
    Autopilot(lag_s=0.125, velocity_gain_1_s=2.78),
    Autopilot(lag_s=0.066, velocity_gain_1_s=1.88, dead_time_s=0.048),
    Autopilot(lag_s=0.11, velocity_gain_1_s=1.71, natural_frequency_rad_s=14.0),
]
STEP_S = 0.02


def flown(settings: Autopilot, amplitude_m_s2: float, omega: float) -> complex:
    """Complex gain of the acceleration for a sine that is sent every 20 ms together with its velocity."""
    motion, sums, count = Motion(0j, inner=inner_of(settings)), 0j, round(20 * math.tau / omega / STEP_S)
    velocity = 0j
    for k in range(2 * count):
        sent = amplitude_m_s2 * math.sin(omega * (k + 0.5) * STEP_S)
        target = Target(complex(sent), velocity, settings.velocity_gain_1_s, growth=1.0)
        before = motion.velocity_m_s
        motion, target = advance(motion, target, settings, STEP_S)
        velocity = target.velocity_m_s
        if k >= count:
            mean = (motion.velocity_m_s - before).real / STEP_S
            sums += mean * np.exp(-1j * omega * (k + 0.5) * STEP_S)
    return 2j * sums / count / amplitude_m_s2


@pytest.mark.parametrize("settings", MODELS)
@pytest.mark.parametrize("omega", [1.0, 2.0, 5.0])
def test_every_response_has_its_transfer_function(settings: Autopilot, omega: float) -> None:
    told = Response(
        settings.lag_s, settings.velocity_gain_1_s, settings.dead_time_s, settings.natural_frequency_rad_s
    ).transfer(np.array([omega]))[0]
    # means over 20 ms at both ends, and a remainder of a period in the sums
    assert abs(flown(settings, 0.5, omega) - told) < 0.01


def test_beyond_its_jerk_limit_the_response_lags_far_behind() -> None:
    limited = MODELS[1].model_copy(update={"jerk_max_m_s3": 5.0})
    within, beyond = flown(limited, 1.5, 2.0), flown(limited, 5.0, 2.0)
    assert abs(within - flown(MODELS[1], 1.5, 2.0)) < 0.02
    assert np.degrees(np.angle(beyond)) < np.degrees(np.angle(within)) - 30.0


def test_a_second_order_response_keeps_to_its_acceleration_limit() -> None:
    settings = MODELS[2].model_copy(update={"acceleration_max_m_s2": 2.5})
    motion, target = Motion(0j, inner=inner_of(settings)), Target(9.0 + 0j)
    motion, _ = advance(motion, target, settings, 3.0)
    assert motion.acceleration_m_s2.real == pytest.approx(2.5, abs=1e-3)
