"""The vehicles' boot clocks, and that samples are taken on their whole milliseconds."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenarios.schema import Clocks
from sim_vehicles.services.clock import BootClock
from sim_vehicles.vehicles.double_integrator import DoubleIntegrator
from tests.support.sim_client import (
    MS,
    SECOND,
    START,
    a_vehicle,
    command,
    guided,
    parse_all,
    scenario,
    shell_of,
    take_off,
)

times = st.integers(0, 10**15)
clocks = st.builds(BootClock, times, times, st.integers(-(10**7), 10**7))


@given(clocks, times)
def test_host_time_is_the_first_nanosecond_of_a_boot_time(clock: BootClock, boot_ns: int) -> None:
    host_ns = clock.host_ns(boot_ns)
    assert clock.boot_ns(host_ns) >= boot_ns
    assert clock.boot_ns(host_ns - 1) < boot_ns


def test_seed_and_system_id_draw_a_clock_within_its_bounds() -> None:
    bounds = Clocks(offset_max_s=50.0, drift_max_ppm=30.0)
    drawn = [BootClock.draw(bounds, seed, system_id, START) for seed in (1, 2) for system_id in range(1, 51)]
    assert len({(clock.offset_ns, clock.drift_ppb) for clock in drawn}) == 100
    assert all(0 <= clock.offset_ns <= 50 * SECOND and abs(clock.drift_ppb) <= 30_000 for clock in drawn)
    assert min(clock.drift_ppb for clock in drawn) < -20_000 < 20_000 < max(clock.drift_ppb for clock in drawn)
    assert BootClock.draw(bounds, 2, 7, START) in drawn
    assert BootClock.draw(bounds, 2, 7, START) == BootClock.draw(bounds, 2, 7, START)


def test_a_drifting_clock_gains_its_drift() -> None:
    clock = BootClock(start_ns=START, offset_ns=7, drift_ppb=20_000)
    assert clock.boot_ns(START) == 7
    assert clock.boot_ns(START + 1000 * SECOND) == 7 + 1000 * SECOND + 20 * MS


def test_positions_are_sampled_exactly_on_the_millisecond_they_name() -> None:
    vehicle = a_vehicle(seed=3, drift_max_ppm=1000.0)
    take_off(vehicle)
    start = vehicle.craft.state_at(START)
    vehicle.step([(command(511, 32, 20_000), START)], START)
    sent: list[tuple[bytes, int]] = []
    now = START
    for step in (3_141_592, 27_000_001, 111, 19_999_999, 450_000_000):  # late and irregular, as a real loop is
        now += step
        sent += vehicle.step([], now)
    positions = parse_all(sent, "LOCAL_POSITION_NED")
    assert len(positions) in (24, 25)  # 0.5 s at 50 Hz of a clock that is up to 0.1 % off
    for message, time_ns in positions:
        assert 0 <= vehicle.radio.clock.boot_ns(time_ns) - message.time_boot_ms * MS <= 1
        flown_s = (time_ns - START) / SECOND
        assert message.x == pytest.approx(start.north_m + 40.0 * flown_s, abs=1e-5)  # float32 of some 20 m
        assert message.vy == pytest.approx(9.0, abs=1e-6)
        assert message.z == -100.0


@pytest.mark.parametrize("interval_us", [1000, 2000, 16_667, 20_000, 333_333])
def test_positions_come_at_the_requested_rate_whatever_the_period(interval_us: int) -> None:
    vehicle = a_vehicle(drift_max_ppm=0.0)
    sent = vehicle.step([(command(511, 32, interval_us), START)], START + 20 * SECOND)
    stamps = [message.time_boot_ms for message, _ in parse_all(sent, "LOCAL_POSITION_NED")]
    assert abs(len(stamps) - 20_000_000 / interval_us) <= 1
    gaps = {after - before for before, after in pairwise(stamps)}
    assert gaps <= {interval_us // 1000, -(-interval_us // 1000)}


def test_asking_for_the_same_rate_again_moves_no_sample() -> None:
    once, twice = a_vehicle(), a_vehicle()
    request = command(511, 32, 20_000)
    sent_once = once.step([(request, START)], START + SECOND)
    sent_twice = twice.step([(request, START), (request, START + 333 * MS)], START + SECOND)
    assert [t for _, t in parse_all(sent_once, "LOCAL_POSITION_NED")] == [
        t for _, t in parse_all(sent_twice, "LOCAL_POSITION_NED")
    ]


def test_two_vehicles_do_not_share_a_clock() -> None:
    first, second = (shell_of(scenario(2), DoubleIntegrator, k) for k in (0, 1))
    assert first.radio.clock.boot_ns(START) != second.radio.clock.boot_ns(START)
    assert first.radio.clock.drift_ppb != second.radio.clock.drift_ppb


def test_unasked_it_sends_a_heartbeat_at_once_and_then_slowly() -> None:
    vehicle = a_vehicle(drift_max_ppm=0.0)
    sent = vehicle.step([(guided(), START)], START + 20 * SECOND)
    heartbeats = parse_all(sent, "HEARTBEAT")
    assert heartbeats[0][1] - START < MS
    assert len(heartbeats) == 21
    assert len(parse_all(sent, "LOCAL_POSITION_NED")) == 80
    assert len(parse_all(sent, "GLOBAL_POSITION_INT")) == 20
    assert len(parse_all(sent, "TIMESYNC")) == 2
    assert [m.get_seq() for m, _ in parse_all(sent)] == [k % 256 for k in range(len(sent))]
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m, _ in parse_all(sent)} == {(1, 1)}
    assert vehicle.next_event_ns > START + 20 * SECOND
