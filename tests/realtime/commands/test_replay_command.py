"""`gcs replay` as a user runs it: on a run that was just flown, and on a log that another tool has written."""

import json
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from scenarios.files import dump, load
from tests.support.paths import ROOT
from tests.support.processes import PATIENCE_S, gcs

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("realtime")]

LISTENER = """
import select, sys, time
from pymavlink import mavutil
link = mavutil.mavlink_connection("udpin:127.0.0.1:" + sys.argv[1])
link.setup_logfile(sys.argv[2])
select.select([link.fd], [], [], 60.0)  # until the vehicles are up
end = time.monotonic() + 4.0
while time.monotonic() < end:
    select.select([link.fd], [], [], 0.1)
    while mavutil.mavfile.recv_msg(link) is not None:  # the one of all kinds of link, which logs
        pass
link.logfile.close()
"""
"""A ground station that listens and logs with pymavlink's own logger."""


def quantiles_ms(figures: dict[str, Any], *names: str) -> list[float]:
    return [1e3 * figures[name] for name in names]


def test_a_runs_log_gives_its_summary_to_tenths_of_milliseconds(tmp_path: Path) -> None:
    scenario = load(ROOT / "scenarios" / "chain3.toml").model_copy(update={"duration_s": 5.0})
    (tmp_path / "chain3.toml").write_text(dump(scenario), encoding="utf-8")
    run = tmp_path / "run"
    flown = gcs("fly", tmp_path / "chain3.toml", "--listen", "127.0.0.1:0", "--out", run, "--json")
    done = gcs("replay", run, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    recorded, result = json.loads(flown.stdout), json.loads(done.stdout)
    rebuilt = result["flight"]
    assert result["recorded"]["verdict"] == recorded["verdict"]
    for name in ("verdict", "reason", "settling_time_s"):
        assert rebuilt[name] == recorded[name]
    for name in ("ticks", "deadline_misses"):
        assert abs(rebuilt["control"][name] - recorded["control"][name]) <= 1
    for was, found in zip(recorded["vehicles"], rebuilt["vehicles"], strict=True):
        # The log stamps requests when they have been sent, some 0.05 ms after the time that they bear; the machine
        # may hold up a single one.
        for name in ("rtt_s", "loop_delay_s"):
            assert quantiles_ms(found[name], "p50") == pytest.approx(quantiles_ms(was[name], "p50"), abs=0.3)
            assert quantiles_ms(found[name], "p99") == pytest.approx(quantiles_ms(was[name], "p99"), abs=2.0)
        assert found["spacing_error_final_m"] == pytest.approx(was["spacing_error_final_m"] or 0.0, abs=0.1) or (
            was["spacing_error_final_m"] is None
        )
    shown = gcs("replay", run)
    assert (shown.returncode, shown.stderr) == (0, "")
    assert "verdict  stable: completed" in shown.stdout
    assert "recorded stable: loop" in shown.stdout
    cut = tmp_path / "cut.tlog"
    cut.write_bytes((run / "flight.tlog").read_bytes()[:-5])
    shown = gcs("replay", cut, tmp_path / "chain3.toml")
    assert shown.returncode == 0
    assert "1 damaged places" in shown.stdout


def test_pymavlinks_own_log_shows_its_links_and_errors(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    log = tmp_path / "theirs.tlog"
    vehicles = [
        sys.executable,
        "-m",
        "sim_vehicles.drive.cli",
        "scenarios/chain3.toml",
        "--station",
        f"127.0.0.1:{port}",
    ]
    with subprocess.Popen(vehicles, stdout=subprocess.DEVNULL, cwd=ROOT) as process:
        subprocess.run([sys.executable, "-c", LISTENER, port, str(log)], check=True, timeout=PATIENCE_S)
        process.terminate()
    done = gcs("replay", log, "scenarios/chain3.toml", "--margin", "0.3", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    result = json.loads(done.stdout)
    assert result["log"]["left_out"] == {}
    assert result["flight"]["verdict"] == "not judged"
    assert [links["system_id"] for links in result["links"]] == [1, 2, 3]
    for links in result["links"]:
        # a busy machine holds reports back: one interval of a dozen, more or less
        assert links["telemetry_hz"] == pytest.approx(4.0, abs=0.6)
        assert links["loop_delay_s"]["status"] == "lower bound"
        assert links["lost"] == 0
        assert 0.15 < links["telemetry_age_s"]["max"] < 0.35  # at 4 Hz
    assert all(vehicle["spacing_error_max_m"] > 1 for vehicle in result["flight"]["vehicles"][1:])


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["nowhere"], "nowhere: No such file"),
        (["README.md"], "README.md: read no MAVLink frame"),
        (["scenarios"], "flight.tlog: No such file"),
        (["README.md", "--margin", "1", "--design", "x.json"], "wanted one of them"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments: list[str], wanted: str) -> None:
    done = gcs("replay", *arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert wanted in done.stderr
    assert done.stderr.count("\n") == 1
