"""An emulated one-way radio link: a queue ordered by the time each datagram comes out.

A datagram's fate is decided when it enters, in `send`, and nowhere else: further effects (jitter, loss, duplicates)
belong there, with a stream of their own per vehicle and direction and the same number of draws for every datagram.
"""

import heapq

from scenarios import schema
from scenarios.schema import NS_PER_S

NEVER_NS = 2**63 - 1
CAPACITY = 10_000
"""Most datagrams on their way: 100 s of delay at 50 Hz twice over. What does not fit is dropped and counted."""


class Link:
    """Datagrams on their way."""

    def __init__(self, link: schema.Link, *, capacity: int = CAPACITY) -> None:
        self.least_delay_ns = round(link.delay_s * NS_PER_S)
        """No datagram takes less time than this."""
        self.next_due_ns = NEVER_NS
        self.sent = 0
        self.dropped = 0
        self._capacity = capacity
        self._queue: list[tuple[int, int, int, bytes]] = []

    def send(self, data: bytes, time_ns: int) -> None:
        """Let a datagram enter the link."""
        if len(self._queue) >= self._capacity:
            self.dropped += 1
            return
        self.sent += 1  # also the order of datagrams that are due at one instant: first in, first out
        heapq.heappush(self._queue, (time_ns + self.least_delay_ns, self.sent, time_ns, data))
        self.next_due_ns = self._queue[0][0]

    def due(self, now_ns: int) -> list[tuple[bytes, int]]:
        """The datagrams that have come out by now, in the order they did, each with the exact instant."""
        return [(data, due_ns) for data, due_ns, _ in self.due_entered(now_ns)]

    def due_entered(self, now_ns: int) -> list[tuple[bytes, int, int]]:
        """As `due`, each with the instant it entered as well."""
        out: list[tuple[bytes, int, int]] = []
        queue = self._queue
        while queue and queue[0][0] <= now_ns:
            due_ns, _, entered_ns, data = heapq.heappop(queue)
            out.append((data, due_ns, entered_ns))
        self.next_due_ns = queue[0][0] if queue else NEVER_NS
        return out
