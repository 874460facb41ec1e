"""The newest signing timestamps, in memory that may be a mapped file, so that restarts do not let replays in.

A timestamp is stored in the file as soon as it is accepted, and survives any end of the process. If the machine itself
goes down, those of the last seconds may be lost.
"""

import fcntl
import mmap
import os
from pathlib import Path
from struct import Struct

from scenarios.signing.keys import KeyFileError

_MAGIC = b"MAVLink stamps 1"
_ENTRY = Struct("<QQ")
"""Timestamp and stream, in this order: an incomplete entry still has stream 0, which means no entry."""
MOST_STREAMS = 4095
SIZE = len(_MAGIC) + _ENTRY.size * MOST_STREAMS


class Stamps:
    """Timestamps by stream, a number above 0. `memory` is SIZE bytes, by default the process's own."""

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
        """Store a stream's newest timestamp; False if there is no room for another stream."""
        at = self._places.get(stream)
        if at is None:
            if len(self._places) >= MOST_STREAMS:
                return False
            at = self._places[stream] = len(_MAGIC) + _ENTRY.size * len(self._places)
        self.known[stream] = timestamp
        _ENTRY.pack_into(self.memory, at, timestamp, stream)
        return True


def open_stamps(file: Path) -> Stamps:
    """The timestamps in a file, created if missing and locked until this process ends.

    Raises KeyFileError if the file cannot be used, is of another kind, or another process has it.
    """
    try:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise KeyFileError(f"{file}: {error.strerror}, wanted a file of timestamps that can be written") from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise KeyFileError(f"{file}: another process uses it, wanted a separate key for each process") from None
    with os.fdopen(descriptor, "r+b", buffering=0, closefd=False) as opened:
        found = opened.read(SIZE + 1)
        if not found:
            opened.write(_MAGIC.ljust(SIZE, b"\0"))
        elif len(found) != SIZE or found[: len(_MAGIC)] != _MAGIC:
            os.close(descriptor)
            raise KeyFileError(f"{file}: read no timestamps, wanted a file that this program made, or none")
    # The descriptor stays open, as it holds the lock.
    return Stamps(mmap.mmap(descriptor, SIZE))
