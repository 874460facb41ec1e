"""The live table: how close each vehicle of the formation is to its delay margin, while it flies.

`FlightState` holds the data of the table, `render` draws it, `plain_line` puts it on one line where there is no
terminal, and `Display` chooses between the two.
"""

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, partial
from itertools import groupby

import numpy as np
from rich.console import Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from gains.core.arrays import FloatArray
from gcs.control.phases import patience_s
from gcs.control.tick import TICK, Event, Mode, TickArray
from gcs.link.startup import WITHOUT_TARGET
from gcs.plan.at_delay import figures_at
from gcs.plan.design import Design
from gcs.plan.mismatch import assumption
from gcs.runs.refusals import REFUSED
from gcs.views.console import (
    UNKNOWN,
    FittedColumn,
    draw,
    fitted_table,
    growth_text,
    ms_text,
    not_shown,
    number_text,
    vehicles_text,
)
from gcs.views.scene import Newest
from scenarios.keys.part import PREDICTION_MAX_S
from scenarios.schema import Scenario

WINDOW_S = 5.0
"""Window of the last seconds for percentiles and the least headroom."""
PLAIN_EVERY_S = 5.0
EVENTS_SHOWN = 3
TOGETHER_S = 0.5
"""Equal events within this time share a line."""
_NEVER = sys.maxsize
"""Least terminal width of a column that a flight does not need: it is never shown."""

HEADROOM_GOOD = 0.3
"""Headroom from which it is shown in green."""
MODE_STYLES: dict[Mode, str] = {
    Mode.NOMINAL: "green",
    Mode.WAITING: "dim",
    Mode.RECOVERING: "cyan",
    Mode.CAUTION: "yellow",
    Mode.CRITICAL: "bold red",
    Mode.FAILSAFE: "bold magenta",
    Mode.LOST: "bold red",
}
"""Style of each mode, from the best mode to the worst."""
_BADNESS = list(MODE_STYLES)


class FlightState:
    """The state of a flight according to the ticks and events read so far."""

    def __init__(self, scenario: Scenario, design: Design) -> None:
        self.scenario = scenario
        self.redesigned(design)
        self.phase = UNKNOWN
        self.refused = ""
        """What the station has refused, in words."""
        self.without_target = set[int]()
        """Vehicles that do not report which set-point is acting."""
        self.time_s = np.nan
        self.before_s = patience_s(scenario)
        """Offset from scenario time to the time since the station started, which is shown until the flight begins."""
        self.skipped = 0
        """Number of ticks that the station skipped."""
        self.news: list[str] = []
        """The newest events, one line each; equal events of several vehicles share a line."""
        self._last_event: tuple[str, str, float] | None = None
        self._named: list[int] = []
        self.system_ids = [vehicle.system_id for vehicle in scenario.vehicles]
        self.newest: TickArray = np.zeros(len(self.system_ids), TICK)
        for name in TICK.names or ():
            if TICK[name].kind == "f":
                self.newest[name] = np.nan
        self._newest_rtt_s = Newest(len(self.system_ids))
        self.rtt_s = self.newest["rtt_s"]
        self._window: TickArray = np.empty((0, len(self.system_ids)), TICK)

    def redesigned(self, design: Design) -> None:
        self.design = design
        self._figures_at = cache(partial(figures_at, design, self.scenario))

    def at_delay(self, figures: "Figures") -> str:
        """In words, α and the growth of spacing errors at the largest median loop delay, rounded to the millisecond.

        Empty for delays longer than any loop is designed for.
        """
        delay_s = _worst(figures.loop_delay_s_p50)
        if not delay_s <= PREDICTION_MAX_S:
            return ""
        delay_ms = round(1e3 * delay_s)
        found = self._figures_at(delay_ms / 1e3, figures.gain_set)
        grows = f", errors {growth_text(found.string_peak)}" if found.has_string_verdict else ""
        return "" if found.alpha is None else f"alpha {found.alpha:.3f}{grows} at {delay_ms} ms"

    def add(self, ticks: TickArray, events: list[Event]) -> None:
        """Update the state with whole ticks, shape (ticks, vehicles), and events."""
        for event in events:
            if event.kind == "phase":
                self.phase = event.text
            if event.text == WITHOUT_TARGET:
                self.without_target.update(event.about)
            if event.kind == REFUSED:
                self.refused = event.text
            else:
                self._add_news(event)
        if not ticks.size:
            return
        before = ticks["tick"][0, 0] - 1 if np.isnan(self.time_s) else self.newest["tick"][0]
        self.skipped += int(ticks["tick"][-1, 0] - before) - len(ticks)
        self.newest = ticks[-1]
        self.time_s = float(ticks["time_s"][-1, 0])
        self.rtt_s = self._newest_rtt_s.fill(ticks["rtt_s"])[-1]
        window = np.concatenate([self._window, ticks])
        flown = window[window["commanded"].any(axis=1)]
        window = flown if flown.size else window
        self._window = window[window["time_s"][:, 0] > window["time_s"][-1, 0] - WINDOW_S]

    def _add_news(self, event: Event) -> None:
        same = (event.kind, event.text, event.time_s // TOGETHER_S)
        if event.system_id is not None and self._named and same == self._last_event:
            self._named.append(event.system_id)
            self.news.pop()
        else:
            self._named = event.about
            self._last_event = same
        self.news = [*self.news, event_text(event, self._named, self.before_s)][-EVENTS_SHOWN:]

    def figures(self) -> "Figures":
        """The figures to show; NaN where unknown. After the flight they stay those of its last commands."""
        now, window = self.newest, self._window
        heard = window["mode"] != Mode.LOST  # the age of a lost vehicle's last state is no loop delay
        loop_delay_s, headroom = (np.where(heard, window[name], np.nan) for name in ("loop_delay_s", "headroom"))
        late_s = (window["sent_ns"].max(axis=1, keepdims=True) - window["due_ns"][:, :1]) / 1e9
        return Figures(
            spacing_error_m=np.hypot(now["spacing_error_north_m"], now["spacing_error_east_m"]),
            loop_delay_s_p50=_quantile(loop_delay_s, 0.5),
            loop_delay_s_p99=_quantile(loop_delay_s, 0.99),
            headroom=_quantile(headroom, 0.0),
            modes=[Mode(int(mode)) for mode in now["mode"]],
            lateness_s_p99=float(_quantile(late_s, 0.99)[0]),
            gain_set=int(window["gain_set"][-1:].max(initial=0, where=window["commanded"][-1:])),
        )


@dataclass(frozen=True)
class Figures:
    """Figures of each vehicle, in the scenario's order; percentiles and least headroom are over the last WINDOW_S."""

    spacing_error_m: FloatArray
    loop_delay_s_p50: FloatArray
    loop_delay_s_p99: FloatArray
    headroom: FloatArray
    modes: list[Mode]
    lateness_s_p99: float
    gain_set: int
    """The slowest gain set with which any vehicle is flown."""


def render(state: FlightState, *, width: int, height: int) -> RenderableType:
    """The whole display, in at most `height` lines: as many vehicles as fit, and the number of the others."""
    figures, duration_s = state.figures(), state.scenario.duration_s
    done_s = min(max(np.nan_to_num(state.time_s), 0.0), duration_s)
    bar = ProgressBar(total=duration_s, completed=done_s, width=max(width - 28, 10))
    progress = Table.grid(padding=(0, 2))
    progress.add_row(bar, f"{duration_s - done_s:.1f} s of {duration_s:.1f} s left")
    foot = _footer(state, figures)
    order = list(range(len(state.system_ids)))
    room = max(height - len(foot) - 6, 2)  # 6: two lines above the table, two of headings, the rule, an empty line
    if len(order) > room:  # keeps the vehicles in the worst modes, within a mode those with the least headroom
        headroom = np.nan_to_num(figures.headroom, nan=np.inf)
        order.sort(key=lambda k: (-_BADNESS.index(figures.modes[k]), headroom[k]))
        order = sorted(order[: room - 1])
    table, hidden = _vehicles(state, figures, order, width), len(state.system_ids) - len(order)
    return Group(_headline(state), progress, table, *not_shown(hidden), Text(), *foot)


def _headline(state: FlightState) -> Text:
    time = UNKNOWN if np.isnan(state.time_s) else time_text(state.time_s, state.before_s, ".1f")
    line = Text.assemble((state.scenario.name, "bold"), "  ", (state.phase, "bold cyan"), f"  {time}")
    loop = state.scenario.control.loop
    margin = f"{ms_text(state.design.delay_margin_s, '.0f', unit='')} ms ({loop} loop, fastest gains)"
    line.append(f"   delay margin {'unknown' if state.design.margin_unknown else margin}", style="dim")
    line.no_wrap = True
    return line


def _vehicles(state: FlightState, figures: Figures, order: list[int], width: int) -> Table:
    vehicles, headroom, error_m = state.scenario.vehicles, figures.headroom, figures.spacing_error_m
    spacing_m = [np.hypot(*(vehicle.offset_ne_m or (np.nan, np.nan))) for vehicle in vehicles]
    altitude_from = 76 if state.scenario.has_altitude_slots else _NEVER
    assumed_from = 101 if state.scenario.control.prediction != "off" else _NEVER
    columns: list[FittedColumn[int]] = [
        ("id", 3, 0, lambda k: str(vehicles[k].system_id)),
        ("follows", 7, 101, lambda k: number_text(vehicles[k].follows, "d")),
        ("altitude\nm", 8, altitude_from, lambda k: number_text(-state.newest["down_m"][k], ".1f")),
        ("spacing\nerror m", 7, 0, lambda k: number_text(error_m[k], ".2f")),
        ("error\n%", 5, 76, lambda k: number_text(100 * error_m[k] / spacing_m[k], ".1f")),
        ("RTT\nms", 6, 76, lambda k: ms_text(state.rtt_s[k], unit="")),
        ("delay p50\nms", 9, 76, lambda k: ms_text(figures.loop_delay_s_p50[k], unit="")),
        ("delay p99\nms", 9, 0, lambda k: ms_text(figures.loop_delay_s_p99[k], unit="")),
        ("assumed\nms", 7, assumed_from, lambda k: ms_text(state.newest["assumed_delay_s"][k], ".0f", unit="")),
        ("margin\nms", 6, 101, lambda k: ms_text(state.newest["delay_margin_s"][k], ".0f", unit="")),
        ("headroom\n%", 8, 0, lambda k: headroom_text(headroom[k])),
        ("", 10, 113, lambda k: Text(_bar(headroom[k]), headroom_style(headroom[k]))),
        ("lost", 5, 76, lambda k: str(state.newest["lost"][k])),
        ("late", 5, 76, lambda k: str(state.newest["late"][k])),
        ("mode", 8, 0, lambda k: Text(figures.modes[k].name, MODE_STYLES[figures.modes[k]])),
    ]
    return fitted_table(order, columns, width=width, gap=1 if width >= 101 else 0)


def _footer(state: FlightState, figures: Figures) -> list[Text]:
    line = Text(f"least headroom {_worst_headroom(state, figures)}", no_wrap=True)
    line.append(f"   tick lateness p99 {ms_text(figures.lateness_s_p99, '.2f', unit='')} ms")
    if state.skipped:
        line.append(f"   {state.skipped} ticks skipped", style="yellow")
    refused = [Text(f"refused: {state.refused}", style="yellow", no_wrap=True)] if state.refused else []
    flown = [Text(at_delay, no_wrap=True)] if (at_delay := state.at_delay(figures)) else []
    text = assumption(state.scenario)
    if text and state.without_target:
        text = f"{text}: {vehicles_text(sorted(state.without_target))}"
    assumed = [Text(f"assumed: {text}", style="dim", no_wrap=True)] if text else []
    return [line, *flown, *refused, *assumed, *(Text(line, style="dim", no_wrap=True) for line in state.news)]


def plain_line(state: FlightState) -> str:
    figures, modes = state.figures(), list[str]()
    for mode in (mode for mode in reversed(_BADNESS) if mode != Mode.NOMINAL and mode in figures.modes):
        own = [str(system_id) for system_id, now in zip(state.system_ids, figures.modes, strict=True) if now == mode]
        modes.append(f"{mode.name} {' '.join(own)}")
    time, at_delay = time_text(state.time_s, state.before_s), state.at_delay(figures)
    return (
        f"{time}  spacing error max {number_text(_worst(figures.spacing_error_m), '.2f')} m"
        f"  loop delay p99 max {ms_text(_worst(figures.loop_delay_s_p99), unit='')} ms"
        f"  headroom min {_worst_headroom(state, figures)}  {', '.join(modes) or 'all NOMINAL'}"
        f"{at_delay and f'  {at_delay}'}"
    )


def time_text(time_s: float, before_s: float, form: str = "8.2f") -> str:
    """The flight time or, before the flight, the time since the station started: scenario time plus `before_s`."""
    return f"start {time_s + before_s:+.2f} s" if time_s < 0.0 else f"{number_text(time_s, form)} s"


def merged(events: Iterable[Event]) -> list[tuple[Event, list[int]]]:
    """Events with the vehicles that each is about; consecutive events equal in time, kind and text are merged."""
    same = groupby(events, key=lambda event: (event.time_s, event.kind, event.text))
    groups = [list(group) for _, group in same]
    return [(group[0], [system_id for event in group for system_id in event.about]) for group in groups]


def event_text(event: Event, system_ids: list[int], before_s: float) -> str:
    """One line of text for an event about these vehicles; `before_s` is as in `time_text`."""
    who = f"{vehicles_text(system_ids)}: " if system_ids else ""
    kind = "" if event.kind == "vehicle" else f"{event.kind}  "  # otherwise "vehicle" would appear twice
    return f"{time_text(event.time_s, before_s)}  {kind}{who}{event.text}"


class Display:
    """Shows a flight on standard output: as a live table on a terminal, otherwise as lines of text."""

    def __init__(self, state: FlightState, live: Live | None, *, shown: bool) -> None:
        self._state = state
        self._live = live
        self._says_lines = shown and live is None
        self._line_due_s = -np.inf

    def events(self, events: list[Event]) -> None:
        """Print each event once, unless the live table shows it."""
        for event, system_ids in merged(events) if self._says_lines else ():
            print(event_text(event, system_ids, self._state.before_s), flush=True)

    def show(self, *, last: bool = False) -> None:
        """Show the current state; as text, only every `PLAIN_EVERY_S` of scenario time, and if `last`."""
        state = self._state
        if self._live is not None:
            draw(self._live, partial(render, state))
        elif self._says_lines and (state.time_s >= self._line_due_s or last):
            self._line_due_s = (state.time_s // PLAIN_EVERY_S + 1) * PLAIN_EVERY_S
            print(plain_line(state), flush=True)


def _quantile(values: FloatArray, probability: float) -> FloatArray:
    """A quantile (the nearest value above) over axis 0, ignoring NaN; NaN where all values are.

    It equals np.nanquantile, which takes a hundred times longer with a NaN in every column.
    """
    ordered = np.sort(np.vstack([values, np.full(values.shape[1], np.nan)]), axis=0)  # NaN last
    place = np.ceil(probability * (np.sum(~np.isnan(values), axis=0) - 1)).astype(int)  # -1 where nothing is known
    return ordered[place, np.arange(values.shape[1])]


def _worst(values: FloatArray) -> float:
    return float(np.fmax.reduce(values, initial=np.nan))


def _worst_headroom(state: FlightState, figures: Figures) -> str:
    if np.all(np.isnan(figures.headroom)):
        return UNKNOWN
    worst = int(np.nanargmin(figures.headroom))
    return f"{100 * figures.headroom[worst]:.0f} % (vehicle {state.system_ids[worst]})"


def headroom_style(headroom: float | None) -> str:
    """The style in which a headroom is shown; dim if it is unknown."""
    if headroom is None or np.isnan(headroom):
        return "dim"
    return "green" if headroom >= HEADROOM_GOOD else "yellow" if headroom >= 0 else "bold red"


def headroom_text(headroom: float | None, before: str = "") -> Text:
    """A headroom in percent, in its style."""
    return Text(before + number_text(headroom, ".0f", factor=100), headroom_style(headroom))


def _bar(headroom: float) -> str:
    eighths = int(np.clip(np.nan_to_num(headroom), 0, 1) * 80)
    return ("█" * (eighths // 8) + " ▏▎▍▌▋▊▉"[eighths % 8]).ljust(10)[:10]
