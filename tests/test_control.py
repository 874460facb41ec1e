"""The control law against the thesis's equations, written out vehicle by vehicle."""

import numpy as np
import pytest

from gcs.control import Formation, Gains, overlapping_control, without
from gcs.telemetry import HISTORY, StateHistory

MS = 1_000_000
RNG = np.random.default_rng(11)
GAINS = Gains(*(RNG.normal(size=(2, 2)) for _ in range(3)))
# 0 leads; 1 and 2 follow it; 3 follows 1; 4 follows 3
TREE = Formation((9, 3, 4, 7, 5), np.array([-1, 0, 0, 1, 3]), np.vstack([np.zeros(2), RNG.normal(size=(4, 2)) * 100]))


def filled(states: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> StateHistory:
    history = StateHistory(len(states))
    for row, state in enumerate(states):
        assert history.add(row, 5 * MS, tuple(state))
    return history


def test_commands_are_those_of_the_thesis() -> None:
    states = RNG.normal(size=(5, 4)) * [1000, 1000, 50, 50]
    v_d = (40.0, -3.0)
    result = overlapping_control(filled(states), TREE, GAINS, nominal_velocity_m_s=v_d, limit_m_s2=1e9)
    for i in range(5):
        e_v = states[i, 2:] - v_d
        u = GAINS.K1 @ e_v
        ahead = TREE.predecessor[i]
        if ahead >= 0:
            d = -TREE.offset_ne_m[i]
            e_p = states[ahead, :2] - states[i, :2] - d
            u = u + GAINS.K2 @ (states[ahead, 2:] - v_d) + GAINS.K3 @ e_p
            assert result.spacing_error_m[i] == pytest.approx(e_p)
        else:
            assert np.isnan(result.spacing_error_m[i]).all()
        assert result.command_m_s2[i] == pytest.approx(u)


def test_command_is_shortened_to_the_limit_and_keeps_its_direction() -> None:
    states = RNG.normal(size=(5, 4)) * 1000
    free = overlapping_control(filled(states), TREE, GAINS, nominal_velocity_m_s=(1.0, 0.0), limit_m_s2=1e9)
    held = overlapping_control(filled(states), TREE, GAINS, nominal_velocity_m_s=(1.0, 0.0), limit_m_s2=5.0)
    assert np.hypot(*held.command_m_s2.T) == pytest.approx(np.full(5, 5.0))
    direction = free.command_m_s2 / np.hypot(*free.command_m_s2.T)[:, None]
    assert held.command_m_s2 == pytest.approx(5.0 * direction)


def test_a_formation_in_place_is_left_alone_though_its_states_are_of_different_instants() -> None:
    v_d = np.array([91.44, 10.0])
    place = np.zeros((5, 2))
    for row in range(1, 5):
        place[row] = place[TREE.predecessor[row]] + TREE.offset_ne_m[row]
    history = StateHistory(5)
    for k in range(10):
        for row in range(5):
            t_ns = 20 * MS * k + 3 * MS * row
            history.add(row, t_ns, (*(place[row] + v_d * t_ns * 1e-9), *v_d))
    result = overlapping_control(history, TREE, GAINS, nominal_velocity_m_s=(91.44, 10.0), limit_m_s2=1e9)
    assert result.command_m_s2 == pytest.approx(np.zeros((5, 2)), abs=1e-9)


def test_unknown_vehicle_gives_no_command_to_itself_and_its_follower_only() -> None:
    history = StateHistory(5)
    for row in (0, 2, 3, 4):
        history.add(row, 5 * MS, (0.0, 0.0, 1.0, 1.0))
    result = overlapping_control(history, TREE, GAINS, nominal_velocity_m_s=(1.0, 0.0), limit_m_s2=1e9)
    assert np.isfinite(result.command_m_s2).all(axis=1).tolist() == [True, False, True, False, True]


def test_lost_vehicles_are_flown_around_with_everybody_in_place() -> None:
    lost = np.array([False, True, False, True, False])
    around = without(TREE, lost)
    assert around.predecessor[4] == 0
    assert around.offset_ne_m[4] == pytest.approx(TREE.offset_ne_m[[1, 3, 4]].sum(axis=0))
    assert around.predecessor[2] == 0


def test_followers_of_a_lost_leader_keep_the_nominal_velocity() -> None:
    around = without(TREE, np.array([True, False, False, False, False]))
    assert around.predecessor.tolist() == [-1, -1, -1, 1, 3]
    assert around.offset_ne_m[1].tolist() == [0.0, 0.0]


def test_interpolation_is_exact_under_constant_acceleration() -> None:
    p, v, a = np.array([3.0, -2.0]), np.array([80.0, 5.0]), np.array([4.0, -9.0])

    def state(t_s: float) -> tuple[float, float, float, float]:
        return (*(p + v * t_s + a * t_s**2 / 2), *(v + a * t_s))

    history = StateHistory(1)
    for k in range(HISTORY + 50):  # more than it keeps
        history.add(0, 20 * MS * k, state(0.02 * k))
    newest_s = 0.02 * (HISTORY + 49)
    for back_s in (0.0, 0.003, 0.4, 2.5):
        t_s = newest_s - back_s
        position, velocity = history.at(np.array([0]), np.array([round(t_s * 1e9)]))
        assert position[0] == pytest.approx(state(t_s)[:2], rel=1e-9)
        assert velocity[0] == pytest.approx(state(t_s)[2:], rel=1e-9)
    ahead_s = newest_s + 0.01  # straight on: off by a t^2 / 2
    position, _ = history.at(np.array([0]), np.array([round(ahead_s * 1e9)]))
    assert position[0] == pytest.approx(np.array(state(ahead_s)[:2]) - a * 0.01**2 / 2, rel=1e-9)


def test_a_report_older_than_the_newest_changes_nothing() -> None:
    history = StateHistory(1)
    assert history.add(0, 100, (1.0, 2.0, 3.0, 4.0))
    assert not history.add(0, 100, (9.0, 9.0, 9.0, 9.0))
    assert not history.add(0, 50, (9.0, 9.0, 9.0, 9.0))
    assert history.newest()[1].tolist() == [[1.0, 2.0]]
