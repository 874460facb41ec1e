"""The mismatch window of one block of a predicted loop, with telemetry at the rate of control or at another rate.

At its ends det(I - N) = 0 on the unit circle, see `gains.sampled._predicted_difference`. Newton's method finds them.
Its starting points come from loci: with a delay of q + m common periods, q whole and m below 1, N = z^{-q} S_m - S^, so
z^q is an eigenvalue of (I + S^)^{-1} S_m, whose modulus is independent of q and changes little with m. If N is large,
the starting points are the crossings of the continuous loop, and delays inside the window are tested too. A kink is a
delay at which a command starts to act just as a state is sampled. Loci can miss a short interval of instability around
a kink, so kinks are tested if they are few. Each end is confirmed on either side by the spectrum of the map of one
common period, or by Nyquist's criterion if that map is large. If these tests show that the window ends nearer to the
assumed delay, bisection provides starting points closer to that end.
"""

from collections.abc import Sequence
from math import inf, log, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.core._bracketing import may_reach_zero
from gains.core.arrays import ComplexArray, FloatArray
from gains.core.errors import DisagreementError
from gains.delay._loci import log_moduli, solved_beside_poles
from gains.sampled._continuous_mismatch import continuous_crossings, highest_crossing
from gains.sampled._loop import HeldPlant, radius_of
from gains.sampled._predicted_difference import ROUNDING, PredictedDifference
from gains.sampled.multirate import Timing

# fractions of a period at which loci are computed, twice as many at two rates; angle (rad) per period below which one
# fraction is enough and kinks do not matter; largest size of N whose loci are computed at two rates; delays per period
# at which det(I - N) is computed at z = -1 and 1
_FRACTIONS, _SLOW, _FEW, _AT_ONE = 4, 1.0, 4, 8
# most starting points on either side; a mismatch below this (control periods) is no mismatch
_TRIED, _AT_ASSUMED = 16, 1e-9
# Newton's method: most steps; last step of a converged solution (control periods); increments for derivatives, as
# shares of angle and period
_STEPS, _SOLVED, _DIFFERENCE = 8, 1e-9, 1e-7
# further steps, each of which leaves a fixed part of the distance to a multiple solution; least singular value up to
# which they are worth taking
_STEPS_TO_MULTIPLE, _NEARLY = 40, 1e-4
# states of the largest map whose spectrum is computed; most kinks tested, times the control periods in a common one
_LARGEST_CHECK, _KINKS = 40, 600
# shares of the mismatch at the end at which the loop must be stable; relative offset of the tests beside the end;
# ratio of successive mismatches tested beyond it, up to so many times the end's mismatch plus so many common periods
_WITHIN, _BESIDE, _FARTHER = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9), 1e-6, 1.15
_SEARCHED, _SEARCHED_PERIODS = 3.0, 10.0
# if a block's continuous crossings are this many windows of the other blocks away, tests at these shares are enough
_FAR, _WITHIN_FAR = 1.5, (0.5, 1.0)
# most bisections; bisections between searches for a solution; angles per search; relative gap of equal mismatches
_HALVINGS, _SEARCH_EVERY, _BESIDE_IT, _SAME = 40, 3, 3, 1e-9


def common_window(plants: Sequence[HeldPlant], timing: Timing, assumed_s: float) -> tuple[float, float]:
    """The nearest true (mean) loop delays (s) below and above the assumed one with an eigenvalue on the unit circle.

    0 and `inf` if there are none, and `assumed_s` twice if the loop is unstable without mismatch. `plants`, the blocks
    of one loop, are held over the common period. The ends of a block are searched only if its continuous crossings are
    not far outside the window of the other blocks, or if it is unstable at a delay tested inside that window.
    """
    for plant in plants:
        tick = plant.transition(np.array([timing.common_s / timing.ticks]))
        if radius_of((tick[0] + tick[1] @ plant.K)[0]) >= 1.0:
            return assumed_s, assumed_s
    shorter_s, longer_s = assumed_s, inf
    # followers have more states than a leader, and narrower windows
    for plant in sorted(plants, key=lambda plant: -len(plant.A)):
        if plant.K.any():
            search = _Search(plant, timing, assumed_s)
            if longer_s == inf or not search.is_stable_within(shorter_s, longer_s):
                shorter_s, longer_s = search.ends_s(shorter_s, longer_s)
    return assumed_s - shorter_s, assumed_s + longer_s


class _Looks(NamedTuple):
    """Mismatches (s) in one direction: those to test, the first one likely beyond the end, and all likely ends."""

    all_s: list[float]
    beyond_s: float
    ends_s: FloatArray


class _Search:
    """Search for the ends of the window of one block."""

    def __init__(self, plant: HeldPlant, timing: Timing, assumed_s: float) -> None:
        self.plant, self.timing, self.assumed_s = plant, timing, assumed_s
        self.loop = PredictedDifference(plant, timing, assumed_s)
        self.tick_s, self.common_s = self.loop.tick_s, self.loop.common_s
        # at many angles, eigenvalues of larger matrices would take most of the time; determinants are cheaper
        self.by_loci = timing.ticks == 1 or len(self.loop.sample) <= _FEW
        self.stable = dict[float, bool]()

    def is_stable_within(self, shorter_s: float, longer_s: float) -> bool:
        """Whether the block's window extends beyond these mismatches (s), by continuous crossings and a few tests."""
        aside_s = continuous_crossings(self.plant, self.assumed_s)[1]
        near_s = _FAR * np.array([shorter_s, longer_s]) + self.timing.held_s
        if np.any((aside_s > -near_s[0]) & (aside_s < near_s[1])):
            return False
        looks = (self.assumed_s + np.outer(_WITHIN_FAR, (-shorter_s, longer_s))).ravel().tolist()
        self._judge(looks)
        return all(self.stable[look] for look in looks)

    def ends_s(self, shorter_s: float, longer_s: float) -> tuple[float, float]:
        """Mismatches (s) at which the window ends below and above the assumed delay, capped at the arguments."""
        aside_s = self._refined(*self._starts())
        below, above = self._looks(-1.0, shorter_s, aside_s), self._looks(1.0, longer_s, aside_s)
        # in one call: with many small matrices, the number of calls dominates the time
        self._judge(
            [
                self.assumed_s + way * aside_s
                for way, own in ((-1.0, below), (1.0, above))
                for aside_s in own.all_s
                if aside_s <= own.beyond_s
            ]
        )
        return min(shorter_s, self._end_s(-1.0, below)), min(longer_s, self._end_s(1.0, above))

    def _looks(self, way: float, longest_s: float, aside_s: FloatArray) -> _Looks:
        """Mismatches to test below (-1) or above (1) the assumed delay, from the solutions found on that side."""
        ends_s = way * aside_s
        ends_s = np.sort(ends_s[(ends_s > _AT_ASSUMED * self.tick_s) & (ends_s <= longest_s)])
        known_s = float(ends_s[0]) if ends_s.size else min(longest_s, self.assumed_s + 5.0 * self.timing.held_s)
        looks = [(1.0 - _BESIDE) * known_s, *self._kinks(way, max(known_s, float(ends_s.max(initial=0.0))))]
        beyond_s = inf
        if not self.by_loci:  # loci miss no crossing in between, except in a short interval around a kink
            looks += [share * known_s for share in _WITHIN]
        if ends_s.size or (not self.by_loci and way > 0.0):
            beyond_s = min(longest_s, (1.0 + _BESIDE) * known_s)
            last_s = min(longest_s, _SEARCHED * known_s + _SEARCHED_PERIODS * self.common_s)
            farther = _FARTHER ** np.arange(1.0, log(last_s / known_s) / log(_FARTHER))
            looks += [beyond_s, *((1.0 + _BESIDE) * ends_s).tolist(), *(farther * known_s).tolist()]
        return _Looks(sorted({min(longest_s, look) for look in looks}), beyond_s, ends_s)

    def _end_s(self, way: float, looks: _Looks) -> float:
        stable_s = 0.0
        for aside_s in looks.all_s:
            if not self._is_stable(self.assumed_s + way * aside_s):
                return self._between(way, stable_s, aside_s, looks.ends_s)
            stable_s = aside_s
        return inf

    def _kinks(self, way: float, most_s: float) -> list[float]:
        """The nearest mismatches (s) up to `most_s` at which a command starts to act just as a state is sampled."""
        if highest_crossing(self.plant, self.assumed_s) * self.timing.held_s <= _SLOW:
            return []
        first_s = np.unique((way * (self.loop.samples_s + self.timing.spread_s - self.assumed_s)) % self.tick_s)
        aside_s = (first_s + np.arange(most_s / self.tick_s)[:, np.newaxis] * self.tick_s).ravel()
        # the time for a map grows with the periods in it
        near_s = aside_s[aside_s < most_s][: _KINKS // self.timing.ticks].tolist()
        return [own_s for own_s in near_s if not self._is_large(self.assumed_s + way * own_s)]

    def _between(self, way: float, stable_s: float, unstable_s: float, ends_s: FloatArray) -> float:
        """The end between a stable and an unstable mismatch (s); `ends_s` are solutions, some of them perhaps there."""
        for halving in range(_HALVINGS):
            # a mismatch is known to the rounding of the delay
            blur_s = _SAME * (stable_s + self.tick_s)
            ends_s = ends_s[(ends_s >= stable_s - blur_s) & (ends_s <= unstable_s + blur_s)]
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
        """Mismatches (s) of the solutions near a true delay, started from the angles of eigenvalues near the circle."""
        if not self._is_large(delay_s):
            values = np.linalg.eigvals(self.loop.maps(np.array([delay_s]))[0]).astype(np.complex128)
            angle = np.angle(values).astype(np.float64)
            nearest = np.argsort(np.abs(np.abs(values) - 1.0))
            angle = angle[nearest[angle[nearest] >= 0.0]][:_BESIDE_IT]
        else:
            [(angle, values)] = self.loop.resolved(np.array([delay_s]))
            sizes = np.abs(np.nan_to_num(values))
            dips = np.flatnonzero((sizes[1:-1] <= sizes[:-2]) & (sizes[1:-1] <= sizes[2:])) + 1
            least = np.concatenate([[0], dips, [sizes.size - 1]])
            angle = angle[least[np.argsort(sizes[least])][:_BESIDE_IT]]
        delays_s = np.full(angle.size, delay_s)
        here_s = delays_s[self._least_singular(angle, delays_s) <= ROUNDING]
        return np.append(here_s - self.assumed_s, self._refined(angle, delays_s - self.assumed_s))

    def _least_singular(self, angle: FloatArray, delays_s: FloatArray) -> FloatArray:
        """The least singular value of I - N relative to its terms (k,): rounding if an eigenvalue is on the circle."""
        return self.loop.least_singular(self.loop.at(angle), self.loop.answers(delays_s))

    def _is_stable(self, delay_s: float) -> bool:
        if delay_s not in self.stable:
            self._judge([delay_s])
        return self.stable[delay_s]

    def _judge(self, delays_s: list[float]) -> None:
        """Record whether the loop is stable at each true delay, by its spectrum or by Nyquist's criterion."""
        large = [delay_s for delay_s in delays_s if self._is_large(delay_s)]
        small = [delay_s for delay_s in delays_s if not self._is_large(delay_s)]
        if large:
            self.stable |= zip(large, (turns == 0 for turns in self.loop.turns(large)), strict=True)
        if small:
            radii = np.abs(np.linalg.eigvals(self.loop.maps(np.array(small)))).max(axis=1)
            self.stable |= zip(small, (radii < 1.0).tolist(), strict=True)

    def _is_large(self, delay_s: float) -> bool:
        return self.loop.states(delay_s) > _LARGEST_CHECK

    def _starts(self) -> tuple[FloatArray, FloatArray]:
        """Angles and mismatches (s) near the ends, the nearest on either side."""
        if self.by_loci:
            angle, aside_s = self._by_loci()
        else:
            frequency, aside_s = continuous_crossings(self.plant, self.assumed_s + self.tick_s / 2.0)
            angle = np.abs((frequency * self.common_s + pi) % (2.0 * pi) - pi)
        # also z = -1 and z = 1, where det(I - N) is real
        spans_s = (self.common_s, self.common_s), (self.timing.held_s, self.tick_s)
        beside_s = np.unique(np.concatenate([np.arange(-2.0 * a, 2.0 * a, b / _AT_ONE) for a, b in spans_s]))
        answers = self.loop.answers(np.maximum(0.0, self.assumed_s + beside_s))
        for real in (pi, 0.0):
            signs = np.sign(np.linalg.det(self.loop.differences(self.loop.at(np.array([real])), answers).real))
            at = np.flatnonzero(signs[1:] != signs[:-1])
            angle, aside_s = np.append(angle, np.full(at.size, real)), np.append(aside_s, beside_s[at])
        angle, aside_s = (each[aside_s > -self.assumed_s] for each in (angle, aside_s))
        tried, nearest = _TRIED if self.by_loci else _TRIED // _FRACTIONS, np.argsort(np.abs(aside_s))
        chosen = np.concatenate([nearest[aside_s[nearest] * way > 0.0][:tried] for way in (-1.0, 1.0)])
        return angle[chosen], aside_s[chosen]

    def _by_loci(self) -> tuple[FloatArray, FloatArray]:
        """Angles and mismatches (s) near all crossings, from loci."""
        grid = self.loop.at(self.loop.grid.angle[1:])
        fractions = min(self.timing.ticks, 2) * (_FRACTIONS if grid.angle[-1] > _SLOW else 1)
        m = np.arange(fractions) / fractions
        answers = self.loop.answers(m * self.common_s)
        # a column for each fraction and rank
        inverse = np.linalg.inv(np.eye(len(self.loop.sample)) + grid.assumed)
        logs = log_moduli(np.hstack([_ranked(inverse @ self.loop.seen_at(grid, own)) for own in answers.each()]))
        at, column = np.nonzero((logs[1:] > 0.0) != (logs[:-1] > 0.0))
        share = logs[at, column] / (logs[at, column] - logs[at + 1, column])
        beside, nth = np.nonzero(may_reach_zero(grid.angle, logs) | may_reach_zero(grid.angle, -logs))
        angle = np.concatenate([grid.angle[at] + share * np.diff(grid.angle)[at], grid.angle[beside + 1]])
        fraction, rank = np.divmod(np.concatenate([column, nth]), len(self.loop.sample))
        grid = self.loop.at(angle)
        seen = self.loop.seen_at(grid, answers.of(fraction))
        loci = _ranked(np.linalg.solve(np.eye(len(self.loop.sample)) + grid.assumed, seen))
        turn_s = 2.0 * pi / angle * self.common_s
        longer_s = (np.angle(loci[np.arange(angle.size), rank]) / angle + m[fraction]) * self.common_s - self.assumed_s
        return np.tile(angle, 2), np.concatenate([longer_s % turn_s, longer_s % turn_s - turn_s])

    def _refined(self, angle: FloatArray, aside_s: FloatArray) -> FloatArray:
        """Mismatches (s) of the solutions to which Newton's method converges from these starting points."""
        if angle.size == 0:
            return aside_s
        delay_s, beside_s = self.assumed_s + aside_s, _DIFFERENCE * self.tick_s
        # 1 / (u'(I - N)^{-1} v) is zero where det(I - N) is; for the singular vectors it is the least singular value
        vectors = np.linalg.svd(self.loop.differences(self.loop.at(angle), self.loop.answers(delay_s)))
        left, right = vectors.Vh[:, -1], vectors.U[:, :, -1:]
        solved_s = [np.zeros(0)]
        for step in range(_STEPS + _STEPS_TO_MULTIPLE):
            if step >= _STEPS:  # few are left: what is nearly a solution may be a multiple one
                least = self._least_singular(angle, delay_s)
                solved_s.append(delay_s[least <= ROUNDING])
                left_over = (least > ROUNDING) & (least <= _NEARLY)
                angle, delay_s, left, right = (part[left_over] for part in (angle, delay_s, left, right))
                if not angle.size:
                    break
            answers = self.loop.answers(np.concatenate([delay_s, delay_s + beside_s]))
            # at the point itself, with the angle incremented, and with the delay incremented
            here, turn = np.arange(angle.size), _DIFFERENCE * np.where(angle > 0.0, angle, 1.0)
            answers = answers.of(np.concatenate([here, here, here + angle.size]))
            solved = solved_beside_poles(
                self.loop.differences(self.loop.at(np.concatenate([angle, angle + turn, angle])), answers),
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
            solved_s.append(delay_s[(delay_s >= 0.0) & (np.abs(delay_step) < _SOLVED * self.tick_s)])
            moving = (delay_s >= 0.0) & ~(np.abs(delay_step) < _SOLVED * self.tick_s)
            if not moving.any():
                break
            angle, delay_s, left, right = angle[moving], delay_s[moving], left[moving], right[moving]
        return np.concatenate(solved_s) - self.assumed_s


def _ranked(maps: NDArray[np.complexfloating]) -> ComplexArray:
    """Eigenvalues (k, m) of maps (k, m, m), largest first."""
    loci = np.linalg.eigvals(maps).astype(np.complex128)
    return np.take_along_axis(loci, np.argsort(-np.abs(loci), axis=1), 1)
