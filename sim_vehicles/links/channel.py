"""Limited bandwidth, of one link or shared by several: a drop-tail queue with one sender."""

from collections import deque

from scenarios import link_schema
from scenarios.schema import NS_PER_S


class Channel:
    """Sends one datagram at a time, in order of arrival; those of one instant in order of `send`."""

    def __init__(self, channel: link_schema.Channel) -> None:
        self._ns_per_byte = channel.bits_per_byte * NS_PER_S / channel.bandwidth_bit_s
        self._most_bytes = channel.queue_bytes
        self._most_datagrams = channel.queue_datagrams
        self._free_ns = 0
        """When everything accepted so far has been sent."""
        self._waiting: deque[tuple[int, int]] = deque()
        """(when its sending begins, bytes) of each datagram that was waiting at the last call, in order."""
        self._waiting_bytes = 0

    def send(self, size_bytes: int, time_ns: int) -> tuple[int, int] | None:
        """When the sending of a datagram begins and ends, or None if the queue is full.

        Successive calls must be in order of time.
        """
        waiting = self._waiting
        while waiting and waiting[0][0] <= time_ns:
            self._waiting_bytes -= waiting.popleft()[1]
        begin_ns = max(time_ns, self._free_ns)
        if begin_ns > time_ns:
            if self._most_bytes is not None and self._waiting_bytes + size_bytes > self._most_bytes:
                return None
            if self._most_datagrams is not None and len(waiting) >= self._most_datagrams:
                return None
            waiting.append((begin_ns, size_bytes))
            self._waiting_bytes += size_bytes
        self._free_ns = begin_ns + round(size_bytes * self._ns_per_byte)
        return begin_ns, self._free_ns
