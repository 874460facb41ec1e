"""The fast path in real time: a step of the station in one kernel, from its sockets and back to them.

In most flights nearly all steps are of this kind. Where the kernel stops, for example when a vehicle answers a command,
a step in Python continues from there (`gcs.drive.udp`).
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gcs.control.tick import TICK, TickArray
from gcs.link.clocks import note_sent
from gcs.link.datagram import NETWORK_BIT, NUMBER_BITS
from gcs.runs.record import add_entry
from gcs.station.fast_path import (
    DONE,
    NOT_DONE,
    NOT_JUDGED,
    NOT_TAKEN,
    WITH_TICK,
    FastPathData,
    Sending,
    fast_rows,
    fast_step,
)
from gcs.station.station import Station
from scenarios.kernel import Columns, Records, array_kernel, kernel
from scenarios.networks import LAST_NETWORK
from scenarios.sockets import (
    MOST_DATAGRAMS,
    OFFSET,
    Batch,
    Buffers,
    Bytes,
    Ints,
    Reader,
    batch,
    monotonic_ns,
    read_all,
    write_all,
)

if TYPE_CHECKING:
    from scenarios.handle import Handle

_LOG_BYTES, _MUCH_LOGGED = 4 << 20, 2 << 20
"""Room for new entries of each log, and how much of it a step may find used. A step reads at most 1 MiB."""
_STEP = np.dtype(
    [
        ("count", "i8"), ("end", "i8"), ("errors", "i8"), ("read_ns", "i8"),  # the results of `read_all`
        ("taken", "i8"),  # how many of the datagrams the station has processed
    ]
)  # fmt: skip


class Wire(NamedTuple):
    """The sockets of a station, and the buffers into which they are read."""

    read_from: Ints
    """Descriptors of the sockets."""
    descriptors: Ints
    """The descriptor of each network's socket."""
    networks: Ints
    """The network of each descriptor."""
    buffers: Buffers


def no_wire() -> Wire:
    """A wire without sockets."""
    nothing = np.empty(0, np.int64)
    return Wire(nothing, np.full(LAST_NETWORK + 1, -1), nothing, Reader().buffers)


class Ends(NamedTuple):
    """The arrays that a step works on; kernels that Python calls take a handle on them."""

    data: FastPathData
    wire: Wire
    step: Records
    """The state and the results of a step: one record of _STEP."""
    rows: Records
    """The rows of the last tick."""
    sent_ns: Ints
    """When its set-points were sent."""
    entries: Bytes
    """New entries of each network's telemetry log, (networks, bytes)."""
    logged: Ints
    """The size of the entries of each network."""


class UdpFastPath:
    """Does the fast steps of a station on its sockets. `log` takes a network and entries of its telemetry log."""

    def __init__(self, station: Station, wire: Wire, log: Callable[[int, bytes], None]) -> None:
        n, networks = len(station.vehicles), LAST_NETWORK + 1
        self._station, self._log = station, log
        self._ends = Ends(
            station.fast_path_data, wire, np.zeros(1, _STEP), np.zeros(n, TICK),
            np.zeros(n, np.int64), np.empty((networks, _LOG_BYTES), np.uint8), np.zeros(networks, np.int64),
        )  # fmt: skip
        self._state = Columns(self._ends.step)
        self._handle: Handle | None = None
        self.rows: TickArray | None = None
        """The rows of the tick done in the last step; None if it did none."""

    def step(self) -> bool:
        """Do a step, or as much of it as needs no Python; returns whether it is done."""
        station = self._station
        if self._handle is None:
            from scenarios.handle import handle  # imports Numba

            self._ends = self._ends._replace(data=station.fast_path_data)
            self._handle = handle(self._ends)
            station.look_ahead()
        outcome = _step(self._handle)
        self.rows = self._ends.rows if outcome == WITH_TICK else None
        if outcome != DONE or self._ends.logged.max() > _MUCH_LOGGED:
            self._write_log()
        if outcome == NOT_JUDGED:
            self.rows = station.complete(station.unjudged(np.arange(len(station.vehicles))), self._ends.sent_ns)
            self.look_again()
        return outcome not in (NOT_TAKEN, NOT_DONE)

    def look_again(self) -> None:
        """Take up the station's data again: call this after Python has changed the station."""
        self._handle = None

    @property
    def read(self) -> Batch:
        """The datagrams that the last step has read."""
        state = self._state
        return batch(self._ends.wire.buffers, *(state[name][0] for name in ("count", "end", "errors", "read_ns")))

    @property
    def taken(self) -> int:
        """How many of the datagrams read in the last step are processed."""
        return self._state["taken"][0]

    def _write_log(self) -> None:
        entries, logged = self._ends.entries, self._ends.logged
        for network, size in enumerate(logged.tolist()):
            if size:
                self._log(network, entries[network, :size].tobytes())
        logged[:] = 0


@array_kernel
def _step(ends: Any) -> int:
    """Do a step, but nothing after reading if Python has to; returns its outcome."""
    own, schedule, tables = ends.arrays, ends.arrays.data.schedule[0], ends.arrays.data.tables
    step, stream, words = own.step[0], own.wire.buffers.stream, own.wire.buffers.words
    table, queued_ns = _received(own)
    schedule.now_ns = monotonic_ns(words)
    outcome, step.taken, answers, second, requests = fast_step(own.data, stream, table, queued_ns)
    if outcome in (NOT_TAKEN, NOT_DONE):
        return outcome
    answers_ns, second_ns, requests_ns = _send(own, answers), _send(own, second), _send(own, requests)
    note_sent(tables.clocks, tables.pending_ns, requests.rows, requests_ns)
    for k in range(step.count):
        network, time_ns = table[2, k] >> NETWORK_BIT, words[OFFSET] + table[3, k]
        size = own.logged[network]
        own.logged[network] = add_entry(own.entries[network], size, stream, table[0, k], table[1, k], time_ns)
    _log(own, answers, answers_ns)
    _log(own, second, second_ns)
    _log(own, requests, requests_ns)
    if outcome == WITH_TICK:
        last_ns = second_ns[-1] if len(second_ns) else schedule.now_ns
        for row in range(len(own.sent_ns)):
            own.sent_ns[row] = last_ns  # kept for vehicles that are sent none
        for k in range(len(second_ns)):
            own.sent_ns[second.rows[k]] = second_ns[k]
        if not fast_rows(own.data, own.sent_ns, own.rows):
            return NOT_JUDGED
    return outcome


@array_kernel
def _received(own: Any) -> tuple[Ints, Ints]:
    """Read the sockets; returns `table` and `queued_ns` of `Arrivals`."""
    step, wire, all_read = own.step[0], own.wire, own.wire.buffers.table
    step.count, step.end, step.errors, step.read_ns = read_all(wire.read_from, MOST_DATAGRAMS, wire.buffers)
    table, queued_ns = np.empty((4, step.count), np.int64), np.empty(step.count, np.int64)
    for k in range(step.count):
        for part in range(4):
            table[part, k] = all_read[part, k]
        table[2, k] |= wire.networks[all_read[4, k]] << NETWORK_BIT
        queued_ns[k] = step.read_ns - table[3, k]
    return table, queued_ns


@array_kernel
def _send(own: Any, sending: Sending) -> Ints:
    """Send frames to vehicles; returns when each was handed to the operating system."""
    wire, count, width = own.wire, len(sending.rows), sending.frames.shape[1]
    begins, ends, descriptors, addresses, sent_ns = np.empty((5, count), np.int64)
    for k in range(count):
        address = own.data.tables.links[sending.rows[k]].address
        begins[k], ends[k] = k * width, k * width + sending.sizes[k]
        descriptors[k], addresses[k] = wire.descriptors[address >> NETWORK_BIT], address & NUMBER_BITS
    write_all(sending.frames.ravel(), begins, ends, descriptors, addresses, sent_ns, wire.buffers)
    return sent_ns


@kernel
def _log(own: Any, sending: Sending, sent_ns: Ints) -> None:
    """Add frames sent to the telemetry log."""
    for k in range(len(sending.rows)):
        network = own.data.tables.links[sending.rows[k]].address >> NETWORK_BIT
        time_ns, size = own.wire.buffers.words[OFFSET] + sent_ns[k], own.logged[network]
        own.logged[network] = add_entry(own.entries[network], size, sending.frames[k], 0, sending.sizes[k], time_ns)
