"""Small charts as SVG text: lines over time, drawn without any library, readable in a page of any width.

Lines are thinned to the extremes of each column of the picture, so no peak is lost and a long flight stays small.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from math import ceil, floor, isfinite, log10

import numpy as np

from gains.core.arrays import FloatArray

COLOURS = "#1f4e79", "#c1440e", "#2e7d32", "#6a3d9a", "#b8860b", "#00838f", "#ad1457", "#5d4037"
OTHERS = "#b9c2cc"
_WIDTH, _HEIGHT = 560, 240
_LEFT, _RIGHT, _TOP, _BOTTOM = 50, 12, 12, 38
_COLUMNS = 250
"""Columns to which a line is thinned."""


@dataclass(frozen=True)
class Line:
    """One line: values (k,) at the chart's times, NaN where there is none. An empty label leaves it out of the key."""

    values: FloatArray
    label: str = ""
    colour: str = OTHERS
    dashed: bool = False


@dataclass(frozen=True)
class Level:
    """A horizontal line across the chart with a word at its right end."""

    value: float
    label: str
    colour: str = "#b3261e"


def chart(
    time_s: FloatArray,
    lines: Sequence[Line],
    *,
    title: str,
    unit: str,
    levels: Sequence[Level] = (),
    least: float | None = None,
    most: float | None = None,
) -> str:
    """A chart of lines over the whole of `time_s` (k,), which ascends, in s.

    The values reach from `least` to `most`; where these are None, as far as lines and levels do.
    """
    known = [line.values[np.isfinite(line.values)] for line in lines]
    values = np.concatenate([*known, [level.value for level in levels]]) if known or levels else np.zeros(1)
    values = values if values.size else np.zeros(1)
    low, high = (float(values.min()) if least is None else least), (float(values.max()) if most is None else most)
    high = high if high > low else low + 1.0
    marks = _ticks(low, high)
    low, high = min(low, marks[0]), max(high, marks[-1])
    start_s, end_s = (float(time_s[0]), float(time_s[-1])) if time_s.size else (0.0, 1.0)
    end_s = end_s if end_s > start_s else start_s + 1.0

    def x(at_s: float) -> float:
        return _LEFT + (at_s - start_s) / (end_s - start_s) * (_WIDTH - _LEFT - _RIGHT)

    def y(value: float) -> float:
        return _HEIGHT - _BOTTOM - (min(max(value, low), high) - low) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)

    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(title)}" '
        'xmlns="http://www.w3.org/2000/svg" font-family="system-ui, sans-serif" font-size="13">'
    ]
    for mark in marks:
        parts.append(_straight(_LEFT, y(mark), _WIDTH - _RIGHT, y(mark), "#dde2e8"))
        parts.append(_text(_LEFT - 6, y(mark) + 4, f"{mark:g}", anchor="end"))
    for mark in (mark for mark in _ticks(start_s, end_s) if start_s <= mark <= end_s):
        parts.append(_straight(x(mark), _HEIGHT - _BOTTOM, x(mark), _HEIGHT - _BOTTOM + 4, "#5a6572"))
        # the last one ends at the edge: no tick is cut off
        parts.append(_text(x(mark), _HEIGHT - _BOTTOM + 18, f"{mark:g}", anchor="end" if mark == end_s else "middle"))
    parts.append(_straight(_LEFT, _HEIGHT - _BOTTOM, _WIDTH - _RIGHT, _HEIGHT - _BOTTOM, "#5a6572"))
    parts.append(_text(_WIDTH - _RIGHT, _HEIGHT - 3, "time, s", anchor="end"))
    parts.append(_text(_LEFT, _HEIGHT - 3, unit, anchor="start"))
    # those with a label last: they lie above the others
    for line in sorted(lines, key=lambda line: bool(line.label)):
        points = [
            " ".join(f"{x(at_s):.1f},{y(value):.1f}" for at_s, value in run)
            for run in _runs(*_thinned(time_s, line.values))
        ]
        dash = ' stroke-dasharray="5 3"' if line.dashed else ""
        width = 1.7 if line.label else 1.0
        parts += [
            f'<polyline points="{run}" fill="none" stroke="{line.colour}" stroke-width="{width}"{dash}/>'
            for run in points
        ]
    for level in levels:
        parts.append(_straight(_LEFT, y(level.value), _WIDTH - _RIGHT, y(level.value), level.colour, dashed=True))
        parts.append(_text(_WIDTH - _RIGHT - 2, y(level.value) - 4, level.label, anchor="end", colour=level.colour))
    return "".join([*parts, "</svg>"])


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers, about five, that enclose the range."""
    rough = (high - low) / 5.0
    size = 10.0 ** floor(log10(rough))
    step = next(size * factor for factor in (1.0, 2.0, 5.0, 10.0) if size * factor >= rough * 0.999)
    return [round(k * step, 12) for k in range(floor(low / step + 1e-9), ceil(high / step - 1e-9) + 1)]


def _thinned(time_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The least and the largest value of each column, in order of time; a column without any gives NaN."""
    if len(values) <= 2 * _COLUMNS:
        return time_s, values
    edges = np.array([part[0] for part in np.array_split(np.arange(len(values)), _COLUMNS)] + [len(values)])
    at = edges[:-1, np.newaxis] + np.arange(np.diff(edges).max())  # a column each line
    own = np.where(at < edges[1:, np.newaxis], values[np.minimum(at, len(values) - 1)], np.nan)
    least = np.argmin(np.where(np.isnan(own), np.inf, own), axis=1)
    most = np.argmax(np.where(np.isnan(own), -np.inf, own), axis=1)
    at = np.unique([*(edges[:-1] + least), *(edges[:-1] + most), len(values) - 1])
    return time_s[at], values[at]


def _runs(time_s: FloatArray, values: FloatArray) -> list[list[tuple[float, float]]]:
    """The pieces of a line between values that are not finite."""
    runs: list[list[tuple[float, float]]] = [[]]
    for at_s, value in zip(time_s.tolist(), values.tolist(), strict=True):
        if isfinite(value):
            runs[-1].append((at_s, value))
        elif runs[-1]:
            runs.append([])
    return [run for run in runs if run]


def _straight(x1: float, y1: float, x2: float, y2: float, colour: str, *, dashed: bool = False) -> str:
    dash = ' stroke-dasharray="2 3"' if dashed else ""
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{colour}"{dash}/>'


def _text(x: float, y: float, text: str, *, anchor: str, colour: str = "#5a6572") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}">{escape(text)}</text>'
