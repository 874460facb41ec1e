"""Prediction is the arithmetic of `gains.sampled.prediction`; measured deliveries are followed within bounds."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from gains.core.arrays import FloatArray
from gains.formation.model import FormationModel
from gains.performance.response import Response, formation_loop
from gains.sampled.multirate import Timing
from gcs.control.history import StateHistory
from gcs.control.prediction import (
    FASTEST,
    KEPT_S,
    CommandHistory,
    FixedDelivery,
    MeasuredDelivery,
    PredictedStates,
    carried,
)
from gcs.control.responding import Responding

MS, S = 1_000_000, 1_000_000_000
START = 10 * S
LONG = 100 * S
STATE = (3.0, -4.0, 0.5, -0.25)
Commands = list[tuple[int, tuple[float, float]]]


def history_of(commands: Commands, *, held_ns: int = LONG) -> CommandHistory:
    history = CommandHistory(held_ns)
    for due_ns, acceleration in commands:
        history.add(due_ns, acceleration)
    return history


def integrated(commands: Commands, from_ns: int, to_ns: int) -> FloatArray:
    """The state after the pieces of constant acceleration between two times, one after the other."""
    north, east, v_north, v_east = STATE
    edges = sorted({from_ns, to_ns, *(due_ns for due_ns, _ in commands if from_ns < due_ns < to_ns)})
    for begin_ns, end_ns in pairwise(edges):
        a_north, a_east = next((u for due_ns, u in reversed(commands) if due_ns <= begin_ns), (0.0, 0.0))
        t = (end_ns - begin_ns) * 1e-9
        north, east = north + v_north * t + a_north * t * t / 2.0, east + v_east * t + a_east * t * t / 2.0
        v_north, v_east = v_north + a_north * t, v_east + a_east * t
    return np.array([north, east, v_north, v_east])


ACCELERATIONS = st.tuples(st.floats(-30.0, 30.0), st.floats(-30.0, 30.0))


@given(
    st.lists(st.tuples(st.integers(1, 500), ACCELERATIONS), max_size=40),
    st.integers(-1000, 5000),
    st.integers(0, 10_000),
)
def test_states_are_predicted_as_if_each_piece_were_integrated(
    steps: list[tuple[int, tuple[float, float]]], from_ms: int, for_ms: int
) -> None:
    due_ms = np.cumsum([gap_ms for gap_ms, _ in steps]).tolist()
    commands = [(START + due * MS, u) for due, (_, u) in zip(due_ms, steps, strict=True)]
    from_ns, to_ns = START + from_ms * MS, START + (from_ms + for_ms) * MS
    found = carried(history_of(commands), STATE, from_ns, to_ns)
    # sums over minutes of 30 m/s² reach 1e4 m, and are subtracted from each other
    assert np.array(found) == pytest.approx(integrated(commands, from_ns, to_ns), rel=1e-9, abs=1e-8)


def test_without_set_points_a_vehicle_holds_velocity_after_the_timeout() -> None:
    history = history_of([(START, (1.0, 0.0)), (START + 9 * S, (2.0, 0.0))], held_ns=S)
    north, _, v_north, _ = carried(history, (0.0, 0.0, 0.0, 0.0), START, START + 10 * S)
    assert v_north == pytest.approx(1.0 + 2.0)
    assert north == pytest.approx(0.5 + 8.0 * 1.0 + 1.0 + 1.0)


def test_forgetting_set_points_older_than_any_prediction_changes_nothing() -> None:
    commands: Commands = [(START + 20 * MS * k, (np.sin(0.01 * k), 1.0)) for k in range(6000)]
    history, now_ns = history_of(commands), commands[-1][0]
    remembered = len(history._due_ns)  # noqa: SLF001 - what it forgets shows nowhere else
    assert remembered < 2 * KEPT_S * 50 + 2
    since_ns = now_ns - 3 * S
    found = carried(history, STATE, since_ns, now_ns)
    assert np.array(found) == pytest.approx(integrated(commands, since_ns, now_ns), abs=1e-6)


def states(sent: list[CommandHistory], assumed_s: float) -> PredictedStates:
    return PredictedStates(sent, [FixedDelivery(assumed_s) for _ in sent], Timing(0.02, 0.02))


def test_the_newest_set_point_acts_an_assumed_delay_after_sampling() -> None:
    history = StateHistory(1)
    history.add(0, START, STATE)
    predicted = states([CommandHistory(LONG)], 0.3)
    [[acts_ns], [assumed_s]] = predicted.look(history, START + 110 * MS)
    assert (acts_ns, assumed_s) == (START + 300 * MS, pytest.approx(0.3))
    # the next state is lost: its set-point acts a tick later all the same
    [[acts_ns], [assumed_s]] = predicted.look(history, START + 130 * MS)
    assert (acts_ns, assumed_s) == (START + 320 * MS, pytest.approx(0.3))


def test_each_vehicle_is_predicted_from_what_it_was_sent_itself() -> None:
    history = StateHistory(2)
    for row in range(2):
        history.add(row, START, STATE)
    sent = [history_of([(START - S, (2.0, 0.0))]), CommandHistory(LONG)]
    predicted = states(sent, 0.5)
    predicted.look(history, START)
    assert predicted.at(0, START + 500 * MS) == pytest.approx((3.0 + 0.25 + 0.25, -4.125, 1.5, -0.25))
    assert predicted.at(1, START + 500 * MS) == pytest.approx((3.0 + 0.25, -4.125, 0.5, -0.25))
    assert predicted.at(0, START) == STATE


def test_without_a_state_nothing_is_predicted() -> None:
    predicted = states([CommandHistory(LONG)], 0.5)
    assert predicted.look(StateHistory(1), START) == ([0], [0.0])
    assert predicted.at(0, START) is None


def followed(down_s: Callable[[float], float], *, seconds: float, round_trip_s: float = 0.0) -> FloatArray:
    """Rows (time, assumed delivery) in s at 50 Hz; a delivery is measured every 0.1 s and known a round trip later."""
    delivery, rows, asked = MeasuredDelivery(), list[tuple[float, float]](), 0
    for tick in range(round(50 * seconds)):
        now_s = 0.02 * tick
        while 0.1 * asked + round_trip_s <= now_s:
            delivery.measured(round(down_s(0.1 * asked) * S), START + asked * 100 * MS)
            asked += 1
        assumed_ns = delivery.assumed_ns(START + round(now_s * S), 0)
        if assumed_ns is not None:
            rows.append((now_s, assumed_ns / S))
    return np.array(rows)


def test_a_constant_delay_is_assumed_from_its_first_measurement_on() -> None:
    assert followed(lambda _: 0.4, seconds=3.0)[:, 1] == pytest.approx(0.4)


def test_a_delay_that_grows_evenly_is_followed_without_falling_behind() -> None:
    time_s, assumed_s = followed(lambda t: 0.02 + 0.025 * t, seconds=60.0, round_trip_s=1.5).T
    late = time_s > 20.0
    assert assumed_s[late] == pytest.approx(0.02 + 0.025 * time_s[late], abs=1e-4)


def test_the_assumed_delay_changes_no_faster_than_its_bound() -> None:
    time_s, assumed_s = followed(lambda t: 0.1 if t < 5.0 else 1.1, seconds=40.0).T
    assert np.abs(np.diff(assumed_s) / np.diff(time_s)).max() <= FASTEST * (1.0 + 1e-6)
    assert assumed_s[-1] == pytest.approx(1.1, abs=1e-3)


def test_jitter_is_smoothed() -> None:
    draws = np.random.default_rng(3).uniform(-0.03, 0.03, 1000)
    assumed_s = followed(lambda t: 1.0 + float(draws[round(10 * t)]), seconds=60.0)[:, 1]
    assert assumed_s[1000:].std() < 0.03 / 3**0.5 / 2.0  # less than half of the jitter's
    assert assumed_s[1000:].mean() == pytest.approx(1.0, abs=0.003)


@pytest.mark.parametrize(
    "response", [Response(0.15, 2.0), Response(0.3, 0.0), Response(0.125, 2.0), Response(1.0, 3.0)]
)
def test_a_response_moves_as_its_differential_equation_says(response: Response) -> None:
    """Also where its two modes coincide, at four times the lag times the gain, and where they oscillate."""
    rng = np.random.default_rng(7)
    history, held_ns = CommandHistory(S, Responding(response)), 20 * MS
    A, B, _ = formation_loop(FormationModel((-1,), axes=1), np.array([[-1.0]]), [response])
    state, position = np.zeros((len(A), 2)), np.zeros(2)
    fine = 40
    step = expm(np.block([[A, B], [np.zeros((1, len(A) + 1))]]) * (held_ns * 1e-9 / fine))
    for k in range(100):
        u = rng.standard_normal(2)
        history.add(START + k * held_ns, (float(u[0]), float(u[1])))
        for _ in range(fine):
            before = state[0].copy()
            state = step[:-1, :-1] @ state + step[:-1, -1:] * u
            position += (before + state[0]) / 2.0 * held_ns * 1e-9 / fine
        velocity, moved = history.sums(START + (k + 1) * held_ns)
        # coinciding modes are parted by a thousandth of the lag; positions are summed by trapezoids
        assert [velocity.real, velocity.imag] == pytest.approx(state[0].tolist(), abs=1e-3)
        assert [moved.real, moved.imag] == pytest.approx(position.tolist(), abs=1e-3)


def test_jitter_of_the_age_does_not_shift_set_point_times() -> None:
    """The age of a state is known: only its mean over two seconds counts against the assumed loop delay."""
    history, predicted, rng = StateHistory(1), states([CommandHistory(LONG)], 0.5), np.random.default_rng(5)
    assumed_ms = list[float]()
    for tick in range(300):
        due_ns = START + 20 * MS * tick
        history.add(0, due_ns - round(MS * (200.0 + rng.uniform(-9.0, 9.0))), STATE)
        [[acts_ns], [assumed_s]] = predicted.look(history, due_ns)
        assert assumed_s == pytest.approx(0.5)
        assumed_ms.append((acts_ns - due_ns) / MS)
    # a mean of 100 ages, each uniform within 9 ms: a standard deviation of 0.52 ms
    assert np.array(assumed_ms[100:]) == pytest.approx(300.0, abs=3.0 * 0.52)
