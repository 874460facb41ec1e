"""The comparison with other people's tools: the same work is done, and who is absent is named."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect
from typer.testing import CliRunner

from examples.peers.plain import Law
from gcs.cli.main import app
from gcs.errors import InputError
from gcs.plan.planner import flight_plan
from gcs.studies.benchmark import (
    GAINS,
    position_frames,
    pymavlink_set_point,
    station_set_points,
    with_vehicles,
    without_solver,
)
from gcs.studies.peers import PeerError, run_script, side_by_side
from scenarios.files import load
from tests.support.paths import SCENARIOS

TRIANGLE = SCENARIOS / "triangle5.toml"
PACKAGES = {"MAVSDK": "mavsdk", "JSBSim": "jsbsim", "python-control": "control", "CVXPY": "cvxpy"}


@pytest.fixture
def lean(monkeypatch: pytest.MonkeyPatch) -> None:
    """None of the optional packages is installed."""
    for package in PACKAGES.values():
        monkeypatch.setitem(sys.modules, package, None)


@pytest.mark.usefixtures("lean")
def test_absent_peers_are_named_and_skipped() -> None:
    found = side_by_side(load(TRIANGLE), seconds=1.0, sizes=())
    assert {skipped.peer for skipped in found.skipped} == set(PACKAGES)
    assert {skipped.why for skipped in found.skipped} == {"not installed: python3 make.py peers"}
    assert not {row.peer for row in found.rows} & set(PACKAGES)
    own = [row for row in found.to_dict()["rows"] if row["peer"] == "pymavlink"]
    assert [row["work"].split()[0] for row in own] == ["decode", "encode"]
    for row in own:
        assert min(row["ours"], row["theirs"]) > 0.0
        assert row["ratio"] == pytest.approx(row["theirs"] / row["ours"])


def test_both_codecs_are_timed_on_the_same_bytes() -> None:
    packer = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    assert [bytes(pymavlink_set_point(packer, 7))] == station_set_points(1, 7)
    parser = dialect.MAVLink(None)
    messages = [parser.parse_char(frame) for frame in position_frames(3)]
    assert [(m.get_type(), m.get_srcSystem()) for m in messages if m] == [("LOCAL_POSITION_NED", k) for k in (1, 2, 3)]


def test_plain_stations_fly_the_law_of_this_station() -> None:
    scenario = without_solver(with_vehicles(load(TRIANGLE), 12), 1.0)
    _, plan = flight_plan(scenario)
    law, model = Law(scenario), plan.model
    law.states[:] = np.random.default_rng(1).normal(size=law.states.shape) * 10.0
    errors = np.zeros(model.states)
    for i in range(model.vehicles):
        errors[model.velocity_slice(i)] = law.states[i, 2:] - scenario.nominal_velocity_at(0.0)
    for i in model.followers:
        ahead = law.states[model.predecessors[i], :2]
        errors[model.spacing_slice(i)] = ahead - law.states[i, :2] + plan.formation.offset_ne_m[i]
    commands = plan.gain @ errors
    assert scenario.control.gains == GAINS
    np.testing.assert_allclose(law.commands().ravel(), commands, rtol=1e-12, atol=1e-9)


@pytest.mark.realtime
@pytest.mark.usefixtures("lean")
def test_a_plain_station_flies_the_closed_loop_beside_ours() -> None:
    arguments = ["bench", str(TRIANGLE), "--peers", "--vehicles", "5", "--seconds", "1", "--json"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    rows = {row["work"]: row for row in json.loads(result.stdout)["rows"] if "closed loop of 5" in row["work"]}
    share = rows["closed loop of 5 vehicles: processor share per vehicle"]
    assert min(share["ours"], share["theirs"]) > 0.0
    assert len(rows) == 5


def test_a_script_that_fails_says_why_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(PeerError, match="read no such file, wanted a scenario file"):
        run_script("pymavlink_station", str(tmp_path / "none.toml"), "0", folder=tmp_path)


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["triangle5", "--peers", "--real-time"], "read --peers and --real-time, wanted one of them"),
        (["copters5", "--peers"], "dynamics: read 'autopilot', wanted 'double_integrator'"),
    ],
)
def test_what_no_plain_station_flies_is_refused(arguments: list[str], wanted: str) -> None:
    result = CliRunner().invoke(app, ["bench", *arguments])
    assert isinstance(result.exception, InputError)
    assert wanted in str(result.exception)
