"""What a shell and an editor get: completion, JSON that parses, a schema beside a new scenario."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NoReturn

import pytest
from typer.testing import CliRunner

from gcs.cli.main import app
from scenarios.files import dump, load
from scenarios.schema import Control, FixedGains
from tests.support.commands import exit_code
from tests.support.paths import SCENARIOS


def completed(typed: str) -> list[str]:
    """What bash offers for the last word of a command line."""
    asks = {"COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" ")), "_GCS_COMPLETE": "complete_bash"}
    command = [sys.executable, "-c", "import sys; sys.argv[0] = 'gcs'; from gcs.cli.main import main; main()"]
    done = subprocess.run(command, env=os.environ | asks, capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_shell_completes_commands_options_and_scenarios() -> None:
    assert completed("gcs cap") == ["capacity"]
    assert completed("gcs fly --assert-h") == ["--assert-headroom"]
    assert completed("gcs check triangle5") == ["triangle5", "triangle5_scattered", "triangle5_turns"]


def test_check_of_an_unstable_loop_prints_json_that_parses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    unstable = tmp_path / "unstable.toml"
    control = Control(gains=FixedGains(K1=1.0, K2=0.0, K3=1.0))
    unstable.write_text(dump(load(SCENARIOS / "chain3.toml").model_copy(update={"control": control})), encoding="utf-8")
    assert exit_code(monkeypatch, "check", str(unstable), "--allow-unstable", "--json") == 0
    found = json.loads(capsys.readouterr().out, parse_constant=refuse)
    assert (found["schema_version"], found["delay_margin_s"], found["headroom"]) == (1, 0.0, None)


def refuse(constant: str) -> NoReturn:
    raise AssertionError(f"{constant} is no JSON")


def test_new_scenario_names_the_schema_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "mine.toml"
    assert exit_code(monkeypatch, "new", str(file)) == 0
    first = file.read_text(encoding="utf-8").splitlines()[0]
    assert first == "#:schema ./scenario.schema.json"
    assert "properties" in json.loads((tmp_path / "scenario.schema.json").read_text(encoding="utf-8"))
    assert load(file).name == "mine"


def test_no_command_is_cut_in_the_list_of_commands() -> None:
    """In a terminal of 80 columns, where text that is too long ends in three dots."""
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "80"}).output
    commands = shown.partition("Commands:\n")[2].splitlines()
    assert len(commands) == len(app.registered_commands)
    assert [line for line in commands if not line.endswith(".") or line.endswith("...")] == []


@pytest.mark.parametrize(
    ("command", "option"), [("stress", "--link-delay of gcs fly"), ("fly", "--delay of gcs stress")]
)
def test_help_says_that_delays_of_links_differ(command: str, option: str) -> None:
    shown = " ".join(CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "80"}).output.split())
    assert option in shown
    assert "each way" in shown
    assert "up + down" in shown
