"""MAVLink 2 codec of the vehicles: decodes datagrams into messages and encodes messages into frames.

Each datagram is parsed on its own: in pymavlink's stream parser a truncated frame would swallow the next datagram. The
message tables are pymavlink's, as is the decoder of all but the frequent messages. Refused frames are counted by
reason; nothing is raised.
"""

import struct
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from fastcrc.crc16 import mcrf4xx
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as dialect

from scenarios.kernel import Cell, at_row
from scenarios.networks import wire_id
from sim_vehicles.services import frames
from sim_vehicles.services.frames import ARDUPILOT, AUTOPILOT, HEARTBEAT, LOCAL_NED, NO_MESSAGE, STATION_TYPE
from sim_vehicles.services.hot import Place
from sim_vehicles.services.messages import REQUESTS, Condition, Message, Request

MAGIC_1, MAGIC_2 = dialect.PROTOCOL_MARKER_V1, dialect.PROTOCOL_MARKER_V2
HEADER_BYTES, CHECKSUM_BYTES, SIGNATURE_BYTES = dialect.HEADER_LEN_V2, 2, dialect.MAVLINK_SIGNATURE_BLOCK_LEN
SIGNED = dialect.MAVLINK_IFLAG_SIGNED

MODE_STABILIZE, MODE_GUIDED, MODE_LOITER, MODE_BRAKE = 0, 4, 5, 17
MODE_RETURN, MODE_LAND = 6, 9
BASE_MODE_CUSTOM = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
SEVERITY_CRITICAL, SEVERITY_WARNING = dialect.MAV_SEVERITY_CRITICAL, dialect.MAV_SEVERITY_WARNING

COMMAND_MODE, COMMAND_ARM = dialect.MAV_CMD_DO_SET_MODE, dialect.MAV_CMD_COMPONENT_ARM_DISARM
COMMAND_TAKEOFF, COMMAND_LAND = dialect.MAV_CMD_NAV_TAKEOFF, dialect.MAV_CMD_NAV_LAND
COMMAND_RETURN = dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH
COMMAND_CAPABILITIES = dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES
COMMAND_GET_HOME, COMMAND_GET_INTERVAL = dialect.MAV_CMD_GET_HOME_POSITION, dialect.MAV_CMD_GET_MESSAGE_INTERVAL
COMMAND_SHUTDOWN = dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
COMMAND_INTERVAL, COMMAND_REQUEST = dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAV_CMD_REQUEST_MESSAGE
ACCEPTED, DENIED = dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_DENIED
UNSUPPORTED = dialect.MAV_RESULT_UNSUPPORTED

POSITION_TARGET = dialect.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED
COMMAND_LONG, COMMAND_INT = dialect.MAVLINK_MSG_ID_COMMAND_LONG, dialect.MAVLINK_MSG_ID_COMMAND_INT
AUTOPILOT_VERSION = dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION
HOME_POSITION = dialect.MAVLINK_MSG_ID_HOME_POSITION
GLOBAL_ORIGIN = dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN
MESSAGE_INTERVAL = dialect.MAVLINK_MSG_ID_MESSAGE_INTERVAL

SETUP_SIGNING = dialect.MAVLINK_MSG_ID_SETUP_SIGNING
CRC_EXTRA: dict[int, bytes] = {
    number: bytes([known.crc_extra]) for number, known in dialect.mavlink_map.items() if number != SETUP_SIGNING
}
"""CRC_EXTRA of the accepted messages. SETUP_SIGNING is not among them: no key is accepted from a link."""
TO_ALL, TO_NONE = -1, -2


def _targets() -> NDArray[np.int64]:
    places = np.full(_MESSAGES, TO_NONE)
    for number, message in dialect.mavlink_map.items():
        if number < _MESSAGES and "target_system" in message.fieldnames:
            field = message.orders[message.fieldnames.index("target_system")]
            numbered = message.unpacker.unpack(bytes(range(message.unpacker.size)))  # each byte holds its place
            places[number] = numbered[sum(message.lengths[:field])]
    places[HEARTBEAT] = TO_ALL
    places[frames.TIMESYNC] = 16  # an extension that pymavlink's dialect lacks
    return places


_MESSAGES = 512  # the ids of all that stations send to a vehicle are below
TARGETS = _targets()
"""Where in its payload a message, by id, names its target system. TO_ALL: nowhere, it is for everybody; TO_NONE: no
vehicle acts on it."""
_SETPOINT = dialect.MAVLink_set_position_target_local_ned_message
_TIMESYNC = dialect.MAVLink_timesync_message
_DECODER = dialect.MAVLink(None)


Triple = tuple[float, float, float]
"""North, east, down."""


class Setpoint(NamedTuple):
    """SET_POSITION_TARGET_LOCAL_NED as received."""

    time_boot_ms: int
    velocity_ned_m_s: Triple
    acceleration_ned_m_s2: Triple
    yaw_rad: float = 0.0
    yaw_rate_rad_s: float = 0.0
    type_mask: int = 0
    target_system: int = 0
    target_component: int = 0
    frame: int = LOCAL_NED


class Command(NamedTuple):
    """COMMAND_LONG or COMMAND_INT, with the parameters that vehicles use."""

    source: tuple[int, int]
    target_system: int
    target_component: int
    command: int
    param1: float
    param2: float
    param3: float
    param5: float
    param6: float
    param7: float
    """Parameters 5 to 7 are x, y and z of a COMMAND_INT."""


class Timesync(NamedTuple):
    """TIMESYNC; target_system is 0 if the sender named none."""

    tc1: int
    ts1: int
    target_system: int


Heartbeat = dialect.MAVLink_heartbeat_message
Asked = Setpoint | Command | Request
"""A message addressed to one vehicle."""
Read = Heartbeat | Timesync | Asked


def read_datagram(data: bytes, counters: Counter[str]) -> list[tuple[int, Read]]:
    """The messages of a datagram that a vehicle may act on, each with the system id of its source.

    Everything else is counted: `refused_empty`, `refused_mavlink1`, `refused_garbage` (no frame starts where one
    should), `refused_truncated`, `refused_incompatible` (unknown flags), `refused_unknown` (message id not in the
    dialect), `refused_setup_signing`, `refused_crc`, and `ignored_message` (valid, but nothing for a vehicle).
    """
    messages: list[tuple[int, Read]] = []
    begin, end = 0, len(data)
    if not data:
        counters["refused_empty"] += 1
    while begin < end:
        if data[begin] != MAGIC_2:
            counters["refused_mavlink1" if data[begin] == MAGIC_1 else "refused_garbage"] += 1
            break
        if end - begin < HEADER_BYTES + CHECKSUM_BYTES:
            counters["refused_truncated"] += 1
            break
        flags = data[begin + 2]
        checked = begin + HEADER_BYTES + data[begin + 1]
        after = checked + CHECKSUM_BYTES + (SIGNATURE_BYTES if flags & SIGNED else 0)
        if after > end:
            counters["refused_truncated"] += 1
            break
        reason = _refusal(data, begin, checked)
        if reason:
            counters[reason] += 1
        else:
            _append(messages, data[begin:after], checked - begin, counters)
        begin = after
    return messages


def is_for(message: Asked, system_id: int) -> bool:
    """Whether a message is addressed to this vehicle: to its autopilot, or to all of its components."""
    # SET_MODE names no component
    return message.target_system == system_id and getattr(message, "target_component", 0) in (0, AUTOPILOT)


def in_version_1(frame: bytes) -> bytes:
    """Our own HEARTBEAT frame, converted to MAVLink 1."""
    size = dialect.MAVLink_heartbeat_message.unpacker.size
    payload = frame[HEADER_BYTES:-CHECKSUM_BYTES].ljust(size, b"\0")
    body = bytes([size, frame[4], frame[5], frame[6], HEARTBEAT]) + payload
    return bytes([MAGIC_1]) + body + mcrf4xx(body + CRC_EXTRA[HEARTBEAT]).to_bytes(2, "little")


def message_id(data: bytes) -> int:
    """Message id of a datagram's first frame, NO_MESSAGE if it has none."""
    return int.from_bytes(data[7:10], "little") if len(data) >= HEADER_BYTES and data[0] == MAGIC_2 else NO_MESSAGE


def _refusal(data: bytes, begin: int, checked: int) -> str:
    if data[begin + 2] & ~SIGNED:
        return "refused_incompatible"
    extra = CRC_EXTRA.get(data[begin + 7] | data[begin + 8] << 8 | data[begin + 9] << 16)
    if extra is None:
        number = int.from_bytes(data[begin + 7 : begin + 10], "little")
        return "refused_setup_signing" if number == SETUP_SIGNING else "refused_unknown"
    if mcrf4xx(data[begin + 1 : checked] + extra) != data[checked] | data[checked + 1] << 8:
        return "refused_crc"
    return ""


def _append(messages: list[tuple[int, Read]], frame: bytes, checked: int, counters: Counter[str]) -> None:
    """Decode one frame with a valid checksum; `checked` is the end of its payload."""
    number = frame[7] | frame[8] << 8 | frame[9] << 16
    # Most traffic is these two messages, so they are decoded without pymavlink's objects.
    if number == frames.SETPOINT:
        values = _values(_SETPOINT.unpacker, frame, checked)
        messages.append((frame[5], Setpoint(values[0], values[4:7], values[7:10], *values[10:])))
    elif number == frames.TIMESYNC:
        # The target is an extension field that this dialect does not have yet.
        target = frame[HEADER_BYTES + 16] if checked > HEADER_BYTES + 16 else 0
        tc1, ts1 = _values(_TIMESYNC.unpacker, frame, checked)
        messages.append((frame[5], Timesync(tc1, ts1, target)))
    elif number in (COMMAND_LONG, COMMAND_INT):
        messages.append((frame[5], _command(frame)))
    elif number == HEARTBEAT or number in REQUESTS:
        decoded: Any = _DECODER.decode(bytearray(frame))
        messages.append((frame[5], decoded))
    else:
        counters["ignored_message"] += 1


def _values(packing: struct.Struct, frame: bytes, checked: int) -> tuple[Any, ...]:
    """A payload's values in wire order: trailing zeros that were not sent are restored, extension fields dropped."""
    size = packing.size
    if checked - HEADER_BYTES >= size:
        return packing.unpack_from(frame, HEADER_BYTES)
    return packing.unpack(frame[HEADER_BYTES:checked].ljust(size, b"\0"))


def _command(frame: bytes) -> Command:
    asked: Any = _DECODER.decode(bytearray(frame))
    is_long = asked.id == COMMAND_LONG
    last = (asked.param5, asked.param6, asked.param7) if is_long else (asked.x, asked.y, asked.z)
    target = asked.target_system, asked.target_component
    return Command((frame[5], frame[6]), *target, asked.command, asked.param1, asked.param2, asked.param3, *last)


_local_position_at, _global_position_at = at_row(frames.local_position), at_row(frames.global_position)
_heartbeat_at, _timesync_at, _finish_at = at_row(frames.heartbeat), at_row(frames.timesync), at_row(frames.finish)


class Encoder:
    """Encodes one vehicle's frames; sequence numbers follow the order of the calls."""

    sequence = Cell[int]()

    def __init__(self, place: Place) -> None:
        self._vehicles, self._columns, self._row = place
        self.wire_id: int = self._columns["wire_id"][self._row]
        self._pymavlink = dialect.MAVLink(None, srcSystem=self.wire_id, srcComponent=AUTOPILOT)
        self._frame = np.zeros(frames.FRAME_BYTES, np.uint8)

    def local_position(self, time_boot_ms: int, position: Triple, velocity: Triple) -> bytes:
        """LOCAL_POSITION_NED in m and m/s."""
        return self._made(_local_position_at, time_boot_ms, *position, *velocity)

    def global_position(self, at: Condition) -> bytes:
        """GLOBAL_POSITION_INT; without a position, latitude and longitude are zero, as ArduPilot sends them."""
        place = at.place_deg if at.has_position else (0.0, 0.0)
        values = at.time_boot_ms, *place, at.altitude_m, *at.velocity_ned_m_s, at.attitude_rad[2]
        return self._made(_global_position_at, *values)

    def heartbeat(
        self, mode: int, *, armed: bool, flying: bool, critical: bool, guided: bool = False, autopilot: int = ARDUPILOT
    ) -> bytes:
        """HEARTBEAT of a quadrotor, by default an ArduCopter."""
        return self._made(_heartbeat_at, mode, autopilot, armed, guided, flying, critical)

    def timesync(self, tc1: int, ts1: int) -> bytes:
        return self._made(_timesync_at, tc1, ts1)

    def command_ack(self, command: int, result: int, requester: tuple[int, int]) -> bytes:
        system, component = requester
        message = dialect.MAVLink_command_ack_message
        return self.pack(message(command, result, target_system=system, target_component=component))

    def statustext(self, severity: int, text: str) -> bytes:
        """STATUSTEXT in one chunk."""
        encoded = text.encode("ascii")
        assert len(encoded) <= 50
        return self.pack(dialect.MAVLink_statustext_message(severity, encoded))

    def frame(self, number: int, payload: bytes) -> bytes:
        """The frame of a frequent message, without pymavlink's objects."""
        self._frame[frames.PAYLOAD : frames.PAYLOAD + len(payload)] = np.frombuffer(payload, np.uint8)
        self._frame[1], self._frame[7] = len(payload), number
        return self._made(_finish_at)

    def _made(self, make: Callable[..., int], *values: float) -> bytes:
        """The frame that a kernel makes from these values."""
        size = make(self._vehicles, self._row, self._frame, *values)
        return self._frame[:size].tobytes()

    def pack(self, message: Message) -> bytes:
        self._pymavlink.seq = self.sequence
        frame = message.pack(self._pymavlink)
        self.sequence = (self.sequence + 1) & 0xFF
        return frame


def rehearsal(system_id: int) -> list[bytes]:
    """Frames with which a station prepares a vehicle for flight, and its first set-points."""
    system_id = wire_id(system_id)
    station = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    command: Any = dialect.MAVLink_command_long_message
    zeros = (0.0,) * 6
    messages = (
        dialect.MAVLink_heartbeat_message(STATION_TYPE, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3),
        dialect.MAVLink_timesync_message(0, 1),
        command(system_id, 1, COMMAND_MODE, 0, BASE_MODE_CUSTOM, MODE_GUIDED, *zeros[1:]),
        command(system_id, 1, COMMAND_ARM, 0, 1.0, *zeros),
    )
    set_point: Any = dialect.MAVLink_set_position_target_local_ned_message
    flown = [set_point(ms, system_id, 1, LOCAL_NED, 0x0C3F, *zeros, 0.5, -0.5, *zeros[:3]) for ms in (1, 2)]
    return [message.pack(station) for message in (*messages, *flown)]
