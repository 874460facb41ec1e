"""The onset of instability of simulated autopilots, with responses as measured of an ArduCopter in SITL."""

from functools import cache
from typing import Any

import pytest

from gcs.drive.flown import identified_in_flight
from gcs.errors import InputError
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.stress.growth import GrowthPoint, locate_zero
from gcs.stress.measure import fly_trial
from gcs.stress.study import Study
from tests.support.fleets.flown_copters import TRUTH, plan_for, three

LIMITS: dict[str, Any] = {"acceleration_max_m_s2": 2.5, "jerk_max_m_s3": 5.0}
MODELS: dict[str, dict[str, Any]] = {
    "lag": {"lag_s": 0.125, "velocity_gain_1_s": 2.78},
    "lag with dead time": {"lag_s": 0.066, "velocity_gain_1_s": 1.88, "dead_time_s": 0.048},
    "second order": {"lag_s": 0.11, "velocity_gain_1_s": 1.71, "natural_frequency_rad_s": 14.0},
}


@cache
def identified(model: str) -> FlightPlan:
    """The leader and one platoon of copters5 with its gains, as identified in flight."""
    scenario = three(**LIMITS, **MODELS[model]).with_calm_monitor()
    return identified_in_flight(plan_for(scenario))


@pytest.mark.slow(first=1)
@pytest.mark.parametrize("model", MODELS)
def test_flown_onset_is_the_margin_of_the_identified_response(model: str) -> None:
    plan = identified(model)
    assert plan.responses is not None
    assert {found.model for found in plan.responses.of.values()} == {model}
    assert [found.lag_s for found in plan.responses.of.values()] == pytest.approx([MODELS[model]["lag_s"]] * 3, rel=0.1)
    # the jerk limit lengthens the identified lag by up to 1.2 %, which is 4e-3 1/s and 0.7 % of the margin
    assert onset_of(plan, within_1_s=6e-3) == pytest.approx(plan.delay_margin_s, rel=0.015)


def test_flown_onset_is_the_margin_of_the_given_response() -> None:
    plan = flight_plan(three().model_copy(update={"response": TRUTH}).with_calm_monitor())[1]
    assert identified_in_flight(plan) is plan
    assert onset_of(plan, within_1_s=5e-4) == pytest.approx(plan.delay_margin_s, rel=5e-3)


def onset_of(plan: FlightPlan, *, within_1_s: float) -> float:
    """The loop delay (s) at which the growth of small errors passes zero, from flights at 0.95 and 1.05 of the computed
    margin. The growth in both must be within `within_1_s` of the predicted."""
    study, points = Study(plan), list[GrowthPoint]()
    for part in (0.95, 1.05):
        outcome = fly_trial(study.trial("probe", {"delay": part * plan.delay_margin_s - 0.01}, seed=9))
        assert outcome.error is None
        assert outcome.growth_1_s == pytest.approx(outcome.predicted_growth_1_s, abs=within_1_s)
        assert outcome.predicted_growth_continuous_1_s == pytest.approx(outcome.predicted_growth_1_s, abs=2e-3)
        points.append(GrowthPoint(outcome.loop_delay_s or 0.0, outcome.growth_1_s or 0.0, 0.0))
    zero = locate_zero(points)
    assert zero is not None
    assert zero.inside
    return zero.varied


def test_vehicles_that_never_become_ready_are_refused_in_one_line() -> None:
    scenario = three(ready_after_s=1000.0)
    with pytest.raises(InputError, match=r"^copters5: not ready: "):
        identified_in_flight(plan_for(scenario))
