"""Growth rates from motions whose modes are known, and the delay at which they pass zero."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gcs.control.tick import TICK, TickArray
from gcs.stress.growth import GrowthPoint, Motion, envelope_growth, fit_growth, locate_zero, motion_of, norm_growth

PERIOD_S = 0.02


def motion(*modes: tuple[complex, float], seconds: float = 20.0, noise: float = 0.0, seed: int = 1) -> Motion:
    """Two channels, each the sum of modes e^{st} with given amplitudes and different phases."""
    time_s = np.arange(round(seconds / PERIOD_S), dtype=np.float64) * PERIOD_S
    values = np.zeros((time_s.size, 2))
    for s, amplitude in modes:
        values += amplitude * np.real(np.exp(s * time_s[:, None] + 1j * np.array([0.3, 1.7])))
    return Motion(time_s, values + noise * np.random.default_rng(seed).standard_normal(values.shape), PERIOD_S)


@given(
    growth=st.floats(-3.0, 3.0),
    frequency=st.floats(0.5, 12.0),
    amplitude=st.floats(1e-3, 1e2),
)
def test_one_oscillation_is_found_whatever_its_rate_frequency_and_size(
    growth: float, frequency: float, amplitude: float
) -> None:
    found = fit_growth(motion((complex(growth, frequency), amplitude), seconds=8.0), start_s=0.0)
    assert found is not None
    assert found.growth_1_s == pytest.approx(growth, abs=1e-5)  # of a window of 1.3 s at least, in double precision
    assert found.frequency_rad_s == pytest.approx(frequency, abs=1e-4)


def test_the_slower_mode_is_reported_though_it_starts_smaller() -> None:
    found = fit_growth(motion((-0.3 + 4j, 1.0), (-1.5 + 2j, 3.0)), start_s=0.0)
    assert found is not None
    assert found.growth_1_s == pytest.approx(-0.3, abs=1e-6)


def test_the_slowest_mode_counts_where_it_stands_out_from_noise() -> None:
    """As in predicted loops near 0.72 s, it carries less than a tenth of the motion, yet many times the noise."""
    slowest, other = (-0.362 + 9.8j, 0.065), (-0.455 + 2.24j, 0.72)
    for noise, (mode, _), allowed in ((1e-4, slowest, 1e-3), (0.03, other, 0.03)):  # the rates are 0.09 1/s apart
        found = fit_growth(motion(slowest, other, noise=noise), start_s=0.0, end_s=9.5)
        assert found is not None
        assert found.growth_1_s == pytest.approx(mode.real, abs=allowed)


def test_a_real_mode_is_found_beside_an_oscillation() -> None:
    found = fit_growth(motion((-0.2, 2.0), (-0.9 + 3j, 2.0)), start_s=0.0)
    assert found is not None
    assert found.growth_1_s == pytest.approx(-0.2, abs=1e-6)
    assert found.frequency_rad_s == pytest.approx(0.0, abs=1e-6)


def test_a_fast_growth_is_found_beside_an_error_that_stays() -> None:
    """As in a loop that feeds back velocities alone: the position error outweighs the growth until the end."""
    found = fit_growth(motion((14.3, 2e-5), (1e-9, 1.0), seconds=0.9, noise=1e-6), start_s=0.0)
    assert found is not None
    assert found.growth_1_s == pytest.approx(14.3, abs=1e-3)


def test_the_error_says_how_far_noise_has_moved_the_rate() -> None:
    """Over many seeds: within three standard errors nearly always, and the errors are not just large."""
    misses = 0
    errors: list[float] = []
    for seed in range(60):
        found = fit_growth(motion((-0.05 + 3.7j, 1.0), noise=0.02, seed=seed), start_s=0.0)
        assert found is not None
        misses += abs(found.growth_1_s + 0.05) > 3.0 * found.error_1_s
        errors.append(found.error_1_s)
    assert misses <= 6
    assert np.median(errors) < 0.002  # the motion is 35 times the noise, for 20 s


def test_noise_after_the_motion_is_not_a_mode() -> None:
    """Rounding of the telemetry remains after a fast motion is gone: 1e-4 of it, here for nine tenths of the time."""
    found = fit_growth(motion((-3.0 + 4j, 1.0), noise=1e-4), start_s=0.0)
    assert found is not None
    assert found.growth_1_s == pytest.approx(-3.0, abs=0.01)
    assert found.end_s < 3.0


def test_no_motion_or_a_short_one_has_no_rate() -> None:
    assert fit_growth(motion((-0.1 + 4j, 0.0)), start_s=0.0) is None
    assert fit_growth(motion((-0.1 + 4j, 1.0), seconds=0.2), start_s=0.0) is None
    assert fit_growth(motion((-0.1 + 4j, 1.0)), start_s=5.0, end_s=5.1) is None
    assert norm_growth(motion((-0.1 + 4j, 0.0)), start_s=0.0) is None
    assert norm_growth(motion((-0.1 + 4j, 1.0)), start_s=25.0) is None


@pytest.mark.parametrize("growth", [-0.3, 0.0, 0.4])
def test_growth_through_varying_delays_is_the_mean_rate(
    growth: float,
) -> None:
    """A rate that wanders, over many seeds: no modes to fit."""
    rng = np.random.default_rng(2)
    time_s = np.arange(500, dtype=np.float64) * PERIOD_S
    off: list[float] = []
    errors: list[float] = []
    frequencies: list[float] = []
    for _ in range(60):
        wander = 0.1 * np.cumsum(rng.standard_normal(time_s.size)) * np.sqrt(PERIOD_S)
        angle = 3.7 * time_s + wander
        values = np.exp(growth * time_s + wander)[:, None] * np.stack([np.cos(angle), 3.7 * np.sin(angle)], axis=1)
        found = norm_growth(Motion(time_s, values, PERIOD_S), start_s=0.0)
        assert found is not None
        assert found.frequency_rad_s is not None
        off.append(found.growth_1_s - growth)
        errors.append(found.error_1_s)
        frequencies.append(found.frequency_rad_s)
    assert np.median(frequencies) == pytest.approx(3.7, rel=0.01)
    assert frequencies == pytest.approx([3.7] * 60, rel=0.1)  # ten seconds are six turns; the wander shifts them
    spread = float(np.std(off))
    assert abs(np.mean(off)) < 3.0 * spread / np.sqrt(60.0)
    assert spread / 2.0 < np.sqrt(np.mean(np.square(errors))) < 2.0 * spread


def test_a_motion_that_never_changes_sign_has_no_frequency() -> None:
    for found in (
        norm_growth(motion((-0.3, 1.0)), start_s=0.0),
        envelope_growth(np.exp(-0.1 * np.arange(80.0)), period_s=0.25, start_s=0.0),
    ):
        assert found is not None
        assert found.frequency_rad_s is None


def ticks_with_samples(boot_ms: NDArray[np.int64]) -> TickArray:
    """A tick for each sample; the errors are a known oscillation at the samples."""
    ticks = np.zeros(boot_ms.size, TICK)
    ticks["system_id"], ticks["commanded"] = 2, True
    ticks["time_s"] = PERIOD_S * np.arange(boot_ms.size)
    ticks["sample_boot_ms"] = boot_ms
    time_s = (boot_ms - boot_ms[0]) * 1e-3
    for name, phase in (("spacing_error_north_m", 0.0), ("spacing_error_east_m", 1.0)):
        ticks[name] = np.exp(-0.1 * time_s) * np.cos(3.0 * time_s + phase)
    for name in ("velocity_error_north_m_s", "velocity_error_east_m_s"):
        ticks[name] = 0.5 * ticks["spacing_error_east_m"]
    return ticks


def test_a_state_that_two_ticks_used_counts_once() -> None:
    regular = np.arange(500) * 20 + 7
    doubled = np.sort(np.concatenate([regular, regular[::3]]))
    once = motion_of(ticks_with_samples(regular), [2], period_s=PERIOD_S)
    twice = motion_of(ticks_with_samples(doubled), [2], period_s=PERIOD_S)
    assert np.array_equal(once.values, twice.values)


def test_irregular_samples_are_resampled_at_equal_intervals() -> None:
    """Telemetry with gaps and samples up to 9 ms off: the rate is that of the motion, not of the sampling."""
    rng = np.random.default_rng(3)
    boot_ms = np.unique(np.arange(1000) * 20 + rng.integers(-9, 10, 1000) + 100)
    kept = boot_ms[rng.random(boot_ms.size) > 0.1]
    found = fit_growth(motion_of(ticks_with_samples(kept), [2], period_s=PERIOD_S), start_s=0.0)
    assert found is not None
    assert found.growth_1_s == pytest.approx(-0.1, abs=1e-3)


def test_ticks_without_command_and_other_vehicles_are_left_out() -> None:
    ticks = ticks_with_samples(np.arange(200) * 20)
    ticks["commanded"][:50] = False
    ticks["system_id"][150:] = 3
    assert motion_of(ticks, [2], period_s=PERIOD_S).values.shape == (100, 4)


@pytest.mark.parametrize("growth", [-0.4, 0.0, 0.7])
def test_envelope_follows_an_oscillation(growth: float) -> None:
    time_s = np.arange(0.0, 20.0, 0.25)
    size = 5.0 * np.exp(growth * time_s) * np.abs(np.cos(3.7 * time_s))
    found = envelope_growth(size, period_s=0.25, start_s=0.0)
    assert found is not None
    assert found.growth_1_s == pytest.approx(growth, abs=0.03)  # its ripple, over 20 s


def curve(delay_s: float) -> float:
    """Rises through zero at 0.3 s, bent as growth rates are."""
    return 8.0 * (delay_s - 0.3) - 12.0 * (delay_s - 0.3) ** 2


@pytest.mark.parametrize(
    ("half_width_s", "allowed_s"),
    [(0.03, 1e-9), (0.1, 1e-9)],  # the parabola is exact here
)
def test_the_zero_of_a_bent_curve_is_found(half_width_s: float, allowed_s: float) -> None:
    delays = 0.305 + half_width_s * np.linspace(-1.0, 1.0, 5)
    zero = locate_zero([GrowthPoint(float(d), curve(float(d)), 1e-5) for d in delays])
    assert zero is not None
    assert zero.inside
    assert zero.varied == pytest.approx(0.3, abs=allowed_s)
    assert zero.slope == pytest.approx(8.0, rel=1e-6)


def test_the_zeros_error_is_the_rates_error_over_the_slope() -> None:
    rng = np.random.default_rng(5)
    noise, delays = 0.05, np.linspace(0.28, 0.32, 5)
    off: list[float] = []
    for _ in range(300):
        points = [GrowthPoint(float(d), curve(float(d)) + noise * rng.standard_normal(), noise) for d in delays]
        zero = locate_zero(points)
        if zero is not None:
            off.append((zero.varied - 0.3) / zero.error)
    assert 0.7 < float(np.std(off)) < 1.4


def test_flights_over_a_kink_show_a_misfit_and_larger_error() -> None:
    """The sampled loop has such kinks at whole numbers of periods; a graph-dk design had slopes of 18 and 14 1/s²."""
    for half_width_s, smooth in ((0.004, False), (0.0002, False), (0.004, True)):
        delays = 0.2 + half_width_s * np.linspace(-1.0, 0.8, 5)
        rates = [(18.0 if d < 0.2 and not smooth else 14.0) * (float(d) - 0.2) for d in delays]
        zero = locate_zero([GrowthPoint(float(d), rate, 1e-6) for d, rate in zip(delays, rates, strict=True)])
        assert zero is not None
        assert (zero.misfit < 1e-3) is smooth
        assert (zero.misfit > 5.0) is not smooth
        assert abs(zero.varied - 0.2) < 3.0 * zero.error + 1e-12
        assert abs(zero.varied - 0.2) < 0.06 * half_width_s


def test_zero_outside_the_flights_is_marked_and_points_the_way() -> None:
    zero = locate_zero([GrowthPoint(d, curve(d), 1e-5) for d in (0.2, 0.22, 0.24)])
    assert zero is not None
    assert not zero.inside
    assert zero.varied > 0.24


@pytest.mark.parametrize("points", [[], [(0.3, 0.1)], [(0.3, 0.1), (0.3, 0.2)], [(0.2, 0.3), (0.3, 0.1)]])
def test_no_zero_without_two_delays_and_a_rise(points: list[tuple[float, float]]) -> None:
    assert locate_zero([GrowthPoint(d, g, 1e-3) for d, g in points]) is None
