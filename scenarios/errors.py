"""Errors of scenario files, in a module of their own: importing them does not import the reader."""

from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path


class InWords(str):
    """What was read, described in words: an error shows it without quotes, which are for values of the file."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


class ScenarioError(Exception):
    """The scenario cannot be flown: one line with file, key, what was read and what was wanted.

    `place` is the key with the line in front of it, or empty if `file` says it all. None as `read` means that the file
    has nothing there.
    """

    def __init__(self, file: Path, place: str, read: object, wanted: str) -> None:
        self.place, self.read, self.wanted = place, read, wanted
        shown = "nothing" if read is None else " ".join(repr(read).split())
        shown = shown if len(shown) <= 80 else shown[:77] + "..."
        super().__init__(f"{file}: {place and f'{place}: '}read {shown}, wanted {wanted}")


class UnreadableError(ScenarioError):
    """The named file is missing, unreadable, empty or not text."""

    def __init__(self, path: Path, read: str, wanted: str = "") -> None:
        run = path / "scenario.toml"
        such = f", such as {run}" if path.is_dir() and run.is_file() else " (see gcs new)"
        Exception.__init__(self, f"{path}: read {read}, wanted {wanted or f'a scenario file{such}'}")


def did_you_mean(read: str, known: Iterable[str]) -> str:
    """The end of an error that names the known word closest to what was read; empty if none is close.

    >>> did_you_mean("folows", ["follows", "hears"]), did_you_mean("colour", ["follows", "hears"])
    ('; did you mean follows?', '')
    """
    near = get_close_matches(read, list(known), n=1, cutoff=0.7)
    return f"; did you mean {near[0]}?" if near else ""
