"""The commands as a user runs them: real processes, real UDP, the real clock. Figures are judged at the median."""

import json
import os
import re
import resource
import signal
import struct
import subprocess
import sys
import time  # noqa: TID251 - waits for processes, with time-outs
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.control.tick import TICK, TickArray
from gcs.drive.sitl import ORPHAN_S
from gcs.runs.files import read_ticks
from gcs.runs.record import TRUTH_FILE
from scenarios.files import dump, load
from scenarios.keys.link import Jitter, Link, Links
from scenarios.schema import Control
from sim_vehicles.links.truth import ACTED, SAMPLED, read_truth
from tests.support.paths import SCENARIOS
from tests.support.processes import PATIENCE_S, children_named, fly, flying, free_port, gcs, short, until

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("realtime")]


def vehicles_log(folder: Path) -> str:
    return (folder / "vehicles.log").read_text(encoding="utf-8")


def true_loop_delay_s(folder: Path, ticks: TickArray) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Loop delay of each set-point that acted, from the vehicles' log: from its state's sampling until it acted."""
    truth = read_truth(folder / TRUTH_FILE)
    sampled = {(int(r["system_id"]), int(r["key"])): int(r["time_ns"]) for r in truth[truth["kind"] == SAMPLED]}
    acted = {(int(r["system_id"]), int(r["key"])): int(r["time_ns"]) for r in truth[truth["kind"] == ACTED]}
    delays = [
        (acted[key] - sampled[state]) * 1e-9
        for row in ticks
        if (key := (int(row["system_id"]), int(row["key_ms"]))) in acted
        and (state := (int(row["system_id"]), int(row["sample_boot_ms"]))) in sampled
    ]
    return np.array(delays)


@pytest.mark.slow(first=1)
@pytest.mark.parametrize("delay_s", [0.02, 0.06])
def test_a_udp_flight_settles_and_reports_its_links_loop_delay(tmp_path: Path, delay_s: float) -> None:
    folder = tmp_path / "run"
    scenario = short(tmp_path, "triangle5", 8.0)
    done = gcs("fly", scenario, "--listen", "127.0.0.1:0", "--link-delay", str(delay_s), "--out", folder, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    summary = json.loads(done.stdout)
    assert summary == json.loads((folder / "summary.json").read_text())
    assert summary["verdict"] == "stable"
    ticks = read_ticks(folder)
    commanded = ticks[ticks["commanded"]]
    truth_s = true_loop_delay_s(folder, commanded)
    assert truth_s.size > 0.95 * commanded.size
    # Within 1 ms at the median; kernel stamps make it far better on a quiet machine.
    assert float(np.median(commanded["loop_delay_s"])) == pytest.approx(float(np.median(truth_s)), abs=1e-3)
    for vehicle in summary["vehicles"]:
        assert vehicle["rtt_s"]["p50"] == pytest.approx(2 * delay_s, abs=2e-3)
        assert vehicle["lost"] == 0
    for name in ("flight.rrd", "flight.tlog", "scenario.toml", "design.json", "ticks.parquet"):
        assert (folder / name).stat().st_size > 100
    assert {"flight.rrd", "flight.tlog", "ticks.parquet", "summary.json"} <= set(summary["files"])
    frames = check_tlog(folder / "flight.tlog")
    sent = [(time_us, frame) for time_us, frame in frames if frame.get_srcSystem() == 255]
    set_points_us = [time_us for time_us, frame in sent if frame.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]
    requests_us = [t_us for t_us, frame in sent if frame.get_type() == "TIMESYNC" and frame.tc1 == 0]
    requests_us = [t_us for t_us in requests_us if set_points_us[0] < t_us < set_points_us[-1]]
    next_us = np.array(set_points_us)[np.searchsorted(set_points_us, requests_us)]
    # the one wake-up between two ticks is 2 ms before the second; half a period would be 10 ms
    assert float(np.median(next_us - requests_us)) < 5e3


def check_tlog(file: Path) -> list[tuple[int, Any]]:
    """Every entry is a time and one frame that pymavlink accepts; times increase, except within a tick."""
    parser: Any = dialect.MAVLink(None)
    data = file.read_bytes()
    at, frames = 0, list[tuple[int, Any]]()
    while at < len(data):
        (time_us,) = struct.unpack_from(">Q", data, at)
        length = 12 + data[at + 9]
        frames.append((time_us, parser.parse_char(data[at + 8 : at + 8 + length])))
        at += 8 + length
    assert at == len(data)
    times, kinds = [time_us for time_us, _ in frames], {message.get_type() for _, message in frames}
    assert {"HEARTBEAT", "LOCAL_POSITION_NED", "TIMESYNC", "SET_POSITION_TARGET_LOCAL_NED", "COMMAND_ACK"} <= kinds
    assert abs(times[0] * 1e-6 - time.time()) < 3600
    assert min(np.diff(times)) > -1e6
    return frames


def test_too_slow_a_link_is_unstable_with_exit_code_1(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    scenario = short(tmp_path, "triangle5", 20.0)
    done = gcs("fly", scenario, "--listen", "127.0.0.1:0", "--link-delay", "0.4", "--out", folder)
    assert done.returncode == 1
    assert "verdict  unstable: broken: spacing error of vehicle" in done.stdout
    summary = json.loads((folder / "summary.json").read_text())
    assert {vehicle["mode_final"] for vehicle in summary["vehicles"]} == {"FAILSAFE"}
    assert summary["headroom_min"] < 0


@pytest.mark.slow(first=3)
@pytest.mark.parametrize(
    ("early", "number"),
    [
        (True, signal.SIGINT),
        (False, signal.SIGTERM),
        (False, signal.SIGHUP),
        (False, signal.SIGINT),
        (True, signal.SIGHUP),
    ],
)
def test_ctrl_c_sigterm_and_hangup_leave_whole_files_without_traceback(
    tmp_path: Path, early: bool, number: signal.Signals
) -> None:
    folder = tmp_path / "run"
    process = fly(short(tmp_path, "chain3", 60.0), "--listen", "127.0.0.1:0", "--out", folder)
    until(lambda: (folder / "scenario.toml").exists() if early else flying(folder))
    process.send_signal(number)
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert "Traceback" not in err
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["verdict"], summary["reason"]) == ("aborted", f"interrupted: {number.name}")
    assert (folder / "flight.rrd").stat().st_size > 100
    assert not children_named(str(folder))


def test_after_a_kill_logs_are_readable_and_vehicles_taken_back(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    scenario, port = short(tmp_path, "triangle5", 10.0), free_port()
    listen = f"127.0.0.1:{port}"
    process = fly(scenario, "--listen", listen, "--out", first)
    until(lambda: flying(first, 4.0))  # settled: vehicles that hold different velocities would drift far apart
    process.kill()
    killed_ns = time.monotonic_ns()
    process.communicate(timeout=PATIENCE_S)
    try:
        until(lambda: vehicles_log(first).count("failsafe") >= 5)
        until((first / "summary.json").exists)  # the observer finishes the run of a station that has gone
        summary = json.loads((first / "summary.json").read_text())
        assert summary["verdict"] == "aborted"
        ticks = read_ticks(first)
        assert 0 <= killed_ns - ticks["due_ns"][-1] < 1e9
        for options, flown in ((["--link-delay", "0.4"], "fly triangle5 with other links"), ([], "fly triangle5,")):
            another = scenario if options else short(tmp_path, "chain3", 10.0)
            refused = gcs("fly", another, "--listen", listen, "--out", tmp_path / "refused", *options)
            assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (2, "", 1)
            assert flown in refused.stderr
        again = gcs("fly", scenario, "--listen", listen, "--out", second, "--json")
        assert (again.returncode, again.stderr) == (0, "")
        summary = json.loads(again.stdout)
        assert (summary["verdict"], summary["fleet"]) == ("stable", "taken over: they were there already")
        assert not (second / "vehicles.log").exists()  # it started none
        until(lambda: not children_named(str(first)))  # and has ended those it took over
    finally:
        for pid in children_named(str(first)):
            os.kill(pid, signal.SIGTERM)


def test_vehicles_nobody_listens_to_again_end_with_their_station(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    process = fly(short(tmp_path, "chain3", 60.0), "--listen", "127.0.0.1:0", "--out", folder)
    until(lambda: flying(folder))
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    killed_s = time.monotonic()
    until(lambda: not children_named(str(folder)))
    assert time.monotonic() - killed_s < ORPHAN_S / 4


def test_a_reader_that_leaves_neither_ends_nor_changes_a_flight(tmp_path: Path) -> None:
    process = fly(short(tmp_path, "chain3", 4.0), "--listen", "127.0.0.1:0", "--out", tmp_path / "run")
    assert process.stdout is not None
    assert process.stderr is not None
    assert process.stdout.readline().startswith("design")
    process.stdout.close()  # as `gcs fly | head -1` does
    assert (process.wait(PATIENCE_S), process.stderr.read()) == (0, "")
    process.stderr.close()
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["verdict"], summary["not_logged"]) == ("stable", [])
    assert (tmp_path / "run" / "flight.rrd").exists()


def test_a_flight_that_is_started_without_standard_output_flies(tmp_path: Path) -> None:
    """As `gcs fly >&-` starts it: the observer inherits what stands in for the closed file."""
    process = fly(
        short(tmp_path, "chain3", 2.0), "--listen", "127.0.0.1:0", "--out", tmp_path / "run",
        preexec_fn=lambda: os.close(1),
    )  # fmt: skip
    _, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, err) == (0, "")
    assert (tmp_path / "run" / "flight.rrd").exists()


def test_a_full_disk_ends_the_logs_and_not_the_flight(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    process = fly(short(tmp_path, "chain3", 4.0), "--listen", "127.0.0.1:0", "--out", folder)
    until(lambda: flying(folder))
    full_bytes = (folder / "ticks.part").stat().st_size + TICK.itemsize // 2  # within a record
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (full_bytes, full_bytes))
    out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, err) == (1, "")
    assert "verdict  unknown: completed: duration reached" in out
    assert "log      not written: ticks.part: File too large, from" in out
    summary = json.loads((folder / "summary.json").read_text())
    logged = read_ticks(folder)[-1]
    assert [text.split(":")[0] for text in summary["not_logged"]].count("ticks.part") == 1
    assert 0.0 < logged["time_s"] < 3.5
    truth = read_truth(folder / TRUTH_FILE)
    acted_ns = int(truth["time_ns"][truth["kind"] == ACTED].max())
    assert logged["time_s"] + (acted_ns - int(logged["due_ns"])) * 1e-9 > 3.5  # set-points went on to the end
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    assert [event["text"] for event in events if event["kind"] == "log"].count("ticks.part: File too large") == 1
    assert events[-1]["kind"] == "end"
    assert not children_named(str(folder))


def test_onboard_loops_keep_vehicles_in_place_until_a_station_returns(
    tmp_path: Path,
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    scenario, listen = short(tmp_path, "thesis_delay", 8.0), f"127.0.0.1:{free_port()}"
    process = fly(scenario, "--listen", listen, "--out", first)
    until(lambda: flying(first, 4.0))
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    try:
        until(lambda: vehicles_log(first).count("failsafe") >= 3)
        again = gcs("fly", scenario, "--listen", listen, "--out", second, "--json")
        assert (again.returncode, again.stderr) == (0, "")
        summary = json.loads(again.stdout)
        assert (summary["verdict"], summary["loop"]) == ("stable", "onboard")
        assert summary["settling_time_s"] == 0.0  # they had kept their places
        # the links' 160 ms, and up to two periods until states of all vehicles are there
        assert 0.16 < summary["loop_delay_s"]["p50"] < 0.2
        assert summary["delay_margin_s"] == pytest.approx(1.00216, abs=1e-5)
    finally:
        for pid in children_named(str(first)):
            os.kill(pid, signal.SIGTERM)


def test_killed_vehicles_end_the_flight_with_the_station_saying_which(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    process = fly(short(tmp_path, "chain3", 60.0), "--listen", "127.0.0.1:0", "--out", folder)
    until(lambda: flying(folder))
    (pid,) = children_named(str(folder))
    os.kill(pid, signal.SIGKILL)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "Traceback" not in err
    lost = re.findall(r"vehicles? ([\d ]+): is lost", out)  # those of one tick are one line
    assert sorted(" ".join(lost).split()) == ["1", "2", "3"]
    assert "verdict  aborted: lost: all vehicles" in out


@pytest.mark.slow(first=1)
@pytest.mark.parametrize("connected", [False, True])
def test_gains_are_chosen_for_links_measured_just_before_the_flight(tmp_path: Path, *, connected: bool) -> None:
    up = Link(delay_s=0.15, jitter=Jitter(distribution="uniform", scale_s=0.02))
    update = {"duration_s": 4.0, "links": Links(up=up, down=Link(delay_s=0.1)), "control": Control(for_link="measured")}
    file, folder, at = tmp_path / "measured.toml", tmp_path / "run", f"127.0.0.1:{free_port()}"
    file.write_text(dump(load(SCENARIOS / "chain3.toml").model_copy(update=update)), encoding="utf-8")
    vehicles = [sys.executable, "-m", "sim_vehicles.drive.cli", file, "--station", at]
    with subprocess.Popen(vehicles, stdout=subprocess.DEVNULL) if connected else nullcontext() as running:
        done = gcs("fly", file, "--connect" if connected else "--listen", at, "--out", folder, "--json")
        if running is not None:
            running.terminate()
    assert (done.returncode, done.stderr) == (0, "")
    summary, design = json.loads(done.stdout), json.loads((folder / "design.json").read_text())
    measured = design["for_link"]
    assert (measured["source"], measured["vehicles"]) == ("the 5 s before the flight", [1, 2, 3])
    # within a control period: the phase of telemetry between two ticks is random, and constant during a flight
    assert measured["loop_delay_s_p50"] == pytest.approx(summary["loop_delay_s"]["p50"], abs=0.02)
    assert measured["loop_delay_s_worst"] - measured["loop_delay_s_least"] > 0.04
    own = next(own for own in measured["candidates"] if own["K1"] == pytest.approx(design["K1_1_s"][0][0]))
    assert own["headroom"] >= measured["headroom"]
    assert max(known["alpha"] for known in measured["candidates"]) == own["alpha"]


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["fly", "nowhere.toml"], "nowhere.toml: read no such file"),
        (["fly", "scenarios/chain3.toml", "--listen", "here"], "wanted HOST:PORT"),
        (["fly", "scenarios/chain3.toml", "--listen", "192.0.2.1:14550"], "wanted a free UDP port"),
        (["fly", "scenarios/chain3.toml", "--link-delay", "-1"], "--link-delay: read -1"),
        (["fly", "scenarios/chain3.toml", "--no-such-option"], "--no-such-option"),
        (["view", "nowhere"], "nowhere"),
        (["recover", "nowhere"], "wanted the folder of a run"),
        (["nonsense"], "nonsense"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments: list[str], wanted: str) -> None:
    done = gcs(*arguments)
    assert done.returncode == 2
    assert wanted in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""
