"""The station's MAVLink codec and pymavlink's, timed on the same frames."""

import time  # noqa: TID251 - run time is what is measured; nothing flown depends on it
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.link import mavlink

_FRAMES = 250
_REPEATS = 20


class Seconds(NamedTuple):
    """The run time of the same work by the station and by pymavlink."""

    ours: float
    theirs: float


def position_frames(count: int) -> list[bytes]:
    """One LOCAL_POSITION_NED of each of `count` vehicles in flight; no byte of it is omitted as a trailing zero."""
    states = [(1000 + k, 100.5 * k, -3.25 * k, -1000.0, 91.44, 0.125, -0.5) for k in range(count)]
    position = mavlink.LOCAL_POSITION_NED
    return [mavlink.encode(position, state, sequence=0, system_id=k + 1) for k, state in enumerate(states)]


def pymavlink_parse_s(frames: Sequence[bytes]) -> float:
    """The time that pymavlink's parser takes for the frames, each a datagram of its own."""
    parser: Any = dialect.MAVLink(None)
    return _taken_s(lambda: [parser.parse_char(frame) for frame in frames])


def decode_s() -> Seconds:
    """The time to decode one LOCAL_POSITION_NED and verify its checksum: the least of several runs."""
    frames, refused = position_frames(_FRAMES), Counter[str]()
    return _least(
        lambda: _taken_s(lambda: [mavlink.decode(frame, refused) for frame in frames]),
        lambda: pymavlink_parse_s(frames),
    )


def encode_s() -> Seconds:
    """The time to encode one set-point, SET_POSITION_TARGET_LOCAL_NED: the least of several runs."""
    packer: Any = dialect.MAVLink(None, mavlink.STATION_SYSTEM_ID, mavlink.STATION_COMPONENT_ID)
    return _least(
        lambda: _taken_s(lambda: [station_set_point(k) for k in range(_FRAMES)]),
        lambda: _taken_s(lambda: [pymavlink_set_point(packer, k) for k in range(_FRAMES)]),
    )


def station_set_point(key_ms: int) -> bytes:
    """A set-point with an acceleration only, by the station."""
    fields = mavlink.acceleration_set_point(key_ms=key_ms, target_system=1, north_m_s2=0.5, east_m_s2=-0.25)
    return mavlink.encode(mavlink.SET_POSITION_TARGET_LOCAL_NED, fields, sequence=0)


def pymavlink_set_point(packer: Any, key_ms: int) -> bytes:
    """The same set-point by pymavlink."""
    numbers = key_ms, 1, 1, dialect.MAV_FRAME_LOCAL_NED, mavlink.IGNORE_ALL_BUT_ACCELERATION
    fields = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5, -0.25, 0.0, 0.0, 0.0
    return dialect.MAVLink_set_position_target_local_ned_message(*numbers, *fields).pack(packer)


def _taken_s(work: Callable[[], object]) -> float:
    begun_s = time.perf_counter()
    work()
    return time.perf_counter() - begun_s


def _least(ours: Callable[[], float], theirs: Callable[[], float]) -> Seconds:
    """The least time a frame of each, measured in turn, so that a busy machine slows both."""
    taken = [Seconds(ours(), theirs()) for _ in range(_REPEATS)]
    return Seconds(min(each.ours for each in taken) / _FRAMES, min(each.theirs for each in taken) / _FRAMES)
