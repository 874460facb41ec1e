"""The error of scenario files, in a module of its own so that naming it does not import what reads them."""

from pathlib import Path


class ScenarioError(Exception):
    """The scenario cannot be flown: one line with file, key, what was read and what was wanted."""

    def __init__(self, file: Path, key: str, read: object, wanted: str) -> None:
        shown = " ".join(repr(read).split())
        shown = shown if len(shown) <= 80 else shown[:77] + "..."
        super().__init__(f"{file}: {key}: read {shown}, wanted {wanted}")
