"""Figures, as in `LoopFigures`, of a loop whose station predicts over an assumed delay; feed-forward of commands.

The station predicts every vehicle over tau^ while the loop delay is tau (`gains.sampled.prediction`). It may also feed
forward a share k_ff of the command of the vehicle in front, computed in the same tick::

    u_i = k_ff u_j + K1 e_i^v + K2 e_j^v + K3 e_i^p     for a follower i behind j

All commands together are u = (I - k_ff N)^{-1} K x^, with N = 1 where i follows j: lower triangular, with the diagonal
blocks of K. Feed-forward therefore changes neither the roots nor the margin, only the coupling between vehicles. With
K2 = -K1 and k_ff = 1 a follower repeats the motion in front exactly, and no spacing error arises at any delay.

The station knows a commanded motion before it happens. From vehicle to vehicle, such a motion propagates as

    U_i / U_j = (k_ff + K_i S_j) / (1 - K_i S_i),

    S(z) = R(z) G + L R(z) (g_tau(z) - g_tau^(z)),   R(z) = (z I - Phi)^{-1},

where g_tau = (G0 z + G1) z^{-q-1} is the effect of a held command that acts tau late, and L = e^{A tau^} on the
measured states (`HeldPlant.carry`). This is exact, and independent of the delay without mismatch. Only a motion that no
command explains is seen late, by the first vehicle behind it.

For the whole formation, noise n in the measurements and disturbances w of the errors give

    u = (I - K S)^{-1} K L (n + R w),   x = R w + R B g_tau u.

For disturbances the loop is continuous, R = (s I - A)^{-1}, and a hold counts as half a period; for noise it is the
sampled loop.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, pi
from typing import Self

import numpy as np

from gains.core._bracketing import Functions, highest
from gains.core.arrays import ComplexArray, FloatArray, spectral_norms
from gains.core.errors import BadModelError
from gains.criteria.figures import DelayFreeFigures
from gains.delay.rightmost import rightmost_root
from gains.formation.model import FormationModel
from gains.performance.response import Response, formation_loop
from gains.sampled._loop import HeldPlant, held_entry, radius_of, rate_of, settled_covariance
from gains.sampled.multirate import Predictor, Timing, multirate_map
from gains.sampled.prediction import mismatch_window, predicted_growth_rate

_FREQUENCIES, _LOWEST = 1600, 1e-3
# assumed delays, in periods, below which the continuous loop approximates the sampled one too poorly
_SHORT = 4.0
# angles in the integral of the noise over the unit circle, whose error decays geometrically in their number
_ANGLES = 4096
# if motions decay by less than e to this power in twice as many periods, the covariance is computed instead
_DECAYED = 25.0


def fed_forward(model: FormationModel, K: FloatArray, share: float) -> FloatArray:
    """The gain (inputs, states) of u = K e with `share` of the command of the vehicle in front added to each command.

    Here a follower adds half the leader's command to its own:

    >>> pair = FormationModel((-1, 0), axes=1)
    >>> fed_forward(pair, np.array([[-3.0, 0.0, 0.0], [1.0, 2.0, -3.0]]), 0.5).tolist()
    [[-3.0, 0.0, 0.0], [-0.5, 2.0, -3.0]]
    """
    whole = K.copy()
    for i in model.followers:  # those in front come first
        whole[model.input_slice(i)] += share * whole[model.input_slice(model.predecessors[i])]
    return whole


@dataclass(frozen=True, eq=False)
class PredictedFigures(DelayFreeFigures):
    """Figures of a formation of one axis with a gain K, predicted over `assumed_s`; 0 means without prediction.

    Figures at a delay are the worst over the true loop delays `delays_s`. Without a `response`, vehicles respond at
    once. `chain` states that the model is a vehicle and its follower in a chain of equal ones. `feed_forward` is k_ff,
    which is not part of K. `thinned` is as in `LoopFigures`; the window of a search is that of the continuous loop,
    unless the delay is short.

    The gains of `triangle5`, with an assumed and true delay of 0.6 s:

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
    chain: bool = False
    thinned: int = 1
    response: Response | None = None
    feed_forward: float = 0.0

    @property
    def exact(self) -> Self:
        return replace(self, thinned=1)

    @property
    def delay_margin_s(self) -> float:
        """The longest stable true loop delay; 0 if the loop is unstable without mismatch."""
        return self.window_s[1] if self.window_s[1] > self.assumed_s else 0.0

    @cached_property
    def window_s(self) -> tuple[float, float]:
        """The least and the largest stable true loop delay (s), see `gains.sampled.prediction.mismatch_window`."""
        if not self._is_rough:
            timing = Timing(self.period_s, self.period_s)
            return mismatch_window(*self._loop, timing, assumed_s=self.assumed_s, measured=self._measured)
        half_s = self.period_s / 2.0
        least_s, most_s = _rough_window(self._plant, self.assumed_s + half_s, _FREQUENCIES // self.thinned)
        return max(0.0, least_s - half_s), most_s - half_s

    def proved_spread_s(self, mean_s: float, rate: float) -> float:
        """How far (s) a constant loop delay may deviate from a mean on both sides; 0 if the mean is not in the window.

        Raises BadModelError for delays that vary, for which there is no proof.
        """
        if rate > 0.0:
            raise BadModelError(f"delay_rate is {rate}; 0 is wanted with prediction")
        least_s, most_s = self.window_s
        return max(0.0, min(mean_s if least_s == 0.0 else mean_s - least_s, most_s - mean_s))

    @cached_property
    def decay_rate_at_delay_1_s(self) -> float:
        """Decay rate of the slowest motion of the sampled loop at the worst delay; approximate in searches."""
        (A, B, K), half_s = self._loop, self.period_s / 2.0

        def decay(delay_s: float) -> float:
            if self.decay_rate_1_s <= 0.0:
                return self.decay_rate_1_s
            # the loop behind the delay is that without delay; errors of a computed response decay like the response
            if delay_s == self.assumed_s and (self.response is None or self.thinned > 1):
                Phi, G = (maps[0] for maps in self._plant.transition(np.array([self.period_s])))
                return -rate_of(radius_of(Phi + G @ K), self.period_s)
            if self.thinned == 1:
                loop, assumed_s = (A, B, K, Timing(self.period_s, self.period_s)), self.assumed_s
                return -predicted_growth_rate(*loop, assumed_s=assumed_s, delay_s=delay_s, measured=self._measured)
            late = B @ K @ self._ahead
            terms = [(A + B @ K, 0.0), (late, delay_s + half_s), (-late, self.assumed_s + half_s)]
            return -rightmost_root(terms).real

        return min(map(decay, self.delays_s))

    @property
    def is_stable_at_delay(self) -> bool:
        """Whether the loop is stable at every true delay; in searches also by the window."""
        shared = self._is_rough and self.decay_rate_1_s > 0.0 and self.delays_s != (self.assumed_s,)
        least_s, most_s = self.window_s if shared else (inf, 0.0)
        return least_s < min(self.delays_s) <= max(self.delays_s) < most_s or self.decay_rate_at_delay_1_s > 0.0

    @property
    def _is_rough(self) -> bool:
        """Whether the window is that of the continuous loop."""
        return self.thinned > 1 and self.assumed_s >= _SHORT * self.period_s

    @property
    def alpha_at_delay(self) -> float:
        """The complex stability radius, as in `gains.performance.flown`; 0 if the loop is unstable."""
        return self.alpha_at_delay_most if self.is_stable_at_delay else 0.0

    @cached_property
    def alpha_at_delay_most(self) -> float:
        """α at the delay, if the loop is stable."""
        return 1.0 / self._peak(self.W, np.eye(self.model.states))

    @cached_property
    def spacing_gain_max_s2(self) -> float:
        """H-infinity gain from disturbing accelerations to spacing errors; `inf` if the loop is unstable."""
        if not self.is_stable_at_delay:
            return inf
        rows = self.model.spacing_mask
        return self._peak(np.eye(self.model.states)[rows], self.model.B) if rows.any() else 0.0

    @cached_property
    def noise_gain_max(self) -> float:
        """Standard deviation of the noisiest command if every sampled error has unit white noise."""
        if self.decay_rate_at_delay_1_s <= 0.0:
            return inf
        # the error of the sum over angles is about what remains of noise after twice as many periods
        slow = 2 * _ANGLES * self.period_s * self.decay_rate_at_delay_1_s < _DECAYED
        if slow and self.assumed_s + min(self.delays_s) > 0.0:
            return max(self._settled_noise(delay_s) for delay_s in self.delays_s)
        angles = np.linspace(0.0, pi, _ANGLES, endpoint=False) + pi / (2 * _ANGLES)
        return max(self._noise(angles, delay_s) for delay_s in self.delays_s)

    @cached_property
    def string_peak(self) -> float:
        """Largest growth of a commanded motion from vehicle to vehicle; 1 if there is no chain."""
        if not self.chain:
            return 1.0
        if not self.is_stable_at_delay:
            return inf
        omega = np.geomspace(_LOWEST * self._slowest, pi / self.period_s, _FREQUENCIES)[:: self.thinned]
        return max(1.0, self._largest(lambda at: self.growth(at, *self.delays_s), omega))

    def growth(self, omega: FloatArray, *delays_s: float) -> FloatArray:
        """|U_i / U_j| (k,) of the follower of a stable loop at frequencies omega (k,), rad/s, up to pi / `period_s`.

        Each value is the largest over the true delays `delays_s`.
        """
        z = np.exp(1j * omega * self.period_s)[:, np.newaxis, np.newaxis]
        front, own = np.array(self._seen(self._loop[2][1:2], z, delays_s))[:, :, 0].T
        return np.abs((self.feed_forward + front) / (1.0 - own)).max(axis=1)

    def _seen(self, K: FloatArray, z: ComplexArray, delays_s: Sequence[float]) -> list[ComplexArray]:
        """K S of the module's docstring at each true delay, at points z (k, 1, 1)."""
        Phi, G = (maps[0] for maps in self._plant.transition(np.array([self.period_s])))
        both = np.vstack([K, K @ self._ahead]).T.astype(np.complex128)
        at_once, ahead = np.split(np.linalg.solve(z * np.eye(len(Phi)) - Phi.T, both).swapaxes(1, 2), 2, axis=1)
        assumed, answer = held_entry(self._plant, z, self.assumed_s), at_once @ G
        return [answer + ahead @ (held_entry(self._plant, z, delay_s) - assumed) for delay_s in delays_s]

    def _largest(self, function: Functions, omega: FloatArray) -> float:
        return highest(function, omega)[1] if self.thinned == 1 else float(function(omega).max())

    def _peak(self, out: FloatArray, entry: FloatArray) -> float:
        """Largest gain from disturbances that enter through `entry` to the outputs `out` of the errors."""
        (A, B, alone), L, half_s, r = self._loop, self._ahead, self.period_s / 2.0, self.model.inputs
        K, n = self._fed_forward, self.model.states
        enters = np.hstack([B, np.eye(len(A))[:, :n] @ entry]).astype(np.complex128)
        leaves = np.vstack([K, K @ L, out @ np.eye(len(A))[:n]])

        def gain(omega: FloatArray) -> FloatArray:
            s = 1j * omega[:, np.newaxis, np.newaxis]
            answers = leaves @ np.linalg.solve(s * np.eye(len(A)) - A, enters)
            seen, mismatch, driven = np.split(answers[:, :, :r], (r, 2 * r), axis=1)
            known, free = np.split(answers[:, r:, r:], (r,), axis=1)
            rest = np.eye(r) - seen * np.exp(-s * half_s) + mismatch * np.exp(-s * (self.assumed_s + half_s))
            most = np.zeros(omega.size)
            for delay_s in self.delays_s:
                late = np.exp(-s * (delay_s + half_s))
                commands = np.linalg.solve(rest - mismatch * late, known)
                most = np.maximum(most, spectral_norms(free + driven @ commands * late))
            return most

        most = 4.0 * float(np.linalg.norm(A, 2) + np.linalg.norm(B @ alone, 2) + np.linalg.norm(B @ alone @ L, 2))
        omega = np.geomspace(_LOWEST * self._slowest, most, _FREQUENCIES)[:: self.thinned]
        return self._largest(gain, omega)

    def _noise(self, angles: FloatArray, delay_s: float) -> float:
        z = np.exp(1j * angles)[:, np.newaxis, np.newaxis]
        K, measured = self._fed_forward, self._ahead[:, : self.model.states]
        known = np.broadcast_to(K @ measured, (len(z), len(K), self.model.states))
        commands = np.linalg.solve(np.eye(len(K)) - self._seen(K, z, [delay_s])[0], known)
        return float((np.abs(commands) ** 2).sum(axis=2).mean(axis=0).max() ** 0.5)

    def _settled_noise(self, delay_s: float) -> float:
        """`_noise` from the stationary covariance of the last commands, which are states of the one-period map."""
        n, reported = len(self._plant.A), self.model.states
        plant, timing = replace(self._plant, K=self._fed_forward), Timing(self.period_s, self.period_s)
        loop, calm = (
            multirate_map(own, timing, delay_s=delay_s, predictor=Predictor(own, self.assumed_s))
            for own in (plant, replace(plant, K=0.0 * plant.K))
        )
        entry = (loop - calm)[:, :reported]
        covariance = settled_covariance(loop, entry @ entry.T)
        if covariance is None:
            return inf
        return float(np.diag(covariance)[n : n + len(plant.K)].max() ** 0.5)

    @cached_property
    def _ahead(self) -> FloatArray:
        """L of the module's docstring."""
        return self._plant.carry(np.array([self.assumed_s]))[0]

    @cached_property
    def _plant(self) -> HeldPlant:
        return HeldPlant(*self._loop, self.period_s, np.array(self._measured))

    @cached_property
    def _loop(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A, B and K with the response; K without feed-forward."""
        answers = None if self.response is None else (self.response,) * self.model.vehicles
        return formation_loop(self.model, self.K, answers)

    @property
    def _fed_forward(self) -> FloatArray:
        return fed_forward(self.model, self._loop[2], self.feed_forward)

    @property
    def _measured(self) -> list[bool]:
        """Positions and velocities; a response is computed from the commands."""
        return [state < self.model.states for state in range(len(self._loop[0]))]

    @cached_property
    def _slowest(self) -> float:
        A, B, K = self._loop
        return float(np.abs(np.linalg.eigvals(A + B @ K)).min())


def _rough_window(plant: HeldPlant, assumed_s: float, frequencies: int) -> tuple[float, float]:
    """The mismatch window of the continuous loop, from crossings interpolated between frequencies on a grid.

    At its edges e^{-s tau} = e^{-s tau^} + 1 / m, with m an eigenvalue of K L (s I - A - B K)^{-1} B.
    """
    A, B, K = plant.A, plant.B, plant.K
    closed, onto = A + B @ K, K @ plant.carry(np.array([assumed_s]))[0]
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
