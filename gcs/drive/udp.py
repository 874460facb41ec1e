"""The station's real-time driver: one UDP socket, the monotonic clock, one select loop.

The station itself reads no clock and touches no socket. Kernel receive stamps (SO_TIMESTAMPNS) say when a datagram
arrived, so a busy station does not lengthen the delays that it measures.
"""

import contextlib
import ctypes
import errno
import gc
import os
import select
import socket
import struct
import time  # noqa: TID251 - this is a driver
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Self

from gcs.control.phases import Phase
from gcs.control.tick import Event
from gcs.drive.guard import Guard
from gcs.drive.mirror import Mirror
from gcs.link import mavlink
from gcs.link.datagram import Datagram, Logged, Outgoing
from gcs.plan.flight_plan import FlightPlan
from gcs.runs.record import MIRROR, RunWriter
from gcs.runs.refusals import REFUSED, Refusals, in_words
from gcs.station.station import Station

_SO_TIMESTAMPNS = 35
_TIMESPEC = struct.Struct("qq")
_ANCILLARY_BYTES = 64
_LARGEST_DATAGRAM = 2048
_DATAGRAMS_A_STEP = 4096
_TOGETHER_NS = 3_000_000
"""The station wakes for datagrams at most once in this time. Their stamps say when they arrived."""
_BEFORE_TICK_NS = 2_000_000
"""This long before a tick, what has arrived is read. 250 vehicles send 30 datagrams in the time that is left."""
_PR_SET_TIMERSLACK = 29
_PORTS_TO_TRY, _LAST_PORT = 100, 65535


def clock_ns() -> int:
    """The station's clock."""
    return time.monotonic_ns()


def realtime_offset_ns() -> int:
    """The offset from the station's clock to ns since 1970.

    Taken from the quickest of three readings of both clocks, as the process may be interrupted between them.
    """
    readings: list[tuple[int, int]] = []
    for _ in range(3):
        before_ns, real_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        readings.append((after_ns - before_ns, real_ns - (before_ns + after_ns) // 2))
    return min(readings)[1]


class StationSocket:
    """A bound UDP socket for each network, with kernel receive stamps; with a guard, frames are signed and verified.

    `port` is that of network 0, also if it has no vehicles; network k listens at the port k above. With port 0, free
    ones are found. Raises OSError if an address cannot be bound.
    """

    def __init__(self, host: str, port: int, guard: Guard | None = None, networks: Sequence[int] = (0,)) -> None:
        self.guard, self.networks = guard, networks
        self._sockets = _bound(host, port, networks)
        self.bound_ns = self._woken_ns = clock_ns()
        self._emptied_ns = dict.fromkeys(networks, self.bound_ns)
        self.send_errors = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for own in self._sockets.values():
            own.close()

    @property
    def address(self) -> tuple[str, int]:
        """Where network 0 listens, or would."""
        network, own = next(iter(self._sockets.items()))
        host, port = own.getsockname()
        return host, port - network

    def wait(self, until_ns: int) -> None:
        """Wait until a datagram arrives or a time is reached; datagrams that follow closely are awaited together."""
        left_s = max(0, until_ns - clock_ns()) * 1e-9
        select.select(self._sockets.values(), [], [], left_s)
        time.sleep(max(0, min(until_ns, self._woken_ns + _TOGETHER_NS) - clock_ns()) * 1e-9)
        self._woken_ns = clock_ns()

    def receive(
        self, refused: Counter[str] | None = None, is_another: Callable[[int, Datagram], bool] | None = None
    ) -> list[Datagram]:
        """All waiting datagrams, the oldest of each network first, with their arrival on the station's clock.

        `refused` and `is_another` are those of `Guard.received`.
        """
        datagrams: list[Datagram] = []
        for network in self._sockets:
            self._receive(network, datagrams)
        if self.guard is not None:
            return self.guard.received(datagrams, clock_ns(), Counter() if refused is None else refused, is_another)
        return datagrams

    def send(self, outgoing: Iterable[Outgoing]) -> list[int]:
        """Send datagrams; returns when each had been handed to the kernel, on the station's clock."""
        sent_ns: list[int] = []
        for data, (host, port, network) in outgoing if self.guard is None else self.guard.sent(outgoing, clock_ns()):
            try:
                self._sockets[network].sendto(data, (host, port))
            except OSError:  # a full buffer or a closed port is a loss, which the link statistics show
                self.send_errors += 1
            sent_ns.append(clock_ns())
        return sent_ns

    def _receive(self, network: int, datagrams: list[Datagram]) -> None:
        """Add the waiting datagrams of a network."""
        own, oldest_ns = self._sockets[network], self._emptied_ns[network]
        begin_ns, to_monotonic_ns = clock_ns(), -realtime_offset_ns()
        for _ in range(_DATAGRAMS_A_STEP):
            try:
                data, ancillary, _, (host, port) = own.recvmsg(_LARGEST_DATAGRAM, _ANCILLARY_BYTES)
            except BlockingIOError:
                self._emptied_ns[network] = begin_ns
                break
            except ConnectionError:  # an earlier datagram met a closed port; the vehicle will count as silent
                self.send_errors += 1
                continue
            seconds, nanoseconds = _TIMESPEC.unpack(ancillary[0][2])
            read_ns = clock_ns()
            # Stamps jump when the wall clock is set, but nothing arrived before the socket was last empty.
            received_ns = seconds * 1_000_000_000 + nanoseconds + to_monotonic_ns
            received_ns = min(max(received_ns, oldest_ns), read_ns)
            datagrams.append(Datagram(data, (host, port, network), received_ns, read_ns - received_ns))


def _bound(host: str, port: int, networks: Sequence[int]) -> dict[int, socket.socket]:
    """The sockets of networks, see `StationSocket`."""
    if port or len(networks) == 1:
        return _bound_at(host, port, networks)
    for _ in range(_PORTS_TO_TRY):
        with contextlib.suppress(OSError):
            return _bound_at(host, port, networks)
    return _bound_at(host, port, networks)  # the error that comes now is reported


def _bound_at(host: str, port: int, networks: Sequence[int]) -> dict[int, socket.socket]:
    """The sockets of networks; with port 0 the first is bound to any free port, which says where the others are."""
    with contextlib.ExitStack() as opened:
        sockets: dict[int, socket.socket] = {}
        for network in networks:
            own = opened.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            own.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
            if port + network > _LAST_PORT:
                raise OSError(errno.EADDRNOTAVAIL, f"there is no port {port + network} for network {network}")
            own.bind((host, port + network if port else 0))
            port = own.getsockname()[1] - network
            own.setblocking(False)
            sockets[network] = own
        opened.pop_all()
    return sockets


@contextlib.contextmanager
def undisturbed(*, own_code: bool) -> Generator[None]:
    """While entered, this process wakes on time: minimum timer slack, no garbage collection, real-time priority.

    Real-time priority needs root, or `ulimit -r` of at least 1; without either it is left as it is. With 250 vehicles a
    garbage collection takes 30 ms. The station makes no reference cycles. The user's `own_code` may: with it, garbage
    is collected, but not among objects that exist already.
    """
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    gc.collect()
    gc.freeze()
    if not own_code:
        gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))


def drive(
    station: Station,
    link: StationSocket,
    writer: RunWriter,
    stop_reason: Callable[[], str],
    new_plan: Callable[[FlightPlan], None],
    mirror: Mirror | None = None,
) -> None:
    """Run the station in real time until its flight has ended.

    `stop_reason` is called at every tick; a text other than "" ends the flight for that reason. `new_plan` is called
    when identification has changed the flight plan. A mirror gets every frame received and sent, and may pass frames on
    to the vehicles.
    """
    plan = station.plan
    log: list[Logged] = []
    """Frames received and sent since the last tick, in order."""
    refusals = Refusals()

    def log_refusals(now_ns: int, *, last: bool = False) -> None:
        if counts := refusals.news(station.counters, last=last):
            text = in_words(counts) if last else ", ".join(counts)
            writer.event(Event(time_s=station.scenario_time_s(now_ns), kind=REFUSED, text=text, counts=counts))

    while station.phase is not Phase.ENDED:
        # What came since the last tick is read before the next one is due, so that set-points do not wait for it.
        read_ns = station.next_tick_ns - _BEFORE_TICK_NS
        link.wait(min(station.next_event_ns, read_ns if clock_ns() < read_ns else station.next_tick_ns))
        now_ns = clock_ns()
        requests: list[Outgoing] = []
        if station.next_event_ns <= now_ns < station.next_tick_ns:
            requests = [*station.step([], now_ns)[0]]  # before anything is read: a round trip counts from this step
            link.send(requests)
            log += [(data, now_ns, address) for data, address in requests]
        datagrams = link.receive(station.counters, station.is_another)
        now_ns = clock_ns()
        outbox, tick = station.step(datagrams, now_ns)
        outgoing = [*outbox]
        sent_ns = link.send(outgoing)
        if mirror is not None:
            received = [frame for frame, _, _ in station.frames]
            mirror.forward(received + [data for data, _ in requests + outgoing], now_ns)
            link.send(mirror.passed_on(station.vehicles, now_ns))
        log += station.frames
        log += [
            (data, own_ns if mavlink.is_set_point(data) else now_ns, address)
            for (data, address), own_ns in zip(outgoing, sent_ns, strict=True)
        ]
        station.frames.clear()
        if tick is None:
            continue
        writer.tick(station.complete(tick, sent_ns))
        writer.frames(log, realtime_offset_ns())
        for event in station.events:
            writer.event(event)
        log.clear()
        station.events.clear()
        log_refusals(now_ns)
        if station.plan is not plan:
            plan = station.plan
            new_plan(plan)
        if reason := stop_reason():
            station.request_stop(reason)
    log_refusals(clock_ns(), last=True)
    if mirror is not None:
        time_s, counts = station.scenario_time_s(clock_ns()), dict(mirror.counters)
        writer.event(Event(time_s=time_s, kind=MIRROR, text=in_words(counts), counts=counts))
