"""The `gcs` command in processes forked from one that has loaded the project, which saves each a second or two."""

import contextlib
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from multiprocessing import forkserver, get_context
from pathlib import Path
from subprocess import CompletedProcess, TimeoutExpired

from docs.generate.blocks import ROOT
from gcs.__main__ import main

_CONTEXT = get_context("forkserver")


def run_gcs(
    arguments: Sequence[str], folder: Path, environment: Mapping[str, str] | None = None, timeout_s: float | None = None
) -> CompletedProcess[str]:
    """Run `gcs` with arguments in a folder, with these changes of the environment, as `subprocess.run` would."""
    with contextlib.chdir(ROOT):  # where the server finds what it loads
        _CONTEXT.set_forkserver_preload(["docs.generate.preloaded"])
        forkserver.ensure_running()
    with tempfile.TemporaryDirectory() as name:
        printed = [Path(name) / stream for stream in ("stdout", "stderr")]
        started = {**os.environ, **(environment or {})}
        process = _CONTEXT.Process(target=_gcs, args=(list(arguments), folder, started, printed))
        process.start()
        process.join(timeout_s)
        if process.exitcode is None:
            process.kill()
            process.join()
            raise TimeoutExpired(["gcs", *arguments], timeout_s or 0.0)
        stdout, stderr = (file.read_text(encoding="utf-8") if file.exists() else "" for file in printed)
        return CompletedProcess(["gcs", *arguments], process.exitcode, stdout, stderr)


def _gcs(arguments: list[str], folder: Path, environment: Mapping[str, str], printed: Sequence[Path]) -> None:
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = ["gcs", *arguments]
    for number, file in enumerate(printed, 1):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), number)
    sys.stdout, sys.stderr = (os.fdopen(number, "w", encoding="utf-8", closefd=False) for number in (1, 2))
    main()
