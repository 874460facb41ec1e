"""A vehicle obeys one ground station; others are refused, counted and reported, but may still ask."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.drive.lockstep import START_NS, Sent, fly_lockstep
from gcs.plan.planner import flight_plan
from gcs.station.station import Station
from scenarios.files import load
from scenarios.schema import FixedGains
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.vehicles.copter import Copter
from sim_vehicles.vehicles.shell import Craft, Shell
from tests.support.paths import SCENARIOS
from tests.support.sim_client import (
    SECOND,
    START,
    a_vehicle,
    arm,
    guided,
    heartbeat,
    parse,
    scenario,
    setpoint,
    shell_of,
    take_off,
)

OTHER = 245


def from_another(message: dialect.MAVLink_message) -> bytes:
    return message.pack(dialect.MAVLink(None, srcSystem=OTHER, srcComponent=190))


def command_from_another(number: int, *parameters: float) -> bytes:
    padded = (*parameters, *(0.0,) * (7 - len(parameters)))
    return from_another(dialect.MAVLink_command_long_message(1, 1, number, 0, *padded))


def a_copter() -> Shell[Copter]:
    return shell_of(scenario(), Copter)


COMMANDS = {
    "disarm": command_from_another(400, 0, 21196),
    "mode": command_from_another(176, 1, 5),
    "set mode": from_another(dialect.MAVLink_set_mode_message(1, 1, 5)),
    "interval": command_from_another(511, 32, 1e6),
    "parameter": from_another(dialect.MAVLink_param_set_message(1, 1, b"FS_GCS_TIMEOUT", 100.0, 9)),
    "stream": from_another(dialect.MAVLink_request_data_stream_message(1, 1, 0, 10, 1)),
    "set-point": from_another(
        dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0x0C3F, 0, 0, 0, 0, 0, 0, 5, 5, 0, 0, 0)
    ),
}


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("make", [a_vehicle, a_copter])
def test_another_systems_commands_are_counted_and_change_nothing(make: Callable[[], Shell[Craft]], name: str) -> None:
    hit, calm = make(), make()
    for vehicle in (hit, calm):
        vehicle.step([(frame, START + SECOND) for frame in (arm(), guided(), setpoint(1.0, 1.0))], START + SECOND)
    at_ns = START + 3 * SECOND // 2
    told = hit.step([(COMMANDS[name], at_ns)] * 3, at_ns)
    calm.step([], at_ns)
    assert hit.counters["refused_not_the_station"] == 3
    texts = [message.text for data, _ in told if (message := parse(data)).get_type() == "STATUSTEXT"]
    assert texts == ["refused: system 245, obeys system 255"]
    assert "COMMAND_ACK" not in {parse(data).get_type() for data, _ in told}
    assert hit.craft.state_at(START + 3 * SECOND) == calm.craft.state_at(START + 3 * SECOND)
    later = [
        [(parse(data).get_type(), time_ns) for data, time_ns in vehicle.step([], START + 4 * SECOND)]
        for vehicle in (hit, calm)
    ]
    assert later[0] == later[1]


def test_another_station_may_ask() -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    asked = from_another(dialect.MAVLink_param_request_read_message(1, 1, b"SYSID_THISMAV", -1))
    sent = vehicle.step([(asked, START + SECOND)], START + SECOND)
    assert "PARAM_VALUE" in {parse(data).get_type() for data, _ in sent}
    assert vehicle.counters["refused_not_the_station"] == 0


@pytest.mark.parametrize("make", [a_vehicle, a_copter])
def test_a_display_that_comes_first_admits_the_station(make: Callable[[], Shell[Craft]]) -> None:
    """What other people's ground stations send by themselves when they find a vehicle, before anybody flies it."""
    vehicle = make()
    shown = [command_from_another(512, 148), COMMANDS["stream"], COMMANDS["interval"], command_from_another(520, 1)]
    vehicle.step([(frame, START + SECOND) for frame in shown], START + SECOND)
    sent = vehicle.step([(guided(), START + 2 * SECOND)], START + 2 * SECOND)
    assert "COMMAND_ACK" in {parse(data).get_type() for data, _ in sent}
    # once there is a station, others are still answered, but only the station sets rates
    refused = vehicle.counters["refused_not_the_station"]
    assert refused == 0
    for frame, more in ((command_from_another(512, 148), 0), (COMMANDS["interval"], 1)):
        vehicle.step([(frame, START + 3 * SECOND)], START + 3 * SECOND)
        assert vehicle.counters["refused_not_the_station"] == refused + more
        refused += more


def test_heartbeats_of_another_station_do_not_keep_the_failsafe_away() -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    other = from_another(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    for tenth in range(1, 60):
        # the station's set-points go on, its heartbeat stops after a second
        time_ns = START + tenth * SECOND // 10
        own = [setpoint(), heartbeat()] if tenth <= 10 else [setpoint()]
        vehicle.step([(data, time_ns) for data in (other, *own)], time_ns)
    assert vehicle.craft.flight.failsafe == "station heartbeat"
    assert vehicle.counters["heartbeats"] == 10


def test_after_the_station_has_been_silent_another_takes_over() -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    vehicle.step([(heartbeat(), START + 2 * SECOND)], START + 2 * SECOND)
    vehicle.step([(COMMANDS["mode"], START + 4_900_000_000)], START + 4_900_000_000)
    assert vehicle.counters["refused_not_the_station"] == 1
    sent = vehicle.step([(COMMANDS["mode"], START + 5_100_000_000)], START + 5_100_000_000)
    assert [parse(data).result for data, _ in sent if parse(data).get_type() == "COMMAND_ACK"] == [0]
    vehicle.step([(arm(), START + 6 * SECOND)], START + 6 * SECOND)
    assert vehicle.counters["refused_not_the_station"] == 2  # the first station is now the other one


class TwoStations:
    """A fleet to which another ground station speaks as well."""

    def __init__(self, fleet: Fleet) -> None:
        self.fleet = fleet
        self.sent = 0

    def step(self, received: Sent, now_ns: int) -> Sent:
        other: list[Any] = []
        if now_ns > START_NS + SECOND:
            other = [(1, data, now_ns) for data in COMMANDS.values()]
            self.sent += len(other)
        return self.fleet.step(list(received) + other, now_ns)


def test_a_second_station_neither_moves_a_formation_nor_goes_unseen() -> None:
    flown = load(SCENARIOS / "chain3.toml")
    control = flown.control.model_copy(update={"gains": FixedGains(K1=-3.4, K2=0.6, K3=5.6)})
    _, plan = flight_plan(flown.model_copy(update={"duration_s": 3.0, "control": control}))
    station, fleet = Station(plan, start_ns=START_NS), TwoStations(Fleet(plan.scenario, START_NS))
    ticks = list(fly_lockstep(plan, station=station, vehicles=fleet))
    calm = list(fly_lockstep(plan))
    assert station.end_reason == "completed: duration reached"
    assert fleet.fleet.counters["refused_not_the_station"] > 0.9 * fleet.sent > 500
    assert [event.text for event in station.events if event.kind == "statustext"].count(
        "refused: system 245, obeys system 255"
    ) == 1
    for name in ("command_north_m_s2", "north_m", "east_m", "loop_delay_s"):
        np.testing.assert_array_equal(np.concatenate(ticks)[name], np.concatenate(calm)[name])
