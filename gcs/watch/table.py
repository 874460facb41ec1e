"""What `gcs monitor` shows: the figures of links as a table, a line, or the last word."""

from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from gcs.views.table import UNKNOWN, headroom_style
from gcs.watch.links import Figures

STATUS_STYLES = {"measured": "green", "past the margin": "bold red", "silent": "bold red", "not heard": "bold red"}
_LOWER_BOUND = "lower bound"
_USUAL, _WIDE = 73, 140
"""Widths of terminals that more columns have room on."""


def render(report: dict[str, Any], *, width: int, height: int | None = None) -> RenderableType:
    """The whole display, in at most `height` lines: what fits of the vehicles, the worst, and how many do not."""
    vehicles: list[Figures] = report["vehicles"]
    room = len(vehicles) if height is None else max(1, height - 7)
    shown = vehicles
    if len(vehicles) > room:
        worst = sorted(vehicles, key=_badness)[: max(1, room - 1)]
        shown = sorted(worst, key=lambda figures: figures["system_id"])
    hidden = len(vehicles) - len(shown)
    more = [Text(f"  … {hidden} vehicles not shown, none of them worse", style="dim", no_wrap=True)] if hidden else []
    table = links_table(shown, width) if shown else Text("no vehicle heard", "bold red")
    return Group(_headline(report), table, *more, _footer(report))


def plain_line(report: dict[str, Any]) -> str:
    """The links in one line of text."""
    vehicles: list[Figures] = report["vehicles"]
    if not vehicles:
        return f"{report['duration_s']:8.1f} s  no vehicle heard"
    rtt_s, loop_s = (
        max((v[name]["p99"] for v in vehicles if v[name]["p99"] is not None), default=None)
        for name in ("rtt_s", "loop_delay_s")
    )
    least = min((v["headroom"] for v in vehicles if v["headroom"] is not None), default=None)
    states = sorted({v["status"] for v in vehicles})
    return (
        f"{report['duration_s']:8.1f} s  {len(vehicles)} vehicles: {', '.join(states)}  RTT p99 max {_ms(rtt_s)} ms"
        f"  loop delay p99 max {_ms(loop_s)} ms  headroom min {_percent(least)} %"
    )


def _badness(figures: Figures) -> tuple[bool, float]:
    return figures["status"] not in ("silent", "not heard"), 1.0 if figures["headroom"] is None else figures["headroom"]


def _headline(report: dict[str, Any]) -> Text:
    line = Text.assemble(("links", "bold"), f" at {report['listening']}  {report['duration_s']:.1f} s", no_wrap=True)
    margin_s = report["delay_margin_s"]
    of = f"{_ms(margin_s)} ms ({report['margin_of']})" if margin_s is not None else "none given"
    line.append(f"   delay margin {of}", style="dim")
    return line


_COLUMNS = (
    ("id", 3, 0),
    ("Hz", 5, _WIDE),
    ("RTT p50\nms", 8, 0),
    ("p99\nms", 7, _USUAL),
    ("age p50\nms", 8, _WIDE),
    ("p99\nms", 7, _WIDE),
    ("loop p50\nms", 9, _USUAL),
    ("p99\nms", 9, 0),
    ("headroom\n%", 8, 0),
    ("lost\n%", 6, _USUAL),
    ("late", 4, _WIDE),
    ("clock offset\ns", 13, _WIDE),
    ("±\nms", 7, _WIDE),
    ("", 15, 0),
)
"""Heading, least width, and the width of the terminal it needs."""


def links_table(vehicles: list[Figures], width: int) -> Table:
    """One row for each vehicle; on a narrow terminal the columns that say least are left out."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1 if width >= _WIDE else 0, 0, 0))
    for name, least, from_width in _COLUMNS:
        if width >= from_width:
            heading = f"loop {name}" if width < _USUAL and name == "p99\nms" else name
            table.add_column(heading, justify="left" if name == "" else "right", no_wrap=True, min_width=least)
    for v in vehicles:
        bound = "≥ " if v["loop_delay_s"]["status"] == _LOWER_BOUND else ""
        at_most = "≤ " if bound and v["headroom"] is not None else ""
        expected = v["received"] + v["lost"]
        clock, status, left = v["clock"], v["status"], v["headroom"]
        cells = [
            str(v["system_id"]),
            _number(v["telemetry_hz"], ".1f"),
            *(_ms(v["rtt_s"][p]) for p in ("p50", "p99")),
            *(_ms(v["telemetry_age_s"][p], bound) for p in ("p50", "p99")),
            *(_ms(v["loop_delay_s"][p], bound) for p in ("p50", "p99")),
            Text(at_most + _percent(left), "dim" if left is None else headroom_style(left)),
            _number(100 * v["lost"] / expected if expected else None, ".1f"),
            str(v["late"]),
            _number(clock["offset_s"], ".6f"),
            _ms(clock["bound_s"]),
            Text(f" {status}", STATUS_STYLES.get(status, "yellow")),
        ]
        columns = zip(cells, _COLUMNS, strict=True)
        table.add_row(*(cell for cell, (_, _, from_width) in columns if width >= from_width))
    return table


def _footer(report: dict[str, Any]) -> Text:
    sent = report["sent"]["TIMESYNC"]
    text = "nothing is sent" if report["silent"] else f"sent {sent} TIMESYNC requests, nothing else"
    if report["stations"]:
        text += f"; stations heard: {' '.join(map(str, report['stations']))}"
    if report["refused"]:
        text += "; left out: " + ", ".join(f"{count} {reason}" for reason, count in report["refused"].items())
    return Text(text, style="dim", no_wrap=True, overflow="ellipsis")


def _ms(seconds: float | None, before: str = "") -> str:
    return UNKNOWN if seconds is None else f"{before}{1e3 * seconds:.1f}"


def _percent(value: float | None) -> str:
    return UNKNOWN if value is None else f"{100 * value:.0f}"


def _number(value: float | None, form: str) -> str:
    return UNKNOWN if value is None else format(value, form)
