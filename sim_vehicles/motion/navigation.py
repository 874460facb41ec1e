"""The position and velocity that a vehicle reports: the true ones plus noise and a slowly varying bias."""

import math

import numpy as np

from scenarios.schema import NS_PER_S, Scenario
from sim_vehicles.links.truth import POSITION_ERROR, VELOCITY_ERROR, Recorder, disturbance_row
from sim_vehicles.services.draws import Use, draws_of

Pair = tuple[float, float]


class Navigator:
    """The errors of one vehicle's reports: white noise plus a bias b, a first-order Gauss-Markov process.

    b(t + h) = f b(t) + sqrt(1 - f^2) sigma w, f = exp(-h / bias_time_s), with w standard normal. Each report draws
    eight numbers, whichever are used.
    """

    def __init__(self, scenario: Scenario, system_id: int, recorder: Recorder | None) -> None:
        own = scenario.navigation
        assert own is not None
        self._draw = draws_of(scenario.seed, system_id, Use.NAVIGATION)
        self._noise = np.array([own.position_noise_m] * 2 + [own.velocity_noise_m_s] * 2)
        self._drift = np.array([own.position_bias_m] * 2 + [own.velocity_bias_m_s] * 2)
        self._time_s = own.bias_time_s
        self._bias = self._drift * self._draw.standard_normal(4)
        self._at_ns: int | None = None
        self._system_id, self._recorder = system_id, recorder

    def reported(self, position_m: Pair, velocity_m_s: Pair, time_ns: int, boot_ms: int) -> tuple[Pair, Pair]:
        """Position and velocity as reported at one time; calls must be in order of time."""
        drawn = self._draw.standard_normal((2, 4))
        since_s = 0.0 if self._at_ns is None else (time_ns - self._at_ns) / NS_PER_S
        fades = math.exp(-since_s / self._time_s)
        self._bias = fades * self._bias + math.sqrt(1.0 - fades * fades) * self._drift * drawn[0]
        self._at_ns = time_ns
        north_m, east_m, north_m_s, east_m_s = (self._bias + self._noise * drawn[1]).tolist()
        if self._recorder is not None:
            self._recorder.add(disturbance_row(POSITION_ERROR, self._system_id, boot_ms, time_ns, north_m, east_m))
            self._recorder.add(disturbance_row(VELOCITY_ERROR, self._system_id, boot_ms, time_ns, north_m_s, east_m_s))
        position = position_m[0] + north_m, position_m[1] + east_m
        return position, (velocity_m_s[0] + north_m_s, velocity_m_s[1] + east_m_s)
