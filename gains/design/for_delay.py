"""Search for gains that are best at a loop delay; all such searches are here.

Gains with a margin of twice a delay are not the best at that delay: at 0.3 s and 50 Hz they decay at 1.40 1/s there and
withstand α = 0.508; gains searched for the delay decay at 1.89 1/s, or withstand 0.632. The search ranks gains by the
figures of `gains.criteria.figures` at the delay: first by their shortfall from the requirement, then by the objective.
The gains with the fastest decay are known in closed form, and every search includes them in its starts.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from math import exp, inf, log, sqrt
from typing import Protocol

import numpy as np

from gains.core._evolution import Rank, best_of, first_of
from gains.core.arrays import BoolArray, FloatArray
from gains.core.errors import InfeasibleError
from gains.core.requirement import Requirement
from gains.core.structure import positive_number, positive_seconds
from gains.criteria.figures import LoopFigures
from gains.criteria.parts import Figures, Part, parts_of
from gains.delay.constant import delay_margin
from gains.design.time_scale import time_scaled
from gains.formation.model import FormationModel
from gains.performance.flown import FlownLoop, FlownTiming
from gains.performance.response import Response, formation_loop
from gains.performance.scalar_gains import PAIR, ScalarGains
from gains.sampled._loop import HeldPlant, held_entry
from gains.sampled.multirate import Timing, multirate_growth_rate

Reached = tuple[FloatArray, Figures]
"""A point of a family and its exact figures."""

# Gains compared per search: for each free entry, and the least and the most for any family.
_EVALUATIONS_EACH, _EVALUATIONS_LEAST, _EVALUATIONS_MOST = 50, 320, 1280
# Most searches until gains that meet the requirement with rough figures also meet it with exact ones.
_AIMS = 4
# A search over more than a few entries is repeated from its best point with steps divided by these: it may have started
# so close to the optimum that nearly all first draws were worse.
_FEW, _FINER = 3, (4.0, 16.0)
# While searching, frequencies are thinned by this factor; peaks are refined all the same.
_THINNED = 4
# Without delay and hold, gains have no scale of their own: the search starts at the scale of this delay.
_NO_DELAY_S = 0.1
# Shares by which several parts are relaxed together, as multiples of the largest shortfall of the nearest gains.
_SHARES = 1.0, 1.5, 2.0, 3.0
# shortfall, as a logarithm, from which no advice on relaxing is possible: the figure is out of reach
_HOPELESS = 100.0
# shortfall of an unstable loop
_UNSTABLE = 1e4
# added to the shortfall of a loop that misses a part that is quick to compute; exceeds the shortfall in any slow part
_SLOW_PARTS = 2e3
# margins at which gains on a pattern start, as multiples of the delay plus half a hold
_SPARES = 1.5, 2.0, 3.0, 6.0, 12.0
# values of k1 at which gains behind another vehicle start, as multiples of the fastest ones at the delay
_SCALES = 1.0, 1.7, 0.3, 0.1
_FASTEST = 2.0 - sqrt(2.0)
# With a response: number of frequencies of a root at the wanted decay, up to this many times the decay; by how much
# (1/s) rounding may make another root slower; resolution of the delay.
_FREQUENCIES, _HIGHEST, _NO_SLOWER, _RESOLUTION_S = 100, 5.0, 1e-6, 1e-4


def fastest_at_delay(late_s: float) -> tuple[float, float]:
    """Return the (k1, k3) for which s² + (k1 s + k3) e^{−s late} decays fastest: a triple root at −(2 − √2) / late.

    Raises BadModelError if the delay is not positive.

    >>> [round(gain, 4) for gain in fastest_at_delay(0.31)]
    [1.4876, 0.8233]
    """
    positive_seconds("late_s", late_s)
    x = -_FASTEST
    k1 = -x * (2.0 + x) * exp(x)
    return k1 / late_s, -(x * x * exp(x) + k1 * x) / late_s**2


def longest_static_delay(
    decay_1_s: float, period_s: float, response: Response | None = None
) -> tuple[float, ScalarGains]:
    """Return the longest loop delay (s) at which static gains decay at a rate (1/s), and these gains, with k2 = 0.

    If the delay is 0 or less, no gains decay this fast. If vehicles respond at once, `fastest_at_delay` gives it, and a
    hold counts as half a period. With a `response` the loop is sampled and held: the equation for a root at
    (-decay + j w) is linear in (k1, k3); the delay is raised while the gains of some w of a grid have no slower root.

    A lag of 0.15 s costs nearly half of the delay:

    >>> from gains import Response
    >>> lag = Response(lag_s=0.15, velocity_gain_1_s=2.0)
    >>> [round(longest_static_delay(1.0, 0.02, response)[0], 3) for response in (None, lag)]
    [0.576, 0.315]

    Raises BadModelError if the decay rate or the period is not positive.
    """
    longest_s = _FASTEST / positive_number("decay_1_s", decay_1_s) - positive_seconds("period_s", period_s) / 2.0
    if response is None or longest_s <= 0.0:
        k1, k3 = fastest_at_delay(longest_s + period_s / 2.0)
        return longest_s, ScalarGains(k1, 0.0, k3, 0.0)
    A, B, K = formation_loop(PAIR, np.zeros((2, 3)), (response, response))
    plant, timing = HeldPlant(A, B, K, period_s), Timing(period_s, period_s)
    z = np.exp((1j * np.linspace(0.0, _HIGHEST, _FREQUENCIES + 1)[1:] - 1.0) * decay_1_s * period_s)[:, None, None]
    resolvent = np.linalg.inv(z * np.eye(len(A)) - plant.transition(np.array([period_s]))[0])

    def gains_at(delay_s: float) -> ScalarGains | None:
        answers = (resolvent @ held_entry(plant, z, delay_s))[:, 1:3, 1]  # spacing and velocity of the follower
        each = np.linalg.solve(np.stack([answers.real, answers.imag], axis=1), np.array([[1.0], [0.0]]))[..., 0]
        for k3, k1 in each[(each[:, 0] > 0.0) & (each[:, 1] < 0.0)]:
            own = ScalarGains(-float(k1), 0.0, float(k3), 0.0)
            loop = formation_loop(PAIR, own.K, (response, response))
            if multirate_growth_rate(*loop, timing, delay_s=delay_s) < _NO_SLOWER - decay_1_s:
                return own
        return None

    least_s, beyond_s, found = 0.0, inf, gains_at(0.0)
    while found is not None and beyond_s - least_s > _RESOLUTION_S:
        middle_s = least_s + longest_s / 2.0 if beyond_s == inf else (least_s + beyond_s) / 2.0
        better = gains_at(middle_s)
        least_s, beyond_s = (least_s, middle_s) if better is None else (middle_s, beyond_s)
        found = better or found
    return least_s, found or ScalarGains(0.0, 0.0, 0.0, 0.0)


def criteria_gains(wanted: Requirement, period_s: float, response: Response | None = None) -> ScalarGains:
    """Return the gains of the inclusion principle that meet a requirement with criteria and have the best objective.

    They are the same for every vehicle of a leader-follower tree of any size. Each vehicle has the `response`, or
    responds at once. Commands are held for `period_s`, which counts as half a period of delay. The α of the result is
    the one at the delay. BadModelError if the period is not positive; InfeasibleError if no gains were found, saying
    how far each part alone would have to be relaxed.

    The gains with the fastest decay at 0.3 s and 50 Hz:

    >>> from gains.core.requirement import Criteria, Requirement
    >>> fastest = Criteria(at_delay_s=0.3, maximise="decay_rate_at_delay_1_s")
    >>> found = criteria_gains(Requirement(criteria=fastest), 0.02)
    >>> round(found.k1, 2), round(found.k3, 2)
    (1.49, 0.82)
    """
    criteria = wanted.criteria
    assert criteria is not None
    timing = FlownTiming(inf, positive_seconds("period_s", period_s))
    tree = TreeGains(criteria.at_delay_s, timing, criteria.weight, criteria.discrete, response)
    point, figures = searched(tree, wanted)
    return replace(tree.gains(point), alpha=figures.alpha_at_delay)


class GainFamily(Protocol):
    """A family of gains to search, parametrised by points."""

    @property
    def step(self) -> float:
        """Standard deviation of the first draws."""
        ...

    @property
    def starts(self) -> Sequence[FloatArray]:
        """Points at which to start; the search begins at the best of them."""
        ...

    def figures(self, point: FloatArray) -> Figures:
        """The figures of the gains at a point."""
        ...


def _late_s(delay_s: float | None, timing: FlownTiming) -> float:
    return (delay_s or _NO_DELAY_S) + timing.period_s / 2.0


@dataclass(frozen=True)
class TreeGains:
    """k1, k2 and k3 of a vehicle behind another; a point is (ln(k1 late), k2 / k1, ln(k3 / k1²)).

    Without a `response`, vehicles respond at once.
    """

    delay_s: float | None
    timing: FlownTiming
    weight: tuple[float, float] | None = None
    discrete: bool = False
    response: Response | None = None
    step: float = 0.3

    @property
    def late_s(self) -> float:
        """The delay plus half a hold and roughly the delay of the response."""
        slow_s = 0.0 if self.response is None else self.response.lag_s + self.response.dead_time_s
        return _late_s(self.delay_s, self.timing) + slow_s

    @property
    def starts(self) -> Sequence[FloatArray]:
        k1, k3 = fastest_at_delay(self.late_s)
        return [np.array([log(scale * k1 * self.late_s), 0.2, log(k3 / k1**2)]) for scale in _SCALES]

    def gains(self, point: FloatArray) -> ScalarGains:
        """The gains at a point; their α is not computed and set to 0."""
        first, share, last = (float(entry) for entry in np.clip(point, -20.0, 20.0))
        k1 = exp(first) / self.late_s
        return ScalarGains(k1, share * k1, exp(last) * k1**2, 0.0)

    def figures(self, point: FloatArray) -> LoopFigures:
        chain = FlownLoop(self.gains(point), self.timing, self.response)
        K, responses = chain.pair.K, chain.pair.responses
        weight, discrete = self.weight, self.discrete
        return LoopFigures(PAIR, K, self.timing, self.delay_s, weight, responses, chain, discrete, _THINNED)


@dataclass(frozen=True, eq=False)
class PatternGains:
    """The free entries of K on a pattern, for one axis; a point holds them in units of the delay plus half a hold."""

    model: FormationModel
    mask: BoolArray
    bases: tuple[FloatArray, ...]
    """Stabilising gains (inputs, states) at which to start, in several time scales."""
    delay_s: float | None
    timing: FlownTiming
    weight: tuple[float, float] | None = None
    discrete: bool = False
    step: float = 0.05

    @cached_property
    def _units(self) -> FloatArray:
        """Unit of each entry of a point: 1 / late for velocity errors, 1 / late² for spacing errors."""
        late_s = _late_s(self.delay_s, self.timing)
        units = np.full(self.mask.shape, 1.0 / late_s)
        units[:, self.model.spacing_mask] /= late_s
        return units

    @property
    def starts(self) -> Sequence[FloatArray]:
        late_s = _late_s(self.delay_s, self.timing)
        margins = [delay_margin(self.model.A, self.model.B @ base) for base in self.bases]
        scaled = (
            time_scaled(self.model, base, spare * late_s / margin_s)
            for base, margin_s in zip(self.bases, margins, strict=True)
            for spare in _SPARES
        )
        tree = TreeGains(self.delay_s, self.timing)
        # the starts for a vehicle behind another, given to every vehicle
        own = [tree.gains(point).gain_of(self.model) for point in tree.starts]
        return [self.point(K) for K in (*scaled, *own)]

    def point(self, K: FloatArray) -> FloatArray:
        """The point of a K with the pattern."""
        return (K / self._units)[self.mask]

    def gain(self, point: FloatArray) -> FloatArray:
        K = np.zeros(self.mask.shape)
        K[self.mask] = point
        return K * self._units

    def figures(self, point: FloatArray) -> LoopFigures:
        K, discrete = self.gain(point), self.discrete
        return LoopFigures(self.model, K, self.timing, self.delay_s, self.weight, discrete=discrete, thinned=_THINNED)


def searched(family: GainFamily, wanted: Requirement, *, evaluations: int | None = None) -> Reached:
    """Return the point of a family that meets a requirement with criteria and has the best objective, with its figures.

    `evaluations` is the number of gains compared; if None, it grows with the number of free entries. InfeasibleError if
    no gains were found that are stable and meet the requirement; the message says how far each part alone, or several
    together, must be relaxed. A requirement relaxed as advised is met: the search finds the same gains again.
    """
    assert wanted.criteria is not None
    objective = wanted.criteria.objective or ("alpha" if wanted.delay_margin_s is not None else "delay_margin_s")
    parts = parts_of(wanted)
    aim = Part(objective, 0.0, True)
    found = _best(family, parts, aim, family.starts, evaluations)
    if _meets(found[1], parts):
        return found
    most: list[Reached] = []
    for part in parts:
        most.append(_most(family, part, parts, evaluations))
        if _meets(most[-1][1], parts):
            better = _best(family, parts, aim, [most[-1][0]], evaluations)
            return better if _meets(better[1], parts) else most[-1]
    if not parts:
        raise InfeasibleError(f"found no stable gains at at_delay_s = {wanted.criteria.at_delay_s}; try a shorter one")
    raise InfeasibleError(_refusal(family, parts, most, found[1]))


def _refusal(family: GainFamily, parts: Sequence[Part], most: Sequence[Reached], nearest: Figures) -> str:
    """Message naming the parts in conflict, and how far to relax each alone, or several if none alone is enough."""
    named = " and ".join(f"{part.name} = {part.wanted_text}" for part in parts)
    conflict = "exclude each other" if len(parts) > 1 else "cannot be reached"
    alone = [_relaxed(part, reached, parts) for part, reached in zip(parts, most, strict=True)]
    advice = " or ".join(part.advice for part in alone if part) or _together(family, parts, nearest)
    return f"{named} {conflict}: {advice or 'relax more than one of them'}"


def _relaxed(part: Part, reached: Reached, parts: Sequence[Part]) -> Part | None:
    """The part relaxed to what the gains reach; None if they miss another part."""
    _, figures = reached
    return part.relaxed(figures) if _meets(figures, [other for other in parts if other is not part]) else None


def _together(family: GainFamily, parts: Sequence[Part], nearest: Figures) -> str:
    """Advice to relax all parts that the nearest gains miss: by a common share, the last as far as still needed."""
    short = [part.shortfall(nearest) for part in parts]
    for share in (max(short) * times for times in _SHARES if max(short) < _HOPELESS):
        eased = [part.eased(share) if each > 0.0 else part for part, each in zip(parts, short, strict=True)]
        *missed, last = [part for part, each in zip(eased, short, strict=True) if each > 0.0]
        if (found := _relaxed(last, _most(family, last, eased), eased)) is not None:
            return " and ".join(part.advice for part in (*missed, found))
    return ""


def _most(family: GainFamily, part: Part, parts: Sequence[Part], evaluations: int | None = None) -> Reached:
    """The gains that reach most in one part among those that meet all others.

    The value wanted of the part has no influence, so a requirement for what they reach leads to the same gains.
    """
    return _best(family, [other for other in parts if other is not part], part, family.starts, evaluations)


def _best(
    family: GainFamily,
    parts: Sequence[Part],
    aim: Part,
    starts: Sequence[FloatArray],
    evaluations: int | None,
) -> Reached:
    """The gains of least cost that meet the parts, or the nearest to them, searched from the best of the starts.

    Figures are rough during the search. It is repeated with tighter limits if exact figures miss a part.
    """
    limits, some_meet = parts, False
    enough = min(max(_EVALUATIONS_EACH * starts[0].size, _EVALUATIONS_LEAST), _EVALUATIONS_MOST)

    def bounds(point: FloatArray) -> Iterator[Rank]:
        nonlocal some_meet
        figures, meets = family.figures(point), True
        # once some gains meet the limits, a quick cost may reject others before their shortfalls are computed
        if some_meet and aim.name == "alpha_at_delay":
            yield 0.0, -figures.alpha_at_delay_most
        elif some_meet and not aim.is_slow:
            yield 0.0, cost(figures)
        for short in _shortfalls(figures, limits):
            meets = False
            yield short, inf
        if meets:
            some_meet = True
            yield 0.0, cost(figures)

    def cost(figures: Figures) -> float:
        return aim.figure(figures) * (-1.0 if aim.at_least else 1.0)

    for turn in count(1):
        [(_, best)] = first_of(bounds, starts, 1)
        point, reached = best_of(bounds, starts[best], step=family.step, evaluations=evaluations or enough)
        for finer in _FINER if evaluations is None and starts[0].size > _FEW else ():
            point, reached = best_of(bounds, point, step=family.step / finer, evaluations=enough)
        exact = family.figures(point).exact
        if turn == _AIMS or reached[0] > 0.0 or _meets(exact, parts):
            return point, exact
        limits = [own.tightened(part.shortfall(exact)) for own, part in zip(limits, parts, strict=True)]
    raise AssertionError


def _meets(figures: Figures, parts: Sequence[Part]) -> bool:
    return next(_shortfalls(figures, parts), None) is None


def _shortfalls(figures: Figures, parts: Sequence[Part]) -> Iterator[float]:
    """Lower bounds on the shortfall by which gains are ranked; none if they meet all parts.

    The largest bound is that shortfall: the largest in any part, raised if a quick part is missed, and more for an
    unstable loop. Parts that are slow to compute are evaluated only if all others are met.
    """
    if figures.decay_rate_1_s <= 0.0:
        yield _UNSTABLE - figures.decay_rate_1_s
        return
    quick, slow = ([part for part in parts if part.is_slow is is_slow] for is_slow in (False, True))
    for part in quick:
        if (short := part.shortfall(figures)) > 0.0:
            slow = []
            yield _SLOW_PARTS + short
    for part in slow:
        if (short := part.shortfall(figures)) > 0.0:
            yield short
    if not figures.is_stable_at_delay:
        yield _UNSTABLE - figures.decay_rate_at_delay_1_s
