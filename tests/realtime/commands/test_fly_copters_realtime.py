"""`gcs fly --connect` against `sim-vehicles` in another process, over UDP."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest

from scenarios import files
from tests.support.paths import SCENARIOS
from tests.support.processes import free_port, gcs

COPTERS5 = SCENARIOS / "copters5.toml"
RUN_S = 80.0

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("realtime")]


@contextmanager
def vehicles_of(scenario_file: Path, port: int) -> Generator[None]:
    command = [sys.executable, "-m", "sim_vehicles.drive.cli", str(scenario_file), "--station", f"127.0.0.1:{port}"]
    process = subprocess.Popen([*command, "--duration", str(RUN_S)], stdout=subprocess.DEVNULL)
    try:
        yield
    finally:
        os.kill(process.pid, signal.SIGTERM)
        process.wait(10.0)


def test_arducopters_and_px4_started_elsewhere_are_identified_and_flown(tmp_path: Path) -> None:
    scenario = files.load(COPTERS5)
    mixed = (v.model_copy(update={"flavour": "px4" if v.system_id > 3 else None}) for v in scenario.vehicles)
    scenario = scenario.model_copy(update={"vehicles": tuple(mixed), "duration_s": 10.0, "altitude_m": 5.0})
    file, port = tmp_path / "copters.toml", free_port()
    file.write_text(files.dump(scenario), encoding="utf-8")
    with vehicles_of(file, port):
        done = gcs("fly", file, "--connect", f"127.0.0.1:{port}", "--json", "--out", tmp_path / "run")
    assert done.returncode == 0, done.stdout + done.stderr
    summary = json.loads(done.stdout)
    assert summary["verdict"] == "stable"
    assert summary["response"]["source"] == "identified"
    # judged loosely: on a busy machine a set-point that leaves late makes the response look slower
    lags_s = sorted(vehicle["lag_s"] for vehicle in summary["response"]["vehicles"])
    assert lags_s[2] == pytest.approx(scenario.autopilot.lag_s, abs=0.03)
    assert summary["delay_margin_s"] < summary["response"]["delay_margin_at_once_s"] - scenario.autopilot.lag_s / 2
    events = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    [designed_s] = [event["time_s"] for event in events if event["kind"] == "design"]
    [begun_s] = [event["time_s"] for event in events if event["kind"] == "phase" and event["text"] == "flying"]
    assert designed_s - begun_s < 0.3, "control waited for the figures of the new design, which take a second"
    assert json.loads((tmp_path / "run" / "design.json").read_text())["response"] == summary["response"]
