"""The monitor: every row of its transition table, and that a change of gains does not jump."""

from math import inf, nan
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gcs.control.tick import Mode
from gcs.station.modes import STATE, Observation, VehicleState, next_state, policy_of
from gcs.station.monitor import FormationMonitor, Seen, _judged_delay_s
from scenarios.kernel import at_row
from scenarios.schema import Monitor

MARGINS_S = (0.3, 0.6, 1.2)
POLICY = Monitor(caution_headroom=0.3, critical_headroom=0.15, hysteresis=0.05, hold_s=0.3, ease_s=3.0, blend_s=1.0)
SEEN = Observation(time_s=100.0, flying=True, silent=False, guided=True, failsafe=False, loop_delay_s=0.05)
NOMINAL = VehicleState(mode=Mode.NOMINAL)


next_state_at = at_row(next_state)


def monitored(state: VehicleState, seen: Observation, margins_s: tuple[float, ...], policy: Monitor) -> VehicleState:
    """The state after one tick."""
    states = np.zeros(1, STATE)
    states[0] = state
    next_state_at(states, 0, seen, np.array(margins_s), policy_of(policy))
    mode, *rest = states[0].item()
    return VehicleState(Mode(mode), *rest)


def with_headroom(headroom: float, gain_set: int = 0) -> float:
    """The loop delay that leaves a headroom with a gain set."""
    return (1 - headroom) * MARGINS_S[gain_set]


def after(state: VehicleState, *, seconds: float = 0.0, policy: Monitor = POLICY, **seen: Any) -> VehicleState:
    """The state after the same observation at each tick (50 Hz) for `seconds`, by default for one tick."""
    for k in range(max(1, round(seconds * 50) + 1)):
        state = monitored(state, SEEN._replace(**seen, time_s=100.0 + 0.02 * k), MARGINS_S, policy)
    return state


@pytest.mark.parametrize("mode", list(Mode))
def test_unflown_formation_is_waiting_or_in_failsafe_whatever_was_before(mode: Mode) -> None:
    state = VehicleState(mode=mode, gain_set=2, released=True)
    assert after(state, flying=False) == VehicleState(mode=Mode.WAITING)
    assert after(state, flying=False, failsafe=True, silent=True).mode is Mode.FAILSAFE


@pytest.mark.parametrize("mode", list(Mode))
def test_silent_vehicle_is_lost_whatever_was_before(mode: Mode) -> None:
    assert after(VehicleState(mode=mode), silent=True, guided=False).mode is Mode.LOST


@pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.LOST])
def test_vehicle_that_is_not_guided_is_in_failsafe(mode: Mode) -> None:
    assert after(VehicleState(mode=mode), guided=False).mode is Mode.FAILSAFE


@pytest.mark.parametrize("mode", [Mode.LOST, Mode.FAILSAFE])
def test_vehicle_heard_and_guided_again_recovers_on_the_slowest_gains(mode: Mode) -> None:
    state = after(VehicleState(mode=mode))
    assert (state.mode, state.gain_set, state.former_set, state.changed_s) == (Mode.RECOVERING, 2, 0, 100.0)


def test_flight_begins_nominal_on_the_fastest_gains() -> None:
    assert after(VehicleState()) == NOMINAL._replace(eased_s=inf)


@pytest.mark.parametrize(
    ("headroom", "mode"), [(0.31, Mode.NOMINAL), (0.29, Mode.CAUTION), (0.16, Mode.CAUTION), (nan, Mode.NOMINAL)]
)
def test_little_headroom_is_caution_at_once(headroom: float, mode: Mode) -> None:
    assert after(NOMINAL, loop_delay_s=with_headroom(headroom)).mode is mode


def test_caution_ends_past_the_hysteresis_and_after_the_hold() -> None:
    caution = VehicleState(mode=Mode.CAUTION)
    assert after(caution, seconds=5, loop_delay_s=with_headroom(0.34)).mode is Mode.CAUTION
    assert after(caution, seconds=0.28, loop_delay_s=with_headroom(0.36)).mode is Mode.CAUTION
    assert after(caution, seconds=0.32, loop_delay_s=with_headroom(0.36)).mode is Mode.NOMINAL


@pytest.mark.parametrize("mode", [Mode.NOMINAL, Mode.CAUTION, Mode.RECOVERING, Mode.CRITICAL])
def test_critical_headroom_brings_the_next_slower_gains_after_the_hold(mode: Mode) -> None:
    state = VehicleState(mode=mode)
    assert after(state, seconds=0.28, loop_delay_s=with_headroom(0.14)).gain_set == 0
    held = after(state, seconds=0.32, loop_delay_s=with_headroom(0.14))
    assert (held.mode, held.gain_set, held.former_set) == (Mode.CRITICAL, 1, 0)


def test_a_spike_shorter_than_the_hold_changes_nothing() -> None:
    state = after(NOMINAL, seconds=0.28, loop_delay_s=with_headroom(-1.0))
    state = after(state, loop_delay_s=with_headroom(0.8))
    assert after(state, seconds=0.28, loop_delay_s=with_headroom(-1.0)).gain_set == 0


def test_no_second_change_while_gains_are_blended() -> None:
    state = after(NOMINAL, seconds=1.3, loop_delay_s=with_headroom(-5.0))
    assert (state.gain_set, state.changed_s) == (1, pytest.approx(100.3, abs=0.021))
    assert after(NOMINAL, seconds=1.4, loop_delay_s=with_headroom(-5.0)).gain_set == 2


def test_slower_gains_with_headroom_are_caution_until_the_link_returns() -> None:
    state = after(NOMINAL, seconds=2.0, loop_delay_s=0.29)
    assert (state.mode, state.gain_set) == (Mode.CAUTION, 1)
    state = state._replace(changed_s=0.0)
    # Against the margin of the faster gains, 0.3 s, a headroom of 0.35 is required for 3 s.
    assert after(state, seconds=10.0, loop_delay_s=0.3 * 0.66).gain_set == 1
    assert after(state, seconds=2.9, loop_delay_s=0.3 * 0.64).gain_set == 1
    back = after(state, seconds=3.1, loop_delay_s=0.3 * 0.64)
    assert (back.mode, back.gain_set, back.former_set) == (Mode.RECOVERING, 0, 1)
    assert after(state, seconds=4.2, loop_delay_s=0.3 * 0.64).mode is Mode.NOMINAL


def test_recovery_from_the_slowest_gains_goes_up_set_by_set() -> None:
    state = VehicleState(mode=Mode.CAUTION, gain_set=2, former_set=1, changed_s=0.0)
    seen: list[tuple[Mode, int]] = []
    for k in range(600):
        state = monitored(state, SEEN._replace(time_s=100.0 + 0.02 * k), MARGINS_S, POLICY)
        if not seen or seen[-1] != (state.mode, state.gain_set):
            seen.append((state.mode, state.gain_set))
    assert seen == [
        (Mode.CAUTION, 2),
        (Mode.RECOVERING, 1),
        (Mode.CAUTION, 1),
        (Mode.RECOVERING, 0),
        (Mode.NOMINAL, 0),
    ]


def test_the_slowest_gains_release_a_vehicle_only_without_headroom() -> None:
    slowest = VehicleState(mode=Mode.CRITICAL, gain_set=2, former_set=1, changed_s=0.0)
    assert not after(slowest, seconds=10.0, loop_delay_s=with_headroom(0.05, 2)).released
    released = after(slowest, seconds=0.4, loop_delay_s=with_headroom(-0.05, 2))
    assert released.released
    assert released.mode is Mode.FAILSAFE
    # It stays released until headroom suffices, though its failsafe shows, and comes back by way of FAILSAFE.
    still = after(released, seconds=10.0, loop_delay_s=with_headroom(0.3, 2), guided=False)
    assert still.released
    freed = after(released._replace(eased_s=inf), seconds=3.1, loop_delay_s=with_headroom(0.4, 2), guided=False)
    assert (freed.released, freed.mode) == (False, Mode.FAILSAFE)
    assert after(freed, guided=True).mode is Mode.RECOVERING


def test_a_monitor_that_does_not_act_only_shows_modes() -> None:
    policy = POLICY.model_copy(update={"act": False})
    state = after(NOMINAL, seconds=20.0, policy=policy, loop_delay_s=with_headroom(-1.0))
    assert (state.mode, state.gain_set, state.released) == (Mode.CRITICAL, 0, False)
    assert after(state, seconds=1.0, policy=policy).mode in (Mode.CAUTION, Mode.NOMINAL)


@given(st.lists(st.tuples(st.floats(0.0, 3.0), st.booleans(), st.booleans()), min_size=1, max_size=300))
def test_invariants_hold_for_any_history(history: list[tuple[float, bool, bool]]) -> None:
    state, last_change_s = VehicleState(), -1e9
    for k, (delay_s, silent, guided) in enumerate(history):
        before, now_s = state, 0.1 * k
        seen = Observation(now_s, True, silent, guided, not guided, delay_s)
        state = monitored(state, seen, MARGINS_S, POLICY)
        assert 0 <= state.gain_set <= 2
        assert state.mode is not Mode.WAITING or not guided
        assert (state.mode is Mode.LOST) == silent
        if state.released:
            assert state.gain_set == 2
        if state.gain_set != before.gain_set:
            assert state.former_set == before.gain_set
            recovered = before.mode in (Mode.LOST, Mode.FAILSAFE)
            assert recovered or now_s - last_change_s >= POLICY.blend_s
            assert recovered or abs(state.gain_set - before.gain_set) == 1
            last_change_s = now_s


@given(st.lists(st.floats(0.0, 1.0) | st.just(nan), min_size=1, max_size=50))
def test_the_judged_90th_percentile_counts_unknown_delays_as_longest(delays_s: list[float]) -> None:
    judged_s = _judged_delay_s(np.array([delays_s]), 0, len(delays_s), np.zeros(50))
    wanted_s = np.sort(delays_s)[min(len(delays_s) - 1, int(0.9 * len(delays_s)))]
    assert judged_s == wanted_s or (np.isnan(judged_s) and np.isnan(wanted_s))


def formation(n: int, *, separable: bool = True) -> FormationMonitor:
    return FormationMonitor(n, MARGINS_S, POLICY, separable=separable, period_s=0.02)


def update(
    monitor: FormationMonitor, k: int, delays_s: list[float], *, flying: bool = True
) -> list[tuple[int, VehicleState, VehicleState]]:
    """Tick k at 50 Hz, with every vehicle heard and guided."""
    yes, no = np.ones(len(delays_s), np.bool_), np.zeros(len(delays_s), np.bool_)
    return monitor.update(Seen(0.02 * k, flying, no, yes, no, np.array(delays_s)))


def test_in_a_tree_a_late_vehicle_changes_only_its_gains() -> None:
    monitor = formation(3)
    for k in range(100):
        update(monitor, k, [0.05, 0.29, 0.05])
    assert [state.gain_set for state in monitor.states] == [0, 1, 0]


def test_one_late_vehicle_changes_everybodys_gains_where_loops_are_coupled() -> None:
    monitor = formation(3, separable=False)
    for k in range(100):
        update(monitor, k, [0.05, 0.29, 0.05])
    assert [state.gain_set for state in monitor.states] == [1, 1, 1]


def test_share_of_the_new_gains_rises_without_a_jump() -> None:
    monitor, shares = formation(1), list[float]()
    for k in range(120):
        update(monitor, k, [0.29])
        flown, former, share = monitor.blends(0.02 * k)[0]
        shares.append(flown * share + former * (1 - share))
    assert shares[0] == 0.0
    assert shares[-1] == 1.0
    assert max(np.diff(shares)) <= 0.02 / POLICY.blend_s + 1e-9


def test_delays_before_the_flight_are_not_judged() -> None:
    monitor = formation(1)
    for k in range(100):  # slow telemetry of a vehicle that is getting ready
        update(monitor, k, [2.0], flying=False)
    for k in range(100, 200):
        update(monitor, k, [0.05])
        assert monitor.states[0].mode is Mode.NOMINAL


def test_release_goes_from_the_end_of_the_tree_forwards() -> None:
    monitor, order = formation(4), list[int]()
    for k in range(600):
        for row, before, after_ in update(monitor, k, [0.05, 2.0, 2.0, 2.0]):
            if after_.released and not before.released:
                order.append(row)
    assert order == [3, 2, 1]


def test_formation_is_not_opened_when_the_slowest_gains_are_enough() -> None:
    monitor = formation(1)
    for k in range(1000):
        update(monitor, k, [0.05 if k < 100 else 0.55])
        assert monitor.opening == 1.0
    assert monitor.states[0].gain_set == 2


def test_formation_is_opened_slowly_while_the_slowest_gains_are_critical() -> None:
    monitor, openings = formation(2), list[float]()
    for k in range(1500):
        update(monitor, k, [0.05, 1.1])  # headroom 0.08 on the slowest gains
        openings.append(monitor.opening)
    assert openings[-1] == pytest.approx(POLICY.open_factor)
    assert max(np.diff(openings)) == pytest.approx((POLICY.open_factor - 1) * 0.02 / POLICY.open_s)
    for k in range(1500, 3000):
        update(monitor, k, [0.05, 0.05])
    assert monitor.opening == pytest.approx(1.0)
