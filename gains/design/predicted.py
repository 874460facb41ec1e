"""Gains for a station that predicts over the loop delay: the search of `for_delay` with the figures of prediction.

Prediction removes the delay from the undisturbed loop, so the tolerated error of the assumed delay bounds the gains.
The requirement is a window of true delays, `Criteria.delays_s` with a `delay_rate` of 0, around the assumed delay
`Criteria.at_delay_s`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import exp, inf, log, sqrt

import numpy as np

from gains.core._bracketing import met_end
from gains.core.arrays import FloatArray
from gains.core.requirement import Criteria, Requirement
from gains.core.structure import positive_number, positive_seconds
from gains.criteria.predicted import PredictedFigures
from gains.design.for_delay import PatternGains, TreeGains, searched
from gains.design.time_scale import time_scaled
from gains.performance.flown import FlownTiming
from gains.performance.response import Response
from gains.performance.scalar_gains import PAIR, ScalarGains

_THINNED, _THINNED_PATTERN = 4, 10
# gains compared per search, without and with a response
_EVALUATIONS, _EVALUATIONS_RESPONSE = 160, 400
# mismatch assumed for the start of a search if none is required, as a share of the assumed delay
_TOLERATED = 0.2
# time scales at which gains on a pattern start, as multiples of the assumed delay
_SCALES = 0.2, 0.4, 0.8
# excess of the tolerance at the longest delay over the required one, relative; least tolerance distinguished from none
_CLOSE, _NOTHING_S = 1e-6, 1e-9


def least_gains(decay_rate_1_s: float, period_s: float) -> tuple[float, float]:
    """Return the least (k1, k3) with a decay rate, sampled and held without delay: a double root z = e^{-sigma T}.

    z^2 - (2 - k1 T - k3 T^2 / 2) z + 1 - k1 T + k3 T^2 / 2 has both roots within |z| <= p exactly if

        k1 T >= 1 - p^2 + k3 T^2 / 2   and   k3 T^2 / 2 >= (1 - p) (k1 T - 1 + p) / (1 + p),

    and the double root meets both with the least k1 and the least k3. With prediction, a loop decays like this at every
    delay and the window is about 1 / (k1 + k3 tau^) to either side, so no gains that decay as fast tolerate more.
    BadModelError if the rate or the period is not positive.

    >>> [round(gain, 3) for gain in least_gains(1.735, 0.02)]
    [3.381, 2.908]
    """
    p = exp(-positive_number("decay_rate_1_s", decay_rate_1_s) * positive_seconds("period_s", period_s))
    return (1.0 - p) * (3.0 + p) / (2.0 * period_s), ((1.0 - p) / period_s) ** 2


def longest_assumed_s(
    gains: ScalarGains, period_s: float, share: float, most_s: float, response: Response | None = None
) -> float:
    """Return the longest assumed delay (s), up to `most_s`, at which prediction tolerates a relative error of `share`.

    The loop is stable at every constant delay within this share of the assumed delay. 0 if not even at one period.

    >>> round(longest_assumed_s(ScalarGains(3.408, 0.631, 5.608, 0.0), 0.02, 0.05, 10.0), 2)
    1.6
    """

    def spare(log_s: float) -> float:
        assumed_s = exp(log_s)
        figures = PredictedFigures(PAIR, gains.K, period_s, assumed_s, (assumed_s,), response=response)
        return log(max(_NOTHING_S, figures.proved_spread_s(assumed_s, 0.0)) / (share * assumed_s))

    ends = [(at, spare(at)) for at in (log(period_s), log(most_s))]
    if ends[0][1] < 0.0:
        return 0.0
    return most_s if ends[1][1] >= 0.0 else exp(met_end(spare, *ends, resolution=_CLOSE))


def predicted_gains(
    wanted: Requirement, period_s: float, at_s: Sequence[float] | None = None, response: Response | None = None
) -> ScalarGains:
    """Return the gains of the inclusion principle that meet a requirement with prediction and have the best objective.

    `wanted.criteria.at_delay_s` is the assumed delay. Figures at a delay, and the α of the result, are the worst over
    the true delays `at_s`; None means no mismatch. Without a `response`, vehicles respond at once. Raises
    InfeasibleError as `searched` does.

    With a mismatch of 20 % to either side of 0.6 s, errors decay at 2.5 1/s, without prediction at 0.96 1/s at best:

    >>> from gains.core.requirement import Criteria, Requirement
    >>> criteria = Criteria(0.6, "decay_rate_at_delay_1_s", delays_s=(0.48, 0.72), delay_rate=0.0)
    >>> found = predicted_gains(Requirement(criteria=criteria), 0.02)
    >>> round(found.k1, 1), round(found.k3, 1)
    (5.0, 6.5)
    """
    criteria = wanted.criteria
    assert criteria is not None
    assert criteria.at_delay_s is not None
    tree = TreeGains(criteria.at_delay_s, FlownTiming(inf, period_s), criteria.weight, response=response)
    evaluations = _EVALUATIONS if response is None else _EVALUATIONS_RESPONSE
    point, figures = searched(PredictedTree(tree, at_s, _tolerated(criteria)), wanted, evaluations=evaluations)
    return replace(tree.gains(point), alpha=figures.alpha_at_delay)


def _tolerated(criteria: Criteria) -> float:
    """Half the width of the required window as a share of the assumed delay."""
    if criteria.delays_s is None or criteria.at_delay_s is None:
        return _TOLERATED
    return max(1e-3, (criteria.delays_s[1] - criteria.delays_s[0]) / 2.0 / criteria.at_delay_s)


@dataclass(frozen=True)
class PredictedTree:
    """The gain family `TreeGains` (k1, k2 and k3 of a vehicle behind another) with prediction over its delay."""

    tree: TreeGains
    at_s: Sequence[float] | None = None
    tolerated: float = _TOLERATED
    step: float = 0.2

    @property
    def starts(self) -> Sequence[FloatArray]:
        assert self.tree.delay_s is not None
        # the window is about 1 / (k1 + k3 tau^) to either side; a double root decays fastest; the largest alpha with a
        # string peak of 1 is near k3 = 0.45 k1^2, k2 = 0.27 k1
        found: list[FloatArray] = []
        for share, front, ratio in ((0.9, 0.3, 0.25), (0.6, 0.3, 0.25), (0.3, 0.3, 0.25), (1.0, 0.27, 0.45)):
            k1 = (sqrt(1.0 + 4.0 * ratio / self.tolerated) - 1.0) / (2.0 * ratio * self.tree.delay_s)
            found.append(np.array([log(share * k1 * self.tree.late_s), front, log(ratio)]))
        return found

    def figures(self, point: FloatArray) -> PredictedFigures:
        own = self.tree
        assert own.delay_s is not None
        K, period_s = own.gains(point).K, own.timing.period_s
        at_s = (own.delay_s,) if self.at_s is None else tuple(self.at_s)
        return PredictedFigures(PAIR, K, period_s, own.delay_s, at_s, own.weight, True, _THINNED, own.response)


@dataclass(frozen=True, eq=False)
class PredictedPattern:
    """The gain family `PatternGains` (free entries of K on a pattern) with prediction over its delay."""

    pattern: PatternGains
    step: float = 0.05

    @property
    def starts(self) -> Sequence[FloatArray]:
        own, delay_s = self.pattern, self.pattern.delay_s or 0.0
        slowest = [1.0 / float(np.abs(np.linalg.eigvals(own.model.A + own.model.B @ K)).min()) for K in own.bases]
        return [
            own.point(time_scaled(own.model, K, scale * delay_s / slow_s))
            for scale in _SCALES
            for K, slow_s in zip(own.bases, slowest, strict=True)
        ]

    def figures(self, point: FloatArray) -> PredictedFigures:
        own = self.pattern
        assert own.delay_s is not None
        K, period_s = own.gain(point), own.timing.period_s
        return PredictedFigures(
            own.model, K, period_s, own.delay_s, (own.delay_s,), own.weight, False, _THINNED_PATTERN
        )
