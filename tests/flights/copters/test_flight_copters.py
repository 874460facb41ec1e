"""Flights of vehicles with autopilots in virtual time, from boot to hold, and what the start-up has to cope with."""

from collections import deque
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.control.phases import START_PATIENCE_S
from gcs.control.tick import TickArray
from gcs.drive.lockstep import START_NS, fly_lockstep
from gcs.link.datagram import Datagram
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import described, flight_plan
from gcs.runs.summary import verdict
from gcs.station.absence import TAKEN_OVER
from gcs.station.station import Station
from gcs.studies.benchmark import start_and_speed
from scenarios.keys.link import Link, Outage, VehicleLinks
from scenarios.schema import ClockJump, NominalVelocity
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.motion.copter import pair
from sim_vehicles.vehicles.copter_rules import RULES
from tests.support.fleets.flown_copters import COPTERS5, TRUTH, Flight, fly, plan_for, planned, three
from tests.support.fleets.pilots import PilotsVehicle
from tests.support.sim_client import command, parse
from tests.support.station_peer import HOME, Peer, messages

shared = pytest.mark.xdist_group("copters")  # tests that look at the same flights
PERIOD_S = 0.02


@cache
def usual(flavour: str) -> Flight:
    """A flight in which nothing happens, for tests that only look at it."""
    return fly(planned(flavour))


@shared
@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_copters_start_on_the_ground_fly_the_formation_and_hold(flavour: str) -> None:
    flight = usual(flavour)
    assert flight.station.end_reason == "completed: duration reached"
    for system_id in (2, 3):
        error_m = flight.error_m(system_id)
        assert error_m[0] > 1.0
        assert error_m[-1] < 0.01 * 17.0
    for system_id in (1, 2, 3):
        copter = flight.copter(system_id)
        assert copter.mode == copter.rules.hold_mode
        assert copter.motion.altitude_m == pytest.approx(20.0, abs=0.3)


@shared
def test_the_announced_time_of_a_sweep_includes_the_take_off() -> None:
    flight = usual("ardupilot")
    start_s = flight.flown["due_ns"].min() * 1e-9 - START_NS * 1e-9
    assert start_and_speed(planned("ardupilot"), seconds=1.0)[0] == pytest.approx(start_s, abs=0.1)


@shared
def test_distances_are_true_though_each_vehicle_has_its_own_origin() -> None:
    flight = usual("ardupilot")
    # the last positions, in the scenario's frame; by then all vehicles brake alike
    place = {k: np.array(pair(flight.copter(k).motion.place_m)) for k in (1, 2, 3)}
    assert place[2] - place[1] == pytest.approx([-12.0, 12.0], abs=0.05)  # origins are reported to 11 mm
    down_m = flight.flown["down_m"][-3:]
    assert np.ptp(down_m) == pytest.approx(0.0, abs=0.1)  # all at 20 m above one ground
    assert place[3] - place[2] == pytest.approx([-12.0, 12.0], abs=0.05)


@shared
@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_the_identified_response_is_true_and_its_margin_is_used(flavour: str) -> None:
    flight = usual(flavour)
    responses = flight.station.plan.responses
    assert responses is not None
    assert responses.source == "identified"
    for found in responses.of.values():
        assert found.lag_s == pytest.approx(TRUTH.lag_s, rel=0.02)
        assert found.velocity_gain_1_s == pytest.approx(TRUTH.velocity_gain_1_s, rel=0.02)
    given = flight_plan(three(flavour=flavour).model_copy(update={"response": TRUTH}))[1]
    assert flight.station.plan.delay_margin_s < planned(flavour).delay_margin_s - TRUTH.lag_s / 2
    assert given.delay_margin_s == pytest.approx(0.6, abs=1e-6)  # what the scenario asks for, with the response


def test_a_given_response_skips_the_manoeuvre_as_the_design_says() -> None:
    design, plan = flight_plan(three().model_copy(update={"response": TRUTH}))
    flight = fly(plan)
    assert "identifying" not in flight.texts("phase")
    assert design.response is not None
    assert design.response.source == "given"
    assert design.delay_margin_s == pytest.approx(0.6, abs=1e-6)
    at_once_s = design.response.delay_margin_at_once_s
    assert at_once_s is not None
    assert at_once_s > 0.6 + TRUTH.lag_s / 2


@shared
def test_design_of_a_flight_names_what_was_identified() -> None:
    design, _ = flight_plan(three())
    flight = usual("ardupilot")
    known = described(design, flight.station.plan)
    assert known.margins_s == flight.station.plan.margins_s
    assert known.margins_s[0] < design.margins_s[0]
    assert known.response is not None
    assert [vehicle.system_id for vehicle in known.response.vehicles] == [1, 2, 3]


def test_graph_gains_get_the_margin_with_the_response_too() -> None:
    control = COPTERS5.control.model_copy(update={"method": "graph-lqr", "delay_margin_s": 0.5})
    design, plan = flight_plan(three().model_copy(update={"control": control}))
    flight = fly(plan)
    assert flight.station.end_reason == "completed: duration reached"
    assert max(float(flight.error_m(k)[-1]) for k in (2, 3)) < 0.17
    known = described(design, flight.station.plan)
    assert known.margins_s[0] < design.margins_s[0] - TRUTH.lag_s / 2
    assert known.margins_s[0] < (known.delay_margin_continuous_s or 0.0)


def settled(flight: Flight) -> bool:
    rows = max(float(flight.error_m(system_id)[-100:].max()) for system_id in (2, 3))
    return rows < 0.01 * 17.0


def at_loop_delay(plan: FlightPlan, delay_s: float) -> Flight:
    """A flight whose vehicles' mean loop delay is about this, with a monitor that only watches."""
    waiting_s = PERIOD_S / 2
    link_s = (delay_s - waiting_s) / 2
    scenario = plan.scenario.with_link_delay(up_s=link_s, down_s=link_s)
    watching = scenario.monitor.model_copy(update={"act": False})
    return fly(replace(plan, scenario=scenario.model_copy(update={"monitor": watching, "duration_s": 60.0})))


@shared
def test_the_flight_breaks_only_at_the_margin_with_the_response() -> None:
    without_s = planned("ardupilot").delay_margin_s
    with_s = usual("ardupilot").station.plan.delay_margin_s
    assert with_s < 0.8 * without_s
    plan = planned("ardupilot")
    assert settled(at_loop_delay(plan, 0.9 * with_s))
    beyond = at_loop_delay(plan, 1.1 * with_s)  # far below the margin that leaves the response out
    assert not settled(beyond)
    assert 1.1 * with_s < 0.9 * without_s
    assert verdict(beyond.station.end_reason, None) == "unstable"


@pytest.mark.slow(first=0)
def test_margin_with_drag_is_that_of_the_velocity_flown() -> None:
    resisted, still = three(drag_1_m=0.06), (NominalVelocity(from_s=0.0, velocity_ne_m_s=(0.0, 0.0)),)
    short = resisted.model_copy(update={"duration_s": 1.0})
    margin_s, at_rest_s = (
        fly(plan_for(each)).station.plan.delay_margin_s
        for each in (short, short.model_copy(update={"nominal_velocity": still}))
    )
    assert margin_s > 1.08 * at_rest_s
    assert settled(at_loop_delay(plan_for(resisted), 0.9 * margin_s))
    assert not settled(at_loop_delay(plan_for(resisted), 1.1 * margin_s))


@pytest.mark.slow(first=2)
@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_start_up_survives_losses_and_refusals(flavour: str, seed: int) -> None:
    lossy = Link(delay_s=0.03, loss_probability=0.15)
    scenario = three(flavour=flavour, arming_refusals=3, up_down=lossy).model_copy(update={"seed": seed})
    flight = fly(plan_for(scenario))
    assert flight.station.end_reason == "completed: duration reached"
    assert any("to command 400" in text for text in flight.texts("vehicle"))
    assert max(float(flight.error_m(k)[-1]) for k in (2, 3)) < 0.5  # losses keep pushing the vehicles a little


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_telemetry_that_begins_40_s_after_boot_is_waited_for(flavour: str) -> None:
    scenario = three(flavour=flavour, telemetry_after_s=40.0, ready_after_s=55.0)
    flight = fly(plan_for(scenario))
    assert flight.station.end_reason == "completed: duration reached"
    began_ns = float(flight.flown["due_ns"][0])
    assert began_ns > START_NS + 55e9


def test_a_vehicle_without_position_ends_the_start_and_is_named() -> None:
    scenario = three(duration_s=1.0, ready_after_s=1e6)
    flight = fly(plan_for(scenario))
    reason = flight.station.end_reason
    assert reason.startswith("not ready: vehicle 1 has no position yet (estimator flags 0x481); vehicle 2 ")
    assert "has no position yet (estimator flags 0x481)" in flight.texts("start")
    assert flight.ticks["due_ns"][-1] == pytest.approx(START_NS + 120e9, abs=10e9)
    assert all(not flight.copter(k).armed for k in (1, 2, 3))


@pytest.mark.slow(first=4)
@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
@pytest.mark.parametrize("by_s", [-0.2, 5.0, 0.2])
def test_a_clock_jump_in_flight_is_noticed_and_flown_through(flavour: str, by_s: float) -> None:
    scenario = three(flavour=flavour, clock_jumps=(ClockJump(at_s=32.0, by_s=by_s),))
    flight = fly(plan_for(scenario))
    assert flight.station.end_reason == "completed: duration reached"
    assert flight.texts("vehicle").count("its clock jumped") == 3
    assert all(flight.fleet.vehicle(k).counters["timesync_replies"] >= 2 for k in (1, 2, 3))  # to requests of their own
    time_s = flight.flown["time_s"]
    assert time_s[0] + 2.0 < 32.0 - (flight.flown["due_ns"][0] - START_NS) * 1e-9 < time_s[-1]  # it was in flight
    assert max(float(flight.error_m(k)[-1]) for k in (2, 3)) < 0.17


@pytest.mark.parametrize(("flavour", "mode", "left"), [("ardupilot", 5, "GUIDED"), ("px4", 3 << 16, "OFFBOARD")])
def test_a_pilot_who_takes_over_in_the_manoeuvre_ends_it(flavour: str, mode: int, left: str) -> None:
    flight = fly_with_a_pilot(flavour, {13.0 - START_PATIENCE_S: mode})
    assert flight.station.end_reason == f"not identified: vehicle 3 left {left}: flown by its pilot or its autopilot"
    modes = [flight.copter(k).mode for k in (1, 2, 3)]
    assert modes == [RULES[flavour].hold_mode] * 2 + [mode]


@pytest.mark.parametrize("by_s", [-0.2, 5.0])
def test_a_clock_jump_in_the_manoeuvre_leaves_the_same_response(by_s: float) -> None:
    flight = fly(plan_for(three(duration_s=1.0, clock_jumps=(ClockJump(at_s=20.0, by_s=by_s),))))
    times = [event.time_s for event in flight.events if event.text in ("identifying", "its clock jumped")]
    assert 8.0 < times[-1] - times[0] < 12.0  # in the manoeuvre, after a run-up of 7.2 s
    responses = flight.station.plan.responses
    assert responses is not None
    for found in responses.of.values():
        assert found.lag_s == pytest.approx(TRUTH.lag_s, rel=0.02)
        assert found.velocity_gain_1_s == pytest.approx(TRUTH.velocity_gain_1_s, rel=0.02)


@pytest.mark.parametrize(
    ("again", "end"), [(False, "completed: duration reached"), (True, "not identified: vehicle 3 ")]
)
def test_a_disturbed_manoeuvre_is_flown_once_more(again: bool, end: str) -> None:
    # set-points are lost for 1.5 s, in the first manoeuvre or in both
    times_s = (20.7, 28.0) if again else (20.7,)
    silent = Link(delay_s=0.02, outages=tuple(Outage(from_s=s, until_s=s + 1.5) for s in times_s))
    links = COPTERS5.links.model_copy(
        update={"vehicles": (VehicleLinks(system_id=3, down=silent),), "times_from": "start"}
    )
    flight = fly(plan_for(three(duration_s=10.0).model_copy(update={"links": links})))
    repeated = [event for event in flight.events if event.text.endswith("the manoeuvre is flown once more")]
    assert [event.system_id for event in repeated] == [3]
    assert flight.station.end_reason.startswith(end)
    responses = flight.station.plan.responses
    assert again == (responses is None)
    if responses is not None:
        assert responses.of[3].lag_s == pytest.approx(TRUTH.lag_s, rel=0.02)
        assert max(float(flight.error_m(k)[-1]) for k in (2, 3)) < 0.17


def test_clocks_that_drift_by_500_ppm_change_nothing() -> None:
    drifting = COPTERS5.clocks.model_copy(update={"drift_max_ppm": 500.0})
    flight = fly(plan_for(three().model_copy(update={"clocks": drifting})))
    assert flight.station.end_reason == "completed: duration reached"
    assert max(float(flight.error_m(k)[-1]) for k in (2, 3)) < 0.17


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_after_an_outage_past_the_timeouts_the_vehicle_is_recalled(flavour: str) -> None:
    gone = Link(delay_s=0.02, outages=(Outage(from_s=28.0, until_s=32.0),))
    links = COPTERS5.links.model_copy(
        update={"vehicles": (VehicleLinks(system_id=3, up=gone, down=gone),), "times_from": "start"}
    )
    flight = fly(plan_for(three(flavour=flavour, duration_s=40.0).model_copy(update={"links": links})))
    assert flight.station.end_reason == "completed: duration reached"
    assert "is lost" in flight.texts("vehicle")
    assert flight.error_m(3)[-1] < 0.17
    assert flight.fleet.vehicle(3).counters["setpoints"] > 1000


@pytest.mark.parametrize(("flavour", "mode"), [("ardupilot", 6), ("px4", 4 << 16 | 5 << 24)])
def test_a_vehicle_piloted_home_is_left_alone_and_flown_around(flavour: str, mode: int) -> None:
    flight = fly_with_a_pilot(flavour, {5.0: mode})
    assert flight.station.end_reason == "taken over: vehicles 3"
    flight.fleet.step([], int(flight.ticks["due_ns"][-1]) + 60_000_000_000)
    assert flight.copter(3).landed  # the return was not stopped in flight, nor at the end
    rules = flight.copter(2).rules
    assert [flight.copter(k).mode for k in (1, 2)] == [rules.hold_mode] * 2
    assert flight.error_m(2)[-1] < 0.17
    assert flight.texts("vehicle")[-2:] == [f"left {flight.station.vehicles[2].kind.guided_name}", TAKEN_OVER]


@pytest.mark.parametrize(("flavour", "mode"), [("ardupilot", 5), ("px4", 3 << 16)])
def test_a_vehicle_given_back_by_its_pilot_rejoins_the_formation(flavour: str, mode: int) -> None:
    flight = fly_with_a_pilot(flavour, {5.0: mode, 8.0: RULES[flavour].guided_mode})
    assert flight.station.end_reason == "completed: duration reached"
    assert flight.texts("vehicle")[-2:] == ["is given back", "is back near its place"]
    assert flight.error_m(3)[-1] < 0.17


def test_nobody_follows_a_vehicle_that_returns_from_far() -> None:
    mode, guided = 5, RULES["ardupilot"].guided_mode
    flight = fly_with_a_pilot("ardupilot", {8.0: mode, 20.0: guided}, system_id=2, duration_s=75.0)
    assert flight.station.end_reason == "completed: duration reached"
    rows = {k: flight.flown[flight.flown["system_id"] == k] for k in (1, 2, 3)}
    ticks = np.intersect1d(rows[1]["tick"][rows[1]["time_s"] > 7.0], rows[3]["tick"])
    first, third = (rows[k][np.isin(rows[k]["tick"], ticks)] for k in (1, 3))
    north, east = (third[name] - first[name] for name in ("north_m", "east_m"))
    assert np.hypot(north + 24.0, east - 24.0).max() < 3.5  # its place, at the sum of both offsets
    assert np.nanmax(flight.error_m(2)) > 40.0
    assert flight.error_m(2)[-1] < 0.17
    assert flight.texts("vehicle")[-1] == "is back near its place"


def fly_with_a_pilot(flavour: str, modes: dict[float, int], *, system_id: int = 3, duration_s: float = 20.0) -> Flight:
    """A flight in which the pilot of a vehicle changes its mode at these times."""
    scenario = three(flavour=flavour, duration_s=duration_s)
    station, fleet = Station(plan_for(scenario), start_ns=START_NS), Fleet(scenario, START_NS)
    wanted, ticks = deque(sorted(modes.items())), list[TickArray]()
    for tick in fly_lockstep(station.plan, station=station, vehicles=fleet):
        ticks.append(tick)
        if wanted and tick["time_s"][0] > wanted[0][0]:
            # a switch of the pilot's remote control acts as this command, but needs no link
            vehicle, (_, mode) = fleet.vehicle(system_id), wanted.popleft()
            packed = (mode >> 16 & 0xFF, mode >> 24) if flavour == "px4" else (mode, 0)
            vehicle.step([(command(176, 1, *packed, system=system_id), int(tick["due_ns"][0]))], int(tick["due_ns"][0]))
    return Flight(station, fleet, np.concatenate(ticks), station.events)


def test_a_second_station_takes_over_airborne_vehicles() -> None:
    first = fly(planned("ardupilot"))
    took_off = sum(change.text == "takes off" for change in first.fleet.take_changes())
    second = fly(planned("ardupilot"), first.fleet, int(first.ticks["due_ns"][-1]) + 100_000_000)
    assert second.station.end_reason == "completed: duration reached"
    again = sum(change.text == "takes off" for change in second.fleet.take_changes())
    assert (took_off, again) == (3, 0)


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_copters_told_to_land_at_the_end_do(flavour: str) -> None:
    flight = fly(plan_for(three(flavour=flavour, duration_s=3.0).model_copy(update={"at_end": "land"})))
    end_ns = int(flight.ticks["due_ns"][-1])
    flight.fleet.step([], end_ns + 60_000_000_000)
    assert all(flight.copter(k).landed and not flight.copter(k).armed for k in (1, 2, 3))


def test_an_arduplane_is_refused_at_once_and_by_name() -> None:
    station, plane = Station(planned("ardupilot"), start_ns=START_NS), Peer(2)
    station.step([plane.datagram(plane.link.heartbeat_encode(1, 3, 1, 0, 3), START_NS)], START_NS)
    told = [station.step([], START_NS + 20_000_000 * k)[0] for k in range(1, 60)]
    assert station.end_reason.startswith("refused: vehicle 2 is an ArduPlane")
    assert not any(messages(outgoing, "COMMAND_LONG") for outgoing in told)  # whoever flies it is not disturbed


def test_px4_starting_in_mavlink_1_is_answered_in_mavlink_2() -> None:
    first = dialect.MAVLink(None, srcSystem=2, srcComponent=1)
    heartbeat = bytes(first.heartbeat_encode(2, 12, 1, 4 << 16 | 3 << 24, 3).pack(first, force_mavlink1=True))
    assert heartbeat[0] == 0xFE
    station = Station(planned("px4"), start_ns=START_NS)
    damaged = heartbeat[:-1] + bytes([heartbeat[-1] ^ 1])
    station.step([Datagram(damaged, HOME, START_NS)], START_NS)
    assert station.vehicles[1].address is None
    outgoing, _ = station.step([Datagram(b"\xfe" + bytes(30) + heartbeat, HOME, START_NS)], START_NS + 20_000_000)
    assert station.vehicles[1].address is None  # no frame begins where one should
    station.step([Datagram(b"\xfe", HOME, START_NS)], START_NS + 40_000_000)
    assert station.counters == {"bad checksum": 2, "not MAVLink 1": 1, "truncated": 1}
    now_ns = START_NS + 1_100_000_000
    outgoing = [*station.step([Datagram(heartbeat * 2, HOME, START_NS)], now_ns)[0], *station.step([], now_ns)[0]]
    assert station.vehicles[1].kind.name == "PX4 multicopter"
    assert all(data[0] == 0xFD for data, _ in outgoing)
    assert messages(outgoing, "HEARTBEAT")


def test_a_gimbal_with_the_same_system_id_is_no_vehicle() -> None:
    station, peer = Station(planned("ardupilot"), start_ns=START_NS), Peer(2)
    gimbal: Any = dialect.MAVLink(None, srcSystem=2, srcComponent=154)
    station.step([peer.heartbeat(START_NS)], START_NS)
    heartbeat = peer.datagram(peer.link.heartbeat_encode(26, 8, 0, 0, 4), START_NS)
    other = heartbeat._replace(data=bytes(gimbal.heartbeat_encode(26, 8, 0, 0, 4).pack(gimbal)))
    outgoing, _ = station.step([other], START_NS + 20_000_000)
    assert station.counters["other component"] == 1
    assert station.end_reason == ""
    assert messages(outgoing, "COMMAND_LONG") == []  # one command is in flight already


def test_vehicle_reporting_no_motion_is_not_blamed_for_its_telemetry() -> None:
    """Vehicle 3 always reports zero velocity."""

    def at_rest(data: bytes, now_ns: int) -> list[tuple[bytes, int]]:
        message = parse(data)
        if message.get_type() != "LOCAL_POSITION_NED":
            return [(data, now_ns)]
        message.vx = message.vy = message.vz = 0.0
        link: Any = dialect.MAVLink(None, srcSystem=3, srcComponent=1)
        link.seq = message.get_seq()
        return [(bytes(message.pack(link)), now_ns)]

    station, vehicles = (
        Station(planned("ardupilot"), start_ns=START_NS),
        PilotsVehicle(Fleet(three(), START_NS), "", {}),
    )
    vehicles.change = at_rest
    for _ in fly_lockstep(station.plan, station=station, vehicles=vehicles):
        pass
    assert station.end_reason.startswith("not identified: vehicle 3 reported the same velocity throughout a manoeuvre")
