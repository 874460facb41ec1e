"""Where the formation loses stability: predicted loop by loop, and located from measured growth rates.

The states of a formation fall into loops that do not act on those ahead of them: in a leader-follower tree every
vehicle is a loop of its own. The formation is stable exactly when every loop is, each at its own loop delay, so the
loop with the least room, margin minus loop delay, is the one that breaks first.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.structure import strongly_connected_blocks
from gains.delay.constant import delay_margin
from gains.delay.rightmost import rightmost_root
from gains.delay.several import late_by_vehicle
from gains.formation.model import FormationModel
from gains.sampled.multirate import Timing, multirate_delay_margin, multirate_growth_rate
from gains.sampled.onboard import OnboardLoop, OnboardTiming, onboard_loop


@dataclass(frozen=True, eq=False)
class Loop:
    """Vehicles that act on each other, with their part of e' = A e + B u, u = K e.

    `onboard` is their part of the onboard loop; without it all feedback is late.
    """

    system_ids: tuple[int, ...]
    A: FloatArray
    B: FloatArray
    K: FloatArray
    timing: Timing
    onboard: OnboardLoop | None = None

    @property
    def has_late_terms(self) -> bool:
        """Whether anything in it is fed back late: not on board, in a loop of one vehicle."""
        return self.onboard is None or bool(self.onboard.late.any())

    def margin_s(self) -> float:
        """The least loop delay at which the sampled and held loop loses stability."""
        if self.onboard is not None:
            return self.onboard.sampled_margin_s()
        return float(multirate_delay_margin(self.A, self.B, self.K, self.timing))

    def margin_continuous_s(self) -> float:
        """The least loop delay at which the continuous model loses stability; the hold counts as half a period."""
        whole_s = delay_margin(self.A, self.B @ self.K) if self.onboard is None else self.onboard.continuous_margin_s()
        return whole_s - self.timing.held_s / 2.0

    def growth_1_s(self, delay_s: float) -> float:
        """Growth rate of the sampled and held loop at a loop delay."""
        if self.onboard is not None:
            return self.onboard.growth_1_s(delay_s)
        return multirate_growth_rate(self.A, self.B, self.K, self.timing, delay_s=delay_s)

    def growth_continuous_1_s(self, delay_s: float) -> float:
        """Real part of the rightmost root of the continuous model; the hold counts as half a period of delay."""
        return self.growth_continuous_at_1_s(dict.fromkeys(self.system_ids, delay_s))

    def growth_continuous_at_1_s(self, loop_delay_s: Mapping[int, float]) -> float:
        """The same with a loop delay of its own for each vehicle's command, as in `gains.delay.several`."""
        late_gain = self.K if self.onboard is None else self.B.T @ self.onboard.late
        at_once = [(self.A, 0.0)] if self.onboard is None else self.onboard.continuous_at_once()
        late = late_by_vehicle(self.B, late_gain, [slice(2 * k, 2 * k + 2) for k in range(len(self.system_ids))])
        delays_s = [loop_delay_s[system_id] + self.timing.held_s / 2.0 for system_id in self.system_ids]
        return rightmost_root([*at_once, *zip(late, delays_s, strict=True)]).real

    def growth_at_1_s(self, loop_delay_s: Mapping[int, float]) -> float:
        """Growth rate of the sampled loop with a loop delay of its own for each vehicle.

        Exact where they are equal; elsewhere that at their mean, and what the continuous model says their differences
        add to it.
        """
        delays_s = [loop_delay_s[system_id] for system_id in self.system_ids]
        mean_s = sum(delays_s) / len(delays_s)
        rate_1_s = self.growth_1_s(mean_s)
        if max(delays_s) == min(delays_s):
            return rate_1_s
        return rate_1_s + self.growth_continuous_at_1_s(loop_delay_s) - self.growth_continuous_1_s(mean_s)

    def same_as(self, other: "Loop") -> bool:
        """Whether the other loop is the same system, of other vehicles."""
        mine, its = (self.A, self.B, self.K), (other.A, other.B, other.K)
        return self.timing == other.timing and all(
            a.shape == b.shape and bool((a == b).all()) for a, b in zip(mine, its, strict=True)
        )


@dataclass(frozen=True)
class GrowthPoint:
    """One flight near the onset: the loop delay it had, and the growth rate measured."""

    loop_delay_s: float
    growth_1_s: float
    error_1_s: float


@dataclass(frozen=True)
class Zero:
    """Where growth passes from below to above zero; `error_s` is the standard error, `slope_1_s2` dg/dtau there.

    `inside` says that there are flights on both sides: otherwise it is extrapolated. `misfit` is how far the flights
    lie off the curve, in their errors: well above one where no parabola fits, as over a kink. The sampled loop's growth
    has one where the delay is a whole number of periods.
    """

    loop_delay_s: float
    error_s: float
    slope_1_s2: float
    inside: bool
    misfit: float


def loops_of(
    predecessors: Sequence[int],
    system_ids: Sequence[int],
    K: FloatArray,
    *,
    timing: Timing,
    onboard: OnboardTiming | None = None,
) -> list[Loop]:
    """The loops of a formation flown with a gain matrix K, those ahead first.

    `predecessors` and the order of K are those of `gains.formation.model.FormationModel`. `onboard` is the timing of
    the onboard loop; without it the station closes every loop.
    """
    model = FormationModel(tuple(predecessors))
    whole = None if onboard is None else onboard_loop(model, K, onboard)
    states = [
        np.r_[model.spacing_slice(i), model.velocity_slice(i)] if i > 0 else np.r_[model.velocity_slice(0)]
        for i in range(model.vehicles)
    ]
    A, B = model.A, model.B
    pattern = np.abs(A) + np.abs(B @ K)
    coupled = np.array([[pattern[np.ix_(own, other)].sum() for other in states] for own in states])
    loops: list[Loop] = []
    for members in strongly_connected_blocks(coupled):
        rows = members.tolist()
        own = np.concatenate([states[i] for i in rows])
        inputs = np.concatenate([np.r_[model.input_slice(i)] for i in rows])
        loops.append(
            Loop(
                system_ids=tuple(system_ids[i] for i in rows),
                A=A[np.ix_(own, own)],
                B=B[np.ix_(own, inputs)],
                K=K[np.ix_(inputs, own)],
                timing=timing,
                onboard=None if whole is None else whole.part(own),
            )
        )
    return loops


def distinct(loops: Sequence[Loop]) -> list[Loop]:
    """One loop of each kind."""
    kinds: list[Loop] = []
    for loop in loops:
        if not any(loop.same_as(kind) for kind in kinds):
            kinds.append(loop)
    return kinds


def critical_loop(loops: Sequence[Loop], loop_delay_s: Mapping[int, float]) -> Loop:
    """The loop of largest predicted growth at the loop delays of its vehicles; the first in a tie."""
    rates: list[float] = []
    known: list[tuple[Loop, list[float], float]] = []
    for loop in loops:
        delays_s = [round(loop_delay_s[system_id], 9) for system_id in loop.system_ids]
        rate = next((r for other, d, r in known if d == delays_s and other.same_as(loop)), None)
        if rate is None:
            rate = loop.growth_at_1_s(loop_delay_s)
            known.append((loop, delays_s, rate))
        rates.append(rate)
    return loops[int(np.argmax(rates))]


def locate_zero(points: Sequence[GrowthPoint]) -> Zero | None:
    """The loop delay of zero growth, from at least two flights at different delays.

    A line, or with four and more flights a parabola, by least squares weighted with the flights' errors. None when
    growth does not rise with delay in them.
    """
    if len({round(point.loop_delay_s, 6) for point in points}) < 2:
        return None
    delay_s, growth, error = np.array([(p.loop_delay_s, p.growth_1_s, p.error_1_s) for p in points], dtype=float).T
    # no flight is trusted more than a thousandth of what the rates differ by: the curve is not exactly a parabola
    error = np.maximum(error, 1e-3 * float(np.ptp(growth)) + 1e-9)
    middle, half = float(delay_s.mean()), float(np.ptp(delay_s)) / 2.0
    x = (delay_s - middle) / half
    for degree in (2, 1) if len(points) >= 4 else (1,):
        weighted = np.vander(x, degree + 1) / error[:, np.newaxis]
        coefficients = np.linalg.lstsq(weighted, growth / error, rcond=None)[0]
        at = _rising_root(coefficients, nearest_to=float(x[np.abs(growth).argmin()]))
        if at is not None:
            row = at ** np.arange(degree, -1, -1.0)
            slope = float(np.polyval(np.polyder(coefficients), at))
            variance = float(row @ np.linalg.pinv(weighted.T @ weighted) @ row)
            off, free = weighted @ coefficients - growth / error, len(points) - degree - 1
            misfit = float(np.linalg.norm(off)) / free**0.5 if free else 0.0
            return Zero(
                loop_delay_s=middle + half * at,
                error_s=half * variance**0.5 / slope * max(1.0, misfit),
                slope_1_s2=slope / half,
                inside=bool((growth < 0.0).any() and (growth > 0.0).any()),
                misfit=misfit,
            )
    return None


def _rising_root(coefficients: FloatArray, *, nearest_to: float) -> float | None:
    """The root at which a polynomial rises; of two the one nearest to a place."""
    roots = np.roots(coefficients)
    real = roots[np.abs(roots.imag) < 1e-9].real
    rising = real[np.polyval(np.polyder(coefficients), real) > 0.0]
    return float(rising[np.abs(rising - nearest_to).argmin()]) if rising.size else None
