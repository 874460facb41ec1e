"""`gcs scenarios`, `new`, `check`, `design` and `margin`: scenarios, their gains, and the delay that these tolerate."""

from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from gcs.cli import FAILED, options
from gcs.cli import front as fronts
from gcs.cli.front import chosen_for
from gcs.errors import InputError
from scenarios.networks import MOST_VEHICLES

_LONGER = 1.01
"""Smallest ratio of effective to expected loop delay that is printed."""
_RARE = 0.01
"""Largest expected number of failsafes in a flight that is not printed."""

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from gcs.plan.design import Design
    from gcs.preflight.check import ScenarioCheck, VehicleCheck


def scenarios(
    links: Annotated[bool, typer.Option("--links", help="list the shipped link profiles instead")] = False,
    as_json: options.AsJson = False,
) -> None:
    """List the shipped scenarios; commands accept their names."""
    from scenarios.shipped import FOLDER, PROFILES, description, names

    folder = PROFILES if links else FOLDER
    found = {name: description(name, folder) for name in names(folder)}
    if as_json:
        options.print_json({"links" if links else "scenarios": found})
        return
    from rich.table import Table

    from gcs.views.console import plain_console

    table = Table.grid(padding=(0, 2))
    for name, text in found.items():
        table.add_row(name, text)
    plain_console(soft_wrap=False).print(table)


def new(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="the new scenario")],
    like: Annotated[str | None, typer.Option(metavar="NAME", help="copy this scenario (see gcs scenarios)")] = None,
    chain: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=1, max=MOST_VEHICLES, help="N vehicles, each behind and to the right of the one in front"
        ),
    ] = None,
    columns: Annotated[str | None, typer.Option(metavar="CxN", help="C columns of N vehicles, side by side")] = None,
) -> None:
    """Write a scenario to start from, by default a chain of three.

    Also writes scenario.schema.json beside it, which lets editors complete and check the keys.
    """
    from scenarios import shipped
    from scenarios.errors import did_you_mean
    from scenarios.files import parse

    if sum(asked is not None for asked in (like, chain, columns)) > 1:
        raise InputError("read several of --like, --chain and --columns, wanted one of them")
    if file.suffix != ".toml":
        raise InputError(f"read {file}, wanted a file name that ends in .toml")
    if file.exists():
        raise InputError(f"{file}: read a file that exists, wanted a new one")
    if like is not None:
        if like not in shipped.names():
            near = did_you_mean(like, shipped.names())
            raise InputError(f"--like: read {like}, wanted one of {', '.join(shipped.names())}{near}")
        text = shipped.copied(like, file.stem)
    else:
        text = shipped.columns(file.stem, *(_shape(columns) if columns is not None else (1, chain or 3)))
    parse(text, file)
    if not file.parent.is_dir():
        raise InputError(f"{file}: read no folder {file.parent}, wanted one that exists")
    file.write_text(text, encoding="utf-8")
    beside = file.with_name(shipped.SCHEMA.name)  # the file names it: editors then know all keys
    if not beside.exists():
        beside.write_bytes(shipped.SCHEMA.read_bytes())
    typer.echo(f"scenario {file}\ncheck    gcs check {file}\nfly      gcs fly {file} --virtual")


def _shape(text: str) -> tuple[int, int]:
    across, _, length = text.partition("x")
    known = across.isdecimal() and length.isdecimal() and len(across) < 4 and len(length) < 4
    if not known or not 1 <= int(across) * int(length) <= MOST_VEHICLES:
        wanted = f"columns and vehicles in each, such as 3x4, of at most {MOST_VEHICLES} vehicles"
        raise InputError(f"--columns: read {text!r}, wanted {wanted}")
    return int(across), int(length)


def check(
    scenario_file: options.ScenarioFile,
    loop: options.LoopOption = None,
    links: options.LinksOption = None,
    links_of: fronts.LinksOf = None,
    link_delay: options.LinkDelayOption = None,
    allow_unstable: options.AllowUnstable = False,
    allow_code: options.AllowCode = False,
    assert_headroom: Annotated[
        float | None,
        typer.Option(
            metavar="FRACTION",
            min=-1000,
            max=1,
            help="exit with code 1 if the headroom expected over the links is lower",
        ),
    ] = None,
    as_json: options.AsJson = False,
) -> None:
    """Check a scenario before a flight: its keys, design and start.

    Exit code 2 if `gcs fly` would refuse it. --assert-headroom tests two figures: the headroom that 99 % of the
    set-points keep, and the headroom of the effective loop delay, which takes late and lost datagrams into account.
    """
    from gcs.plan.planner import flight_plan
    from gcs.preflight import faults
    from gcs.preflight.check import check as checked

    scenario = options.load_scenario(scenario_file, loop, links=links, link_delay_s=link_delay, allow_code=allow_code)
    options.refuse(scenario_file, faults.bad_start(scenario))
    options.refuse(scenario_file, faults.endless_link(scenario), in_file=link_delay is None and links is None)
    scenario, measured = chosen_for(scenario, links_of)
    design, plan = flight_plan(scenario, measured)
    design, plan = options.flyable(scenario_file, design, plan, allow_unstable=allow_unstable)
    found = checked(plan)
    if assert_headroom is not None and not found.response_known:
        read, wanted = "autopilots that are identified in flight", "a [response] in the scenario, which makes it known"
        options.refuse(scenario_file, f"--assert-headroom: read {read}, wanted {wanted}", in_file=False)
    options.answer(found, partial(_print_check, design), as_json=as_json)
    if assert_headroom is not None:
        late, effective = " for 99 % of the set-points", " at the effective loop delay"
        both = (found.headroom_p99, late), (found.effective_headroom, effective)
        unmet = [text for left, of in both if (text := options.unmet_headroom(left, assert_headroom, of))]
        for text in unmet:
            options.say_failed(text)
        raise typer.Exit(FAILED if unmet else 0)


def _print_check(design: "Design", found: "ScenarioCheck") -> None:
    from gcs.views.console import UNKNOWN, ms_text, number_text, plain_console, table_of
    from gcs.views.report import print_design
    from gcs.views.scene import plan_view

    console = plain_console()
    for text, code in found.code.items():
        console.print(f"runs     {text}, sha256 {code.sha256}", markup=False)
    print_design(design, console)
    for line in _delay_lines(design, found):
        console.print(line, markup=False)
    for key, (given, simulated) in found.response_differs.items():
        simulated_text = f"the simulated autopilots have {number_text(simulated, 'g')}"
        console.print(f"response {key} {number_text(given, 'g')}, for which the control is designed: {simulated_text}")
    if found.closest_m is not None:
        when = f", at {found.closest_s:.1f} s" if found.closest_s else ""
        console.print(f"places   at least {found.closest_m:.2f} m between any two vehicles{when}")
    if (course := found.course) is not None:
        length = "" if course.length_m is None else f"{course.length_m:,.0f} m in "
        turns = f"{course.turns} change{'s' * (course.turns != 1)} of velocity"
        most = f"{course.acceleration_max_m_s2:.2f} m/s² and {course.jerk_max_m_s3:.2f} m/s³"
        console.print(f"course   {length}{course.duration_s:.1f} s; {turns}, at most {most}")
    for motion in (motion for motion in found.planned if motion.beyond):
        needs = ", ".join(f"{key} {getattr(motion, key):.2f}" for key in motion.beyond)
        console.print(f"limits   vehicle {motion.system_id} cannot fly the planned motion, which needs {needs}")
    console.print(plan_view({v.system_id: v.place_ne_m for v in found.vehicles}))
    title = "places, their errors and first commands at the start, and the expected loop delays"
    columns: dict[str, Callable[[VehicleCheck], str]] = {
        "vehicle": lambda v: str(v.system_id),
        "follows": lambda v: UNKNOWN if v.follows is None else str(v.follows),
        "north\nm": lambda v: f"{v.place_ne_m[0]:.2f}",
        "east\nm": lambda v: f"{v.place_ne_m[1]:.2f}",
        "error\nm": lambda v: number_text(v.spacing_error_m, ".2f"),
        "command\nm/s²": lambda v: f"{v.command_m_s2:.2f}",
        "limit\nm/s²": lambda v: number_text(v.command_max_m_s2, ".2f"),
        "loop\nms": lambda v: ms_text(v.expected_loop_delay_s, unit=""),
        f"link takes\n+ms ± {ms_text(found.phase_s, unit='')}": lambda v: ms_text(v.link_delay_left_s, unit=""),
    }
    console.print(table_of(found.vehicles, columns, title=title, dense=True))
    if beyond := [v.system_id for v in found.vehicles if v.command_m_s2 > (v.command_max_m_s2 or float("inf"))]:
        console.print(
            f"limits   vehicle{'s' * (len(beyond) > 1)} {' '.join(map(str, beyond))} cannot fly the first command: "
            "until errors are smaller, the flight differs from the linear analysis"
        )


def _delay_lines(design: "Design", found: "ScenarioCheck") -> "Iterator[str]":
    """Lines on the loop delay expected over the links, and on the headroom it leaves."""
    from gcs.views.console import ms_text, number_text

    commanded = [v for v in found.vehicles if v.expected_loop_delay_s is not None]
    slowest = max(commanded, key=lambda v: v.expected_loop_delay_s or 0.0)
    margin_s = design.margin_of(slowest.system_id)
    margin = "no limit" if margin_s is None else ms_text(margin_s)
    margin = "unknown" if design.margin_unknown else margin
    if found.mismatch_window_s is not None:
        least_s, most_s = found.mismatch_window_s
        stable = f"stable from {ms_text(least_s, unit='')} to {ms_text(most_s)}"
        margin = f"predicted over {ms_text(found.assumed_delay_s)}: {stable}"
    else:
        margin = f"margin {margin}"
    unstable = "" if found.headroom is None or found.headroom > 0.0 else ": unstable"
    whose = "" if len({v.expected_loop_delay_s for v in commanded}) == 1 else f" for vehicle {slowest.system_id}"
    least = min(commanded, key=lambda v: inf if v.headroom is None else v.headroom)
    of = "" if least is slowest or not whose else f" of vehicle {least.system_id}"
    yield (
        f"delay    loop {ms_text(found.expected_loop_delay_s, unit='')} ± {ms_text(found.phase_s)} expected from the "
        f"links{whose}, {margin}, "
        f"headroom {number_text(found.headroom, '.0%')}{of}{unstable}"
    )
    if not found.response_known:
        yield "         if the vehicles responded at once: how autopilots respond is known once they are identified"
    if (found.effective_loop_delay_s or inf) > _LONGER * found.expected_loop_delay_s:
        left = -inf if found.effective_loop_delay_s is None else found.effective_headroom
        past = ": unstable" if left is not None and left <= 0.0 else ""
        effective = f"{ms_text(found.effective_loop_delay_s)}, headroom {number_text(found.effective_headroom, '.0%')}"
        yield f"         with late and lost datagrams it amounts to a constant {effective}{past}"
    late = f"loop at most {ms_text(found.loop_delay_s_p99)}, headroom at least {number_text(found.headroom_p99, '.0%')}"
    yield f"         for 99 % of the set-points: {late}"
    for name, share in found.channel_use.items():
        overloaded = ": it drops datagrams" if share > 1.0 else ""
        yield f"channel  {name} is offered {share:.0%} of what it carries{overloaded}"
    if found.channels_not_included:
        yield "         next to nothing reaches some vehicle: the other figures are without the channel"
    elif found.channel_use:
        yield "         the delays above include the waits for it, seen in short virtual flights; the design's do not"
    if found.outage_s is not None:
        yield f"         without the outages of links, of up to {found.outage_s:g} s"
    if found.setpoint_gaps > _RARE:
        often = f"{found.setpoint_gaps:.2g} times in the flight, no set-point arrives for safety.setpoint_timeout_s"
        yield f"failsafe about {often}, after which a vehicle holds"


def design(
    scenario_file: options.ScenarioFile,
    method: Annotated[
        Literal["inclusion", "graph-dk", "graph-lqr"] | None,
        typer.Option(help="design method; default as in the scenario"),
    ] = None,
    loop: options.LoopOption = None,
    links: options.LinksOption = None,
    front: Annotated[
        bool, typer.Option("--front", help="show the best α and decay at several delays, with and without prediction")
    ] = False,
    at: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", min=0.001, max=10, help="use the gains of the front at this loop delay"),
    ] = None,
    maximise: Annotated[Literal["alpha", "decay"], typer.Option(help="with --at: the quantity to maximise")] = "alpha",
    predict: Annotated[
        Literal["on", "off"] | None, typer.Option(help="with --at: predict over that delay or not; default the better")
    ] = None,
    links_of: fronts.LinksOf = None,
    compare_prediction: Annotated[
        bool,
        typer.Option("--compare-prediction", help="show the loop delay tolerated with prediction, and its cost"),
    ] = False,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE.svg|png", help="with --front: draw it into this file")
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option(metavar="FILE.toml", help="with --at or --links-of: write the scenario with these gains"),
    ] = None,
    allow_unstable: options.AllowUnstable = False,
    allow_code: options.AllowCode = False,
    as_json: options.AsJson = False,
) -> None:
    """Design the gains of a scenario.

    Shows the gains, their robustness and delay margins, and the trade-off between the two.
    """
    from gcs.plan.criteria import with_bounds
    from gcs.plan.disturbed import with_spread
    from gcs.plan.planner import flight_plan, with_trade_off
    from gcs.preflight.faults import unstable_loop
    from gcs.views.report import print_design
    from scenarios.files import dump
    from scenarios.keys.own import NO_LAW

    scenario = options.load_scenario(scenario_file, loop, links=links, allow_code=allow_code)
    if method is not None:
        scenario = scenario.with_keys(control={"method": method, "gains": None, "blocks": ()} | NO_LAW)
    options.refuse_alone("--save", save, "--at or --links-of", at, links_of)
    options.refuse_alone("--predict", predict, "--at", at)
    options.refuse_alone("--picture", picture, "--front", front or None)
    if save is not None:
        options.out_file("--save", save)
        if save.exists():
            raise InputError(f"--save: {save}: read a file that exists, wanted a new one")
    if sum((front, at is not None, links_of is not None)) > 1:
        raise InputError("read several of --front, --at and --links-of, wanted one of them")
    if front:
        fronts.show_front(scenario, method, picture, as_json=as_json)
        return
    scenario = scenario if at is None else fronts.scenario_at(scenario, at, maximise, predict)
    scenario, measured = chosen_for(scenario, links_of)
    if save is not None:
        save.write_text(dump(scenario), encoding="utf-8")
    result, plan = flight_plan(scenario, measured)
    if compare_prediction:
        from gcs.studies.front import compared

        options.answer(compared(result, scenario.name), fronts.print_comparison, as_json=as_json)
        return
    if (unstable := unstable_loop(plan)) is not None:
        options.refuse_or_warn(scenario_file, unstable, allow=allow_unstable)
    found = with_bounds(with_spread(with_trade_off(result), plan), scenario)
    options.answer(found, print_design, as_json=as_json)


def margin(
    model_file: Annotated[
        Path,
        typer.Argument(
            metavar="MODEL.json|FILE.mat|SCENARIO.toml",
            help="a linear loop with delays, continuous or sampled and held (docs/reference/margin.md), or a scenario",
        ),
    ],
    allow_code: options.AllowCode = False,
    as_json: options.AsJson = False,
) -> None:
    """Find how much delay a linear loop or a scenario tolerates.

    Shows the delays at which it is stable, the margin, and where roots cross the stability boundary.
    """
    from gcs.cli.margin import margin_fields, margin_of_file, margin_of_scenario, print_margin
    from scenarios.shipped import located

    model_file = located(str(model_file))
    if model_file.suffix == ".toml":
        found = margin_of_scenario(model_file, allow_code=allow_code)
    else:
        found = margin_of_file(model_file)
    if as_json:
        options.print_json(margin_fields(found))
    else:
        print_margin(found)
