"""String stability and robustness of a predicted loop, and the feed-forward of the command in front.

The station predicts every vehicle over tau^ where the loop delay is tau (`gains.sampled.prediction`). It may also feed
a share k_ff of the command of the vehicle in front forward, which it has computed in the same tick::

    u_i = k_ff u_j + K1 e_i^v + K2 e_j^v + K3 e_i^p     for a follower i behind j

All commands together are u = (I - k_ff N)^{-1} K x^, N being one where i follows j: lower triangular, with the diagonal
blocks of K. Feed-forward therefore changes neither the roots nor the margin, but who acts on whom. With K2 = -K1 and
k_ff = 1 the vehicle in front and its follower do the same, and no spacing error arises from it at any delay.

A motion that its own command explains is known to the station before it happens. Between two samples it propagates as

    U_i / U_j = (k_ff + K_i S_j) / (1 - K_i S_i),

    S(z) = R(z) G + L R(z) (g_tau(z) - g_tau^(z)),   R(z) = (z I - Phi)^{-1},

in which g_tau = (G0 z + G1) z^{-q-1} is the entry of a held command that acts tau late, and L = e^{A tau^} of the
measured states (`HeldPlant.carry`): exact, and without mismatch free of the delay. Only a motion that no command
explains is seen late, by the first vehicle behind it.
"""

from dataclasses import dataclass
from functools import cached_property
from math import inf, pi

import numpy as np

from gains.core._bracketing import highest
from gains.core.arrays import FloatArray
from gains.formation.model import FormationModel
from gains.performance.response import Response, formation_loop
from gains.performance.scalar_gains import PAIR, ScalarGains
from gains.sampled._loop import HeldPlant, held_entry
from gains.sampled.multirate import Timing
from gains.sampled.prediction import mismatch_window, predicted_growth_rate

# frequencies of the first look at a response, and how far below the slowest motion they begin
_FREQUENCIES, _LOWEST = 1500, 1e-3


def fed_forward(model: FormationModel, K: FloatArray, share: float) -> FloatArray:
    """The gain (inputs, states) of u = K e with `share` of the command of the vehicle in front added to each command.

    A follower gets half the leader's command beside its own gains:

    >>> pair = FormationModel((-1, 0), axes=1)
    >>> fed_forward(pair, np.array([[-3.0, 0.0, 0.0], [1.0, 2.0, -3.0]]), 0.5).tolist()
    [[-3.0, 0.0, 0.0], [-0.5, 2.0, -3.0]]
    """
    whole = K.copy()
    for i in model.followers:  # those in front come first
        whole[model.input_slice(i)] += share * whole[model.input_slice(model.predecessors[i])]
    return whole


@dataclass(frozen=True)
class PredictedLoop:
    """One follower behind another, flown by a station that predicts both over `assumed_s`; without prediction it is 0.

    `gains` are k1, k2 and k3, which act on every axis alike; their alpha is not used. Commands are sampled and held for
    `period_s`. Vehicles answer at once if they have no `response`. `feed_forward` is k_ff.

    The gains of `triangle5`, with and without prediction over 0.25 s, at that loop delay:

    >>> gains = ScalarGains(k1=3.408, k2=0.631, k3=5.608, alpha=0.817)
    >>> loops = [PredictedLoop(gains, period_s=0.02, assumed_s=assumed_s) for assumed_s in (0.0, 0.25)]
    >>> [round(loop.string_peak(0.25), 2) for loop in loops], [round(loop.alpha(0.25), 2) for loop in loops]
    ([2.49, 1.0], [0.31, 0.66])
    """

    gains: ScalarGains
    period_s: float
    assumed_s: float
    response: Response | None = None
    feed_forward: float = 0.0

    @cached_property
    def window_s(self) -> tuple[float, float]:
        """The least and the largest stable true loop delay in s, see `gains.sampled.prediction.mismatch_window`."""
        A, B, K = self._matrices
        timing = Timing(self.period_s, self.period_s)
        return mismatch_window(A, B, K, timing, assumed_s=self.assumed_s, measured=self._measured)

    def string_peak(self, delay_s: float) -> float:
        """Largest ratio of a follower's commanded motion to that in front, over all frequencies that samples have.

        At least one; `inf` where the loop is unstable.
        """
        if not self.is_stable(delay_s):
            return inf
        frequencies = np.geomspace(_LOWEST * self._slowest, pi / self.period_s, _FREQUENCIES)
        return max(1.0, highest(lambda omega: self.growth(omega, delay_s), frequencies)[1])

    def growth(self, omega: FloatArray, delay_s: float) -> FloatArray:
        """|U_i / U_j| (k,) at frequencies omega (k,) in rad/s up to pi / `period_s`, if the loop is stable."""
        z = np.exp(1j * omega * self.period_s)[:, np.newaxis, np.newaxis]
        Phi, G = (maps[0] for maps in self._plant.transition(np.array([self.period_s])))
        mismatch = held_entry(self._plant, z, delay_s) - held_entry(self._plant, z, self.assumed_s)
        resolvent = np.linalg.inv(z * np.eye(len(Phi)) - Phi)
        S = resolvent @ G + self._ahead @ resolvent @ mismatch
        front, own = (self._matrices[2][1] @ S).T
        return np.abs((self.feed_forward + front) / (1.0 - own))

    def alpha(self, delay_s: float) -> float:
        """Disturbances |w| up to alpha |e| (1/s) are withstood at a true loop delay; 0 if the loop is unstable.

        The complex stability radius, as of `gains.performance.flown`: the hold counts as half a period.
        """
        if not self.is_stable(delay_s):
            return 0.0
        A, B, alone = self._matrices
        K, L, half_s = fed_forward(PAIR, alone, self.feed_forward), self._ahead, self.period_s / 2.0

        def gain(omega: FloatArray) -> FloatArray:
            s = (1j * omega[:, np.newaxis, np.newaxis]).astype(np.complex128)
            resolvent = np.linalg.inv(s * np.eye(len(A)) - A)
            answers, mismatch = resolvent @ B, np.exp(-s * delay_s) - np.exp(-s * self.assumed_s)
            # what the predicted state answers to commands
            seen = (answers + L @ answers * mismatch) * np.exp(-s * half_s)
            commands = np.linalg.solve(np.eye(2) - K @ seen, K @ L @ resolvent)
            disturbed = resolvent + resolvent @ (B * np.exp(-s * (delay_s + half_s))) @ commands
            return np.linalg.norm(disturbed[:, :3, :3], ord=2, axis=(1, 2))

        most = 4.0 * float(np.linalg.norm(A, 2) + np.linalg.norm(B @ alone, 2) + np.linalg.norm(B @ alone @ L, 2))
        return 1.0 / highest(gain, np.geomspace(_LOWEST * self._slowest, most, _FREQUENCIES))[1]

    def is_stable(self, delay_s: float) -> bool:
        """Whether the loop is stable at a true delay, in its window or in another interval of delays."""
        A, B, K = self._matrices
        timing = Timing(self.period_s, self.period_s)
        growth_1_s = predicted_growth_rate(
            A, B, K, timing, assumed_s=self.assumed_s, delay_s=delay_s, measured=self._measured
        )
        return growth_1_s < 0.0

    @cached_property
    def _matrices(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A, B and K of a vehicle and its follower, of one axis; K without feed-forward."""
        return formation_loop(PAIR, self.gains.K, None if self.response is None else (self.response, self.response))

    @cached_property
    def _plant(self) -> HeldPlant:
        return HeldPlant(*self._matrices, self.period_s, np.array(self._measured))

    @property
    def _measured(self) -> list[bool]:
        """Positions and velocities; a response is computed from the commands."""
        return [k < 3 for k in range(len(self._matrices[0]))]

    @cached_property
    def _ahead(self) -> FloatArray:
        """L = e^{A tau^}, of the measured states."""
        return self._plant.carry(np.array([self.assumed_s]))[0]

    @cached_property
    def _slowest(self) -> float:
        A, B, K = self._matrices
        return float(np.abs(np.linalg.eigvals(A + B @ K)).min())
