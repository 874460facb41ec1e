"""Set-points that act early or late in a loop with prediction: proved spreads against adverse simulations."""

from functools import cache

import numpy as np
import pytest

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.formation.model import FormationModel
from gains.performance.response import Response, formation_loop
from gains.sampled.multirate import Timing
from gains.sampled.prediction import mismatch_window
from gains.varying.predicted import (
    PredictedSpread,
    _gain,  # the lemma on which the proof rests
)

PERIOD_S, K1, K3 = 0.02, 3.408, 5.608
TIMING = Timing(PERIOD_S, PERIOD_S)
FOLLOWER = np.array([[0.0, -1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[K3, -K1]])
TICKS = 700
DUE_S = (np.arange(TICKS) * PERIOD_S).astype(np.float64)
UP_S = 0.2
"""Delay of telemetry; only what is between it and the assumed delay matters."""


@cache
def spread(assumed_s: float) -> PredictedSpread:
    return PredictedSpread(*FOLLOWER, TIMING, assumed_s)


def flown(assumed_s: float, mean_age_s: float, late_s: FloatArray, age_s: FloatArray) -> float:
    """How much the largest prediction of the last four seconds exceeds that of seconds 2 to 6, by superposition.

    Set-point j acts at t_j + D + late_j, the state used at tick k was sampled at t_k - age_k. Velocity and spacing
    error are sums of ramps and parabolas of the steps of the set-points: no map, no transfer function.
    """
    due_s, delivery_s = DUE_S, assumed_s - mean_age_s
    acts_s, sampled_s = due_s + delivery_s + late_s, due_s - age_s
    assert (np.diff(acts_s) > -1e-12).all()
    assert (np.diff(sampled_s) > -1e-12).all()
    steps, sizes = np.zeros(TICKS), np.zeros(TICKS)
    command = 0.0
    for k in range(TICKS):

        def moved(at_s: float, begin_s: FloatArray, k: int = k) -> FloatArray:
            since_s = np.maximum(0.0, at_s - begin_s[:k])
            return np.array([-0.5 * since_s**2 @ steps[:k], since_s @ steps[:k]])

        error = np.array([1.0 - 0.5 * sampled_s[k], 0.5]) + moved(sampled_s[k], acts_s)
        off = error - moved(sampled_s[k] - delivery_s, due_s)
        ahead_s = delivery_s + age_s[k]
        spacing, velocity = moved(due_s[k], due_s) + np.array([off[0] - ahead_s * off[1], off[1]])
        steps[k] = K3 * spacing - K1 * velocity - command
        command += steps[k]
        sizes[k] = max(abs(spacing), abs(velocity))
    return float(sizes[-200:].max() / sizes[100:300].max())


def deviations(rng: np.random.Generator, most_s: float) -> FloatArray:
    """One way of jumping between early and late: a square wave, a repeated or a random pattern, slow or fast."""
    kind, t = rng.integers(3), np.arange(TICKS)
    if kind == 0:
        signs = np.sign(np.sin(2.0 * np.pi * t * PERIOD_S / rng.uniform(0.1, 4.0) + rng.uniform(0.0, 6.0)) + 1e-9)
    elif kind == 1:
        pattern = rng.choice([-1.0, 1.0], rng.integers(2, 60))
        signs = np.tile(pattern, TICKS // len(pattern) + 1)[:TICKS]
    else:
        signs = np.repeat(rng.choice([-1.0, 1.0], TICKS), rng.integers(1, 40))[:TICKS]
    return most_s * signs


def in_order(late_s: FloatArray) -> FloatArray:
    """The same without overtaking: a link that keeps the order delays the later ones more."""
    return np.maximum.accumulate(DUE_S + late_s) - DUE_S


def jittery_ages(rng: np.random.Generator, most_s: float) -> FloatArray:
    """Ages of the newest states where the delay of telemetry jumps by so much to both sides."""
    due_s, wait_s = DUE_S, rng.uniform(0.0, PERIOD_S)
    arrival_s = due_s + in_order(deviations(rng, most_s)) + wait_s
    newest = np.maximum(np.searchsorted(arrival_s, due_s, side="right") - 1, 0)
    ages_s = UP_S + due_s - due_s[newest] - wait_s
    return due_s - np.maximum.accumulate(due_s - ages_s)


@pytest.mark.parametrize("assumed_s", [0.3, 0.6, 1.5])
def test_no_jumping_within_the_bound_makes_errors_grow(assumed_s: float) -> None:
    rng, bound_s = np.random.default_rng(1), spread(assumed_s).bound_s(mean_s=assumed_s)
    ages_s = np.full(TICKS, UP_S)
    for _ in range(12):
        assert flown(assumed_s, UP_S, in_order(deviations(rng, bound_s)), ages_s) < 0.7


def test_some_jumping_a_quarter_beyond_makes_errors_grow() -> None:
    """So without telemetry jitter the bound is at most a quarter too small, and the simulation can tell."""
    rng, bound_s = np.random.default_rng(1), spread(0.6).bound_s(mean_s=0.6)
    ages_s = np.full(TICKS, UP_S)
    found = [flown(0.6, UP_S, in_order(deviations(rng, 1.25 * bound_s)), ages_s) for _ in range(25)]
    assert max(found) > 1.0


@pytest.mark.parametrize("telemetry_s", [0.01, 0.05])
def test_ages_and_deliveries_may_jump_together(telemetry_s: float) -> None:
    rng, bound_s = np.random.default_rng(2), spread(0.6).bound_s(mean_s=0.6, telemetry_s=telemetry_s)
    assert bound_s > 0.04
    for _ in range(12):
        late_s = in_order(deviations(rng, bound_s))
        assert flown(0.6, UP_S + PERIOD_S / 2.0, late_s, jittery_ages(rng, telemetry_s)) < 0.7


def test_with_jittery_ages_the_bound_is_cautious() -> None:
    """Deliveries twice as far off, with telemetry of +-30 ms, let errors decay in all that is tried."""
    rng, bound_s = np.random.default_rng(3), spread(0.6).bound_s(mean_s=0.6, telemetry_s=0.03)
    for _ in range(25):
        late_s = in_order(deviations(rng, 2.0 * bound_s))
        assert flown(0.6, UP_S + PERIOD_S / 2.0, late_s, jittery_ages(rng, 0.03)) < 0.9


@pytest.mark.parametrize("seed", range(5))
def test_pulses_within_windows_have_at_most_the_gain_counted_on(seed: int) -> None:
    """The norm of the matrix c_kj itself, for random pulses and windows in order."""
    rng = np.random.default_rng(seed)
    early_s, late_s, windows = *(PERIOD_S * rng.uniform(0.0, 3.0, 2)).tolist(), int(rng.integers(1, 4))
    due_s = np.arange(80) * PERIOD_S
    acts_s = np.maximum.accumulate(due_s + rng.choice([-early_s, late_s, 0.0], 80))
    begin_s, end_s = np.minimum(due_s, acts_s), np.maximum(due_s, acts_s)
    edges_s = np.cumsum(PERIOD_S * rng.integers(0, windows + 1, 80)) + rng.uniform(0.0, PERIOD_S)
    common_s = np.minimum(end_s, edges_s[1:, np.newaxis]) - np.maximum(begin_s, edges_s[:-1, np.newaxis])
    largest_s = float(np.linalg.norm(np.maximum(0.0, common_s), 2))
    assert 0.0 < largest_s <= _gain(early_s, late_s, PERIOD_S, windows) * (1.0 + 1e-12)


def test_the_bound_vanishes_at_both_ends_of_the_window() -> None:
    ends_s = mismatch_window(*FOLLOWER, TIMING, assumed_s=0.6)
    for end_s in ends_s:
        shares = [spread(0.6).bound_s(mean_s=0.6 + share * (end_s - 0.6)) for share in (0.0, 0.5, 0.9, 0.99, 1.01)]
        assert shares == sorted(shares, reverse=True)
        assert 0.0 < shares[-2] < 0.02 * shares[0]
        assert shares[-1] == 0.0
        # a constant mismatch is one way of varying
        for share, bound_s in zip((0.0, 0.5, 0.9, 0.99), shares, strict=False):
            assert bound_s <= (1.0 - share) * abs(end_s - 0.6)


def test_without_sampling_the_bound_is_the_continuous_loops_gain() -> None:
    """1 / max |s K (s I - A - B K)^{-1} e^{A tau^} B|, written out for a double integrator."""
    s = 1j * np.logspace(-3.0, 3.0, 100_001)
    for assumed_s in (0.3, 1.0):
        largest = float(np.abs(s * ((K1 + K3 * assumed_s) * s + K3) / (s * s + K1 * s + K3)).max())
        fine = PredictedSpread(*FOLLOWER, Timing(0.0005, 0.0005), assumed_s)
        # fractions of a period and the last period before the tick, half a per cent together
        assert fine.bound_s(mean_s=assumed_s) == pytest.approx(1.0 / largest, rel=5e-3)


def test_over_a_short_delay_the_bound_is_the_delay() -> None:
    assert spread(0.06).bound_s(mean_s=0.06) == 0.06


def test_jitter_of_telemetry_and_a_longer_delay_leave_less() -> None:
    by_jitter = [spread(0.6).bound_s(mean_s=0.6, telemetry_s=jitter_s) for jitter_s in (0.0, 0.01, 0.03, 0.1)]
    by_delay = [spread(assumed_s).bound_s(mean_s=assumed_s) for assumed_s in (0.3, 0.6, 1.5, 3.0)]
    assert by_jitter == sorted(by_jitter, reverse=True)
    assert by_delay == sorted(by_delay, reverse=True)


def test_a_formation_has_the_bound_of_its_worst_vehicle() -> None:
    chain = FormationModel((-1, 0, 1), axes=1)
    K = chain.overlapping_gain(-K1 * np.eye(1), 0.631 * np.eye(1), K3 * np.eye(1))
    whole = PredictedSpread(chain.A, chain.B, K, TIMING, 0.6)
    assert whole.bound_s(mean_s=0.62) == pytest.approx(spread(0.6).bound_s(mean_s=0.62), rel=1e-9)


def test_a_response_that_hardly_lags_changes_little() -> None:
    """With a lag the acceleration is computed from the commands: another branch of the proof, the same limit."""
    pair, found = FormationModel((-1, 0), axes=1), list[float]()
    K = pair.overlapping_gain(-K1 * np.eye(1), 0.631 * np.eye(1), K3 * np.eye(1))
    for lag_s in (0.002, 0.15):
        loop = formation_loop(pair, K, [Response(lag_s, 0.0)] * 2)
        measured = [k < pair.states for k in range(len(loop[0]))]
        bound_s = PredictedSpread(*loop, TIMING, 0.6, measured).bound_s(mean_s=0.6)
        ends_s = mismatch_window(*loop, TIMING, assumed_s=0.6, measured=measured)
        assert bound_s <= min(0.6 - ends_s[0], ends_s[1] - 0.6)
        found.append(bound_s)
    assert found[0] == pytest.approx(spread(0.6).bound_s(mean_s=0.6), rel=0.02)
    assert 0.0 < found[1] < found[0]


def test_an_unstable_loop_has_no_bound() -> None:
    A, B, K = FOLLOWER
    assert PredictedSpread(A, B, -K, TIMING, 0.6).bound_s(mean_s=0.6) == 0.0


def test_a_negative_mean_is_refused() -> None:
    with pytest.raises(BadModelError, match="mean_s is -1"):
        spread(0.6).bound_s(mean_s=-1.0)
