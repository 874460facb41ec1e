"""A vehicle that its pilot has taken over stays the pilot's, whatever happens, until it reports its guided mode."""

from collections.abc import Callable

import pytest

from gcs.drive.lockstep import START_NS, fly_lockstep
from gcs.link.startup import LaunchedStartup
from gcs.link.vehicle import RemoteVehicle
from gcs.station.station import Station
from scenarios.keys.link import Link, Outage, VehicleLinks
from scenarios.schema import ClockJump, Scenario
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.vehicles.copter_rules import RULES
from tests.support.fleets.flown_copters import COPTERS5, plan_for
from tests.support.fleets.pilots import PILOTS_MODE, POSCTL, RTL, SET_MESSAGE_INTERVAL, PilotsVehicle, flight_s, flown
from tests.support.sim_client import SECOND, parse


def fly(
    scenario: Scenario,
    flavour: str,
    modes: dict[float, int],
    *,
    until_s: float = 60.0,
    change: Callable[[bytes, int], list[tuple[bytes, int]]] | None = None,
    fleet: Fleet | None = None,
    start_ns: int = START_NS,
) -> tuple[Station, PilotsVehicle]:
    """Fly until the end, or until `until_s` after the start."""
    station = Station(plan_for(scenario), start_ns=start_ns)
    pilots = PilotsVehicle(fleet or Fleet(scenario, START_NS), flavour, modes)
    if change is not None:
        pilots.change = change
    for tick in fly_lockstep(station.plan, station=station, vehicles=pilots):
        if tick["due_ns"][0] > start_ns + until_s * SECOND:
            break
    return station, pilots


def assert_left_alone(pilots: PilotsVehicle, mode: int) -> None:
    assert pilots.told, "nothing was sent at all: the test would not see a command"
    assert pilots.commanded == []
    assert pilots.copter.mode == mode


@pytest.mark.slow(first=2)
@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
@pytest.mark.parametrize("by_s", [-0.2, 3.0, -1000.0])
def test_a_clock_jump_takes_no_vehicle_from_its_pilot(flavour: str, by_s: float) -> None:
    began_s, mode = flight_s(flavour), PILOTS_MODE[flavour]
    scenario = flown(flavour, clock_jumps=(ClockJump(at_s=began_s + 8.0, by_s=by_s),))
    station, pilots = fly(scenario, flavour, {began_s + 5.0: mode})
    assert "its clock jumped" in [event.text for event in station.events if event.system_id == 3]
    assert station.end_reason == "taken over: vehicles 3"
    assert_left_alone(pilots, mode)


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_a_silence_that_ends_takes_no_vehicle_from_its_pilot(flavour: str) -> None:
    began_s, mode = flight_s(flavour), PILOTS_MODE[flavour]
    gone = Link(delay_s=0.02, outages=(Outage(from_s=began_s + 7.0, until_s=began_s + 12.0),))
    own = (VehicleLinks(system_id=3, up=gone, down=gone),)
    links = COPTERS5.links.model_copy(update={"vehicles": own, "times_from": "start"})
    scenario = flown(flavour).model_copy(update={"links": links})
    station, pilots = fly(scenario, flavour, {began_s + 5.0: mode})
    texts = [event.text for event in station.events if event.system_id == 3]
    assert "is lost" in texts
    assert "is given back" not in texts
    assert_left_alone(pilots, mode)


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_an_old_heartbeat_after_a_silence_overrides_no_pilot(flavour: str) -> None:
    """A link held it back, or somebody recorded it: it shows guided mode, from before the pilot took over."""
    began_s, mode = flight_s(flavour), PILOTS_MODE[flavour]
    kept: list[bytes] = []

    def change(data: bytes, now_ns: int) -> list[tuple[bytes, int]]:
        since_s = (now_ns - START_NS) / SECOND - began_s
        if since_s < 4.0 and parse(data).get_type() == "HEARTBEAT":
            kept.append(data)
        if not 7.0 < since_s < 12.0:
            return [(data, now_ns)]
        return [(kept.pop(), now_ns)] if since_s > 11.5 and len(kept) > 5 else []  # silence, and then old ones

    station, pilots = fly(flown(flavour), flavour, {began_s + 5.0: mode}, change=change)
    assert "is given back" not in [event.text for event in station.events]
    assert_left_alone(pilots, mode)


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_a_vehicle_heard_from_another_address_is_still_its_pilots(flavour: str) -> None:
    began_s, mode = flight_s(flavour), PILOTS_MODE[flavour]
    scenario = flown(flavour)
    station, fleet = Station(plan_for(scenario), start_ns=START_NS), Fleet(scenario, START_NS)
    ticks = fly_lockstep(station.plan, station=station, vehicles=PilotsVehicle(fleet, flavour, {began_s + 2.0: mode}))
    for tick in ticks:
        if tick["time_s"][0] > 5.0:
            break
    vehicle = station.vehicles[2]
    assert vehicle.taken_over
    vehicle.address = 1_000_003
    vehicle.begin_anew()
    told = [vehicle.next_frame(station.next_event_ns + k * SECOND // 50) for k in range(500)]
    numbers = {parse(frame).command for frame in told if frame is not None}
    assert numbers <= {SET_MESSAGE_INTERVAL}


@pytest.mark.slow(first=2)
@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
@pytest.mark.parametrize("after_the_end_s", [-1.5, 0.5, 2.0])
def test_no_hold_is_sent_to_pilots_intervening_at_the_end(flavour: str, after_the_end_s: float) -> None:
    began_s = flight_s(flavour)
    mode, end_s = PILOTS_MODE[flavour], began_s + 20.0
    lossy = VehicleLinks(system_id=2, up=Link(delay_s=0.02, outages=(Outage(from_s=end_s - 1.0, until_s=1e6),)))
    # vehicle 2 is not heard at the end, which therefore takes its full 6 s
    links = COPTERS5.links.model_copy(update={"vehicles": (lossy,), "times_from": "start"})
    scenario = flown(flavour).model_copy(update={"links": links})
    station, pilots = fly(scenario, flavour, {end_s + after_the_end_s: mode})
    assert station.end_reason
    assert_left_alone(pilots, mode)


@pytest.mark.slow(first=4)
@pytest.mark.parametrize("mode", [POSCTL, 4 << 16 | 5 << 24, 4 << 16 | 6 << 24, 4 << 16 | 3 << 24])
@pytest.mark.parametrize("at_s", [5.0, 6.0])
def test_a_px4_pilot_intervening_before_first_offboard_is_left_alone(mode: int, at_s: float) -> None:
    """During the climb. One of the pilot's choices is the hold mode in which a take-off also ends."""
    station, pilots = fly(flown("px4"), "px4", {at_s: mode}, until_s=30.0)
    flown_by = "has landed and is not armed again", "is armed and not in OFFBOARD: flown by its pilot or its autopilot"
    assert station.vehicles[2].missing == flown_by[pilots.copter.armed]
    assert_left_alone(pilots, pilots.copter.mode)
    assert pilots.copter.mode != RULES["px4"].guided_mode  # a pilot's return ends in a landing


def test_unanswered_takeoffs_are_not_repeated_once_a_px4_pilot_intervenes() -> None:
    def change(data: bytes, now_ns: int) -> list[tuple[bytes, int]]:
        message = parse(data)
        lost = message.get_type() == "COMMAND_ACK" and message.command == 22
        return [] if lost else [(data, now_ns)]

    _, pilots = fly(flown("px4"), "px4", {5.0: POSCTL}, until_s=20.0, change=change)
    assert_left_alone(pilots, POSCTL)


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_a_pilot_intervening_after_release_is_left_alone(flavour: str) -> None:
    """A released PX4 leaves OFFBOARD by itself: it is called back from that failsafe, not from its pilot's mode."""
    began_s, mode = flight_s(flavour), PILOTS_MODE[flavour]
    scenario = flown(flavour)
    station, fleet = Station(plan_for(scenario), start_ns=START_NS), Fleet(scenario, START_NS)
    own = PilotsVehicle(fleet, flavour, {})
    for tick in fly_lockstep(station.plan, station=station, vehicles=own):
        since_s = (int(tick["due_ns"][0]) - START_NS) / SECOND - began_s
        vehicle = station.vehicles[2]
        if 3.0 < since_s < 7.0:
            vehicle.goal = None  # as the monitor does
        if since_s > 6.0 and not own.modes and own.reached_ns == 0:
            own.modes[since_s + began_s] = mode
    assert_left_alone(own, mode)


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_the_next_station_takes_no_vehicle_from_its_pilot(flavour: str) -> None:
    """The first was killed; the second knows nothing of what happened before."""
    began_s, mode = flight_s(flavour), PILOTS_MODE[flavour]
    scenario = flown(flavour)
    _, first = fly(scenario, flavour, {began_s + 3.0: mode}, until_s=began_s + 5.0)
    second_ns = START_NS + round((began_s + 6.0) * SECOND)
    station = Station(plan_for(scenario), start_ns=second_ns)
    first.told.clear()
    for tick in fly_lockstep(station.plan, station=station, vehicles=first):
        if tick["due_ns"][0] > second_ns + 20 * SECOND:
            break
    assert station.vehicles[2].taken_over
    assert_left_alone(first, mode)
    # once the vehicle is given back, the flight goes on
    first.modes[(second_ns - START_NS) / SECOND + 20.0] = RULES[flavour].guided_mode
    for tick in fly_lockstep(station.plan, station=station, vehicles=first):
        if tick["due_ns"][0] > second_ns + 37 * SECOND:
            break
    assert station.phase == "flying"


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_an_abandoned_flight_leaves_its_vehicles_holding(flavour: str) -> None:
    began_s, mode = flight_s(flavour), PILOTS_MODE[flavour]
    station, pilots = fly(flown(flavour), flavour, {began_s + 2.0: mode}, until_s=began_s + 5.0)
    now_ns = station.next_event_ns
    pilots.step([(address, frame, now_ns) for frame, address in station.abandoned()], now_ns)
    pilots.step([], now_ns + SECOND)
    modes = {system_id: pilots.fleet.vehicle(system_id).craft.mode for system_id in (1, 2, 3)}  # pyrefly: ignore[missing-attribute]
    assert modes == {1: RULES[flavour].hold_mode, 2: RULES[flavour].hold_mode, 3: mode}


def test_the_next_heartbeat_shows_a_pilot_soon_after_an_answer() -> None:
    """An ACK outweighs heartbeats sent before it, but not a heartbeat with a new mode."""
    scenario = flown("ardupilot")
    station, fleet = Station(plan_for(scenario), start_ns=START_NS), Fleet(scenario, START_NS)
    own, vehicle, answered_s = PilotsVehicle(fleet, "ardupilot", {}), station.vehicles[2], 0.0
    for tick in fly_lockstep(station.plan, station=station, vehicles=own):
        if vehicle.guided and own.reached_ns == 0:
            answered_s = (int(tick["due_ns"][0]) - START_NS) / SECOND
            own.modes[answered_s + 0.1] = RTL
        if vehicle.taken_over:
            assert (int(tick["due_ns"][0]) - START_NS) / SECOND - answered_s < 1.1
            return
    raise AssertionError("the pilot was never seen")


def test_a_heartbeat_before_a_command_does_not_undo_its_answer() -> None:
    vehicle = RemoteVehicle(3, startup=LaunchedStartup(50.0))
    vehicle.address = 3

    def heartbeat(mode: int, *, armed: bool, at_s: float) -> tuple[int, bool]:
        vehicle.heartbeat((mode, 2, 3, 0x80 if armed else 0, 4, 3), round(at_s * SECOND))
        return vehicle.custom_mode, vehicle.armed

    def answered(at_s: float) -> None:
        now_ns = round(at_s * SECOND)
        frame = vehicle.next_frame(now_ns)
        assert frame is not None
        vehicle.acknowledge((parse(frame).command, 0, 0, 0, 255, 190), now_ns)

    heartbeat(0, armed=False, at_s=1.0)
    for at_s in (1.1, 1.2, 1.3):  # rate, mode, arming
        answered(at_s)
    assert vehicle.guided
    assert heartbeat(0, armed=False, at_s=1.4) == (4, True)
    assert heartbeat(4, armed=False, at_s=1.5) == (4, True)
    assert heartbeat(5, armed=True, at_s=1.6) == (5, True)  # a mode that it was not in before is new
    assert heartbeat(0, armed=False, at_s=3.0) == (0, False)
