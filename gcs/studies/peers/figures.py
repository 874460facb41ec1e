"""The figures that a script leaves for the process that started it, in a file: foreign libraries print, too."""

import json
from pathlib import Path

_FILE = "figures.json"


def write_figures(folder: Path, figures: dict[str, float]) -> None:
    (folder / _FILE).write_text(json.dumps(figures), encoding="utf-8")


def read_figures(folder: Path) -> dict[str, float] | None:
    """None if the script left none."""
    file = folder / _FILE
    return json.loads(file.read_text(encoding="utf-8")) if file.exists() else None
