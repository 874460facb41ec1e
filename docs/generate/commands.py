"""The commands and their options, as the programs themselves say it."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import typer

from docs.generate.blocks import table


def commands_page() -> str:
    """A section for each command of `gcs`, in the order of its help, and one for `sim-vehicles`."""
    from gcs.cli.main import app

    group: Any = typer.main.get_command(app)
    sections = [_section(f"gcs {name}", command) for name, command in group.commands.items()]
    return "\n\n".join([*sections, _vehicles()])


def _section(name: str, command: Any) -> str:
    context = typer.Context(command, info_name=name)
    rows: list[tuple[str, ...]] = []
    for parameter in command.params:
        shown, text = parameter.get_help_record(context)
        rows.append((f"`{shown.strip('[]')}`", " ".join(text.split())))
    usage = " ".join(piece.metavar or piece.human_readable_name for piece in _arguments(command))
    options = " [OPTIONS]" if len(rows) > len(_arguments(command)) else ""
    return f"## {name}\n\n```text\n{name} {usage}{options}\n```\n\n{_prose(command.help)}\n\n{table(('', ''), rows)}"


def _arguments(command: Any) -> list[Any]:
    return [parameter for parameter in command.params if parameter.param_type_name == "argument"]


def _prose(text: str) -> str:
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in text.strip().split("\n\n"))


def _vehicles() -> str:
    """The help of the vehicles' own program, which is light and so has no Typer."""
    program = Path(sys.executable).with_name("sim-vehicles")
    environment = {"COLUMNS": "100", "NO_COLOR": "1"}
    done = subprocess.run([program, "--help"], capture_output=True, text=True, check=True, env=environment)
    return f"## sim-vehicles\n\n```text\n{done.stdout.rstrip()}\n```"
