"""The links of a scenario in front of other programs' vehicles, as one function of datagrams and time.

A vehicle is identified by the system id in its first frame; only headers are read. It gets the same links, random
streams and truth log that it would have in a Fleet.
"""

import heapq
from collections import Counter
from collections.abc import Iterable
from operator import itemgetter
from typing import NamedTuple

from scenarios import schema
from scenarios.networks import MOST_IN_NETWORK
from sim_vehicles.links.links import LinkSet
from sim_vehicles.links.truth import LINK_DOWN, LINK_UP, Recorder
from sim_vehicles.services.clock import NEVER_NS
from sim_vehicles.services.frames import AUTOPILOT
from sim_vehicles.services.mavlink import MAGIC_1, MAGIC_2

SETUP_SIGNING = (256).to_bytes(3, "little")


class InTransit(NamedTuple):
    """A datagram on its way through the links, up to the station or down to the vehicle. Sorts by time."""

    time_ns: int
    kind: int
    """LINK_UP or LINK_DOWN."""
    system_id: int
    data: bytes


def sender(data: bytes) -> int | None:
    """System id of a datagram's first frame, MAVLink 1 or 2; None if it is not a vehicle's (1 to 250).

    A camera or companion with a vehicle's system id is not the vehicle.
    """
    if len(data) >= 12 and data[0] == MAGIC_2:
        system_id, component_id = data[5:7]
    elif len(data) >= 8 and data[0] == MAGIC_1:
        system_id, component_id = data[3:5]
    else:
        return None
    return system_id if 1 <= system_id <= MOST_IN_NETWORK and component_id == AUTOPILOT else None


def holds_key(data: bytes) -> bool:
    """Whether a SETUP_SIGNING frame, which is never passed on, may begin anywhere: receivers skip stray bytes."""
    at = data.find(SETUP_SIGNING, 7)
    while at >= 0 and data[at - 7] != MAGIC_2:
        at = data.find(SETUP_SIGNING, at + 1)
    return at >= 0


class Relay:
    """The links of a scenario between a station and any vehicles; `next_event_ns` says when to call `step` next."""

    def __init__(self, scenario: schema.Scenario, start_ns: int, *, recorder: Recorder | None = None) -> None:
        self.last_heard_ns = start_ns
        """When the station was last heard; the start if never."""
        self._recorder = recorder
        most = max(MOST_IN_NETWORK, len(scenario.vehicles))
        self._links = LinkSet(scenario, start_ns, recorder=recorder, most=most)
        self._entering: list[InTransit] = []
        """Datagrams stamped later than the last step: an earlier one may still be unread."""

    @property
    def counters(self) -> Counter[str]:
        return self._links.counters()

    @property
    def next_event_ns(self) -> int:
        """Before this time `step` returns nothing, unless datagrams arrive."""
        due_ns = self._links.next_due_ns
        return min(due_ns, self._entering[0].time_ns) if self._entering else due_ns

    def step(self, received: Iterable[InTransit], now_ns: int) -> list[InTransit]:
        """The datagrams that leave the links by now, with their exact times, in order of time."""
        entering = self._entering
        for passing in received:
            heapq.heappush(entering, passing)
        while entering and entering[0].time_ns <= now_ns:
            time_ns, kind, system_id, data = heapq.heappop(entering)
            if kind == LINK_DOWN:
                self.last_heard_ns = max(self.last_heard_ns, time_ns)
                if self._links.zero_ns == NEVER_NS:
                    self._links.hear(data, time_ns)
            up, down = self._links.of(system_id)
            (up if kind == LINK_UP else down).send(data, time_ns)
        out: list[InTransit] = []
        for link in self._links.due(now_ns):
            for entry in link.due(now_ns):
                out.append(InTransit(entry[0], link.kind, link.system_id, entry[3]))
                if self._recorder is not None:
                    self._recorder.add(link.row(entry, now_ns))
        out.sort(key=itemgetter(0, 1, 2))
        return out
