"""The vehicles' side of MAVLink 2: datagrams to typed messages, and reports to frames.

Each datagram is split into frames on its own: with pymavlink's stream parser a truncated frame would swallow the next
datagram. Its message tables, and its decoder for all but the frequent messages, do the rest. Refused frames are counted
by reason, never raised.
"""

import struct
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_vehicles.services.service_messages import REQUESTS, Request, request

MAGIC_1, MAGIC_2 = dialect.PROTOCOL_MARKER_V1, dialect.PROTOCOL_MARKER_V2
HEADER_BYTES, CHECKSUM_BYTES, SIGNATURE_BYTES = dialect.HEADER_LEN_V2, 2, dialect.MAVLINK_SIGNATURE_BLOCK_LEN
SIGNED = dialect.MAVLINK_IFLAG_SIGNED

COMPONENT_AUTOPILOT = dialect.MAV_COMP_ID_AUTOPILOT1
OUR_COMPONENTS = (0, COMPONENT_AUTOPILOT)
"""Target components that mean this vehicle: all, or the autopilot."""
UINT32 = 0xFFFFFFFF
TYPE_GCS = dialect.MAV_TYPE_GCS
MODE_STABILIZE, MODE_GUIDED, MODE_LOITER, MODE_BRAKE = 0, 4, 5, 17
MODE_RETURN, MODE_LAND = 6, 9
BASE_MODE_CUSTOM = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
BASE_MODE_ARMED = dialect.MAV_MODE_FLAG_SAFETY_ARMED
BASE_MODE_GUIDED = dialect.MAV_MODE_FLAG_GUIDED_ENABLED
STATUS_STANDBY, STATUS_ACTIVE = dialect.MAV_STATE_STANDBY, dialect.MAV_STATE_ACTIVE
STATUS_CRITICAL = dialect.MAV_STATE_CRITICAL
SEVERITY_CRITICAL, SEVERITY_WARNING = dialect.MAV_SEVERITY_CRITICAL, dialect.MAV_SEVERITY_WARNING
FRAME_LOCAL_NED = dialect.MAV_FRAME_LOCAL_NED

COMMAND_MODE, COMMAND_ARM = dialect.MAV_CMD_DO_SET_MODE, dialect.MAV_CMD_COMPONENT_ARM_DISARM
COMMAND_TAKEOFF, COMMAND_LAND = dialect.MAV_CMD_NAV_TAKEOFF, dialect.MAV_CMD_NAV_LAND
COMMAND_RETURN = dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH
COMMAND_CAPABILITIES = dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES
COMMAND_GET_HOME, COMMAND_GET_INTERVAL = dialect.MAV_CMD_GET_HOME_POSITION, dialect.MAV_CMD_GET_MESSAGE_INTERVAL
COMMAND_SHUTDOWN = dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
COMMAND_INTERVAL, COMMAND_REQUEST = dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAV_CMD_REQUEST_MESSAGE
ACCEPTED, DENIED = dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_DENIED
UNSUPPORTED = dialect.MAV_RESULT_UNSUPPORTED

HEARTBEAT = dialect.MAVLINK_MSG_ID_HEARTBEAT
LOCAL_POSITION = dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED
GLOBAL_POSITION = dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
SETPOINT = dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED
COMMAND_LONG, COMMAND_INT = dialect.MAVLINK_MSG_ID_COMMAND_LONG, dialect.MAVLINK_MSG_ID_COMMAND_INT
TIMESYNC = dialect.MAVLINK_MSG_ID_TIMESYNC
AUTOPILOT_VERSION = dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION
HOME_POSITION = dialect.MAVLINK_MSG_ID_HOME_POSITION
EKF_STATUS = dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT
ESTIMATOR_STATUS = dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS
GLOBAL_ORIGIN = dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN
MESSAGE_INTERVAL = dialect.MAVLINK_MSG_ID_MESSAGE_INTERVAL

SETUP_SIGNING = dialect.MAVLINK_MSG_ID_SETUP_SIGNING
CRC_EXTRA: dict[int, bytes] = {
    number: bytes([known.crc_extra]) for number, known in dialect.mavlink_map.items() if number != SETUP_SIGNING
}
"""The CRC_EXTRA of accepted messages; SETUP_SIGNING is not one: no key is accepted from a link."""
_LOCAL_POSITION = dialect.MAVLink_local_position_ned_message
_SETPOINT = dialect.MAVLink_set_position_target_local_ned_message
_TIMESYNC = dialect.MAVLink_timesync_message
_DECODER = dialect.MAVLink(None)
_CAPABILITIES = (
    dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
)
_BYTEWISE = dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
_C_CAST = dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST


class Setpoint(NamedTuple):
    """SET_POSITION_TARGET_LOCAL_NED as it came; vectors are north, east, down."""

    time_boot_ms: int
    velocity_ned_m_s: tuple[float, float, float]
    acceleration_ned_m_s2: tuple[float, float, float]
    yaw_rad: float
    yaw_rate_rad_s: float
    type_mask: int
    target_system: int
    target_component: int
    frame: int


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


class Heartbeat(NamedTuple):
    """HEARTBEAT of another system."""

    vehicle_type: int


class Timesync(NamedTuple):
    """TIMESYNC; target_system is 0 if the sender named none."""

    tc1: int
    ts1: int
    target_system: int


Asked = Setpoint | Command | Request
"""A message that asks one vehicle for something."""
Message = Heartbeat | Timesync | Asked


def read_datagram(data: bytes, counters: Counter[str]) -> list[tuple[int, Message]]:
    """The messages of a datagram that a vehicle may act on, each with the system id of its source.

    Everything else is counted: `refused_empty`, `refused_mavlink1`, `refused_garbage` (no frame starts where one
    should), `refused_truncated`, `refused_incompatible` (unknown flags), `refused_unknown` (message id not in the
    dialect), `refused_setup_signing`, `refused_crc`, and `ignored_message` (valid, but nothing for a vehicle).
    """
    messages: list[tuple[int, Message]] = []
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


def in_version_1(frame: bytes) -> bytes:
    """Our own HEARTBEAT frame, converted to MAVLink 1."""
    size = dialect.MAVLink_heartbeat_message.unpacker.size
    payload = frame[HEADER_BYTES:-CHECKSUM_BYTES].ljust(size, b"\0")
    body = bytes([size, frame[4], frame[5], frame[6], HEARTBEAT]) + payload
    return bytes([MAGIC_1]) + body + mcrf4xx(body + CRC_EXTRA[HEARTBEAT]).to_bytes(2, "little")


def message_id(data: bytes) -> int:
    """Message id of a datagram's first frame, 0xFFFFFF if it has none."""
    return int.from_bytes(data[7:10], "little") if len(data) >= HEADER_BYTES and data[0] == MAGIC_2 else 0xFFFFFF


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


def _append(messages: list[tuple[int, Message]], frame: bytes, checked: int, counters: Counter[str]) -> None:
    """Decode one frame with a valid checksum; `checked` is the end of its payload."""
    number = frame[7] | frame[8] << 8 | frame[9] << 16
    # Most traffic is these two messages, so they are decoded without pymavlink's objects.
    if number == SETPOINT:
        values = _values(_SETPOINT.unpacker, frame, checked)
        messages.append((frame[5], Setpoint(values[0], values[4:7], values[7:10], *values[10:])))
    elif number == TIMESYNC:
        # The target is an extension field that this dialect does not have yet.
        target = frame[HEADER_BYTES + 16] if checked > HEADER_BYTES + 16 else 0
        tc1, ts1 = _values(_TIMESYNC.unpacker, frame, checked)
        messages.append((frame[5], Timesync(tc1, ts1, target)))
    elif number in (HEARTBEAT, COMMAND_LONG, COMMAND_INT):
        messages.append((frame[5], _decode(number, frame)))
    elif number in REQUESTS:
        messages.append((frame[5], request(number, (frame[5], frame[6]), frame[HEADER_BYTES:checked])))
    else:
        counters["ignored_message"] += 1


def _values(packing: struct.Struct, frame: bytes, checked: int) -> tuple[Any, ...]:
    """A payload's values in wire order, with the trailing zeros that are not sent, without extension fields."""
    size = packing.size
    if checked - HEADER_BYTES >= size:
        return packing.unpack_from(frame, HEADER_BYTES)
    return packing.unpack(frame[HEADER_BYTES:checked].ljust(size, b"\0"))


def _decode(number: int, frame: bytes) -> Message:
    decoded: Any = _DECODER.decode(bytearray(frame))
    if number == HEARTBEAT:
        return Heartbeat(decoded.type)
    long = number == COMMAND_LONG
    return Command(
        (frame[5], frame[6]),
        decoded.target_system,
        decoded.target_component,
        decoded.command,
        decoded.param1,
        decoded.param2,
        decoded.param3,
        *((decoded.param5, decoded.param6, decoded.param7) if long else (decoded.x, decoded.y, decoded.z)),
    )


class Encoder:
    """Makes one vehicle's frames, with sequence numbers in the order of the calls."""

    def __init__(self, system_id: int) -> None:
        self._pymavlink = dialect.MAVLink(None, srcSystem=system_id, srcComponent=COMPONENT_AUTOPILOT)

    def local_position(
        self,
        time_boot_ms: int,
        north_m: float,
        east_m: float,
        down_m: float,
        velocity_ne_m_s: tuple[float, float],
        velocity_down_m_s: float = 0.0,
    ) -> bytes:
        """LOCAL_POSITION_NED."""
        velocity = (*velocity_ne_m_s, velocity_down_m_s)
        payload = _LOCAL_POSITION.unpacker.pack(time_boot_ms, north_m, east_m, down_m, *velocity)
        return self.frame(LOCAL_POSITION, payload)

    def global_position(
        self,
        *,
        time_boot_ms: int,
        latitude_deg: float,
        longitude_deg: float,
        altitude_m: float,
        relative_altitude_m: float,
        velocity_ne_m_s: tuple[float, float],
        velocity_down_m_s: float = 0.0,
        heading_deg: float,
    ) -> bytes:
        """GLOBAL_POSITION_INT, with each value clipped to its field."""
        north, east = velocity_ne_m_s
        return self.pack(
            dialect.MAVLink_global_position_int_message(
                time_boot_ms,
                _clipped(latitude_deg * 1e7, 2**31 - 1),
                _clipped(longitude_deg * 1e7, 2**31 - 1),
                _clipped(altitude_m * 1e3, 2**31 - 1),
                _clipped(relative_altitude_m * 1e3, 2**31 - 1),
                _clipped(north * 1e2, 2**15 - 1),
                _clipped(east * 1e2, 2**15 - 1),
                _clipped(velocity_down_m_s * 1e2, 2**15 - 1),
                round(heading_deg * 1e2) % 36000,
            )
        )

    def heartbeat(
        self,
        base_mode: int,
        custom_mode: int,
        system_status: int,
        autopilot: int = dialect.MAV_AUTOPILOT_ARDUPILOTMEGA,
    ) -> bytes:
        """HEARTBEAT of a quadrotor, by default an ArduCopter."""
        return self.pack(
            dialect.MAVLink_heartbeat_message(
                dialect.MAV_TYPE_QUADROTOR,
                autopilot,
                base_mode,
                custom_mode,
                system_status,
                3,
            )
        )

    def timesync(self, tc1: int, ts1: int) -> bytes:
        """TIMESYNC, a request if tc1 is 0."""
        return self.frame(TIMESYNC, _TIMESYNC.unpacker.pack(tc1, ts1))

    def command_ack(self, command: int, result: int, requester: tuple[int, int]) -> bytes:
        """COMMAND_ACK to the (system, component) that asked."""
        return self.pack(
            dialect.MAVLink_command_ack_message(
                command, result, target_system=requester[0], target_component=requester[1]
            )
        )

    def statustext(self, severity: int, text: str) -> bytes:
        """STATUSTEXT in one chunk."""
        encoded = text.encode("ascii")
        assert len(encoded) <= 50
        return self.pack(dialect.MAVLink_statustext_message(severity, encoded))

    def autopilot_version(self, version: tuple[int, int, int], *, parameters_bytewise: bool) -> dialect.MAVLink_message:
        """AUTOPILOT_VERSION: capabilities, the version as a development version, and zeros for the rest."""
        major, minor, patch = version
        encoding = _BYTEWISE if parameters_bytewise else _C_CAST
        none: Sequence[int] = (0,) * 8
        uid = self._pymavlink.srcSystem
        return dialect.MAVLink_autopilot_version_message(
            _CAPABILITIES | encoding, major << 24 | minor << 16 | patch << 8, 0, 0, 0, none, none, none, 0, 0, uid
        )

    def home_position(
        self,
        latitude_deg: float,
        longitude_deg: float,
        altitude_m: float,
        local_ned_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> bytes:
        """HOME_POSITION, on the globe and in the local frame."""
        return self.pack(
            dialect.MAVLink_home_position_message(
                _clipped(latitude_deg * 1e7, 2**31 - 1),
                _clipped(longitude_deg * 1e7, 2**31 - 1),
                _clipped(altitude_m * 1e3, 2**31 - 1),
                *local_ned_m,
                (1.0, 0.0, 0.0, 0.0),
                *(0.0, 0.0, 0.0),
            )
        )

    def frame(self, number: int, payload: bytes) -> bytes:
        """The frame of a frequent message, without pymavlink's objects; `number` is below 256."""
        payload = payload.rstrip(b"\0") or b"\0"
        mav = self._pymavlink
        body = bytes((len(payload), 0, 0, mav.seq, mav.srcSystem, COMPONENT_AUTOPILOT, number, 0, 0)) + payload
        mav.seq = (mav.seq + 1) & 0xFF
        return b"\xfd" + body + mcrf4xx(body + CRC_EXTRA[number]).to_bytes(2, "little")

    def estimator_flags(self, message_id: int, time_us: int, flags: int) -> bytes:
        """EKF_STATUS_REPORT or ESTIMATOR_STATUS; the flags mean the same in both."""
        if message_id == EKF_STATUS:
            return self.pack(dialect.MAVLink_ekf_status_report_message(flags, *(0.1,) * 5))
        assert message_id == ESTIMATOR_STATUS
        return self.pack(dialect.MAVLink_estimator_status_message(time_us, flags, *(0.1,) * 8))

    def global_origin(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> bytes:
        """GPS_GLOBAL_ORIGIN: the origin of this vehicle's local frame."""
        degrees = _clipped(latitude_deg * 1e7, 2**31 - 1), _clipped(longitude_deg * 1e7, 2**31 - 1)
        return self.pack(dialect.MAVLink_gps_global_origin_message(*degrees, round(altitude_m * 1e3)))

    def pack(self, message: dialect.MAVLink_message) -> bytes:
        """The frame of any pymavlink message."""
        frame = message.pack(self._pymavlink)
        self._pymavlink.seq = (self._pymavlink.seq + 1) & 0xFF
        return frame


def _clipped(value: float, largest: int) -> int:
    return max(-largest, min(largest, round(value)))
