"""The onboard loop: its continuous margin against that of the source, its map against a march event by event."""

from math import inf, isclose

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.delay.sweep import frequency_sweep_margin
from gains.formation.model import FormationModel
from gains.sampled._loop import lifted_map
from gains.sampled.constant import growth_rate, sampled_delay_margin
from gains.sampled.onboard import OnboardLoop, OnboardTiming, local_plant, onboard_loop, own_part

FINE = OnboardTiming(0.02, steps=2, steps_per_sample=1)
CHAIN = FormationModel((-1, 0, 1), axes=1)
# blocks of section 5.2.2 of the source, one axis, off-diagonal entries left out
PRINTED = np.array(
    [
        [-18.0874, -17.2478, 1.9965, 0.0, 0.0],
        [-6.0567, 2.0180, -17.0089, -7.6645, -0.5902],
        [0.0, 5.7726, -2.6051, 10.5003, -17.0949],
    ]
)


def marched(loop: OnboardLoop, delay_s: float, *, periods: int) -> FloatArray:
    """The state (periods, n) at every beginning of a period, marched instant by instant, without the map."""
    timing = loop.timing
    n, step_s = len(loop.A), timing.control_s / timing.steps
    x = np.arange(1.0, n + 1.0)
    seen, seen_s, own, late = np.zeros(n), 0.0, np.zeros(n), np.zeros(n)
    under_way: list[tuple[float, FloatArray]] = []
    states: list[FloatArray] = []
    now_s = 0.0

    def fly(until_s: float) -> None:
        nonlocal x, now_s
        h, force = until_s - now_s, own + late
        # A is nilpotent: e^(A h) = I + A h exactly
        x = x + h * (loop.A @ x + force) + h * h / 2.0 * (loop.A @ force)
        now_s = until_s

    for step in range(periods * timing.steps):
        time_s = step * step_s
        while under_way and under_way[0][0] <= time_s + 1e-12:
            acts_s, command = under_way.pop(0)
            fly(acts_s)
            late = command
        fly(time_s)
        if step % timing.steps_per_sample == 0:
            seen, seen_s = x, time_s
        if step % timing.steps == 0:
            states.append(x)
            under_way.append((time_s + delay_s, loop.late @ x))
            if delay_s == 0.0:
                late = under_way.pop()[1]
        own = loop.sensed @ (seen + (time_s - seen_s) * (loop.A @ seen)) + loop.known @ x
    return np.array(states)


def test_printed_gains_have_the_erratums_continuous_margin_in_two_ways() -> None:
    loop = onboard_loop(CHAIN, PRINTED, FINE)
    own = own_part(CHAIN, PRINTED)
    others = PRINTED - own
    assert loop.continuous_margin_s() == pytest.approx(1.00796, rel=1e-3)  # computed with the off-diagonal entries
    assert frequency_sweep_margin(CHAIN.A + CHAIN.B @ own, CHAIN.B @ others) == pytest.approx(
        loop.continuous_margin_s(), rel=1e-9
    )


@pytest.mark.parametrize("delay_s", [0.0, 0.04, 0.17, 0.9071])
@pytest.mark.parametrize("timing", [FINE, OnboardTiming(0.04, 4, 2), OnboardTiming(0.1, 5, 5), OnboardTiming(0.03, 1)])
def test_the_map_agrees_with_a_march_event_by_event(timing: OnboardTiming, delay_s: float) -> None:
    loop = onboard_loop(CHAIN, PRINTED, timing)
    states = marched(loop, delay_s, periods=60)
    step = lifted_map(local_plant((loop.A, loop.sensed, loop.known, loop.late), timing), delay_s)
    whole = np.zeros(len(step))
    whole[:5] = states[0]
    for state in states:
        assert whole[:5] == pytest.approx(state, rel=1e-9, abs=1e-9)
        whole = step @ whole


@pytest.mark.parametrize("timing", [FINE, OnboardTiming(0.02, 4, 4), OnboardTiming(0.05, 1, 1)])
def test_growth_changes_sign_at_the_margin(timing: OnboardTiming) -> None:
    loop = onboard_loop(CHAIN, PRINTED, timing)
    margin_s = loop.sampled_margin_s()
    assert loop.growth_1_s(margin_s * (1.0 - 1e-6)) < 0.0 < loop.growth_1_s(margin_s * (1.0 + 1e-6))
    assert all(loop.growth_1_s(part * margin_s) < 0.0 for part in np.linspace(0.0, 0.99, 25))


@pytest.mark.parametrize("telemetry_s", [0.025, 0.013])
def test_long_margins_at_uneven_periods_are_where_growth_changes_sign(telemetry_s: float) -> None:
    loop = onboard_loop(CHAIN, PRINTED, OnboardTiming(0.02, 4, 2, telemetry_s))
    margin_s = loop.sampled_margin_s()
    assert margin_s > 30.0 * loop.timing.rates.held_s
    # two parts in 10^4 were measured to be left to the order of the loop delays
    assert loop.growth_1_s(margin_s * (1.0 - 3e-4)) < 0.0 < loop.growth_1_s(margin_s * (1.0 + 3e-4))


def test_own_loops_too_fast_for_their_steps_leave_no_margin() -> None:
    K = np.zeros((4, 7))
    K[:3, :5] = PRINTED
    K[3, 5:] = 3.0, -300.0  # 1 − 300 T = −5
    loop = onboard_loop(FormationModel((-1, 0, 1, 0), axes=1), K, OnboardTiming(0.02, telemetry_s=0.025))
    assert loop.continuous_margin_s() > 30.0 * loop.timing.rates.held_s
    assert loop.sampled_margin_s() == 0.0


def test_sampled_margin_goes_to_the_continuous_one_with_the_period() -> None:
    fine = onboard_loop(CHAIN, PRINTED, OnboardTiming(0.0002))
    assert fine.sampled_margin_s() == pytest.approx(fine.continuous_margin_s(), rel=1e-4)


def test_many_own_steps_make_the_local_loop_continuous() -> None:
    """With many steps the local loop is the matrix exponential of A + B K_own, and what is late a held command."""
    loop = onboard_loop(CHAIN, PRINTED, OnboardTiming(0.02, steps=400))
    held = growth_rate(loop.A + loop.sensed + loop.known, loop.late, np.eye(5), period_s=0.02, delay_s=0.9)
    assert loop.growth_1_s(0.9) == pytest.approx(held, abs=1e-4)


def test_an_onboard_loop_without_own_terms_is_the_ground_loop() -> None:
    """Gains that vehicles have on each other's errors only: nothing is fed back on board, all is late."""
    K = np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
    pair = FormationModel((-1, 0), axes=1)
    loop = onboard_loop(pair, K, OnboardTiming(0.05, 5, 5))
    assert loop.sampled_margin_s() == sampled_delay_margin(pair.A, pair.B, K, period_s=0.05) == 0.0
    assert loop.growth_1_s(0.3) == pytest.approx(growth_rate(pair.A, pair.B, K, period_s=0.05, delay_s=0.3), abs=1e-9)


@given(
    own=st.floats(-8.0, -0.5),
    front=st.floats(-3.0, 3.0),
    spacing=st.floats(0.1, 8.0),
    predecessors=st.lists(st.integers(0, 4), min_size=1, max_size=5),
)
@settings(max_examples=25, deadline=None)
def test_no_delay_breaks_a_leader_follower_tree(
    own: float, front: float, spacing: float, predecessors: list[int]
) -> None:
    tree = (-1, *(min(ahead, k) for k, ahead in enumerate(predecessors)))
    model = FormationModel(tree, axes=1)
    loop = onboard_loop(model, model.overlapping_gain([[own]], [[front]], [[spacing]]), FINE)
    assert loop.continuous_margin_s() == inf
    assert loop.sampled_margin_s() == inf
    # and the motion is that of one vehicle, however late the others
    assert isclose(loop.growth_1_s(0.0), loop.growth_1_s(0.613), rel_tol=1e-6, abs_tol=1e-9)


@pytest.mark.parametrize(("steps", "per_sample"), [(0, 1), (3, 2), (2, 0)])
def test_timing_that_does_not_fit_is_refused(steps: int, per_sample: int) -> None:
    with pytest.raises(BadModelError, match="divisor"):
        OnboardTiming(0.02, steps, per_sample)
