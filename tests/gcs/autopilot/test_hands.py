"""Who flies a vehicle: what its heartbeats show of a pilot's intervention, and what the station then commands."""

from typing import Any

import pytest

from gcs.autopilot.kinds import ARDUPILOT, PX4, PX4_COPTER
from gcs.autopilot.startup import AutopilotStartup
from gcs.link import mavlink
from gcs.link.clocks import LEAST_SAMPLES
from gcs.link.kinds import ARM_DISARM, SET_MESSAGE_INTERVAL, SET_MODE, TAKE_OFF
from gcs.link.vehicle import RemoteVehicle
from scenarios.schema import NS_PER_S
from tests.support.sim_client import parse

ACTIVE, STANDBY, CRITICAL = 4, 3, 5
STABILIZE, GUIDED, LOITER, RTL, POSCTL = 0, 4, 5, 6, 3 << 16


class Talk:
    """A vehicle with an autopilot, of which the station knows all that it needs except heartbeats."""

    def __init__(self, autopilot: int = ARDUPILOT) -> None:
        self.texts: list[str] = []
        startup = AutopilotStartup(altitude_m=5.0, telemetry_hz=50.0)
        self.vehicle = RemoteVehicle(2, startup=startup, report=lambda _kind, text, _id: self.texts.append(text))
        self.vehicle.address = 1
        self.vehicle.clock.samples = LEAST_SAMPLES
        self.now_ns, self._autopilot = NS_PER_S, autopilot
        self.hear(mavlink.EKF_STATUS_REPORT if autopilot != PX4 else mavlink.ESTIMATOR_STATUS, flags=0x33F)
        self.hear(mavlink.LOCAL_POSITION_NED, (1000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        self.rise(0.0)

    def hear(self, msg_id: int, fields: tuple[Any, ...] = (), *, flags: int = 0) -> None:
        self.vehicle.heard_ns = self.now_ns
        self.vehicle.pass_to_startup(msg_id, fields or (*(0,) * 5, flags, *(0,) * 3, flags))

    def rise(self, altitude_m: float) -> None:
        mm = round(1000.0 * altitude_m)
        self.hear(mavlink.GLOBAL_POSITION_INT, (1000, -353632620, 1491652370, 584_000 + mm, mm, 0, 0, 0, 0))

    def heartbeat(self, mode: int, *, armed: bool, status: int = STANDBY, after_s: float = 3.0) -> None:
        """A heartbeat, by default so late that it was sent after all earlier commands had arrived."""
        self.now_ns += round(after_s * NS_PER_S)
        fields = mode, 2, self._autopilot, 0x80 if armed else 0, status, 3
        self.vehicle.heartbeat(fields, self.now_ns)
        self.hear(mavlink.HEARTBEAT, fields)

    def commanded(self, *, answers: bool = True, seconds: float = 4.0) -> list[int]:
        """Commands sent within `seconds`, except for rates; these are always accepted, the others if it `answers`."""
        numbers: list[int] = []
        for _ in range(round(seconds * 50.0)):
            self.now_ns += NS_PER_S // 50
            self.vehicle.heard_ns = self.now_ns
            frame = self.vehicle.next_frame(self.now_ns)
            message = None if frame is None else parse(frame)
            if message is None or message.get_type() != "COMMAND_LONG":
                continue
            rate = message.command == SET_MESSAGE_INTERVAL
            numbers += [] if rate else [message.command]
            if answers or rate:
                self.vehicle.acknowledge((message.command, 0, 0, 0, 255, 190), self.now_ns)
        return numbers


def test_a_vehicle_that_somebody_disarms_is_not_armed_again() -> None:
    talk = Talk()
    talk.heartbeat(STABILIZE, armed=False)
    assert talk.commanded() == [SET_MODE, ARM_DISARM, TAKE_OFF]
    talk.heartbeat(GUIDED, armed=False)  # before any heartbeat showed it armed
    assert talk.commanded() == []
    assert talk.texts == ["was disarmed"]
    assert talk.vehicle.missing == "was disarmed and is not armed again"
    talk.heartbeat(GUIDED, armed=True)  # by its pilot
    assert talk.commanded() == [TAKE_OFF]


@pytest.mark.parametrize(
    ("autopilot", "modes"),
    [
        (ARDUPILOT, (LOITER,)),
        (ARDUPILOT, (RTL,)),  # on a low battery
        (ARDUPILOT, (GUIDED, RTL)),
        (PX4, (POSCTL,)),
        (PX4, (PX4_COPTER.guided_mode, POSCTL)),
        (PX4, (PX4_COPTER.guided_mode, PX4_COPTER.hold_mode, POSCTL)),
    ],
)
def test_a_failsafe_takes_no_vehicle_from_its_pilot(autopilot: int, modes: tuple[int, ...]) -> None:
    talk = Talk(autopilot)
    talk.rise(8.0)
    for mode in modes:
        guided = mode == talk.vehicle.kind.guided_mode
        talk.heartbeat(mode, armed=True, status=ACTIVE if guided else CRITICAL)
    assert talk.commanded() == []
    assert talk.vehicle.taken_over


def test_whoever_arms_a_vehicle_in_its_former_mode_flies_it() -> None:
    talk = Talk()
    talk.hear(mavlink.EKF_STATUS_REPORT, flags=0x481)  # no position yet
    talk.heartbeat(STABILIZE, armed=False)
    assert talk.commanded() == []
    talk.heartbeat(STABILIZE, armed=True, status=ACTIVE)
    talk.hear(mavlink.EKF_STATUS_REPORT, flags=0x33F)
    talk.rise(7.5)
    assert talk.commanded() == []
    assert talk.vehicle.missing == "is armed and not in GUIDED: flown by its pilot or its autopilot"
    talk.vehicle.end()
    assert talk.commanded() == []


@pytest.mark.parametrize("mode", [GUIDED, PX4_COPTER.hold_mode])
def test_arming_under_way_at_the_end_is_followed_by_hold(mode: int) -> None:
    talk = Talk(ARDUPILOT if mode == GUIDED else PX4)
    talk.heartbeat(mode, armed=False)
    assert talk.commanded(answers=False, seconds=0.5) == [ARM_DISARM]
    talk.vehicle.end()
    assert not talk.vehicle.ended
    assert talk.commanded(answers=False, seconds=0.5) == [SET_MODE]
    assert talk.vehicle.missing == "does not hold"
    assert talk.commanded(seconds=1.5) == [SET_MODE]  # not the arming again
    assert talk.vehicle.ended
