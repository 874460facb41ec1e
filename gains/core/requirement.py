"""What a design must reach, and the plain types in which designs are written to JSON.

`gains.design.design` turns a requirement into gains.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from gains.core.errors import BadModelError

DEFAULT_DELAY_MARGIN_S = 0.3
# Below this α, and above this margin, the numbers in a proof spread too far for the solver.
ALPHA_MIN, DELAY_MARGIN_MAX_S = 5e-4, 30.0


@dataclass(frozen=True)
class OnboardPeak:
    """A limit on the growth of spacing errors in the onboard loop, where only the errors of others arrive late."""

    peak: float


PeakLimit = float | OnboardPeak | None


@dataclass(frozen=True)
class Requirement:
    """What the design must reach.

    With `delay_margin_s` the design makes α as large as possible, and must reach `alpha` and `decay_rate_1_s` if they
    are given. Without it, the delay margin is made as large as these two allow. With none of the three, a margin of
    0.3 s is required. BadModelError if a number is out of its range.

    A delay margin of 0.3 s is wanted when nothing is given:

    >>> from gains import Requirement
    >>> Requirement().delay_margin_s, Requirement(alpha=0.4).delay_margin_s
    (0.3, None)
    >>> Requirement(string_peak_max=1.2, loop="onboard").peak_limit
    OnboardPeak(peak=1.2)
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

    def __post_init__(self) -> None:
        for name in ("delay_margin_s", "alpha", "decay_rate_1_s"):
            wanted = getattr(self, name)
            if wanted is not None and not (np.isfinite(wanted) and wanted > 0):
                raise BadModelError(f"{name} = {wanted}; wanted a positive number")
        if self.delay_margin_s is not None and self.delay_margin_s > DELAY_MARGIN_MAX_S:
            raise BadModelError(f"delay_margin_s = {self.delay_margin_s}; wanted at most {DELAY_MARGIN_MAX_S} s")
        if self.alpha is not None and self.alpha < ALPHA_MIN:
            raise BadModelError(f"alpha = {self.alpha}; wanted at least {ALPHA_MIN}")
        if self.string_peak_max is not None and not 1 <= self.string_peak_max < np.inf:
            raise BadModelError(f"string_peak_max = {self.string_peak_max}; wanted a number of at least 1")
        if self.delay_margin_s is None and self.alpha is None and self.decay_rate_1_s is None:
            object.__setattr__(self, "delay_margin_s", DEFAULT_DELAY_MARGIN_S)

    @property
    def peak_limit(self) -> PeakLimit:
        """`string_peak_max` as a limit in the loop that is flown."""
        peak = self.string_peak_max
        return peak if peak is None or self.loop == "ground" else OnboardPeak(peak)


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
