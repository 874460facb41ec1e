"""Identifies a vehicle's response to set-points from a short manoeuvre before the formation flight.

All vehicles are commanded the same acceleration at the same time: forwards, backwards for twice as long, and forwards
again. So they keep their distances and end at their initial velocity. The model of `gains.performance.response` is
fitted to the velocity they report. A command acts at its sending time plus the measured delay down; the instant of a
sample comes from the vehicle's clock. So the response found does not include the link's delay.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gains.core.arrays import FloatArray
from gains.performance.response import Response

LONGEST_S = 6.0
PROFILE = ((0.0, 1.0), (1.0, -2.0), (3.0, 2.0), (4.0, -1.0))
"""(time in s, change of the acceleration relative to its amplitude)"""
_LARGEST_M_S2 = 2.0
MISFIT_MAX = 0.1
"""A fit that leaves more than this fraction of the velocity unexplained is refused."""
_FEWEST_SAMPLES = 30
_LAGS_S = np.geomspace(0.02, 1.5, 12)
_GAINS_1_S = np.geomspace(0.05, 8.0, 12)
_STEPS = 30
_NUDGE = 1e-4


@dataclass(frozen=True)
class Identified:
    """The response of one vehicle; `misfit` is the fraction of the velocity (rms) that it leaves unexplained."""

    response: Response
    misfit: float
    samples: int


def amplitude_m_s2(limit_m_s2: float | None) -> float:
    """Amplitude of the manoeuvre's acceleration: half the limit, as the velocity loop adds to it."""
    return min(_LARGEST_M_S2, 0.5 * limit_m_s2) if limit_m_s2 is not None else _LARGEST_M_S2


def manoeuvre_m_s2(since_s: float, amplitude: float) -> tuple[float, float]:
    """The commanded acceleration north and east, `since_s` after the manoeuvre began."""
    north = sum(change for at_s, change in PROFILE if at_s <= since_s) * amplitude
    return (north, 0.0) if since_s < PROFILE[-1][0] else (0.0, 0.0)


def step_velocity(response: Response, since_s: FloatArray) -> FloatArray:
    """Velocity `since_s` after the commanded acceleration stepped to 1 m/s²; 0 before.

    v(s) = (s + g) / (s² (lag s² + s + g)), v(t) = t - e^{-σt} sin(ωt) / ω with σ = 1 / (2 lag), ω² = g / lag - σ²; ω is
    imaginary for a vehicle that does not overshoot.
    """
    t = np.maximum(since_s, 0.0)
    decay = 0.5 / response.lag_s
    omega = np.sqrt(complex(response.velocity_gain_1_s / response.lag_s - decay**2))
    if abs(omega) < 1e-9 * decay:
        return t - t * np.exp(-decay * t)
    # e^{-σt} sin(ωt) as two exponentials, so that neither factor overflows
    rising, falling = np.exp((1j * omega - decay) * t), np.exp((-1j * omega - decay) * t)
    return t - ((rising - falling) / (2j * omega)).real


def identify(
    acted_s: FloatArray, change_m_s2: FloatArray, sample_s: FloatArray, velocity_m_s: FloatArray
) -> Identified | None:
    """The least-squares fit of a response to sampled velocities; None if there are too few.

    `acted_s` and `change_m_s2` (m,) say when the commanded acceleration changed at the vehicle, and by how much.
    `velocity_m_s` (n,) is in the direction of the manoeuvre. Its mean, such as a drift, is ignored.
    """
    if sample_s.size < _FEWEST_SAMPLES or acted_s.size < len(PROFILE):
        return None
    measured = velocity_m_s - velocity_m_s.mean()
    size = float(np.sqrt((measured**2).mean()))
    if size == 0.0:
        return None
    since_s = sample_s[:, np.newaxis] - acted_s

    def misfit(logs: Sequence[float] | FloatArray) -> FloatArray:
        lag_s, gain = np.exp(logs).tolist()
        velocity = step_velocity(Response(lag_s, gain), since_s) @ change_m_s2
        return velocity - velocity.mean() - measured

    starts = [(float(np.log(lag)), float(np.log(gain))) for lag in _LAGS_S for gain in _GAINS_1_S]
    x = np.array(min(starts, key=lambda logs: float((misfit(logs) ** 2).sum())))
    x = _descended(misfit, x)
    lag_s, gain = np.exp(x).tolist()
    return Identified(Response(lag_s, gain), float(np.sqrt((misfit(x) ** 2).mean())) / size, sample_s.size)


def _descended(misfit: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    """Levenberg-Marquardt descent from a nearby start."""
    rest, damping = misfit(x), 1e-3
    for _ in range(_STEPS):
        slope = np.stack([(misfit(x + _NUDGE * axis) - rest) / _NUDGE for axis in np.eye(x.size)], axis=1)
        normal = slope.T @ slope
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), -slope.T @ rest)
        step = np.clip(step, -0.5, 0.5)
        after = misfit(x + step)
        if after @ after < rest @ rest:
            x, rest, damping = x + step, after, damping / 10.0
            if np.abs(step).max() < 1e-9:
                break
        else:
            damping *= 10.0
    return np.clip(x, np.log(1e-3), np.log(20.0))
