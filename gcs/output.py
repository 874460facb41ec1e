"""Standard output that survives losing its reader: a `head` that has exited, a closed terminal, a full disk."""

import errno
import io
import os
import sys
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""The `errno` values after which nothing more can be written."""
_GONE = (*DISK_FULL, errno.EPIPE, errno.EIO, errno.EBADF)
_STANDARD = (0, 1, 2)


def open_what_is_closed() -> None:
    """Open /dev/null for closed standard files; otherwise a socket may get descriptor 1 or 2 and be printed to."""
    for number in _STANDARD:
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # open() takes the lowest free number: this one


def outlive_readers() -> None:
    """Make printing safe for the rest of the process: output that nobody can read any more is dropped, not an error."""
    if sys.stdout is sys.__stdout__:
        sys.stdout = _unfailing(1, sys.stdout)
    if sys.stderr is sys.__stderr__:
        sys.stderr = _unfailing(2, sys.stderr)


class _Unfailing(io.FileIO):
    """A standard file that redirects itself to the null device once it cannot be written."""

    def write(self, data: "ReadableBuffer", /) -> int:
        try:
            return super().write(data) or 0
        except OSError as error:
            if error.errno not in _GONE:
                raise
            with open(os.devnull, "wb") as null:
                os.dup2(null.fileno(), self.fileno())
            return memoryview(data).nbytes


def _unfailing(number: int, former: TextIO | None) -> io.TextIOWrapper:
    """A replacement for a standard file; `former` is None if it was closed at the start."""
    return io.TextIOWrapper(
        io.BufferedWriter(_Unfailing(number, "w", closefd=False)),
        encoding="utf-8" if former is None else former.encoding,
        errors=None if former is None else former.errors,
        line_buffering=number == 2 or os.isatty(number),
    )
