"""The script of the page on SITL starts the five vehicles of copters5, each at its own home."""

import os
import subprocess
from math import cos, radians
from pathlib import Path

import pytest

from docs.generate.sessions import steps_of
from scenarios.files import load
from tests.support.paths import ROOT, SCENARIOS

[SCRIPT] = [step.text for step in steps_of(ROOT / "docs/how-to/sitl-in-ci.md") if step.file == "with-sitl.sh"]
RECORDER = '#!/bin/bash\nprintf "%s\\n" "$@" > arguments.part\nmv arguments.part arguments\nexec sleep 60\n'
"""Stands in for arducopter: writes its arguments to a file in the folder where it is started."""
WAIT = 'for i in 1 2 3 4 5; do until [ -e sitl/$i/arguments ]; do sleep 0.02; done; done; exit "$0"'


def started(folder: Path, exit_code: int) -> "subprocess.CompletedProcess[str]":
    binary = folder / "ardupilot/build/sitl/bin/arducopter"
    binary.parent.mkdir(parents=True)
    binary.write_text(RECORDER)
    binary.chmod(0o755)
    (folder / "with-sitl.sh").write_text(SCRIPT)
    command = ["bash", "with-sitl.sh", "ardupilot", "bash", "-c", WAIT, str(exit_code)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=30, check=False)


def test_five_vehicles_start_at_the_places_of_copters5(tmp_path: Path) -> None:
    done = started(tmp_path, 0)
    assert (done.returncode, done.stderr) == (0, "")
    homes: dict[int, list[float]] = {}
    instances: set[str] = set()
    for number in range(1, 6):
        given = (tmp_path / f"sitl/{number}/arguments").read_text().split("\n")
        after = {name: given[given.index(name) + 1] for name in ("--sysid", "--home", "--serial0", "--defaults")}
        homes[int(after["--sysid"])] = [float(part) for part in after["--home"].split(",")]
        instances |= {word for word in given if word.startswith("-I")}
        assert after["--serial0"] == "udpclient:127.0.0.1:14550"
        assert after["--defaults"] == os.path.realpath(tmp_path / "ardupilot/Tools/autotest/default_params/copter.parm")
    assert instances == {f"-I{k}" for k in range(5)}
    origin = homes[1]
    for vehicle in load(SCENARIOS / "copters5.toml").vehicles:
        latitude, longitude, altitude_m, _ = homes[vehicle.system_id]
        metres = 6_371_000.0 * radians(1.0)
        place = (latitude - origin[0]) * metres, (longitude - origin[1]) * metres * cos(radians(origin[0]))
        assert place == pytest.approx(vehicle.position_ne_m, abs=0.05)  # earth radii differ by 1 in 900, digits by 1 cm
        assert altitude_m == origin[2]


def test_the_script_exits_with_the_gates_code_and_stops_vehicles(tmp_path: Path) -> None:
    assert started(tmp_path, 3).returncode == 3  # and returned at once, though the vehicles would sleep for a minute
