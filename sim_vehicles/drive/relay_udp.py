"""A `Relay` on real UDP: other programs' vehicles send to our ports; the station hears each from a port of its own.

A vehicle's datagrams go through its up link to the station, from a socket of that vehicle's own. The station's answers
to that socket go through the down link to the address from which the vehicle last sent.
"""

from scenarios.schema import NS_PER_S
from scenarios.sockets import Received
from sim_vehicles.drive.udp import Sockets
from sim_vehicles.links.relay import InTransit, holds_key, sender
from sim_vehicles.links.truth import LINK_DOWN, LINK_UP
from sim_vehicles.vehicles.shell import Change

MOST_PEERS = 1000
"""Maximum number of addresses from which vehicles are accepted; a restarted vehicle may have a new one."""
SILENCE_NS = 3 * NS_PER_S // 2
"""A vehicle silent for this long may have been restarted, and may send from another address."""


class Peers:
    """The vehicles' addresses and the sockets on both sides. Raises OSError if a vehicle port cannot be bound."""

    def __init__(
        self, vehicle_ports: list[tuple[str, int]], station: tuple[str, int], *, silence_ns: int = SILENCE_NS
    ) -> None:
        self.sockets = Sockets()
        self._changes: list[Change] = []
        self._station = station
        self._silence_ns = silence_ns
        self._station_side: dict[int, int] = {}
        """System id to the file descriptor of the socket that the station hears it from."""
        self._system_ids: dict[int, int] = {}
        """The inverse of `_station_side`."""
        self._peers: dict[tuple[int, tuple[str, int]], int] = {}
        """(File descriptor of our port, the vehicle's address) to system id."""
        self._addresses: dict[int, tuple[int, tuple[str, int]]] = {}
        """System id to the port and address of the vehicle's last datagram."""
        self._heard_ns: dict[int, int] = {}
        """System id to the time of that datagram."""
        try:
            for address in vehicle_ports:
                self.sockets.add(bind=address)
            self.sockets.add(connect=station)  # a bad station address fails here, not with the first vehicle
        except OSError:
            self.sockets.close()
            raise

    def receive(self) -> list[InTransit]:
        """Everything that has arrived, from either side."""
        received: list[InTransit] = []
        for datagram in self.sockets.receive():
            if holds_key(datagram.data):
                self.sockets.counters["refused_setup_signing"] += 1
                continue
            system_id = self._system_ids.get(datagram.descriptor)
            if system_id is not None:
                received.append(InTransit(datagram.time_ns, LINK_DOWN, system_id, datagram.data))
            elif (system_id := self._vehicle(datagram)) is not None:
                received.append(InTransit(datagram.time_ns, LINK_UP, system_id, datagram.data))
        return received

    def send(self, passing: list[InTransit]) -> None:
        sent: list[tuple[bytes, int, int, tuple[str, int] | None]] = []
        for due_ns, kind, system_id, data in passing:
            up = kind == LINK_UP
            descriptor, address = (self._station_side[system_id], None) if up else self._addresses[system_id]
            sent.append((data, descriptor, due_ns, address))
        self.sockets.send_each(sent)

    def take_changes(self) -> list[Change]:
        """The vehicles found since the last call."""
        changes, self._changes = self._changes, []
        return changes

    def _vehicle(self, datagram: Received) -> int | None:
        """The vehicle that sent a datagram to one of our ports, or None if that is unknown or refused."""
        place = datagram.descriptor, datagram.address
        system_id = self._peers.get(place) or sender(datagram.data)
        if system_id is None:
            self.sockets.counters["refused_peer"] += 1
            return None
        known = self._addresses.get(system_id, place)
        if known != place and datagram.time_ns - self._heard_ns[system_id] < self._silence_ns:
            self.sockets.counters["refused_second_source"] += 1
            return None
        if place not in self._peers:
            if len(self._peers) >= MOST_PEERS or not self._admit(system_id):
                self.sockets.counters["refused_peer"] += 1
                return None
            self._peers[place] = system_id
            text = f"found at {datagram.address[0]}:{datagram.address[1]}"
            self._changes.append(Change(datagram.time_ns, system_id, text))
        self._addresses[system_id], self._heard_ns[system_id] = place, datagram.time_ns
        return system_id

    def _admit(self, system_id: int) -> bool:
        if system_id not in self._station_side:
            try:
                number = self.sockets.add(connect=self._station)
            except OSError:
                self.sockets.counters["send_failed"] += 1
                return False
            self._station_side[system_id] = number
            self._system_ids[number] = system_id
        return True
