"""Requests of ground stations, as pymavlink decodes them, and the messages with which a vehicle answers and reports."""

import math
from typing import NamedTuple, get_args

from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_vehicles.services.earth import ORIGIN_ALTITUDE_M, ORIGIN_LATITUDE_DEG, ORIGIN_LONGITUDE_DEG
from sim_vehicles.services.frames import clipped

Message = dialect.MAVLink_message
ParameterList = dialect.MAVLink_param_request_list_message
ParameterRead = dialect.MAVLink_param_request_read_message
ParameterSet = dialect.MAVLink_param_set_message
TextRead = dialect.MAVLink_param_ext_request_read_message
"""The request for a parameter whose value is text."""
MissionList, MissionClear = dialect.MAVLink_mission_request_list_message, dialect.MAVLink_mission_clear_all_message
MissionCount = dialect.MAVLink_mission_count_message
MissionItem, MissionItemInt = dialect.MAVLink_mission_request_message, dialect.MAVLink_mission_request_int_message
FileTransfer = dialect.MAVLink_file_transfer_protocol_message
DataStream = dialect.MAVLink_request_data_stream_message
SetMode = dialect.MAVLink_set_mode_message
Mission = MissionList | MissionClear | MissionCount | MissionItem | MissionItemInt
"""A request about the items of a mission, a fence or the rally points."""
Request = ParameterList | ParameterRead | ParameterSet | TextRead | Mission | FileTransfer | DataStream | SetMode
REQUESTS = frozenset(kind.id for kind in get_args(Request))
"""Message ids of all requests."""

NAMED_INT = dialect.MAVLINK_MSG_ID_NAMED_VALUE_INT
REAL32, INT32 = dialect.MAV_PARAM_TYPE_REAL32, dialect.MAV_PARAM_TYPE_INT32
EKF_STATUS = dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT
SYS_STATUS, EXTENDED_SYS_STATE = dialect.MAVLINK_MSG_ID_SYS_STATUS, dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE
GPS_RAW, ATTITUDE = dialect.MAVLINK_MSG_ID_GPS_RAW_INT, dialect.MAVLINK_MSG_ID_ATTITUDE
BATTERY_STATUS, VFR_HUD = dialect.MAVLINK_MSG_ID_BATTERY_STATUS, dialect.MAVLINK_MSG_ID_VFR_HUD
EXTRA = (SYS_STATUS, EXTENDED_SYS_STATE, GPS_RAW, ATTITUDE, BATTERY_STATUS, VFR_HUD)
"""The messages that every vehicle can send besides its telemetry."""

_SENSORS = (
    dialect.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | dialect.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | dialect.MAV_SYS_STATUS_SENSOR_3D_MAG
    | dialect.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | dialect.MAV_SYS_STATUS_AHRS
    | dialect.MAV_SYS_STATUS_SENSOR_BATTERY
)
_ALL_SENSORS = _SENSORS | dialect.MAV_SYS_STATUS_SENSOR_GPS | dialect.MAV_SYS_STATUS_PREARM_CHECK
_GEOFENCE = dialect.MAV_SYS_STATUS_GEOFENCE
"""Stations report a fence breach if this bit is missing from the health, even where there is no fence."""
_CAPABILITIES = (
    dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
)
_BYTEWISE = dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
_C_CAST = dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
_FULL_MV, _UNKNOWN = 12_600, 0xFFFF
_INT16, _INT32 = 2**15 - 1, 2**31 - 1

_FTP_TERMINATE, _FTP_RESET, _FTP_ACK, _FTP_NAK = 1, 2, 128, 129
_FTP_OPENS = (3, 4, 14)
"""Opcodes that open something: list a directory, open a file for reading, compute a file's checksum."""
_FTP_FILE_NOT_FOUND, _FTP_UNKNOWN_COMMAND = 10, 7


def source(message: Message) -> tuple[int, int]:
    """The (system, component) that sent a message."""
    return message.get_srcSystem(), message.get_srcComponent()


def payload_of(message: Message) -> bytes:
    """The payload of a decoded message as received, without the trailing zeros that are not sent."""
    frame = bytes(message.get_msgbuf())
    return frame[dialect.HEADER_LEN_V2 : dialect.HEADER_LEN_V2 + frame[1]]


def parameter_error(message: ParameterRead | ParameterSet) -> Message:
    """PARAM_ERROR to all systems: there is no such parameter."""
    index = message.param_index if isinstance(message, ParameterRead) else -1
    name = message.param_id.encode("ascii", "replace")[:16]
    return dialect.MAVLink_param_error_message(0, 0, name, index, dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST)


def text_value(name: str, text: str) -> Message:
    """PARAM_EXT_VALUE of the one parameter whose value is text: up to 128 ASCII characters, the name up to 16."""
    kind = dialect.MAV_PARAM_EXT_TYPE_CUSTOM
    return dialect.MAVLink_param_ext_value_message(name.encode("ascii"), text.encode("ascii"), kind, 1, 0)


def mission_answer(request: Mission) -> Message:
    """The answer of a vehicle whose lists are empty, can be cleared, and accept no items."""
    if isinstance(request, MissionList):
        return MissionCount(*source(request), 0, request.mission_type)
    if isinstance(request, MissionClear) or (isinstance(request, MissionCount) and request.count == 0):
        result = dialect.MAV_MISSION_ACCEPTED
    elif isinstance(request, MissionCount):
        result = dialect.MAV_MISSION_UNSUPPORTED
    else:
        result = dialect.MAV_MISSION_INVALID_SEQUENCE
    return dialect.MAVLink_mission_ack_message(*source(request), result, request.mission_type)


def file_answer(request: FileTransfer) -> Message:
    """The answer of a vehicle without files: opening one fails, ending a session works, the rest is unknown."""
    payload = bytes(request.payload)
    number = int.from_bytes(payload[:2], "little") + 1
    session, asked = payload[2:4]
    if asked in (_FTP_TERMINATE, _FTP_RESET):
        result, data = _FTP_ACK, b""
    else:
        result, data = _FTP_NAK, bytes([_FTP_FILE_NOT_FOUND if asked in _FTP_OPENS else _FTP_UNKNOWN_COMMAND])
    header = (number & 0xFFFF).to_bytes(2, "little") + bytes([session, result, len(data), asked, 0, 0]) + bytes(4)
    return FileTransfer(0, *source(request), list((header + data).ljust(251, b"\0")))


def message_interval(number: int, interval_us: int) -> Message:
    return dialect.MAVLink_message_interval_message(number, interval_us)


def autopilot_version(version: tuple[int, int, int], uid: int, *, parameters_bytewise: bool) -> Message:
    """AUTOPILOT_VERSION: capabilities, the version as a development version, and zeros for the rest."""
    major, minor, patch = version
    capabilities = _CAPABILITIES | (_BYTEWISE if parameters_bytewise else _C_CAST)
    none = (0,) * 8
    return dialect.MAVLink_autopilot_version_message(
        capabilities, major << 24 | minor << 16 | patch << 8, 0, 0, 0, none, none, none, 0, 0, uid
    )


def home_position(
    place_deg: tuple[float, float] = (ORIGIN_LATITUDE_DEG, ORIGIN_LONGITUDE_DEG),
    local_ned_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Message:
    """HOME_POSITION on the ground: latitude and longitude, and position in the local frame."""
    place = *_degrees_e7(place_deg), clipped(ORIGIN_ALTITUDE_M * 1e3, _INT32)
    return dialect.MAVLink_home_position_message(*place, *local_ned_m, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0)


def estimator_flags(message_id: int, time_us: int, flags: int) -> Message:
    """EKF_STATUS_REPORT or ESTIMATOR_STATUS; the flags mean the same in both."""
    if message_id == EKF_STATUS:
        return dialect.MAVLink_ekf_status_report_message(flags, *(0.1,) * 5)
    return dialect.MAVLink_estimator_status_message(time_us, flags, *(0.1,) * 8)


def global_origin(place_deg: tuple[float, float], altitude_m: float) -> Message:
    """GPS_GLOBAL_ORIGIN: the origin of a vehicle's local frame."""
    return dialect.MAVLink_gps_global_origin_message(*_degrees_e7(place_deg), round(altitude_m * 1e3))


def position_target(
    boot_ms: int, mask: int, velocity_ned_m_s: tuple[float, float, float], acceleration_ne_m_s2: tuple[float, float]
) -> Message:
    """POSITION_TARGET_LOCAL_NED of a vehicle that steers to a velocity, an acceleration or both."""
    nowhere, yaw = (0.0, 0.0, 0.0), (0.0, 0.0)
    acceleration = *acceleration_ne_m_s2, 0.0
    return dialect.MAVLink_position_target_local_ned_message(
        boot_ms, dialect.MAV_FRAME_LOCAL_NED, mask, *nowhere, *velocity_ned_m_s, *acceleration, *yaw
    )


def named_int(boot_ms: int, name: str, value: int) -> Message:
    """NAMED_VALUE_INT; a value beyond 32 bits wraps, as times in ms do."""
    return dialect.MAVLink_named_value_int_message(boot_ms, name.encode("ascii"), (value + 2**31) % 2**32 - 2**31)


class Condition(NamedTuple):
    """A vehicle's state at one time, for GLOBAL_POSITION_INT and the messages of EXTRA."""

    time_boot_ms: int
    place_deg: tuple[float, float]
    """Latitude and longitude."""
    altitude_m: float
    """Above sea level."""
    velocity_ned_m_s: tuple[float, float, float]
    attitude_rad: tuple[float, float, float]
    """Roll, pitch, yaw."""
    flying: bool
    has_position: bool


def report(message_id: int, at: Condition) -> Message:
    """One of EXTRA; a value that does not fit its field is clipped."""
    north, east, down = at.velocity_ned_m_s
    speed_m_s, heading_deg = math.hypot(north, east), math.degrees(at.attitude_rad[2]) % 360.0
    # Without a position it sends zeros, as ArduPilot does.
    latitude, longitude = _degrees_e7(at.place_deg if at.has_position else (0.0, 0.0))
    altitude = clipped(at.altitude_m * 1e3, _INT32)
    if message_id == SYS_STATUS:  # the battery is always full
        health = _GEOFENCE | (_ALL_SENSORS if at.has_position else _SENSORS)
        present = _ALL_SENSORS
        return dialect.MAVLink_sys_status_message(present, present, health, 100, _FULL_MV, -1, 100, *(0,) * 6)
    if message_id == GPS_RAW:
        course = round(math.degrees(math.atan2(east, north)) % 360.0 * 100.0) % 36_000
        fix = [dialect.GPS_FIX_TYPE_NO_FIX, 0, 0, 0, *[_UNKNOWN] * 4, 0]
        if at.has_position:
            speed = min(_UNKNOWN - 1, round(speed_m_s * 100.0))
            fix = [dialect.GPS_FIX_TYPE_3D_FIX, latitude, longitude, altitude, 80, 120, speed, course, 12]
        return dialect.MAVLink_gps_raw_int_message(at.time_boot_ms * 1000, *fix)
    landed = dialect.MAV_LANDED_STATE_IN_AIR if at.flying else dialect.MAV_LANDED_STATE_ON_GROUND
    hud = speed_m_s, speed_m_s, round(heading_deg) % 360, 50, at.altitude_m, -down
    voltages = (_FULL_MV, *(_UNKNOWN,) * 9)
    others = {
        ATTITUDE: lambda: dialect.MAVLink_attitude_message(at.time_boot_ms, *at.attitude_rad, 0.0, 0.0, 0.0),
        BATTERY_STATUS: lambda: dialect.MAVLink_battery_status_message(0, 0, 0, _INT16, voltages, -1, -1, -1, 100),
        EXTENDED_SYS_STATE: lambda: dialect.MAVLink_extended_sys_state_message(0, landed),  # no VTOL
        VFR_HUD: lambda: dialect.MAVLink_vfr_hud_message(*hud),
    }
    return others[message_id]()


def _degrees_e7(place_deg: tuple[float, float]) -> tuple[int, int]:
    latitude_deg, longitude_deg = place_deg
    return clipped(latitude_deg * 1e7, _INT32), clipped(longitude_deg * 1e7, _INT32)
