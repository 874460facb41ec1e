"""Commands and their answers, which do not say what they answer."""

from gcs.link import mavlink
from gcs.link.kinds import SET_MESSAGE_INTERVAL
from gcs.link.startup import LaunchedStartup
from gcs.link.vehicle import RemoteVehicle, in_words
from scenarios.schema import NS_PER_S

ACCEPTED = (SET_MESSAGE_INTERVAL, 0, 0, 0, 0, 0)


def requested(frame: bytes | None) -> float:
    """The message whose rate a frame asks for."""
    assert frame is not None
    [parsed] = mavlink.decode(frame, {})  # pyright: ignore[reportArgumentType] - nothing is refused
    assert parsed.msg_id == mavlink.COMMAND_LONG
    return parsed.fields[0]


def asked_twice() -> RemoteVehicle:
    """A vehicle that was asked twice for positions, before the first answer came."""
    vehicle = RemoteVehicle(7, startup=LaunchedStartup(50.0, target_hz=10.0))
    vehicle.address = "127.0.0.1", 1, 0
    vehicle.clock.rtt_ns = 3 * NS_PER_S // 10
    assert requested(vehicle.next_frame(0)) == mavlink.LOCAL_POSITION_NED
    assert requested(vehicle.next_frame(NS_PER_S)) == mavlink.LOCAL_POSITION_NED
    vehicle.acknowledge(ACCEPTED, NS_PER_S + 1)
    assert requested(vehicle.next_frame(NS_PER_S + 2)) == mavlink.POSITION_TARGET_LOCAL_NED
    return vehicle


def test_a_second_answer_to_a_request_is_none_to_the_next() -> None:
    vehicle = asked_twice()
    vehicle.acknowledge(ACCEPTED, NS_PER_S + 3)
    assert requested(vehicle.next_frame(2 * NS_PER_S + 2)) == mavlink.POSITION_TARGET_LOCAL_NED
    vehicle.acknowledge(ACCEPTED, 2 * NS_PER_S + 3)
    assert "message" not in vehicle.missing
    assert "telemetry rate" not in vehicle.missing


def test_an_answer_after_a_round_trip_is_to_the_newest_request() -> None:
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


def test_a_line_about_many_vehicles_names_ten_of_them() -> None:
    vehicles = [RemoteVehicle(k + 1, startup=LaunchedStartup(50.0)) for k in range(1000)]
    line = in_words("not ready: ", vehicles)
    assert line.startswith("not ready: vehicle 1 not heard; vehicle 2 not heard; ")
    assert line.endswith("; vehicle 10 not heard; 990 others")
    assert in_words("not ready: ", vehicles[:2]) == "not ready: vehicle 1 not heard; vehicle 2 not heard"
    assert in_words("not ready: ", []) == ""
