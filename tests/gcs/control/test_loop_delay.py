"""Loop delay and headroom: the definition, its unknowns, repetitions, and the error that a clock leaves in it."""

from math import inf, isnan, nan

import numpy as np
import pytest

from gcs.control.loop_delay import headroom, longest_repetition_ns, loop_delay_s, repeated_s
from gcs.link.clocks import LEAST_SAMPLES, VehicleClock, bound_at_ns
from scenarios.schema import Rates

S, MS = 1_000_000_000, 1_000_000


def test_loop_delay_is_state_age_plus_down_delay_less_repetition() -> None:
    assert loop_delay_s(10 * S, 10 * S + 50 * MS, 0.03, 0.01) == pytest.approx(0.07, abs=1e-12)


@pytest.mark.parametrize(("used_ns", "down_s"), [(0, 0.03), (10 * S, nan)])
def test_loop_delay_is_unknown_while_either_part_is(used_ns: int, down_s: float) -> None:
    assert isnan(loop_delay_s(used_ns, 11 * S, down_s))


def test_headroom_is_what_is_left_of_the_margin() -> None:
    assert headroom(0.1, 0.4) == pytest.approx(0.75)
    assert headroom(0.1, inf) == 1.0
    assert headroom(0.1, 0.0) == -inf
    assert isnan(headroom(nan, 0.4))


def test_repetitions_count_only_as_far_as_the_telemetry_rate_explains() -> None:
    longest_ns, known_ns = longest_repetition_ns(Rates(control_hz=50.0, telemetry_hz=10.0)), np.zeros((2, 2), np.int64)
    used_ns = np.array([6 * S, 7 * S])
    ages_s = [repeated_s(known_ns, longest_ns, used_ns, 8 * S + k * 20 * MS)[1] for k in range(8)]
    assert ages_s == pytest.approx([0.0, 0.02, 0.04, 0.06, 0.08, 0.08, 0.08, 0.08])
    newer_ns = np.array([6 * S, 7 * S + 100 * MS])
    assert repeated_s(known_ns, longest_ns, newer_ns, 9 * S).tolist() == [0.08, 0.0]
    longest_ns = longest_repetition_ns(Rates(control_hz=50.0, telemetry_hz=50.0))
    assert repeated_s(known_ns, longest_ns, used_ns, 10 * S).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(("up_ms", "down_ms"), [(10, 110), (110, 10), (60, 60)])
def test_the_error_of_the_clock_cancels_however_asymmetric_the_link(up_ms: int, down_ms: int) -> None:
    """The offset is wrong by half of the asymmetry, up to 50 ms here."""
    clock, booted_ns = VehicleClock(), 3 * S
    for k in range(2 * LEAST_SAMPLES):
        asked_ns = clock.request(20 * S + k * 200 * MS)
        there_ns = asked_ns + down_ms * MS
        clock.reply(tc1_ns=there_ns - booted_ns, ts1_ns=asked_ns, received_ns=there_ns + up_ms * MS)
    sampled_ns, sent_ns = 23 * S, 23 * S + (up_ms + 7) * MS
    used_ns = clock.sampled_ns((sampled_ns - booted_ns) // MS, sampled_ns + up_ms * MS, newest=True)
    assert used_ns is not None
    assert clock.down_ns is not None
    bound_s = (bound_at_ns(clock.estimate, used_ns) + clock.down_bound_ns) * 1e-9
    measured_s, true_s = loop_delay_s(used_ns, sent_ns, clock.down_ns * 1e-9), (up_ms + 7 + down_ms) * 1e-3
    assert abs(used_ns - sampled_ns) == pytest.approx(abs(up_ms - down_ms) / 2 * MS, abs=MS / 10)
    assert abs(measured_s - true_s) < min(1e-5, bound_s)
