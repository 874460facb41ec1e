"""What `gcs compare`, `bench` and `capacity` print."""

import os
from collections.abc import Callable
from shutil import which

from gcs.cli.runs import print_grade
from gcs.studies.benchmark import Benchmark, RealTimeBenchmark
from gcs.studies.capacity import FEWEST, Capacity, Load
from gcs.studies.cluster import ClusterMap
from gcs.studies.compare import Route, rows
from gcs.studies.compare_cost import RATIO, DesignCost, left_out, ratios
from gcs.studies.peers import Row, SideBySide
from gcs.views.console import ms_text, plain_console, table_of
from scenarios.schema import Scenario

_WHOLE_CORE = 0.95
"""A flight that had at least this share of a core counts as undisturbed."""


def print_comparison(scenario: Scenario, routes: list[Route], grown: list[DesignCost]) -> None:
    console = plain_console()
    columns: dict[str, Callable[[tuple[str, list[str]]], str]] = {"": lambda row: row[0]}
    columns |= {route.method: lambda row, k=k: row[1][k] for k, route in enumerate(routes)}
    title = f"{scenario.name}: designed for its requirement, flown over its links"
    console.print(table_of(rows(routes), columns, title=title))
    for route in routes:
        if route.failed:
            console.print(f"{route.method}: {route.failed}")
    if grown:
        costs: dict[str, Callable[[tuple[DesignCost, float]], str]] = {
            "design of a chain": lambda row: row[0].method,
            "vehicles": lambda row: str(row[0].vehicles),
            "free gains an axis": lambda row: str(row[0].free_gains),
            "time, s": lambda row: f"{row[0].design_s:.3f}",
            RATIO: lambda row: f"{row[1]:.2f}",
        }
        console.print(table_of(zip(grown, ratios(grown), strict=True), costs))
        for line in left_out(grown):
            console.print(line)


def print_capacity(scenario: Scenario, found: list[Capacity]) -> None:
    """Print, for each rate, the largest formation that the links carry and the next one, which they do not."""
    console = plain_console()
    loads = [load for capacity in found for load in (capacity.most, capacity.next) if load is not None]
    title = f"{scenario.name}: what its links carry"
    console.print(table_of(loads, _LOAD_COLUMNS, title=title, is_dim=lambda load: not load.holds))
    for capacity in found:
        if capacity.failed:
            console.print(f"{capacity.rate_hz:g} Hz: {capacity.failed}")
        elif capacity.most is None:
            console.print(f"{capacity.rate_hz:g} Hz: not even {FEWEST} vehicles")


def _ms(seconds: float | None) -> str:
    return ms_text(seconds, ".0f", unit="")


_LOAD_COLUMNS: dict[str, Callable[[Load], str]] = {
    "Hz": lambda load: f"{load.rate_hz:g}",
    "UAVs": lambda load: str(load.vehicles),
    "loop delay, ms\np50  p99": lambda load: f"{_ms(load.loop_delay_p50_s)}  {_ms(load.loop_delay_p99_s)}",
    "margin\nms": lambda load: _ms(load.delay_margin_s),
    "byte/s": lambda load: f"{load.station_bytes_s:.0f}",
    "lost, %\nup  down": lambda load: f"{100.0 * load.lost_up:.1f}  {100.0 * load.lost_down:4.1f}",
    "": lambda load: "holds" if load.holds else load.reason,
}


def print_benchmark(result: Benchmark) -> None:
    how = "compiled" if result.compiled else "interpreted"
    print(f"{result.vehicles} vehicles at {result.control_hz:g} Hz, one core, hot path {how}")
    print(
        f"virtual time    {result.real_time_factor:.3g} times real time "
        f"(best of {result.flights}; median {result.real_time_factor_p50:.3g})"
    )
    if result.core_share < _WHOLE_CORE:
        whole = result.real_time_factor / result.core_share
        print(f"                with {result.core_share:.0%} of a core; {whole:.3g} times with all of it")
    print(
        f"station alone   {1e6 * result.station_s_per_tick:.0f} µs a tick, "
        f"{100 * result.station_share_of_period:.1f} % of its period"
    )
    print(
        f"                {result.tick_over_parse:.2f} times what pymavlink takes "
        "to parse one LOCAL_POSITION_NED of each vehicle"
    )
    if (cost := result.signed) is not None:
        print(
            f"signed          takes {cost.time_ratio:.2f} times as long (median {cost.time_ratio_p50:.2f}), "
            f"the station {cost.station_time_ratio:.2f} times (median {cost.station_time_ratio_p50:.2f})"
        )
    if not result.compiled:
        first = "" if which(os.environ.get("CC", "cc")) else "install a C compiler, then "
        print(f"twice as fast:  {first}python3 make.py compile")


def print_peers(found: SideBySide) -> None:
    console = plain_console()
    columns: dict[str, Callable[[Row], str]] = {
        "": lambda row: f"{row.peer}: {row.work}",
        "unit": lambda row: row.unit,
        "ours": lambda row: f"{row.ours:.3g}",
        "theirs": lambda row: f"{row.theirs:.3g}",
        "ratio": lambda row: "" if row.ratio is None else f"{row.ratio:.3g}",
    }
    console.print(
        table_of(
            found.rows, columns, title=f"the same work by this station and by others; load {found.load_average:.1f}"
        )
    )
    for skipped in found.skipped:
        console.print(f"{skipped.peer}: {skipped.why}")


def print_cluster(found: ClusterMap) -> None:
    print(f"map             {found.trials} trials of {found.seconds:g} s on Dask, {1e3 * found.trial_s:.0f} ms each")
    print(
        f"{found.workers} workers       {found.all_workers_s:.1f} s; one takes {found.one_worker_s:.1f} s: "
        f"efficiency {found.efficiency:.2f}"
    )
    print(
        f"each trial      {1e3 * found.worker_overhead_s:.1f} ms of its worker beside the flight, "
        f"{1e3 * found.central_s:.2f} ms of scheduler and client, "
        f"{found.trial_bytes:.0f} bytes there, {found.outcome_bytes:.0f} back"
    )
    print(f"at most         {found.cores_served:.0f} workers for one scheduler and client, with trials of this length")


def print_real_time(result: RealTimeBenchmark) -> None:
    control = result.control
    p50, p99 = (ms_text(late_s, ".3f") for late_s in (control.lateness_s.p50, control.lateness_s.p99))
    print(f"{result.reason}; load {result.load_average:.1f}, {result.steal_share:.1%} taken by the host")
    print(
        f"set-points sent after they were due: p50 {p50}, p99 {p99}, "
        f"{control.deadline_misses} deadline misses of {control.ticks} ticks"
    )
    print_grade(result)
