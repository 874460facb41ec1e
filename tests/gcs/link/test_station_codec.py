"""The station's codec against pymavlink's own, and against everything that is not MAVLink."""

from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.link import mavlink

vehicle: Any = dialect.MAVLink(None, srcSystem=7, srcComponent=1)


def position(boot_ms: int = 1000, north_m: float = 1.5, vz_m_s: float = 0.0) -> bytes:
    return bytes(vehicle.local_position_ned_encode(boot_ms, north_m, 2, 3, 4, 5, vz_m_s).pack(vehicle))


def parsed(data: bytes) -> Any:
    return dialect.MAVLink(None).parse_char(data)


def decode(datagram: bytes) -> tuple[list[mavlink.Frame], Counter[str]]:
    refused: Counter[str] = Counter()
    return mavlink.decode(datagram, refused), refused


def test_set_point_is_read_by_pymavlink_as_it_was_meant() -> None:
    points, sequences = np.zeros(2, mavlink.SET_POINT), np.array([7, 299])
    points["type_mask"] = mavlink.IGNORE_ALL_BUT_ACCELERATION
    points["acceleration_ne_m_s2"][1] = 1.5, -2.25
    [data] = mavlink.set_point_frames(points, np.array([1]), sequences, np.array([2, 3]), 5)
    assert sequences.tolist() == [7, 300 & 0xFF]
    message = parsed(data.tobytes())
    assert message.get_type() == "SET_POSITION_TARGET_LOCAL_NED"
    assert (message.get_srcSystem(), message.get_srcComponent(), message.get_seq()) == (255, 190, 300 & 0xFF)
    assert (message.target_system, message.target_component, message.time_boot_ms) == (3, 1, 5)
    assert (message.afx, message.afy, message.afz) == (1.5, -2.25, 0.0)
    assert message.coordinate_frame == dialect.MAV_FRAME_LOCAL_NED
    ignored = {1 << bit for bit in range(12) if message.type_mask >> bit & 1}
    assert ignored == {1, 2, 4, 8, 16, 32, 1024, 2048}  # all but the acceleration; 512 is not an ignore bit


@pytest.mark.parametrize(
    ("msg_id", "fields", "expected"),
    [
        (mavlink.HEARTBEAT, mavlink.heartbeat(), {"type": 6, "autopilot": 8, "system_status": 4}),
        (mavlink.TIMESYNC, mavlink.timesync(tc1_ns=0, ts1_ns=123456789012), {"tc1": 0, "ts1": 123456789012}),
        (
            mavlink.COMMAND_LONG,
            mavlink.command_long(511, target_system=9, confirmation=2, parameters=(32.0, 20000.0)),
            {"command": 511, "target_system": 9, "confirmation": 2, "param1": 32.0, "param2": 20000.0, "param7": 0.0},
        ),
    ],
)
def test_frames_are_read_by_pymavlink(msg_id: int, fields: tuple[object, ...], expected: dict[str, object]) -> None:
    message = parsed(mavlink.encode(msg_id, fields, sequence=1))
    assert {name: getattr(message, name) for name in expected} == expected


def test_position_with_trailing_zeros_trimmed_is_read_whole() -> None:
    data = position(vz_m_s=0.0)
    assert len(data) < 28 + 12
    (frame,), refused = decode(data)
    assert frame.fields == (1000, 1.5, 2.0, 3.0, 4.0, 5.0, 0.0)
    assert (frame.msg_id, frame.system_id, frame.component_id) == (mavlink.LOCAL_POSITION_NED, 7, 1)
    assert not refused


def test_several_frames_in_one_datagram_are_all_read() -> None:
    frames, refused = decode(position(1) + position(2) + position(3))
    assert [frame.fields[0] for frame in frames] == [1, 2, 3]
    assert [frame.data for frame in frames][1] == frames[1].data
    assert not refused


def test_every_dialect_message_but_a_key_can_be_read() -> None:
    for msg_id, message in dialect.mavlink_map.items():
        if msg_id == dialect.MAVLINK_MSG_ID_SETUP_SIGNING:
            continue
        payload = bytes(range(1, 1 + message.unpacker.size))
        header = bytes([0xFD, len(payload), 0, 0, 0, 7, 1]) + msg_id.to_bytes(3, "little")
        crc = dialect.x25crc(header[1:] + payload + bytes([message.crc_extra])).crc
        (frame,), _ = decode(header + payload + crc.to_bytes(2, "little"))
        assert frame.msg_id == msg_id


@pytest.mark.parametrize(
    ("datagram", "reason"),
    [
        (position()[:-1], "truncated"),
        (position()[:5], "truncated"),
        (b"\xfe" + position()[1:], "not MAVLink 2"),
        (b"hello", "not MAVLink 2"),
        (position()[:-1] + bytes([position()[-1] ^ 1]), "bad checksum"),
        (position()[:2] + b"\x02" + position()[3:], "unknown flags"),
    ],
)
def test_bad_datagram_is_counted_by_reason(datagram: bytes, reason: str) -> None:
    frames, refused = decode(datagram)
    assert not frames
    assert refused == {reason: 1}


@pytest.mark.parametrize(("north_m", "is_finite"), [(1.0, True), (float("nan"), False), (float("inf"), False)])
def test_a_position_tells_whether_it_is_finite(north_m: float, is_finite: bool) -> None:
    (frame,), refused = decode(position(north_m=north_m))
    assert (mavlink.is_finite(frame), refused) == (is_finite, {})


@given(st.binary(max_size=400))
def test_random_bytes_give_no_frame_and_raise_nothing(datagram: bytes) -> None:
    frames, refused = decode(datagram)
    assert not frames
    assert bool(refused) == bool(datagram)


@given(st.integers(0, len(position()) * 8 - 1))
def test_one_flipped_bit_never_gives_a_wrong_position(bit: int) -> None:
    data = bytearray(position())
    data[bit // 8] ^= 1 << bit % 8
    frames, _ = decode(bytes(data))
    assert not frames
