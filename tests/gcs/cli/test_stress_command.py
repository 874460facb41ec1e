"""`gcs stress` as a user runs it: the onset, resumed campaigns, refused options."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import SCENARIOS
from tests.support.processes import gcs


def stress_command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "gcs", "stress", *map(str, arguments)]


def stress(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    return gcs("stress", *arguments)


def test_onset_of_instability_is_measured_at_the_sampled_margin(tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = stress(SCENARIOS / "chain3.toml", "--onset", "--out", out, "--json", "--workers", "2")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout) == json.loads((out / "stress.json").read_text())
    result = json.loads(done.stdout)
    assert result["passed"]
    for name in ("report.html", "trials.parquet", "growth.png"):
        assert (out / name).stat().st_size > 1000
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "http://" not in page
    assert "https://" not in page


def test_a_resumed_campaign_neither_loses_nor_repeats_a_flight(tmp_path: Path) -> None:
    out, log = tmp_path / "out", tmp_path / "out" / "trials.jsonl"
    arguments = (SCENARIOS / "chain3.toml", "--delay", "0.1:0.3:3", "--out", out, "--workers", "2", "--json")
    process = subprocess.Popen(stress_command(*arguments), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not (log.exists() and log.read_bytes().count(b"\n") >= 2):
        assert process.poll() is None
    process.kill()
    process.wait()
    kept = log.read_bytes().rpartition(b"\n")[0] + b"\n"
    again = stress(*arguments, "--resume")
    assert again.returncode == 0, again.stderr
    assert log.read_bytes().startswith(kept)
    ids = [json.loads(line)["id"] for line in log.read_bytes().splitlines() if line.endswith(b"}")]
    assert len(ids) == len(set(ids)) == json.loads(again.stdout)["trials"] == 6
    other = stress(SCENARIOS / "triangle5.toml", *arguments[1:], "--resume")
    assert (other.returncode, other.stderr.count("\n")) == (2, 1)
    assert "another scenario" in other.stderr
    assert log.read_bytes().count(b"\n") <= 7


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        ((), "--"),
        (("--disturbance",), "--onset"),
        (("--disturbance", "--onset", "--loss", "0.1"), "--loss"),
        (("--disturbance", "--onset", "--delay", "0.1,0.2"), "--delay"),
        (("--disturbance", "--onset", "--loop", "onboard"), "control.loop"),
        (("--disturbance", "--onset", "--links", "nowhere"), "nowhere"),
        (("--delay", "0:0.6:0"), "--delay"),
        (("--delay", "nonsense"), "--delay"),
        (("--onset", "--resume"), "--resume"),
        (("--onset", "--resume", "--out", SCENARIOS), "wanted the folder of a campaign"),
        (("--trial", "1234", "--out", SCENARIOS), "wanted the folder of a campaign"),
    ],
)
def test_bad_options_are_one_line_and_exit_code_2(arguments: tuple[str, ...], wanted: str) -> None:
    done = stress(SCENARIOS / "chain3.toml", *arguments)
    assert done.returncode == 2, done.stdout
    assert wanted in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("option", ["--real-time", "--disturbance"])
def test_options_that_autopilots_cannot_fly_are_refused(option: str) -> None:
    done = stress(SCENARIOS / "copters5.toml", "--onset", option)
    wanted = f"dynamics: read 'autopilot', wanted double_integrator with {option}\n"
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.endswith(wanted)


def test_aircraft_are_refused_with_disturbances_of_errors(tmp_path: Path) -> None:
    text = (SCENARIOS / "triangle5.toml").read_text(encoding="utf-8")
    file = tmp_path / "aircraft.toml"
    file.write_text(text.replace("seed = 1", 'seed = 1\ndynamics = "jsbsim"', 1), encoding="utf-8")
    done = stress(file, "--onset", "--disturbance")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.endswith("dynamics: read 'jsbsim', wanted double_integrator with --disturbance\n")
