"""All vehicles behind their links, in virtual time."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from scenarios.keys.link import Jitter, Link, Links, VehicleLinks
from sim_vehicles.drive.fleet import Datagram, Fleet
from sim_vehicles.links.truth import ACTED, LINK_DOWN, LINK_UP, SAMPLED, MemoryRecorder
from tests.support.sim_client import (
    MS,
    SECOND,
    START,
    arm,
    command,
    guided,
    heartbeat,
    pack,
    parse,
    parse_all,
    scenario,
    setpoint,
)

COUNT = 4


def requests(now_ns: int) -> list[Datagram]:
    """What a station first sends to every vehicle."""
    return [
        (k, _unnumbered(frame), now_ns)
        for k in range(1, COUNT + 1)
        for frame in (command(511, 32, 20_000, system=k), arm(k), guided(k))
    ]


def flight(fleet: Fleet, pace_ns: int = 20 * MS) -> list[Datagram]:
    """All that a fleet sends in two seconds with set-points at 50 Hz, stepped every `pace_ns`."""
    out = [*fleet.step(requests(START), START)]
    setpoints_ns = START
    for now_ns in range(START + pace_ns, START + 2 * SECOND + 1, pace_ns):
        received: list[Datagram] = []
        while setpoints_ns + 20 * MS <= now_ns:
            setpoints_ns += 20 * MS
            for k in range(1, COUNT + 1):
                frame = setpoint(0.5 * k, -0.25, system=k, time_boot_ms=setpoints_ns // MS)
                received.append((k, _unnumbered(frame), setpoints_ns))
        out += fleet.step(received, now_ns)
    return out


def _unnumbered(frame: bytes) -> bytes:
    """The frame with sequence number 0, so that two flights are given the same bytes."""
    message = parse(frame)
    return message.pack(dialect.MAVLink(None, 255, 190))


def test_the_same_scenario_gives_the_same_bytes_and_instants() -> None:
    first = flight(Fleet(scenario(COUNT, up_s=0.02, down_s=0.03), START))
    second = flight(Fleet(scenario(COUNT, up_s=0.02, down_s=0.03), START))
    other = flight(Fleet(scenario(COUNT, seed=2, up_s=0.02, down_s=0.03), START))
    assert first == second
    assert len(first) > 400
    assert first != other


def test_how_often_the_fleet_is_stepped_changes_nothing() -> None:
    """Every event has its exact instant; a coarser pace only delivers datagrams later."""
    fine, coarse = (
        sorted(flight(Fleet(scenario(COUNT, up_s=0.02, down_s=0.03), START), pace), key=lambda d: (d[2], d[0]))
        for pace in (5 * MS, 20 * MS)
    )
    assert fine == coarse


@pytest.mark.parametrize("reordering", [False, True])
def test_the_kernel_does_what_the_shell_does(reordering: bool) -> None:
    """Vehicles that are not plain send every event through the shell; both ways leave the same record."""
    link = Link(
        delay_s=0.03,
        jitter=Jitter(distribution="normal", scale_s=0.02),
        reordering=reordering,
        loss_probability=0.05,
        duplicate_probability=0.1,
        corrupt_probability=0.05,
    )
    own = scenario(COUNT).model_copy(update={"links": Links(up=link, down=link)})
    recorders = MemoryRecorder(), MemoryRecorder()
    plain, shells = (Fleet(own, START, recorder=recorder) for recorder in recorders)
    shells.vehicle(1).radio.place.vehicles["plain"] = False
    assert flight(plain) == flight(shells) == flight(Fleet(own, START))
    assert plain.counters == shells.counters
    assert plain.next_event_ns == shells.next_event_ns
    assert [plain.state(k, START + 3 * SECOND) for k in plain.system_ids] == [
        shells.state(k, START + 3 * SECOND) for k in plain.system_ids
    ]
    records = [sorted(recorder.records.tolist()) for recorder in recorders]
    assert records[0] == records[1]
    assert sum(kind == ACTED for kind, *_ in records[0]) > 100


@pytest.mark.parametrize("rows", [6, 7, 50])
def test_a_full_record_buffer_loses_nothing(rows: int) -> None:
    link = Link(delay_s=0.03, loss_probability=0.1, duplicate_probability=0.2, corrupt_probability=0.05)
    own = scenario(COUNT).model_copy(update={"links": Links(up=link, down=link)})
    roomy, narrow = MemoryRecorder(), MemoryRecorder(rows)
    assert flight(Fleet(own, START, recorder=roomy)) == flight(Fleet(own, START, recorder=narrow))
    assert sorted(roomy.records.tolist()) == sorted(narrow.records.tolist())


def test_what_is_returned_is_due_and_in_order() -> None:
    fleet = Fleet(scenario(COUNT, up_s=0.01), START)
    fleet.step(requests(START), START)
    last = (START, 0)
    for now_ns in range(START, START + SECOND, 7 * MS):
        for system_id, data, due_ns in fleet.step([], now_ns):
            assert last <= (due_ns, system_id)
            assert due_ns <= now_ns
            assert data[5] == system_id
            last = (due_ns, system_id)


def test_next_event_is_when_the_next_datagram_leaves() -> None:
    fleet = Fleet(scenario(COUNT, up_s=0.0123), START)
    fleet.step(requests(START), START)
    for _ in range(200):
        next_ns = fleet.next_event_ns
        assert not len(fleet.step([], next_ns - 1))
        left = fleet.step([], next_ns)
        assert left
        assert {due_ns for _, _, due_ns in left} == {next_ns}


def test_a_round_trip_takes_exactly_both_delays() -> None:
    own = Links(
        up=Link(delay_s=0.03),
        down=Link(delay_s=0.05),
        vehicles=(VehicleLinks(system_id=2, up=Link(delay_s=0.2)), VehicleLinks(system_id=3, down=Link(delay_s=0.0))),
    )
    fleet = Fleet(scenario(3).model_copy(update={"links": own}), START)
    sent_ns = START + 3
    request = pack(dialect.MAVLink_timesync_message(0, 77))
    out = fleet.step([(k, request, sent_ns) for k in (1, 2, 3)], START + SECOND)
    replies = {k: (parse(data), due) for k, data, due in out if parse(data).get_type() == "TIMESYNC"}
    assert {k: due - sent_ns for k, (_, due) in replies.items()} == {1: 80 * MS, 2: 250 * MS, 3: 30 * MS}
    for k, arrival_ns in ((1, sent_ns + 50 * MS), (2, sent_ns + 50 * MS), (3, sent_ns)):
        assert replies[k][0].tc1 == fleet.vehicle(k).radio.clock.boot_ns(arrival_ns)


def test_the_true_state_is_known_at_any_time() -> None:
    fleet = Fleet(scenario(1, up_s=0.5, down_s=0.1), START)
    fleet.step([(1, frame, START) for frame in (arm(), guided(), setpoint(2.0))], START)
    acts_ns = START + 100 * MS
    state = fleet.state(1, acts_ns + 400 * MS)
    assert state.velocity_ne_m_s() == pytest.approx((40.8, 9.0))
    assert state.north_m == pytest.approx(40.0 * 0.4 + 0.16)


def test_the_truth_logs_sampling_and_acting_instants() -> None:
    recorder = MemoryRecorder()
    fleet = Fleet(scenario(COUNT, up_s=0.02, down_s=0.03), START, recorder=recorder)
    out = flight(fleet)
    rows = recorder.records.tolist()
    sampled = {row[1:3]: row[3] for row in rows if row[0] == SAMPLED}
    positions = [(d, parse(d[1])) for d in out if parse(d[1]).get_type() == "LOCAL_POSITION_NED"]
    assert len(positions) > 300
    for (system_id, _, due_ns), message in positions:
        assert due_ns - sampled[system_id, message.time_boot_ms] == 20 * MS
    acted = [row for row in rows if row[0] == ACTED]
    assert {row[3] - row[2] * MS for row in acted} == {30 * MS}
    assert len(acted) == COUNT * 98  # 100 ticks, the last two still under way
    for kind, delay_ns in ((LINK_UP, 20 * MS), (LINK_DOWN, 30 * MS)):
        links = [row for row in rows if row[0] == kind]
        assert {row[5] - row[4] for row in links} == {delay_ns}
        assert all(row[3] >= row[5] for row in links)


def test_heartbeats_and_questions_do_not_count_as_commands() -> None:
    fleet = Fleet(scenario(2, down_s=0.1), START)
    fleet.step([(2, heartbeat(), START + SECOND), (1, b"noise", START + 2 * SECOND)], START + 3 * SECOND)
    fleet.step([(1, pack(dialect.MAVLink_timesync_message(0, 5)), START + 3 * SECOND)], START + 4 * SECOND)
    assert fleet.commanded_ns == START
    fleet.step([(1, arm(1), START + 5 * SECOND)], START + 6 * SECOND)
    assert fleet.commanded_ns == START + 5100 * MS
    assert fleet.counters["refused_garbage"] == 1
    assert fleet.counters["heartbeats"] == 1


def test_changes_come_once_and_in_order_of_time() -> None:
    fleet = Fleet(scenario(2), START)
    fleet.step([(2, arm(2), START + 5), (1, arm(1), START + 9)], START + SECOND)
    assert [change.system_id for change in fleet.take_changes()] == [2, 1]
    assert fleet.take_changes() == []


def test_frames_of_all_vehicles_carry_their_own_numbers() -> None:
    out = flight(Fleet(scenario(COUNT), START))
    for k in range(1, COUNT + 1):
        own = parse_all([(data, due) for system_id, data, due in out if system_id == k])
        assert [message.get_seq() for message, _ in own] == [n % 256 for n in range(len(own))]
