"""Datagrams as the station receives and sends them: one by one, or many together as arrays.

Many are kept as one array of bytes and a table that says where each begins and ends. An object `bytes` is made only of
a datagram that somebody reads.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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


Outgoing = tuple[bytes, Address]
"""One datagram to be sent, and to whom."""
Logged = tuple[bytes, int, Address]
"""A frame, when it was received or sent, and from or to whom."""


class Arrivals(NamedTuple):
    """Received datagrams.

    The rows of `table` (4, n) say of each where it begins and ends in `stream`, which of `addresses` it is from, and
    when it was received.
    """

    stream: NDArray[np.uint8]
    table: NDArray[np.int64]
    queued_ns: NDArray[np.int64]
    addresses: Sequence[Address]

    def datagram(self, place: int) -> Datagram:
        begin, end, sender, received_ns = self.table[:, place].tolist()
        data = self.stream[begin:end].tobytes()
        return Datagram(data, self.addresses[sender], received_ns, self.queued_ns.item(place))


def arrivals_of(datagrams: Sequence[Datagram]) -> Arrivals:
    """The same datagrams as arrays."""
    data, addresses, received_ns, queued_ns = zip(*datagrams, strict=True) if datagrams else ((), (), (), ())
    senders = {address: place for place, address in enumerate(dict.fromkeys(addresses))}
    ends = np.cumsum([0, *map(len, data)])
    table = np.array([ends[:-1], ends[1:], [senders[address] for address in addresses], received_ns], np.int64)
    stream = np.frombuffer(bytearray().join(data), np.uint8)
    return Arrivals(stream, table.reshape(4, -1), np.array(queued_ns, np.int64), [*senders])


class Frames:
    """Frames received, in order, until they are cleared."""

    def __init__(self) -> None:
        self._parts: list[Logged | Arrivals] = []

    def append(self, frame: Logged) -> None:
        self._parts.append(frame)

    def add(self, arrivals: Arrivals, first: int, stop: int) -> None:
        """Add the datagrams from the place `first` up to `stop`, each of one frame."""
        self._parts.append(arrivals._replace(table=arrivals.table[:, first:stop]))

    def clear(self) -> None:
        self._parts.clear()

    def __iter__(self) -> Iterator[Logged]:
        for part in self._parts:
            if not isinstance(part, Arrivals):
                yield part
                continue
            for begin, end, sender, received_ns in part.table.T.tolist():
                yield part.stream[begin:end].tobytes(), received_ns, part.addresses[sender]


@dataclass(slots=True)
class Block:
    """Frames to many vehicles: frame k is the first `sizes[k]` bytes of `frames[k]`, to the vehicle `rows[k]`.

    `to` holds the addresses of all vehicles.
    """

    frames: NDArray[np.uint8]
    sizes: NDArray[np.int64]
    rows: NDArray[np.int64]
    to: Sequence[Address | None]


class Outbox:
    """Datagrams to be sent, in order. Iterating over it gives (bytes, address) of each."""

    def __init__(self) -> None:
        self.parts: list[Outgoing | Block] = []
        self._count = 0

    def append(self, each: Outgoing) -> None:
        self.parts.append(each)
        self._count += 1

    def add(self, block: Block) -> None:
        self.parts.append(block)
        self._count += len(block.rows)

    def __iter__(self) -> Iterator[Outgoing]:
        for part in self.parts:
            if not isinstance(part, Block):
                yield part
                continue
            data, width = part.frames.tobytes(), part.frames.shape[1]
            for k, (row, size) in enumerate(zip(part.rows.tolist(), part.sizes.tolist(), strict=True)):
                address = part.to[row]
                assert address is not None
                yield data[k * width : k * width + size], address

    def __len__(self) -> int:
        return self._count
