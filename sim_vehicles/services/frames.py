"""Reads and writes MAVLink 2 frames of the frequent messages in place, as bytes in arrays of uint8.

All numbers are little-endian. A payload's trailing zeros are not sent.
"""

import math

import numpy as np
from numpy.typing import NDArray

from scenarios.kernel import Record, int64, kernel
from sim_vehicles.services.earth import ORIGIN_ALTITUDE_M

HEARTBEAT, PARAMETER_VALUE, LOCAL_POSITION, GLOBAL_POSITION, SETPOINT, TIMESYNC = 0, 22, 32, 33, 84, 111
EXTRA = {
    HEARTBEAT: 50, PARAMETER_VALUE: 220, LOCAL_POSITION: 185, GLOBAL_POSITION: 104, SETPOINT: 143, TIMESYNC: 34
}  # fmt: skip
"""CRC_EXTRA of each of these messages."""
FRAME_BYTES = 280
"""The longest frame: 10 bytes of header, 255 of payload, 2 of checksum, 13 of signature."""
PAYLOAD = 10
"""Where a frame's payload begins."""
NONE = -1
NO_MESSAGE = 0xFFFFFF
UINT32 = 0xFFFFFFFF
AUTOPILOT, STATION_TYPE, LOCAL_NED, ARDUPILOT = 1, 6, 1, 3
"""MAV_COMP_ID_AUTOPILOT1, MAV_TYPE_GCS, MAV_FRAME_LOCAL_NED, MAV_AUTOPILOT_ARDUPILOTMEGA."""
INT32, INT16 = 2**31 - 1, 2**15 - 1
_MAGIC = 0xFD
_QUADROTOR, _VERSION = 2, 3
_CUSTOM_MODE, _ARMED, _GUIDED = 1, 128, 8
_STANDBY, _ACTIVE, _CRITICAL = 3, 4, 5

Frame = NDArray[np.uint8]


def _crc_tables() -> NDArray[np.uint16]:
    """Tables for slicing by four: the CRC of each byte followed by 0 to 3 zero bytes; only four, to compile fast."""
    remainder, tables = np.arange(256), []
    for _ in range(4):
        for _ in range(8):
            remainder = remainder >> 1 ^ 0x8408 * (remainder & 1)
        tables.append(remainder)
    return np.array(tables, np.uint16)


_CRC = _crc_tables()
_EXTRAS = np.array([EXTRA.get(number, NONE) for number in range(256)])


# Numba recompiles a kernel for every constant argument, so the kernels below get none where that can be avoided.


@kernel
def checksum(frame: Frame, end: int, extra: int) -> int:
    """CRC-16/MCRF4XX of a frame from its second byte to the end of its payload, followed by its CRC_EXTRA."""
    crc, k = 0xFFFF, 1
    while k + 4 <= end:
        # four independent table look-ups, which a processor does in parallel
        low, high = (crc ^ frame[k]) & 0xFF, (crc >> 8 ^ frame[k + 1]) & 0xFF
        crc = int64(_CRC[3, low] ^ _CRC[2, high] ^ _CRC[1, frame[k + 2]] ^ _CRC[0, frame[k + 3]])
        k += 4
    while k < end:
        crc = crc >> 8 ^ _CRC[0, (crc ^ frame[k]) & 0xFF]
        k += 1
    return crc >> 8 ^ _CRC[0, (crc ^ extra) & 0xFF]


@kernel
def frequent_message(frame: Frame, size: int) -> int:
    """The message id of a datagram that holds one valid unsigned frame of a frequent message; NONE for any other."""
    if not PAYLOAD + 2 < size <= FRAME_BYTES or frame[0] != _MAGIC or frame[1] != size - PAYLOAD - 2 or frame[2] != 0:
        return NONE
    extra, end = _EXTRAS[int(frame[7])], size - 2
    if extra == NONE or frame[8] != 0 or frame[9] != 0 or checksum(frame, end, extra) != read_uint16(frame, end):
        return NONE
    return int(frame[7])


@kernel
def first_message(data: Frame, size: int) -> int:
    """The message id of a datagram's first frame; NO_MESSAGE if it has none."""
    if size < PAYLOAD or data[0] != _MAGIC:
        return NO_MESSAGE
    return int(data[7]) | int(data[8]) << 8 | int(data[9]) << 16


@kernel
def read_uint16(frame: Frame, at: int) -> int:
    return int(frame[at]) | int(frame[at + 1]) << 8


@kernel
def read_int64(frame: Frame, at: int, count: int) -> int:
    """An integer of `count` bytes; the bytes that were not sent are zero."""
    value = 0
    for k in range(count):
        value |= int(frame[at + k]) << 8 * k
    return value


@kernel
def read_float(frame: Frame, at: int) -> float:
    bits = read_uint16(frame, at) | read_uint16(frame, at + 2) << 16
    return float(np.uint32(bits).view(np.float32))


@kernel
def _put_int(frame: Frame, at: int, count: int, value: int) -> None:
    for k in range(count):
        frame[at + k] = value >> 8 * k & 0xFF


@kernel
def _put_float(frame: Frame, at: int, value: float) -> None:
    _put_int(frame, at, 4, int(np.int64(np.float32(value).view(np.uint32))))


@kernel
def finish(vehicle: Record, frame: Frame) -> int:
    """Complete the next frame of a frequent message, which already has its message id, payload and payload size.

    Returns the size of the frame.
    """
    size = int(frame[1])
    while size > 1 and frame[PAYLOAD + size - 1] == 0:
        size -= 1
    end = PAYLOAD + size
    frame[0], frame[1], frame[2], frame[3] = _MAGIC, size, 0, 0
    frame[4], frame[5], frame[6] = vehicle.sequence, vehicle.wire_id, AUTOPILOT
    frame[8], frame[9] = 0, 0
    vehicle.sequence = (vehicle.sequence + 1) & 0xFF
    crc = checksum(frame, end, _EXTRAS[int(frame[7])])
    frame[end], frame[end + 1] = crc & 0xFF, crc >> 8
    return end + 2


@kernel
def local_position(
    vehicle: Record, frame: Frame, boot_ms: int, north: float, east: float, down: float,
    v_north: float, v_east: float, v_down: float,
) -> int:  # fmt: skip
    """Make a LOCAL_POSITION_NED in m and m/s; returns its size."""
    _put_int(frame, PAYLOAD + 0, 4, boot_ms & UINT32)
    _put_float(frame, PAYLOAD + 4, north)
    _put_float(frame, PAYLOAD + 8, east)
    _put_float(frame, PAYLOAD + 12, down)
    _put_float(frame, PAYLOAD + 16, v_north)
    _put_float(frame, PAYLOAD + 20, v_east)
    _put_float(frame, PAYLOAD + 24, v_down)
    frame[1], frame[7] = 28, LOCAL_POSITION
    return finish(vehicle, frame)


@kernel
def global_position(
    vehicle: Record, frame: Frame, boot_ms: int, latitude_deg: float, longitude_deg: float, altitude_m: float,
    v_north: float, v_east: float, v_down: float, yaw_rad: float,
) -> int:  # fmt: skip
    """Make a GLOBAL_POSITION_INT; returns its size. A value that does not fit its field is clipped."""
    _put_int(frame, PAYLOAD + 0, 4, boot_ms & UINT32)
    _put_int(frame, PAYLOAD + 4, 4, clipped(latitude_deg * 1e7, INT32))
    _put_int(frame, PAYLOAD + 8, 4, clipped(longitude_deg * 1e7, INT32))
    _put_int(frame, PAYLOAD + 12, 4, clipped(altitude_m * 1e3, INT32))
    _put_int(frame, PAYLOAD + 16, 4, clipped((altitude_m - ORIGIN_ALTITUDE_M) * 1e3, INT32))
    _put_int(frame, PAYLOAD + 20, 2, clipped(v_north * 1e2, INT16))
    _put_int(frame, PAYLOAD + 22, 2, clipped(v_east * 1e2, INT16))
    _put_int(frame, PAYLOAD + 24, 2, clipped(v_down * 1e2, INT16))
    _put_int(frame, PAYLOAD + 26, 2, round(math.degrees(yaw_rad) % 360.0 * 1e2) % 36_000)
    frame[1], frame[7] = 28, GLOBAL_POSITION
    return finish(vehicle, frame)


@kernel
def clipped(value: float, largest: int) -> int:
    """The value rounded to a whole number and clipped to ± `largest`."""
    return max(-largest, min(largest, round(value)))


@kernel
def heartbeat(
    vehicle: Record, frame: Frame, mode: int, autopilot: int, armed: bool, guided: bool, flying: bool, critical: bool
) -> int:
    """Make a HEARTBEAT of a quadrotor; returns its size."""
    _put_int(frame, PAYLOAD + 0, 4, mode)
    frame[PAYLOAD + 4], frame[PAYLOAD + 5] = _QUADROTOR, autopilot
    frame[PAYLOAD + 6] = _CUSTOM_MODE | (_ARMED if armed else 0) | (_GUIDED if guided else 0)
    frame[PAYLOAD + 7] = _CRITICAL if critical else _ACTIVE if flying else _STANDBY
    frame[PAYLOAD + 8] = _VERSION
    frame[1], frame[7] = 9, HEARTBEAT
    return finish(vehicle, frame)


@kernel
def timesync(vehicle: Record, frame: Frame, tc1: int, ts1: int) -> int:
    """Make a TIMESYNC, a request if tc1 is 0; returns its size."""
    _put_int(frame, PAYLOAD + 0, 8, tc1)
    _put_int(frame, PAYLOAD + 8, 8, ts1)
    frame[1], frame[7] = 16, TIMESYNC
    return finish(vehicle, frame)
