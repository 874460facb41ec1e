"""Datagrams to and from the vehicles of a fleet, as arrays: few are ever handled one by one."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from scenarios.kernel import array_kernel, int64, kernel
from scenarios.sockets import Bytes, Ints, joined
from sim_vehicles.services.frames import PAYLOAD, first_message
from sim_vehicles.services.mavlink import TO_ALL, TO_NONE

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


@array_kernel
def to_vehicles(stream: Bytes, table: Ints, behind: Ints, wire_ids: Ints, targets: Ints) -> Ints:
    """The table of `Datagrams` for a `Batch` that was read from the vehicles' sockets.

    Behind the socket with descriptor d are the vehicles in the rows from `behind[d, 0]` up to `behind[d, 1]`, whose
    MAVLink system ids are in `wire_ids`. If they are several, a frame goes to the one that is its target (`targets` is
    `services.mavlink.TARGETS`), and a heartbeat or a frame to system 0 to all; what concerns no vehicle goes to the
    first, which counts it.
    """
    count, total = table.shape[1], 0
    rows = np.empty((count, 2), np.int64)
    for k in range(count):
        first, stop = behind[table[4, k], 0], behind[table[4, k], 1]
        if stop > first + 1:
            target = _target(stream[table[0, k] : table[1, k]], targets)
            if target:
                row = first
                while row < stop and wire_ids[row] != target:
                    row += 1
                first = row if row < stop else first
                stop = first + 1
        rows[k, 0], rows[k, 1] = first, stop
        total += stop - first
    out, place = np.empty((4, total), np.int64), 0
    for k in range(count):
        for row in range(rows[k, 0], rows[k, 1]):
            out[0, place], out[1, place], out[2, place], out[3, place] = table[0, k], table[1, k], row, table[3, k]
            place += 1
    return out


@kernel
def _target(frame: Bytes, targets: Ints) -> int:
    """The system that is the target of a datagram's first frame: 0 for all, TO_NONE if no vehicle is."""
    number = int64(first_message(frame, len(frame)))
    place = targets[number] if number < len(targets) else TO_NONE
    if place < 0:
        return 0 if place == TO_ALL else TO_NONE
    return int64(frame[PAYLOAD + place]) if place < frame[1] and PAYLOAD + place < len(frame) else 0
