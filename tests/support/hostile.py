"""Hostile bytes from a seed, for the tests that fire at parsers and at flights.

Noise, frames of the flight that were broken, frames of any message with any content, and frames whose numbers are the
worst that fit: NaN, infinities, ends of ranges, and here and there what a vehicle or a station would really say.
"""

import math
import re
import struct
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import ardupilotmega as dialect

MESSAGES: dict[int, Any] = dict(sorted(dialect.mavlink_map.items()))
SAID_BY_VEHICLES = [0, 1, 22, 24, 32, 33, 49, 77, 111, 148, 193, 230, 242, 245, 253]
SAID_BY_STATIONS = [0, 11, 20, 21, 23, 40, 43, 44, 45, 51, 66, 75, 76, 84, 110, 111]
TO_VEHICLES = {0, 11, 23, 66, 75, 76, 84, 111}
"""HEARTBEAT, SET_MODE, PARAM_SET, REQUEST_DATA_STREAM, COMMAND_INT and _LONG, set-points, TIMESYNC: a vehicle may take
these from its station."""
_COMMANDS = [16, 20, 21, 22, 176, 183, 400, 410, 510, 511, 512, 519, 520]
_REALS = (math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 1e-45, 0.0, -0.0, 1.0, -1.0, 4.0, 1e9, 1e10, 20_000.0)
_Value = TypeVar("_Value")
_ALL = list(MESSAGES)
_TEXTS = [b"", b"\xff" * 16, b"FORM_KP_NN", b"GUID_TIMEOUT", b"MIS_TAKEOFF_ALT", b"refused: \xf0\x28", b"a\0b"]
_MAGIC = re.compile(b"[\xfd\xfe]")
_FIELD = re.compile(r"(\d*)([a-zA-Z])")
_WIDTH = {"b": 8, "h": 16, "i": 32, "q": 64}


def any_message(rng: np.random.Generator, count: int, system_ids: list[int], left_out: set[int]) -> list[bytes]:
    """Frames of any message except those left out, with any content and length, and a correct checksum."""
    messages = [number for number in MESSAGES if number not in left_out]
    lengths = rng.integers(0, 256, size=count).tolist()
    sources = rng.choice(system_ids, size=count).tolist()
    noise = rng.bytes(256 * count)
    return [
        frame_of(number, noise[256 * k : 256 * k + lengths[k]], sources[k], k)
        for k, number in enumerate(rng.choice(messages, size=count).tolist())
    ]


def extreme(
    rng: np.random.Generator, count: int, messages: list[int], *, source: int, targets: list[int]
) -> list[bytes]:
    """Frames of these messages, now and then of another, from one system, whose fields hold the worst that fits."""
    frames: list[bytes] = []
    for k in range(count):
        message = MESSAGES[_one_of(rng, messages if rng.random() < 0.9 else _ALL)]
        values: list[Any] = []
        for name, (times, letter) in zip(
            message.ordered_fieldnames, _FIELD.findall(message.unpacker.format), strict=True
        ):
            if letter == "s":
                values.append(_one_of(rng, _TEXTS) if rng.random() < 0.5 else rng.bytes(int(times)))
            else:
                values += [_worst(rng, name, letter, targets) for _ in range(int(times or 1))]
        frames.append(frame_of(message.id, message.unpacker.pack(*values).rstrip(b"\0") or b"\0", source, k))
    return frames


def _worst(rng: np.random.Generator, name: str, letter: str, targets: list[int]) -> float | int:
    """A value for a field: that of a plausible message now and then, so that what is checked first lets it pass."""
    if letter in "fd":
        return _one_of(rng, _REALS) if rng.random() < 0.9 else float(rng.normal() * 1e3)
    if name == "target_system":
        return _one_of(rng, targets)
    if name == "command":
        return _one_of(rng, _COMMANDS)
    bits = _WIDTH[letter.lower()]
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if letter.islower() else (0, 2**bits - 1)
    return _one_of(rng, (low, 0, 0, 0, 1, 1, 1, 4, high - 1, high))


def _one_of(rng: np.random.Generator, values: Sequence[_Value]) -> _Value:
    return values[int(rng.integers(len(values)))]


def changed(rng: np.random.Generator, count: int, real: list[bytes]) -> list[bytes]:
    """Real frames with a byte changed, cut short, with bytes put in or written over, or with another glued behind."""
    places = rng.random(size=count).tolist()
    picks = rng.integers(len(real), size=(count, 2)).tolist()
    noise = rng.bytes(8 * count)
    out: list[bytes] = []
    for k, (one, two) in enumerate(picks):
        frame, own = real[one], noise[8 * k : 8 * k + 8]
        at = int(places[k] * len(frame))
        broken = frame[:at] + bytes([frame[at] ^ (own[0] or 1)]) + frame[at + 1 :]
        glued = broken + real[two][: int(places[k] * len(real[two]))]
        ways = (broken, frame[:at], frame[:at] + own + frame[at:], frame[:at] + own + frame[at + 8 :], glued)
        out.append(ways[k % 5])
    return [data for data in out if not holds_a_frame(data)]


def noise(rng: np.random.Generator, count: int) -> list[bytes]:
    """Random bytes, 0 to 300, often few; half begin as a frame of MAVLink 1 or 2 does, and some end as one begins."""
    lengths = (300 * rng.random(size=count) ** 3).astype(int).tolist()
    whole, starts, ends = rng.bytes(300 * count), (b"", b"\xfd", b"", b"\xfe"), (b"", b"", b"", b"\xfe", b"\xfd")
    out = [starts[k % 4] + whole[300 * k : 300 * k + length] + ends[k % 5] for k, length in enumerate(lengths)]
    return [data for data in out if not holds_a_frame(data)]


def holds_a_frame(data: bytes) -> bool:
    """Whether a valid MAVLink frame begins anywhere: one change in 65,536 happens to leave the checksum right."""
    for magic in _MAGIC.finditer(data):
        at = magic.start()
        header, number = (10, data[at + 7 : at + 10]) if data[at] == 0xFD else (6, data[at + 5 : at + 6])
        message = MESSAGES.get(int.from_bytes(number, "little"))
        if message is None or at + header >= len(data):
            continue
        end = at + header + data[at + 1]
        if end + 2 <= len(data):
            checksum = mcrf4xx(data[at + 1 : end] + bytes([message.crc_extra]))
            if checksum == int.from_bytes(data[end : end + 2], "little"):
                return True
    return False


def frame_of(number: int, payload: bytes, source: int, sequence: int, *, component: int = 1) -> bytes:
    """An unsigned MAVLink 2 frame."""
    header = bytes([len(payload), 0, 0, sequence & 0xFF, source, component]) + number.to_bytes(3, "little")
    body = header + payload
    return b"\xfd" + body + mcrf4xx(body + bytes([MESSAGES[number].crc_extra])).to_bytes(2, "little")


def timesync_reply(tc1_ns: int, ts1_ns: int, source: int, sequence: int) -> bytes:
    """A vehicle's answer to a request of TIMESYNC."""
    return frame_of(111, struct.pack("<qq", tc1_ns, ts1_ns), source, sequence)


def in_version_1(frame: bytes) -> bytes:
    """An unsigned MAVLink 2 frame of a message that MAVLink 1 has, as a MAVLink 1 frame."""
    message = MESSAGES[frame[7]]
    body = bytes([message.unpacker.size, frame[4], frame[5], frame[6], frame[7]])
    body += frame[10:-2][: message.unpacker.size].ljust(message.unpacker.size, b"\0")
    return b"\xfe" + body + mcrf4xx(body + bytes([message.crc_extra])).to_bytes(2, "little")
