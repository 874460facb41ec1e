"""The figures of `gcs compare`, as PNG files."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from gcs.control.tick import TickArray
from gcs.stress.figures import figure_of, saved
from gcs.studies.compare_cost import DesignCost

_COLOURS = ("#1f4e79", "#c1440e", "#5b8c3a", "#8a5a9c", "#777777", "#b8860b")
_FLOOR_M = 1e-3
"""Smaller values are rounding of the telemetry."""


def errors_figure(file: Path, flights: Iterable[tuple[str, TickArray]]) -> Path:
    """A figure of the largest spacing error and the largest command of all vehicles over time, for each route."""
    figure, (above, below) = figure_of(2, (9.0, 6.0), heights=(1.4, 1.0))
    for (method, ticks), colour in zip(flights, _COLOURS, strict=False):
        flown = ticks[(ticks["time_s"] >= 0.0) & ticks["commanded"]]
        time_s, place = np.unique(flown["time_s"], return_inverse=True)
        error, command = np.zeros(time_s.size), np.zeros(time_s.size)
        spacing = np.hypot(flown["spacing_error_north_m"], flown["spacing_error_east_m"])
        np.fmax.at(error, place, spacing)
        np.fmax.at(command, place, np.hypot(flown["command_north_m_s2"], flown["command_east_m_s2"]))
        above.semilogy(time_s, np.maximum(error, _FLOOR_M), color=colour, linewidth=1.4, label=method)
        below.semilogy(time_s, np.maximum(command, _FLOOR_M), color=colour, linewidth=1.4)
    above.set(ylabel="largest spacing error [m]")
    below.set(xlabel="time of flight [s]", ylabel="largest command [m/s²]")
    above.legend(frameon=False)
    return saved(figure, file)


def sizes_figure(file: Path, grown: list[DesignCost]) -> Path:
    """Design time against the number of vehicles in a chain."""
    figure, (plot,) = figure_of(1, (9.0, 3.8))
    labels = list(dict.fromkeys(size.method for size in grown))
    for label, colour in zip(labels, _COLOURS, strict=False):
        own = [size for size in grown if size.method == label]
        plot.loglog([s.vehicles for s in own], [s.design_s for s in own], "o-", color=colour, label=label)
    ticks = sorted({size.vehicles for size in grown})
    plot.set_xticks(ticks, [str(tick) for tick in ticks])
    plot.minorticks_off()
    plot.set(xlabel="vehicles in the chain", ylabel="time of the design [s]")
    plot.legend(frameon=False)
    return saved(figure, file)
