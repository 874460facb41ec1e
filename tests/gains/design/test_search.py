"""The search for the best gains: its formulas against independent ones, its optimum against a plain scan."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gains.core.requirement import ChainLimit
from gains.delay.constant import delay_margin
from gains.design.search import largest_alpha, largest_margin
from gains.formation.model import FormationModel
from gains.performance.robust import robustness
from gains.performance.scalar_gains import alpha_of, front_gain_range, gains_of_margin
from gains.sampled.constant import sampled_delay_margin

FOLLOWER = FormationModel((-1, 0), axes=1)


def gain(k1: float, k2: float, k3: float) -> np.ndarray:
    return FOLLOWER.overlapping_gain([[-k1]], [[k2]], [[k3]])


@settings(max_examples=30, deadline=None)
@given(st.floats(0.05, 0.99), st.floats(0.01, 5.0))
def test_continuous_curve_has_the_margin_it_is_named_for(share: float, margin_s: float) -> None:
    """Against the closed form of the follower block, τ = atan(k1 ω / k3) / ω, ω² = (k1² + √(k1⁴ + 4 k3²)) / 2."""
    k1, k3 = (float(k) for k in gains_of_margin(np.array(share), np.array(margin_s), 0.0))
    omega = np.sqrt((k1**2 + np.sqrt(k1**4 + 4 * k3**2)) / 2)
    assert np.arctan2(k1 * omega, k3) / omega == pytest.approx(margin_s, rel=1e-12)
    # The general method, without any formula for this block.
    A, B = FOLLOWER.A, FOLLOWER.B
    assert delay_margin(A, B @ gain(k1, 0.0, k3)) == pytest.approx(margin_s, rel=1e-9)


@pytest.mark.parametrize("period_s", [0.02, 0.05, 0.1, 0.2])
@pytest.mark.parametrize("margin_s", [0.05, 0.1, 0.237, 0.3, 1.0])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.74])
def test_sampled_curve_has_the_margin_it_is_named_for(period_s: float, margin_s: float, share: float) -> None:
    """Against the general sampled margin; margins of whole periods and others, shorter than a period and longer."""
    k1, k3 = (float(k) for k in gains_of_margin(np.array(share), np.array(margin_s), period_s))
    assert k1 * period_s < 2
    found = sampled_delay_margin(FOLLOWER.A, FOLLOWER.B, gain(k1, 0.3 * k1, k3), period_s=period_s)
    assert found == pytest.approx(margin_s, rel=1e-9)


def test_sampled_curve_becomes_the_continuous_one_as_the_period_vanishes() -> None:
    """The hold acts like half a period of delay, so the difference to a margin larger by T/2 is of order T²."""
    share, margin_s, period_s = np.linspace(0.1, 0.95, 9), np.array(0.3), 1e-3
    sampled = np.array(gains_of_margin(share, margin_s, period_s))
    continuous = np.array(gains_of_margin(share, margin_s + period_s / 2, 0.0))
    # (T / 0.3 s)² = 1e-5, times a factor of order 1.
    np.testing.assert_allclose(sampled, continuous, rtol=1e-5)


@settings(max_examples=60, deadline=None)
@given(st.floats(0.1, 50), st.floats(-2, 2), st.floats(0.02, 2))
def test_quick_alpha_is_the_exact_alpha(k1: float, front: float, spacing: float) -> None:
    """Newton on the characteristic polynomial and a refined grid, against level sets of the frequency response."""
    k2, k3 = front * k1, spacing * k1**2
    quick = float(alpha_of(np.array(k1), np.array(k2), np.array(k3)))
    # 1e-10 is what the level sets resolve; squares of gains up to 5000 in the polynomial cost some digits more.
    assert quick == pytest.approx(robustness(-k1, k2, k3), rel=2e-7)


@pytest.mark.parametrize("feed_forward", [0.0, 0.6, 0.9])
@pytest.mark.parametrize("peak", [1.0, 1.05, 1.3])
@pytest.mark.parametrize("delay_s", [0.0, 0.15])
def test_front_gain_range_is_where_spacing_errors_begin_to_grow(
    peak: float, delay_s: float, feed_forward: float
) -> None:
    """|Γ(jω)| computed from its definition on a dense grid: within the peak at both ends, above it 1 % beyond."""
    k1, k3 = 3.5, 4.5
    ends = front_gain_range(np.array([k1]), np.array([k3]), np.array([delay_s]), peak, feed_forward)
    least, most = (float(end[0]) for end in ends)
    assert least < most
    s = 1j * np.geomspace(1e-3, 300, 400_001)
    late = np.exp(-s * delay_s)

    def growth(k2: float) -> float:
        entry = feed_forward * s**2 + (k2 * s + k3) * late
        return float(np.abs(entry / (s**2 + (k1 * s + k3) * late)).max())

    # The search for the least frequency resolves the peak to 1e-6.
    assert max(growth(least), growth(most)) <= peak + 1e-6
    assert growth(most + 0.01 * k1) > peak
    assert growth(least - 0.01 * k1) > peak
    if peak == 1 and delay_s == 0:
        assert most == pytest.approx(np.sqrt(k1**2 - 2 * (1.0 - feed_forward) * k3), rel=1e-9)


def test_when_own_loops_amplify_no_front_gain_is_small_enough() -> None:
    """k1² < 2 k3: even without feed-forward the follower overshoots."""
    least, most = front_gain_range(np.array([1.0]), np.array([1.0]), np.array([0.0]), 1.0)
    assert least[0] > most[0]


def test_full_feed_forward_leaves_one_front_gain() -> None:
    """k2 = k1: both vehicles then do the same, so that nothing propagates at any delay."""
    for delay_s in (0.15, 0.29):
        ends = front_gain_range(np.array([3.5]), np.array([4.5]), np.array([delay_s]), 1.0, 1.0)
        assert [float(end[0]) for end in ends] == pytest.approx([3.5, 3.5], rel=1e-3)  # the grid of frequencies


@pytest.mark.parametrize(("margin_s", "coarse"), [(0.1, 0.94), (0.3, 0.80), (0.5, 0.63)])
def test_optimum_beats_a_plain_scan_at_most_by_its_grid(margin_s: float, coarse: float) -> None:
    """Scan of (k1, k2, k3) at the closed-form margin with α by singular values: the optimum is above and near it."""
    best = largest_alpha(margin_s, 0.0)
    assert best is not None
    assert best.alpha > coarse
    omega = np.linspace(0, 4, 101)
    scanned = 0.0
    for angle in np.linspace(1.0, 1.3, 31):
        k1, k3 = angle * np.sin(angle) / margin_s, angle**2 * np.cos(angle) / margin_s**2
        for k2 in np.linspace(0, 1.5, 31) * k1:
            A = np.array([[-k1, 0, 0], [1, 0, -1], [k2, k3, -k1]])
            M = 1j * omega[:, None, None] * np.eye(3) - A
            scanned = max(scanned, float(np.linalg.svd(M, compute_uv=False)[:, -1].min()))
    # 0.01 in the angle, 5 % of k1 in k2 and 0.04 rad/s in ω: 2e-4 of α, either way (the ω grid overestimates).
    assert best.alpha == pytest.approx(scanned, abs=5e-4)
    assert robustness(-best.k1, best.k2, best.k3) == pytest.approx(best.alpha, rel=1e-8)


@settings(max_examples=60, deadline=None)
@given(st.floats(-0.1, 0.1), st.floats(-0.3, 0.3), st.sampled_from([0.02, 0.05]), st.sampled_from([0.15, 0.3, 0.8]))
def test_no_neighbour_with_the_margin_is_better(angle: float, front: float, period_s: float, margin_s: float) -> None:
    best = largest_alpha(margin_s, period_s)
    assert best is not None
    k1, k3 = (float(k) for k in gains_of_margin(np.array(0.74 + angle), np.array(margin_s), period_s))
    # 1e-8: the width of the last window of the search, in α.
    assert robustness(-k1, best.k2 + front * k1, k3) <= best.alpha + 1e-8


def test_more_margin_longer_periods_and_string_stability_cost_alpha() -> None:
    def alpha(margin_s: float, period_s: float, peak: float | None) -> float:
        gains = largest_alpha(margin_s, period_s, ChainLimit(peak))
        assert gains is not None
        return gains.alpha

    for series in (
        [alpha(margin_s, 0.05, None) for margin_s in (0.05, 0.1, 0.2, 0.3, 0.5, 1.0)],
        [alpha(0.3, period_s, None) for period_s in (0.0, 0.02, 0.05, 0.1, 0.2)],
        [alpha(0.3, 0.05, peak) for peak in (None, 1.5, 1.2, 1.1, 1.0)],
    ):
        assert all(later < earlier for earlier, later in pairwise(series))


@pytest.mark.parametrize("peak", [None, 1.0])
@pytest.mark.parametrize("alpha", [0.05, 0.5, 0.8, 0.95])
def test_largest_margin_inverts_largest_alpha(alpha: float, peak: float | None) -> None:
    found = largest_margin(alpha, 0.05, ChainLimit(peak))
    assert found is not None
    margin_s, gains = found
    assert gains.alpha >= alpha
    here, beyond = (largest_alpha(factor * margin_s, 0.05, ChainLimit(peak)) for factor in (1.0, 1.001))
    assert here is not None
    assert beyond is not None
    assert beyond.alpha < alpha <= here.alpha


def test_alpha_beyond_what_the_period_allows_has_no_margin() -> None:
    """α < 1 for every gain, and high gains are not stable when sampled."""
    assert largest_margin(0.9999, 0.05) is None
