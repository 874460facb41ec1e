"""Flights of the copters of copters5 in virtual time, for the tests of what the start-up and the flight cope with."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from gcs.control.tick import Event, TickArray
from gcs.drive.lockstep import START_NS, fly_lockstep
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.station.station import Station
from scenarios.files import load
from scenarios.keys.link import Link, Links
from scenarios.schema import Response, Scenario
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.vehicles.copter import Copter
from tests.support.paths import SCENARIOS

COPTERS5 = load(SCENARIOS / "copters5.toml")
TRUTH = Response(lag_s=COPTERS5.autopilot.lag_s, velocity_gain_1_s=COPTERS5.autopilot.velocity_gain_1_s)


def three(*, duration_s: float = 15.0, up_down: Link | None = None, **changes: Any) -> Scenario:
    """The leader and one platoon of copters5, with these changes to their autopilots."""
    kept: dict[str, Any] = {"vehicles": COPTERS5.vehicles[:3], "duration_s": duration_s}
    links = Links(up=up_down, down=up_down) if up_down else COPTERS5.links
    autopilot = COPTERS5.autopilot.model_copy(update=changes)
    return COPTERS5.model_copy(update=kept | {"links": links, "autopilot": autopilot})


@dataclass(frozen=True)
class Flight:
    """A flight that has ended: its ticks, events and vehicles."""

    station: Station
    fleet: Fleet
    ticks: TickArray
    events: list[Event]

    @property
    def flown(self) -> TickArray:
        """Ticks of the formation flight, without those in which the vehicles are told to hold."""
        last = self.ticks["tick"][self.ticks["commanded"]][-1]
        return self.ticks[(self.ticks["time_s"] >= 0.0) & (self.ticks["tick"] <= last)]

    def error_m(self, system_id: int) -> np.ndarray[Any, np.dtype[np.float64]]:
        rows = self.flown[self.flown["system_id"] == system_id]
        return np.hypot(rows["spacing_error_north_m"], rows["spacing_error_east_m"])

    def texts(self, kind: str) -> list[str]:
        return [event.text for event in self.events if event.kind == kind]

    def copter(self, system_id: int) -> Copter:
        craft = self.fleet.vehicle(system_id).craft
        assert isinstance(craft, Copter)
        return craft


def fly(plan: FlightPlan, fleet: Fleet | None = None, start_ns: int = START_NS) -> Flight:
    station, fleet = Station(plan, start_ns=start_ns), fleet or Fleet(plan.scenario, start_ns)
    ticks = list(fly_lockstep(plan, station=station, vehicles=fleet))
    return Flight(station, fleet, np.concatenate(ticks), station.events)


@cache
def planned(flavour: str) -> FlightPlan:
    return flight_plan(three(flavour=flavour))[1]


def plan_for(scenario: Scenario) -> FlightPlan:
    """The gains of copters5 with another scenario of the same formation: designing takes longer than flying."""
    return replace(planned("ardupilot"), scenario=scenario)
