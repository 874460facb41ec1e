"""What a run leaves behind while it flies: the tick record, the events, the telemetry log.

All three are append-only files written with one system call a tick, so a killed process loses nothing that it had
logged, and others (the live table, the Rerun recording) follow the flight by reading files: the control loop
never waits for them.
"""

import contextlib
import json
import os
import struct
from collections.abc import Iterable
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

SCENARIO_FILE = "scenario.toml"
DESIGN_FILE = "design.json"
TICKS_FILE = "ticks.part"
"""The growing tick log; it becomes PARQUET_FILE when the run is finished."""
PARQUET_FILE = "ticks.parquet"
EVENTS_FILE = "events.jsonl"
TLOG_FILE = "flight.tlog"
CLOCK_JUMPED = "its clock jumped"
"""Text of the event."""
GAIN_SET = "gain set "
"""How a STATUSTEXT begins that tells the gain set a vehicle is flown with from now on, after the vehicle's name."""
RECORDING_FILE = "flight.rrd"
SUMMARY_FILE = "summary.json"
NEW_DESIGN = "design"
"""Kind of the event that DESIGN_FILE has been written anew."""
END = "end"
"""Kind of the last event of a flight."""
FLEET = "fleet"
"""Kind of the event that says where the vehicles are from, if the flight did not start them."""
STARTED = "started by the station"
"""Where those of other flights are from."""
LOG_ENDED = "log"
"""Kind of the event that a file could not be written from then on: its name and the reason."""
_MOST_WAITING = 1000
READY_FILE = ".observer-ready"
"""There while an observer follows the run."""

TickArray = NDArray[Any]
"""A structured array of dtype TICK: one row for each vehicle."""


class Mode(IntEnum):
    """What the station thinks of one vehicle."""

    WAITING = 0  # not heard, or not yet ready to fly
    NOMINAL = 1  # flying, loop delay well below the margin
    CAUTION = 2  # flying, little headroom left
    CRITICAL = 3  # flying, next to no headroom left: the station acts
    FAILSAFE = 4  # heard, but it does not take set-points: it holds its velocity
    LOST = 5  # not heard
    RECOVERING = 6  # flying, its gains on the way back to faster ones


SEVERITY = {
    Mode.WAITING: 6,
    Mode.NOMINAL: 6,
    Mode.RECOVERING: 5,
    Mode.CAUTION: 4,
    Mode.LOST: 3,
    Mode.CRITICAL: 2,
    Mode.FAILSAFE: 1,
}
"""How serious a change to the mode is, as MAV_SEVERITY: 6 info, 5 notice, 4 warning, 3 error, 2 critical, 1 alert."""

TICK = np.dtype(
    [
        ("tick", "<i8"),  # counts control ticks, from 0; a number left out is a tick that was skipped
        ("time_s", "<f8"),  # scenario time; below 0 before the formation is flown
        ("due_ns", "<i8"),  # when the tick was due, station clock
        ("sent_ns", "<i8"),  # when its set-points had been handed to the kernel, station clock
        ("key_ms", "<u4"),  # time_boot_ms of its set-points: joins this log with the vehicles' own
        ("system_id", "u1"),  # the vehicle that the row is about
        ("mode", "u1"),  # its mode, as a number
        ("gain_set", "u1"),  # place in the gain schedule, 0 the fastest
        ("commanded", "?"),  # a set-point was sent to this vehicle
        ("sample_boot_ms", "<u4"),  # time_boot_ms of the newest state used
        ("sample_ns", "<i8"),  # the same instant on the station's clock, as estimated
        ("telemetry_age_s", "<f8"),  # sent_ns - sample_ns; NaN while the vehicle's clock is unknown
        ("north_m", "<f8"),  # newest state, local NED
        ("east_m", "<f8"),
        ("down_m", "<f8"),
        ("velocity_north_m_s", "<f8"),
        ("velocity_east_m_s", "<f8"),
        ("velocity_down_m_s", "<f8"),
        ("spacing_error_north_m", "<f8"),  # e^p at the instant of the newest state; NaN for the leader
        ("spacing_error_east_m", "<f8"),
        ("velocity_error_north_m_s", "<f8"),  # e^v
        ("velocity_error_east_m_s", "<f8"),
        ("command_north_m_s2", "<f8"),  # set-point, acceleration; NaN when none was sent
        ("command_east_m_s2", "<f8"),
        ("nearest_m", "<f8"),  # distance to the nearest other vehicle, at the tick's instant; NaN while unknown
        ("queue_s", "<f8"),  # from the kernel's receive stamp of the newest state to its use by a step
        ("up_delay_s", "<f8"),  # one-way delay of the newest state: from sample_ns to the kernel's receive stamp
        ("sample_bound_s", "<f8"),  # most that sample_ns, telemetry_age_s and up_delay_s can be wrong (gcs/clocks.py)
        ("down_delay_s", "<f8"),  # newest measured one-way delay station to vehicle; NaN while unknown
        ("down_bound_s", "<f8"),  # most that it can be wrong
        ("loop_delay_s", "<f8"),  # age of the oldest state used + down_delay_s - repeated_s; ground loop: of the newest
        ("repeated_s", "<f8"),  # how long the set-point has repeated an earlier one, as far as telemetry is slower
        ("delay_margin_s", "<f8"),  # of the gains flown, as known at the time; infinite if no delay is too long
        ("headroom", "<f8"),  # 1 - loop delay / margin
        ("rtt_s", "<f8"),  # a TIMESYNC round trip that has ended and is in no earlier row; NaN if there is none
        ("clock_offset_s", "<f8"),  # vehicle's boot clock minus station clock, at sent_ns
        ("clock_offset_bound_s", "<f8"),  # most that it can be wrong
        ("received", "<u4"),  # frames from this vehicle so far, and those lost, late, twice
        ("lost", "<u4"),
        ("late", "<u4"),
        ("duplicate", "<u4"),
    ]
)


class RunWriter:
    """Appends ticks, events and MAVLink frames to the files of one run folder.

    Nothing here raises because a disk is full: the flight goes on without the log. A log of ticks or frames that could
    not be written ends there, after its last whole record and without a gap; the event LOG_ENDED says so. Events are
    few, and are kept until they can be written.
    """

    def __init__(self, folder: Path) -> None:
        self._ticks, self._events, self._tlog = (
            RecordLog(folder / name) for name in (TICKS_FILE, EVENTS_FILE, TLOG_FILE)
        )
        self._ended: set[str] = set()
        self._waiting: list[bytes] = []
        """Events that could not be written yet."""
        self._time_s = -np.inf
        """Of the newest tick."""

    def tick(self, rows: TickArray) -> None:
        self._time_s = float(rows["time_s"][0])
        self._add(TICKS_FILE, self._ticks, rows.tobytes())

    def event(
        self,
        *,
        time_s: float,
        kind: str,
        text: str,
        system_id: int | None = None,
        counts: dict[str, int] | None = None,
    ) -> None:
        line: dict[str, Any] = {"time_s": round(time_s, 6), "kind": kind, "system_id": system_id, "text": text}
        if counts is not None:
            line["counts"] = counts
        if len(self._waiting) < _MOST_WAITING or kind == END:
            self._waiting.append((json.dumps(line) + "\n").encode())
        with contextlib.suppress(OSError):
            self._events.add(b"".join(self._waiting))
            self._waiting.clear()

    def frames(self, frames: Iterable[tuple[bytes, int]]) -> None:
        """Log frames, each with its time in ns since 1970, in the .tlog layout: big-endian µs, then the frame."""
        entries = b"".join(struct.pack(">Q", time_ns // 1000) + frame for frame, time_ns in frames)
        if entries:
            self._add(TLOG_FILE, self._tlog, entries)

    def ended(self, name: str, error: OSError) -> None:
        """Note that a file of the run could not be written, and is not from now on."""
        self._ended.add(name)
        self.event(time_s=self._time_s, kind=LOG_ENDED, text=f"{name}: {error.strerror}")

    def close(self) -> list[dict[str, Any]]:
        """Close the files; gives the events that could not be written."""
        for log in (self._ticks, self._events, self._tlog):
            log.close()
        return [json.loads(line) for line in self._waiting]

    def _add(self, name: str, log: "RecordLog", data: bytes) -> None:
        if name in self._ended:
            return
        try:
            log.add(data)
        except OSError as error:
            self.ended(name, error)


class RecordLog:
    """A file that grows by whole records: what a failed write has left of one is cut off."""

    def __init__(self, file: Path) -> None:
        self.descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        self._size = os.fstat(self.descriptor).st_size

    def add(self, record: bytes) -> None:
        """Append a record, or nothing; raises OSError."""
        try:
            left = record
            while left:
                left = left[os.write(self.descriptor, left) :]
        except OSError:
            os.ftruncate(self.descriptor, self._size)
            raise
        self._size += len(record)

    def close(self) -> None:
        os.close(self.descriptor)


def write_whole(file: Path, data: bytes) -> None:
    """Write a file in one step, for those who read it meanwhile; one that is there stays if that fails."""
    part = file.with_name(file.name + ".new")
    try:
        part.write_bytes(data)
        part.replace(file)
    except OSError:
        part.unlink(missing_ok=True)
        raise
