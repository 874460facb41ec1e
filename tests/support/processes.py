"""The commands in processes of their own: how tests start, watch and find them."""

import os
import socket
import subprocess
import sys
import time  # noqa: TID251 - waits for processes, with time-outs
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from docs.generate.forked import run_gcs
from gcs.control.tick import TICK
from scenarios.files import dump, load
from tests.support.paths import ROOT, SCENARIOS

GCS = [sys.executable, "-m", "gcs"]
PATIENCE_S = 180.0


def short(tmp_path: Path, name: str, duration_s: float) -> Path:
    """A scenario of the repository, made shorter."""
    scenario = load(SCENARIOS / f"{name}.toml").model_copy(update={"duration_s": duration_s})
    file = tmp_path / f"{name}.toml"
    file.write_text(dump(scenario), encoding="utf-8")
    return file


def gcs(*arguments: str | Path, folder: Path = ROOT, **environment: str) -> "subprocess.CompletedProcess[str]":
    """What a command printed and its exit code, with these changes of the environment."""
    return run_gcs([*map(str, arguments)], folder, environment, PATIENCE_S)


def fly(*arguments: str | Path, **kwargs: Any) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [*GCS, "fly", *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **kwargs
    )


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)


def flying(folder: Path, at_least_s: float = 1.0) -> bool:
    """Whether the run has flown for that long."""
    file = folder / "ticks.part"
    if not file.exists():
        return False
    whole = file.stat().st_size // TICK.itemsize * TICK.itemsize
    ticks = np.frombuffer(file.read_bytes()[:whole], TICK)
    return bool(ticks.size and ticks["time_s"][-1] > at_least_s)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def children_named(text: str) -> list[int]:
    """Process ids whose command line contains a text that only this test uses."""
    found: list[int] = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                command = (entry / "cmdline").read_bytes().decode(errors="replace")
            except OSError:
                continue
            if text in command and "sim_vehicles.drive.cli" in command:
                found.append(int(entry.name))
    return found
