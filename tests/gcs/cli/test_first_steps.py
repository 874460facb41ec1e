"""A user's first steps: new scenarios, checks of what they would fly, and flights in virtual time."""

import json
from pathlib import Path

import numpy as np
import pytest

from gcs.plan.planner import flight_plan
from gcs.preflight.check import check
from gcs.runs.files import read_ticks
from gcs.runs.grade import grade
from gcs.runs.record import TLOG_FILE
from gcs.watch.tlog import parse_tlog
from scenarios.files import load, parse
from scenarios.schema import Scenario
from scenarios.shipped import columns, copied, names
from tests.support.commands import exit_code

pytestmark = pytest.mark.xdist_group("processes")  # flights start an observer process


@pytest.mark.parametrize("name", names())
def test_a_copied_scenario_differs_only_by_its_name(name: str, tmp_path: Path) -> None:
    text = copied(name, "mine")
    assert load_text(text, tmp_path).model_copy(update={"name": name}) == load_text(copied(name, name), tmp_path)


def load_text(text: str, folder: Path) -> Scenario:
    return parse(text, folder / "mine.toml")


@pytest.mark.parametrize(("count", "length"), [(1, 1), (1, 2), (1, 40), (3, 4), (2, 1), (7, 6)])
def test_new_columns_fly_in_their_places(count: int, length: int, tmp_path: Path) -> None:
    scenario = load_text(columns("mine", count, length), tmp_path)
    assert len(scenario.vehicles) == count * length
    found = check(flight_plan(scenario)[1])
    assert found.closest_m is None or found.closest_m >= 40.0
    assert max((v.spacing_error_m or 0.0) for v in found.vehicles) < 8.0
    assert len({v.place_ne_m for v in found.vehicles}) == count * length


def test_a_check_shows_the_commands_of_the_first_tick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the launcher vehicles report 25 m/s and do not move. Extrapolation thus errs by up to one period of that speed
    in every spacing error, times K3 = 5.6 1/s²."""
    monkeypatch.chdir(tmp_path)
    assert exit_code(monkeypatch, "new", "five.toml", "--chain", "5") == 0
    assert exit_code(monkeypatch, "fly", "five.toml", "--virtual", "--out", "run", "--json") == 0
    expected = {v.system_id: v.command_m_s2 for v in check(flight_plan(load(Path("five.toml")))[1]).vehicles}
    ticks = read_ticks(tmp_path / "run")
    first = ticks[ticks["commanded"]][: len(expected)]
    size = np.hypot(first["command_north_m_s2"], first["command_east_m_s2"])
    for system_id, flown in zip(first["system_id"].tolist(), size.tolist(), strict=True):
        assert flown == pytest.approx(expected[system_id], abs=25.0 * 0.02 * 5.7)


def test_a_virtual_flight_leaves_the_files_of_a_real_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert exit_code(monkeypatch, "new", "trio.toml") == 0
    for folder in ("one", "two"):
        assert exit_code(monkeypatch, "fly", "trio.toml", "--virtual", "--out", folder, "--json") == 0
    files = {file.name for file in Path("one").iterdir()}
    assert files == {
        "design.json", "events.jsonl", "flight.rrd", "flight.tlog", "report.html", "scenario.toml", "summary.json",
        "ticks.parquet", "truth.bin",
    }  # fmt: skip
    graded = grade(Path("one"))
    assert graded.loop_delay.error_max_s == pytest.approx(0.0, abs=1e-5)
    assert graded.link_delay.error_max_s == 0.0
    assert read_ticks(Path("one")).tobytes() == read_ticks(Path("two")).tobytes()
    frames = parse_tlog((Path("one") / TLOG_FILE).read_bytes()).frames
    times = [time_ns for time_ns, _ in frames]
    assert times == sorted(times)
    assert {84, 32, 111} <= {frame.msg_id for _, frame in frames}  # set-points, positions, TIMESYNC


def test_names_of_shipped_scenarios_are_accepted_in_place_of_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert exit_code(monkeypatch, "scenarios", "--json") == 0
    assert list(json.loads(capsys.readouterr().out)["scenarios"]) == names()
    assert exit_code(monkeypatch, "check", "chain3", "--json") == 0
    assert json.loads(capsys.readouterr().out)["delay_margin_s"] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("prediction", "wanted"),
    [
        ("0.6", "predicted over 600.0 ms: stable from 450.4 to 756.9 ms, headroom -268%: unstable"),
        ('"measured"', "predicted over 50.0 ms: stable from 0.0 to 331.8 ms, headroom 100%"),
        ('"off"', "margin 300.0 ms, headroom 83%"),
    ],
)
def test_check_says_between_which_delays_a_predicted_loop_is_stable(
    prediction: str, wanted: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    text = copied("triangle5", "mine").replace("[control]", f"[control]\nprediction = {prediction}")
    Path("mine.toml").write_text(text)
    assert exit_code(monkeypatch, "check", "mine.toml") == 0
    assert f"delay    loop 50.0 ± 10.0 ms expected from the links, {wanted}\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        ("fly chain3 --virtual --listen 127.0.0.1:0", "read --virtual and --listen, wanted one of them"),
        ("fly chain3 --speed 2", "read --speed without --virtual, wanted both"),
        ("fly chain3 --virtual --speed 0", "--speed: read 0, wanted a number from 0.01 to 1e+06"),
        ("new mine.txt", "read mine.txt, wanted a file name that ends in .toml"),
        ("new there.toml", "there.toml: read a file that exists, wanted a new one"),
        ("new mine.toml --chain 0", "--chain: read 0, wanted a number from 1 to 1000"),
        ("new mine.toml --columns 40x40", "--columns: read '40x40', wanted columns and vehicles in each, such as 3x4"),
        ("new mine.toml --columns ax4", "--columns: read 'ax4', wanted"),
        ("new missing/n.toml", "missing/n.toml: read no folder missing, wanted one that exists"),
        ("new mine.toml --like chain33", "wifi_bursts; did you mean chain3?"),
        ("fly chain33 --virtual", "chain33: read no such file, wanted a scenario file or the name of one"),
        ("margin triangel5", "triangel5: read no such file, wanted a model or a scenario (see gcs scenarios); did you"),
        ("check chain3 --links nolink", "--links: read 'nolink', wanted one of lte, radio, satellite, wifi, or a file"),
        ("check chain3 --links satelite", "did you mean satellite?"),
        ("new mine.toml --like nothing", "--like: read nothing, wanted one of chain20, chain3"),
        ("new mine.toml --chain 3 --like chain3", "read several of --like, --chain and --columns"),
    ],
)
def test_unusable_arguments_are_refused_in_one_line(
    arguments: str, wanted: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.toml").touch()
    assert exit_code(monkeypatch, *arguments.split()) == 2
    printed = capsys.readouterr().err
    assert wanted in printed
    assert printed.count("\n") == 1
    assert [file.name for file in tmp_path.iterdir()] == ["there.toml"]


def test_check_names_a_response_that_simulated_autopilots_do_not_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "copters.toml"
    given = "\n[response]\nlag_s = {}\nvelocity_gain_1_s = 2.0\n"
    for lag_s, differs in ((0.1, True), (0.15, False)):
        file.write_text(copied("copters5", "copters") + given.format(lag_s), encoding="utf-8")
        assert exit_code(monkeypatch, "check", file) == 0
        line = "response lag_s 0.1, for which the control is designed: the simulated autopilots have 0.15"
        assert (line in capsys.readouterr().out) == differs
