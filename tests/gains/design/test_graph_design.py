"""The graph route from a requirement to a flown design, checked against the parts it is made of."""

from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from gains.core.errors import BadModelError, InfeasibleError
from gains.core.requirement import Requirement
from gains.delay.constant import delay_margin
from gains.design.design import design, evaluate_gains
from gains.design.graph import GraphDesign, GraphMethod
from gains.design.time_scale import time_scaled
from gains.formation.bipartite import expanded_gain, partition_by_input, smallest_partition, verify_expansion
from gains.formation.model import FormationModel
from gains.formation.pattern import Pattern, bidirectional, formation_plant, leader_follower, with_links, without_links
from gains.sampled.constant import spectral_radius
from gcs.plan.planner import flight_plan
from scenarios.errors import ScenarioError
from scenarios.files import load, parse
from tests.support.paths import SCENARIOS

PERIOD_S = 0.02
CHAIN = FormationModel((-1, 0, 1))
TRIANGLE = FormationModel((-1, 0, 0, 1, 2))
# the third vehicle also hears the leader: two predecessors
TWO_AHEAD = with_links(leader_follower(CHAIN), [(2, 0)])
METHODS: tuple[GraphMethod, ...] = ("graph-lqr", "graph-dk")
CASES = [
    pytest.param(CHAIN, leader_follower(CHAIN), id="chain"),
    pytest.param(CHAIN, bidirectional(CHAIN), id="bidirectional"),
    pytest.param(CHAIN, TWO_AHEAD, id="two predecessors"),
    pytest.param(TRIANGLE, leader_follower(TRIANGLE), id="triangle"),
]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("formation", "pattern"), CASES)
def test_design_has_the_margin_asked_for_on_its_pattern(
    formation: FormationModel, pattern: Pattern, method: GraphMethod
) -> None:
    found = design(formation, Requirement(delay_margin_s=0.25), method=method, pattern=pattern, period_s=PERIOD_S)
    assert 0.25 <= found.delay_margin_s <= 0.25 * (1 + 1e-6)
    assert not found.K[~pattern.mask].any()
    # the one-period map is the second opinion on the sampled margin, the closed loop on the decay rate
    A, B = formation.A, formation.B
    radius = [spectral_radius(A, B, found.K, period_s=PERIOD_S, delay_s=s) for s in (0.249, 0.251)]
    assert radius[0] < 1 < radius[1]
    assert found.delay_margin_continuous_s == pytest.approx(delay_margin(A, B @ found.K), rel=1e-9)
    slowest = np.linalg.eigvals(A + B @ found.K).real.max()
    assert found.decay_rate_1_s == pytest.approx(-slowest, rel=1e-6)
    assert found.certificate is not None
    assert 0 > found.certificate.alpha >= -2 * found.decay_rate_1_s
    # closed-loop modes are equal in the expanded space, for both partitions
    plant = formation_plant(formation)
    for partition in (partition_by_input(pattern), smallest_partition(pattern)):
        assert verify_expansion(plant, expanded_gain(pattern, partition), found.K) < 1e-6
    assert found.subgraphs_smallest <= found.subgraphs


@pytest.mark.parametrize("method", ["inclusion", *METHODS])
def test_decay_rate_asked_for_is_reached_with_the_largest_margin(
    method: Literal["inclusion", "graph-dk", "graph-lqr"],
) -> None:
    found = design(CHAIN, Requirement(decay_rate_1_s=0.7), method=method, period_s=PERIOD_S)
    K = found.K if isinstance(found, GraphDesign) else CHAIN.overlapping_gain(found.K1, found.K2, found.K3)
    single = np.linalg.eigvals((CHAIN.A + CHAIN.B @ K)[::2, ::2])
    assert -single.real.max() == pytest.approx(0.7, rel=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_robustness_asked_for_is_reached(method: GraphMethod) -> None:
    found = design(CHAIN, Requirement(alpha=0.3), method=method, period_s=PERIOD_S)
    assert found.alpha == pytest.approx(0.3, rel=1e-6)
    # the frequency response on a grid is the second opinion: its largest value is never above the reciprocal
    omega = np.geomspace(1e-3, 1e3, 2000)
    response = np.linalg.inv(1j * omega[:, None, None] * np.eye(CHAIN.states) - CHAIN.A - CHAIN.B @ found.K)
    peak = float(np.linalg.norm(response, ord=2, axis=(1, 2)).max())
    assert 0.999 / 0.3 <= peak <= (1 + 1e-9) / found.alpha


def test_time_scale_multiplies_the_margin_and_divides_the_decay_rate() -> None:
    K = design(CHAIN, method="graph-lqr", pattern=bidirectional(CHAIN), period_s=PERIOD_S).K
    slow = time_scaled(CHAIN, K, 3.0)
    late, late_slow = CHAIN.B @ K, CHAIN.B @ slow
    assert delay_margin(CHAIN.A, late_slow) == pytest.approx(3 * delay_margin(CHAIN.A, late), rel=1e-10)
    fast_roots, slow_roots = (np.linalg.eigvals(CHAIN.A + part).real.max() for part in (late, late_slow))
    assert slow_roots == pytest.approx(fast_roots / 3, rel=1e-6)


def test_what_cannot_be_had_together_is_named() -> None:
    with pytest.raises(InfeasibleError, match=r"lower that, or delay_margin_s"):
        design(CHAIN, Requirement(delay_margin_s=0.5, alpha=0.9), method="graph-lqr", period_s=PERIOD_S)
    with pytest.raises(InfeasibleError, match=r"alpha = 1\.5 .*: alpha = 0\.\d+ at most; lower that, .*or add links"):
        design(CHAIN, Requirement(alpha=1.5), method="graph-lqr", period_s=PERIOD_S)
    with pytest.raises(InfeasibleError, match="exclude each other"):
        design(CHAIN, Requirement(delay_margin_s=1.0, decay_rate_1_s=3.0), period_s=PERIOD_S)


def test_a_decay_that_the_sampled_loop_cannot_have_is_refused() -> None:
    # a gain that decays like e^-500t without hold, sampled 50 times a second, was once returned with a margin of 0
    with pytest.raises(InfeasibleError, match=r"decay_rate_1_s = 500\.0 with period_s = 0\.02.*: decay_rate_1_s = \d+"):
        design(CHAIN, Requirement(decay_rate_1_s=500.0), method="graph-lqr", period_s=0.02)


def test_missing_link_is_named_before_anything_is_designed() -> None:
    blind = without_links(leader_follower(CHAIN), [(2, 2)])
    with pytest.raises(InfeasibleError, match=r"\(2, 2\)"):
        design(CHAIN, method="graph-dk", pattern=blind, period_s=PERIOD_S)


def test_given_gain_outside_its_pattern_is_refused() -> None:
    K = np.ones((CHAIN.inputs, CHAIN.states))
    with pytest.raises(BadModelError, match="pattern"):
        evaluate_gains(CHAIN, K, pattern=leader_follower(CHAIN), period_s=PERIOD_S)


BIDIRECTIONAL = (SCENARIOS / "chain3_bidirectional.toml").read_text(encoding="utf-8")


def test_design_file_gives_the_gains_that_a_scenario_takes() -> None:
    scenario = load(SCENARIOS / "chain3_bidirectional.toml")
    designed, plan = flight_plan(scenario)
    assert not plan.separable
    assert len(plan.around_loss) == len(plan.gains)
    head, tail = BIDIRECTIONAL.split("[control]")
    blocks = "".join(
        f"[[control.blocks]]\nvehicle = {b.vehicle}\nof = {b.of}\ngain = {[list(row) for row in b.gain]}\n"
        for b in designed.blocks
    )
    head = head.replace("hears = [2]\n", "").replace("hears = [3]\n", "")
    text = head + blocks + "[links]" + tail.split("[links]")[1]
    given, replan = flight_plan(parse(text, Path("given.toml")))
    assert np.array_equal(replan.gain, plan.gain)
    assert given.delay_margin_s == designed.delay_margin_s
    assert given.method == "given"


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("hears = [2]", "hears = [7]", "vehicle 1: hears"),
        ("hears = [3]", "hears = [1]", "vehicle 2: hears"),
        ('method = "graph-lqr"', 'method = "inclusion"', "graph-lqr or graph-dk"),
        ('method = "graph-lqr"', 'method = "magic"', "control.method"),
        ("delay_margin_s = 0.3", "gains = { K1 = -3.0, K2 = 0.5, K3 = 5.0 }", "control.method"),
        (
            "delay_margin_s = 0.3",
            "[[control.blocks]]\nvehicle = 1\nof = 1\ngain = [[1, 2, 3], [1, 2, 3]]",
            r"control.blocks\[0\].gain.*two rows of 2 numbers",
        ),
        (
            "delay_margin_s = 0.3",
            "[[control.blocks]]\nvehicle = 9\nof = 1\ngain = [[1, 2], [1, 2]]",
            r"control.blocks\[0\].vehicle",
        ),
    ],
)
def test_wrong_links_and_gains_are_refused_by_name(before: str, after: str, message: str) -> None:
    assert before in BIDIRECTIONAL
    with pytest.raises(ScenarioError, match=message):
        parse(BIDIRECTIONAL.replace(before, after), Path("bad.toml"))
