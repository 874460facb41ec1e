"""Flies a formation with the station of a script, in processes of their own on loopback."""

import socket
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from gcs.drive.sitl import VehicleProcess
from gcs.studies.benchmark import with_vehicles, without_solver
from gcs.studies.peers.figures import read_figures
from scenarios.files import dump
from scenarios.schema import Scenario

_PATIENCE_S = 60.0
"""How long a script may take beside its flight."""


class PeerError(Exception):
    """A peer did not do what it was started for; the text is one line."""


@dataclass(frozen=True)
class ClosedLoop:
    """What a closed loop took of its station. `lateness`: from when a tick was due until all set-points were sent."""

    processor_share_per_vehicle: float
    median_lateness: float
    p99_lateness: float
    ticks_flown: float
    last_spacing_error: float

    UNITS: ClassVar = {
        "processor_share_per_vehicle": "% of a core",
        "median_lateness": "ms",
        "p99_lateness": "ms",
        "ticks_flown": "%",
        "last_spacing_error": "m",
    }


def fly_closed_loop(script: str, scenario: Scenario, vehicles: int, seconds: float) -> ClosedLoop:
    """Fly `seconds` of so many vehicles by the station of a script. Raises PeerError if it does not fly them."""
    flown = without_solver(with_vehicles(scenario, vehicles), seconds)
    with tempfile.TemporaryDirectory(prefix="peers-") as name:
        folder = Path(name)
        file, port = folder / "flown.toml", _free_port()
        file.write_text(dump(flown), encoding="utf-8")
        with VehicleProcess(file, station=("127.0.0.1", port), folder=folder):
            found = run_script(script, str(file), str(port), folder=folder, patience_s=_PATIENCE_S + seconds)
    return ClosedLoop(
        processor_share_per_vehicle=100.0 * found["used_s"] / seconds / vehicles,
        median_lateness=1e3 * found["late_p50_s"],
        p99_lateness=1e3 * found["late_p99_s"],
        ticks_flown=100.0 * found["flown"],
        last_spacing_error=found["error_m"],
    )


def run_script(script: str, *arguments: str, folder: Path, patience_s: float = _PATIENCE_S) -> dict[str, float]:
    """The figures that a script of this package leaves in a folder, its last argument."""
    command = [sys.executable, "-m", f"gcs.studies.peers.{script}", *arguments, str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=patience_s, check=False)
    except subprocess.TimeoutExpired:
        raise PeerError(f"no result after {patience_s:g} s") from None
    found = read_figures(folder)
    if found is None:
        last = [line for line in done.stderr.splitlines() if line.strip()][-1:]
        raise PeerError(last[0] if last else f"exit code {done.returncode} without a word")
    return found


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
