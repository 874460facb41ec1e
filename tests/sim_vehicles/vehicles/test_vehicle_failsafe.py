"""The vehicle helps itself when the station goes silent: when exactly, how, and until when."""

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
    guided,
    heartbeat,
    mode,
    parse_all,
    setpoint,
    take_off,
)


def texts(sent: list[tuple[bytes, int]]) -> list[tuple[str, int]]:
    return [(m.text, t) for m, t in parse_all(sent, "STATUSTEXT")]


def shown(sent: list[tuple[bytes, int]]) -> Any:
    """(custom_mode, system_status) of the last heartbeat."""
    last = parse_all(sent, "HEARTBEAT")[-1][0]
    return last.custom_mode, last.system_status


def stream_setpoints(vehicle: Shell[DoubleIntegrator], begin_ns: int, end_ns: int) -> list[tuple[bytes, int]]:
    """Set-points at 10 Hz without any heartbeat."""
    frames = [(setpoint(), t) for t in range(begin_ns, end_ns, 100 * MS)]
    return vehicle.step(frames, end_ns)


@pytest.mark.parametrize("late_ns", [0, 1, 777 * MS])
def test_without_set_points_it_holds_at_the_exact_instant(late_ns: int) -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    vehicle.step([(setpoint(2.0, 1.0), START + 300 * MS)], START + 300 * MS)
    deadline = START + 1300 * MS
    assert not texts(vehicle.step([], deadline - 1))
    assert vehicle.next_event_ns <= deadline
    sent = vehicle.step([], deadline + late_ns)
    assert texts(sent) == [("failsafe: set-points stopped", deadline)]
    state = vehicle.craft.state_at(deadline + SECOND)
    assert state.velocity_ne_m_s() == pytest.approx((42.0, 10.0))
    assert shown(vehicle.step([], deadline + 2 * SECOND)) == (5, dialect.MAV_STATE_CRITICAL)


def test_a_set_point_on_the_deadline_is_still_in_time() -> None:
    for late_ns, in_failsafe in ((0, False), (1, True)):
        vehicle = a_vehicle()
        take_off(vehicle)
        arrival = START + SECOND + late_ns
        vehicle.step([(setpoint(), arrival)], arrival)
        assert bool(vehicle.craft.flight.failsafe) is in_failsafe
        assert vehicle.counters["ignored_in_failsafe"] == int(in_failsafe)


def test_without_heartbeats_it_holds_despite_set_points() -> None:
    vehicle = a_vehicle()
    vehicle.step([(heartbeat(), START)], START)
    take_off(vehicle)
    vehicle.step([(heartbeat(), START + 50 * MS)], START + 50 * MS)
    sent = stream_setpoints(vehicle, START + 60 * MS, START + 4 * SECOND)
    assert texts(sent) == [("failsafe: station heartbeat stopped", START + 3050 * MS)]
    assert vehicle.counters["ignored_in_failsafe"] == 10


def test_only_a_stations_heartbeat_counts() -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    vehicle.step([(heartbeat(dialect.MAV_TYPE_QUADROTOR), START + SECOND // 2)], START + SECOND // 2)
    sent = stream_setpoints(vehicle, START + SECOND // 2, START + 4 * SECOND)
    assert texts(sent) == [("failsafe: station heartbeat stopped", START + 3 * SECOND)]


def test_a_silent_stations_time_starts_with_the_flight() -> None:
    vehicle = a_vehicle()
    vehicle.step([(heartbeat(), START)], START + 100 * SECOND)
    take_off(vehicle, START + 100 * SECOND)
    sent = stream_setpoints(vehicle, START + 100 * SECOND, START + 104 * SECOND)
    assert texts(sent) == [("failsafe: station heartbeat stopped", START + 103 * SECOND)]


def test_on_the_launcher_there_is_no_failsafe() -> None:
    vehicle = a_vehicle()
    sent = vehicle.step([(heartbeat(), START), (guided(), START)], START + 100 * SECOND)
    assert texts(sent) == []
    assert shown(sent) == (4, dialect.MAV_STATE_STANDBY)


def test_a_commanded_hold_needs_heartbeats_not_set_points() -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    sent = vehicle.step([(mode(5), START + SECOND // 2)], START + 5 * SECOND)
    assert texts(sent) == [("failsafe: station heartbeat stopped", START + 3500 * MS)]


def test_in_failsafe_it_ignores_set_points_until_guided_again() -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    now = START + 2 * SECOND
    vehicle.step([(heartbeat(), now), (setpoint(5.0), now)], now)
    assert vehicle.counters["ignored_in_failsafe"] == 1
    assert vehicle.craft.state_at(now + SECOND).velocity_ne_m_s() == pytest.approx((40.0, 9.0))
    vehicle.step([(guided(), now)], now)
    vehicle.step([(setpoint(5.0), now + 900 * MS)], now + 900 * MS)
    assert vehicle.counters["ignored_in_failsafe"] == 1
    sent = vehicle.step([], now + 1890 * MS)
    assert shown(sent) == (4, dialect.MAV_STATE_ACTIVE)
    assert vehicle.craft.state_at(now + 1890 * MS).velocity_ne_m_s() == pytest.approx((40.0 + 5.0 * 0.99, 9.0))
    assert [change.text for change in vehicle.changes][-2:] == ["failsafe: set-points stopped", "GUIDED, failsafe over"]


def test_after_the_failsafe_the_set_point_timer_begins_anew() -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    again = START + 2 * SECOND
    sent = vehicle.step([(guided(), again)], again + 3 * SECOND)
    assert texts(sent)[-1] == ("failsafe: set-points stopped", again + SECOND)


def test_commanding_hold_in_failsafe_makes_it_a_normal_hold() -> None:
    vehicle = a_vehicle()
    take_off(vehicle)
    vehicle.step([], START + 2 * SECOND)
    sent = vehicle.step([(mode(5), START + 2 * SECOND)], START + 3500 * MS)
    assert shown(sent) == (5, dialect.MAV_STATE_ACTIVE)
