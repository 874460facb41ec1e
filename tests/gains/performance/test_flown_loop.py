"""α and the growth of spacing errors with delay, each by a second way that shares no formula with the first."""

from math import inf, pi
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gains.delay.constant import delay_margin
from gains.delay.rightmost import rightmost_root
from gains.formation.model import FormationModel
from gains.performance.flown import FlownLoop, FlownTiming
from gains.performance.response import Response, sampled_margin
from gains.performance.scalar_gains import ScalarGains
from gains.sampled.constant import period_map, sampled_delay_margin, spectral_radius
from gains.sampled.multirate import Timing

PERIOD_S = 0.02
GAINS = ScalarGains(3.4079559741115664, 0.6308727089934395, 5.608081773264997, 0.8168)
"""The gains of triangle5."""
FLOWN = FlownLoop(GAINS, FlownTiming(delay_margin_s=0.3, period_s=PERIOD_S))


def subsystem(gains: ScalarGains, axes: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(A0, A1) of a vehicle and its follower, all feedback late."""
    pair, identity = FormationModel((-1, 0), axes=axes), np.eye(axes)
    return pair.ground_loop(-gains.k1 * identity, gains.k2 * identity, gains.k3 * identity)


def smallest_singular_value(A0: NDArray[np.float64], A1: NDArray[np.float64], delay_s: float) -> tuple[float, float]:
    """A certified interval of min over ω of σ_min(jωI − A0 − A1 e^{−jωτ}), which is Lipschitz with 1 + τ ‖A1‖."""
    slope = 1.0 + delay_s * np.linalg.norm(A1, 2)
    ends: NDArray[np.float64] = np.linspace(0.0, 2.0 * float(np.linalg.norm(A0, 2) + np.linalg.norm(A1, 2)), 400)
    low, high = ends[:-1], ends[1:]
    best = inf
    for _ in range(40):
        middle, half = (low + high) / 2.0, (high - low) / 2.0
        matrix = 1j * middle[:, None, None] * np.eye(len(A0)) - A0 - A1 * np.exp(-1j * middle * delay_s)[:, None, None]
        sigma: NDArray[np.floating[Any]] = np.linalg.svd(matrix, compute_uv=False)
        sigma = sigma[:, -1]
        best = min(best, float(sigma.min()))
        bound = sigma - slope * half
        if bound.min() > best - 1e-5:
            return float(bound.min()), best
        alive = bound < best - 1e-5
        low, high, middle = low[alive], high[alive], middle[alive]
        low, high = np.concatenate([low, middle]), np.concatenate([middle, high])
    raise AssertionError("no certificate")


@pytest.mark.parametrize(
    ("delay_s", "alpha", "peak"),
    [(0.0, 0.817, 1.0), (0.15, 0.815, 1.0), (0.2, 0.666, 1.19), (0.25, 0.312, 2.49), (0.29, 0.055, 13.8)],
)
def test_alpha_and_growth_of_triangle5_degrade_well_before_the_margin(
    delay_s: float, alpha: float, peak: float
) -> None:
    assert FLOWN.pair.alpha(delay_s) == pytest.approx(alpha, abs=6e-4)
    assert FLOWN.string_peak(delay_s) == pytest.approx(peak, rel=4e-3)
    least, most = smallest_singular_value(*subsystem(GAINS, 1), delay_s + PERIOD_S / 2)
    assert least - 1e-9 <= FLOWN.pair.alpha(delay_s) <= most + 1e-9


@pytest.mark.parametrize("delay_s", [0.1, 0.2, 0.25])
def test_only_a_real_disturbance_beyond_alpha_destabilises_the_sampled_loop(delay_s: float) -> None:
    pair = FormationModel((-1, 0))
    K = pair.overlapping_gain(-GAINS.k1 * np.eye(2), GAINS.k2 * np.eye(2), GAINS.k3 * np.eye(2))
    A0, A1 = subsystem(GAINS, 1)
    late_s = delay_s + PERIOD_S / 2
    grid = np.linspace(0.0, 12.0, 4001)
    matrix = 1j * grid[:, None, None] * np.eye(3) - A0 - A1 * np.exp(-1j * grid * late_s)[:, None, None]
    left, sigma, right = np.linalg.svd(matrix)
    at = int(np.argmin(sigma[:, -1]))
    worst: NDArray[np.complex128] = left[at, :, -1][:, None] @ right[at, -1, :][None, :]
    # complex on one axis, it is the real [[Re, -Im], [Im, Re]] on north and east
    real = np.kron(worst.real, np.eye(2)) + np.kron(worst.imag, np.array([[0.0, -1.0], [1.0, 0.0]]))
    assert np.linalg.norm(real, 2) == pytest.approx(1.0)
    alpha = FLOWN.pair.alpha(delay_s)

    def radius(disturbance: NDArray[np.float64]) -> float:
        return spectral_radius(pair.A + disturbance, pair.B, K, period_s=PERIOD_S, delay_s=delay_s)

    # the hold is a delay of half a period to its second order only: (ω T)² / 24 at some 6 rad/s
    assert radius(1.01 * alpha * real) > 1.0
    assert radius(0.99 * alpha * real) < 1.0
    draw = np.random.default_rng(1)
    for _ in range(50):
        other = draw.standard_normal((6, 6))
        assert radius(0.99 * alpha * other / np.linalg.norm(other, 2)) < 1.0


@pytest.mark.parametrize("delay_s", [0.0, 0.05, 0.2, 0.25, 0.28])
def test_the_peak_is_the_sampled_chains_growth_between_vehicles(delay_s: float) -> None:
    chain = FormationModel((-1, 0, 1), axes=1)
    K = chain.overlapping_gain([[-GAINS.k1]], [[GAINS.k2]], [[GAINS.k3]])
    lifted = period_map(chain.A, chain.B, K, period_s=PERIOD_S, delay_s=delay_s)
    entry = np.zeros(len(lifted))
    entry[0], entry[1] = PERIOD_S, PERIOD_S**2 / 2.0  # a held acceleration of the leader
    z = np.exp(1j * np.linspace(0.01, 12.0, 6000) * PERIOD_S)
    response = np.linalg.solve(z[:, None, None] * np.eye(len(lifted)) - lifted, entry[:, None])[..., 0]
    growth = np.abs(response[:, 4] / response[:, 2])  # velocity errors of the second and the first follower
    # the second order of the hold moves the margin by 1e-5 s, which moves the peak more, the nearer it is
    assert FLOWN.string_peak(delay_s) == pytest.approx(
        max(1.0, float(growth.max())), rel=2e-2 if delay_s > 0.26 else 4e-3
    )


def gains_of_stable_loops() -> st.SearchStrategy[ScalarGains]:
    def gains(k1: float, front: float, share: float) -> ScalarGains:
        return ScalarGains(k1, front * k1, share * k1**2 / 2.0, 0.0)

    return st.builds(gains, st.floats(0.2, 8.0), st.floats(-1.5, 1.5), st.floats(0.02, 1.5))


@settings(max_examples=60, deadline=None)
@given(
    gains=gains_of_stable_loops(), loop=st.sampled_from(["ground", "onboard"]), peak=st.sampled_from([1.0, 1.1, 2.0])
)
@example(gains=GAINS, loop="ground", peak=1.0)
@example(gains=GAINS, loop="onboard", peak=1.05)
def test_the_closed_form_limit_is_where_growth_exceeds_the_peak(gains: ScalarGains, loop: str, peak: float) -> None:
    pair = FormationModel((-1, 0), axes=1)
    K = pair.overlapping_gain([[-gains.k1]], [[gains.k2]], [[gains.k3]])
    margin_s = sampled_delay_margin(pair.A, pair.B, K, period_s=PERIOD_S) if loop == "ground" else inf
    flown = FlownLoop(gains, FlownTiming(margin_s, PERIOD_S, "ground" if loop == "ground" else "onboard", 0.01))
    limit_s = flown.string_limit_s(peak)
    most = peak * (1.0 + 1e-7)
    if limit_s == inf:
        assert all(flown.string_peak(delay_s) <= most for delay_s in np.geomspace(0.01, 20.0, 40))
        return
    assert all(flown.string_peak(share * limit_s) <= most for share in np.linspace(0.0, 0.999, 12) if limit_s > 0.0)
    beyond = [flown.string_peak(limit_s + extra_s) for extra_s in np.geomspace(1e-3, 0.3, 8)]
    # a growth that begins at low frequencies is too flat at first for the peak to show
    assert max(beyond) > peak * (1.0 - 1e-12)
    if limit_s < margin_s and peak > 1.0 and limit_s > 0.0:
        assert max(beyond) > peak


def test_without_the_velocity_in_front_no_delay_changes_onboard_growth() -> None:
    # |1 / (s² + s + 1)| peaks at 2 / √3 = 1.1547
    flown = FlownLoop(ScalarGains(1.0, 0.0, 1.0, 0.0), FlownTiming(inf, PERIOD_S, "onboard"))
    assert (flown.string_limit_s(1.15), flown.string_limit_s(1.16)) == (0.0, inf)


@settings(max_examples=25, deadline=None)
@given(gains=gains_of_stable_loops(), share=st.floats(0.0, 0.95))
@example(gains=GAINS, share=0.66)
def test_alpha_with_delay_lies_in_its_certified_interval(gains: ScalarGains, share: float) -> None:
    A0, A1 = subsystem(gains, 1)
    margin_s = delay_margin(A0, A1)
    assume(margin_s > 0.01)
    flown = FlownLoop(gains, FlownTiming(margin_s, 0.0))
    least, most = smallest_singular_value(A0, A1, share * margin_s)
    assert least - 1e-7 <= flown.pair.alpha(share * margin_s) <= most + 1e-7


def test_alpha_is_kept_up_to_its_limit_and_not_beyond() -> None:
    limit_s = FLOWN.pair.alpha_limit_s(0.5)
    assert FLOWN.pair.alpha(limit_s) == pytest.approx(0.5, abs=1e-6)
    assert 0.2 < limit_s < 0.25
    assert min(FLOWN.pair.alpha(delay_s) for delay_s in np.linspace(0.0, limit_s, 50)) >= 0.5 - 1e-6
    assert FLOWN.pair.alpha_limit_s(0.9) == 0.0
    assert FLOWN.pair.alpha_limit_s(1e-3) == pytest.approx(0.3, abs=1e-3)
    assert FLOWN.string_limit_s(1.0) == pytest.approx(0.1607, abs=1e-4)
    assert (FLOWN.pair.alpha(0.3), FLOWN.string_peak(0.3)) == (0.0, inf)


@pytest.mark.parametrize(("delay_s", "peak"), [(0.49, 1.039), (0.99, 1.083)])
def test_late_front_velocity_lets_onboard_errors_grow_at_every_delay(delay_s: float, peak: float) -> None:
    onboard = FlownLoop(GAINS, FlownTiming(inf, PERIOD_S, "onboard"))
    assert onboard.string_peak(delay_s) == pytest.approx(peak, abs=5e-4)
    # Γ = (k3 + k2 s e^{−sτ}) / (s² + k1 s + k3), with half a period for the hold
    s = 1j * np.linspace(1e-3, 20.0, 100_001)
    late = np.exp(-s * (delay_s + PERIOD_S / 2))
    direct = np.abs((GAINS.k3 + GAINS.k2 * s * late) / (s**2 + GAINS.k1 * s + GAINS.k3))
    assert onboard.string_peak(delay_s) == pytest.approx(float(direct.max()), rel=1e-8)
    assert onboard.string_limit_s(1.0) == 0.0
    without = FlownLoop(ScalarGains(GAINS.k1, 0.0, GAINS.k3, 0.0), FlownTiming(inf, PERIOD_S, "onboard", 0.01))
    assert without.string_limit_s(1.0) == inf
    assert without.string_peak(delay_s) == pytest.approx(1.0, abs=1e-9)
    assert without.pair.alpha(delay_s) == pytest.approx(0.8138, abs=1e-4)
    assert without.pair.alpha_limit_s(0.81) == inf


def test_a_followers_motion_on_board_grows_by_the_peak() -> None:
    onboard, delay_s, step_s = FlownLoop(GAINS, FlownTiming(inf, 0.0, "onboard")), 1.0, 1e-3
    omega = 2 * pi / 4.0
    # e_p' = v_front − v, v' = −k1 v + k2 v_front(t − τ) + k3 e_p behind a vehicle whose velocity swings
    spacing = velocity = 0.0
    most = 0.0
    for k in range(60_000):
        time_s = k * step_s
        front, late = np.cos(omega * time_s), np.cos(omega * (time_s - delay_s))
        velocity += step_s * (-GAINS.k1 * velocity + GAINS.k2 * late + GAINS.k3 * spacing)
        spacing += step_s * (front - velocity)
        most = max(most, abs(velocity)) if time_s > 40.0 else 0.0
    assert most <= onboard.string_peak(delay_s) * 1.002
    s = 1j * omega
    gamma = abs((GAINS.k3 + GAINS.k2 * s * np.exp(-s * delay_s)) / (s**2 + GAINS.k1 * s + GAINS.k3))
    assert most == pytest.approx(gamma, rel=5e-3)


def test_a_response_costs_alpha_growth_and_margin_alike() -> None:
    response, pair = Response(0.15, 2.0), FormationModel((-1, 0), axes=1)
    K = pair.overlapping_gain([[-2.1]], [[0.6]], [[2.0]])
    margin_s = sampled_margin(pair, K, [response] * 2, timing=Timing(PERIOD_S, PERIOD_S))
    flown = FlownLoop(ScalarGains(2.1, 0.6, 2.0, 0.0), FlownTiming(margin_s, PERIOD_S), response)
    alphas = [flown.pair.alpha(share * margin_s) for share in (0.6, 0.9, 0.999)]
    assert alphas == sorted(alphas, reverse=True)
    assert alphas[-1] < 2e-3
    limit_s = flown.string_limit_s(1.2)
    assert 0.0 < limit_s < margin_s
    assert flown.string_peak(limit_s * 0.999) <= 1.2 < flown.string_peak(limit_s * 1.001 + 1e-6)


def test_ground_growth_is_the_transfer_peak_half_a_period_later() -> None:
    s = 1j * np.linspace(1e-3, 20.0, 100_001)
    late = np.exp(-s * 0.21)
    direct = np.abs((GAINS.k2 * s + GAINS.k3) * late / (s**2 + (GAINS.k1 * s + GAINS.k3) * late))
    # the grid is 2e-4 rad/s wide
    assert FLOWN.string_peak(0.2) == pytest.approx(float(direct.max()), rel=1e-7)


def test_a_root_on_the_axis_appears_where_alpha_ends() -> None:
    A0, A1 = subsystem(GAINS, 1)
    margin_s = delay_margin(A0, A1)
    flown = FlownLoop(GAINS, FlownTiming(margin_s, 0.0))
    near = flown.pair.alpha(margin_s * (1 - 1e-4))
    root = rightmost_root([(A0, 0.0), (A1, margin_s * (1 - 1e-4))])
    # α is at most the distance of a root to the axis over its condition number
    assert 0.0 < near <= -root.real
