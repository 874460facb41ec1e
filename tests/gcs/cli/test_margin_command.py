"""`gcs margin` from the outside: its JSON, its table, its exit codes, what it imports."""

import json
import subprocess
import sys
from math import acos, atan, log, pi, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from gains.core.errors import BadModelError, DisagreementError
from gains.margin.loop_margin import loop_margin
from gains.margin.model_file import parse_model
from gcs.cli.margin import ModelFileError, margin_fields, margin_of_file, margin_of_scenario, print_margin
from tests.support.paths import SCENARIOS
from tests.support.processes import gcs

CLASSIC = {"A0": [[-2.0, 0.0], [0.0, -0.9]], "A1": [[-1.0, 0.0], [-1.0, -1.0]]}
CLASSIC_MARGIN_S = acos(-0.9) / sqrt(1.0 - 0.81)


def result_of(model: object) -> dict[str, Any]:
    return margin_fields(loop_margin(parse_model(json.dumps(model))))


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return gcs("margin", *arguments, COLUMNS="100")


def test_command_prints_json_and_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "classic.json"
    file.write_text(json.dumps(CLASSIC))
    done = run(str(file), "--json")
    assert (done.returncode, done.stderr) == (0, "")
    result = json.loads(done.stdout)
    assert result["delay_margin_s"] == pytest.approx(CLASSIC_MARGIN_S, rel=1e-13)
    assert result["stable_intervals_s"] == [[0.0, result["delay_margin_s"]]]
    assert result["crossings"][0]["direction"] == 1


def test_command_prints_a_table(tmp_path: Path) -> None:
    file = tmp_path / "classic.json"
    file.write_text(json.dumps(CLASSIC))
    done = run(str(file))
    assert done.returncode == 0
    assert "margin 6.17258 s" in done.stdout
    assert "right: unstable" in done.stdout


def test_a_crossing_without_delay_shows_its_whole_frequency(tmp_path: Path) -> None:
    """x'' + x = 0.2 x(t - tau) has roots at ± i sqrt(0.8) without delay."""
    file = tmp_path / "oscillator.json"
    file.write_text(json.dumps({"A0": [[0.0, 1.0], [-1.0, 0.0]], "A1": [[0.0, 0.0], [0.2, 0.0]]}))
    [row] = [line.split() for line in run(str(file)).stdout.splitlines() if "left: stable" in line]
    assert row[:2] == [f"{sqrt(0.8):.6g}", "0"]


def test_command_ends_with_2_and_one_line_on_bad_input(tmp_path: Path) -> None:
    file = tmp_path / "bad.json"
    file.write_text('{"A0": [[1, 2]], "A1": [[1]]}')
    done = run(str(file), "--json")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"{file}: A0: read 1x2, wanted a square matrix\n"


def test_command_imports_only_the_libraries_it_needs(tmp_path: Path) -> None:
    # the optimiser, SciPy, the recorder or the schema of scenarios would each take a large part of the command's time
    heavy = ("scipy", "cvxpy", "clarabel", "rerun", "rich", "scenarios.schema")
    code = (
        "import sys; sys.argv = ['gcs', 'margin', sys.argv[1], '--json']\n"
        "from gcs.cli.main import main\n"
        "try: main()\n"
        f"finally: print([m for m in {heavy} if m in sys.modules])"
    )
    file = tmp_path / "model.json"
    file.write_text(json.dumps(CLASSIC))
    done = subprocess.run([sys.executable, "-c", code, str(file)], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("content", [None, b"\xff\xfe\x00"])
def test_unreadable_file_is_named(tmp_path: Path, content: bytes | None) -> None:
    file = tmp_path / "model.json"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(ModelFileError, match=r"model\.json: .*wanted a (JSON )?model"):
        margin_of_file(file)


def test_byte_order_mark_is_accepted(tmp_path: Path) -> None:
    file = tmp_path / "model.json"
    file.write_text(json.dumps(CLASSIC), encoding="utf-8-sig")
    assert margin_fields(margin_of_file(file))["unknown"] == "tau"


def test_terms_with_one_delay_equal_a0_and_a1() -> None:
    terms = [{"A": CLASSIC["A0"], "delay": 0}, {"A": CLASSIC["A1"], "delay": "T"}]
    assert result_of({"terms": terms}) == {**result_of(CLASSIC), "unknown": "T"}


@pytest.mark.parametrize(("delay", "scale"), [("3*tau", 3.0), ("tau/4", 0.25), ("0.1*tau", 0.1)])
def test_multiples_of_the_unknown_scale_it(delay: str, scale: float) -> None:
    result = result_of({"terms": [{"A": CLASSIC["A0"], "delay": 0}, {"A": CLASSIC["A1"], "delay": delay}]})
    assert result["delay_margin_s"] == pytest.approx(CLASSIC_MARGIN_S / scale, rel=1e-13)
    [crossing] = result["crossings"]
    # the crossing repeats after a turn of omega times the delay, not of omega times the unknown
    assert crossing["repeats_every_s"] == pytest.approx(2.0 * pi / crossing["omega_rad_s"] / scale, rel=1e-13)


def test_two_commensurate_delays_give_the_published_window() -> None:
    result = result_of(
        {
            "terms": [
                {"A": [[0, 1], [-1, 0.1]], "delay": 0},
                {"A": [[0, 0], [-1, 0]], "delay": "tau/2"},
                {"A": [[0, 0], [1, 0]], "delay": "tau"},
            ]
        }
    )
    [window] = result["stable_intervals_s"]
    # Gu, Kharitonov and Chen: 0.2024 to 1.3722; full digits from an independent program
    assert window == pytest.approx([0.20245217189860842, 1.3722938029082334], rel=1e-12)
    assert (result["delay_margin_s"], result["unstable_roots_at_zero_delay"]) == (0.0, 2)


def test_known_delay_beside_the_unknown() -> None:
    result = result_of({"terms": [{"A": [[0]], "delay": 0.3}, {"A": [[-1]], "delay": "0.1 + tau"}]})
    assert result["delay_margin_s"] == pytest.approx(pi / 2.0 - 0.1, rel=1e-12)
    assert "rightmost root" in result["checked_by"]


def test_delays_that_are_all_numbers_give_the_rightmost_root() -> None:
    result = result_of({"terms": [{"A": [[0]], "delay": 0}, {"A": [[-1]], "delay": 1}]})
    # Lambert's function at -1, published to 16 digits
    assert result["rightmost_root"] == pytest.approx([-0.31813150520476413, 1.3372357014306895], rel=1e-14)
    assert (result["stable"], result["unknown"], result["delay_margin_s"]) == (True, None, None)


def test_held_loop_gives_the_published_period() -> None:
    result = result_of({"A": [[0, 1], [0, -0.1]], "B": [[0], [0.1]], "K": [[-3.75, -11.5]], "hold": True})
    # Fridman 2010: 1.7294; full digits from the spectral radius by an independent program
    assert result["delay_margin_s"] == pytest.approx(1.7294142794798775, rel=1e-12)
    assert result["unknown"] == "period"


def test_held_loop_may_need_a_long_period() -> None:
    # x'' = -x + k x'(sample) with k > 0: a push in the direction of motion. A period maps by
    # [[cos, sin], [-sin, cos]] + k [1 - cos; sin] [0, 1], and held for most of a turn the push is a brake.
    k = 0.2
    result = result_of({"A": [[0, 1], [-1, 0]], "B": [[0], [1]], "K": [[0, k]], "hold": True})
    edges = [edge for window in result["stable_intervals_s"] for edge in window]
    assert result["delay_margin_s"] == 0.0
    # the determinant 1 + k sin T is below one from half a turn on, an eigenvalue passes -1 where tan(T / 2) = -1 / k
    assert edges[:2] == pytest.approx([2.0 * (pi - atan(1.0 / k)), 2.0 * pi], rel=1e-12)
    for period_s in np.linspace(0.03, 12.0, 200).tolist():
        c, s = np.cos(period_s), np.sin(period_s)
        radius = np.abs(np.linalg.eigvals([[c, s + k * (1.0 - c)], [-s, c + k * s]])).max()
        if min(abs(period_s - edge) for edge in edges) > 1e-6:
            inside = any(start < period_s < end for start, end in result["stable_intervals_s"])
            assert inside == (radius < 1.0)


def test_held_loop_that_is_never_stable_has_no_window() -> None:
    # x'' = -x - x(sample) / 2: the radius touches one at whole turns, where rounding once produced windows
    result = result_of({"A": [[0, 1], [-1, 0]], "B": [[0], [1]], "K": [[-0.5, 0]], "hold": True})
    assert result["stable_intervals_s"] == []


def test_held_loop_touches_the_circle_where_samples_see_no_motion() -> None:
    # x'' = -x + x(sample) / 5: at half turns the map has the eigenvalue -1, at whole turns it is the identity
    result = result_of({"A": [[0, 1], [-1, 0]], "B": [[0], [1]], "K": [[0.2, 0]], "hold": True})
    first = result["stable_intervals_s"][:4]
    # a double eigenvalue is known to sqrt(eps)
    assert np.array(first) == pytest.approx(pi * np.array([[0, 1], [1, 2], [2, 3], [3, 4]]), rel=1e-7)
    assert {crossing["direction"] for crossing in result["crossings"][:4]} == {0}


@pytest.mark.parametrize("pole", [2.0, 300.0])
def test_held_loop_of_an_unstable_plant(pole: float) -> None:
    # x' = p x + u, u = -2 p x: e^{pT} - 2 (e^{pT} - 1) reaches -1 at e^{pT} = 3; e^{AT} once grew until it overflowed
    result = result_of({"A": [[pole]], "B": [[1]], "K": [[-2.0 * pole]], "hold": True})
    assert result["stable_intervals_s"] == [[0.0, pytest.approx(log(3.0) / pole, rel=1e-12)]]


def test_held_loop_stable_at_every_period_is_unbounded() -> None:
    result = result_of({"A": [[-1]], "B": [[1]], "K": [[-0.5]], "hold": True})
    assert result["stable_intervals_s"] == [[0.0, None]]
    assert (result["delay_margin_s"], result["delay_independent"]) == (None, True)


def test_unbounded_window_ends_in_null() -> None:
    result = result_of({"A0": [[-2.0]], "A1": [[1.0]]})
    assert result["stable_intervals_s"] == [[0.0, None]]
    assert (result["delay_margin_s"], result["delay_independent"]) == (None, True)


def test_loop_at_the_edge_of_delay_independence_has_no_limit() -> None:
    # s + 1 + e^{-s tau}: a locus of modulus one at zero frequency, which rounding once made a crossing at 1e16 s
    result = result_of({"A0": [[-1.0]], "A1": [[-1.0]]})
    assert (result["delay_independent"], result["crossings"]) == (True, [])


def test_fast_and_slow_loops_side_by_side() -> None:
    # once, all 1e10 turns of the fast loop within one turn of the slow loop were listed
    result = result_of({"A0": [[0, 0], [0, 0]], "A1": [[-1e-8, 0], [0, -100]]})
    assert result["delay_margin_s"] == pytest.approx(pi / 200.0, rel=1e-14)


def test_multiples_without_a_common_divisor_are_refused() -> None:
    terms = [{"A": [[-1]], "delay": "tau"}, {"A": [[-1]], "delay": "3.14159*tau"}]
    with pytest.raises(BadModelError, match=r"up to 314159 times their common divisor 1/100000\*tau"):
        result_of({"terms": terms})


def test_given_delays_leave_out_the_common_value_of_a_consensus() -> None:
    # eigenvalue 2 of the Laplacian, late by 0.1 s: s = -2 e^(-0.1 s). The eigenvalue 0 is rounded to either sign
    result = result_of({"terms": [{"A": [[-1, 1], [1, -1]], "delay": 0.1}]})
    root = result["rightmost_root"][0]
    assert (result["roots_fixed_at_zero"], result["unstable_roots_at_zero_delay"], result["stable"]) == (1, 0, True)
    assert root < -1.0
    assert root == pytest.approx(-2.0 * np.exp(-0.1 * root), rel=1e-12)


def test_small_loops_are_confirmed_by_two_other_methods() -> None:
    assert result_of(CLASSIC)["checked_by"] == ["sweep", "rightmost root"]


def test_disagreement_is_an_error_of_its_own() -> None:
    # BadModelError means bad input, exit code 2: a disagreement of methods must not be reported as that
    assert not issubclass(DisagreementError, BadModelError)


@pytest.mark.parametrize(
    ("model", "lines"),
    [
        ({"A0": [[0, 1], [-2, 0.1]], "A1": [[0, 0], [1, 0]]}, ["stable from 0.100168 s to 1.71786 s", "margin 0 s"]),
        ({"A0": [[-2]], "A1": [[1]]}, ["stable from 0 s to any delay", "no limit: stable at every delay"]),
        ({"A0": [[1]], "A1": [[0]]}, ["not stable at any tau", "unstable roots at tau = 0: 1"]),
        ({"terms": [{"A": [[-1]], "delay": 2}]}, ["not stable: rightmost root 0.086408 +- 0.836843j 1/s"]),
    ],
)
def test_table_says_the_verdict(model: object, lines: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    print_margin(loop_margin(parse_model(json.dumps(model))))
    shown = capsys.readouterr().out
    for line in lines:
        assert line in shown


@pytest.mark.parametrize(
    ("name", "loop", "continuous_s", "sampled_s"),
    [("thesis_delay", "onboard", 1.00796, 1.00216), ("thesis_gains", "ground", 0.077736, 0.068456)],
)
def test_a_scenario_has_the_margins_of_the_loop_it_flies(
    name: str, loop: str, continuous_s: float, sampled_s: float, capsys: pytest.CaptureFixture[str]
) -> None:
    found = margin_of_scenario(SCENARIOS / f"{name}.toml")
    result = margin_fields(found)
    assert result["loop"] == loop
    assert result["delay_margin_s"] == pytest.approx(continuous_s, rel=1e-5)
    assert result["delay_margin_sampled_s"] == pytest.approx(sampled_s, rel=1e-5)
    assert result["checked_by"]
    print_margin(found)
    shown = capsys.readouterr().out
    assert shown.startswith(f"as flown, sampled and held every 20 ms: margin {sampled_s}")
    assert f"continuous model: margin {continuous_s}" in shown


def test_a_scenario_that_predicts_has_its_windows_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "predicted.toml"
    text = (SCENARIOS / "chain3.toml").read_text()
    file.write_text(text.replace("[control]\n", "[control]\nprediction = 0.6\n"))
    found = margin_of_scenario(file)
    result = margin_fields(found)
    assert result["delay_margin_sampled_s"] == pytest.approx(0.3, abs=1e-6)  # without prediction
    least_s, most_s = result["prediction"]["mismatch_window_s"]
    assert least_s < 0.6 < most_s
    print_margin(found)
    shown = capsys.readouterr().out
    assert "stable between, with prediction" in shown
    assert f"{1e3 * least_s:.1f}" in shown


def test_a_scenario_whose_vehicles_respond_with_lag_is_refused() -> None:
    with pytest.raises(ModelFileError, match="dynamics: read 'autopilot', wanted double_integrator"):
        margin_of_scenario(SCENARIOS / "copters5.toml")


def test_an_aircraft_without_response_is_refused_with_advice(tmp_path: Path) -> None:
    file, text = tmp_path / "aircraft.toml", (SCENARIOS / "triangle5.toml").read_text(encoding="utf-8")
    file.write_text(text.replace("seed = 1", 'seed = 1\ndynamics = "jsbsim"', 1), encoding="utf-8")
    wanted = r"wanted a \[response\], as gcs identify prints it, for gcs design; or gcs stress --onset"
    with pytest.raises(ModelFileError, match=f"read dynamics 'jsbsim' without a linear model of its loop, {wanted}"):
        margin_of_scenario(file)


def test_matlab_file_is_read_as_its_json_would_be(tmp_path: Path) -> None:
    held = {"A": [[0.0, 1.0], [0.0, 0.0]], "B": [[0.0], [1.0]], "K": [[-1.0, -1.5]], "hold": True, "period": 0.02}
    savemat(tmp_path / "held.mat", held)
    (tmp_path / "held.json").write_text(json.dumps(held), encoding="utf-8")
    assert margin_of_file(tmp_path / "held.mat") == margin_of_file(tmp_path / "held.json")


def test_file_that_is_not_matlab_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.mat").write_bytes(b"MATLAB, but not really" * 10)
    with pytest.raises(ModelFileError, match="wanted a MATLAB file"):
        margin_of_file(tmp_path / "bad.mat")
