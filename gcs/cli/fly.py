"""`gcs fly` and `gcs key`: the options of a flight and its exit code."""

import contextlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gcs.cli import FAILED, INTERRUPTED, options
from gcs.cli.front import LinksOf, chosen_for, chosen_now
from gcs.errors import InputError, beyond
from gcs.output import outlive_readers
from scenarios.networks import networks_of

if TYPE_CHECKING:
    from gcs.runs.summary_record import Summary

LISTEN = "127.0.0.1:14550"


def fly(
    scenario_file: options.ScenarioFile,
    loop: options.LoopOption = None,
    links: options.LinksOption = None,
    links_of: LinksOf = None,
    link_delay: options.LinkDelayOption = None,
    without: Annotated[
        list[int] | None,
        typer.Option(metavar="ID", help="leave this vehicle out and fly the formation around it; may be repeated"),
    ] = None,
    connect: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="listen on this address and fly vehicles already running")
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help=f"listen here for vehicles that gcs fly starts; default {LISTEN}"),
    ] = None,
    mirror: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="forward all frames to another ground station, read-only")
    ] = None,
    mirror_commands: Annotated[
        bool, typer.Option("--mirror-commands", help="with --mirror: forward that station's frames to the vehicles")
    ] = False,
    key: options.KeyFile = None,
    allow_unstable: options.AllowUnstable = False,
    allow_code: options.AllowCode = False,
    virtual: Annotated[bool, typer.Option("--virtual", help="fly in virtual time, faster than real time")] = False,
    speed: Annotated[
        float | None,
        typer.Option(metavar="N", min=0.01, max=1_000_000, help="with --virtual: at most N times as fast as real time"),
    ] = None,
    live: Annotated[
        str | None,
        typer.Option(metavar="new|HOST:PORT", help="show the flight in a new Rerun viewer, or in the one at HOST:PORT"),
    ] = None,
    assert_headroom: Annotated[
        float | None,
        typer.Option(
            metavar="FRACTION", min=-1000, max=1, help="exit with code 1 if the headroom ever fell below this"
        ),
    ] = None,
    assert_settled: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", min=0, max=1_000_000, help="exit with code 1 if errors take longer to settle"),
    ] = None,
    junit: Annotated[Path | None, typer.Option(metavar="FILE", help="write JUnit XML for CI")] = None,
    out: options.OutFolder = None,
    as_json: options.AsJson = False,
) -> None:
    """Design the control, start the vehicles, fly and record.

    Exit code 1 if the flight is not stable, its log is incomplete, a vehicle does not confirm at the end that it holds
    or lands, or an assertion does not hold.
    """
    from gcs.drive import fly as flying
    from gcs.drive.takeover import CONNECTED, TAKEN_OVER, Presence
    from gcs.plan.planner import flight_plan, with_trade_off
    from gcs.preflight import faults
    from gcs.views.flight_report import leave_report
    from gcs.views.report import print_design, print_summary
    from gcs.views.viewer import new_viewer, viewer_url

    outlive_readers()
    if out is not None:
        options.refuse_out(out)
    if junit is not None:
        options.out_file("--junit", junit)
    sockets = {"--connect": connect, "--listen": listen, "--mirror": mirror, "--key": key}
    _refuse_contradictions(sockets, speed, live, virtual=virtual, mirror_commands=mirror_commands)
    scenario = options.load_scenario(
        scenario_file, loop, without, links=links, link_delay_s=link_delay, allow_code=allow_code
    )
    if connect is None:
        options.refuse(scenario_file, faults.bad_start(scenario))
        options.refuse(scenario_file, faults.endless_link(scenario), in_file=link_delay is None and links is None)
    with contextlib.ExitStack() as opened:
        link = to = None
        at = ("--listen", LISTEN if listen is None else listen) if connect is None else ("--connect", connect)
        if not virtual:
            link = opened.enter_context(
                options.listening(
                    *at,
                    options.opened_guard(key, role="station"),
                    networks_of(vehicle.system_id for vehicle in scenario.vehicles),
                    together=scenario.links.one_port,
                )
            )
            options.warn_if_open(link)
            if mirror is not None:
                to = opened.enter_context(options.mirroring(mirror, link, commands=mirror_commands))
        unmeasured = links_of is None and scenario.control.for_link == "measured"
        presence = Presence(link, scenario) if unmeasured and link is not None and connect is None else None
        scenario, measured = (
            chosen_now(scenario, link, presence, key, shown=not as_json)
            if unmeasured
            else chosen_for(scenario, links_of)
        )
        design, plan = flight_plan(scenario, measured)
        design, plan = options.flyable(scenario_file, design, plan, allow_unstable=allow_unstable)
        design = with_trade_off(design)
        presence = presence or (None if link is None or connect is not None else Presence(link, plan.scenario))
        taken_over = presence is not None and bool(presence.taken_over())
        if not as_json:
            print_design(design)
        viewer = new_viewer() if live == "new" else live and viewer_url(*options.address("--live", live))
        folder = options.run_folder(out, scenario.name)
        if link is None:
            summary = flying.fly_in_virtual_time(
                plan, design, folder, show_table=not as_json, speed=speed, viewer=viewer
            )
        else:
            summary = flying.fly(
                plan,
                design,
                link,
                folder,
                show_table=not as_json,
                fleet=CONNECTED if connect is not None else TAKEN_OVER if taken_over else "",
                outlive_station=options.address(*at)[1] != 0,  # no later station listens at a port the system chose
                key_file=key,
                mirror=to,
                viewer=viewer,
            )
        if presence is not None and taken_over:
            presence.shut_down()
        summary = leave_report(folder, summary)
    options.answer(summary, partial(print_summary, folder=folder), as_json=as_json)
    passed = _passed(summary, assert_headroom, assert_settled, junit)
    raise typer.Exit(INTERRUPTED if summary.reason.startswith("interrupted") else 0 if passed else FAILED)


def _passed(summary: "Summary", least_headroom: float | None, settled_s: float | None, junit: Path | None) -> bool:
    """Check the flight, and print one line for each assertion that fails; the summary shows the other checks."""
    from gcs.runs.junit import Check, write_junit

    stable = "" if summary.verdict == "stable" else f"{summary.verdict}: {summary.reason}"
    checks = [Check("the flight is stable", stable), Check("the log is whole", "; ".join(summary.not_logged))]
    checks.append(Check("the vehicles hold or land at the end", summary.not_confirmed))
    least, after_s, asserted = summary.headroom_min, summary.settling_time_s, list[Check]()
    if least_headroom is not None:
        unmet = options.unmet_headroom(least, least_headroom)
        asserted.append(Check(f"the headroom is at least {least_headroom:.1%}", unmet))
    if settled_s is not None:
        met = after_s is not None and after_s <= settled_s
        name = f"the errors settle within {settled_s:g} s"
        read = "errors that did not settle" if after_s is None else f"{beyond(after_s, settled_s, 2)} s"
        asserted.append(Check(name, "" if met else f"--assert-settled: read {read}, wanted at most {settled_s:g} s"))
    if junit is not None:
        write_junit(junit, f"gcs fly {summary.scenario}", [*checks, *asserted], time_s=summary.duration_s or 0.0)
    for failed in (check for check in asserted if check.failure):
        options.say_failed(failed.failure)
    return not any(check.failure for check in [*checks, *asserted])


def _refuse_contradictions(
    sockets: Mapping[str, str | Path | None],
    speed: float | None,
    live: str | None,
    *,
    virtual: bool,
    mirror_commands: bool,
) -> None:
    if live is not None:
        from gcs.views.viewer import refuse_without_viewer

        refuse_without_viewer()
        if live != "new":
            options.address("--live", live)
    if mirror_commands and sockets["--mirror"] is None:
        raise InputError("read --mirror-commands without --mirror, wanted both")
    if sockets["--connect"] is not None and sockets["--listen"] is not None:
        raise InputError("read --connect and --listen, wanted one of them")
    if speed is not None and not virtual:
        raise InputError("read --speed without --virtual, wanted both")
    if virtual and (read := [option for option, value in sockets.items() if value is not None]):
        raise InputError(f"read --virtual and {read[0]}, wanted one of them: a flight in virtual time has no sockets")


def key(file: Annotated[Path, typer.Argument(metavar="FILE", help="a new file")]) -> None:
    """Make a key for signing (--key) that only you can read."""
    from scenarios.signing.keys import make_key

    make_key(file)
