"""Signing as a user meets it: real processes, real UDP on loopback, and pymavlink's signing at the other end."""

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time  # noqa: TID251 - waits for processes, with time-outs
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.drive.guard import Guard
from gcs.drive.udp import StationSocket, clock_ns
from gcs.plan.planner import flight_plan
from gcs.station.station import Station
from scenarios.files import load
from scenarios.schema import FixedGains
from scenarios.signing.keys import Key, make_key, read_key
from scenarios.signing.stamps import Stamps, open_stamps
from scenarios.sockets import realtime_offset_ns
from tests.support.paths import SCENARIOS
from tests.support.processes import PATIENCE_S, children_named, fly, flying, free_port, gcs, short, until
from tests.support.signed_peer import KEY, OTHER_KEY, position

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("realtime")]


def now_stamp() -> int:
    return (time.time_ns() - 1_420_070_400 * 10**9) // 10_000


def a_peer(key: bytes | None, system: int, component: int = 1) -> Any:
    """A MAVLink system of pymavlink's as its users set it up: see mavutil.setup_signing."""
    mav: Any = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
    mav.robust_parsing = True
    if key is not None:
        mav.signing.secret_key, mav.signing.sign_outgoing = key, True
        mav.signing.timestamp = now_stamp()
    return mav


def packed(mav: Any, message: dialect.MAVLink_message) -> bytes:
    data: bytes = message.pack(mav)
    mav.seq = (mav.seq + 1) % 256
    return data


def holds_key(folder: Path, secret: bytes) -> list[str]:
    """Files of a folder that contain a key, as bytes or as text."""
    forms = (secret, secret.hex().encode(), repr(secret).encode())
    files = [file for file in folder.rglob("*") if file.is_file()]
    return [file.name for file in files if any(form in file.read_bytes() for form in forms)]


def test_under_attack_a_signed_flight_is_stable_and_reports_refusals(tmp_path: Path) -> None:
    key_file, folder, port = tmp_path / "formation.key", tmp_path / "run", free_port()
    make_key(key_file)
    process = fly(
        short(tmp_path, "triangle5", 8.0), "--listen", f"127.0.0.1:{port}", "--key", key_file, "--out", folder
    )
    until(lambda: flying(folder, 0.5))
    hostile = [
        position(a_peer(None, system=2)),
        position(a_peer(OTHER_KEY, system=2)),
        position(a_peer(None, system=77)),
        dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(a_peer(None, system=2), force_mavlink1=True),
        dialect.MAVLink_setup_signing_message(2, 1, list(OTHER_KEY), 0).pack(a_peer(OTHER_KEY, system=2)),
    ]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for data in hostile * 20:
            stranger.sendto(data, ("127.0.0.1", port))
    out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, err) == (0, "")
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["verdict"] == "stable"
    assert summary["refused"] == {"unsigned": 40, "wrong signature": 20, "MAVLink 1": 20, "SETUP_SIGNING": 20}
    assert summary["refused_by_vehicles"] == {}
    assert "refused  by the station: 40 unsigned, 20 wrong signature, 20 MAVLink 1, 20 SETUP_SIGNING" in out
    secret = read_key(key_file).secret
    assert holds_key(tmp_path, secret) == ["formation.key"]
    assert secret.hex() not in out
    assert holds_key(folder, OTHER_KEY) == []  # nor one that was sent to us


def test_after_a_kill_another_station_with_the_key_takes_over(tmp_path: Path) -> None:
    key_file, first, second = (tmp_path / name for name in ("key", "first", "second"))
    make_key(key_file)
    scenario, listen = short(tmp_path, "chain3", 4.0), f"127.0.0.1:{free_port()}"
    process = fly(scenario, "--listen", listen, "--key", key_file, "--out", first)
    until(lambda: flying(first, 3.0))
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    try:
        again = gcs("fly", scenario, "--listen", listen, "--key", key_file, "--out", second, "--json")
        assert (again.returncode, again.stderr) == (0, "")
        assert json.loads(again.stdout)["refused"] == {}
        assert not (second / "vehicles.log").exists()  # it started none
    finally:
        for pid in children_named(str(first)):
            os.kill(pid, signal.SIGTERM)


def test_vehicles_whose_timestamps_are_taken_end_the_flight_saying_so(
    tmp_path: Path,
) -> None:
    key_file = tmp_path / "key"
    make_key(key_file)
    held = open_stamps(tmp_path / "key.vehicles")  # as by vehicles at another port
    options = ("--listen", f"127.0.0.1:{free_port()}", "--key", key_file, "--out", tmp_path / "run", "--json")
    summary = json.loads(gcs("fly", short(tmp_path, "chain3", 1.0), *options).stdout)
    said = f"{tmp_path}/key.vehicles: another process uses it, wanted a separate key for each process"
    assert (summary["verdict"], summary["reason"]) == ("aborted", f"vehicles ended: sim-vehicles: {said}")
    assert len(held.known) == 0


@pytest.mark.parametrize("signed", [False, True])
def test_an_unsigned_port_that_others_can_reach_is_warned_of(tmp_path: Path, signed: bool) -> None:
    make_key(tmp_path / "key")
    key = ["--key", tmp_path / "key"] if signed else []
    options = ("--listen", "0.0.0.0:0", *key, "--out", tmp_path / "run", "--json")
    err = gcs("fly", short(tmp_path, "chain3", 0.2), *options).stderr
    warned = err.startswith("warning: 0.0.0.0:") and err.endswith("--key\n") and err.count("\n") == 1
    assert (warned, err == "") == (not signed, signed)


@contextmanager
def signed_vehicles(tmp_path: Path, station_port: int) -> Generator[None]:
    key_file = tmp_path / "vehicles.key"
    key_file.write_bytes(KEY)
    key_file.chmod(0o600)
    command = [sys.executable, "-m", "sim_vehicles.drive.cli", str(SCENARIOS / "chain3.toml"), "--key", str(key_file)]
    process = subprocess.Popen(
        [*command, "--station", f"127.0.0.1:{station_port}", "--duration", "30"], stdout=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


def test_monitors_with_the_key_are_answered_and_others_only_hear(tmp_path: Path) -> None:
    port = free_port()
    with signed_vehicles(tmp_path, port):
        watch = [
            sys.executable,
            "-m",
            "gcs",
            "monitor",
            "--listen",
            f"127.0.0.1:{port}",
            "--for",
            "2",
            "--json",
        ]
        for key, status in ((["--key", str(tmp_path / "vehicles.key")], "measured"), ([], "no exchange")):
            done = subprocess.run([*watch, *key], capture_output=True, text=True, timeout=PATIENCE_S, check=False)
            assert (done.returncode, done.stderr) == (0, "")
            report = json.loads(done.stdout)
            assert [vehicle["status"] for vehicle in report["vehicles"]] == [status] * 3
            assert report["refused"] == {}


def answers(link: socket.socket, mav: Any, data: bytes, address: Any, wanted: str, patience_s: float) -> Any:
    """The first message of a type that comes from an address after data was sent there, None if none does."""
    link.sendto(data, address)
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        if not select.select([link], [], [], 0.05)[0]:
            continue
        received, sender = link.recvfrom(2048)
        for message in mav.parse_buffer(received) or []:
            if sender == address and message.get_type() == wanted:
                return message
    return None


def test_only_a_pymavlink_station_with_the_key_commands_our_vehicles(tmp_path: Path) -> None:
    arm = dialect.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", 0))
        with signed_vehicles(tmp_path, link.getsockname()[1]):
            station, address = a_peer(KEY, 255, 190), None
            deadline = time.monotonic() + PATIENCE_S
            while address is None and time.monotonic() < deadline:
                received, sender = link.recvfrom(2048)
                for message in station.parse_buffer(received) or []:
                    if message.get_srcSystem() == 1:
                        assert message.get_signed()
                        address = sender
            for wrong in (a_peer(None, 255, 190), a_peer(OTHER_KEY, 255, 190)):
                assert answers(link, station, packed(wrong, arm), address, "COMMAND_ACK", 0.5) is None
            ack = answers(link, station, packed(station, arm), address, "COMMAND_ACK", PATIENCE_S)
            assert (ack.command, ack.result, ack.get_signed()) == (400, 0, True)
            assert station.signing.badsig_count == 0
            assert station.signing.goodsig_count > 5


def test_our_station_flies_a_pymavlink_vehicle_only_with_the_key() -> None:
    """Only until the station has sent its requests: for the vehicle's clock, its telemetry rate, its mode."""
    scenario = load(SCENARIOS / "chain3.toml")
    gains = scenario.control.model_copy(update={"gains": FixedGains(K1=-3.4, K2=0.6, K3=5.6)})
    _, plan = flight_plan(scenario.model_copy(update={"control": gains}))
    vehicle, spoofer = a_peer(KEY, 1), a_peer(OTHER_KEY, 2)
    asked: set[str] = set()
    with (
        StationSocket("127.0.0.1", 0) as link,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own,
    ):
        guard = Guard(Key(KEY), epoch_ns=realtime_offset_ns(), stamps=Stamps())
        station = Station(plan, start_ns=clock_ns())
        own.connect(link.address)
        own.setblocking(False)
        heartbeat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
        deadline = time.monotonic() + PATIENCE_S
        next_s = 0.0
        while (len(asked) < 4 or station.vehicles[0].clock.rtt_ns is None) and time.monotonic() < deadline:
            if time.monotonic() > next_s:
                next_s = time.monotonic() + 0.5
                own.send(packed(vehicle, heartbeat))
                own.send(packed(spoofer, heartbeat))
            link.wait(station.next_event_ns)
            now_ns = clock_ns()
            outgoing, _ = station.step(
                guard.received(link.receive(), now_ns, station.counters, station.is_another), now_ns
            )
            link.send(guard.sent(outgoing, now_ns))
            while select.select([own], [], [], 0)[0]:
                for message in vehicle.parse_buffer(own.recv(2048)) or []:
                    assert message.get_signed()
                    asked.add(message.get_type())
                    if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                        asked.add("answered")
                        own.send(packed(vehicle, dialect.MAVLink_timesync_message(clock_ns(), message.ts1)))
        assert asked >= {"HEARTBEAT", "TIMESYNC", "COMMAND_LONG", "answered"}
        assert station.vehicles[0].clock.rtt_ns is not None
        assert station.vehicles[1].address is None
        assert set(station.counters) == {"wrong signature"}
        assert vehicle.signing.badsig_count == 0
