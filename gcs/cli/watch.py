"""The options of `gcs monitor` and `gcs replay`.

The work is in `links` (what frames say), `live` (the socket), `tlog` and `replay` (logs), all of this package.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from gcs.cli.options import KeyFile, listening, opened_guard
from gcs.errors import InputError
from gcs.output import outlive_readers

_FAILED, _INTERRUPTED = 1, 130
_TIMESYNC_HZ = 10.0


def monitor(
    scenario_file: Annotated[
        Path | None, typer.Argument(metavar="[SCENARIO]", help="the vehicles expected, and the margin of their gains")
    ] = None,
    listen: Annotated[
        str, typer.Option("--listen", "--connect", metavar="HOST:PORT", help="where vehicles or a mirror send to")
    ] = "127.0.0.1:14550",
    margin: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="compare with this delay margin", min=0.0)
    ] = None,
    design: Annotated[
        Path | None, typer.Option(metavar="DESIGN.json", help="compare with the margin of a run's design.json")
    ] = None,
    key: KeyFile = None,
    silent: Annotated[bool, typer.Option("--silent", help="send nothing: delays are lower bounds then")] = False,
    seconds: Annotated[
        float, typer.Option("--for", metavar="SECONDS", help="end by itself after this time", min=0.1)
    ] = float("inf"),
    as_json: Annotated[bool, typer.Option("--json", help="print JSON and nothing else")] = False,
) -> None:
    """Watch the latencies of vehicles against a margin, without commanding anything.

    All that is sent are TIMESYNC requests (10 a second to each address), which vehicles answer with their clock. No
    heartbeat is sent. With --silent nothing is sent: exchanges of a station on the same stream are used if there are
    any; otherwise delays are told against the fastest frames, and are lower bounds.

    Exit code 1 if an expected vehicle, or any at all, was not heard, or if the loop delay (p99) was past the margin.
    """
    if margin is not None and design is not None:
        raise InputError("read --margin and --design, wanted one of them")
    if sys.stdout.isatty():  # a closed terminal ends it by a signal; a reader that has enough, by what is printed
        outlive_readers()
    guard = opened_guard(key, role="monitor")
    with listening("--listen", listen) as link:
        scenario, margin_s, margin_of = _compared_with(scenario_file, margin, design)
        # After the socket: what comes while these load keeps its receive stamp.
        from gcs.interrupts import stop_signals
        from gcs.watch.links import Watch
        from gcs.watch.live import MonitorOptions, monitor_links
        from gcs.watch.table import print_report

        asked_hz = scenario.rates.timesync_hz if scenario else _TIMESYNC_HZ
        options = MonitorOptions(
            margin_s=margin_s,
            margin_of=margin_of,
            timesync_hz=0.0 if silent else asked_hz,
            seconds=seconds,
            shown=not as_json,
        )
        watch = Watch(vehicle.system_id for vehicle in scenario.vehicles) if scenario else Watch()
        with stop_signals() as stop_reason:
            report = monitor_links(link, watch, options, stop_reason, guard)
            interrupted = bool(stop_reason())
    if as_json:
        typer.echo(json.dumps(report, indent=2, allow_nan=False))
    else:
        print_report(report)
    raise typer.Exit(_INTERRUPTED if interrupted else _exit_code(report))


def replay(
    run: Annotated[
        Path, typer.Argument(metavar="RUN|FILE.tlog", help="a run's folder, or a telemetry log of any tool")
    ],
    scenario_file: Annotated[
        Path | None, typer.Argument(metavar="[SCENARIO]", help="the formation flown, where it is not in the run")
    ] = None,
    margin: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="compare with this delay margin", min=0.0)
    ] = None,
    design: Annotated[
        Path | None, typer.Option(metavar="DESIGN.json", help="compare with the margins of this design")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print JSON and nothing else")] = False,
) -> None:
    """Rebuild latencies, errors and margins from a telemetry log alone.

    Round trips come from the TIMESYNC exchanges in the log; in one without, delays are lower bounds, told against the
    fastest frames. Errors need the formation, of the run's folder or of SCENARIO. What is damaged is left out and
    counted.
    """
    if margin is not None and design is not None:
        raise InputError("read --margin and --design, wanted one of them")
    from gcs.plan.design import Design
    from gcs.runs.files import read_design
    from gcs.watch import rebuild_report as replay_report
    from gcs.watch.tlog import TlogError, read_tlog

    there = replay_report.found(run)
    given = None if design is None else read_design(design)
    try:
        log = read_tlog(there.log_file)
    except TlogError as error:
        raise InputError(str(error)) from None
    if scenario_file is not None:
        from scenarios.files import load

        there = replace(there, scenario=load(scenario_file), design=None, recorded=None)
    if margin is not None:
        there = replace(there, design=Design(delay_margin_s=margin))
    elif given is not None:
        there = replace(there, design=given)
    elif there.design is None and there.scenario is not None:
        from gcs.plan.planner import flight_plan

        there = replace(there, design=flight_plan(there.scenario)[0])
    result = replay_report.replay(log, there)
    if as_json:
        typer.echo(json.dumps(result, indent=2, allow_nan=False))
    else:
        replay_report.print_replay(result)


def _exit_code(report: dict[str, Any]) -> int:
    bad = {"not heard", "past the margin"} & {vehicle["status"] for vehicle in report["vehicles"]}
    return _FAILED if bad or not report["vehicles"] else 0


def _compared_with(scenario_file: Path | None, margin: float | None, design: Path | None) -> tuple[Any, Any, str]:
    """The scenario, the margin in s (None: none is known) and in words where it is from."""
    scenario = None
    if scenario_file is not None:
        from scenarios.files import load

        scenario = load(scenario_file)
    if margin is not None:
        return scenario, margin, "given"
    if design is not None:
        from gcs.runs.files import read_design

        return scenario, read_design(design).delay_margin_s, f"of {design}"
    if scenario is not None:
        from gcs.plan.planner import flight_plan

        return scenario, flight_plan(scenario)[0].delay_margin_s, f"of {scenario.name}'s gains"
    return None, None, ""
