"""Where one block of a predicted loop loses stability as the true delay leaves the assumed one: both crossings.

One command in every period T, sampled and held as in `gains.sampled.constant`, true delay tau, assumed delay tau^. With
P_tau(z) = (z I - Phi)^{-1} (G0 z + G1) z^{-q-1}, the response of the sampled state to a command that acts tau late, the
sum of the commands in the predictor telescopes, and the loop has the eigenvalue z exactly if

    det(I - K (z I - Phi)^{-1} G - K e^{A tau^} (P_tau(z) - P_tau^(z))) = 0,   G = int_0^T e^{A s} ds B,

with `HeldPlant.carry` in place of e^{A tau^} if some states are not measured.

Without mismatch this is det(z I - Phi - G K) = 0: the loop without delay. As in `_crossings`, at a given fraction m of
a period the moduli of the loci do not depend on the whole periods of tau. That gives the angle of each crossing, and
Newton's method its delay. The crossings nearest to tau^ on either side end the window.
"""

from math import inf, pi

import numpy as np

from gains.core._bracketing import bracketed_roots, may_reach_zero
from gains.core.arrays import ComplexArray, FloatArray
from gains.delay._loci import log_moduli
from gains.sampled._loop import HeldPlant, held_entry, split_delay

# fractions of a period at which the angles are computed: they hardly depend on them
_FRACTIONS = 4
# rad by which e^{-j phi tau^ / T} turns between neighbouring angles; angles a decade; and decades below pi
_TURN, _POINTS_PER_DECADE, _DECADES = 0.2, 40, 6
# delays in a period at which the determinant is computed at z = -1, and starting points to either side elsewhere
_AT_MINUS_ONE, _NEAREST = 16, 60
# steps of Newton's method, the shortest one, in periods, and the determinant of a solution
_STEPS, _STILL, _SOLVED = 12, 1e-12, 1e-9
# shares of the angle and of the period by which derivatives are taken
_DIFFERENCE = 1e-6
# the assumed delay itself, in periods
_AT_ASSUMED = 1e-9


def block_window(plant: HeldPlant, assumed_s: float, refinement: int = 1) -> tuple[float, float]:
    """The nearest true delays (s) below and above the assumed one with an eigenvalue on the unit circle; 0 and inf."""
    loop = _PredictedBlock(plant, assumed_s)
    found_s = np.concatenate([loop.refined(*loop.starts(refinement)), loop.at_minus_one()]) - assumed_s
    found_s = found_s[np.abs(found_s) > _AT_ASSUMED * plant.period_s]
    shorter_s, longer_s = found_s[found_s < 0.0], found_s[found_s > 0.0]
    return assumed_s + float(shorter_s.max(initial=-assumed_s)), assumed_s + float(longer_s.min(initial=inf))


class _PredictedBlock:
    """The characteristic matrix of one block at any z on the unit circle and any true delay."""

    def __init__(self, plant: HeldPlant, assumed_s: float) -> None:
        self.plant, self.assumed_s = plant, assumed_s
        self.Phi, self.G = (maps[0] for maps in plant.transition(np.array([plant.period_s])))
        self.ahead = plant.carry(np.array([assumed_s]))[0]

    def starts(self, refinement: int) -> tuple[FloatArray, FloatArray]:
        """Angles and delays near the crossings next to the assumed delay."""
        period_s, grid = self.plant.period_s, self._angles(refinement)
        terms, found = self._terms(grid), list[FloatArray]()
        for m in (np.arange(_FRACTIONS * refinement) / (_FRACTIONS * refinement)).tolist():
            logs = log_moduli(self._loci(grid, m, *terms))
            begin, rank = np.nonzero((logs[1:] > 0.0) != (logs[:-1] > 0.0))
            share = logs[begin, rank] / (logs[begin, rank] - logs[begin + 1, rank])
            beside, nth = np.nonzero(may_reach_zero(grid, logs) | may_reach_zero(grid, -logs))
            angle = np.concatenate([grid[begin] + share * np.diff(grid)[begin], grid[beside], grid[beside + 2]])
            rank = np.concatenate([rank, nth, nth])[:, np.newaxis]
            loci = self._loci(angle, m, *self._terms(angle))
            locus = np.take_along_axis(loci, np.take_along_axis(np.argsort(-np.abs(loci)), rank, 1), 1)[:, 0]
            # the locus is z^{q+1}: delays with a q that need not be whole
            turn_s = 2.0 * pi / angle * period_s
            any_s = (np.angle(locus) / angle - 1.0 + m) * period_s
            below_s = self.assumed_s - (self.assumed_s - any_s) % turn_s
            found += [np.stack([angle, below_s + turns * turn_s]) for turns in (-1, 0, 1, 2)]
        starts = np.hstack(found)
        starts = starts[:, np.argsort(np.abs(starts[1] - self.assumed_s))]
        longer = starts[1] > self.assumed_s
        angles, delays_s = np.hstack(
            [starts[:, longer][:, : _NEAREST * refinement], starts[:, ~longer][:, : _NEAREST * refinement]]
        )
        return angles[delays_s >= 0.0], delays_s[delays_s >= 0.0]

    def at_minus_one(self) -> FloatArray:
        """The delays of eigenvalues z = -1, where the determinant repeats itself after two periods of delay."""
        # whole periods, at which it has kinks, are among them
        periods = split_delay(self.assumed_s, self.plant.period_s)[0] + np.arange(-2.0, 3.0, 1.0 / _AT_MINUS_ONE)
        delays_s = np.maximum(periods * self.plant.period_s, 0.0)

        def determinant(delay_s: FloatArray) -> FloatArray:
            return np.linalg.det(self._characteristic(np.full(delay_s.size, pi), delay_s)).real

        values = determinant(delays_s)
        at = np.flatnonzero(np.sign(values[1:]) != np.sign(values[:-1]))
        return bracketed_roots(determinant, delays_s[at], delays_s[at + 1], values[at], values[at + 1])

    def refined(self, angles: FloatArray, delays_s: FloatArray) -> FloatArray:
        """The delays of the solutions next to these starting points, of those that lead to one."""
        period_s = self.plant.period_s
        beside_s = _DIFFERENCE * period_s
        for _ in range(_STEPS):
            value = self._nearest(angles, delays_s, np.zeros(1))
            by_angle = (self._nearest(angles * (1.0 + _DIFFERENCE), delays_s, value) - value) / (_DIFFERENCE * angles)
            by_delay = (self._nearest(angles, delays_s + beside_s, value) - value) / beside_s
            area = (by_angle * by_delay.conj()).imag
            with np.errstate(divide="ignore", invalid="ignore"):
                angle_step = -(value * by_delay.conj()).imag / area
                delay_step = np.clip((value * by_angle.conj()).imag / area, -period_s, period_s)
            # the loci at -phi are the conjugates of those at phi
            angles, delays_s = pi - np.abs(pi - np.abs(angles + angle_step)), delays_s + delay_step
            kept = (angles > 0.0) & (delays_s >= 0.0)
            angles, delays_s = angles[kept], delays_s[kept]
            if not np.any(np.abs(delay_step[kept]) > _STILL * period_s):
                break
        return delays_s[np.abs(self._nearest(angles, delays_s, np.zeros(1))) < _SOLVED]

    def _angles(self, refinement: int) -> FloatArray:
        turns = pi * (self.assumed_s / self.plant.period_s + 1.0) / _TURN
        turning = np.linspace(0.0, pi, refinement * (int(turns) + 200))
        return np.union1d(turning[1:-1], np.logspace(-_DECADES, 0.0, _DECADES * _POINTS_PER_DECADE) * (pi * 0.999))

    def _terms(self, angle: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """K e^{A tau^} (z I - Phi)^{-1}, shape (k, r, n), and the part (k, r, r) that does not depend on tau."""
        plant, z = self.plant, np.exp(1j * angle)[:, np.newaxis, np.newaxis]
        resolvent = (z * np.eye(len(self.Phi)) - self.Phi).swapaxes(1, 2)
        both = np.hstack([plant.K.T, (plant.K @ self.ahead).T]).astype(np.complex128)
        rows, ahead = np.split(np.linalg.solve(resolvent, both).swapaxes(1, 2).astype(np.complex128), 2, axis=1)
        assumed = ahead @ held_entry(plant, z, self.assumed_s)
        return ahead, np.eye(plant.K.shape[0]) - rows @ self.G + assumed

    def _entered(self, z: ComplexArray, rest_s: FloatArray) -> ComplexArray:
        """G0 z + G1 (k, n, r) with a part of a period in the delay."""
        newer = self.plant.transition(self.plant.period_s - rest_s)[1]
        return newer * (z - 1.0) + self.G

    def _loci(self, angle: FloatArray, m: float, ahead: ComplexArray, rest: ComplexArray) -> ComplexArray:
        """The values (k, r) that z^{q+1} takes at a crossing whose delay is m beyond a whole number of periods."""
        z = np.exp(1j * angle)[:, np.newaxis, np.newaxis]
        entered = self._entered(z, np.array([m * self.plant.period_s]))
        return np.linalg.eigvals(np.linalg.solve(rest, ahead @ entered)).astype(np.complex128)

    def _characteristic(self, angle: FloatArray, delay_s: FloatArray) -> ComplexArray:
        """The matrix (k, r, r) that is singular where e^{j phi} is an eigenvalue, at each of k angles and delays."""
        whole = np.floor(delay_s / self.plant.period_s)
        z = np.exp(1j * angle)[:, np.newaxis, np.newaxis]
        ahead, rest = self._terms(angle)
        turned = z ** (-whole - 1.0)[:, np.newaxis, np.newaxis]
        return rest - ahead @ self._entered(z, delay_s - whole * self.plant.period_s) * turned

    def _nearest(self, angle: FloatArray, delay_s: FloatArray, to: ComplexArray | FloatArray) -> ComplexArray:
        """The eigenvalue (k,) of this matrix that is nearest `to` a value."""
        values = np.linalg.eigvals(self._characteristic(angle, delay_s))
        nearest = np.argmin(np.abs(values - to[:, np.newaxis]), axis=1)
        return values[np.arange(angle.size), nearest].astype(np.complex128)
