"""Figures of loops with prediction agree with those of other code, and with a simulated loop."""

from math import inf

import numpy as np
import pytest

from gains.core.requirement import Criteria, Requirement
from gains.criteria.figures import LoopFigures
from gains.criteria.predicted import PredictedFigures
from gains.design.predicted import least_gains, longest_assumed_s, predicted_gains
from gains.formation.model import FormationModel
from gains.performance.flown import FlownTiming
from gains.performance.response import Response
from gains.performance.scalar_gains import ScalarGains
from gains.sampled.multirate import Timing
from gains.sampled.prediction import mismatch_window_continuous, predicted_growth_rate

PERIOD_S = 0.02
PAIR = FormationModel((-1, 0), axes=1)
GAINS = ScalarGains(3.408, 0.631, 5.608, 0.0)
K = PAIR.overlapping_gain([[-3.408]], [[0.631]], [[5.608]])
RESPONSES = None, Response(lag_s=0.05, velocity_gain_1_s=2.0)


@pytest.mark.parametrize("response", RESPONSES)
def test_prediction_over_no_delay_is_no_prediction(response: Response | None) -> None:
    responses = None if response is None else (response, response)
    predicted = PredictedFigures(PAIR, K, PERIOD_S, 0.0, (0.15,), response=response)
    plain = LoopFigures(PAIR, K, FlownTiming(inf, PERIOD_S), 0.15, responses=responses)
    assert predicted.window_s[1] == pytest.approx(plain.delay_margin_s, abs=1e-6)
    for name in ("noise_gain_max", "spacing_gain_max_s2", "alpha_at_delay"):
        assert getattr(predicted, name) == pytest.approx(getattr(plain, name), rel=1e-5), name


def test_noise_gain_with_prediction_is_that_of_a_simulated_loop() -> None:
    """Second way: the sum of squares of the commands that a pulse of noise on each state causes."""
    late, delay_s = 5, 0.1
    Phi, G = np.eye(3) + PERIOD_S * PAIR.A, PERIOD_S * PAIR.B + PERIOD_S**2 / 2.0 * PAIR.A @ PAIR.B  # A A = 0
    power = np.zeros(2)
    for state in range(3):
        x, sent = np.zeros(3), [np.zeros(2)] * late
        for tick in range(1500):
            predicted = x + (np.eye(3)[state] if tick == 0 else 0.0)
            for past in sent:  # the oldest command acts first
                predicted = Phi @ predicted + G @ past
            x, sent = Phi @ x + G @ sent[0], [*sent[1:], K @ predicted]
            power += sent[-1] ** 2
    figures = PredictedFigures(PAIR, K, PERIOD_S, delay_s, (delay_s,))
    assert figures.noise_gain_max == pytest.approx(power.max() ** 0.5, rel=1e-6)


def test_noise_near_the_edge_of_the_window_agrees_with_simulation() -> None:
    """As above, for all states at once: assumed 0.6 s, true 0.76 s. Motions decay in 7800 ticks."""
    assumed, late = 30, 38
    Phi, G = np.eye(3) + PERIOD_S * PAIR.A, PERIOD_S * PAIR.B + PERIOD_S**2 / 2.0 * PAIR.A @ PAIR.B
    gain = PAIR.overlapping_gain([[-3.4]], [[0.631]], [[5.4]])
    powers = [np.linalg.matrix_power(Phi, age) for age in range(assumed + 1)]
    ahead = gain @ np.hstack([powers[assumed], *(powers[age] @ G for age in range(assumed))])
    x, sent, power = np.zeros((3, 3)), np.zeros((late * 2, 3)), np.zeros(2)  # the newest command first
    for tick in range(80_000):
        told = x + np.eye(3) if tick == 0 else x
        command = ahead @ np.vstack([told, sent[: 2 * assumed]])
        x, sent = Phi @ x + G @ sent[-2:], np.vstack([command, sent[:-2]])
        power += (command**2).sum(axis=1)
    figures = PredictedFigures(PAIR, gain, PERIOD_S, 0.6, (0.76,))
    assert figures.noise_gain_max == pytest.approx(power.max() ** 0.5, rel=1e-6)


def test_gains_with_prediction_decay_faster_within_a_mismatch() -> None:
    """At least the 2.32 1/s of a grid search, where static gains decay at 0.96 1/s; stable from 0.48 to 0.72 s."""
    criteria = Criteria(0.6, "decay_rate_at_delay_1_s", delays_s=(0.48, 0.72), delay_rate=0.0)
    found = predicted_gains(Requirement(criteria=criteria), PERIOD_S)
    gain = PAIR.overlapping_gain([[-found.k1]], [[found.k2]], [[found.k3]])
    figures = PredictedFigures(PAIR, gain, PERIOD_S, 0.6, (0.6,))
    assert figures.decay_rate_at_delay_1_s > 2.32
    for delay_s in (0.48, 0.72):
        timing = Timing(PERIOD_S, PERIOD_S)
        assert predicted_growth_rate(PAIR.A, PAIR.B, gain, timing, assumed_s=0.6, delay_s=delay_s) < 0.0


def test_the_search_comes_near_the_most_robust_gains() -> None:
    """A simplex search with another code's window found 0.2843 at 1.0 s, stable within 20 % of it."""
    criteria = Criteria(1.0, "alpha_at_delay", delays_s=(0.8, 1.2), delay_rate=0.0)
    found = predicted_gains(Requirement(criteria=criteria, string_peak_max=1.0), PERIOD_S)
    assert found.alpha > 0.98 * 0.2843


DECAY_1_S = 1.735


def test_least_gains_have_the_least_k1_and_k3() -> None:
    """Of all gains on a grid whose sampled loop without delay has its eigenvalues within e^{-sigma T}."""
    least = np.array(least_gains(DECAY_1_S, PERIOD_S))
    first, last = (axis.ravel() for axis in np.meshgrid(*np.outer(least, np.linspace(0.5, 2.0, 61)), indexing="ij"))
    step = np.array([[1.0, PERIOD_S], [0.0, 1.0]])  # e' = v, v' = u = -k1 v - k3 e
    entry = np.array([PERIOD_S**2 / 2.0, PERIOD_S])
    closed = step - entry[:, np.newaxis] * np.stack([last, first], axis=1)[:, np.newaxis, :]
    fast = np.abs(np.linalg.eigvals(closed)).max(axis=1) <= np.exp(-DECAY_1_S * PERIOD_S)
    assert fast.sum() > 300
    assert first[fast].min() >= least[0] * (1.0 - 1e-9)  # rounding
    assert last[fast].min() >= least[1] * (1.0 - 1e-9)


def tolerates(k1: float, k3: float, late_s: float, share: float) -> bool:
    """Whether the continuous loop is stable up to a share of mismatch, by roots on the axis of

    s^2 + k1 s + k3 + ((k1 + k3 tau^) s + k3) (e^{-s tau} - e^{-s tau^}).
    """
    onto = k1 + k3 * late_s
    omega = np.linspace(1e-3, 2.5 * onto + 3.0 * k1, 6000)  # 2 (k1 + k3 tau^) is beyond the last crossing
    s = 1j * omega
    turn = np.exp(-s * late_s) - (s * s + k1 * s + k3) / (onto * s + k3)  # e^{-s tau} at the limit
    beyond = np.abs(turn) - 1.0
    at = np.flatnonzero(beyond[:-1] * beyond[1:] < 0.0)
    longer_s = np.mod(-np.angle(turn[at]) / omega[at] - late_s, 2.0 * np.pi / omega[at])
    nearest_s = min(longer_s.min(), (2.0 * np.pi / omega[at] - longer_s).min())
    return bool(nearest_s >= share * late_s)


@pytest.mark.parametrize(("share", "reached_s"), [(0.2, 0.910), (0.05, 2.159)])
def test_no_gains_that_decay_as_fast_tolerate_longer(share: float, reached_s: float) -> None:
    """By crossings of the continuous loop with half a hold, on a grid; and by the search over k1, k2 and k3."""
    k1, k3 = least_gains(DECAY_1_S, PERIOD_S)
    gains = ScalarGains(k1, 0.2 * k1, k3, 0.0)
    longest_s = longest_assumed_s(gains, PERIOD_S, share, 10.0)
    assert longest_s == pytest.approx(reached_s, rel=1e-3)
    least, late_s = DECAY_1_S, longest_s + PERIOD_S / 2.0
    assert tolerates(2.0 * least, least**2, 0.99 * late_s, share)  # half a hold is 0.9 % off at 0.9 s
    for own in 2.0 * least * np.geomspace(1.0, 1.5, 12):
        for spacing in least * (own - least) * np.geomspace(1.0, 1.8, 12):  # roots left of -sigma
            assert not tolerates(own, spacing, 1.01 * late_s, share)
    around_s = (1.0 - share) * longest_s, (1.0 + share) * longest_s
    criteria = Criteria(longest_s, "decay_rate_at_delay_1_s", delays_s=around_s, delay_rate=0.0)
    found = predicted_gains(Requirement(criteria=criteria, string_peak_max=1.0), PERIOD_S)
    figures = PredictedFigures(PAIR, found.K, PERIOD_S, longest_s, (longest_s,))
    # the search stops 0.3 to 1.7 % short
    assert 0.975 * DECAY_1_S < figures.decay_rate_at_delay_1_s < 1.001 * DECAY_1_S


@pytest.mark.parametrize(("mismatch_s", "decay_1_s"), [(1e-4, 1.515), (1e-3, 1.285), (0.054, 0.296)])
def test_a_mismatch_parts_the_double_root(mismatch_s: float, decay_1_s: float) -> None:
    """Of the least gains of the sampled loop at 2.159 s, and of the gains whose continuous loop has a double root."""
    k1, k3 = least_gains(DECAY_1_S, PERIOD_S)
    for own, spacing, thinned in ((k1, k3, 1), (2.0 * DECAY_1_S, DECAY_1_S**2, 2)):
        gain = ScalarGains(own, 0.2 * own, spacing, 0.0).K
        found = PredictedFigures(PAIR, gain, PERIOD_S, 2.159, (2.159 + mismatch_s,), thinned=thinned)
        assert found.decay_rate_at_delay_1_s == pytest.approx(decay_1_s, abs=2e-3)  # the second has half a hold


def test_the_longest_assumed_delay_has_two_limits() -> None:
    """Unstable gains tolerate none; slow gains tolerate 5 % of the longest that is asked for."""
    assert longest_assumed_s(ScalarGains(1.0, 0.0, -1.0, 0.0), PERIOD_S, 0.05, 10.0) == 0.0
    assert longest_assumed_s(ScalarGains(0.2, 0.0, 0.01, 0.0), PERIOD_S, 0.05, 10.0) == 10.0


@pytest.mark.parametrize("predecessors", [(-1, 0), (-1, 0, 1, 0, 3)])
@pytest.mark.parametrize("assumed_s", [0.1, 0.6, 1.5])
def test_the_window_of_a_search_is_near_the_exact_one(assumed_s: float, predecessors: tuple[int, ...]) -> None:
    model = FormationModel(predecessors, axes=1)
    gain = model.overlapping_gain([[-3.408]], [[0.631]], [[5.608]])
    rough = PredictedFigures(model, gain, PERIOD_S, assumed_s, (assumed_s,), thinned=10)
    half_s = PERIOD_S / 2.0
    least_s, most_s = mismatch_window_continuous(model.A, model.B, gain, assumed_s=assumed_s + half_s)
    # 160 frequencies over three decades
    assert rough.window_s == pytest.approx((max(0.0, least_s - half_s), most_s - half_s), abs=4e-3)


@pytest.mark.parametrize("share", [0.16, 0.22, 0.31])
def test_the_window_of_a_search_knows_which_states_are_measured(share: float) -> None:
    """Taking all of its states as measured puts the window's end 2 to 4 % too far out."""
    gain = PAIR.overlapping_gain([[-3.4 * share]], [[0.6 * share]], [[5.6 * share**2]])
    lagged = Response(lag_s=0.15, velocity_gain_1_s=2.0)
    rough = PredictedFigures(PAIR, gain, PERIOD_S, 0.5, (0.5,), response=lagged, thinned=4)
    assert rough.window_s == pytest.approx(rough.exact.window_s, rel=0.006)
