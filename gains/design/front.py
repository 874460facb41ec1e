"""The Pareto front at a loop delay: robustness, decay, string peak and disturbance gain, by every route.

At each delay and for each route, both ends of the front are searched: the gains with the largest α and those with the
fastest decay, with prediction over the delay and without. All must be stable at every constant delay within a share of
the delay to either side, so that neither way relies on exact knowledge of the delay.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from typing import Literal, NamedTuple

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.errors import GainsError
from gains.core.requirement import Criteria, Requirement
from gains.criteria.figures import LoopFigures
from gains.criteria.parts import Figures
from gains.criteria.predicted import PredictedFigures
from gains.design.for_delay import GainFamily, PatternGains, TreeGains, searched
from gains.design.graph import lqr_bases
from gains.design.predicted import PredictedPattern, PredictedTree
from gains.formation.model import FormationModel
from gains.formation.pattern import Pattern
from gains.performance.flown import FlownTiming
from gains.performance.response import Response

Method = Literal["inclusion", "graph-lqr"]
Aim = Literal["alpha_at_delay", "decay_rate_at_delay_1_s"]
AIMS: tuple[Aim, Aim] = "alpha_at_delay", "decay_rate_at_delay_1_s"
# gains compared per search; α is within about 2 % of that of a search three times as long
_EVALUATIONS: dict[Method, int] = {"inclusion": 120, "graph-lqr": 40}
# the same by inclusion with a response, where the fastest decay has more roots side by side
_EVALUATIONS_RESPONSE = 300
# figures that differ by no more than this share count as equal
_ALIKE = 1e-3


class Route(NamedTuple):
    """A design method, with or without prediction, and the end of the front to search."""

    method: Method
    predicted: bool
    aim: Aim


@dataclass(frozen=True, eq=False)
class FrontPoint:
    """The gains that a route finds for a loop delay, and their figures there; K (inputs, states) is of one axis.

    `alpha` and `spacing_gain_s2` are of the whole formation; `alpha_design` is the α that the method reports, for
    inclusion that of one follower. `stable_s` is the range of constant delays around this one in which the loop is
    stable. `is_efficient`: no other point at this delay is as good in α, decay, string peak and disturbance gain, and
    better in one of them. `string_peak` is None if errors run both ways.
    """

    route: Route
    delay_s: float
    K: FloatArray
    alpha: float
    alpha_design: float
    decay_rate_1_s: float
    string_peak: float | None
    spacing_gain_s2: float
    noise_gain: float
    stable_s: tuple[float, float]
    is_efficient: bool = True


class Refusal(NamedTuple):
    """Why a route has no point at a delay."""

    route: Route
    delay_s: float
    reason: str


@dataclass(frozen=True, eq=False)
class FrontSearch:
    """Search for the points of a front. `tolerated` is the share by which the delay may differ from the design delay.

    With a `response`, common to all vehicles, the front consists of gains by inclusion only.
    """

    formation: FormationModel
    pattern: Pattern
    period_s: float
    tolerated: float = 0.2
    string_peak_max: float | None = 1.0
    response: Response | None = None

    def point(self, at: tuple[Route, float]) -> FrontPoint | Refusal:
        """The point of a route at a loop delay (s), or why there is none."""
        route, delay_s = at
        family, gain = self._family(route, delay_s)
        evaluations = _EVALUATIONS[route.method] if self.response is None else _EVALUATIONS_RESPONSE
        try:
            point, found = searched(family, self.wanted(route, delay_s), evaluations=evaluations)
        except GainsError as error:
            return Refusal(route, delay_s, str(error))
        return self._point(route, delay_s, gain(point), found)

    @cached_property
    def _graph(self) -> PatternGains:
        """The family of gains on the pattern, with the LQR gains from which searches start."""
        return lqr_bases(self.formation, self.pattern)

    def wanted(self, route: Route, delay_s: float) -> Requirement:
        """The requirement on the gains at a delay."""
        around_s = (1.0 - self.tolerated) * delay_s, (1.0 + self.tolerated) * delay_s
        criteria = Criteria(delay_s, route.aim, delays_s=around_s, delay_rate=0.0)
        return Requirement(criteria=criteria, string_peak_max=self.string_peak_max)

    @cached_property
    def _single(self) -> FormationModel:
        return FormationModel(self.formation.predecessors, axes=1)

    def _family(self, route: Route, delay_s: float) -> tuple[GainFamily, Callable[[FloatArray], FloatArray]]:
        """The gain family of a route, and the function from its points to K of the whole formation."""
        timing = FlownTiming(inf, self.period_s)
        if route.method == "graph-lqr":
            gains = replace(self._graph, delay_s=delay_s, timing=timing)
            return PredictedPattern(gains) if route.predicted else gains, gains.gain
        tree = TreeGains(delay_s, timing, response=self.response)
        family = PredictedTree(tree, tolerated=self.tolerated) if route.predicted else tree
        return family, lambda point: tree.gains(point).gain_of(self._single)

    def _point(self, route: Route, delay_s: float, K: FloatArray, found: Figures) -> FrontPoint:
        single, response = self._single, self.response
        if route.predicted:
            whole = PredictedFigures(single, K, self.period_s, delay_s, (delay_s,), response=response)
            stable_s = whole.window_s
        else:
            every = None if response is None else (response,) * single.vehicles
            whole = LoopFigures(single, K, FlownTiming(inf, self.period_s), delay_s, responses=every)
            stable_s = 0.0, whole.delay_margin_s
        return FrontPoint(
            route=route,
            delay_s=delay_s,
            K=K,
            alpha=whole.alpha_at_delay,
            alpha_design=found.alpha_at_delay,
            decay_rate_1_s=found.decay_rate_at_delay_1_s,
            string_peak=found.string_peak if route.method == "inclusion" else None,
            spacing_gain_s2=whole.spacing_gain_max_s2,
            noise_gain=whole.noise_gain_max,
            stable_s=stable_s,
        )


def efficient(points: Sequence[FrontPoint]) -> list[FrontPoint]:
    """The points with `is_efficient` set by comparison with the others at the same delay."""
    return [
        replace(own, is_efficient=not any(_beats(other, own) for other in points if other.delay_s == own.delay_s))
        for own in points
    ]


def _beats(other: FrontPoint, own: FrontPoint) -> bool:
    pairs = [
        (other.alpha, own.alpha),
        (other.decay_rate_1_s, own.decay_rate_1_s),
        (own.spacing_gain_s2, other.spacing_gain_s2),
    ]
    if other.string_peak is not None and own.string_peak is not None:
        pairs.append((own.string_peak, other.string_peak))
    better = np.array([mine / yours for mine, yours in pairs])
    return bool((better >= 1.0 - _ALIKE).all() and (better > 1.0 + _ALIKE).any())
