"""Datagrams to and from the vehicles of a fleet, as arrays: few are ever handled one by one."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from scenarios.sockets import Bytes, Ints, joined

Datagram = tuple[int, bytes, int]
"""(system id of the vehicle, bytes, host time in ns)"""


@dataclass(slots=True)
class Datagrams:
    """Datagrams in order; iterating over them yields tuples.

    The rows of `table` (4, n) are start and end of each datagram in `stream`, the vehicle's row in the fleet, and the
    time in ns. `system_ids` holds the system id of each row of the fleet.
    """

    stream: Bytes
    table: Ints
    system_ids: Sequence[int]

    def __len__(self) -> int:
        return self.table.shape[1]

    def __iter__(self) -> Iterator[Datagram]:
        data = self.stream.tobytes()
        for begin, end, row, time_ns in self.table.T.tolist():
            yield self.system_ids[row], data[begin:end], time_ns


def datagrams_of(datagrams: Sequence[Datagram], rows: Mapping[int, int]) -> Datagrams:
    """The same datagrams as arrays; `rows` maps system ids to rows of the fleet."""
    stream, ends = joined([data for _, data, _ in datagrams])
    numbers = [ends[:-1], ends[1:], [rows[key] for key, _, _ in datagrams], [time_ns for _, _, time_ns in datagrams]]
    return Datagrams(stream, np.array(numbers, np.int64), [*rows])
