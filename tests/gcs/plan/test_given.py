"""A gain that the user gives is the one flown."""

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from gains import BadModelError, FormationModel, sampled_delay_margin
from gcs import load_scenario, with_gain
from gcs.errors import InputError
from gcs.plan.planner import flight_plan

CHAIN = FormationModel((-1, 0, 1), axes=1)


def test_gain_of_an_lqr_has_the_margin_of_its_loop() -> None:
    K = -CHAIN.B.T @ solve_continuous_are(CHAIN.A, CHAIN.B, np.eye(5), np.eye(3))
    design, plan = flight_plan(with_gain(load_scenario("chain3"), K))
    assert np.allclose(plan.gain, np.kron(K, np.eye(2)), atol=1e-12)
    assert design.delay_margin_s == pytest.approx(sampled_delay_margin(CHAIN.A, CHAIN.B, K, period_s=0.02), rel=1e-9)


def test_gain_of_another_shape_is_refused() -> None:
    with pytest.raises(InputError, match=r"K: read shape \(2, 5\), wanted \(3, 5\): a row for each vehicle"):
        with_gain(load_scenario("chain3"), np.ones((2, 5)))
    with pytest.raises(BadModelError, match="K has entries that are not finite"):
        with_gain(load_scenario("chain3"), np.full((3, 5), np.nan))
