"""Commands run in this process: their exit code, and the one line with which they refuse their input."""

from pathlib import Path

import pytest

from gcs.cli.main import main


def exit_code(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int:
    """The exit code of `gcs` with these arguments."""
    monkeypatch.setattr("sys.argv", ["gcs", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert isinstance(ended.value.code, int)
    return ended.value.code


def complaint(monkeypatch: pytest.MonkeyPatch, capture: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """What `gcs` prints when it refuses its input: one line and nothing else."""
    code, printed = exit_code(monkeypatch, *arguments), capture.readouterr()
    assert (code, printed.out, printed.err.count("\n")) == (2, "", 1)
    return printed.err
