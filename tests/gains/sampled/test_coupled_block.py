"""Coupled blocks of a formation: which vehicles they hold, and their margins and growth."""

from math import atan, pi, sqrt
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from gains.formation.model import FormationModel
from gains.performance.response import Response, continuous_margin, formation_loop, response_states, sampled_margin
from gains.sampled.coupled_block import CoupledBlock, coupled_blocks, critical_block, first_of_each_kind
from gains.sampled.multirate import Timing

TREE = (-1, 0, 1, 0, 3)
K1, K2, K3 = -3.4, 0.6, 5.6


def tree_blocks(period_s: float = 0.02) -> list[CoupledBlock]:
    K = FormationModel(TREE).overlapping_gain(K1 * np.eye(2), K2 * np.eye(2), K3 * np.eye(2))
    return coupled_blocks(FormationModel(TREE), K, (1, 2, 3, 4, 5), timing=Timing(period_s, period_s))


def test_each_vehicle_of_a_tree_is_its_own_block() -> None:
    blocks = tree_blocks()
    assert sorted(block.system_ids for block in blocks) == [(1,), (2,), (3,), (4,), (5,)]
    leader, follower = first_of_each_kind(blocks)
    assert (leader.system_ids, follower.system_ids) == ((1,), (2,))
    assert leader.K.tolist() == [[K1, 0.0], [0.0, K1]]
    assert follower.K.tolist() == [[K3, 0.0, K1, 0.0], [0.0, K3, 0.0, K1]]


def test_vehicles_that_act_on_each_other_are_one_block() -> None:
    model = FormationModel((-1, 0, 1))
    K = model.overlapping_gain(K1 * np.eye(2), K2 * np.eye(2), K3 * np.eye(2))
    K[model.input_slice(1), model.velocity_slice(2)] = 0.1 * np.eye(2)  # vehicle 2 looks back as well
    blocks = coupled_blocks(model, K, (7, 8, 9), timing=Timing(0.02, 0.02))
    assert [block.system_ids for block in blocks] == [(7,), (8, 9)]


def test_blocks_of_responding_vehicles_have_the_margin_of_the_formation() -> None:
    model, timing = FormationModel((-1, 0, 1)), Timing(0.02, 0.02)
    K = model.overlapping_gain(-1.778 * np.eye(2), 0.549 * np.eye(2), 1.43 * np.eye(2))
    responses = [Response(0.125, 2.78), Response(0.066, 1.88, 0.048), Response(0.11, 1.71, 0.0, 14.0)]
    loop, states = formation_loop(model, K, responses), response_states(model, responses)
    blocks = coupled_blocks(model, K, (1, 2, 3), timing=timing, responding=loop, response_states=states)
    assert [len(block.A) for block in blocks] == [2 + 4, 4 + 12, 4 + 6]
    assert min(block.margin_s() for block in blocks) == pytest.approx(
        sampled_margin(model, K, responses, timing=timing), abs=1e-8
    )
    at_s = continuous_margin(model, K, responses) - 0.01
    assert max(block.growth_continuous_1_s(at_s) for block in blocks) == pytest.approx(0.0, abs=1e-8)


def test_models_meet_the_closed_formulas_at_a_short_period() -> None:
    """Margins of the continuous blocks in closed form; a period T reduces them by T / 2."""
    period_s = 1e-3
    leader, follower = first_of_each_kind(tree_blocks(period_s))
    omega = sqrt((K1**2 + sqrt(K1**4 + 4.0 * K3**2)) / 2.0)
    for block, margin_s in ((leader, pi / (-2.0 * K1)), (follower, atan(-K1 * omega / K3) / omega)):
        assert block.margin_s() == pytest.approx(margin_s - period_s / 2.0, abs=1e-6)
        at_s = margin_s - period_s / 2.0
        assert block.growth_1_s(at_s) == pytest.approx(0.0, abs=1e-5)
        assert block.growth_continuous_1_s(at_s) == pytest.approx(0.0, abs=1e-9)


def test_the_critical_block_grows_most_at_its_own_delay() -> None:
    blocks = tree_blocks()
    delays = {1: 0.25, 2: 0.25, 3: 0.25, 4: 0.28, 5: 0.27}
    assert critical_block(blocks, delays).system_ids == (4,)
    assert critical_block(blocks, {**delays, 1: 0.6}).system_ids == (1,)
    assert critical_block(blocks, dict.fromkeys(delays, 0.25)).system_ids == (2,)  # the first of equals


@pytest.mark.parametrize("whole", [False, True])
def test_positions_instead_of_errors_leave_the_growth_as_it_is(whole: bool) -> None:
    """With and without the leader in the loop; each vehicle responds in its own way, and all states have one age."""
    model = FormationModel((-1, 0, 1))
    K = model.overlapping_gain(-1.778 * np.eye(2), 0.549 * np.eye(2), 1.43 * np.eye(2))
    K[model.input_slice(1), model.velocity_slice(2)] = 0.1 * np.eye(2)
    K[model.input_slice(1), model.spacing_slice(2)] = -0.2 * np.eye(2)
    if whole:
        K[model.input_slice(0), model.spacing_slice(1)] = -0.2 * np.eye(2)
    responses = [Response(0.125, 2.78), Response(0.066, 1.88, 0.048), Response(0.11, 1.71, 0.0, 14.0)]
    loop, states = formation_loop(model, K, responses), response_states(model, responses)
    timing, ids = Timing(0.02, 0.02), (1, 2, 3)
    [*_, shared] = coupled_blocks(model, K, ids, timing=timing, responding=loop, response_states=states)
    assert shared.system_ids == (ids if whole else (2, 3))
    delays_s = {1: 0.2, 2: 0.3, 3: 0.25}
    of_positions = shared.growth_continuous_at_1_s(delays_s, dict.fromkeys(ids, 0.1))
    assert of_positions == pytest.approx(shared.growth_continuous_at_1_s(delays_s), abs=1e-9)


@pytest.mark.parametrize("aged", [False, True])
def test_counted_roots_tell_where_growth_begins(aged: bool) -> None:
    """Also with the root at zero of the formation's position, which states of several ages leave free."""
    model, ids = FormationModel((-1, 0, 1)), (1, 2, 3)
    K = model.overlapping_gain(K1 * np.eye(2), K2 * np.eye(2), K3 * np.eye(2))
    K[model.input_slice(0), model.spacing_slice(1)] = -0.4 * np.eye(2)
    K[model.input_slice(1), model.spacing_slice(2)] = -0.4 * np.eye(2)
    [block] = coupled_blocks(model, K, ids, timing=Timing(0.02, 0.02))
    margin_s = block.margin_s()
    assert [block.is_stable_at(dict.fromkeys(ids, part * margin_s)) for part in (0.9999, 1.0001)] == [True, False]
    for slow in ids:
        for part in (0.98, 1.02):
            delays_s = dict.fromkeys(ids, 0.3 * margin_s) | {slow: part * _edge_s(block, slow, aged=aged)}
            ages_s = {own: at_s / 2.0 for own, at_s in delays_s.items()} if aged else None
            assert block.is_stable_at(delays_s, ages_s) == (block.growth_at_1_s(delays_s, ages_s) < 0.0)


def _edge_s(block: CoupledBlock, slow: int, *, aged: bool) -> float:
    """The loop delay of one vehicle at which the loop breaks, the others having 0.3 of its margin."""
    margin_s = block.margin_s()

    def growth_1_s(delay_s: float) -> float:
        delays_s = dict.fromkeys(block.system_ids, 0.3 * margin_s) | {slow: delay_s}
        return block.growth_at_1_s(delays_s, {own: at_s / 2.0 for own, at_s in delays_s.items()} if aged else None)

    found: Any = brentq(growth_1_s, 0.3 * margin_s, 3.0 * margin_s, xtol=1e-4)
    return float(found)
