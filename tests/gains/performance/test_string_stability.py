"""Growth of errors from vehicle to vehicle: closed forms, and dense grids."""

from math import inf, nan, sqrt

import numpy as np
import pytest

from gains.core.errors import BadModelError
from gains.design.design import design
from gains.formation.model import FormationModel
from gains.performance.string_stability import formation_string_peak, largest_magnitude, string_peak

CHAIN = FormationModel((-1, 0, 1))


def peak_of(own: float, front: float, spacing: float, delay_s: float = 0.0) -> float:
    return string_peak((np.array([[-own]]), np.array([[front]]), np.array([[spacing]])), delay_s)


@pytest.mark.parametrize(("delay_s", "peak"), [(0.0, 1.47), (0.4, 2.59), (0.7, 73.6)])
def test_predecessor_following_amplifies_and_delay_makes_it_worse(delay_s: float, peak: float) -> None:
    # three digits are known
    assert peak_of(1.0, 1.0, 1.0, delay_s) == pytest.approx(peak, rel=4e-3)


def test_peak_without_delay_is_the_closed_form() -> None:
    # |s + 1|^2 / |s^2 + s + 1|^2 = (1 + w) / (1 - w + w^2) with w = omega^2, largest at w = sqrt(3) - 1
    w = sqrt(3.0) - 1.0
    assert peak_of(1.0, 1.0, 1.0) == pytest.approx(sqrt((1.0 + w) / (1.0 - w + w * w)), rel=1e-13)


def test_without_front_velocity_strong_damping_makes_the_chain_string_stable() -> None:
    # k2^2 + 2 k3 <= k1^2
    assert peak_of(2.0, 0.0, 1.0) == 1.0
    # k1^2 a hundredth short of 2 k3: |1 / (s^2 + k1 s + 1)| peaks at 1 / (k1 sqrt(1 - k1^2 / 4)), a little above one
    k1 = sqrt(2.0 - 0.02)
    assert peak_of(k1, 0.0, 1.0) == pytest.approx(1.0 / (k1 * sqrt(1.0 - k1**2 / 4.0)), rel=1e-13)


@pytest.mark.parametrize(("gain", "delay_s"), [(1.0, 0.1), (1.0, 0.4), (2.0, 0.1)])
def test_peak_with_delay_is_that_of_a_dense_grid(gain: float, delay_s: float) -> None:
    s = 1j * np.geomspace(1e-2, 1e2, 200_001)
    late = np.exp(-s * delay_s)
    size = np.abs((gain * s + gain) * late / (s**2 + (gain * s + gain) * late))
    # the grid's steps are 5e-5 of the frequency
    assert peak_of(gain, gain, gain, delay_s) == pytest.approx(float(size.max()), rel=1e-6)


@pytest.mark.parametrize("near_rad_s", [0.0, -1.0, nan, inf])
def test_a_sweep_around_no_frequency_is_refused(near_rad_s: float) -> None:
    with pytest.raises(BadModelError, match="near_rad_s is"):
        largest_magnitude(lambda omega: omega, near_rad_s=near_rad_s)


def test_formation_string_peak_equals_that_of_two_followers() -> None:
    found = design(CHAIN, period_s=0.02)
    K = CHAIN.overlapping_gain(found.K1, found.K2, 1.4 * found.K3)
    k1, k2, k3 = -found.K1[0, 0], found.K2[0, 0], 1.4 * found.K3[0, 0]
    s = 1j * np.geomspace(1e-3, 1e2, 20000)
    peak = np.abs((k2 * s + k3) / (s**2 + k1 * s + k3)).max()
    assert peak > 1.05
    assert formation_string_peak(CHAIN, K) == pytest.approx(peak, rel=1e-4)
    assert formation_string_peak(FormationModel((-1, 0)), np.zeros((4, 6))) is None
