"""TIMESYNC: offsets and round trips of vehicles whose clocks are offset, drift and jump, at any RTT."""

import numpy as np
import pytest

from gcs.clocks import LEAST_SAMPLES, VehicleClock

MS = 1_000_000
S = 1000 * MS


class Exchange:
    """Truth: a vehicle clock with offset and drift behind a link with given one-way delays."""

    def __init__(self, *, offset_ns: int, drift: float) -> None:
        self.clock = VehicleClock()
        self.offset_ns = offset_ns
        self.drift = drift

    def boot_ns(self, time_ns: int) -> int:
        return time_ns + self.offset_ns + round(self.drift * time_ns)

    def at(self, time_ns: int, *, down_ns: int, up_ns: int) -> int | None:
        ts1 = self.clock.request(time_ns)
        tc1 = self.boot_ns(time_ns + down_ns)
        return self.clock.reply(tc1_ns=tc1, ts1_ns=ts1, received_ns=time_ns + down_ns + up_ns)

    def error_ns(self, time_ns: int) -> int:
        return self.clock.estimate.to_station_ns(self.boot_ns(time_ns)) - time_ns


@pytest.mark.parametrize("one_way_ms", [0, 1, 20, 400, 2500])
def test_clock_is_known_within_a_microsecond_at_any_symmetric_rtt(one_way_ms: int) -> None:
    truth = Exchange(offset_ns=-3600 * S, drift=40e-6)
    delay = one_way_ms * MS
    for k in range(100):
        assert truth.at(k * S // 10, down_ns=delay, up_ns=delay) == 2 * delay
    assert abs(truth.error_ns(10 * S)) < 1000  # ns; rounding of a line through ns readings
    assert truth.clock.down_ns == pytest.approx(delay, abs=1000)


@pytest.mark.parametrize("up_ms", [0, 5, 80])
def test_error_of_an_asymmetric_link_is_half_the_asymmetry_and_within_the_bound(up_ms: int) -> None:
    truth = Exchange(offset_ns=5 * S, drift=0.0)
    for k in range(20):
        truth.at(k * S // 10, down_ns=20 * MS, up_ns=up_ms * MS)
    error = truth.error_ns(2 * S)
    assert error == pytest.approx((up_ms - 20) * MS / 2, abs=2)
    assert abs(error) <= truth.clock.estimate.bound_ns


def test_jitter_of_one_direction_hardly_moves_the_estimate() -> None:
    rng = np.random.default_rng(7)
    truth = Exchange(offset_ns=S, drift=20e-6)
    for k in range(120):
        truth.at(k * S // 10, down_ns=20 * MS, up_ns=20 * MS + int(rng.exponential(10 * MS)))
    # The unweighted mean would be off by half the mean jitter, 5 ms.
    assert abs(truth.error_ns(12 * S)) < MS // 2


def test_drift_is_followed_between_exchanges() -> None:
    truth = Exchange(offset_ns=0, drift=100e-6)
    for k in range(100):
        truth.at(k * S // 10, down_ns=MS, up_ns=MS)
    # 5 s later a clock taken as drift-free would be wrong by 500 µs.
    assert abs(truth.error_ns(15 * S)) < 5000


def test_clock_jump_is_detected_and_the_new_clock_learnt() -> None:
    truth = Exchange(offset_ns=0, drift=0.0)
    for k in range(50):
        truth.at(k * S // 10, down_ns=20 * MS, up_ns=20 * MS)
    truth.offset_ns = 200 * MS
    for k in range(50, 60):
        truth.at(k * S // 10, down_ns=20 * MS, up_ns=20 * MS)
    assert truth.clock.jumps == 1
    assert truth.clock.estimate.samples == 10
    assert abs(truth.error_ns(6 * S)) < 1000


def test_jitter_alone_is_never_taken_for_a_jump() -> None:
    rng = np.random.default_rng(3)
    truth = Exchange(offset_ns=0, drift=50e-6)
    for k in range(500):
        truth.at(k * S // 10, down_ns=int(rng.uniform(0, 300)) * MS, up_ns=int(rng.uniform(0, 300)) * MS)
    assert truth.clock.jumps == 0


def test_reply_to_nothing_asked_is_refused() -> None:
    clock = VehicleClock()
    ts1 = clock.request(100)
    assert clock.reply(tc1_ns=5, ts1_ns=ts1 + 1, received_ns=200) is None
    assert clock.reply(tc1_ns=5, ts1_ns=ts1, received_ns=200) == 100
    assert clock.reply(tc1_ns=5, ts1_ns=ts1, received_ns=300) is None  # the same reply again
    assert clock.unmatched == 2
    assert clock.estimate.samples == 1 < LEAST_SAMPLES
