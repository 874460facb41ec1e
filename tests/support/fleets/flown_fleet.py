"""Vehicles in a process of their own, for the tests with other people's clients."""

import contextlib
import subprocess
import sys
import time  # noqa: TID251 - the clients have threads and clocks of their own
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

from scenarios import files
from scenarios.schema import Scenario
from tests.support.paths import SCENARIOS
from tests.support.processes import PATIENCE_S, free_port


def until(condition: Callable[[], Any], what: str) -> None:
    """Wait for a condition that a client's threads or processes bring about."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s, f"{what}: not after {PATIENCE_S} s"
        time.sleep(0.02)


def copters() -> Scenario:
    """Three ArduCopters and two PX4, soon ready to fly."""
    loaded = files.load(SCENARIOS / "copters5.toml")
    vehicles = (v.model_copy(update={"flavour": "px4" if v.system_id > 3 else None}) for v in loaded.vehicles)
    autopilot = loaded.autopilot.model_copy(update={"telemetry_after_s": 0.1, "ready_after_s": 0.2})
    return loaded.model_copy(update={"vehicles": tuple(vehicles), "autopilot": autopilot})


@contextlib.contextmanager
def fleet(scenario: Scenario, folder: Path, *options: str) -> Generator[int]:
    """The vehicles of a scenario, with further options of their command, and the port they send to."""
    file = folder / "scenario.toml"
    file.write_text(files.dump(scenario), encoding="utf-8")
    port = free_port()
    command = [sys.executable, "-m", "sim_vehicles.drive.cli", str(file), "--station", f"127.0.0.1:{port}", *options]
    with subprocess.Popen([*command, "--duration", "90"], stdout=subprocess.DEVNULL) as process:
        try:
            yield port
        finally:
            process.terminate()
