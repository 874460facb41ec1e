"""The examples run as they stand."""

import json
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import pytest

from tests.support.paths import ROOT

EXAMPLES = ROOT / "examples"


def test_errors_stop_dying_away_past_the_margin(tmp_path: Path) -> None:
    picture = tmp_path / "sweep.png"
    command = [sys.executable, EXAMPLES / "delay_sweep.py", picture]
    said = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path).stdout.splitlines()
    assert said[0] == "delay margin 0.300 s"
    assert [line.split(": ")[1].split(",")[0] for line in said[1:]] == ["stable", "stable", "stable", "unstable"]
    assert picture.stat().st_size > 10_000


@pytest.mark.timeout(180)
def test_an_own_law_flies_with_and_without_a_margin(tmp_path: Path) -> None:
    command = [sys.executable, EXAMPLES / "own_law" / "fly.py"]
    said = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path).stdout.splitlines()
    assert said == [
        "soft: stable, commands up to 14.7 m/s² an axis, delay margin unknown: law without control.linear; measure it "
        "with gcs stress --onset",
        "linear: stable, commands up to 18.7 m/s² an axis, delay margin 0.186 s",
    ]


def test_the_notebook_runs_from_top_to_bottom(monkeypatch: pytest.MonkeyPatch) -> None:
    mpl.use("Agg")
    cells = json.loads((EXAMPLES / "margin_to_flight.ipynb").read_text(encoding="utf-8"))["cells"]
    session: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            exec("".join(cell["source"]), session)
    assert session["flight"].summary.verdict == "stable"  # type: ignore[attr-defined]
