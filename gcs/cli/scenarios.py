"""`gcs scenarios`, `new`, `check`, `design` and `margin`: from a scenario to its gains and the delay they tolerate."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from gcs.cli.options import (
    AllowUnstable,
    AsJson,
    LoopOption,
    ScenarioFile,
    answer,
    load_scenario,
    print_json,
    refuse,
    refuse_or_warn,
)
from gcs.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from gcs.drive.check import ScenarioCheck, VehicleCheck
    from gcs.plan.design import Design

MOST_VEHICLES = 254


def scenarios(as_json: AsJson = False) -> None:
    """List the scenarios that ship, by the names that commands accept."""
    from scenarios.shipped import description, names

    answer({name: description(name) for name in names()}, _print_scenarios, as_json=as_json)


def _print_scenarios(found: dict[str, str]) -> None:
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
        int | None, typer.Option(metavar="N", help="N vehicles, each behind and to the right of the one in front")
    ] = None,
    columns: Annotated[str | None, typer.Option(metavar="CxN", help="C columns of N vehicles, side by side")] = None,
) -> None:
    """Write a scenario to start from, by default a chain of three."""
    from scenarios import shipped
    from scenarios.files import parse

    if sum(asked is not None for asked in (like, chain, columns)) > 1:
        raise InputError("read several of --like, --chain and --columns, wanted one of them")
    if file.suffix != ".toml":
        raise InputError(f"read {file}, wanted a file name that ends in .toml")
    if file.exists():
        raise InputError(f"{file}: read a file that exists, wanted a new one")
    if like is not None:
        if like not in shipped.names():
            raise InputError(f"--like: read {like}, wanted one of {', '.join(shipped.names())}")
        text = shipped.copied(like, file.stem)
    else:
        text = shipped.columns(file.stem, *(_shape(columns) if columns is not None else (1, _chain(chain))))
    parse(text, file)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")
    typer.echo(f"scenario {file}\ncheck    gcs check {file}\nfly      gcs fly {file} --virtual")


def _chain(count: int | None) -> int:
    if count is not None and not 1 <= count <= MOST_VEHICLES:
        raise InputError(f"--chain: read {count}, wanted 1 to {MOST_VEHICLES} vehicles")
    return 3 if count is None else count


def _shape(text: str) -> tuple[int, int]:
    across, _, length = text.partition("x")
    known = across.isdecimal() and length.isdecimal() and len(across) < 4 and len(length) < 4
    if not known or not 1 <= int(across) * int(length) <= MOST_VEHICLES:
        wanted = f"columns and vehicles in each, such as 3x4, of at most {MOST_VEHICLES} vehicles"
        raise InputError(f"--columns: read {text!r}, wanted {wanted}")
    return int(across), int(length)


def check(
    scenario_file: ScenarioFile,
    loop: LoopOption = None,
    allow_unstable: AllowUnstable = False,
    as_json: AsJson = False,
) -> None:
    """Validate a scenario, design its gains and show its start, without flying.

    Exit code 2 if `gcs fly` would refuse it.
    """
    from gcs.drive import preflight
    from gcs.drive.check import check as checked
    from gcs.plan.planner import flight_plan

    scenario = load_scenario(scenario_file, loop)
    refuse(scenario_file, preflight.bad_start(scenario), preflight.endless_link(scenario))
    design, plan = flight_plan(scenario)
    if (unstable := preflight.unstable_loop(plan)) is not None:
        refuse_or_warn(scenario_file, unstable, allow=allow_unstable)
    answer(checked(plan), partial(_print_check, design), as_json=as_json)


def _print_check(design: "Design", found: "ScenarioCheck") -> None:
    from gcs.views.console import UNKNOWN, ms_text, number_text, plain_console, table_of
    from gcs.views.report import print_design
    from gcs.views.scene import plan_view

    console = plain_console()
    print_design(design, console)
    margin = "no limit" if found.delay_margin_s is None else ms_text(found.delay_margin_s)
    console.print(
        f"delay    loop {ms_text(found.expected_loop_delay_s)} expected from the links, margin {margin}: "
        f"headroom {found.headroom:.0%}"
    )
    if found.closest_m is not None:
        console.print(f"places   at least {found.closest_m:.1f} m between any two vehicles")
    console.print(plan_view({v.system_id: v.place_ne_m for v in found.vehicles}))
    columns: dict[str, Callable[[VehicleCheck], str]] = {
        "vehicle": lambda v: str(v.system_id),
        "follows": lambda v: UNKNOWN if v.follows is None else str(v.follows),
        "place north, m": lambda v: f"{v.place_ne_m[0]:.2f}",
        "east, m": lambda v: f"{v.place_ne_m[1]:.2f}",
        "start error, m": lambda v: number_text(v.spacing_error_m, ".2f"),
        "command, m/s²": lambda v: f"{v.command_m_s2:.2f}",
        "limit": lambda v: number_text(v.command_max_m_s2, ".2f"),
    }
    console.print(table_of(found.vehicles, columns))
    if beyond := [v.system_id for v in found.vehicles if v.command_m_s2 > (v.command_max_m_s2 or float("inf"))]:
        console.print(
            f"limits   vehicle{'s' * (len(beyond) > 1)} {' '.join(map(str, beyond))} cannot fly the first command: "
            "until errors are smaller, the flight differs from the linear analysis"
        )


def design(
    scenario_file: ScenarioFile,
    method: Annotated[
        Literal["inclusion", "graph-dk", "graph-lqr"] | None,
        typer.Option(help="design method; default as in the scenario"),
    ] = None,
    loop: LoopOption = None,
    allow_unstable: AllowUnstable = False,
    as_json: AsJson = False,
) -> None:
    """Design the gains of a scenario.

    Shows the gains, their robustness and delay margins, and the trade-off between the two.
    """
    from gcs.drive.preflight import unstable_loop
    from gcs.plan.planner import flight_plan, with_trade_off
    from gcs.views.report import print_design

    scenario = load_scenario(scenario_file, loop)
    if method is not None:
        control = scenario.control.model_copy(update={"method": method, "gains": None, "blocks": ()})
        scenario = scenario.model_copy(update={"control": control})
    result, plan = flight_plan(scenario)
    if (unstable := unstable_loop(plan)) is not None:
        refuse_or_warn(scenario_file, unstable, allow=allow_unstable)
    answer(with_trade_off(result), print_design, as_json=as_json)


def margin(
    model_file: Annotated[
        Path,
        typer.Argument(
            metavar="MODEL.json|SCENARIO.toml",
            help="any linear loop with delays, or one sampled and held (docs/reference/margin.md), or a scenario",
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Find how much delay a linear loop or a scenario tolerates.

    Shows the delays at which it is stable, the margin, and where roots cross the stability boundary.
    """
    from gcs.cli.margin import margin_fields, margin_of_file, margin_of_scenario, print_margin

    found = margin_of_scenario(model_file) if model_file.suffix == ".toml" else margin_of_file(model_file)
    if as_json:
        print_json(margin_fields(found))
    else:
        print_margin(found)
