"""What a design must reach, and the plain types in which designs are written to JSON.

`gains.design.design` turns a requirement into gains.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf
from numbers import Real
from typing import Any, Literal, get_args

import numpy as np

from gains.core.errors import BadModelError

DEFAULT_DELAY_MARGIN_S = 0.3
# Below this α, and above this margin, the numbers in a proof spread too far for the solver.
ALPHA_MIN, DELAY_MARGIN_MAX_S = 5e-4, 30.0


@dataclass(frozen=True)
class ChainLimit:
    """How much spacing errors may grow from one vehicle to the next, and the loop in which they do."""

    peak: float | None = None
    """None: without limit."""
    loop: Literal["ground", "onboard"] = "ground"
    """On board only the errors of others are late."""
    feed_forward: float = 0.0
    """Share of the command of the vehicle in front that each follower adds to its own."""


UNLIMITED = ChainLimit()


Objective = Literal["alpha", "decay_rate_1_s", "alpha_at_delay", "decay_rate_at_delay_1_s", "delay_margin_s"]


@dataclass(frozen=True)
class Criteria:
    """What a design must reach besides the parts of `Requirement`; None is no requirement.

    A figure at a delay is that of the loop as flown (`gains.performance.flown`): late by the delay and half a control
    period, or with `discrete` held for one. BadModelError if a number is out of its range, or a figure at a delay is
    asked for without the delay.

    >>> Criteria(at_delay_s=0.3, alpha_at_delay=0.5).objective, Criteria(damping_min=0.7).objective
    ('alpha_at_delay', None)
    """

    at_delay_s: float | None = None
    """Loop delay (s) of the figures at a delay. Gains are then searched for this delay."""
    maximise: Objective | None = None
    """The figure that is made best among the gains that meet the rest. If None: `alpha_at_delay` if there is a delay,
    otherwise as `Requirement` says."""
    alpha_at_delay: float | None = None
    """Least α (1/s) at the delay."""
    decay_rate_at_delay_1_s: float | None = None
    """Least decay rate (1/s) at the delay."""
    damping_min: float | None = None
    """Least damping ratio of every root without delay, at most 1."""
    natural_frequency_max_rad_s: float | None = None
    """Largest natural frequency |s| of every root without delay."""
    spacing_gain_max_s2: float | None = None
    """Largest H∞ gain (s²) from disturbing accelerations to spacing errors, at the delay, without one if none is
    given."""
    noise_gain_max: float | None = None
    """Largest H2 gain from measurement noise to commands: the standard deviation of the noisiest command (m/s²) where
    every error is measured with white noise of standard deviation 1 (m, m/s), at the delay."""
    delays_s: tuple[float, float] | None = None
    """The loop delays (least, largest) between which the loop must be proved stable."""
    delay_rate: float | None = None
    """How fast the delay varies between them, s/s: 0 if it is constant but not known, None if it jumps."""
    discrete: bool = False
    """Whether decay rate and α at the delay are those of the sampled and held loop itself, at any control period."""
    weight: tuple[float, float] | None = None
    """Weights of spacing errors and of velocity errors, the diagonal of W: every α then bounds |w| ≤ α |W E|."""

    def __post_init__(self) -> None:
        _check_positive(self, _POSITIVE)
        if self.maximise not in (None, *(known := get_args(Objective))):
            raise BadModelError(f"maximise = {self.maximise!r}; wanted one of {', '.join(known)}")
        if self.damping_min is not None and self.damping_min > 1.0:
            raise BadModelError(f"damping_min = {self.damping_min}; wanted at most 1")
        for name in (*AT_DELAY, "discrete"):
            if self.at_delay_s is None and (getattr(self, name) or self.maximise == name):
                raise BadModelError(f"{name} is asked for without a delay; wanted at_delay_s")
        low, high = self.delays_s or (0.0, 0.0)
        if not 0.0 <= low <= high < inf:
            raise BadModelError(f"delays_s = {self.delays_s}; wanted two numbers of seconds, the smaller one first")
        if self.delay_rate is not None and not 0.0 <= self.delay_rate < inf:
            raise BadModelError(f"delay_rate = {self.delay_rate}; wanted a number >= 0, none for a delay that jumps")
        if self.weight is not None and not all(0.0 < entry < inf for entry in self.weight):
            raise BadModelError(f"weight = {self.weight}; wanted two positive numbers")

    @property
    def objective(self) -> Objective | None:
        """The figure to make best; None if the rest of the requirement decides it."""
        return self.maximise or ("alpha_at_delay" if self.at_delay_s is not None else None)


AT_DELAY = "alpha_at_delay", "decay_rate_at_delay_1_s"
_POSITIVE = (
    "at_delay_s", *AT_DELAY, "damping_min", "natural_frequency_max_rad_s", "spacing_gain_max_s2", "noise_gain_max",
)  # fmt: skip


def _check_positive(record: object, names: Iterable[str]) -> None:
    for name in names:
        wanted = getattr(record, name)
        if wanted is not None and not (isinstance(wanted, Real) and 0.0 < float(wanted) < inf):
            raise BadModelError(f"{name} = {wanted}; wanted a positive number")


@dataclass(frozen=True)
class Requirement:
    """What the design must reach.

    With `delay_margin_s` the design makes α as large as possible, and must reach `alpha` and `decay_rate_1_s` if they
    are given. Without it, the delay margin is made as large as these two allow. With none of the three, a margin of
    0.3 s is required. BadModelError if a number is out of its range.

    A delay margin of 0.3 s is wanted when nothing is given:

    >>> Requirement().delay_margin_s, Requirement(alpha=0.4).delay_margin_s
    (0.3, None)
    >>> Requirement(string_peak_max=1.2, loop="onboard").chain_limit
    ChainLimit(peak=1.2, loop='onboard', feed_forward=0.0)
    """

    delay_margin_s: float | None = None
    """Least sampled delay margin, up to 30 s."""
    alpha: float | None = None
    """Least sector bound, from 5e-4 (1/s)."""
    string_peak_max: float | None = None
    """Limit, at least 1, on the growth of spacing errors from vehicle to vehicle: in the ground loop without delay and
    at half the margin, in the onboard loop at every delay. 1 lets no error grow down the chain and costs little α. Not
    limited if None."""
    decay_rate_1_s: float | None = None
    """Least decay rate of the continuous loop without delay, 1/s."""
    loop: Literal["ground", "onboard"] = "ground"
    """The loop that is flown. On board a pattern without cycles takes any delay; `delay_margin_s` then limits each
    vehicle's own gains, as if a ground station closed their loops. On a pattern with cycles the onboard loop must have
    this margin too."""
    feed_forward: float = 0.0
    """Share, 0 to 1, of the command of the vehicle in front that each follower adds to its own. It changes no margin
    and no decay, but alpha and the growth of spacing errors. In the ground loop, by inclusion and without criteria."""
    criteria: Criteria | None = None
    """What else must be reached. Gains are then searched by `gains.design.for_delay`."""

    def __post_init__(self) -> None:
        _check_positive(self, ("delay_margin_s", "alpha", "decay_rate_1_s"))
        if self.delay_margin_s is not None and self.delay_margin_s > DELAY_MARGIN_MAX_S:
            raise BadModelError(f"delay_margin_s = {self.delay_margin_s}; wanted at most {DELAY_MARGIN_MAX_S} s")
        if self.alpha is not None and self.alpha < ALPHA_MIN:
            raise BadModelError(f"alpha = {self.alpha}; wanted at least {ALPHA_MIN}")
        if self.string_peak_max is not None and not 1 <= self.string_peak_max < np.inf:
            raise BadModelError(f"string_peak_max = {self.string_peak_max}; wanted a number of at least 1")
        if self.loop not in ("ground", "onboard"):
            raise BadModelError(f"loop = {self.loop!r}; wanted ground or onboard")
        if not 0.0 <= self.feed_forward <= 1.0:
            raise BadModelError(f"feed_forward = {self.feed_forward}; wanted a number from 0 to 1")
        if self.feed_forward and (self.loop == "onboard" or self.criteria is not None):
            raise BadModelError(f"feed_forward = {self.feed_forward}; wanted 0 with criteria or the onboard loop")
        given = (self.delay_margin_s, self.alpha, self.decay_rate_1_s, self.criteria and self.criteria.at_delay_s)
        if all(wanted is None for wanted in given):
            object.__setattr__(self, "delay_margin_s", DEFAULT_DELAY_MARGIN_S)

    @property
    def chain_limit(self) -> ChainLimit:
        """`string_peak_max` as a limit in the loop that is flown."""
        return ChainLimit(self.string_peak_max, self.loop, self.feed_forward)


def plain(value: Any) -> Any:
    """`value` with lists and plain numbers in place of arrays, tuples and numpy numbers; None if not finite."""
    if isinstance(value, dict):
        return {str(name): plain(entry) for name, entry in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value
