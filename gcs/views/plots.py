"""Matplotlib plots for scripts and notebooks: the effect of a delay on a loop x'(t) = A0 x(t) + A1 x(t - tau).

Each function draws into the given `axes`, or into pyplot's current ones, and returns them. The front at loop delays is
drawn by `gcs.studies.front.plot_front`.
"""

from collections.abc import Sequence
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import FloatArray
from gains.delay.constant import analyse_delay
from gains.delay.rightmost import rightmost_root, rightmost_roots


def plot_growth(A0: ArrayLike, A1: ArrayLike, delays_s: Sequence[float] | FloatArray, axes: Any = None) -> Any:
    """Plot the real part (1/s) of the rightmost root against delay; stable windows are shaded, the margin is the title.

    Raises what `gains.analyse_delay` and `gains.rightmost_root` raise.
    """
    plot, longest_s = _axes(axes), max(delays_s)
    found = analyse_delay(A0, A1, horizon_s=longest_s)
    plot.plot(delays_s, [rightmost_root([(A0, 0.0), (A1, delay_s)]).real for delay_s in delays_s])
    plot.axhline(0.0, color="black", linewidth=0.8)
    for start_s, end_s in found.stable_intervals_s:
        plot.axvspan(start_s, min(end_s, longest_s), color="#2e7d32", alpha=0.12)
    margin = f"{found.delay_margin_s:.4g} s" if isfinite(found.delay_margin_s) else "without limit"
    plot.set(xlabel="delay [s]", ylabel="growth of errors [1/s]", title=f"delay margin {margin}")
    return plot


def plot_root_locus(
    A0: ArrayLike, A1: ArrayLike, delays_s: Sequence[float] | FloatArray, axes: Any = None, *, roots: int = 4
) -> Any:
    """Plot the `roots` rightmost roots with imaginary part >= 0 at each delay, coloured by delay; crossings are ringed.

    Raises what `gains.analyse_delay` and `gains.rightmost_roots` raise.
    """
    plot = _axes(axes)
    found = [rightmost_roots([(A0, 0.0), (A1, delay_s)], roots) for delay_s in delays_s]
    colour = np.repeat(delays_s, [own.size for own in found])
    at = np.concatenate(found)
    drawn = plot.scatter(at.real, at.imag, c=colour, s=9)
    crossings = analyse_delay(A0, A1, horizon_s=max(delays_s)).crossings
    omegas = [c.omega_rad_s for c in crossings if c.delay_s <= max(delays_s)]
    plot.plot([0.0] * len(omegas), omegas, "o", color="black", fillstyle="none", markersize=9)
    plot.axvline(0.0, color="black", linewidth=0.8)
    plot.figure.colorbar(drawn, ax=plot, label="delay [s]")
    plot.set(xlabel="real part [1/s]", ylabel="imaginary part [rad/s]")
    return plot


def _axes(axes: Any) -> Any:
    if axes is not None:
        return axes
    import matplotlib.pyplot as plt

    return plt.gca()
