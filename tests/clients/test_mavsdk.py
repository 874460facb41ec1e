"""The real MAVSDK flies our vehicles: its own library, over UDP, in this process and in one that is killed."""

import contextlib
import json
import math
import socket
import subprocess
import sys
import time  # noqa: TID251 - MAVSDK has threads and a clock of its own
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from mavsdk import Autopilot, ComponentType, Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.offboard import Offboard, OffboardError, VelocityBodyYawspeed, VelocityNedYaw
from mavsdk.plugins.param import Param, ParamError
from mavsdk.plugins.telemetry import FlightMode, Telemetry
from pymavlink.dialects.v20 import ardupilotmega as dialect

from scenarios import files
from tests.support.fleets.flown_fleet import SCENARIOS, copters, fleet, until
from tests.support.processes import PATIENCE_S
from tests.support.sim_client import parse

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("clients")]


class Client:
    """MAVSDK on a port, with the systems that it found there and their telemetry."""

    def __init__(self, port: int) -> None:
        self.mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
        self.mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        until(lambda: self.mavsdk.system_count() == 5, "five systems")
        # they are found in any order
        self.systems: dict[int, Any] = {system.get_system_id(): system for system in self.mavsdk.get_systems()}
        self.telemetry: dict[int, Any] = {number: Telemetry(system) for number, system in self.systems.items()}
        until(lambda: all(told.health_all_ok() for told in self.telemetry.values()), "all healthy")

    def mode(self, number: int) -> FlightMode:
        return FlightMode(self.telemetry[number].flight_mode())

    def velocity_ned_m_s(self, number: int) -> tuple[float, float, float]:
        found = self.telemetry[number].position_velocity_ned().velocity
        return found.north_m_s, found.east_m_s, found.down_m_s


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Generator[Client]:
    with fleet(copters(), tmp_path_factory.mktemp("mavsdk")) as port:
        made = Client(port)
        yield made
        made.mavsdk.destroy()


def test_all_five_are_found_healthy_with_their_places_and_homes(client: Client) -> None:
    assert sorted(client.systems) == [1, 2, 3, 4, 5]
    for number, own in enumerate(copters().vehicles, 1):
        told = client.telemetry[number]
        px4 = number > 3
        assert client.systems[number].autopilot_type() == (Autopilot.PX4 if px4 else Autopilot.ARDUPILOT)
        health = told.health()
        assert health.is_gyrometer_calibration_ok
        assert health.is_global_position_ok
        assert health.is_home_position_ok
        assert health.is_armable
        home, position = told.home(), told.position()
        north_m = math.radians(home.latitude_deg + 35.363262) * 6_378_137.0
        assert north_m == pytest.approx(own.position_ne_m[0], abs=0.03)  # 1e-7 degrees are 11 mm
        assert home.absolute_altitude_m == pytest.approx(584.0)
        until(lambda told=told: told.position_velocity_ned().position.down_m != 0.0, "a local position")
        local = told.position_velocity_ned().position
        if not told.in_air():
            assert (local.north_m, local.east_m) == pytest.approx((home.local_north_m, home.local_east_m), abs=0.03)
            assert position.relative_altitude_m == pytest.approx(0.0, abs=0.01)
        assert told.gps_info().num_satellites > 5
        assert told.battery().remaining_percent == 100.0


@pytest.mark.parametrize(
    ("number", "name", "identity"), [(2, "GUID_TIMEOUT", "SYSID_THISMAV"), (5, "COM_OF_LOSS_T", "MAV_SYS_ID")]
)
def test_parameters_are_listed_read_set_and_kept(client: Client, number: int, name: str, identity: str) -> None:
    parameters = Param(client.systems[number])
    listed = parameters.get_all_params()
    assert len(listed.int_params) + len(listed.float_params) >= 15
    assert {p.name: p.value for p in listed.int_params}[identity] == number
    assert parameters.get_param_int(identity) == number
    before = {p.name: p.value for p in listed.float_params}[name]
    parameters.set_param_float(name, before + 0.25)
    assert parameters.get_param_float(name) == before + 0.25
    again = {p.name: p.value for p in parameters.get_all_params().float_params}
    assert again[name] == before + 0.25
    with pytest.raises(ParamError):
        parameters.get_param_float("NOT_THERE")


def test_it_arms_changes_the_mode_and_disarms(client: Client) -> None:
    action, told = Action(client.systems[3]), client.telemetry[3]
    action.arm()
    until(told.armed, "armed")
    action.hold()
    until(lambda: client.mode(3) == FlightMode.HOLD, "hold")
    action.disarm()
    until(lambda: not told.armed(), "disarmed")


def test_velocities_are_flown_in_both_frames_before_hold_and_return(client: Client) -> None:
    numbers = (1, 4)
    for number in numbers:
        action = Action(client.systems[number])
        action.arm()
        if number == 1:
            action.set_takeoff_altitude(2.5)
        action.takeoff()
    for number in numbers:
        until(lambda told=client.telemetry[number]: told.position().relative_altitude_m > 1.0, "taken off")
    controls = {number: Offboard(client.systems[number]) for number in numbers}
    for control in controls.values():
        control.set_velocity_ned(VelocityNedYaw(2.0, -1.0, 0.0, 90.0))
        control.start()

    def flies(number: int, wanted: tuple[float, float, float]) -> bool:
        return math.dist(client.velocity_ned_m_s(number), wanted) < 0.1

    for number in numbers:
        until(lambda number=number: flies(number, (2.0, -1.0, 0.0)), "velocity north, east, down")
        until(lambda number=number: abs(client.telemetry[number].heading().heading_deg - 90.0) < 1.0, "heading east")
        assert client.mode(number) == FlightMode.OFFBOARD
    before = {number: client.telemetry[number].position_velocity_ned().position for number in numbers}
    for control in controls.values():  # forward is east now, and right is south
        control.set_velocity_body(VelocityBodyYawspeed(2.0, 1.0, 0.0, 0.0))
    for number in numbers:
        until(lambda number=number: flies(number, (-1.0, 2.0, 0.0)), "velocity forward, right, down")
        begin = before[number]
        until(
            lambda number=number, begin=begin: (
                client.telemetry[number].position_velocity_ned().position.east_m > begin.east_m + 1.0
            ),
            "way made good to the east",
        )
    for number in numbers:
        controls[number].stop()
        until(lambda number=number: client.mode(number) == FlightMode.HOLD, "hold")
        until(lambda number=number: flies(number, (0.0, 0.0, 0.0)), "standing still")
        Action(client.systems[number]).return_to_launch()
        until(lambda number=number: client.mode(number) == FlightMode.RETURN_TO_LAUNCH, "return to launch")


def take_control_and_report(port: int) -> None:
    """Fly a double integrator in OFFBOARD and wait: runs in the process that is killed."""
    client = Client(port)
    action = Action(client.systems[2])
    action.arm()
    action.hold()
    until(lambda: client.mode(2) == FlightMode.HOLD, "hold")
    control = Offboard(client.systems[2])
    for _ in range(10):
        with contextlib.suppress(OffboardError):
            control.set_velocity_ned(VelocityNedYaw(90.0, 3.0, 0.0, 0.0))
            control.start()
            break
    until(lambda: math.dist(client.velocity_ned_m_s(2), (90.0, 3.0, 0.0)) < 0.5, "velocity north, east, down")
    print(json.dumps({"systems": sorted(client.systems), "mode": client.mode(2).name}), flush=True)
    time.sleep(60.0)


def test_a_vehicle_holds_when_its_client_is_killed(tmp_path: Path) -> None:
    with fleet(files.load(SCENARIOS / "triangle5.toml"), tmp_path) as port:
        # as a module: run as a file, it would not find its own package
        command = [sys.executable, "-m", "tests.clients.test_mavsdk", str(port)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=SCENARIOS.parent) as process:
            assert process.stdout is not None
            said = next((line for line in process.stdout if line.startswith("{")), "")
            process.kill()
        assert json.loads(said) == {"systems": [1, 2, 3, 4, 5], "mode": "OFFBOARD"}
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
            station.bind(("127.0.0.1", port))
            station.settimeout(PATIENCE_S)
            modes: list[tuple[int, int]] = []
            while (5, dialect.MAV_STATE_CRITICAL) not in modes:
                message = parse(station.recv(2048))
                if message.get_srcSystem() == 2 and message.get_type() == "HEARTBEAT":
                    modes.append((message.custom_mode, message.system_status))
                    assert len(modes) < 10
            assert set(modes) <= {(4, dialect.MAV_STATE_ACTIVE), (5, dialect.MAV_STATE_CRITICAL)}


if __name__ == "__main__":
    take_control_and_report(int(sys.argv[1]))
