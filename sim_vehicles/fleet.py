"""All vehicles of a scenario with their links, as one function of datagrams and time.

Both the driver on real UDP and one on a virtual clock call `Fleet.step`; the same seed, start and datagrams give the
same bytes at the same instants.
"""

import heapq
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from operator import itemgetter

from scenarios import schema
from sim_vehicles.dynamics import State
from sim_vehicles.links import NEVER_NS, Link
from sim_vehicles.mavlink import message_id
from sim_vehicles.truth import LINK_DOWN, LINK_UP, Record
from sim_vehicles.vehicle import Change, Vehicle

Datagram = tuple[int, bytes, int]
"""(system id of the vehicle, bytes, host time in ns)"""

_DUE_THEN_SYSTEM_ID = itemgetter(2, 0)


@dataclass(slots=True)
class _Member:
    vehicle: Vehicle
    up: Link
    down: Link
    leaves_ns: int = NEVER_NS
    """The earliest instant at which a datagram of this vehicle can leave its up link."""


class Fleet:
    """The vehicles and links of a scenario.

    Vehicles do not meet each other here, so each is brought up to date only when a datagram of its own can leave,
    in order of that time and of system id; nothing is late for it, since everything it does has its exact instant.
    """

    def __init__(self, scenario: schema.Scenario, start_ns: int, *, record: Record | None = None) -> None:
        self._record = record
        self._members: dict[int, _Member] = {}
        self._heap: list[tuple[int, int]] = []
        """(leaves_ns, system id); entries that no longer agree with the member are stale and skipped."""
        for own in sorted(scenario.vehicles, key=lambda vehicle: vehicle.system_id):
            up, down = scenario.link_of(own.system_id)
            member = _Member(Vehicle(scenario, own, start_ns, record=record), Link(up), Link(down))
            self._members[own.system_id] = member
            self._plan(member)

    @property
    def system_ids(self) -> tuple[int, ...]:
        """The vehicles, ascending."""
        return tuple(self._members)

    @property
    def next_event_ns(self) -> int:
        """Before this instant `step` returns nothing, unless datagrams come in."""
        heap = self._heap
        while heap and self._members[heap[0][1]].leaves_ns != heap[0][0]:
            heapq.heappop(heap)
        return heap[0][0] if heap else NEVER_NS

    @property
    def last_heard_ns(self) -> int:
        """When a vehicle last heard a valid frame meant for it; the start if never."""
        return max(member.vehicle.last_heard_ns for member in self._members.values())

    @property
    def counters(self) -> Counter[str]:
        """The vehicles' counters added up, with the links' `link_up_dropped` and `link_down_dropped`."""
        total: Counter[str] = Counter()
        for member in self._members.values():
            total.update(member.vehicle.counters)
            total["link_up_dropped"] += member.up.dropped
            total["link_down_dropped"] += member.down.dropped
        return total

    def vehicle(self, system_id: int) -> Vehicle:
        """One vehicle, as of the last time it was brought up to date; `state` is exact at any time."""
        return self._members[system_id].vehicle

    def take_changes(self) -> list[Change]:
        """What happened to the vehicles since the last call, in order of time."""
        changes: list[Change] = []
        for member in self._members.values():
            if member.vehicle.changes:
                changes += member.vehicle.changes
                member.vehicle.changes.clear()
        return sorted(changes)

    def step(self, received: Iterable[Datagram], now_ns: int) -> list[Datagram]:
        """What leaves the up links by now, with the exact instants at which it does, in order of time.

        Parameters
        ----------
        received
            Datagrams of the station with the instants at which each enters its vehicle's down link.
        """
        for system_id, data, time_ns in received:
            member = self._members[system_id]
            member.down.send(data, time_ns)
            if member.down.next_due_ns + member.up.least_delay_ns < member.leaves_ns:
                self._plan(member)
        out: list[Datagram] = []
        heap = self._heap
        while heap and heap[0][0] <= now_ns:
            leaves_ns, system_id = heapq.heappop(heap)
            member = self._members[system_id]
            if leaves_ns != member.leaves_ns:
                continue
            self._live(member, now_ns)
            for data, due_ns, entered_ns in member.up.due_entered(now_ns):
                out.append((system_id, data, due_ns))
                if self._record is not None:
                    self._record((LINK_UP, system_id, message_id(data), now_ns, entered_ns, due_ns))
            self._plan(member)
        out.sort(key=_DUE_THEN_SYSTEM_ID)
        return out

    def state(self, system_id: int, now_ns: int) -> State:
        """The true state of a vehicle now, everything that has reached it by now included."""
        member = self._members[system_id]
        self._live(member, now_ns)
        self._plan(member)
        return member.vehicle.state_at(now_ns)

    def _live(self, member: _Member, now_ns: int) -> None:
        """Bring a vehicle up to now; what it sends enters its up link."""
        arrived: list[tuple[bytes, int]] = []
        if member.down.next_due_ns <= now_ns:
            for data, due_ns, entered_ns in member.down.due_entered(now_ns):
                arrived.append((data, due_ns))
                if self._record is not None:
                    key = message_id(data)
                    self._record((LINK_DOWN, member.vehicle.system_id, key, due_ns, entered_ns, due_ns))
        for data, time_ns in member.vehicle.step(arrived, now_ns):
            member.up.send(data, time_ns)

    def _plan(self, member: _Member) -> None:
        """Note when a datagram of the vehicle can leave next. Comparisons, not min(): every datagram comes by here."""
        acts_ns, arrives_ns = member.vehicle.next_event_ns, member.down.next_due_ns
        leaves_ns = (arrives_ns if arrives_ns < acts_ns else acts_ns) + member.up.least_delay_ns
        leaves_ns = min(leaves_ns, member.up.next_due_ns)
        if leaves_ns != member.leaves_ns:
            member.leaves_ns = leaves_ns
            heapq.heappush(self._heap, (leaves_ns, member.vehicle.system_id))
