"""What the terminal shows before and after a flight."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from gcs.plan.design import Design, FiguresAtDelay, FiguresAtExpectedDelay, ResponsePart
from gcs.runs.record import STARTED
from gcs.runs.refusals import in_words
from gcs.views.console import plain_console

UNKNOWN = "–"


def print_design(design: Design, console: Console | None = None) -> None:
    """Gains, robustness, both margins, and the trade-off between robustness and margin."""
    console = console or plain_console()
    console.print(f"design   {design.method}, loop {design.loop}, period {design.period_s * 1e3:g} ms")
    if design.inclusion_gains is None or design.behaviour is None:
        _print_graph_design(design, console)
        return
    own, front, spacing = (gain[0][0] for gain in design.inclusion_gains)
    console.print(f"gains    K1 {own:+.4f} 1/s, K2 {front:+.4f} 1/s, K3 {spacing:+.4f} 1/s²")
    console.print("         u_i = K1 e_i^v + K2 e_(i-1)^v + K3 e_i^p, the leader u_1 = K1 e_1^v, north and east alike")
    _print_margins(design, console)
    console.print(_response(design.response), end="")
    console.print(
        f"alpha    {design.alpha:.4f} (robustness bound), decay {design.behaviour.decay_rate_1_s:.2f} 1/s without delay"
    )
    if design.at_loop_delay is not None:
        _print_figures_at_delay(design.at_loop_delay, console)
    if not design.trade_off:
        return
    table = Table(box=box.SIMPLE_HEAD, title="the trade-off it sits on", title_justify="left", title_style="")
    table.add_column("delay margin, ms", justify="right")
    table.add_column("largest alpha", justify="right")
    for point in design.trade_off:
        table.add_row(_ms(point.delay_margin_s, unit=""), f"{point.alpha:.3f}")
    console.print(table)


def _print_margins(design: Design, console: Console) -> None:
    sampled_s, continuous_s = design.delay_margin_s, design.delay_margin_continuous_s
    if design.loop == "onboard" and sampled_s is None:
        console.print("margin   no limit: no delay of what the station streams makes this loop unstable")
    elif sampled_s == 0.0:
        console.print("margin   none: the sampled loop is unstable without any delay")
    else:
        console.print(
            f"margin   {_ms(sampled_s)} of loop delay in the sampled loop, {_ms(continuous_s)} in the continuous model"
        )
    if design.vehicles == 1:
        console.print("         of the one vehicle's own velocity loop, as nobody follows it")
    if design.onboard is not None:
        ground_s = design.onboard.ground_delay_margin_s
        console.print(f"         {_ms(ground_s)} if the station closed every loop with the same gains")


def _print_figures_at_delay(flown: FiguresAtExpectedDelay, console: Console) -> None:
    console.print(f"         {figures_text(flown)} (that of the scenario's links)")
    kept = f"at least {flown.alpha_kept:.4f} {_up_to(flown.alpha_kept_to_s)}"
    if flown.string_peak_kept is None:
        console.print(f"         {kept}")
        console.print("string   no verdict: with gains on a general pattern errors do not run down a chain")
        return
    growth = f"growth at most {flown.string_peak_kept:.2f} times {_up_to(flown.string_peak_kept_to_s)}"
    console.print(f"         {kept}; {growth}")


def figures_text(flown: FiguresAtDelay) -> str:
    """α and, where they run down a chain, the growth of spacing errors at a loop delay, in words."""
    alpha = f"{flown.alpha:.4f} at {_ms(flown.loop_delay_s)} of loop delay"
    if not flown.has_string_verdict:
        return f"{alpha}, of the whole formation"
    grows = "without bound" if flown.string_peak is None else f"{flown.string_peak:.2f} times at most"
    return f"{alpha}, where spacing errors grow {grows} from vehicle to vehicle"


def _up_to(delay_s: float | None) -> str:
    if delay_s is None:
        return "at every loop delay"
    return "at no loop delay" if delay_s == 0.0 else f"up to {_ms(delay_s)} of it"


def _print_graph_design(design: Design, console: Console) -> None:
    """The gain matrix by blocks: who uses whose errors, and how."""
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("vehicle", "uses", "spacing error, 1/s²", "velocity error, 1/s"):
        table.add_column(heading, justify="right")
    for block in design.blocks:
        *spacing, north, east = zip(*block.gain, strict=True)
        table.add_row(str(block.vehicle), str(block.of), _matrix(spacing), _matrix([north, east]))
    console.print(table)
    _print_margins(design, console)
    loss = "" if design.cost_loss is None else f"; costs {design.cost_loss:.1%} more than with all information"
    console.print(
        f"alpha    {design.alpha:.4f} (robustness bound of the whole formation), decay "
        f"{design.decay_rate_1_s:.2f} 1/s without delay{loss}"
    )
    if design.at_loop_delay is not None:
        _print_figures_at_delay(design.at_loop_delay, console)


def number_text(value: float | None, form: str = ".5f") -> str:
    return UNKNOWN if value is None else format(value, form)


def _matrix(columns: Sequence[Sequence[float]]) -> str:
    """A block as one number where it is that on each axis alike, else with all of its numbers."""
    if not columns:
        return UNKNOWN
    (a, c), (b, d) = columns
    return f"{a:+.4f}" if a == d and b == c == 0.0 else f"[{a:+.4f} {b:+.4f}; {c:+.4f} {d:+.4f}]"


def print_summary(summary: dict[str, Any], folder: Path, console: Console | None = None) -> None:
    """The verdict with its figures, and where the files are."""
    console = console or plain_console()
    print_flight(summary, console)
    console.print(f"files    {folder}: {', '.join(summary['files'])}")
    if "flight.rrd" in summary["files"]:
        console.print(f"look     gcs view {folder}")


def print_flight(summary: dict[str, Any], console: Console) -> None:
    """The verdict with its figures; `control` may be None, where a log does not show the ticks."""
    style = {"stable": "bold green", "unstable": "bold red"}.get(summary["verdict"], "bold yellow")
    fleet = summary.get("fleet", STARTED)
    flown = "" if fleet == STARTED else f"; vehicles {fleet}"
    console.print(Text.assemble("verdict  ", (summary["verdict"], style), f": {_reason(summary)}{flown}"))
    for text in summary.get("not_logged", ()):
        console.print(f"log      not written: {text}")
    console.print(f"delay    {delay_text(summary)}")
    at_delay = FiguresAtDelay.model_validate(summary.get("at_loop_delay") or {"loop_delay_s": None})
    if at_delay.alpha is not None:
        console.print(f"alpha    {figures_text(at_delay)}")
    if (response := summary.get("response")) is not None:
        console.print(_response(ResponsePart.model_validate(response)), end="")
    control = summary["control"]
    if control is not None:
        console.print(
            f"control  {control['ticks']} ticks at {control['rate_hz']:g} Hz, "
            f"{control['deadline_misses']} deadline misses; settled {_after(summary['settling_time_s'])}"
        )
    for who, counts in (("station", summary.get("refused")), ("vehicles", summary.get("refused_by_vehicles"))):
        if counts:
            console.print(f"refused  by the {who}: {in_words(counts)}")
    if mirror := summary.get("mirror"):
        console.print(f"mirror   {in_words(mirror)}")
    table = Table(box=box.SIMPLE_HEAD)
    for name in ("vehicle", "final error, m", "largest, m", "RTT p50, ms", "loop p50, ms", "p99, ms", "lost", "late"):
        table.add_column(name, justify="right")
    for vehicle in summary["vehicles"]:
        table.add_row(
            str(vehicle["system_id"]),
            _metres(vehicle["spacing_error_final_m"]),
            _metres(vehicle["spacing_error_max_m"]),
            _ms(vehicle["rtt_s"]["p50"], unit=""),
            _ms(vehicle["loop_delay_s"]["p50"], unit=""),
            _ms(vehicle["loop_delay_s"]["p99"], unit=""),
            _count(vehicle["lost"]),
            _count(vehicle["late"]),
        )
    console.print(table)


def _reason(summary: dict[str, Any]) -> str:
    """How the flight ended; of one that was flown to its end and is not stable, why."""
    errors = [(v["spacing_error_final_m"], v["spacing_error_max_m"]) for v in summary["vehicles"]]
    known = [(final_m, most_m) for final_m, most_m in errors if final_m is not None and most_m is not None]
    if summary["verdict"] != "unstable" or not summary["reason"].startswith("completed") or not known:
        return summary["reason"]
    if summary["settling_time_s"] is not None:
        return f"errors are small after {summary['duration_s']:.1f} s, but the loop delay is past the margin"
    final_m, most_m = (max(column) for column in zip(*known, strict=True))
    return f"not settled in {summary['duration_s']:.1f} s; {final_m:.2f} m left of errors of up to {most_m:.2f} m"


def delay_text(summary: dict[str, Any]) -> str:
    """Loop delay against the margin."""
    delay, margin_s = summary["loop_delay_s"], summary["delay_margin_s"]
    margin = "no limit" if summary["loop"] == "onboard" and margin_s is None else f"margin {_ms(margin_s)}"
    flown_s = [vehicle.get("delay_margin_s", {}).get("max") for vehicle in summary.get("vehicles", [])]
    slowest_s = max((s for s in flown_s if s is not None), default=0.0)
    if margin_s is not None and slowest_s > margin_s:
        margin += f", up to {_ms(slowest_s)} with slower gains"
    return (
        f"loop {_ms(delay['p50'])} p50, {_ms(delay['p99'])} p99, {_ms(delay['max'])} max; "
        f"{margin}; least headroom {_percent(summary['headroom_min'])}"
    )


def _response(response: ResponsePart | None) -> str:
    """A line on how the vehicles answer, if they do not do so at once."""
    if response is None:
        return ""
    if not response.vehicles:
        text = "this margin is of vehicles that answer at once; theirs is found before the formation flight"
        return f"response {response.source}: {text}\n"
    lags, gains = (
        sorted(texts)
        for texts in zip(*((f"{v.lag_s:.3f}", f"{v.velocity_gain_1_s:.2f}") for v in response.vehicles), strict=True)
    )
    peak = response.string_peak
    grows = "" if peak is None else f"; spacing errors grow by {peak:.2f} at most from vehicle to vehicle with it"
    lag, gain = (" to ".join(dict.fromkeys((each[0], each[-1]))) for each in (lags, gains))
    return (
        f"response {response.source}: lag {lag} s, velocity gain {gain} 1/s; in the margin, which would be "
        f"{_ms(response.delay_margin_at_once_s)} without it{grows}\n"
    )


def _ms(seconds: float | None, *, unit: str = " ms") -> str:
    return UNKNOWN if seconds is None else f"{seconds * 1e3:.1f}{unit}"


def _metres(value: float | None) -> str:
    return UNKNOWN if value is None else f"{value:.2f}"


def _percent(value: float | None) -> str:
    return UNKNOWN if value is None else f"{value:.0%}"


def _after(seconds: float | None) -> str:
    return "not at all" if seconds is None else f"after {seconds:.1f} s"


def _count(value: int | None) -> str:
    return UNKNOWN if value is None else str(value)
