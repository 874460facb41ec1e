"""Vehicles on real UDP: the one place here that reads a clock or touches a socket.

One thread, one socket per vehicle. The kernel stamps what arrives, so the emulated down link begins when the datagram
reached the host and not when this loop got round to reading it; what is sent waits for its due time to some tens of
microseconds.
"""

import contextlib
import ctypes
import gc
import select
import socket
import struct
import time  # noqa: TID251 - this is the real-time driver
from collections import Counter
from collections.abc import Callable, Generator, Iterator

from scenarios.schema import NS_PER_S
from sim_vehicles.fleet import Datagram, Fleet
from sim_vehicles.vehicle import Change

LONGEST_SPIN_NS, SPIN_OF_ALL_NS = 100_000, 2_000_000
"""Before a due time the loop stops sleeping and looks at the clock this long: with few vehicles, waking from sleep is
most of the error. Of all vehicles together not more than the second figure, a tenth of a core at 50 Hz."""
LONGEST_WAIT_NS = NS_PER_S // 10
"""The loop looks at the flags that end it at least this often."""
DATAGRAM_BYTES = 2048
READS_PER_WAKE = 1000
"""From one socket, so that a flood into it cannot stop the others."""
CLOCK_GAP_NS = 3_000
"""A reading of the two clocks that took longer was interrupted and is not used."""

_SO_TIMESTAMPNS = 35  # Linux; Python has no name for it
_PR_SET_TIMERSLACK = 29
_STAMP = struct.Struct("qq")


class Ports:
    """The vehicles' sockets, each connected to the station: nobody else's datagrams are taken.

    Raises
    ------
    OSError
        If the station's address cannot be used.
    """

    def __init__(self, system_ids: tuple[int, ...], station: tuple[str, int]) -> None:
        self.counters: Counter[str] = Counter()
        """`send_refused` (nobody listens at the station's port), `send_failed`, `receive_refused`."""
        self._epoll = select.epoll()
        self._sockets: dict[int, socket.socket] = {}
        self._system_ids: dict[int, int] = {}
        self._clocks = _Clocks()
        self._spin_ns = min(LONGEST_SPIN_NS, SPIN_OF_ALL_NS // len(system_ids))
        self._emptied_ns = time.monotonic_ns()
        try:
            for system_id in system_ids:
                own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                self._sockets[system_id] = own
                self._system_ids[own.fileno()] = system_id
                own.setblocking(False)
                own.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
                own.connect(station)
                self._epoll.register(own, select.EPOLLIN)
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """Close all sockets."""
        self._epoll.close()
        for own in self._sockets.values():
            own.close()

    def wait(self, until_ns: int) -> None:
        """Sleep until then, or until a datagram is there."""
        # epoll rounds its own time-outs up to whole milliseconds; select does not.
        remaining_ns = until_ns - self._spin_ns - time.monotonic_ns()
        if remaining_ns > 0 and select.select((self._epoll,), (), (), remaining_ns / NS_PER_S)[0]:
            return
        while time.monotonic_ns() < until_ns:
            pass

    def receive(self) -> list[Datagram]:
        """Everything that has arrived, each with the instant at which it reached this host."""
        begin_ns = time.monotonic_ns()
        to_monotonic_ns = self._clocks.to_monotonic_ns()
        received: list[Datagram] = []
        emptied = True
        for file_number, _ in self._epoll.poll(0):
            system_id = self._system_ids[file_number]
            read = 0
            for data, stamp_ns in self._read(self._sockets[system_id]):
                # If the wall clock is set, stamps jump; but nothing came before the sockets were last empty.
                latest_ns = time.monotonic_ns()
                time_ns = latest_ns if stamp_ns is None else stamp_ns + to_monotonic_ns
                received.append((system_id, data, min(max(time_ns, self._emptied_ns), latest_ns)))
                read += 1
            emptied = emptied and read < READS_PER_WAKE
        if emptied:
            self._emptied_ns = begin_ns
        return received

    def send(self, datagrams: list[Datagram]) -> None:
        """Send to the station; that nobody listens there is no fault of ours."""
        for system_id, data, _ in datagrams:
            try:
                self._sockets[system_id].send(data)
            except ConnectionRefusedError:
                self.counters["send_refused"] += 1
            except OSError:
                self.counters["send_failed"] += 1

    def _read(self, own: socket.socket) -> Iterator[tuple[bytes, int | None]]:
        for _ in range(READS_PER_WAKE):
            try:
                data, ancillary, _, _ = own.recvmsg(DATAGRAM_BYTES, 64)
            except BlockingIOError:
                return
            except OSError:  # the answer to something sent when nobody listened
                self.counters["receive_refused"] += 1
                continue
            stamp_ns = None
            if ancillary and len(ancillary[0][2]) == _STAMP.size:
                seconds, nanoseconds = _STAMP.unpack(ancillary[0][2])
                stamp_ns = seconds * NS_PER_S + nanoseconds
            yield data, stamp_ns


class _Clocks:
    """The difference between the kernel's stamps (CLOCK_REALTIME) and CLOCK_MONOTONIC, followed continuously."""

    def __init__(self) -> None:
        self._offset_ns = time.monotonic_ns() - time.time_ns()
        self._read_ns = 0

    def to_monotonic_ns(self) -> int:
        """What to add to a stamp."""
        before_ns = time.monotonic_ns()
        real_ns = time.time_ns()
        after_ns = time.monotonic_ns()
        if after_ns - before_ns < CLOCK_GAP_NS or after_ns - self._read_ns > NS_PER_S:
            self._offset_ns = (before_ns + after_ns) // 2 - real_ns
            self._read_ns = after_ns
        return self._offset_ns


def fly(
    fleet: Fleet,
    ports: Ports,
    *,
    stop: Callable[[int, int], bool],
    tell: Callable[[list[Change]], None],
) -> None:
    """Run the vehicles in real time until `stop(now_ns, last_heard_ns)`.

    `stop` and `tell` (with what happened to the vehicles since) are called about ten times a second.
    """
    next_look_ns = 0
    with _undisturbed():
        while True:
            ports.wait(min(fleet.next_event_ns, next_look_ns))
            # The clock before the sockets: every datagram that came by then is among those received.
            now_ns = time.monotonic_ns()
            ports.send(fleet.step(ports.receive(), now_ns))
            if now_ns >= next_look_ns:
                next_look_ns = now_ns + LONGEST_WAIT_NS
                tell(fleet.take_changes())
                if stop(now_ns, fleet.last_heard_ns):
                    return


@contextlib.contextmanager
def _undisturbed() -> Generator[None]:
    """Timers as exact as the kernel can, and no pauses for garbage."""
    # The default slack lets the kernel put off a wake-up by 50 µs.
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    # A collection stops the loop for milliseconds. Nothing in it makes reference cycles, so nothing piles up.
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
