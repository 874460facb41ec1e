"""A flight in a viewer while it flies, and its recording in a browser."""

import os
import re
import subprocess
import sys
import time  # noqa: TID251 - waits for another program
import urllib.request
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rerun.experimental import ViewerClient

from gcs.views import viewer
from gcs.views.recording import length_s
from scenarios.files import dump, load
from tests.support.paths import SCENARIOS
from tests.support.processes import PATIENCE_S, gcs

pytestmark = pytest.mark.xdist_group("processes")
needs_vulkan = pytest.mark.skipif(viewer.vulkan_missing(), reason="no Vulkan driver to draw with")


@contextmanager
def headless(folder: Path) -> Generator[str]:
    """HOST:PORT of a viewer without a window."""
    program = viewer._program()  # noqa: SLF001
    log = folder / "viewer.log"
    with log.open("wb") as out:
        process = subprocess.Popen(
            [program, "--headless", "--bind", "127.0.0.1", "--port", "0"],
            stdout=out, stderr=out, env=os.environ | {"RERUN_APP_ONLY": "true"},
        )  # fmt: skip
    try:
        give_up = time.monotonic() + PATIENCE_S
        while "Headless viewer running" not in (text := log.read_text()) and time.monotonic() < give_up:
            time.sleep(0.05)
        found = re.search(r"rerun\+http://([0-9.:]+)/proxy", text)
        assert found is not None, text
        yield found.group(1)
    finally:
        process.kill()
        process.wait()


def fly(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    file = folder / "chain3.toml"
    file.write_text(dump(load(SCENARIOS / "chain3.toml").model_copy(update={"duration_s": 3.0})))
    return gcs("fly", file, "--virtual", "--out", folder / "run", *options)


@needs_vulkan
def test_a_viewer_shows_the_flight_and_the_file_holds_it(tmp_path: Path) -> None:
    with headless(tmp_path) as at:
        done = fly(tmp_path, "--live", at)
        assert (done.returncode, done.stderr) == (0, "")
        client = ViewerClient.connect(f"rerun+http://{at}/proxy")
        client.set_time("sim_time", duration=2.0, play_state="paused")
        names = {view.name for view in client.get_state().views}
    assert any("Spacing errors" in name for name in names)
    assert length_s(tmp_path / "run" / "flight.rrd") == pytest.approx(3.0, abs=0.1)


def test_where_no_viewer_listens_nothing_flies(tmp_path: Path) -> None:
    done = fly(tmp_path, "--live", "127.0.0.1:1")
    assert done.returncode == 2
    assert "nothing listens at 127.0.0.1:1, wanted an open Rerun viewer" in done.stderr
    assert not (tmp_path / "run").exists()


def test_a_browser_is_served_the_recording(tmp_path: Path) -> None:
    assert fly(tmp_path).returncode == 0
    command = [sys.executable, "-m", "gcs", "view", tmp_path / "run", "--web"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            said = process.stdout.readline()
            page, data = re.findall(r"(http://[0-9.:]+)\?url=\S*%3A([0-9]+)%2Fproxy", said)[0]
            with urllib.request.urlopen(page, timeout=PATIENCE_S) as answer:
                assert b"rerun" in answer.read().lower()
            assert viewer.viewer_url("127.0.0.1", int(data)).endswith("/proxy")
        finally:
            process.terminate()
            process.wait()
