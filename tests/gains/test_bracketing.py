"""Maxima between samples that may hide a zero."""

import numpy as np
import pytest

from gains.core._bracketing import may_reach_zero

PEAK = np.array([[-1.0], [-0.05], [-1.0]])
"""Samples of a maximum just below zero, between samples far below zero."""


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("twice", [0, 1, 2], ids=["once", "twice", "three times"])
def test_a_repeated_point_hides_no_maximum(twice: int) -> None:
    points = np.insert(np.array([0.0, 1.0, 2.0]), [1] * twice, 1.0)
    values = np.insert(PEAK, [1] * twice, -0.05, axis=0)
    assert may_reach_zero(points, values).any()


def test_a_maximum_far_below_zero_hides_none() -> None:
    assert not may_reach_zero(np.array([0.0, 1.0, 2.0]), PEAK - 5.0).any()
