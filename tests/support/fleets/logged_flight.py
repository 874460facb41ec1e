"""A flight in virtual time that leaves its telemetry log, as the station writes it in real time."""

import struct
from pathlib import Path

import numpy as np

from gcs.control.tick import Event, TickArray
from gcs.drive.lockstep import START_NS, Sent, Vehicles, fly_lockstep, vehicles_of
from gcs.plan.design import Design
from gcs.plan.planner import flight_plan, over_own_links
from gcs.runs.summary import summarise
from gcs.runs.summary_record import Summary
from gcs.station.station import Station
from scenarios.schema import Scenario

EPOCH_NS = 1_750_000_000_000_000_000
"""When virtual time began, in ns since 1970."""


class Logged:
    """Vehicles whose datagrams, and those sent to them, are logged on the way."""

    def __init__(self, vehicles: Vehicles) -> None:
        self.vehicles = vehicles
        self.entries: list[tuple[int, bytes]] = []
        """Time in ns since 1970, and frame."""

    def step(self, received: Sent, now_ns: int) -> Sent:
        self.entries += [(EPOCH_NS + time_ns, data) for _, data, time_ns in received]
        arrived = self.vehicles.step(received, now_ns)
        self.entries += [(EPOCH_NS + time_ns, data) for _, data, time_ns in arrived]
        return arrived


def log_bytes(entries: list[tuple[int, bytes]]) -> bytes:
    return b"".join(struct.pack(">Q", time_ns // 1000) + data for time_ns, data in entries)


def flown(scenario: Scenario) -> tuple[Design, Summary, TickArray, list[tuple[int, bytes]]]:
    """The design, the summary and the ticks of a flight, and the entries of its log."""
    design, plan = over_own_links(*flight_plan(scenario))
    station, vehicles = Station(plan, start_ns=START_NS), Logged(vehicles_of(plan.scenario))
    ticks = np.concatenate(list(fly_lockstep(plan, station=station, vehicles=vehicles)))
    events = [*station.events, Event(time_s=0.0, kind="end", text=station.end_reason)]
    return design, summarise(scenario, design, ticks, events), ticks, vehicles.entries


def write_log(file: Path, entries: list[tuple[int, bytes]]) -> Path:
    file.write_bytes(log_bytes(entries))
    return file
