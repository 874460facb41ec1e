"""How early or late set-points may act while a predicted loop is still proved stable.

The station predicts as in `gains.sampled.prediction`. A set-point u_j, computed at the tick t_j = j T, is assumed to
act at t_j + D, with a constant *delivery delay* D. In fact it acts at any instant between t_j + D - e and t_j + D + l,
independently of the others, but none overtakes another. The newest state known at tick k was sampled at s_k, which the
station knows; s_k never decreases. Let U(t) be the set-point computed at the latest tick at time t, u_act(t) the one
that acts, and w(r) = u_act(r) - U(r - D). The prediction at tick k, for the instant t_k + D, is

    x^_k = Y(t_k) + Phi(t_k + D - s_k) (x(s_k) - Y(s_k - D))    for any solution of Y' = A Y + B U,

and x(r) - Y(r - D) obeys z' = A z + B w: only w drives it. Exactly, therefore,

    x^_{k+1} = (Phi(T) + G K) x^_k + w_k,   w_k = int Phi(t_{k+1} + D - r) B w(r) dr over W_k = (s_k, s_{k+1}]:

the loop without delay. Each instant of w disturbs it once, when the first state sampled after it is used. w is a sum of
pulses: set-point j adds (u_j - u_{j-1}) or its negative over P_j, between t_j + D and the instant at which it acts.
With c_kj = |P_j and W_k|, Schur's test bounds the gain from u_j - u_{j-1} to the sums c_kj (u_j - u_{j-1}) by

    g^2 <= max over j of |P_j|  times  max over k of the sum over j of |P_j and W_k|.

The first is max(e, l). At any instant only late or only early pulses overlap, so the second is at most the number of
control periods in W_k times the integral of the larger number over one of them. The loop is stable if

    g  sum over i of  b^i / i!  max over omega of || (1 - 1/z) K (z I - Phi(T) - G K)^{-1} A^i Phi(h) B ||  < 1,

by the small-gain theorem, where h is the middle of the intervals t_{k+1} + D - r, and b their largest distance from it.
In a leader-follower tree errors only pass down, so each block is tested alone. The maxima are searched on a fine grid
and refined: a search, not a proof.

If every state has the same age, W_k lies at the same place in every period, and a constant mismatch leaves the loop
time-invariant. Then e and l count from the true mean, and the loop in the norm is the one with the mismatch.

States that are not measured are computed from the commands. w reaches the measured states through them, which
multiplies g by the integral of the modulus of the impulse response along that path.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil, floor, inf, pi

import numpy as np
from numpy.typing import ArrayLike

from gains.core._bracketing import highest
from gains.core.arrays import BoolArray, ComplexArray, FloatArray, matrix_exponentials, spectral_norms
from gains.core.errors import BadModelError
from gains.core.structure import seconds
from gains.sampled._loop import HeldPlant, block_radius, held_blocks, held_entry
from gains.sampled.constant import checked_loop
from gains.sampled.multirate import Predictor, Timing, lifted_radius
from gains.sampled.prediction import checked_mask

# angles in the grid, and the lowest; bisections; relative size below which terms of the series in b are left out
_ANGLES, _LOWEST, _HALVINGS, _SMALL = 2000, 1e-4, 50, 1e-9
# samples of an impulse response, and time constants over which it is integrated
_INSTANTS, _SETTLED = 4000, 40.0
# sums of periods and spreads are known to rounding
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class PredictedSpread:
    """Tolerated deviations of set-points from their mean delay, in a loop that is predicted over `assumed_s`.

    A, B, K, `timing`, `assumed_s` and `measured`, and the exceptions, are those of
    `gains.sampled.prediction.mismatch_window`; the delays of all inputs of a block vary together.

    A follower with the gains of `triangle5` is predicted over 0.6 s. With telemetry of constant age, its set-points may
    act 0.14 s early or late; if that age also varies by 50 ms, a third of this:

    >>> A, B, K = [[0, -1], [0, 0]], [[0], [1]], [[5.608, -3.408]]
    >>> spread = PredictedSpread(A, B, K, Timing(0.02, 0.02), assumed_s=0.6)
    >>> round(spread.bound_s(mean_s=0.6), 3), round(spread.bound_s(mean_s=0.6, telemetry_s=0.05), 3)
    (0.141, 0.048)
    """

    A: ArrayLike
    B: ArrayLike
    K: ArrayLike
    timing: Timing
    assumed_s: float
    measured: Sequence[bool] | None = None

    def bound_s(self, *, mean_s: float, telemetry_s: float = 0.0) -> float:
        """How early or late (s) each set-point may act relative to its mean, with the loop proved stable.

        `mean_s` is the mean loop delay and the largest possible result. `telemetry_s` is the largest deviation of the
        telemetry delay from its mean, to either side. 0 if nothing is proved.
        """
        if not (0.0 <= mean_s < inf and 0.0 <= telemetry_s < inf):
            raise BadModelError(f"mean_s is {mean_s}, telemetry_s {telemetry_s}; numbers of seconds >= 0 are wanted")
        off_s = mean_s - seconds("assumed_s", self.assumed_s)
        period_s, regular = self.timing.control_s, telemetry_s == 0.0 and self.timing.ticks == 1
        # by how much the age of the newest state varies, which grows until the next arrives; how long that may take
        varies_s = 0.0 if regular else 2.0 * telemetry_s + self.timing.telemetry_s
        gap_s = self.timing.telemetry_s * (ceil((period_s + varies_s) / self.timing.telemetry_s - _ROUNDING) - 1)
        windows = 1 if regular else ceil(gap_s / period_s - _ROUNDING)
        apart_s = period_s / 2.0 + (0.0 if regular else varies_s + period_s)
        bounds_s: list[float] = []
        for plant, at_once in self._blocks:
            most = _most_s(at_once, apart_s)
            aside_s = _bisected(lambda s, most=most: _gain(s - off_s, s + off_s, period_s, windows) < most, mean_s)
            if regular and off_s != 0.0:
                around = _most_s(_peaks(plant, self.timing, self.assumed_s, mean_s), apart_s)
                aside_s = max(aside_s, _bisected(lambda s, most=around: _gain(s, s, period_s, 1) < most, mean_s))
            bounds_s.append(aside_s)
        return min(bounds_s)

    @cached_property
    def _blocks(self) -> list[tuple[HeldPlant, list[float]]]:
        """Each block with its `_peaks` without mismatch."""
        loop = checked_loop(self.A, self.B, self.K)
        mask = checked_mask(loop, self.measured)
        plants = held_blocks(*loop, period_s=self.timing.control_s, measured=mask)
        return [(own, _peaks(own, self.timing, self.assumed_s, self.assumed_s)) for own in plants]


def _most_s(peaks: list[float], apart_s: float) -> float:
    """The g (s) at which the stability sum, over the powers of b = `apart_s`, is one; 0 if the loop is unstable."""
    if not peaks:
        return 0.0
    factors = np.cumprod([1.0, *(apart_s / power for power in range(1, len(peaks)))])
    total = float(factors @ np.array(peaks))
    return 1.0 / total if total > 0.0 else inf


def _peaks(plant: HeldPlant, timing: Timing, assumed_s: float, mean_s: float) -> list[float]:
    """Largest gains from sums of pulses to u_j - u_{j-1} in one block, for each power of b; none if it is unstable."""
    if mean_s == assumed_s:
        radius = block_radius(plant, 0.0)  # the loop behind the delay is the loop without delay
    else:
        radius = lifted_radius(plant, timing, delay_s=mean_s, predictor=Predictor(plant, assumed_s))
    if radius >= 1.0:
        return []
    A, seen = plant.A, np.ones(len(plant.A), dtype=np.bool_) if plant.measured is None else plant.measured
    A_seen = np.where(np.outer(seen, seen), A, 0.0)
    ahead = plant.carry(np.array([assumed_s + plant.period_s / 2.0]))[0]
    onto = np.hstack([ahead @ plant.B, ahead @ A[:, ~seen] * _integral(A, plant.B, ~seen)])
    grid = np.union1d(np.geomspace(_LOWEST, pi, _ANGLES), np.linspace(0.0, pi, _ANGLES)[1:])
    found = list[float]()
    while not found or onto.any():

        def gain(angle: FloatArray, onto: FloatArray = onto) -> FloatArray:
            return spectral_norms(_rows(plant, angle, assumed_s, mean_s) @ onto)

        found.append(highest(gain, grid)[1])
        onto = A_seen @ onto
        if found[-1] <= _SMALL * found[0] or len(found) > 30:
            break
    return found


def _rows(plant: HeldPlant, angle: FloatArray, assumed_s: float, mean_s: float) -> ComplexArray:
    """Response of u_j - u_{j-1} to a disturbance of the predicted state (n,), shape (k, r, n), at z = e^{j angle}."""
    z = np.exp(1j * angle)[:, np.newaxis, np.newaxis]
    Phi, G = (maps[0] for maps in plant.transition(np.array([plant.period_s])))
    resolvent = np.linalg.inv(z * np.eye(len(Phi)) - Phi)
    answers = resolvent @ G
    if mean_s != assumed_s:
        ahead = plant.carry(np.array([assumed_s]))[0]
        answers = answers + ahead @ resolvent @ (held_entry(plant, z, mean_s) - held_entry(plant, z, assumed_s))
    return (1.0 - 1.0 / z) * np.linalg.solve(np.eye(len(plant.K)) - plant.K @ answers, plant.K @ resolvent)


def _integral(A: FloatArray, B: FloatArray, computed: BoolArray) -> float:
    """int ||e^{A t} B|| dt for the states that are computed from the commands; 0 if there are none."""
    own, entry = A[np.ix_(computed, computed)], B[computed]
    if not computed.any():
        return 0.0
    settled_s = _SETTLED / float(-np.linalg.eigvals(own).real.max())
    at_s = np.linspace(0.0, settled_s, _INSTANTS)
    sizes = spectral_norms(matrix_exponentials(own, at_s) @ entry)
    return float(np.trapezoid(sizes, at_s))


def _gain(early_s: float, late_s: float, period_s: float, windows: int) -> float:
    """The bound g (s) for set-points that act at most so early or late, with `windows` control periods in W_k."""
    early, late = (max(0.0, each_s) / period_s for each_s in (early_s, late_s))
    most, whole = max(early, late), floor(early)
    # the numbers of early and of late pulses at an instant are these, or one more during part of each period
    larger = whole + min(1.0, early + late - 2 * whole) if whole == floor(late) else most
    return period_s * (most * larger * windows) ** 0.5


def _bisected(proved: Callable[[float], bool], most_s: float) -> float:
    """The largest number up to `most_s` at which `proved` holds, assuming that it then holds below; 0 if nowhere."""
    if proved(most_s):
        return most_s
    low_s, high_s = 0.0, most_s
    for _ in range(_HALVINGS):
        middle_s = (low_s + high_s) / 2.0
        low_s, high_s = (middle_s, high_s) if proved(middle_s) else (low_s, middle_s)
    return low_s
