"""`gcs stress` from command line to report, with the pair of vehicles that is cheapest to fly."""

import json
import re
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import typer
from lxml import etree  # it comes with pymavlink, untyped
from typer.testing import CliRunner

from gcs.cli.results import checks_of
from gcs.cli.stress import stress
from gcs.errors import InputError
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.loops import plan_loops
from gcs.runs.junit import write_junit
from gcs.runs.record import SUMMARY_FILE
from gcs.stress.campaign import TRIALS_FILE, local_workers, run_campaign, trials_of
from gcs.stress.report import CampaignResult
from gcs.stress.study import Onset, Study, find_onset
from gcs.stress.trial import Outcome
from scenarios.files import dump
from tests.support.fleets.stress_pair import SCENARIO, pair_plan
from tests.support.paths import DATA

app = typer.Typer()
app.command()(stress)


def run(folder: Path, *options: str, code: int = 0, **changes: Any) -> str:
    """The command's output, for the pair with some of its parts changed."""
    file = folder / "pair.toml"
    file.write_text(dump(SCENARIO.model_copy(update=changes)), encoding="utf-8")
    result = CliRunner().invoke(app, [str(file), "--workers", "1", *options])
    assert result.exit_code == code, result.output
    return result.output


def junit_counts(file: Path) -> dict[str, int]:
    """The counts that a report claims; it must be valid by the schema, and have as many cases of each kind."""
    schema = etree.XMLSchema(etree.parse(str(DATA / "junit.xsd")))
    schema.assertValid(etree.parse(str(file)))
    suite = ElementTree.parse(file).getroot()
    found = {"tests": len(suite)}
    for kind, plural in (("failure", "failures"), ("error", "errors"), ("skipped", "skipped")):
        found[plural] = len(suite.findall(f"testcase/{kind}"))
    assert {name: int(suite.get(name, -1)) for name in found} == found
    return found


@pytest.mark.slow(first=0)
def test_sweep_and_onset_agree_with_the_margin(tmp_path: Path) -> None:
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
    assert junit_counts(junit) == {"tests": 1, "failures": 0, "errors": 0, "skipped": 0}
    # resumed, it flies nothing and reports the same
    lines = (out / TRIALS_FILE).read_bytes()
    again = json.loads(run(tmp_path, *options, "--json", "--resume"))
    assert (out / TRIALS_FILE).read_bytes() == lines
    assert again["onset"] == onset
    before = (out / "stress.json").read_bytes()
    for other in (["--onset-of", "2"], ["--delay", "0"]):
        refused = CliRunner().invoke(app, [str(tmp_path / "pair.toml"), *other, "--out", str(out), "--resume"])
        assert isinstance(refused.exception, InputError), refused.output
        assert "holds the onset of --onset, wanted --onset again, or a folder of its own" in str(refused.exception)
    assert (out / "stress.json").read_bytes() == before


def test_a_campaign_is_resumed_with_its_own_scenario_only(tmp_path: Path) -> None:
    out, run_folder = tmp_path / "out", tmp_path / "run"
    run(tmp_path, "--delay", "0", "--out", str(out))
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    run_folder.mkdir()
    (run_folder / "scenario.toml").write_text(dump(SCENARIO), encoding="utf-8")
    (tmp_path / "pair.toml").write_text(dump(SCENARIO.model_copy(update={"seed": 99})), encoding="utf-8")
    for folder, option, wanted in (
        (out, ("--resume",), "holds a campaign of another scenario"),
        (run_folder, ("--resume",), "read no trials.jsonl"),
        (run_folder, ("--trial", "abc"), "read no trials.jsonl"),
    ):
        arguments = [str(tmp_path / "pair.toml"), "--delay", "0", "--out", str(folder), *option]
        result = CliRunner().invoke(app, arguments)
        assert isinstance(result.exception, InputError), result.output
        assert wanted in str(result.exception)
    assert {file.name: file.read_bytes() for file in out.iterdir()} == before
    assert [file.name for file in run_folder.iterdir()] == ["scenario.toml"]


def found_with(plan: FlightPlan, folder: Path) -> Onset:
    store = trials_of(folder)
    with local_workers(1) as fly:
        onset = find_onset(Study(plan), lambda trials: run_campaign(trials, store, fly), tolerance=0.02)
    store.close()
    return onset


def test_a_margin_that_the_gains_lack_is_exposed(tmp_path: Path) -> None:
    """The gains flown are 1.25 times those of the margin: the loop breaks sooner, and the onset is found there."""
    plan = pair_plan()
    flown = replace(plan, gain=1.25 * plan.gain)
    onset = found_with(flown, tmp_path)
    assert onset.predicted_s == plan.delay_margin_s
    assert onset.difference is not None
    assert onset.difference < -0.1
    assert onset.loop_delay_s == pytest.approx(margin_of(flown), rel=5e-4)


def margin_of(plan: FlightPlan) -> float:

    return min(loop.margin_s() for loop in plan_loops(plan))


def test_assert_onset_fails_where_the_margin_does_not_hold(tmp_path: Path) -> None:
    """Telemetry rounds positions to float32: no flight agrees with the margin to one part in ten billion."""
    out, junit = tmp_path / "out", tmp_path / "junit.xml"
    options = ["--assert-onset", "1e-10", "--junit", str(junit), "--out", str(out)]
    output = run(tmp_path, *options, code=1)
    assert "1e-08% is allowed" in output
    assert junit_counts(junit) == {"tests": 1, "failures": 1, "errors": 0, "skipped": 0}
    [case] = ElementTree.parse(junit).getroot().findall("testcase")
    assert case.find("failure") is not None
    assert "not met" in (out / "report.html").read_text(encoding="utf-8")


def test_a_map_flies_probes_and_own_trials_per_seed(tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ["--delay", "0,0.4", "--jitter", "0,0.01", "--seeds", "2", "--out", str(out), "--json"]
    result = json.loads(run(tmp_path, *options))
    for kind in ("probe", "own"):
        seeds = [point["seed"] for point in result["points"] if point["kind"] == kind]
        assert sorted(seeds) == 4 * [SCENARIO.seed] + 4 * [SCENARIO.seed + 1]
    verdicts = {(p["coordinates"]["delay"], p["verdict"]) for p in result["points"]}
    assert verdicts == {(0.0, "stable"), (0.4, "unstable")}
    assert (out / "map.png").stat().st_size > 0


def printed_refly(output: str) -> list[str]:
    """The arguments of the printed command that reflies the worst trial."""
    [line] = [line for line in output.splitlines() if line.startswith("again")]
    return line.split()[3:]


def test_the_printed_command_reflies_a_trial_to_the_last_bit(tmp_path: Path) -> None:
    """At 0.5 s of link delay and with jitter: the tick log's hash is part of what is compared."""
    out = tmp_path / "out"
    output = run(tmp_path, "--delay", "0.1,0.5", "--jitter", "0.01", "--out", str(out))
    scenario, *options = printed_refly(output)
    result = CliRunner().invoke(app, [scenario, *options])
    assert result.exit_code == 0, result.output
    assert re.search(r"^verdict  unstable: (not settled in|broken: )", result.output, re.MULTILINE)
    assert "identical to the last bit" in result.output
    [recording] = (out / "flights").rglob("flight.rrd")
    assert recording.stat().st_size > 0
    summary = json.loads((recording.parent / SUMMARY_FILE).read_text(encoding="utf-8"))
    assert (summary["scenario"], summary["verdict"]) == ("pair", "unstable")


@pytest.mark.parametrize("loss", ["0", "0.1"])
def test_a_reflown_trial_is_reported_as_a_flight(loss: str, tmp_path: Path) -> None:
    """At 0.32 s of loop delay errors grow by a few percent a second: the flight is completed, and unstable."""
    out = tmp_path / "out"
    output = run(tmp_path, "--delay", "0.31", "--loss", loss, "--out", str(out), duration_s=6.0)
    [files] = [line for line in output.splitlines() if line.startswith("files")]
    assert files == f"files    {out}: {', '.join(sorted(file.name for file in out.iterdir()))}"
    assert {"scenario.toml", "worst.png"} <= set(files.replace(",", "").split())
    with closing(trials_of(out)) as store:
        trials = list(store.flown.values())
    for trial in trials:
        printed = run(tmp_path, "--trial", trial.id, "--out", str(out), duration_s=6.0)
        assert f", delay 0.31 s, loss {loss}\n" in printed
        [verdict] = [line for line in printed.splitlines() if line.startswith("verdict")]
        if trial.verdict == "unstable":
            assert f"final spacing error {trial.spacing_error_final_m:.2f} m, largest" in verdict or "broken" in verdict


def test_both_flights_of_a_pair_are_kept_and_differences_reported(tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = json.loads(run(tmp_path, "--delay", "0.1", "--loss", "0.1", "--out", str(out), "--json"))
    [probe] = [point["id"] for point in result["points"] if point["kind"] == "probe"]
    run(tmp_path, "--trial", probe, "--out", str(out))
    assert len(list((out / "flights").rglob("flight.rrd"))) == 2
    table = out / TRIALS_FILE
    table.write_text(
        re.sub(r'"ticks_sha256": "\w{8}', '"ticks_sha256": "00000000', table.read_text()), encoding="utf-8"
    )
    reflown = run(tmp_path, "--trial", probe, "--out", str(out), code=1)
    assert "differs from the first flight in: ticks_sha256" in reflown


def test_a_sweep_over_two_vehicles_links_names_both_axes(tmp_path: Path) -> None:
    options = ["--delay-of", "1=0.1:0.2:2", "--delay-of", "2=0.1,0.3", "--out", str(tmp_path / "out"), "--json"]
    result = json.loads(run(tmp_path, *options))
    assert result["axes"] == {"delay_1": [0.1, 0.2], "delay_2": [0.1, 0.3]}
    assert result["noise"] is None


def test_a_rate_with_a_fractional_period_is_flown(tmp_path: Path) -> None:
    result = json.loads(run(tmp_path, "--rate", "30", "--out", str(tmp_path / "out"), "--json"))
    for point in result["points"]:
        assert point["verdict"] == "stable"
    [probe] = [point for point in result["points"] if point["kind"] == "probe"]
    # telemetry is sampled on whole milliseconds, up to one later than its period says
    assert probe["growth_1_s"] == pytest.approx(probe["predicted_growth_1_s"], rel=0.01)


@pytest.mark.realtime
def test_a_real_time_trial_records_the_machines_noise(tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ["--delay", "0.1", "--jitter", "0.005", "--real-time", "--out", str(out), "--json"]
    result = json.loads(run(tmp_path, *options, duration_s=2.0))
    assert [point["kind"] for point in result["points"]] == ["own"]
    noise = result["noise"]
    assert noise["flights"] == 1
    assert 0.0 <= noise["lateness_s_p50"]["median"] <= noise["lateness_s_p99"]["max"]
    assert 0.0 <= noise["steal_share"]["max"] <= noise["busy_share"]["max"] <= 1.0
    assert "Noise of the machine" in (out / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ([], "wanted --onset, or an axis"),
        (["--delay", "x"], "wanted FROM:TO:N"),
        (["--delay-of", "9=0:1:2"], "system id of a vehicle"),
        (["--delay", "0", "--rate", "50", "--loss", "0"], "wanted one (a sweep) or two (a map)"),
        (["--onset", "--tolerance", "2"], "wanted a fraction between 0 and 1"),
        (["--onset-of", "2", "--seeds", "3"], "--seeds: read 3, wanted it with an axis"),
        (["--onset-of", "2", "--onset", "--disturbance"], "read --disturbance and --onset-of"),
        (["--onset", "--resume"], "--resume: read no --out, wanted --out with the folder of a campaign"),
        (["--trial", "1234"], "--trial: read no --out, wanted --out with the folder of a campaign"),
        (["--onset", "--dask", "no address"], "wanted the address of a Dask scheduler"),
    ],
)
def test_unusable_input_is_refused_and_leaves_nothing(tmp_path: Path, options: list[str], wanted: str) -> None:
    (tmp_path / "pair.toml").write_text(dump(SCENARIO), encoding="utf-8")
    result = CliRunner().invoke(app, [str(tmp_path / "pair.toml"), *options])
    assert isinstance(result.exception, InputError)
    assert wanted in str(result.exception)
    assert [file.name for file in tmp_path.iterdir()] == ["pair.toml"]


def test_failed_trials_are_errors_in_junit(tmp_path: Path) -> None:
    failed = Outcome(
        id="abc", kind="own", seed=3, coordinates={"delay": 0.1}, real_time=False, error="Traceback\nValueError: no"
    )
    known: dict[str, Any] = {"scenario": "pair", "flight_time_s": 1.0, "failure": "", "assert_onset": None}
    result = CampaignResult.model_construct(**known, trials_failed=(failed,))
    write_junit(tmp_path / "junit.xml", "gcs stress pair", checks_of(result), time_s=1.0)
    suite = ElementTree.parse(tmp_path / "junit.xml").getroot()
    assert junit_counts(tmp_path / "junit.xml") == {"tests": 2, "failures": 0, "errors": 1, "skipped": 1}
    error = suite.findall("testcase")[1].find("error")
    assert error is not None
    assert error.get("message") == "ValueError: no"
