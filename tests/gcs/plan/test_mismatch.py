"""By how much the loop delay may differ from the assumed one, at any assumed delay."""

from dataclasses import replace
from functools import cache
from math import inf

import numpy as np
import pytest

from gains import mismatch_window
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from scenarios.files import load
from scenarios.schema import Control, FixedGains
from tests.support.paths import SCENARIOS

TRIANGLE = load(SCENARIOS / "triangle5.toml")
GAINS = FixedGains(K1=-3.408, K2=0.631, K3=5.608)


@cache
def planned(prediction: float | str) -> FlightPlan:
    control = Control.model_validate({"gains": GAINS, "prediction": prediction})
    return flight_plan(TRIANGLE.model_copy(update={"control": control}))[1]


def exact(gain_set: int, assumed_s: float) -> tuple[float, float]:
    plan = planned("measured")
    model = plan.model
    return mismatch_window(model.A, model.B, plan.gains[gain_set], plan.timing, assumed_s=assumed_s)


def test_without_prediction_any_delay_up_to_the_margin_is_tolerated() -> None:
    plan = planned("off")
    tolerated = plan.tolerance(0.0)
    assert tolerated.longer_s == plan.margins_s
    assert set(tolerated.shorter_s) == {inf}
    assert tolerated.used_s(0, 0.1) == 0.1


def test_a_fixed_assumption_tolerates_the_published_mismatch() -> None:
    tolerated = planned(0.6).tolerance(0.6)
    assert tolerated.longer_s[0] == pytest.approx(0.156, abs=1e-3)  # the table of docs/explanation/prediction.md
    assert tolerated.shorter_s[0] == pytest.approx(0.149, abs=1e-3)
    assert tolerated.shorter_s[2] == inf
    assert len(tolerated.longer_s) == 3


@pytest.mark.parametrize(
    ("assumed_s", "sampled_s", "continuous_s"),
    [
        # the windows of both models for k1 = 3.408 and k3 = 5.608, computed independently from the equation of each, to
        # the digits printed here
        (0.3, (0.0, 0.5429), (0.0, 0.5480)),
        (0.6, (0.4504, 0.7569), (0.4446, 0.7642)),
        (1.5, (1.4163, 1.5838), (1.4134, 1.5869)),
        (3.0, (2.9516, 3.0484), (2.9499, 3.0501)),
    ],
)
def test_the_design_record_has_the_windows_of_both_models(
    assumed_s: float, sampled_s: tuple[float, float], continuous_s: tuple[float, float]
) -> None:
    control = Control.model_validate({"gains": GAINS, "prediction": assumed_s})
    found = flight_plan(TRIANGLE.model_copy(update={"control": control}))[0].prediction
    assert found is not None
    assert found.mismatch_window_s == pytest.approx(sampled_s, abs=5e-5)
    assert found.mismatch_window_continuous_s == pytest.approx(continuous_s, abs=5e-5)


@pytest.mark.parametrize("gain_set", [0, 1, 2])
@pytest.mark.parametrize("assumed_s", [0.07, 0.25, 0.52, 1.1, 1.6, 2.4, 6.1, 9.0])
def test_the_table_has_the_exact_windows_or_somewhat_narrower_ones(gain_set: int, assumed_s: float) -> None:
    tolerated, (least_s, most_s) = planned("measured").tolerance(assumed_s), exact(gain_set, assumed_s)
    # where a window begins to have a lower end, its upper end has a kink, which the table rounds off by 13 % at most
    assert 0.85 < tolerated.longer_s[gain_set] / (most_s - assumed_s) < 1.04
    if least_s > 0.0:
        assert 0.85 < tolerated.shorter_s[gain_set] / (assumed_s - least_s) < 1.04


def test_a_window_that_begins_at_no_delay_ends_at_none() -> None:
    tolerated = planned("measured").tolerance(0.1)
    assert tolerated.shorter_s[0] == inf
    assert tolerated.used_s(0, -0.05) == 0.0


def test_both_ends_of_a_window_use_the_same_share() -> None:
    tolerated = planned(1.5).tolerance(1.5)
    used_s = tolerated.used_s(0, -tolerated.shorter_s[0])
    assert used_s == pytest.approx(tolerated.longer_s[0])
    assert np.isnan(tolerated.used_s(0, np.nan))


def test_the_windows_are_those_of_the_gains_flown() -> None:
    slowed = replace(planned(1.5), gain=planned(1.5).gains[1], slower=())
    assert slowed.tolerance(1.5).longer_s == pytest.approx((planned(1.5).tolerance(1.5).longer_s[1],))
