"""Loops with telemetry and control at different rates: when samples are used, and the margin that results.

The vehicle samples its state every `telemetry_s`; the station computes a command every `control_s` from the newest
sample that has arrived. Only the slower of the two counts: a command from a sample that was used before repeats the
command already held, and a sample overtaken by a newer one is never used. In a common period T of both, n commands
act, where n is the number of slower periods in T:

* If the slower period is a whole multiple of the faster one, n = 1. All commands have the same delay, and the loop is
  that of `gains.sampled.constant` with the slower period.
* Otherwise the commands have the least loop delay plus 0, g, 2 g, ..., (n - 1) g, in an order fixed by the rates; g is
  the faster period divided by n. Phases only rotate this order, so the least loop delay determines the loop. So does
  the mean over the commands that are the first to use their sample, which is (n - 1) g / 2 longer. *Loop delay* here is
  that mean, because it changes less from rate to rate.
"""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import chain, pairwise
from math import ceil, floor, inf, isfinite

import numpy as np
from numpy.typing import ArrayLike

from gains.core._bracketing import met_end, peaks
from gains.core.arrays import FloatArray, IntArray
from gains.core.structure import of_type, positive_seconds, seconds
from gains.delay.constant import delay_margin
from gains.sampled._loop import HeldPlant, SampledPlant, block_radius, held_blocks, radius_of, rate_of
from gains.sampled.constant import checked_loop, sampled_delay_margin

# instants closer together than this (in common periods) coincide: sums of periods and delays are known to rounding
_SAME_INSTANT = 1e-11
# Limit on slower periods in a common period. Rates without such a common period are replaced by the nearest that have
# one: over so many periods their phase drifts by less than a clock drifts within seconds.
_MOST_COMMANDS = 20
# delays evaluated per slower period, in which no visible motion turns by more than half a circle, and per continuous
# margin; the longer step of the two is taken
_LOOKS, _LOOKS_MARGIN = 6, 40
# the margin is searched up to this many continuous margins plus this many slower periods
_SEARCHED_MARGINS, _SEARCHED_PERIODS = 3.0, 10.0
# longer margins, in slower periods, are computed as if at one rate: measured to be right to two parts in 10^4
_MOST_PERIODS = 30.0
# the spectral radius at a margin is at most this far below one
_RESOLUTION = 1e-13
# a local maximum of the radius is refined when its sample is above this
_NEAR_ONE = 0.99
# delays are closer where the radius exceeds this to the power of the number of commands in a common period,
_NEAR_ONE_COMMAND = 0.95
# and a change this many times that over the last delays would take it to one
_CHANGES = 3.0
# delays at which a command starts to act just as a state is sampled are dense if closer than this share of a step
_DENSE = 0.4


@dataclass(frozen=True)
class Timing:
    """Periods (s) of control and telemetry, and the quantities derived from them.

    BadModelError if a period is not positive and finite.

    With control at 50 Hz and telemetry at 20 Hz, samples at 0 and 50 ms are first used at 0 and 60 ms:

    >>> timing = Timing(control_s=0.02, telemetry_s=0.05)
    >>> timing.held_s, timing.commands, timing.common_s, timing.spread_s
    (0.05, 2, 0.1, 0.005)
    """

    control_s: float
    telemetry_s: float

    def __post_init__(self) -> None:
        for name in ("control_s", "telemetry_s"):
            positive_seconds(name, getattr(self, name))

    @property
    def held_s(self) -> float:
        """The slower period: the mean time for which a command from a new sample is held."""
        return max(self.control_s, self.telemetry_s)

    @property
    def commands(self) -> int:
        """n: the number of commands from new samples in a common period."""
        return self._ratio.denominator

    @property
    def common_s(self) -> float:
        """T: the common period of control and telemetry."""
        return self.commands * self.held_s

    @property
    def faster_s(self) -> float:
        """The faster period, as a fraction of T."""
        return self.common_s / self._ratio.numerator

    @property
    def step_s(self) -> float:
        """g, of which differences between the commands' loop delays are multiples; the faster period if n = 1."""
        return self.faster_s / self.commands

    @property
    def spread_s(self) -> float:
        """Mean loop delay over a common period minus the least one."""
        return (self.faster_s - self.step_s) / 2.0

    @cached_property
    def _ratio(self) -> Fraction:
        """Slower over faster period."""
        return Fraction(self.held_s / min(self.control_s, self.telemetry_s)).limit_denominator(_MOST_COMMANDS)

    @property
    def ticks(self) -> int:
        """The number of control periods in a common period."""
        return self._ratio.numerator if self.telemetry_s > self.control_s else self.commands

    def commands_from(self, first: int, last: int, *, every_tick: bool = False) -> list[tuple[float, float]]:
        """(Sample instant, computation instant) of the commands first to last, without delay.

        Command 0 is computed at 0 from a sample that arrives at that instant. With `every_tick`, commands that reuse a
        sample are included.
        """
        slower_s, faster_s = self.held_s, self.faster_s
        near = _SAME_INSTANT * self.commands
        numbers = range(first, last + 1)
        if self.telemetry_s >= self.control_s and every_tick:
            return [(floor(i * faster_s / slower_s + near) * slower_s, i * faster_s) for i in numbers]
        if self.telemetry_s >= self.control_s:
            return [(i * slower_s, ceil(i * slower_s / faster_s - near) * faster_s) for i in numbers]
        return [(floor(i * slower_s / faster_s + near) * faster_s, i * slower_s) for i in numbers]


def multirate_growth_rate(A: ArrayLike, B: ArrayLike, K: ArrayLike, timing: Timing, *, delay_s: float) -> float:
    """Exponential rate (1/s) of the slowest motion at a (mean) loop delay: negative when stable.

    A (n, n), B (n, p) and K (p, n) are real, with the feedback u = +K x; BadModelError names one that does not fit. A
    `delay_s` (s) below the least mean possible at these rates is raised to it.

    x' = u, u = -x with telemetry at 1 Hz, control at 5 Hz and a loop delay of half a second decays at ln(2) / 2:

    >>> round(multirate_growth_rate([[0]], [[1]], [[-1]], Timing(control_s=0.2, telemetry_s=1.0), delay_s=0.5), 6)
    -0.346574
    """
    common_s = of_type("timing", timing, Timing).common_s
    return lifted_growth(held_blocks(*checked_loop(A, B, K), period_s=common_s), timing, delay_s=delay_s)


def multirate_delay_margin(A: ArrayLike, B: ArrayLike, K: ArrayLike, timing: Timing) -> float:
    """The least (mean) loop delay (s) at which the loop loses stability; 0 if unstable at once, `inf` if none is found.

    If the slower period is a multiple of the faster one, the margin is the exact one of `gains.sampled.constant`. If
    the continuous margin exceeds thirty slower periods, the margin is that of the slower period alone. Otherwise the
    loop delay is raised in steps, smaller ones where the loop comes near instability, up to three times the margin of
    the continuous loop plus ten slower periods: a search, not a proof. Arguments as for `multirate_growth_rate`,
    exceptions as for `gains.sampled.constant.sampled_delay_margin`.

    x' = u, u = -x has a margin of 1 s if either of the two periods is 1 s and the other divides it:

    >>> [round(multirate_delay_margin([[0]], [[1]], [[-1]], Timing(*s)), 6) for s in ((1.0, 0.2), (0.2, 1.0))]
    [1.0, 1.0]
    """
    if of_type("timing", timing, Timing).commands == 1:
        return sampled_delay_margin(A, B, K, period_s=timing.held_s)
    plant, entry, feedback = checked_loop(A, B, K)
    continuous_s = delay_margin(plant, entry @ feedback)
    if is_nearly_continuous(timing, near_s=continuous_s):
        return sampled_delay_margin(A, B, K, period_s=timing.held_s)
    return lifted_margin(held_blocks(plant, entry, feedback, period_s=timing.common_s), timing, near_s=continuous_s)


@dataclass(frozen=True, eq=False)
class Predictor:
    """The station's model of the plant, and the (mean) loop delay (s) over which it predicts."""

    believed: HeldPlant
    assumed_s: float

    @property
    def computed(self) -> list[int]:
        """Indices of the states that are not measured and are computed from the commands alone."""
        measured = self.believed.measured
        return [] if measured is None else np.flatnonzero(~measured).tolist()


def multirate_map(
    plant: SampledPlant, timing: Timing, *, delay_s: float, predictor: Predictor | None = None
) -> FloatArray:
    """The map of (x, u(command -1), u(command -2), ...) over one common period.

    u = K x(sample). With a predictor, u at every control tick is K times the state predicted for the instant at which
    it acts. The states that the predictor computes, because they are not measured, follow the commands.
    """
    inputs, on = plant.K.shape
    common_s, count = timing.common_s, timing.commands if predictor is None else timing.ticks
    least_s, least_assumed_s = (
        max(0.0, late_s - timing.spread_s) for late_s in (delay_s, predictor.assumed_s if predictor else 0.0)
    )
    earlier = count * (ceil(max(least_s, least_assumed_s) / common_s) + 2)
    schedule = timing.commands_from(-earlier, count - 1, every_tick=predictor is not None)
    close_s, taken_s = _SAME_INSTANT * common_s, [sampled_s for sampled_s, _ in schedule[earlier:]]
    acts_s, assumed_s = ([computed_s + late_s for _, computed_s in schedule] for late_s in (least_s, least_assumed_s))
    # commands from before the period that still act in it, by the true or the assumed delay
    kept = max(0, *(earlier + 1 - bisect_right(s, close_s) for s in (acts_s, *([assumed_s] if predictor else []))))
    inside = [at_s for at_s in acts_s if close_s < at_s < common_s - close_s]
    instants = _merged([0.0, *inside, *taken_s, common_s], close_s)
    flows, holds = plant.between(instants)
    n, computed = flows.shape[1], predictor.computed if predictor else []
    start = np.eye(n + kept * inputs + len(computed))
    x, believed = start[:n], np.zeros((on, len(start)))
    believed[computed] = start[len(start) - len(computed) :]
    commands = {-age: start[n + (age - 1) * inputs : n + age * inputs] for age in range(1, kept + 1)}
    times = _merged([0.0, *(at_s for at_s in assumed_s if at_s > 0.0), *taken_s, common_s], close_s)
    maps = list(zip(*predictor.believed.between(times), strict=True)) if predictor else []
    acting = [bisect_right(assumed_s, at_s + close_s) - 1 - earlier for at_s in times]

    def carried(state: FloatArray, from_s: float, to_s: float) -> FloatArray:
        """The station's estimate of the state at one instant of `times`, propagated from another."""
        for k in range(*(bisect_right(times, at_s + close_s) - 1 for at_s in (from_s, to_s))):
            Phi, hold = maps[k]
            state = Phi @ state + hold @ commands[acting[k]]
        return state

    number, known_s, reached_s, state = 0, 0.0, 0.0, x[:on]
    for instant, Phi, hold in zip(instants, flows, holds, strict=False):
        while number < count and taken_s[number] <= instant + close_s:
            if number == 0 or taken_s[number] > taken_s[number - 1]:  # a new sample
                state, reached_s = x[:on], taken_s[number]
                if computed:
                    believed, known_s = carried(believed, known_s, reached_s), reached_s
                    state = state.copy()
                    state[computed] = believed[computed]
            if predictor:
                acts_next_s = max(reached_s, assumed_s[number + earlier])
                state, reached_s = carried(state, reached_s, acts_next_s), acts_next_s
            commands[number] = plant.K @ state
            number += 1
        x = Phi @ x + hold @ commands[bisect_right(acts_s, instant + close_s) - 1 - earlier]
    believed = carried(believed, known_s, common_s) if computed else believed
    return np.vstack([x, *(commands[count - age] for age in range(1, kept + 1)), believed[computed]])


def lifted_radius(plant: SampledPlant, timing: Timing, *, delay_s: float, predictor: Predictor | None = None) -> float:
    """Spectral radius of `multirate_map`."""
    return radius_of(multirate_map(plant, timing, delay_s=delay_s, predictor=predictor))


def lifted_growth(plants: Sequence[SampledPlant], timing: Timing, *, delay_s: float) -> float:
    """`multirate_growth_rate` (1/s) at a mean loop delay (s), from the blocks' plants over a common period."""
    if timing.commands == 1:
        radius = max(block_radius(plant, seconds("delay_s", delay_s)) for plant in plants)
    else:
        radius = max(lifted_radius(plant, timing, delay_s=delay_s) for plant in plants)
    return rate_of(radius, timing.common_s)


def is_nearly_continuous(timing: Timing, *, near_s: float) -> bool:
    """Whether a margin near `near_s` is so long that only the mean loop delay and the mean hold time matter."""
    return _MOST_PERIODS * timing.held_s < near_s < inf


def lifted_margin(plants: Sequence[SampledPlant], timing: Timing, *, near_s: float) -> float:
    """`multirate_delay_margin` from the blocks' plants; `near_s` is the margin of the continuous loop."""
    known_s = near_s if isfinite(near_s) else 0.0
    last_s = _SEARCHED_MARGINS * known_s + _SEARCHED_PERIODS * timing.held_s
    step_s = max(timing.held_s / _LOOKS, known_s / _LOOKS_MARGIN)
    looks = (timing.spread_s + np.arange(0.0, last_s, step_s)).tolist()
    least_s = inf
    for plant in plants:
        # without feedback one delay is enough; delays beyond another plant's margin do not matter
        seen = [look for look in looks if look < least_s + step_s] if plant.K.any() else looks[:1]
        found_s = first_unstable(
            lambda delay_s, plant=plant: lifted_radius(plant, timing, delay_s=delay_s), seen, timing
        )
        least_s = min(least_s, found_s)
    return least_s


def _merged(instants: list[float], close_s: float) -> list[float]:
    """The instants in ascending order, those within rounding of each other merged."""
    merged: list[float] = []
    for instant in sorted(instants):
        if not merged or instant - merged[-1] > close_s:
            merged.append(instant)
    return merged


def first_unstable(radius: Callable[[float], float], looks: Sequence[float], timing: Timing) -> float:
    """The least mean loop delay at which the radius reaches one: 0 if at the first of `looks`, `inf` if at none.

    `looks` are ascending delays (s). The radius has a kink wherever a command starts to act just as a state is sampled.
    Where it comes near one, it is also computed at every kink and at three delays in each gap: it may pass one and
    return within a single step of `looks`.
    """
    near, met, radii = _NEAR_ONE_COMMAND**timing.commands, list[tuple[float, float]](), list[float]()
    for i, look in enumerate(looks):
        radii.append(radius(look))
        found, highest, change = (look, radii[i]), max(radii[-2:]), max(radii[-3:]) - min(radii[-3:])
        closely = i > 0 and highest > near and highest + _CHANGES * change > 1.0
        closer = _closer_looks(looks[i - 1], look, timing) if closely else []
        for delay_s, at in chain(((delay_s, radius(delay_s)) for delay_s in closer), [found]):
            met.append((delay_s, at))
            if at >= 1.0:
                return _edge(radius, met[-2][0], delay_s) if len(met) > 1 else 0.0
            *_, (first_s, first), (_, middle), (last_s, last) = [(0.0, inf)] * 2 + met
            if middle > _NEAR_ONE and first < middle > last:  # a peak between these
                [peak_s] = peaks(np.vectorize(radius, [float]), np.array([first_s]), np.array([last_s])).tolist()
                if radius(peak_s) >= 1.0:
                    return _edge(radius, first_s, peak_s)
    return inf


def _closer_looks(after_s: float, before_s: float, timing: Timing) -> list[float]:
    """The kinks of the radius between two delays, and three delays in each gap.

    Where kinks are dense, each moves few of many commands and hardly shows, so they are left out.
    """
    ends = [after_s, before_s]
    if timing.step_s > _DENSE * (before_s - after_s):
        first, last = (int((delay_s - timing.spread_s) / timing.step_s) for delay_s in ends)
        kinks = (timing.spread_s + timing.step_s * np.arange(first, last + 2)).tolist()
        ends[1:1] = [kink_s for kink_s in kinks if after_s < kink_s < before_s]
    return np.concatenate([np.linspace(one, other, 5)[:-1] for one, other in pairwise(ends)])[1:].tolist()


def _edge(radius: Callable[[float], float], stable_s: float, unstable_s: float) -> float:
    met, missed = ((delay_s, 1.0 - radius(delay_s)) for delay_s in (stable_s, unstable_s))
    return met_end(lambda delay_s: 1.0 - radius(delay_s), met, missed, resolution=_RESOLUTION)


def effective_delay_s(commands: IntArray, *, held_s: float) -> float:
    """Effective delay: the constant loop delay (s) equivalent to a series of commands, from their mean age less T / 2.

    `commands` (k, 2) holds the instants in ns at which each command acted and at which its state was sampled, in order.
    T = `held_s` is the slower of the periods of telemetry and control. The acting command ages until one from a newer
    state acts, T / 2 on average if all arrive. Unlike the median of the loop delays, this accounts for lost commands.
    If delays change fast compared with the loop's motion, only the mean age matters, to first order.

    Every 20 ms a command acts whose state was sampled 0.1 s before; then one command is lost:

    >>> acted_ns = np.array([0, 20, 40, 60, 100]) * 1_000_000
    >>> commands = np.column_stack([acted_ns, acted_ns - 100_000_000])
    >>> [round(effective_delay_s(some, held_s=0.02), 6) for some in (commands[:4], commands)]
    [0.1, 0.104]
    """
    if len(commands) < 2:
        return 0.0
    acted_ns, sampled_ns = commands[:, 0], commands[:-1, 1]
    acting_s, late_s = np.diff(acted_ns) * 1e-9, (acted_ns[:-1] - sampled_ns) * 1e-9
    return float((acting_s * (late_s + acting_s / 2.0)).sum() / acting_s.sum()) - held_s / 2.0
