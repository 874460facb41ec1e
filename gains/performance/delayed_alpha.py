"""α of a loop with delay: the least singular value of its characteristic matrix, and the delay up to which it is kept.

With x'(t) = A x(t) + sum of A_k x(t − τ_k) + w, any |w| ≤ α |x| leaves the loop stable up to
α = min over ω of σ_min(jωI − A − sum of A_k e^{−jωτ_k}), its complex stability radius.
"""

from math import inf
from typing import Protocol

import numpy as np

from gains.core._bracketing import met_end, peaks
from gains.core.arrays import FloatArray

# Where no α is asked for, it counts as kept down to this share of its value without delay.
ALPHA_KEPT = 0.99
# Delays of the first look at how far α is kept.
_DELAYS = 32
# α at its limit is within this share of what it is to be.
_RESOLUTION = 1e-7


class DelayedLoop(Protocol):
    """A loop whose characteristic matrix depends on one loop delay."""

    @property
    def delay_margin_s(self) -> float:
        """Least loop delay (s) at which the loop as flown is unstable; `inf` if there is none."""
        ...

    @property
    def longest_s(self) -> float:
        """The longest delay (s) that is looked at where there is no margin."""
        ...

    def frequencies(self) -> FloatArray:
        """Frequencies (rad/s) that show every valley of σ_min. Beyond the last one σ_min is larger than at rest."""
        ...

    def singular_value(self, omega: FloatArray, delay_s: float) -> FloatArray:
        """σ_min of the characteristic matrix at each frequency, with a loop delay (s)."""
        ...


def alpha_at(loop: DelayedLoop, delay_s: float) -> float:
    """α at a loop delay (s), the least of σ_min on a grid of frequencies, refined; 0 from the margin on."""
    if not delay_s < loop.delay_margin_s:
        return 0.0
    omega = loop.frequencies()

    def depth(at: FloatArray) -> FloatArray:
        return -loop.singular_value(at, delay_s)

    values = depth(omega)
    inner = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:])) + 1
    best = float(values.max())
    if inner.size:
        best = max(best, float(depth(peaks(depth, omega[inner - 1], omega[inner + 1])).max()))
    return -best


def alpha_limit_s(loop: DelayedLoop, alpha: float) -> float:
    """The largest loop delay up to which α is kept: `inf` if at every one, 0 if not even without delay."""
    longest_s = min(loop.delay_margin_s, loop.longest_s)
    delays = np.linspace(0.0, longest_s, _DELAYS, endpoint=False)
    omega = loop.frequencies()
    kept = np.array([loop.singular_value(omega, delay_s).min() for delay_s in delays.tolist()]) >= alpha
    at_rest = alpha_at(loop, 0.0) - alpha
    if at_rest < 0.0 or not kept[0]:
        return 0.0
    if kept.all() and loop.delay_margin_s == inf:
        return inf
    failed = int(np.argmin(kept)) if not kept.all() else _DELAYS
    low, high = float(delays[failed - 1]), longest_s if failed == _DELAYS else float(delays[failed])
    ends = [(delay_s, alpha_at(loop, delay_s) - alpha) for delay_s in (low, high)]
    if ends[0][1] < 0.0:  # a valley between the frequencies looked at first
        ends = [(0.0, at_rest), ends[0]]
    return met_end(lambda delay_s: alpha_at(loop, delay_s) - alpha, ends[0], ends[1], resolution=_RESOLUTION * alpha)
