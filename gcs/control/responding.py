"""The motion that a vehicle with a response has from the set-points sent to it: prediction with an autopilot.

The acceleration a follows the commands u by a response (`gains.performance.response`), linear with constant
coefficients. In modes m it is

    m_k' = lambda_k m_k + beta_k u,   a = sum_k gamma_k m_k,   V' = a,   P' = V.

Telemetry holds position and velocity, not a: that is computed from the commands alone. What was wrong at the start
decays with the response.
"""

from bisect import bisect_right
from cmath import exp
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gains.formation.model import FormationModel
from gains.performance.response import Response, formation_loop
from gcs.control.prediction import KEPT_S
from scenarios.schema import NS_PER_S

_APART = 1e-3
"""Modes that coincide are parted by changing the lag by this share, below what identification resolves."""
_Motion = tuple[tuple[complex, ...], complex, complex]
"""Modes m (north + 1j * east), V and P."""


class _Mode(NamedTuple):
    decay_1_s: complex
    """lambda."""
    entry: complex
    """beta."""
    share: complex
    """gamma."""


class _Sent(NamedTuple):
    """A set-point, with the motion at the time it is due."""

    due_ns: int
    u: complex
    motion: _Motion


class RespondingHistory:
    """`gcs.control.prediction.CommandHistory` of a vehicle with a response."""

    def __init__(self, held_ns: int, response: Response) -> None:
        self._held_ns, self._modes = held_ns, _modes(response)
        self._sent = [_Sent(0, 0j, ((0j,) * len(self._modes), 0j, 0j))]
        self._due_ns = [0]

    def add(self, due_ns: int, acceleration_m_s2: tuple[float, float]) -> None:
        """Remember the set-point of a tick; ticks come in order."""
        self._sent.append(_Sent(due_ns, complex(*acceleration_m_s2), self._at(due_ns)))
        self._due_ns.append(due_ns)
        long_ago = bisect_right(self._due_ns, due_ns - round(KEPT_S * NS_PER_S)) - 1
        if 2 * long_ago > len(self._sent):
            del self._sent[:long_ago], self._due_ns[:long_ago]

    def sums(self, time_ns: int) -> tuple[complex, complex]:
        """V (m/s) and P (m) at a time."""
        _, velocity, position = self._at(time_ns)
        return velocity, position

    def _at(self, time_ns: int) -> _Motion:
        due_ns, u, motion = self._sent[max(0, bisect_right(self._due_ns, time_ns) - 1)]
        since_ns = max(0, time_ns - due_ns)
        motion = self._moved(motion, u, min(since_ns, self._held_ns) * 1e-9)
        beyond_ns = since_ns - self._held_ns
        return self._moved(motion, 0j, beyond_ns * 1e-9) if beyond_ns > 0 else motion

    def _moved(self, motion: _Motion, u: complex, t: float) -> _Motion:
        modes, velocity, position = motion
        position += velocity * t
        after: list[complex] = []
        for m, (decay, entry, share) in zip(modes, self._modes, strict=True):
            # m approaches `aim`; the integrals of m - aim and of that once more
            aim = -entry * u / decay
            grown = exp(decay * t)
            off = share * (m - aim)
            first = off * (grown - 1.0) / decay
            velocity += share * aim * t + first
            position += 0.5 * share * aim * t * t + (first - off * t) / decay
            after.append(aim + (m - aim) * grown)
        return tuple(after), velocity, position


def _modes(response: Response) -> list[_Mode]:
    A, B, _ = formation_loop(FormationModel((-1,), axes=1), np.array([[-1.0]]), [response])
    decay, shapes = np.linalg.eig(A[1:, 1:])  # the first state is the velocity
    if decay.size > 1 and float(np.abs(np.subtract.outer(decay, decay))[~np.eye(decay.size, dtype=bool)].min()) < (
        0.1 * _APART * float(np.abs(decay).max())
    ):
        return _modes(replace(response, lag_s=response.lag_s * (1.0 + _APART)))
    entries, shares = np.linalg.solve(shapes, B[1:, 0].astype(np.complex128)), A[0, 1:] @ shapes
    return [_Mode(*map(complex, mode)) for mode in zip(decay, entries, shares, strict=True)]
