"""The station's MAVLink 2 codec: decodes datagrams into frames and encodes frames.

Message definitions (wire layout, CRC_EXTRA) come from pymavlink's dialect. Framing and checksum are our own, because
they run for 25,000 datagrams a second with 250 vehicles. Fields are in wire order. The kernels at the end read and
write the few messages that make up nearly all traffic, in the same layout.
"""

import struct
from collections import Counter
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from fastcrc.crc16 import mcrf4xx
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as dialect

from scenarios.kernel import Array, Records, array_kernel, int64, kernel
from scenarios.networks import system_id_of

STATION_SYSTEM_ID = 255
STATION_COMPONENT_ID = 190

HEARTBEAT = 0
PARAM_REQUEST_READ = 20
PARAM_VALUE = 22
PARAM_SET = 23
LOCAL_POSITION_NED = 32
GLOBAL_POSITION_INT = 33
GPS_GLOBAL_ORIGIN = 49
COMMAND_LONG = 76
COMMAND_ACK = 77
SET_POSITION_TARGET_LOCAL_NED = 84
POSITION_TARGET_LOCAL_NED = 85
TIMESYNC = 111
EKF_STATUS_REPORT = 193
ESTIMATOR_STATUS = 230
HOME_POSITION = 242
NAMED_VALUE_INT = 252
STATUSTEXT = 253
PARAM_EXT_REQUEST_READ = 320
PARAM_EXT_VALUE = 322
SCENARIO = "SCENARIO"
"""The extended parameter in which a simulated vehicle names its scenario."""

MAGIC, MAGIC_1 = 0xFD, 0xFE
_HEADER, _HEADER_1_BYTES = struct.Struct("<BBBBBBBHB"), 6
_SIGNED = 0x01
_SIGNATURE_LENGTH = 13
_OVERHEAD, _OVERHEAD_1 = 12, 8
_TIMESYNC_REQUEST = TIMESYNC.to_bytes(3, "little") + bytes(8)
"""The message id and the first field of a request."""


class _Layout(NamedTuple):
    packing: struct.Struct
    length: int
    crc_extra: bytes
    frame: struct.Struct
    """Header and payload, up to the checksum."""


SETUP_SIGNING = 256
"""This message carries a key, so it is neither sent nor accepted, and never logged."""
_MESSAGES: dict[int, Any] = dialect.mavlink_map
_LAYOUTS = {
    msg_id: _Layout(
        message.unpacker,
        message.unpacker.size,
        bytes([message.crc_extra]),
        struct.Struct(_HEADER.format + message.unpacker.format.lstrip("<")),
    )
    for msg_id, message in _MESSAGES.items()
    if msg_id != SETUP_SIGNING
}
_TARGET_PLACES = {
    msg_id: sum(message.lengths[: message.ordered_fieldnames.index("target_system")])
    for msg_id, message in _MESSAGES.items()
    if "target_system" in message.ordered_fieldnames
}
"""Index of target_system among the fields, for each message that has one."""
CRC_EXTRA = {msg_id: layout.crc_extra for msg_id, layout in _LAYOUTS.items()}


class Frame(NamedTuple):
    """One valid frame. `fields` are in wire order (largest type first), as pymavlink's `ordered_fieldnames` lists."""

    msg_id: int
    system_id: int
    component_id: int
    sequence: int
    fields: tuple[Any, ...]
    data: bytes


def named_fields(frame: Frame) -> dict[str, Any]:
    """The fields by name, with arrays as lists and characters as a string."""
    message = _MESSAGES[frame.msg_id]
    named: dict[str, Any] = {}
    at = 0
    for name, length in zip(message.ordered_fieldnames, message.lengths, strict=True):
        value = frame.fields[at] if length == 1 else list(frame.fields[at : at + length])
        named[name] = value.rstrip(b"\0").decode(errors="replace") if isinstance(value, bytes) else value
        at += length
    return named


def text_of(field: bytes) -> str:
    """The text in a field up to its first NUL. What is not printable is replaced: a terminal would obey it."""
    text = field.partition(b"\0")[0].decode(errors="replace")
    return "".join(character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in text)


def is_finite(frame: Frame) -> bool:
    """Whether a frame is no position used for control, or one without NaN and infinity."""
    return frame.msg_id != LOCAL_POSITION_NED or isfinite(sum(frame.fields))


def target_system(frame: Frame) -> int:
    """The system that a frame is addressed to; 0 for all."""
    place = _TARGET_PLACES.get(frame.msg_id)
    return 0 if place is None else frame.fields[place]


def message_name(msg_id: int) -> str:
    """The name of a message that `decode` knows."""
    return _MESSAGES[msg_id].msgname


def decode(datagram: bytes, refused: Counter[str]) -> list[Frame]:
    """The valid MAVLink 2 frames of one datagram; refused ones are counted by reason, and nothing is raised.

    Each datagram is parsed on its own, so a truncated frame cannot swallow the next datagram. Numbers may be NaN or
    infinite, which a checksum does not show; see `is_finite`.
    """
    end = len(datagram)
    if end >= _OVERHEAD and datagram[0] == MAGIC and end == _OVERHEAD + datagram[1] and not datagram[2]:
        frame = _checked(datagram, refused)  # the usual case: one unsigned frame
        return [] if frame is None else [frame]
    return _decode(datagram, MAGIC, refused)


def decode_1(datagram: bytes, refused: Counter[str]) -> list[Frame]:
    """The valid MAVLink 1 frames of one datagram; refused ones are counted by reason."""
    return _decode(datagram, MAGIC_1, refused)


def decode_either(datagram: bytes, refused: Counter[str]) -> list[Frame]:
    """The valid frames of one datagram, which may hold MAVLink 1 or MAVLink 2."""
    return decode_1(datagram, refused) if datagram[:1] == b"\xfe" else decode(datagram, refused)


def in_network(frames: list[Frame], network: int) -> list[Frame]:
    """Frames received in a network, with their system ids replaced by those of `scenarios.networks`."""
    return [frame._replace(system_id=system_id_of(network, frame.system_id)) for frame in frames] if network else frames


def _decode(datagram: bytes, magic: int, refused: Counter[str]) -> list[Frame]:
    frames: list[Frame] = []
    at = 0
    while at < len(datagram):
        if datagram[at] != magic:
            refused["not MAVLink 2" if magic == MAGIC else "not MAVLink 1"] += 1
            break
        stop = frame_end(datagram, at)
        if not stop:
            refused["truncated"] += 1
            break
        if magic == MAGIC and datagram[at + 2] & ~_SIGNED:
            refused["unknown flags"] += 1
        else:
            frame = _checked(datagram[at:stop], refused)
            if frame is not None:
                frames.append(frame)
        at = stop
    return frames


def is_magic(data: bytes, at: int) -> bool:
    """Whether a frame may begin at this index, or the data end there."""
    return at >= len(data) or data[at] in (MAGIC, MAGIC_1)


def frame_end(data: bytes, at: int) -> int:
    """The end of the frame that begins at this index; 0 if none begins there or it is truncated.

    Decoders call it before they read past the magic byte. Only it computes the length of a frame that may be signed.
    """
    if at + _OVERHEAD_1 > len(data) or data[at] not in (MAGIC, MAGIC_1):
        return 0
    signature = _SIGNATURE_LENGTH if data[at] == MAGIC and data[at + 2] & _SIGNED else 0
    stop = at + data[at + 1] + (_OVERHEAD + signature if data[at] == MAGIC else _OVERHEAD_1)
    return stop if stop <= len(data) else 0


def _checked(data: bytes, refused: Counter[str]) -> Frame | None:
    """Decode one frame whose length has been checked; None if it is refused."""
    if data[0] == MAGIC:
        _, length, _, _, sequence, system_id, component_id, id_low, id_high = _HEADER.unpack_from(data)
        msg_id, begin = id_low | id_high << 16, _HEADER.size
    else:
        _, length, sequence, system_id, component_id, msg_id = data[:_HEADER_1_BYTES]
        begin = _HEADER_1_BYTES
    layout = _LAYOUTS.get(msg_id)
    if layout is None:
        refused["SETUP_SIGNING" if msg_id == SETUP_SIGNING else "unknown message"] += 1
        return None
    packing, full_length, crc_extra, _ = layout
    end = begin + length
    if mcrf4xx(data[1:end] + crc_extra) != data[end] | data[end + 1] << 8:
        refused["bad checksum"] += 1
        return None
    if length == full_length:
        fields = packing.unpack_from(data, begin)
    else:  # MAVLink 2 omits trailing zeros; a newer dialect may add fields, which are ignored
        fields = packing.unpack(data[begin : begin + min(length, full_length)].ljust(full_length, b"\0"))
    return Frame(msg_id, system_id, component_id, sequence, fields, data)


def encode(msg_id: int, fields: tuple[Any, ...], *, sequence: int, system_id: int = STATION_SYSTEM_ID) -> bytes:
    """One unsigned MAVLink 2 frame, by default from the station; `fields` in wire order, `sequence` modulo 256."""
    _, length, crc_extra, frame = _LAYOUTS[msg_id]
    numbers = 0, 0, sequence & 0xFF, system_id, STATION_COMPONENT_ID, msg_id & 0xFFFF, msg_id >> 16
    body = frame.pack(MAGIC, length, *numbers, *fields)
    if not body[-1]:  # trailing zeros are omitted, except for the first byte of the payload
        payload = body[_HEADER.size :].rstrip(b"\0") or b"\0"
        body = _HEADER.pack(MAGIC, len(payload), *numbers) + payload
    return body + mcrf4xx(body[1:] + crc_extra).to_bytes(2, "little")


def heartbeat() -> tuple[Any, ...]:
    return (0, dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, dialect.MAV_STATE_ACTIVE, 3)


def timesync(*, tc1_ns: int, ts1_ns: int) -> tuple[Any, ...]:
    """Fields of TIMESYNC: a request has tc1 = 0, a reply mirrors ts1."""
    return (tc1_ns, ts1_ns)


def is_timesync_request(data: bytes) -> bool:
    """Whether a MAVLink 2 frame is a TIMESYNC whose tc1, its first field, is 0."""
    return data[7 : _HEADER.size + 8] == _TIMESYNC_REQUEST


def statustext(severity: int, text: str) -> tuple[Any, ...]:
    """Fields of STATUSTEXT; the message holds 50 bytes of text."""
    return (severity, text.encode()[:50], 0, 0)


def command_long(
    command: int, *, target_system: int, confirmation: int = 0, parameters: tuple[float, ...] = ()
) -> tuple[Any, ...]:
    """Fields of COMMAND_LONG to the autopilot (component 1) of one vehicle; omitted parameters are 0."""
    padding = (0.0,) * (7 - len(parameters))
    return (*parameters, *padding, command, target_system, 1, confirmation)


def param_set(name: str, value: float, *, target_system: int) -> tuple[Any, ...]:
    """Fields of PARAM_SET with a REAL32."""
    return (value, target_system, 1, name.encode(), dialect.MAV_PARAM_TYPE_REAL32)


def param_request_read(name: str, *, target_system: int) -> tuple[Any, ...]:
    """Fields of PARAM_REQUEST_READ, or of PARAM_EXT_REQUEST_READ, by name."""
    return (-1, target_system, 1, name.encode())


def scenario_of(fields: tuple[Any, ...]) -> str:
    """The fingerprint and name of a simulated vehicle's scenario, from the fields of PARAM_EXT_VALUE; "" if of another
    parameter."""
    name, value = map(text_of, fields[2:4])
    return value if name == SCENARIO else ""


IGNORE_ALL_BUT_VELOCITY_AND_ACCELERATION = 0x0C07
IGNORE_ALL_BUT_ACCELERATION = 0x0C3F
VELOCITY_IGNORED = 0x0018
"""Values of type_mask, in which each set bit makes the vehicle ignore a field."""


_LOCAL_FRAME = dialect.MAV_FRAME_LOCAL_NED
SET_POINT = np.dtype(
    [("sent", "?"), ("type_mask", "u2"), ("velocity_ned_m_s", "f8", (3,)), ("acceleration_ne_m_s2", "f8", (2,))]
)
"""A set-point: SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME_LOCAL_NED; `sent`: whether the vehicle is sent one."""
_TIMESYNC_BYTES = _LAYOUTS[TIMESYNC].length
_SET_POINT_BYTES = _LAYOUTS[SET_POSITION_TARGET_LOCAL_NED].length
_HEADER_BYTES = _HEADER.size
_POSITION_EXTRA, _TIMESYNC_EXTRA = CRC_EXTRA[LOCAL_POSITION_NED][0], CRC_EXTRA[TIMESYNC][0]
_SET_POINT_EXTRA = CRC_EXTRA[SET_POSITION_TARGET_LOCAL_NED][0]
HEARTBEAT_EXTRA, _GLOBAL_EXTRA = CRC_EXTRA[HEARTBEAT][0], CRC_EXTRA[GLOBAL_POSITION_INT][0]


_CRC, _rest = np.empty((4, 256), np.uint16), np.arange(256)
"""Lookup tables of CRC-16/MCRF4XX, polynomial 0x8408: row k holds the contribution of a byte followed by k more. The
type is short because a kernel embeds the table as text in its code."""
for _row in _CRC:
    for _bit in range(8):
        _rest = _rest >> 1 ^ 0x8408 * (_rest & 1)
    _row[:] = _rest


@kernel
def checksum(data: Array, begin: int, end: int, extra: int) -> int:
    """The checksum of a frame, over its bytes from the length field to the end of the payload, and CRC_EXTRA."""
    crc, fours = 0xFFFF, begin + (end - begin) // 4 * 4
    for k in range(begin, fours, 4):  # the four lookups are independent of one another
        ahead = _CRC[3, (crc ^ data[k]) & 0xFF] ^ _CRC[2, (crc >> 8 ^ data[k + 1]) & 0xFF]
        crc = int64(ahead ^ _CRC[1, data[k + 2]] ^ _CRC[0, data[k + 3]])
    for k in range(fours, end):
        crc = crc >> 8 ^ _CRC[0, (crc ^ data[k]) & 0xFF]
    return crc >> 8 ^ _CRC[0, (crc ^ extra) & 0xFF]


@kernel
def common_message(data: Array, begin: int, end: int) -> int:
    """The message id of a datagram that holds exactly one valid, unsigned frame of a common message; else -1.

    Common messages are LOCAL_POSITION_NED, TIMESYNC, HEARTBEAT and GLOBAL_POSITION_INT.
    """
    if end - begin < _OVERHEAD or data[begin] != MAGIC or data[begin + 2] or end - begin != _OVERHEAD + data[begin + 1]:
        return -1
    msg_id = int64(data[begin + 7])
    if data[begin + 8] or data[begin + 9]:
        return -1
    if msg_id == LOCAL_POSITION_NED:
        extra = _POSITION_EXTRA
    elif msg_id == TIMESYNC:
        extra = _TIMESYNC_EXTRA
    elif msg_id == HEARTBEAT:
        extra = HEARTBEAT_EXTRA
    elif msg_id == GLOBAL_POSITION_INT:
        extra = _GLOBAL_EXTRA
    else:
        return -1
    crc = checksum(data, begin + 1, end - 2, extra)
    return msg_id if crc == int64(data[end - 2]) | int64(data[end - 1]) << 8 else -1


@kernel
def unsigned_at(data: Array, place: int, size: int, end: int) -> Any:
    """The unsigned integer of `size` bytes at an index; bytes from `end` on are zeros, which MAVLink 2 omits."""
    value = np.uint64(0)
    for k in range(min(size, end - place)):
        value |= np.uint64(data[place + k]) << np.uint64(8 * k)
    return value


@kernel
def float_at(data: Array, place: int, end: int) -> float:
    """The float32 at an index, read as by `unsigned_at`."""
    return np.float64(np.uint32(unsigned_at(data, place, 4, end)).view(np.float32))


@kernel
def _put(data: Array, place: int, value: Any, size: int) -> None:
    for k in range(size):
        data[place + k] = (value >> np.uint64(8 * k)) & np.uint64(0xFF)


@kernel
def _put_float(data: Array, place: int, value: float) -> None:
    _put(data, place, np.uint64(np.float32(value).view(np.uint32)), 4)


@array_kernel
def set_point_frames(points: Records, rows: Array, sequences: Array, targets: Array, key_ms: int) -> NDArray[np.uint8]:
    """Set-point frames (m, bytes) for some vehicles, each with its own sequence numbers.

    `points` (SET_POINT), `sequences` and `targets` (their system ids on the wire) are those of all vehicles;
    `sequences` is advanced. The last payload byte, the coordinate frame, is never zero, so all have the same length.
    """
    end = _HEADER_BYTES + _SET_POINT_BYTES
    frames = np.zeros((len(rows), end + 2), np.uint8)
    for place in range(len(rows)):
        row, data = rows[place], frames[place]
        point = points[row]
        sequences[row] = (sequences[row] + 1) & 0xFF
        data[0], data[1], data[4] = MAGIC, _SET_POINT_BYTES, sequences[row]
        data[5], data[6], data[7] = STATION_SYSTEM_ID, STATION_COMPONENT_ID, SET_POSITION_TARGET_LOCAL_NED
        _put(data, _HEADER_BYTES, np.uint64(key_ms), 4)
        for k in range(3):
            _put_float(data, _HEADER_BYTES + 4 * (4 + k), point.velocity_ned_m_s[k])
        for k in range(2):
            _put_float(data, _HEADER_BYTES + 4 * (7 + k), point.acceleration_ne_m_s2[k])
        _put(data, end - 5, np.uint64(point.type_mask), 2)
        data[end - 3], data[end - 2], data[end - 1] = targets[row], 1, _LOCAL_FRAME
        _put(data, end, np.uint64(checksum(data, 1, end, _SET_POINT_EXTRA)), 2)
    return frames


@array_kernel
def same_frames(frame: Array, extra: int, rows: Array, sequences: Array) -> NDArray[np.uint8]:
    """Copies (m, bytes) of a frame for some vehicles, each with its own sequence numbers.

    `extra` is the CRC_EXTRA byte of the message.
    """
    size = len(frame)
    frames = np.empty((len(rows), size), np.uint8)
    for place in range(len(rows)):
        row, own = rows[place], frames[place]
        for k in range(size):  # `own[:] = frame` would take two seconds longer to compile, for its error message
            own[k] = frame[k]
        own[4] = sequences[row] = (sequences[row] + 1) & 0xFF
        _put(own, size - 2, np.uint64(checksum(own, 1, size - 2, extra)), 2)
    return frames


TIMESYNC_FRAME_BYTES = _OVERHEAD + _TIMESYNC_BYTES + 2
"""The longest TIMESYNC frame: pymavlink's dialect lacks the two last fields, the ids of the target."""


@kernel
def encode_timesync(data: Array, tc1_ns: int, ts1_ns: int, target: int, sequence: int) -> int:
    """Write a TIMESYNC frame into `TIMESYNC_FRAME_BYTES` zeros; returns its length.

    A request has tc1 = 0, a reply mirrors ts1. `target` is the system id of the vehicle, or 0 for all that hear it.
    """
    _put(data, _HEADER_BYTES, np.uint64(tc1_ns), 8)
    _put(data, _HEADER_BYTES + 8, np.uint64(ts1_ns), 8)
    data[_HEADER_BYTES + 16] = target
    end = len(data) - 2
    while end > _HEADER_BYTES + 1 and not data[end - 1]:
        end -= 1  # trailing zeros are omitted, except for the first byte of the payload
    data[0], data[1], data[4] = MAGIC, end - _HEADER_BYTES, sequence
    data[5], data[6], data[7] = STATION_SYSTEM_ID, STATION_COMPONENT_ID, TIMESYNC
    _put(data, end, np.uint64(checksum(data, 1, end, _TIMESYNC_EXTRA)), 2)
    return end + 2
