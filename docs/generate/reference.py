"""The blocks of the reference, and the schema that editors read: all of them follow from the code."""

import re
from collections.abc import Callable
from pathlib import Path

import typer
from typer.cli import get_docs_for_click

from docs.generate import api, blocks, fields, keys
from docs.generate.runner import runner


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


MAKERS: dict[str, Callable[[], str]] = {
    "commands": commands_page,
    "scenario-keys": keys.keys_page,
    "tick-columns": fields.tick_columns,
    "modes": fields.modes,
    "truth-columns": fields.truth_columns,
    "summary-fields": lambda: fields.json_fields("summary"),
    "design-fields": lambda: fields.json_fields("design"),
    "trial-fields": lambda: fields.json_fields("trial"),
    "margin-fields": lambda: fields.json_fields("margin"),
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
    """What is committed and no longer follows from the code."""
    made = blocks.once_each(MAKERS)
    found = [f"{page}: {name}" for name, text in made.items() for page in blocks.differing(name, text)]
    if not keys.SCHEMA_FILE.exists() or keys.SCHEMA_FILE.read_text(encoding="utf-8") != keys.schema_text():
        found.append(str(keys.SCHEMA_FILE))
    return found
