"""The table of `gcs bench --peers`: a row for each figure, and a list of peers that are not installed or failed."""

import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from timeit import timeit
from typing import Any

import numpy as np

from gains.delay.constant import delay_margin
from gains.formation.model import FormationModel
from gcs.drive.sitl import VehicleProcess
from gcs.published import Published
from gcs.runs.files import write_scenario
from gcs.runs.record import SCENARIO_FILE
from gcs.studies.benchmark import GAINS, benchmark, decode_s, encode_s, with_vehicles, without_solver
from gcs.studies.compare_cost import timed
from scenarios.schema import Scenario

SIZES = (5, 20, 100)
SCRIPTS = Path(__file__).parents[2] / "examples" / "peers"
_PATIENCE_S = 60.0
"""Time that a script may take in addition to its flight."""
_OURS = "this station"
_STATIONS = {_OURS: "own_station", "pymavlink": "pymavlink_station", "MAVSDK": "mavsdk_station"}
_PACKAGES = {
    "pymavlink": "pymavlink",
    "MAVSDK": "mavsdk",
    "JSBSim": "jsbsim",
    "python-control": "control",
    "CVXPY": "cvxpy",
    "SciPy": "scipy",
}
"""The package of each peer."""
_GROWTH = {"SciPy": ("centralised LQR", 80), "CVXPY": ("centralised LMI", 10)}
"""Method and largest chain of the designs whose growth is compared."""
_SMALLEST = 5
_MARGINS = 20


class PeerError(Exception):
    """A peer failed at its task; the text is one line."""


class Row(Published):
    """A figure of the same work by both; `ratio` is `theirs` over `ours`, None if `ours` is 0."""

    peer: str
    work: str
    unit: str
    ours: float
    theirs: float
    ratio: float | None


class Skipped(Published):
    """A peer that is left out of the whole comparison or of one task, and why."""

    peer: str
    why: str


class SideBySide(Published):
    """All rows of one run, and the load of the machine after it."""

    rows: tuple[Row, ...]
    skipped: tuple[Skipped, ...]
    load_average: float


def side_by_side(
    scenario: Scenario, *, seconds: float, sizes: Sequence[int] = SIZES, ended: Callable[[int], None] = lambda _: None
) -> SideBySide:
    """Compare with every peer that is installed; stations fly formations of `sizes` for `seconds` each.

    `ended` is called after each part with the number of parts left.
    """
    absent = [peer for peer, package in _PACKAGES.items() if find_spec(package) is None]
    skipped = [Skipped(peer=peer, why="not installed: python3 make.py peers") for peer in absent]
    rows: list[Row] = []
    parts: list[tuple[str, Callable[[], Iterator[Row]]]] = [
        ("pymavlink", _codecs),
        *(("", lambda n=n: _closed_loops(scenario, n, seconds, absent, skipped)) for n in sizes),
        ("JSBSim", lambda: _aircraft(scenario)),
        ("python-control", _margins),
        *((peer, lambda peer=peer: _growth(peer)) for peer in _GROWTH),
    ]
    for left, (peer, part) in zip(reversed(range(len(parts))), parts, strict=True):
        if peer not in absent:
            try:
                rows += part()
            except PeerError as error:
                skipped.append(Skipped(peer=peer, why=str(error)))
        ended(left)
    return SideBySide(rows=tuple(rows), skipped=tuple(skipped), load_average=os.getloadavg()[0])


def _row(peer: str, work: str, unit: str, ours: float, theirs: float) -> Row:
    return Row(peer=peer, work=work, unit=unit, ours=ours, theirs=theirs, ratio=theirs / ours if ours else None)


def _codecs() -> Iterator[Row]:
    for work, each in (
        ("decode a LOCAL_POSITION_NED", decode_s()),
        ("encode a SET_POSITION_TARGET_LOCAL_NED", encode_s()),
    ):
        yield _row("pymavlink", work, "µs", 1e6 * each.ours, 1e6 * each.theirs)


def _closed_loops(
    scenario: Scenario, vehicles: int, seconds: float, absent: Sequence[str], skipped: list[Skipped]
) -> Iterator[Row]:
    """Fly the same formation with this station and with each peer's; those that fail are added to `skipped`."""
    flown: dict[str, dict[str, tuple[float, str]]] = {}
    for peer, script in _STATIONS.items():
        if peer not in absent:
            try:
                flown[peer] = _fly_closed_loop(script, scenario, vehicles, seconds)
            except PeerError as error:
                skipped.append(Skipped(peer=peer, why=f"closed loop of {vehicles} vehicles: {error}"))
    ours = flown.pop(_OURS, {})
    for peer, theirs in flown.items():
        for name, (figure, unit) in ours.items():
            yield _row(peer, f"closed loop of {vehicles} vehicles: {name}", unit, figure, theirs[name][0])


def _aircraft(scenario: Scenario) -> Iterator[Row]:
    flight = benchmark(with_vehicles(scenario, _SMALLEST), seconds=2.0, repeat=3)
    vehicle_s = flight.vehicles_s_per_tick * flight.control_hz / _SMALLEST
    with tempfile.TemporaryDirectory(prefix="peers-") as name:
        found = run_script("aircraft", folder=Path(name))
    work = "a vehicle for a second: ours with links and MAVLink, theirs an aircraft without"
    yield _row("JSBSim", work, "ms", 1e3 * vehicle_s, 1e3 * found["step_run_s"] / found["step_s"])


def _margins() -> Iterator[Row]:
    """The delay margin of a follower's loop L(s) = (K3 - K1 s) / s²: phase margin over crossover frequency."""
    control: Any = import_module("control")
    loop = control.tf([-GAINS.K1, GAINS.K3], [1.0, 0.0, 0.0])
    whole = FormationModel((-1, 0), axes=1).ground_loop([[GAINS.K1]], [[GAINS.K2]], [[GAINS.K3]])
    A0, A1 = (matrix[1:, 1:] for matrix in whole)  # without the leader's velocity

    def theirs() -> float:
        _, phase_deg, _, _, crossover_rad_s, _ = control.stability_margins(loop, returnall=True)
        return float((np.radians(phase_deg) / crossover_rad_s).min())

    def ours() -> float:
        return delay_margin(A0, A1)

    work = "delay margin of a follower's continuous loop"
    yield _row("python-control", work, "ms", 1e3 * ours(), 1e3 * theirs())
    taken = [(timeit(ours, number=1), timeit(theirs, number=1)) for _ in range(_MARGINS)]
    yield _row("python-control", f"time of the {work}", "ms", *(1e3 * min(own) for own in zip(*taken, strict=True)))


def _growth(peer: str) -> Iterator[Row]:
    method, largest = _GROWTH[peer]
    ours, theirs = (timed(name, largest)[0] / timed(name, _SMALLEST)[0] for name in ("inclusion", method))
    work = f"design of a chain of {largest} over one of {_SMALLEST}: inclusion, {method}"
    yield _row(peer, work, "times as long", ours, theirs)


def _fly_closed_loop(script: str, scenario: Scenario, vehicles: int, seconds: float) -> dict[str, tuple[float, str]]:
    """Fly this many vehicles for `seconds` with the station of a script; returns figures with their units, by name.

    Lateness is from when a tick was due until all its set-points were sent. Raises PeerError if the script fails.
    """
    flown = without_solver(with_vehicles(scenario, vehicles), seconds)
    with tempfile.TemporaryDirectory(prefix="peers-") as name:
        folder = Path(name)
        write_scenario(folder, flown)
        file = folder / SCENARIO_FILE
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
    """Run a script, and return the figures that it writes to the file named by its last argument."""
    out = folder / "figures.json"
    command = [sys.executable, str(SCRIPTS / f"{script}.py"), *arguments, str(out)]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=patience_s, check=False)
    except subprocess.TimeoutExpired:
        raise PeerError(f"no result after {patience_s:g} s") from None
    if not out.exists():
        last = [line for line in done.stderr.splitlines() if line.strip()][-1:]
        raise PeerError(last[0] if last else f"exit code {done.returncode} without a word")
    return json.loads(out.read_text(encoding="utf-8"))
