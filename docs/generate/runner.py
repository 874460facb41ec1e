"""Runs commands as a reader of the documentation would type them, and lists them."""

import contextlib
import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Generator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from docs.generate.blocks import MEASURED_ON, ROOT
from docs.generate.forked import run_gcs

_ENVIRONMENT = {"COLUMNS": "120", "NO_COLOR": "1", "TERM": "dumb"}


class CommandError(Exception):
    """A command behind a figure had an unwanted exit code or printed no JSON."""


class Runner:
    """Runs commands in a folder in which `scenarios` and `docs` are those of the repository."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.commands: list[str] = []
        """What was run, without repetitions."""

    def run(self, command: str, *, wanted: tuple[int, ...] = (0,)) -> str:
        """What a command prints; an exit code that is not `wanted` is an error."""
        if command not in self.commands:
            self.commands.append(command)
        program, *arguments = shlex.split(command)
        if program == "gcs":
            done = run_gcs(arguments, self.folder, _ENVIRONMENT)
        else:
            whole = [str(Path(sys.executable).with_name(program)), *arguments]
            changed = os.environ | _ENVIRONMENT
            done = subprocess.run(whole, cwd=self.folder, capture_output=True, text=True, env=changed, check=False)
        if done.returncode not in wanted:
            raise CommandError(f"{command}: exit code {done.returncode}, wanted {wanted}; {done.stderr.strip()}")
        return done.stdout

    def json(self, command: str, *, wanted: tuple[int, ...] = (0,)) -> Any:
        """The JSON that a command prints."""
        text = self.run(f"{command} --json", wanted=wanted)
        try:
            return json.loads(text)
        except ValueError:
            raise CommandError(f"{command} --json: read {text[:200]!r}, wanted JSON") from None


@contextlib.contextmanager
def runner() -> Generator[Runner]:
    """A runner in a folder of its own."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for shared in ("scenarios", "docs"):
            (folder / shared).symlink_to(ROOT / shared)
        yield Runner(folder)


def measured_on() -> str:
    """The line that says on which machine and when."""
    today = datetime.now(UTC).date().isoformat()
    return f"{MEASURED_ON}{today}: {_processor()}, {os.cpu_count()} processors, Python {platform.python_version()}."


def _processor() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return " ".join(line.partition(":")[2].split())
    return platform.machine()
