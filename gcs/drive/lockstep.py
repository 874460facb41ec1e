"""Vehicles, links and station on one virtual clock in one process: the same code and bytes as in real time.

Deterministic: the same plan gives the same ticks to the last bit. Nothing waits, so a flight is as fast as its
computation. The station is called when something of its own is due. Datagrams that arrive before wait with their
receive stamps, as in a socket; the station decides nothing in between.
"""

from collections.abc import Iterator
from typing import Protocol

from gcs.control.phases import Phase
from gcs.control.tick import TickArray
from gcs.drive.guard import Guard
from gcs.link.datagram import Datagram
from gcs.plan.flight_plan import FlightPlan
from gcs.station.station import Station
from scenarios.signing.keys import Key
from scenarios.signing.stamps import Stamps
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.drive.guard import signed_links
from sim_vehicles.links.truth import DROPPED, LINK_DOWN, LINK_UP, Record, Row

START_NS = 1_000_000_000
"""Virtual time at which vehicles and station start; not zero, so that a forgotten time is noticed."""
EPOCH_NS = 1_800_000_000 * 1_000_000_000
"""Virtual time 0 of a signed flight, in ns since 1970."""
_HOST = "virtual"

Sent = list[tuple[int, bytes, int]]
"""Datagrams as (system id, bytes, time in ns)."""


class Vehicles(Protocol):
    """The vehicles behind their links: takes the station's datagrams, returns those that arrive at the station."""

    def step(self, received: Sent, now_ns: int) -> Sent: ...


class LinkLosses:
    """Counts all datagrams on the links and those lost, from the truth that `vehicles_of` records."""

    def __init__(self) -> None:
        self.entered = {LINK_UP: 0, LINK_DOWN: 0}
        self.lost = {LINK_UP: 0, LINK_DOWN: 0}

    def record(self, row: Row) -> None:
        kind = row[0]
        if kind in (LINK_UP, LINK_DOWN):
            self.entered[kind] += 1
            self.lost[kind] += len(row) == 8 and row[6] & DROPPED != 0

    @property
    def share_up(self) -> float:
        """Share of the datagrams from vehicles that were lost."""
        return self.lost[LINK_UP] / max(self.entered[LINK_UP], 1)

    @property
    def share_down(self) -> float:
        """Share of the datagrams to vehicles that were lost."""
        return self.lost[LINK_DOWN] / max(self.entered[LINK_DOWN], 1)


def vehicles_of(plan: FlightPlan, *, record: Record | None = None) -> Vehicles:
    """The simulated vehicles of a plan and their links, at the start; `record` takes the truth about them."""
    return Fleet(plan.scenario, START_NS, record=record)


def signed_ends(plan: FlightPlan, key: Key) -> tuple[Vehicles, Guard]:
    """The same vehicles and the guard of their station, with a common key and no memory of earlier flights."""
    links = signed_links(key, plan.formation.system_ids, epoch_ns=EPOCH_NS, stamps=Stamps())
    vehicles = Fleet(plan.scenario, START_NS, signed=links)
    return vehicles, Guard(key, epoch_ns=EPOCH_NS, stamps=Stamps())


def fly_lockstep(
    plan: FlightPlan, *, station: Station | None = None, vehicles: Vehicles | None = None, guard: Guard | None = None
) -> Iterator[TickArray]:
    """Fly a plan in virtual time; yields the rows (a fresh copy) of each control tick.

    Pass a station to read its events and end reason afterwards, vehicles to go on from an earlier flight, a guard to
    sign and verify at the station's end. The address of a vehicle is (a fixed name, its system id).
    """
    station = station or Station(plan, start_ns=START_NS)
    vehicles = vehicles or vehicles_of(plan)
    addresses = {system_id: (_HOST, system_id) for system_id in plan.formation.system_ids}
    to_vehicles: Sent = []
    while station.phase is not Phase.ENDED:
        now_ns = station.next_event_ns
        arrived = vehicles.step(to_vehicles, now_ns)
        datagrams = [Datagram(data, addresses[system_id], time_ns) for system_id, data, time_ns in arrived]
        if guard is not None:
            datagrams = guard.received(datagrams, now_ns, station.counters, station.is_another)
        outgoing, tick = station.step(datagrams, now_ns)
        if guard is not None:
            outgoing = guard.sent(outgoing, now_ns)
        to_vehicles = [(system_id, data, now_ns) for data, (_, system_id) in outgoing]
        if tick is not None:
            yield station.complete(tick, now_ns)
            station.frames.clear()
