"""Vehicles on real UDP, with one thread and one socket per vehicle.

The kernel stamps what arrives, so the emulated down link begins when the datagram reached the host, not when this loop
read it. Datagrams leave within some tens of microseconds of their due time.
"""

import contextlib
import ctypes
import gc
import os
import resource
import select
import socket
import struct
import time  # noqa: TID251 - this is the real-time driver
from collections import Counter
from collections.abc import Callable, Generator
from typing import NamedTuple

from scenarios.networks import network_of
from scenarios.schema import NS_PER_S
from sim_vehicles.drive.datagrams import Datagram, Datagrams

LONGEST_SPIN_NS, SPIN_OF_ALL_NS = 100_000, 2_000_000
"""How long before a due time the loop polls the clock instead of sleeping: with few vehicles, late wake-ups are most of
the error. The second figure bounds the sum over all vehicles, to a tenth of a core at 50 Hz."""
TOGETHER_NS = 1_000
"""Between two wake-ups pass at least this times the number of vehicles; what is due by then is handled together. 250
vehicles act and receive about 30,000 times a second."""
LONGEST_WAIT_NS = NS_PER_S // 10
"""The loop checks at least this often whether to stop."""
DATAGRAM_BYTES = 2048
READS_PER_WAKE = 1000
"""Most datagrams read from one socket before the vehicles act again, so that a flood cannot hold them up."""
LATE_NS = 5_000_000
"""A datagram that leaves later than this is counted: the emulated link then differs from the scenario's."""
CLOCK_GAP_NS = 3_000
"""A reading of both clocks that took longer than this was interrupted, and is discarded."""

_OTHER_FILES = 100
"""Files that are open beside the sockets, and room for more."""
_SO_TIMESTAMPNS = 35  # Linux; Python has no name for it
_PR_SET_TIMERSLACK = 29
_STAMP = struct.Struct("qq")


class Received(NamedTuple):
    """A datagram with its receiving socket, the instant at which it reached this host, and its sender."""

    descriptor: int
    data: bytes
    time_ns: int
    address: tuple[str, int]


class Sockets:
    """All sockets of the process: waits for them, reads them, sends, and counts late datagrams."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        """`send_refused` (nobody listens at the port), `send_failed`, `receive_refused`, `left_late`."""
        self.latest_ns = 0
        """The largest lateness among those counted as `left_late`; a reader may reset it to 0."""
        self._epoll = select.epoll()
        self._sockets: dict[int, socket.socket] = {}
        self._clocks = _Clocks()
        self._emptied_ns = self._woken_ns = time.monotonic_ns()

    def add(self, *, bind: tuple[str, int] | None = None, connect: tuple[str, int] | None = None) -> int:
        """Open a socket, bound or connected, and return its file descriptor; a connected one hears only its peer.

        Raises OSError if the address cannot be used.
        """
        own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        number = own.fileno()
        self._sockets[number] = own
        own.setblocking(False)
        own.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        if bind is not None:
            own.bind(bind)
        if connect is not None:
            own.connect(connect)
        self._epoll.register(own, select.EPOLLIN)
        return number

    def close(self) -> None:
        self._epoll.close()
        for own in self._sockets.values():
            own.close()

    def wait(self, until_ns: int) -> None:
        """Sleep until a time, or until a datagram has arrived."""
        # select, because epoll rounds its time-outs up to whole milliseconds
        spin_ns = min(LONGEST_SPIN_NS, SPIN_OF_ALL_NS // max(1, len(self._sockets)))
        together_ns = self._woken_ns + TOGETHER_NS * len(self._sockets)
        remaining_ns = max(until_ns, together_ns) - spin_ns - time.monotonic_ns()
        if remaining_ns > 0 and select.select((self._epoll,), (), (), remaining_ns / NS_PER_S)[0]:
            until_ns = 0
        time.sleep(max(0, together_ns - spin_ns - time.monotonic_ns()) / NS_PER_S)
        while time.monotonic_ns() < until_ns:
            pass
        self._woken_ns = time.monotonic_ns()

    def receive(self) -> list[Received]:
        """Everything that has arrived, at most `READS_PER_WAKE` datagrams from each socket, in turn."""
        begin_ns = time.monotonic_ns()
        to_monotonic_ns = self._clocks.to_monotonic_ns()
        received: list[Received] = []
        for _ in range(READS_PER_WAKE):
            ready = self._epoll.poll(0)
            if not ready:
                self._emptied_ns = begin_ns
                break
            for descriptor, _ in ready:
                read = self._read(self._sockets[descriptor])
                if read is None:
                    continue
                data, stamp_ns, address = read
                # Stamps jump if the wall clock is set, but nothing arrived before the sockets were last empty.
                latest_ns = time.monotonic_ns()
                time_ns = latest_ns if stamp_ns is None else stamp_ns + to_monotonic_ns
                time_ns = min(max(time_ns, self._emptied_ns), latest_ns)
                received.append(Received(descriptor, data, time_ns, address))
        return received

    def send(self, descriptor: int, data: bytes, due_ns: int, address: tuple[str, int] | None = None) -> None:
        """Send to the address, or to the socket's peer; failures are counted."""
        own = self._sockets[descriptor]
        try:
            if address is None:
                own.send(data)
            else:
                own.sendto(data, address)
        except ConnectionRefusedError:
            self.counters["send_refused"] += 1
        except OSError:
            self.counters["send_failed"] += 1
        late_ns = time.monotonic_ns() - due_ns
        if late_ns > LATE_NS:
            self.counters["left_late"] += 1
            self.latest_ns = max(self.latest_ns, late_ns)

    def _read(self, own: socket.socket) -> tuple[bytes, int | None, tuple[str, int]] | None:
        """One datagram with its stamp and sender; None if there is none after all."""
        try:
            data, ancillary, _, address = own.recvmsg(DATAGRAM_BYTES, 64)
        except BlockingIOError:
            return None
        except OSError:  # the ICMP answer to a datagram sent while nobody listened
            self.counters["receive_refused"] += 1
            return None
        stamp_ns = None
        if ancillary and len(ancillary[0][2]) == _STAMP.size:
            seconds, nanoseconds = _STAMP.unpack(ancillary[0][2])
            stamp_ns = seconds * NS_PER_S + nanoseconds
        return data, stamp_ns, address


class Ports:
    """The vehicles' sockets, each connected to the station, so that datagrams of others are not accepted.

    `station` is where the station listens to network 0; network k has the port k above. Raises OSError if an address
    cannot be used, or too few files may be open.
    """

    def __init__(self, system_ids: tuple[int, ...], station: tuple[str, int]) -> None:
        self.sockets = Sockets()
        try:
            _allow_open(len(system_ids) + _OTHER_FILES)
            host, port = station
            self._descriptors = {key: self.sockets.add(connect=(host, port + network_of(key))) for key in system_ids}
        except OSError:
            self.sockets.close()
            raise
        self._system_ids = {number: system_id for system_id, number in self._descriptors.items()}

    def receive(self) -> list[Datagram]:
        """Everything that has arrived, with the instants at which it reached this host."""
        system_ids = self._system_ids
        return [(system_ids[number], data, time_ns) for number, data, time_ns, _ in self.sockets.receive()]

    def send(self, datagrams: Datagrams | list[Datagram]) -> None:
        for system_id, data, due_ns in datagrams:
            self.sockets.send(self._descriptors[system_id], data, due_ns)


def _allow_open(files: int) -> None:
    """See to it that this process may have so many files open, which is often limited to 1,024."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < files and soft != resource.RLIM_INFINITY:
        most = files if hard == resource.RLIM_INFINITY else min(files, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


class _Clocks:
    """The difference between the kernel's stamps (CLOCK_REALTIME) and CLOCK_MONOTONIC, followed continuously."""

    def __init__(self) -> None:
        self._offset_ns = time.monotonic_ns() - time.time_ns()
        self._read_ns = 0

    def to_monotonic_ns(self) -> int:
        """What to add to a kernel stamp."""
        before_ns = time.monotonic_ns()
        real_ns = time.time_ns()
        after_ns = time.monotonic_ns()
        if after_ns - before_ns < CLOCK_GAP_NS or after_ns - self._read_ns > NS_PER_S:
            self._offset_ns = (before_ns + after_ns) // 2 - real_ns
            self._read_ns = after_ns
        return self._offset_ns


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
            # Read the clock before the sockets, so that every datagram that came by then is among those received.
            now_ns = time.monotonic_ns()
            step(now_ns)
            if now_ns >= next_look_ns:
                next_look_ns = now_ns + LONGEST_WAIT_NS
                if look(now_ns):
                    return


@contextlib.contextmanager
def undisturbed() -> Generator[None]:
    """While entered, timers are as exact as the kernel allows, no garbage collection runs, and priority is real-time.

    Real-time priority needs root, or `ulimit -r` of at least 1; without either it is left as it is.
    """
    # The default timer slack lets the kernel delay a wake-up by 50 µs.
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    # A collection stops the loop for milliseconds. The loop makes no reference cycles, so memory does not grow.
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
