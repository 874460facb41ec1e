"""`gcs fly` and `gcs key`: what a flight is asked for, and what its exit code says."""

import contextlib
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from gcs.cli import FAILED, INTERRUPTED
from gcs.cli.options import (
    AllowUnstable,
    AsJson,
    KeyFile,
    LoopOption,
    OutFolder,
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
    from gcs.plan.design import Design
    from gcs.plan.flight_plan import FlightPlan
    from gcs.runs.summary_record import Summary
    from scenarios.schema import Scenario

LISTEN = "127.0.0.1:14550"


def fly(
    scenario_file: ScenarioFile,
    loop: LoopOption = None,
    link_delay: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="constant delay of every link, each way")
    ] = None,
    connect: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="listen here and fly vehicles that are already running")
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help=f"listen here for the vehicles it starts; default {LISTEN}"),
    ] = None,
    mirror: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="forward all frames to another ground station, read-only")
    ] = None,
    mirror_commands: Annotated[
        bool, typer.Option("--mirror-commands", help="with --mirror: pass that station's frames on to the vehicles")
    ] = False,
    key: KeyFile = None,
    allow_unstable: AllowUnstable = False,
    virtual: Annotated[bool, typer.Option("--virtual", help="fly in virtual time, faster than real time")] = False,
    speed: Annotated[
        float | None, typer.Option(metavar="N", help="with --virtual: at most N times as fast as real time")
    ] = None,
    out: OutFolder = None,
    as_json: AsJson = False,
) -> None:
    """Design the control, start the vehicles, fly and record.

    Exit code 1 if the flight is not stable, or its log is incomplete.
    """
    from gcs.drive import preflight
    from gcs.views.report import print_summary

    outlive_readers()
    sockets = Sockets(connect, listen, mirror, mirror_commands, key)
    _refuse_contradictions(sockets, speed, virtual=virtual)
    scenario = load_scenario(scenario_file, loop)
    if link_delay is not None:
        within("--link-delay", link_delay, 0, 60, "seconds")
        scenario = scenario.with_link_delay(up_s=link_delay, down_s=link_delay)
    if connect is None:
        refuse(scenario_file, preflight.bad_start(scenario), preflight.endless_link(scenario))
    flight = Asked(scenario_file, scenario, allow_unstable, out, as_json)
    folder, summary = _fly_virtually(flight, speed) if virtual else _fly_in_real_time(flight, sockets)
    answer(summary, partial(print_summary, folder=folder), as_json=as_json)
    raise typer.Exit(_exit_code(summary))


class Sockets(NamedTuple):
    """The options of a flight in real time."""

    connect: str | None
    listen: str | None
    mirror: str | None
    mirror_commands: bool
    key: Path | None


class Asked(NamedTuple):
    """What is to be flown, and what is to be shown of it."""

    file: Path
    scenario: "Scenario"
    allow_unstable: bool
    out: Path | None
    as_json: bool

    def designed(self) -> "tuple[Design, FlightPlan]":
        from gcs.drive import preflight
        from gcs.plan.planner import flight_plan, with_trade_off

        design, plan = flight_plan(self.scenario)
        if (unstable := preflight.unstable_loop(plan)) is not None:
            refuse_or_warn(self.file, unstable, allow=self.allow_unstable)
            plan = preflight.without_actions(plan)
        return with_trade_off(design), plan

    def begun(self, design: "Design") -> Path:
        """Show the design; returns the run's folder."""
        from gcs.views.report import print_design

        if not self.as_json:
            print_design(design)
        return run_folder(self.out, self.scenario.name)


def _refuse_contradictions(sockets: Sockets, speed: float | None, *, virtual: bool) -> None:
    connect, listen, mirror, mirror_commands, key = sockets
    if mirror_commands and mirror is None:
        raise InputError("read --mirror-commands without --mirror, wanted both")
    if connect is not None and listen is not None:
        raise InputError("read --connect and --listen, wanted one of them")
    if speed is not None:
        within("--speed", speed, 0.01, 1e6, "a multiple of real time")
        if not virtual:
            raise InputError("read --speed without --virtual, wanted both")
    given = {"--connect": connect, "--listen": listen, "--mirror": mirror, "--key": key}
    if virtual and (read := [option for option, value in given.items() if value is not None]):
        raise InputError(f"read --virtual and {read[0]}, wanted one of them: a flight in virtual time has no sockets")


def _fly_virtually(flight: Asked, speed: float | None) -> "tuple[Path, Summary]":
    from gcs.drive.fly import fly_in_virtual_time

    design, plan = flight.designed()
    folder = flight.begun(design)
    return folder, fly_in_virtual_time(plan, design, folder, show_table=not flight.as_json, speed=speed)


def _fly_in_real_time(flight: Asked, sockets: Sockets) -> "tuple[Path, Summary]":
    from gcs.drive.fly import FlyOptions
    from gcs.drive.fly import fly as fly_now
    from gcs.drive.takeover import CONNECTED, TAKEN_OVER, Presence

    connect, listen, mirror, mirror_commands, key = sockets
    at = ("--connect", connect) if connect is not None else ("--listen", LISTEN if listen is None else listen)
    with contextlib.ExitStack() as opened:
        guard = opened_guard(key, role="station")
        link = opened.enter_context(listening(*at, guard))
        warn_if_open(link)
        to = None if mirror is None else opened.enter_context(mirroring(mirror, link, commands=mirror_commands))
        design, plan = flight.designed()
        there = Presence(link, plan.scenario)
        taken_over = there.taken_over() if connect is None else []
        folder = flight.begun(design)
        options = FlyOptions(
            folder=folder,
            show_table=not flight.as_json,
            fleet=CONNECTED if connect is not None else TAKEN_OVER if taken_over else "",
            outlive_station=address(*at)[1] != 0,  # nobody listens again at a port that the system chose
            key_file=key,
        )
        summary = fly_now(plan, design, link, options, to)
        if taken_over:
            there.shut_down()
    return folder, summary


def _exit_code(summary: "Summary") -> int:
    if summary.reason.startswith("interrupted"):
        return INTERRUPTED
    return 0 if summary.verdict == "stable" and not summary.not_logged else FAILED


def key(file: Annotated[Path, typer.Argument(metavar="FILE", help="a new file")]) -> None:
    """Make a key for signing (--key) that only you can read."""
    from scenarios.signing.keys import make_key

    make_key(file)
