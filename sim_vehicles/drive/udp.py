"""Vehicles on real UDP, with one thread, and one socket per vehicle or per network.

The operating system timestamps each arrival, so the emulated down link begins when the datagram reached the host, not
when this loop read it. Datagrams leave within some tens of microseconds of their due time.
"""

import resource
import select
import socket
import time  # noqa: TID251 - this is the real-time driver
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from scenarios.networks import network_of, wire_id
from scenarios.schema import NS_PER_S
from scenarios.sockets import NO_ADDRESS, Batch, Bytes, Ints, Reader, joined, number_of, stamped, write
from scenarios.undisturbed import undisturbed
from sim_vehicles.drive.datagrams import Datagram, Datagrams, datagrams_of, to_vehicles
from sim_vehicles.services.mavlink import TARGETS

LONGEST_SPIN_NS, SPIN_OF_ALL_NS = 100_000, 2_000_000
"""The loop busy-waits for this long before a due time, because with few vehicles late wake-ups are most of the error.
The second figure bounds the sum over all vehicles: a tenth of a core at 50 Hz."""
TOGETHER_NS = 1_000
"""Minimum time between two wake-ups, per vehicle; everything due by then is handled together. 250 vehicles act and
receive about 30,000 times a second."""
LONGEST_WAIT_NS = NS_PER_S // 10
"""The loop checks at least this often whether to stop."""
READ_OF_EACH = 16
"""Maximum number of datagrams read from one socket before the vehicles act again: a flood cannot hold them up."""
LATE_NS = 5_000_000
"""A datagram that leaves later than this is counted: the emulated link then differs from the scenario's."""

_OTHER_FILES = 100
"""Allowance for files open besides the sockets."""


class Sockets:
    """All sockets of the process: waits for them, reads them, sends, and counts late datagrams.

    Each is shared by `vehicles_each` vehicles, whose frames share datagrams if there are several.
    """

    def __init__(self, vehicles_each: int = 1) -> None:
        self.counters: Counter[str] = Counter()
        """`send_refused` (nobody listens at the port), `send_failed`, `receive_refused`, `left_late`."""
        self.latest_ns = 0
        """The largest lateness among those counted as `left_late`; a reader may reset it to 0."""
        self._epoll = select.epoll()
        self._sockets: dict[int, socket.socket] = {}
        self._vehicles_each = vehicles_each
        self._reader = Reader(READ_OF_EACH * vehicles_each, together=vehicles_each > 1)
        self._woken_ns = time.monotonic_ns()

    def add(self, *, bind: tuple[str, int] | None = None, connect: tuple[str, int] | None = None) -> int:
        """Open a socket, bound or connected, and return its file descriptor; a connected one hears only its peer.

        Raises OSError if the address cannot be used.
        """
        own = stamped(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        number = own.fileno()
        self._sockets[number] = own
        if bind is not None:
            own.bind(bind)
        if connect is not None:
            own.connect(connect)
        self._epoll.register(own, select.EPOLLIN)
        return number

    @property
    def count(self) -> int:
        """How many sockets are open."""
        return len(self._sockets)

    def close(self) -> None:
        self._epoll.close()
        for own in self._sockets.values():
            own.close()

    def wait(self, until_ns: int) -> None:
        """Sleep until a time, or until a datagram has arrived."""
        # select, because epoll rounds its timeouts up to whole milliseconds
        vehicles = self._vehicles_each * len(self._sockets)
        spin_ns = min(LONGEST_SPIN_NS, SPIN_OF_ALL_NS // max(1, vehicles))
        together_ns = self._woken_ns + TOGETHER_NS * vehicles
        remaining_ns = max(until_ns, together_ns) - spin_ns - time.monotonic_ns()
        if remaining_ns > 0 and select.select((self._epoll,), (), (), remaining_ns / NS_PER_S)[0]:
            until_ns = 0
        time.sleep(max(0, together_ns - spin_ns - time.monotonic_ns()) / NS_PER_S)
        while time.monotonic_ns() < until_ns:
            pass
        self._woken_ns = time.monotonic_ns()

    def receive(self) -> Batch:
        """The datagrams that have arrived, at most `READ_OF_EACH` per socket; for more, the next wait ends at once."""
        ready = self._epoll.poll(0, len(self._sockets))
        batch = self._reader.read([number for number, _ in ready])
        self.counters["receive_refused"] += batch.errors  # answers to what was sent while nobody listened
        return batch

    def send(self, stream: Bytes, table: Ints, addresses: Ints | None = None) -> None:
        """Send datagrams to addresses with these numbers, or to the sockets' peers; failures are counted.

        The rows of `table` (4, n) are start and end of each datagram in `stream`, the descriptor of the socket, and the
        due time in ns.
        """
        begins, ends, descriptors, due_ns = table
        to = np.full(len(due_ns), NO_ADDRESS) if addresses is None else addresses
        sent_ns, refused, failed = write(stream, begins, ends, descriptors, to, self._reader.buffers)
        self.counters["send_refused"] += refused
        self.counters["send_failed"] += failed
        late_ns = sent_ns - due_ns
        self.counters["left_late"] += int((late_ns > LATE_NS).sum())
        latest_ns = int(late_ns.max(initial=0))
        if latest_ns > LATE_NS:
            self.latest_ns = max(self.latest_ns, latest_ns)

    def send_each(self, datagrams: Sequence[tuple[bytes, int, int, tuple[str, int] | None]]) -> None:
        """As `send`, given the bytes, socket, due time and address of each; None as address is the socket's peer."""
        data, descriptors, due_ns, addresses = zip(*datagrams, strict=True) if datagrams else ((), (), (), ())
        stream, ends = joined(data)
        to = [NO_ADDRESS if address is None else number_of(address) for address in addresses]
        self.send(stream, np.array([ends[:-1], ends[1:], descriptors, due_ns], np.int64), np.array(to, np.int64))


class Ports:
    """The vehicles' sockets, each connected to the station, so that datagrams from others are not accepted.

    Each vehicle has its own. With `one_port`, each network has one, where a frame reaches the vehicle that is its
    target, or all vehicles if it names none of them. `station` is where the station listens to network 0; network k has
    the port k above. Raises OSError if an address cannot be used, or too few files may be open.
    """

    def __init__(self, system_ids: tuple[int, ...], station: tuple[str, int], *, one_port: bool = False) -> None:
        sharing: dict[int, list[int]] = {}
        for row, key in enumerate(system_ids):
            sharing.setdefault(network_of(key) if one_port else key, []).append(row)
        self.sockets = Sockets(max(map(len, sharing.values()), default=1))
        self._numbers = np.zeros(len(system_ids), np.int64)
        """The descriptor of each vehicle's socket."""
        try:
            _allow_open(len(sharing) + _OTHER_FILES)
            host, port = station
            for rows in sharing.values():
                self._numbers[rows] = self.sockets.add(connect=(host, port + network_of(system_ids[rows[0]])))
        except OSError:
            self.sockets.close()
            raise
        self._system_ids = system_ids
        self._wire_ids = np.array([*map(wire_id, system_ids)], np.int64)
        self._behind = np.zeros((self._numbers.max(initial=0) + 1, 2), np.int64)
        """The rows of the vehicles behind each descriptor, from the first up to the second number."""
        for rows in sharing.values():
            self._behind[self._numbers[rows[0]]] = rows[0], rows[-1] + 1
        self.send([])  # so that nothing is compiled in flight
        self.receive()

    def receive(self) -> Datagrams:
        """The datagrams that have arrived, with the times at which they reached this host."""
        batch = self.sockets.receive()
        table = to_vehicles(batch.stream, batch.table, self._behind, self._wire_ids, TARGETS)
        return Datagrams(batch.stream, table, self._system_ids)

    def send(self, datagrams: Datagrams | list[Datagram]) -> None:
        if not isinstance(datagrams, Datagrams):
            datagrams = datagrams_of(datagrams, {system_id: row for row, system_id in enumerate(self._system_ids)})
        table = datagrams.table.copy()
        table[2] = self._numbers[table[2]]
        if len(self._numbers) > self.sockets.count:
            table = table.take(table[2].argsort(kind="stable"), axis=1)  # those of one socket travel together
        self.sockets.send(datagrams.stream, table)


def _allow_open(files: int) -> None:
    """Raise this process's limit of open files, often 1,024, to at least `files` if it may be raised so far."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < files and soft != resource.RLIM_INFINITY:
        most = files if hard == resource.RLIM_INFINITY else min(files, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def run(
    sockets: Sockets, step: Callable[[int], None], next_event_ns: Callable[[], int], look: Callable[[int], bool]
) -> None:
    """Call `step(now_ns)` whenever a datagram has arrived or an event is due, until `look(now_ns)` is true.

    `look` is called about ten times a second.
    """
    next_look_ns = 0
    with undisturbed():
        while True:
            sockets.wait(min(next_event_ns(), next_look_ns))
            # Read the clock before the sockets, so that every datagram that arrived by then is among those received.
            now_ns = time.monotonic_ns()
            step(now_ns)
            if now_ns >= next_look_ns:
                next_look_ns = now_ns + LONGEST_WAIT_NS
                if look(now_ns):
                    return
