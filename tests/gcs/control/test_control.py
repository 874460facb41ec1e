"""The control law against the thesis's equations, written out vehicle by vehicle."""

from dataclasses import dataclass

import numpy as np
import pytest

from gains.core.arrays import FloatArray
from gains.formation.model import FormationModel
from gcs.control.history import HISTORY, StateHistory
from gcs.control.law import FeedbackLaw, TickInputs, feedback_law, formation_control, unblended
from gcs.control.limits import shorten
from gcs.plan.formation import Formation

MS = 1_000_000
RNG = np.random.default_rng(11)
K1, K2, K3 = (RNG.normal(size=(2, 2)) for _ in range(3))
NOBODY = (False,) * 5
FASTEST = 0, 0, 1.0
"""Gain set flown, the former one, and the share of the first."""
# 0 leads; 1 and 2 follow it; 3 follows 1; 4 follows 3
MODEL = FormationModel((-1, 0, 0, 1, 3))
TREE = Formation((9, 3, 4, 7, 5), MODEL, np.vstack([np.zeros(2), RNG.normal(size=(4, 2)) * 100]))
OVERLAPPING = MODEL.overlapping_gain(K1, K2, K3)


def filled(states: FloatArray) -> StateHistory:
    history = StateHistory(len(states))
    for row, (north, east, v_north, v_east) in enumerate(states.tolist()):
        assert history.add(row, 5 * MS, (north, east, v_north, v_east))
    return history


@dataclass(frozen=True)
class Controlled:
    """What the law gave, a row (north, east) for each vehicle."""

    command_m_s2: FloatArray
    spacing_error_m: FloatArray
    velocity_error_m_s: FloatArray


def controlled(
    history: StateHistory,
    K: tuple[FloatArray, ...] = (OVERLAPPING,),
    lost: tuple[bool, ...] = NOBODY,
    *,
    v_d: tuple[float, float] = (1.0, 0.0),
    blend: tuple[int, int, float] = FASTEST,
) -> Controlled:
    law, blends = feedback_law(TREE, K, lost), unblended(5)
    blends[:] = blend
    controls = formation_control(history, law, blends, TickInputs(0, 0.0, v_d))
    return Controlled(*(controls[name] for name in ("command_m_s2", "spacing_error_m", "velocity_error_m_s")))


def errors(states: FloatArray, v_d: tuple[float, float]) -> FloatArray:
    """The error vector e of the thesis (2.10), from the definition."""
    parts = [states[0, 2:] - v_d]
    for i in range(1, 5):
        ahead = MODEL.predecessors[i]
        d = -TREE.offset_ne_m[i]
        parts += [states[ahead, :2] - states[i, :2] - d, states[i, 2:] - v_d]
    return np.concatenate(parts)


def of_each(law: FeedbackLaw) -> list[object]:
    """The law of each vehicle: its terms, and the vehicle ahead."""
    terms = [slice(*law.begin[row : row + 2]) for row in range(5)]
    parts = law.to, law.source, law.offset_ne_m, law.gains
    return [([part[own].tolist() for part in parts], law.ahead.item(row)) for row, own in enumerate(terms)]


@pytest.mark.parametrize("gain", [OVERLAPPING, RNG.normal(size=OVERLAPPING.shape)], ids=["overlapping", "full"])
def test_a_returning_vehicle_has_its_law_others_fly_without_it(gain: FloatArray) -> None:
    away = (False, True, False, False, False)
    returning, lost, all_there = (
        of_each(feedback_law(TREE, (gain,), gone, back))
        for gone, back in ((NOBODY, away), (away, NOBODY), (NOBODY, NOBODY))
    )
    assert returning[1] == all_there[1]
    assert [returning[row] for row in (0, 2, 3, 4)] == [lost[row] for row in (0, 2, 3, 4)]
    assert returning != all_there


@pytest.mark.parametrize("gain", [OVERLAPPING, RNG.normal(size=OVERLAPPING.shape)], ids=["overlapping", "full"])
def test_commands_are_those_of_the_thesis(gain: FloatArray) -> None:
    states = RNG.normal(size=(5, 4)) * [1000, 1000, 50, 50] + [1e5, -1e5, 0, 0]
    v_d = (40.0, -3.0)
    result = controlled(filled(states), (gain,), v_d=v_d)
    e = errors(states, v_d)
    assert result.command_m_s2.ravel() == pytest.approx(gain @ e, rel=1e-9)
    for i in range(1, 5):
        assert result.spacing_error_m[i] == pytest.approx(e[MODEL.spacing_slice(i)], rel=1e-9)
    assert np.isnan(result.spacing_error_m[0]).all()
    assert result.velocity_error_m_s == pytest.approx(states[:, 2:] - v_d)


def test_gains_are_blended_by_their_share() -> None:
    history = filled(RNG.normal(size=(5, 4)) * 10)
    fast, slow = (controlled(history, (K,)).command_m_s2 for K in (OVERLAPPING, OVERLAPPING / 4))
    both = (OVERLAPPING, OVERLAPPING / 4)
    assert controlled(history, both, blend=(1, 0, 1.0)).command_m_s2 == pytest.approx(slow)
    assert controlled(history, both, blend=(1, 0, 0.25)).command_m_s2 == pytest.approx(0.25 * slow + 0.75 * fast)


def test_command_is_shortened_to_the_limit_and_keeps_its_direction() -> None:
    states = RNG.normal(size=(5, 4)) * 1000
    free = controlled(filled(states))
    held = free.command_m_s2.copy()
    shorten(held, 5.0)
    direction = free.command_m_s2 / np.hypot(*free.command_m_s2.T)[:, None]
    assert np.array(held) == pytest.approx(5.0 * direction)


def test_states_of_different_instants_leave_a_formation_in_place_alone() -> None:
    v_d = (91.44, 10.0)
    place = TREE.place_ne_m()
    history = StateHistory(5)
    for k in range(10):
        for row in range(5):
            t_ns = 20 * MS * k + 3 * MS * row
            north, east = place[row] + np.array(v_d) * t_ns * 1e-9
            history.add(row, t_ns, (north, east, *v_d))
    result = controlled(history, v_d=v_d)
    assert result.command_m_s2 == pytest.approx(np.zeros((5, 2)), abs=1e-9)


def test_only_an_unknown_vehicle_and_its_follower_get_no_command() -> None:
    history = StateHistory(5)
    for row in (0, 2, 3, 4):
        history.add(row, 5 * MS, (0.0, 0.0, 1.0, 1.0))
    result = controlled(history)
    assert np.isfinite(result.command_m_s2).all(axis=1).tolist() == [True, False, True, False, True]


def test_lost_vehicles_are_bridged_without_moving_those_in_place() -> None:
    place = TREE.place_ne_m()
    states = np.hstack([place + np.array([500.0, 300.0]), np.tile([40.0, 2.0], (5, 1))])
    states[[1, 3]] = np.nan
    result = controlled(filled(states), lost=(False, True, False, True, False), v_d=(40.0, 2.0))
    assert result.command_m_s2[[0, 2, 4]] == pytest.approx(np.zeros((3, 2)), abs=1e-9)
    assert np.isnan(result.command_m_s2[[1, 3]]).all()
    states[4] += [3.0, -4.0, 0.5, 0.25]  # vehicle 4 now keeps its distance to the leader
    states[0, 2:] += [0.125, 1.0]
    result = controlled(filled(states), lost=(False, True, False, True, False), v_d=(40.0, 2.0))
    assert result.command_m_s2[4] == pytest.approx(K1 @ [0.5, 0.25] + K2 @ [0.125, 1.0] + K3 @ [-3.0, 4.0])


def test_followers_of_a_lost_leader_keep_the_nominal_velocity() -> None:
    states = RNG.normal(size=(5, 4)) * 10
    result = controlled(filled(states), lost=(True, False, False, False, False), v_d=(4.0, 2.0))
    assert result.command_m_s2[1] == pytest.approx(K1 @ (states[1, 2:] - [4.0, 2.0]))
    assert np.isnan(result.spacing_error_m[1]).all()


def test_if_all_vehicles_are_lost_none_is_commanded() -> None:
    result = controlled(filled(RNG.normal(size=(5, 4))), lost=(True,) * 5)
    assert np.isnan(result.command_m_s2).all()


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
        found = history.at(0, round(t_s * 1e9))
        assert found == pytest.approx(state(t_s), rel=1e-9)
    oldest_s = newest_s - 0.02 * (HISTORY - 1)
    found = history.at(0, round((oldest_s - 0.5) * 1e9))  # before the oldest report
    assert found is not None
    assert found[:2] == pytest.approx(
        tuple(np.array(state(oldest_s)[:2]) - 0.5 * np.array(state(oldest_s)[2:])), rel=1e-9
    )
    ahead_s = newest_s + 0.01  # straight on: off by a t^2 / 2
    found = history.at(0, round(ahead_s * 1e9))
    assert found is not None
    assert found[:2] == pytest.approx(tuple(np.array(state(ahead_s)[:2]) - a * 0.01**2 / 2), rel=1e-9)


def test_a_report_older_than_the_newest_changes_nothing() -> None:
    history = StateHistory(1)
    assert history.add(0, 100, (1.0, 2.0, 3.0, 4.0))
    assert not history.add(0, 100, (9.0, 9.0, 9.0, 9.0))
    assert not history.add(0, 50, (9.0, 9.0, 9.0, 9.0))
    assert history.newest(0) == (100, (1.0, 2.0, 3.0, 4.0))


def test_a_clock_correction_between_reports_makes_no_velocity() -> None:
    """0.2 ms at 91 m/s are 18 mm between reports 20 ms apart, which would change the slope of a cubic by 1.4 m/s."""
    history = StateHistory(1)
    history.add(0, 0, (0.0, 0.0, 91.0, 0.1))
    history.add(0, 20 * MS + MS // 5, (91.0 * 0.02, 0.002, 91.2, 0.1))
    for time_ns in range(0, 20 * MS, MS):
        _, _, v_north, v_east = history.at(0, time_ns) or (np.nan,) * 4
        assert 91.0 <= v_north <= 91.2
        assert v_east == pytest.approx(0.1)


def test_before_the_first_report_the_first_one_is_used() -> None:
    history = StateHistory(1)
    history.add(0, 1000 * MS, (10.0, 0.0, 2.0, 0.0))
    history.add(0, 1020 * MS, (10.04, 0.0, 2.0, 0.0))
    assert history.at(0, 500 * MS) == pytest.approx((9.0, 0.0, 2.0, 0.0))
