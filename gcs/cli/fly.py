"""`gcs fly` and `gcs key`: what a flight is asked for, and what its exit code says."""

import contextlib
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gcs.cli import FAILED, INTERRUPTED
from gcs.cli.options import (
    AllowUnstable,
    AsJson,
    KeyFile,
    LoopOption,
    ScenarioFile,
    address,
    answer,
    listening,
    load_scenario,
    mirroring,
    opened_guard,
    refuse,
    refuse_or_warn,
    run_folder,
    warn_if_open,
    within,
)
from gcs.errors import InputError
from gcs.output import outlive_readers

if TYPE_CHECKING:
    from gcs.runs.summary_record import Summary

LISTEN = "127.0.0.1:14550"


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
    from gcs.drive.fly import FlyOptions
    from gcs.drive.fly import fly as fly_now
    from gcs.drive.takeover import CONNECTED, TAKEN_OVER, Presence
    from gcs.plan.planner import flight_plan
    from gcs.views.report import print_design, print_summary

    outlive_readers()
    scenario = load_scenario(scenario_file, loop)
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
            refuse_or_warn(scenario_file, unstable, allow=allow_unstable)
            plan = preflight.without_actions(plan)
        there = Presence(link, plan.scenario, guard)
        taken_over = there.taken_over() if connect is None else []
        if not as_json:
            print_design(design)
        folder = run_folder(out, scenario.name)
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
    answer(summary, partial(print_summary, folder=folder), as_json=as_json)
    raise typer.Exit(_exit_code(summary))


def _exit_code(summary: "Summary") -> int:
    if summary.reason.startswith("interrupted"):
        return INTERRUPTED
    return 0 if summary.verdict == "stable" and not summary.not_logged else FAILED


def key(file: Annotated[Path, typer.Argument(metavar="FILE", help="a new file")]) -> None:
    """Make a key for signing (--key) that only you can read."""
    from scenarios.signing.keys import make_key

    make_key(file)
