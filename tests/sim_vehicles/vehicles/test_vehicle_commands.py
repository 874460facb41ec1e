"""What a station can ask of a vehicle and what it answers, seen by plain pymavlink."""

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_vehicles.vehicles.double_integrator import DoubleIntegrator
from sim_vehicles.vehicles.shell import Shell
from tests.support.sim_client import (
    MS,
    SECOND,
    START,
    a_vehicle,
    arm,
    command,
    guided,
    mode,
    pack,
    parse_all,
    setpoint,
    take_off,
)


def answers(vehicle: Shell[DoubleIntegrator], request: bytes, time_ns: int = START) -> list[Any]:
    """What a vehicle sends at the instant of a request."""
    return [m for m, t in parse_all(vehicle.step([(request, time_ns)], time_ns)) if t == time_ns]


def result(vehicle: Shell[DoubleIntegrator], request: bytes, time_ns: int = START) -> int:
    """The result of a command, acknowledged to its sender."""
    (ack,) = [m for m in answers(vehicle, request, time_ns) if m.get_type() == "COMMAND_ACK"]
    assert (ack.target_system, ack.target_component) == (255, 190)
    assert ack.command == dialect.MAVLink(None).parse_buffer(request)[0].command  # type: ignore[index]
    return ack.result


def last_heartbeat(vehicle: Shell[DoubleIntegrator], now_ns: int) -> Any:
    return parse_all(vehicle.step([], now_ns + SECOND), "HEARTBEAT")[-1][0]


def test_it_presents_itself_as_a_disarmed_copter() -> None:
    heartbeat = last_heartbeat(a_vehicle(), START)
    assert heartbeat.type == dialect.MAV_TYPE_QUADROTOR
    assert heartbeat.autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
    assert heartbeat.base_mode == dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    assert heartbeat.custom_mode == 0
    assert heartbeat.system_status == dialect.MAV_STATE_STANDBY


def test_the_heartbeat_shows_arming_guided_and_flight() -> None:
    vehicle = a_vehicle()
    assert result(vehicle, guided()) == dialect.MAV_RESULT_ACCEPTED
    assert result(vehicle, arm()) == dialect.MAV_RESULT_ACCEPTED
    heartbeat = last_heartbeat(vehicle, START)
    assert heartbeat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED
    assert heartbeat.custom_mode == 4
    assert heartbeat.system_status == dialect.MAV_STATE_STANDBY
    vehicle.step([(setpoint(), START + 2 * SECOND)], START + 2 * SECOND)
    assert last_heartbeat(vehicle, START + 2 * SECOND).system_status == dialect.MAV_STATE_ACTIVE
    assert [change.text for change in vehicle.changes][:3] == ["GUIDED", "armed", "flying"]


def test_the_launcher_holds_it_until_armed_guided_and_commanded() -> None:
    vehicle = a_vehicle()
    start = vehicle.craft.state_at(START)
    vehicle.step([(setpoint(1.0), START)], START)
    vehicle.step([(arm(), START), (setpoint(1.0), START)], START)
    assert vehicle.counters["ignored_not_armed"] == 1
    assert vehicle.counters["ignored_not_guided"] == 1
    sent = vehicle.step([(guided(), START)], START + 10 * SECOND)
    assert vehicle.craft.state_at(START + 10 * SECOND) == start
    position = parse_all(sent, "LOCAL_POSITION_NED")[-1][0]
    assert (position.x, position.y) == (0.0, 10.0)
    assert (position.vx, position.vy) == pytest.approx((40.0, 9.0))
    vehicle.step([(setpoint(2.0), START + 10 * SECOND)], START + 10 * SECOND)
    state = vehicle.craft.state_at(START + 11 * SECOND)
    assert state[:2] == pytest.approx((41.0, 19.0))


def test_it_disarms_on_the_launcher_but_not_in_flight() -> None:
    vehicle = a_vehicle()
    assert result(vehicle, arm()) == dialect.MAV_RESULT_ACCEPTED
    assert result(vehicle, command(400, 0)) == dialect.MAV_RESULT_ACCEPTED
    assert not vehicle.craft.flight.armed
    take_off(vehicle)
    assert result(vehicle, command(400, 0)) == dialect.MAV_RESULT_DENIED
    assert result(vehicle, command(400, 0, 21196)) == dialect.MAV_RESULT_DENIED  # forced
    assert vehicle.craft.flight.armed


@pytest.mark.parametrize("hold", [5, 17], ids=["LOITER", "BRAKE"])
def test_a_commanded_hold_flies_straight_on_and_is_no_failsafe(hold: int) -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    vehicle.step([(setpoint(2.0, 1.0), START)], START)
    assert result(vehicle, mode(hold), START + SECOND // 2) == dialect.MAV_RESULT_ACCEPTED
    vehicle.step([(setpoint(9.0), START + SECOND // 2)], START + SECOND // 2)
    assert vehicle.counters["ignored_not_guided"] == 1
    heartbeat = last_heartbeat(vehicle, START + SECOND)
    assert (heartbeat.custom_mode, heartbeat.system_status) == (hold, dialect.MAV_STATE_ACTIVE)
    assert vehicle.craft.state_at(START + 2 * SECOND).velocity_ne_m_s() == pytest.approx((41.0, 9.5))


@pytest.mark.parametrize("wish", [command(21), command(20), mode(9), mode(6)], ids=["21", "20", "LAND", "RTL"])
def test_landing_and_return_are_refused_with_a_text(wish: bytes) -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    ack, told = answers(vehicle, wish, START + SECOND // 2)
    assert (ack.get_type(), ack.result) == ("COMMAND_ACK", dialect.MAV_RESULT_DENIED)
    assert (told.severity, told.text.split(",")[0]) == (dialect.MAV_SEVERITY_CRITICAL, "cannot land or return")
    assert vehicle.craft.flight.mode == 4


DENIED, UNSUPPORTED = dialect.MAV_RESULT_DENIED, dialect.MAV_RESULT_UNSUPPORTED
IMPOSSIBLE = {
    "neither arm nor disarm": (command(400, 2), DENIED),
    "arm with NaN": (command(400, math.nan), DENIED),
    "unknown mode": (mode(16), DENIED),
    "mode without the flag for custom modes": (command(176, 0, 4), DENIED),
    "mode with infinity and NaN": (command(176, math.inf, math.nan), DENIED),
    "interval NaN": (command(511, 32, math.nan), DENIED),
    "interval below a millisecond": (command(511, 32, 999), DENIED),
    "interval beyond 32 bits": (command(511, 32, 1e30), DENIED),
    "interval of a message it has not": (command(511, 27, 20_000), DENIED),
    "request of a message it has not": (command(512, 27), DENIED),
    "request of message infinity": (command(512, math.inf), DENIED),
    "take-off before it is armed": (command(22, 0, 0, 0, 0, 0, 0, 10), DENIED),
    "no command at all": (command(65535), UNSUPPORTED),
}


@pytest.mark.parametrize(("request_frame", "wanted"), IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_what_it_cannot_do_is_answered_and_changes_nothing(request_frame: bytes, wanted: int) -> None:
    vehicle, untouched = a_vehicle(), a_vehicle()
    assert result(vehicle, request_frame) == wanted
    later = START + 3 * SECOND
    sent = [(t, data[7:10]) for data, t in vehicle.step([], later)]
    assert sent == [(t, data[7:10]) for data, t in untouched.step([], later)]


def test_rates_can_be_changed_stopped_and_reset() -> None:
    vehicle = a_vehicle(drift_max_ppm=0.0)

    def count_after(interval_us: float, begin_s: int) -> int:
        begin = START + begin_s * SECOND
        assert result(vehicle, command(511, 32, interval_us), begin) == dialect.MAV_RESULT_ACCEPTED
        return len(parse_all(vehicle.step([], begin + SECOND), "LOCAL_POSITION_NED"))

    assert count_after(10_000, 0) == 100
    assert count_after(-1, 2) == 0
    assert count_after(0, 4) == 4  # the default


def test_single_messages_come_on_request() -> None:
    vehicle = a_vehicle()
    ack, version = answers(vehicle, command(512, 148))
    assert (ack.get_type(), version.get_type()) == ("COMMAND_ACK", "AUTOPILOT_VERSION")
    assert version.capabilities & dialect.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    assert result(vehicle, command(512, 242)) == dialect.MAV_RESULT_ACCEPTED
    ((home, _),) = parse_all(vehicle.step([], START + 2 * MS), "HOME_POSITION")
    assert (home.latitude, home.longitude) == (-353632620, 1491652370)
    _, interval = answers(vehicle, command(512, 244, 32))
    assert (interval.message_id, interval.interval_us) == (32, 250_000)
    vehicle.step([(command(511, 32, -1), START), (command(511, 33, -1), START)], START)
    sent = vehicle.step([(command(512, 32), START), (command(512, 33), START)], START + 100 * MS)
    ((local, time_ns),) = parse_all(sent, "LOCAL_POSITION_NED")
    assert 0 <= vehicle.radio.clock.boot_ns(time_ns) - local.time_boot_ms * MS <= 1
    ((earth, _),) = parse_all(sent, "GLOBAL_POSITION_INT")
    assert earth.lat == -353632620
    assert earth.lon == 1491652370 + round(math.degrees(10.0 / (6378137.0 * math.cos(math.radians(35.363262)))) * 1e7)
    assert (earth.relative_alt, earth.alt) == (100_000, 684_000)
    assert (earth.vx, earth.vy, earth.hdg) == (4000, 900, round(math.degrees(math.atan2(9, 40)) * 100))


def test_command_int_is_answered_like_command_long() -> None:
    vehicle = a_vehicle()
    request = pack(dialect.MAVLink_command_int_message(1, 1, 0, 400, 0, 0, 1, 0, 0, 0, 0, 0, 0))
    assert result(vehicle, request) == dialect.MAV_RESULT_ACCEPTED
    assert vehicle.craft.flight.armed


def test_timesync_replies_carry_the_clock_at_arrival() -> None:
    vehicle = a_vehicle()
    arrival = START + 123_456_789
    request = pack(dialect.MAVLink_timesync_message(0, -987654321))
    ((reply, sent_ns),) = [
        (m, t) for m, t in parse_all(vehicle.step([(request, arrival)], START + SECOND)) if m.get_type() == "TIMESYNC"
    ]
    assert (reply.tc1, reply.ts1) == (vehicle.radio.clock.boot_ns(arrival), -987654321)
    assert sent_ns == arrival


def test_its_own_timesync_request_is_matched_by_the_exact_stamp() -> None:
    vehicle = a_vehicle()
    ((request, sent_ns),) = parse_all(vehicle.step([], START + 10 * SECOND), "TIMESYNC")
    assert (request.tc1, request.ts1) == (0, vehicle.radio.clock.boot_ns(sent_ns))
    replies = [pack(dialect.MAVLink_timesync_message(42, request.ts1 + error)) for error in (1, 0)]
    assert parse_all(vehicle.step([(r, START + 10 * SECOND) for r in replies], START + 10 * SECOND), "TIMESYNC") == []
    assert vehicle.counters["timesync_replies"] == 1
    assert vehicle.counters["ignored_timesync_reply"] == 1


def test_a_set_point_acts_from_the_instant_it_arrives() -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    vehicle.step([(setpoint(2.0), START + 100 * MS), (setpoint(0.0, -1.0), START + 250 * MS)], START + SECOND // 2)
    state = vehicle.craft.state_at(START + SECOND // 2)
    assert state.velocity_ne_m_s() == pytest.approx((40.0 + 2.0 * 0.15, 9.0 - 1.0 * 0.25))
    assert state.north_m == pytest.approx(40.0 * 0.5 + 0.5 * 2.0 * 0.15**2 + 0.3 * 0.25)


def test_velocity_and_acceleration_together_are_feed_forward_and_feedback() -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    vehicle.step([(setpoint(1.0, 0.0, velocity=(45.0, 9.0), mask=0x0C07), START)], START)
    # v' = 1 + 2 (45 - v): settles at 45.5 with a time constant of 0.5 s
    expected = 45.5 - 5.5 * math.exp(-2.0 * 0.5)
    assert vehicle.craft.state_at(START + SECOND // 2).velocity_ne_m_s() == pytest.approx((expected, 9.0), abs=1e-6)


def test_a_late_set_point_never_changes_the_past() -> None:
    """A kernel stamp can lie a little before a state that has already been reported."""
    vehicle = a_vehicle()
    take_off(vehicle)
    vehicle.step([(command(511, 32, 20_000), START)], START)
    position, sampled_ns = parse_all(vehicle.step([], START + 200 * MS), "LOCAL_POSITION_NED")[-1]
    vehicle.step([(setpoint(3.0), sampled_ns - 50 * MS)], START + 200 * MS)
    at_sample, later = vehicle.craft.state_at(sampled_ns), vehicle.craft.state_at(sampled_ns + 100 * MS)
    assert at_sample.north_m == pytest.approx(position.x, abs=1e-5)
    assert at_sample.velocity_ne_m_s()[0] == pytest.approx(40.0)
    assert later.velocity_ne_m_s()[0] == pytest.approx(40.3)


def test_it_cannot_be_put_back_on_the_launcher_in_flight() -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    assert result(vehicle, mode(0)) == dialect.MAV_RESULT_DENIED
    assert vehicle.craft.flight.mode == 4
