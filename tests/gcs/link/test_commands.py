"""Commands and their answers, which do not say to which request they belong."""

from collections import Counter

from gcs.link import mavlink
from gcs.link.clocks import LEAST_SAMPLES
from gcs.link.kinds import ARM_DISARM, SET_MESSAGE_INTERVAL, SET_MODE, Goal
from gcs.link.startup import LaunchedStartup
from gcs.link.vehicle import RemoteVehicle, in_words
from scenarios.schema import NS_PER_S

ACCEPTED = (SET_MESSAGE_INTERVAL, 0, 0, 0, 0, 0)


def requested(frame: bytes | None) -> float:
    """The message whose rate a frame asks for."""
    assert frame is not None
    [parsed] = mavlink.decode(frame, Counter())
    assert parsed.msg_id == mavlink.COMMAND_LONG
    return parsed.fields[0]


def asked_twice() -> RemoteVehicle:
    """A vehicle that was asked twice for positions, before the first answer came."""
    vehicle = RemoteVehicle(7, startup=LaunchedStartup(50.0, target_hz=10.0))
    vehicle.address = 1
    vehicle.clock.rtt_ns = 3 * NS_PER_S // 10
    assert requested(vehicle.next_frame(0)) == mavlink.LOCAL_POSITION_NED
    assert requested(vehicle.next_frame(NS_PER_S)) == mavlink.LOCAL_POSITION_NED
    vehicle.acknowledge(ACCEPTED, NS_PER_S + 1)
    assert requested(vehicle.next_frame(NS_PER_S + 2)) == mavlink.POSITION_TARGET_LOCAL_NED
    return vehicle


def test_a_second_answer_does_not_answer_the_next_request() -> None:
    vehicle = asked_twice()
    vehicle.acknowledge(ACCEPTED, NS_PER_S + 3)
    assert requested(vehicle.next_frame(2 * NS_PER_S + 2)) == mavlink.POSITION_TARGET_LOCAL_NED
    vehicle.acknowledge(ACCEPTED, 2 * NS_PER_S + 3)
    assert "message" not in vehicle.missing
    assert "telemetry rate" not in vehicle.missing


def test_answer_after_a_round_trip_is_to_the_newest_request() -> None:
    vehicle = asked_twice()
    # the first copy was never answered: the vehicle was still booting
    vehicle.acknowledge(ACCEPTED, NS_PER_S + 2 + 3 * NS_PER_S // 10)
    assert "telemetry rate" not in vehicle.missing


def test_a_request_is_repeated_until_it_is_answered_itself() -> None:
    vehicle = asked_twice()
    # the second answer was lost; this one, taken for it, does not end the request either
    vehicle.acknowledge(ACCEPTED, NS_PER_S + 3)
    for k in range(2, 5):
        vehicle.heard_ns = k * NS_PER_S
        assert requested(vehicle.next_frame(k * NS_PER_S + 2)) == mavlink.POSITION_TARGET_LOCAL_NED
    assert "telemetry rate" in vehicle.missing


def test_vehicle_with_nothing_left_to_command_awaits_timesync_answers() -> None:
    vehicle = RemoteVehicle(7, startup=LaunchedStartup(50.0))
    vehicle.address, vehicle.heard_ns = 1, NS_PER_S
    for command in (SET_MESSAGE_INTERVAL, SET_MODE, ARM_DISARM):
        assert not vehicle.awaits_clock
        assert vehicle.next_frame(NS_PER_S) is not None
        vehicle.acknowledge((command, 0, 0, 0, 0, 0), NS_PER_S)
    assert vehicle.awaits_clock
    assert vehicle.next_frame(NS_PER_S) is None
    assert vehicle.quiet_until_ns > NS_PER_S
    vehicle.clock.samples = LEAST_SAMPLES
    assert not vehicle.awaits_clock
    assert vehicle.ready


def stranger() -> tuple[RemoteVehicle, list[int]]:
    """A vehicle that has to say that it is simulated, and the ids of the messages sent to it in twenty seconds."""
    vehicle, sent = RemoteVehicle(7, startup=LaunchedStartup(50.0, stranger=True)), list[int]()
    vehicle.address = 1
    for k in range(400):
        vehicle.heard_ns = k * NS_PER_S // 20
        if (frame := vehicle.next_frame(k * NS_PER_S // 20)) is not None:
            sent += [parsed.msg_id for parsed in mavlink.decode(frame, Counter())]
    return vehicle, sent


def test_a_stranger_is_only_asked_whether_it_is_simulated() -> None:
    vehicle, sent = stranger()
    assert {*sent} == {mavlink.PARAM_EXT_REQUEST_READ}
    assert vehicle.startup.refusal.startswith("does not say that it is simulated, wanted")
    vehicle.goal = Goal.END
    assert vehicle.next_frame(20 * NS_PER_S) is None
    assert vehicle.final_command() is None


def test_a_stranger_that_says_it_is_simulated_is_flown() -> None:
    vehicle, _ = stranger()
    vehicle.pass_to_startup(mavlink.PARAM_EXT_VALUE, (0, 1, b"OTHER\0", b"0123 trio\0", 11))
    assert vehicle.next_frame(20 * NS_PER_S) is None
    vehicle.pass_to_startup(mavlink.PARAM_EXT_VALUE, (0, 1, b"SCENARIO\0", b"0123 trio\0", 11))
    assert requested(vehicle.next_frame(20 * NS_PER_S)) == mavlink.LOCAL_POSITION_NED


def test_a_line_about_many_vehicles_names_ten_of_them() -> None:
    vehicles = [RemoteVehicle(k + 1, startup=LaunchedStartup(50.0)) for k in range(1000)]
    line = in_words("not ready: ", vehicles)
    assert line.startswith("not ready: vehicle 1 not heard; vehicle 2 not heard; ")
    assert line.endswith("; vehicle 10 not heard; 990 others")
    assert in_words("not ready: ", vehicles[:2]) == "not ready: vehicle 1 not heard; vehicle 2 not heard"
    assert in_words("not ready: ", []) == ""
