"""Datagrams as the station takes them in and sends them."""

from typing import NamedTuple

Address = tuple[str, int]


class Datagram(NamedTuple):
    """One received datagram."""

    data: bytes
    address: Address
    received_ns: int
    """The kernel's stamp, on the station's clock."""
    queued_ns: int = 0
    """How long it waited in the socket after that for the station to be free."""


class Outgoing(NamedTuple):
    data: bytes
    address: Address
