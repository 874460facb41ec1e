"""Input that a command cannot use, as `main` meets it: one line with what was read and what was wanted, exit code 2."""

import sys
from pathlib import Path

import pytest
from flown_run import line, ticks_of, write_run

from gcs.cli import main

CHAIN = "scenarios/chain3.toml"
ROOT = Path(__file__).parent.parent


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a run, whole; `{run}` in arguments."""
    folder = tmp_path / "run"
    folder.mkdir()
    scenario = line(3)
    write_run(folder, scenario, ticks_of(scenario, start_s=0.0, count=100))
    return folder


def complaint(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: str) -> str:
    """What a command says that refuses its input: one line and nothing else."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", ["gcs", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    told = capsys.readouterr()
    assert (ended.value.code, told.out) == (2, "")
    assert told.err.count("\n") == 1
    return told.err


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        ("view {run} --picture /proc/x.png", "--picture: /proc/x.png: No such file or directory, wanted a file that"),
        ("view {run} --picture {run}", "run: Is a directory, wanted a file that can be written"),
        ("view {run} --picture {run}/a.png --at nan", "--at: read nan, wanted seconds from"),
        ("view {run} --picture {run}/a.png --at 1e300", "--at: read 1e+300, wanted seconds from"),
        ("view README.md", "README.md: read a file of another kind; wanted a recording of a run (.rrd)"),
        (f"fly {CHAIN} --link-delay nan", "--link-delay: read nan, wanted seconds from 0 to 60"),
        (
            f"stress {CHAIN} --onset --out /proc/x",
            "--out: /proc/x: No such file or directory, wanted a folder that can",
        ),
        (f"stress {CHAIN} --onset --out README.md", "--out: README.md: File exists, wanted a folder that can"),
        (f"stress {CHAIN} --onset --out {{run}}", "run is not empty, wanted a new or empty folder, or --resume"),
        (f"stress {CHAIN} --onset --junit {{run}}", "run: Is a directory, wanted a file that can be written"),
        (f"stress {CHAIN} --onset --tolerance nan", "--tolerance: read nan, wanted a part between 0 and 1"),
        (f"stress {CHAIN} --delay 0:x:3", "--delay: "),
    ],
)
def test_what_cannot_be_used_is_refused_before_the_work(
    arguments: str, wanted: str, run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said = complaint(capsys, monkeypatch, *arguments.format(run=run).split())
    assert wanted in said
    assert "Invalid value" not in said
