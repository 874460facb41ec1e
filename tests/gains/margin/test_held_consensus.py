"""Held loops of many equal vehicles: consensus is judged by its disagreement, equal followers by one of them."""

import json

import numpy as np
import pytest

from gains.core.arrays import FloatArray, RealArray
from gains.formation.model import FormationModel
from gains.margin.loop_margin import LoopMargin, loop_margin
from gains.margin.model_file import parse_model
from gains.sampled.constant import period_map

COMPLETE = 2.0 / 3.0 * (3.0 * np.eye(3) - np.ones((3, 3)))  # eigenvalues 0, 2, 2
PATH = np.array([[1.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])  # 0, 1, 3
DIRECTED = np.array([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0], [-1.0, 0.0, 1.0]])  # 0, 1.5 +- 0.866j
PERIOD_S = 0.1


def margin_of(plant: RealArray, entry: RealArray, gain: RealArray, period_s: float | None) -> LoopMargin:
    model = {"A": plant.tolist(), "B": entry.tolist(), "K": gain.tolist(), "hold": True}
    found = loop_margin(parse_model(json.dumps(model | ({} if period_s is None else {"period": period_s}))))
    assert isinstance(found, LoopMargin)
    return found


def radius_on_disagreement(laplacian: FloatArray, delay_s: float) -> float:
    """Spectral radius of the lifted map on x orthogonal to (1, 1, 1), in coordinates that `gains` does not use."""
    basis = np.array([[1.0, 1.0], [-1.0, 1.0], [0.0, -2.0]]) / np.sqrt([2.0, 6.0])
    late = -basis.T @ laplacian @ basis
    map_ = period_map(np.zeros((2, 2)), np.eye(2), late, period_s=PERIOD_S, delay_s=delay_s)
    return float(np.abs(np.linalg.eigvals(map_)).max())


@pytest.mark.parametrize(
    ("laplacian", "margin_s"), [(COMPLETE, 0.737815), (PATH, 0.475802), (DIRECTED, 0.556060)], ids=str
)
def test_held_consensus_is_judged_on_its_disagreement(laplacian: FloatArray, margin_s: float) -> None:
    found = margin_of(np.zeros((3, 3)), np.eye(3), -laplacian, PERIOD_S)
    assert found.delay_margin_s == pytest.approx(margin_s, abs=1e-6)  # its digits
    assert (found.roots_fixed_at_zero, found.unstable_roots_at_zero_delay) == (1, 0)
    # the radius moves by 1e-5 or so for a part in 1e4 of the margin, its rounding by 1e-12
    assert radius_on_disagreement(laplacian, found.delay_margin_s * (1.0 - 1e-4)) < 1.0 - 1e-7
    assert radius_on_disagreement(laplacian, found.delay_margin_s * (1.0 + 1e-4)) > 1.0 + 1e-7


def test_period_of_held_consensus_ends_at_two_over_fastest_mode() -> None:
    # x_{k+1} = (1 - lambda T) x_k leaves the unit circle at lambda T = 2
    found = margin_of(np.zeros((3, 3)), np.eye(3), -PATH, None)
    assert found.stable_intervals_s == ((0.0, pytest.approx(2.0 / 3.0)),)
    assert found.roots_fixed_at_zero == 1


def test_held_formation_of_double_integrators_loses_position_and_velocity() -> None:
    plant, entry = np.kron(np.eye(3), [[0.0, 1.0], [0.0, 0.0]]), np.kron(np.eye(3), [[0.0], [1.0]])
    found = margin_of(plant, entry, np.kron(-COMPLETE, [[0.5, 1.0]]), PERIOD_S)
    alone = margin_of(plant[:2, :2], entry[:2, :1], np.array([[-1.0, -2.0]]), PERIOD_S)  # its one mode, lambda = 2
    assert found.roots_fixed_at_zero == 2
    assert found.delay_margin_s == pytest.approx(alone.delay_margin_s, rel=1e-9)


def test_integrator_that_nobody_feeds_back_has_no_margin() -> None:
    found = margin_of(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)), PERIOD_S)
    assert (found.delay_margin_s, found.roots_fixed_at_zero) == (0.0, 0)


@pytest.mark.parametrize("period_s", [PERIOD_S, None])
def test_equal_followers_have_the_error_and_frequency_of_one(period_s: float | None) -> None:
    def found(followers: int) -> LoopMargin:
        chain = FormationModel((-1, *range(followers)), axes=1)
        return margin_of(chain.A, chain.B, chain.overlapping_gain([[-1.0]], [[0.3]], [[0.25]]), period_s)

    one, many = found(1), found(20)
    assert many.delay_margin_s == pytest.approx(one.delay_margin_s, rel=1e-12)
    assert many.delay_margin_error_s < 1e-6 * many.delay_margin_s
    assert many.crossings[0].omega_rad_s == pytest.approx(one.crossings[0].omega_rad_s, rel=1e-6)
    assert many.checked_by == one.checked_by


def test_a_margin_whose_maps_are_too_large_has_unknown_error() -> None:
    found = margin_of(np.zeros((1, 1)), np.eye(1), -np.eye(1), 0.004)  # pi / 2 s are 393 periods
    assert np.isnan(found.delay_margin_error_s)
    assert found.crossings == found.checked_by == ()


@pytest.mark.parametrize("across", [3, 5, 8])
@pytest.mark.parametrize("share", [2.0**-16, 2.0**-19, 2.0**-25])
def test_error_bounds_a_period_beside_a_double_eigenvalue(across: int, share: float) -> None:
    # p'' = -k p - p' held for T has a pair on the circle at T = 2 / k; with k = 1 it is double, at z = -1. Whole
    # numbers of determinant one mix the states without rounding.
    mixed = np.array([[1.0, across], [12.0, 1.0 + 12.0 * across]])
    back = np.array([[1.0 + 12.0 * across, -across], [-12.0, 1.0]])
    k = 1.0 + share
    found = margin_of(
        back @ [[0.0, 1.0], [0.0, 0.0]] @ mixed, back @ [[0.0], [1.0]], np.array([[-k, -1.0]]) @ mixed, None
    )
    assert abs(found.delay_margin_s - 2.0 / k) < found.delay_margin_error_s < 1e-4
