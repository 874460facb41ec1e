"""The mismatch window of one block of a predicted loop, at one rate or with telemetry at another rate than control.

Let X_i be the predicted state at the instant at which command i is assumed to act: X_{i+1} = Phi X_i + G u_i. At the
sample j the measured state differs from the predicted one by w_j, and a command k computed from it is

    u_k = K X_k + K L_k w_j,   L_k = `HeldPlant.carry` from that sample to the instant at which the command acts.

Both states answer to the same commands, one after the true delay and one after the assumed delay, so each is that of X
an instant earlier: w_j = Phi(r) X_i + Gamma(r) u_i, with i and r by the true delay, minus the same by the assumed one.
Of w_j only v_j matters: w_j itself, or the K L_k w_j if these are fewer numbers. Over a common period of both rates u
depends on v by a transfer function that is stable if the loop without delay is stable, and v depends on u. Together
v = N(z) v, with N = 0 where there is no mismatch. So ends of the window have det(I - N) = 0 on the unit circle, and the
loop is stable exactly where det(I - N) does not encircle 0 as z goes around the unit circle (Nyquist).

Newton's method finds the ends. Its starting points come from loci: with a delay of q + m common periods, q whole and m
below 1, N = z^{-q} S_m - S^. So z^q is an eigenvalue of (I + S^)^{-1} S_m, whose modulus does not depend on q and only
little on m. Where N is large, they are the crossings of the continuous loop, and delays within the window are looked at
too. Loci can miss a short stretch of instability around a kink, a delay at which a command starts to act as a state is
sampled: kinks are looked at where there are few. Each end is confirmed on either side by the spectrum of the lifted
map, or by Nyquist's criterion if that map is large. If another end lies nearer, bisection finds starting points closer
to the assumed delay.
"""

from math import inf, log, pi
from typing import NamedTuple

import numpy as np

from gains.core._bracketing import local_maxima, may_reach_zero
from gains.core.arrays import ComplexArray, FloatArray
from gains.core.errors import DisagreementError
from gains.delay._loci import (
    delay_loci,
    log_moduli,
    solved_beside_poles,
    swept_crossings,
    unit_gain_roots,
)
from gains.sampled._loop import HeldPlant, radius_of
from gains.sampled.multirate import Predictor, Timing, multirate_map

# rad by which a delayed term turns between neighbouring angles, the longest true delay (in assumed ones) for which it
# does, and the least number of angles; the same turn in the continuous loop
_TURN, _LONGEST, _ANGLES, _TURN_CONTINUOUS = 0.25, 1.5, 200, 0.1
# angles added to even ones: shares of the highest; and beside a pole, in half-widths of its resonance
_LOW, _BESIDE_POLE = np.logspace(-5.0, 0.0, 80), np.sinh(np.linspace(-4.0, 4.0, 17))
# no angle is needed where the norm of N stays below this
_SMALL = 0.95
# fractions of a period at which loci are computed, twice as many at two rates; the angle (rad) in a period below which
# one is enough, and kinks do not matter; the largest N of which they are computed at two rates; and the delays in a
# period at which det(I - N) is computed at z = -1 and 1
_FRACTIONS, _SLOW, _FEW, _AT_ONE = 4, 1.0, 4, 16
# starting points to either side at most, and the assumed delay itself (control periods)
_TRIED, _AT_ASSUMED = 16, 1e-9
# Newton's method: steps, the last one (control periods) and that of a solution, and shares of angle and period for
# derivatives
_STEPS, _STILL, _SOLVED, _DIFFERENCE = 12, 1e-11, 1e-9, 1e-7
# states of the largest lifted map whose spectrum is computed, and how many kinks are looked at, times the control
# periods in a common one
_LARGEST_CHECK, _KINKS = 100, 600
# shares of the mismatch at which the loop must be stable, how far beside its end it is looked at, how much farther each
# look beyond is than the one before, and up to how many mismatches and common periods
_WITHIN, _BESIDE, _FARTHER = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9), 1e-6, 1.15
_SEARCHED, _SEARCHED_PERIODS = 3.0, 10.0
# halvings between two looks, after how many a solution is searched, from how many angles; and equal mismatches
_HALVINGS, _SEARCH_EVERY, _BESIDE_IT, _SAME = 40, 3, 3, 1e-9
# largest relative change of det(I - N) between neighbouring angles, into how many parts they are divided for that, how
# often, and the modulus of a zero
_MOST_TURN, _PARTS, _REFINEMENTS, _LEAST = 1.0, 8, 14, 1e-300


def block_window(plant: HeldPlant, timing: Timing, assumed_s: float) -> tuple[float, float]:
    """The nearest true (mean) loop delays (s) below and above the assumed one with an eigenvalue on the unit circle.

    0 and `inf` if there is none, and `assumed_s` twice if the loop is unstable without mismatch. `plant` is held over
    the common period.
    """
    tick = plant.transition(np.array([timing.common_s / timing.ticks]))
    if radius_of((tick[0] + tick[1] @ plant.K)[0]) >= 1.0:
        return assumed_s, assumed_s
    if not plant.K.any():
        return 0.0, inf
    shorter_s, longer_s = _PredictedBlock(plant, timing, assumed_s).ends_s()
    return max(0.0, assumed_s - shorter_s), assumed_s + longer_s


def highest_crossing(plant: HeldPlant, assumed_s: float) -> float:
    """A frequency (rad/s) above which `continuous_crossings` has none, 0 if there is none at all."""
    loop, carried = plant.A + plant.B @ plant.K, plant.K @ plant.carry(np.array([assumed_s]))[0]
    gain, scale = unit_gain_roots(loop, plant.B, 2.0 * carried), float(np.linalg.norm(loop))
    return 1.05 * float(gain.imag[np.abs(gain.real) <= 1e-6 * scale].max(initial=0.0))


def continuous_crossings(plant: HeldPlant, assumed_s: float) -> tuple[FloatArray, FloatArray]:
    """Frequencies (rad/s) and mismatches (s) of the roots of the continuous loop that are on the imaginary axis.

    With M(s) = K e^{A tau^} (s I - A - B K)^{-1} B and an eigenvalue lambda of it, e^{s tau} is
    lambda / (1 + lambda e^{-s tau^}). Of each crossing there are the nearest mismatches on either side. Where no
    singular value of M exceeds a half, there is none.
    """
    highest = highest_crossing(plant, assumed_s)
    if highest <= 0.0:
        return np.zeros(0), np.zeros(0)
    loop = plant.A + plant.B @ plant.K
    own = delay_loci(loop, plant.B, plant.K @ plant.carry(np.array([assumed_s]))[0])

    def loci(omega: FloatArray) -> ComplexArray:
        late = own(omega)
        with np.errstate(divide="ignore", invalid="ignore"):  # infinite where a root needs no delay
            return late / (1.0 + late * np.exp(-1j * omega * assumed_s)[:, np.newaxis])

    poles = np.linalg.eigvals(loop).astype(np.complex128)
    resonant = poles.imag[:, np.newaxis] + np.outer(poles.real, _BESIDE_POLE)
    dense = np.linspace(0.0, highest, int(highest * assumed_s / _TURN_CONTINUOUS) + _ANGLES)
    omega = np.unique(np.concatenate([dense, highest * _LOW, resonant.ravel()]))
    found = swept_crossings(loci, omega[(omega > 0.0) & (omega <= highest)])
    frequency = np.array([crossing.omega for crossing in found])
    turn_s = 2.0 * pi / frequency
    longer_s = (np.array([crossing.delay_s for crossing in found]) - assumed_s) % turn_s
    return np.tile(frequency, 2), np.concatenate([longer_s, longer_s - turn_s])


class _Grid(NamedTuple):
    """Angles (k,) of z, X_0 (k, n, m) as a function of v, and what the samples see of it by the assumed delay."""

    angle: FloatArray
    first: ComplexArray
    assumed: ComplexArray


class _Answers(NamedTuple):
    """What the samples see of X_0 and v: exponents of z (k, m), maps (k, m, n) and (k, m, m)."""

    exponents: FloatArray
    of_first: FloatArray
    of_v: FloatArray


class _Looks(NamedTuple):
    """Mismatches (s) in one direction: where the loop is judged, beside the likeliest end, and all likely ends."""

    all_s: list[float]
    likely_s: list[float]
    ends_s: FloatArray


class _PredictedBlock:
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
        # rows of v: what they see of w, and of which sample; and what v adds to each command
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
        # at many angles, eigenvalues of larger matrices would take most of the time
        self.by_loci = self.ticks == 1 or len(self.sample) <= _FEW
        self.by_assumed = self._answers(np.array([assumed_s]))
        self.grid = self._grid(self._angles())
        self.aside_s = self._refined(*self._starts())
        self.stable = dict[float, bool]()

    def ends_s(self) -> tuple[float, float]:
        """How far (s) from the assumed delay the window ends below and above it."""
        below, above = (self._looks(way) for way in (-1.0, 1.0))
        # judged in one go: at many small matrices, the number of calls takes the time
        self._judge(
            [self.assumed_s + way * look for way, own in ((-1.0, below), (1.0, above)) for look in own.likely_s]
        )
        return self._end_s(-1.0, below), self._end_s(1.0, above)

    def _looks(self, way: float) -> _Looks:
        """Where the loop is judged below (-1) or above (1) the assumed delay, from the solutions found there."""
        ends_s, longest_s = way * self.aside_s, self.assumed_s if way < 0.0 else inf
        ends_s = np.sort(ends_s[ends_s > _AT_ASSUMED * self.tick_s])
        known_s = float(ends_s[0]) if ends_s.size else min(longest_s, self.assumed_s + 5.0 * self.timing.held_s)
        likely, looks = [(1.0 - _BESIDE) * known_s], self._kinks(way, max(known_s, float(ends_s.max(initial=0.0))))
        if not self.by_loci:  # these miss no crossing in between but those of a short stretch around a kink
            looks += [share * known_s for share in _WITHIN]
        if ends_s.size or (not self.by_loci and way > 0.0):
            likely.append((1.0 + _BESIDE) * known_s)
            last_s = min(longest_s, _SEARCHED * known_s + _SEARCHED_PERIODS * self.common_s)
            farther = _FARTHER ** np.arange(1.0, log(last_s / known_s) / log(_FARTHER))
            looks += [*((1.0 + _BESIDE) * ends_s).tolist(), *(farther * known_s).tolist()]
        likely = [min(longest_s, look) for look in likely]
        return _Looks(sorted({*likely, *(min(longest_s, look) for look in looks)}), likely, ends_s)

    def _end_s(self, way: float, looks: _Looks) -> float:
        stable_s = 0.0
        for aside_s in looks.all_s:
            if not self._is_stable(self.assumed_s + way * aside_s):
                return self._between(way, stable_s, aside_s, looks.ends_s)
            stable_s = aside_s
        return inf

    def _kinks(self, way: float, most_s: float) -> list[float]:
        """Mismatches (s) up to this one at which a command starts to act as a state is sampled, the nearest of them."""
        if highest_crossing(self.plant, self.assumed_s) * self.timing.held_s <= _SLOW:
            return []
        first_s = np.unique((way * (self.samples_s + self.spread_s - self.assumed_s)) % self.tick_s)
        aside_s = (first_s + np.arange(most_s / self.tick_s)[:, np.newaxis] * self.tick_s).ravel()
        # the map takes as long as there are periods in it
        near_s = aside_s[aside_s < most_s][: _KINKS // self.ticks].tolist()
        return [own_s for own_s in near_s if self._states(self.assumed_s + way * own_s) <= _LARGEST_CHECK]

    def _between(self, way: float, stable_s: float, unstable_s: float, ends_s: FloatArray) -> float:
        """The same, between two mismatches (s), with solutions of which some may be there."""
        for halving in range(_HALVINGS):
            ends_s = ends_s[(ends_s >= stable_s) & (ends_s <= unstable_s)]
            if ends_s.size:
                end_s = float(ends_s.min())
                inside_s = (1.0 - _BESIDE) * end_s
                if inside_s <= stable_s * (1.0 + _SAME) or self._is_stable(self.assumed_s + way * inside_s):
                    return end_s
                unstable_s = inside_s
            middle_s = (stable_s + unstable_s) / 2.0
            if self._is_stable(self.assumed_s + way * middle_s):
                stable_s = middle_s
            else:
                unstable_s = middle_s
            if halving % _SEARCH_EVERY == 0:
                ends_s = way * self._beside(self.assumed_s + way * middle_s)
        raise DisagreementError(
            f"the loop that is predicted over {self.assumed_s} s loses stability at "
            f"{self.assumed_s + way * stable_s} s, but no eigenvalue is found on the unit circle there"
        )

    def _beside(self, delay_s: float) -> FloatArray:
        """Mismatches (s) of the solutions next to a true delay, from the angles at which eigenvalues are near there."""
        if self._states(delay_s) <= _LARGEST_CHECK:
            values = np.linalg.eigvals(self._lifted(delay_s)).astype(np.complex128)
            angle = np.angle(values).astype(np.float64)
            nearest = np.argsort(np.abs(np.abs(values) - 1.0))
            angle = angle[nearest[angle[nearest] >= 0.0]][:_BESIDE_IT]
        else:
            [(angle, values)] = self._resolved(np.array([delay_s]))
            sizes = np.abs(values)
            least = np.concatenate([[0], local_maxima(-sizes), [sizes.size - 1]])
            angle = angle[least[np.argsort(sizes[least])][:_BESIDE_IT]]
        return self._refined(angle, np.full(angle.size, delay_s - self.assumed_s))

    def _lifted(self, delay_s: float) -> FloatArray:
        predictor = Predictor(self.plant, self.assumed_s)
        return multirate_map(self.plant, self.timing, delay_s=delay_s, predictor=predictor)

    def _angles(self) -> FloatArray:
        """Angles from 0 to pi, or to where the norm of N stays below one at every true delay."""
        coarse = np.union1d(np.linspace(0.0, pi, _ANGLES), pi * _LOW)
        delays_s = self.spread_s + np.linspace(0.0, self.common_s, max(self.ticks, 8) + 1)
        _, onto_first, onto_v = self._answers(delays_s)
        of_first, of_v = (np.linalg.norm(onto, axis=(1, 2)).max() for onto in (onto_first, onto_v))
        bound = 2.0 * (of_first * np.linalg.norm(self._first(coarse), axis=(1, 2)) + of_v)
        last = coarse[min(np.flatnonzero(bound > _SMALL).max(initial=0) + 1, coarse.size - 1)]
        turns = last * (_LONGEST * self.assumed_s / self.common_s + 1.0) / _TURN
        return np.union1d(np.linspace(0.0, last, max(int(turns), _ANGLES)), last * _LOW)

    def _first(self, angle: FloatArray) -> ComplexArray:
        free = np.exp(1j * angle)[:, np.newaxis, np.newaxis] * np.eye(len(self.closed)) - self.powers[-1]
        return np.linalg.solve(free, self.added[-1]).astype(np.complex128)

    def _grid(self, angle: FloatArray) -> _Grid:
        grid = _Grid(angle, self._first(angle), np.zeros(1, np.complex128))
        return grid._replace(assumed=self._seen(grid, self.by_assumed))

    def _answers(self, delays_s: FloatArray) -> _Answers:
        """What the samples see with k true delays."""
        until_s = self.samples_s - np.maximum(0.0, delays_s - self.spread_s)[:, np.newaxis]
        behind = np.floor(until_s / self.tick_s + 1e-11)
        rest_s = np.maximum(0.0, until_s - behind * self.tick_s)
        flow, hold = (maps.reshape(*rest_s.shape, *maps.shape[1:]) for maps in self.plant.transition(rest_s.ravel()))
        periods, k = np.divmod(behind.astype(np.int64), self.ticks)
        flow = flow + hold @ self.plant.K
        seen = self.counted[:, np.newaxis]
        of_first = seen @ (flow @ self.powers[k])[:, self.sample]
        of_v = seen @ (flow @ self.added[k] + hold @ self.on_v[k])[:, self.sample]
        return _Answers(periods[:, self.sample].astype(np.float64), of_first[:, :, 0], of_v[:, :, 0])

    def _seen(self, grid: _Grid, answers: _Answers) -> ComplexArray:
        """What the samples see of v through the commands, (k, m, m), with one true delay or k of them."""
        turned = np.exp(1j * grid.angle[:, np.newaxis] * answers.exponents)[:, :, np.newaxis]
        return turned * (answers.of_first.astype(np.complex128) @ grid.first + answers.of_v)

    def _differences(self, grid: _Grid, answers: _Answers) -> ComplexArray:
        """I - N (k, m, m), with one true delay or k of them."""
        return np.eye(len(self.sample)) + grid.assumed - self._seen(grid, answers)

    def _determinants(self, grid: _Grid, answers: _Answers) -> ComplexArray:
        """det(I - N) (k,), none of them zero."""
        values = np.linalg.det(self._differences(grid, answers)).astype(np.complex128)
        return np.where(values == 0.0, _LEAST, values)

    def _is_stable(self, delay_s: float) -> bool:
        """Whether the loop is stable at a true delay."""
        if delay_s not in self.stable:
            self._judge([delay_s])
        return self.stable[delay_s]

    def _judge(self, delays_s: list[float]) -> None:
        """Remember whether the loop is stable at each true delay."""
        large = [delay_s for delay_s in delays_s if self._states(delay_s) > _LARGEST_CHECK]
        if large:
            self.stable |= {delay_s: turns == 0 for delay_s, turns in zip(large, self._turns(large), strict=True)}
        for delay_s in set(delays_s).difference(large):
            self.stable[delay_s] = radius_of(self._lifted(delay_s)) < 1.0

    def _turns(self, delays_s: list[float]) -> list[int]:
        """How often det(I - N) goes around 0 as z goes around the unit circle, backwards, at each true delay."""
        found = list[int]()
        for delay_s, (angle, values) in zip(delays_s, self._resolved(np.array(delays_s)), strict=True):
            # from the last angle to pi the eigenvalues of I - N stay in the right half plane
            last = self._differences(self._grid(angle[-1:]), self._answers(np.array([delay_s])))[0]
            rest = np.angle(np.linalg.eigvals(last)).sum() if angle[-1] < pi else 0.0
            found.append(-round(float(np.angle(values[1:] / values[:-1]).sum() - rest) / pi))
        return found

    def _resolved(self, delays_s: FloatArray) -> list[tuple[FloatArray, ComplexArray]]:
        """For each true delay, angles and det(I - N), which changes little from each angle to the next."""
        answers = self._answers(delays_s)
        each = [_Answers(*(part[[k]] for part in answers)) for k in range(delays_s.size)]
        found = [(self.grid.angle, self._determinants(self.grid, own)) for own in each]
        for _ in range(_REFINEMENTS):
            between = [_refining(*own) for own in found]
            of = np.repeat(np.arange(delays_s.size), [own.size for own in between])
            if of.size == 0:
                break
            added = self._determinants(self._grid(np.concatenate(between)), _Answers(*(part[of] for part in answers)))
            for k in np.unique(of).tolist():
                angle = np.concatenate([found[k][0], between[k]])
                order = np.argsort(angle)
                found[k] = angle[order], np.concatenate([found[k][1], added[of == k]])[order]
        return found

    def _states(self, delay_s: float) -> float:
        """Of the lifted map."""
        return len(self.closed) + len(self.plant.K) * (max(delay_s, self.assumed_s) / self.tick_s + 2.0)

    def _starts(self) -> tuple[FloatArray, FloatArray]:
        """Angles and mismatches (s) near the ends, the nearest to either side."""
        if self.by_loci:
            angle, aside_s = self._by_loci()
        else:
            frequency, aside_s = continuous_crossings(self.plant, self.assumed_s + self.tick_s / 2.0)
            angle = np.abs((frequency * self.common_s + pi) % (2.0 * pi) - pi)
        # z = -1, and at two rates z = 1 too, where det(I - N) is real
        spans_s = (self.common_s, self.common_s), (self.timing.held_s, self.tick_s)
        beside_s = np.unique(np.concatenate([np.arange(-2.0 * a, 2.0 * a, b / _AT_ONE) for a, b in spans_s]))
        answers = self._answers(np.maximum(0.0, self.assumed_s + beside_s))
        for real in (pi, 0.0):
            signs = np.sign(self._determinants(self._grid(np.full(beside_s.size, real)), answers).real)
            at = np.flatnonzero(signs[1:] != signs[:-1])
            angle, aside_s = np.append(angle, np.full(at.size, real)), np.append(aside_s, beside_s[at])
        angle, aside_s = (each[aside_s > -self.assumed_s] for each in (angle, aside_s))
        tried, nearest = _TRIED if self.by_loci else _TRIED // _FRACTIONS, np.argsort(np.abs(aside_s))
        chosen = np.concatenate([nearest[aside_s[nearest] * way > 0.0][:tried] for way in (-1.0, 1.0)])
        return angle[chosen], aside_s[chosen]

    def _by_loci(self) -> tuple[FloatArray, FloatArray]:
        """The same of all crossings, from loci."""
        grid = self.grid._replace(angle=self.grid.angle[1:], first=self.grid.first[1:], assumed=self.grid.assumed[1:])
        fractions = min(self.ticks, 2) * (_FRACTIONS if grid.angle[-1] > _SLOW else 1)
        angles, asides_s = list[FloatArray](), list[FloatArray]()
        for m in (np.arange(fractions) / fractions).tolist():
            answers = self._answers(np.array([m * self.common_s]))
            logs = log_moduli(self._ranked_loci(grid, answers))
            at, rank = np.nonzero((logs[1:] > 0.0) != (logs[:-1] > 0.0))
            share = logs[at, rank] / (logs[at, rank] - logs[at + 1, rank])
            beside, nth = np.nonzero(may_reach_zero(grid.angle, logs) | may_reach_zero(grid.angle, -logs))
            angle = np.concatenate([grid.angle[at] + share * np.diff(grid.angle)[at], grid.angle[beside + 1]])
            rank = np.concatenate([rank, nth])
            locus = self._ranked_loci(self._grid(angle), answers)[np.arange(angle.size), rank]
            turn_s = 2.0 * pi / angle * self.common_s
            longer_s = (np.angle(locus) / angle + m) * self.common_s - self.assumed_s
            angles += [angle, angle]
            asides_s += [longer_s % turn_s, longer_s % turn_s - turn_s]
        return np.concatenate(angles), np.concatenate(asides_s)

    def _ranked_loci(self, grid: _Grid, answers: _Answers) -> ComplexArray:
        """Eigenvalues (k, m) of (I + S^)^{-1} S_m, the largest first."""
        seen = self._seen(grid, answers)
        loci = np.linalg.eigvals(np.linalg.solve(np.eye(len(self.sample)) + grid.assumed, seen)).astype(np.complex128)
        return np.take_along_axis(loci, np.argsort(-np.abs(loci), axis=1), 1)

    def _refined(self, angle: FloatArray, aside_s: FloatArray) -> FloatArray:
        """Mismatches (s) of the solutions next to these starting points, of those that lead to one."""
        if angle.size == 0:
            return aside_s
        delay_s, beside_s = self.assumed_s + aside_s, _DIFFERENCE * self.tick_s
        # u'(I - N)^{-1} v is large with the inverse of the eigenvalue that is to be zero, and so with no other
        values, vectors = np.linalg.eig(self._differences(self._grid(angle), self._answers(delay_s)))
        own = np.arange(angle.size), np.argmin(np.abs(values), axis=1)
        left, right = np.linalg.pinv(vectors)[own], vectors.swapaxes(1, 2)[own][:, :, np.newaxis]
        step_s = np.full(angle.size, inf)
        for _ in range(_STEPS):
            answers = self._answers(np.concatenate([delay_s, delay_s + beside_s]))
            # at the place itself, at an angle beside it, and at a delay beside it
            here, turn = np.arange(angle.size), _DIFFERENCE * np.where(angle > 0.0, angle, 1.0)
            answers = _Answers(*(part[np.concatenate([here, here, here + angle.size])] for part in answers))
            solved = solved_beside_poles(
                self._differences(self._grid(np.concatenate([angle, angle + turn, angle])), answers),
                np.tile(right, (3, 1, 1)),
            )
            with np.errstate(divide="ignore", invalid="ignore"):
                value, turned, later = 1.0 / (np.tile(left, (3, 1)) * solved[:, :, 0]).sum(axis=1).reshape(3, -1)
                by_angle, by_delay = (turned - value) / turn, (later - value) / beside_s
                area = (by_angle * by_delay.conj()).imag
                angle_step = -(value * by_delay.conj()).imag / area
                delay_step = np.clip((value * by_angle.conj()).imag / area, -self.tick_s, self.tick_s)
                # N at -phi is the conjugate of that at phi
                angle, delay_s = pi - np.abs(pi - np.abs(angle + angle_step) % (2.0 * pi)), delay_s + delay_step
            kept = delay_s >= 0.0
            angle, delay_s, left, right = angle[kept], delay_s[kept], left[kept], right[kept]
            step_s = np.abs(delay_step[kept])
            if not np.any(step_s > _STILL * self.tick_s):
                break
        return delay_s[step_s < _SOLVED * self.tick_s] - self.assumed_s


def _refining(angle: FloatArray, values: ComplexArray) -> FloatArray:
    """Angles between neighbours at which values change too much."""
    size, width = np.abs(values), np.diff(angle)
    slope = np.abs(np.diff(values)) / (np.minimum(size[1:], size[:-1]) * width)
    # slopes beside them count too: two zeros at one place turn the phase by a whole turn, which looks like none
    steepest = np.maximum(slope, np.maximum(np.append(slope[1:], 0.0), np.append(0.0, slope[:-1])))
    coarse = np.flatnonzero(width * steepest > _MOST_TURN)
    shares = np.arange(1.0, _PARTS) / _PARTS
    return (angle[coarse, np.newaxis] + width[coarse, np.newaxis] * shares).ravel()
