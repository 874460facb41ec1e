"""Requests of ground stations for parameters, missions, files and streams, typed; and the messages that answer them."""

import struct
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

PARAMETER_READ = dialect.MAVLINK_MSG_ID_PARAM_REQUEST_READ
PARAMETER_LIST = dialect.MAVLINK_MSG_ID_PARAM_REQUEST_LIST
PARAMETER_VALUE = dialect.MAVLINK_MSG_ID_PARAM_VALUE
PARAMETER_SET = dialect.MAVLINK_MSG_ID_PARAM_SET
TEXT_READ = dialect.MAVLINK_MSG_ID_PARAM_EXT_REQUEST_READ
REAL32, INT32 = dialect.MAV_PARAM_TYPE_REAL32, dialect.MAV_PARAM_TYPE_INT32
DOES_NOT_EXIST = dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST
BY_NAME = -1
"""PARAM_REQUEST_READ.param_index of a request by name."""

MISSION_LIST, MISSION_COUNT = dialect.MAVLINK_MSG_ID_MISSION_REQUEST_LIST, dialect.MAVLINK_MSG_ID_MISSION_COUNT
MISSION_ITEM, MISSION_ITEM_INT = dialect.MAVLINK_MSG_ID_MISSION_REQUEST, dialect.MAVLINK_MSG_ID_MISSION_REQUEST_INT
MISSION_CLEAR = dialect.MAVLINK_MSG_ID_MISSION_CLEAR_ALL
MISSION_ACCEPTED, MISSION_UNSUPPORTED = dialect.MAV_MISSION_ACCEPTED, dialect.MAV_MISSION_UNSUPPORTED
MISSION_NO_ITEM = dialect.MAV_MISSION_INVALID_SEQUENCE

FILE_TRANSFER = dialect.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL
DATA_STREAM = dialect.MAVLINK_MSG_ID_REQUEST_DATA_STREAM
SET_MODE = dialect.MAVLINK_MSG_ID_SET_MODE

SYS_STATUS, EXTENDED_SYS_STATE = dialect.MAVLINK_MSG_ID_SYS_STATUS, dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE
GPS_RAW, ATTITUDE = dialect.MAVLINK_MSG_ID_GPS_RAW_INT, dialect.MAVLINK_MSG_ID_ATTITUDE
BATTERY_STATUS, VFR_HUD = dialect.MAVLINK_MSG_ID_BATTERY_STATUS, dialect.MAVLINK_MSG_ID_VFR_HUD
ON_GROUND, IN_AIR = dialect.MAV_LANDED_STATE_ON_GROUND, dialect.MAV_LANDED_STATE_IN_AIR

SENSORS = (
    dialect.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | dialect.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | dialect.MAV_SYS_STATUS_SENSOR_3D_MAG
    | dialect.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | dialect.MAV_SYS_STATUS_AHRS
    | dialect.MAV_SYS_STATUS_SENSOR_BATTERY
)
POSITION_SENSORS = dialect.MAV_SYS_STATUS_SENSOR_GPS | dialect.MAV_SYS_STATUS_PREARM_CHECK
GEOFENCE = dialect.MAV_SYS_STATUS_GEOFENCE
"""Stations report a fence breach if this bit is missing from the health, even where there is no fence."""

# The value as four bytes: an integer sent bytewise may look like a NaN, which a float may not preserve.
_PARAMETER_VALUE = struct.Struct("<4sHH16sB")
Message = dialect.MAVLink_message
LARGEST = 2**31 - 1
_LAYOUTS = {
    PARAMETER_LIST: dialect.MAVLink_param_request_list_message.unpacker,
    PARAMETER_READ: dialect.MAVLink_param_request_read_message.unpacker,
    PARAMETER_SET: struct.Struct("<4sBB16sB"),
    TEXT_READ: dialect.MAVLink_param_ext_request_read_message.unpacker,
    MISSION_LIST: dialect.MAVLink_mission_request_list_message.unpacker,
    MISSION_COUNT: dialect.MAVLink_mission_count_message.unpacker,
    MISSION_ITEM: dialect.MAVLink_mission_request_message.unpacker,
    MISSION_ITEM_INT: dialect.MAVLink_mission_request_int_message.unpacker,
    MISSION_CLEAR: dialect.MAVLink_mission_clear_all_message.unpacker,
    FILE_TRANSFER: struct.Struct("<BBB251s"),
    DATA_STREAM: dialect.MAVLink_request_data_stream_message.unpacker,
    SET_MODE: dialect.MAVLink_set_mode_message.unpacker,
}
REQUESTS = frozenset(_LAYOUTS)
"""Ids of the messages that are requests."""


class ParameterList(NamedTuple):
    """PARAM_REQUEST_LIST."""

    target_system: int
    target_component: int


class ParameterRead(NamedTuple):
    """PARAM_REQUEST_READ; `number` is the index, or BY_NAME."""

    target_system: int
    target_component: int
    number: int
    name: str


class ParameterSet(NamedTuple):
    """PARAM_SET, with the value as its four bytes."""

    target_system: int
    target_component: int
    name: str
    value: bytes
    kind: int
    """MAV_PARAM_TYPE"""


class TextRead(NamedTuple):
    """PARAM_EXT_REQUEST_READ of a parameter whose value is text."""

    target_system: int
    target_component: int
    name: str


class Mission(NamedTuple):
    """A request about the items of a mission, a fence or the rally points, by its message id."""

    source: tuple[int, int]
    target_system: int
    target_component: int
    asked: int
    number: int
    """How many items the station wants to send; 0 in the other requests."""
    kind: int
    """MAV_MISSION_TYPE"""


class FileTransfer(NamedTuple):
    """FILE_TRANSFER_PROTOCOL."""

    source: tuple[int, int]
    target_system: int
    target_component: int
    payload: bytes


class DataStream(NamedTuple):
    """REQUEST_DATA_STREAM: a group of messages at a rate, in Hz, 0 to stop."""

    target_system: int
    target_component: int
    stream: int
    rate_hz: int


class SetMode(NamedTuple):
    """SET_MODE, which is not acknowledged."""

    target_system: int
    target_component: int
    base_mode: int
    custom_mode: int


Request = ParameterList | ParameterRead | ParameterSet | TextRead | Mission | FileTransfer | DataStream | SetMode


def request(number: int, source: tuple[int, int], payload: bytes) -> Request:
    """The typed request in a payload of one of REQUESTS; trailing zeros may be missing."""
    layout = _LAYOUTS[number]
    values = layout.unpack(payload[: layout.size].ljust(layout.size, b"\0"))
    asked: Request
    if number == PARAMETER_LIST:
        asked = ParameterList(*values)
    elif number == PARAMETER_READ:
        index, system, component, name = values
        asked = ParameterRead(system, component, index, _name(name))
    elif number == PARAMETER_SET:
        value, system, component, name, kind = values
        asked = ParameterSet(system, component, _name(name), value, kind)
    elif number == TEXT_READ:
        _, system, component, name = values
        asked = TextRead(system, component, _name(name))
    elif number == FILE_TRANSFER:
        asked = FileTransfer(source, *values[1:])
    elif number == DATA_STREAM:
        rate_hz, system, component, stream, start = values
        asked = DataStream(system, component, stream, rate_hz if start else 0)
    elif number == SET_MODE:
        custom_mode, system, base_mode = values
        asked = SetMode(system, 0, base_mode, custom_mode)
    else:
        *first, system, component, kind = values
        asked = Mission(source, system, component, number, first[0] if number == MISSION_COUNT else 0, kind)
    return asked


def parameter_value(name: str, value: bytes, kind: int, index: int, count: int) -> bytes:
    """The payload of PARAM_VALUE, with the value as its four bytes."""
    return _PARAMETER_VALUE.pack(value, count, index, name.encode("ascii"), kind)


def parameter_error(message: ParameterRead | ParameterSet, error: int) -> Message:
    """PARAM_ERROR, addressed to all systems."""
    index = message.number if isinstance(message, ParameterRead) else BY_NAME
    return dialect.MAVLink_param_error_message(0, 0, message.name.encode("ascii", "replace")[:16], index, error)


def message_interval(number: int, interval_us: int) -> Message:
    """MESSAGE_INTERVAL."""
    return dialect.MAVLink_message_interval_message(number, interval_us)


def text_value(name: str, text: str) -> Message:
    """PARAM_EXT_VALUE of the one parameter whose value is text."""
    kind = dialect.MAV_PARAM_EXT_TYPE_CUSTOM
    return dialect.MAVLink_param_ext_value_message(name.encode("ascii"), text.encode("ascii"), kind, 1, 0)


def mission_count(message: Mission) -> Message:
    """MISSION_COUNT of a list without items."""
    return dialect.MAVLink_mission_count_message(*message.source, 0, message.kind)


def mission_ack(message: Mission, result: int) -> Message:
    """MISSION_ACK."""
    return dialect.MAVLink_mission_ack_message(*message.source, result, message.kind)


def file_transfer(message: FileTransfer, payload: bytes) -> Message:
    """FILE_TRANSFER_PROTOCOL, to the system that asked."""
    return dialect.MAVLink_file_transfer_protocol_message(0, *message.source, list(payload.ljust(251, b"\0")))


def sys_status(*, has_position: bool) -> Message:
    """SYS_STATUS of a vehicle with healthy sensors and a battery that is always full."""
    present = SENSORS | POSITION_SENSORS
    health = GEOFENCE | (present if has_position else SENSORS)
    return dialect.MAVLink_sys_status_message(present, present, health, 100, 12_600, -1, 100, *(0,) * 6)


def extended_sys_state(landed: int) -> Message:
    """EXTENDED_SYS_STATE of a vehicle that is no VTOL."""
    return dialect.MAVLink_extended_sys_state_message(dialect.MAV_VTOL_STATE_UNDEFINED, landed)


def battery_status() -> Message:
    """BATTERY_STATUS: always full."""
    unknown = 0xFFFF
    voltages = (12_600, *(unknown,) * 9)
    return dialect.MAVLink_battery_status_message(0, 0, 0, 0x7FFF, voltages, -1, -1, -1, 100)


def gps_raw(
    time_us: int, place_deg: tuple[float, float], altitude_m: float, speed_m_s: float, course_deg: float, *, fix: bool
) -> Message:
    """GPS_RAW_INT; without a fix it has no place. What does not fit a field is cut to its largest value."""
    if not fix:
        return dialect.MAVLink_gps_raw_int_message(
            time_us, dialect.GPS_FIX_TYPE_NO_FIX, 0, 0, 0, *(0xFFFF,) * 4, satellites_visible=0
        )
    wanted = place_deg[0] * 1e7, place_deg[1] * 1e7, altitude_m * 1e3
    latitude, longitude, altitude = (max(-LARGEST, min(LARGEST, round(value))) for value in wanted)
    speed = min(0xFFFE, round(speed_m_s * 100.0))
    return dialect.MAVLink_gps_raw_int_message(
        time_us,
        dialect.GPS_FIX_TYPE_3D_FIX,
        latitude,
        longitude,
        altitude,
        80,
        120,
        speed,
        round(course_deg * 100.0) % 36_000,
        12,
    )


def attitude(time_boot_ms: int, attitude_rad: tuple[float, float, float]) -> Message:
    """ATTITUDE, with roll, pitch and yaw; rates are not known."""
    return dialect.MAVLink_attitude_message(time_boot_ms, *attitude_rad, 0.0, 0.0, 0.0)


def vfr_hud(speed_m_s: float, heading_deg: float, altitude_m: float, climb_m_s: float) -> Message:
    """VFR_HUD, without wind."""
    return dialect.MAVLink_vfr_hud_message(speed_m_s, speed_m_s, round(heading_deg) % 360, 50, altitude_m, climb_m_s)


def _name(field: bytes) -> str:
    """A parameter's name; one of 16 characters has no terminating zero."""
    return field.partition(b"\0")[0].decode("ascii", "replace")
