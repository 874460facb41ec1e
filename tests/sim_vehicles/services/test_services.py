"""What the start-up of other ground stations asks of a vehicle, with plain pymavlink as their side.

The sequence of QGroundControl is that of its InitialConnectStateMachine and of its firmware plugins for ArduPilot and
PX4, read in its source.
"""

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_vehicles.motion.copter import pair
from sim_vehicles.vehicles.copter import Copter
from sim_vehicles.vehicles.shell import Craft, Shell
from tests.support.fleets.vehicle_kinds import VEHICLES, copter
from tests.support.sim_client import (
    MS,
    SECOND,
    START,
    a_vehicle,
    arm,
    command,
    heartbeat,
    mode,
    pack,
    parse_all,
    setpoint,
    take_off,
)

ACCEPTED, DENIED, UNSUPPORTED = (
    dialect.MAV_RESULT_ACCEPTED,
    dialect.MAV_RESULT_DENIED,
    dialect.MAV_RESULT_UNSUPPORTED,
)
STATION = (255, 190)
FLYING = {"double_integrator": 0, "ardupilot": 4, "px4": 6 << 16}


def sent_after(vehicle: Shell[Craft], data: bytes, at_s: float, until_s: float) -> list[Any]:
    """What a vehicle sends from the instant it is told something to a later one, in s since its start."""
    begin_ns = START + round(at_s * SECOND)
    vehicle.step([], begin_ns - 1)
    return [m for m, _ in parse_all(vehicle.step([(data, begin_ns)], START + round(until_s * SECOND)))]


def acknowledged(sent: list[Any], number: int) -> int:
    (ack,) = [m for m in sent if m.get_type() == "COMMAND_ACK"]
    assert (ack.command, ack.target_system, ack.target_component) == (number, *STATION)
    return ack.result


def named(sent: list[Any], kind: str) -> list[Any]:
    return [m for m in sent if m.get_type() == kind]


def stream(number: int, rate_hz: int, start: int = 1) -> bytes:
    return pack(dialect.MAVLink_request_data_stream_message(1, 1, number, rate_hz, start))


def file_request(operation: int, data: bytes = b"", number: int = 7) -> bytes:
    payload = number.to_bytes(2, "little") + bytes([0, operation, len(data), 0, 0, 0]) + bytes(4) + data
    return pack(dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, list(payload.ljust(251, b"\0"))))


@pytest.mark.parametrize("kind", VEHICLES)
def test_a_client_that_asks_nothing_gets_only_telemetry(kind: str) -> None:
    vehicle = VEHICLES[kind]()
    sent = sent_after(vehicle, heartbeat(), 3.0, 30.0)
    telemetry = {"HEARTBEAT", "TIMESYNC"} | (
        {"LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"} if kind == "double_integrator" else set()
    )
    assert {m.get_type() for m in sent} == telemetry


@pytest.mark.parametrize("kind", VEHICLES)
@pytest.mark.parametrize("greeting", [command(512, 148), command(520, 1)], ids=["message", "capabilities"])
def test_a_version_request_starts_the_health_reports(kind: str, greeting: bytes) -> None:
    vehicle = VEHICLES[kind]()
    sent = sent_after(vehicle, greeting, 5.0, 10.0)
    (version,) = named(sent, "AUTOPILOT_VERSION")
    assert version.flight_sw_version >> 24 >= (1 if kind == "px4" else 4)
    assert version.capabilities & dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    assert version.capabilities & dialect.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    for name in ("SYS_STATUS", "EXTENDED_SYS_STATE", "GPS_RAW_INT", "ATTITUDE", "BATTERY_STATUS", "VFR_HUD"):
        assert 4 <= len(named(sent, name)) <= 6, name
    assert len(named(sent, "GLOBAL_POSITION_INT")) >= 4
    assert len(named(sent, "HOME_POSITION")) >= 2  # QGroundControl asks ArduPilot for it; PX4 sends it by itself
    status, gps = named(sent, "SYS_STATUS")[-1], named(sent, "GPS_RAW_INT")[-1]
    wanted = (
        dialect.MAV_SYS_STATUS_SENSOR_3D_GYRO
        | dialect.MAV_SYS_STATUS_SENSOR_3D_ACCEL
        | dialect.MAV_SYS_STATUS_SENSOR_3D_MAG
        | dialect.MAV_SYS_STATUS_SENSOR_GPS
        | dialect.MAV_SYS_STATUS_PREARM_CHECK
    )
    assert status.onboard_control_sensors_present & wanted == wanted
    assert status.onboard_control_sensors_health & (wanted | dialect.MAV_SYS_STATUS_GEOFENCE) >= wanted
    assert gps.fix_type == dialect.GPS_FIX_TYPE_3D_FIX
    place = named(sent, "GLOBAL_POSITION_INT")[-1]
    assert (gps.lat, gps.lon, gps.alt) == (place.lat, place.lon, place.alt)
    assert named(sent, "EXTENDED_SYS_STATE")[-1].landed_state == dialect.MAV_LANDED_STATE_ON_GROUND


def test_a_version_request_slows_no_telemetry() -> None:
    vehicle = VEHICLES["double_integrator"]()
    vehicle.step([(command(511, 32, 20_000), START)], START)
    assert len(named(sent_after(vehicle, command(512, 148), 1.0, 2.0), "LOCAL_POSITION_NED")) >= 49


def test_before_it_has_a_position_a_copter_is_not_healthy() -> None:
    vehicle = copter("ardupilot")
    sent = sent_after(vehicle, command(512, 148), 1.0, 1.99)
    (status,) = named(sent, "SYS_STATUS")
    assert not status.onboard_control_sensors_health & dialect.MAV_SYS_STATUS_SENSOR_GPS
    assert not status.onboard_control_sensors_health & dialect.MAV_SYS_STATUS_PREARM_CHECK
    assert named(sent, "GPS_RAW_INT")[0].fix_type == dialect.GPS_FIX_TYPE_NO_FIX


@pytest.mark.parametrize("kind", VEHICLES)
@pytest.mark.parametrize("request_frame", [command(512, 242), command(410)], ids=["message", "old"])
def test_home_is_where_it_stood_in_both_frames(kind: str, request_frame: bytes) -> None:
    vehicle = VEHICLES[kind]()
    sent_after(vehicle, command(511, 33, 100_000), 4.0, 4.0)
    sent_after(vehicle, command(511, 32, 100_000), 4.0, 4.0)
    sent = sent_after(vehicle, request_frame, 5.0, 5.5)
    assert named(sent, "COMMAND_ACK")[0].result == ACCEPTED
    (home,) = named(sent, "HOME_POSITION")
    place, local = named(sent, "GLOBAL_POSITION_INT")[-1], named(sent, "LOCAL_POSITION_NED")[-1]
    north_m = math.radians((place.lat - home.latitude) * 1e-7) * 6_378_137.0
    # 1e-7 degrees are 11 mm; a double integrator's home is the origin of its frame, under the launcher
    assert (local.x - home.x, home.z - local.z) == pytest.approx((north_m, place.relative_alt * 1e-3), abs=0.03)
    assert home.altitude == place.alt - place.relative_alt


@pytest.mark.parametrize("kind", VEHICLES)
@pytest.mark.parametrize("list_kind", [0, 1, 2], ids=["mission", "fence", "rally"])
def test_every_list_is_empty_clearable_and_read_only(kind: str, list_kind: int) -> None:
    vehicle = VEHICLES[kind]()

    def answer(message: dialect.MAVLink_message) -> Any:
        (found,) = [m for m in sent_after(vehicle, pack(message), 5.0, 5.0) if m.get_type().startswith("MISSION")]
        assert (found.target_system, found.target_component, found.mission_type) == (*STATION, list_kind)
        return found

    count = answer(dialect.MAVLink_mission_request_list_message(1, 1, list_kind))
    assert (count.get_type(), count.count) == ("MISSION_COUNT", 0)
    assert answer(dialect.MAVLink_mission_clear_all_message(1, 1, list_kind)).type == dialect.MAV_MISSION_ACCEPTED
    assert answer(dialect.MAVLink_mission_count_message(1, 1, 0, list_kind)).type == dialect.MAV_MISSION_ACCEPTED
    assert answer(dialect.MAVLink_mission_count_message(1, 1, 3, list_kind)).type == dialect.MAV_MISSION_UNSUPPORTED
    missing = answer(dialect.MAVLink_mission_request_int_message(1, 1, 0, list_kind))
    assert missing.type == dialect.MAV_MISSION_INVALID_SEQUENCE


@pytest.mark.parametrize("kind", VEHICLES)
@pytest.mark.parametrize(
    ("operation", "wanted"), [(4, (129, 10)), (3, (129, 10)), (2, (128,)), (1, (128,)), (99, (129, 7))]
)
def test_file_transfer_says_that_there_are_no_files(kind: str, operation: int, wanted: tuple[int, ...]) -> None:
    vehicle = VEHICLES[kind]()
    (answer,) = named(
        sent_after(vehicle, file_request(operation, b"@PARAM/param.pck"), 5.0, 5.0), "FILE_TRANSFER_PROTOCOL"
    )
    payload = bytes(answer.payload)
    assert (answer.target_system, answer.target_component) == STATION
    assert int.from_bytes(payload[:2], "little") == 8  # the number of the request and one
    assert (payload[3], *payload[12 : 12 + payload[4]]) == wanted
    assert payload[5] == operation


@pytest.mark.parametrize("kind", VEHICLES)
def test_data_streams_begin_change_and_stop(kind: str) -> None:
    vehicle = VEHICLES[kind]()
    begun = sent_after(vehicle, stream(10, 10), 5.0, 6.0)
    assert 9 <= len(named(begun, "ATTITUDE")) <= 11
    assert not named(sent_after(vehicle, stream(10, 10, start=0), 6.0, 8.0), "ATTITUDE")
    everything = sent_after(vehicle, stream(0, 4), 8.0, 9.0)
    assert 3 <= len(named(everything, "SYS_STATUS")) <= 5
    assert not [m for m in sent_after(vehicle, stream(77, 50), 9.0, 9.1) if m.get_type() == "COMMAND_ACK"]


def test_a_stream_request_is_limited_to_1000_hz() -> None:
    assert len(named(sent_after(VEHICLES["double_integrator"](), stream(10, 65_535), 5.0, 5.1), "ATTITUDE")) == 100


def test_a_vehicle_beyond_the_range_of_latitude_still_reports() -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    vehicle.step([(command(512, 148), START)], START)
    for k in range(800):  # at 1000 g
        at = START + k * 100 * MS
        vehicle.step([(heartbeat(), at), (setpoint(9_000.0), at)], at)
    sent = [m for m, _ in parse_all(vehicle.step([], START + 82 * SECOND))]
    assert named(sent, "GPS_RAW_INT")[-1].lat == 2**31 - 1
    assert named(sent, "GPS_RAW_INT")[-1].vel == 0xFFFE
    assert named(sent, "VFR_HUD")[-1].groundspeed > 7e5


@pytest.mark.parametrize("kind", VEHICLES)
def test_intervals_are_set_reported_and_reset(kind: str) -> None:
    vehicle = VEHICLES[kind]()
    assert acknowledged(sent_after(vehicle, command(511, 30, 200_000), 5.0, 5.0), 511) == ACCEPTED
    (told,) = named(sent_after(vehicle, command(510, 30), 5.1, 5.1), "MESSAGE_INTERVAL")
    assert (told.message_id, told.interval_us) == (30, 200_000)
    assert acknowledged(sent_after(vehicle, command(511, 30, 0), 6.0, 6.0), 511) == ACCEPTED
    (told,) = named(sent_after(vehicle, command(512, 244, 30), 7.0, 7.0), "MESSAGE_INTERVAL")
    assert told.interval_us == -1


@pytest.mark.parametrize("kind", VEHICLES)
def test_every_start_up_step_of_qgroundcontrol_is_answered(kind: str) -> None:
    vehicle = VEHICLES[kind]()
    parameters: dict[str, Any] = {}
    results: dict[tuple[int, int], int] = {}
    steps = [
        *(stream(group, rate) for group, rate in ((1, 2), (2, 2), (3, 2), (6, 3), (10, 10), (11, 10), (12, 3))),
        command(511, 242, 1_000_000),
        command(511, 245, 1_000_000),
        *(command(512, number) for number in (148, 397, 395, 435, 300, 280)),
        file_request(4, b"/general.json"),
        pack(dialect.MAVLink_param_request_read_message(1, 1, b"_HASH_CHECK", -1)),
        pack(dialect.MAVLink_param_request_list_message(1, 0)),
        *(pack(dialect.MAVLink_mission_request_list_message(1, 1, list_kind)) for list_kind in (0, 1, 2)),
        command(410),
    ]
    received: list[Any] = []
    for step, data in enumerate(steps):
        at_s = 5.0 + step
        sent = sent_after(vehicle, data, at_s, at_s + 0.999)
        asked: Any = (dialect.MAVLink(None).parse_buffer(data) or [None])[0]
        if asked.get_type() == "COMMAND_LONG":
            results[asked.command, int(asked.param1)] = acknowledged(sent, asked.command)
        received += sent
    assert results[512, 148] == results[511, 242] == results[511, 245] == results[410, 0] == ACCEPTED
    # no component metadata, no list of modes: refused at once, so that the station goes on and does not ask again
    assert {results[512, number] for number in (397, 395, 435, 300, 280)} == {DENIED}
    for value in named(received, "PARAM_VALUE"):
        parameters[value.param_id] = value
    assert len(parameters) == next(iter(parameters.values())).param_count
    assert [m.mission_type for m in named(received, "MISSION_COUNT")] == [0, 1, 2]
    assert [m.param_id for m in named(received, "PARAM_ERROR")] == ["_HASH_CHECK"]
    assert len(named(received, "FILE_TRANSFER_PROTOCOL")) == 1
    assert not named(received, "STATUSTEXT")  # nothing for it to show
    # QGroundControl starts its streams again if it has not heard these for 10 s
    for name in ("HOME_POSITION", "BATTERY_STATUS"):
        assert len(named(received, name)) >= 10
    set_up = ("SYS_AUTOSTART", "CAL_ACC0_ID") if kind == "px4" else ("FRAME_CLASS", "INS_ACCOFFS_X", "BATT_CAPACITY")
    assert all(parameters[name].param_value != 0.0 for name in set_up)


@pytest.mark.parametrize("kind", VEHICLES)
def test_a_mode_requested_by_set_mode_is_flown(kind: str) -> None:
    vehicle = VEHICLES[kind]()
    number = 5 if kind != "px4" else 4 << 16 | 5 << 24
    request = pack(dialect.MAVLink_set_mode_message(1, dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, number))
    sent = sent_after(vehicle, request, 5.0, 6.5)
    assert named(sent, "HEARTBEAT")[-1].custom_mode == number
    assert not named(sent, "COMMAND_ACK")


def test_a_launched_double_integrator_waits_forever_for_set_points() -> None:
    vehicle = VEHICLES["double_integrator"]()
    for data in (arm(), mode(4)):
        vehicle.step([(data, START)], START)
    assert acknowledged(sent_after(vehicle, command(22, 0, 0, 0, 0, 0, 0, 10), 1.0, 1.0), 22) == ACCEPTED
    beats = [(heartbeat(), START + k * SECOND) for k in range(2, 11)]
    sent = [m for m, _ in parse_all(vehicle.step(beats, START + 11 * SECOND))]
    assert not named(sent, "STATUSTEXT")
    assert vehicle.craft.state_at(START + 11 * SECOND).north_m == pytest.approx(40.0 * 10.0)
    silent = [m for m, _ in parse_all(vehicle.step([], START + 14 * SECOND))]
    assert [m.text for m in named(silent, "STATUSTEXT")] == ["failsafe: station heartbeat stopped"]


def velocity_setpoint(
    frame: int,
    mask: int,
    velocity: tuple[float, float, float],
    yaw: float = 0.0,
    yaw_rate: float = 0.0,
    *,
    other: float = 0.0,
) -> bytes:
    """A velocity set-point, with `other` in all fields of position and acceleration."""
    x = other
    message = dialect.MAVLink_set_position_target_local_ned_message
    return pack(message(0, 1, 1, frame, mask, x, x, x, *velocity, x, x, x, yaw, yaw_rate))


@pytest.mark.parametrize(("frame", "mask"), [(1, 0x9C7), (8, 0x5C7), (8, 0xFC7)], ids=["MAVSDK", "body", "MAVProxy"])
def test_a_double_integrator_takes_the_velocity_that_clients_send(frame: int, mask: int) -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    course = math.atan2(9.0, 40.0)
    for k in range(200):
        at = START + k * 50 * MS
        vehicle.step([(heartbeat(), at), (velocity_setpoint(frame, mask, (30.0, 0.0, 0.0)), at)], at)
    found = vehicle.craft.state_at(START + 10 * SECOND).velocity_ne_m_s()
    wanted = (30.0, 0.0) if frame == 1 else (30.0 * math.cos(course), 30.0 * math.sin(course))
    assert found == pytest.approx(wanted, abs=1e-3)


def hovering(kind: str) -> tuple[Shell[Copter], int]:
    """A copter at 10 m under velocity control."""
    vehicle = copter("px4" if kind == "px4" else "ardupilot")
    told = [arm(), command(22, 0, 0, 0, math.nan, math.nan, math.nan, 594.0)]
    if kind == "ardupilot":
        told = [mode(4), arm(), command(22, 0, 0, 0, 0, 0, 0, 10)]
    for k, data in enumerate(told):
        vehicle.step([(data, START + 5 * SECOND + k)], START + 5 * SECOND + k)
    now = START + 25 * SECOND
    vehicle.step([(velocity_setpoint(1, 0xDC7, (0.0, 0.0, 0.0)), now)], now)
    if kind == "px4":
        vehicle.step([(command(176, 1, 6), now)], now)
    assert (vehicle.craft.mode, vehicle.craft.motion.altitude_m) == (FLYING[kind], pytest.approx(10.0, abs=0.5))
    return vehicle, now


@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_only_ignored_fields_may_be_nan(kind: str) -> None:
    vehicle, now = hovering(kind)
    nan, at = math.nan, now
    for k in range(60):
        at = now + k * 50 * MS
        vehicle.step([(velocity_setpoint(1, 0xDC7, (2.0, 0.0, 0.0), nan, nan, other=nan), at)], at)
    assert vehicle.craft.motion.velocity_m_s.real == pytest.approx(2.0, abs=0.01)
    assert vehicle.counters["refused_absurd"] == 0
    bad = [((nan, 0.0, 0.0), 0.0, 0.0), ((2.0, 0.0, 0.0), nan, 0.0), ((2.0, 0.0, 0.0), 0.0, nan)]
    for velocity, yaw, rate in bad:
        vehicle.step([(velocity_setpoint(1, 0x1C7, velocity, yaw, rate), at)], at)
    assert vehicle.counters["refused_absurd"] == 3


@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_a_climb_shows_alike_in_all_reports(kind: str) -> None:
    vehicle, now = hovering(kind)
    for number in (30, 32, 33, 74):
        vehicle.step([(command(511, number, 20_000), now)], now)
    sent: list[tuple[Any, int]] = []
    for k in range(1, 40):
        at = now + k * 50 * MS
        sent = parse_all(vehicle.step([(velocity_setpoint(1, 0xDC7, (0.0, 0.0, -1.5)), at)], at))
    found = {m.get_type(): m for m, _ in sent}
    assert found["LOCAL_POSITION_NED"].vz == pytest.approx(-1.5, abs=0.01)
    assert found["GLOBAL_POSITION_INT"].vz == -150
    assert found["VFR_HUD"].climb == pytest.approx(1.5, abs=0.01)
    assert found["VFR_HUD"].alt == pytest.approx(found["GLOBAL_POSITION_INT"].alt * 1e-3, abs=0.05)


@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_a_copter_turns_to_the_commanded_yaw(kind: str) -> None:
    vehicle, now = hovering(kind)
    for k in range(100):
        at = now + k * 50 * MS
        vehicle.step([(velocity_setpoint(1, 0x9C7, (0.0, 0.0, 0.0), math.radians(-120.0)), at)], at)
    assert math.degrees(vehicle.craft.motion.yaw_rad) == pytest.approx(-120.0, abs=1e-4)  # a float32
    for k in range(100, 200):
        at = now + k * 50 * MS
        vehicle.step([(velocity_setpoint(8, 0xDC7, (2.0, 1.0, 0.0)), at)], at)
    forward, right = math.radians(-120.0), math.radians(-30.0)
    wanted = (2.0 * math.cos(forward) + math.cos(right), 2.0 * math.sin(forward) + math.sin(right))
    assert pair(vehicle.craft.motion.velocity_m_s) == pytest.approx(wanted, abs=1e-2)


@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_a_copter_returns_home_and_lands(kind: str) -> None:
    vehicle, now = hovering(kind)
    for k in range(50):
        at = now + k * 50 * MS
        vehicle.step([(velocity_setpoint(1, 0xDC7, (5.0, -5.0, 0.0)), at)], at)
    assert abs(vehicle.craft.motion.place_m - vehicle.craft.home_m) > 10.0
    assert acknowledged(sent_after(vehicle, command(20), 27.5, 27.5), 20) == ACCEPTED
    vehicle.step([], START + 90 * SECOND)
    assert (vehicle.craft.landed, vehicle.craft.armed) == (True, False)
    assert abs(vehicle.craft.motion.place_m - vehicle.craft.home_m) < 1.0


@pytest.mark.parametrize("kind", VEHICLES)
def test_commands_that_no_vehicle_has_are_unsupported(kind: str) -> None:
    vehicle = VEHICLES[kind]()
    for number in (519, 521, 252, 2000, 30000):
        assert acknowledged(sent_after(vehicle, command(number), 5.0, 5.0), number) == UNSUPPORTED


@given(
    data=st.binary(max_size=255),
    number=st.sampled_from([11, 40, 43, 44, 45, 51, 66, 110]),
    kind=st.sampled_from(list(VEHICLES)),
)
def test_no_payload_of_a_request_does_harm(data: bytes, number: int, kind: str) -> None:
    vehicle = VEHICLES[kind]()
    body = bytes([len(data), 0, 0, 0, *STATION, number, 0, 0]) + data
    crc = dialect.x25crc(body + bytes([dialect.mavlink_map[number].crc_extra])).crc
    now = START + 5 * SECOND
    vehicle.step([(b"\xfd" + body + crc.to_bytes(2, "little"), now), (heartbeat(), now)], now + SECOND // 10)
    assert vehicle.counters["heartbeats"] == 1
