"""`gcs margin` as a user runs it: systems with known margins, and input that cannot be used."""

import json
import subprocess
from math import log, pi
from pathlib import Path
from typing import Any

import pytest

from tests.support.paths import ROOT
from tests.support.processes import gcs

KNOWN: dict[str, tuple[dict[str, Any], list[list[float | None]]]] = {
    "x' = -x(t - tau): pi/2": ({"A0": [[0.0]], "A1": [[-1.0]]}, [[0.0, pi / 2]]),
    "Gu, Kharitonov, Chen 2003, page 192": (
        {"A0": [[-2.0, 0.0], [0.0, -0.9]], "A1": [[-1.0, 0.0], [-1.0, -1.0]]},
        [[0.0, 6.172581371221286]],
    ),
    "delay-induced stability, the same, page 193": (
        {"A0": [[0.0, 1.0], [-2.0, 0.1]], "A1": [[0.0, 0.0], [1.0, 0.0]]},
        [[0.10016826845243451, 1.7178581782970905]],
    ),
    "stable for every delay (Hayes)": ({"A0": [[-2.0]], "A1": [[1.0]]}, [[0.0, None]]),
    "the same delay written as terms": (
        {"terms": [{"A": [[0.0]], "delay": 0}, {"A": [[-1.0]], "delay": "2*tau"}]},
        [[0.0, pi / 4]],
    ),
    "x'' = -2 x + x(t - tau), on the axis at 0, beside a link that carries nothing: pi / sqrt(3)": (
        {
            "terms": [
                {"A": [[0, 1], [-2, 0]], "delay": 0},
                {"A": [[0, 0], [1, 0]], "delay": "tau"},
                {"A": [[0, 0], [0, 0]], "delay": "0.8 + tau"},
            ]
        },
        [[0.0, pi / 3**0.5]],
    ),
    "sampled loop, the period unknown": (
        {"A": [[0, 1], [0, -0.1]], "B": [[0], [0.1]], "K": [[-3.75, -11.5]], "hold": True},
        [[0.0, 1.7294142794798775]],
    ),
    "an unstable plant, held: e^2T - 1.5 (e^2T - 1) = -1": (
        {"A": [[2]], "B": [[1]], "K": [[-3]], "hold": True},
        [[0.0, log(5) / 2]],
    ),
}


def run(tmp_path: Path, text: str, *options: str) -> "subprocess.CompletedProcess[str]":
    file = tmp_path / "model.json"
    file.write_text(text, encoding="utf-8")
    return gcs("margin", file, *options)


@pytest.mark.parametrize(("model", "intervals"), KNOWN.values(), ids=KNOWN)
def test_known_margins(tmp_path: Path, model: dict[str, Any], intervals: list[list[float | None]]) -> None:
    done = run(tmp_path, json.dumps(model), "--json")
    assert (done.returncode, done.stderr) == (0, "")
    result = json.loads(done.stdout)
    assert len(result["stable_intervals_s"]) == len(intervals)
    for got, wanted in zip(result["stable_intervals_s"], intervals, strict=True):
        assert got == [None if end is None else pytest.approx(end, rel=1e-8) for end in wanted]
    first = intervals[0]
    assert result["delay_margin_s"] == (first[1] if first[0] == 0.0 and first[1] is None else pytest.approx(
        first[1] if first[0] == 0.0 else 0.0, rel=1e-8
    ))  # fmt: skip


@pytest.mark.parametrize(
    ("name", "interval"),
    [
        ("two_matrices", [0.10016826845243451, 1.7178581782970905]),
        # the delay of the coupling does not matter: each state is a loop of its own, the second with 2 tau
        ("terms", [0.0, 6.172581371221286 / 2]),
        ("held", [0.0, 1.7294142794798775]),
        # from SciPy's matrix exponential over one period, bisected to its unit circle
        ("held_late", [0.0, 1.157157060376148]),
    ],
)
def test_model_files_in_docs_have_their_known_margins(tmp_path: Path, name: str, interval: list[float]) -> None:
    text = (ROOT / "docs" / "models" / f"{name}.json").read_text(encoding="utf-8")
    [found] = json.loads(run(tmp_path, text, "--json").stdout)["stable_intervals_s"]
    assert found == pytest.approx(interval, rel=1e-8)


@pytest.mark.parametrize("gain", [0, -1])
def test_too_little_gain_stabilises_an_unstable_plant_at_no_period(tmp_path: Path, gain: int) -> None:
    done = run(tmp_path, json.dumps({"A": [[2]], "B": [[1]], "K": [[gain]], "hold": True}), "--json")
    assert (done.returncode, done.stderr) == (0, "")
    result = json.loads(done.stdout)
    assert (result["stable_intervals_s"], result["unstable_roots_at_zero_delay"]) == ([], 1)


def test_fixed_delays_give_the_rightmost_root(tmp_path: Path) -> None:
    model = {"terms": [{"A": [[0.0]], "delay": 0}, {"A": [[-1.0]], "delay": pi / 2}]}
    result = json.loads(run(tmp_path, json.dumps(model), "--json").stdout)
    assert result["rightmost_root"][0] == pytest.approx(0.0, abs=1e-9)
    assert abs(result["rightmost_root"][1]) == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("{", "JSON"),
        ('{"A0": [[1]]}', "A0"),
        ('{"A0": [[1, 2], [3]], "A1": [[1]]}', "A0"),
        ('{"A0": [[1]], "A1": [[1, 2], [3, 4]]}', "A1"),
        ('{"A0": [["x"]], "A1": [[1]]}', "A0"),
        ('{"A0": [[NaN]], "A1": [[1]]}', "A0"),
        ('{"A0": [[1]], "A1": [[1]], "A2": [[1]]}', "A2"),
        ('{"terms": [{"A": [[1]], "delay": -0.1}]}', "delay"),
    ],
)
def test_a_bad_model_gives_one_line_and_exit_code_2(tmp_path: Path, text: str, named: str) -> None:
    done = run(tmp_path, text)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert named in done.stderr
    assert "model.json" in done.stderr
