"""Vehicles, links and station on one virtual clock in one process, running the same code and bytes as in real time.

The same plan gives the same ticks to the last bit. Nothing sleeps, so a flight takes only its computing time. The
station is called when one of its own events is due. Datagrams that arrive earlier wait with their receive stamps, as in
a socket buffer, because the station decides nothing between its events.
"""

import gc
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Protocol

import numpy as np

from gcs.control.phases import Phase
from gcs.control.tick import TickArray
from gcs.drive.fast_path import FastPath
from gcs.drive.guard import Guard
from gcs.drive.udp_fast_path import UdpFastPath, no_wire
from gcs.link import datagram
from gcs.link.datagram import NETWORK_BIT, NUMBER_BITS, Address, Arrivals, Logged, Outbox
from gcs.plan.flight_plan import FlightPlan
from gcs.runs.record import tlog_entries
from gcs.station.station import Station
from scenarios.kernel import Records
from scenarios.keys.link import Links
from scenarios.networks import network_of
from scenarios.schema import Scenario
from scenarios.signing.keys import Key
from scenarios.signing.stamps import Stamps
from sim_vehicles.drive.datagrams import Datagram, Datagrams
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.drive.guard import signed_links
from sim_vehicles.links.truth import LINK_UP, Recorder, TruthLog

START_NS = 1_000_000_000
"""Virtual time at which vehicles and station start. It is not zero, to expose times that were never set."""
EPOCH_NS = 1_800_000_000 * 1_000_000_000
"""Virtual time 0 of a signed flight, in ns since 1970."""
_FLIGHTS_A_COLLECTION = 100
"""Flights between garbage collections. Freezing postpones them, in campaigns of short flights indefinitely."""
_flights = count(1)
_TICKS_TO_PREPARE, _STEPS_TO_PREPARE = 10, 20

Sent = Datagrams | list[Datagram]
"""Datagrams from or to vehicles, as arrays or as a list. Iterating over either gives (system id, bytes, time in ns)."""


class Vehicles(Protocol):
    """The vehicles and their links: `step` takes the station's datagrams and returns those that reach the station."""

    def step(self, received: Sent, now_ns: int) -> Sent: ...


def vehicles_of(scenario: Scenario, *, recorder: Recorder | None = None) -> Fleet:
    """The simulated vehicles of a scenario and their links, in their initial state."""
    return Fleet(scenario, START_NS, recorder=recorder)


class RecordedVehicles:
    """The simulated vehicles of a plan, logged as in real time: records their truth and the frames sent to them."""

    def __init__(self, plan: FlightPlan, truth_file: Path) -> None:
        self._log, self._truth = TruthLog(truth_file), Recorder(self._write)
        self._vehicles = vehicles_of(plan.scenario, recorder=self._truth)
        self._sent: list[Logged] = []

    def step(self, received: Sent, now_ns: int) -> Sent:
        self._sent += [(data, time_ns, virtual_address(key)) for key, data, time_ns in received]
        return self._vehicles.step(received, now_ns)

    def take_sent(self) -> list[Logged]:
        """The frames that the station sent since the last call."""
        sent, self._sent = self._sent, []
        return sent

    def close(self) -> None:
        self._truth.flush()
        self._log.close()

    def _write(self, records: Records) -> None:
        up = records["kind"] == LINK_UP
        records["time_ns"][up] = records["due_ns"][up]  # a datagram leaves when it is due, although computed later
        self._log.write(records)


def signed_ends(plan: FlightPlan, key: Key) -> tuple[Vehicles, Guard]:
    """Signing vehicles and the guard of their station, with one key and no timestamps from earlier flights."""
    links = signed_links(key, plan.formation.system_ids, epoch_ns=EPOCH_NS, stamps=Stamps())
    vehicles = Fleet(plan.scenario, START_NS, signed=links)
    return vehicles, Guard(key, epoch_ns=EPOCH_NS, stamps=Stamps())


@dataclass
class _Joining:
    """Vehicles that each pack all frames of a step into one datagram, as real vehicles may."""

    vehicles: Vehicles

    def step(self, received: Sent, now_ns: int) -> Sent:
        joined: dict[int, tuple[int, bytes, int]] = {}
        for system_id, data, time_ns in self.vehicles.step(received, now_ns):
            joined[system_id] = system_id, joined.get(system_id, (0, b"", 0))[1] + data, time_ns
        return [*joined.values()]


def prepare(plan: FlightPlan) -> None:
    """Compile all kernels before a flight in real time, by flying the beginning of the plan with plain vehicles."""
    plain = {"dynamics": "double_integrator", "links": Links(), "response": None}
    scenario = plan.scenario.model_copy(update=plain).with_keys(control={"execute_at": False})
    station = Station(replace(plan, scenario=scenario, law=None, responses=None), start_ns=START_NS)
    flown, vehicles = 0, _Joining(vehicles_of(scenario))
    for _ in fly_lockstep(station.plan, station=station, vehicles=vehicles):
        tlog_entries(station.frames)
        flown += station.phase is Phase.FLYING
        if flown == _TICKS_TO_PREPARE:
            break
    for _ in range(_STEPS_TO_PREPARE):
        outbox, _ = station.step([], station.next_event_ns)
        station.sent(outbox, np.zeros(len(outbox), np.int64))
    if station.has_fast_path:
        UdpFastPath(station, no_wire(), lambda _network, _entries: None).step()
    station.vehicles[0].frames.restart()  # as after a long silence
    station.vehicles[0].send_timesync(0, 0, Outbox())  # as in answer to a datagram of several frames
    station.vehicles[0].delivery_ns(0, 0)  # as when it reports how long it holds set-points


def fly_lockstep(
    plan: FlightPlan,
    *,
    station: Station | None = None,
    vehicles: Vehicles | None = None,
    guard: Guard | None = None,
    ahead: bool = False,
) -> Iterator[TickArray]:
    """Fly a plan in virtual time; yields the rows (a fresh copy) of each control tick.

    `ahead` is faster: the rows of several ticks may be yielded together, and the station may be ahead of them. It suits
    callers that only collect rows.

    Pass a station to read its events and end reason afterwards, vehicles to continue an earlier flight, and a guard to
    sign and verify at the station's end.
    """
    station = station or Station(plan, start_ns=START_NS)
    vehicles = vehicles or vehicles_of(plan.scenario)
    gc.freeze()  # exempts all existing objects from garbage collection
    try:
        yield from _ticks(plan, station, vehicles, guard, ahead)
    finally:
        gc.unfreeze()
        if next(_flights) % _FLIGHTS_A_COLLECTION == 0:
            gc.collect()


def virtual_address(system_id: int) -> Address:
    """The address of a vehicle in virtual time: its network, and its system id."""
    return network_of(system_id) << NETWORK_BIT | system_id


class _Bridge:
    """Converts datagrams between a station and vehicles, whose rows in the fleet are in order of system id."""

    def __init__(self, system_ids: Sequence[int]) -> None:
        self._ids = sorted(system_ids)
        self.addresses = np.array([*map(virtual_address, self._ids)])
        self.rows = np.array([self._ids.index(key) for key in system_ids])
        """The row in the fleet of each of the station's vehicles."""

    def arrivals(self, sent: Datagrams) -> Arrivals:
        begins, ends, rows, times_ns = sent.table
        table = np.array([begins, ends, self.addresses[rows], times_ns])
        return Arrivals(sent.stream, table, np.zeros(len(sent), np.int64))

    def one_by_one(self, sent: Sent) -> list[datagram.Datagram]:
        return [datagram.Datagram(data, virtual_address(key), time_ns) for key, data, time_ns in sent]

    def to_vehicles(self, outgoing: Outbox, now_ns: int) -> Datagrams:
        stream, table = outgoing.packed()
        table[2], table[3] = self.addresses.searchsorted(table[2]), now_ns
        return Datagrams(stream, table, self._ids)


def _ticks(
    plan: FlightPlan, station: Station, vehicles: Vehicles, guard: Guard | None, ahead: bool
) -> Iterator[TickArray]:
    bridge = _Bridge(plan.formation.system_ids)
    to_vehicles: Sent = bridge.to_vehicles(Outbox(), START_NS)
    plain = guard is None and station.has_fast_path
    fleet = vehicles if plain and isinstance(vehicles, Fleet) and vehicles.has_fast_path else None
    fast = None if fleet is None else FastPath(station, fleet, bridge.addresses, bridge.rows, ahead=ahead)
    while station.phase is not Phase.ENDED:
        # `Fleet.step` looks for the first set-point, at which link time begins; none is sent while CONNECTING
        is_fast = fleet is not None and (fleet.knows_link_time or station.phase is Phase.CONNECTING)
        if fast is not None and is_fast and isinstance(to_vehicles, Datagrams):
            now_ns, arrived, taken = yield from fast.fly(to_vehicles)
        else:
            now_ns, taken = station.next_event_ns, 0
            arrived = vehicles.step(to_vehicles, now_ns)
        if guard is not None:
            datagrams = guard.received(bridge.one_by_one(arrived), now_ns, station.counters, station.is_another)
            outgoing, tick = station.step(datagrams, now_ns)
            to_vehicles = [(address & NUMBER_BITS, data, now_ns) for data, address in guard.sent(outgoing, now_ns)]
        else:
            arrivals = bridge.arrivals(arrived) if isinstance(arrived, Datagrams) else bridge.one_by_one(arrived)
            outgoing, tick = station.step(arrivals, now_ns, taken)
            to_vehicles = bridge.to_vehicles(outgoing, now_ns)
        if tick is not None:
            yield station.complete(tick, np.full(len(outgoing), now_ns))
            station.frames.clear()
