"""`gcs stress` from command line to report, with the pair of vehicles that is cheapest to fly."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import typer
from stress_pair import SCENARIO, pair_plan
from typer.testing import CliRunner

from gcs.campaign import TRIALS_FILE, Store, local_workers, run_campaign
from gcs.plan import FlightPlan
from gcs.stress import stress
from gcs.stress_report import write_junit
from gcs.study import Onset, Study, find_onset
from gcs.summary import SUMMARY_FILE
from scenarios.files import dump

app = typer.Typer()
app.command()(stress)


def run(folder: Path, *options: str, code: int = 0, **changes: Any) -> str:
    """The command's output, for the pair with some of its parts changed."""
    file = folder / "pair.toml"
    file.write_text(dump(SCENARIO.model_copy(update=changes)), encoding="utf-8")
    result = CliRunner().invoke(app, [str(file), "--workers", "1", *options])
    assert result.exit_code == code, result.output
    return result.output


def test_sweep_and_onset_agree_with_the_margin_and_leave_a_page_of_their_own(tmp_path: Path) -> None:
    out, junit = tmp_path / "out", tmp_path / "ci" / "junit.xml"
    options = ["--delay", "0,0.25", "--assert-onset", "0.005", "--junit", str(junit), "--out", str(out)]
    result = json.loads(run(tmp_path, *options, "--json"))
    onset = result["onset"]
    assert result["passed"]
    assert abs(onset["difference"]) < 5e-4  # fits and telemetry allow some 1e-5
    assert onset["link_delay_s"] == pytest.approx(onset["loop_delay_s"] - onset["waiting_s"], abs=1e-6)
    assert result["curve_error"] < 1e-3
    page = (out / "report.html").read_text(encoding="utf-8")
    assert re.findall(r"""(?:src|href)=["'](?!data:)""", page) == []
    assert "http" not in page.split("<style>")[0]
    assert page.count("data:image/png;base64,") == 2
    for name in ("stress.json", "trials.parquet", "growth.png", "worst.png", "scenario.toml"):
        assert (out / name).stat().st_size > 0
    suite = ElementTree.parse(junit).getroot()
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("1", "0", "0")
    # taken up again it flies nothing, and says the same
    lines = (out / TRIALS_FILE).read_bytes()
    again = json.loads(run(tmp_path, *options, "--json", "--resume"))
    assert (out / TRIALS_FILE).read_bytes() == lines
    assert again["onset"] == onset


def found_with(plan: FlightPlan, folder: Path) -> Onset:
    store = Store(folder)
    with local_workers(1) as fly:
        onset = find_onset(Study(plan), lambda trials: run_campaign(trials, store, fly), tolerance=0.02)
    store.close()
    return onset


def test_a_margin_that_is_not_that_of_the_gains_flown_is_found_out(tmp_path: Path) -> None:
    """The gains flown are 1.25 times those that the margin was computed for: it breaks sooner, and is found there."""
    plan = pair_plan()
    onset = found_with(replace(plan, gain=1.25 * plan.gain), tmp_path)
    assert onset.predicted_s == plan.delay_margin_s
    assert onset.difference < -0.1
    true_s = Study(replace(plan, gain=1.25 * plan.gain))
    assert onset.loop_delay_s == pytest.approx(margin_of(true_s.plan), rel=5e-4)


def margin_of(plan: FlightPlan) -> float:
    from gcs.trial import plan_loops

    return min(loop.margin_s() for loop in plan_loops(plan))


def test_assert_onset_fails_where_the_margin_does_not_hold(tmp_path: Path) -> None:
    """The margin is for telemetry at the control rate; at a tenth of it the loop is another, and 2 % shows it."""
    rates = SCENARIO.rates.model_copy(update={"telemetry_hz": 5.0})
    out, junit = tmp_path / "out", tmp_path / "junit.xml"
    options = ["--assert-onset", "0.005", "--junit", str(junit), "--out", str(out)]
    output = run(tmp_path, *options, code=1, rates=rates)
    assert "0.5% is allowed" in output
    [case] = ElementTree.parse(junit).getroot().findall("testcase")
    assert case.find("failure") is not None
    assert "not met" in (out / "report.html").read_text(encoding="utf-8")


def test_map_of_random_links_flies_probes_and_the_scenarios_own_states_with_each_seed(tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ["--delay", "0,0.4", "--jitter", "0,0.01", "--seeds", "2", "--out", str(out), "--json"]
    result = json.loads(run(tmp_path, *options))
    for kind in ("probe", "own"):
        seeds = [point["seed"] for point in result["points"] if point["kind"] == kind]
        assert sorted(seeds) == 4 * [SCENARIO.seed] + 4 * [SCENARIO.seed + 1]
    verdicts = {(p["coordinates"]["delay"], p["verdict"]) for p in result["points"]}
    assert verdicts == {(0.0, "stable"), (0.4, "unstable")}
    assert (out / "map.png").stat().st_size > 0


def test_one_trial_is_flown_again_with_a_recording(tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = json.loads(run(tmp_path, "--delay", "0.1", "--out", str(out), "--json"))
    stored = {point["kind"]: point for point in result["points"]}
    for kind in ("own", "probe"):
        again = json.loads(run(tmp_path, "--trial", stored[kind]["id"], "--out", str(out), "--json"))
        assert {name: again[name] for name in ("id", "verdict", "growth_1_s")} == {
            name: stored[kind][name] for name in ("id", "verdict", "growth_1_s")
        }
        [recording] = (out / "flights" / stored[kind]["id"]).rglob("flight.rrd")
        assert recording.stat().st_size > 0
        assert json.loads((recording.parent / SUMMARY_FILE).read_text(encoding="utf-8"))["scenario"] == "pair"


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ([], "wanted --onset, or an axis"),
        (["--delay", "x"], "wanted FROM:TO:COUNT"),
        (["--delay-of", "9=0:1:2"], "system id of a vehicle"),
        (["--delay", "0", "--rate", "50", "--loss", "0"], "wanted one (a sweep) or two (a map)"),
        (["--onset", "--tolerance", "2"], "wanted a part between 0 and 1"),
        (["--onset", "--resume"], "wanted the folder of a campaign"),
        (["--onset", "--dask", "no address"], "wanted the address of a Dask scheduler"),
    ],
)
def test_input_that_cannot_be_used_is_one_line_and_code_2(tmp_path: Path, options: list[str], wanted: str) -> None:
    assert wanted in " ".join(run(tmp_path, *options, code=2).replace("│", " ").split())
    assert [file.name for file in tmp_path.iterdir()] == ["pair.toml"]


def test_failed_trials_are_errors_in_junit(tmp_path: Path) -> None:
    failed = {"id": "abc", "seed": 3, "coordinates": {"delay": 0.1}, "error": "Traceback\nValueError: no"}
    result = {
        "scenario": "pair", "flight_time_s": 1.0, "failure": "", "assert_onset": None, "trials_failed": [failed]
    }  # fmt: skip
    write_junit(result, tmp_path / "junit.xml")
    suite = ElementTree.parse(tmp_path / "junit.xml").getroot()
    assert (suite.get("tests"), suite.get("errors")) == ("2", "1")
    error = suite.findall("testcase")[1].find("error")
    assert error is not None
    assert error.get("message") == "ValueError: no"
