"""What was measured on a real ArduCopter in SITL, shown by the simulated copters: one test for each fact."""

from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from scenarios.keys.autopilot import Sitl
from scenarios.keys.part import Flavour
from sim_vehicles.services.sitl import slips
from sim_vehicles.vehicles.copter import Copter
from sim_vehicles.vehicles.shell import Shell
from tests.sim_vehicles.vehicles.test_copter import VELOCITY_ACCELERATION, airborne, copter, of_copters, tell
from tests.support.sim_client import MS, SECOND, START, arm, command, parse_all, setpoint

TARGET = 85
"""POSITION_TARGET_LOCAL_NED"""


def timesync(ts1: int) -> bytes:
    link = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    return bytes(dialect.MAVLink_timesync_message(0, ts1).pack(link))


def target_at(vehicle: Shell[Copter], at_s: float) -> Any:
    """The target that a vehicle reports within a millisecond of a request."""
    time_ns = START + round(at_s * SECOND)
    vehicle.step([], time_ns - 1)
    sent = vehicle.step([(command(512, TARGET), time_ns)], time_ns + MS)
    [(message, _)] = parse_all(sent, "POSITION_TARGET_LOCAL_NED")
    return message


def backdated_ns(vehicle: Shell[Copter], count: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    found: list[int] = []
    for k in range(count):
        (reply,) = tell(vehicle, timesync(k + 1), 2.0 + 0.1 * k, "TIMESYNC")
        found.append(vehicle.radio.clock.boot_ns(START + round((2.0 + 0.1 * k) * SECOND)) - reply.tc1)
    return np.array(found)


def test_replies_are_backdated_by_up_to_the_configured_time() -> None:
    back_ns = backdated_ns(copter(sitl=Sitl(timesync_back_s=0.0035)), 400)
    assert back_ns.min() >= 0
    assert back_ns.max() < 3.5 * MS
    assert back_ns.mean() == pytest.approx(1.75 * MS, rel=0.1)  # uniform; four standard errors are 0.2 ms
    assert not backdated_ns(copter(), 5).any()


def test_the_simulator_slips_as_often_and_as_far_as_configured() -> None:
    scenario = of_copters(sitl=Sitl(slip_s=0.002, slip_every_s=5.0))
    found = [next_slip for next_slip, _ in zip(slips(scenario, 1, START), range(400), strict=False)]
    at_ns, by_ns = np.array(found).T
    assert np.diff(at_ns).mean() == pytest.approx(5.0 * SECOND, rel=0.2)  # exponential; four standard errors
    assert -by_ns.mean() == pytest.approx(2.0 * MS, rel=0.2)
    vehicle = copter(sitl=Sitl(slip_s=0.002, slip_every_s=5.0))
    before_ns = vehicle.radio.clock.boot_ns(START)
    vehicle.step([], START + 50 * SECOND)
    drift_ns = 50 * 1000 * vehicle.radio.clock.drift_ppb / 1000
    lost_ns = sum(by_ns[at_ns <= START + 50 * SECOND].tolist())
    late_ns = vehicle.radio.clock.boot_ns(START + 50 * SECOND) - before_ns - 50 * SECOND
    assert late_ns == pytest.approx(lost_ns + drift_ns, abs=100_000)  # drift is lost with the time it drifted in
    assert lost_ns < -5 * MS


@pytest.mark.parametrize(("flavour", "grown_m_s"), [("ardupilot", 1.45), ("px4", 1.0)])
def test_the_active_target_is_echoed_and_integrated_on_request(flavour: Flavour, grown_m_s: float) -> None:
    vehicle, at_s = airborne(flavour)
    tell(vehicle, setpoint(0.5, mask=VELOCITY_ACCELERATION, velocity=(1.0, 0.0)), at_s)
    before, after = target_at(vehicle, at_s), target_at(vehicle, at_s + 0.9)
    assert before.vx == pytest.approx(1.0, abs=0.001)  # the request is answered within a millisecond
    wanted_m_s2 = 0.5 if flavour == "ardupilot" else 0.5 + vehicle.craft.settings.velocity_gain_1_s
    # PX4 reports what its velocity loop wants: it stood, and has flown for a millisecond
    assert before.afx == pytest.approx(wanted_m_s2, abs=0.01)
    assert before.type_mask == VELOCITY_ACCELERATION
    assert after.vx == pytest.approx(grown_m_s, abs=0.001)


def test_a_stream_of_targets_comes_only_when_asked_for() -> None:
    vehicle, at_s = airborne()
    tell(vehicle, setpoint(mask=VELOCITY_ACCELERATION, velocity=(1.0, 0.0)), at_s)
    assert parse_all(vehicle.step([], START + round((at_s + 1.0) * SECOND)), "POSITION_TARGET_LOCAL_NED") == []
    tell(vehicle, command(511, TARGET, 100_000), at_s + 1.0)
    assert len(parse_all(vehicle.step([], START + round((at_s + 2.0) * SECOND)), "POSITION_TARGET_LOCAL_NED")) == 10


def test_set_points_that_stop_are_flown_on_for_three_seconds() -> None:
    vehicle, at_s = airborne()
    tell(vehicle, setpoint(mask=VELOCITY_ACCELERATION, velocity=(1.0, 0.0)), at_s)
    assert [target_at(vehicle, at_s + later_s).vx for later_s in (2.9, 3.1)] == [1.0, 0.0]
    assert vehicle.craft.mode == vehicle.craft.rules.guided_mode  # it stands in GUIDED


def test_it_says_why_it_cannot_be_armed_unasked_and_asked() -> None:
    vehicle = copter(ready_after_s=38.0, arming_refusals=1)
    assert tell(vehicle, arm(), 5.0, "STATUSTEXT")[0].text == "Arm: Need Position Estimate"
    by_itself = parse_all(vehicle.step([], START + 37 * SECOND), "STATUSTEXT")
    assert [message.text for message, _ in by_itself] == ["PreArm: Need Position Estimate"]
    assert tell(vehicle, arm(), 37.9, "STATUSTEXT")[0].text == "Arm: Need Position Estimate"
    assert tell(vehicle, arm(), 38.1, "STATUSTEXT")[0].text == "Arm: Accels inconsistent"
    assert tell(vehicle, arm(), 39.1)[0].result == 0
    assert parse_all(vehicle.step([], START + 48 * SECOND), "STATUSTEXT") == []
