"""report.html of a flight: its verdict, headroom, errors, links and events on one self-contained page."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gains.core.arrays import FloatArray
from gcs.control.tick import Event, Mode, TickArray
from gcs.plan.design import Design
from gcs.runs.files import RunTail, by_tick, read_design, read_scenario, read_ticks
from gcs.runs.record import DESIGN_FILE, SUMMARY_FILE, write_whole
from gcs.runs.summary_record import Summary
from gcs.views.page import rendered
from gcs.views.report import flight_lines
from gcs.views.scene import MODE_COLORS
from gcs.views.svg import COLOURS, OTHERS, Level, Line, chart
from gcs.views.table import merged
from scenarios.schema import Scenario

REPORT_FILE = "report.html"
_TEMPLATE = "flight_report.html.j2"
_NAMED = len(COLOURS)
"""Up to this many vehicles each have a colour; of more, only the `_NAMED_OF_MANY` with the least headroom."""
_NAMED_OF_MANY = 3
_MOST_EVENTS = 60
_HEADROOM_LEAST = -1.0
"""Lowest value on the headroom axis; lower headrooms are drawn at this edge."""
_MODE_COLOURS = {mode: "#{:02x}{:02x}{:02x}".format(*color) for mode, color in MODE_COLORS.items()}


def leave_report(folder: Path, summary: Summary) -> Summary:
    """Write report.html of a finished run and add it to the files in summary.json; returns the updated summary.

    A report that cannot be written is named in `not_logged`.
    """
    file = folder / REPORT_FILE
    scenario, design = read_scenario(folder), read_design(folder / DESIGN_FILE)
    ticks = by_tick(read_ticks(folder), [vehicle.system_id for vehicle in scenario.vehicles])
    page = flight_page(summary, scenario, design, ticks, RunTail(folder).events())
    files = tuple(sorted({*summary.files, REPORT_FILE}))
    reported = summary.model_copy(update={"files": files})
    try:
        write_whole(file, page.encode())
        write_whole(folder / SUMMARY_FILE, reported.to_json().encode())
    except OSError as error:
        lost = (*summary.not_logged, f"{REPORT_FILE}: {error.strerror or error}")
        return summary.model_copy(update={"not_logged": lost})
    return reported


def flight_page(summary: Summary, scenario: Scenario, design: Design, ticks: TickArray, events: Sequence[Event]) -> str:
    """The page as HTML; `ticks` has shape (ticks, vehicles)."""
    flown = ticks[ticks["time_s"][:, 0] >= 0.0] if ticks.size else ticks
    named = _named([vehicle.headroom_min for vehicle in summary.vehicles])
    labels = [str(vehicle.system_id) for vehicle in scenario.vehicles]
    modes = _mode_bars(flown, labels)
    shown = {name for _, bar in modes for name, _, _ in bar}
    said = merged(event for event in events if event.time_s >= 0.0)
    colours = [COLOURS[named.index(k) % len(COLOURS)] if k in named else OTHERS for k in range(len(labels))]
    return rendered(
        _TEMPLATE,
        summary=summary,
        lines=flight_lines(summary),
        design=design,
        charts=_charts(scenario, flown, labels, colours) if flown.size else [],
        key=[(labels[k], colours[k]) for k in sorted(named)],
        others=len(labels) - len(named),
        modes=modes,
        mode_key=[(mode.name, colour) for mode, colour in _MODE_COLOURS.items() if mode.name in shown],
        events=said[:_MOST_EVENTS],
        left_out=max(0, len(said) - _MOST_EVENTS),
    )


def _named(least: Sequence[float | None]) -> list[int]:
    """The indices of the vehicles with a colour of their own: all, or those with the least headroom."""
    if len(least) <= _NAMED:
        return list(range(len(least)))
    known = [np.inf if value is None else value for value in least]
    return np.argsort(known, kind="stable")[:_NAMED_OF_MANY].tolist()


def _charts(scenario: Scenario, flown: TickArray, labels: list[str], colours: list[str]) -> list[tuple[str, str, str]]:
    """The charts: for each, its heading, its SVG and a caption."""
    time_s = flown["time_s"][:, 0]
    sent = flown["commanded"]

    def lines(values: FloatArray, *, dashed: bool = False) -> list[Line]:
        return [
            Line(values[:, k], "" if colour == OTHERS else label, colour, dashed)
            for k, (label, colour) in enumerate(zip(labels, colours, strict=True))
        ]

    headroom = np.where(sent, flown["headroom"], np.nan)
    monitor = scenario.monitor
    levels = [
        Level(monitor.caution_headroom, "caution", _MODE_COLOURS[Mode.CAUTION]),
        Level(monitor.critical_headroom, "critical", _MODE_COLOURS[Mode.CRITICAL]),
    ]
    unit, reached, dashed = "1 − loop delay / margin", "the loop delay has reached the margin", "the margin"
    if scenario.control.prediction != "off":
        unit = "1 − mismatch / mismatch tolerated"
        reached = "the mismatch of set-points has reached an end of the window"
        dashed = "the upper end of the window"
    lowest = float(np.nanmin(headroom, initial=0.0))
    delay_ms = 1e3 * np.where(sent, flown["loop_delay_s"], np.nan)
    margin_ms = 1e3 * np.where(np.isfinite(flown["delay_margin_s"]), flown["delay_margin_s"], np.nan)
    error_m = np.hypot(flown["spacing_error_north_m"], flown["spacing_error_east_m"])
    headrooms = chart(
        time_s,
        lines(headroom),
        title="headroom over time",
        unit=unit,
        levels=levels,
        least=max(_HEADROOM_LEAST, min(0.0, lowest)),
        most=1.0,
    )
    both_ms = [*lines(delay_ms), *lines(margin_ms, dashed=True)]
    delays = chart(time_s, both_ms, title="loop delay and delay margin over time", unit="ms")
    errors = chart(time_s, lines(error_m), title="spacing errors over time", unit="m")
    solid = f"Solid: each vehicle's loop delay. Dashed: {dashed} of its gains at that time; "
    return [
        ("Headroom", headrooms, f"At 0 {reached} of the gains that are flown."),
        ("Loop delay and margin", delays, f"{solid}where the monitor takes slower gains, it rises."),
        ("Spacing errors", errors, "Distance of each follower from its place behind the vehicle in front."),
    ]


def _mode_bars(flown: TickArray, labels: list[str]) -> list[tuple[str, list[tuple[str, float, str]]]]:
    """For each vehicle that left NOMINAL during the flight: its modes in order, with share of the time and colour.

    Before its first command and after its last a vehicle is WAITING; that is drawn, but does not count as leaving.
    """
    bars: list[tuple[str, list[tuple[str, float, str]]]] = []
    for k, label in enumerate(labels):
        mode = flown["mode"][:, k]
        flying = np.flatnonzero(mode != Mode.WAITING)
        if mode.size == 0 or (flying.size and (mode[flying[0] : flying[-1] + 1] == Mode.NOMINAL).all()):
            continue
        starts = np.flatnonzero(np.diff(mode, prepend=-1)).tolist()
        turns = [
            (Mode(int(mode[start])), 100.0 * (end - start) / len(mode))
            for start, end in zip(starts, [*starts[1:], len(mode)], strict=True)
        ]
        bars.append((label, [(own.name, share, _MODE_COLOURS[own]) for own, share in turns]))
    return bars
