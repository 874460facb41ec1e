"""Growth of errors from vehicle to vehicle: published numbers, closed forms, and a conservation law."""

from math import pi, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gains.core.errors import BadModelError
from gains.performance.behaviour import string_peak
from gains.performance.string_stability import (
    Follower,
    least_headway,
    low_frequency_coefficient,
    response_peak,
    string_verdict,
    vehicle_with_lag,
)


def test_published_headway_of_adaptive_cruise_control() -> None:
    # Ploeg et al. 2014: kp = 0.2, kd = 0.7, a lag of 0.1 s and a delay of 0.2 s need 3.16 s without communication
    response = vehicle_with_lag(proportional=0.2, derivative=0.7, lag_s=0.1, delay_s=0.2)
    headway_s = least_headway(response, near_rad_s=1.0)
    assert headway_s == pytest.approx(3.16, abs=5e-3)
    # the limit at zero frequency decides: sqrt(2 / kp), extrapolated to 1e-9
    assert headway_s == pytest.approx(sqrt(2.0 / 0.2), rel=1e-8)


@pytest.mark.parametrize(("delay_s", "peak"), [(0.0, 1.47), (0.4, 2.59), (0.7, 73.6)])
def test_predecessor_following_amplifies_and_delay_makes_it_worse(delay_s: float, peak: float) -> None:
    verdict = string_verdict(Follower(1.0, 1.0, 1.0, delay_s))
    assert verdict.is_loop_stable
    assert not verdict.is_string_stable
    # three digits are known
    assert verdict.peak == pytest.approx(peak, rel=4e-3)


def test_peak_without_delay_is_the_closed_form() -> None:
    # |s + 1|^2 / |s^2 + s + 1|^2 = (1 + w) / (1 - w + w^2) with w = omega^2, largest at w = sqrt(3) - 1
    w = sqrt(3.0) - 1.0
    verdict = string_verdict(Follower(1.0, 1.0, 1.0))
    assert verdict.peak == pytest.approx(sqrt((1.0 + w) / (1.0 - w + w * w)), rel=1e-13)
    # the place of a maximum is known to sqrt(eps)
    assert verdict.peak_rad_s == pytest.approx(sqrt(w), rel=1e-7)


@pytest.mark.parametrize(
    ("gain", "delay_s", "headway_s"),
    [(1.0, 0.0, 0.0), (1.0, 0.4, 0.0), (1.0, 0.3, 1.0), (2.0, 0.1, 0.5), (1.0, 0.2, 3.0)],
)
def test_logarithm_of_the_growth_has_a_fixed_integral(gain: float, delay_s: float, headway_s: float) -> None:
    follower = Follower(gain, gain, gain, delay_s, headway_s)
    omega = np.logspace(-3.0, 6.0, 900_001)
    # over ln(omega); the part below the grid by the limit at zero
    integral = float(np.trapezoid(np.log(np.abs(follower.response(omega))) / omega, np.log(omega)))
    integral += follower.low_frequency_coefficient / 2.0 * omega[0]
    # the grid resolves e^{-j omega tau} up to 10^4 rad/s; beyond, 1 / omega^2 leaves 1e-3 of ln(omega) at most
    assert integral == pytest.approx(pi / 2.0 * (delay_s - headway_s), abs=2e-3)


@given(
    own=st.floats(0.2, 5.0),
    front=st.floats(0.0, 5.0),
    spacing=st.floats(0.2, 5.0),
    delay_s=st.floats(0.0, 0.1),
    headway_s=st.floats(0.0, 2.0),
)
def test_limit_at_zero_is_the_closed_form_with_any_delay(
    own: float, front: float, spacing: float, delay_s: float, headway_s: float
) -> None:
    follower = Follower(own, front, spacing, delay_s, headway_s)
    found = low_frequency_coefficient(follower.response, near_rad_s=0.1 * spacing)
    # extrapolation leaves a few 1e-8 of the largest of its parts
    size = (front**2 + own**2 + 2.0 * spacing) / spacing**2 + headway_s**2
    assert found == pytest.approx(follower.low_frequency_coefficient, abs=1e-5 * size)


def test_velocity_against_the_formations_own_makes_the_chain_string_stable() -> None:
    # k2^2 + 2 k3 <= k1^2
    verdict = string_verdict(Follower(2.0, 0.0, 1.0))
    assert verdict.is_string_stable
    assert (verdict.peak, verdict.peak_rad_s) == (1.0, 0.0)
    assert verdict.low_frequency_coefficient == -2.0


def test_low_frequencies_decide_where_a_grid_sees_no_peak() -> None:
    # k1^2 a part in 10^7 short of 2 k3: a peak of 1 + 1e-14 or so
    verdict = string_verdict(Follower(sqrt(2.0 - 2e-7), 0.0, 1.0))
    assert verdict.peak < 1.0 + 1e-9
    assert verdict.low_frequency_coefficient == pytest.approx(2e-7, rel=1e-6)
    assert not verdict.is_string_stable


def test_least_headway_makes_the_chain_just_string_stable() -> None:
    # k1 = k2 = k3 = 1 with delay: the peak of (|Q|^2 - 1) / omega^2 decides, not its limit at zero
    without = Follower(1.0, 1.0, 1.0, 0.4)
    headway_s = least_headway(without.response, near_rad_s=1.0)
    assert headway_s > sqrt(without.low_frequency_coefficient) * 1.01
    assert string_verdict(Follower(1.0, 1.0, 1.0, 0.4, headway_s * (1.0 + 1e-9))).is_string_stable
    assert not string_verdict(Follower(1.0, 1.0, 1.0, 0.4, headway_s * 0.999)).is_string_stable


def test_no_headway_is_needed_where_nothing_grows() -> None:
    assert least_headway(Follower(2.0, 0.0, 1.0).response, near_rad_s=1.0) == 0.0


def test_delay_beyond_the_margin_is_not_string_stable() -> None:
    # tau = 0.711 is the margin of k1 = k3 = 1
    verdict = string_verdict(Follower(1.0, 0.0, 1.0, 0.72))
    assert (verdict.is_loop_stable, verdict.is_string_stable) == (False, False)


@pytest.mark.parametrize(("own", "front", "spacing", "delay_s"), [(1.0, 0.3, 1.0, 0.2), (3.0, 1.0, 2.0, 0.05)])
def test_peak_agrees_with_the_one_the_design_uses(own: float, front: float, spacing: float, delay_s: float) -> None:
    gains = (np.array([[-own]]), np.array([[front]]), np.array([[spacing]]))
    peak = response_peak(Follower(own, front, spacing, delay_s).response, near_rad_s=own)[0]
    # the design's peak is from two grids, a few parts in 10^5 wide
    assert peak == pytest.approx(string_peak(gains, delay_s), rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1.0, 1.0, float("nan")), "spacing is nan"),
        ((1.0, 1.0, 1.0, -0.1), r"delay_s is -0\.1"),
        ((1.0, 1.0, 1.0, 0.0, float("inf")), "headway_s is inf"),
    ],
)
def test_wrong_followers_are_named(arguments: tuple[float, ...], message: str) -> None:
    with pytest.raises(BadModelError, match=message):
        Follower(*arguments)


def test_follower_that_holds_no_distance_has_no_verdict() -> None:
    with pytest.raises(BadModelError, match="spacing is 0"):
        string_verdict(Follower(1.0, 1.0, 0.0))
