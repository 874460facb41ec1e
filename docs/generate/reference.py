"""The blocks of the reference, and the schema that editors read: all of them follow from the code."""

from collections.abc import Callable
from pathlib import Path

from docs.generate import api, blocks, commands, fields, keys

MAKERS: dict[str, Callable[[], str]] = {
    "commands": commands.commands_page,
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
