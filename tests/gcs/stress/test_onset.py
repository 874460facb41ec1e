"""The delay at which measured growth passes zero."""

import numpy as np
import pytest

from gcs.stress.onset import GrowthPoint, locate_zero


def curve(delay_s: float) -> float:
    """Rises through zero at 0.3 s, bent as growth rates are."""
    return 8.0 * (delay_s - 0.3) - 12.0 * (delay_s - 0.3) ** 2


@pytest.mark.parametrize(
    ("half_width_s", "allowed_s"),
    [(0.03, 1e-9), (0.1, 1e-9)],  # the parabola is exact here
)
def test_zero_of_a_bent_curve(half_width_s: float, allowed_s: float) -> None:
    delays = 0.305 + half_width_s * np.linspace(-1.0, 1.0, 5)
    zero = locate_zero([GrowthPoint(float(d), curve(float(d)), 1e-5) for d in delays])
    assert zero is not None
    assert zero.inside
    assert zero.loop_delay_s == pytest.approx(0.3, abs=allowed_s)
    assert zero.slope_1_s2 == pytest.approx(8.0, rel=1e-6)


def test_the_zeros_error_is_the_rates_error_over_the_slope() -> None:
    rng = np.random.default_rng(5)
    noise, delays = 0.05, np.linspace(0.28, 0.32, 5)
    off: list[float] = []
    for _ in range(300):
        points = [GrowthPoint(float(d), curve(float(d)) + noise * rng.standard_normal(), noise) for d in delays]
        zero = locate_zero(points)
        if zero is not None:
            off.append((zero.loop_delay_s - 0.3) / zero.error_s)
    assert 0.7 < float(np.std(off)) < 1.4


def test_flights_over_a_kink_show_a_misfit_and_larger_error() -> None:
    """As the sampled loop has at whole numbers of periods: slopes of 18 and 14 1/s², seen of a graph-dk design."""
    for half_width_s, smooth in ((0.004, False), (0.0002, False), (0.004, True)):
        delays = 0.2 + half_width_s * np.linspace(-1.0, 0.8, 5)
        rates = [(18.0 if d < 0.2 and not smooth else 14.0) * (float(d) - 0.2) for d in delays]
        zero = locate_zero([GrowthPoint(float(d), rate, 1e-6) for d, rate in zip(delays, rates, strict=True)])
        assert zero is not None
        assert (zero.misfit < 1e-3) is smooth
        assert (zero.misfit > 5.0) is not smooth
        assert abs(zero.loop_delay_s - 0.2) < 3.0 * zero.error_s + 1e-12
        assert abs(zero.loop_delay_s - 0.2) < 0.06 * half_width_s


def test_zero_outside_the_flights_is_marked_and_points_the_way() -> None:
    zero = locate_zero([GrowthPoint(d, curve(d), 1e-5) for d in (0.2, 0.22, 0.24)])
    assert zero is not None
    assert not zero.inside
    assert zero.loop_delay_s > 0.24


@pytest.mark.parametrize("points", [[], [(0.3, 0.1)], [(0.3, 0.1), (0.3, 0.2)], [(0.2, 0.3), (0.3, 0.1)]])
def test_no_zero_without_two_delays_and_a_rise(points: list[tuple[float, float]]) -> None:
    assert locate_zero([GrowthPoint(d, g, 1e-3) for d, g in points]) is None
