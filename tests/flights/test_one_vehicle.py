"""A leader that nobody follows: flown and judged by its own velocity loop."""

from math import pi
from typing import Any

import pytest

from gcs.drive.flown import fly_plan
from gcs.plan.design import Design
from gcs.plan.planner import flight_plan
from gcs.runs.summary import summarise
from gcs.runs.summary_record import Summary
from scenarios.schema import Control, NominalVelocity, Scenario, Vehicle
from tests.support.known import known

LONE = Scenario(
    name="lone",
    seed=4,
    duration_s=15.0,
    vehicles=(Vehicle(system_id=1, position_ne_m=(0.0, 0.0), velocity_ne_m_s=(24.0, 3.0)),),
    nominal_velocity=(NominalVelocity(from_s=0.0, velocity_ne_m_s=(20.0, 0.0)),),
)


def flown(scenario: Scenario) -> tuple[Design, Summary]:
    """Design and summary of a flight whose monitor only watches."""
    calm = scenario.model_copy(update={"monitor": scenario.monitor.model_copy(update={"act": False})})
    design, plan = flight_plan(calm)
    flight = fly_plan(plan)
    return design, summarise(calm, design, flight.ticks, flight.events)


@pytest.mark.parametrize("loop", ["ground", "onboard"])
def test_one_vehicle_alone_has_the_margin_of_its_velocity_loop(loop: Any) -> None:
    design, summary = flown(LONE.model_copy(update={"control": Control(loop=loop)}))
    assert design.K1_1_s is not None
    own = -design.K1_1_s[0][0]
    if loop == "ground":
        # x' = -k1 x(t - tau): pi / (2 k1)
        assert design.delay_margin_continuous_s == pytest.approx(pi / (2.0 * own), rel=1e-9)
        assert 0.3 < design.margins_s[0] < pi / (2.0 * own)
    else:
        assert design.delay_margin_s is None
    assert summary.verdict == "stable"
    assert 0.5 < known(summary.settling_time_s) < 5.0


def test_one_vehicle_beyond_its_margin_is_called_unstable() -> None:
    design, summary = flown(LONE.with_link_delay(up_s=0.3, down_s=0.3))
    assert known(summary.loop_delay_s.p50) > design.margins_s[0]
    assert summary.verdict == "unstable"


@pytest.mark.parametrize("method", ["graph-lqr", "graph-dk"])
def test_the_graph_methods_give_one_vehicle_the_margin_asked_for(method: Any) -> None:
    design, _ = flight_plan(LONE.model_copy(update={"control": Control(method=method)}))
    assert design.delay_margin_s == pytest.approx(0.3, rel=1e-6)
