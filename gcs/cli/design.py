"""`gcs design` and `gcs margin`: gains of a scenario, and the delay margin of any linear loop."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from gcs.cli.options import (
    AllowUnstable,
    AsJson,
    LoopOption,
    ScenarioFile,
    answer,
    load_scenario,
    print_json,
    refuse_or_warn,
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
    """Find how much delay a linear loop or a scenario takes.

    Shows the delays at which it is stable, the margin, and where roots cross the stability boundary.
    """
    from gcs.cli.margin import margin_fields, margin_of_file, margin_of_scenario, print_margin

    found = margin_of_scenario(model_file) if model_file.suffix == ".toml" else margin_of_file(model_file)
    if as_json:
        print_json(margin_fields(found))
    else:
        print_margin(found)
