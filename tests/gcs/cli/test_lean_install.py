"""Commands where an extra is not installed: they do without it, or say in one line which one they need."""

import sys
from pathlib import Path

import pytest

from gcs.runs.summary import finish
from gcs.views.observer import recover_run
from gcs.views.report import print_summary
from scenarios.files import dump, load
from tests.support.commands import exit_code
from tests.support.fleets.flown_run import line, ticks_of, write_run
from tests.support.paths import SCENARIOS


def without(monkeypatch: pytest.MonkeyPatch, *modules: str) -> None:
    """Make imports of these modules fail as if they were not installed."""
    for module in modules:
        monkeypatch.setitem(sys.modules, module, None)
    for importer in ("gcs.views.recording", "mcap.writer"):
        monkeypatch.delitem(sys.modules, importer, raising=False)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    write_run(folder, line(3), ticks_of(line(3), start_s=0.0, count=100))
    return folder


def test_run_without_rerun_is_complete_except_for_its_recording(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    without(monkeypatch, "rerun")
    summary = recover_run(run)
    assert "flight.rrd" not in summary.files
    assert "report.html" in summary.files
    assert finish(run, unwritten=()).not_logged == ()
    wanted = "no flight.rrd: the package rerun is not installed; wanted pip install 'formation-gcs[viewer]'\n"
    assert capsys.readouterr().err == wanted


def test_last_line_names_the_report_if_no_viewer_is_installed(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    without(monkeypatch, "rerun")
    print_summary(recover_run(run), run)
    said = " ".join(capsys.readouterr().out.replace("\n", "").split())
    assert said.endswith(f"look {run / 'report.html'} in a browser")


@pytest.mark.parametrize(
    ("module", "command", "wanted"),
    [
        ("mcap", "export {run} --mcap {run}/a.mcap", "the package mcap is not installed; wanted pip install"),
        ("rerun", "view {run}", "'formation-gcs[viewer]'"),
        ("rerun", "fly {scenarios}/chain3.toml --virtual --live 127.0.0.1:9 --out {run}/live --json", "[viewer]'"),
        ("distributed", "bench {scenarios}/chain3.toml --cluster 2", "'formation-gcs[cluster]'"),
        ("cvxpy", "design {scenarios}/chain3_bidirectional.toml --method graph-dk", "'formation-gcs[solver]'"),
    ],
)
def test_missing_extra_is_named_in_one_line(
    module: str,
    command: str,
    wanted: str,
    run: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    without(monkeypatch, module)
    assert exit_code(monkeypatch, *command.format(run=run, scenarios=SCENARIOS).split()) == 2
    printed = capsys.readouterr().err
    assert wanted in printed
    assert printed.count("\n") == 1


def test_campaign_without_matplotlib_has_a_report_without_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    without(monkeypatch, "matplotlib")
    file = tmp_path / "short.toml"
    file.write_text(dump(load(SCENARIOS / "chain3.toml").model_copy(update={"duration_s": 3.0})), encoding="utf-8")
    out = tmp_path / "out"
    assert exit_code(monkeypatch, "stress", file, "--delay", "0.1", "--workers", "1", "--out", out) == 0
    printed = capsys.readouterr().err
    assert "no figures: the package matplotlib is not installed" in printed
    assert "flights  2, 24 s in all: about " in printed
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "<img" not in page
    assert "All points" in page
