"""The truth log: what happened and when, on the host's clock. The station's estimates are graded against it.

The file is a magic number followed by fixed-size records, written in batches: a killed process loses its last batch at
most. An incomplete record at the end is skipped when reading and overwritten when the log is continued.
"""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from scenarios.kernel import Records, kernel

SAMPLED, ACTED, LINK_UP, LINK_DOWN = 1, 2, 3, 4
PUSHED, CARRIED, POSITION_ERROR, VELOCITY_ERROR = 5, 6, 7, 8
KINDS = SAMPLED, ACTED, LINK_UP, LINK_DOWN, PUSHED, CARRIED, POSITION_ERROR, VELOCITY_ERROR

DTYPE = np.dtype(
    [
        ("kind", "u1"),
        ("system_id", "<u2"),
        ("key", "<u4"),
        ("time_ns", "<i8"),
        ("entered_ns", "<i8"),
        ("due_ns", "<i8"),
        ("fate", "u1"),
        ("queued_ns", "<i8"),
    ]
)
"""One record.

SAMPLED: the state in the LOCAL_POSITION_NED with time_boot_ms `key` was sampled at `time_ns`. ACTED: the set-point
with the sender's time_boot_ms `key` acts from `time_ns` on. For these two the other times equal `time_ns`, and the
last two fields are 0.
LINK_UP, LINK_DOWN: a datagram whose first frame has the message id `key` (as it left, so perhaps corrupted; 0xFFFFFF
if it has none) entered the link at `entered_ns`, was due at `due_ns`, and left at `time_ns`. Upwards it was then handed
to a socket (in virtual time, to the station); downwards the simulated vehicle took it. It waited `queued_ns` for the
channel. `fate` combines the bits in FATES. With one of DROPPED it never left: due_ns and time_ns equal entered_ns. A
duplicated datagram has two records; the copy's has DUPLICATE.
PUSHED, CARRIED: from `time_ns` on the vehicle is pushed by an acceleration, or carried at a velocity. POSITION_ERROR,
VELOCITY_ERROR: the state sampled with time_boot_ms `key` was reported with this error. In all four, `entered_ns` and
`due_ns` hold the north and east components in m/s², m/s, m and m/s, times 1e9.
"""

_OLDER = np.dtype([(name, "u1" if name == "system_id" else DTYPE[name]) for name in DTYPE.names or ()])
"""One record as it was written before there were several networks."""

PASSED = 0
DUPLICATE, CORRUPTED, LOST, OUTAGE, QUEUE_FULL, LINK_FULL = 1, 2, 4, 8, 16, 32
DROPPED = LOST | OUTAGE | QUEUE_FULL | LINK_FULL
FATES = {
    DUPLICATE: "duplicated",
    CORRUPTED: "corrupted",
    LOST: "lost",
    OUTAGE: "outage",
    QUEUE_FULL: "queue_full",
    LINK_FULL: "link_full",
}

_MAGIC, _OLDER_MAGIC = b"UAVTRUE3", b"UAVTRUE2"
_BATCH = 8192
_OF_ONE_EVENT = 4
"""Upper bound on the records that one event of a vehicle or link makes."""
_PARTS = 1e9


Row = tuple[int, int, int, int, int, int] | tuple[int, int, int, int, int, int, int, int]
"""The values of one record in the order of DTYPE; the last two are 0 if omitted."""
NOT_RECORDED: Records = np.zeros(1, DTYPE)
"""Stands in for `Recorder.rows` where nothing is recorded."""


class Recorder:
    """Collects the records of one simulation, from kernels and from Python, and writes them in batches.

    Kernels add theirs to `rows`. Row 0 is no record; its `queued_ns` counts the records after it.
    """

    def __init__(self, write: Callable[[Records], object], batch: int = _BATCH) -> None:
        self.rows: Records = np.zeros(1 + batch, DTYPE)
        self._counts = self.rows["queued_ns"].data
        self._write = write

    def add(self, row: Row) -> None:
        self.make_room()
        self._counts[0] = count = self._counts[0] + 1
        self.rows[count] = row if len(row) == 8 else (*row, PASSED, 0)

    def make_room(self) -> None:
        """Flush, unless one more event can be recorded."""
        if not can_record(self.rows):
            self.flush()

    def flush(self) -> None:
        """Write the batch, and begin a new one."""
        count = self._counts[0]
        self._write(self.rows[1 : 1 + count].copy())
        self._counts[0] = 0


def rows_of(recorder: Recorder | None) -> Records:
    """The rows to which kernels add records."""
    return NOT_RECORDED if recorder is None else recorder.rows


class MemoryRecorder(Recorder):
    """Keeps all records."""

    def __init__(self, batch: int = _BATCH) -> None:
        self._batches: list[Records] = [NOT_RECORDED[:0]]
        super().__init__(self._batches.append, batch)

    @property
    def records(self) -> Records:
        self.flush()
        return np.concatenate(self._batches)


@kernel
def can_record(rows: Records) -> bool:
    """Whether one event can be recorded, or nothing is recorded."""
    return len(rows) == 1 or rows[0].queued_ns + _OF_ONE_EVENT < len(rows)


@kernel
def note(
    rows: Records, kind: int, system_id: int, key: int, time_ns: int,
    entered_ns: int, due_ns: int, fate: int, queued_ns: int,
) -> None:  # fmt: skip
    """Add a record, see DTYPE, if there is room."""
    if rows[0].queued_ns + 1 < len(rows):
        rows[0].queued_ns += 1
        row = rows[rows[0].queued_ns]
        row.kind, row.system_id, row.key, row.fate, row.queued_ns = kind, system_id, key, fate, queued_ns
        row.time_ns, row.entered_ns, row.due_ns = time_ns, entered_ns, due_ns


class TruthLog(Recorder):
    """A truth log open for writing, a new one or one to continue.

    Raises ValueError if the file is of another kind, and OSError if it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(self.write)
        self.lost = 0
        """Records that could not be written: a full disk stops no vehicle."""
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        head = os.pread(self._file, len(_MAGIC), 0)
        if not _MAGIC.startswith(head):
            os.close(self._file)
            raise ValueError(f"{path} exists and is not a truth log")
        size = os.fstat(self._file).st_size
        self._end = size - (size - len(_MAGIC)) % DTYPE.itemsize if head == _MAGIC else 0
        """Where the next batch goes: after the last complete record, over whatever a failed write left there."""
        self.flush()

    def write(self, records: Records) -> None:
        """Hand records to the operating system."""
        head = b"" if self._end else _MAGIC
        try:
            written = os.pwrite(self._file, head + records.tobytes(), self._end)
        except OSError:
            written = 0
        whole = max(0, written - len(head)) // DTYPE.itemsize
        if written >= len(head):
            self._end += len(head) + whole * DTYPE.itemsize
        self.lost += len(records) - whole

    def close(self) -> None:
        """Write the last batch and cut off an incomplete record."""
        self.flush()
        with contextlib.suppress(OSError):
            os.ftruncate(self._file, self._end)
        os.close(self._file)


def disturbance_row(kind: int, system_id: int, key: int, time_ns: int, north: float, east: float) -> Row:
    """The record of a disturbance, PUSHED to VELOCITY_ERROR, with its components in m/s², m/s or m."""
    return kind, system_id, key, time_ns, round(north * _PARTS), round(east * _PARTS)


def read_truth(path: Path) -> npt.NDArray[np.void]:
    """The complete records of a truth log, in the order written, as an array of DTYPE.

    A log that a full disk cut off within its magic number has none.

    Raises ValueError if the file is not a truth log, or holds a record of an unknown kind.
    """
    data = path.read_bytes()
    layout = _OLDER if data.startswith(_OLDER_MAGIC) else DTYPE
    if layout is DTYPE and not data.startswith(_MAGIC[: len(data)]):
        raise ValueError(f"{path} is not a truth log")
    count = max(0, len(data) - len(_MAGIC)) // layout.itemsize
    records = np.frombuffer(data, layout, count, min(len(_MAGIC), len(data))).astype(DTYPE)
    if (unknown := np.flatnonzero(~np.isin(records["kind"], KINDS))).size:
        raise ValueError(f"{path}: record {unknown[0] + 1} of {count} is of no known kind")
    return records
