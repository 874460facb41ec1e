"""Flies a formation with the station of a script in `examples/peers`, in processes of their own on loopback."""

import json
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

from gcs.drive.sitl import VehicleProcess
from gcs.studies.benchmark import with_vehicles, without_solver
from scenarios.files import dump
from scenarios.schema import Scenario

SCRIPTS = Path(__file__).parents[2] / "examples" / "peers"
_PATIENCE_S = 60.0
"""How long a script may take beside its flight."""


class PeerError(Exception):
    """A peer did not do what it was started for; the text is one line."""


def fly_closed_loop(script: str, scenario: Scenario, vehicles: int, seconds: float) -> dict[str, tuple[float, str]]:
    """Fly `seconds` of so many vehicles by the station of a script: figures with their units, by name.

    Lateness is from when a tick was due until all its set-points were sent. Raises PeerError if it does not fly them.
    """
    flown = without_solver(with_vehicles(scenario, vehicles), seconds)
    with tempfile.TemporaryDirectory(prefix="peers-") as name:
        folder = Path(name)
        file = folder / "flown.toml"
        file.write_text(dump(flown), encoding="utf-8")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            host, port = probe.getsockname()
        with VehicleProcess(file, station=(host, port), folder=folder):
            found = run_script(script, str(file), str(port), folder=folder, patience_s=_PATIENCE_S + seconds)
    return {
        "processor share per vehicle": (100.0 * found["used_s"] / seconds / vehicles, "% of a core"),
        "median lateness": (1e3 * found["late_p50_s"], "ms"),
        "p99 lateness": (1e3 * found["late_p99_s"], "ms"),
        "ticks flown": (100.0 * found["flown"], "%"),
        "last spacing error": (found["error_m"], "m"),
    }


def run_script(script: str, *arguments: str, folder: Path, patience_s: float = _PATIENCE_S) -> dict[str, float]:
    """The figures that a script leaves in a file of the folder, its last argument."""
    out = folder / "figures.json"
    command = [sys.executable, str(SCRIPTS / f"{script}.py"), *arguments, str(out)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=patience_s, check=False)
    except subprocess.TimeoutExpired:
        raise PeerError(f"no result after {patience_s:g} s") from None
    if not out.exists():
        last = [line for line in done.stderr.splitlines() if line.strip()][-1:]
        raise PeerError(last[0] if last else f"exit code {done.returncode} without a word")
    return json.loads(out.read_text(encoding="utf-8"))
