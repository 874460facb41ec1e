"""The output of `gcs stress`, `compare`, `bench` and `capacity`, and the checks of `gcs stress` for CI."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.text import Text

from gcs.cli.runs import print_grade
from gcs.runs.files import read_summary
from gcs.runs.junit import Check
from gcs.runs.record import SUMMARY_FILE
from gcs.stress.axes import place_text
from gcs.stress.campaign import Reflown
from gcs.stress.disturbance import DisturbanceOnset, DisturbanceResult
from gcs.stress.report import MOST_ROWS, CampaignResult, Noise, refly_command
from gcs.stress.study import Onset
from gcs.stress.trial import Outcome
from gcs.studies.benchmark import Benchmark, RealTimeBenchmark
from gcs.studies.capacity import FEWEST, Capacity, Load
from gcs.studies.cluster import ClusterMap
from gcs.studies.compare import Route, rows
from gcs.studies.compare_cost import RATIO, DesignCost, left_out, ratios
from gcs.studies.peers import Row, SideBySide
from gcs.views.console import UNKNOWN, ms_text, number_text, plain_console, table_of
from gcs.views.report import flight_lines, response_text
from scenarios.schema import Scenario

_ms = partial(ms_text, form=".2f")
_whole_ms = partial(ms_text, form=".0f", unit="")
_FILE_WIDTH = 120
_ID = 8
"""Number of characters of an id that are shown; `--trial` accepts the beginning of an id."""
_KINDS = {"probe": "probes with small errors", "own": "flights from the scenario's initial states"}
_WHOLE_CORE = 0.95
"""A flight that had at least this share of a core counts as undisturbed."""


def _wide_console() -> Console:
    console = plain_console()
    if not console.is_terminal:
        console.width = _FILE_WIDTH
    return console


def print_result(result: CampaignResult, folder: Path) -> None:
    console = _wide_console()
    margin_s, points = result.delay_margin_s, result.points
    if result.gains.margin_unknown:
        console.print(f"margin   unknown: {result.gains.margin_unknown}")
    else:
        console.print(f"margin   {'no limit' if margin_s is None else f'{_ms(margin_s)} of loop delay'}, sampled")
    console.print(response_text(result.response), end="")
    kinds = ", ".join(f"{count} {_KINDS[kind]}" for kind, count in sorted(result.trials_of_kind.items(), reverse=True))
    console.print(f"trials   {result.trials}: {kinds}")
    for onset in (found for found in (result.onset, result.onset_shorter) if found is not None):
        breaks = "" if onset.frequency_rad_s is None else f"; breaks at {onset.frequency_rad_s:.2f} rad/s"
        found = f"{_ms(onset.loop_delay_s)} ± {1e3 * onset.error_s:.2f} ms of loop delay in flight"
        console.print(f"onset    {found}, {_against(result, onset)}")
        if onset.predicted_continuous_s is not None:
            continuous = "by the continuous model, in which the hold counts as half a period"
            console.print(f"         {_ms(onset.predicted_continuous_s)} {continuous}")
        whose = f"vehicle {onset.vehicle} alone" if onset.vehicle is not None else "every vehicle"
        left_s = onset.link_delay_left_s
        least, most = map(_ms, onset.link_delay_range_s)
        between = "" if least == most else f" ({least} to {most} by the waits of single flights)"
        left = "" if left_s is None else f", {_ms(left_s, form='+.2f')} from the scenario's"
        console.print(
            f"         {_ms(onset.link_delay_s)}{between} of link delay, up + down, for {whose}{left}: vehicle "
            f"{onset.critical} waits {_ms(onset.waiting_s)} for {onset.waits_for}{breaks}"
        )
    found = "none, as predicted" if result.onset_missing_as_predicted else "not found"
    reasons = (
        (found, result.onset_missing),
        ("of shorter delays not found", result.onset_shorter_missing),
        ("contradicted", result.onset_contradicted),
    )
    for found, why in (each for each in reasons if each[1]):
        console.print(f"onset    {found}: {why}")
    if result.curve_error is not None:
        console.print(f"curve    measured and predicted growth differ by at most {result.curve_error:.3%} of the range")
    if result.past_limits:
        console.print(
            f"limits   the links alone push vehicles past [limits] in {result.past_limits} probes, which fly without "
            "limits; where limits bind, errors persist that would otherwise decay",
            markup=False,
        )
    _print_noise(console, result.noise)
    if points := [point for point in points if point.kind == "probe"] or points:
        console.print(table_of(points[:MOST_ROWS], _columns(list(points[0].coordinates)), dense=True))
    aborted = [own for own in result.points if own.verdict == "aborted"]
    if 0 < len(aborted) < len(result.points):
        first = f"the first, {aborted[0].id[:_ID]}: {aborted[0].reason}"
        console.print(f"aborted  {len(aborted)} of {len(result.points)} trials, {first}", markup=False)
    for failed in result.trials_failed:
        fault = (failed.error or "").strip().splitlines()[-1]
        console.print(f"failed   {failed.id}, seed {failed.seed}, {place_text(failed.coordinates)}: {fault}")
    files = sorted(file.name for file in folder.iterdir() if file.is_file())
    console.print(f"files    {folder}: {', '.join(files)}")
    if result.worst:
        console.print(f"again    {refly_command(folder, result)}")
    if result.failure:
        console.print(Text.assemble(("failed", "bold red"), f"   {result.failure}"))


def _against(result: CampaignResult, onset: Onset) -> str:
    """How far an onset is from its predicted value, in words, or that there is none."""
    if onset.difference is None:
        return "with no margin to compare it with"
    limit = "sampled margin" if result.gains.prediction is None else "end of the mismatch window"
    limit = f"{limit} of this loop"
    if onset.vehicle is not None and len(onset.loop) > 1:
        limit = f"model of the loop that vehicles {' '.join(map(str, onset.loop))} share over links that differ"
    return f"{onset.difference:+.3%} from the {limit}: {_ms(onset.predicted_s)}"


def _print_noise(console: Console, noise: Noise | None) -> None:
    if noise is None or not (noise.lateness_s_p50 and noise.lateness_s_p99 and noise.steal_share and noise.busy_share):
        return
    latest = noise.lateness_s_p99
    console.print(
        f"noise    set-points {_ms(noise.lateness_s_p50.median)} late at the median, {_ms(latest.median)} at the 99th "
        f"percentile (at worst {_ms(latest.max)}); the host took {noise.steal_share.median:.1%} of the processors, "
        f"all processes together used {noise.busy_share.median:.0%}"
    )


def _columns(axes: list[str]) -> dict[str, Callable[[Outcome], str]]:
    return {
        "trial": lambda point: point.id[:_ID],
        **{name: lambda point, name=name: f"{point.coordinates[name]:g}" for name in axes},
        "vehicle": lambda point: UNKNOWN if point.critical is None else str(point.critical),
        "loop, ms": lambda point: _ms(point.loop_delay_s, unit=""),
        "growth, 1/s": lambda point: number_text(point.growth_1_s),
        "±": lambda point: number_text(point.growth_error_1_s, "0.1g"),
        "model": lambda point: number_text(point.predicted_growth_1_s),
        "verdict": lambda point: point.verdict or UNKNOWN,
    }


def print_reflown(reflown: Reflown) -> None:
    console, outcome = plain_console(), reflown.outcome
    console.print(f"trial    {outcome.id}, {outcome.kind}, seed {outcome.seed}, {place_text(outcome.coordinates)}")
    console.print(f"verdict  {outcome.verdict}: {_reason(reflown)}")
    if outcome.growth_1_s is not None:
        of = f" of vehicle {outcome.probed}" if outcome.probed is not None else ""
        console.print(
            f"growth   {number_text(outcome.growth_1_s)} ± {number_text(outcome.growth_error_1_s, '0.1g')} 1/s{of}, "
            f"predicted {number_text(outcome.predicted_growth_1_s)} at {_ms(outcome.loop_delay_s)}"
        )
    if outcome.real_time:
        console.print("again    in real time, where no two flights are the same")
    elif reflown.differs:
        console.print(f"again    differs from the first flight in: {', '.join(reflown.differs)}")
    else:
        console.print(f"again    identical to the last bit, tick log {outcome.ticks_sha256}")
    for run in reflown.runs:
        console.print(f"look     gcs view {run}")
    if outcome.error is not None:
        console.print(outcome.error)


def _reason(reflown: Reflown) -> str | None:
    """The reason for a trial's verdict as `gcs fly` words it, from the summary of the flight that was judged."""
    outcome, flown = reflown.outcome, (read_summary(run / SUMMARY_FILE) for run in reflown.runs)
    judged = (outcome.reason, outcome.spacing_error_final_m)
    found = next((own for own in flown if (own.reason, own.spacing_error_final_m) == judged), None)
    if found is None:
        return outcome.reason
    return flight_lines(found.model_copy(update={"verdict": outcome.verdict}))["verdict"]


def checks_of(result: CampaignResult) -> list[Check]:
    """One check that onset and margin agree, and a failed one for every trial that could not be flown."""
    skipped = "" if result.failure or result.assert_onset is not None else "--assert-onset was not given"
    name = "the onset is where the margin says" if result.assert_onset is not None or skipped else "the sweep was flown"
    agrees = Check(name, failure=result.failure or "", skipped=skipped)
    return [agrees, *(Check(f"trial {outcome.id}", error=outcome.error or "") for outcome in result.trials_failed)]


def print_disturbances(result: DisturbanceResult) -> None:
    console = _wide_console()

    def errors_of(o: DisturbanceOnset) -> str:
        return "one follower" if len(o.vehicles) == 2 else "all vehicles"

    columns: dict[str, Callable[[DisturbanceOnset], str]] = {
        "errors of": errors_of,
        "disturbance": lambda o: o.kind,
        "radius, 1/s": lambda o: number_text(o.radius_1_s, ".5f"),
        "at, rad/s": lambda o: f"{o.frequency_rad_s:.2f}",
        "onset flown, 1/s": lambda o: number_text(o.onset_1_s, ".5f"),
        "±": lambda o: number_text(o.error_1_s, "0.1g"),
        "apart": lambda o: UNKNOWN if o.difference is None else f"{o.difference:+.3%}",
        "flights": lambda o: str(o.flights),
    }
    title = f"disturbances that break {result.scenario} at {ms_text(result.loop_delay_s)} of loop delay"
    console.print(table_of(result.onsets, columns, title=title))
    console.print("dynamic: any stable filter, alpha is its radius; constant: a matrix, the same north and east")
    for onset in (onset for onset in result.onsets if onset.missing):
        found = "none, by prediction alone" if onset.radius_1_s is None else "not found"
        console.print(f"onset    {errors_of(onset)}, {onset.kind}, {found}: {onset.missing}")
    if result.failure:
        console.print(f"failed   {result.failure}")


def print_comparison(scenario: Scenario, routes: list[Route], grown: list[DesignCost]) -> None:
    console = plain_console()
    columns: dict[str, Callable[[tuple[str, list[str]]], str]] = {"": lambda row: row[0]}
    columns |= {route.method: lambda row, k=k: row[1][k] for k, route in enumerate(routes)}
    title = f"{scenario.name}: designed for its requirement, flown over its links"
    console.print(table_of(rows(scenario, routes), columns, title=title))
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
    """Print for each rate the largest formation that the links carry and the smallest tried that they do not."""
    console = plain_console()
    loads = [load for capacity in found for load in (capacity.most, capacity.next) if load is not None]
    title = f"{scenario.name}: what its links carry"
    console.print(table_of(loads, _LOAD_COLUMNS, title=title, is_dim=lambda load: not load.holds))
    for capacity in found:
        if capacity.failed:
            console.print(f"{capacity.rate_hz:g} Hz: {capacity.failed}")
        elif capacity.most is None:
            console.print(f"{capacity.rate_hz:g} Hz: not even {FEWEST} vehicles")


_LOAD_COLUMNS: dict[str, Callable[[Load], str]] = {
    "Hz": lambda load: f"{load.rate_hz:g}",
    "UAVs": lambda load: str(load.vehicles),
    "loop delay, ms\np50  p99": lambda load: f"{_whole_ms(load.loop_delay_p50_s)}  {_whole_ms(load.loop_delay_p99_s)}",
    "margin\nms": lambda load: _whole_ms(load.delay_margin_s),
    "byte/s": lambda load: f"{load.station_bytes_s:.0f}",
    "lost, %\nup  down": lambda load: f"{100.0 * load.lost_up:.1f}  {100.0 * load.lost_down:4.1f}",
    "": lambda load: "holds" if load.holds else load.reason,
}


def print_benchmark(result: Benchmark) -> None:
    print(f"{result.vehicles} vehicles at {result.control_hz:g} Hz, one core")
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


def print_peers(found: SideBySide) -> None:
    console = plain_console()
    columns: dict[str, Callable[[Row], str]] = {
        "": lambda row: f"{row.peer}: {row.work}",
        "unit": lambda row: row.unit,
        "ours": lambda row: f"{row.ours:.3g}",
        "theirs": lambda row: f"{row.theirs:.3g}",
        "ratio": lambda row: "" if row.ratio is None else f"{row.ratio:.3g}",
    }
    title = f"the same work by this station and by others; load {found.load_average:.1f}"
    console.print(table_of(found.rows, columns, title=title))
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
