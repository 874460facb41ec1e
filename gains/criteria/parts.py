"""The parts of a requirement: what each asks of which figure, how far gains are from it, and how it is relaxed."""

from dataclasses import dataclass, replace
from math import exp, floor, inf, isfinite, log, log10
from typing import Self

from gains.core.requirement import Requirement
from gains.criteria.figures import LoopFigures
from gains.criteria.predicted import PredictedFigures

Figures = LoopFigures | PredictedFigures
"""Those of gains without prediction and with it."""

_AT_LEAST = "delay_margin_s", "alpha", "decay_rate_1_s"
_CRITERIA_AT_LEAST = "alpha_at_delay", "decay_rate_at_delay_1_s", "damping_min"
_CRITERIA_AT_MOST = "natural_frequency_max_rad_s", "spacing_gain_max_s2", "noise_gain_max"
# how far an unstable or missing figure counts as being from any requirement, in logarithms
_FAR = 1e3


@dataclass(frozen=True)
class Part:
    """One number that a requirement asks for: the figure `name` of gains must be at least, or at most, `wanted`."""

    name: str
    wanted: float
    at_least: bool

    @property
    def is_slow(self) -> bool:
        """Whether its figure takes long to compute."""
        return self.name == "delay_margin_s"

    @property
    def wanted_text(self) -> str:
        """What is wanted, in words."""
        return f"{self.wanted:.6g}"

    def figure(self, figures: Figures) -> float:
        """What gains reach of it."""
        return getattr(figures, "string_peak" if self.name == "string_peak_max" else self.name)

    def shortfall(self, figures: Figures) -> float:
        """How far gains are from it, as the logarithm of a ratio; 0 if they meet it."""
        reached = self.figure(figures)
        if (reached >= self.wanted) if self.at_least else (reached <= self.wanted):
            return 0.0
        if not isfinite(reached) or reached <= 0.0:
            return _FAR
        return abs(log(reached / self.wanted))

    def tightened(self, short: float) -> Self:
        """A part that asks for more, by a shortfall and a little."""
        more = exp(1.2 * short + 1e-6) if short > 0.0 else 1.0
        return replace(self, wanted=self.wanted * more if self.at_least else self.wanted / more)

    def relaxed(self, reached: float) -> str:
        """The advice to ask for no more than was reached; empty if that is nothing."""
        if not 0.0 < reached < inf:
            return ""
        return f"{'lower' if self.at_least else 'raise'} {self.name} to {rounded(reached, up=not self.at_least):g}"


@dataclass(frozen=True)
class DelaysPart(Part):
    """The interval of delays in which a loop must be proved stable; its figure is the half-width that is proved."""

    mean_s: float
    rate: float

    @property
    def is_slow(self) -> bool:
        return True

    @property
    def wanted_text(self) -> str:
        return f"[{self.mean_s - self.wanted:g}, {self.mean_s + self.wanted:g}]"

    def figure(self, figures: Figures) -> float:
        return figures.proved_spread_s(self.mean_s, self.rate)

    def relaxed(self, reached: float) -> str:
        spread_s = rounded(reached, up=False)
        if spread_s <= 0.0:
            return ""
        return f"narrow {self.name} to [{self.mean_s - spread_s:.6g}, {self.mean_s + spread_s:.6g}]"


def parts_of(wanted: Requirement) -> list[Part]:
    """Everything that a requirement asks for, in the order of its fields."""
    parts = [Part(name, value, True) for name in _AT_LEAST if (value := getattr(wanted, name)) is not None]
    if wanted.string_peak_max is not None:
        parts.append(Part("string_peak_max", wanted.string_peak_max * (1.0 + 1e-9), False))
    for names, at_least in ((_CRITERIA_AT_LEAST, True), (_CRITERIA_AT_MOST, False)):
        given = ((name, getattr(wanted.criteria, name, None)) for name in names)
        parts += [Part(name, value, at_least) for name, value in given if value is not None]
    if wanted.criteria is not None and wanted.criteria.delays_s is not None:
        (low, high), rate = wanted.criteria.delays_s, wanted.criteria.delay_rate
        middle = (low + high) / 2.0
        parts.append(DelaysPart("delays_s", (high - low) / 2.0, True, middle, inf if rate is None else rate))
    return parts


def rounded(value: float, *, up: bool) -> float:
    """Four digits, on the easier side of a value; `inf` and 0 stay."""
    if not 0.0 < value < inf:
        return value
    unit = 10.0 ** (floor(log10(value)) - 3)
    return (floor(value / unit) + (1 if up else 0)) * unit
