"""`sim-vehicles --links-only`: the scenario's links in front of vehicles that are somebody else's."""

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Generator, Iterable
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from scenarios import schema
from scenarios.files import dump
from scenarios.keys import link as link_keys
from scenarios.keys.link import Jitter, Links
from sim_vehicles.drive.relay_udp import MOST_PEERS, Peers
from sim_vehicles.links.links import CAPACITY, LinkSet
from sim_vehicles.links.relay import InTransit, Relay, holds_key, sender
from sim_vehicles.links.truth import CORRUPTED, DUPLICATE, LINK_DOWN, LINK_UP, LOST, MemoryRecorder, read_truth
from sim_vehicles.services.clock import NEVER_NS
from tests.support.processes import free_port
from tests.support.sim_client import MS, SECOND, START, heartbeat, scenario, setpoint

WILD = link_keys.Link(
    delay_s=0.02,
    jitter=Jitter(distribution="uniform", scale_s=0.005),
    reordering=True,
    loss_probability=0.2,
    duplicate_probability=0.1,
    corrupt_probability=0.1,
)


def wild(seed: int = 1) -> schema.Scenario:
    return scenario(2, seed=seed).model_copy(update={"links": Links(up=WILD, down=WILD)})


def frame(system_id: int, sequence: int = 0, *, version: int = 2, component: int = 1) -> bytes:
    """A heartbeat of an autopilot, by pymavlink."""
    mav = dialect.MAVLink(None, srcSystem=system_id, srcComponent=component)
    mav.seq = sequence & 0xFF
    return dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3).pack(mav, force_mavlink1=version == 1)


def through(relay: Relay, sent: Iterable[InTransit], *, every_ns: int = MS) -> list[InTransit]:
    """What comes out when the relay is called every so often."""
    waiting = sorted(sent)
    out: list[InTransit] = []
    now_ns = START
    while waiting or relay.next_event_ns != NEVER_NS:
        now_ns += every_ns
        entering = [passing for passing in waiting if passing.time_ns <= now_ns]
        del waiting[: len(entering)]
        out += relay.step(entering, now_ns)
    return out


def test_the_sender_is_read_from_the_header_alone() -> None:
    assert sender(frame(17)) == sender(frame(17, version=1)) == 17
    assert sender(frame(255)) is None  # a station
    assert sender(frame(17, component=191)) is sender(frame(17, version=1, component=191)) is None  # a companion
    assert [sender(data) for data in (b"", b"\xfd", b"\xfe" * 7, b"\xfd" * 11, b"\0" * 40)] == [None] * 5


@given(st.binary(max_size=300))
def test_no_datagram_makes_the_relay_stumble(data: bytes) -> None:
    assert sender(data) in {None, *range(1, 251)}
    relay = Relay(scenario(1), START)
    assert through(relay, [InTransit(START, LINK_UP, 1, data), InTransit(START, LINK_DOWN, 1, data)])


@pytest.mark.parametrize("kind", [LINK_UP, LINK_DOWN])
def test_a_relayed_datagram_has_the_fate_of_a_simulated_one(kind: int) -> None:
    sent = [InTransit(START + k * 2 * MS, kind, 2, frame(2, k)) for k in range(500)]
    recorder = MemoryRecorder()
    came = through(Relay(wild(), START, recorder=recorder), sent)
    alone = LinkSet(wild(), START).of(2)[kind != LINK_UP]
    for passing in sent:
        alone.send(passing.data, passing.time_ns)
    assert [(p.time_ns, p.data) for p in came] == [(entry[0], entry[3]) for entry in alone.due(NEVER_NS)]
    fates = recorder.records["fate"]
    assert len(fates) == len(came) + alone.dropped  # every datagram has its record
    for fate, share in ((LOST, 0.2), (DUPLICATE, 0.08), (CORRUPTED, 0.08)):  # 0.1 of those not lost
        # four standard errors of a share of 500
        assert np.mean(fates & fate != 0) == pytest.approx(share, abs=4 * (share * (1 - share) / 500) ** 0.5)


def test_how_often_the_relay_is_called_changes_nothing() -> None:
    sent = [InTransit(START + k * MS, kind, 1, frame(1, k)) for k in range(200) for kind in (LINK_UP, LINK_DOWN)]
    rare, often = (through(Relay(wild(), START), sent, every_ns=every_ns) for every_ns in (SECOND, MS // 3))
    assert sorted(rare) == sorted(often)


def test_a_flood_beyond_capacity_is_dropped_and_counted() -> None:
    relay = Relay(scenario(1, up_s=10.0), START)
    came = through(relay, (InTransit(START, LINK_UP, 1, frame(1, k)) for k in range(CAPACITY + 500)), every_ns=SECOND)
    assert len(came) == CAPACITY
    assert relay.counters["link_up_link_full"] == 500


def test_the_links_time_begins_with_the_stations_first_set_point() -> None:
    ramp = link_keys.Link(
        delay_points=(link_keys.DelayPoint(at_s=0.0, delay_s=0.1), link_keys.DelayPoint(at_s=1.0, delay_s=0.3))
    )
    late = scenario(1).model_copy(update={"links": Links(up=ramp, down=ramp)})
    sent = [
        InTransit(START, LINK_UP, 1, frame(1)),
        InTransit(START + 5 * SECOND, LINK_DOWN, 1, setpoint(1.0)),
        InTransit(START + 5 * SECOND + SECOND // 2, LINK_UP, 1, frame(1)),
    ]
    delays = [p.time_ns - s.time_ns for p, s in zip(through(Relay(late, START), sent), sent, strict=True)]
    assert delays == pytest.approx([100 * MS, 100 * MS, 200 * MS], abs=1)


# -- on real sockets ---------------------------------------------------------------------------------------------------


def a_socket() -> socket.socket:
    own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    own.bind(("127.0.0.1", 0))
    own.settimeout(10.0)
    return own


@contextmanager
def running(
    flown: schema.Scenario, station: socket.socket, folder: Path
) -> Generator[tuple[int, subprocess.Popen[str]]]:
    """`sim-vehicles --links-only` in front of one vehicle port; it does not outlive the test."""
    (folder / "links.toml").write_text(dump(flown))
    port = free_port()
    station_at = f"127.0.0.1:{station.getsockname()[1]}"
    command = [sys.executable, "-m", "sim_vehicles.drive.cli", str(folder / "links.toml"), "--links-only"]
    with subprocess.Popen(
        [
            *(*command, "--vehicle-port", str(port), "--station", station_at),
            *("--truth", str(folder / "truth"), "--counters", str(folder / "counters.json")),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            assert "links of test" in process.stdout.readline()
            yield port, process
        finally:
            process.kill()


def ended(process: subprocess.Popen[str]) -> str:
    process.send_signal(signal.SIGTERM)
    out, errors = process.communicate(timeout=20)
    assert (process.returncode, errors) == (0, "")
    return out


@pytest.mark.realtime
def test_relayed_vehicles_and_station_communicate_and_truth_is_logged(tmp_path: Path) -> None:
    with ExitStack() as opened:
        station, one, two, stranger = (opened.enter_context(a_socket()) for _ in range(4))
        port, process = opened.enter_context(running(scenario(2, up_s=0.03, down_s=0.01), station, tmp_path))
        relay = ("127.0.0.1", port)
        stranger.sendto(b"\0" * 40, relay)  # no frame, so of no vehicle
        stranger.sendto(frame(255), relay)  # a station is no vehicle
        addresses: dict[int, tuple[str, int]] = {}
        for system_id, own in ((1, one), (2, two)):
            own.sendto(frame(system_id), relay)
            data, addresses[system_id] = station.recvfrom(2048)
            assert data == frame(system_id)
        assert addresses[1] != addresses[2]
        one.sendto(garbage := b"\xff" * 200, relay)  # from a known peer: passed on, and left to the station
        assert station.recvfrom(2048) == (garbage, addresses[1])
        for system_id, own in ((2, two), (1, one)):
            station.sendto(wanted := setpoint(float(system_id)), addresses[system_id])
            assert own.recvfrom(2048) == (wanted, relay)
        with a_socket() as again:  # the vehicle was started anew, at another port
            station.settimeout(0.5)
            again.sendto(frame(2, 7), relay)
            while (got := received(station)) is None:  # for 1.5 s it may be another sender that claims this id
                again.sendto(frame(2, 7), relay)
            assert got == (frame(2, 7), addresses[2])
            station.sendto(wanted := heartbeat(), addresses[2])
            assert again.recvfrom(2048)[0] == wanted
        one.sendto(frame(1, 9), relay)
        assert station.recvfrom(2048) == (frame(1, 9), addresses[1])
        stranger.sendto(frame(1), relay)
        key = dialect.MAVLink_setup_signing_message(1, 1, [7] * 32, 0)
        one.sendto(frame(1) + key.pack(dialect.MAVLink(None, srcSystem=1)), relay)
        assert received(station) is None
        out = ended(process)
    assert "vehicle 1: found at 127.0.0.1" in out
    assert "refused_peer 2" in out
    assert "refused_setup_signing 1" in out
    counted = dict(part.split() for part in out.split("received: ")[-1].strip().split(", "))
    assert int(counted["refused_second_source"]) >= 2  # before the silence, and the stranger
    assert json.loads((tmp_path / "counters.json").read_text()) == {name: int(count) for name, count in counted.items()}
    truth = read_truth(tmp_path / "truth")
    for kind, delay_ns, count in ((LINK_UP, 30 * MS, 5), (LINK_DOWN, 10 * MS, 3)):
        own = truth[truth["kind"] == kind]
        assert own.size == count
        assert (own["due_ns"] - own["entered_ns"] == delay_ns).all()
        assert (own["time_ns"] >= own["due_ns"]).all()


@pytest.mark.realtime
def test_what_a_peer_gets_is_what_the_truth_says(tmp_path: Path) -> None:
    """400 datagrams each way over a link that loses, doubles, corrupts and reorders."""
    with ExitStack() as opened:
        station, vehicle = (opened.enter_context(a_socket()) for _ in range(2))
        port, process = opened.enter_context(running(wild(seed=4), station, tmp_path))
        relay = ("127.0.0.1", port)
        arrived: dict[int, list[bytes]] = {LINK_UP: [], LINK_DOWN: []}
        known, sent_down = None, set[bytes]()
        for k in range(400):
            vehicle.sendto(frame(1, k), relay)
            for own, kind in ((station, LINK_UP), (vehicle, LINK_DOWN)):
                own.settimeout(0.002)
                while (got := received(own)) is not None:
                    arrived[kind].append(got[0])
                    known = got[1] if own is station else known
            if known is not None:
                sent_down.add(beat := heartbeat())
                station.sendto(beat, known)
        for own, kind in ((station, LINK_UP), (vehicle, LINK_DOWN)):
            own.settimeout(0.5)
            while (got := received(own)) is not None:
                arrived[kind].append(got[0])
        ended(process)
    truth = read_truth(tmp_path / "truth")
    for kind, good in ((LINK_UP, {frame(1, k) for k in range(256)}), (LINK_DOWN, sent_down)):
        own = truth[truth["kind"] == kind]
        left = own[own["fate"] & LOST == 0]
        assert left.size == len(arrived[kind]) > 200
        assert np.sum(left["fate"] & CORRUPTED != 0) == sum(data not in good for data in arrived[kind]) > 0
        assert np.sum(own["fate"] & LOST != 0) > 40  # of some 400, a fifth
        delay_ns = left["due_ns"] - left["entered_ns"]
        assert 15 * MS <= delay_ns.min() < 17 * MS < 23 * MS < delay_ns.max() <= 25 * MS


def received(own: socket.socket) -> tuple[bytes, tuple[str, int]] | None:
    try:
        return own.recvfrom(2048)
    except TimeoutError:
        return None


@pytest.mark.realtime
def test_strangers_take_no_memory_beyond_the_bound() -> None:
    with a_socket() as station:
        peers = Peers([("127.0.0.1", port := free_port())], station.getsockname(), silence_ns=0)
        try:
            admitted = 0
            for k in range(MOST_PEERS + 50):
                with a_socket() as vehicle:  # each from a port of its own
                    vehicle.sendto(frame(k % 250 + 1), ("127.0.0.1", port))
                peers.sockets.wait(NEVER_NS)
                admitted += len(peers.receive())
            assert admitted + peers.sockets.counters["refused_peer"] == MOST_PEERS + 50
            # The kernel may give a port twice; then it is a known peer.
            found = peers.take_changes()
            assert len(found) == min(MOST_PEERS, len(found)) > MOST_PEERS * 3 // 4
            assert len({change.system_id for change in found}) <= 250
        finally:
            peers.sockets.close()


@pytest.mark.parametrize("before", [b"", b"\0", b"\xfd", b"\xfe\x09", heartbeat(), heartbeat()[:-1]])
def test_a_key_is_found_wherever_in_a_datagram_it_begins(before: bytes) -> None:
    """A receiver that looks for the next magic reads what follows a stray byte, a MAVLink 1 frame or a cut one."""
    key = dialect.MAVLink_setup_signing_message(1, 1, [7] * 32, 0).pack(dialect.MAVLink(None, srcSystem=255))
    assert holds_key(before + bytes(key))
    assert not holds_key(before + setpoint(1.0))
