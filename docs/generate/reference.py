"""The blocks of the reference, and the schema that editors read, all generated from the code.

Columns come from the record in the code, JSON fields from `fields.toml`; `keys` and `api` make the other two pages.
"""

import inspect
import re
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import typer
from typer.cli import get_docs_for_click

import gcs.control.tick
import sim_vehicles.links.truth
from docs.generate import api, blocks, keys
from docs.generate.blocks import table
from docs.generate.runner import runner

_LINE = re.compile(r'\s+\("(?P<name>\w+)", "(?P<type>[^"]+)"\),(?:  # (?P<text>.*))?$')
_TYPES = {"f": "float", "i": "integer", "u": "unsigned", "b": "boolean"}


def commands_page() -> str:
    """A section for each command of `gcs`, as Typer documents it, and one for `sim-vehicles`, which has no Typer."""
    from gcs.cli.main import app

    group = typer.main.get_command(app)
    text = get_docs_for_click(obj=group, ctx=typer.Context(group, info_name="gcs"), name="gcs")
    sections = text[text.index("## ") :].replace("* `--help`: Show this message and exit.\n", "")
    sections = re.sub(r"^\$ (.*)$", lambda line: re.sub(r"[{}]", "", line[1]), sections, flags=re.MULTILINE)
    sections = re.sub(
        r"`[^`]*`|<", lambda found: found[0].replace("<", "\\<") if found[0] == "<" else found[0], sections
    )
    with runner() as run:
        vehicles = run.run("sim-vehicles --help")
    return f"{sections.rstrip()}\n\n## `sim-vehicles`\n\n```text\n{vehicles.rstrip()}\n```"


def described() -> dict[str, dict[str, str]]:
    """By file, what each of its JSON fields means."""
    return tomllib.loads(Path(__file__).with_name("fields.toml").read_text(encoding="utf-8"))


def json_fields(file: str) -> str:
    """The table of one file's JSON fields."""
    fields = described()
    own = fields[file] if file == "trial" else fields["every"] | fields[file]  # trials are lines of a table
    return table(("field", "meaning"), [(f"`{path}`", text) for path, text in own.items()])


def found_fields(value: Any, known: Iterable[str], path: str = "") -> set[str]:
    """The paths of the fields of a JSON value, down to those in `known`."""
    if path in set(known):
        return {path}
    if isinstance(value, dict):
        found = (found_fields(inner, known, f"{path}.{name}" if path else name) for name, inner in value.items())
        return set[str]().union(*found)
    if value == [] and any(each.startswith(f"{path}[]") for each in known):
        return set()  # the list is empty here
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return set[str]().union(*(found_fields(inner, known, f"{path}[]") for inner in value))
    return {path}


def columns(module: ModuleType, dtype: "np.dtype[Any]") -> str:
    """The columns of a record with the comments beside them; a line without one is described with the line above."""
    lines = [found for line in inspect.getsource(module).splitlines() if (found := _LINE.match(line))]
    assert tuple(line["name"] for line in lines) == dtype.names
    rows: list[tuple[list[str], str, str]] = []
    for line in lines:
        kind = dtype[line["name"]]
        words = f"{_TYPES[kind.kind]}{'' if kind.kind == 'b' else f' {8 * kind.itemsize}'}"
        if line["text"] or not rows:
            rows.append(([], words, line["text"] or ""))
        rows[-1][0].append(f"`{line['name']}`")
    return table(("columns", "type", "meaning"), [(", ".join(names), words, text) for names, words, text in rows])


def tick_columns() -> str:
    return columns(gcs.control.tick, gcs.control.tick.TICK)


def modes() -> str:
    """The modes of a vehicle, by the number in the tick record."""
    source = inspect.getsource(gcs.control.tick.Mode)
    lines = re.findall(r"^\s+([A-Z]+) = (\d+)  # (.*)$", source, re.MULTILINE)
    return table(("number", "mode", "meaning"), [(number, name, text) for name, number, text in lines])


def truth_columns() -> str:
    dtype = sim_vehicles.links.truth.DTYPE
    rows = [(f"`{name}`", f"{_TYPES[dtype[name].kind]} {8 * dtype[name].itemsize}") for name in dtype.names or ()]
    return table(("field", "type"), rows)


MAKERS: dict[str, Callable[[], str]] = {
    "commands": commands_page,
    "scenario-keys": keys.keys_page,
    "tick-columns": tick_columns,
    "modes": modes,
    "truth-columns": truth_columns,
    "summary-fields": lambda: json_fields("summary"),
    "design-fields": lambda: json_fields("design"),
    "trial-fields": lambda: json_fields("trial"),
    "margin-fields": lambda: json_fields("margin"),
    "gains-api": api.api_page,
}


def write() -> list[Path]:
    """Write the schema and every block of the reference; the files that changed."""
    changed = blocks.fill(blocks.once_each(MAKERS))
    text = keys.schema_text()
    if not keys.SCHEMA_FILE.exists() or keys.SCHEMA_FILE.read_text(encoding="utf-8") != text:
        keys.SCHEMA_FILE.write_text(text, encoding="utf-8")
        changed.append(keys.SCHEMA_FILE)
    return changed


def stale() -> list[str]:
    """What is committed and differs from what the code gives now."""
    made = blocks.once_each(MAKERS)
    found = [f"{page}: {name}" for name, text in made.items() for page in blocks.differing(name, text)]
    if not keys.SCHEMA_FILE.exists() or keys.SCHEMA_FILE.read_text(encoding="utf-8") != keys.schema_text():
        found.append(str(keys.SCHEMA_FILE))
    return found
