"""Scaling of a gain on any pattern to a requirement by a change of time scale, which keeps the pattern.

With velocity gains K_v / s and spacing gains K_p / s² a loop of double integrators makes the same motion s times
slower: its continuous delay margin is s times larger and its decay rate s times smaller, exactly. A few steps of a
fixed-point iteration on s meet the margin of the sampled loop, which is about half a period less.

On board only the errors of other vehicles are late, and a pattern without cycles tolerates every delay, so gains could
rise without bound. The vehicles' own gains must therefore have the margin too, as if a station closed their loops.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.errors import InfeasibleError
from gains.core.requirement import Requirement
from gains.core.semidefinite import SolverFacts
from gains.delay.constant import delay_margin
from gains.formation.model import FormationModel
from gains.performance.robust import disturbance_bound
from gains.sampled.constant import sampled_delay_margin
from gains.sampled.onboard import OnboardTiming, onboard_loop, own_part

# The margin is exceeded by at most this share of it.
_SPARE = 1e-6
_SCALING_STEPS, _BISECTIONS = 20, 40
# Time scales tried if only robustness or decay are required.
_SCALES = np.geomspace(1e-3, 1e3, 121).tolist()
# The required figures that a time scale trades for the margin.
_FIGURES = "alpha", "decay_rate_1_s"


@dataclass(frozen=True, eq=False)
class BaseGain:
    """A stabilising gain for one axis, before scaling of time, and how it was found.

    `margin_s` is the continuous margin that a requirement bounds; `cost_loss` and `solver` are as in
    `gains.design.graph.GraphDesign`.
    """

    K: FloatArray
    margin_s: float
    decay_rate_1_s: float
    cost_loss: float | None
    solver: SolverFacts | None


@dataclass(frozen=True)
class BoundedMargins:
    """The margins of a gain for one axis that a requirement bounds; they depend on where the loop is closed."""

    model: FormationModel
    period_s: float
    onboard: OnboardTiming | None = None

    def continuous_s(self, K: FloatArray) -> float:
        A, B = self.model.A, self.model.B
        if self.onboard is None:
            return delay_margin(A, B @ K)
        own_s = delay_margin(A, B @ own_part(self.model, K))
        return min(own_s, onboard_loop(self.model, K, self.onboard).continuous_margin_s())

    def sampled_s(self, K: FloatArray) -> float:
        A, B = self.model.A, self.model.B
        if self.onboard is None:
            return sampled_delay_margin(A, B, K, period_s=self.period_s)
        own_s = sampled_delay_margin(A, B, own_part(self.model, K), period_s=self.period_s)
        return min(own_s, onboard_loop(self.model, K, self.onboard).sampled_margin_s())


def time_scaled(formation: FormationModel, K: FloatArray, scale: float) -> FloatArray:
    """Return the gain with which the loop makes the same motion `scale` times slower: K_v / scale, K_p / scale².

    K has the shape (any, states): K_v are its columns for velocity errors, K_p those for spacing errors.

    >>> time_scaled(FormationModel((-1, 0), axes=1), np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, -1.0]]), 2.0).tolist()
    [[-0.5, 0.0, 0.0], [0.0, 0.25, -0.5]]
    """
    scaled = K / scale
    scaled[:, formation.spacing_mask] /= scale
    return scaled


def scaled_to(wanted: Requirement, margins: BoundedMargins, bases: Sequence[BaseGain]) -> tuple[BaseGain, FloatArray]:
    """Return the best base and its gain, scaled to meet the requirement.

    InfeasibleError if no time scale of any base meets it; the message says what can be reached.
    """
    base, scale = (_slowest if wanted.delay_margin_s is None else _at_margin)(wanted, margins, bases)
    return base, time_scaled(margins.model, base.K, scale)


def _at_margin(wanted: Requirement, margins: BoundedMargins, bases: Sequence[BaseGain]) -> tuple[BaseGain, float]:
    """The most robust base that meets the rest of the requirement, and the scale that gives it the wanted margin."""
    margin_s, period_s = wanted.delay_margin_s, margins.period_s
    assert margin_s is not None
    # exact but for terms in the square of the period
    scaled = [(base, (margin_s + period_s / 2.0) / base.margin_s) for base in bases]
    reached = [_figures(margins, *each) for each in scaled]
    meeting = [k for k, figures in enumerate(reached) if _meets(figures, wanted)]
    if not meeting:
        asked, most = _short_of(wanted, reached)
        raise InfeasibleError(
            f"with delay_margin_s = {margin_s} this pattern does not reach {asked}: {most} at most; lower that, or "
            "delay_margin_s"
        )
    base, scale = scaled[max(meeting, key=lambda k: reached[k][0])]
    for _ in range(_SCALING_STEPS):
        found_s = margins.sampled_s(time_scaled(margins.model, base.K, scale))
        if margin_s <= found_s <= margin_s * (1.0 + _SPARE):
            return base, scale
        scale *= (margin_s * (1.0 + _SPARE / 2.0) + period_s / 2.0) / (found_s + period_s / 2.0)
    raise InfeasibleError(
        f"no time scale brings the sampled margin to delay_margin_s = {margin_s} with period_s = {period_s}; lower "
        "period_s or raise delay_margin_s"
    )


def _slowest(wanted: Requirement, margins: BoundedMargins, bases: Sequence[BaseGain]) -> tuple[BaseGain, float]:
    """The base and time scale with the largest margin that reach the wanted robustness and decay rate."""
    fitting = [(base, scale) for base in bases if (scale := _slowest_scale(wanted, margins, base)) is not None]
    if fitting:
        base, scale = max(fitting, key=lambda each: each[0].margin_s * each[1])
        if margins.sampled_s(time_scaled(margins.model, base.K, scale)) > 0.0:
            return base, scale
    period_s = margins.period_s
    flown = [(base, scale) for base in bases for scale in _SCALES if base.margin_s * scale > period_s / 2.0]
    asked, most = _short_of(wanted, [_figures(margins, *each) for each in flown])
    raise InfeasibleError(
        f"this pattern does not reach {asked} with period_s = {period_s}, however small the delay margin: {most} at "
        "most; lower that, or period_s, or add links"
    )


def _slowest_scale(wanted: Requirement, margins: BoundedMargins, base: BaseGain) -> float | None:
    """The largest time scale at which a base reaches the wanted robustness and decay rate; None if it never does."""
    fitting = [scale for scale in _SCALES if _meets(_figures(margins, base, scale), wanted)]
    if not fitting:
        return None
    low, high = fitting[-1], fitting[-1] * (_SCALES[1] / _SCALES[0])
    for _ in range(_BISECTIONS):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if _meets(_figures(margins, base, middle), wanted) else (low, middle)
    return low


def _figures(margins: BoundedMargins, base: BaseGain, scale: float) -> tuple[float, float]:
    """α of the whole formation and decay rate (1/s) of a base at a time scale."""
    model = margins.model
    closed_loop = model.A + model.B @ time_scaled(model, base.K, scale)
    return disturbance_bound(closed_loop, np.eye(model.states)), base.decay_rate_1_s / scale


def _meets(figures: tuple[float, float], wanted: Requirement) -> bool:
    return figures[0] >= (wanted.alpha or 0.0) and figures[1] >= (wanted.decay_rate_1_s or 0.0)


def _short_of(wanted: Requirement, reached: Sequence[tuple[float, float]]) -> tuple[str, str]:
    """Text of the required figures, and text of the most that was reached of each."""
    asked = [
        (name, most) for name, most in zip(_FIGURES, np.max(reached, axis=0), strict=True) if getattr(wanted, name)
    ]
    return (
        " and ".join(f"{name} = {getattr(wanted, name)}" for name, _ in asked),
        " or ".join(f"{name} = {most:.4f}" for name, most in asked),
    )
