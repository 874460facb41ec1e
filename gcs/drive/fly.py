"""One flight in real time: start the vehicles, fly, record, sum up."""

import contextlib
import os
import subprocess
import sys
import time  # noqa: TID251 - names the run's folder; the flight's own clock is in the driver
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path

from gcs.control.tick import Event
from gcs.drive.guard import Guard
from gcs.drive.mirror import Mirror
from gcs.drive.sitl import VehicleProcess
from gcs.drive.udp import StationSocket, clock_ns, drive, prepare_real_time
from gcs.interrupts import held_back, stop_signals
from gcs.plan.design import Design
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import described
from gcs.runs.files import write_design
from gcs.runs.record import DESIGN_FILE, END, FLEET, NEW_DESIGN, READY_FILE, SCENARIO_FILE, RunWriter
from gcs.runs.summary import finish
from gcs.runs.summary_record import Summary
from gcs.station.station import Station
from scenarios import files as scenario_files

_NS = 1_000_000_000
_OBSERVER_PATIENCE_S = 60.0
_START_DELAY_NS = _NS // 5


@dataclass(frozen=True)
class FlyOptions:
    """Options of one flight that are not part of the experiment, which the scenario describes."""

    folder: Path
    show_table: bool
    """Whether to show the live table, or its plain lines without a terminal."""
    fleet: str = ""
    """Who provides the vehicles, in words; empty to start simulated ones."""
    outlive_station: bool = False
    """Whether the simulated vehicles wait to be taken over if this process is killed."""
    key_file: Path | None = None
    """The guard's key, for the simulated vehicles."""


def fly(
    plan: FlightPlan,
    design: Design,
    link: StationSocket,
    options: FlyOptions,
    guard: Guard | None = None,
    mirror: Mirror | None = None,
) -> Summary:
    """Fly a designed scenario in real time; returns the summary of the run, which is left in the folder."""
    folder = options.folder
    (folder / SCENARIO_FILE).write_text(scenario_files.dump(plan.scenario), encoding="utf-8")
    write_design(folder, design)
    with stop_signals() as asked_to_stop:
        unwritten = _flown(plan, design, link, options, guard, mirror, asked_to_stop)
        return finish(folder, unwritten=unwritten)


def _flown(
    plan: FlightPlan,
    design: Design,
    link: StationSocket,
    options: FlyOptions,
    guard: Guard | None,
    mirror: Mirror | None,
    asked_to_stop: Callable[[], str],
) -> list[Event]:
    """Fly and leave the logs in the folder; returns the events that could not be written."""
    folder = options.folder
    with contextlib.ExitStack() as stack:
        # Left in the reverse order: first the vehicles end, then the observer finishes the recording.
        vehicles: VehicleProcess | None = None
        observer = stack.enter_context(_observer(folder, show_table=options.show_table))
        if not options.fleet:
            vehicles = VehicleProcess(
                folder / SCENARIO_FILE,
                station=link.address,
                folder=folder,
                key_file=options.key_file,
                outlive_station=options.outlive_station,
            )
            stack.enter_context(vehicles)
        writer = RunWriter(folder)
        _wait_until_ready(observer, folder, asked_to_stop)
        prepare_real_time()
        station = Station(plan, start_ns=clock_ns() + _START_DELAY_NS)
        if options.fleet:
            writer.event(Event(time_s=station.scenario_time_s(clock_ns()), kind=FLEET, text=options.fleet))

        def new_plan(found: FlightPlan) -> None:
            try:
                write_design(folder, described(design, found))
            except OSError as error:
                writer.ended(DESIGN_FILE, error)
            text = f"delay margin {found.delay_margin_s:.3f} s with the vehicles' response"
            writer.event(Event(time_s=station.scenario_time_s(clock_ns()), kind=NEW_DESIGN, text=text))

        def stop() -> str:
            return asked_to_stop() or ("" if vehicles is None else vehicles.complaint())

        try:
            drive(station, link, writer, stop, new_plan, guard, mirror)
            writer.event(Event(time_s=station.scenario_time_s(clock_ns()), kind=END, text=station.end_reason))
        finally:
            unwritten = writer.close()
        if unwritten:  # including the last event, for which the observer waits
            observer.terminate()
    return unwritten


def new_folder(scenario_name: str) -> Path:
    """A new folder for a run in runs/, named after the scenario and the local time."""
    stem = f"{scenario_name}-{time.strftime('%Y%m%d-%H%M%S')}"
    for count in range(1, 1000):
        folder = Path("runs") / (stem if count == 1 else f"{stem}-{count}")
        with contextlib.suppress(FileExistsError):
            folder.mkdir(parents=True)
            return folder
    raise FileExistsError(f"runs/{stem}: 1000 runs in one second")


@contextlib.contextmanager
def _observer(folder: Path, *, show_table: bool) -> Generator["subprocess.Popen[bytes]"]:
    """The process that shows and records the flight. On leaving the context it has ended by itself or been ended."""
    command = [sys.executable, "-m", "gcs.views.observer", str(folder), "--parent", str(os.getpid())]
    with held_back():  # once started, it ignores Ctrl-C by itself
        process = subprocess.Popen(command + ([] if show_table else ["--no-table"]), stdin=subprocess.DEVNULL)
    try:
        yield process
    except BaseException:
        process.terminate()
        process.wait(_OBSERVER_PATIENCE_S)
        raise
    for end in (process.terminate, process.kill):  # if it does not end by itself after the last event
        try:
            process.wait(_OBSERVER_PATIENCE_S)
        except subprocess.TimeoutExpired:
            end()
    process.wait()


def _wait_until_ready(observer: "subprocess.Popen[bytes]", folder: Path, asked_to_stop: Callable[[], str]) -> None:
    """Wait for the observer's slow imports, which would otherwise compete with the first ticks for the processor."""
    while observer.poll() is None and not (folder / READY_FILE).exists() and not asked_to_stop():
        time.sleep(0.02)
