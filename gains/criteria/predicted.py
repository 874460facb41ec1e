"""The same figures as `LoopFigures` of a loop whose station predicts over an assumed loop delay.

With S as in `gains.performance.predicted`, noise n in the measurements and disturbances w of the errors lead to

    u = (I - K S)^{-1} K L (n + R w),   x = R w + R B g_tau u,   R = (s I - A)^{-1},   L = e^{A tau^},

of the whole formation. For disturbances a hold counts as half a period; noise is that of the sampled loop.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, pi
from typing import Self

import numpy as np
from numpy.typing import NDArray

from gains.core._bracketing import highest
from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.criteria.figures import LoopFigures
from gains.delay.rightmost import rightmost_root
from gains.formation.model import FormationModel
from gains.performance.flown import FlownTiming
from gains.performance.predicted import PredictedLoop
from gains.performance.response import Response, formation_loop
from gains.performance.scalar_gains import ScalarGains
from gains.sampled._loop import HeldPlant, carry, radius_of, rate_of, split_delay
from gains.sampled.multirate import Timing
from gains.sampled.prediction import mismatch_window, predicted_growth_rate

_FREQUENCIES, _LOWEST = 1600, 1e-3
# assumed delays, in periods, below which the continuous loop tells too little of the sampled one
_SHORT = 4.0
# of the integral of the noise over the unit circle, which converges like a power of the number
_ANGLES = 4096

Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class PredictedFigures:
    """What a formation of one axis is good for with a gain K, predicted over `assumed_s`.

    Figures at a delay are the worst at the true loop delays `delays_s`. `chain` has k1, k2 and k3 where errors run down
    a chain of equal followers. `thinned` is as of `LoopFigures`, and the window of a search that of the continuous
    loop, unless the delay is short. Figures without delay do not include the `responses`, for which nothing is thinned.

    The gains of `triangle5`, assumed and true delay 0.6 s:

    >>> pair = FormationModel((-1, 0), axes=1)
    >>> K = pair.overlapping_gain([[-3.408]], [[0.631]], [[5.608]])
    >>> found = PredictedFigures(pair, K, 0.02, 0.6, (0.6,))
    >>> round(found.alpha_at_delay, 3), round(found.spacing_gain_max_s2, 3), [round(s, 3) for s in found.window_s]
    (0.476, 0.999, [0.45, 0.757])
    """

    model: FormationModel
    K: FloatArray
    period_s: float
    assumed_s: float
    delays_s: tuple[float, ...]
    weight: tuple[float, float] | None = None
    chain: ScalarGains | None = None
    thinned: int = 1
    responses: tuple[Response, ...] | None = None

    @property
    def exact(self) -> Self:
        """The same figures, none of them rough."""
        return replace(self, thinned=1)

    @cached_property
    def at_once(self) -> LoopFigures:
        """Those without prediction, of which only what holds without any delay is read."""
        timing = FlownTiming(inf, self.period_s)
        return LoopFigures(self.model, self.K, timing, None, self.weight, thinned=self.thinned)

    @property
    def decay_rate_1_s(self) -> float:
        """Without delay; the same at every delay without mismatch."""
        return self.at_once.decay_rate_1_s

    @property
    def alpha(self) -> float:
        """Without delay; as the next three."""
        return self.at_once.alpha

    @property
    def damping_min(self) -> float:
        return self.at_once.damping_min

    @property
    def natural_frequency_max_rad_s(self) -> float:
        return self.at_once.natural_frequency_max_rad_s

    @property
    def delay_margin_s(self) -> float:
        """The longest true loop delay; 0 if the loop is unstable without mismatch."""
        return self.window_s[1] if self.window_s[1] > self.assumed_s else 0.0

    @cached_property
    def _loop(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A, B and K with the responses."""
        return formation_loop(self.model, self.K, self.responses)

    @property
    def _measured(self) -> list[bool]:
        """Errors; a response is computed from the commands."""
        return [k < self.model.states for k in range(len(self._loop[0]))]

    @cached_property
    def window_s(self) -> tuple[float, float]:
        """The least and the largest true loop delay (s), see `gains.sampled.prediction.mismatch_window`."""
        A, B, K = self._loop
        if self.thinned == 1 or self.assumed_s < _SHORT * self.period_s:
            return mismatch_window(
                A, B, K, Timing(self.period_s, self.period_s), assumed_s=self.assumed_s, measured=self._measured
            )
        half_s = self.period_s / 2.0
        least_s, most_s = _rough_window((A, B, K), self.assumed_s + half_s, _FREQUENCIES // self.thinned)
        return max(0.0, least_s - half_s), most_s - half_s

    def proved_spread_s(self, mean_s: float, rate: float) -> float:
        """How far a constant loop delay may be from a mean (s) on both sides; 0 if the mean is not in the window.

        Raises BadModelError for delays that vary: there is no proof for these.
        """
        if rate > 0.0:
            raise BadModelError(f"delay_rate is {rate}; 0 is wanted with prediction")
        least_s, most_s = self.window_s
        return max(0.0, min(mean_s if least_s == 0.0 else mean_s - least_s, most_s - mean_s))

    @cached_property
    def decay_rate_at_delay_1_s(self) -> float:
        """Of the slowest motion of the sampled loop, at the worst of the delays; in searches about that."""
        (A, B, K), half_s = self._loop, self.period_s / 2.0

        def decay(delay_s: float) -> float:
            if self.decay_rate_1_s <= 0.0:
                return self.decay_rate_1_s
            if delay_s == self.assumed_s and self.responses is None:  # the loop behind the delay is that without
                Phi, G = (maps[0] for maps in self._plant.transition(np.array([self.period_s])))
                return -rate_of(radius_of(Phi + G @ K), self.period_s)
            if self.thinned == 1:
                delays = {"assumed_s": self.assumed_s, "delay_s": delay_s}
                timing = Timing(self.period_s, self.period_s)
                return -predicted_growth_rate(A, B, K, timing, measured=self._measured, **delays)
            late = B @ K @ self._ahead
            terms = [(A + B @ K, 0.0), (late, delay_s + half_s), (-late, self.assumed_s + half_s)]
            return -rightmost_root(terms).real

        return min(map(decay, self.delays_s))

    @cached_property
    def alpha_at_delay(self) -> float:
        """The complex stability radius, as of `PredictedLoop.alpha`; 0 if the loop is unstable."""
        heavy, states = self.at_once.W, np.eye(self.model.states)
        return 1.0 / gain if (gain := self._peak(heavy, states)) < inf else 0.0

    @cached_property
    def spacing_gain_max_s2(self) -> float:
        """H-infinity gain from disturbing accelerations to spacing errors; `inf` if the loop is unstable."""
        rows = self.model.spacing_mask
        return self._peak(np.eye(self.model.states)[rows], self.model.B) if rows.any() else 0.0

    @cached_property
    def noise_gain_max(self) -> float:
        """Standard deviation of the noisiest command where every sampled error has white noise of 1."""
        if self.decay_rate_at_delay_1_s <= 0.0:
            return inf
        angles = np.linspace(0.0, pi, _ANGLES, endpoint=False) + pi / (2 * _ANGLES)
        return max(self._noise(angles, delay_s) for delay_s in self.delays_s)

    @cached_property
    def string_peak(self) -> float:
        """Largest growth of a commanded motion from vehicle to vehicle; 1 where errors run down no chain."""
        if self.chain is None:
            return 1.0
        if self.decay_rate_at_delay_1_s <= 0.0:
            return inf
        response = self.responses[0] if self.responses else None
        loop = PredictedLoop(self.chain, self.period_s, self.assumed_s, response)
        omega = np.geomspace(_LOWEST * self._slowest, pi / self.period_s, _FREQUENCIES)[:: self.thinned]
        return max(1.0, *(self._largest(lambda at, s=s: loop.growth(at, s), omega) for s in self.delays_s))

    def _largest(self, function: Callable[[FloatArray], FloatArray], omega: FloatArray) -> float:
        return highest(function, omega)[1] if self.thinned == 1 else float(function(omega).max())

    def _peak(self, out: FloatArray, entry: FloatArray) -> float:
        """Largest gain from disturbances that act by `entry` to what `out` reads of the errors."""
        if self.decay_rate_at_delay_1_s <= 0.0:
            return inf
        (A, B, K), L, half_s, more = self._loop, self._ahead, self.period_s / 2.0, len(self._measured) - out.shape[1]
        out, entry = np.pad(out, ((0, 0), (0, more))), np.pad(entry, ((0, more), (0, 0)))

        def gain_at(delay_s: float) -> Callable[[FloatArray], FloatArray]:
            def gain(omega: FloatArray) -> FloatArray:
                s = 1j * omega[:, np.newaxis, np.newaxis]
                R = np.linalg.inv(s * np.eye(len(A)) - A)
                late = np.exp(-s * (delay_s + half_s))
                seen = R @ B * np.exp(-s * half_s) + L @ R @ B * (late - np.exp(-s * (self.assumed_s + half_s)))
                commands = np.linalg.solve(np.eye(len(K)) - K @ seen, K @ L @ R @ entry)
                return np.linalg.norm(out @ (R @ entry + R @ B @ commands * late), ord=2, axis=(1, 2))

            return gain

        highest = 4.0 * float(np.linalg.norm(A, 2) + np.linalg.norm(B @ K, 2) + np.linalg.norm(B @ K @ L, 2))
        omega = np.geomspace(_LOWEST * self._slowest, highest, _FREQUENCIES)[:: self.thinned]
        return max(self._largest(gain_at(delay_s), omega) for delay_s in self.delays_s)

    def _noise(self, angles: FloatArray, delay_s: float) -> float:
        z = np.exp(1j * angles)[:, np.newaxis, np.newaxis]
        plant, K = self._plant, self._loop[2]
        Phi, G = (maps[0] for maps in plant.transition(np.array([self.period_s])))

        def entry(late_s: float) -> Complex:
            whole, rest_s = split_delay(late_s, self.period_s)
            newer = plant.transition(np.array([self.period_s - rest_s]))[1][0]
            return (newer * (z - 1.0) + G) * z ** (-whole - 1)

        R = np.linalg.inv(z * np.eye(len(Phi)) - Phi)
        seen = R @ G + self._ahead @ R @ (entry(delay_s) - entry(self.assumed_s))
        commands = np.linalg.solve(np.eye(len(K)) - K @ seen, np.broadcast_to(K @ self._ahead, (len(z), *K.shape)))
        return float((np.abs(commands) ** 2).sum(axis=2).mean(axis=0).max() ** 0.5)

    @cached_property
    def _ahead(self) -> FloatArray:
        """L."""
        return self._plant.carry(np.array([self.assumed_s]))[0]

    @cached_property
    def _plant(self) -> HeldPlant:
        return HeldPlant(*self._loop, self.period_s, np.array(self._measured))

    @cached_property
    def _slowest(self) -> float:
        return float(np.abs(np.linalg.eigvals(self.at_once.closed_loop)).min())


def _rough_window(
    loop: tuple[FloatArray, FloatArray, FloatArray], assumed_s: float, frequencies: int
) -> tuple[float, float]:
    """The window of the continuous loop, from crossings between frequencies on a grid.

    It is at its edge where e^{-s tau} = e^{-s tau^} + 1 / m, m an eigenvalue of K L (s I - A - B K)^{-1} B.
    """
    A, B, K = loop
    closed, onto = A + B @ K, K @ carry(A, None, np.array([assumed_s]))[0]
    highest = 4.0 * float(np.linalg.norm(onto @ B, 2)) + 2.0 * float(np.abs(np.linalg.eigvals(closed)).max())
    omega = highest * np.geomspace(1e-3, 1.0, frequencies)
    s = 1j * omega
    M = onto @ np.linalg.solve(s[:, np.newaxis, np.newaxis] * np.eye(len(A)) - closed, B.astype(np.complex128))
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.exp(-s * assumed_s)[:, np.newaxis] + 1.0 / np.linalg.eigvals(M)
    turn = np.take_along_axis(turn, np.argsort(np.abs(turn), axis=1), 1)
    spare = np.abs(turn) - 1.0
    at, rank = np.nonzero(spare[:-1] * spare[1:] < 0.0)
    part = spare[at, rank] / (spare[at, rank] - spare[at + 1, rank])
    crossing = omega[at] + part * (omega[at + 1] - omega[at])
    phase = np.angle(turn[at, rank]) + part * np.angle(turn[at + 1, rank] / turn[at, rank])
    around_s = 2.0 * pi / crossing
    longer_s = np.mod(-phase / crossing - assumed_s, around_s)
    longest_s = float(longer_s.min(initial=inf))
    return assumed_s + float((longer_s - around_s).max(initial=-assumed_s)), assumed_s + longest_s
