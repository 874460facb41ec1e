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
from functools import lru_cache
from typing import Self

import numpy as np

from gcs.control.phases import Phase
from gcs.control.tick import Event
from gcs.drive.guard import Guard
from gcs.drive.mirror import Mirror
from gcs.link.datagram import Address, Arrivals, Datagram, Frames, Outbox, Outgoing
from gcs.plan.expected_delay import waits_for_channels
from gcs.plan.flight_plan import FlightPlan
from gcs.runs.record import MIRROR, RunWriter
from gcs.runs.refusals import REFUSED, Refusals, in_words
from gcs.station.station import Station
from scenarios.networks import LAST_NETWORK
from scenarios.schema import NS_PER_S
from scenarios.sockets import Bytes, Ints, Reader, address_of, number_of, realtime_offset_ns, stamped, write

_MOST_ADDRESSES = 8192
"""Most addresses remembered; a limit is needed because anybody may send."""
_NETWORK_BIT, _ADDRESS_BITS = 48, (1 << 48) - 1
"""First bit of the network in an address's key, and the mask of the bits below, which hold its `number_of`."""
_TOGETHER_NS = 8_000_000
"""Longest time that a datagram usually waits for others, so that they are read in one wake-up."""
_BEFORE_TICK_NS = 2_000_000
"""How long before a tick the sockets are read. In the time left, 250 vehicles send 30 datagrams."""
_FEW = 25
"""So many vehicles need so little work before a tick that requests can be sent then. In a channel with limited
bandwidth, requests would delay the set-points: they are sent between ticks."""
_PORTS_TO_TRY, _LAST_PORT = 100, 65535


def clock_ns() -> int:
    """The station's clock."""
    return time.monotonic_ns()


@lru_cache(maxsize=_MOST_ADDRESSES)
def _key(address: Address | None) -> int:
    """An address and its network packed into one number; 0 for None."""
    return 0 if address is None else address[2] << _NETWORK_BIT | number_of(address[:2])


class _Addresses:
    """Recent addresses of senders and receivers; the number of each is its place in `known`."""

    def __init__(self) -> None:
        self.known: list[Address] = []
        self._numbers: dict[int, int] = {}
        self._vehicles: list[Address | None] = []
        self._keys = np.empty(0, np.int64)
        """Cached keys of the addresses in `_vehicles`: those of all vehicles when they were last sent to."""

    def packed(self, outbox: Outbox) -> tuple[Bytes, Ints]:
        """The datagrams as a stream and a table, with the keys of their addresses."""
        return outbox.packed(_key, self._keys_of)

    def _keys_of(self, vehicles: Sequence[Address | None]) -> Ints:
        if vehicles != self._vehicles:
            self._vehicles, self._keys = [*vehicles], np.array([*map(_key, vehicles)], np.int64)
        return self._keys

    def numbers(self, keys: Ints) -> Ints:
        """The number of each key's address; a new address is added."""
        if len(self.known) > _MOST_ADDRESSES:
            self.known, self._numbers = [], {}
        return np.array([*map(self._number, keys.tolist())], np.int64)

    def _number(self, key: int) -> int:
        if key not in self._numbers:
            self._numbers[key] = len(self.known)
            network, number = divmod(key, 1 << _NETWORK_BIT)
            self.known.append((*address_of(number), network))
        return self._numbers[key]


class StationSocket:
    """A bound UDP socket for each network, with kernel receive stamps; with a guard, frames are signed and verified.

    `port` is that of network 0, even if that network has no vehicles; network k listens at `port` + k. With port 0,
    free ports are found. Raises OSError if an address cannot be bound.
    """

    def __init__(self, host: str, port: int, guard: Guard | None = None, networks: Sequence[int] = (0,)) -> None:
        self.guard, self.networks = guard, networks
        self._reader, self._addresses = Reader(), _Addresses()
        self._reader.read([])  # compiles it before the flight
        self._sockets = _bound(host, port, networks)
        self._descriptors = np.zeros(LAST_NETWORK + 1, np.int64)
        """Descriptor of each network's socket."""
        for network, own in self._sockets.items():
            self._descriptors[network] = own.fileno()
        self._read_from = self._descriptors[[*networks]]
        self._wait_for = self._read_from.tolist()
        self._networks = np.zeros(self._descriptors.max() + 1, np.int64)
        """Network of each descriptor."""
        self._networks[self._read_from] = networks
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
        batch = self._reader.read(self._read_from)
        self.send_errors += batch.errors  # a port was closed to an earlier datagram; the vehicle will count as silent
        table = batch.table[:4]
        table[2] = self._addresses.numbers(table[2] | self._networks[batch.table[4]] << _NETWORK_BIT)
        arrivals = Arrivals(batch.stream, table, batch.read_ns - table[3], self._addresses.known)
        if self.guard is not None:
            return self.guard.received(arrivals, clock_ns(), Counter() if refused is None else refused, is_another)
        return arrivals

    def send(self, outgoing: Outbox | Sequence[Outgoing]) -> Arrivals:
        """Send datagrams; returns them unsigned, with the time at which each was handed to the kernel."""
        outbox = outgoing if isinstance(outgoing, Outbox) else Outbox(outgoing)
        return self._send(outbox) if len(outbox) else self._nothing

    def _send(self, outbox: Outbox) -> Arrivals:
        stream, table = self._addresses.packed(outbox)
        signed = (
            (stream, table)
            if self.guard is None
            else self._addresses.packed(Outbox(self.guard.sent(outbox, clock_ns())))
        )
        begins, ends, keys, _ = signed[1]
        descriptors = self._descriptors[keys >> _NETWORK_BIT]
        sent_ns, refused, failed = write(signed[0], begins, ends, descriptors, keys & _ADDRESS_BITS)
        self.send_errors += refused + failed  # full buffers and closed ports are losses: links count them
        table[2], table[3] = self._addresses.numbers(table[2]), sent_ns
        return Arrivals(stream, table, np.zeros(len(sent_ns), np.int64), self._addresses.known)


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
    plan = station.plan
    log = Frames()
    """Frames received and sent since the last tick, in order."""
    refusals = Refusals()
    together_ns = station.together_ns if mirror is None else _TOGETHER_NS
    is_light = (
        len(station.vehicles) <= _FEW
        and link.guard is None
        and not waits_for_channels(plan.scenario)
        and NS_PER_S / plan.scenario.rates.control_hz - _BEFORE_TICK_NS <= together_ns
    )
    """Whether one wake-up before each tick is enough, both to read datagrams and to send requests and heartbeats."""

    def log_refusals(now_ns: int, *, last: bool = False) -> None:
        if counts := refusals.news(station.counters, last=last):
            text = in_words(counts) if last else ", ".join(counts)
            writer.event(Event(time_s=station.scenario_time_s(now_ns), kind=REFUSED, text=text, counts=counts))

    while station.phase is not Phase.ENDED:
        # Datagrams are read shortly before the next tick is due: set-points then do not wait for that work.
        read_ns = station.next_tick_ns - _BEFORE_TICK_NS
        wake_ns = read_ns if clock_ns() < read_ns else station.next_tick_ns
        link.wait(wake_ns if is_light else min(wake_ns, station.next_event_ns), together_ns)
        now_ns = clock_ns()
        requests = Outbox()
        if not is_light and station.next_event_ns <= now_ns < station.next_tick_ns:
            requests = station.step([], now_ns)[0]  # before many datagrams are read, to send them in time
            log.add(sent := link.send(requests))
            station.sent(requests, sent.table[3])
        datagrams = link.receive(station.counters, station.is_another)
        now_ns = clock_ns()
        outgoing, tick = station.step(datagrams, now_ns)
        sent = link.send(outgoing)
        station.sent(outgoing, sent.table[3])
        if mirror is not None:
            mirror.forward([frame[0] for frames in (station.frames, requests, outgoing) for frame in frames], now_ns)
            link.send(mirror.passed_on(station.vehicles, now_ns))
        log.take(station.frames)
        log.add(sent)
        if tick is None:
            continue
        writer.tick(station.complete(tick, sent.table[3]))
        writer.frames(log, realtime_offset_ns())
        writer.event(*station.events)
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
