"""Designs and evaluations: independent analyses find what was asked for, and the report is complete."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from gains.core.errors import BadModelError, InfeasibleError
from gains.core.requirement import Criteria
from gains.criteria.predicted import PredictedFigures, fed_forward
from gains.delay.constant import delay_margin
from gains.design.design import Design, Requirement, design, evaluate_gains, trade_off
from gains.formation.model import FormationModel
from gains.performance.robust import robustness
from gains.performance.scalar_gains import PAIR, ScalarGains
from gains.performance.string_stability import string_peak
from gains.sampled.constant import sampled_delay_margin, spectral_radius

TRIANGLE = FormationModel((-1, 0, 1, 0, 3))
PERIOD_S = 0.05
EYE = np.eye(2)


@pytest.fixture(scope="module")
def default_design() -> Design:
    return design(TRIANGLE, period_s=PERIOD_S)


def test_default_design_has_just_the_margin_asked_for(default_design: Design) -> None:
    A, B = TRIANGLE.A, TRIANGLE.B
    K = TRIANGLE.overlapping_gain(default_design.K1, default_design.K2, default_design.K3)
    margin_s = sampled_delay_margin(A, B, K, period_s=PERIOD_S)
    assert 0.3 <= margin_s <= 0.3 + 1e-9
    assert default_design.delay_margin_s == margin_s
    assert default_design.delay_margin_continuous_s == delay_margin(A, B @ K)
    # The hold costs about half a period.
    assert default_design.delay_margin_continuous_s - margin_s == pytest.approx(PERIOD_S / 2, abs=2e-3)


def test_sampled_loop_is_stable_just_below_its_margin_not_above(default_design: Design) -> None:
    """By the spectral radius of the one-period map, which no formula of the design uses."""
    K = TRIANGLE.overlapping_gain(default_design.K1, default_design.K2, default_design.K3)
    below, above = (
        spectral_radius(TRIANGLE.A, TRIANGLE.B, K, period_s=PERIOD_S, delay_s=0.3 * factor) for factor in (0.999, 1.001)
    )
    assert below < 1 < above


def test_default_design_is_proved_and_reported(default_design: Design) -> None:
    assert default_design.alpha == robustness(default_design.K1, default_design.K2, default_design.K3)
    certificate = default_design.certificate
    assert certificate is not None
    assert 0.999 * default_design.alpha < certificate.alpha < default_design.alpha
    assert certificate.P_eigenvalue_min > 0 > certificate.s_procedure_eigenvalue_max
    assert (default_design.loop, default_design.method, default_design.vehicles) == ("ground", "inclusion", 5)


def test_block_margins_are_the_closed_forms(default_design: Design) -> None:
    """Leader π / (2 k1) at ω = k1; follower atan(k1 ω / k3) / ω, ω² = (k1² + √(k1⁴ + 4 k3²)) / 2."""
    k1, k3 = -default_design.K1[0, 0], default_design.K3[0, 0]
    omega = np.sqrt((k1**2 + np.sqrt(k1**4 + 4 * k3**2)) / 2)
    leader, follower = default_design.leader, default_design.follower
    assert leader.delay_margin_s == pytest.approx(np.pi / (2 * k1), rel=1e-9)
    assert leader.crossing_rad_s == pytest.approx(k1, rel=1e-9)
    assert follower.delay_margin_s == pytest.approx(np.arctan2(k1 * omega, k3) / omega, rel=1e-9)
    assert follower.crossing_rad_s == pytest.approx(omega, rel=1e-9)


def test_behaviour_is_that_of_the_characteristic_polynomial(default_design: Design) -> None:
    """s² + k1 s + k3: decay k1 / 2, damping k1 / (2 √k3); k1² < 4 k3 here. Γ on a dense grid."""
    k1, k2, k3 = -default_design.K1[0, 0], default_design.K2[0, 0], default_design.K3[0, 0]
    behaviour = default_design.behaviour
    # A double root each for the two axes, not defective: rounding.
    assert behaviour.decay_rate_1_s == pytest.approx(k1 / 2, rel=1e-6)
    assert behaviour.damping == pytest.approx(k1 / (2 * np.sqrt(k3)), rel=1e-6)
    s = 1j * np.geomspace(1e-3, 100, 100_001)
    for delay_s, peak in ((0.0, behaviour.string_peak), (behaviour.delay_s, behaviour.string_peak_delayed)):
        late = np.exp(-s * delay_s)
        growth = np.abs((k2 * s + k3) * late / (s**2 + (k1 * s + k3) * late)).max()
        # The grid's steps of 1e-4 about the peak of a smooth curve.
        assert peak == pytest.approx(growth, rel=1e-5)
    assert behaviour.delay_s == pytest.approx((0.3 + PERIOD_S) / 2, abs=1e-9)
    # On the ray of the damping ratio with delay the characteristic equation has a root; steps of 1e-4 leave about 1e-3.
    ray = -behaviour.damping_delayed + 1j * np.sqrt(1 - behaviour.damping_delayed**2)
    s = ray * np.arange(0.1, 10, 1e-4)
    assert np.abs(s**2 + (k1 * s + k3) * np.exp(-s * behaviour.delay_s)).min() < 2e-3


def test_alpha_alone_gets_the_largest_margin() -> None:
    found = design(TRIANGLE, Requirement(alpha=0.8), period_s=PERIOD_S)
    # The search resolves α to 1e-9.
    assert 0.8 <= found.alpha <= 0.8 + 1e-8
    # α falls by about 1 per second of margin, and at 0.3 s it is above 0.8.
    assert 0.30 < found.delay_margin_s < 0.32
    with pytest.raises(InfeasibleError):
        design(TRIANGLE, Requirement(alpha=0.8, delay_margin_s=found.delay_margin_s + 1e-6), period_s=PERIOD_S)


def test_alpha_and_margin_are_both_met_when_they_can_be() -> None:
    found = design(TRIANGLE, Requirement(alpha=0.7, delay_margin_s=0.3), period_s=PERIOD_S)
    assert found.delay_margin_s >= 0.3
    assert found.alpha > 0.8


def scalar_scan(*, delay_margin_s: float = 0.0, decay_rate_1_s: float = 0.0) -> list[tuple[float, float, float]]:
    """(k1, k3, margin) of followers on a plain grid whose sampled margin and decay rate are no less."""
    found: list[tuple[float, float, float]] = []
    for k1 in np.linspace(1.0, 6.0, 51).tolist():
        for k3 in np.linspace(0.2, 12.0, 119).tolist():
            omega = np.sqrt((k1**2 + np.sqrt(k1**4 + 4 * k3**2)) / 2)
            # the hold costs about half a period; a tenth of one for what is of higher order
            margin_s = float(np.arctan2(k1 * omega, k3) / omega) - 0.6 * PERIOD_S
            decay = -float(np.roots([1.0, k1, k3]).real.max())
            if margin_s >= delay_margin_s and decay >= decay_rate_1_s:
                found.append((k1, k3, margin_s))
    return found


def test_decay_rate_alone_gets_the_largest_margin() -> None:
    found = design(TRIANGLE, Requirement(decay_rate_1_s=1.0), period_s=PERIOD_S)
    assert found.behaviour.decay_rate_1_s == pytest.approx(1.0, rel=1e-6)
    assert found.delay_margin_s >= max(margin_s for _, _, margin_s in scalar_scan(decay_rate_1_s=1.0))


def test_decay_rate_is_refused_only_where_no_gains_have_it() -> None:
    # these were once refused: the most robust gains of that margin are slower
    assert scalar_scan(delay_margin_s=0.57, decay_rate_1_s=1.05)
    found = design(TRIANGLE, Requirement(delay_margin_s=0.57, decay_rate_1_s=1.05), period_s=PERIOD_S)
    assert found.delay_margin_s >= 0.57
    assert found.behaviour.decay_rate_1_s >= 1.05 * (1 - 1e-6)
    assert not scalar_scan(delay_margin_s=0.57, decay_rate_1_s=1.2)
    with pytest.raises(InfeasibleError, match=r"lower delay_margin_s to .* or lower decay_rate_1_s to"):
        design(TRIANGLE, Requirement(delay_margin_s=0.57, decay_rate_1_s=1.2), period_s=PERIOD_S)


@pytest.mark.slow(first=4)
@pytest.mark.parametrize(
    "wanted",
    [
        {"alpha": 0.9, "delay_margin_s": 0.3},
        {"alpha": 0.9999},
        {"decay_rate_1_s": 500.0},
        {"delay_margin_s": 0.5, "decay_rate_1_s": 3.0},
        {"alpha": 0.75, "delay_margin_s": 0.3, "decay_rate_1_s": 2.05},
        {"alpha": 0.805, "delay_margin_s": 0.3, "string_peak_max": 1.0},
    ],
)
def test_a_refusal_says_what_each_part_would_have_to_be(wanted: dict[str, Any]) -> None:
    with pytest.raises(InfeasibleError) as refused:
        design(TRIANGLE, Requirement(**wanted), period_s=PERIOD_S)
    offers = re.findall(r"lower (\w+) to ([0-9.e-]+)", str(refused.value))
    assert offers
    for name, most in offers:
        assert float(most) < wanted[name]
        # what is offered is feasible, and hardly more is
        relaxed: dict[str, Any] = wanted | {name: float(most)}
        design(TRIANGLE, Requirement(**relaxed), period_s=PERIOD_S)
        relaxed[name] *= 1.002
        with pytest.raises(InfeasibleError):
            design(TRIANGLE, Requirement(**relaxed), period_s=PERIOD_S)
    assert ("raise string_peak_max" in str(refused.value)) == ("string_peak_max" in wanted)


def test_string_stability_costs_little_alpha_and_holds_down_a_chain(default_design: Design) -> None:
    chain = FormationModel(tuple(range(-1, 19)))
    found = design(chain, Requirement(string_peak_max=1.0), period_s=PERIOD_S)
    assert default_design.behaviour.string_peak_delayed > 1.5
    # The search for the frequency of the peak resolves it to 1e-6.
    assert found.behaviour.string_peak_delayed <= 1 + 1e-6
    assert default_design.alpha - 0.01 < found.alpha < default_design.alpha
    # The impulse response of the whole chain: no spacing error exceeds that of the first follower in energy.
    A = chain.A + chain.B @ chain.overlapping_gain(found.K1, found.K2, found.K3)
    omega = np.geomspace(0.01, 30, 300)
    start = np.zeros(chain.states)
    start[chain.velocity_slice(0)] = 1
    response = np.linalg.solve(1j * omega[:, None, None] * np.eye(len(A)) - A, start[:, None])[:, :, 0]
    spacing = np.array([np.linalg.norm(response[:, chain.spacing_slice(i)], axis=1) for i in chain.followers])
    assert (spacing[1:] <= spacing[:-1] * (1 + 1e-6)).all()


def follower(gains: ScalarGains, share: float) -> Callable[[float], PredictedFigures]:
    """The figures at a loop delay of the sampled loop of a vehicle and its follower, without prediction."""
    return lambda delay_s: PredictedFigures(PAIR, gains.K, 0.02, 0.0, (delay_s,), chain=True, feed_forward=share)


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_gains_are_designed_for_the_command_fed_forward(share: float) -> None:
    """α, proof, margin and growth of the loop that flies, each against another computation of it."""
    wanted = Requirement(delay_margin_s=0.3, string_peak_max=1.0, feed_forward=share)
    found = design(TRIANGLE, wanted, period_s=0.02)
    k1, k2, k3 = -found.K1[0, 0], found.K2[0, 0], found.K3[0, 0]
    flown = fed_forward(TRIANGLE, TRIANGLE.overlapping_gain(found.K1, found.K2, found.K3), share)
    # the first follower's row of the flown gain is (3.26) with the gain on the leader's velocity error that it shows
    on_leader = flown[TRIANGLE.input_slice(1), TRIANGLE.velocity_slice(0)]
    assert found.alpha == pytest.approx(robustness(found.K1, on_leader, found.K3), rel=1e-12)
    assert found.certificate is not None
    assert 0.999 * found.alpha < found.certificate.alpha < found.alpha
    assert 0.3 <= sampled_delay_margin(TRIANGLE.A, TRIANGLE.B, flown, period_s=0.02) <= 0.3 + 1e-9
    loop = follower(ScalarGains(k1, k2, k3, 0.0), share)
    # 2e-3: the design takes the hold as half a period of delay
    assert max(loop(delay_s).string_peak for delay_s in (0.0, 0.15)) <= 1.0 + 2e-3
    # tried one by one, no other gain on the velocity in front has a larger α without growth
    tried = [
        robustness(-k1, other - share * k1, k3)
        for other in np.linspace(-2.0 * k1, 2.0 * k1, 81)
        if string_peak((found.K1, other * EYE, found.K3), 0.16, feed_forward=share) <= 1.0
        and string_peak((found.K1, other * EYE, found.K3), 0.0, feed_forward=share) <= 1.0
    ]
    assert max(tried) <= found.alpha + 1e-9
    bare = design(TRIANGLE, Requirement(delay_margin_s=0.3, string_peak_max=1.0), period_s=0.02)
    late = follower(ScalarGains(-bare.K1[0, 0], bare.K2[0, 0], bare.K3[0, 0], 0.0), 0.0)
    assert loop(0.25).string_peak < 0.6 * late(0.25).string_peak


def test_trade_off_falls_and_passes_through_the_design(default_design: Design) -> None:
    limit = default_design.requirement.string_peak_max if default_design.requirement else None
    alphas = {point.delay_margin_s: point.alpha for point in trade_off(period_s=PERIOD_S, string_peak_max=limit)}
    assert len(alphas) >= 8
    assert list(alphas.values()) == sorted(alphas.values(), reverse=True)
    # The design aims 2e-10 s above the margin, and the slope is about −1 per second.
    assert alphas[0.3] == pytest.approx(default_design.alpha, abs=2e-9)


def test_number_of_vehicles_changes_neither_gains_nor_margins(default_design: Design) -> None:
    """Identical followers give one defective chain of roots; 60 deep, whole-matrix methods fail."""
    found = design(FormationModel(tuple(range(-1, 59))), period_s=PERIOD_S)
    np.testing.assert_array_equal(found.K1, default_design.K1)
    np.testing.assert_array_equal(found.K3, default_design.K3)
    assert found.delay_margin_s == pytest.approx(default_design.delay_margin_s, rel=1e-12)
    assert found.delay_margin_continuous_s == pytest.approx(default_design.delay_margin_continuous_s, rel=1e-12)


def test_given_gains_are_evaluated() -> None:
    """k1 = k3 = 1, all feedback late: continuous margin 0.711119 s and string peak 1.47 without delay at K2 = k1."""
    found = evaluate_gains(TRIANGLE, (-EYE, EYE, EYE), period_s=0.02)
    assert found.delay_margin_continuous_s == pytest.approx(0.711119, abs=1e-6)
    assert found.delay_margin_s == pytest.approx(0.711119 - 0.01, abs=1e-3)
    assert found.behaviour.string_peak == pytest.approx(1.47, abs=5e-3)
    assert found.method == "given"
    assert found.alpha == robustness(-EYE, EYE, EYE)


def test_coupled_axes_are_evaluated() -> None:
    K1 = np.array([[-3.0, 0.4], [-0.4, -3.0]])
    found = evaluate_gains(TRIANGLE, (K1, 2 * EYE, 4 * EYE), period_s=0.02)
    # K1 has eigenvalues −3 ± 0.4j: z' = (−3 + 0.4j) z(t − τ) turns unstable at (π/2 − atan(0.4 / 3)) / |−3 + 0.4j|.
    closed_form = (np.pi / 2 - np.arctan2(0.4, 3)) / np.hypot(3, 0.4)
    assert found.leader.delay_margin_s == pytest.approx(closed_form, rel=1e-9)
    assert 0 < found.delay_margin_s < found.delay_margin_continuous_s
    assert found.certificate is not None


def test_an_unstable_loop_is_reported_without_margin_and_proof() -> None:
    found = evaluate_gains(TRIANGLE, (EYE, EYE, EYE), period_s=0.02)
    assert (found.alpha, found.delay_margin_s, found.delay_margin_continuous_s, found.certificate) == (0, 0, 0, None)


def test_a_design_is_written_as_strict_json(default_design: Design) -> None:
    fields = json.loads(json.dumps(default_design.to_dict(), allow_nan=False))
    assert fields["K2_1_s"] == default_design.K2.tolist()
    assert default_design.certificate is not None
    assert fields["certificate"]["P"] == default_design.certificate.P.tolist()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("delay_margin_s", 0.0),
        ("delay_margin_s", np.nan),
        ("delay_margin_s", 31.0),
        ("alpha", -1.0),
        ("alpha", 1e-4),
        ("string_peak_max", 0.9),
        ("loop", "Onboard"),
        ("feed_forward", -3.0),
    ],
)
def test_requirement_out_of_range_is_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(BadModelError, match=name):
        Requirement(**{name: value})


def test_period_and_gains_are_checked() -> None:
    with pytest.raises(BadModelError, match="period_s is 0"):
        design(TRIANGLE, period_s=0.0)
    with pytest.raises(BadModelError, match="K1 has shape"):
        evaluate_gains(TRIANGLE, ([[1.0]], EYE, EYE), period_s=PERIOD_S)
    with pytest.raises(BadModelError, match="period_s is -1"):
        trade_off(period_s=-1.0)
    with pytest.raises(BadModelError, match=r"string_peak_max = 0\.5"):
        trade_off(period_s=PERIOD_S, string_peak_max=0.5)


def test_unknown_choices_and_shares_are_refused() -> None:
    unknown: Any = "lqr"
    with pytest.raises(BadModelError, match="method = 'lqr'; wanted inclusion, graph-dk or graph-lqr"):
        design(TRIANGLE, period_s=PERIOD_S, method=unknown)
    with pytest.raises(BadModelError, match="maximise = 'lqr'"):
        Criteria(maximise=unknown)
    with pytest.raises(BadModelError, match="feed_forward = -3"):
        evaluate_gains(TRIANGLE, (-EYE, 0.0 * EYE, EYE), period_s=PERIOD_S, feed_forward=-3.0)


def test_importing_the_design_imports_no_slow_library() -> None:
    """cvxpy takes seconds to import and scipy.optimize most of one; commands that only ask for help must not wait."""
    slow = ("cvxpy", "scipy.optimize", "scipy.signal")
    code = f"import sys, gains.design.design; print([name for name in {slow} if name in sys.modules])"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert printed.strip() == "[]"
