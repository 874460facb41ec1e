"""The station's real-time driver: a UDP socket for each network, the monotonic clock, one select loop.

The station itself reads no clock and touches no socket. Kernel receive stamps (SO_TIMESTAMPNS) say when a datagram
arrived, so a busy station does not lengthen the delays that it measures.
"""

import contextlib
import errno
import select
import socket
import time  # noqa: TID251 - this is a driver
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Self

import numpy as np

from gcs.control.phases import Phase
from gcs.control.tick import Event, TickArray
from gcs.drive.guard import Guard
from gcs.drive.mirror import Mirror
from gcs.drive.udp_fast_path import UdpFastPath, Wire
from gcs.link.datagram import NETWORK_BIT, NUMBER_BITS, Arrivals, Datagram, Outbox, Outgoing
from gcs.plan.expected_delay import waits_for_channels
from gcs.plan.flight_plan import FlightPlan
from gcs.runs.record import MIRROR, RunWriter
from gcs.runs.refusals import REFUSED, Refusals, in_words
from gcs.station.station import Station
from scenarios.networks import LAST_NETWORK
from scenarios.sockets import OFFSET, Batch, Ints, Reader, stamped, write

_TOGETHER_NS = 8_000_000
"""Longest time that a datagram usually waits for others, so that they are read in one wake-up."""
_BEFORE_TICK_NS = 2_000_000
"""How long before a tick the sockets are read. In the time left, 250 vehicles send 30 datagrams."""
_FEW = 25
"""Up to this many vehicles need so little work before a tick that requests can be sent then. In a channel with limited
bandwidth, requests would delay the set-points, so they are sent between ticks."""
_PORTS_TO_TRY, _LAST_PORT = 100, 65535


def clock_ns() -> int:
    """The station's clock."""
    return time.monotonic_ns()


class StationSocket:
    """A bound UDP socket for each network, with kernel receive stamps; with a guard, frames are signed and verified.

    `port` is that of network 0, even if that network has no vehicles; network k listens at `port` + k. With port 0,
    free ports are found. With `together`, frames share datagrams, see `Reader`. Raises OSError if an address cannot be
    bound.
    """

    def __init__(
        self,
        host: str,
        port: int,
        guard: Guard | None = None,
        networks: Sequence[int] = (0,),
        *,
        together: bool = False,
    ) -> None:
        self.guard, self.networks = guard, networks
        self._reader = Reader(together=together)
        self._reader.read([])  # compiles it before the flight
        self._sockets = _bound(host, port, networks)
        descriptors = np.zeros(LAST_NETWORK + 1, np.int64)
        for network, own in self._sockets.items():
            descriptors[network] = own.fileno()
        network_of, read_from = np.zeros(descriptors.max() + 1, np.int64), descriptors[[*networks]]
        network_of[read_from] = networks
        self._wait_for, self.wire = read_from.tolist(), Wire(read_from, descriptors, network_of, self._reader.buffers)
        self.bound_ns = self._woken_ns = clock_ns()
        self.send_errors = 0
        self._nothing = self._send(Outbox())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for own in self._sockets.values():
            own.close()

    @property
    def address(self) -> tuple[str, int]:
        """The address at which network 0 listens, or would listen."""
        network, own = next(iter(self._sockets.items()))
        host, port = own.getsockname()
        return host, port - network

    @property
    def epoch_ns(self) -> int:
        """Zero of the station's clock in ns since 1970, as known when the sockets were last read."""
        return self.wire.buffers.words.item(OFFSET)

    def wait(self, until_ns: int, together_ns: int = _TOGETHER_NS) -> None:
        """Wait until a time is reached or a datagram has waited `together_ns` for others."""
        busy_ns = clock_ns() - self._woken_ns
        if self._woken_ns + together_ns < until_ns:
            select.select(self._wait_for, [], [], max(0, until_ns - clock_ns()) * 1e-9)
            # the datagram may have come right after the last wake-up
            until_ns = min(until_ns, clock_ns() + together_ns - busy_ns)
        if (left_ns := until_ns - clock_ns()) > 0:
            time.sleep(left_ns * 1e-9)
        self._woken_ns = clock_ns()

    def receive(
        self, refused: Counter[str] | None = None, is_another: Callable[[int, Datagram], bool] | None = None
    ) -> Arrivals | list[Datagram]:
        """All waiting datagrams, the oldest of each network first, with their arrival times on the station's clock.

        `refused` and `is_another` are passed to `Guard.received`.
        """
        arrivals = self.arrivals(self._reader.read(self.wire.read_from))
        if self.guard is not None:
            return self.guard.received(arrivals, clock_ns(), Counter() if refused is None else refused, is_another)
        return arrivals

    def arrivals(self, batch: Batch) -> Arrivals:
        self.send_errors += batch.errors  # a port was closed to an earlier datagram; the vehicle will count as silent
        table = batch.table[:4]
        table[2] |= self.wire.networks[batch.table[4]] << NETWORK_BIT
        return Arrivals(batch.stream, table, batch.read_ns - table[3])

    def send(self, outgoing: Outbox | Sequence[Outgoing]) -> Arrivals:
        """Send datagrams; returns them unsigned, with the time at which each was handed to the kernel."""
        outbox = outgoing if isinstance(outgoing, Outbox) else Outbox(outgoing)
        return self._send(outbox) if len(outbox) else self._nothing

    def _send(self, outbox: Outbox) -> Arrivals:
        stream, table = outbox.packed()
        signed, (begins, ends, addresses, _) = (
            (stream, table) if self.guard is None else Outbox(self.guard.sent(outbox, clock_ns())).packed()
        )
        descriptors = self.wire.descriptors[addresses >> NETWORK_BIT]
        table[3], refused, failed = write(
            signed, begins, ends, descriptors, addresses & NUMBER_BITS, self._reader.buffers
        )
        self.send_errors += refused + failed  # full buffers and closed ports are losses: links count them
        return Arrivals(stream, table, np.zeros(len(outbox), np.int64))


def _bound(host: str, port: int, networks: Sequence[int]) -> dict[int, socket.socket]:
    """The bound socket of each network, as described in `StationSocket`."""
    if port or len(networks) == 1:
        return _bound_at(host, port, networks)
    for _ in range(_PORTS_TO_TRY):
        with contextlib.suppress(OSError):
            return _bound_at(host, port, networks)
    return _bound_at(host, port, networks)  # its error is raised


def _bound_at(host: str, port: int, networks: Sequence[int]) -> dict[int, socket.socket]:
    """The bound socket of each network; with port 0 the first takes any free port, which determines the other ports."""
    with contextlib.ExitStack() as opened:
        sockets: dict[int, socket.socket] = {}
        for network in networks:
            own = opened.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            stamped(own).setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
            if port + network > _LAST_PORT:
                raise OSError(errno.EADDRNOTAVAIL, f"there is no port {port + network} for network {network}")
            own.bind((host, port + network if port else 0))
            port = own.getsockname()[1] - network
            sockets[network] = own
        opened.pop_all()
    return sockets


def drive(
    station: Station,
    link: StationSocket,
    writer: RunWriter,
    stop_reason: Callable[[], str],
    new_plan: Callable[[FlightPlan], None],
    mirror: Mirror | None = None,
) -> None:
    """Run the station in real time until its flight has ended.

    `stop_reason` is called at every tick; any text except "" ends the flight for that reason. `new_plan` is called when
    identification has changed the flight plan. A mirror gets every frame received and sent, and may pass frames on to
    the vehicles.
    """
    plan, refusals = station.plan, Refusals()
    is_plain = mirror is None and link.guard is None and station.has_fast_path
    fast = UdpFastPath(station, link.wire, writer.entries) if is_plain else None
    together_ns = station.together_ns if mirror is None else _TOGETHER_NS
    is_light = (
        len(station.vehicles) <= _FEW
        and link.guard is None
        and not waits_for_channels(plan.scenario)
        and station.period_ns - _BEFORE_TICK_NS <= together_ns
    )
    """Whether one wake-up before each tick is enough, both to read datagrams and to send requests and heartbeats."""

    def log_refusals(*, last: bool = False) -> None:
        if counts := refusals.news(station.counters, last=last):
            text = in_words(counts) if last else ", ".join(counts)
            writer.event(Event(time_s=station.scenario_time_s(clock_ns()), kind=REFUSED, text=text, counts=counts))

    while station.phase is not Phase.ENDED:
        # Datagrams are read shortly before the next tick is due: set-points then do not wait for that work.
        read_ns = station.next_tick_ns - _BEFORE_TICK_NS
        wake_ns = read_ns if clock_ns() < read_ns else station.next_tick_ns
        link.wait(wake_ns if is_light else min(wake_ns, station.next_event_ns), together_ns)
        rows = fast.rows if fast is not None and fast.step() else _step(station, link, writer, fast, mirror)
        if rows is None:
            continue
        writer.tick(rows)
        writer.event(*station.events)
        station.events.clear()
        log_refusals()
        if station.plan is not plan:
            plan = station.plan
            new_plan(plan)
        if reason := stop_reason():
            station.request_stop(reason)
            if fast is not None:
                fast.look_again()
    log_refusals(last=True)
    if mirror is not None:
        time_s, counts = station.scenario_time_s(clock_ns()), dict(mirror.counters)
        writer.event(Event(time_s=time_s, kind=MIRROR, text=in_words(counts), counts=counts))


def _step(
    station: Station, link: StationSocket, writer: RunWriter, fast: UdpFastPath | None, mirror: Mirror | None
) -> TickArray | None:
    """Do a step in Python, or finish one that the fast path began; returns the rows of the tick if there was one."""
    if fast is None:
        now_ns = clock_ns()
        if len(station.vehicles) > _FEW and station.next_event_ns <= now_ns < station.next_tick_ns:
            _send(station, link, station.step([], now_ns)[0])  # requests leave in time, before many datagrams are read
        datagrams = link.receive(station.counters, station.is_another)
    else:
        datagrams = link.arrivals(fast.read)
    now_ns = clock_ns()
    outgoing, tick = station.step(datagrams, now_ns, 0 if fast is None else fast.taken)
    sent_ns = _send(station, link, outgoing)
    if mirror is not None:
        mirror.forward([frame for frame, _, _ in station.frames], now_ns)
        link.send(mirror.passed_on(station.vehicles, now_ns))
    writer.frames(station.frames, link.epoch_ns)
    station.frames.clear()
    rows = None if tick is None else station.complete(tick, sent_ns)
    if fast is not None:
        fast.look_again()
    return rows


def _send(station: Station, link: StationSocket, outgoing: Outbox) -> Ints:
    """Send the datagrams of a step; returns when each was sent."""
    sent = link.send(outgoing)
    station.sent(outgoing, sent.table[3])
    station.frames.add(sent)
    return sent.table[3]
