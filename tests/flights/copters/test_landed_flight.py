"""A vehicle that has been in the air and is on the ground again is never armed by the station."""

import numpy as np
import pytest

from gcs.drive.lockstep import START_NS, fly_lockstep
from gcs.station.station import Station
from scenarios.schema import NominalVelocity
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.vehicles.copter_rules import RULES
from tests.support.fleets.flown_copters import plan_for, three
from tests.support.fleets.pilots import PilotsVehicle, flight_s, flown
from tests.support.sim_client import SECOND


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_a_vehicle_landed_by_its_pilot_stays_disarmed_in_guided(flavour: str) -> None:
    rules, began_s = RULES[flavour], flight_s(flavour)
    landed_s = began_s + 27.0
    modes = {began_s + 5.0: rules.land_mode, landed_s: rules.guided_mode}
    scenario = flown(flavour).model_copy(update={"duration_s": 45.0})
    station, fleet = Station(plan_for(scenario), start_ns=START_NS), Fleet(scenario, START_NS)
    own = PilotsVehicle(fleet, flavour, modes)
    error_m = 0.0
    for tick in fly_lockstep(station.plan, station=station, vehicles=own):
        since_s = (int(tick["due_ns"][0]) - START_NS) / SECOND
        if since_s > landed_s - 0.5:
            assert own.copter.landed
            assert not own.copter.armed
            error_m = float(tick["spacing_error_north_m"][tick["system_id"] == 2][0])
    assert own.told
    assert own.commanded == []
    texts = [event.text for event in station.events if event.system_id == 3]
    assert texts.count("has landed and is not armed again") == 1
    assert station.end_reason == "landed: vehicles 3"
    assert abs(error_m) < 0.17  # the others fly on


def test_a_landed_vehicle_does_not_collide_with_one_above_it() -> None:
    """The others stand still until it has landed, and then fly over it."""
    speeds = ((0.0, 0.0), (25.0, 3.0))
    over = tuple(NominalVelocity(from_s=at_s, velocity_ne_m_s=(-speed, speed)) for at_s, speed in speeds)
    scenario = flown("ardupilot").model_copy(update={"duration_s": 32.0, "nominal_velocity": over})
    station, fleet = Station(plan_for(scenario), start_ns=START_NS), Fleet(scenario, START_NS)
    own = PilotsVehicle(fleet, "ardupilot", {flight_s("ardupilot") + 1.0: RULES["ardupilot"].land_mode})
    ticks = np.concatenate([*fly_lockstep(station.plan, station=station, vehicles=own)])
    second, third = (ticks[ticks["system_id"] == k] for k in (2, 3))
    apart_m = np.hypot(second["north_m"] - third["north_m"], second["east_m"] - third["east_m"])
    assert np.nanmin(apart_m) < scenario.safety.collision_distance_m
    assert station.end_reason == "landed: vehicles 3"


def test_refusals_to_arm_are_one_event_and_a_count() -> None:
    scenario = three(arming_refusals=7, duration_s=1.0)
    station = Station(plan_for(scenario), start_ns=START_NS)
    for _ in fly_lockstep(station.plan, station=station, vehicles=Fleet(scenario, START_NS)):
        pass
    texts = [event.text for event in station.events if event.system_id == 3]
    assert sum("to command 400" in text for text in texts) == 1
    assert texts.count("Arm: Accels inconsistent") == 1
    assert "arms after 7 refusals" in texts
