"""The next start-up step for each kind of autopilot, as a table, and what is refused."""

import math

import pytest

from gcs.autopilot.fleet import AutopilotFleet
from gcs.autopilot.kinds import ARDUCOPTER, PX4_COPTER, kind_of
from gcs.autopilot.startup import AutopilotStartup, between, shifted
from gcs.control.history import StateHistory
from gcs.link.kinds import UNRECOGNISED, Kind, commanded_mode, mode_command
from gcs.link.vehicle import ignored
from tests.support.fleets.flown_copters import plan_for, three

ALTITUDE_M = 20.0
GOOD = 0x33F
OFFBOARD = 6 << 16
AUTOPILOTS = {ARDUCOPTER: 3, PX4_COPTER: 12}


class Informed:
    """Start-up after a vehicle has sent all messages except the one with id `but`, and accepted their rates."""

    def __init__(self, kind: Kind, *, flags: int = GOOD, but: int = -1) -> None:
        self.startup = AutopilotStartup(altitude_m=ALTITUDE_M, telemetry_hz=50.0)
        self.startup.recognise(AUTOPILOTS[kind], 2)
        status = 193 if kind is ARDUCOPTER else 230
        for number, fields in (
            (32, (1000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
            (49, (-353632620, 1491652370, 584_000)),
            (status, (flags,) * 10),
        ):
            if number != but:
                self.startup.take(number, fields)
        if but != 33:
            self.at(0.0)
        for number in (32.0, 33.0, 49.0, float(status)):
            self.startup.accepted(511, (number, 0.0), 0)

    def at(self, height_m: float) -> None:
        self.startup.take(33, (1000, -353632620, 1491652370, 584_000 + round(1e3 * height_m), round(1e3 * height_m)))

    def advised(
        self, mode: int = 0, *, armed: bool = False, clock_known: bool = True
    ) -> tuple[str, tuple[int, tuple[float, ...]] | None]:
        return self.startup.next(custom_mode=mode, armed=armed, clock_known=clock_known, now_ns=0)


def test_arducopter_goes_guided_arms_takes_off_and_then_is_ready() -> None:
    copter = Informed(ARDUCOPTER)
    assert copter.advised() == ("does not enter GUIDED", (176, (1.0, 4.0)))
    assert copter.advised(4) == ("does not arm", (400, (1.0,)))
    assert copter.advised(4, armed=True) == ("does not take off", (22, (0.0,) * 6 + (20.0,)))
    copter.startup.accepted(22, (), 0)
    copter.at(7.31)
    assert copter.advised(4, armed=True) == ("climbs to 20 m, is at 7.3 m", None)
    copter.at(19.5)
    assert copter.advised(4, armed=True) == ("", None)


def test_px4_arms_takes_off_to_altitude_amsl_then_enters_offboard() -> None:
    copter, hold = Informed(PX4_COPTER), 4 << 16 | 3 << 24
    assert copter.advised(hold) == ("does not arm", (400, (1.0,)))
    _, command = copter.advised(hold, armed=True)
    assert command is not None
    assert (command[0], command[1][6]) == (22, 604.0)
    assert all(math.isnan(value) for value in command[1][3:6])  # finite numbers would be a position to fly to
    copter.startup.accepted(22, (), 0)
    assert copter.advised(4 << 16 | 2 << 24, armed=True)[1] is None
    copter.at(19.5)
    assert copter.advised(hold, armed=True) == ("does not enter OFFBOARD", (176, (1.0, 6.0, 0.0)))
    assert copter.advised(OFFBOARD, armed=True) == ("", None)


@pytest.mark.parametrize(
    ("flags", "ready"), [(0x33F, True), (0x18, True), (0x08, False), (0x10, False), (0x98, False), (0x481, False)]
)
def test_nothing_is_armed_before_the_estimator_has_a_position(flags: int, ready: bool) -> None:
    for kind in (ARDUCOPTER, PX4_COPTER):
        missing, command = Informed(kind, flags=flags).advised()
        assert (command is not None) == ready
        assert ready or missing == f"has no position yet (estimator flags 0x{flags:x})"


@pytest.mark.parametrize(
    ("unsaid", "words"),
    [
        (193, "sends no estimator status (message 193)"),
        (32, "sends no LOCAL_POSITION_NED"),
        (33, "sends no GLOBAL_POSITION_INT"),
    ],
)
def test_a_message_that_is_missing_is_named(unsaid: int, words: str) -> None:
    assert Informed(ARDUCOPTER, but=unsaid).advised() == (words, None)


def test_unaccepted_rate_unknown_clock_and_unknown_origin_are_named() -> None:
    copter = Informed(ARDUCOPTER)
    assert copter.advised(clock_known=False) == ("does not answer TIMESYNC", None)
    copter.startup.origin = None
    assert copter.advised() == ("does not say where its local origin is", None)
    copter.startup.begin_anew()
    assert copter.advised() == ("does not accept the rate of message 32", (511, (32.0, 20000.0)))


def test_a_vehicle_found_flying_is_not_told_to_take_off() -> None:
    startup = AutopilotStartup(altitude_m=ALTITUDE_M, telemetry_hz=50.0)
    startup.recognise(3, 2)
    startup.take(33, (1000, -353632620, 1491652370, 596_000, 12_000, 0, 0, 0, 0))
    startup.next(custom_mode=4, armed=True, clock_known=True, now_ns=0)
    assert startup.airborne


def startup_that_flew() -> AutopilotStartup:
    startup = AutopilotStartup(altitude_m=ALTITUDE_M, telemetry_hz=50.0)
    startup.recognise(3, 2)
    startup.take(0, (4, 2, 3, 0x80, 4, 3))
    startup.take(33, (1000, -353632620, 1491652370, 590_000, 6_000, 0, 0, 0, 0))
    return startup


@pytest.mark.parametrize(("base_mode", "status", "lands"), [(0x00, 3, True), (0x80, 3, True), (0x80, 4, False)])
def test_a_vehicle_on_the_ground_after_flight_has_landed(base_mode: int, status: int, *, lands: bool) -> None:
    startup = startup_that_flew()
    startup.take(33, (2000, -353632620, 1491652370, 584_100, 100, 0, 0, 0, 0))
    assert not startup.stays_disarmed  # low, but its motors carry it
    startup.take(0, (4, 2, 3, base_mode, status, 3))
    assert bool(startup.stays_disarmed) == lands
    startup.begin_anew()  # as after a restart of its autopilot
    assert bool(startup.stays_disarmed) == lands


def test_a_landed_vehicle_whose_pilot_takes_off_again_is_flown() -> None:
    startup = startup_that_flew()
    startup.take(0, (4, 2, 3, 0, 3, 3))
    startup.take(0, (5, 2, 3, 0x80, 4, 3))
    assert not startup.stays_disarmed  # the newest altitude is from before the landing
    startup.take(0, (5, 2, 3, 0, 3, 3))
    startup.take(33, (2000, -353632620, 1491652370, 584_100, 100, 0, 0, 0, 0))
    startup.take(0, (5, 2, 3, 0x80, 4, 3))
    assert startup.stays_disarmed
    startup.take(33, (3000, -353632620, 1491652370, 589_000, 5_000, 0, 0, 0, 0))
    assert not startup.stays_disarmed


def test_a_drifting_barometer_is_no_flight() -> None:
    startup = AutopilotStartup(altitude_m=ALTITUDE_M, telemetry_hz=50.0)
    startup.recognise(3, 2)
    for base_mode in (0x80, 0, 0x80, 0):
        startup.take(0, (4, 2, 3, base_mode, 3, 3))
        startup.take(33, (1000, -353632620, 1491652370, 584_400, 400, 0, 0, 0, 0))  # its barometer drifts
    assert not startup.stays_disarmed


def test_repeated_refusals_to_arm_are_one_text_and_a_count() -> None:
    startup = AutopilotStartup(altitude_m=ALTITUDE_M, telemetry_hz=50.0)
    startup.recognise(3, 2)
    startup.take(0, (4, 2, 3, 0, 3, 3))
    news = [startup.is_news("Arm: Throttle too high") for _ in range(3)]
    assert news == [True, False, False]
    for _ in range(3):
        startup.refused(400, (1.0,), 0, repeated=False)
    assert startup.arming_refusals == 3
    startup.take(0, (4, 2, 3, 0x80, 4, 3))
    assert startup.arming_refusals == 0
    assert [startup.is_news("Land complete") for _ in range(2)] == [True, True]  # in the air every text is passed on


def test_a_takeoff_counts_though_unanswered_and_refused_on_repetition() -> None:
    startup = AutopilotStartup(altitude_m=ALTITUDE_M, telemetry_hz=50.0)
    startup.recognise(3, 2)
    startup.refused(22, (0.0,) * 7, 0, repeated=True)
    startup.take(33, (1000, -353632620, 1491652370, 589_000, 5_000, 0, 0, 0, 0))
    startup.next(custom_mode=4, armed=True, clock_known=True, now_ns=0)
    assert not startup.airborne  # a set-point now would end its take-off at 5 m


@pytest.mark.parametrize(
    ("autopilot", "vehicle_type", "words"),
    [(3, 1, "is an ArduPlane"), (12, 1, "type 1 with autopilot 12"), (3, 10, "type 10"), (8, 2, "autopilot 8")],
)
def test_what_cannot_be_flown_is_refused_by_name(autopilot: int, vehicle_type: int, words: str) -> None:
    found = kind_of(autopilot, vehicle_type)
    assert isinstance(found, str)
    assert words in found


def test_a_vehicle_still_of_unknown_type_is_waited_for() -> None:
    startup = AutopilotStartup(altitude_m=ALTITUDE_M, telemetry_hz=50.0)
    startup.recognise(3, 0)
    assert (startup.kind, startup.refusal) == (UNRECOGNISED, "")
    startup.recognise(3, 13)
    assert startup.kind is ARDUCOPTER


@pytest.mark.parametrize("kind", [ARDUCOPTER, PX4_COPTER])
def test_a_mode_command_is_read_back_as_its_mode(kind: Kind) -> None:
    for mode in (kind.guided_mode, kind.hold_mode, kind.land_mode):
        assert commanded_mode(kind, mode_command(kind, mode)[1]) == mode


def test_a_moving_vehicles_origin_allows_for_time_between_its_positions() -> None:
    origin = (47.397742, 8.545594)
    startup = AutopilotStartup(altitude_m=ALTITUDE_M, telemetry_hz=50.0)
    startup.take(32, (10_000, 100.0, -40.0, -5.0, 12.0, -3.0, 0.0))
    place = shifted(origin, 100.0 + 0.5 * 12.0, -40.0 - 0.5 * 3.0)
    startup.take(33, (10_500, round(place[0] * 1e7), round(place[1] * 1e7), 500_000, 5_000, 0, 0, 0, 0))
    assert startup.origin is not None
    assert between(origin, startup.origin) == pytest.approx((0.0, 0.0), abs=0.012)  # 1e-7 degrees are 11 mm


def test_a_reported_origin_wins_over_home_and_a_computed_one() -> None:
    startup = AutopilotStartup(altitude_m=ALTITUDE_M, telemetry_hz=50.0)
    startup.take(242, (470000000, 80000000, 400_000, 3.0, 4.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0))
    assert startup.origin is not None
    assert between(startup.origin, (47.0, 8.0)) == pytest.approx((3.0, 4.0), abs=1e-3)
    startup.take(49, (471000000, 81000000, 400_000, 0))
    startup.take(32, (10_000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    startup.take(33, (10_000, 470000000, 80000000, 400_000, 0, 0, 0, 0, 0))
    assert startup.origin == pytest.approx((47.1, 8.1))


def test_a_position_of_zeros_is_none() -> None:
    startup = AutopilotStartup(altitude_m=ALTITUDE_M, telemetry_hz=50.0)
    startup.take(32, (10_000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    startup.take(33, (10_000, 0, 0, 0, 0, 0, 0, 0, 0))
    assert startup.origin is None
    assert startup.relative_altitude_m is None


def test_an_old_altitude_is_updated_from_the_local_height() -> None:
    startup = AutopilotStartup(altitude_m=ALTITUDE_M, telemetry_hz=50.0)
    startup.take(32, (10_000, 0.0, 0.0, -18.6, 0.0, 0.0, 0.0))
    startup.take(33, (10_000, 470000000, 80000000, 400_000, 19_600, 0, 0, 0, 0))
    startup.take(32, (10_900, 0.0, 0.0, -19.1, 0.0, 0.0, 0.0))
    assert startup.relative_altitude_m == 19.6  # reported five times a second: the next may still arrive
    startup.take(32, (11_100, 0.0, 0.0, -19.3, 0.0, 0.0, 0.0))
    assert startup.relative_altitude_m == pytest.approx(20.3)


def test_a_restarted_vehicle_has_to_report_its_origin_again() -> None:
    startup = AutopilotStartup(altitude_m=ALTITUDE_M, telemetry_hz=50.0)
    startup.take(49, (471000000, 81000000, 400_000, 0))
    for base_mode, known in ((128, True), (0, False)):  # if it is armed, only its clock has jumped
        startup.take(0, (2, 3, 0, 128, 4, 3))
        startup.begin_anew()
        startup.take(0, (2, 3, 0, base_mode, 4, 3))
        assert (startup.origin is not None) == known


def test_states_in_the_frame_before_a_restart_are_dropped() -> None:
    fleet, history = AutopilotFleet(plan_for(three()), ignored), StateHistory(3)
    for startup in fleet.starts:
        startup.take(49, (471000000, 81000000, 400_000, 0))
    fleet.locate(history)
    for row in (1, 2):
        history.add(row, 10, (1.0, 2.0, 0.0, 0.0))
    fleet.starts[1].begin_anew()
    fleet.locate(history)
    assert [history.newest(row) is None for row in (1, 2)] == [True, False]
    fleet.starts[1].take(49, (471001000, 81000000, 400_000, 0))
    fleet.locate(history)
    assert fleet.frame_ned_m[1, 0] == pytest.approx(11.1, abs=0.1)
