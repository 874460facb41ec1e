"""The display of `gcs monitor`: the figures of links, as a table or as one line."""

from collections.abc import Sequence

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from gcs.views.console import UNKNOWN, FittedColumn, fitted_table, ms_text, not_shown, number_text
from gcs.views.table import headroom_text
from gcs.watch.links import LOWER_BOUND, PAST, LinkFigures, WatchReport

STATUS_STYLES = {"measured": "green", PAST: "bold red", "silent": "bold red", "not heard": "bold red"}
NOT_ASKED = "many autopilots send none until a station asks; --request asks"
RATES_UNKNOWN = "no scenario, so no rates: repetition of a position counts as loop delay"
_SLOW = 0.9
"""Telemetry below this share of the scenario's rate is reported as slow."""
_USUAL, _MORE, _WIDE = 73, 84, 146
"""Terminal widths from which more columns are shown."""


def render(report: WatchReport, *, width: int, height: int | None = None) -> RenderableType:
    """The whole display, in at most `height` lines: the worst vehicles that fit, and the number of the others."""
    vehicles = report.vehicles
    notes = [*_without_position(report), *_of_rates(report), *unjudged(vehicles)]
    room = len(vehicles) if height is None else max(1, height - 6 - max(1, len(notes)))
    if len(vehicles) > room:
        vehicles = sorted(sorted(vehicles, key=_badness)[: max(1, room - 1)], key=lambda figures: figures.system_id)
    table = links_table(vehicles, width) if vehicles else Text("no vehicle heard", "bold red")
    hidden = len(report.vehicles) - len(vehicles)
    return Group(_headline(report), table, *not_shown(hidden), *notes, _footer(report, is_whole=height is None))


def plain_line(report: WatchReport) -> str:
    vehicles = report.vehicles
    if not vehicles:
        return f"{report.duration_s:8.1f} s  no vehicle heard"
    rtt_s = max((v.rtt_s.p99 for v in vehicles if v.rtt_s.p99 is not None), default=None)
    loop_s = max((v.loop_delay_s.p99 for v in vehicles if v.loop_delay_s.p99 is not None), default=None)
    least = min((v.headroom for v in vehicles if v.headroom is not None), default=None)
    states = sorted({v.status for v in vehicles})
    return (
        f"{report.duration_s:8.1f} s  {len(vehicles)} vehicles: {', '.join(states)}  RTT p99 max {_ms(rtt_s)} ms"
        f"  loop delay p99 max {_ms(loop_s)} ms  headroom min {number_text(least, '.0f', factor=100)} %"
    )


def _badness(figures: LinkFigures) -> tuple[bool, float]:
    heard = figures.status not in ("silent", "not heard") and not figures.unjudged
    return heard, 1.0 if figures.headroom is None else figures.headroom


def _headline(report: WatchReport) -> Text:
    line = Text.assemble(("links", "bold"), f" at {report.listening}  {report.duration_s:.1f} s", no_wrap=True)
    margin_s = report.delay_margin_s
    unlimited = "no limit" if report.margin_of else "none given"
    of = unlimited if margin_s is None else f"{ms_text(margin_s)} ({report.margin_of})"
    line.append(f"   delay margin {of}", style="dim")
    return line


def links_table(vehicles: Sequence[LinkFigures], width: int) -> Table:
    def headroom(v: LinkFigures) -> Text:
        return headroom_text(v.headroom, "≤ " if _bound(v) and v.headroom is not None else "")

    columns: list[FittedColumn[LinkFigures]] = [
        ("id", 3, 0, lambda v: str(v.system_id)),
        ("Hz", 5, _WIDE, lambda v: number_text(v.telemetry_hz, ".1f")),
        ("RTT p50\nms", 8, 0, lambda v: _ms(v.rtt_s.p50)),
        ("p99\nms", 7, _MORE, lambda v: _ms(v.rtt_s.p99)),
        ("age p50\nms", 8, _WIDE, lambda v: _ms(v.telemetry_age_s.p50, _bound(v))),
        ("p99\nms", 7, _WIDE, lambda v: _ms(v.telemetry_age_s.p99, _bound(v))),
        ("loop p50\nms", 8, _USUAL, lambda v: _ms(v.loop_delay_s.p50, _bound(v))),
        ("p99\nms" if width >= _USUAL else "loop p99\nms", 8, 0, lambda v: _ms(v.loop_delay_s.p99, _bound(v))),
        ("mean\nms", 7, _USUAL, lambda v: _ms(v.effective_loop_delay_s, _bound(v))),
        ("headroom\n%", 8, 0, headroom),
        ("lost\n%", 6, _USUAL, lambda v: number_text(100 * v.lost / (v.received + v.lost or np.nan), ".1f")),
        ("late", 4, _WIDE, lambda v: str(v.late)),
        ("clock offset\ns", 13, _WIDE, lambda v: number_text(v.clock.offset_s, ".6f")),
        ("±\nms", 7, _WIDE, lambda v: _ms(v.clock.bound_s)),
        ("", 15, 0, lambda v: Text(f" {v.status}", STATUS_STYLES.get(v.status, "yellow"))),
    ]
    return fitted_table(vehicles, columns, width=width, gap=1 if width >= _WIDE else 0)


def unjudged(vehicles: Sequence[LinkFigures]) -> list[Text]:
    """A note about vehicles whose headroom says nothing about the end of the watch, if there are any."""
    which = " ".join(str(v.system_id) for v in vehicles if v.unjudged)
    return [Text(f"not judged: {which}; loop delay unknown or a lower bound at the end", "yellow")] if which else []


def _bound(figures: LinkFigures) -> str:
    return "≥ " if figures.loop_delay_s.status == LOWER_BOUND else ""


def _without_position(report: WatchReport) -> list[Text]:
    """A note about vehicles that send no position, if there are any: an ArduPilot streams none unless it is asked."""
    without = [str(v.system_id) for v in report.vehicles if v.telemetry_age_s.p50 is None and v.received]
    if not without:
        return []
    why = "asked for, but not sent yet" if report.sent.get("SET_MESSAGE_INTERVAL") else NOT_ASKED
    return [Text(f"no position from {' '.join(without)}: {why}", "yellow")]


def _of_rates(report: WatchReport) -> list[Text]:
    """A note if telemetry is slower than the scenario's rate, or if that rate is unknown."""
    if (wanted_hz := report.scenario_telemetry_hz) is None:
        return [] if report.delay_margin_s is None else [Text(RATES_UNKNOWN, "yellow")]
    slow = {v.system_id: v.telemetry_hz for v in report.vehicles if (v.telemetry_hz or wanted_hz) < _SLOW * wanted_hz}
    if not slow:
        return []
    unasked = f" until a station asks; loop delays are for {wanted_hz:g} Hz"
    effect = f", not {wanted_hz:g} Hz: the difference counts as loop delay" if report.stations else unasked
    slowest_hz = min(filter(None, slow.values()))
    return [Text(f"positions at {slowest_hz:.3g} Hz from {' '.join(map(str, slow))}{effect}", "yellow")]


def _footer(report: WatchReport, *, is_whole: bool) -> Text:
    """What was sent and left out; on one line, unless the display is `is_whole`, of any height."""
    asked = report.sent.get("SET_MESSAGE_INTERVAL", 0)
    more = f"{asked} requests for positions" if asked else "nothing else"
    text = "nothing is sent" if report.silent else f"sent {report.sent['TIMESYNC']} TIMESYNC requests, {more}"
    if report.stations:
        text += f"; stations heard: {' '.join(map(str, report.stations))}"
    if report.refused:
        text += "; left out: " + ", ".join(f"{count} {reason}" for reason, count in report.refused.items())
    return Text(text, style="dim", no_wrap=not is_whole, overflow="fold" if is_whole else "ellipsis")


def _ms(seconds: float | None, before: str = "") -> str:
    return UNKNOWN if seconds is None else before + ms_text(seconds, unit="")
