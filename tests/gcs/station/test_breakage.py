"""A vehicle that returns to the formation gets the time to return before its error ends the flight."""

from dataclasses import replace
from math import hypot, nan

import numpy as np
import pytest

from gcs.control.law import CONTROL, Nearest
from gcs.drive.lockstep import START_NS, fly_lockstep
from gcs.plan.flight_plan import FlightPlan
from gcs.runs.summary import verdict
from gcs.station.breakage import Breakage, recovery_time_s, slowest_decay_1_s
from gcs.station.station import Station
from scenarios.kernel import Records
from scenarios.schema import Limits, Scenario
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.vehicles.copter_rules import RULES
from tests.support.fleets.flown_copters import TRUTH, Flight, plan_for, three
from tests.support.fleets.pilots import PILOTS_MODE, PilotsVehicle, flight_s

APART = Nearest(np.full(3, 100.0), (0, 1))


def with_errors(*errors_m: float) -> Records:
    """The controls of vehicles with these spacing errors north."""
    controls = np.zeros(len(errors_m), CONTROL)
    controls["spacing_error_m"][:, 0] = errors_m
    return controls


def flown(flavour: str, modes: dict[float, int], **changes: object) -> Flight:
    """A flight of 60 s in which the pilot of vehicle 3 changes its mode at these times of the flight."""
    scenario: Scenario = three(flavour=flavour, duration_s=60.0).model_copy(update={"response": TRUTH} | changes)
    began_s = flight_s(flavour)
    station, fleet = Station(plan_for(scenario), start_ns=START_NS), Fleet(scenario, START_NS)
    vehicles = PilotsVehicle(fleet, flavour, {began_s + at_s: mode for at_s, mode in modes.items()})
    ticks = list(fly_lockstep(station.plan, station=station, vehicles=vehicles))
    return Flight(station, fleet, np.concatenate(ticks), station.events)


@pytest.mark.slow(first=1)
@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_a_vehicle_given_back_far_behind_returns_to_stable_flight(flavour: str) -> None:
    flight = flown(flavour, {5.0: PILOTS_MODE[flavour], 20.0: RULES[flavour].guided_mode})
    assert flight.station.end_reason == "completed: duration reached"
    assert "is given back" in flight.texts("vehicle")
    limit_m = flight.station.plan.scenario.safety.spacing_error_limit_m
    assert np.nanmax(flight.error_m(3)) > 1.5 * limit_m  # without time to return, this would have ended the flight
    assert flight.error_m(3)[-1] < 0.17
    assert verdict(flight.station.end_reason, 1.0) == "stable"


def test_vehicles_or_followers_not_back_in_time_end_the_flight() -> None:
    plan = plan_for(three())
    breakage, limit_m = Breakage(plan), plan.scenario.safety.spacing_error_limit_m

    def judged(time_s: float, errors_m: tuple[float, float], *, away: bool = False) -> str:
        """The reason to end with these errors of vehicles 2 and 3, of which vehicle 2 may be away."""
        return breakage.judge(with_errors(nan, *errors_m), {1: False} if away else {}, APART, time_s)

    far_m = 2.0 * limit_m
    assert judged(1.0, (0.9 * limit_m, 0.9 * limit_m)) == ""
    assert judged(2.0, (far_m, 0.0), away=True) == ""
    assert judged(3.0, (far_m, far_m)) == ""
    allowed_s = recovery_time_s(plan, slowest_decay_1_s(plan), far_m, 4.0)
    assert 10.0 < allowed_s < 120.0
    assert judged(3.0 + 0.99 * allowed_s, (far_m, far_m)) == ""
    reason = judged(3.0 + 1.01 * allowed_s, (0.0, far_m))
    assert reason == f"broken: spacing error of vehicle 3 is {far_m:.0f} m, limit 30 m"


def test_a_vehicle_that_keeps_failing_gets_no_new_time() -> None:
    """New time is for a vehicle that was back within the limit, or that its pilot flew."""
    plan = plan_for(three())
    limit_m = plan.scenario.safety.spacing_error_limit_m

    def end_of(error_m: float, again_m: float, *, piloted: bool = False) -> str:
        """The end of a flight in which vehicle 2 falls into its failsafe, or is taken over, every 2 s for 600 s."""
        breakage = Breakage(plan)
        for tick in range(600):
            controls = with_errors(nan, again_m if tick % 4 == 3 else error_m, 0.0)
            reason = breakage.judge(controls, {} if tick % 2 else {1: piloted}, APART, float(tick))
            if reason:
                return reason
        return ""

    assert end_of(2.0 * limit_m, 2.0 * limit_m).startswith("broken: spacing error of vehicle 2")
    assert end_of(2.0 * limit_m, 0.0) == ""
    assert end_of(2.0 * limit_m, 2.0 * limit_m, piloted=True) == ""


def test_the_time_suffices_for_the_slowest_gains_and_for_limits() -> None:
    """Checked with the loop itself: after that time, the error stays within the limit."""
    plan: FlightPlan = replace(plan_for(three()), scenario=three().model_copy(update={"limits": Limits()}))
    decay_1_s = slowest_decay_1_s(plan)
    model, K = plan.model, plan.gains[-1]
    closed_loop = model.A + model.B @ K
    assert decay_1_s == pytest.approx(-np.linalg.eigvals(closed_loop).real.max(), rel=1e-6)
    limit_m = plan.scenario.safety.spacing_error_limit_m
    for start_m in (54.0, 200.0, 5000.0):
        time_s = recovery_time_s(plan, decay_1_s, start_m, 4.0)
        values, vectors = np.linalg.eig(closed_loop)
        x0 = np.zeros(model.states)
        x0[model.spacing_slice(2)] = start_m, 0.0
        parts = np.linalg.solve(vectors, x0)
        later_m = [
            hypot(*(vectors @ (parts * np.exp(values * t))).real[model.spacing_slice(2)])
            for t in np.linspace(time_s, 2.0 * time_s, 50)
        ]
        assert max(later_m) < limit_m
    limited = replace(plan, scenario=three())
    assert recovery_time_s(limited, decay_1_s, 54.0, 4.0) > recovery_time_s(plan, decay_1_s, 54.0, 4.0) + 20.0
