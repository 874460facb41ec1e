"""Set-points that a vehicle holds until a fixed time after their stamps."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from scenarios.keys.part import HELD_SHARE
from scenarios.schema import Clocks
from sim_vehicles.services.clock import NEVER_NS, BootClock
from sim_vehicles.services.mavlink import Setpoint
from sim_vehicles.vehicles.hold import Hold
from tests.support.sim_client import MS, SECOND, START

CLOCK = BootClock.draw(Clocks(), seed=3, system_id=1, start_ns=START)
PERIOD_MS = 20


def stamped(key_ms: int) -> Setpoint:
    return Setpoint(key_ms, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.0, 0.0, 0x0C3F, 1, 1, 1)


def played(delays_ms: list[float]) -> tuple[Hold, list[tuple[int, float]], list[int]]:
    """Play set-points 20 ms apart with these delays: the hold, (key, ms from stamp to action), and the late keys."""
    hold, acted, late = Hold(), list[tuple[int, float]](), list[int]()

    def let_act(until_ns: int) -> None:
        while hold.next_ns <= until_ns:
            at_ns, key_ms = hold.next_ns, hold.pop().time_boot_ms
            acted.append((key_ms, (at_ns - START) / MS - key_ms))

    arrivals = sorted((round((k * PERIOD_MS + own) * MS), k * PERIOD_MS) for k, own in enumerate(delays_ms))
    for arrival_ns, key_ms in arrivals:
        let_act(START + arrival_ns)
        if not hold.take(stamped(key_ms), START + arrival_ns, CLOCK):
            late.append(key_ms)
            acted.append((key_ms, arrival_ns / MS - key_ms))
    let_act(START + arrivals[-1][0] + 10 * SECOND)
    assert hold.next_ns == NEVER_NS
    return hold, acted, late


def test_jitter_becomes_constant_delay() -> None:
    delays_ms = np.random.default_rng(1).uniform(20.0, 80.0, 2000).tolist()
    _, acted, late = played(delays_ms)
    lateness_ms = np.array([own for key, own in acted[1000:] if key not in late])
    assert np.ptp(lateness_ms) < 3.0  # the lag is a percentile of the last 500, in whole ms
    assert abs(np.median(lateness_ms) - np.percentile(delays_ms, 100 * HELD_SHARE)) < 2.0
    assert 0 < len([key for key in late if key > 1000 * PERIOD_MS]) < 25  # 1 % of the last thousand, twice at most


def test_set_points_that_overtook_each_other_act_in_order() -> None:
    delays_ms = [5.0, 60.0] * 300
    keys = [key for key, _ in played(delays_ms)[1]]
    assert keys[20:] == sorted(keys[20:])


@given(st.lists(st.floats(0.0, 400.0), min_size=1, max_size=60))
def test_every_set_point_acts_once_and_never_before_it_arrives(delays_ms: list[float]) -> None:
    _, acted, _ = played(delays_ms)
    assert sorted(key for key, _ in acted) == [k * PERIOD_MS for k in range(len(delays_ms))]
    assert all(own >= delays_ms[key // PERIOD_MS] - 1e-3 for key, own in acted)


def test_stamps_of_another_station_begin_anew() -> None:
    """The next station's stamps are 100 s ahead: by the previous lag, its set-points would be held that long."""
    hold = Hold()
    hold.take(stamped(1000), START + SECOND, CLOCK)
    hold.take(stamped(101_020), START + SECOND + 20 * MS, CLOCK)
    assert hold.pop().time_boot_ms == 1000
    assert hold.next_ns <= START + SECOND + 22 * MS
