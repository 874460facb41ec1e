"""Code that a scenario names is run only with --allow-code, by every command that would run it."""

import json
from pathlib import Path

import pytest

from gcs import fly_virtual
from gcs.plan.own_law import OWN_LAW
from gcs.runs.files import read_ticks
from scenarios.files import dump
from scenarios.own_code import write_code
from sim_vehicles.drive.cli import run as sim_vehicles
from tests.support.commands import exit_code
from tests.support.fleets.own_code import LAW, coded

MARKS = "from pathlib import Path\nPath('ran').touch()\n" + LAW


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scenario whose code leaves a file in the working folder, which is that of the scenario."""
    scenario = coded(MARKS, law="soft", duration_s=2.0)
    write_code(scenario, tmp_path)
    (tmp_path / "pair.toml").write_text(dump(scenario))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "pair.toml"


@pytest.mark.parametrize(
    "arguments",
    [
        "check pair.toml",
        "design pair.toml",
        "margin pair.toml",
        "fly pair.toml --virtual",
        "stress pair.toml --onset",
        "stress pair.toml --onset --disturbance",
        "bench pair.toml",
        "compare pair.toml",
        "capacity pair.toml",
    ],
)
def test_a_command_that_was_not_allowed_runs_no_code(
    arguments: str, file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(monkeypatch, *arguments.split()) == 2
    printed = capsys.readouterr()
    assert (printed.out, printed.err.count("\n")) == ("", 1)
    assert printed.err.startswith("pair.toml: control.controller: read 'own.py:soft', wanted ")
    if arguments.split(maxsplit=1)[0] not in ("compare", "capacity"):
        assert printed.err.endswith("--allow-code to run the code in own.py\n")
    assert not Path("ran").exists()


def test_simulated_vehicles_run_no_code_that_was_not_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario = coded(MARKS, dynamics="step")
    write_code(scenario, tmp_path)
    (tmp_path / "pair.toml").write_text(dump(scenario))
    monkeypatch.chdir(tmp_path)
    assert sim_vehicles(["pair.toml"]) == 2
    assert "dynamics: read 'own.py:step', wanted --allow-code to run the code in own.py" in capsys.readouterr().err
    assert not Path("ran").exists()


def test_check_shows_the_code_that_it_runs(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(monkeypatch, "check", "pair.toml", "--allow-code") == 0
    printed = capsys.readouterr().out
    [code] = coded(MARKS, law="soft").code
    assert f"runs     control.controller = own.py:soft, sha256 {code.sha256}" in printed
    assert f"margin   unknown: {OWN_LAW}" in printed
    assert exit_code(monkeypatch, "check", "pair.toml", "--allow-code", "--json") == 0
    assert json.loads(capsys.readouterr().out)["code"] == {
        "control.controller = own.py:soft": {"file": "own.py", "sha256": code.sha256}
    }


def test_unknown_margins_cannot_be_asserted(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(monkeypatch, "stress", "pair.toml", "--assert-onset", "0.01", "--allow-code") == 2
    assert "the margin is unknown" in capsys.readouterr().err
    assert exit_code(monkeypatch, "margin", "pair.toml", "--allow-code") == 2
    assert OWN_LAW in capsys.readouterr().err


def test_a_campaign_prints_the_command_that_reflies_its_code(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = "stress pair.toml --delay 0.1 --workers 1 --allow-code --out map"
    assert exit_code(monkeypatch, *arguments.split()) == 0
    [again] = [line for line in capsys.readouterr().out.splitlines() if line.startswith("again ")]
    assert exit_code(monkeypatch, *again.split()[2:]) == 0
    assert "identical to the last bit" in capsys.readouterr().out


def test_a_run_keeps_its_code_and_flies_again_from_it(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = file.parent / "run"
    assert exit_code(monkeypatch, "fly", "pair.toml", "--virtual", "--allow-code", "--out", "run") in (0, 1)
    (file.parent / "own.py").unlink()
    [code] = coded(MARKS, law="soft").code
    recorded = [{"file": "own.py", "sha256": code.sha256}]
    assert (run / "own.py").read_text() == MARKS
    for name in ("summary.json", "design.json"):
        assert json.loads((run / name).read_text())["code"] == recorded
    assert "law " in capsys.readouterr().out
    again = fly_virtual(run / "scenario.toml", allow_code=True)
    assert again.ticks.tobytes() == read_ticks(run).tobytes()
