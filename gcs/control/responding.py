"""For prediction: the motion of a vehicle that follows its set-points with a response, such as an autopilot's lag.

The acceleration a follows the commands u with a linear time-invariant response (`gains.performance.response`). In modal
coordinates m,

    m_k' = lambda_k m_k + beta_k u,   a = sum_k gamma_k m_k,   V' = a,   P' = V.

Telemetry holds position and velocity but not a, which is computed from the commands alone. Its initial error decays
with the response.
"""

from cmath import exp
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gains.formation.model import FormationModel
from gains.performance.response import Response, formation_loop
from gcs.control.prediction import LaglessMotion, Motion

_APART = 1e-3
"""Relative change of the lag that separates coincident modes; below the resolution of identification."""


class _Mode(NamedTuple):
    decay_1_s: complex
    """lambda."""
    entry: complex
    """beta."""
    share: complex
    """gamma."""
    owed: complex
    """The change of m per 1 m/s of owed velocity; 0 if the response has no such state."""


class Responding(LaglessMotion):
    """The motion (V, P and the modes m) of a vehicle with a response, for `gcs.control.prediction.CommandHistory`.

    The velocity in a set-point is the integral of all accelerations sent. A vehicle that holds an earlier set-point
    strays from this velocity. At the next set-point, the velocity that it *owes*, set-point minus own, jumps.
    """

    def __init__(self, response: Response) -> None:
        self._modes = _modes(response)
        self.rest: Motion = 0j, 0j, (0j,) * len(self._modes)

    def moved(self, motion: Motion, u: complex, duration_s: float) -> Motion:
        velocity, position, modes = motion
        t = duration_s
        position += velocity * t
        after: list[complex] = []
        for m, (decay, entry, share, _) in zip(modes, self._modes, strict=True):
            # m approaches `aim`; m - aim is integrated once for the velocity, twice for the position
            aim = -entry * u / decay
            grown = exp(decay * t)
            off = share * (m - aim)
            first = off * (grown - 1.0) / decay
            velocity += share * aim * t + first
            position += 0.5 * share * aim * t * t + (first - off * t) / decay
            after.append(aim + (m - aim) * grown)
        return velocity, position, tuple(after)

    def returned(self, motion: Motion, astray_m_s: complex) -> Motion:
        velocity, position, modes = motion
        return velocity, position, tuple(m - own.owed * astray_m_s for m, own in zip(modes, self._modes, strict=True))


def _modes(response: Response) -> list[_Mode]:
    A, B, _ = formation_loop(FormationModel((-1,), axes=1), np.array([[-1.0]]), [response])
    decay, shapes = np.linalg.eig(A[1:, 1:])  # the first state is the velocity
    if decay.size > 1 and float(np.abs(np.subtract.outer(decay, decay))[~np.eye(decay.size, dtype=bool)].min()) < (
        0.1 * _APART * float(np.abs(decay).max())
    ):
        return _modes(replace(response, lag_s=response.lag_s * (1.0 + _APART)))
    entries, shares = np.linalg.solve(shapes, B[1:, 0].astype(np.complex128)), A[0, 1:] @ shapes
    last = np.eye(decay.size)[-1] * (response.velocity_gain_1_s > 0.0)  # the last state is the velocity owed
    owed = np.linalg.solve(shapes, last.astype(np.complex128))
    return [_Mode(*map(complex, mode)) for mode in zip(decay, entries, shares, owed, strict=True)]
