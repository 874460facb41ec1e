"""Arguments that are not a number of seconds, a rate or a model are refused in one line that names them."""

from collections.abc import Callable
from typing import Any

import pytest

from gains import (
    BadModelError,
    FormationModel,
    Requirement,
    Response,
    Timing,
    design,
    evaluate_gains,
    loop_margin,
    mismatch_window,
    multirate_delay_margin,
    parse_model,
    rightmost_root,
    robustness,
    varying_delay_bound,
)
from gains.design.for_delay import fastest_at_delay, longest_static_delay
from gains.design.predicted import least_gains


def designed(period_s: Any) -> object:
    return design(FormationModel((-1, 0)), period_s=period_s)


def designed_for(formation: Any, requirement: Any = None) -> object:
    return design(formation, requirement, period_s=0.02)


def evaluated(gains: Any) -> object:
    return evaluate_gains(FormationModel((-1, 0)), gains, period_s=0.02)


def windowed(timing: Any) -> object:
    return mismatch_window([[0]], [[1]], [[-1]], timing, assumed_s=0.1)


def bounded(rate: Any) -> object:
    return varying_delay_bound([[0]], [[-1]], rate=rate)


@pytest.mark.parametrize(
    ("call", "arguments", "named"),
    [
        (rightmost_root, ([[[1]]],), "terms"),
        (rightmost_root, ([([[1]], "x")],), "terms"),
        (parse_model, (3,), "the model: read int"),
        (fastest_at_delay, (0,), "late_s is 0"),
        (longest_static_delay, (0.0, 0.02), r"decay_1_s is 0\.0"),
        (longest_static_delay, (1.0, -0.02), r"period_s is -0\.02"),
        (least_gains, (-1, 0.02), "decay_rate_1_s is -1"),
        (designed, ("0.02",), r"period_s is '0\.02'"),
        (Timing, ("a", 0.02), "control_s is 'a'"),
        (Requirement, ("a",), "delay_margin_s = a"),
        (robustness, ("a", 0, 1), "K1"),
        (robustness, ([[1], [1, 2]], 0, 1), "K1 is ragged"),
        (Requirement, (0.3, None, "a"), "string_peak_max = 'a'"),
        (Requirement, (0.3, None, None, None, "ground", None), "feed_forward = None"),
        (Requirement, (0.3, None, None, None, "ground", 0.0, 3), "criteria is 3; a Criteria is wanted"),
        (Requirement, (10**400,), "delay_margin_s = 1000"),
        (Timing, (10**400, 0.02), "control_s is 1000"),
        (Response, ("a", 1.0), "lag_s = 'a'"),
        (FormationModel, ((-1, 0), "a"), "axes = 'a'"),
        (FormationModel, ((-1, 0), 1.5), "axes = 1.5"),
        (FormationModel, ([[1, 2], [3]],), "predecessors"),
        (designed_for, (None,), "formation is None; a FormationModel is wanted"),
        (designed_for, (FormationModel((-1, 0)), 0.3), "requirement is 0.3; a Requirement or NoneType is wanted"),
        (evaluated, (5,), "gains is 5; K1, K2 and K3 are wanted"),
        (evaluated, (([[1]], [[1]]),), "K1, K2 and K3 are wanted"),
        (loop_margin, ("a",), "model is 'a'; a DelayModel or HeldModel is wanted"),
        (windowed, (0.02,), "timing is 0.02; a Timing is wanted"),
        (multirate_delay_margin, ([[0]], [[1]], [[-1]], None), "timing is None; a Timing is wanted"),
        (bounded, ("a",), "rate is 'a'"),
    ],
)
def test_wrong_arguments_are_refused_by_name(call: Callable[..., Any], arguments: tuple[Any, ...], named: str) -> None:
    with pytest.raises(BadModelError, match=named):
        call(*arguments)
