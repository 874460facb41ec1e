"""What is no number of seconds, no rate and no model is refused in one line that names it."""

from collections.abc import Callable
from typing import Any

import pytest

from gains import (
    BadModelError,
    FormationModel,
    Requirement,
    Timing,
    design,
    parse_model,
    rightmost_root,
    robustness,
)
from gains.design.for_delay import fastest_at_delay, longest_static_delay
from gains.design.predicted import least_gains


def designed(period_s: Any) -> object:
    return design(FormationModel((-1, 0)), period_s=period_s)


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
    ],
)
def test_wrong_arguments_are_refused_by_name(call: Callable[..., Any], arguments: tuple[Any, ...], named: str) -> None:
    with pytest.raises(BadModelError, match=named):
        call(*arguments)
