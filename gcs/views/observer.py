"""The observer: a separate process that follows a flight by reading the run's files.

It draws the live table and writes the Rerun recording, so the control process never waits for either.

    python -m gcs.views.observer FOLDER --parent PID [--no-table] [--viewer URL]

The file FOLDER/.observer-ready exists from the end of the slow imports until the observer ends. The observer ends after
the run's "end" event, on SIGTERM, or when its parent has died and nothing new is written; in each case the recording is
complete. It ignores SIGINT and SIGHUP, because the parent decides how the flight ends.
"""

import argparse
import gc
import os
import select
import signal
import sys
import time  # noqa: TID251 (this process is a driver: it runs at the pace of the flight it watches)
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from gcs.errors import InputError, extra_wanted
from gcs.output import outlive_readers
from gcs.plan.design import Design
from gcs.runs.files import RunTail, by_tick, read_design, read_scenario, read_ticks
from gcs.runs.record import DESIGN_FILE, END, NEW_DESIGN, READY_FILE, RECORDING_FILE
from gcs.runs.summary import finish
from gcs.runs.summary_record import Summary
from gcs.views.console import live_display
from gcs.views.flight_report import leave_report
from gcs.views.table import Display, FlightState
from scenarios.schema import Scenario

if TYPE_CHECKING:
    from gcs.views.recording import Recording

POLL_S = 0.1
TABLE_S = 0.24
SEND_S = 1.0
ROWS_AT_ONCE = 100_000
ORPHAN_S = 1.0
"""An observer whose parent has died ends after this time without new ticks or events."""


@dataclass
class Parent:
    """The process that started the observer, and whether it told the observer to stop."""

    pid: int
    stop: bool = False
    has_written: bool = False
    """Whether it has closed our standard input, which means that it will write nothing more."""

    def gone(self) -> bool:
        return os.getppid() != self.pid

    def wait(self) -> None:
        """Wait for POLL_S, or until the parent has written everything."""
        if self.has_written:
            time.sleep(POLL_S)
        else:
            self.has_written = bool(select.select([0], [], [], POLL_S)[0])


def main() -> int:
    parser = argparse.ArgumentParser(prog="gcs.views.observer", description="follow a flight: live table and recording")
    parser.add_argument("folder", type=Path, help="the run's folder")
    parser.add_argument("--parent", type=int, required=True, metavar="PID", help="process id of the ground station")
    parser.add_argument("--no-table", action="store_true", help="write the recording and print nothing")
    parser.add_argument("--viewer", metavar="URL", help="send the recording to this Rerun viewer, too")
    arguments = parser.parse_args()
    parent = Parent(arguments.parent)

    def stop(*_: object) -> None:
        parent.stop = True

    for decided_by_parent in (signal.SIGINT, signal.SIGHUP):
        signal.signal(decided_by_parent, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, stop)
    outlive_readers()
    os.environ.setdefault("RUST_LOG", "off")  # keeps Rerun's errors off the table; one line at the end reports them
    sys.meta_path.insert(0, _NoPandas())
    recorder = import_recording()
    os.nice(10)  # only now, because the station waits for the imports
    ready = arguments.folder / READY_FILE
    try:
        ready.touch()
        inputs = _inputs(arguments.folder, parent)
        if inputs is not None:
            recording = nullcontext() if recorder is None else recorder(arguments.folder, *inputs, arguments.viewer)
            observe(arguments.folder, *inputs, recording, parent=parent, show_table=not arguments.no_table)
            if parent.gone():
                finish(arguments.folder)  # the station was killed, so its run is summarised here
    except OSError as error:  # a full disk; the flight goes on
        print(f"{arguments.folder}: {error.strerror or error}; wanted room for it, then gcs recover", file=sys.stderr)
        return 1
    finally:
        ready.unlink(missing_ok=True)
    return 0


def observe(
    folder: Path,
    scenario: Scenario,
    design: Design,
    recorded: "AbstractContextManager[Recording | None]",
    *,
    parent: Parent,
    show_table: bool,
) -> None:
    """Follow the run in `folder` until it ends, a stop is requested, or the parent has died and nothing new arrives."""
    system_ids = [vehicle.system_id for vehicle in scenario.vehicles]
    tail = RunTail(folder, len(system_ids))
    state = FlightState(scenario, design)
    with recorded as recording, live_display(shown=show_table) as live:
        display = Display(state, live, shown=show_table)
        news = table_due = send_due = time.monotonic()
        ended = False
        while not ended:
            last_look = parent.stop or (parent.gone() and time.monotonic() - news > ORPHAN_S)
            # Events are read before ticks: once "end" is seen, all ticks written before it are read, too.
            events = tail.events()
            ticks = by_tick(tail.ticks(), system_ids)
            ended = last_look or any(event.kind == END for event in events)
            if any(event.kind == NEW_DESIGN for event in events):
                design = read_design(folder / DESIGN_FILE)
                state.redesigned(design)
                if recording is not None:
                    recording.redesigned(design)
            state.add(ticks, events)
            if recording is not None:
                recording.add(ticks, events)
            display.events(events)
            now = time.monotonic()
            if ticks.size or events:
                news = now
            if now >= table_due or ended:
                display.show(last=ended)
                table_due = now + TABLE_S
            if recording is not None and (now >= send_due or ended):
                recording.send()
                send_due = now + SEND_S
            if not ended:
                parent.wait()


def recover_run(folder: Path) -> Summary:
    """Finish the files of a run that has ended, flight.rrd among them, and return its summary."""
    finish(folder)
    if import_recording() is not None:
        record_run(folder)
    return leave_report(folder, finish(folder))  # again, because the summary lists the files


def record_run(folder: Path) -> Path:
    """Make flight.rrd from the other files of a run that has ended, and return its path; needs the extra viewer."""
    from gcs.views.recording import Recording

    scenario, design = read_scenario(folder), read_design(folder / DESIGN_FILE)
    ticks = by_tick(read_ticks(folder), [vehicle.system_id for vehicle in scenario.vehicles])
    with Recording(folder, scenario, design) as recording:
        recording.add(ticks[:0], RunTail(folder).events())
        step = ROWS_AT_ONCE // len(scenario.vehicles)
        for start in range(0, len(ticks), step):
            recording.add(ticks[start : start + step], [])
            recording.send()
    return folder / RECORDING_FILE


def import_recording() -> "type[Recording] | None":
    """Import `Recording`, which is slow; prints one line and returns None if Rerun is not installed."""
    try:
        from gcs.views.recording import Recording
    except ModuleNotFoundError as error:
        if not (why := extra_wanted(error.name)):
            raise
        print(f"no {RECORDING_FILE}: {why}", file=sys.stderr)
        return None
    return Recording


class _NoPandas:
    """An import hook that hides an installed pandas: pyarrow would import it, which takes 0.2 s, and not use it."""

    def find_spec(self, name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(f"{name} is not used here", name=name)


def _inputs(folder: Path, parent: Parent) -> tuple[Scenario, Design] | None:
    """Wait for the run's scenario and design to be written; None if the parent is gone or a stop is asked for first."""
    while True:
        try:
            design = read_design(folder / DESIGN_FILE)
        except InputError:  # not yet written, or not completely
            if parent.stop or parent.gone():
                return None
            time.sleep(POLL_S)
        else:
            return read_scenario(folder), design


if __name__ == "__main__":
    code = main()
    gc.freeze()  # skips the interpreter's final garbage collection, for which the station would wait
    sys.exit(code)
