"""Reads telemetry logs (.tlog) of any tool: a sequence of big-endian µs since 1970, each with a MAVLink 1 or 2 frame.

Damaged parts are skipped and counted; reading resumes at the next frame with a good checksum.
"""

import re
import struct
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gcs.errors import InputError, usable
from gcs.link import mavlink
from gcs.link.clocks import LATEST_NS

_STAMP = struct.Struct(">Q")
_MAGIC = re.compile(b"[\xfd\xfe]")
_WRONG_STAMP_US = 1_000_000
"""A stamp this far from its neighbours is taken as wrong. The checksum does not cover stamps."""


@dataclass(frozen=True)
class TelemetryLog:
    """The frames of a log in order, each with its time in ns since 1970, and counts of what was left out."""

    frames: list[tuple[int, mavlink.Frame]]
    counters: Counter[str]


def read_tlog(file: Path) -> TelemetryLog:
    """Read the intact frames of a log. Raises InputError if the file cannot be read or has no frame."""
    with usable(file, "a telemetry log"):
        data = file.read_bytes()
    log = parse_tlog(data)
    if not log.frames:
        raise InputError(f"{file}: read no MAVLink frame in {len(data)} bytes, wanted a telemetry log (.tlog)")
    return log


def parse_tlog(data: bytes) -> TelemetryLog:
    stamps_us: list[int] = []
    frames: list[mavlink.Frame] = []
    counters: Counter[str] = Counter()
    at, damaged = 0, False
    while at + _STAMP.size < len(data):
        start = at + _STAMP.size
        stop = mavlink.frame_end(data, start)
        refused: Counter[str] = Counter()
        found = mavlink.decode_either(data[start:stop], refused) if stop else []
        unusable = refused and not refused["bad checksum"]
        if found:
            stamps_us.append(_STAMP.unpack_from(data, at)[0])
            frames.append(found[0])
        elif unusable and mavlink.is_magic(data, stop + _STAMP.size) and not _good_within(data, start + 1, stop):
            counters.update(refused)
        else:
            following = _MAGIC.search(data, start + 1)
            after = len(data) if following is None else following.start() - _STAMP.size
            counters["damaged places"] += not damaged
            counters["damaged bytes"] += after - at
            at, damaged = after, True
            continue
        at, damaged = stop, False
    if at < len(data):
        counters["damaged places"] += not damaged
        counters["damaged bytes"] += len(data) - at
    kept = [
        (us * 1000, frame) for us, frame, good in zip(stamps_us, frames, _plausible(stamps_us), strict=True) if good
    ]
    counters["wrong time stamps"] += len(frames) - len(kept)
    return TelemetryLog(kept, +counters)


def _good_within(data: bytes, start: int, stop: int) -> bool:
    """Whether a good frame begins in a range of bytes; if so, the frame that seemed to span it has a damaged length."""
    for magic in _MAGIC.finditer(data, start, stop):
        end = mavlink.frame_end(data, magic.start())
        if end and mavlink.decode_either(data[magic.start() : end], Counter()):
            return True
    return False


def _plausible(stamps_us: list[int]) -> list[bool]:
    """For each stamp, whether it is a possible time and near the median of itself and its two neighbours."""
    possible = [us < LATEST_NS // 1000 for us in stamps_us]
    if len(stamps_us) < 3:
        return possible
    t = np.array(stamps_us, dtype=np.uint64).astype(np.float64)
    around = np.stack([np.concatenate([t[2:3], t[:-1]]), t, np.concatenate([t[1:], t[-3:-2]])])
    near: list[bool] = (np.abs(t - np.median(around, axis=0)) < _WRONG_STAMP_US).tolist()
    return [one and other for one, other in zip(possible, near, strict=True)]
