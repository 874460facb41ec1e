"""The simulated multicopters: start-up, rules and response of both flavours, with plain pymavlink as the other side."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from scenarios.keys.part import Flavour
from scenarios.schema import Autopilot, ClockJump, Scenario
from sim_vehicles.vehicles.copter import Copter
from sim_vehicles.vehicles.shell import Shell
from tests.support.sim_client import MS, SECOND, START, arm, command, mode, parse_all, scenario, setpoint, shell_of

VELOCITY_ACCELERATION, VELOCITY, ACCELERATION = 0x0C07, 0x0DC7, 0x0C3F
PX4_OFFBOARD, PX4_HOLD, PX4_TAKEOFF = 6 << 16, 4 << 16 | 3 << 24, 4 << 16 | 2 << 24
GROUND_M = 584.0


def of_copters(flavour: Flavour = "ardupilot", **settings: Any) -> Scenario:
    flown = scenario(2)
    vehicles = tuple(v.model_copy(update={"velocity_ne_m_s": (0.0, 0.0)}) for v in flown.vehicles)
    autopilot = Autopilot(flavour=flavour, **settings)
    return flown.model_copy(
        update={"dynamics": "autopilot", "vehicles": vehicles, "autopilot": autopilot, "altitude_m": 20.0}
    )


def copter(flavour: Flavour = "ardupilot", **settings: Any) -> Shell[Copter]:
    return shell_of(of_copters(flavour, **settings), Copter)


def tell(vehicle: Shell[Copter], data: bytes, at_s: float, kind: str = "COMMAND_ACK") -> list[Any]:
    """Messages of a kind that the vehicle sends at once when told something `at_s` after its start."""
    time_ns = START + round(at_s * SECOND)
    vehicle.step([], time_ns - 1)
    return [message for message, _ in parse_all(vehicle.step([(data, time_ns)], time_ns), kind)]


def result(vehicle: Shell[Copter], data: bytes, at_s: float) -> int:
    (ack,) = tell(vehicle, data, at_s)
    return ack.result


def px4_mode(main: int, sub: int = 0) -> bytes:
    return command(176, 1, main, sub)


def take_off_px4(altitude_m: float, place: float = math.nan) -> bytes:
    return command(22, 0, 0, 0, math.nan, place, place, GROUND_M + altitude_m)


def airborne(flavour: Flavour = "ardupilot", **settings: Any) -> tuple[Shell[Copter], float]:
    """A vehicle that hovers at 20 m, under velocity control and at rest, and the time in s since its start."""
    vehicle = copter(flavour, **settings)
    if flavour == "ardupilot":
        told = [mode(4), arm(), command(22, 0, 0, 0, 0, 0, 0, 20)]
    else:
        told = [arm(), take_off_px4(20.0)]
    assert [result(vehicle, data, 5.0 + 0.1 * k) for k, data in enumerate(told)] == [0] * len(told)
    tell(vehicle, setpoint(mask=VELOCITY_ACCELERATION), 30.0)
    assert vehicle.craft.motion.altitude_m == pytest.approx(20.0, abs=0.5)
    if flavour == "px4":
        assert result(vehicle, px4_mode(6), 30.1) == 0
    return vehicle, 30.2


def test_a_px4_speaks_mavlink_1_until_it_hears_mavlink_2() -> None:
    vehicle = copter("px4")
    before = [data[0] for data, _ in vehicle.step([], START + 3 * SECOND)]
    assert set(before) == {0xFE}
    after = vehicle.step([(command(400, 0.0), START + 3 * SECOND)], START + 6 * SECOND)
    assert {data[0] for data, _ in after} == {0xFD}


def test_telemetry_begins_late_and_heartbeats_at_once() -> None:
    vehicle = copter(telemetry_after_s=40.0, ready_after_s=45.0)
    tell(vehicle, command(511, 32, 20_000), 1.0)
    sent = parse_all(vehicle.step([], START + 60 * SECOND))
    first = {name: min(t for m, t in sent if m.get_type() == name) for name in ("HEARTBEAT", "LOCAL_POSITION_NED")}
    assert first["HEARTBEAT"] < START + 3 * SECOND
    assert START + 45 * SECOND <= first["LOCAL_POSITION_NED"] < START + 45 * SECOND + 21 * MS


@pytest.mark.parametrize(
    ("flavour", "message", "number"), [("ardupilot", "EKF_STATUS_REPORT", 193), ("px4", "ESTIMATOR_STATUS", 230)]
)
def test_the_estimator_says_when_it_has_a_position(flavour: Flavour, message: str, number: int) -> None:
    vehicle = copter(flavour, ready_after_s=10.0)
    tell(vehicle, command(511, number, 1_000_000), 1.5)
    flags = [(t, m.flags) for m, t in parse_all(vehicle.step([], START + 20 * SECOND), message)]
    for time_ns, value in flags:
        good = value & 0x08 and value & 0x10 and not value & 0x80
        assert bool(good) == (time_ns >= START + 10 * SECOND)
    assert len(flags) >= 18


@pytest.mark.parametrize(("flavour", "refused"), [("ardupilot", 4), ("px4", 1)])
def test_arming_is_refused_until_ready_and_then_as_configured(flavour: Flavour, refused: int) -> None:
    vehicle = copter(flavour, ready_after_s=10.0, arming_refusals=2)
    answers = [result(vehicle, arm(), at_s) for at_s in (9.0, 10.5, 11.0, 11.5)]
    assert answers == [refused, refused, refused, 0]


def test_ardupilot_needs_position_arming_and_mode_to_take_off() -> None:
    vehicle = copter(ready_after_s=10.0)
    take_off = command(22, 0, 0, 0, 0, 0, 0, 20)
    assert result(vehicle, mode(4), 5.0) == 4
    assert result(vehicle, arm(), 11.0) == 0
    assert result(vehicle, take_off, 11.1) == 4
    assert result(vehicle, mode(4), 11.2) == 0
    assert result(vehicle, take_off, 11.3) == 0
    assert result(vehicle, take_off, 15.0) == 4  # it has left the ground


def test_px4_takes_off_above_sea_level_and_holds() -> None:
    vehicle = copter("px4")
    assert result(vehicle, take_off_px4(20.0 - GROUND_M), 5.0) == 1  # below the ground
    assert result(vehicle, take_off_px4(20.0, 0.0), 5.05) == 2  # at latitude and longitude 0
    assert result(vehicle, take_off_px4(20.0), 5.1) == 0
    assert vehicle.craft.mode == PX4_TAKEOFF
    assert result(vehicle, arm(), 5.2) == 0
    vehicle.step([], START + 30 * SECOND)
    assert vehicle.craft.mode == PX4_HOLD
    assert vehicle.craft.motion.altitude_m == pytest.approx(20.0, abs=0.5)


def test_offboard_is_entered_only_while_set_points_come() -> None:
    vehicle = copter("px4")
    assert result(vehicle, px4_mode(6), 5.0) == 1
    tell(vehicle, setpoint(mask=VELOCITY_ACCELERATION), 6.0)
    assert result(vehicle, px4_mode(6), 7.5) == 1
    tell(vehicle, setpoint(mask=VELOCITY_ACCELERATION), 8.0)
    assert result(vehicle, px4_mode(6), 8.9) == 0
    assert vehicle.craft.mode == PX4_OFFBOARD


def test_px4_leaves_offboard_a_second_after_the_last_set_point() -> None:
    vehicle, at_s = airborne("px4")
    tell(vehicle, setpoint(mask=VELOCITY_ACCELERATION, velocity=(3.0, 0.0)), at_s)
    vehicle.step([], START + round((at_s + 0.99) * SECOND))
    assert vehicle.craft.mode == PX4_OFFBOARD
    vehicle.step([], START + round((at_s + 1.01) * SECOND))
    assert (vehicle.craft.mode, vehicle.craft.failsafe) == (PX4_HOLD, True)


def test_ardupilot_stops_three_seconds_after_its_last_set_point() -> None:
    vehicle, at_s = airborne()
    tell(vehicle, setpoint(mask=VELOCITY_ACCELERATION, velocity=(3.0, 0.0)), at_s)
    vehicle.step([], START + round((at_s + 3.0) * SECOND))
    assert vehicle.craft.motion.velocity_m_s.real == pytest.approx(3.0, abs=0.05)
    vehicle.step([], START + round((at_s + 9.0) * SECOND))
    assert vehicle.craft.motion.velocity_m_s.real == pytest.approx(0.0, abs=0.01)
    assert vehicle.craft.mode == 4


def test_a_set_point_ends_a_guided_take_off() -> None:
    vehicle = copter()
    for k, data in enumerate((mode(4), arm(), command(22, 0, 0, 0, 0, 0, 0, 20))):
        assert result(vehicle, data, 5.0 + 0.1 * k) == 0
    for k in range(100):
        tell(vehicle, setpoint(mask=VELOCITY_ACCELERATION), 8.0 + 0.2 * k)
    assert 2.0 < vehicle.craft.motion.altitude_m < 15.0


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_a_copter_left_on_the_ground_disarms_after_ten_seconds(flavour: Flavour) -> None:
    vehicle = copter(flavour)
    assert result(vehicle, arm(), 5.0) == 0
    vehicle.step([], START + 14 * SECOND)
    assert vehicle.craft.armed
    vehicle.step([], START + 16 * SECOND)
    assert not vehicle.craft.armed


@pytest.mark.parametrize(
    ("mask", "reason"),
    [
        (VELOCITY_ACCELERATION | 0x200, "refused_force"),
        (VELOCITY_ACCELERATION | 8, "setpoints"),  # one velocity axis ignored: all three are, the acceleration counts
        (VELOCITY_ACCELERATION | 64, "setpoints"),
        (VELOCITY_ACCELERATION | 8 | 64, "refused_mask"),
        (0x0C00, "refused_mask"),
    ],
)
def test_masks_mean_what_arducopter_makes_of_them(mask: int, reason: str) -> None:
    vehicle, at_s = airborne()
    before = vehicle.counters[reason]
    tell(vehicle, setpoint(0.0, 1.0, velocity=(2.0, 0.0), mask=mask), at_s)
    assert vehicle.counters[reason] == before + 1
    vehicle.step([], START + round((at_s + 2.0) * SECOND))
    moves = reason == "setpoints"
    assert (abs(vehicle.craft.motion.velocity_m_s.real) > 0.5) == (moves and not mask & 8)
    assert (vehicle.craft.motion.velocity_m_s.imag > 0.5) == (moves and not mask & 64)


def integrated(
    flavour: Flavour, settings: Autopilot, wanted: tuple[float, float], after_s: float
) -> NDArray[np.float64]:
    """(position, velocity, acceleration) north by scipy, from rest, for one held velocity and acceleration."""
    grows = 1.0 if flavour == "ardupilot" else 0.0

    def rates(t: float, x: NDArray[np.float64]) -> list[float]:
        target = wanted[0] + grows * wanted[1] * t
        asked = wanted[1] + settings.velocity_gain_1_s * (target - x[1])
        return [x[1], x[2], (asked - x[2]) / settings.lag_s]

    return solve_ivp(rates, (0.0, after_s), [0.0, 0.0, 0.0], rtol=1e-10, atol=1e-12).y[:, -1]


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_a_copter_responds_with_the_scenarios_lag(flavour: Flavour) -> None:
    vehicle, at_s = airborne(flavour, lag_s=0.3, velocity_gain_1_s=1.5)
    start_m = vehicle.craft.motion.place_m.real
    tell(vehicle, setpoint(0.7, 0.0, velocity=(1.2, 0.0), mask=VELOCITY_ACCELERATION), at_s)
    tell(vehicle, command(0), at_s + 0.9)  # any message brings its state up to date
    expected = integrated(flavour, vehicle.craft.settings, (1.2, 0.7), 0.9)
    motion = vehicle.craft.motion
    found = motion.place_m.real - start_m, motion.velocity_m_s.real, motion.acceleration_m_s2.real
    assert found == pytest.approx(expected.tolist(), abs=1e-6)  # RK4 with steps of 10 ms against a lag of 300 ms


def test_acceleration_and_speed_limits_hold_in_every_direction() -> None:
    vehicle, at_s = airborne(acceleration_max_m_s2=2.0, speed_max_m_s=6.0)
    accelerations: list[float] = []
    speeds: list[float] = []
    for k in range(200):
        tell(vehicle, setpoint(30.0, -40.0, mask=ACCELERATION), at_s + 0.05 * k)
        accelerations.append(abs(vehicle.craft.motion.acceleration_m_s2))
        speeds.append(abs(vehicle.craft.motion.velocity_m_s))
    assert max(accelerations) == pytest.approx(2.0, abs=1e-6)
    assert max(speeds) == pytest.approx(6.0, abs=1e-6)


def test_each_copter_reports_its_own_local_origin() -> None:
    flown = of_copters()
    for k, own in enumerate(flown.vehicles):
        vehicle = shell_of(flown, Copter, k)
        for number in (32, 49):
            vehicle.step(
                [(command(511, number, 1_000_000, system=own.system_id), START + 3 * SECOND)], START + 3 * SECOND
            )
        sent = parse_all(vehicle.step([], START + 6 * SECOND))
        local = next(m for m, _ in sent if m.get_type() == "LOCAL_POSITION_NED")
        origin = next(m for m, _ in sent if m.get_type() == "GPS_GLOBAL_ORIGIN")
        north_m = math.radians(origin.latitude * 1e-7 + 35.363262) * 6_378_137.0 + local.x
        assert north_m == pytest.approx(own.position_ne_m[0], abs=0.01)  # 1e-7 degrees are 11 mm
        assert abs(local.x - own.position_ne_m[0]) > 0.05


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_it_lands_where_it_is_told_to_and_disarms(flavour: Flavour) -> None:
    vehicle, at_s = airborne(flavour)
    assert result(vehicle, mode(9) if flavour == "ardupilot" else px4_mode(4, 6), at_s) == 0
    vehicle.step([], START + round((at_s + 40.0) * SECOND))
    assert (vehicle.craft.landed, vehicle.craft.armed) == (True, False)


def test_a_clock_jump_shows_in_every_stamp_from_then_on() -> None:
    vehicle = copter(clock_jumps=(ClockJump(at_s=10.0, by_s=-0.2),))
    tell(vehicle, command(511, 32, 20_000), 3.0)
    sent = parse_all(vehicle.step([], START + 20 * SECOND), "LOCAL_POSITION_NED")
    offset_ms = np.array([m.time_boot_ms - t / MS for m, t in sent])
    steps = np.diff(offset_ms)
    assert np.abs(np.sort(steps)[1:]).max() < 1.5  # whole milliseconds, and drift
    assert steps.min() == pytest.approx(-200.0, abs=1.5)
