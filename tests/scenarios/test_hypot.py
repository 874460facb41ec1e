"""The length of a vector in kernels is CPython's, to the last bit."""

import math
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenarios.hypot import hypot


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="later versions round a few lengths otherwise")
@given(st.floats(), st.floats())
def test_hypot_is_that_of_cpython(x: float, y: float) -> None:
    found, expected = hypot(x, y), math.hypot(x, y)
    assert found == expected or (math.isnan(found) and math.isnan(expected))
