"""What a reader of a page would type: code blocks with a comment above that says what they are.

    <!-- test: run -->               commands, in virtual time or short
    <!-- test: realtime -->          commands that need sockets and the real clock
    <!-- test: realtime, server -->  a command that keeps running while the others are typed in another terminal
    <!-- test: run, exit 1 -->       commands with this exit code
    <!-- test: file NAME -->         a file to save
    <!-- test: append NAME -->       what to add at its end
    <!-- test: python -->            a Python session

All blocks of a page are one session, in one folder.
"""

import re
from dataclasses import dataclass
from pathlib import Path

_STEP = re.compile(r"<!-- test: (?P<what>[^>]+?) -->\n```\w+\n(?P<text>.*?)```", re.DOTALL)


@dataclass(frozen=True)
class Step:
    """One marked block."""

    text: str
    file: str = ""
    """The file that the block is saved as or appended to."""
    append: bool = False
    python: bool = False
    realtime: bool = False
    server: bool = False
    exit_code: int = 0


def steps_of(page: Path) -> list[Step]:
    """The marked blocks of a page, in order."""
    return [_step(found["what"], found["text"]) for found in _STEP.finditer(page.read_text(encoding="utf-8"))]


def _step(what: str, text: str) -> Step:
    words = what.replace(",", " ").split()
    match words:
        case ["file" | "append" as how, name]:
            return Step(text, file=name, append=how == "append")
        case ["python"]:
            return Step(text, python=True)
        case ["run" | "realtime" as how, *rest]:
            code = int(rest[rest.index("exit") + 1]) if "exit" in rest else 0
            return Step(text, realtime=how == "realtime", server="server" in rest, exit_code=code)
        case _:
            raise ValueError(f"read <!-- test: {what} -->, wanted one that docs/generate/sessions.py describes")
