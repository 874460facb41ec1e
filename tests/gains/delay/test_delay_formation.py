"""Delay margins of the formation: closed forms, the thesis's gains, and long chains of identical vehicles.

The thesis: P. R. Sahoo, "Decentralized Control Design Approaches for Formation Control of Unmanned Aerial Vehicles",
M.Tech thesis, NIT Rourkela, 2012.
"""

from math import atan, pi, sqrt

import numpy as np
import pytest
from numpy.typing import NDArray

from gains.delay.constant import analyse_delay, delay_margin
from gains.delay.rightmost import rightmost_root
from gains.delay.sweep import frequency_sweep_margin
from gains.margin.opinions import checked_delay_margin
from gains.sampled.constant import sampled_delay_margin

Matrix = NDArray[np.float64]


def follower_margin_s(k1: float, k3: float) -> float:
    """First critical delay of s^2 + (k1 s + k3) e^{-s tau}: |k1 j w + k3| = w^2 and its phase."""
    omega = sqrt((k1**2 + sqrt(k1**4 + 4.0 * k3**2)) / 2.0)
    return atan(k1 * omega / k3) / omega


def chain(vehicles: int, k1: float, k3: float, *, axes: int = 1) -> tuple[Matrix, Matrix, Matrix]:
    """A, B, K of a leader (velocity error) and followers (spacing error, velocity error), K1 = -k1, K2 = 0, K3 = k3."""
    n = 2 * vehicles - 1
    A, B, K = np.zeros((n, n)), np.zeros((n, vehicles)), np.zeros((vehicles, n))
    B[0, 0], K[0, 0] = 1.0, -k1
    for i in range(1, vehicles):
        spacing, speed = 2 * i - 1, 2 * i
        A[spacing, speed], A[spacing, speed - 2 if i > 1 else 0] = -1.0, 1.0
        B[speed, i] = 1.0
        K[i, spacing], K[i, speed], K[i, speed - 2 if i > 1 else 0] = k3, -k1, 0.3
    per_axis = [np.kron(matrix, np.eye(axes)).astype(np.float64) for matrix in (A, B, K)]
    return per_axis[0], per_axis[1], per_axis[2]


@pytest.mark.parametrize(("k1", "k3"), [(1.0, 1.0), (17.0, 10.0), (0.3, 2.0), (5.0, 0.01)])
def test_follower_margin_is_the_closed_form(k1: float, k3: float) -> None:
    # 14 digits: the pair of crossing frequencies is well separated
    assert delay_margin([[0.0, -1.0], [0.0, 0.0]], [[0.0, 0.0], [k3, -k1]]) == pytest.approx(
        follower_margin_s(k1, k3), rel=1e-13
    )


def test_follower_with_unit_gains_takes_0_711119_s() -> None:
    assert delay_margin([[0.0, -1.0], [0.0, 0.0]], [[0.0, 0.0], [1.0, -1.0]]) == pytest.approx(0.711119, abs=5e-7)


def test_leader_margin_is_a_quarter_turn() -> None:
    assert delay_margin([[0.0]], [[-3.0]]) == pytest.approx(pi / 6.0, rel=1e-15)


@pytest.mark.parametrize("vehicles", [2, 12, 40])
def test_chain_margin_does_not_depend_on_its_length(vehicles: int) -> None:
    A, B, K = chain(vehicles, 1.0, 1.0)
    # a defective chain of 12 costs whole-matrix methods 2 to 6 %; block by block nothing is lost
    assert delay_margin(A, B @ K) == pytest.approx(follower_margin_s(1.0, 1.0), rel=1e-13)
    assert frequency_sweep_margin(A, B @ K) == pytest.approx(follower_margin_s(1.0, 1.0), rel=1e-11)


def test_rightmost_root_of_a_chain_is_that_of_one_follower() -> None:
    A, B, K = chain(12, 1.0, 1.0)
    margin_s = follower_margin_s(1.0, 1.0)
    # at the margin the root is on the axis; 1e-13 is rounding in a root of modulus 1.27
    assert abs(rightmost_root([(A, 0.0), (B @ K, margin_s)]).real) < 1e-13


def test_400_followers_are_analysed_once() -> None:
    A, B, K = chain(401, 1.0, 1.0, axes=2)
    analysis = analyse_delay(A, B @ K)
    assert analysis.delay_margin_s == pytest.approx(follower_margin_s(1.0, 1.0), rel=1e-13)
    # two axes: one leader pair and 400 follower pairs each; every crossing is listed once with its multiplicity
    assert [(crossing.roots, crossing.direction) for crossing in analysis.crossings] == [(1600, 1), (4, 1)]
    assert sampled_delay_margin(A, B, K, period_s=0.02) == pytest.approx(
        sampled_delay_margin([[0.0, -1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, -1.0]], period_s=0.02), rel=1e-12
    )


def thesis_loop() -> tuple[Matrix, Matrix, Matrix]:
    """A, B, K of the three-vehicle platoon with the gains printed in chapter 5 (misprint 0.5003 read as 10.5003)."""
    identity, zero = np.eye(2), np.zeros((2, 2))
    A = np.block(
        [
            [zero, zero, zero, zero, zero],
            [identity, zero, -identity, zero, zero],
            [zero, zero, zero, zero, zero],
            [zero, zero, identity, zero, -identity],
            [zero, zero, zero, zero, zero],
        ]
    )
    B = np.zeros((10, 6))
    B[0:2, 0:2] = B[4:6, 2:4] = B[8:10, 4:6] = identity
    K = np.zeros((6, 10))
    K[0:2, 0:2] = [[-18.0874, 0.0005], [0.0005, -18.0874]]
    K[0:2, 2:6] = [[-17.2478, -0.0013, 1.9965, -0.0013], [-0.0013, -17.2478, -0.0013, 1.9965]]
    K[2:4, 0:2] = [[-6.0567, 0.0053], [0.0053, -6.0567]]
    K[2:4, 2:6] = [[2.0180, 0.0015, -17.0089, -0.0005], [0.0015, 2.0180, -0.0005, -17.0089]]
    K[2:4, 6:10] = [[-7.6645, 0.0002, -0.5902, -0.0006], [0.0002, -7.6645, -0.0006, -0.5902]]
    K[4:6, 2:6] = [[5.7726, -0.0002, -2.6051, 0.0036], [-0.0002, 5.7726, 0.0036, -2.6051]]
    K[4:6, 6:10] = [[10.5003, 0.0008, -17.0949, 0.0012], [0.0008, 10.5003, 0.0012, -17.0949]]
    return A, B, K


def own_part(K: Matrix) -> Matrix:
    """The block-diagonal part of K: what each vehicle feeds back of its own state."""
    own = np.zeros_like(K)
    for rows, columns in ((slice(0, 2), slice(0, 2)), (slice(2, 4), slice(2, 6)), (slice(4, 6), slice(6, 10))):
        own[rows, columns] = K[rows, columns]
    return own


def test_thesis_gains_take_1_00796_s_from_late_neighbours_only() -> None:
    A, B, K = thesis_loop()
    own = own_part(K)
    # the published 0.19 s does not follow from the published gains: erratum, confirmed by three methods
    assert checked_delay_margin(A + B @ own, B @ (K - own)) == pytest.approx(1.00796, abs=5e-6)


def test_thesis_gains_take_0_077736_s_when_everything_is_late() -> None:
    A, B, K = thesis_loop()
    assert checked_delay_margin(A, B @ K) == pytest.approx(0.077736, abs=5e-7)


def test_thesis_gains_settle_as_published_at_0_17_s() -> None:
    A, B, K = thesis_loop()
    own = own_part(K)
    # settling in 3.5 s is about 4 / 1.106
    assert rightmost_root([(A + B @ own, 0.0), (B @ (K - own), 0.17)]).real == pytest.approx(-1.106, abs=5e-4)


def test_immediate_own_feedback_makes_a_leader_follower_tree_delay_independent() -> None:
    A, B, K = chain(4, 1.0, 1.0)
    own = np.zeros_like(K)
    own[0, 0] = K[0, 0]
    for i in range(1, 4):
        own[i, 2 * i - 1 : 2 * i + 1] = K[i, 2 * i - 1 : 2 * i + 1]
    assert analyse_delay(A + B @ own, B @ (K - own)).delay_independent
