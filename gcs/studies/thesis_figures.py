"""The source's figures, drawn from our flights, as PNG files."""

from pathlib import Path
from typing import Any

import numpy as np

from gcs.control.tick import TickArray
from gcs.stress.figures import figure_of, saved
from gcs.studies.thesis_flights import CHAIN, DELAYS_S, flown, late_flight

_COLOURS = ("#1f4e79", "#c1440e", "#5b8c3a", "#8a5a9c", "#8a6d1f")
_FT = 0.3048
_SHOTS = 7


def formation_figure(file: Path, method: str) -> Path:
    """Figures 3.2-3.6 (inclusion) and 4.3-4.7 (graph): superimposed snapshots and distances of three flights."""
    titles = {"triangle5": "first", "triangle5_scattered": "second", "triangle5_turns": "turns"}
    figure, plots = figure_of(2, (12.0, 7.0), heights=(1.3, 1.0), columns=3)
    for column, (name, title) in enumerate(titles.items()):
        ticks, settled_s = flown(name, method)
        above, below = plots[0][column], plots[1][column]
        until_s = 75.0 if name == "triangle5_turns" else 15.0
        _snapshots(above, ticks, until_s)
        _distances(below, ticks, until_s)
        above.set_title(f"{title}: settled after {settled_s:.1f} s" if settled_s is not None else title, fontsize=10)
    plots[0][0].set_ylabel("north [ft]")
    plots[1][0].set_ylabel("distance to the vehicle in front [ft]")
    plots[1][0].legend(frameon=False, fontsize=8)
    return saved(figure, file)


def _snapshots(plot: Any, ticks: TickArray, until_s: float) -> None:
    for time_s, strength in zip(np.linspace(0.0, until_s, _SHOTS), np.linspace(0.35, 1.0, _SHOTS), strict=True):
        tick = ticks["tick"][np.abs(ticks["time_s"] - time_s).argmin()]
        now = ticks[ticks["tick"] == tick]
        for row, colour in zip(now, _COLOURS, strict=False):
            plot.plot(row["east_m"] / _FT, row["north_m"] / _FT, "^", color=colour, alpha=strength, markersize=5)
    plot.set_xlabel("east [ft]")
    plot.set_aspect("equal", adjustable="datalim")


def _distances(plot: Any, ticks: TickArray, until_s: float) -> None:
    within = ticks[(ticks["time_s"] >= 0.0) & (ticks["time_s"] <= until_s)]
    own = {k: within[within["system_id"] == k] for k in (1, 2, 3)}
    time_s = own[1]["time_s"]
    for one, other, colour in ((1, 2, _COLOURS[0]), (2, 3, _COLOURS[1])):
        apart = (own[one][name] - own[other][name] for name in ("north_m", "east_m"))
        distance = np.hypot(*apart) / _FT
        plot.plot(time_s, distance, color=colour, linewidth=1.3, label=f"V{one}-V{other}")
    plot.set_xlabel("time [s]")


def responses_figure(file: Path) -> Path:
    """Figures 5.2-5.4: the errors of the three vehicles at h = 0.17 s, and the same at 0.9 s and 1.1 s."""
    figure, plots = figure_of(3, (12.0, 8.0), heights=(1.0, 1.0, 1.0), columns=3)
    for column, delay_s in enumerate(DELAYS_S):
        time_s, errors = late_flight(delay_s)
        shown = time_s <= (8.0 if delay_s < 0.5 else 20.0)
        for i in range(3):
            plot = plots[i][column]
            part = errors[shown, CHAIN.output_slice(i)]
            names = ["v north", "v east"] if i == 0 else ["p north", "p east", "v north", "v east"]
            for values, name, colour in zip(part.T, names, _COLOURS, strict=False):
                plot.plot(time_s[shown], values, color=colour, linewidth=1.0, label=name)
            if column == 0:
                plot.set_ylabel(f"errors of vehicle {i + 1} [m, m/s]")
                plot.legend(frameon=False, fontsize=7, ncols=2)
        plots[0][column].set_title(f"h = {delay_s} s", fontsize=10)
        plots[2][column].set_xlabel("time [s]")
    return saved(figure, file)
