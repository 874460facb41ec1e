"""The recording of a flight as another program reads it: complete, with the values flown, and drawn without errors."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from gcs.drive.lockstep import START_NS, fly_lockstep
from gcs.errors import InputError
from gcs.plan.planner import flight_plan
from gcs.runs.files import read_design, read_ticks, write_design
from gcs.runs.record import DESIGN_FILE, RECORDING_FILE, SCENARIO_FILE, RunWriter
from gcs.runs.summary import finish
from gcs.station.station import Station
from gcs.views.observer import record_run
from gcs.views.report import delay_text
from gcs.views.viewer import screenshot, vulkan_missing
from scenarios.files import dump, load
from scenarios.keys.link import DelayPoint, Link, VehicleLinks
from scenarios.schema import Scenario
from tests.support.paths import SCENARIOS
from tests.support.recordings import read_back

pytestmark = pytest.mark.xdist_group("recorded flight")

SCENARIO = load(SCENARIOS / "triangle5.toml").model_copy(update={"duration_s": 4.0})
SLOW = Link(delay_points=(DelayPoint(at_s=0.0, delay_s=0.02), DelayPoint(at_s=1.0, delay_s=0.16)))
"""Past the margin of the fastest gains from the first second on."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a flight of four seconds, with its recording."""
    return recorded(SCENARIO, tmp_path_factory.mktemp("run"))


def recorded(scenario: Scenario, folder: Path) -> Path:
    """The folder of a flight, with its recording."""
    design, plan = flight_plan(scenario)
    (folder / SCENARIO_FILE).write_text(dump(scenario), encoding="utf-8")
    write_design(folder, design)
    writer, station = RunWriter(folder), Station(plan, start_ns=START_NS)
    for rows in fly_lockstep(plan, station=station):
        writer.tick(rows)
    for event in station.events:
        writer.event(event)
    writer.close()
    record_run(folder)
    return folder


def rerun(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    program = Path(sys.executable).with_name("rerun")
    return subprocess.run([program, *arguments], capture_output=True, text=True, check=False, timeout=60)


def test_reruns_own_check_finds_the_recording_valid(run: Path) -> None:
    assert rerun("rrd", "verify", run / "flight.rrd").returncode == 0
    cut = run / "cut.rrd"
    cut.write_bytes(b"RRF2" + bytes(200))
    assert rerun("rrd", "verify", cut).returncode != 0  # the check can fail


def test_recorded_delays_headroom_and_errors_are_those_of_the_ticks(run: Path) -> None:
    ticks = read_ticks(run).reshape(-1, len(SCENARIO.vehicles))
    column = {system_id: k for k, system_id in enumerate(ticks[0]["system_id"].tolist())}
    flown = ticks[ticks["time_s"][:, 0] >= 0][:, [column[vehicle.system_id] for vehicle in SCENARIO.vehicles]]
    errors_m = np.hypot(flown["spacing_error_north_m"], flown["spacing_error_east_m"])[:, 1:]
    wanted: dict[str, Any] = {
        "/delay/loop_ms": 1e3 * flown["loop_delay_s"],
        "/headroom/percent": 100 * flown["headroom"],
        "/delay/margin_ms": 1e3 * flown["delay_margin_s"],
        "/spacing/error_m": errors_m,
    }
    for entity, values in wanted.items():
        times_s, found = read_back(run / "flight.rrd", entity, "Scalars:scalars")
        np.testing.assert_allclose(times_s, flown["time_s"][:, 0], atol=1e-9)
        np.testing.assert_allclose(found, values, rtol=1e-12, atol=1e-9)
    assert len(flown) > 200
    assert np.nanmax(errors_m[0]) > 4 > np.nanmax(errors_m[-1])


def test_a_margin_is_drawn_for_each_vehicles_flown_gains(tmp_path: Path) -> None:
    """The loop delay of vehicle 2 passes the margin of the fastest gains, and it changes to slower ones."""
    links = SCENARIO.links.model_copy(update={"vehicles": (VehicleLinks(system_id=2, up=SLOW, down=SLOW),)})
    folder = recorded(SCENARIO.model_copy(update={"links": links}), tmp_path)
    times_s, margins_ms = read_back(folder / "flight.rrd", "/delay/margin_ms", "Scalars:scalars")
    _, headroom = read_back(folder / "flight.rrd", "/headroom/percent", "Scalars:scalars")
    _, loops_ms = read_back(folder / "flight.rrd", "/delay/loop_ms", "Scalars:scalars")
    flown = times_s < 3.9
    margins_ms, headroom, loops_ms = margins_ms[flown], headroom[flown], loops_ms[flown]
    own = [vehicle.system_id for vehicle in SCENARIO.vehicles].index(2)
    assert margins_ms[0] == pytest.approx([300.0] * 5, abs=0.1)
    design = read_design(folder / DESIGN_FILE)
    slower_s = design.margins_s[1]
    assert slower_s > 0.6
    assert margins_ms[-1, own] == pytest.approx(1e3 * slower_s)
    assert np.delete(margins_ms[-1], own) == pytest.approx([300.0] * 4, abs=0.1)
    known = np.isfinite(headroom)
    np.testing.assert_allclose((100.0 * (1.0 - loops_ms / margins_ms))[known], headroom[known], rtol=1e-9, atol=1e-9)
    summary = finish(folder)
    margins = {vehicle.system_id: vehicle.delay_margin_s for vehicle in summary.vehicles}
    assert margins[2].min == pytest.approx(0.3, abs=1e-4)
    assert margins[2].max == pytest.approx(slower_s, abs=1e-6)
    assert margins[3].max == pytest.approx(0.3, abs=1e-4)
    assert "margin 300.0 ms, up to 610.0 ms with slower gains" in delay_text(summary)


@pytest.mark.skipif(vulkan_missing(), reason="no Vulkan driver installed (Debian: mesa-vulkan-drivers)")
def test_the_headless_viewer_opens_a_flight_without_view_errors(run: Path) -> None:
    pictures: list[Any] = []
    for time_s in (0.2, 3.5):
        png = run / f"{time_s}.png"
        assert screenshot(run / RECORDING_FILE, png, time_s=time_s) == []
        pictures.append(imread(png))
    assert [picture.shape[:2] for picture in pictures] == [(900, 1600)] * 2
    assert len(np.unique(pictures[0].reshape(-1, pictures[0].shape[2]), axis=0)) > 100  # lines, labels, vehicles
    moved = np.abs(pictures[0] - pictures[1]).max(axis=2) > 0.1
    assert 0.001 < moved.mean() < 0.9  # vehicles and the time cursor have moved on, the screen is the same


@pytest.mark.skipif(vulkan_missing(), reason="no Vulkan driver installed (Debian: mesa-vulkan-drivers)")
def test_a_recording_without_any_tick_is_reported_in_one_line(run: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.rrd"
    cut.write_bytes((run / "flight.rrd").read_bytes()[:2000])
    with pytest.raises(InputError, match=r"cut\.rrd: the viewer reads no flight in it, wanted a recording of a run"):
        screenshot(cut, tmp_path / "cut.png", time_s=0.0)
