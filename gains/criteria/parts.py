"""The parts of a requirement: the limit each sets on a figure, the shortfall of gains, and how to relax it."""

from dataclasses import dataclass, replace
from math import exp, floor, inf, isfinite, log, log10
from typing import Self

from gains.core.requirement import Requirement
from gains.criteria.figures import LoopFigures
from gains.criteria.predicted import PredictedFigures

Figures = LoopFigures | PredictedFigures
"""Figures of gains without or with prediction."""

_AT_LEAST = "delay_margin_s", "alpha", "decay_rate_1_s"
_CRITERIA_AT_LEAST = "alpha_at_delay", "decay_rate_at_delay_1_s", "damping_min"
_CRITERIA_AT_MOST = "natural_frequency_max_rad_s", "spacing_gain_max_s2", "noise_gain_max"
# relative growth of spacing errors that is only rounding
_ROUNDING = 1e-9
# decimals of a second to which an interval of delays is rounded: its middle must not change as it is narrowed
_DECIMALS = 12
# shortfall, as a logarithm, of a figure that is not positive or not finite
_FAR = 1e3


@dataclass(frozen=True)
class Part:
    """One limit in a requirement: the figure `name` of gains must be at least, or at most, `wanted`."""

    name: str
    wanted: float
    at_least: bool

    @property
    def is_slow(self) -> bool:
        """Whether its figure takes long to compute."""
        return self.name == "delay_margin_s"

    @property
    def wanted_text(self) -> str:
        """The limit as text."""
        return f"{self.wanted:.6g}"

    def figure(self, figures: Figures) -> float:
        """The value of the figure that gains reach."""
        if self.name == "string_peak_max":
            return figures.string_peak / (1.0 + _ROUNDING)
        return getattr(figures, self.name)

    def shortfall(self, figures: Figures) -> float:
        """How far gains are from the limit, as the logarithm of a ratio; 0 if they meet it."""
        reached = self.figure(figures)
        if (reached >= self.wanted) if self.at_least else (reached <= self.wanted):
            return 0.0
        if not isfinite(reached) or reached <= 0.0:
            return _FAR
        return abs(log(reached / self.wanted))

    def tightened(self, short: float) -> Self:
        """The part with its limit tightened by slightly more than a shortfall."""
        more = exp(1.2 * short + 1e-6) if short > 0.0 else 1.0
        return replace(self, wanted=self.wanted * more if self.at_least else self.wanted / more)

    def relaxed(self, figures: Figures) -> Self | None:
        """The part relaxed to what gains reach; None if that is not positive or not finite."""
        reached = self.figure(figures)
        return self._limited_to(reached) if 0.0 < reached < inf else None

    def eased(self, share: float) -> Self:
        """The part relaxed by a share, given as a logarithm."""
        return self._limited_to(self.wanted * exp(-share if self.at_least else share))

    @property
    def advice(self) -> str:
        """The change of a requirement that gives it this part."""
        return f"{'lower' if self.at_least else 'raise'} {self.name} to {self.wanted_text}"

    def _limited_to(self, reached: float) -> Self:
        """The part with this limit, rounded to the easier side so that it equals its text."""
        return replace(self, wanted=float(f"{rounded(reached, up=not self.at_least):.6g}"))


@dataclass(frozen=True)
class DelaysPart(Part):
    """The interval of delays in which a loop must be proved stable; its figure is the proved half-width."""

    mean_s: float
    rate: float

    @property
    def is_slow(self) -> bool:
        return True

    @property
    def wanted_text(self) -> str:
        return f"[{self.mean_s - self.wanted:.12g}, {self.mean_s + self.wanted:.12g}]"

    def figure(self, figures: Figures) -> float:
        return figures.proved_spread_s(self.mean_s, self.rate)

    @property
    def advice(self) -> str:
        return f"narrow {self.name} to {self.wanted_text}"


def parts_of(wanted: Requirement) -> list[Part]:
    """All parts of a requirement: its own limits, then those of its criteria, the interval of delays last."""
    parts = [Part(name, value, True) for name in _AT_LEAST if (value := getattr(wanted, name)) is not None]
    if wanted.string_peak_max is not None:
        parts.append(Part("string_peak_max", wanted.string_peak_max, False))
    for names, at_least in ((_CRITERIA_AT_LEAST, True), (_CRITERIA_AT_MOST, False)):
        given = ((name, getattr(wanted.criteria, name, None)) for name in names)
        parts += [Part(name, value, at_least) for name, value in given if value is not None]
    if wanted.criteria is not None and wanted.criteria.delays_s is not None:
        (low, high), rate = wanted.criteria.delays_s, wanted.criteria.delay_rate
        middle_s, spread_s = round((low + high) / 2.0, _DECIMALS), round((high - low) / 2.0, _DECIMALS)
        parts.append(DelaysPart("delays_s", spread_s, True, middle_s, inf if rate is None else rate))
    return parts


def rounded(value: float, *, up: bool) -> float:
    """The value rounded up or down to four digits; `inf`, zero and negative values stay."""
    if not 0.0 < value < inf:
        return value
    unit = 10.0 ** (floor(log10(value)) - 3)
    return (floor(value / unit) + (1 if up else 0)) * unit
