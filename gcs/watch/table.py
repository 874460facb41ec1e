"""What `gcs monitor` shows: the figures of links as a table, a line, or the last word."""

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from gcs.views.console import UNKNOWN, fitted_table, ms_text, not_shown, number_text
from gcs.views.table import headroom_style
from gcs.watch.links import LOWER_BOUND, LinkFigures, WatchReport

STATUS_STYLES = {"measured": "green", "past the margin": "bold red", "silent": "bold red", "not heard": "bold red"}
_USUAL, _WIDE = 73, 140
"""Widths of terminals that more columns have room on."""


def render(report: WatchReport, *, width: int, height: int | None = None) -> RenderableType:
    """The whole display, in at most `height` lines: what fits of the vehicles, the worst, and how many do not."""
    vehicles = report.vehicles
    room = len(vehicles) if height is None else max(1, height - 7)
    if len(vehicles) > room:
        vehicles = sorted(sorted(vehicles, key=_badness)[: max(1, room - 1)], key=lambda figures: figures.system_id)
    table = links_table(vehicles, width) if vehicles else Text("no vehicle heard", "bold red")
    hidden = len(report.vehicles) - len(vehicles)
    return Group(_headline(report), table, *not_shown(hidden), _footer(report))


def plain_line(report: WatchReport) -> str:
    """The links in one line of text."""
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
    return figures.status not in ("silent", "not heard"), 1.0 if figures.headroom is None else figures.headroom


def _headline(report: WatchReport) -> Text:
    line = Text.assemble(("links", "bold"), f" at {report.listening}  {report.duration_s:.1f} s", no_wrap=True)
    margin_s = report.delay_margin_s
    of = f"{ms_text(margin_s)} ({report.margin_of})" if margin_s is not None else "none given"
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
"""As `fitted_table` takes them."""


def links_table(vehicles: Sequence[LinkFigures], width: int) -> Table:
    """One row for each vehicle."""

    def row(v: LinkFigures) -> list[str | Text]:
        bound = "≥ " if v.loop_delay_s.status == LOWER_BOUND else ""
        at_most = "≤ " if bound and v.headroom is not None else ""
        style = "dim" if v.headroom is None else headroom_style(v.headroom)
        expected = v.received + v.lost
        return [
            str(v.system_id),
            number_text(v.telemetry_hz, ".1f"),
            _ms(v.rtt_s.p50),
            _ms(v.rtt_s.p99),
            _ms(v.telemetry_age_s.p50, bound),
            _ms(v.telemetry_age_s.p99, bound),
            _ms(v.loop_delay_s.p50, bound),
            _ms(v.loop_delay_s.p99, bound),
            Text(at_most + number_text(v.headroom, ".0f", factor=100), style),
            number_text(100 * v.lost / expected if expected else None, ".1f"),
            str(v.late),
            number_text(v.clock.offset_s, ".6f"),
            _ms(v.clock.bound_s),
            Text(f" {v.status}", STATUS_STYLES.get(v.status, "yellow")),
        ]

    columns = [
        (f"loop {name}" if width < _USUAL and name == "p99\nms" else name, least, from_width)
        for name, least, from_width in _COLUMNS
    ]
    return fitted_table(columns, map(row, vehicles), width=width, gap=1 if width >= _WIDE else 0)


def _footer(report: WatchReport) -> Text:
    text = "nothing is sent" if report.silent else f"sent {report.sent['TIMESYNC']} TIMESYNC requests, nothing else"
    if report.stations:
        text += f"; stations heard: {' '.join(map(str, report.stations))}"
    if report.refused:
        text += "; left out: " + ", ".join(f"{count} {reason}" for reason, count in report.refused.items())
    return Text(text, style="dim", no_wrap=True, overflow="ellipsis")


def _ms(seconds: float | None, before: str = "") -> str:
    return UNKNOWN if seconds is None else before + ms_text(seconds, unit="")
