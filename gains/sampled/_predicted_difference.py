"""I - N of one block of a predicted loop, with telemetry at the rate of control or at another rate.

Let X_i be the predicted state at the instant at which command i is assumed to act: X_{i+1} = Phi X_i + G u_i. At
sample j the measured state differs from the predicted one by w_j, and a command k computed from it is

    u_k = K X_k + K L_k w_j,   L_k = `HeldPlant.carry` from that sample to the instant at which the command acts.

Both states respond to the same commands, one after the true delay and one after the assumed delay, so each is X at an
earlier instant: w_j = Phi(r) X_i + Gamma(r) u_i, with i and r from the true delay, minus the same from the assumed one.
Only v_j matters: w_j itself, or the K L_k w_j if these are fewer numbers. Over a common period of both rates u depends
on v through a transfer function that is stable if the loop without delay is stable, and v depends on u. Together
v = N(z) v, with N = 0 if there is no mismatch. An eigenvalue is on the unit circle where det(I - N) = 0, and the loop
is stable exactly if det(I - N) does not encircle 0 as z goes around the unit circle (Nyquist).
"""

from functools import cached_property
from math import ceil, isnan, pi
from typing import NamedTuple

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray, IntArray
from gains.sampled._loop import HeldPlant
from gains.sampled.multirate import Timing

# rotation (rad) of a delayed term between neighbouring angles; longest true delay (in assumed delays) that the grid
# resolves; least number of angles
_TURN, _LONGEST, _ANGLES = 0.25, 1.5, 200
# angles added to an even grid, as shares of the highest
_LOW = np.logspace(-5.0, 0.0, 80)
# the grid ends at the angle beyond which the norm of N stays below this
_SMALL = 0.95
# largest relative change of det(I - N) between neighbouring angles; parts into which an interval is divided to meet it;
# most such refinements; the modulus that replaces zero
_MOST_TURN, _PARTS, _REFINEMENTS, _LEAST = 1.0, 8, 14, 1e-300
# least singular value of I - N, relative to its terms, up to which it is rounding; refinements before it is computed
ROUNDING, _UNCHECKED = 1e-14, 3


class Grid(NamedTuple):
    """Angles (k,) of z, X_0 (k, n, m) as a function of v, and the part of it that samples see at the assumed delay."""

    angle: FloatArray
    first: ComplexArray
    assumed: ComplexArray


class Answers(NamedTuple):
    """Responses of the samples to X_0 and v: exponents of z (k, m), maps (k, m, n) and (k, m, m)."""

    exponents: FloatArray
    of_first: FloatArray
    of_v: FloatArray

    def of(self, delays: IntArray) -> "Answers":
        """The responses at the true delays with these indices."""
        return Answers(*(part[delays] for part in self))

    def each(self) -> list["Answers"]:
        """The responses at each true delay, one at a time."""
        return [self.of(np.array([k])) for k in range(len(self.of_v))]


class PredictedDifference:
    """I - N of one block at any z on the unit circle and any true delay."""

    def __init__(self, plant: HeldPlant, timing: Timing, assumed_s: float) -> None:
        self.plant, self.timing, self.assumed_s = plant, timing, assumed_s
        self.ticks, self.common_s, self.spread_s = timing.ticks, timing.common_s, timing.spread_s
        self.tick_s = self.common_s / self.ticks
        K, n = plant.K, len(plant.A)
        Phi, G = (maps[0] for maps in plant.transition(np.array([self.tick_s])))
        self.closed = Phi + G @ K
        commands = timing.commands_from(0, self.ticks - 1, every_tick=True)
        taken_s = np.array([sampled_s for sampled_s, _ in commands])
        self.samples_s, of_sample = np.unique(taken_s, return_inverse=True)
        late_s = np.array([computed_s for _, computed_s in commands]) + max(0.0, assumed_s - self.spread_s) - taken_s
        seen = np.eye(n) if plant.measured is None else np.diag(plant.measured.astype(np.float64))[plant.measured]
        carried = K @ plant.carry(late_s) @ seen.T
        # rows of v: their maps from w and their samples; and the contribution of v to each command
        counted, onto = list[FloatArray](), list[FloatArray]()
        for sample in range(self.samples_s.size):
            every = np.vstack(list(carried[of_sample == sample]))
            few = len(every) < len(seen)
            counted.append(every @ seen if few else seen)
            onto += np.split(np.eye(len(every)) if few else every, np.count_nonzero(of_sample == sample))
        self.counted = np.vstack(counted)
        self.sample = np.repeat(np.arange(self.samples_s.size), [len(rows) for rows in counted])
        self.on_v = np.zeros((self.ticks, len(K), len(self.sample)))
        for k, own in enumerate(onto):
            self.on_v[k][:, self.sample == of_sample[k]] = own
        # X_k = closed^k X_0 + added_k
        powers, added = [np.eye(n)], [np.zeros((n, len(self.sample)))]
        for on_v in self.on_v:
            powers.append(self.closed @ powers[-1])
            added.append(self.closed @ added[-1] + G @ on_v)
        self.powers, self.added = np.array(powers), np.array(added)
        self.by_assumed = self.answers(np.array([assumed_s]))

    @cached_property
    def grid(self) -> Grid:
        """Angles from 0 to pi, or to the angle beyond which the norm of N stays below one at every true delay."""
        coarse = np.union1d(np.linspace(0.0, pi, _ANGLES), pi * _LOW)
        delays_s = self.spread_s + np.linspace(0.0, self.common_s, max(self.ticks, 8) + 1)
        _, onto_first, onto_v = self.answers(delays_s)
        of_first, of_v = (np.linalg.norm(onto, axis=(1, 2)).max() for onto in (onto_first, onto_v))
        bound = 2.0 * (of_first * np.linalg.norm(self._first(coarse), axis=(1, 2)) + of_v)
        last = coarse[min(np.flatnonzero(bound > _SMALL).max(initial=0) + 1, coarse.size - 1)]
        turns = last * (_LONGEST * self.assumed_s / self.common_s + 1.0) / _TURN
        return self.at(np.union1d(np.linspace(0.0, last, max(int(turns), _ANGLES)), last * _LOW))

    def _first(self, angle: FloatArray) -> ComplexArray:
        free = np.exp(1j * angle)[:, np.newaxis, np.newaxis] * np.eye(len(self.closed)) - self.powers[-1]
        return np.linalg.solve(free, self.added[-1]).astype(np.complex128)

    def at(self, angle: FloatArray) -> Grid:
        """The quantities that do not depend on the true delay, at k angles."""
        grid = Grid(angle, self._first(angle), np.zeros(1, np.complex128))
        return grid._replace(assumed=self.seen_at(grid, self.by_assumed))

    def answers(self, delays_s: FloatArray) -> Answers:
        """The responses of the samples at k true delays."""
        until_s = self.samples_s - np.maximum(0.0, delays_s - self.spread_s)[:, np.newaxis]
        behind = np.floor(until_s / self.tick_s + 1e-11)
        rest_s = np.maximum(0.0, until_s - behind * self.tick_s)
        flow, hold = (maps.reshape(*rest_s.shape, *maps.shape[1:]) for maps in self.plant.transition(rest_s.ravel()))
        periods, k = np.divmod(behind.astype(np.int64), self.ticks)
        flow = flow + hold @ self.plant.K
        periods, k, flow, hold = (part[:, self.sample] for part in (periods, k, flow, hold))
        flow, hold = (self.counted[:, np.newaxis] @ part for part in (flow, hold))
        of_first, of_v = flow @ self.powers[k], flow @ self.added[k] + hold @ self.on_v[k]
        return Answers(periods.astype(np.float64), of_first[:, :, 0], of_v[:, :, 0])

    def seen_at(self, grid: Grid, answers: Answers) -> ComplexArray:
        """Response of the samples to v through the commands, (k, m, m), for one true delay or k of them."""
        # real and imaginary parts side by side: a product of a real and a complex matrix takes twice as long
        seen = (answers.of_first @ grid.first.view(np.float64)).view(np.complex128)
        seen += answers.of_v
        seen *= np.exp(1j * grid.angle[:, np.newaxis] * answers.exponents)[:, :, np.newaxis]
        return seen

    def differences(self, grid: Grid, answers: Answers) -> ComplexArray:
        """I - N (k, m, m), for one true delay or k of them."""
        return np.eye(len(self.sample)) + grid.assumed - self.seen_at(grid, answers)

    def determinants(self, grid: Grid, answers: Answers) -> ComplexArray:
        """det(I - N) (k,), with zeros replaced by a tiny number."""
        values = np.linalg.det(self.differences(grid, answers)).astype(np.complex128)
        return np.where(values == 0.0, _LEAST, values)

    def least_singular(self, grid: Grid, answers: Answers) -> FloatArray:
        """The least singular value of I - N relative to its terms (k,)."""
        least = np.linalg.svd(self.differences(grid, answers), compute_uv=False)[:, -1]
        return least / (1.0 + np.linalg.norm(grid.assumed, axis=(1, 2)))

    def states(self, delay_s: float) -> int:
        """The number of states of `maps` at a true delay."""
        late_s = max(delay_s, self.assumed_s) - self.spread_s
        return len(self.closed) + len(self.sample) * max(1, ceil(late_s / self.common_s - 1e-11))

    def maps(self, delays_s: FloatArray) -> FloatArray:
        """The loop's map over one common period at k true delays, (k, states, states).

        Its state is X_0 of P periods ago and the v since then, oldest first; nothing takes longer than that to act.
        """
        answers, (n, m) = self.answers(delays_s), self.added[-1].shape
        late = [-part.exponents.astype(np.int64) for part in (answers, self.by_assumed)]
        periods = max(1, *(int(own.max()) for own in late))
        # X_0 of each later period as a function of the state
        first = np.zeros((periods + 1, n, n + periods * m))
        first[0, :, :n] = np.eye(n)
        for k in range(periods):
            first[k + 1] = self.powers[-1] @ first[k]
            first[k + 1, :, n + k * m : n + (k + 1) * m] += self.added[-1]
        # responses to the state and to the new v: at the true delay, minus those at the assumed delay
        seen = np.zeros((delays_s.size, m, n + (periods + 1) * m))
        at = np.arange(delays_s.size)[:, np.newaxis, np.newaxis], np.arange(m)[:, np.newaxis]
        for own, part, sign in zip(late, (answers, self.by_assumed), (1.0, -1.0), strict=True):
            seen[..., : n + periods * m] += sign * (part.of_first[..., np.newaxis, :] @ first[periods - own])[..., 0, :]
            seen[(*at, n + (periods - own)[..., np.newaxis] * m + np.arange(m))] += sign * part.of_v
        maps = np.zeros((delays_s.size, n + periods * m, n + periods * m))
        maps[:, :n] = first[1]
        maps[:, n : n + (periods - 1) * m, n + m :] = np.eye((periods - 1) * m)
        itself = n + periods * m
        maps[:, itself - m :] = np.linalg.solve(np.eye(m) - seen[..., itself:], seen[..., :itself])
        return maps

    def turns(self, delays_s: list[float]) -> list[int]:
        """How often det(I - N) encircles 0, clockwise, as z goes around the unit circle, at each true delay.

        1 if det(I - N) is 0 to rounding at some angle: the loop is not asymptotically stable, as far as can be known.
        """
        # a product, because dividing by nan would warn
        turned = [np.angle(values[1:] * values[:-1].conj()).sum() for _, values in self.resolved(np.array(delays_s))]
        last = self.grid.angle[-1:].repeat(len(delays_s))
        if last[0] < pi:  # from there to pi the eigenvalues of I - N stay in the right half plane
            beyond = np.linalg.eigvals(self.differences(self.at(last), self.answers(np.array(delays_s))))
            turned -= np.angle(beyond).sum(axis=1)
        return [1 if isnan(turn) else -round(float(turn) / pi) for turn in turned]

    def resolved(self, delays_s: FloatArray) -> list[tuple[FloatArray, ComplexArray]]:
        """For each true delay, angles and det(I - N), refined until it changes little from each angle to the next.

        nan where it is 0 to rounding, as beside a multiple eigenvalue on the unit circle: its changes there are noise.
        """
        answers = self.answers(delays_s)
        found = [(self.grid.angle, self.determinants(self.grid, own)) for own in answers.each()]
        changing = list(range(delays_s.size))
        for refinement in range(_REFINEMENTS):
            between = {k: added for k in changing if (added := _refining(*found[k])).size}
            changing = list(between)
            if not changing:
                break
            of = np.repeat(changing, [own.size for own in between.values()])
            grid, own = self.at(np.concatenate([*between.values()])), answers.of(of)
            added = self.determinants(grid, own)
            if refinement >= _UNCHECKED:
                added[self.least_singular(grid, own) <= ROUNDING] = np.nan
            for k in changing:
                angle = np.concatenate([found[k][0], between[k]])
                order = np.argsort(angle)
                found[k] = angle[order], np.concatenate([found[k][1], added[of == k]])[order]
        return found


def _refining(angle: FloatArray, values: ComplexArray) -> FloatArray:
    """Angles to insert between neighbours whose values differ too much."""
    size, width = np.abs(values), np.diff(angle)
    slope = np.abs(np.diff(values)) / (np.minimum(size[1:], size[:-1]) * width)
    # neighbouring slopes count too: two zeros at one place change the phase by a whole turn, which looks like no change
    steepest = np.maximum(slope, np.maximum(np.append(slope[1:], 0.0), np.append(0.0, slope[:-1])))
    coarse = np.flatnonzero(width * steepest > _MOST_TURN)
    shares = np.arange(1.0, _PARTS) / _PARTS
    return (angle[coarse, np.newaxis] + width[coarse, np.newaxis] * shares).ravel()
