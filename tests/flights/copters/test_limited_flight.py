"""Copters with the limits of a real one, sent to their places from far away."""

from typing import Any

import numpy as np
import pytest

from scenarios.schema import Response
from tests.support.fleets.flown_copters import fly, plan_for, three

LIMITS: dict[str, Any] = {"acceleration_max_m_s2": 2.5, "jerk_max_m_s3": 5.0}
RESPONSE: dict[str, Any] = {"lag_s": 0.066, "velocity_gain_1_s": 1.88, "dead_time_s": 0.048}
SENT_M_S2, SENT_M_S3 = 2.25, 4.0


@pytest.mark.parametrize("start_m", [3.0, 20.0])
def test_far_vehicle_arrives_without_overshoot_nearly_as_fast_as_allowed(start_m: float) -> None:
    scenario = three(duration_s=14.0, **LIMITS, **RESPONSE)
    first, *rest = scenario.vehicles
    places = [(first.position_ne_m[0] - 12.0 * k - start_m, first.position_ne_m[1] + 12.0 * k) for k in (1, 2)]
    moved = [vehicle.model_copy(update={"position_ne_m": at}) for vehicle, at in zip(rest, places, strict=True)]
    slow = scenario.nominal_velocity[0].model_copy(update={"velocity_ne_m_s": (0.5, 0.0)})
    changes = {"vehicles": (first, *moved), "nominal_velocity": (slow,), "response": Response(**RESPONSE)}
    flight = fly(plan_for(scenario.model_copy(update=changes)))
    own = flight.flown[flight.flown["system_id"] == 2]
    north = own["spacing_error_north_m"]
    assert north[0] == pytest.approx(start_m, abs=0.1)
    assert -north.min() < 0.1 * start_m
    # from rest to rest: two halves at the largest acceleration, or four quarters at the largest jerk
    best_s = max(2.0 * (start_m / SENT_M_S2) ** 0.5, (32.0 * start_m / SENT_M_S3) ** (1.0 / 3.0))
    settled_s = own["time_s"][np.flatnonzero(np.abs(north) > 0.05 * start_m)[-1]] - own["time_s"][0]
    assert settled_s < 1.5 * best_s
    assert flight.error_m(2)[-1] < 0.02  # no limit cycle
    assert any("WPNAV_ACCEL 2.5 m/s^2, PSC_JERK_XY 5 m/s^3" in text for text in flight.texts("limits"))
