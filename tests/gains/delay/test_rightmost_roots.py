"""Several roots of a delayed loop at once: each is a root, and none to the right of them is missing."""

import numpy as np
import pytest
from scipy.special import lambertw

from gains.delay.rightmost import rightmost_roots


@pytest.mark.parametrize("delay_s", [0.01, 0.3, 5.0])
def test_roots_are_the_branches_of_lamberts_function(delay_s: float) -> None:
    # with 0.01 s the discretisation has approximations near no root, and two roots are real
    branches = {complex(lambertw(-delay_s, k)) / delay_s for k in range(-1, 9)}
    upper = sorted({complex(round(s.real, 9), round(abs(s.imag), 9)) for s in branches}, key=lambda s: -s.real)
    found = rightmost_roots([([[-1.0]], delay_s)], 6)
    assert np.allclose(found, upper[:6], rtol=1e-9)


def test_further_roots_leave_those_found_before_as_they_are() -> None:
    rng = np.random.default_rng(1)
    for _ in range(30):
        now, late = rng.normal(size=(2, 3, 3))
        terms = [(now, 0.0), (late, float(rng.uniform(0.05, 2.0)))]
        assert np.allclose(rightmost_roots(terms, 12)[:6], rightmost_roots(terms, 6), atol=1e-6)


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(("now", "late", "delay_s"), [(-10.0, 0.05, 3.0), (-5.0, -1e-6, 1.2), (-10.0, -1e-3, 3.0)])
def test_weakly_delayed_loops_have_lamberts_root(now: float, late: float, delay_s: float, count: int) -> None:
    # s = a + b e^{-s tau}: the first approximations belong to no root
    scaled = late * delay_s * np.exp(-now * delay_s)
    rightmost = max((now + complex(lambertw(scaled, k)) / delay_s for k in (-1, 0)), key=lambda s: s.real)
    found = rightmost_roots([([[now]], 0.0), ([[late]], delay_s)], count)[0]
    assert found == pytest.approx(complex(rightmost.real, abs(rightmost.imag)), rel=1e-9)
