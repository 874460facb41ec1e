"""Ctrl-C and a closed terminal at any moment, as sent to all processes of a command: no traceback, exit code 130."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.paths import ROOT

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("processes")]

STRESS = ["stress", "scenarios/chain3.toml", "--delay", "0.1:0.3:3", "--workers", "2", "--out"]
FRONT = ["design", "scenarios/chain3.toml", "--front"]
FLY = ["fly", "scenarios/chain3.toml", "--listen", "127.0.0.1:0", "--out"]


@pytest.mark.slow(first=5)
@pytest.mark.parametrize(
    ("arguments", "module", "times", "number"),
    [
        (STRESS, "typer", 1, signal.SIGINT),
        (STRESS, "numpy", 1, signal.SIGINT),
        (STRESS, "site", 3, signal.SIGINT),  # a worker starts, after the command and the resource tracker
        (STRESS, "numpy", 2, signal.SIGINT),
        (FLY, "numpy", 1, signal.SIGINT),
        (FLY, "site", 2, signal.SIGINT),  # the observer starts
        (STRESS, "numpy", 1, signal.SIGHUP),
        (STRESS, "site", 3, signal.SIGHUP),
        (STRESS, "numpy", 2, signal.SIGHUP),
        (FLY, "site", 2, signal.SIGHUP),
    ],
)
def test_a_signal_while_workers_import_shows_no_traceback(
    arguments: list[str], module: str, times: int, number: signal.Signals, tmp_path: Path
) -> None:
    told = ended([*arguments, str(tmp_path / "out")], module, times, lambda process: os.killpg(process.pid, number))
    assert "Traceback" not in told
    assert "KeyboardInterrupt" not in told


def test_a_front_that_is_interrupted_leaks_no_semaphores() -> None:
    told = ended(FRONT, "numpy", 2, lambda process: process.send_signal(signal.SIGINT))
    lines = [line for line in told.splitlines() if not line.startswith("import time:")]
    assert lines == ["interrupted"]


def ended(arguments: list[str], module: str, times: int, end: Callable[["subprocess.Popen[str]"], None]) -> str:
    """The last stderr of a command that `end` stops, with code 130, once a module has been imported `times` times."""
    command = [sys.executable, "-m", "gcs", *arguments]
    environment = os.environ | {"PYTHONPROFILEIMPORTTIME": "1"}  # each process tells what it has imported
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, cwd=ROOT, env=environment,
        start_new_session=True,
    ) as process:  # fmt: skip
        assert process.stderr is not None
        seen = 0
        for line in process.stderr:
            seen += line.split("|")[-1].strip() == module
            if seen == times:
                break
        end(process)
        told = process.stderr.read()
        code = process.wait(60)
    assert (seen, code) == (times, 130)
    return told
