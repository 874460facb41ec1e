"""What `gcs compare`, `bench` and `capacity` print."""

import os
from shutil import which
from typing import Any

from rich import box
from rich.table import Table

from gcs.cli.runs import print_grade
from gcs.runs.grade import Grade
from gcs.studies.capacity import FEWEST, Capacity, Load
from gcs.studies.compare import Route, rows
from gcs.studies.compare_cost import RATIO, DesignCost, left_out, ratios
from gcs.views.console import number_text, plain_console
from scenarios.schema import Scenario

_WHOLE_CORE = 0.95
"""A flight that had at least this share of a core counts as undisturbed."""


def print_comparison(scenario: Scenario, routes: list[Route], grown: list[DesignCost]) -> None:
    """Print each route's figures side by side, and what designs cost as the formation grows."""
    console = plain_console()
    title = f"{scenario.name}: designed for what it asks for, flown over its links"
    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", title_style="")
    for heading in ("", *(route.method for route in routes)):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for title, texts in rows(routes):
        table.add_row(title, *texts)
    console.print(table)
    for route in routes:
        if route.failed:
            console.print(f"{route.method}: {route.failed}")
    if grown:
        table = Table(box=box.SIMPLE_HEAD)
        for heading in ("design of a chain", "vehicles", "free gains an axis", "time, s", RATIO):
            table.add_column(heading, justify="right", no_wrap=not table.columns)
        for size, ratio in zip(grown, ratios(grown), strict=True):
            table.add_row(size.method, str(size.vehicles), str(size.free_gains), f"{size.design_s:.3f}", f"{ratio:.2f}")
        console.print(table)
        for line in left_out(grown):
            console.print(line)


def print_capacity(scenario: Scenario, found: list[Capacity]) -> None:
    """Print, for each rate, the largest formation that is carried and the next, which is not."""
    console = plain_console()
    table = Table(box=box.SIMPLE_HEAD, title=f"{scenario.name}: what its links carry", title_justify="left")
    for heading in ("Hz", "UAVs", "loop delay, ms\np50  p99", "margin\nms", "byte/s", "lost, %\nup  down", ""):
        table.add_column(heading, justify="right", no_wrap=True, min_width=4)
    for capacity in found:
        for load in (capacity.most, capacity.next):
            if load is not None:
                table.add_row(*_row(load), style="" if load.holds else "dim")
    console.print(table)
    for capacity in found:
        if capacity.failed:
            console.print(f"{capacity.rate_hz:g} Hz: {capacity.failed}")
        elif capacity.most is None:
            console.print(f"{capacity.rate_hz:g} Hz: not even {FEWEST} vehicles")


def _row(load: Load) -> list[str]:
    def ms(value: float | None) -> str:
        return number_text(None if value is None else 1e3 * value, ".0f")

    gone = load.headroom_p01 is None or load.headroom_p01 <= 0.0
    return [
        f"{load.rate_hz:g}",
        str(load.vehicles),
        f"{ms(load.loop_delay_p50_s)}  {ms(load.loop_delay_p99_s)}",
        ms(load.delay_margin_s),
        f"{load.station_bytes_s:.0f}",
        f"{100.0 * load.lost_up:.1f}  {100.0 * load.lost_down:4.1f}",
        "holds" if load.holds else "margin gone" if gone else load.reason,
    ]


def print_benchmark(result: dict[str, Any]) -> None:
    """Print how much faster than real time flights are, and the station's share of its period."""
    how = "compiled" if result["compiled"] else "interpreted"
    print(f"{result['vehicles']} vehicles at {result['control_hz']:g} Hz, one core, hot path {how}")
    print(
        f"virtual time    {result['real_time_factor']:.3g} times real time "
        f"(best of {result['flights']}; median {result['real_time_factor_p50']:.3g})"
    )
    if result["core_share"] < _WHOLE_CORE:
        whole = result["real_time_factor"] / result["core_share"]
        print(f"                with {result['core_share']:.0%} of a core; {whole:.3g} times with all of it")
    print(
        f"station alone   {1e6 * result['station_s_per_tick']:.0f} µs a tick, "
        f"{100 * result['station_share_of_period']:.1f} % of its period"
    )
    if (cost := result["signed"]) is not None:
        print(
            f"signed          takes {cost['time_ratio']:.2f} times as long (median {cost['time_ratio_p50']:.2f}), "
            f"the station {cost['station_time_ratio']:.2f} times (median {cost['station_time_ratio_p50']:.2f})"
        )
    if not result["compiled"]:
        first = "" if which(os.environ.get("CC", "cc")) else "install a C compiler, then "
        print(f"twice as fast:  {first}python3 make.py compile")


def print_real_time(result: dict[str, Any]) -> None:
    """Print how punctual the station was, and the errors of its measurements."""
    control = result["control"]
    late = control["lateness_s"]
    print(f"{result['reason']}; load {result['load_average']:.1f}, {result['steal_share']:.1%} taken by the host")
    print(
        f"set-points sent after they were due: p50 {1e3 * late['p50']:.3f} ms, p99 {1e3 * late['p99']:.3f} ms, "
        f"{control['deadline_misses']} deadline misses of {control['ticks']} ticks"
    )
    print_grade(Grade.model_validate(result))
