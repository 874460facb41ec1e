"""Writes the logs of a run in flight: the tick record, the events, the telemetry log.

All three are append-only files, each written with few system calls per tick, so a killed process loses nothing that it
had logged. The live table and the Rerun recording follow the flight by reading these files, so the control loop never
waits for them.
"""

import contextlib
import json
import os
import struct
from collections import defaultdict
from collections.abc import Generator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gcs.control.tick import Event, TickArray
from gcs.link.datagram import NETWORK_BIT, Arrivals, Frames, network_at
from scenarios.kernel import Array, kernel

SCENARIO_FILE = "scenario.toml"
DESIGN_FILE = "design.json"
TICKS_FILE = "ticks.part"
"""The tick log while it grows; it becomes PARQUET_FILE when the run is finished."""
PARQUET_FILE = "ticks.parquet"
EVENTS_FILE = "events.jsonl"
TLOG_FILE = "flight.tlog"
"""The telemetry log of network 0, see `tlog_file`."""
TRUTH_FILE = "truth.bin"
"""The vehicles' own record of when they sampled their states and when set-points acted."""
MIRROR = "mirror"
"""Kind of the event that counts the frames exchanged with the other station of a mirror."""
RECORDING_FILE = "flight.rrd"
UNFINISHED_FILE = RECORDING_FILE + ".part"
"""The recording while it is written."""
SUMMARY_FILE = "summary.json"
NEW_DESIGN = "design"
"""Kind of the event that reports that DESIGN_FILE was rewritten."""
END = "end"
"""Kind of the last event of a flight."""
FLEET = "fleet"
"""Kind of the event that says where the vehicles come from, if the flight did not start them."""
STARTED = "started by the station"
"""Origin of the vehicles in all other flights."""
LOG_ENDED = "log"
"""Kind of the event that names a file that can no longer be written, and the reason."""
_MOST_WAITING = 1000
_STAMP = struct.Struct(">Q")
READY_FILE = ".observer-ready"
"""A file that exists while an observer follows the run."""


def tlog_file(network: int | str) -> str:
    """The name of a network's telemetry log. Each network has its own, because frames do not name their network."""
    return TLOG_FILE if network == 0 else f"flight-{network}.tlog"


class RunWriter:
    """Appends ticks, events and MAVLink frames to the files of one run folder.

    A full disk raises nothing: the flight continues without the log. If ticks or frames cannot be written, their log
    ends there, after its last whole record and without a gap, and the event LOG_ENDED says so. Events are few; they are
    kept in memory until they can be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._logs = {name: RecordLog(folder / name) for name in (TICKS_FILE, EVENTS_FILE, TLOG_FILE)}
        self._ended: set[str] = set()
        self._waiting: list[Event] = []
        """Events that could not be written yet."""
        self._time_s = -np.inf
        """Scenario time of the newest tick."""

    def tick(self, rows: TickArray) -> None:
        self._time_s = float(rows["time_s"][0])
        self._add(TICKS_FILE, rows.tobytes())

    def event(self, *events: Event) -> None:
        """Log events, after the earlier ones that could not be written yet."""
        self._waiting += (replace(event, time_s=round(event.time_s, 6)) for event in events)
        if not self._waiting:
            return
        lines = (json.dumps(event_fields(waiting)) + "\n" for waiting in self._waiting)
        try:
            self._logs[EVENTS_FILE].add("".join(lines).encode())
            self._waiting.clear()
        except OSError:
            self._waiting = [e for k, e in enumerate(self._waiting) if k < _MOST_WAITING or e.kind == END]

    def frames(self, frames: Frames, epoch_ns: int = 0) -> None:
        """Log frames in the .tlog layout: big-endian µs since 1970, then the frame.

        `epoch_ns` is the zero of the frames' times, in ns since 1970.
        """
        for network, entries in tlog_entries(frames, epoch_ns).items():
            self.entries(network, entries)

    def entries(self, network: int, entries: bytes) -> None:
        """Append entries to the telemetry log of a network."""
        self._add(tlog_file(network), entries)

    def ended(self, name: str, error: OSError) -> None:
        """Log that a file of the run could not be written, and write no more to it."""
        self._ended.add(name)
        self.event(Event(time_s=self._time_s, kind=LOG_ENDED, text=f"{name}: {error.strerror}"))

    def close(self) -> list[Event]:
        """Close the files; returns the events that could not be written."""
        for log in self._logs.values():
            log.close()
        return self._waiting

    def _add(self, name: str, data: bytes) -> None:
        if name in self._ended:
            return
        try:
            if name not in self._logs:  # the first frames of another network
                self._logs[name] = RecordLog(self._folder / name)
            self._logs[name].add(data)
        except OSError as error:
            self.ended(name, error)


def tlog_entries(frames: Frames, epoch_ns: int = 0) -> dict[int, bytes]:
    """The bytes to append to the telemetry log of each network."""
    entries: dict[int, list[bytes]] = defaultdict(list)
    for part in frames.parts:
        if isinstance(part, Arrivals):
            networks = part.table[2] >> NETWORK_BIT
            for network in np.unique(networks).tolist():
                table = part.table[:, networks == network]
                own = np.empty(int((table[1] - table[0]).sum()) + _STAMP.size * table.shape[1], np.uint8)
                _fill(own, part.stream, table, epoch_ns)
                entries[network].append(own.tobytes())
        else:
            frame, time_ns, address = part
            entries[network_at(address)] += (_STAMP.pack((epoch_ns + time_ns) // 1000), frame)
    return {network: b"".join(parts) for network, parts in entries.items()}


@kernel
def _fill(entries: Array, stream: Array, table: Array, epoch_ns: int) -> None:
    """Fill the array `entries` with the telemetry log entries of the frames in a table."""
    at = 0
    for k in range(table.shape[1]):
        at = add_entry(entries, at, stream, table[0, k], table[1, k], epoch_ns + table[3, k])


@kernel
def add_entry(entries: Array, at: int, stream: Array, begin: int, end: int, time_ns: int) -> int:
    """Write a frame's telemetry log entry at an index of `entries`, with its time since 1970; returns its end."""
    for byte in range(8):
        entries[at + byte] = time_ns // 1000 >> 8 * (7 - byte) & 0xFF
    at += 8
    for place in range(begin, end):
        entries[at] = stream[place]
        at += 1
    return at


def event_fields(event: Event) -> dict[str, Any]:
    """The fields of a line of events.jsonl; `counts` is left out if it is None."""
    return {name: value for name, value in vars(event).items() if name != "counts" or value is not None}


class RecordLog:
    """A file that grows by whole records: if writing one fails, the part written is truncated."""

    def __init__(self, file: Path) -> None:
        self.descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        self._size = os.fstat(self.descriptor).st_size

    def add(self, record: bytes) -> None:
        """Append a record; raises OSError, with the file as before, if it cannot be written whole."""
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
    """Replace a file atomically: no reader sees half of it, and the old file stays if writing fails."""
    with replacing(file) as part:
        part.write_bytes(data)


def write_parquet(file: Path, columns: Mapping[str, Any]) -> None:
    """Replace a Parquet file atomically. A column is a contiguous numpy array or a list."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    def column(values: Any) -> Any:
        if not isinstance(values, np.ndarray):
            return pa.array(values)
        # pa.array(values) would import pandas if that is installed, which takes a fifth of a second
        kind, data = pa.from_numpy_dtype(values.dtype), values
        if values.dtype == bool:  # Arrow stores one bit for each
            data = np.packbits(values, bitorder="little")
        return pa.Array.from_buffers(kind, values.size, [None, pa.py_buffer(data)])

    with replacing(file) as part:
        table = pa.table({name: column(values) for name, values in columns.items()})
        pq.write_table(table, part, compression="zstd")


@contextlib.contextmanager
def replacing(file: Path) -> Generator[Path]:
    """Yields a new file to write inside the `with` block; on exit it atomically replaces `file`."""
    part = file.with_name(file.name + ".new")
    try:
        yield part
        part.replace(file)
    except OSError:
        part.unlink(missing_ok=True)
        raise
