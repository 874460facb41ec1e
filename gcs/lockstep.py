"""Vehicles, links and station on one virtual clock in one process: the same code and bytes as in real time.

Deterministic: the same plan gives the same ticks to the last bit. Nothing waits, so it runs as fast as it computes.
"""

from collections.abc import Iterator

from gcs.modes import Phase
from gcs.record import TickArray
from gcs.station import Datagram, FlightPlan, Station
from sim_vehicles.fleet import Fleet

START_NS = 1_000_000_000
"""Virtual time of the first tick; not zero, so that a forgotten time shows."""
_HOST = "virtual"


def fly_lockstep(plan: FlightPlan, station: Station | None = None) -> Iterator[TickArray]:
    """Fly a plan in virtual time, giving each control tick's rows (a fresh copy) as it is done.

    The address of a vehicle is (`_HOST`, its system id). A station may be passed in so that its events and end reason
    can be read afterwards; it must start at START_NS.
    """
    station = station or Station(plan, start_ns=START_NS)
    fleet = Fleet(plan.scenario, START_NS)
    to_vehicles: list[tuple[int, bytes, int]] = []
    now_ns = START_NS
    while station.phase is not Phase.ENDED:
        arrived = fleet.step(to_vehicles, now_ns)
        datagrams = [Datagram(data, (_HOST, system_id), time_ns) for system_id, data, time_ns in arrived]
        outgoing, rows = station.step(datagrams, now_ns)
        to_vehicles = [(port, data, now_ns) for data, (_, port) in outgoing]
        if rows is not None:
            station.complete(rows, now_ns)
            yield rows.copy()
            station.frames.clear()
        if not to_vehicles:
            now_ns = max(now_ns, min(fleet.next_event_ns, station.next_event_ns))
