"""Identifies a vehicle's response to set-points from a short manoeuvre before the formation flight.

All vehicles are commanded the same acceleration at the same time, so they keep their distances: two periods of a sine
of 2.1 rad/s, near the frequency at which loops with such vehicles become unstable, plus its third harmonic. The vehicle
ends with its initial velocity, displaced by some metres. The jerk stays well below the autopilots' limit: a square wave
would measure that limit instead of the response. A sine reversed half-way would have no energy at its own frequency.

The manoeuvre is flown at the formation's velocity, because air resistance matters. At 1.9 rad/s, an ArduCopter in SITL
responds with a gain of 1.09 at rest; at 4 m/s the gain is 0.98 along track and 1.02 across track. Five of them became
unstable at 506 ms of loop delay at rest, and at about 565 ms at 4 m/s. The margin across track is the smaller one.

The models of `gains.performance.response` are fitted to the velocity that a vehicle reports; the Bayesian information
criterion selects one. A command is taken to act at its send time plus the measured delay down, and samples are timed by
the vehicle's clock. So the identified response does not include the link delay.
"""

from collections.abc import Generator, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import hypot, inf, pi, sin, sqrt

import numpy as np
from scipy.linalg import expm

from gains.core.arrays import ComplexArray, FloatArray
from gains.performance.response import Response, own_dynamics

LONGEST_S = 6.0
_OMEGA_RAD_S, _HARMONIC, _SHARE = 2.0 * pi / 3.0, 3, 0.15
"""The sine, and a harmonic with this fraction of its amplitude, which distinguishes the models."""
_JERK_M_S3 = 2.5
_RUN_UP_M_S2, _SETTLED_S, _SLIGHT_M_S = 1.5, 3.0, 0.2
"""Maximum acceleration of a run-up, settling time after it, and the change of velocity below which none is flown."""
MISFIT_MAX = 0.1
"""A fit that leaves more than this fraction of the velocity unexplained is refused."""
LEAST_RATE_HZ = 10.0
_FEWEST_SAMPLES = 42
"""At 10 Hz the manoeuvre gives sixty samples, some of which may be lost."""
LAG_S_LEAST = 0.01
"""The shortest lag that is fitted: a vehicle whose fit ends here may respond at once."""
_BOUNDS = np.log([(LAG_S_LEAST, 3.0), (0.001, 10.0), (0.002, 0.5), (0.5, 200.0)])
"""Bounds of lag, velocity gain, dead time and natural frequency, as logarithms."""
_USED = {"lag": [0, 1], "lag with dead time": [0, 1, 2], "second order": [0, 1, 3]}
_GAIN = 1
"""Index of the velocity gain in `_BOUNDS`."""
_STEPS, _NUDGE, _STEPS_A_TICK = 24, 1e-4, 2
RESOLUTION = 1e-3
"""Misfits that differ by less than this fraction of the velocity do not distinguish models."""


@dataclass(frozen=True)
class Identified:
    """The response of one vehicle; `misfit` is the fraction of the velocity (rms) that it leaves unexplained."""

    response: Response
    misfit: float
    samples: int
    misfits: Mapping[str, float]
    """The misfit of every model, by name."""


def amplitude_m_s2(acceleration_max_m_s2: float | None) -> float:
    """Amplitude of the manoeuvre's sine, at most half of the limit because the velocity loop adds to it."""
    return min(_JERK_M_S3 / (_OMEGA_RAD_S * (1.0 + _HARMONIC * _SHARE)), 0.5 * (acceleration_max_m_s2 or inf))


def manoeuvre_m_s2(since_s: float, amplitude: float) -> float:
    """The commanded acceleration `since_s` after the manoeuvre began."""
    if not 0.0 <= since_s < LONGEST_S:
        return 0.0
    angle = _OMEGA_RAD_S * since_s
    return amplitude * (sin(angle) + _SHARE * sin(_HARMONIC * angle))


@dataclass(frozen=True)
class RunUp:
    """A half sine of acceleration that changes the velocity by `gain_ne_m_s`, followed by a settling time."""

    gain_ne_m_s: tuple[float, float]
    sine_s: float

    @property
    def duration_s(self) -> float:
        return self.sine_s + _SETTLED_S if self.sine_s else 0.0

    def acceleration_m_s2(self, since_s: float) -> tuple[float, float]:
        """North and east, `since_s` after it began."""
        if not 0.0 <= since_s < self.sine_s:
            return 0.0, 0.0
        share_1_s = pi / (2.0 * self.sine_s) * sin(pi * since_s / self.sine_s)
        north, east = self.gain_ne_m_s
        return north * share_1_s, east * share_1_s


def run_up(gain_ne_m_s: tuple[float, float], acceleration_max_m_s2: float | None) -> RunUp:
    """The run-up, within half of the acceleration limit; an empty one for a slight change of velocity."""
    gain_m_s = hypot(*gain_ne_m_s)
    if gain_m_s < _SLIGHT_M_S:
        return RunUp((0.0, 0.0), 0.0)
    most_m_s2 = min(_RUN_UP_M_S2, 0.5 * (acceleration_max_m_s2 or inf))
    return RunUp(gain_ne_m_s, max(pi * gain_m_s / (2.0 * most_m_s2), pi * sqrt(gain_m_s / (2.0 * _JERK_M_S3))))


@dataclass(frozen=True)
class Flown:
    """A vehicle's commands in the manoeuvre, and the velocities it reported."""

    period_s: float
    command_m_s2: FloatArray
    """Acceleration (m,), constant from one control tick to the next."""
    sample_s: FloatArray
    """Instants (n,) of the samples, relative to when the first command acted, from 0 to m periods."""
    velocity_m_s: FloatArray
    """In the direction of the manoeuvre. Its mean, such as a drift, is ignored."""
    velocity_commanded: bool = True
    """Whether set-points carry a velocity as well as an acceleration. If not, the velocity gain is 0."""

    @property
    def has_too_few_samples(self) -> bool:
        return self.sample_s.size < _FEWEST_SAMPLES or self.command_m_s2.size < 2

    @cached_property
    def _spectrum(self) -> tuple[int, ComplexArray]:
        """The size of a transform in which the commands do not wrap around, and theirs."""
        size = 1 << (2 * self.command_m_s2.size).bit_length()
        return size, np.fft.rfft(self.command_m_s2, size)

    def velocities(self, responses: list[Response]) -> FloatArray:
        """The modelled velocity at each sample, for each of k responses of one model, shape (k, n).

        At the ticks, acceleration and velocity are the commands convolved with the response to a one-tick command;
        between ticks the velocity is a cubic. Repeatedly squaring the one-tick matrix gives that response at all ticks.
        """
        m, h = self.command_m_s2.size, self.period_s
        dynamics = [own_dynamics(response) for response in responses]
        n = len(dynamics[0][0])
        whole = np.zeros((len(responses), n + 2, n + 2))
        for k, (A, B) in enumerate(dynamics):
            whole[k, :n, :n], whole[k, :n, n + 1 :], whole[k, n, 0] = A, B, 1.0
        whole = np.asarray(expm(whole * h), dtype=np.float64)
        power: FloatArray = whole[:, : n + 1, : n + 1]
        answers: FloatArray = whole[:, : n + 1, n + 1 :]
        while answers.shape[2] < m:
            answers = np.concatenate([answers, power @ answers], axis=2)
            power = power @ power
        answers = answers[:, [0, n], :m]
        size, commanded = self._spectrum
        spectrum = np.fft.rfft(answers, size) * commanded
        at_ticks = np.zeros((len(responses), 2, m + 1))
        at_ticks[:, :, 1:] = np.fft.irfft(spectrum, size)[:, :, :m]
        index = np.minimum((self.sample_s / h).astype(np.int64), m - 1)
        s: FloatArray = self.sample_s / h - index
        (a0, v0), (a1, v1) = (at_ticks[:, :, index + k].swapaxes(0, 1) for k in (0, 1))
        return (
            v0 * (1.0 + 2.0 * s) * (1.0 - s) ** 2
            + v1 * s**2 * (3.0 - 2.0 * s)
            + h * s * (1.0 - s) * (a0 * (1.0 - s) - a1 * s)
        )


def identify(flown: Flown) -> Generator[None, None, Identified | None]:
    """The least-squares fit of the selected model, computed in steps of a few milliseconds.

    None if there are too few samples, or no motion.
    """
    if flown.has_too_few_samples:
        return None
    size = float(np.sqrt(np.square(flown.velocity_m_s - flown.velocity_m_s.mean()).mean()))
    if not size > 0.0:
        return None
    grid = [(lag, gain) for lag in (0.06, 0.15, 0.45) for gain in (0.3, 1.5, 4.0)]
    misfits = _misfit(flown, "lag", np.log([[lag, gain, 1.0, 1.0] for lag, gain in grid]))
    first = np.log([*grid[int(np.square(misfits).sum(axis=1).argmin())], 0.03, 15.0])
    yield
    found: dict[str, tuple[FloatArray, FloatArray]] = {}
    for name in _USED:
        found[name] = yield from _descent(flown, name, first)
        if name == "lag":
            lag, gain, _, _ = np.exp(found[name][0]).tolist()
            first = np.clip(np.log([0.6 * lag, gain, 0.4 * lag, 1.6 / lag]), *_BOUNDS.T)
    rms = {name: float(np.sqrt(np.square(rest).mean())) / size for name, (_, rest) in found.items()}
    name = _chosen(rms, found[min(rms, key=rms.__getitem__)][1])
    return Identified(_response(flown, name, found[name][0]), rms[name], flown.sample_s.size, rms)


def _chosen(rms: Mapping[str, float], residuals: FloatArray) -> str:
    """The model with the smallest information criterion; correlated residuals count as fewer samples."""
    n = residuals.size
    alike = float(residuals[1:] @ residuals[:-1]) / max(float(residuals @ residuals), 1e-300)
    count = max(10.0, n * (1.0 - alike) / (1.0 + alike)) if alike > 0.0 else float(n)

    def criterion(name: str) -> float:
        return count * float(np.log(rms[name] ** 2 + RESOLUTION**2)) + len(_USED[name]) * float(np.log(count))

    return min(rms, key=criterion)


def _response(flown: Flown, name: str, logs: FloatArray) -> Response:
    lag_s, gain, dead_time_s, natural = np.exp(logs).tolist()
    gain *= flown.velocity_commanded
    late_s = dead_time_s if name == "lag with dead time" else 0.0
    return Response(lag_s, gain, late_s, natural if name == "second order" else None)


def _misfit(flown: Flown, name: str, logs: FloatArray) -> FloatArray:
    """Modelled minus measured velocity, both without their means, for each row of parameters."""
    velocity = flown.velocities([_response(flown, name, row) for row in logs]) - flown.velocity_m_s
    return velocity - velocity.mean(axis=1, keepdims=True)


def _descent(flown: Flown, name: str, start: FloatArray) -> Generator[None, None, tuple[FloatArray, FloatArray]]:
    """Levenberg-Marquardt fit of a model, a few steps at a time; returns parameters and residuals."""
    used = [i for i in _USED[name] if i != _GAIN or flown.velocity_commanded]
    x, damping = start.copy(), 1e-3
    nudges = _NUDGE * np.eye(x.size)[used]
    rest = np.empty(0)
    for step_number in range(_STEPS):
        rests = _misfit(flown, name, x + np.vstack([np.zeros(x.size), nudges]))
        rest, slope = rests[0], (rests[1:] - rests[0]).T / _NUDGE
        if step_number % _STEPS_A_TICK == _STEPS_A_TICK - 1:
            yield
        normal, moved = slope.T @ slope, 0.0
        for _ in range(8):
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), -slope.T @ rest)
            new = x.copy()
            new[used] = np.clip(x[used] + np.clip(step, -0.5, 0.5), *_BOUNDS[used].T)
            after = _misfit(flown, name, new[np.newaxis])[0]
            if after @ after < rest @ rest:
                moved = float(np.abs(new - x).max())
                x, rest, damping = new, after, damping / 10.0
                break
            damping *= 10.0
        if moved < 1e-5:
            break
    return x, rest
