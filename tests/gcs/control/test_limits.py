"""No set-point that leaves the station asks for more than the scenario's limits, whatever it is for."""

from dataclasses import replace

import numpy as np
import pytest

from gcs.drive.lockstep import START_NS, Sent, fly_lockstep
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.station.station import Station
from scenarios.files import load
from scenarios.schema import FixedGains, Limits, Vehicle
from sim_vehicles.drive.fleet import Fleet
from tests.support.fleets.flown_copters import planned, three
from tests.support.paths import SCENARIOS
from tests.support.sim_client import parse

ROUNDED = 1.0 + 1e-6
"""Set-points are sent as float32."""


class Wiretap:
    """A fleet, and the size of what each set-point to it asked for."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self.accelerations_m_s2: list[float] = []
        self.speeds_m_s: list[float] = []

    def step(self, received: Sent, now_ns: int) -> Sent:
        for _, data, _ in received:
            message = parse(data)
            if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                self.accelerations_m_s2.append(float(np.hypot(message.afx, message.afy)))
                self.speeds_m_s.append(float(np.hypot(message.vx, message.vy)))
        return self._fleet.step(received, now_ns)


def tapped(plan: FlightPlan, *, opening: float | None = None) -> Wiretap:
    """The set-points sent in a flight; with an `opening`, the monitor has opened the formation by it at once."""
    station, tap = Station(plan, start_ns=START_NS), Wiretap(Fleet(plan.scenario, START_NS))
    for _ in fly_lockstep(plan, station=station, vehicles=tap):
        if opening is not None:
            station._monitor.opening = opening  # noqa: SLF001
    return tap


@pytest.mark.parametrize("limit_m_s2", [1.0, 30.0])
@pytest.mark.parametrize("loop", ["onboard", "ground"])
def test_a_formation_opened_by_the_monitor_keeps_the_acceleration_limit(loop: str, limit_m_s2: float) -> None:
    flown = load(SCENARIOS / "chain3.toml")
    control = flown.control.model_copy(update={"loop": loop, "gains": FixedGains(K1=-3.4, K2=0.6, K3=5.6)})
    limits = Limits(acceleration_max_m_s2=limit_m_s2)
    changes = {"control": control, "limits": limits, "duration_s": 4.0}
    tap = tapped(flight_plan(flown.model_copy(update=changes))[1], opening=1.5)
    assert len(tap.accelerations_m_s2) > 500
    assert 0.99 * limit_m_s2 < max(tap.accelerations_m_s2) <= limit_m_s2 * ROUNDED


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_copters_keep_speed_and_acceleration_limits_in_manoeuvre_and_flight(flavour: str) -> None:
    """Speed is limited in the targets sent, which grow with the commands while a vehicle cannot follow."""
    scenario, limits = three(flavour=flavour, duration_s=8.0), Limits(acceleration_max_m_s2=1.5, speed_max_m_s=4.5)
    behind: list[Vehicle] = []
    for vehicle in scenario.vehicles:
        north, east = vehicle.position_ne_m
        further_m = 0.0 if vehicle.follows is None else 15.0
        behind.append(vehicle.model_copy(update={"position_ne_m": (north - further_m, east)}))
    scenario = scenario.model_copy(update={"vehicles": tuple(behind), "limits": limits})
    tap = tapped(replace(planned(flavour), scenario=scenario))
    assert 1.49 < max(tap.accelerations_m_s2) <= 1.5 * ROUNDED
    assert 4.49 < max(tap.speeds_m_s) <= 4.5 * ROUNDED
