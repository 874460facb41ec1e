"""Independent delays: the curves of two delays, the rectangle of a leader-follower formation, stability at a point."""

from collections.abc import Sequence
from itertools import pairwise
from math import inf, pi, sqrt

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from gains.core.errors import BadModelError
from gains.delay.constant import analyse_delay, delay_margin
from gains.delay.rightmost import rightmost_root
from gains.delay.several import Polyline, boundary_of_two_delays, crossing_curves, delay_box, late_by_vehicle
from gains.formation.model import FormationModel

Matrix = NDArray[np.float64]


def random_loop(seed: int) -> list[Matrix]:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    matrices = [rng.normal(size=(n, n)) for _ in range(3)]
    rightmost = float(np.linalg.eigvals(sum(matrices[1:], matrices[0])).real.max())
    return [matrices[0] - (rightmost + 0.5) * np.eye(n), *matrices[1:]]


def stable_at(A0: ArrayLike, late: Sequence[ArrayLike], delays_s: Sequence[float]) -> bool:
    return rightmost_root([(A0, 0.0), *zip(late, delays_s, strict=True)]).real < 0.0


def residual(matrices: list[Matrix], line: Polyline) -> float:
    """The largest least singular value of the characteristic matrix along a polyline."""
    A0, A1, A2 = matrices
    largest = 0.0
    for (first_s, second_s), omega in zip(line.delays_s.tolist(), line.omega_rad_s.tolist(), strict=True):
        turned = A1 * np.exp(-1j * omega * first_s) + A2 * np.exp(-1j * omega * second_s)
        matrix = 1j * omega * np.eye(len(A0)) - A0 - turned
        largest = max(largest, float(np.linalg.svd(matrix, compute_uv=False)[-1]))
    return largest


def meetings(lines: tuple[Polyline, ...], slope: float) -> list[float]:
    """tau_1 at which the polylines meet the ray tau_2 = slope tau_1, by linear interpolation."""
    found: list[float] = []
    for line in lines:
        side = line.delays_s[:, 1] - slope * line.delays_s[:, 0]
        for i in np.flatnonzero(np.sign(side[1:]) != np.sign(side[:-1])).tolist():
            share = side[i] / (side[i] - side[i + 1])
            found.append(float(line.delays_s[i, 0] + share * (line.delays_s[i + 1, 0] - line.delays_s[i, 0])))
    return sorted(found)


@pytest.mark.parametrize("seed", [3, 5, 8, 9, 14, 21])
def test_curves_are_roots_on_the_imaginary_axis(seed: int) -> None:
    matrices = random_loop(seed)
    lines = crossing_curves(*matrices, longest_s=(4.0, 4.0))
    assert lines
    # Newton's method stops at rounding, a few eps times the norm
    assert max(residual(matrices, line) for line in lines) < 1e-12


@pytest.mark.slow(first=5)
@pytest.mark.parametrize("seed", [2, 5, 7, 8, 9, 14, 16, 17, 19, 23])
def test_edge_on_the_diagonal_is_the_margin_of_one_delay(seed: int) -> None:
    A0, A1, A2 = random_loop(seed)
    margin_s = delay_margin(A0, A1 + A2)
    assert 0.0 < margin_s < 4.0
    first_s = meetings(boundary_of_two_delays(A0, A1, A2, longest_s=(4.0, 4.0)), 1.0)[0]
    # chords between points some per cent of a radian apart
    assert first_s == pytest.approx(margin_s, rel=2e-3)


@pytest.mark.parametrize("seed", [2, 7, 15, 26])
def test_all_crossings_on_the_diagonal_are_those_of_one_delay(seed: int) -> None:
    A0, A1, A2 = random_loop(seed)
    crossings = analyse_delay(A0, A1 + A2, horizon_s=1e-300).crossings
    expected = sorted(
        delay_s for c in crossings for delay_s in np.arange(c.delay_s, 2.5, 2.0 * pi / c.omega_rad_s).tolist()
    )
    found = [met for met in meetings(crossing_curves(A0, A1, A2, longest_s=(2.6, 2.6)), 1.0) if met < 2.5]
    # chords again
    assert found == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize("seed", [5, 9, 21])
def test_stability_changes_across_the_edge_only(seed: int) -> None:
    matrices = random_loop(seed)
    lines = boundary_of_two_delays(*matrices, longest_s=(3.0, 3.0))
    for slope in (0.2, 0.7, 1.6):
        edges = [0.0, *meetings(lines, slope), 3.0 / max(slope, 1.0)]
        stable = [
            stable_at(matrices[0], matrices[1:], [middle_s, slope * middle_s])
            for middle_s in ((a + b) / 2.0 for a, b in pairwise(edges))
        ]
        # an edge has a stable side and an unstable one
        assert all(a != b for a, b in pairwise(stable))
        assert stable[0]


def test_scalar_boundary_is_the_closed_form() -> None:
    # s = -e^{-s tau_1} - e^{-s tau_2}
    [line, *_] = boundary_of_two_delays([[0.0]], [[-1.0]], [[-1.0]], longest_s=(3.0, 3.0))
    omega, delays = line.omega_rad_s, line.delays_s
    # cos(alpha) + cos(beta) = 0 and sin(alpha) + sin(beta) = omega
    assert np.abs(np.cos(omega * delays[:, 0]) + np.cos(omega * delays[:, 1])).max() < 1e-12
    assert np.sin(omega * delays[:, 0]) + np.sin(omega * delays[:, 1]) == pytest.approx(omega, abs=1e-12)


def test_published_gain_threshold_with_two_delays() -> None:
    # x' = -2 x + b x(t-1) - x(t-2) is stable for b < 3 (PIETOOLS, examples_DDE_library_PIETOOLS.m, example C), where a
    # real root is at zero
    for gain, stable in ((2.99, True), (3.0 - 1e-9, True), (3.0 + 1e-9, False), (3.01, False)):
        assert stable_at([[-2.0]], [[[gain]], [[-1.0]]], [1.0, 2.0]) == stable


def formation_with_k3(spacings: tuple[float, ...]) -> tuple[FormationModel, Matrix]:
    """A chain whose followers have different spacing gains, k1 = 1; the formation and its gain matrix."""
    formation = FormationModel(tuple(range(-1, len(spacings))), axes=1)
    K = formation.overlapping_gain([[-1.0]], [[0.3]], [[1.0]])
    for i, spacing in enumerate(spacings, start=1):
        K[formation.input_slice(i), formation.spacing_slice(i)] = spacing
    return formation, K


def follower_margin_s(k3: float) -> float:
    """s^2 + (s + k3) e^{-s tau}."""
    omega = sqrt((1.0 + sqrt(1.0 + 4.0 * k3**2)) / 2.0)
    return float(np.arctan(omega / k3)) / omega


def test_leader_follower_formation_takes_a_rectangle_of_delays() -> None:
    spacings = (1.0, 0.5, 2.0)
    formation, K = formation_with_k3(spacings)
    late = late_by_vehicle(formation.B, K, [formation.input_slice(i) for i in range(formation.vehicles)])
    box = delay_box(formation.A, late)
    assert box.is_exact
    # the leader alone is s + e^{-s tau}
    assert box.limits_s == pytest.approx([pi / 2.0, *map(follower_margin_s, spacings)], rel=1e-13)
    # a corner of the box, just inside in all delays and just outside in one: the rightmost root moves by some 1e-4
    inside = [limit * (1.0 - 1e-4) for limit in box.limits_s]
    assert stable_at(formation.A, late, inside)
    for i in range(len(inside)):
        outside = [*inside[:i], box.limits_s[i] * (1.0 + 1e-4), *inside[i + 1 :]]
        assert not stable_at(formation.A, late, outside)


def test_a_gain_that_does_not_fit_the_inputs_is_refused() -> None:
    with pytest.raises(BadModelError, match=r"K has shape \(3, 3\); \(2, 3\) is wanted"):
        late_by_vehicle(np.ones((3, 2)), np.eye(3), [slice(0, 1), slice(1, 2)])


def test_edge_of_two_delays_in_separate_blocks_is_the_rectangle() -> None:
    """Both sides, whichever matrix is called the first."""
    formation, K = formation_with_k3((1.0, 0.5))
    leader, *late = late_by_vehicle(formation.B, K, [formation.input_slice(i) for i in range(3)])
    limits_s = delay_box(formation.A + leader, late).limits_s
    for order in ((0, 1), (1, 0)):
        first, second = (late[k] for k in order)
        lines = boundary_of_two_delays(formation.A + leader, first, second, longest_s=(1.5, 1.5))
        points = np.concatenate([line.delays_s for line in lines])
        off_s = points - np.array([limits_s[k] for k in order])
        for side, along in ((0, 1), (1, 0)):
            on_side = np.abs(off_s[:, side]) < 1e-9
            assert np.ptp(points[on_side, along]) > 0.8 * limits_s[order[along]]  # but for a step at each end
        assert np.abs(off_s).min(axis=1).max() < 1e-9


def test_vehicles_that_know_each_other_have_no_rectangle() -> None:
    # vehicle 1 also uses the spacing of vehicle 2: both delays act in one block
    formation, K = formation_with_k3((1.0, 1.0))
    K[formation.input_slice(1), formation.spacing_slice(2)] = -0.4
    late = late_by_vehicle(formation.B, K, [formation.input_slice(i) for i in range(formation.vehicles)])
    box = delay_box(formation.A, late)
    assert box.coupled == (frozenset({1, 2}),)
    assert (box.is_exact, box.limits_s) == (False, (pi / 2.0, inf, inf))
    # the edge of the region of their two delays is curved: its limit of one depends on the other
    block = slice(1, 5)
    lines = boundary_of_two_delays(
        formation.A[block, block], late[1][block, block], late[2][block, block], longest_s=(1.5, 1.5)
    )
    flat, steep = meetings(lines, 0.2)[0], meetings(lines, 0.8)[0]
    assert abs(flat - steep) > 0.01


def test_box_of_an_unstable_loop_is_empty() -> None:
    assert delay_box([[1.0]], [[[-0.5]]]).limits_s == (0.0,)


def test_delays_that_act_on_nothing_have_no_limit() -> None:
    assert delay_box([[-1.0]], [[[0.0]], [[-3.0]]]).limits_s == (inf, delay_margin([[-1.0]], [[-3.0]]))


@pytest.mark.parametrize("longest_s", [(0.0, 1.0), (1.0, inf), (float("nan"), 1.0)])
def test_box_of_curves_must_be_finite(longest_s: tuple[float, float]) -> None:
    with pytest.raises(BadModelError, match="longest_s is"):
        crossing_curves([[-1.0]], [[1.0]], [[1.0]], longest_s=longest_s)


@pytest.mark.slow(first=8)
@pytest.mark.parametrize("seed", range(24))
def test_curves_reach_the_axes(seed: int) -> None:
    now, first, second = random_loop(seed)
    lines = crossing_curves(now, first, second, longest_s=(4.0, 4.0))
    ends = np.array([end for line in lines for end in (line.delays_s[0], line.delays_s[-1])]).reshape(-1, 2)
    # on an axis one delay is zero: what is left are the critical delays of the other, by another analysis
    for which, A0, A1 in ((0, now + second, first), (1, now + first, second)):
        on_axis = ends[ends[:, 1 - which] == 0.0, which]
        for crossing in analyse_delay(A0, A1).crossings:
            if 0.01 < crossing.delay_s < 3.99 and crossing.direction != 0:
                assert np.abs(on_axis - crossing.delay_s).min() < 1e-9, (which, crossing)
