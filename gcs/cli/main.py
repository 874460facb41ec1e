"""The `gcs` command: its subcommands, and the one-line message and exit code of each kind of error.

Each command does its imports when it runs: cvxpy, rerun and matplotlib are slow, and --help must be quick.
"""

import gc
import os
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from gcs.cli import BAD_INPUT, FAILED, INTERRUPTED
from gcs.cli.fly import fly, key
from gcs.cli.runs import export, grade, recover, view
from gcs.cli.scenarios import check, design, margin, new, scenarios
from gcs.cli.stress import stress
from gcs.cli.studies import bench, capacity, compare, identify, thesis
from gcs.cli.watch import monitor, replay
from gcs.errors import InputError, extra_wanted
from gcs.output import DISK_FULL


class _Group(TyperGroup):
    """Turns an interrupt into an Abort, because Typer would exit on it silently."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise typer.Abort from None


app = typer.Typer(
    cls=_Group,
    add_completion=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Fly UAV formations over MAVLink and see how much link delay they tolerate.",
)


def _show_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"gcs {version('formation-gcs')}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def help_without_command(
    context: typer.Context,
    version: Annotated[  # noqa: ARG001 - its callback answers
        bool, typer.Option("--version", help="print the version", callback=_show_version, is_eager=True)
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


_COMMANDS = (
    scenarios, new, check, identify, fly, design, compare, margin, thesis, bench, capacity, grade, view, export,
    recover, key, stress, monitor, replay,
)  # fmt: skip
for _command in _COMMANDS:
    app.command()(_command)


def main() -> None:
    """Entry point: bad input becomes one line and exit code 2."""
    from gains.core.errors import GainsError
    from scenarios.errors import ScenarioError
    from scenarios.signing.keys import KeyFileError

    try:
        code = app(standalone_mode=False)
    except (InputError, ScenarioError, GainsError, KeyFileError) as error:
        code = _bad_input(str(error))
    except typer.TyperException as error:  # an unknown option, a missing argument
        code = _bad_input(_misread(error))
    except ModuleNotFoundError as error:
        if not extra_wanted(error.name):
            raise
        code = _bad_input(extra_wanted(error.name))
    except (KeyboardInterrupt, typer.Abort):
        print("interrupted", file=sys.stderr)
        code = INTERRUPTED
    except BrokenPipeError:  # the reader of our output, such as `head`, has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = FAILED
    except OSError as error:
        if error.filename is None and error.errno not in DISK_FULL:
            raise  # not about a file that the user named
        code = _bad_input(f"{error.filename or 'write'}: {error.strerror}, wanted a file or folder that can be used")
    gc.freeze()  # skip the interpreter's last garbage collection, which takes a tenth of a second
    sys.exit(code if isinstance(code, int) else 0)


def _misread(error: typer.TyperException) -> str:
    """The message for a value of the wrong kind, with what was read and wanted, or for a misspelt option."""
    from pydantic import ValidationError

    if near := getattr(error, "possibilities", None):
        return f"{error}; did you mean {' or '.join(near)}?"
    if not isinstance(error, typer.BadParameter):
        return str(error)
    if error.param is None or not isinstance(error.__cause__, ValidationError):
        return error.format_message()
    [found, *_] = error.__cause__.errors()
    option = error.param.get_error_hint().replace("'", "")
    if found["type"] in ("greater_than_equal", "less_than_equal"):
        low, high = (getattr(error.param, bound) for bound in ("min", "max"))
        unit = "seconds" if error.param.metavar == "SECONDS" else "a number"
        range_text = f"from {low:g} to {high:g}" if high is not None else f"of at least {low:g}"
        return f"{option}: read {float(found['input']):g}, wanted {unit} {range_text}"
    wanted = found["msg"].removeprefix("Input should be ").split(", unable to")[0].split("is not ")[-1].rstrip(".")
    return f"{option}: read {found['input']!r}, wanted {wanted}"


def _bad_input(line: str) -> int:
    print(" ".join(line.split()), file=sys.stderr)
    return BAD_INPUT
