"""Datagrams as the station receives and sends them: one at a time, or in batches as arrays.

A batch is one array of bytes and a table of where each datagram begins and ends. A `bytes` object is made only for a
datagram that is read individually.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scenarios.kernel import Array, kernel
from scenarios.sockets import Bytes, Ints, joined

Address = int
"""A host and a port (`scenarios.sockets.number_of`) and, in the bits above, the network: the number of the station's
socket that sends to the address. 0 is none."""
NETWORK_BIT, NUMBER_BITS = 48, (1 << 48) - 1
"""First bit of the network in an address, and the mask of the bits below it, which hold `number_of` host and port."""


def network_at(address: Address) -> int:
    """The network of an address."""
    return address >> NETWORK_BIT


class Datagram(NamedTuple):
    """One received datagram."""

    data: bytes
    address: Address
    received_ns: int
    """The operating system's receive timestamp, on the station's clock."""
    queued_ns: int = 0
    """Time it waited in the socket buffer before the station read it."""


Outgoing = tuple[bytes, Address]
"""One datagram to be sent, and its destination."""
Logged = tuple[bytes, int, Address]
"""A frame, its receive or send time in ns, and its source or destination."""


@dataclass(slots=True)
class Arrivals:
    """A batch of received or sent datagrams; iterating over it yields `Datagram` objects.

    The rows of `table` (4, n): where each begins and ends in `stream`, the address of its source or destination, and
    its receive or send time.
    """

    stream: Bytes
    table: Ints
    queued_ns: Ints

    def datagram(self, place: int) -> Datagram:
        begin, end, address, received_ns = self.table[:, place].tolist()
        return Datagram(self.stream[begin:end].tobytes(), address, received_ns, self.queued_ns.item(place))

    def __len__(self) -> int:
        return self.table.shape[1]

    def __iter__(self) -> Iterator[Datagram]:
        return map(self.datagram, range(len(self)))


def arrivals_of(datagrams: Sequence[Datagram]) -> Arrivals:
    """The batch that holds these datagrams."""
    data, addresses, received_ns, queued_ns = zip(*datagrams, strict=True) if datagrams else ((), (), (), ())
    stream, ends = joined(data)
    table = np.array([ends[:-1], ends[1:], addresses, received_ns], np.int64)
    return Arrivals(stream, table.reshape(4, -1), np.array(queued_ns, np.int64))


class Frames:
    """A log buffer of frames received or sent, in order."""

    def __init__(self, frames: Iterable[Logged] = ()) -> None:
        self.parts: list[Logged | Arrivals] = [*frames]

    def append(self, frame: Logged) -> None:
        self.parts.append(frame)

    def add(self, arrivals: Arrivals, first: int = 0, stop: int | None = None) -> None:
        """Add the datagrams from index `first` up to `stop`; each must hold one frame."""
        table = arrivals.table[:, first:stop]
        if table.shape[1]:
            self.parts.append(Arrivals(arrivals.stream, table, arrivals.queued_ns))

    def take(self, other: "Frames") -> None:
        """Move all frames of another buffer into this one."""
        self.parts += other.parts
        other.clear()

    def clear(self) -> None:
        self.parts.clear()

    def __iter__(self) -> Iterator[Logged]:
        for part in self.parts:
            if not isinstance(part, Arrivals):
                yield part
                continue
            for begin, end, address, received_ns in part.table.T.tolist():
                yield part.stream[begin:end].tobytes(), received_ns, address


@dataclass(slots=True)
class Block:
    """Frames to many vehicles: frame k is the first `sizes[k]` bytes of `frames[k]` and goes to the vehicle `rows[k]`.

    `to` holds the addresses of all vehicles.
    """

    frames: Bytes
    sizes: Ints
    rows: Ints
    to: Ints


class Outbox:
    """Queue of datagrams to be sent. Iterating over it yields (bytes, address) of each."""

    def __init__(self, parts: Sequence[Outgoing] = ()) -> None:
        self.parts: list[Outgoing | Block] = [*parts]
        self._count = len(parts)

    def append(self, each: Outgoing) -> None:
        self.parts.append(each)
        self._count += 1

    def add(self, block: Block) -> None:
        self.parts.append(block)
        self._count += len(block.rows)

    def packed(self) -> tuple[Bytes, Ints]:
        """Its datagrams as the stream and the table of `Arrivals`, with times 0 because they are not yet sent."""
        table, streams = np.zeros((4, len(self)), np.int64), [np.empty(0, np.uint8)]
        place = begin = 0
        for part in self.parts:
            if isinstance(part, Block):
                _enter(table, place, begin, part.frames.shape[1], part.sizes, part.rows, part.to)
                place += len(part.rows)
                streams.append(part.frames.ravel())
            else:
                data, address = part
                table[:3, place] = begin, begin + len(data), address
                place += 1
                streams.append(np.frombuffer(data, np.uint8))
            begin += len(streams[-1])
        return np.concatenate(streams), table

    def __iter__(self) -> Iterator[Outgoing]:
        for part in self.parts:
            if not isinstance(part, Block):
                yield part
                continue
            data, width = part.frames.tobytes(), part.frames.shape[1]
            for k, (row, size) in enumerate(zip(part.rows.tolist(), part.sizes.tolist(), strict=True)):
                yield data[k * width : k * width + size], part.to.item(row)

    def __len__(self) -> int:
        return self._count


@kernel
def _enter(table: Array, place: int, begin: int, width: int, sizes: Array, rows: Array, to: Array) -> None:
    """Enter frames, one every `width` bytes from `begin` on, into a table of datagrams."""
    for k in range(len(rows)):
        table[0, place + k] = begin + k * width
        table[1, place + k] = begin + k * width + sizes[k]
        table[2, place + k] = to[rows[k]]
