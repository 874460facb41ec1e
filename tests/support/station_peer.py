"""A vehicle played by pymavlink, for the tests of what the station says to it."""

from collections.abc import Iterable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.link.datagram import NETWORK_BIT, Address, Datagram, Outgoing
from scenarios.sockets import number_of


def address_at(host: str, port: int, network: int = 0) -> Address:
    return network << NETWORK_BIT | number_of((host, port))


HOME = address_at("127.0.0.1", 5001)


class Peer:
    """One vehicle played by pymavlink: the datagrams that it sends."""

    def __init__(self, system_id: int, address: Address = HOME, *, component: int = 1) -> None:
        self.link: Any = dialect.MAVLink(None, srcSystem=system_id, srcComponent=component)
        self.address = address

    def datagram(self, message: Any, time_ns: int) -> Datagram:
        data = bytes(message.pack(self.link))
        self.link.seq = (self.link.seq + 1) % 256  # pymavlink counts only what it sends itself
        return Datagram(data, self.address, time_ns)

    def heartbeat(self, time_ns: int, *, base_mode: int = 1, custom_mode: int = 0, status: int = 3) -> Datagram:
        return self.datagram(self.link.heartbeat_encode(2, 3, base_mode, custom_mode, status), time_ns)


def messages(outgoing: Iterable[Outgoing], kind: str, to: Address = HOME) -> list[Any]:
    """The messages of one kind sent to an address, as pymavlink reads them."""
    parser: Any = dialect.MAVLink(None)
    read = [parser.parse_char(data) for data, address in outgoing if address == to]
    return [message for message in read if message.get_type() == kind]
