"""Kernels that read and write UDP sockets without making an object for each datagram.

They call the C library with the layouts of 64-bit Linux. One array of 64-bit integers, the words, holds all arguments
and results: a `struct msghdr`, then an `iovec`, the ancillary data, a `sockaddr_in` and a `timespec`.
"""

import errno
import socket
import time  # noqa: TID251 - the drivers read their clock here
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scenarios.kernel import int64, kernel

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]

_LONGEST_DATAGRAM, _LONGEST_SHARED = 2048, 1400
"""The longest datagram that is read, and the longest that frames share: networks carry it in one piece."""
MOST_DATAGRAMS, _MOST_BYTES = 4096, 1 << 20
"""Limits of one read; the rest waits in the sockets."""
NO_ADDRESS = -1
"""Stands for the number of an address where the socket is connected."""
NS_PER_S = 1_000_000_000
_SO_TIMESTAMPNS = 35  # Linux; Python has no name for it
_EAGAIN, _REFUSED = errno.EAGAIN, errno.ECONNREFUSED
_DONTWAIT, _REALTIME, _MONOTONIC, _IPV4 = 0x40, 0, 1, 2
_NAME, _VECTOR, _CONTROL, _CLOCK, _EMPTIED, OFFSET, _WORDS = 7, 9, 11, 19, 21, 22, 23
"""Where the parts of the array begin, and its length. The last two words are the time at which all sockets were last
empty and, from the last read, the offset from the monotonic clock to ns since 1970."""
_NAME_BYTES, _CONTROL_BYTES, _STAMP = 16, 64, 13
_VERSION_1, _VERSION_2, _OVERHEAD_1, _OVERHEAD_2, _SIGNATURE = 0xFE, 0xFD, 8, 12, 13
"""The first byte of a MAVLink frame, and how many bytes it has besides its payload."""
_MOST_FRAMES = _LONGEST_DATAGRAM // _OVERHEAD_1
_48_BITS, _LONGEST_NS = 0xFFFFFFFFFFFF, 2**63 - 1


class _External:
    """A function of the C library, for kernels; Numba is imported only when a kernel with it is compiled."""

    def __init__(self, name: str, result: str, *arguments: str) -> None:
        self._name, self._result, self._arguments = name, result, arguments

    @property
    def _numba_type_(self) -> Any:
        from numba import types

        kinds: Any = types
        result = kinds.CPointer(types.int32) if self._result == "int32*" else getattr(types, self._result)
        return kinds.ExternalFunction(self._name, result(*(getattr(types, kind) for kind in self._arguments)))


_recvmsg: Any = _External("recvmsg", "int64", "int32", "uintp", "int32")
_sendto: Any = _External("sendto", "int64", "int32", "uintp", "uintp", "int32", "uintp", "uint32")
_clock_gettime: Any = _External("clock_gettime", "int32", "int32", "uintp")
_errno: Any = _External("__errno_location", "int32*")


class Received(NamedTuple):
    """A datagram with its receiving socket, the time at which it reached this host, and its sender."""

    descriptor: int
    data: bytes
    time_ns: int
    address: tuple[str, int]


@dataclass(slots=True)
class Batch:
    """Datagrams read together; iterating over them yields `Received` objects.

    The rows of `table` (5, n) are start and end of each datagram in `stream`, the number of the sender's address, the
    time at which it reached this host, and the descriptor of the socket.
    """

    stream: Bytes
    table: Ints
    read_ns: int
    errors: int
    """Number of earlier datagrams that met a closed port or failed otherwise."""

    def __iter__(self) -> Iterator[Received]:
        data = self.stream.tobytes()
        for begin, end, number, time_ns, descriptor in self.table.T.tolist():
            yield Received(descriptor, data[begin:end], time_ns, address_of(number))


def stamped(own: socket.socket) -> socket.socket:
    """The socket, made non-blocking, with timestamps of arrival by the operating system."""
    own.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    own.setblocking(False)
    return own


class Buffers(NamedTuple):
    """The arrays into which kernels read, and the words. A `Batch` copies the filled part of `stream` and `table`."""

    stream: Bytes
    table: Ints
    words: Ints
    together: Bytes
    """Room for the frames that share a datagram; empty if each travels alone."""


class Reader:
    """Reads sockets that are `stamped`, at most `most_of_each` datagrams from each at once.

    With `together`, MAVLink frames share datagrams: `write` sends consecutive frames to one address in one datagram,
    and frames that came in one datagram are read as if each had come in its own. What is not exactly one frame, as when
    a link has flipped bits in its header, travels alone: readers would not find the frames behind it.
    """

    def __init__(self, most_of_each: int = MOST_DATAGRAMS, *, together: bool = False) -> None:
        self._most = most_of_each
        self.buffers = Buffers(
            np.empty(_MOST_BYTES, np.uint8), np.empty((5, MOST_DATAGRAMS), np.int64), _words(),
            np.empty(_LONGEST_SHARED if together else 0, np.uint8),
        )  # fmt: skip
        self.buffers.words[_EMPTIED] = time.monotonic_ns()

    def read(self, descriptors: Sequence[int] | Ints) -> Batch:
        """The datagrams that have arrived at these sockets; no other sockets may have unread datagrams."""
        return batch(self.buffers, *read_all(np.asarray(descriptors, np.int64), self._most, self.buffers))


def batch(buffers: Buffers, count: int, end: int, errors: int, read_ns: int) -> Batch:
    """A copy of what `read_all` has read into the buffers; the other arguments are its results."""
    return Batch(buffers.stream[:end].copy(), buffers.table[:, :count].copy(), read_ns, errors)


def write(
    stream: Bytes, begins: Ints, ends: Ints, descriptors: Ints, addresses: Ints, buffers: Buffers
) -> tuple[Ints, int, int]:
    """Send datagrams in order, from these sockets to the addresses with these numbers, or to their peers.

    Returns when each was handed to the operating system, how many met a closed port, and how many failed otherwise.
    """
    sent_ns = np.empty(len(begins), np.int64)
    return sent_ns, *write_all(stream, begins, ends, descriptors, addresses, sent_ns, buffers)


def realtime_offset_ns() -> int:
    """The offset from the monotonic clock to ns since 1970."""
    return _offset_ns(_words())


def number_of(address: tuple[str, int]) -> int:
    """A number for an address, from 0 up."""
    host, port = address
    return int.from_bytes(port.to_bytes(2, "big") + socket.inet_aton(host), "little")


@lru_cache(maxsize=4096)
def address_of(number: int) -> tuple[str, int]:
    data = number.to_bytes(6, "little")
    return socket.inet_ntoa(data[2:]), int.from_bytes(data[:2], "big")


def joined(datagrams: Sequence[bytes]) -> tuple[Bytes, Ints]:
    """Datagrams concatenated in one array, and where each begins and the last ends."""
    stream = np.frombuffer(bytearray().join(datagrams), np.uint8)
    return stream, np.cumsum([0, *map(len, datagrams)])


def _words() -> Ints:
    return np.zeros(_WORDS, np.int64)


@kernel
def _clock_ns(clock: int, words: Ints) -> int:
    _clock_gettime(clock, words.ctypes.data + 8 * _CLOCK)
    return words[_CLOCK] * NS_PER_S + words[_CLOCK + 1]


@kernel
def _offset_ns(words: Ints) -> int:
    """The offset by the quickest of three readings of both clocks, as the process may be interrupted between them."""
    quickest_ns, offset_ns = _LONGEST_NS, 0
    for _ in range(3):
        before_ns, real_ns, after_ns = monotonic_ns(words), _clock_ns(_REALTIME, words), monotonic_ns(words)
        if after_ns - before_ns < quickest_ns:
            quickest_ns, offset_ns = after_ns - before_ns, real_ns - (before_ns + after_ns) // 2
    return offset_ns


@kernel
def monotonic_ns(words: Ints) -> int:
    """The time on the monotonic clock."""
    return _clock_ns(_MONOTONIC, words)


@kernel
def read_all(descriptors: Ints, most: int, buffers: Buffers) -> tuple[int, int, int, int]:
    """Read at most `most` datagrams from each socket; returns the last arguments of `batch`."""
    words = buffers.words
    begin_ns, words[OFFSET] = monotonic_ns(words), _offset_ns(words)
    count, end, errors, empty = _read(descriptors, most, buffers)
    read_ns = monotonic_ns(words)
    _to_monotonic(buffers.table, count, -words[OFFSET], words[_EMPTIED], read_ns)
    if empty:
        words[_EMPTIED] = begin_ns
    return count, end, errors, read_ns


@kernel
def _read(descriptors: Ints, most: int, buffers: Buffers) -> tuple[int, int, int, bool]:
    """Read sockets; returns the numbers of datagrams, bytes and errors, and whether all sockets are empty."""
    stream, table, words, together = buffers
    base, room = words.ctypes.data, table.shape[1] - (_MOST_FRAMES if len(together) else 1)
    count = end = errors = 0
    empty = True
    for descriptor in descriptors:
        emptied = False
        for _ in range(most):
            if count > room or end + _LONGEST_DATAGRAM > len(stream):
                return count, end, errors, False
            words[0], words[1], words[2], words[3] = base + 8 * _NAME, _NAME_BYTES, base + 8 * _VECTOR, 1
            words[4], words[5] = base + 8 * _CONTROL, _CONTROL_BYTES
            words[_VECTOR], words[_VECTOR + 1] = stream.ctypes.data + end, _LONGEST_DATAGRAM
            size = _recvmsg(descriptor, base, _DONTWAIT)
            if size >= 0:
                stamp_ns = words[_STAMP] * NS_PER_S + words[_STAMP + 1] if words[5] > 0 else 0
                frames = _frames(stream, end, end + size) if len(together) else 1
                for _ in range(frames):
                    part = size if frames == 1 else _frame_bytes(stream, end, len(stream))
                    table[0, count], table[1, count], table[2, count] = end, end + part, words[_NAME] >> 16 & _48_BITS
                    table[3, count], table[4, count] = stamp_ns, descriptor
                    count, end = count + 1, end + part
            elif _errno()[0] == _EAGAIN:
                emptied = True
                break
            else:
                errors += 1
        empty = empty and emptied
    return count, end, errors, empty


@kernel
def _to_monotonic(table: Ints, count: int, offset_ns: int, emptied_ns: int, read_ns: int) -> None:
    """Convert the stamps of `count` datagrams, 0 where there is none, to the monotonic clock, in place.

    The stamps jump if the wall clock is set, so they are clipped: nothing arrived before the sockets were last empty.
    """
    for k in range(count):
        stamp_ns = table[3, k] + offset_ns if table[3, k] else read_ns
        table[3, k] = min(max(stamp_ns, emptied_ns), read_ns)


@kernel
def _frame_bytes(stream: Bytes, begin: int, end: int) -> int:
    """The size of the MAVLink frame that begins here; 0 if none does, or if it is incomplete."""
    if end - begin < 3:
        return 0
    size = 0
    if stream[begin] == _VERSION_2:
        size = _OVERHEAD_2 + int64(stream[begin + 1]) + _SIGNATURE * int64(stream[begin + 2] & 1)
    elif stream[begin] == _VERSION_1:
        size = _OVERHEAD_1 + int64(stream[begin + 1])
    return size if begin + size <= end else 0


@kernel
def _is_frame(stream: Bytes, begin: int, end: int) -> bool:
    """Whether these bytes are exactly one frame, as far as its size tells."""
    size = _frame_bytes(stream, begin, end)
    return size > 0 and size == end - begin


@kernel
def _frames(stream: Bytes, begin: int, end: int) -> int:
    """How many frames fill a datagram without a gap; 1 if it holds anything else."""
    frames, place = 0, begin
    while place < end:
        size = _frame_bytes(stream, place, end)
        if not size:
            return 1
        frames, place = frames + 1, place + size
    return max(1, frames)


@kernel
def write_all(
    stream: Bytes, begins: Ints, ends: Ints, descriptors: Ints, addresses: Ints, sent_ns: Ints, buffers: Buffers
) -> tuple[int, int]:
    """As `write`; the times are put into `sent_ns`."""
    refused = failed = first = 0
    while first < len(begins):
        place, size, stop = stream.ctypes.data + begins[first], ends[first] - begins[first], first + 1
        while (
            stop < len(begins)
            and descriptors[stop] == descriptors[first]
            and addresses[stop] == addresses[first]
            and size + ends[stop] - begins[stop] <= len(buffers.together)
            and _is_frame(stream, begins[first], ends[first])
            and _is_frame(stream, begins[stop], ends[stop])
        ):
            size += ends[stop] - begins[stop]
            stop += 1
        if stop > first + 1:
            place, size = buffers.together.ctypes.data, 0
            for k in range(first, stop):
                for byte in range(begins[k], ends[k]):
                    buffers.together[size] = stream[byte]
                    size += 1
        time_ns, error = _send(place, size, descriptors[first], addresses[first], buffers.words)
        for k in range(first, stop):
            sent_ns[k] = time_ns
        if error == _REFUSED:
            refused += 1
        elif error:
            failed += 1
        first = stop
    return refused, failed


@kernel
def _send(place: int, size: int, descriptor: int, address: int, words: Ints) -> tuple[int, int]:
    """Send the bytes at a place in memory to the address with this number, or to the socket's peer.

    Returns when they were handed to the operating system, and its error number, or 0.
    """
    name = name_size = 0
    if address != NO_ADDRESS:
        words[_NAME], words[_NAME + 1] = address << 16 | _IPV4, 0
        name, name_size = words.ctypes.data + 8 * _NAME, _NAME_BYTES
    sent_ns = monotonic_ns(words)  # before: an answer may come before the call returns
    if _sendto(descriptor, place, size, _DONTWAIT, name, name_size) < 0:
        return sent_ns, int64(_errno()[0])
    return sent_ns, 0
