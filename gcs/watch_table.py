"""What `gcs monitor` shows: the figures of links as a table, a line, or the last word."""

from typing import Any

from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from gcs.table import UNKNOWN, headroom_style
from gcs.watch import Figures

STATUS_STYLES = {"measured": "green", "past the margin": "bold red", "silent": "bold red", "not heard": "bold red"}
_LOWER_BOUND = "lower bound"
_WIDE = 115


def render(report: dict[str, Any], *, width: int, height: int | None = None) -> RenderableType:
    """The whole display, in at most `height` lines: what fits of the vehicles, the worst, and how many do not."""
    vehicles: list[Figures] = report["vehicles"]
    room = len(vehicles) if height is None else max(1, height - 7)
    shown = vehicles
    if len(vehicles) > room:
        worst = sorted(vehicles, key=_badness)[: max(1, room - 1)]
        shown = sorted(worst, key=lambda figures: figures["system_id"])
    hidden = len(vehicles) - len(shown)
    more = [Text(f"  … {hidden} vehicles not shown, none of them worse", style="dim")] if hidden else []
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


def print_report(report: dict[str, Any], console: Console | None = None) -> None:
    """The figures of the whole time."""
    console = console or Console(highlight=False)
    console.print(render(report, width=console.width))


def _badness(figures: Figures) -> tuple[bool, float]:
    return figures["status"] not in ("silent", "not heard"), 1.0 if figures["headroom"] is None else figures["headroom"]


def _headline(report: dict[str, Any]) -> Text:
    line = Text.assemble(("links", "bold"), f" at {report['listening']}  {report['duration_s']:.1f} s", no_wrap=True)
    margin_s = report["delay_margin_s"]
    of = f"{_ms(margin_s)} ms ({report['margin_of']})" if margin_s is not None else "none given"
    line.append(f"   delay margin {of}", style="dim")
    return line


def links_table(vehicles: list[Figures], width: int) -> Table:
    """One row for each vehicle; on a narrow terminal the columns that say least are left out."""
    wide = width >= _WIDE
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1 if wide else 0, 0, 0))
    columns = [("id", 3), *[("Hz", 5)] * wide, ("RTT p50\nms", 8), ("p99\nms", 7)]
    columns += [("age p50\nms", 8), ("p99\nms", 7)] * wide + [("loop p50\nms", 9), ("p99\nms", 9), ("headroom\n%", 8)]
    columns += [("lost\n%", 6), *[("late", 4), ("clock offset\ns", 13), ("±\nms", 7)] * wide, ("", 15)]
    for name, least in columns:
        table.add_column(name, justify="left" if name == "" else "right", no_wrap=True, min_width=least)
    for v in vehicles:
        bound = "≥ " if v["loop_delay_s"]["status"] == _LOWER_BOUND else ""
        at_most = "≤ " if bound and v["headroom"] is not None else ""
        expected = v["received"] + v["lost"]
        clock, status = v["clock"], v["status"]
        age = [_ms(v["telemetry_age_s"][p], bound) for p in ("p50", "p99")]
        offset = _number(clock["offset_s"], ".6f"), _ms(clock["bound_s"])
        left = v["headroom"]
        table.add_row(
            str(v["system_id"]),
            *[_number(v["telemetry_hz"], ".1f")] * wide,
            *(_ms(v["rtt_s"][p]) for p in ("p50", "p99")),
            *age * wide,
            *(_ms(v["loop_delay_s"][p], bound) for p in ("p50", "p99")),
            Text(at_most + _percent(left), "dim" if left is None else headroom_style(left)),
            _number(100 * v["lost"] / expected if expected else None, ".1f"),
            *([str(v["late"]), *offset] if wide else []),
            Text(f" {status}", STATUS_STYLES.get(status, "yellow")),
        )
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
