"""The vehicles' real-time driver on real sockets."""

import select
import socket
import statistics
import time  # noqa: TID251 - what is tested here is the clock
from collections.abc import Generator
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_vehicles.drive.udp import Ports

pytestmark = pytest.mark.realtime
MS = 1_000_000


def heartbeat(source: int) -> bytes:
    link: Any = dialect.MAVLink(None, srcSystem=source % 1000)
    return bytes(link.heartbeat_encode(2, 3, 1, 0, 3).pack(link))


@pytest.fixture
def station() -> Generator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind(("127.0.0.1", 0))
        own.settimeout(5.0)
        yield own


@pytest.fixture
def ports(station: socket.socket) -> Generator[Ports]:
    opened = Ports((1, 7), station.getsockname())
    yield opened
    opened.sockets.close()


def test_each_vehicle_has_a_port_where_answers_come_back(station: socket.socket, ports: Ports) -> None:
    ports.send([(1, b"one", 0), (7, b"seven", 0)])
    addresses = dict((station.recvfrom(100), station.recvfrom(100)))
    assert addresses[b"one"] != addresses[b"seven"]
    station.sendto(b"to seven", addresses[b"seven"])
    station.sendto(b"to one", addresses[b"one"])
    received: set[tuple[int, bytes]] = set()
    while len(received) < 2:
        ports.sockets.wait(time.monotonic_ns() + 5000 * MS)
        received |= {(system_id, data) for system_id, data, _ in ports.receive()}
    assert received == {(1, b"to one"), (7, b"to seven")}
    assert not len(ports.receive())


def test_datagrams_bear_their_time_of_arrival_not_of_reading(station: socket.socket, ports: Ports) -> None:
    ports.send([(1, b"x", 0)])
    _, address = station.recvfrom(100)
    errors_ns: list[int] = []
    for _ in range(20):
        before_ns = time.monotonic_ns()
        station.sendto(b"stamped", address)
        after_ns = time.monotonic_ns()
        select.select([], [], [], 0.01)  # the reader is busy with something else for 10 ms
        ((_, _, time_ns),) = ports.receive()
        assert time_ns >= before_ns - MS // 10  # the two clocks are compared to some µs
        errors_ns.append(time_ns - after_ns)
    assert statistics.median(errors_ns) < MS  # a loaded host may stop us between any two lines, but rarely does


def test_only_the_station_is_listened_to(station: socket.socket, ports: Ports) -> None:
    ports.send([(1, b"x", 0)])
    _, address = station.recvfrom(100)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b"obey me", address)
    station.sendto(b"station", address)
    ports.sockets.wait(time.monotonic_ns() + 5000 * MS)
    assert [data for _, data, _ in ports.receive()] == [b"station"]


def test_it_waits_until_the_instant_and_never_returns_early(ports: Ports) -> None:
    late_ns: list[int] = []
    for _ in range(20):
        until_ns = time.monotonic_ns() + 3 * MS + MS // 10
        ports.sockets.wait(until_ns)
        late_ns.append(time.monotonic_ns() - until_ns)
    assert min(late_ns) >= 0
    # The best, because a loaded host delays most. A time-out rounded up to whole milliseconds is never below 0.9 ms.
    assert min(late_ns) < MS // 2


def test_a_datagram_ends_the_wait(station: socket.socket, ports: Ports) -> None:
    ports.send([(1, b"x", 0)])
    _, address = station.recvfrom(100)
    station.sendto(b"wake up", address)
    begin_ns = time.monotonic_ns()
    ports.sockets.wait(begin_ns + 5000 * MS)
    assert time.monotonic_ns() - begin_ns < 4000 * MS
    assert [data for _, data, _ in ports.receive()] == [b"wake up"]


def test_a_dead_station_is_counted_and_its_successor_is_found(station: socket.socket, ports: Ports) -> None:
    address = station.getsockname()
    station.close()
    for _ in range(3):
        ports.send([(1, b"anyone?", 0)])
        ports.sockets.wait(time.monotonic_ns() + 5000 * MS)  # woken by the refusal
        assert not len(ports.receive())
    assert ports.sockets.counters["send_refused"] + ports.sockets.counters["receive_refused"] >= 3
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as restarted:
        restarted.bind(address)
        restarted.settimeout(5.0)
        ports.send([(1, b"again", 0)])
        assert restarted.recvfrom(100)[0] == b"again"


def test_vehicles_at_one_port_get_what_is_addressed_to_them(station: socket.socket) -> None:
    opened = Ports((1, 7, 9), station.getsockname(), one_port=True)
    link: Any = dialect.MAVLink(None, srcSystem=255)
    try:
        opened.send([(1, heartbeat(1), 0), (7, heartbeat(7), 0)])
        data, address = station.recvfrom(2000)
        assert data == heartbeat(1) + heartbeat(7)
        beat = link.heartbeat_encode(6, 8, 0, 0, 4).pack(link)
        to_7, to_all = (link.command_long_encode(own, 1, 400, 0, *[1.0] * 7).pack(link) for own in (7, 0))
        elsewhere = link.command_long_encode(8, 1, 400, 0, *[1.0] * 7).pack(link)
        text = link.statustext_encode(6, b"to nobody").pack(link)
        station.sendto(to_7 + beat + to_all + elsewhere + text, address)
        wanted = [(7, to_7), *((own, beat) for own in (1, 7, 9)), *((own, to_all) for own in (1, 7, 9))]
        opened.sockets.wait(time.monotonic_ns() + 5000 * MS)
        received = [(system_id, data) for system_id, data, _ in opened.receive()]
        assert received == [*wanted, (1, elsewhere), (1, text)]
    finally:
        opened.sockets.close()


def test_networks_at_one_port_each_reach_their_own_station_port(station: socket.socket) -> None:
    host, port = station.getsockname()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as next_network:
        next_network.bind((host, port + 1))
        next_network.settimeout(5.0)
        opened = Ports((1, 2, 1001, 1002), (host, port), one_port=True)
        try:
            opened.send([(key, heartbeat(key), 0) for key in (1, 1001, 2, 1002)])
            assert station.recv(2000) == heartbeat(1) + heartbeat(2)
            assert next_network.recv(2000) == heartbeat(1) + heartbeat(2)
        finally:
            opened.sockets.close()
