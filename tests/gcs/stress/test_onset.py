"""Loops of a formation, and the delay at which measured growth passes zero."""

from math import atan, pi, sqrt

import numpy as np
import pytest

from gains.formation.model import FormationModel
from gains.sampled.multirate import Timing
from gcs.stress.onset import GrowthPoint, Loop, critical_loop, distinct, locate_zero, loops_of

TREE = (-1, 0, 1, 0, 3)
K1, K2, K3 = -3.4, 0.6, 5.6


def tree_loops(period_s: float = 0.02) -> list[Loop]:
    K = FormationModel(TREE).overlapping_gain(K1 * np.eye(2), K2 * np.eye(2), K3 * np.eye(2))
    return loops_of(TREE, (1, 2, 3, 4, 5), K, timing=Timing(period_s, period_s))


def test_every_vehicle_of_a_tree_is_its_own_loop() -> None:
    loops = tree_loops()
    assert sorted(loop.system_ids for loop in loops) == [(1,), (2,), (3,), (4,), (5,)]
    leader, follower = distinct(loops)
    assert (leader.system_ids, follower.system_ids) == ((1,), (2,))
    assert leader.K.tolist() == [[K1, 0.0], [0.0, K1]]
    assert follower.K.tolist() == [[K3, 0.0, K1, 0.0], [0.0, K3, 0.0, K1]]


def test_vehicles_that_act_on_each_other_are_one_loop() -> None:
    model = FormationModel((-1, 0, 1))
    K = model.overlapping_gain(K1 * np.eye(2), K2 * np.eye(2), K3 * np.eye(2))
    K[model.input_slice(1), model.velocity_slice(2)] = 0.1 * np.eye(2)  # vehicle 2 looks back as well
    loops = loops_of((-1, 0, 1), (7, 8, 9), K, timing=Timing(0.02, 0.02))
    assert [loop.system_ids for loop in loops] == [(7,), (8, 9)]


def test_models_meet_the_closed_formulas_at_a_short_period() -> None:
    """Margins of the continuous blocks in closed form; a period T takes half of itself away."""
    period_s = 1e-3
    leader, follower = distinct(tree_loops(period_s))
    omega = sqrt((K1**2 + sqrt(K1**4 + 4.0 * K3**2)) / 2.0)
    for loop, margin_s in ((leader, pi / (-2.0 * K1)), (follower, atan(-K1 * omega / K3) / omega)):
        assert loop.margin_s() == pytest.approx(margin_s - period_s / 2.0, abs=1e-6)
        at_s = margin_s - period_s / 2.0
        assert loop.growth_1_s(at_s) == pytest.approx(0.0, abs=1e-5)
        assert loop.growth_continuous_1_s(at_s) == pytest.approx(0.0, abs=1e-9)


def test_the_critical_loop_grows_most_at_its_own_delay() -> None:
    loops = tree_loops()
    delays = {1: 0.25, 2: 0.25, 3: 0.25, 4: 0.28, 5: 0.27}
    assert critical_loop(loops, delays).system_ids == (4,)
    assert critical_loop(loops, {**delays, 1: 0.6}).system_ids == (1,)
    assert critical_loop(loops, dict.fromkeys(delays, 0.25)).system_ids == (2,)  # the first of equals


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
