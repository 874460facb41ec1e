"""The error of scenario files, in a module of its own so that naming it does not import what reads them."""

from pathlib import Path


class ScenarioError(Exception):
    """The scenario cannot be flown: one line with file, key, what was read and what was wanted."""

    def __init__(self, file: Path, key: str, read: object, wanted: str) -> None:
        shown = " ".join(repr(read).split())
        shown = shown if len(shown) <= 80 else shown[:77] + "..."
        super().__init__(f"{file}: {key}: read {shown}, wanted {wanted}")


class UnreadableError(ScenarioError):
    """What was named is no text file."""

    def __init__(self, path: Path, read: str) -> None:
        run = path / "scenario.toml"
        such = f", such as {run}" if path.is_dir() and run.is_file() else " (see gcs new)"
        Exception.__init__(self, f"{path}: read {read}, wanted a scenario file{such}")
