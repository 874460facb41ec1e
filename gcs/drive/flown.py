"""Flies a plan to its end, in virtual time or in real time as `gcs fly` does, and returns its log.

In real time it also measures the load of the machine.
"""

import errno
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gains.core.arrays import FloatArray, IntArray
from gains.sampled.multirate import effective_delay_s
from gcs.control.phases import Phase
from gcs.control.tick import Event, TickArray, in_sequence
from gcs.drive.lockstep import START_NS, fly_lockstep, vehicles_of
from gcs.errors import InputError
from gcs.plan.design import Design
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.own_law import why_unknown
from gcs.runs.files import RunTail, read_ticks, write_experiment
from gcs.runs.grade import Truth, commands_of, commands_on_board, read_truth
from gcs.runs.record import END, EVENTS_FILE, TICKS_FILE, TRUTH_FILE, RunWriter
from gcs.station.station import Station
from scenarios.networks import networks_of
from sim_vehicles.links.truth import MemoryRecorder

_IDLE, _WAITING, _STEAL = 3, 4, 7
"""Indices in the cpu line of /proc/stat: idle, iowait (idle while a disk is busy), and steal (taken by the host)."""


@dataclass(frozen=True, eq=False)
class Flight:
    """A flight's log, in real or virtual time.

    `truth` is the vehicles' record of when states were sampled and set-points acted; in virtual time it is kept only on
    request. `steal_share` is the fraction of processor time taken by the host, `busy_share` the fraction in which
    processors were neither idle nor waiting for a disk; both are measured in real time only.
    """

    ticks: TickArray
    events: list[Event]
    truth: Truth | None = None
    steal_share: float | None = None
    busy_share: float | None = None


def fly_plan(
    plan: FlightPlan, folder: Path | None = None, *, real_time: bool = False, with_truth: bool = False
) -> Flight:
    """Fly a plan, in virtual time or in real time.

    If a folder is given, it is created and receives the run's files; in virtual time these do not include the summary.
    In real time the vehicles' truth is always recorded.
    """
    if real_time:
        return fly_real_time(plan, margins_of(plan), folder)
    station, recorder = Station(plan, start_ns=START_NS), MemoryRecorder() if with_truth else None
    writer = None
    if folder is not None:
        folder.mkdir(parents=True)
        write_experiment(folder, plan.scenario, margins_of(plan))
        writer = RunWriter(folder)
    rows: list[TickArray] = []
    vehicles = vehicles_of(plan.scenario, recorder=recorder)
    for ticks in fly_lockstep(plan, station=station, vehicles=vehicles, ahead=writer is None):
        rows.append(ticks)
        if writer is not None:
            writer.tick(ticks)
            writer.frames(station.frames)
    events = [*station.events, Event(time_s=float(rows[-1]["time_s"][-1]), kind=END, text=station.end_reason)]
    if writer is not None:
        writer.event(*events)
        writer.close()
    return Flight(in_sequence(rows), events, None if recorder is None else recorder.records)


def identified_in_flight(plan: FlightPlan) -> FlightPlan:
    """Identify the responses of simulated autopilots in virtual time; returns the plan with them in its margins.

    A plan whose responses are given, or whose vehicles respond at once, is returned unchanged. Raises InputError with
    the reason if the formation flight does not begin.
    """
    if plan.response_is_known:
        return plan
    station = Station(plan, start_ns=START_NS)
    for _ in fly_lockstep(plan, station=station):
        if station.phase is Phase.FLYING:
            return station.plan
    raise InputError(f"{plan.scenario.name}: {station.end_reason}")


def fly_real_time(plan: FlightPlan, design: Design, folder: Path | None) -> Flight:
    """Fly a plan in real time and leave the run in a folder, created if missing; without a folder it is deleted."""
    from gcs.drive.fly import fly  # processes and sockets, which flights in virtual time do not need
    from gcs.drive.udp import StationSocket

    kept = folder is not None
    folder = folder if folder is not None else Path(tempfile.mkdtemp(prefix="stress-"))
    folder.mkdir(parents=True, exist_ok=True)
    try:
        before = _processor_times()
        networks = networks_of(plan.formation.system_ids)
        with StationSocket("127.0.0.1", 0, networks=networks, together=plan.scenario.links.one_port) as link:
            summary = fly(plan, design, link, folder, show_table=False)
        needed = (TICKS_FILE, EVENTS_FILE, TRUTH_FILE)
        if lost := [text for text in summary.not_logged if text.startswith(needed)]:
            raise OSError(errno.ENOSPC, "; ".join(lost), str(folder))
        spent = _processor_times() - before
        shares = spent / max(1, spent.sum())
        return Flight(
            read_ticks(folder),
            RunTail(folder).events(),
            read_truth(folder / TRUTH_FILE),
            steal_share=float(shares[_STEAL]),
            busy_share=float(1.0 - shares[_IDLE] - shares[_WAITING]),
        )
    finally:
        if not kept:
            shutil.rmtree(folder, ignore_errors=True)


def _processor_times() -> IntArray:
    """Time of all processors together since boot, in jiffies: user, nice, system, idle, iowait, irq, softirq, steal."""
    line = Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0]
    return np.array(line.split()[1:9], dtype=np.int64)


def margins_of(plan: FlightPlan) -> Design:
    """The minimal design for a run's files: only the sampled margin. The campaign's report has the continuous one."""
    if why := why_unknown(plan):
        return Design(delay_margin_s=None, margin_unknown=why)
    return Design(delay_margin_s=plan.delay_margin_s, delay_margin_continuous_s=None)


def median_delays_s(ticks: TickArray, system_ids: tuple[int, ...]) -> dict[int, float]:
    """Median of each vehicle's measured loop delay; 0 for a vehicle that was never commanded."""
    return _medians(ticks, ticks["loop_delay_s"], system_ids)


def median_ages_s(ticks: TickArray, system_ids: tuple[int, ...]) -> dict[int, float]:
    """Median age of each vehicle's states at their first use, as the station estimates it; 0 if never commanded."""
    return _medians(ticks, ticks["telemetry_age_s"] - ticks["repeated_s"], system_ids)


def _medians(ticks: TickArray, values: FloatArray, system_ids: tuple[int, ...]) -> dict[int, float]:
    found: dict[int, float] = {}
    for system_id in system_ids:
        own = values[(ticks["system_id"] == system_id) & ticks["commanded"]]
        known = own[np.isfinite(own)]
        found[system_id] = float(np.median(known)) if known.size else 0.0
    return found


def effective_delays_s(
    plan: FlightPlan, rows: TickArray, flight: Flight, system_ids: tuple[int, ...]
) -> dict[int, float]:
    """For each vehicle, the constant loop delay equivalent to those of its commands in these rows."""
    truth = flight.truth
    assert truth is not None
    held_s = plan.timing.held_s

    def commands(system_id: int) -> IntArray:
        if plan.onboard is None:
            return commands_of(rows, truth, system_id)
        whole = flight.ticks[np.isin(flight.ticks["tick"], rows["tick"])]
        return commands_on_board(whole, truth, system_id)

    return {system_id: effective_delay_s(commands(system_id), held_s=held_s) for system_id in system_ids}


def first_uses(ticks: TickArray) -> TickArray:
    """The rows that use a state for the first time: all rows, unless telemetry is lost or slower than control."""
    _, first = np.unique(ticks[["system_id", "sample_boot_ms"]], return_index=True)
    return ticks[np.sort(first)]
