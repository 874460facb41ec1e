"""Telemetry slower or faster than control: what is planned, what is flown, and what the station says of it."""

from typing import Any

import numpy as np
import pytest

from gains.sampled.multirate import lifted_radius
from gains.sampled.onboard import onboard_loop
from gcs.control.tick import Mode
from gcs.drive.flown import fly_plan, margins_of
from gcs.plan.flight_plan import onboard_timing
from gcs.plan.planner import flight_plan
from gcs.runs.summary import summarise
from gcs.stress.measure import fly_trial
from gcs.stress.study import Study
from scenarios.files import load
from scenarios.keys.link import Link, Outage
from scenarios.schema import Control, FixedGains, Response, Scenario
from tests.support.known import known
from tests.support.paths import SCENARIOS

GAINS = Control(gains=FixedGains(K1=-3.4079559741115664, K2=0.6308727089934395, K3=5.608081773264997))
"""Gains with a margin of 0.3 s if both rates are 50 Hz."""


def scenario_at(telemetry_hz: float, control_hz: float = 50.0, *, name: str = "chain3", **changes: Any) -> Scenario:
    scenario = load(SCENARIOS / f"{name}.toml")
    rates = scenario.rates.model_copy(update={"control_hz": control_hz, "telemetry_hz": telemetry_hz})
    monitor = scenario.monitor.model_copy(update={"time_scales": (1.0, 2.0)})
    return scenario.model_copy(update={"rates": rates, "monitor": monitor} | changes)


@pytest.mark.parametrize(
    ("telemetry_hz", "margin_s"),
    [(100.0, 0.300000), (50.0, 0.300000), (25.0, 0.290179), (10.0, 0.261117), (5.0, 0.213938)],
)
def test_a_flight_has_the_margin_of_its_telemetry_rate(telemetry_hz: float, margin_s: float) -> None:
    """The loop delay counts from the newest sample; margins by the event-by-event method of
    `tests/gains/sampled/test_multirate.py`."""
    design, plan = flight_plan(scenario_at(telemetry_hz, control=GAINS))
    assert plan.delay_margin_s == pytest.approx(margin_s, abs=1e-6)
    assert design.delay_margin_s == plan.delay_margin_s
    assert design.schedule[1].delay_margin_s == plan.margins_s[1]


@pytest.mark.parametrize(
    ("telemetry_hz", "control_hz", "changes"),
    [
        (10.0, 50.0, {}),
        (30.0, 50.0, {}),
        (50.0, 20.0, {}),
        (30.0, 50.0, {"name": "chain3_bidirectional"}),
        (30.0, 50.0, {"response": Response(lag_s=0.05, velocity_gain_1_s=1.0)}),
    ],
    ids=str,
)
def test_a_design_has_the_margin_asked_for_at_any_rates(
    telemetry_hz: float, control_hz: float, changes: dict[str, Any]
) -> None:
    design, plan = flight_plan(scenario_at(telemetry_hz, control_hz, **changes))
    assert 0.3 - 1e-9 <= plan.delay_margin_s < 0.3002
    assert design.delay_margin_s == plan.delay_margin_s


@pytest.mark.parametrize(
    ("telemetry_hz", "control_hz"),
    [(25.0, 50.0), (10.0, 50.0), (5.0, 50.0), (100.0, 50.0), (50.0, 20.0), (30.0, 50.0), (7.0, 50.0)],
)
def test_flown_growth_is_that_of_the_model_at_these_rates(telemetry_hz: float, control_hz: float) -> None:
    """At the margin and 8 % beyond it. An error of half a per cent in loop delay would change the growth by 1e-2.
    Samples are taken at whole milliseconds, although the periods of 30 and 7 Hz are not."""
    _, plan = flight_plan(scenario_at(telemetry_hz, control_hz, control=GAINS))
    for part in (1.0, 1.08):
        link_s = part * plan.delay_margin_s - plan.timing.spread_s - 0.01
        outcome = fly_trial(Study(plan).trial("probe", {"delay": link_s}, seed=4))
        assert outcome.error is None
        assert outcome.growth_1_s == pytest.approx(outcome.predicted_growth_1_s, abs=2e-3)
        assert outcome.loop_delay_s == pytest.approx(link_s, abs=plan.timing.faster_s)


@pytest.mark.slow(first=1)
@pytest.mark.parametrize("telemetry_hz", [10.0, 30.0])
def test_growth_flown_on_board_matches_the_model_at_these_rates(telemetry_hz: float) -> None:
    scenario = scenario_at(telemetry_hz, name="thesis_delay")
    _, plan = flight_plan(scenario)
    outcome = fly_trial(Study(plan).trial("probe", {"delay": 1.05 * plan.delay_margin_s}, seed=4))
    assert outcome.growth_1_s == pytest.approx(outcome.predicted_growth_1_s, abs=1e-3)


def test_the_two_onboard_loop_models_agree_where_both_hold() -> None:
    """Telemetry at a fifth of the control rate: the step-to-step map and the event-to-event map."""
    scenario = scenario_at(10.0, name="thesis_delay")
    _, plan = flight_plan(scenario)
    timing = onboard_timing(scenario)
    assert timing is not None
    loop = onboard_loop(plan.model, plan.gain, timing)
    for delay_s in (0.0, 0.313, 0.9):
        radius = max(lifted_radius(plant, timing.rates, delay_s=delay_s) for plant in loop.plants())
        events = np.log(radius) / timing.rates.common_s
        assert events == pytest.approx(loop.growth_1_s(delay_s), abs=1e-9)


def test_missing_states_delay_the_loop_and_reused_ones_do_not() -> None:
    """Telemetry at 10 Hz over a link with an outage of half a second: five commands from each state, then more."""
    gone = Link(delay_s=0.02, outages=(Outage(from_s=2.02, until_s=2.52),))
    links = scenario_at(10.0).links.model_copy(update={"up": gone})
    _, plan = flight_plan(scenario_at(10.0, control=GAINS, links=links, duration_s=4.0))
    flight = fly_plan(plan)
    own = flight.ticks[(flight.ticks["system_id"] == 2) & flight.ticks["commanded"] & (flight.ticks["time_s"] > 0.5)]
    calm = own[(own["time_s"] < 2.0)]
    assert np.ptp(calm["loop_delay_s"]) < 1e-4
    assert 0.04 <= calm["loop_delay_s"][0] <= 0.06
    assert sorted(set(np.round(calm["repeated_s"], 6).tolist())) == [0.0, 0.02, 0.04, 0.06, 0.08]
    assert calm["headroom"] == pytest.approx(1.0 - calm["loop_delay_s"] / 0.261117, abs=1e-4)
    assert own["loop_delay_s"].max() == pytest.approx(calm["loop_delay_s"][0] + 0.5, abs=0.021)
    assert (own["mode"] >= Mode.CAUTION).any()
    summary = summarise(plan.scenario, margins_of(plan), flight.ticks, flight.events)
    assert 0.04 <= known(summary.loop_delay_s.p50) <= 0.06


def test_slow_telemetry_far_below_the_margin_raises_no_alarm() -> None:
    """100 ms of link delay at 5 Hz, margin 214 ms: if every age of a state counted, the margin would be exceeded."""
    scenario = scenario_at(5.0, control=GAINS, duration_s=30.0).with_link_delay(up_s=0.05, down_s=0.05)
    _, plan = flight_plan(scenario)
    flight = fly_plan(plan)
    flown = flight.ticks[flight.ticks["commanded"] & (flight.ticks["time_s"] > 0.1)]
    assert (flown["mode"] == Mode.NOMINAL).all()
