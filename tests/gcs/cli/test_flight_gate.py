"""A flight as a gate in CI: assertions, exit codes and JUnit XML."""

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from scenarios.files import dump, load
from scenarios.keys.link import Link, Links, Outage, VehicleLinks
from tests.support.commands import complaint, exit_code
from tests.support.paths import SCENARIOS

pytestmark = pytest.mark.xdist_group("processes")  # flights start an observer process


def fly(folder: Path, monkeypatch: pytest.MonkeyPatch, *options: str | Path, links: Links | None = None) -> int:
    file, scenario = folder / "chain3.toml", load(SCENARIOS / "chain3.toml").model_copy(update={"duration_s": 4.0})
    file.write_text(dump(scenario if links is None else scenario.model_copy(update={"links": links})))
    return exit_code(monkeypatch, "fly", file, "--virtual", "--json", "--out", folder / "run", *options)


def test_assertions_that_hold_pass(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    junit = tmp_path / "f.xml"
    options = ["--assert-headroom", "0.8", "--assert-settled", "2", "--junit", junit]
    assert fly(tmp_path, monkeypatch, *options) == 0
    suite = ElementTree.parse(junit).getroot()
    assert [suite.get(count) for count in ("tests", "failures", "errors", "skipped")] == ["5", "0", "0", "0"]
    assert capfd.readouterr().err == ""


def test_each_assertion_that_fails_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    junit = tmp_path / "f.xml"
    options = ["--assert-headroom", "0.9", "--assert-settled", "0.1", "--junit", junit, "--link-delay", "0.1"]
    assert fly(tmp_path, monkeypatch, *options) == 1
    suite = ElementTree.parse(junit).getroot()
    failed = [case.get("name") for case in suite if case.find("failure") is not None]
    assert failed == ["the headroom is at least 90.0%", "the errors settle within 0.1 s"]
    headroom, settled = capfd.readouterr().err.splitlines()
    assert re.fullmatch(r"failed: --assert-headroom: read \d\d\.\d%, wanted at least 90%", headroom)
    assert re.fullmatch(r"failed: --assert-settled: read \d+\.\d+ s, wanted at most 0\.1 s", settled)


def test_a_vehicle_that_does_not_confirm_the_end_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    gone = Link(outages=(Outage(from_s=3.9, until_s=60.0),))
    assert fly(tmp_path, monkeypatch, links=Links(vehicles=(VehicleLinks(system_id=3, up=gone, down=gone),))) == 1
    summary = json.loads(capfd.readouterr().out)
    assert (summary["verdict"], summary["not_confirmed"]) == ("stable", "vehicle 3 is silent")


@pytest.mark.parametrize(
    ("option", "value", "wanted"),
    [
        ("--assert-headroom", "1.5", "--assert-headroom: read 1.5, wanted a number from -1000 to 1"),
        ("--assert-settled", "-1", "--assert-settled: read -1, wanted seconds from 0"),
        ("--junit", "/", "--junit: /: Is a directory"),
        ("--link-delay", "61", "--link-delay: read 61, wanted seconds from 0 to 60"),
    ],
)
def test_bad_options_are_refused_before_the_flight(
    option: str,
    value: str,
    wanted: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert fly(tmp_path, monkeypatch, option, value) == 2
    err = capfd.readouterr().err
    assert wanted in err
    assert err.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_a_check_is_a_gate_on_the_expected_headroom(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """chain3 has a margin of 300 ms and 60 ms of loop delay at most, over links of 20 ms each way: 80 %."""

    gate = "check", "chain3", "--json", "--assert-headroom"
    assert [exit_code(monkeypatch, *gate, least) for least in ("0.8", "0.82", "2")] == [0, 1, 2]
    failed, refused = capfd.readouterr().err.splitlines()
    assert failed == "failed: --assert-headroom: read 80.0% for 99 % of the set-points, wanted at least 82%"
    assert refused == "--assert-headroom: read 2, wanted a number from -1000 to 1"


def test_a_check_is_no_gate_for_autopilots_not_yet_identified(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Their margin is 600 ms if they respond at once, 445 ms with their actual response."""
    refused = complaint(monkeypatch, capfd, "check", "copters5", "--link-delay", "0.23", "--assert-headroom", "0.1")
    assert "read autopilots that are identified in flight, wanted a [response] in the scenario" in refused
