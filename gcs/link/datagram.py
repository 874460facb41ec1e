"""Datagrams as the station receives and sends them: one by one, or many together as arrays.

Many are kept as one array of bytes and a table that says where each begins and ends. An object `bytes` is made only of
a datagram that somebody reads.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from scenarios.kernel import Array, kernel
from scenarios.sockets import Bytes, Ints, joined

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


@dataclass(slots=True)
class Arrivals:
    """Datagrams received, or sent; whoever iterates over them gets objects.

    The rows of `table` (4, n) say of each where it begins and ends in `stream`, which of `addresses` it is from or to,
    and when it was received or sent.
    """

    stream: Bytes
    table: Ints
    queued_ns: Ints
    addresses: Sequence[Address]

    def datagram(self, place: int) -> Datagram:
        begin, end, sender, received_ns = self.table[:, place].tolist()
        data = self.stream[begin:end].tobytes()
        return Datagram(data, self.addresses[sender], received_ns, self.queued_ns.item(place))

    def __len__(self) -> int:
        return self.table.shape[1]

    def __iter__(self) -> Iterator[Datagram]:
        return map(self.datagram, range(len(self)))


def arrivals_of(datagrams: Sequence[Datagram]) -> Arrivals:
    """The same datagrams as arrays."""
    data, addresses, received_ns, queued_ns = zip(*datagrams, strict=True) if datagrams else ((), (), (), ())
    senders = {address: place for place, address in enumerate(dict.fromkeys(addresses))}
    stream, ends = joined(data)
    table = np.array([ends[:-1], ends[1:], [senders[address] for address in addresses], received_ns], np.int64)
    return Arrivals(stream, table.reshape(4, -1), np.array(queued_ns, np.int64), [*senders])


class Frames:
    """Frames received or sent, in order, until they are cleared."""

    def __init__(self, frames: Iterable[Logged] = ()) -> None:
        self.parts: list[Logged | Arrivals] = [*frames]

    def append(self, frame: Logged) -> None:
        self.parts.append(frame)

    def add(self, arrivals: Arrivals, first: int = 0, stop: int | None = None) -> None:
        """Add the datagrams from the place `first` up to `stop`, each of one frame."""
        table = arrivals.table[:, first:stop]
        if table.shape[1]:
            self.parts.append(replace(arrivals, table=table))

    def take(self, other: "Frames") -> None:
        """Add all frames of another, which has none then."""
        self.parts += other.parts
        other.clear()

    def clear(self) -> None:
        self.parts.clear()

    def __iter__(self) -> Iterator[Logged]:
        for part in self.parts:
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

    frames: Bytes
    sizes: Ints
    rows: Ints
    to: Sequence[Address | None]


class Outbox:
    """Datagrams to be sent, in order. Iterating over it gives (bytes, address) of each."""

    def __init__(self, parts: Sequence[Outgoing] = ()) -> None:
        self.parts: list[Outgoing | Block] = [*parts]
        self._count = len(parts)

    def append(self, each: Outgoing) -> None:
        self.parts.append(each)
        self._count += 1

    def add(self, block: Block) -> None:
        self.parts.append(block)
        self._count += len(block.rows)

    def packed(
        self, number: Callable[[Address], int], numbers: Callable[[Sequence[Address | None]], Ints]
    ) -> tuple[Bytes, Ints]:
        """Its datagrams as the stream and the table of `Arrivals`, not yet sent: with 0 for the times.

        `number` and `numbers` give the numbers of one address and of the addresses of all vehicles.
        """
        table, streams = np.zeros((4, len(self)), np.int64), [np.empty(0, np.uint8)]
        place = begin = 0
        for part in self.parts:
            if isinstance(part, Block):
                _enter(table, place, begin, part.frames.shape[1], part.sizes, part.rows, numbers(part.to))
                place += len(part.rows)
                streams.append(part.frames.ravel())
            else:
                data, address = part
                table[:3, place] = begin, begin + len(data), number(address)
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
                address = part.to[row]
                assert address is not None
                yield data[k * width : k * width + size], address

    def __len__(self) -> int:
        return self._count


@kernel
def _enter(table: Array, place: int, begin: int, width: int, sizes: Array, rows: Array, numbers: Array) -> None:
    """Enter frames of a width each, the first of which begins at `begin`, into a table of datagrams."""
    for k in range(len(rows)):
        table[0, place + k] = begin + k * width
        table[1, place + k] = begin + k * width + sizes[k]
        table[2, place + k] = numbers[rows[k]]
