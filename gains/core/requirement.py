"""Requirements of a design, and conversion to the plain types that JSON holds.

`gains.design.design` turns a requirement into gains.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf
from typing import Any, Literal, get_args

import numpy as np

from gains.core.errors import BadModelError
from gains.core.structure import is_number, of_type, shown

DEFAULT_DELAY_MARGIN_S = 0.3
# below this α, and above this margin, the numbers in a proof span too many decades for the solver
ALPHA_MIN, DELAY_MARGIN_MAX_S = 5e-4, 30.0


@dataclass(frozen=True)
class ChainLimit:
    """Limit on the growth of spacing errors from one vehicle to the next, and the loop it applies to."""

    peak: float | None = None
    """Largest growth; None for no limit."""
    loop: Literal["ground", "onboard"] = "ground"
    """The loop that is flown. On board, only the errors of other vehicles are late."""
    feed_forward: float = 0.0
    """Share of the command of the vehicle in front that each follower adds to its own."""


UNLIMITED = ChainLimit()


Objective = Literal["alpha", "decay_rate_1_s", "alpha_at_delay", "decay_rate_at_delay_1_s", "delay_margin_s"]


@dataclass(frozen=True)
class Criteria:
    """Requirements of a design beyond those of `Requirement`; None means not required.

    A figure at a delay belongs to the loop as flown (`gains.performance.flown`): delayed by the loop delay and half a
    control period, or with `discrete` held for a period. BadModelError if a number is out of range, or a figure at a
    delay is required without `at_delay_s`.

    >>> Criteria(at_delay_s=0.3, alpha_at_delay=0.5).objective, Criteria(damping_min=0.7).objective
    ('alpha_at_delay', None)
    """

    at_delay_s: float | None = None
    """Loop delay (s) at which the figures at a delay are judged. Gains are then searched for this delay."""
    maximise: Objective | None = None
    """The figure to maximise among gains that meet the rest. If None: `alpha_at_delay` if `at_delay_s` is given,
    otherwise the objective described in `Requirement`."""
    alpha_at_delay: float | None = None
    """Least α (1/s) at the delay."""
    decay_rate_at_delay_1_s: float | None = None
    """Least decay rate (1/s) at the delay."""
    damping_min: float | None = None
    """Least damping ratio of every root without delay, at most 1."""
    natural_frequency_max_rad_s: float | None = None
    """Largest natural frequency |s| of every root without delay."""
    spacing_gain_max_s2: float | None = None
    """Largest H∞ gain (s²) from disturbing accelerations to spacing errors: at the delay, or without delay if none is
    given."""
    noise_gain_max: float | None = None
    """Largest H2 gain from measurement noise to commands at the delay: the standard deviation of the noisiest command
    (m/s²) when every error is measured with white noise of standard deviation 1 (m, m/s)."""
    delays_s: tuple[float, float] | None = None
    """Range of loop delays (least, largest) over which the loop must be proved stable."""
    delay_rate: float | None = None
    """Largest rate of change of the delay in that range, s/s: 0 if it is constant but unknown, None if it jumps."""
    discrete: bool = False
    """Whether decay rate and α at the delay are those of the sampled and held loop itself, at any control period."""
    weight: tuple[float, float] | None = None
    """Weights of spacing and velocity errors, the diagonal of W: every α is then the bound in |w| ≤ α |W E|."""

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
        """The figure to maximise; None if the rest of the requirement decides it."""
        return self.maximise or ("alpha_at_delay" if self.at_delay_s is not None else None)


AT_DELAY = "alpha_at_delay", "decay_rate_at_delay_1_s"
_POSITIVE = (
    "at_delay_s", *AT_DELAY, "damping_min", "natural_frequency_max_rad_s", "spacing_gain_max_s2", "noise_gain_max",
)  # fmt: skip


def _check_positive(record: object, names: Iterable[str]) -> None:
    for name in names:
        wanted = getattr(record, name)
        if wanted is not None and not (is_number(wanted) and 0.0 < wanted < inf):
            raise BadModelError(f"{name} = {wanted}; wanted a positive number")


@dataclass(frozen=True)
class Requirement:
    """Requirements of a design.

    With `delay_margin_s`, the design maximises α and must reach `alpha` and `decay_rate_1_s` if they are given. Without
    it, the design maximises the delay margin subject to these two. With none of the three and no `criteria.at_delay_s`,
    a margin of 0.3 s is required. BadModelError if a number is out of range.

    The default requirement is a delay margin of 0.3 s:

    >>> Requirement().delay_margin_s, Requirement(alpha=0.4).delay_margin_s
    (0.3, None)
    >>> Requirement(string_peak_max=1.2, loop="onboard").chain_limit
    ChainLimit(peak=1.2, loop='onboard', feed_forward=0.0)
    """

    delay_margin_s: float | None = None
    """Least sampled delay margin, up to 30 s."""
    alpha: float | None = None
    """Least sector bound (1/s), at least 5e-4."""
    string_peak_max: float | None = None
    """Limit, at least 1, on the growth of spacing errors from vehicle to vehicle: in the ground loop without delay and
    at half the margin, in the onboard loop at every delay. With 1 no error grows down the chain, at little cost in α.
    No limit if None."""
    decay_rate_1_s: float | None = None
    """Least decay rate of the continuous loop without delay, 1/s."""
    loop: Literal["ground", "onboard"] = "ground"
    """The loop that is flown. An onboard loop on a pattern without cycles tolerates any delay; `delay_margin_s` then
    limits each vehicle's own gains as if a ground station closed their loops. On a pattern with cycles the onboard loop
    must have this margin too."""
    feed_forward: float = 0.0
    """Share, 0 to 1, of the command of the vehicle in front that each follower adds to its own. It changes alpha and
    the growth of spacing errors, but no margin and no decay. Ground loop only, by inclusion, without criteria."""
    criteria: Criteria | None = None
    """Further requirements. Gains are then searched by `gains.design.for_delay`."""

    def __post_init__(self) -> None:
        _check_positive(self, ("delay_margin_s", "alpha", "decay_rate_1_s"))
        if self.delay_margin_s is not None and self.delay_margin_s > DELAY_MARGIN_MAX_S:
            raise BadModelError(f"delay_margin_s = {self.delay_margin_s}; wanted at most {DELAY_MARGIN_MAX_S} s")
        if self.alpha is not None and self.alpha < ALPHA_MIN:
            raise BadModelError(f"alpha = {self.alpha}; wanted at least {ALPHA_MIN}")
        limit = self.string_peak_max
        if limit is not None and not (is_number(limit) and 1.0 <= limit < inf):
            raise BadModelError(f"string_peak_max = {shown(limit)}; wanted a number of at least 1")
        if of_type("loop", self.loop, str) not in ("ground", "onboard"):
            raise BadModelError(f"loop = {self.loop!r}; wanted ground or onboard")
        if not (is_number(self.feed_forward) and 0.0 <= self.feed_forward <= 1.0):
            raise BadModelError(f"feed_forward = {shown(self.feed_forward)}; wanted a number from 0 to 1")
        if self.feed_forward and (self.loop == "onboard" or self.criteria is not None):
            raise BadModelError(f"feed_forward = {self.feed_forward}; wanted 0 with criteria or the onboard loop")
        at_delay_s = None if self.criteria is None else of_type("criteria", self.criteria, Criteria).at_delay_s
        given = (self.delay_margin_s, self.alpha, self.decay_rate_1_s, at_delay_s)
        if all(wanted is None for wanted in given):
            object.__setattr__(self, "delay_margin_s", DEFAULT_DELAY_MARGIN_S)

    @property
    def chain_limit(self) -> ChainLimit:
        """`string_peak_max` as a limit in the loop that is flown."""
        return ChainLimit(self.string_peak_max, self.loop, self.feed_forward)


def plain(value: Any) -> Any:
    """`value` with arrays and tuples as lists, numpy floats as plain ones, and None in place of non-finite numbers."""
    if isinstance(value, dict):
        return {str(name): plain(entry) for name, entry in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value
