"""All figures on which a requirement can set limits, for given gains at a loop delay."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from typing import Self

import numpy as np

from gains.core._bracketing import highest
from gains.core.arrays import ComplexArray, FloatArray, spectral_norms
from gains.core.structure import roots_of
from gains.criteria.norms import noise_gain, peak_gain
from gains.delay.constant import analyse_delay, delay_margin
from gains.delay.rightmost import rightmost_root
from gains.formation.model import FormationModel
from gains.performance.disturbed import DisturbedFormation
from gains.performance.flown import FlownFormation, FlownLoop, FlownTiming
from gains.performance.radii import SectorLoop
from gains.performance.response import Response, formation_loop
from gains.performance.robust import disturbance_bound
from gains.sampled.constant import growth_rate, sampled_delay_margin
from gains.sampled.onboard import own_part
from gains.varying.jitter import spread_bound


def pole_region(roots: ComplexArray) -> tuple[float, float]:
    """Return the least damping ratio −Re s / |s| and the largest |s| (rad/s) of roots (k,). A root at zero has ratio 0.

    This is for loops without delay: with delay a loop has infinitely many roots, and only the rightmost one counts
    (`gains.performance.behaviour`).

    s² + s + 1 has roots of magnitude 1 and damping ratio 1/2:

    >>> [round(value, 9) for value in pole_region(roots_of(np.array([[0.0, 1.0], [-1.0, -1.0]])))]
    [0.5, 1.0]
    """
    size = np.abs(roots)
    ratios = np.where(size > 0.0, -roots.real / np.where(size > 0.0, size, 1.0), 0.0)
    return float(ratios.min()), float(size.max())


class DelayFreeFigures:
    """Figures without delay, the same with and without prediction; a mix-in for dataclasses with these fields."""

    model: FormationModel
    K: FloatArray
    weight: tuple[float, float] | None
    thinned: int

    @cached_property
    def closed_loop(self) -> FloatArray:
        return self.model.A + self.model.B @ self.K

    @cached_property
    def decay_rate_1_s(self) -> float:
        """−Re of the rightmost root without delay."""
        return -float(self._roots.real.max())

    @cached_property
    def alpha(self) -> float:
        """α without delay."""
        return disturbance_bound(self.closed_loop, self.W)

    @property
    def damping_min(self) -> float:
        """Least damping ratio of a root without delay."""
        return pole_region(self._roots)[0]

    @property
    def natural_frequency_max_rad_s(self) -> float:
        """Largest natural frequency of a root without delay."""
        return pole_region(self._roots)[1]

    @cached_property
    def _roots(self) -> ComplexArray:
        return roots_of(self.closed_loop)

    @property
    def W(self) -> FloatArray:  # noqa: N802 - the source's letter
        """Diagonal matrix of the weights of the states."""
        spacing, velocity = self.weight or (1.0, 1.0)
        return np.diag(np.where(self.model.spacing_mask, spacing, velocity))


@dataclass(frozen=True, eq=False)
class LoopFigures(DelayFreeFigures):
    """Figures of a formation of one axis with a gain K (inputs, states) of u = K e, each computed when it is read.

    Figures at a delay are those of the loop as flown at `delay_s`; None stands for no delay and no hold. `weight` holds
    the weights of spacing and velocity errors, see `gains.core.requirement.Criteria`. If errors run down a chain of
    equal followers, `chain` is one of them. Figures without delay ignore responses, except `string_peak`.

    >>> lone = LoopFigures(FormationModel((-1,), axes=1), np.array([[-1.0]]), FlownTiming(np.inf, 0.02), 0.29)
    >>> round(lone.decay_rate_1_s, 6), round(lone.decay_rate_at_delay_1_s, 3), round(lone.alpha_at_delay, 3)
    (1.0, 1.631, 1.0)
    """

    model: FormationModel
    K: FloatArray
    timing: FlownTiming
    """Periods and place of the loop; its margin is not used."""
    delay_s: float | None = None
    weight: tuple[float, float] | None = None
    responses: tuple[Response, ...] | None = None
    chain: FlownLoop | None = None
    discrete: bool = False
    """Whether decay rate and α at the delay come from the map of one period, instead of half a hold as delay."""
    thinned: int = 1
    """Factor by which frequencies are thinned for rougher figures in a search; 1 is exact."""

    @property
    def exact(self) -> Self:
        """The same figures, computed exactly."""
        return replace(self, thinned=1)

    @cached_property
    def delay_margin_s(self) -> float:
        """Margin of the sampled loop with all feedback late; approximate in searches."""
        (A, B, K), period_s = formation_loop(self.model, self.K, self.responses), self.timing.period_s
        if self.decay_rate_1_s <= 0.0:
            return 0.0
        if self.thinned > 1:  # exact but for terms in the square of the period
            return max(delay_margin(A, B @ K) - period_s / 2.0, 0.0)
        return sampled_delay_margin(A, B, K, period_s=period_s)

    @cached_property
    def decay_rate_at_delay_1_s(self) -> float:
        """−Re of the rightmost root at the delay."""
        if self.delay_s is None:
            return self.decay_rate_1_s
        A, B, K = formation_loop(self.model, self.K, self.responses)
        if self.discrete:
            return -growth_rate(A, B, K, period_s=self.timing.period_s, delay_s=self.delay_s)
        own = np.zeros_like(K)
        own[:, : self.model.states] = own_part(self.model, self.K)
        own_s, late_s = self.timing.delays_s(self.delay_s)
        return -rightmost_root([(A, 0.0), (B @ own, own_s), (B @ (K - own), late_s)]).real

    @property
    def is_stable_at_delay(self) -> bool:
        """Whether the loop is stable at the delay; in searches by its margin if that is known already."""
        shared = self.thinned > 1 and not self.discrete and self.timing.all_late
        known_s = vars(self).get("delay_margin_s", 0.0) if shared else 0.0
        return known_s > (self.delay_s or 0.0) or self.decay_rate_at_delay_1_s > 0.0

    @cached_property
    def alpha_at_delay(self) -> float:
        """α at the delay; 0 if the loop is unstable there."""
        if self.delay_s is None:
            return self.alpha
        if not self.is_stable_at_delay:
            return 0.0
        if self.discrete:
            loop = formation_loop(self.model, self.K, self.responses)
            flown = DisturbedFormation(self.model, *loop, self.timing.period_s, self.delay_s)
            return SectorLoop(flown, tuple(range(self.model.states)), self.W).complex_radius().radius_1_s
        return 1.0 / highest(self._sensitivity, self._frequencies, self._scanned)[1]

    @cached_property
    def alpha_at_delay_most(self) -> float:
        """An upper bound on α at the delay, quick to compute; exact without delay."""
        if self.delay_s is None or self.discrete:
            return self.alpha_at_delay
        return 1.0 / float(self._scanned.max())

    @cached_property
    def _scanned(self) -> FloatArray:
        return self._sensitivity(self._frequencies)

    def _sensitivity(self, omega: FloatArray) -> FloatArray:
        """The largest gain from disturbances of the states to weighted errors at each frequency."""
        return spectral_norms(self.W @ np.linalg.inv(self._characteristic(omega)))

    @cached_property
    def spacing_gain_max_s2(self) -> float:
        """H∞ gain from disturbing accelerations to spacing errors; `inf` if the loop is unstable, 0 for one vehicle."""
        if not self.is_stable_at_delay:
            return inf
        if self.model.vehicles == 1:
            return 0.0
        outputs = np.eye(self.model.states)[self.model.spacing_mask]
        return peak_gain(self._characteristic, self.model.B, outputs, self._frequencies)

    @cached_property
    def noise_gain_max(self) -> float:
        """H2 gain from measurement noise to the noisiest command, in the ground loop; `inf` if it is unstable."""
        if not self.is_stable_at_delay:
            return inf
        loop = formation_loop(self.model, self.K, self.responses)
        return noise_gain(*loop, period_s=self.timing.period_s, delay_s=self.delay_s or 0.0)

    @cached_property
    def string_peak(self) -> float:
        """Largest growth of a spacing error per vehicle, without delay and at the delay; 1 if there is no chain."""
        if self.chain is None:
            return 1.0
        at_once = replace(self.chain, timing=replace(self.timing, period_s=0.0, step_s=0.0, loop="ground"))
        return max(at_once.string_peak(0.0), self.chain.string_peak(self.delay_s or 0.0))

    def proved_spread_s(self, mean_s: float, rate: float) -> float:
        """How far (s) the loop delay may deviate from a mean on both sides with the loop proved stable.

        With a `rate` of 0, the delay is constant but unknown, and the result is exact. Any other rate is covered by
        `gains.varying.jitter.spread_bound`, approximately in a search. 0 if the loop is unstable at the mean.
        """
        A, B, K = formation_loop(self.model, self.K, self.responses)
        late = B @ K
        middle_s = mean_s + self.timing.period_s / 2.0
        if rate > 0.0:
            # with several inputs the scaling takes minutes
            exact = self.thinned == 1 and self.model.vehicles == 2
            return spread_bound(A, late, mean_s=middle_s, rate=rate, scaled=exact)
        start_s, end_s = analyse_delay(A, late).window_around(middle_s) or (middle_s, middle_s)
        return min(mean_s if start_s == 0.0 else middle_s - start_s, end_s - middle_s)

    @cached_property
    def _flown(self) -> FlownFormation:
        timing = self.timing if self.delay_s is not None else FlownTiming(inf, 0.0)
        return FlownFormation(self.model, self.K, timing, self.responses)

    @cached_property
    def _frequencies(self) -> FloatArray:
        return self._flown.frequencies()[:: self.thinned]

    def _characteristic(self, omega: FloatArray) -> ComplexArray:
        return self._flown.characteristic(omega, self.delay_s or 0.0)
