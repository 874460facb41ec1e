"""Parameters of the vehicles over the parameter protocol, with plain pymavlink as the other side."""

import itertools
import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_vehicles.vehicles.shell import Craft, Shell
from tests.support.fleets.vehicle_kinds import VEHICLES, copter
from tests.support.sim_client import SECOND, START, a_vehicle, arm, heartbeat, mode, pack, parse_all, setpoint, take_off

REAL32, INT32 = dialect.MAV_PARAM_TYPE_REAL32, dialect.MAV_PARAM_TYPE_INT32


TIMEOUT = {"double_integrator": "GUID_TIMEOUT", "ardupilot": "GUID_TIMEOUT", "px4": "COM_OF_LOSS_T"}


def ask_list(system: int = 1) -> bytes:
    return pack(dialect.MAVLink_param_request_list_message(system, 1))


def ask(name: str = "", index: int = -1) -> bytes:
    return pack(dialect.MAVLink_param_request_read_message(1, 1, name.encode(), index))


def put(name: str, value: float, kind: int = REAL32) -> bytes:
    return pack(dialect.MAVLink_param_set_message(1, 1, name.encode(), value, kind))


def told(vehicle: Shell[Craft], data: bytes, at_s: float = 5.0) -> list[Any]:
    """PARAM_VALUE and PARAM_ERROR that a vehicle sends at once when it is told something."""
    time_ns = START + round(at_s * SECOND)
    vehicle.step([], time_ns - 1)
    sent = parse_all(vehicle.step([(data, time_ns)], time_ns))
    return [m for m, _ in sent if m.get_type() in ("PARAM_VALUE", "PARAM_ERROR")]


def listed(vehicle: Shell[Craft], at_s: float = 5.0) -> list[tuple[Any, int]]:
    told(vehicle, ask_list(), at_s)
    return parse_all(vehicle.step([], START + round((at_s + 5.0) * SECOND)), "PARAM_VALUE")


@pytest.mark.parametrize("kind", VEHICLES)
def test_a_list_sends_each_parameter_once_without_flooding(kind: str) -> None:
    sent = listed(VEHICLES[kind]())
    values = [m for m, _ in sent]
    assert len(values) >= 3
    assert [m.param_index for m in values] == list(range(len(values)))
    assert {m.param_count for m in values} == {len(values)}
    assert len({m.param_id for m in values}) == len(values)
    times_ns = [t for _, t in sent]
    assert min(b - a for a, b in itertools.pairwise(times_ns)) >= 15_000_000


@pytest.mark.parametrize("kind", VEHICLES)
def test_a_list_asked_for_again_begins_again_and_ends(kind: str) -> None:
    vehicle = VEHICLES[kind]()
    count = len(listed(vehicle))
    told(vehicle, ask_list(), 11.0)
    vehicle.step([], START + round(11.03 * SECOND))  # one or two of them
    told(vehicle, ask_list(), 11.04)
    again = parse_all(vehicle.step([], START + 20 * SECOND), "PARAM_VALUE")
    assert [m.param_index for m, _ in again] == list(range(count))


@pytest.mark.parametrize("kind", VEHICLES)
def test_parameters_read_by_name_and_index_as_listed(kind: str) -> None:
    vehicle = VEHICLES[kind]()
    for wanted, _ in listed(vehicle):
        for request in (ask(wanted.param_id), ask(index=wanted.param_index)):
            (value,) = told(vehicle, request, 11.0)
            assert value.to_dict() == wanted.to_dict()


@pytest.mark.parametrize("kind", VEHICLES)
def test_a_set_value_is_acknowledged_read_and_listed(kind: str) -> None:
    vehicle = VEHICLES[kind]()
    (answer,) = told(vehicle, put(TIMEOUT[kind], 2.7))
    assert answer.param_value == pytest.approx(2.7, rel=1e-7)
    (value,) = told(vehicle, ask(TIMEOUT[kind]), 100.0)
    assert value.param_value == answer.param_value
    assert {m.param_id: m.param_value for m, _ in listed(vehicle, 101.0)}[TIMEOUT[kind]] == answer.param_value


@pytest.mark.parametrize("kind", VEHICLES)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -1.0, 0.0, 1e30])
def test_an_invalid_value_is_answered_with_the_present_one(kind: str, value: float) -> None:
    vehicle = VEHICLES[kind]()
    (before,) = told(vehicle, ask(TIMEOUT[kind]))
    (answer,) = told(vehicle, put(TIMEOUT[kind], value))
    assert answer.to_dict() == before.to_dict()
    assert vehicle.counters["refused_parameter_value"] == 1


@pytest.mark.parametrize("request_frame", [ask("NOT_THERE"), ask(index=9999), ask(index=-2), put("NOT_THERE", 1.0)])
def test_an_unknown_parameter_is_an_error_without_effect(request_frame: bytes) -> None:
    vehicle = a_vehicle()
    before = [m.to_dict() for m, _ in listed(vehicle)]
    (error,) = told(vehicle, request_frame, 11.0)
    assert (error.get_type(), error.error) == ("PARAM_ERROR", dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST)
    assert vehicle.counters["refused_parameter_name"] == 1
    assert [m.to_dict() for m, _ in listed(vehicle, 12.0)] == before


def test_integers_travel_as_each_autopilot_sends_them() -> None:
    (converted,) = told(copter("ardupilot"), ask("SYSID_THISMAV"))
    (bytewise,) = told(copter("px4"), ask("MAV_SYS_ID"))
    assert (converted.param_type, converted.param_value) == (INT32, 1.0)
    assert (bytewise.param_type, struct.unpack("<i", struct.pack("<f", bytewise.param_value))) == (INT32, (1,))


def test_a_system_id_is_not_changed_in_flight() -> None:
    vehicle = a_vehicle()
    (answer,) = told(vehicle, put("SYSID_THISMAV", 9.0, INT32))
    assert answer.param_value == 1.0


def test_requests_for_another_vehicles_parameters_are_not_answered() -> None:
    vehicle = a_vehicle()
    assert told(vehicle, ask_list(system=2)) == []
    assert vehicle.counters["ignored_not_addressed"] == 1


def test_a_time_out_set_in_flight_triggers_the_failsafe() -> None:
    for name, deadline_s in (("GUID_TIMEOUT", 1.5), ("FS_GCS_TIMEOUT", 0.5)):
        vehicle = a_vehicle()
        vehicle.step([(put(name, deadline_s), START)], START)
        take_off(vehicle)
        texts = parse_all(vehicle.step([(setpoint(), START)], START + 10 * SECOND), "STATUSTEXT")
        if name == "GUID_TIMEOUT":
            assert [(m.text, t) for m, t in texts] == [("failsafe: set-points stopped", START + 1500_000_000)]
        else:
            assert [(m.text, t) for m, t in texts] == [("failsafe: station heartbeat stopped", START + 500_000_000)]


def test_a_shorter_time_out_does_not_end_in_the_past() -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    now = START + 900_000_000
    sent = vehicle.step([(put("GUID_TIMEOUT", 0.25), now)], now + SECOND)
    assert [(m.text, t) for m, t in parse_all(sent, "STATUSTEXT")] == [
        ("failsafe: set-points stopped", now + 250_000_000)
    ]


def test_setting_an_unchanged_value_keeps_no_silent_station_alive() -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    frames = [(put("GUID_TIMEOUT", 1.0), START + k * SECOND // 10) for k in range(30)]
    texts = parse_all(vehicle.step(frames, START + 3 * SECOND), "STATUSTEXT")
    assert [(m.text, t) for m, t in texts] == [("failsafe: set-points stopped", START + SECOND)]


def test_a_copter_stops_after_the_time_that_was_set() -> None:
    vehicle = copter("ardupilot")
    for k, data in enumerate((put("GUID_TIMEOUT", 0.5), mode(4), arm())):
        now = START + 5 * SECOND + k
        vehicle.step([(data, now)], now)
    now = START + 6 * SECOND
    takeoff = pack(dialect.MAVLink_command_long_message(1, 1, 22, 0, 0, 0, 0, 0, 0, 0, 10))
    vehicle.step([(takeoff, now)], now)
    later = now + 20 * SECOND
    sent = vehicle.step([(setpoint(mask=0x0DC7), later)], later + 2 * SECOND)
    assert [t for _, t in parse_all(sent, "STATUSTEXT")] == [later + SECOND // 2]


@given(data=st.binary(max_size=30), number=st.sampled_from([20, 21, 23]))
def test_no_payload_of_a_parameter_message_does_harm(data: bytes, number: int) -> None:
    vehicle = a_vehicle()
    before = [m.to_dict() for m, _ in listed(vehicle)]
    body = bytes([len(data), 0, 0, 0, 255, 190, number, 0, 0]) + data
    crc = dialect.x25crc(body + bytes([dialect.mavlink_map[number].crc_extra])).crc
    now = START + 11 * SECOND
    vehicle.step([(b"\xfd" + body + crc.to_bytes(2, "little"), now), (heartbeat(), now)], now + SECOND)
    assert vehicle.counters["heartbeats"] == 1
    assert [m.to_dict() for m, _ in listed(vehicle, 13.0)] == before
