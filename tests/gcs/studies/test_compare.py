"""`gcs compare`: its figures against other ways to find them, and its page in one piece."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gains.formation.model import FormationModel
from gcs.cli.main import app
from gcs.studies.compare import METHODS, rows
from gcs.studies.compare_cost import DesignCost, left_out
from scenarios.files import load
from tests.support.paths import SCENARIOS

SCENARIO = SCENARIOS / "chain3.toml"
CHAIN = FormationModel((-1, 0, 1))


def test_routes_are_flown_and_shown_side_by_side(tmp_path: Path) -> None:
    folder = tmp_path / "compared"
    result = CliRunner().invoke(app, ["compare", str(SCENARIO), "--out", str(folder), "--no-sizes"])
    assert result.exit_code == 0, result.output
    routes = {route["method"]: route for route in json.loads((folder / "compare.json").read_text())["routes"]}
    assert tuple(routes) == METHODS
    for route in routes.values():
        assert route["verdict"] == "stable"
        assert route["delay_margin_s"] == pytest.approx(0.3, rel=1e-5)
        assert route["links"] == 2
        assert 0 < route["settling_time_s"] < 30
        # decay from the initial error to the settled band takes about its logarithm over the rate
        assert route["settling_time_s"] < 12 / route["decay_rate_1_s"]
    assert routes["inclusion"]["numbers_used"] == 4
    assert routes["graph-lqr"]["numbers_used"] == 6
    page = (folder / "compare.html").read_text()
    assert "data:image/png" in page
    assert "http" not in page
    assert f"{routes['graph-dk']['settling_time_s']:.2f}" in page


def test_comparison_claims_no_effort_on_board(tmp_path: Path) -> None:
    # inclusion gains stream nothing here, so the effort sent would be 0
    file, folder = tmp_path / "onboard.toml", tmp_path / "compared"
    text = SCENARIO.read_text().replace('loop = "ground"', 'loop = "onboard"')
    file.write_text(text.replace("duration_s = 30.0", "duration_s = 2.0"))
    result = CliRunner().invoke(app, ["compare", str(file), "--out", str(folder), "--no-sizes"])
    assert result.exit_code == 0, result.output
    for route in json.loads((folder / "compare.json").read_text())["routes"]:
        assert (route["effort_m2_s3"], route["command_max_m_s2"]) == (None, None)


def test_comparison_says_its_margins_are_without_prediction() -> None:
    off = load(SCENARIO)
    predicting = off.model_copy(update={"control": off.control.model_copy(update={"prediction": 0.05})})
    (without, with_) = (
        [title for title, _ in rows(scenario, []) if "margin" in title] for scenario in (off, predicting)
    )
    assert without == ["delay margin, sampled, ms", "delay margin, continuous, ms"]
    assert with_ == ["margin without prediction, sampled, ms", "margin without prediction, continuous, ms"]


def test_sizes_that_were_not_tried_are_named_with_the_reason() -> None:
    costs = [DesignCost("inclusion", size, 0.2, 3) for size in (3, 5, 10, 20, 40, 80, 200)]
    costs += [DesignCost("graph-dk", size, 0.2, 8) for size in (3, 5, 10)]
    costs += [DesignCost("centralised LMI", size, 20.0, 45) for size in (3, 5)]
    assert left_out(costs) == [
        "graph-dk: not tried on 20 vehicles and more; more than 20 states an axis",
        "centralised LMI: not tried on 10 vehicles and more; it may take over 10 s",
    ]
