"""What every kind of simulated vehicle does alike on its link."""

from collections.abc import Callable

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_vehicles.services import frames, mavlink
from sim_vehicles.vehicles.shell import Craft, Shell
from tests.support.fleets.vehicle_kinds import VEHICLES
from tests.support.sim_client import SECOND, START, a_vehicle, arm, command, guided, heartbeat, pack, parse_all

MONITOR = dialect.MAVLink(None, srcSystem=254, srcComponent=190)
every_kind = pytest.mark.parametrize("make", VEHICLES.values(), ids=VEHICLES)
Make = Callable[[], Shell[Craft]]


def own_request(vehicle: Shell[Craft]) -> int:
    """The ts1 of the vehicle's own TIMESYNC request, once it has sent one."""
    sent = parse_all(vehicle.step([], START + 30 * SECOND), "TIMESYNC")
    return next(message.ts1 for message, _ in reversed(sent) if message.tc1 == 0)


@every_kind
def test_a_watching_system_is_not_the_station(make: Make) -> None:
    """`gcs monitor` asks and answers TIMESYNC. If that counted as the station's voice, vehicles would never end."""
    vehicle = make()
    vehicle.step([(heartbeat(), START + SECOND)], START + SECOND)
    reply = dialect.MAVLink_timesync_message(tc1=7, ts1=own_request(vehicle)).pack(MONITOR)
    request = dialect.MAVLink_timesync_message(tc1=0, ts1=5).pack(MONITOR)
    vehicle.step([(request, START + 30 * SECOND), (reply, START + 30 * SECOND)], START + 30 * SECOND)
    assert vehicle.counters["timesync_requests"] == 1
    assert vehicle.counters["timesync_replies"] == 1
    assert vehicle.authority.commanded_ns == 0


@every_kind
def test_only_obeyed_changes_count_as_commands(make: Make) -> None:
    vehicle = make()
    vehicle.step([(arm(), START + SECOND)], START + SECOND)
    assert vehicle.authority.commanded_ns == START + SECOND
    for data in (heartbeat(), heartbeat(dialect.MAV_TYPE_QUADROTOR), arm(system=9), command(400, 1, component=9)):
        vehicle.step([(data, START + 5 * SECOND)], START + 5 * SECOND)
        assert vehicle.authority.commanded_ns == START + SECOND
    assert (vehicle.counters["ignored_heartbeat"], vehicle.counters["ignored_not_addressed"]) == (1, 2)


@every_kind
def test_heartbeats_of_other_stations_are_counted(make: Make) -> None:
    vehicle = make()
    vehicle.step([(arm(), START + SECOND)], START + SECOND)
    other = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_GCS, 8, 0, 0, 4, 3).pack(MONITOR)
    vehicle.step([(other, START + 2 * SECOND)], START + 2 * SECOND)
    assert (vehicle.counters["heartbeats"], vehicle.counters["ignored_not_the_station"]) == (0, 1)
    assert vehicle.authority.commanded_ns == START + SECOND


@every_kind
def test_frames_are_numbered_in_the_order_sent(make: Make) -> None:
    """The ACK of a command comes before the message or text that it causes, so that no frame seems overtaken."""
    vehicle = make()
    asked = [
        arm(),
        command(512, 148),
        command(520, 1),
        command(510, 32),
        command(21),
        command(22, 0, 0, 0, 0, 0, 0, 20),
    ]
    asked += [arm(), guided(), pack(dialect.MAVLink_set_mode_message(1, 1, 9)), command(400, 0), command(176, 1, 6)]
    sent: list[tuple[bytes, int]] = []
    for k, data in enumerate(asked, start=1):
        sent += vehicle.step([(data, START + k * SECOND)], START + k * SECOND)
    kinds = [message.get_type() for message, _ in parse_all(sent)]
    assert kinds.count("COMMAND_ACK") == len(asked) - 1  # SET_MODE has none
    assert "AUTOPILOT_VERSION" in kinds
    assert "STATUSTEXT" in kinds
    numbers = [data[4] for data, _ in sent if data[0] == 0xFD]
    assert numbers == [(numbers[0] + k) % 256 for k in range(len(numbers))]


def test_a_level_vehicle_sends_no_byte_of_its_vertical_velocity() -> None:
    """Trailing zeros are omitted; a velocity of -0.0 would not be, and a slow radio would carry fewer vehicles."""
    sent = a_vehicle().step([(command(511, 32, 100_000), START + SECOND)], START + 3 * SECOND)
    positions = [frame for frame, _ in sent if mavlink.message_id(frame) == frames.LOCAL_POSITION]
    assert len(positions) > 10
    assert max(frame[1] for frame in positions) <= dialect.MAVLink_local_position_ned_message.unpacker.size - 4
