"""Datagrams as the station receives and sends them."""

from typing import NamedTuple

Address = tuple[str, int, int]
"""Host and port, and the network: the number of the station's socket that this address sends to."""


class Datagram(NamedTuple):
    """One received datagram."""

    data: bytes
    address: Address
    received_ns: int
    """The kernel's stamp, on the station's clock."""
    queued_ns: int = 0
    """Time it waited in the socket buffer before the station read it."""


Arrival = tuple[bytes, Address, int, int]
"""A `Datagram`, or a plain tuple of the same, which takes a fifth of the time to make."""
Outgoing = tuple[bytes, Address]
"""One datagram to be sent, and to whom."""
Logged = tuple[bytes, int, Address]
"""A frame, when it was received or sent, and from or to whom."""
