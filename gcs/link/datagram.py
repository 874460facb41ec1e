"""Datagrams as the station receives and sends them."""

from typing import NamedTuple

Address = tuple[str, int]


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
