"""The option --loop: the same scenario with its loop closed elsewhere."""

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from scenarios.schema import Scenario


class Loop(Enum):
    """Where the loop is closed, as `control.loop` of a scenario."""

    GROUND = "ground"
    ONBOARD = "onboard"


LoopOption = Annotated[
    Loop | None,
    typer.Option("--loop", help="in place of the scenario's: own errors fed back by the station or on board"),
]


def load_with_loop(file: Path, loop: Loop | None) -> "Scenario":
    """The scenario of a file, with another loop if one is given.

    Raises
    ------
    scenarios.errors.ScenarioError
        If the file cannot be used, or not with this loop.
    """
    from scenarios.files import load, with_loop

    scenario = load(file)
    return scenario if loop is None else with_loop(scenario, loop.value, file)
