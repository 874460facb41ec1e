"""Hostile, broken and misaddressed datagrams change the counters and nothing else."""

import struct
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_vehicles.services.mavlink import read_datagram
from sim_vehicles.vehicles.double_integrator import DoubleIntegrator
from sim_vehicles.vehicles.shell import Shell
from tests.support.sim_client import (
    SECOND,
    START,
    a_vehicle,
    arm,
    command,
    guided,
    heartbeat,
    mode,
    pack,
    parse_all,
    setpoint,
    take_off,
)

NAN, INFINITY = float("nan"), float("inf")
VALID = [setpoint(3.0, -2.0), arm(), guided(), heartbeat(), command(511, 32, 20_000), mode(5)]


def in_flight() -> Shell[DoubleIntegrator]:
    vehicle = a_vehicle()
    vehicle.step([(heartbeat(), START)], START)
    take_off(vehicle)
    return vehicle


def future(vehicle: Shell[DoubleIntegrator]) -> list[tuple[bytes, int]]:
    return vehicle.step([], START + 5 * SECOND)


UNDISTURBED = future(in_flight())


def assert_only_counted(datagram: bytes) -> Counter[str]:
    """Assert that the datagram changes nothing the vehicle sends, and is counted; returns the counts."""
    vehicle = in_flight()
    before = vehicle.counters.copy()
    vehicle.step([(datagram, START)], START)
    assert future(vehicle) == UNDISTURBED
    counted = vehicle.counters - before
    assert counted.total() > 0
    return counted


def mavlink1(frame: bytes) -> bytes:
    """The same message as a MAVLink 1 frame, valid in itself."""
    message = dialect.MAVLink(None).parse_buffer(frame)
    assert message is not None
    return message[0].pack(dialect.MAVLink(None, 255, 190), force_mavlink1=True)


def with_flag(frame: bytes, flag: int) -> bytes:
    """The frame with an incompatibility flag set and the checksum right again."""
    changed = bytearray(frame)
    changed[2] |= flag
    checksum = dialect.x25crc(bytes(changed[1:-2]) + bytes([143])).crc
    return bytes(changed[:-2]) + struct.pack("<H", checksum)


FAULTY = [
    (b"", "refused_empty"),
    (b"\0" * 40, "refused_garbage"),
    (mavlink1(setpoint(3.0)), "refused_mavlink1"),
    (setpoint(3.0)[:-1], "refused_truncated"),
    (setpoint(3.0)[:5], "refused_truncated"),
    (setpoint(3.0)[:-1] + b"\xff", "refused_crc"),
    (with_flag(setpoint(3.0), 0x02), "refused_incompatible"),
    (b"\xfd\x00\x00\x00\x00\xff\xbe\xff\xff\xff\x00\x00", "refused_unknown"),
    (pack(dialect.MAVLink_ping_message(0, 0, 0, 0)), "ignored_message"),
    (setpoint(NAN), "refused_absurd"),
    (setpoint(0.0, INFINITY), "refused_absurd"),
    (setpoint(-INFINITY), "refused_absurd"),
    (setpoint(8e3, 8e3), "refused_absurd"),
    (setpoint(velocity=(0.0, NAN), mask=0x0C07), "refused_absurd"),
    (setpoint(velocity=(-10_001.0, 0.0), mask=0x0C07), "refused_absurd"),
    (setpoint(3.0, frame=6), "refused_frame"),
    (setpoint(3.0, mask=0x0DCF), "refused_mask"),
    (setpoint(3.0, mask=0x0E3F), "refused_mask"),  # with FORCE_SET
    (setpoint(3.0, mask=0), "refused_mask"),
    (setpoint(3.0, system=2), "ignored_not_addressed"),
    (setpoint(3.0, system=0), "ignored_not_addressed"),
    (setpoint(3.0, component=100), "ignored_not_addressed"),
    (command(176, 1, 5, system=2), "ignored_not_addressed"),
    (command(176, 1, 5, system=0), "ignored_not_addressed"),
    (command(176, 1, 5, component=154), "ignored_not_addressed"),
    (heartbeat(dialect.MAV_TYPE_QUADROTOR), "ignored_heartbeat"),
    (pack(dialect.MAVLink_timesync_message(5, 6)), "ignored_timesync_reply"),
]


@pytest.mark.parametrize(("datagram", "reason"), FAULTY, ids=[reason for _, reason in FAULTY])
def test_a_faulty_datagram_is_counted_by_reason_and_changes_nothing(datagram: bytes, reason: str) -> None:
    assert assert_only_counted(datagram) == Counter({reason: 1})


def test_nan_in_fields_that_the_mask_ignores_does_no_harm() -> None:
    vehicle = in_flight()
    vehicle.step([(setpoint(2.0, velocity=(NAN, INFINITY)), START)], START)
    assert vehicle.counters["setpoints"] == 2
    assert vehicle.craft.state_at(START + SECOND).velocity_ne_m_s()[0] == pytest.approx(42.0)


def test_component_zero_means_every_component_of_the_addressed_system() -> None:
    vehicle = in_flight()
    vehicle.step([(setpoint(2.0, component=0), START), (command(400, 1, component=0), START)], START)
    assert (vehicle.counters["setpoints"], vehicle.counters["commands"]) == (2, 3)


def test_a_timesync_request_for_another_vehicle_is_not_answered() -> None:
    request = pack(dialect.MAVLink_timesync_message(0, 1 << 60))
    for target, answered in ((0, 1), (1, 1), (2, 0)):
        # The target fields are extensions that this dialect lacks: 16 bytes of payload and two more.
        payload = struct.pack("<qqBB", 0, 1 << 60, target, 1)
        body = bytes([len(payload)]) + request[2:10] + payload
        frame = b"\xfd" + body + struct.pack("<H", dialect.x25crc(body + bytes([34])).crc)
        vehicle = a_vehicle()
        assert len(parse_all(vehicle.step([(frame, START)], START), "TIMESYNC")) == answered


def test_several_frames_in_one_datagram_are_all_obeyed() -> None:
    vehicle = a_vehicle()
    vehicle.step([(heartbeat() + arm() + guided() + setpoint(1.0), START)], START)
    assert vehicle.craft.flight.flying
    assert vehicle.counters == {"heartbeats": 1, "commands": 2, "setpoints": 1}


@pytest.mark.parametrize(
    "tail",
    [b"\0\0\0", setpoint(9.0)[:20], mavlink1(setpoint(9.0)), b"\xfd"],
    ids=["zeros", "cut short", "MAVLink 1", "magic only"],
)
def test_a_broken_tail_harms_neither_earlier_frames_nor_later_datagrams(tail: bytes) -> None:
    vehicle = in_flight()
    vehicle.step([(setpoint(1.0) + tail, START), (setpoint(2.0), START)], START)
    assert vehicle.counters["setpoints"] == 3
    assert sum(n for reason, n in vehicle.counters.items() if reason.startswith("refused")) == 1
    assert vehicle.craft.state_at(START + SECOND).velocity_ne_m_s()[0] == pytest.approx(42.0)


def test_a_vehicle_without_a_key_accepts_signed_frames() -> None:
    signing = dialect.MAVLink(None, 255, 190)
    signing.signing.secret_key, signing.signing.sign_outgoing = b"k" * 32, True
    frame = dialect.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0).pack(signing)
    vehicle = a_vehicle()
    vehicle.step([(frame, START)], START)
    assert vehicle.craft.flight.armed
    assert_only_counted(frame[:-1])


@given(st.binary(max_size=300))
def test_random_bytes_change_nothing(datagram: bytes) -> None:
    assert_only_counted(datagram)


@given(st.sampled_from(VALID), st.binary(min_size=1, max_size=80))
def test_random_bytes_behind_a_magic_change_nothing(frame: bytes, noise: bytes) -> None:
    assert_only_counted(frame[:1] + noise)


@given(st.sampled_from(VALID), st.data())
def test_one_flipped_bit_is_always_noticed(frame: bytes, data: st.DataObject) -> None:
    bit = data.draw(st.integers(0, len(frame) * 8 - 1))
    changed = bytearray(frame)
    changed[bit // 8] ^= 1 << bit % 8
    assert_only_counted(bytes(changed))


@given(st.sampled_from(VALID), st.data())
def test_a_frame_cut_short_is_always_noticed(frame: bytes, data: st.DataObject) -> None:
    assert_only_counted(frame[: data.draw(st.integers(0, len(frame) - 1))])


finite_or_not = st.floats(width=32)


@given(finite_or_not, finite_or_not, finite_or_not, finite_or_not, st.sampled_from([0x0C3F, 0x0C07]))
def test_no_set_point_makes_the_reports_anything_but_finite(
    north: float, east: float, v_north: float, v_east: float, mask: int
) -> None:
    vehicle = in_flight()
    sent = vehicle.step([(setpoint(north, east, velocity=(v_north, v_east), mask=mask), START)], START + SECOND)
    for message, _ in parse_all(sent, "LOCAL_POSITION_NED"):
        values = (message.x, message.y, message.vx, message.vy)
        assert all(abs(value) < 1e6 for value in values)


@given(st.lists(st.sampled_from(VALID), max_size=6))
def test_the_frames_read_are_those_pymavlink_reads(frames: list[bytes]) -> None:
    counters: Counter[str] = Counter()
    expected = dialect.MAVLink(None).parse_buffer(b"".join(frames)) or []
    read = read_datagram(b"".join(frames), counters)
    assert len(read) == len(expected)
    for (source, ours), theirs in zip(read, expected, strict=True):
        assert source == theirs.get_srcSystem()
        own = ours._fields if isinstance(ours, tuple) else ours.get_fieldnames()
        for field in set(own) & set(theirs.get_fieldnames()):
            assert getattr(ours, field) == getattr(theirs, field)
