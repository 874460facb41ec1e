"""Hostile datagrams into sockets other than the station's: a mirror's, and those of `--links-only`."""

import socket
from collections.abc import Iterator

import numpy as np
import pytest

from gcs.drive.mirror import Mirror
from gcs.link.startup import LaunchedStartup
from gcs.link.vehicle import RemoteVehicle
from scenarios.files import load
from sim_vehicles.drive.relay_udp import Peers
from sim_vehicles.links.relay import Relay
from tests.support.hostile import SAID_BY_STATIONS, SAID_BY_VEHICLES, any_message, changed, extreme, in_version_1, noise
from tests.support.paths import SCENARIOS
from tests.support.processes import free_port

pytestmark = pytest.mark.realtime
ROUNDS = 60


@pytest.fixture
def other() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind(("127.0.0.1", 0))
        yield own


def hostile(rng: np.random.Generator, messages: list[int], source: int) -> list[bytes]:
    """Some datagrams of every kind, and the start byte of each MAVLink version alone."""
    frames = extreme(rng, 10, messages, source=source, targets=[0, 1, 2, 255])
    frames += any_message(rng, 5, list(range(256)), set())
    frames += [in_version_1(frame) for frame in frames if frame[8:10] == b"\0\0"]
    return [b"", b"\xfe", b"\xfd", *frames, *changed(rng, 10, frames), *noise(rng, 10)]


@pytest.mark.parametrize("commands", [False, True])
def test_a_mirror_under_fire_counts_and_goes_on(other: socket.socket, commands: bool) -> None:
    vehicle = RemoteVehicle(1, startup=LaunchedStartup(1.0))
    vehicle.address, vehicle.armed, vehicle.custom_mode = 9, True, vehicle.kind.guided_mode
    rng = np.random.default_rng(4)
    with Mirror(*other.getsockname(), commands=commands) as mirror:
        mirror.forward([b"hello"], 0)
        _, address = other.recvfrom(100)
        for _ in range(ROUNDS):
            for data in hostile(rng, SAID_BY_STATIONS, 255):
                other.sendto(data, address)
            passed_on = mirror.passed_on([vehicle], 0)
            assert commands or not passed_on
        assert mirror.counters["refused: truncated"] > 0
        assert any(name.startswith("passed on") for name in mirror.counters) == commands


def test_relayed_links_under_fire_count_and_go_on(other: socket.socket) -> None:
    scenario, rng, at = load(SCENARIOS / "chain3.toml"), np.random.default_rng(5), ("127.0.0.1", free_port())
    links, peers = Relay(scenario, 0), Peers([at], other.getsockname())
    passed = 0
    try:
        for step in range(ROUNDS):
            for data in hostile(rng, SAID_BY_VEHICLES, 1 + step % 3):
                other.sendto(data, at)
            left = links.step(peers.receive(), 1 << 62)
            peers.send(left)
            passed += len(left)
        assert peers.sockets.counters["refused_peer"] > 0
        assert passed > ROUNDS
    finally:
        peers.sockets.close()
