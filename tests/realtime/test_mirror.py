"""A flight forwarded to another ground station: all of it, and nothing back unless asked for."""

import json
import socket
import threading  # noqa: TID251 - stands for another process
from collections import Counter
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.telemetry import Telemetry
from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.autopilot.kinds import ARDUCOPTER
from gcs.autopilot.startup import AutopilotStartup
from gcs.drive.guard import Guard
from gcs.drive.mirror import Mirror
from gcs.link import mavlink
from gcs.link.startup import LaunchedStartup
from gcs.link.vehicle import RemoteVehicle
from gcs.runs.files import read_ticks
from gcs.watch.tlog import read_tlog
from scenarios.files import dump, load
from scenarios.signing.keys import Key
from scenarios.signing.stamps import Stamps
from tests.support.fleets.flown_fleet import until
from tests.support.paths import ROOT
from tests.support.processes import gcs
from tests.support.signed_peer import EPOCH_NS, KEY, NOW_NS, a_sender

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("processes")]

PROBE = 31000
"""A command that nobody else sends."""


class Listener:
    """Another ground station, plain pymavlink: hears everything, and now and then sends a heartbeat and a command."""

    def __init__(self, system_id: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.2)
        self.heard: list[bytes] = []
        self.stop = False
        self._mav = dialect.MAVLink(None, srcSystem=system_id, srcComponent=190)

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.socket.getsockname()[1]}"

    def run(self) -> None:
        while not self.stop:
            try:
                data, station = self.socket.recvfrom(2048)
            except TimeoutError:
                continue
            self.heard.append(data)
            if len(self.heard) % 200 == 1:
                heartbeat = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
                command = dialect.MAVLink_command_long_message(2, 1, PROBE, 0, 0, 0, 0, 0, 0, 0, 0)
                for message in (heartbeat, command):
                    self.socket.sendto(message.pack(self._mav), station)


@contextmanager
def listening(system_id: int = 245) -> Generator[Listener]:
    listener = Listener(system_id)
    thread = threading.Thread(target=listener.run)
    thread.start()
    try:
        yield listener
    finally:
        listener.stop = True
        thread.join()
        listener.socket.close()


def fly(tmp_path: Path, *arguments: str) -> tuple[dict[str, Any], Path]:
    """A flight of chain3 for three seconds: its summary and its folder."""
    scenario = load(ROOT / "scenarios" / "chain3.toml").model_copy(update={"duration_s": 3.0})
    file, run = tmp_path / "chain3.toml", tmp_path / "run"
    file.write_text(dump(scenario), encoding="utf-8")
    done = gcs("fly", file, "--listen", "127.0.0.1:0", "--out", run, "--json", *arguments)
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads(done.stdout), run


def acknowledged(heard: list[bytes]) -> list[int]:
    """Vehicles that answered the probe."""
    messages: list[Any] = [message for data in heard for message in dialect.MAVLink(None).parse_buffer(data) or []]
    return [m.get_srcSystem() for m in messages if m.get_type() == "COMMAND_ACK" and m.command == PROBE]


def test_the_other_station_hears_everything_and_cannot_touch_the_flight(tmp_path: Path) -> None:
    with listening() as other:
        summary, run = fly(tmp_path, "--mirror", other.address)
    logged = [frame.data for _, frame in read_tlog(run / "flight.tlog").frames]
    assert summary["mirror"]["forwarded"] == len(logged)
    assert Counter(other.heard) == Counter(logged)  # loopback loses nothing
    heard = [message for data in other.heard for message in dialect.MAVLink(None).parse_buffer(data) or []]
    assert {message.get_srcSystem() for message in heard} == {1, 2, 3, 255}
    names = {message.get_type() for message in heard}
    assert {"HEARTBEAT", "LOCAL_POSITION_NED", "TIMESYNC", "SET_POSITION_TARGET_LOCAL_NED", "COMMAND_ACK"} <= names
    assert summary["mirror"]["refused HEARTBEAT"] == summary["mirror"]["refused COMMAND_LONG"] > 1
    assert not any(name.startswith("passed on") for name in summary["mirror"])
    assert acknowledged(other.heard) == []


def test_the_other_stations_commands_reach_their_vehicle_if_asked_for(tmp_path: Path) -> None:
    with listening(mavlink.STATION_SYSTEM_ID) as other:
        summary, _ = fly(tmp_path, "--mirror", other.address, "--mirror-commands")
    assert summary["verdict"] == "stable"
    assert set(acknowledged(other.heard)) == {2}
    assert summary["mirror"]["passed on COMMAND_LONG"] > 1
    assert summary["mirror"]["passed on HEARTBEAT"] > 1


def test_a_vehicle_obeys_one_station_also_through_a_mirror(tmp_path: Path) -> None:
    with listening(245) as other:
        summary, _ = fly(tmp_path, "--mirror", other.address, "--mirror-commands")
    assert summary["verdict"] == "stable"
    assert acknowledged(other.heard) == []
    passed_on, refused = summary["mirror"]["passed on COMMAND_LONG"], summary["refused_by_vehicles"]["not the station"]
    assert passed_on - 1 <= refused <= passed_on  # one may be under way when the vehicles end
    assert refused > 1


def test_an_unheard_mirror_is_counted_and_the_flight_goes_on(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    summary, _ = fly(tmp_path, "--mirror", f"127.0.0.1:{port}")
    assert summary["verdict"] == "stable"
    assert summary["mirror"]["not forwarded"] > 100
    assert summary["control"]["ticks"] > 100  # of 150; a busy machine takes some away


def test_mavsdk_on_a_mirror_finds_every_vehicle_and_its_position(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    telemetry: dict[int, Telemetry] = {}
    with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as other:
        other.add_any_connection(f"udpin://127.0.0.1:{port}")

        def discover() -> None:
            until(lambda: other.system_count() == 3, "three systems")
            telemetry.update({system.get_system_id(): Telemetry(system) for system in other.get_systems()})

        meanwhile = threading.Thread(target=discover)
        meanwhile.start()
        summary, run = fly(tmp_path, "--mirror", f"127.0.0.1:{port}")
        meanwhile.join()
        found = {system_id: told.position_velocity_ned() for system_id, told in telemetry.items()}
    ends_m = {int(row["system_id"]): float(row["north_m"]) for row in read_ticks(run)}
    assert sorted(found) == [1, 2, 3]
    for system_id, told in found.items():
        assert told.position.north_m == pytest.approx(ends_m[system_id], abs=30.0)  # a third of a second at 91 m/s
        assert told.velocity.north_m_s == pytest.approx(91.4, abs=3.0)  # some are still closing up
    assert summary["mirror"]["refused HEARTBEAT"] >= 1


def test_nothing_garbled_or_in_a_vehicles_name_is_passed_on() -> None:
    vehicle = RemoteVehicle(1, startup=LaunchedStartup(1.0))
    vehicle.address, vehicle.armed, vehicle.custom_mode = 9, True, vehicle.kind.guided_mode
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        other.bind(("127.0.0.1", 0))
        with Mirror(*other.getsockname(), commands=True) as mirror:
            mirror.forward([b"hello"], 0)
            _, address = other.recvfrom(2048)
            good = mavlink.encode(mavlink.COMMAND_LONG, mavlink.command_long(1, target_system=1), sequence=0)
            as_vehicle = mavlink.encode(mavlink.HEARTBEAT, mavlink.heartbeat(), sequence=0, system_id=1)
            for_nobody = mavlink.encode(mavlink.COMMAND_LONG, mavlink.command_long(1, target_system=9), sequence=0)
            for data in (b"\xfdgarbage", as_vehicle, for_nobody, good):
                other.sendto(data, address)
            stranger.sendto(good, address)  # the socket is connected: this never gets in
            passed = mirror.passed_on([vehicle], 0)
    assert passed == [(good, 9)]
    assert mirror.counters["passed on COMMAND_LONG"] == 1
    assert mirror.counters["refused COMMAND_LONG of or for a system that is not flown"] == 1
    assert mirror.counters["refused HEARTBEAT of or for a system that is not flown"] == 1
    assert sum(count for name, count in mirror.counters.items() if name.startswith("refused: ")) == 1


def test_a_display_connecting_in_flight_does_not_slow_the_telemetry() -> None:
    vehicle = RemoteVehicle(1, startup=LaunchedStartup(1.0))
    vehicle.address, vehicle.armed, vehicle.custom_mode = 9, True, vehicle.kind.guided_mode
    mav = dialect.MAVLink(None, srcSystem=255)
    stream, long = dialect.MAVLink_request_data_stream_message, dialect.MAVLink_command_long_message
    whole = dialect.MAVLink_command_int_message(1, 1, 0, 511, 0, 0, 32, 250_000, 0, 0, 0, 0, 0)
    rates = [long(1, 1, 511, 0, message, 250_000, 0, 0, 0, 0, 0) for message in (32, 33, 85, 111)]
    slowing = [stream(1, 1, 0, 3, 1), stream(1, 1, 6, 3, 1), *rates, whole]
    files = dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, [0] * 251)
    other_wishes = [stream(1, 1, 10, 10, 1), long(1, 1, 511, 0, 242, 1_000_000, 0, 0, 0, 0, 0), files]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        with Mirror(*other.getsockname(), commands=True) as mirror:
            mirror.forward([b"hello"], 0)
            _, address = other.recvfrom(2048)
            sent = [message.pack(mav) for message in slowing + other_wishes]
            for data in sent:
                other.sendto(data, address)
            passed = mirror.passed_on([vehicle], 0)
    assert [data for data, _ in passed] == sent[len(slowing) :]
    refused = "refused {} about the rate of the telemetry used for control"
    assert mirror.counters[refused.format("REQUEST_DATA_STREAM")] == 2
    assert mirror.counters[refused.format("COMMAND_LONG")] == len(rates)
    assert mirror.counters[refused.format("COMMAND_INT")] == 1


def test_a_vehicle_that_left_guided_flight_is_not_cut_off() -> None:
    vehicle = RemoteVehicle(1, startup=AutopilotStartup(altitude_m=5.0, telemetry_hz=20.0))
    vehicle.address, guided, loiter = 9, ARDUCOPTER.guided_mode, 5
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        with Mirror(*other.getsockname(), commands=True) as mirror:
            mirror.forward([b"hello"], 0)
            _, address = other.recvfrom(2048)
            land = mavlink.encode(mavlink.COMMAND_LONG, mavlink.command_long(20, target_system=1), sequence=0)
            for mode, passed_on in ((loiter, []), (guided, [land]), (loiter, [land])):
                vehicle.heartbeat((mode, 2, 3, 128, 4, 3), 0)  # an armed ArduCopter in flight
                other.sendto(land, address)
                assert [data for data, _ in mirror.passed_on([vehicle], 0)] == passed_on


def test_one_port_gets_frames_for_all_once_all_are_commanded() -> None:
    vehicles = [RemoteVehicle(number, startup=LaunchedStartup(1.0)) for number in (1, 2, 3)]
    for vehicle, address in zip(vehicles, (9, 9, 8), strict=True):
        vehicle.address, vehicle.armed = address, True
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        with Mirror(*other.getsockname(), commands=True) as mirror:
            mirror.forward([b"hello"], 0)
            _, address = other.recvfrom(2048)
            beat = mavlink.encode(mavlink.HEARTBEAT, mavlink.heartbeat(), sequence=0)
            to_1 = mavlink.encode(mavlink.COMMAND_LONG, mavlink.command_long(1, target_system=1), sequence=0)
            passed: list[list[tuple[bytes, int]]] = []
            for guided in ([], [0, 2], [0, 1, 2]):
                for row in guided:
                    vehicles[row].custom_mode = vehicles[row].kind.guided_mode
                other.sendto(beat, address)
                other.sendto(to_1, address)
                passed.append(mirror.passed_on(vehicles, 0))
    assert passed == [[], [(beat, 8), (to_1, 9)], [(beat, 9), (beat, 8), (to_1, 9)]]


def test_a_signed_link_mirrors_and_hears_signed_frames_only() -> None:
    vehicle = RemoteVehicle(1, startup=LaunchedStartup(1.0))
    vehicle.address, vehicle.armed, vehicle.custom_mode = 9, True, vehicle.kind.guided_mode
    ours, theirs = Guard(Key(KEY), epoch_ns=EPOCH_NS, stamps=Stamps()), a_sender(system=255)
    good = mavlink.encode(mavlink.COMMAND_LONG, mavlink.command_long(1, target_system=1), sequence=0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        with Mirror(*other.getsockname(), commands=True, signed=ours.mirror_link) as mirror:
            mirror.forward([good], NOW_NS)
            data, address = other.recvfrom(2048)
            (heard,) = theirs.parse_buffer(data)
            assert (heard.get_type(), heard.get_signed(), data[-13]) == ("COMMAND_LONG", True, 1)
            theirs.srcComponent = 190
            message = dialect.MAVLink_command_long_message(1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0)
            signed = message.pack(theirs)
            for sent in (good, signed, signed):
                other.sendto(sent, address)
            passed = mirror.passed_on([vehicle], NOW_NS)
    assert passed == [(good, 9)]  # as a frame that the link to the vehicle signs
    assert mirror.counters == {
        "forwarded": 1,
        "refused: unsigned": 1,
        "refused: replayed": 1,
        "passed on COMMAND_LONG": 1,
    }


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["--mirror", "there"], "--mirror: read 'there', wanted HOST:PORT"),
        (["--mirror", "no.such.host.invalid:14551"], "wanted the address of a ground station"),
        (["--mirror-commands"], "read --mirror-commands without --mirror"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments: list[str], wanted: str) -> None:
    done = gcs("fly", "scenarios/chain3.toml", "--listen", "127.0.0.1:0", *arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert wanted in done.stderr
    assert done.stderr.count("\n") == 1
