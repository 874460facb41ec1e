"""The live tables as a person sees them, in real terminals: rows, headroom, modes, and a working shell afterwards."""

import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from gcs.control.tick import Mode
from scenarios.files import dump, load
from tests.support.paths import ROOT
from tests.support.terminals import Terminal, is_restored, rows, terminal, wait_for

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("processes")]

MODES = re.compile("|".join(Mode.__members__))
NOMINAL = re.compile("NOMINAL")
KINDS = [
    "pseudo",
    pytest.param("tmux", marks=pytest.mark.skipif(shutil.which("tmux") is None, reason="tmux is not installed")),
]


def command(*arguments: str | Path) -> str:
    return " ".join([sys.executable, "-m", "gcs", *map(str, arguments)]) + "\r"


def start_flight(shown: Terminal, folder: Path) -> None:
    """Fly triangle5 until told to stop."""
    scenario = load(ROOT / "scenarios" / "triangle5.toml").model_copy(update={"duration_s": 60.0})
    (folder / "t.toml").write_text(dump(scenario), encoding="utf-8")
    shown.send(command("fly", folder / "t.toml", "--listen", "127.0.0.1:0", "--out", folder / "run"))
    wait_for(lambda: len(rows(shown, NOMINAL)) == 5, shown)


@pytest.mark.parametrize("kind", KINDS)
def test_the_flight_table_stands_until_ctrl_c_restores_the_shell(kind: str, tmp_path: Path) -> None:
    with terminal(kind, 120, 40, tmp_path) as shown:
        start_flight(shown, tmp_path)
        text = shown.lines()
        assert not shown.cursor_shown()
        assert any(line.startswith("triangle5  flying") and "delay margin 300 ms" in line for line in text)
        [heading] = [line for line in text if "follows" in line and "mode" in line]
        for system_id, row in rows(shown, NOMINAL).items():
            assert row[1] == {1: "–", 2: "1", 3: "2", 4: "1", 5: "4"}[system_id]
            loop_delay_ms, margin_ms, headroom = float(row[6]), float(row[7]), int(row[8])
            assert 20 < loop_delay_ms < margin_ms == 300
            assert headroom == pytest.approx(100 * (1 - loop_delay_ms / margin_ms), abs=15)
        assert heading.split()[:2] == ["id", "follows"]
        shown.send("\x03")
        wait_for(lambda: any(line.startswith("look     gcs view") for line in shown.lines()), shown)
        assert any(line.startswith("verdict  aborted: interrupted: SIGINT") for line in shown.lines())
        assert is_restored(shown)


@pytest.mark.slow(first=2)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("columns", "lines"), [(60, 24), (40, 20)])
def test_a_narrow_terminal_shows_each_vehicles_headroom_and_mode(
    kind: str, columns: int, lines: int, tmp_path: Path
) -> None:
    with terminal(kind, columns, lines, tmp_path) as shown:
        start_flight(shown, tmp_path)
        found = rows(shown, NOMINAL)
        assert sorted(found) == [1, 2, 3, 4, 5]
        for row in found.values():
            _, _, loop_delay_ms, headroom, mode = row
            assert int(headroom) == pytest.approx(100 * (1 - float(loop_delay_ms) / 300), abs=15)
            assert mode == "NOMINAL"
        shown.resize(110, 40)
        wait_for(lambda: any("follows" in line for line in shown.lines()), shown)
        wait_for(lambda: {row[1] for row in rows(shown, NOMINAL).values()} == {"–", "1", "2", "4"}, shown)
        shown.resize(columns, lines)
        # A terminal may leave wrapped pieces of the wider table above.
        wait_for(lambda: all(len(rows(shown, NOMINAL).get(k, [])) == 5 for k in range(1, 6)), shown)
        shown.send("\x03")
        wait_for(lambda: any("gcs view" in line for line in shown.lines()), shown)
        assert is_restored(shown)


def test_the_links_table_stands_until_ctrl_c_restores_the_shell(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    vehicles = [sys.executable, "-m", "sim_vehicles.drive.cli", "scenarios/chain3.toml", "--station", address]
    measured = re.compile("measured")
    with terminal("pseudo", 120, 30, tmp_path) as shown:
        process = subprocess.Popen(vehicles, stdout=subprocess.DEVNULL, cwd=ROOT)
        try:
            shown.send(command("monitor", "--listen", address, "--margin", "0.5"))
            wait_for(lambda: len(rows(shown, measured)) == 3, shown)
            for row in rows(shown, measured).values():
                assert float(row[1]) == pytest.approx(40, abs=4)
                assert 0 < int(row[6]) < 100
            shown.send("\x03")
            assert is_restored(shown)
            assert any("requests, nothing else" in line for line in shown.lines())
        finally:
            process.terminate()
            process.wait()
