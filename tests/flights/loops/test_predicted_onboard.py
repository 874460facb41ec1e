"""Flights of vehicles with loops on board, whose station predicts the acceleration that it streams to them."""

from functools import cache

import numpy as np
import pytest

from gains.sampled._loop import HeldPlant
from gains.sampled.multirate import Predictor, lifted_radius
from gains.sampled.onboard import local_plant, onboard_loop, streamed_loop
from gcs.drive.flown import fly_plan
from gcs.errors import InputError
from gcs.plan.flight_plan import FlightPlan, onboard_timing
from gcs.plan.planner import flight_plan
from gcs.stress.axes import at_coordinates
from gcs.stress.measure import fly_trial
from gcs.stress.study import Study
from scenarios.files import load
from scenarios.schema import GainBlock, Scenario
from tests.support.known import known
from tests.support.paths import SCENARIOS

THESIS = load(SCENARIOS / "thesis_delay.toml")


def triangle(prediction: float | str, *, link_s: float = 0.0, own: float = 0.2, others: float = 0.4) -> Scenario:
    """The source's three bidirectional vehicles, with larger weights on the others: they tolerate 0.206 s."""

    def scaled(block: GainBlock) -> GainBlock:
        share = own if block.vehicle == block.of else others
        gain = tuple(tuple(share * entry for entry in row) for row in block.gain)
        return GainBlock.model_validate(block.model_dump() | {"gain": gain})

    blocks = tuple(map(scaled, THESIS.control.blocks))
    control = THESIS.control.model_copy(update={"prediction": prediction, "blocks": blocks})
    return at_coordinates(THESIS.model_copy(update={"control": control, "duration_s": 30.0}), {"delay": link_s})


@cache
def planned(prediction: float | str) -> FlightPlan:
    return flight_plan(triangle(prediction).with_calm_monitor())[1]


def test_the_window_is_that_of_onboard_loops_stepped_exactly() -> None:
    """The map of one period in which vehicles sense, compute and hold at their own steps, without approximation."""
    plan = planned(1.0)
    timing = onboard_timing(plan.scenario)
    assert timing is not None
    loop = onboard_loop(plan.model, plan.gain, timing)
    plant = local_plant((loop.A, loop.sensed, loop.known, loop.late), timing)
    A, B, K = streamed_loop(plan.model, plan.gain, timing)
    # the station's commands reach the plant by its own input matrix: both have B_plant K = late
    believed = HeldPlant(A, B @ np.linalg.pinv(plan.model.B) @ plant.B, plant.K, timing.control_s)
    np.testing.assert_allclose(plan.model.B @ K, loop.late, atol=1e-12)

    def radius(delay_s: float) -> float:
        return lifted_radius(plant, timing.rates, delay_s=delay_s, predictor=Predictor(believed, 1.0))

    tolerated = plan.tolerance(1.0)
    least_s, most_s = 1.0 - tolerated.shorter_s[0], 1.0 + tolerated.longer_s[0]
    assert (least_s, most_s) == pytest.approx((0.771, 1.337), abs=1e-3)
    aside_s = 1e-3
    outside = [radius(least_s - aside_s), radius(most_s + aside_s)]
    assert max(radius(least_s + aside_s), radius(most_s - aside_s)) < 1.0 < min(outside)


@pytest.mark.slow(first=2)
@pytest.mark.parametrize("loop_s", [0.75, 1.3, 1.37])
def test_errors_change_at_the_rate_of_the_certificate(loop_s: float) -> None:
    outcome = fly_trial(Study(planned(1.0)).trial("probe", {"delay": loop_s - 0.01}, seed=1))
    growth, predicted = known(outcome.growth_1_s), known(outcome.predicted_growth_1_s)
    assert growth == pytest.approx(predicted, abs=0.01 + 0.01 * abs(predicted))
    assert (growth > 0.0) == (not 0.771 < known(outcome.loop_delay_s) < 1.337)


@pytest.mark.slow(first=1)
@pytest.mark.parametrize("prediction", [1.0, "measured"])
def test_a_predicted_triangle_settles_at_five_times_its_margin(prediction: float | str) -> None:
    _, plan = flight_plan(triangle(prediction, link_s=0.99))
    assert plan.delay_margin_s == pytest.approx(0.206, abs=1e-3)
    ticks = fly_plan(plan).ticks
    settled = ticks[ticks["time_s"] > 20.0]
    # the sensor's noise is 0.05 m
    assert np.nanmax(np.hypot(settled["spacing_error_north_m"], settled["spacing_error_east_m"])) < 0.5
    assert settled["headroom"].min() > 0.9


def test_without_prediction_the_same_triangle_breaks() -> None:
    flight = fly_plan(flight_plan(triangle("off", link_s=0.99))[1])
    late = flight.ticks[flight.ticks["time_s"] > 10.0]
    assert "broken" in flight.events[-1].text or np.nanmax(np.abs(late["spacing_error_north_m"])) > 5.0


def test_own_loops_that_grow_apart_without_the_stream_are_refused() -> None:
    with pytest.raises(InputError, match="own loops whose errors grow at"):
        flight_plan(triangle(1.0, own=-0.1))
