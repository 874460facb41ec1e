"""Small charts as SVG text: lines over time, readable on a page of any width.

Lines are thinned to the extremes of each column of the picture: no peak is lost, and a long flight stays small.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor, log10

import numpy as np

from gains.core.arrays import FloatArray
from gcs.views.page import rendered

COLOURS = "#1f4e79", "#c1440e", "#2e7d32", "#6a3d9a", "#b8860b", "#00838f", "#ad1457", "#5d4037"
OTHERS = "#b9c2cc"
_WIDTH, _HEIGHT = 560, 240
_LEFT, _RIGHT, _TOP, _BOTTOM = 50, 12, 12, 38
_COLUMNS = 250
"""Number of columns to which a line is thinned."""


@dataclass(frozen=True)
class Line:
    """One line: values (k,) at the chart's times, NaN for gaps. A line with a label is drawn thicker, and on top."""

    values: FloatArray
    label: str = ""
    colour: str = OTHERS
    dashed: bool = False


@dataclass(frozen=True)
class Level:
    """A horizontal line across the chart, labelled at its right end."""

    value: float
    label: str
    colour: str


def chart(
    time_s: FloatArray,
    lines: Sequence[Line],
    *,
    title: str,
    unit: str,
    levels: Sequence[Level] = (),
    least: float = 0.0,
    most: float | None = None,
) -> str:
    """A chart of lines over the whole of `time_s` (k,), in s, ascending.

    The axis of values spans `least` to `most`; None takes the largest value of the lines. Both are rounded outwards.
    """
    if most is None:
        values = np.concatenate([line.values for line in lines])
        most = float(values[np.isfinite(values)].max(initial=least))
    marks = _ticks(least, most if most > least else least + 1.0)
    low, high = min(least, marks[0]), max(most, marks[-1])
    start_s, end_s = float(time_s[0]), float(time_s[-1])
    end_s = end_s if end_s > start_s else start_s + 1.0

    def x(at_s: float) -> float:
        return _LEFT + (at_s - start_s) / (end_s - start_s) * (_WIDTH - _LEFT - _RIGHT)

    def y(value: float) -> float:
        return _HEIGHT - _BOTTOM - (min(max(value, low), high) - low) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)

    return rendered(
        "chart.svg.j2",
        title=title,
        unit=unit,
        box=(_WIDTH, _HEIGHT),
        edges=(_LEFT, _WIDTH - _RIGHT, _HEIGHT - _BOTTOM),
        marks=[(y(mark), f"{mark:g}") for mark in marks],
        # the text of the last mark ends at the edge, or it would be cut off
        times=[
            (x(mark), f"{mark:g}", "end" if mark == end_s else "middle")
            for mark in _ticks(start_s, end_s)
            if start_s <= mark <= end_s
        ],
        # labelled lines last, above the others
        lines=[
            (line, [" ".join(f"{x(at_s):.1f},{y(value):.1f}" for at_s, value in run) for run in _runs(time_s, line)])
            for line in sorted(lines, key=lambda line: bool(line.label))
        ],
        levels=[(y(level.value), level) for level in levels],
    )


def _ticks(low: float, high: float) -> list[float]:
    """About five equally spaced round numbers that enclose the range."""
    rough = (high - low) / 5.0
    size = 10.0 ** floor(log10(rough))
    step = next(size * factor for factor in (1.0, 2.0, 5.0, 10.0) if size * factor >= rough * 0.999)
    return [round(k * step, 12) for k in range(floor(low / step + 1e-9), ceil(high / step - 1e-9) + 1)]


def _thinned(time_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The least and the greatest value in each column, in order of time; NaN for a column without values."""
    if len(values) <= 2 * _COLUMNS:
        return time_s, values
    edges = np.array([part[0] for part in np.array_split(np.arange(len(values)), _COLUMNS)] + [len(values)])
    at = edges[:-1, np.newaxis] + np.arange(np.diff(edges).max())  # one row for each column of the picture
    own = np.where(at < edges[1:, np.newaxis], values[np.minimum(at, len(values) - 1)], np.nan)
    least = np.argmin(np.where(np.isnan(own), np.inf, own), axis=1)
    most = np.argmax(np.where(np.isnan(own), -np.inf, own), axis=1)
    at = np.unique([*(edges[:-1] + least), *(edges[:-1] + most), len(values) - 1])
    return time_s[at], values[at]


def _runs(time_s: FloatArray, line: Line) -> list[list[tuple[float, float]]]:
    """The thinned line, split at values that are not finite."""
    times_s, values = _thinned(time_s, line.values)
    parts = np.ma.clump_unmasked(np.ma.masked_invalid(values))
    return [list(zip(times_s[part].tolist(), values[part].tolist(), strict=True)) for part in parts]
