"""Ten minutes with simulated copters whose clocks are as wrong as those of a real ArduCopter in SITL."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from gcs.control.tick import CLOCK_JUMPED
from gcs.drive.lockstep import START_NS
from gcs.plan.design import Design
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.runs.summary import summarise
from scenarios.keys.autopilot import Sitl
from scenarios.keys.link import Link, Links
from scenarios.schema import ClockJump, Rates, Scenario
from tests.support.fleets.flown_copters import COPTERS5, TRUTH, Flight, fly

SLOWLY = Rates(control_hz=10.0, telemetry_hz=10.0, timesync_hz=10.0)
"""TIMESYNC at its usual rate, and as little else as a stable flight needs."""
AS_MEASURED = Sitl(timesync_back_s=0.0035, slip_s=0.0008, slip_every_s=20.0)
DIRECT = Links(up=Link(delay_s=0.0003), down=Link(delay_s=0.0003))


def two(**changes: Any) -> Scenario:
    autopilot = COPTERS5.autopilot.model_copy(update={"sitl": AS_MEASURED, "ready_after_s": 30.0} | changes)
    own = {"vehicles": COPTERS5.vehicles[:2], "duration_s": 600.0, "response": TRUTH, "rates": SLOWLY, "links": DIRECT}
    return COPTERS5.model_copy(update=own | {"autopilot": autopilot})


@cache
def planned() -> tuple[Design, FlightPlan]:
    return flight_plan(two())


def flown(duration_s: float, **changes: Any) -> Flight:
    scenario = two(**changes).model_copy(update={"duration_s": duration_s})
    return fly(replace(planned()[1], scenario=scenario))


def test_wrong_clocks_show_no_jump_or_negative_delay() -> None:
    flight = flown(600.0)
    assert flight.station.end_reason == "completed: duration reached"
    assert CLOCK_JUMPED not in flight.texts("vehicle")
    rows = flight.flown
    assert 38.0 < (float(rows["due_ns"][0]) - START_NS) * 1e-9 < 44.0  # a cold start as measured, take-off included
    for name in ("up_delay_s", "down_delay_s", "loop_delay_s"):
        assert np.nanmin(rows[name]) >= 0.0
    summary = summarise(flight.station.plan.scenario, planned()[0], flight.ticks, flight.events)
    assert summary.loop_delay_bound_s is not None
    assert 0.005 < summary.loop_delay_bound_s < 0.015
    # the true delay: 0.3 ms each way plus at most a period of waiting; the error is within the bound
    known = rows[np.isfinite(rows["loop_delay_s"])]
    assert (known["loop_delay_s"] - known["loop_delay_bound_s"]).max() <= 0.1006


@pytest.mark.parametrize("by_s", [-0.25, 0.02])
def test_a_stalled_simulator_among_wrong_clocks_is_a_jump(by_s: float) -> None:
    flight = flown(30.0, clock_jumps=(ClockJump(at_s=60.0, by_s=by_s),))
    assert flight.texts("vehicle").count(CLOCK_JUMPED) == 2
    assert flight.station.end_reason == "completed: duration reached"
