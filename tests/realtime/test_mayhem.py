"""A flight that is disturbed at a random instant: nothing is left of it but files, and the next one is right.

`SLOW_TESTS=1 MAYHEM=20 python3 make.py test tests/realtime/test_mayhem.py` does each kind of harm twenty times;
MAYHEM_SEED draws other instants.
"""

import contextlib
import fcntl
import json
import os
import pty
import resource
import signal
import subprocess
import sys
import termios
import time  # noqa: TID251 - waits for processes, with time-outs
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gcs.control.tick import Event
from gcs.drive.takeover import TAKEN_OVER
from gcs.runs.files import RunTail, read_ticks
from gcs.watch.tlog import parse_tlog
from scenarios.files import dump, load
from scenarios.schema import FixedGains
from sim_vehicles.links.truth import read_truth
from tests.support.paths import SCENARIOS
from tests.support.processes import PATIENCE_S, free_port, gcs, until

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("processes")]

TIMES = int(os.environ.get("MAYHEM", "1"))
SEED = int(os.environ.get("MAYHEM_SEED", "1"))
FLIGHT_S = 3.0
BEFORE_S, AFTER_S = 5.0, 1.5
"""About how long a flight needs to begin, and to write its files at the end."""
KINDS = ("kill", "stop for 3 s", "disk full", "term", "hang up", "terminal closed")


class Run:
    """One `gcs fly` in a session of its own, on a terminal of its own if wanted."""

    def __init__(self, scenario: Path, port: int, folder: Path, *, on_terminal: bool) -> None:
        self.folder = folder
        self.errors = folder.with_suffix(".errors")
        command = [sys.executable, "-m", "gcs", "fly", str(scenario), "--listen", f"127.0.0.1:{port}"]
        self.terminal, end = pty.openpty() if on_terminal else (-1, -1)
        with self.errors.open("wb") as errors:
            self.process = subprocess.Popen(
                [*command, "--out", str(folder)],
                stdin=end if on_terminal else subprocess.DEVNULL,
                stdout=end if on_terminal else subprocess.DEVNULL,
                stderr=errors,
                start_new_session=True,
                preexec_fn=(lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0)) if on_terminal else None,  # noqa: PLW1509
            )
        if on_terminal:
            os.close(end)

    def flies(self) -> bool:
        """Whether the formation flies, or the run has ended before that."""
        if self.terminal >= 0:  # somebody has to read the table
            os.set_blocking(self.terminal, False)
            with contextlib.suppress(OSError):
                os.read(self.terminal, 1 << 16)
        return self.process.poll() is not None or any(event.text == "flying" for event in self.events())

    def events(self) -> list[Event]:
        return RunTail(self.folder).events()

    def processes(self) -> dict[int, str]:
        """The processes that still run with this folder in their command line."""
        found: dict[int, str] = {}
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                command = (entry / "cmdline").read_bytes() if entry.name.isdigit() else b""
                if str(self.folder).encode() + b"\0" in command or f"{self.folder}/".encode() in command:
                    found[int(entry.name)] = command.replace(b"\0", b" ").decode()
        return found


def do_harm(kind: str, run: Run) -> None:
    pid = run.process.pid
    match kind:
        case "kill":
            os.kill(pid, signal.SIGKILL)
        case "term":
            os.kill(pid, signal.SIGTERM)
        case "hang up":
            os.kill(pid, signal.SIGHUP)
        case "stop for 3 s":
            os.kill(pid, signal.SIGSTOP)
            time.sleep(3.0)
            os.kill(pid, signal.SIGCONT)
        case "disk full":  # no file of any of its processes grows from now on
            for each in run.processes():
                with contextlib.suppress(ProcessLookupError):
                    resource.prlimit(each, resource.RLIMIT_FSIZE, (1, 1))
        case _:
            os.close(run.terminal)
            run.terminal = -1


CODES = {
    "kill": {-signal.SIGKILL, 0},
    "term": {130, 0},
    "hang up": {130, 0},
    "stop for 3 s": {0, 1},
    "disk full": {0, 1, 2},
    "terminal closed": {130, 0},
}
"""Exit codes after each kind of harm; 0 if it came when all was done."""


def is_recovered(folder: Path) -> bool:
    """Whether there is a summary, and every file can be read whole; `gcs recover` may be needed for that."""
    if not (folder / "design.json").exists() or not any(folder.glob("ticks.*")):
        return True  # it had not begun
    before = (folder / "summary.json").exists()
    if not before:
        done = gcs("recover", folder)
        assert done.returncode == 0, done.stderr
    summary = json.loads((folder / "summary.json").read_text())
    ticks = read_ticks(folder)
    assert (np.diff(ticks["tick"]) >= 0).all()
    assert (np.unique(ticks["tick"], return_counts=True)[1] == 3).all()
    assert not parse_tlog((folder / "flight.tlog").read_bytes()).counters
    if (folder / "truth.bin").exists() and (folder / "truth.bin").stat().st_size:
        read_truth(folder / "truth.bin")
    if not summary["not_logged"]:
        assert (folder / "flight.rrd").exists()
    return True


def fly(scenario: Path, port: int, folder: Path, *options: str) -> "subprocess.CompletedProcess[str]":
    return gcs("fly", scenario, "--listen", f"127.0.0.1:{port}", *options, "--out", folder, "--json")


@pytest.mark.slow(first=3)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("time_no", range(TIMES))
def test_harm_at_any_instant_leaves_whole_files_and_no_process(kind: str, time_no: int, tmp_path: Path) -> None:
    scenario, port = tmp_path / "chain3.toml", free_port()
    given = load(SCENARIOS / "chain3.toml")
    control = given.control.model_copy(
        update={"gains": FixedGains(K1=-3.4, K2=0.6, K3=5.6), "delay_margin_s": None, "alpha": None}
    )
    scenario.write_text(dump(given.model_copy(update={"duration_s": FLIGHT_S, "control": control})))
    draw = np.random.default_rng([SEED, KINDS.index(kind), time_no])
    instant_s = float(draw.uniform(-BEFORE_S, FLIGHT_S + AFTER_S))
    print(f"{kind} at {instant_s:.2f} s")
    run = Run(scenario, port, tmp_path / "disturbed", on_terminal=kind == "terminal closed")
    if instant_s < 0.0:
        time.sleep(BEFORE_S + instant_s)
    else:
        until(run.flies)
        time.sleep(instant_s)
    ended = run.process.poll() is not None
    if not ended:
        do_harm(kind, run)
    code = run.process.wait(PATIENCE_S)
    assert code in CODES[kind]
    errors = run.errors.read_text()
    assert "Traceback" not in errors

    def others(orphans: bool) -> Callable[[], bool]:
        return lambda: not [c for c in run.processes().values() if not (orphans and "sim_vehicles.drive.cli" in c)]

    until(others(orphans=kind == "kill"))
    assert is_recovered(run.folder)
    other = ("--link-delay", "0.06")
    if orphaned := bool(run.processes()):
        refused = fly(scenario, port, tmp_path / "refused", *other)
        assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (2, "", 1)
        assert "fly chain3 with other links" in refused.stderr
        assert not (tmp_path / "refused").exists()
        taken = fly(scenario, port, tmp_path / "taken over")
        assert taken.returncode in (0, 1), taken.stderr
        summary = json.loads(taken.stdout)
        assert summary["fleet"] == TAKEN_OVER
        assert summary["reason"].startswith(("completed", "broken"))
        until(others(orphans=False))
    print(f"orphaned: {orphaned}")
    right = fly(scenario, port, tmp_path / "next", *other)
    assert right.returncode == 0, right.stdout + right.stderr
    summary = json.loads(right.stdout)
    assert (summary["verdict"], summary["not_logged"]) == ("stable", [])
    for vehicle in summary["vehicles"]:
        assert vehicle["rtt_s"]["p50"] == pytest.approx(0.12, abs=0.01)
