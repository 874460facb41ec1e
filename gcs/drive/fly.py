"""Runs one flight, in real or virtual time: starts the vehicles, flies, records and summarises."""

import contextlib
import os
import subprocess
import sys
import time  # noqa: TID251 - names the run's folder, paces virtual time and waits for the observer
from collections.abc import Callable, Generator, Sequence
from operator import itemgetter
from pathlib import Path

from gcs.control.tick import Event
from gcs.drive.lockstep import EPOCH_NS, START_NS, RecordedVehicles, fly_lockstep, prepare
from gcs.drive.mirror import Mirror
from gcs.drive.sitl import VehicleProcess
from gcs.drive.takeover import CONNECTED
from gcs.drive.udp import StationSocket, clock_ns, drive
from gcs.interrupts import held_back, stop_signals
from gcs.link.datagram import Frames, Logged
from gcs.link.mavlink import is_timesync_request
from gcs.plan.design import Design
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import described, identified
from gcs.runs import record
from gcs.runs.files import write_design, write_experiment
from gcs.runs.record import RunWriter
from gcs.runs.refusals import REFUSED, Refusals, in_words
from gcs.runs.summary import finish
from gcs.runs.summary_record import Summary
from gcs.station.station import Station
from scenarios.schema import NS_PER_S
from scenarios.undisturbed import undisturbed

_OBSERVER_PATIENCE_S = 60.0
_START_DELAY_NS = NS_PER_S // 5


def fly(
    plan: FlightPlan,
    design: Design,
    link: StationSocket,
    folder: Path,
    *,
    show_table: bool,
    fleet: str = "",
    outlive_station: bool = False,
    key_file: Path | None = None,
    mirror: Mirror | None = None,
    viewer: str | None = None,
) -> Summary:
    """Fly a designed scenario in real time, write the run to the folder, and return its summary.

    `show_table` shows the live table, or plain lines without a terminal. `fleet` says where the vehicles come from; if
    it is empty, this function starts simulated ones, which sign with `key_file`. With `outlive_station` these can be
    taken over if this process is killed. `viewer` is the URL of a Rerun viewer that shows the flight.
    """
    with stop_signals() as asked_to_stop:
        write_experiment(folder, plan.scenario, design)
        prepare(plan)
        # Contexts exit in reverse order: the vehicles stop first, then the observer finishes the recording.
        with _observer(folder, viewer, show_table=show_table) as observer, contextlib.ExitStack() as started:
            vehicles: VehicleProcess | None = None
            if not fleet:
                vehicles = VehicleProcess(
                    folder / record.SCENARIO_FILE,
                    station=link.address,
                    folder=folder,
                    key_file=key_file,
                    outlive_station=outlive_station,
                )
                started.enter_context(vehicles)
            writer = RunWriter(folder)
            _wait_until_ready(observer, folder, asked_to_stop)
            started.enter_context(undisturbed(own_code=plan.law is not None))
            start_ns = clock_ns() + _START_DELAY_NS
            station = Station(plan, start_ns=start_ns, stopwatch_ns=time.perf_counter_ns, strangers=fleet == CONNECTED)
            if fleet:
                writer.event(Event(time_s=station.scenario_time_s(clock_ns()), kind=record.FLEET, text=fleet))

            def new_plan(found: FlightPlan) -> None:
                _note_design(writer, folder, design, found, station.scenario_time_s(clock_ns()))

            def stop() -> str:
                return asked_to_stop() or ("" if vehicles is None else vehicles.complaint())

            try:
                drive(station, link, writer, stop, new_plan, mirror)
                if station.plan is not plan:  # add the figures that take too long to compute in flight
                    _write_design(writer, folder, described(design, station.plan))
                writer.event(
                    Event(time_s=station.scenario_time_s(clock_ns()), kind=record.END, text=station.end_reason)
                )
            except BaseException:
                link.send(station.abandoned())
                raise
            finally:
                unwritten = writer.close()
            if unwritten:  # the "end" event is among them, and the observer would wait for it
                observer.terminate()
        return finish(folder, unwritten=unwritten)


def _in_order(received: Frames, sent: Sequence[Logged]) -> Frames:
    """Frames by time. At one instant, requests come before their replies, which links without delay bring at once."""
    requests = [each for each in sent if is_timesync_request(each[0])]
    others = [each for each in sent if not is_timesync_request(each[0])]
    return Frames(sorted([*requests, *received, *others], key=itemgetter(1)))


def fly_in_virtual_time(
    plan: FlightPlan,
    design: Design,
    folder: Path,
    *,
    show_table: bool,
    speed: float | None = None,
    viewer: str | None = None,
) -> Summary:
    """Fly on one virtual clock, write the same files as in real time, and return the summary.

    `speed` limits the virtual seconds per second of real time; None sets no limit. `viewer` is as for `fly`.
    """
    with stop_signals() as asked_to_stop:
        write_experiment(folder, plan.scenario, design)
        with _observer(folder, viewer, show_table=show_table) as observer:
            if speed is not None:  # without a limit the observer simply catches up
                _wait_until_ready(observer, folder, asked_to_stop)
            station = Station(plan, start_ns=START_NS)
            writer, vehicles = RunWriter(folder), RecordedVehicles(plan, folder / record.TRUTH_FILE)
            began_s, time_s, flown = time.monotonic(), 0.0, plan
            for rows in fly_lockstep(plan, station=station, vehicles=vehicles):
                writer.tick(rows)
                writer.frames(_in_order(station.frames, vehicles.take_sent()), EPOCH_NS)
                writer.event(*station.events)
                station.events.clear()
                time_s = float(rows["time_s"][0])
                if station.plan is not flown:
                    flown = station.plan
                    _note_design(writer, folder, design, flown, time_s)
                if reason := asked_to_stop():
                    station.request_stop(reason)
                if speed is not None:
                    due_s = began_s + (int(rows["due_ns"][0]) - START_NS) / NS_PER_S / speed
                    time.sleep(max(0.0, due_s - time.monotonic()))
            if flown is not plan:
                _write_design(writer, folder, described(design, flown))
            if counts := Refusals().news(station.counters, last=True):
                writer.event(Event(time_s=time_s, kind=REFUSED, text=in_words(counts), counts=counts))
            writer.event(Event(time_s=time_s, kind=record.END, text=station.end_reason))
            vehicles.close()
            unwritten = writer.close()
            if unwritten:
                observer.terminate()
        return finish(folder, unwritten=unwritten)


def _note_design(writer: RunWriter, folder: Path, design: Design, found: FlightPlan, time_s: float) -> None:
    """Rewrite the design with the responses found by identification, and log an event about it."""
    _write_design(writer, folder, identified(design, found))
    text = f"delay margin {found.delay_margin_s:.3f} s with the vehicles' response"
    writer.event(Event(time_s=time_s, kind=record.NEW_DESIGN, text=text))


def _write_design(writer: RunWriter, folder: Path, design: Design) -> None:
    try:
        write_design(folder, design)
    except OSError as error:
        writer.ended(record.DESIGN_FILE, error)


def new_folder(scenario_name: str) -> Path:
    """Create a folder for a run in runs/, named after the scenario and the local time."""
    stem = f"{scenario_name}-{time.strftime('%Y%m%d-%H%M%S')}"
    for end in ("", *(f"-{count}" for count in range(2, 1000))):
        with contextlib.suppress(FileExistsError):
            (folder := Path("runs") / f"{stem}{end}").mkdir(parents=True)
            return folder
    raise FileExistsError(f"runs/{stem}: 1000 runs in one second")


@contextlib.contextmanager
def _observer(folder: Path, viewer: str | None, *, show_table: bool) -> Generator["subprocess.Popen[bytes]"]:
    """Run the process that shows and records the flight; leaving the context waits until it has ended."""
    command = [sys.executable, "-m", "gcs.views.observer", str(folder), "--parent", str(os.getpid())]
    command += [] if show_table else ["--no-table"]
    command += [] if viewer is None else ["--viewer", viewer]
    with held_back():  # once it has started, the observer itself ignores Ctrl-C
        process = subprocess.Popen(command, stdin=subprocess.PIPE)
    try:
        yield process
    except BaseException:
        process.terminate()
        process.wait(_OBSERVER_PATIENCE_S)
        raise
    assert process.stdin is not None
    process.stdin.close()  # tells it that everything is written
    for end in (process.terminate, process.kill):  # in case it does not exit after the last event
        try:
            process.wait(_OBSERVER_PATIENCE_S)
        except subprocess.TimeoutExpired:
            end()
    process.wait()


def _wait_until_ready(observer: "subprocess.Popen[bytes]", folder: Path, asked_to_stop: Callable[[], str]) -> None:
    """Wait until the observer's slow imports are done; they would compete with the first ticks for the processor."""
    while observer.poll() is None and not (folder / record.READY_FILE).exists() and not asked_to_stop():
        time.sleep(0.02)
