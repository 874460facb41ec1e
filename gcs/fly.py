"""One flight from scenario to summary, in real time: design, find or start the vehicles, fly, record, sum up."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time  # noqa: TID251 - names the run's folder; the flight's own clock is in the driver
from collections import Counter
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gcs import mavlink
from gcs.guard import Guard
from gcs.interrupts import held_back
from gcs.mirror import Mirror
from gcs.plan import FlightPlan, described
from gcs.record import DESIGN_FILE, NEW_DESIGN, READY_FILE, SCENARIO_FILE, RunWriter
from gcs.sitl import VehicleProcess
from gcs.station import Station
from gcs.summary import finish
from gcs.udp import StationSocket, clock_ns, drive, prepare_real_time
from scenarios import files as scenario_files

_NS = 1_000_000_000
_HEARTBEAT_PERIOD_S = 1.2
"""Vehicles that already fly have been heard within this time."""
_OBSERVER_PATIENCE_S = 60.0
_START_DELAY_NS = _NS // 5


@dataclass(frozen=True)
class FlyOptions:
    """How one flight is run; the experiment itself is in the scenario."""

    folder: Path
    start_vehicles: bool
    """Whether to start simulated vehicles when none are heard."""
    show_table: bool
    """Whether the live table (or, without a terminal, its plain lines) is shown."""
    key_file: Path | None = None
    """The key of the guard, which vehicles that are started are to have as well."""


def fly(
    plan: FlightPlan,
    design: dict[str, Any],
    link: StationSocket,
    options: FlyOptions,
    guard: Guard | None = None,
    mirror: Mirror | None = None,
) -> dict[str, Any]:
    """Fly a designed scenario in real time and return the summary of the run left in the folder."""
    folder = options.folder
    (folder / SCENARIO_FILE).write_text(scenario_files.dump(plan.scenario), encoding="utf-8")
    (folder / DESIGN_FILE).write_text(json.dumps(design, indent=2), encoding="utf-8")
    with contextlib.ExitStack() as stack:
        asked_to_stop = stack.enter_context(stop_signals())
        heard = _vehicles_heard(link, plan, guard)
        # Left in the reverse order: the log is closed, the vehicles end, the observer has finished the recording.
        vehicles: VehicleProcess | None = None
        observer = stack.enter_context(_observer(folder, show_table=options.show_table))
        if options.start_vehicles and not heard:
            vehicles = VehicleProcess(
                folder / SCENARIO_FILE, station=link.address, folder=folder, key_file=options.key_file
            )
            stack.enter_context(vehicles)
        writer = RunWriter(folder)
        stack.callback(writer.close)
        _wait_until_ready(observer, folder)
        prepare_real_time()
        station = Station(plan, start_ns=clock_ns() + _START_DELAY_NS)
        if heard:
            text = f"vehicles {' '.join(map(str, heard))} are there already: none are started"
            writer.event(time_s=station.scenario_time_s(clock_ns()), kind="vehicle", text=text)

        def new_plan(found: FlightPlan) -> None:
            _write_whole(folder / DESIGN_FILE, described(design, found))
            text = f"delay margin {found.delay_margin_s:.3f} s with the vehicles' response"
            writer.event(time_s=station.scenario_time_s(clock_ns()), kind=NEW_DESIGN, text=text)

        def stop() -> str:
            return asked_to_stop() or ("" if vehicles is None else vehicles.complaint())

        drive(station, link, writer, stop, new_plan, guard, mirror)
        writer.event(time_s=station.scenario_time_s(clock_ns()), kind="end", text=station.end_reason)
    return finish(folder)


def new_folder(scenario_name: str) -> Path:
    """A fresh folder for a run below runs/, named after the scenario and the local time."""
    stem = f"{scenario_name}-{time.strftime('%Y%m%d-%H%M%S')}"
    for count in range(1, 1000):
        folder = Path("runs") / (stem if count == 1 else f"{stem}-{count}")
        with contextlib.suppress(FileExistsError):
            folder.mkdir(parents=True)
            return folder
    raise FileExistsError(f"runs/{stem}: 1000 runs in one second")


@contextlib.contextmanager
def stop_signals() -> Generator[Callable[[], str]]:
    """While entered, Ctrl-C and SIGTERM raise nothing: they become a reason to end the flight, vehicles holding."""
    asked: list[str] = []

    def on_signal(number: int, _frame: object) -> None:
        asked.append(f"interrupted: {signal.Signals(number).name}")

    before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked[0] if asked else ""
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _write_whole(file: Path, data: dict[str, Any]) -> None:
    """In one step, for those who read it meanwhile."""
    part = file.with_suffix(".new")
    part.write_text(json.dumps(data, indent=2), encoding="utf-8")
    part.replace(file)


def _vehicles_heard(link: StationSocket, plan: FlightPlan, guard: Guard | None) -> list[int]:
    """System ids of the scenario that already send to our port, as after a station was killed in flight."""
    while (until_ns := link.bound_ns + round(_HEARTBEAT_PERIOD_S * _NS)) > clock_ns():
        time.sleep((until_ns - clock_ns()) * 1e-9)
    datagrams = link.receive()
    if guard is not None:
        datagrams = guard.received(datagrams, clock_ns(), Counter())
    frames = [frame for datagram in datagrams for frame in mavlink.decode(datagram.data, Counter())]
    return sorted({frame.system_id for frame in frames} & set(plan.formation.system_ids))


@contextlib.contextmanager
def _observer(folder: Path, *, show_table: bool) -> Generator["subprocess.Popen[bytes]"]:
    """The process that shows and records the flight; left, it has ended by itself or been told to."""
    command = [sys.executable, "-m", "gcs.show.observer", str(folder), "--parent", str(os.getpid())]
    with held_back():  # while it starts; then it ignores Ctrl-C by itself
        process = subprocess.Popen(command + ([] if show_table else ["--no-table"]), stdin=subprocess.DEVNULL)
    try:
        yield process
        process.wait(_OBSERVER_PATIENCE_S)
    except BaseException:
        process.terminate()
        process.wait(_OBSERVER_PATIENCE_S)
        raise


def _wait_until_ready(observer: "subprocess.Popen[bytes]", folder: Path) -> None:
    """Wait for the observer's slow imports, so that they do not take the processor from the first ticks."""
    while observer.poll() is None and not (folder / READY_FILE).exists():
        time.sleep(0.02)
