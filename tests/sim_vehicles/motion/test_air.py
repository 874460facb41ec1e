"""What pushes the vehicles, and the errors of their own navigation: distributions, known answers, and the truth log."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from scenarios.kernel import at_row
from scenarios.keys.disturbance import Disturbance, Gusts, Navigation, Sector
from scenarios.schema import Autopilot, Limits, Scenario
from sim_vehicles.links.truth import POSITION_ERROR, PUSHED, VELOCITY_ERROR, MemoryRecorder
from sim_vehicles.motion import air, copter
from sim_vehicles.motion.double_integrator import Command, State, bounds_of, move_under_push, state_from
from sim_vehicles.motion.navigation import Navigator
from sim_vehicles.motion.sector import AllPass, SectorBound
from sim_vehicles.services.hot import new_vehicles
from tests.support.sim_client import SECOND, START, scenario

GUSTS = Gusts(deviation_m_s2=0.5, correlation_time_s=0.2)
PUSH_ON_AT = at_row(move_under_push)
UNLIMITED = bounds_of(Limits())


def disturbances(recorder: MemoryRecorder, kind: int) -> tuple[np.ndarray, np.ndarray]:
    """Times (ns) and components (north, east) of vehicle 1's disturbances of one kind."""
    own = recorder.records[(recorder.records["kind"] == kind) & (recorder.records["system_id"] == 1)]
    return own["time_ns"], np.stack([own["entered_ns"], own["due_ns"]], axis=1) * 1e-9


def disturbed(count: int = 1, **parts: object) -> Scenario:
    return scenario(count).model_copy(update={"disturbance": Disturbance.model_validate(parts)})


def test_gusts_have_the_variance_and_correlation_asked_for() -> None:
    steps = air.Gusts(GUSTS, seed=1, system_id=1)
    values = np.array([steps.at(k) for k in range(100_000)])
    # 1000 s hold 2500 independent values on each axis: 1.4 % for one standard error of either
    assert values.std(axis=0) == pytest.approx([0.5, 0.5], rel=0.05)
    lag = round(GUSTS.correlation_time_s * SECOND / air.STEP_NS)
    correlation = (values[lag:] * values[:-lag]).mean() / (values**2).mean()
    assert correlation == pytest.approx(np.exp(-1.0), abs=0.05)
    assert abs(np.corrcoef(values.T)[0, 1]) < 0.07


def test_common_gusts_push_all_vehicles_alike_and_others_do_not() -> None:
    common = GUSTS.model_copy(update={"common": True})
    assert air.Gusts(common, 1, 1).at(50) == air.Gusts(common, 1, 2).at(50)
    assert air.Gusts(GUSTS, 1, 1).at(50) != air.Gusts(GUSTS, 1, 2).at(50)


def test_forgotten_gusts_leave_the_later_ones_as_they_were() -> None:
    whole, forgetful = (air.Gusts(GUSTS, 3, 1) for _ in range(2))
    for number in range(0, 5000, 7):
        forgetful.forget(number)
        assert forgetful.at(number) == whole.at(number)


def moved(flown: Scenario, to_ns: int, recorder: MemoryRecorder, *, push: air.Push = air.STILL) -> State:
    around = air.Air(flown, 1, START, recorder)
    around.add(push)
    vehicles = new_vehicles(1)
    vehicles["state"], vehicles["command"] = state_from((0.0, 0.0), (40.0, 9.0)), Command(1.0, -0.5)
    vehicles["bounds"] = UNLIMITED
    for piece in around.pieces(START, to_ns):
        PUSH_ON_AT(vehicles, 0, piece)
    return State(*vehicles["state"][0].tolist())


def test_constant_push_adds_to_the_command_as_in_closed_form() -> None:
    recorder = MemoryRecorder()
    reached = moved(
        disturbed(wind_ne_m_s2=(0.3, 0.2)), START + 4 * SECOND, recorder, push=air.Push(0.2, 0.1, 1.5, -2.0)
    )
    assert reached[:2] == pytest.approx((40.0 * 4 + 0.5 * 1.5 * 16 + 6.0, 9.0 * 4 - 0.5 * 0.2 * 16 - 8.0), rel=1e-12)
    assert reached.velocity_ne_m_s() == pytest.approx((46.0, 8.2), rel=1e-12)
    assert disturbances(recorder, PUSHED)[1].tolist() == [[0.5, pytest.approx(0.3)]]


def test_the_truth_log_holds_the_gusts_that_moved_the_vehicle() -> None:
    recorder = MemoryRecorder()
    reached = moved(disturbed(gusts=GUSTS), START + SECOND, recorder)
    times_ns, pushes = disturbances(recorder, PUSHED)
    assert np.diff(times_ns).tolist() == [air.STEP_NS] * 99
    wanted = np.array([40.0 + 1.0, 9.0 - 0.5]) + 0.01 * pushes.sum(axis=0)
    assert reached.velocity_ne_m_s() == pytest.approx(wanted, abs=1e-8)  # the log rounds to 1e-9 m/s²


def test_wind_moves_a_copter_as_its_equations_say() -> None:
    limits = Autopilot(acceleration_max_m_s2=50.0)
    around = air.Air(disturbed(wind_ne_m_s2=(0.4, 0.0)), 1, START, None)
    target = copter.Target(velocity_m_s=3.0 + 0j, velocity_gain_1_s=2.0)
    motion = copter.Motion(0j)
    for k in range(200):
        at_ns = START + k * air.STEP_NS
        for piece in around.pieces(at_ns, at_ns + air.STEP_NS):
            motion, target = copter.pushed(motion, target, limits, piece)

    def rates(_: float, x: np.ndarray) -> list[float]:
        return [x[1], x[2] + 0.4, (2.0 * (3.0 - x[1]) - x[2]) / limits.lag_s]

    exact = solve_ivp(rates, (0.0, 2.0), [0.0, 0.0, 0.0], rtol=1e-10, atol=1e-12).y[:, -1]
    # the splitting of a step is of the second order in 10 ms
    assert (motion.place_m.real, motion.velocity_m_s.real) == pytest.approx(exact[:2], abs=2e-4)


def test_reports_are_wrong_by_the_noise_and_bias_asked_for() -> None:
    own = Navigation(position_noise_m=0.5, velocity_noise_m_s=0.2, position_bias_m=0.7, bias_time_s=0.1)
    recorder = MemoryRecorder()
    navigator = Navigator(scenario().model_copy(update={"navigation": own}), 1, recorder)
    period_ns = SECOND // 50
    reported = [navigator.reported((1.0, 2.0), (3.0, 4.0), START + k * period_ns, 20 * k) for k in range(20_000)]
    off = np.array(reported) - [[1.0, 2.0], [3.0, 4.0]]
    # 20 ms apart, biases of 0.1 s leave 2000 independent values or more: 1.6 % for one standard error
    assert off.std(axis=0) == pytest.approx(np.array([[0.74**0.5] * 2, [0.2] * 2]), rel=0.06)
    next_to = (off[1:, 0] * off[:-1, 0]).mean()
    assert next_to == pytest.approx(0.49 * np.exp(-0.2), rel=0.1)
    logged = [disturbances(recorder, kind)[1] for kind in (POSITION_ERROR, VELOCITY_ERROR)]
    assert np.allclose(np.stack(logged, axis=1), off, rtol=0.0, atol=1e-9)


def test_an_all_pass_filter_turns_phase_and_keeps_the_size() -> None:
    c, angle = -0.8, 0.3
    signal = np.exp(1j * angle * np.arange(400))
    filters = AllPass((c, 1.0), 2)
    pairs = np.stack([np.cos(angle * np.arange(400)), np.sin(angle * np.arange(400))], axis=1)
    out = np.array([filters.passed(np.array([pair, pair])) for pair in pairs])
    wanted = (c + np.exp(-1j * angle)) / (1.0 + c * np.exp(-1j * angle)) * signal
    assert abs(np.exp(-1j * angle) + c) == pytest.approx(abs(1.0 + c * np.exp(-1j * angle)))
    assert out[-1, 0] == pytest.approx([wanted[-1].real, wanted[-1].imag], abs=1e-9)
    assert out[:, 1] == pytest.approx(pairs)


def test_sector_adds_its_matrix_times_the_errors_to_their_rates() -> None:
    direction = np.random.default_rng(2).normal(size=(5, 5))
    sector = Sector(norm_1_s=0.3, direction=tuple(map(tuple, direction.tolist())))
    states = {k: state_from((-50.0 * (k - 1) + k, 10.0 - 2 * k), (40.0 + 0.1 * k, 9.0 - 0.3 * k)) for k in (1, 2, 3)}
    pushes = SectorBound(disturbed(3, sector=sector)).pushes(states.__getitem__)
    errors = np.array([[0.1, -0.3], [-1.0, 2.0], [0.2, -0.6], [-1.0, 2.0], [0.3, -0.9]])
    carried = [np.array(pushes[k][2:]) for k in (1, 2, 3)]
    found = [pushes[1][:2], carried[0] - carried[1], pushes[2][:2], carried[1] - carried[2], pushes[3][:2]]
    wanted = 0.3 * direction / np.linalg.norm(direction, 2) @ errors
    assert np.array(found) == pytest.approx(wanted, abs=1e-9)
