"""The newest signing timestamps, kept in a memory that may be a file: what was heard once is refused after a restart.

A file is mapped, so a timestamp is kept as soon as it is accepted, and survives the end of the process however it
comes. If the machine itself goes down, those of the last seconds may be lost.
"""

import fcntl
import mmap
import os
from pathlib import Path
from struct import Struct

from scenarios.signing.keys import KeyFileError

_MAGIC = b"MAVLink stamps 1"
_ENTRY = Struct("<QQ")
"""Timestamp and stream, in this order: as long as an entry is not whole, it is of stream 0, which is none."""
MOST_STREAMS = 4095
SIZE = len(_MAGIC) + _ENTRY.size * MOST_STREAMS


class Stamps:
    """Timestamps by stream. A stream is any number above 0; memory is SIZE bytes, that of the process if not given."""

    def __init__(self, memory: bytearray | mmap.mmap | None = None) -> None:
        self.memory = bytearray(SIZE) if memory is None else memory
        self._places: dict[int, int] = {}
        self.known: dict[int, int] = {}
        """Newest timestamp by stream."""
        for at in range(len(_MAGIC), SIZE, _ENTRY.size):
            timestamp, stream = _ENTRY.unpack_from(self.memory, at)
            if stream == 0:
                break
            self._places[stream] = at
            self.known[stream] = timestamp

    def keep(self, stream: int, timestamp: int) -> bool:
        """Note a stream's newest timestamp; False if there are too many streams for another one."""
        at = self._places.get(stream)
        if at is None:
            if len(self._places) >= MOST_STREAMS:
                return False
            at = self._places[stream] = len(_MAGIC) + _ENTRY.size * len(self._places)
        self.known[stream] = timestamp
        _ENTRY.pack_into(self.memory, at, timestamp, stream)
        return True


def open_stamps(file: Path) -> Stamps:
    """The timestamps in a file, which is made if it is not there; they are this process's until it ends.

    Raises
    ------
    KeyFileError
        If the file cannot be used, is of another kind, or another process has it.
    """
    try:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise KeyFileError(f"{file}: {error.strerror}, wanted a file of timestamps that can be written") from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise KeyFileError(f"{file}: another process uses it, wanted a key of one's own for each") from None
    with os.fdopen(descriptor, "r+b", buffering=0, closefd=False) as opened:
        found = opened.read(SIZE + 1)
        if not found:
            opened.write(_MAGIC.ljust(SIZE, b"\0"))
        elif len(found) != SIZE or found[: len(_MAGIC)] != _MAGIC:
            os.close(descriptor)
            raise KeyFileError(f"{file}: read no timestamps, wanted a file that this program made, or none")
    # The descriptor stays open: the lock is on it.
    return Stamps(mmap.mmap(descriptor, SIZE))
