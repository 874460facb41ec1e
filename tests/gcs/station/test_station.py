"""The station's conversation with vehicles, frame by frame, with pymavlink as the other side."""

import struct
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from gcs.link.datagram import Address, Datagram, Outgoing
from gcs.link.startup import WITHOUT_TARGET
from gcs.link.vehicle import heartbeat_state
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.formation import plan_formation
from gcs.station.station import Station
from scenarios.files import load
from scenarios.schema import Control
from tests.support.paths import SCENARIOS
from tests.support.station_peer import HOME, Peer, address_at, messages

S, MS = 1_000_000_000, 1_000_000
SCENARIO = load(SCENARIOS / "chain3.toml")
FORMATION = plan_formation(SCENARIO)
GAIN = FORMATION.model.overlapping_gain(-np.eye(2), 0 * np.eye(2), np.eye(2))
PLAN = FlightPlan(SCENARIO, FORMATION, GAIN, 0.3)


def commands(outgoing: Iterable[Outgoing]) -> list[tuple[int, int]]:
    return [(message.command, message.confirmation) for message in messages(outgoing, "COMMAND_LONG")]


def test_a_vehicle_is_set_up_one_command_at_a_time() -> None:
    station, peer = Station(PLAN, start_ns=S), Peer(2)
    outgoing, _ = station.step([peer.heartbeat(S)], S)
    (interval,) = messages(outgoing, "COMMAND_LONG")
    assert (interval.command, interval.param1, interval.param2, interval.target_system) == (511, 32, 20000, 2)
    for command, wanted, parameter in ((511, 176, 4.0), (176, 400, 0.0)):
        ack = peer.datagram(peer.link.command_ack_encode(command, 0), S)
        outgoing, _ = station.step([ack], station.next_tick_ns)
        (sent,) = messages(outgoing, "COMMAND_LONG")
        assert (sent.command, sent.param2) == (wanted, parameter)


def test_a_command_without_answer_is_repeated_with_its_confirmation_raised() -> None:
    station, peer = Station(PLAN, start_ns=S), Peer(2)
    sent: list[tuple[int, int]] = []
    for k in range(160):
        now_ns = S + 20 * MS * k
        outgoing, _ = station.step([peer.heartbeat(now_ns)], now_ns)
        sent += commands(outgoing)
    assert sent == [(511, 0), (511, 1), (511, 2), (511, 3)]


def test_refused_commands_are_reported_and_tried_again_a_second_later() -> None:
    station, peer = Station(PLAN, start_ns=S), Peer(2)
    station.step([peer.heartbeat(S)], S)
    station.step([peer.datagram(peer.link.command_ack_encode(511, 2), S)], S + 20 * MS)
    assert "answered DENIED to command 511" in [event.text for event in station.events]
    times = [k for k in range(2, 100) if commands(station.step([], S + 20 * MS * k)[0])]
    assert times[0] == 50  # the answer came at S


def test_vehicle_not_reporting_its_active_target_is_named_and_flown() -> None:
    predicted = SCENARIO.model_copy(update={"control": Control(prediction="measured")})
    station, peer = Station(replace(PLAN, scenario=predicted), start_ns=S), Peer(2)
    station.step([peer.heartbeat(S)], S)
    station.step([peer.datagram(peer.link.command_ack_encode(511, 0), S)], S + 20 * MS)
    outgoing, _ = station.step([peer.datagram(peer.link.command_ack_encode(511, 2), S)], S + 40 * MS)
    assert [event.system_id for event in station.events if event.text == WITHOUT_TARGET] == [2]
    later = [frame for k in range(3, 100) for frame in station.step([], S + 20 * MS * k)[0]]
    assert {command for command, _ in commands([*outgoing, *later])} == {176}  # the next step of its start-up


def test_an_acknowledgement_of_another_command_is_not_taken_for_ours() -> None:
    station, peer = Station(PLAN, start_ns=S), Peer(2)
    station.step([peer.heartbeat(S)], S)
    station.step([peer.datagram(peer.link.command_ack_encode(400, 0), S)], S + 20 * MS)
    assert not station.vehicles[1].armed
    assert station.vehicles[1].missing == "does not accept the telemetry rate"


def test_a_vehicles_timesync_request_is_answered_with_the_receive_time() -> None:
    station, peer = Station(PLAN, start_ns=S), Peer(2)
    request = peer.datagram(peer.link.timesync_encode(0, 777), S + 3 * MS)
    outgoing, _ = station.step([peer.heartbeat(S), request], S + 5 * MS)
    (reply,) = messages(outgoing, "TIMESYNC")
    assert (reply.tc1, reply.ts1) == (S + 3 * MS, 777)


def test_a_heartbeat_that_is_replayed_or_overtaken_undoes_nothing() -> None:
    station, peer = Station(PLAN, start_ns=S), Peer(2)
    vehicle = next(vehicle for vehicle in station.vehicles if vehicle.system_id == 2)
    old, overtaken, new = (peer.heartbeat(S, base_mode=mode, custom_mode=4) for mode in (1, 1, 129))
    station.step([old, new, old, overtaken], S + 5 * MS)
    assert vehicle.armed
    assert (vehicle.frames.duplicate, vehicle.frames.late) == (1, 1)


def test_a_heartbeat_of_zeros_disarms_like_any_other() -> None:
    station, peer = Station(PLAN, start_ns=S), Peer(2)
    vehicle = next(vehicle for vehicle in station.vehicles if vehicle.system_id == 2)
    station.step([peer.heartbeat(S, base_mode=129, custom_mode=4)], S)
    station.step([peer.datagram(peer.link.command_ack_encode(511, 0), S + 10 * MS)], S + 20 * MS)
    assert vehicle.armed
    station.step([peer.datagram(peer.link.heartbeat_encode(0, 0, 0, 0, 0), S + 30 * MS)], S + 40 * MS)
    assert (vehicle.armed, vehicle.custom_mode) == (False, 0)


@pytest.mark.parametrize(
    ("name", "value", "matters"),
    [
        ("custom_mode", 5, True), ("type", 1, True), ("autopilot", 4, True), ("base_mode", 1, True),
        ("base_mode", 128 | 64, False), ("system_status", 5, True), ("system_status", 3, False),
    ],
)  # fmt: skip
def test_heartbeat_state_covers_mode_kind_arming_and_failsafe(name: str, value: int, matters: bool) -> None:
    fields = {"custom_mode": 4, "type": 2, "autopilot": 3, "base_mode": 129, "system_status": 4}
    one, other = (
        heartbeat_state(int.from_bytes(struct.pack("<IBBBB", *each.values()), "little"))
        for each in (fields, fields | {name: value})
    )
    assert (one != other) == matters


def test_reordered_or_repeated_frames_are_no_refusals_and_reported_once() -> None:
    station, peers = Station(PLAN, start_ns=S), [Peer(2), Peer(3)]
    for second in range(1, 5):
        for peer in peers:
            first, second_one, third = (peer.heartbeat(second * S) for _ in range(3))
            station.step([first, third, second_one, third], second * S)
    assert not station.counters
    reported = [(event.system_id, event.text) for event in station.events if event.kind == "link"]
    texts = "its frames arrive out of order", "its frames arrive more than once"
    assert reported == [(system_id, text) for system_id in (2, 3) for text in texts]


def test_a_vehicle_that_restarts_its_sequence_numbers_is_heard() -> None:
    station, peer = Station(PLAN, start_ns=S), Peer(2)
    vehicle = next(vehicle for vehicle in station.vehicles if vehicle.system_id == 2)
    peer.link.seq = 100
    station.step([peer.heartbeat(S, base_mode=129)], S)
    peer.link.seq = 0
    for second in (2, 3, 4, 5):
        station.step([peer.heartbeat(second * S, base_mode=1)], second * S)
    assert not vehicle.armed
    assert vehicle.frames.lost == 0


def targets_and_heartbeats(own: Address) -> tuple[list[int], int]:
    """The targets of a station's TIMESYNC requests in five seconds, and its heartbeats, with vehicle 3 at `own`.

    The others are at HOME. The target is an extension that pymavlink's dialect lacks; 0 where it is not sent.
    """
    station, peers = Station(PLAN, start_ns=S), [Peer(1), Peer(2), Peer(3, own)]
    station.step([peer.heartbeat(S) for peer in peers], S)
    sent: list[bytes] = []
    while (now_ns := station.next_event_ns) < 6 * S:
        sent += [data for data, _ in station.step([], now_ns)[0]]
    requests = [data for data in sent if data[7:10] == (111).to_bytes(3, "little")]
    return [data[10 + 16] if data[1] > 16 else 0 for data in requests], sum(data[7:10] == bytes(3) for data in sent)


def test_vehicles_at_one_port_share_heartbeats_and_are_named() -> None:
    targets, heartbeats = targets_and_heartbeats(HOME)
    assert (set(targets), heartbeats) == ({1, 2, 3}, 5)
    targets, heartbeats = targets_and_heartbeats(address_at("127.0.0.1", 6666))
    assert (set(targets), heartbeats) == ({0, 1, 2}, 10)


def test_unknown_system_id_is_counted_and_not_answered() -> None:
    station, stranger = Station(PLAN, start_ns=S), Peer(77)
    outgoing, _ = station.step([stranger.heartbeat(S)], S)
    assert not len(outgoing)
    assert station.counters == {"unknown system id": 1}


def test_a_second_source_is_refused_until_the_first_is_silent() -> None:
    station, peer, thief = Station(PLAN, start_ns=S), Peer(2), Peer(2, address_at("127.0.0.1", 6666))
    station.step([peer.heartbeat(S)], S)
    station.step([thief.heartbeat(S + 100 * MS)], S + 100 * MS)
    assert station.vehicles[1].address == HOME
    station.step([thief.heartbeat(S + 200 * MS)], S + 200 * MS)
    assert station.counters == {"known system id from another address": 2}
    assert [event.system_id for event in station.events if "second sender" in event.text] == [2]
    station.step([thief.heartbeat(S + 5 * S)], S + 5 * S)  # as after a restart of the vehicle
    assert station.vehicles[1].address == thief.address


def test_mavlink_1_vehicle_is_named_until_it_speaks_mavlink_2() -> None:
    station, peer = Station(PLAN, start_ns=S), Peer(2)
    vehicle = station.vehicles[1]
    old = peer.link.heartbeat_encode(2, 3, 1, 0, 3).pack(peer.link, force_mavlink1=True)
    station.step([Datagram(bytes(old), HOME, S)], S)
    assert vehicle.missing == "speaks MAVLink 1, wanted MAVLink 2; on an ArduPilot, set SERIALn_PROTOCOL to 2"
    assert station.counters == {"not MAVLink 2": 1}
    station.step([peer.heartbeat(S + MS)], S + MS)
    assert vehicle.missing == "does not accept the telemetry rate"


def test_a_companion_takes_no_vehicles_place() -> None:
    station, peer, companion = Station(PLAN, start_ns=S), Peer(2), Peer(2, address_at("127.0.0.1", 6666), component=191)
    vehicle = station.vehicles[1]
    station.step([companion.heartbeat(S)], S)
    assert (vehicle.address, vehicle.first_heard_ns) == (None, None)
    assert vehicle.missing == "is heard only as component 191, wanted 1, the autopilot"
    station.step([peer.heartbeat(2 * S)], 2 * S)
    assert "component" not in vehicle.missing
    station.step([companion.heartbeat(9 * S)], 9 * S)  # the vehicle is silent
    assert (vehicle.address, vehicle.heard_ns) == (HOME, 2 * S)
    assert station.counters == {"other component": 2}


def test_a_nan_position_is_refused_but_not_lost() -> None:
    station, peer = Station(PLAN, start_ns=S), Peer(2)
    vehicle = station.vehicles[1]
    said = [peer.heartbeat(S)]
    for north_m in (1.0, float("nan"), float("inf"), 2.0):
        frame = peer.link.local_position_ned_encode(1, north_m, 0, 0, 0, 0, 0)
        said.append(peer.datagram(frame, S))
    station.step(said, S)
    assert station.counters == {"not finite": 2}
    assert (vehicle.frames.received, vehicle.frames.lost, len([*station.frames])) == (5, 0, 5)


def test_only_a_heartbeat_makes_a_vehicle_known() -> None:
    station, peer = Station(PLAN, start_ns=S), Peer(2)
    station.step([peer.datagram(peer.link.local_position_ned_encode(1, 0, 0, 0, 0, 0, 0), S)], S)
    assert station.vehicles[1].address is None


@pytest.mark.parametrize(("status", "text"), [(5, "is in failsafe"), (4, "left GUIDED")])
def test_a_vehicle_that_leaves_guided_is_reported_and_called_back(status: int, text: str) -> None:
    station, peer = Station(PLAN, start_ns=S), Peer(2)
    station.step([peer.heartbeat(S, base_mode=0x81, custom_mode=4, status=4)], S)
    station.step([peer.datagram(peer.link.command_ack_encode(511, 0), S)], S + 20 * MS)
    later = S + 4 * S
    outgoing, _ = station.step([peer.heartbeat(later, base_mode=0x81, custom_mode=5, status=status)], later)
    assert text in [event.text for event in station.events]
    assert commands(outgoing) == [(176, 0)]


def test_ticks_that_were_slept_through_are_skipped_but_numbered() -> None:
    station = Station(PLAN, start_ns=S)
    ticks = []
    for now_ns in (S, S + 20 * MS, S + 95 * MS, S + 100 * MS):
        _, tick = station.step([], now_ns)
        assert tick is not None
        ticks.append((tick.number, tick.due_ns))
    assert ticks == [(0, S), (1, S + 20 * MS), (2, S + 40 * MS), (5, S + 100 * MS)]


@pytest.mark.parametrize(("holds", "held_s", "refused"), [(False, 60.0, 0), (True, 60.0, 1), (True, 0.1, 0)])
def test_a_lag_counts_only_where_it_is_possible(holds: bool, held_s: float, refused: int) -> None:
    """A Lua script may send a NAMED_VALUE_INT of the same name."""
    control = SCENARIO.control.model_copy(update={"execute_at": holds})
    scenario = SCENARIO.model_copy(update={"control": control})
    station, peer = Station(replace(PLAN, scenario=scenario), start_ns=S), Peer(2)
    booted_ns, said = S - 7 * S, [peer.heartbeat(S)]
    for now_ns in range(S, 2 * S, MS):  # over links without delay
        outgoing, _ = station.step(said, now_ns)
        asked = [request.ts1 for request in messages(outgoing, "TIMESYNC")]
        said = [peer.datagram(peer.link.timesync_encode(now_ns - booted_ns, ts1), now_ns) for ts1 in asked]
    sent_ns, key_ms = 2 * S, 1000
    lag_ms = (sent_ns - booted_ns) // MS - key_ms + round(1000 * held_s)
    named = peer.link.named_value_int_encode(lag_ms, b"LAG_MS", lag_ms)
    station.step([peer.datagram(named, sent_ns)], sent_ns)
    assert station.counters["impossible LAG_MS"] == refused
    expected_s = held_s if holds and not refused else 0.0
    assert station.vehicles[1].delivery_ns(key_ms, sent_ns) == pytest.approx(expected_s * 1e9, abs=MS)


def test_texts_of_vehicles_cannot_move_the_cursor() -> None:
    """Nor clear the screen, nor begin a line of their own."""
    station, peer = Station(PLAN, start_ns=S), Peer(2)
    texts = [b"\x1b[2J\x1b[31mred", b"one\nvehicle 2: LOST\r\x07", b"\xc2\x9b2J", "Höhe 5 m".encode()]
    said = [peer.datagram(peer.link.statustext_encode(2, text), S) for text in texts]
    station.step([peer.heartbeat(S), *said], S)
    shown = [event.text for event in station.events if event.kind == "statustext"]
    assert shown == ["�[2J�[31mred", "one�vehicle 2: LOST��", "�2J", "Höhe 5 m"]
