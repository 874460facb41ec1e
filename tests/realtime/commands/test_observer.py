"""The observer as the process it is: it follows a growing run, and its recording is whole however the run ends."""

import fcntl
import os
import pty
import select
import shutil
import signal
import struct
import subprocess
import sys
import termios
import time  # noqa: TID251 (waits for other processes)
import warnings
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from gcs.control.tick import Event
from gcs.runs.record import READY_FILE, RECORDING_FILE, TICKS_FILE, UNFINISHED_FILE
from tests.support.fleets.flown_run import line, prepare, ticks_of
from tests.support.recordings import read_back

pytestmark = pytest.mark.realtime
FIVE = line(5)


def wait_for(condition: Callable[[], object], what: str, *, patience_s: float = 20.0) -> None:
    give_up = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < give_up, f"waited {patience_s} s for {what}"
        time.sleep(0.01)


def command(folder: Path, *options: str) -> list[str]:
    return [sys.executable, "-m", "gcs.views.observer", str(folder), *options]


@contextmanager
def observer(folder: Path, stdout: int) -> Generator["subprocess.Popen[bytes]"]:
    """An observer whose parent is this process; none is left when a test fails."""
    arguments = command(folder, "--parent", str(os.getpid()))
    with subprocess.Popen(arguments, stdout=stdout, stderr=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()


def recorded(folder: Path) -> int:
    """How many ticks are in the recording."""
    return len(read_back(folder / RECORDING_FILE, "/headroom/percent", "Scalars:scalars")[0])


def ticks_so_far(growing: Path) -> int:
    """How many ticks are in a recording that is still written."""
    snapshot = growing.with_name("snapshot.rrd")
    shutil.copy(growing, snapshot)
    with suppress(RuntimeError, ValueError), warnings.catch_warnings():  # it has no end, and at first no beginning
        warnings.simplefilter("ignore")
        return len(read_back(snapshot, "/headroom/percent", "Scalars:scalars")[0])
    return 0


def test_growing_runs_are_followed_to_their_end_despite_ctrl_c(tmp_path: Path) -> None:
    writer = prepare(tmp_path, FIVE)
    ticks = ticks_of(FIVE, start_s=-1.0, count=700)
    ready, growing = tmp_path / READY_FILE, tmp_path / UNFINISHED_FILE
    with observer(tmp_path, subprocess.PIPE) as process:
        wait_for(ready.exists, "the observer to be ready")
        process.send_signal(signal.SIGINT)
        wait_for(growing.exists, "the recording to be begun")
        writer.event(Event(time_s=-1.0, kind="phase", text="connecting"))
        for rows in ticks[:300]:
            writer.tick(rows)
        rest = ticks[300:].tobytes()
        with (tmp_path / TICKS_FILE).open("ab") as file:
            file.write(rest[:1000])  # tears a row apart
            file.flush()
            wait_for(lambda: ticks_so_far(growing) == 250, "the first ticks to be recorded before the others come")
            file.write(rest[1000:])
        writer.event(Event(time_s=2.0, kind="mode", system_id=3, text="NOMINAL -> CAUTION"))
        writer.event(Event(time_s=13.0, kind="end", text="duration reached"))
        writer.close()
        output = process.communicate(timeout=20)[0].decode()
        assert process.returncode == 0
    assert not ready.exists()
    assert recorded(tmp_path) == 650
    # Without a terminal each event is printed once, and the formation's state now and then.
    lines = output.splitlines()
    assert [text.split("s  ", 1)[1] for text in lines if "spacing error" not in text] == [
        "phase  connecting",
        "mode  vehicle 3: NOMINAL -> CAUTION",
        "end  duration reached",
    ]
    assert lines[-1].startswith("   12.98 s  spacing error max")
    assert "\x1b" not in output


def test_an_orphan_closes_the_recording_and_ends(tmp_path: Path) -> None:
    writer = prepare(tmp_path, FIVE)
    program = "import os, subprocess, sys\nchild = subprocess.Popen([*sys.argv[1:], '--parent', str(os.getpid())])"
    program += "\nprint(child.pid, flush=True)\nchild.wait()"
    arguments = [sys.executable, "-c", program, *command(tmp_path, "--no-table")]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        orphan = int(parent.stdout.readline())
        try:
            wait_for((tmp_path / READY_FILE).exists, "the observer to be ready")
            for rows in ticks_of(FIVE, start_s=0.0, count=100):
                writer.tick(rows)
            parent.kill()
            wait_for((tmp_path / RECORDING_FILE).exists, "the recording to be closed")
            wait_for(lambda: not (tmp_path / READY_FILE).exists(), "the observer to end")
        finally:
            parent.kill()
            with suppress(ProcessLookupError):
                os.kill(orphan, signal.SIGKILL)
    writer.close()
    assert recorded(tmp_path) == 100


def test_the_terminal_shows_the_table_until_sigterm_closes_the_recording(tmp_path: Path) -> None:
    writer = prepare(tmp_path, FIVE)
    controller, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 0, 0))
    shown = bytearray()

    def table_has_come() -> bool:
        if select.select([controller], [], [], 0)[0]:
            shown.extend(os.read(controller, 65536))
        return shown.decode(errors="replace").count("NOMINAL") >= 5

    with observer(tmp_path, terminal) as process:
        os.close(terminal)
        for rows in ticks_of(FIVE, start_s=0.0, count=100):
            writer.tick(rows)
        wait_for(table_has_come, "the table")
        process.terminate()
        assert process.wait(20) == 0
    os.close(controller)
    writer.close()
    assert recorded(tmp_path) == 100


def test_a_reader_that_goes_away_does_not_stop_the_recording(tmp_path: Path) -> None:
    writer = prepare(tmp_path, FIVE)
    with observer(tmp_path, subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.close()
        for rows in ticks_of(FIVE, start_s=0.0, count=100):
            writer.tick(rows)
        writer.event(Event(time_s=2.0, kind="end", text="duration reached"))
        writer.close()
        assert process.wait(20) == 0
        assert process.stderr is not None
        assert process.stderr.read() == b""
    assert recorded(tmp_path) == 100
