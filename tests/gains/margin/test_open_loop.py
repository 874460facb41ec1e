"""Loops given as systems: margins agree with phase margin over crossover frequency, which shares no algebra."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat
from scipy.optimize import brentq
from scipy.signal import StateSpace, TransferFunction

from gains import BadModelError, delay_margin, delayed_feedback, loop_margin, parse_model
from gains.margin.loop_margin import LoopMargin
from gcs.cli.margin import margin_of_file

# 3 (s + 2) / (s (s + 1) (s + 5)), which crosses the unit circle once
NUM, DEN = [3.0, 6.0], [1.0, 6.0, 5.0, 0.0]


def phase_over_frequency_s() -> float:
    """(pi + arg L(j omega)) / omega where |L(j omega)| = 1."""
    omega = float(brentq(lambda w: abs(np.polyval(NUM, 1j * w) / np.polyval(DEN, 1j * w)) - 1.0, 0.1, 10.0))  # type: ignore[arg-type]
    value = np.polyval(NUM, 1j * omega) / np.polyval(DEN, 1j * omega)
    return float((np.pi + np.angle(value)) / omega)


def test_margin_is_phase_margin_over_crossover_frequency() -> None:
    margin_s = delay_margin(*delayed_feedback(TransferFunction(NUM, DEN)))
    assert margin_s == pytest.approx(phase_over_frequency_s(), rel=1e-9)
    assert delay_margin(*delayed_feedback(TransferFunction(NUM, DEN).to_ss())) == pytest.approx(margin_s, rel=1e-9)


def test_small_coefficients_of_a_numerator_count(recwarn: pytest.WarningsRecorder) -> None:
    # (s + 1) / (1e15 s^2 + s) crosses over at 1e-7.5 rad/s with a phase margin of two times that, so 2 s
    assert delay_margin(*delayed_feedback(SimpleNamespace(num=[1.0, 1.0], den=[1e15, 1.0, 0.0]))) == pytest.approx(2.0)
    delayed_feedback(SimpleNamespace(num=[0.0], den=[1.0, 1.0]))
    assert not recwarn.list


def test_python_control_systems_are_taken_where_matrices_are() -> None:
    control: Any = pytest.importorskip("control")
    loop = control.tf(NUM, DEN)
    _, phase_deg, _, omega = control.margin(loop)
    wanted_s = float(np.deg2rad(phase_deg)) / omega
    for system in (loop, control.ss(loop)):
        assert delay_margin(*delayed_feedback(system)) == pytest.approx(wanted_s, rel=1e-9)
    with pytest.raises(BadModelError, match=r"dt = 0\.1"):
        delayed_feedback(control.c2d(loop, 0.1))


def test_several_inputs_and_outputs_are_closed_together() -> None:
    apart = StateSpace(np.zeros((2, 2)), np.eye(2), np.diag([1.0, 4.0]), np.zeros((2, 2)))
    assert delay_margin(*delayed_feedback(apart)) == pytest.approx(np.pi / 8.0)


@pytest.mark.parametrize(
    ("system", "said"),
    [
        (TransferFunction([1.0], [1.0, 1.0], dt=0.1), "has dt = 0.1; 0 or None is wanted"),
        (StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.5]]), "D is not zero"),
        (StateSpace([[-1.0]], [[1.0, 1.0]], [[1.0]], [[0.0, 0.0]]), r"B has shape \(1, 2\) and C \(1, 1\)"),
        (TransferFunction([1.0, 1.0], [1.0, 2.0]), "num has degree 1 and den 1; more poles than zeros"),
        (SimpleNamespace(num=[[[1.0], [1.0]]], den=[[[1.0, 0.0], [1.0, 0.0]]]), "num is not one polynomial"),
        (SimpleNamespace(num=[[[1.0], [1.0, 2.0]]], den=[[[1.0]]]), "num is not one polynomial"),
        (SimpleNamespace(num=[1.0], den=[0.0, 0.0]), "num has degree 0|den is zero"),
        (np.eye(2), "read an object of type ndarray; a system with A, B, C, D or with num, den"),
    ],
)
def test_systems_that_form_no_loop_with_delay_are_refused(system: object, said: str) -> None:
    with pytest.raises(BadModelError, match=said):
        delayed_feedback(system)


@pytest.mark.parametrize("keys", ["A B C", "A B C D", "num den"])
def test_model_and_matlab_files_hold_the_same_systems(tmp_path: Path, keys: str) -> None:
    system = TransferFunction(NUM, DEN).to_ss()
    whole: dict[str, Any] = {name: getattr(system, name).tolist() for name in "ABCD"} | {"num": NUM, "den": DEN}
    chosen = {name: whole[name] for name in keys.split()}
    savemat(tmp_path / "loop.mat", chosen)
    found = margin_of_file(tmp_path / "loop.mat")
    assert isinstance(found, LoopMargin)
    assert found.delay_margin_s == pytest.approx(phase_over_frequency_s(), rel=1e-9)
    assert found == loop_margin(parse_model(json.dumps(chosen)))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"num": 1, "den": [1, 2]}', r"num: read 1, wanted coefficients as a list"),
        ('{"num": [1, "a"], "den": [1, 2]}', r"num, row 1, column 2: read \'a\', wanted a finite number"),
        ('{"A": [[1]], "B": [[1]], "C": [[1]], "D": [[1]]}', "D is not zero"),
    ],
)
def test_a_wrong_system_in_a_file_is_refused_by_name(text: str, said: str) -> None:
    with pytest.raises(BadModelError, match=said):
        parse_model(text)
