"""The jsbsim aircraft: what its autopilot holds and follows, and its motion between two instants."""

import math

import pytest

from scenarios.errors import ScenarioError
from scenarios.files import parse
from scenarios.schema import Limits, Scenario
from sim_vehicles.motion.aircraft import Aircraft
from sim_vehicles.motion.double_integrator import COAST, Command, State, bounds_of
from tests.support.paths import SCENARIOS

SPEED_M_S = 91.44
BOUNDS = bounds_of(Limits())
TEXT = """
name = "alone"
seed = 1
duration_s = 30.0
dynamics = "jsbsim"
altitude_m = 400.0
nominal_velocity = [{ from_s = 0.0, velocity_ne_m_s = [91.44, 0.0] }]
vehicles = [{ system_id = 1, position_ne_m = [0, 0], velocity_ne_m_s = [91.44, 0] }]
control = { gains = { K1 = -0.5, K2 = 0.0, K3 = 0.1 } }
"""


def scenario(text: str = TEXT) -> Scenario:
    return parse(text, SCENARIOS / "alone.toml")


def flown(command: Command, duration_s: float, *, piece_s: float = 0.02) -> tuple[Aircraft, State]:
    one = scenario()
    aircraft, state = Aircraft(one, one.vehicles[0]), State(0.0, 0.0, 0.0, SPEED_M_S)
    for _ in range(round(duration_s / piece_s)):
        state = aircraft.advance(state, command, BOUNDS, piece_s)
    return aircraft, state


def test_the_aircraft_holds_speed_course_and_altitude() -> None:
    aircraft, state = flown(COAST, 60.0)
    assert abs(state.speed_m_s - SPEED_M_S) < 0.01
    assert abs(state.yaw_rad) < 1e-4
    assert abs(aircraft.attitude().climbed_m) < 0.1


def test_acceleration_to_the_right_is_flown_as_a_coordinated_turn() -> None:
    aircraft, state = flown(Command(0.0, 2.0), 10.0)
    north, east = state.velocity_ne_m_s()
    # the reference lags by 2 ζ / ω = 0.8 s
    assert abs(east - 2.0 * (10.0 - 0.8)) < 0.4
    attitude = aircraft.attitude()
    across_m_s2 = 2.0 * north / state.speed_m_s
    assert abs(attitude.roll_rad - math.atan2(across_m_s2, 9.80665)) < 0.02
    assert abs(attitude.climbed_m) < 1.0


def test_throttle_accelerates_along_the_course() -> None:
    _, state = flown(Command(0.5, 0.0), 10.0)
    assert abs(state.speed_m_s - SPEED_M_S - 0.5 * (10.0 - 0.8)) < 0.1


def test_neither_foreseeing_nor_step_length_changes_the_motion() -> None:
    _, whole = flown(Command(0.3, 0.3), 4.2, piece_s=0.06)
    one = scenario()
    aircraft, state = Aircraft(one, one.vehicles[0]), State(0.0, 0.0, 0.0, SPEED_M_S)
    for _ in range(600):
        aircraft.foreseen(state, Command(0.3, 0.3), BOUNDS, 0.005)
        state = aircraft.advance(state, Command(0.3, 0.3), BOUNDS, 0.007)
    assert state == pytest.approx(whole, rel=1e-9)


def test_the_aircrafts_motion_is_foreseen_from_its_acceleration() -> None:
    aircraft, state = flown(Command(0.0, 1.0), 2.0)
    foreseen = aircraft.foreseen(state, Command(0.0, 1.0), BOUNDS, 0.02)
    # a jerk of at most 1 m/s³: 0.02³ / 6
    assert aircraft.advance(state, Command(0.0, 1.0), BOUNDS, 0.02)[:2] == pytest.approx(foreseen[:2], abs=1e-5)


def test_a_push_carries_the_aircraft_along() -> None:
    one = scenario()
    aircraft, state = Aircraft(one, one.vehicles[0]), State(0.0, 0.0, 0.0, SPEED_M_S)
    state = aircraft.advance(state, COAST, BOUNDS, 0.02)
    north, east = state.velocity_ne_m_s()
    pushed = state._replace(yaw_rad=math.atan2(1.0, north), speed_m_s=math.hypot(north, 1.0))
    state = aircraft.advance(pushed, COAST, BOUNDS, 0.02)
    assert state.velocity_ne_m_s()[1] - east == pytest.approx(1.0, abs=1e-6)
    assert state.east_m == pytest.approx(0.02, abs=1e-6)


@pytest.mark.parametrize(
    ("dynamics", "wanted"),
    [("jsbsim:none", "jsbsim:MODEL with a folder of"), ("jsbsim:c172p", "a model that flies level at 91.44 m/s")],
)
def test_a_model_that_cannot_fly_is_refused(dynamics: str, wanted: str) -> None:
    one = scenario(TEXT.replace("jsbsim", dynamics))
    with pytest.raises(ScenarioError, match=wanted):
        Aircraft(one, one.vehicles[0])
