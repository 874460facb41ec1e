"""The `gcs` command. Slow imports (cvxpy, rerun) are made by the commands that need them, so that --help is quick."""

import contextlib
import json
import os
import sys
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer

from gcs.cli.loop_option import LoopOption, load_with_loop
from gcs.cli.options import (
    KeyFile,
    address,
    listening,
    mirroring,
    opened_guard,
    out_file,
    out_folder,
    refuse,
    warn_if_open,
    within,
)
from gcs.cli.stress import stress
from gcs.cli.watch import monitor, replay
from gcs.errors import InputError
from gcs.interrupts import EXIT_INTERRUPTED
from gcs.output import DISK_FULL, outlive_readers

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Fly UAV formations over MAVLink and see how much link delay they can take.",
)

ScenarioFile = Annotated[Path, typer.Argument(metavar="SCENARIO", help="scenario file, as scenarios/triangle5.toml")]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON and nothing else")]
AllowUnstable = Annotated[
    bool, typer.Option("--allow-unstable", help="accept gains whose loop is unstable without any delay")
]


class Method(Enum):
    """How gains are found, as `control.method` of a scenario."""

    INCLUSION = "inclusion"
    GRAPH_DK = "graph-dk"
    GRAPH_LQR = "graph-lqr"


LISTEN = "127.0.0.1:14550"
EXIT_FAILED = 1
EXIT_BAD_INPUT = 2


@app.callback(invoke_without_command=True)
def help_without_command(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command()
def fly(
    scenario_file: ScenarioFile,
    loop: LoopOption = None,
    link_delay: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="emulate this constant delay each way, on every link")
    ] = None,
    connect: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="listen here, and fly only vehicles that are already there")
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help=f"listen here for the vehicles that this command starts; {LISTEN}"),
    ] = None,
    mirror: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="forward all frames to another ground station, read-only")
    ] = None,
    mirror_commands: Annotated[
        bool, typer.Option("--mirror-commands", help="let what that station sends through to the vehicles")
    ] = False,
    key: KeyFile = None,
    allow_unstable: AllowUnstable = False,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="run folder; default runs/<scenario>-<time>")] = None,
    as_json: AsJson = False,
) -> None:
    """Design the control, start the vehicles, fly, show, record.

    Exit code 1 if the flight is not stable, or not all of it could be logged.
    """
    from gcs.drive import preflight
    from gcs.drive.fly import FlyOptions, new_folder
    from gcs.drive.fly import fly as fly_now
    from gcs.drive.takeover import CONNECTED, TAKEN_OVER, Presence
    from gcs.plan.planner import flight_plan
    from gcs.views.report import print_design, print_summary

    outlive_readers()
    scenario = load_with_loop(scenario_file, loop)
    if link_delay is not None:
        within("--link-delay", link_delay, 0, 60, "seconds")
        scenario = scenario.with_link_delay(up_s=link_delay, down_s=link_delay)
    if connect is None:
        refuse(scenario_file, preflight.bad_start(scenario), preflight.endless_link(scenario))
    guard = opened_guard(key, role="station")
    if mirror_commands and mirror is None:
        raise InputError("read --mirror-commands without --mirror, wanted both")
    if connect is not None and listen is not None:
        raise InputError("read --connect and --listen, wanted one of them")
    with contextlib.ExitStack() as opened:
        at = ("--connect", connect) if connect is not None else ("--listen", LISTEN if listen is None else listen)
        link = opened.enter_context(listening(*at))
        warn_if_open(link, signed=key is not None)
        to = None if mirror is None else opened.enter_context(mirroring(mirror, link, guard, commands=mirror_commands))
        design, plan = flight_plan(scenario)
        if (unstable := preflight.unstable_loop(plan)) is not None:
            _refuse_or_warn(scenario_file, unstable, allow=allow_unstable)
            plan = preflight.without_actions(plan)
        there = Presence(link, plan.scenario, guard)
        taken_over = there.taken_over() if connect is None else []
        if not as_json:
            print_design(design)
        folder = out_folder(out) if out is not None else new_folder(scenario.name)
        options = FlyOptions(
            folder=folder,
            show_table=not as_json,
            fleet=CONNECTED if connect is not None else TAKEN_OVER if taken_over else "",
            outlive_station=address(*at)[1] != 0,  # nobody listens again at a port that the system chose
            key_file=key,
        )
        summary = fly_now(plan, design, link, options, guard, to)
        if taken_over:
            there.shut_down()
    if as_json:
        typer.echo(json.dumps(summary, indent=2))
    else:
        print_summary(summary, folder)
    raise typer.Exit(_exit_code(summary))


@app.command()
def design(
    scenario_file: ScenarioFile,
    method: Annotated[
        Method | None, typer.Option(help="in place of the scenario's: inclusion principle, or a graph method")
    ] = None,
    loop: LoopOption = None,
    allow_unstable: AllowUnstable = False,
    as_json: AsJson = False,
) -> None:
    """Design the gains of a scenario: gains, robustness, delay margins, and the trade-off they sit on."""
    from gcs.drive.preflight import unstable_loop
    from gcs.plan.planner import flight_plan
    from gcs.views.report import print_design

    scenario = load_with_loop(scenario_file, loop)
    if method is not None:
        control = scenario.control.model_copy(update={"method": method.value, "gains": None, "blocks": ()})
        scenario = scenario.model_copy(update={"control": control})
    result, plan = flight_plan(scenario)
    if (unstable := unstable_loop(plan)) is not None:
        _refuse_or_warn(scenario_file, unstable, allow=allow_unstable)
    if as_json:
        typer.echo(json.dumps(result.to_dict(), indent=2))
    else:
        print_design(result)


@app.command()
def compare(
    scenario_file: ScenarioFile,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="default runs/<scenario>-compare-<time>")] = None,
    sizes: Annotated[bool, typer.Option(help="also time designs of growing chains")] = True,
    as_json: AsJson = False,
) -> None:
    """Design and fly a scenario by the inclusion principle and on the graph, side by side: figures, a page, JSON.

    Exit code 1 if no route could be designed.
    """
    from dataclasses import asdict

    from gcs.drive.fly import new_folder
    from gcs.studies import compare as comparing
    from gcs.studies.compare_cost import design_costs

    outlive_readers()
    scenario = _scenario(scenario_file)
    folder = out_folder(out) if out is not None else new_folder(f"{scenario.name}-compare")
    routes, flights = comparing.compare(scenario)
    grown = design_costs() if sizes else []
    comparing.write_comparison(folder, scenario, routes, flights, grown)
    if as_json:
        typer.echo(json.dumps({"routes": [asdict(route) for route in routes], "files": str(folder)}, indent=2))
    else:
        comparing.print_comparison(scenario, routes, grown)
        typer.echo(f"files    {folder}: {comparing.REPORT_FILE}, {comparing.RESULT_FILE}, PNG")
    raise typer.Exit(0 if flights else EXIT_FAILED)


@app.command()
def margin(
    model_file: Annotated[
        Path,
        typer.Argument(
            metavar="MODEL.json|SCENARIO.toml",
            help="matrices and delays of any linear loop, or of one sampled and held (see docs/models), or a scenario",
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """How much delay any linear loop takes, or that of a scenario: stability windows, margin, crossings."""
    from gcs.margin import margin_of_file, margin_of_scenario, print_margin

    result = margin_of_scenario(model_file) if model_file.suffix == ".toml" else margin_of_file(model_file)
    if as_json:
        typer.echo(json.dumps(result, indent=2))
    else:
        print_margin(result)


@app.command()
def thesis(
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="default runs/thesis-<time>")] = None,
    as_json: AsJson = False,
) -> None:
    """Reproduce the figures and numbers of the source, published and computed side by side."""
    from dataclasses import asdict

    from gcs.drive.fly import new_folder
    from gcs.studies import thesis as source

    folder = out_folder(out) if out is not None else new_folder("thesis")
    found = source.claims()
    page = source.write_page(folder, found)
    if as_json:
        typer.echo(json.dumps([asdict(claim) for claim in found], indent=2, ensure_ascii=False))
        return
    for claim in found:
        typer.echo(f"{claim.place}  {claim.subject}: {claim.verdict}")
        typer.echo(f"    published {claim.published}; computed {claim.computed}; {claim.second}")
    typer.echo(f"files    {page} and its figures")


@app.command()
def bench(
    scenario_file: ScenarioFile,
    vehicles: Annotated[
        int, typer.Option(metavar="N", min=0, max=250, help="as many vehicles instead, in columns behind a leader")
    ] = 0,
    seconds: Annotated[float, typer.Option(metavar="S", min=0.1, max=86400, help="flight time of each flight")] = 8.0,
    repeat: Annotated[int, typer.Option(metavar="N", min=1, help="flights; the fastest counts")] = 10,
    real_time: Annotated[
        bool, typer.Option("--real-time", help="one flight over UDP instead: is it punctual, are its latencies true?")
    ] = False,
    signed: Annotated[bool, typer.Option("--signed", help="also measure what signing costs")] = False,
    as_json: AsJson = False,
) -> None:
    """How much faster than real time flights are computed, and what the station takes of its control period."""
    from gcs.studies import benchmark

    scenario = _scenario(scenario_file)
    if vehicles:
        scenario = benchmark.with_vehicles(scenario, vehicles)
    if real_time:
        result = benchmark.benchmark_real_time(scenario, seconds=seconds)
    else:
        result = benchmark.benchmark(scenario, seconds=seconds, repeat=repeat, signed=signed)
    if as_json:
        typer.echo(json.dumps(result, indent=2))
    elif real_time:
        benchmark.print_real_time(result)
    else:
        benchmark.print_benchmark(result)


@app.command()
def capacity(
    scenario_file: ScenarioFile,
    rates: Annotated[str, typer.Option(metavar="HZ,HZ,...", help="telemetry and control rates")] = "2,5,10,20",
    most: Annotated[int, typer.Option(metavar="N", min=2, max=250, help="largest formation tried")] = 100,
    seeds: Annotated[int, typer.Option(metavar="N", min=1, help="flights of each formation; it is carried in all")] = 3,
    as_json: AsJson = False,
) -> None:
    """How many vehicles, at which rate, the scenario's links carry before the delay margin is gone."""
    from gcs.studies import capacity as carrying

    scenario = _scenario(scenario_file)
    found = carrying.capacity(scenario, rates_hz=_rates(rates), most=most, seeds=seeds)
    if as_json:
        typer.echo(json.dumps(carrying.to_dict(found), indent=2))
    else:
        carrying.print_capacity(scenario, found)


def _rates(text: str) -> list[float]:
    """Rates in Hz from a list with commas."""
    try:
        rates = [float(part) for part in text.split(",")]
    except ValueError:
        rates = []
    if not rates or not all(0.1 <= rate <= 1000.0 for rate in rates):
        raise InputError(f"--rates: {text}, wanted numbers from 0.1 to 1000 with commas, for example 2,5,10")
    return rates


@app.command()
def grade(run: Annotated[Path, typer.Argument(metavar="RUN", help="run folder")], as_json: AsJson = False) -> None:
    """How true a flight's latencies were, and how punctual its emulated links: errors against the truth log."""
    from gcs.runs.grade import grade as graded
    from gcs.runs.grade import print_grade

    result = graded(run)
    if as_json:
        typer.echo(json.dumps(result, indent=2))
    else:
        print_grade(result)


@app.command()
def view(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="run folder, or a .rrd file")],
    picture: Annotated[Path | None, typer.Option(metavar="FILE.png", help="write a picture; open no window")] = None,
    at: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="scenario time of the picture; 10, or the end if sooner")
    ] = None,
) -> None:
    """Open a recording in the Rerun viewer, or write a picture of it, which needs no screen.

    Exit code 1 if a view of the picture reports a fault.
    """
    from gcs.views.viewer import ViewerError, find_recording, picture_time_s, screenshot
    from gcs.views.viewer import view as open_viewer

    if at is not None:
        within("--at", at, 0.0, 1e6, "seconds")
    if picture is not None:
        out_file("--picture", picture)
        if picture.suffix.lower() != ".png":
            raise InputError(f"--picture: read {picture}, wanted a name that ends in .png, as what is written is PNG")
    try:
        recording = find_recording(run)
        if picture is None:
            raise typer.Exit(open_viewer(recording))
        time_s = picture_time_s(recording, at)
        complaints = screenshot(recording, picture, time_s=time_s)
        typer.echo(f"picture  {picture}: {recording} at {time_s:g} s")
    except ViewerError as error:
        raise InputError(str(error)) from None
    for complaint in complaints:
        typer.echo(complaint, err=True)
    raise typer.Exit(EXIT_FAILED if complaints else 0)


@app.command()
def recover(run: Annotated[Path, typer.Argument(metavar="RUN", help="folder of a run that was killed")]) -> None:
    """Finish the files of a run whose processes were killed: ticks.parquet, summary.json, flight.rrd."""
    from gcs.runs.summary import finish
    from gcs.views.observer import record_run
    from gcs.views.report import print_summary

    finish(run)
    record_run(run)
    summary = finish(run)  # again: it lists the files
    print_summary(summary, run)


@app.command()
def key(file: Annotated[Path, typer.Argument(metavar="FILE", help="a new file")]) -> None:
    """Make a key for signing (--key) that only you can read."""
    from scenarios.signing.keys import make_key

    make_key(file)


app.command()(stress)
app.command()(monitor)
app.command()(replay)


def main() -> None:
    """Entry point: bad input is one line and exit code 2."""
    from gains.core.errors import GainsError
    from scenarios.errors import ScenarioError
    from scenarios.signing.keys import KeyFileError

    try:
        code = app(standalone_mode=False)
    except (InputError, ScenarioError, GainsError, KeyFileError) as error:
        code = _fail(str(error))
    except typer.TyperException as error:  # an unknown option, a missing argument
        code = _fail(error.format_message() if isinstance(error, typer.BadParameter) else str(error))
    except (KeyboardInterrupt, typer.Abort):
        print("interrupted", file=sys.stderr)
        code = EXIT_INTERRUPTED
    except BrokenPipeError:  # whoever read our output, as `head`, has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = EXIT_FAILED
    except OSError as error:
        if error.filename is None and error.errno not in DISK_FULL:
            raise  # no file of the user's
        code = _fail(f"{error.filename or 'write'}: {error.strerror}, wanted a file or folder that can be used")
    sys.exit(code if isinstance(code, int) else 0)


def _fail(line: str) -> int:
    print(" ".join(line.split()), file=sys.stderr)
    return EXIT_BAD_INPUT


def _scenario(file: Path) -> Any:
    from scenarios.files import load

    return load(file)


def _refuse_or_warn(file: Path, finding: str, *, allow: bool) -> None:
    if not allow:
        refuse(file, finding)
    print(f"warning: {file}: {finding}", file=sys.stderr)


def _exit_code(summary: dict[str, Any]) -> int:
    if summary["reason"].startswith("interrupted"):
        return EXIT_INTERRUPTED
    return 0 if summary["verdict"] == "stable" and not summary["not_logged"] else EXIT_FAILED


if __name__ == "__main__":
    main()
