"""`gcs monitor` as a user runs it, beside vehicles on real sockets."""

import json
import signal
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.link import mavlink
from tests.support.paths import ROOT, SCENARIOS
from tests.support.processes import PATIENCE_S

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("realtime")]

MONITOR = [sys.executable, "-m", "gcs", "monitor"]


def free_address() -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{probe.getsockname()[1]}"


def monitor(*arguments: str) -> "subprocess.Popen[str]":
    return subprocess.Popen([*MONITOR, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)


@contextmanager
def vehicles(address: str, scenario: str = "scenarios/chain3.toml") -> Generator[None]:
    """The vehicles of a scenario; those of chain3 have links of 20 ms each way."""
    command = [sys.executable, "-m", "sim_vehicles.drive.cli", scenario, "--station", address]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, cwd=ROOT) as process:
        try:
            yield
        finally:
            process.terminate()


def test_links_are_watched_and_compared_with_the_scenarios_margin() -> None:
    address = free_address()
    with vehicles(address):
        process = monitor("scenarios/chain3.toml", "--listen", address, "--for", "4", "--json")
        out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, err) == (0, "")
    report = json.loads(out)
    assert report["delay_margin_s"] == pytest.approx(0.3, abs=1e-3)
    assert [vehicle["system_id"] for vehicle in report["vehicles"]] == [1, 2, 3]
    for vehicle in report["vehicles"]:
        assert vehicle["rtt_s"]["p50"] == pytest.approx(0.04, abs=0.003)
        assert vehicle["clock"]["bound_s"] == pytest.approx(0.02, abs=0.002)
        assert vehicle["headroom"] == pytest.approx(1 - vehicle["loop_delay_s"]["p99"] / report["delay_margin_s"])


def test_vehicles_of_all_networks_are_watched(tmp_path: Path) -> None:
    text = (SCENARIOS / "chain3.toml").read_text(encoding="utf-8")
    for before, after in {"system_id = 2": "system_id = 1001", "follows = 2": "follows = 1001"}.items():
        text = text.replace(before, after)
    (tmp_path / "two.toml").write_text(text, encoding="utf-8")
    address, scenario = free_address(), str(tmp_path / "two.toml")
    with vehicles(address, scenario):
        process = monitor(scenario, "--listen", address, "--for", "4", "--json")
        out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, err) == (0, "")
    seen = {vehicle["system_id"]: vehicle["status"] for vehicle in json.loads(out)["vehicles"]}
    assert seen == dict.fromkeys((1, 3, 1001), "measured")


def test_ctrl_c_prints_the_figures_and_what_was_sent() -> None:
    address = free_address()
    with vehicles(address):
        process = monitor("--connect", address, "--margin", "0.01")
        assert process.stdout is not None
        first = process.stdout.readline()  # after five seconds
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, err) == (130, "")
    assert "3 vehicles: p99 past the margin" in first
    assert out.count("past the margin") == 3
    assert "TIMESYNC requests, nothing else" in out


@pytest.mark.parametrize("option", ["--silent", "--json"])
def test_a_vehicle_is_sent_only_timesync_requests_or_nothing(option: str) -> None:
    address = free_address()
    host, _, port = address.partition(":")
    sender = dialect.MAVLink(None, srcSystem=7, srcComponent=1)
    heartbeat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.settimeout(0.2)
        process = monitor("--listen", address, "--for", "2", "--json", *([option] if option == "--silent" else []))
        heard: list[bytes] = []
        while process.poll() is None:
            vehicle.sendto(heartbeat.pack(sender), (host, int(port)))
            try:
                heard.append(vehicle.recv(2048))
            except (TimeoutError, ConnectionError):
                continue
        out, _ = process.communicate(timeout=PATIENCE_S)
    [seen] = json.loads(out)["vehicles"]
    assert (seen["system_id"], seen["status"]) == (7, "no exchange")
    frames = [frame for data in heard for frame in mavlink.decode(data, Counter())]
    assert {frame.msg_id for frame in frames} == (set() if option == "--silent" else {mavlink.TIMESYNC})


def test_nobody_heard_is_a_reported_failure() -> None:
    process = monitor("--listen", free_address(), "--for", "0.3")
    out, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "no vehicle heard" in out


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["nowhere.toml"], "nowhere.toml: read no such file"),
        (["--listen", "here"], "--listen: read 'here', wanted HOST:PORT"),
        (["--margin", "1", "--design", "x.json"], "read --margin and --design, wanted one of them"),
        (["--margin", "-1"], "--margin"),
        (
            ["--design", "README.md"],
            "README.md: Invalid JSON: expected value at line 1 column 1; wanted the design.json of a run",
        ),
        (["--design", "nowhere.json"], "wanted the design.json of a run"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments: list[str], wanted: str) -> None:
    process = monitor(*(arguments if "--listen" in arguments else [*arguments, "--listen", "127.0.0.1:0"]))
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    assert wanted in err
    assert err.count("\n") == 1
    assert out == ""
