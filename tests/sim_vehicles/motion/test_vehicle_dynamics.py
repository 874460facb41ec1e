"""The vehicle's motion against the closed form, against another integrator, and its limits."""

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from scenarios.schema import Limits
from sim_vehicles.motion.double_integrator import COAST, Bounds, Command, State, advance, bounds_of, state_from

UNLIMITED = bounds_of(Limits())


@pytest.mark.parametrize("acceleration", [(0.0, 0.0), (2.0, 0.0), (0.0, -3.0), (-1.0, 2.5), (4.0, 4.0)])
@pytest.mark.parametrize("velocity", [(91.44, 0.0), (-30.0, 40.0), (0.0, -60.0)])
def test_without_limits_it_is_a_planar_double_integrator(
    acceleration: tuple[float, float], velocity: tuple[float, float]
) -> None:
    position, duration_s = (100.0, -200.0), 10.0
    state = advance(state_from(position, velocity), Command(*acceleration), UNLIMITED, duration_s)
    p, v, a = np.array(position), np.array(velocity), np.array(acceleration)
    expected = np.array([p + v * duration_s + 0.5 * a * duration_s**2, v + a * duration_s])
    reached = np.array([state[:2], state.velocity_ne_m_s()])
    # rounding; the scale is the distance flown and the speed
    scale = np.linalg.norm(expected, axis=1).max()
    assert np.abs(reached - expected).max() < 1e-14 * scale


def test_pieces_of_any_length_add_up_to_the_whole_flight() -> None:
    whole = advance(state_from((0, 0), (50.0, 10.0)), Command(1.0, -2.0), UNLIMITED, 1.0)
    state = state_from((0, 0), (50.0, 10.0))
    for piece_s in (0.0137, 0.3, 0.0001, 0.0862, 0.6):
        state = advance(state, Command(1.0, -2.0), UNLIMITED, piece_s)
    assert np.allclose(state, whole, rtol=1e-10, atol=0)


def test_coasting_is_straight_and_level() -> None:
    start = state_from((0.0, 0.0), (30.0, 40.0))
    state = advance(start, COAST, UNLIMITED, 100.0)
    assert state.yaw_rad == start.yaw_rad
    assert state.speed_m_s == start.speed_m_s
    assert state[:2] == pytest.approx((3000.0, 4000.0), rel=1e-12)


def test_velocity_set_points_are_approached_with_the_documented_time_constant() -> None:
    state = advance(state_from((0, 0), (40.0, 0.0)), Command(0.0, 0.0, 45.0, 5.0, 2.0), UNLIMITED, 1.0)
    still_missing = math.exp(-2.0)  # gain 2 1/s after 1 s
    assert state.velocity_ne_m_s() == pytest.approx((45.0 - 5.0 * still_missing, 5.0 - 5.0 * still_missing), abs=1e-6)


LIMITED = [
    pytest.param(Limits(acceleration_max_m_s2=3.0), Command(8.0, 6.0), id="acceleration"),
    pytest.param(Limits(turn_rate_max_rad_s=0.1), Command(0.0, 20.0), id="turn rate"),
    pytest.param(Limits(speed_max_m_s=55.0), Command(4.0, 1.0), id="greatest speed"),
    pytest.param(Limits(speed_min_m_s=40.0), Command(-4.0, 0.5), id="least speed"),
    pytest.param(
        Limits(speed_min_m_s=10.0, speed_max_m_s=60.0, acceleration_max_m_s2=6.0, turn_rate_max_rad_s=0.08),
        Command(1.0, -1.0, -20.0, 45.0, 2.0),
        id="all, with velocity feedback",
    ),
]


@pytest.mark.parametrize(("limits", "command"), LIMITED)
def test_at_its_limits_it_agrees_with_another_integrator(limits: Limits, command: Command) -> None:
    bounds, duration_s = bounds_of(limits), 5.0
    start = state_from((0.0, 0.0), (50.0, 0.0))

    def rates(_: float, y: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return _limited_rates(y, command, bounds)

    solution = solve_ivp(rates, (0, duration_s), start, max_step=5e-3, rtol=1e-8, atol=1e-8)
    state = advance(start, command, bounds, duration_s)
    free = advance(start, command, UNLIMITED, duration_s)
    reached = solution.y[:, -1]
    # Entering a limit in the middle of a 20 ms step costs less than one step's change of speed, 20 ms * 10 m/s²,
    # over that step.
    assert np.abs(np.array(state) - reached).max() < 0.02 * 0.2 * duration_s
    assert math.dist(state[:2], free[:2]) > 5.0, "the limit was not met, the test shows nothing"


def _limited_rates(y: npt.NDArray[np.float64], command: Command, bounds: Bounds) -> npt.NDArray[np.float64]:
    """The equations with limits, written independently: rotate, clip, clip."""
    yaw, speed = y[2], float(np.clip(y[3], bounds.speed_min_m_s, bounds.speed_max_m_s))
    along = np.array([np.cos(yaw), np.sin(yaw)])
    across = np.array([-np.sin(yaw), np.cos(yaw)])
    wanted = np.array(command[:2]) + command.velocity_gain_1_s * (np.array(command[2:4]) - speed * along)
    wanted = wanted * min(1.0, bounds.acceleration_max_m_s2 / max(float(np.linalg.norm(wanted)), 1e-12))
    acceleration = float(wanted @ along)
    if (y[3] <= bounds.speed_min_m_s and acceleration < 0) or (y[3] >= bounds.speed_max_m_s and acceleration > 0):
        acceleration = 0.0
    turn = float(np.clip(wanted @ across / speed, -bounds.turn_rate_max_rad_s, bounds.turn_rate_max_rad_s))
    return np.array([*(speed * along), turn, acceleration])


def test_a_limit_that_is_near_but_not_met_changes_nothing() -> None:
    """The closed form and the integration solve the same equations, up to RK4's own error at steps of 20 ms."""
    start, command = state_from((0.0, 0.0), (50.0, 0.0)), Command(0.0, 4.0)
    near = Bounds(1.0, 50.05, math.inf, 0.0801)  # 4 m/s² turns at 0.08 rad/s and leaves the speed at 50.03 m/s
    limited = advance(start, command, near, 0.4)
    assert np.allclose(limited, advance(start, command, UNLIMITED, 0.4), rtol=1e-10, atol=1e-10)


numbers = st.floats(-1e4, 1e4)


commands = st.builds(Command, numbers, numbers, numbers, numbers, st.sampled_from([0.0, 2.0]))


@given(commands, st.floats(1.0, 100.0), st.floats(0.001, 1.0))
def test_any_command_keeps_state_finite_and_speed_limited(command: Command, speed: float, duration_s: float) -> None:
    bounds, start = bounds_of(Limits(speed_min_m_s=1.0, speed_max_m_s=100.0)), State(0.0, 0.0, 0.5, speed)
    state = advance(start, command, bounds, duration_s)
    assert all(map(math.isfinite, state))
    assert 1.0 <= state.speed_m_s <= 100.0
    unlimited = advance(start, command, UNLIMITED, duration_s)
    assert all(map(math.isfinite, unlimited))
    assert unlimited.speed_m_s >= 1.0


@given(numbers, numbers, st.floats(1.0, 100.0))
def test_no_step_turns_or_accelerates_more_than_the_limits(north: float, east: float, speed: float) -> None:
    bounds = bounds_of(Limits(acceleration_max_m_s2=5.0, turn_rate_max_rad_s=0.2))
    state = State(0.0, 0.0, -1.0, speed)
    after = advance(state, Command(north, east), bounds, 0.02)
    rounding = 1e-12
    assert abs(after.yaw_rad - state.yaw_rad) <= 0.2 * 0.02 + rounding
    assert abs(after.speed_m_s - state.speed_m_s) <= 5.0 * 0.02 + rounding


def test_braking_to_the_least_speed_it_flies_on_straight() -> None:
    start = state_from((0.0, 0.0), (20.0, 0.0))
    state = advance(start, Command(-5.0, 0.0), UNLIMITED, 60.0)
    assert state.speed_m_s == 1.0
    assert state.yaw_rad == 0.0
    braking_s, braking_m = 19.0 / 5.0, (20.0**2 - 1.0) / 10.0
    assert state.north_m == pytest.approx(braking_m + (60.0 - braking_s) * 1.0, abs=0.1)  # one step across the limit
