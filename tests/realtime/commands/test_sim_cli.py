"""`sim-vehicles`, run as a user or a station runs it, with a small pymavlink client as the station."""

import signal
import socket
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scenarios.files import dump
from sim_vehicles.links.truth import ACTED, LINK_UP, SAMPLED, read_truth
from tests.support.paths import SCENARIOS
from tests.support.sim_client import MS, arm, command, guided, heartbeat, parse, scenario, setpoint

RUN = [sys.executable, "-m", "sim_vehicles.drive.cli"]


class Client:
    """A minimal station: one socket, pymavlink, and time-outs."""

    def __init__(self, port: int = 0) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.socket.settimeout(10.0)
        self.port: int = self.socket.getsockname()[1]
        self.vehicles: dict[int, tuple[str, int]] = {}

    def hear(self, name: str, system: int = 1) -> Any:
        """The next message of a type from a vehicle."""
        while True:
            data, address = self.socket.recvfrom(2048)
            message = parse(data)
            self.vehicles[message.get_srcSystem()] = address
            if message.get_type() == name and message.get_srcSystem() == system:
                return message

    def say(self, *frames: bytes, system: int = 1) -> None:
        for frame in frames:
            self.socket.sendto(frame, self.vehicles[system])


@pytest.fixture
def client() -> Generator[Client]:
    made = Client()
    yield made
    made.socket.close()


@pytest.fixture
def scenario_file(tmp_path: Path) -> Path:
    path = tmp_path / "test.toml"
    path.write_text(dump(scenario(2, up_s=0.005, down_s=0.005)))
    return path


@contextmanager
def vehicles(scenario_file: Path, client: Client, *options: str) -> Generator[subprocess.Popen[str]]:
    """The running command, which is killed when the test ends."""
    process = subprocess.Popen(
        [*RUN, str(scenario_file), "--station", f"127.0.0.1:{client.port}", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        try:
            yield process
        finally:
            process.kill()


def finished(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, errors = process.communicate(timeout=20)
    return process.returncode, out, errors


def take_off(client: Client) -> None:
    client.hear("HEARTBEAT")
    client.say(command(511, 32, 10_000), arm(), guided())
    assert [client.hear("COMMAND_ACK").result for _ in range(3)] == [0, 0, 0]


@pytest.mark.realtime
def test_a_vehicle_reports_that_its_client_has_stopped(client: Client, scenario_file: Path, tmp_path: Path) -> None:
    with vehicles(scenario_file, client, "--truth", str(tmp_path / "truth")) as process:
        take_off(client)
        client.say(heartbeat(), setpoint(10.0))
        while True:
            position = client.hear("LOCAL_POSITION_NED")
            client.say(setpoint(10.0, time_boot_ms=position.time_boot_ms))
            if position.vx > 43.0:
                break
        assert position.vy == pytest.approx(9.0)
        assert client.hear("STATUSTEXT").text == "failsafe: set-points stopped"
        process.send_signal(signal.SIGTERM)
        code, out, errors = finished(process)
        assert (code, errors) == (0, "")
        for text in ("armed", "GUIDED", "flying", "failsafe: set-points stopped"):
            assert f"vehicle 1: {text}" in out
        assert "setpoints" in out.splitlines()[-1]
        truth = read_truth(tmp_path / "truth")
        assert position.time_boot_ms in truth["key"][truth["kind"] == SAMPLED]
        assert position.time_boot_ms in truth["key"][truth["kind"] == ACTED]
        left = truth[truth["kind"] == LINK_UP]
        assert ((left["due_ns"] - left["entered_ns"]) == 5 * MS).all()
        assert (left["time_ns"] >= left["due_ns"]).all()
        # Half of them are typically within 0.1 ms, but a loaded host delays most.
        assert np.percentile(left["time_ns"] - left["due_ns"], 10) < MS


@pytest.mark.realtime
def test_vehicles_outlive_their_station_and_the_next_takes_over(client: Client, scenario_file: Path) -> None:
    with vehicles(scenario_file, client, "--stop-after-silence", "2") as process:
        take_off(client)
        client.say(setpoint())
        client.socket.close()
        again = Client(client.port)
        while again.hear("HEARTBEAT").system_status != 5:  # CRITICAL: it is in failsafe
            again.say(heartbeat())
        again.say(guided())
        assert again.hear("COMMAND_ACK").result == 0
        again.say(setpoint(10.0))
        while again.hear("LOCAL_POSITION_NED").vx <= 40.5:
            again.say(setpoint(10.0))
        again.socket.close()
        code, out, errors = finished(process)
        assert (code, errors) == (0, "")
        assert "GUIDED, failsafe over" in out


@pytest.mark.realtime
def test_ctrl_c_ends_it_with_130_and_a_summary(client: Client, scenario_file: Path) -> None:
    with vehicles(scenario_file, client) as process:
        client.hear("HEARTBEAT", system=2)
        process.send_signal(signal.SIGINT)
        code, out, errors = finished(process)
        assert (code, errors) == (130, "")
        assert out.splitlines()[-1].startswith("received:")


@pytest.mark.realtime
def test_it_flies_on_when_the_reader_of_its_output_exits(client: Client, scenario_file: Path) -> None:
    with vehicles(scenario_file, client) as process:
        assert process.stdout is not None
        process.stdout.close()
        client.hear("HEARTBEAT")
        client.say(arm())
        while not client.hear("HEARTBEAT").base_mode & 128:
            pass
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["missing.toml"], "missing.toml"),
        ([str(SCENARIOS / "schema.py")], "schema.py: file"),
        ([], "SCENARIO"),
        ([str(SCENARIOS / "triangle5.toml"), "--station", "14550"], "'14550'"),
        ([str(SCENARIOS / "triangle5.toml"), "--station", "127.0.0.1:0"], "1 to 65535"),
        ([str(SCENARIOS / "triangle5.toml"), "--station", "127.0.0.1:70000"], "1 to 65535"),
        ([str(SCENARIOS / "triangle5.toml"), "--station", "no.such.host.invalid:14550"], "no.such.host.invalid"),
        ([str(SCENARIOS / "triangle5.toml"), "--station", "255.255.255.255:14550"], "255.255.255.255:14550"),
        ([str(SCENARIOS / "triangle5.toml"), "--truth", "/no/such/folder/truth"], "/no/such/folder/truth"),
        ([str(SCENARIOS / "triangle5.toml"), "--truth", str(SCENARIOS / "schema.py")], "is not a truth log, wanted"),
        ([str(SCENARIOS / "triangle5.toml"), "--counters", "/no/such/folder/file"], "--counters: /no/such/folder/file"),
        ([str(SCENARIOS / "triangle5.toml"), "--duration", "-1"], "'-1'"),
        ([str(SCENARIOS / "triangle5.toml"), "--duration", "nan"], "'nan'"),
        ([str(SCENARIOS / "triangle5.toml"), "--stop-after-silence", "soon"], "'soon'"),
        ([str(SCENARIOS / "triangle5.toml"), "--fly"], "--fly"),
    ],
)
def test_wrong_input_is_answered_in_one_line(
    arguments: list[str],
    named: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    from sim_vehicles.drive.cli import run

    monkeypatch.chdir(tmp_path)
    try:
        code = run(arguments)
    except SystemExit as end:  # how argparse refuses
        code = end.code
    assert code == 2
    errors = capsys.readouterr().err
    assert errors.startswith("sim-vehicles: ")
    assert errors.count("\n") == 1
    assert named in errors


def test_a_shipped_scenario_is_flown_by_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    from sim_vehicles.drive.cli import run

    assert run(["chain3", "--duration", "0.1"]) == 0
    assert "3 vehicles of chain3, to 127.0.0.1:14550" in capsys.readouterr().out


def test_help_loads_nothing_slow() -> None:
    """numpy, pydantic and pymavlink take half a second together."""
    program = (
        "import sys\nfrom sim_vehicles.drive.cli import run\n"
        "try:\n    run(['--help'])\nexcept SystemExit as end:\n    assert not end.code\n"
        "assert not {'numpy', 'pydantic', 'pymavlink'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert "--stop-after-silence" in done.stdout
