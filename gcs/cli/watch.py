"""`gcs monitor` and `gcs replay`: latencies of live links and telemetry logs, without commanding vehicles."""

import sys
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gcs.cli import FAILED, INTERRUPTED, options
from gcs.errors import InputError
from gcs.output import outlive_readers
from scenarios.networks import networks_of

if TYPE_CHECKING:
    from gcs.plan.design import Design
    from gcs.watch.rebuild_report import RebuildReport
    from gcs.watch.saved_links import LinkRecorder
    from scenarios.schema import Scenario

_TIMESYNC_HZ = _POSITION_HZ = 10.0
SavedLinks = Annotated[
    Path | None,
    typer.Option("--save-links", metavar="FILE.toml", help="write the links as a profile for scenarios"),
]
ComparedMargin = Annotated[
    float | None,
    typer.Option("--margin", metavar="SECONDS", help="compare with this delay margin", min=0.001, max=30.0),
]


def monitor(
    scenario_file: Annotated[
        Path | None, typer.Argument(metavar="[SCENARIO]", help="the expected vehicles, and the margin of their gains")
    ] = None,
    listen: Annotated[
        str,
        typer.Option("--listen", "--connect", metavar="HOST:PORT", help="address to which vehicles or a mirror send"),
    ] = "127.0.0.1:14550",
    margin: ComparedMargin = None,
    design: Annotated[
        Path | None, typer.Option(metavar="DESIGN.json", help="compare with the margin of a run's design.json")
    ] = None,
    key: options.KeyFile = None,
    request: Annotated[
        bool, typer.Option("--request", help="ask vehicles that send no position to do so, with SET_MESSAGE_INTERVAL")
    ] = False,
    silent: Annotated[bool, typer.Option("--silent", help="send nothing; delays may then be lower bounds")] = False,
    seconds: Annotated[float, typer.Option("--for", metavar="SECONDS", help="stop after this time", min=0.1)] = inf,
    save_links: SavedLinks = None,
    as_json: options.AsJson = False,
) -> None:
    """Compare latencies with a margin, without commanding vehicles.

    The monitor listens on the ports of all networks of SCENARIO; without one, on a single port.

    It sends only TIMESYNC requests (10 a second to each address), which vehicles answer with their clock. It sends no
    heartbeat. With --silent it sends nothing and uses the exchanges of a station on the same stream. Without any
    exchange, delays are measured against the fastest frames, which makes them lower bounds.

    The loop delay is the one that gcs fly would have, over all phases of its control tick. Without SCENARIO the rates
    are unknown, and the loop delay also includes the time for which a position is repeated.

    An ArduPilot sends no position until asked. --request asks each vehicle for LOCAL_POSITION_NED, at the telemetry
    rate of the scenario or 10 a second; a vehicle that obeys another station may refuse.

    Exit code 1 if an expected vehicle was never heard, if none was heard, if a loop delay (p99) exceeded the margin, or
    if a loop delay that has a margin was unknown or a lower bound for most of the last quarter of the time.
    """
    if request and silent:
        raise InputError("read --request and --silent, wanted one of them")
    given, margin_of = _given(margin, design)
    if save_links is not None:
        options.out_file("--save-links", save_links)
    if sys.stdout.isatty():  # a closed terminal sends a signal; a reader that closes its pipe must end the command
        outlive_readers()
    scenario = None if scenario_file is None else _formation(scenario_file, given)
    networks = [0] if scenario is None else networks_of(vehicle.system_id for vehicle in scenario.vehicles)
    with options.listening("--listen", listen, options.opened_guard(key, role="monitor"), networks) as link:
        if scenario is not None and given is None:
            from gcs.plan.planner import flight_plan, over_own_links

            given, margin_of = over_own_links(*flight_plan(scenario))[0], f"of {scenario.name}'s gains"
        # Imported after the socket is open: datagrams that arrive during the imports keep their receive timestamps.
        from gcs.interrupts import stop_signals
        from gcs.watch.links import Watch
        from gcs.watch.live import watch_links
        from gcs.watch.saved_links import LinkRecorder

        options.explain_compiling()
        asked_hz = scenario.rates.timesync_hz if scenario else _TIMESYNC_HZ
        position_hz = scenario.rates.telemetry_hz if scenario else _POSITION_HZ
        watch = Watch((vehicle.system_id for vehicle in scenario.vehicles), scenario.rates) if scenario else Watch()
        recorder = LinkRecorder() if save_links is not None else None
        with stop_signals() as stop_reason:
            report = watch_links(
                link,
                watch,
                stop_reason,
                design=given,
                margin_of=margin_of,
                timesync_hz=0.0 if silent else asked_hz,
                position_hz=position_hz if request else 0.0,
                seconds=seconds,
                shown=not as_json,
                recorder=recorder,
            )
            interrupted = bool(stop_reason())
    if as_json:
        options.print_json(report)
    else:
        from gcs.views.console import plain_console
        from gcs.watch.table import render

        console = plain_console(soft_wrap=False)
        console.print(render(report, width=console.width))
    if save_links is not None and recorder is not None:
        _save(save_links, recorder, f"gcs monitor at {listen}", shown=not as_json)
    raise typer.Exit(INTERRUPTED if interrupted else FAILED if report.failed else 0)


def replay(
    run: Annotated[Path, typer.Argument(metavar="RUN|FILE.tlog", help="run folder, or a telemetry log from any tool")],
    scenario_file: Annotated[
        Path | None, typer.Argument(metavar="[SCENARIO]", help="the formation, if it is not in the run")
    ] = None,
    margin: ComparedMargin = None,
    design: Annotated[
        Path | None, typer.Option(metavar="DESIGN.json", help="compare with the margins of this design")
    ] = None,
    save_links: SavedLinks = None,
    as_json: options.AsJson = False,
) -> None:
    """Rebuild latencies, errors and margins from a telemetry log.

    Round trips come from the TIMESYNC exchanges in the log. Without them, delays are measured against the fastest
    frames, which makes them lower bounds. Spacing errors need the formation, from the run's folder or from SCENARIO.
    Formations of several networks are refused, because a log does not name its network. Damaged parts of the log are
    skipped and counted.
    """
    given, _ = _given(margin, design)
    from gcs.watch.rebuild_report import find_log, rebuild_report
    from gcs.watch.tlog import read_tlog

    if save_links is not None:
        options.out_file("--save-links", save_links)
    found = find_log(run)
    log = read_tlog(found.log_file)
    if scenario_file is not None:
        scenario = _formation(scenario_file, given)
        if (networks := networks_of(vehicle.system_id for vehicle in scenario.vehicles)) != [0]:
            read = f"vehicles in the networks {' '.join(map(str, networks))}"
            raise InputError(f"{scenario_file}: read {read}, wanted network 0 alone: a log does not name its network")
        found = replace(found, scenario=scenario, design=None, recorded=None)
    if given is not None:
        found = replace(found, design=given)
    elif found.design is None and found.scenario is not None:
        from gcs.plan.planner import flight_plan, over_own_links

        found = replace(found, design=over_own_links(*flight_plan(found.scenario))[0])
    options.answer(rebuild_report(log, found), _print_rebuilt, as_json=as_json)
    if save_links is not None:
        from gcs.watch.saved_links import recorded

        _save(save_links, recorded(log.frames), f"gcs replay of {found.log_file.name}", shown=not as_json)


def _formation(scenario_file: Path, given: "Design | None") -> "Scenario":
    """The scenario. If the margin is given, its code is not run, because only its formation is needed."""
    code_allowed = "a margin (--margin or --design), with which no code is run" if given is None else True
    return options.load_scenario(scenario_file, allow_code=code_allowed)


def _save(file: Path, recorder: "LinkRecorder", source: str, *, shown: bool) -> None:
    from gcs.watch.saved_links import describe, save

    profile = recorder.profile(source)
    save(profile, file)
    if shown:
        typer.echo("\n".join([*describe(profile), f"links    {file}"]))


def _print_rebuilt(report: "RebuildReport") -> None:
    from gcs.views.console import plain_console
    from gcs.views.report import delay_text, print_flight
    from gcs.watch.table import links_table, unjudged

    console, log = plain_console(), report.log
    left_out = "".join(f"; {count} {reason}" for reason, count in log.left_out.items())
    console.print(f"log      {log.file}: {log.frames} frames in {log.duration_s:.1f} s{left_out}")
    if not report.links:
        console.print("no vehicle in this log")
    elif report.flight is not None:
        print_flight(report.flight, console)
    else:
        console.print(links_table(report.links, console.width), *unjudged(report.links))
    if report.recorded is not None:
        console.print(f"recorded {report.recorded.verdict}: {delay_text(report.recorded)}")


def _given(margin: float | None, design: Path | None) -> "tuple[Design | None, str]":
    """The design of --design, or one with only the margin of --margin, and the source of the margin in words."""
    if margin is not None and design is not None:
        raise InputError("read --margin and --design, wanted one of them")
    if margin is None and design is None:
        return None, ""
    from gcs.plan.design import Design
    from gcs.runs.files import read_design

    return (Design(delay_margin_s=margin), "given") if design is None else (read_design(design), f"of {design}")
