"""The delay at which growth passes zero, located from the growth rates of a few flights.

`gains.sampled.coupled_block` predicts the same delay, block by block; `study` chooses the flights.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gains.core.arrays import FloatArray


@dataclass(frozen=True)
class GrowthPoint:
    """One flight near the onset: the loop delay it had, and the growth rate measured."""

    loop_delay_s: float
    growth_1_s: float
    error_1_s: float


@dataclass(frozen=True)
class Zero:
    """The delay at which growth rises through zero; `error_s` is its standard error, `slope_1_s2` is dg/dtau there.

    `inside` says that there are flights on both sides; otherwise the zero is extrapolated. `misfit` is the distance of
    the flights from the curve in standard errors: well above one where no parabola fits, as across a kink. The growth
    of a sampled loop has one where the delay is a whole number of periods.
    """

    loop_delay_s: float
    error_s: float
    slope_1_s2: float
    inside: bool
    misfit: float


def locate_zero(points: Sequence[GrowthPoint]) -> Zero | None:
    """The loop delay of zero growth, from at least two flights at different delays.

    Fits a line, or a parabola to four or more flights, by least squares weighted with the flights' errors. None if
    growth does not rise with delay in these flights.
    """
    if len({round(point.loop_delay_s, 6) for point in points}) < 2:
        return None
    delay_s, growth, error = np.array([(p.loop_delay_s, p.growth_1_s, p.error_1_s) for p in points], dtype=float).T
    # no error counts as less than a thousandth of the spread of the rates: the curve is not exactly a parabola
    error = np.maximum(error, 1e-3 * float(np.ptp(growth)) + 1e-9)
    middle, half = float(delay_s.mean()), float(np.ptp(delay_s)) / 2.0
    x = (delay_s - middle) / half
    for degree in (2, 1) if len(points) >= 4 else (1,):
        weighted = np.vander(x, degree + 1) / error[:, np.newaxis]
        coefficients = np.linalg.lstsq(weighted, growth / error, rcond=None)[0]
        at = _rising_root(coefficients, nearest_to=float(x[np.abs(growth).argmin()]))
        if at is not None:
            row = at ** np.arange(degree, -1, -1.0)
            slope = float(np.polyval(np.polyder(coefficients), at))
            variance = float(row @ np.linalg.pinv(weighted.T @ weighted) @ row)
            off, free = weighted @ coefficients - growth / error, len(points) - degree - 1
            misfit = float(np.linalg.norm(off)) / free**0.5 if free else 0.0
            return Zero(
                loop_delay_s=middle + half * at,
                error_s=half * variance**0.5 / slope * max(1.0, misfit),
                slope_1_s2=slope / half,
                inside=bool((growth < 0.0).any() and (growth > 0.0).any()),
                misfit=misfit,
            )
    return None


def _rising_root(coefficients: FloatArray, *, nearest_to: float) -> float | None:
    """The root at which a polynomial rises; if there are several, the one nearest to a given place."""
    roots = np.roots(coefficients)
    real = roots[np.abs(roots.imag) < 1e-9].real
    rising = real[np.polyval(np.polyder(coefficients), real) > 0.0]
    return float(rising[np.abs(rising - nearest_to).argmin()]) if rising.size else None
