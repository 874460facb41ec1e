"""The mismatch window of a predicted loop with telemetry at one rate and control at another.

Let X_i be the computed state at the instant at which, by the assumption, command i acts: X_{i+1} = Phi X_i + G u_i. The
measured state misses the computed one by w_j at the sample j, and a command k computed from it is

    u_k = K X_k + K L_k w_j,   L_k = `HeldPlant.carry` from that sample to the instant at which the command acts.

Both states answer to the same commands, one after the true delay and one after the assumed delay, so each is that of X
an instant earlier: w_j = Phi(r) X_i + Gamma(r) u_i, with i and r by the true delay, minus the same by the assumed one.
Over a common period of both rates, u is a transfer function of w, stable if the loop is without delay, and w one of u:
w = N(z) w with N = 0 where there is no mismatch. So the loop is stable exactly where det(I - N) does not go around 0 as
z goes around the unit circle (Nyquist), and an end of the window has det(I - N) = 0 on the circle. Starting points of
Newton's method are the crossings of the continuous loop. Whether an end is the first is judged at delays in between.
"""

from collections.abc import Sequence
from math import ceil, floor, inf, log, pi
from typing import NamedTuple

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray
from gains.sampled._loop import HeldPlant
from gains.sampled.multirate import Timing

# rad by which a delayed term turns between neighbouring angles; angles a decade, and decades below pi
_TURN, _POINTS_PER_DECADE, _DECADES = 0.25, 20, 5
# longest true delay, in assumed ones, that the angles resolve; angles at which the norm of N is bounded, and its bound
_LONGEST, _BOUNDED, _SMALL = 1.5, 400, 0.95
# the determinant of a solution, steps of Newton's method, the shortest one in control periods, and the difference by
# which derivatives are taken
_SOLVED, _STEPS, _STILL, _DIFFERENCE = 1e-9, 25, 1e-10, 1e-7
# crossings of the continuous loop that are tried, shares of the mismatch at which the loop must be stable, and how far
# (s per s) beyond an end it must not be
_TRIED, _WITHIN, _BESIDE = 4, (0.15, 0.3, 0.45, 0.6, 0.75, 0.9), 1e-4
# share of the mismatch before an end at which others beside it are looked for, how large det(I - N) is there at most,
# how many of them, and how far around they are believed
_SHORTLY, _NEAR_ZERO, _BESIDE_IT, _AROUND = 1e-3, 0.03, 6, 20.0
# a march: delays looked at in a control period and in a window, windows and control periods, how much farther each look
# is than the one before once there have been as many as in a window, and halvings at its end
_LOOKS_PERIOD, _LOOKS_WINDOW, _SEARCHED, _SEARCHED_PERIODS, _FARTHER, _HALVINGS = 3, 20, 3.0, 10, 1.15, 16


def rates_window(plant: HeldPlant, timing: Timing, assumed_s: float) -> tuple[float, float]:
    """The nearest true (mean) loop delays (s) below and above the assumed one with an eigenvalue on the unit circle.

    0 and `inf` if there is none, and `assumed_s` twice if the loop is unstable without mismatch. `plant` is held over
    the common period.
    """
    if not plant.K.any():
        return 0.0, inf
    loop = _Rates(plant, timing, assumed_s)
    if not loop.is_stable_matched:
        return assumed_s, assumed_s
    starts = loop.starts()
    shorter_s, longer_s = (loop.end_s(starts, way) for way in (-1.0, 1.0))
    return max(0.0, assumed_s - shorter_s), assumed_s + longer_s


class _Grid(NamedTuple):
    """Angles (k,) of z, X_0 (n, k, m) as a function of w, and what the samples see of it by the assumed delay."""

    angle: FloatArray
    first: ComplexArray
    assumed: ComplexArray


class _Rates:
    """det(I - N) of one block at any z and true delay."""

    def __init__(self, plant: HeldPlant, timing: Timing, assumed_s: float) -> None:
        self.assumed_s, self.plant = assumed_s, plant
        self.ticks, self.common_s, self.spread_s = timing.ticks, timing.common_s, timing.spread_s
        self.tick_s = self.common_s / self.ticks
        self.K, n = plant.K, len(plant.A)
        self.Phi, self.G = (maps[0] for maps in plant.transition(np.array([self.tick_s])))
        self.closed = self.Phi + self.G @ self.K
        commands = timing.commands_from(0, self.ticks - 1, every_tick=True)
        self.samples_s = sorted({taken_s for taken_s, _ in commands})
        late_s = max(0.0, assumed_s - self.spread_s)
        seen = np.arange(n) if plant.measured is None else np.flatnonzero(plant.measured)
        places = np.arange(len(self.samples_s) * n).reshape(-1, n)[:, seen]
        self.kept = places.ravel()
        carried = self.K @ plant.carry(np.array([computed_s + late_s - taken_s for taken_s, computed_s in commands]))
        # what each command adds for w, and X_k = closed^k X_0 + added_k
        self.on_w, self.added = [], [np.zeros((n, self.kept.size))]
        self.powers = [np.eye(n)]
        for k, (taken_s, _) in enumerate(commands):
            entry = np.zeros((len(self.K), len(self.samples_s) * n))
            entry[:, places[self.samples_s.index(taken_s)]] = carried[k][:, seen]
            self.on_w.append(entry[:, self.kept])
            self.added.append(self.closed @ self.added[-1] + self.G @ self.on_w[-1])
            self.powers.append(self.closed @ self.powers[-1])
        self.is_stable_matched = float(np.abs(np.linalg.eigvals(self.closed)).max()) < 1.0
        self.grid = self._grid(self._angles())

    def _angles(self) -> FloatArray:
        """Angles from 0 to pi, or to where the norm of N stays below one at every true delay."""
        turns = pi * (_LONGEST * self.assumed_s / self.common_s + 1.0) / _TURN
        low = np.logspace(-_DECADES, 0.0, _DECADES * _POINTS_PER_DECADE) * pi
        angles = np.union1d(np.linspace(0.0, pi, int(turns) + 200), low)
        coarse = angles[:: max(1, angles.size // _BOUNDED)]
        of_first, of_w = 0.0, 0.0
        for late_s in np.linspace(0.0, self.common_s, 4 * self.ticks + 1).tolist():
            _, onto_first, onto_w = self._answers(self.spread_s + late_s)
            of_first, of_w = max(of_first, np.linalg.norm(onto_first)), max(of_w, np.linalg.norm(onto_w))
        bound = 2.0 * (of_first * np.linalg.norm(self._first(coarse), axis=(0, 2)) + of_w)
        large = np.flatnonzero(bound > _SMALL)
        last = coarse[min(large.max(initial=0) + 1, coarse.size - 1)]
        return angles[angles <= last] if bound[-1] < _SMALL else angles

    def _first(self, angle: FloatArray) -> ComplexArray:
        free = np.exp(1j * angle)[:, np.newaxis, np.newaxis] * np.eye(len(self.closed)) - self.powers[-1]
        return np.ascontiguousarray(np.linalg.solve(free, self.added[-1]).swapaxes(0, 1), np.complex128)

    def _grid(self, angle: FloatArray) -> _Grid:
        first = self._first(angle)
        return _Grid(angle, first, self._seen(angle, first, self.assumed_s))

    def _answers(self, delay_s: float) -> tuple[list[int], FloatArray, FloatArray]:
        """What the samples see of X_0 and of w: exponents of z (q,), maps (q n, n) and (q n, m), with a true delay."""
        late_s = max(0.0, delay_s - self.spread_s)
        exponents: list[int] = []
        behind = [floor((taken_s - late_s) / self.tick_s + 1e-11) for taken_s in self.samples_s]
        rests_s = [max(0.0, t - late_s - i * self.tick_s) for t, i in zip(self.samples_s, behind, strict=True)]
        of_first, of_w = list[FloatArray](), list[FloatArray]()
        for i, Phi, hold in zip(behind, *self.plant.transition(np.array(rests_s)), strict=True):
            periods, k = divmod(i, self.ticks)
            flow = Phi + hold @ self.K
            exponents.append(periods)
            of_first.append(flow @ self.powers[k])
            of_w.append(flow @ self.added[k] + hold @ self.on_w[k])
        return exponents, np.vstack(of_first), np.vstack(of_w)

    def _seen(self, angle: FloatArray, first: ComplexArray, delay_s: float) -> ComplexArray:
        """What the samples see of w through the commands, (m, k, m), with a true delay."""
        exponents, of_first, of_w = self._answers(delay_s)
        turned = np.exp(1j * np.outer(np.repeat(exponents, len(self.closed))[self.kept], angle))
        seen = of_first[self.kept].astype(np.complex128) @ first.reshape(len(first), -1)
        return turned[:, :, np.newaxis] * (seen.reshape(-1, *first.shape[1:]) + of_w[self.kept][:, np.newaxis])

    def _differences(self, grid: _Grid, delay_s: float) -> ComplexArray:
        """I - N (k, m, m)."""
        N = self._seen(grid.angle, grid.first, delay_s) - grid.assumed
        return np.eye(self.kept.size) - N.swapaxes(0, 1)

    def determinant(self, grid: _Grid, delay_s: float) -> ComplexArray:
        """det(I - N) (k,)."""
        return np.linalg.det(self._differences(grid, delay_s)).astype(np.complex128)

    def is_stable(self, delay_s: float, near_angle: float | None = None) -> bool:
        """Whether det(I - N) does not go around 0; `near_angle` is one at which it may come close to 0."""
        grid = self.grid
        if near_angle is not None:
            aside = near_angle * np.logspace(-9.0, -1.0, 60)
            more = np.concatenate([near_angle - aside, near_angle + aside])
            grid = self._grid(np.union1d(grid.angle, more[(more > 0.0) & (more < grid.angle[-1])]))
        differences = self._differences(grid, delay_s)
        values = np.linalg.det(differences)
        # from the last angle to pi the eigenvalues of I - N stay in the right half plane
        rest = np.angle(np.linalg.eigvals(differences[-1])).sum()
        return round(float(np.angle(values[1:] / values[:-1]).sum() - rest) / pi) == 0

    def starts(self) -> list[tuple[float, float]]:
        """Angles and mismatches (s) of the crossings of the continuous loop, the nearest to the assumed delay first."""
        A, B, K = self.plant.A, self.plant.B, self.K
        omega = np.union1d(self.grid.angle[1:], np.linspace(0.0, pi * self.ticks, 8 * self.ticks)[1:]) / self.common_s
        s = (1j * omega)[:, np.newaxis, np.newaxis]
        inside = np.linalg.solve(s * np.eye(len(A)) - A - B @ K, B.astype(np.complex128))
        late = self.assumed_s + self.tick_s / 2.0
        onto = K @ self.plant.carry(np.array([late]))[0]
        loci = np.linalg.eigvals(onto @ inside * np.exp(-s * late))
        with np.errstate(divide="ignore", invalid="ignore"):
            turned = 1.0 + 1.0 / loci
        turned = np.take_along_axis(turned, np.argsort(np.abs(turned), axis=1), 1)
        beyond = np.abs(turned) > 1.0
        found: list[tuple[float, float]] = []
        for at, rank in zip(*np.nonzero(beyond[1:] != beyond[:-1]), strict=True):
            frequency = float(omega[at] + omega[at + 1]) / 2.0
            longer_s = float(-np.angle(turned[at, rank]) / frequency) % (2.0 * pi / frequency)
            angle = abs((frequency * self.common_s + pi) % (2.0 * pi) - pi)
            found += [(angle, longer_s), (angle, longer_s - 2.0 * pi / frequency)]
        return sorted(found, key=lambda start: abs(start[1]))

    def end_s(self, starts: Sequence[tuple[float, float]], way: float) -> float:
        """How far (s) from the assumed delay the window ends in one direction."""
        longest_s = self.assumed_s if way < 0.0 else inf
        tried = [start for start in starts if way * start[1] > 0.0 and abs(start[1]) < longest_s][:_TRIED]
        solved = [self._solved(angle, self.assumed_s + aside_s) for angle, aside_s in tried]
        ends = sorted((way * (at_s - self.assumed_s), angle) for angle, at_s in solved)
        ends = [end for end in ends if end[0] > 0.0]
        if way < 0.0 and not ends and all(self.is_stable((1.0 - share) * self.assumed_s) for share in (*_WITHIN, 1.0)):
            return inf
        for end_s, angle in [self._nearer(*end, way) for end in ends[:1]]:
            stable = all(self.is_stable(self.assumed_s + way * share * end_s) for share in _WITHIN)
            beside = [max(0.0, self.assumed_s + way * end_s * (1.0 + share)) for share in (-_BESIDE, _BESIDE)]
            if stable and [self.is_stable(at_s, angle) for at_s in beside] == [True, False]:
                return end_s
        return self._marched(way, ends[0][0] if ends else 0.0, longest_s)

    def _marched(self, way: float, wide_s: float, longest_s: float) -> float:
        """The same by looking at one delay after the other."""
        step_s = max(self.tick_s / _LOOKS_PERIOD, wide_s / _LOOKS_WINDOW)
        last_s = min(longest_s, _SEARCHED * wide_s + _SEARCHED_PERIODS * self.common_s)
        even_s = step_s * np.arange(1, _LOOKS_WINDOW + 1)
        farther_s = even_s[-1] * _FARTHER ** np.arange(1, max(1, ceil(log(last_s / even_s[-1]) / log(_FARTHER))))
        stable_s = 0.0
        for aside_s in [each for each in (*even_s.tolist(), *farther_s.tolist()) if each < last_s] + [last_s]:
            if not self.is_stable(self.assumed_s + way * aside_s):
                unstable_s = aside_s
                break
            stable_s = aside_s
        else:
            return inf
        for _ in range(_HALVINGS):
            middle_s = (stable_s + unstable_s) / 2.0
            if self.is_stable(self.assumed_s + way * middle_s):
                stable_s = middle_s
            else:
                unstable_s = middle_s
        return self._nearer(unstable_s, pi, way)[0]

    def _nearer(self, end_s: float, angle: float, way: float) -> tuple[float, float]:
        """The nearest end among this one and those at whose angles det(I - N) is small shortly before it."""
        before_s = self.assumed_s + way * (1.0 - _SHORTLY) * end_s
        sizes = np.abs(self.determinant(self.grid, before_s))
        least = np.flatnonzero((sizes[1:-1] <= np.minimum(sizes[:-2], sizes[2:])) & (sizes[1:-1] < _NEAR_ZERO)) + 1
        smallest = least[np.argsort(sizes[least])][:_BESIDE_IT]
        solved = [self._solved(float(self.grid.angle[at]), before_s) for at in smallest]
        ends = [(way * (at_s - self.assumed_s), at) for at, at_s in solved]
        near = [(end_s, angle), *(end for end in ends if (1.0 - _AROUND * _SHORTLY) * end_s < end[0] < end_s)]
        return min(near)

    def _solved(self, angle: float, delay_s: float) -> tuple[float, float]:
        """Angle and delay with det(I - N) = 0 next to a starting point; the assumed delay if there is none."""
        for _ in range(_STEPS):
            aside, aside_s = _DIFFERENCE * angle, _DIFFERENCE * self.tick_s
            if aside == 0.0:
                break
            grid = self._grid(np.array([angle, angle + aside]))
            value, turned = self.determinant(grid, delay_s).tolist()
            by_angle = (turned - value) / aside
            by_delay = (self.determinant(grid, delay_s + aside_s).tolist()[0] - value) / aside_s
            area = (by_angle * by_delay.conjugate()).imag
            if area == 0.0 or not np.isfinite(area):
                break
            angle_step = -(value * by_delay.conjugate()).imag / area
            delay_step = min(self.tick_s, max(-self.tick_s, (value * by_angle.conjugate()).imag / area))
            # det(I - N) at -phi is the conjugate of that at phi
            angle, delay_s = pi - abs(pi - abs(angle + angle_step) % (2.0 * pi)), delay_s + delay_step
            if angle == 0.0 or delay_s < 0.0:
                break
            if abs(delay_step) < _STILL * self.tick_s:
                return angle, delay_s
        solved = delay_s >= 0.0 < angle and abs(self.determinant(self._grid(np.array([angle])), delay_s)[0]) < _SOLVED
        return (angle, delay_s) if solved else (angle, self.assumed_s)
