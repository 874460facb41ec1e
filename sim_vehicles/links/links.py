"""An emulated one-way radio link: a queue ordered by the time each datagram comes out.

A datagram's fate is decided once, when it enters (`Link.send`): `fate` says what happens to it, `Channel` how long it
waits for bandwidth. A link that only delays by a constant draws no random numbers.
"""

import heapq
from collections import Counter, deque

from scenarios import schema
from scenarios.keys import link as link_keys
from scenarios.schema import NS_PER_S
from sim_vehicles.links import truth
from sim_vehicles.links.fate import Stream, behaviour_of, constant, flipped, outcome
from sim_vehicles.links.truth import DUPLICATE, FATES, LINK_DOWN, LINK_FULL, LINK_UP, PASSED, Record, Row
from sim_vehicles.services.clock import NEVER_NS
from sim_vehicles.services.draws import Use, seeds_of
from sim_vehicles.services.mavlink import message_id

CAPACITY = 10_000
"""Most datagrams under way, twice what 100 s of delay at 50 Hz need. A full link drops and counts the rest."""

SETPOINT_IDS = (82, 84, 86)
"""SET_ATTITUDE_TARGET and SET_POSITION_TARGET_LOCAL_NED and _GLOBAL_INT: the first such message begins the flight."""


def is_set_point(data: bytes) -> bool:
    """Whether a frame is one of the messages that begin the flight."""
    return message_id(data) in SETPOINT_IDS


Entry = tuple[int, int, int, bytes, int, int]
"""(due_ns, number, entered_ns, data, fate, queued_ns). A duplicate has the number of its original."""


class Channel:
    """Limited bandwidth, of one link or shared by several: a drop-tail queue with one sender.

    Sends one datagram at a time, in order of arrival; those of one instant in order of `send`.
    """

    def __init__(self, channel: link_keys.Channel) -> None:
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


class Link:
    """Datagrams under way in one direction.

    `counts` says by name what happened to them: `duplicated`, `corrupted`, and why they were dropped. Datagrams that
    entered, plus duplicates, equal those that came out, were dropped, or are under way.
    """

    def __init__(
        self,
        link: link_keys.Link,
        *,
        capacity: int = CAPACITY,
        seed: int = 0,
        system_id: int = 0,
        kind: int = LINK_UP,
        channel: Channel | None = None,
        record: Record | None = None,
    ) -> None:
        self.kind = kind
        self.system_id = system_id
        self.next_due_ns = NEVER_NS
        self.entered = 0
        self.counts: Counter[str] = Counter()
        self.zero_ns = NEVER_NS
        """Host time at which the link's own time is 0."""
        self.behaviour = behaviour_of(link)
        self.least_delay_ns = self.behaviour.least_delay_ns
        """No datagram takes less time than this."""
        self._capacity = capacity
        self._channel = channel
        self._record = record
        self._queue: list[Entry] = []
        self._last_due_ns = 0
        self._bad = False
        self._stream = None
        if channel is not None or not constant(link):
            self._stream = Stream(link, seeds_of(seed, system_id, Use.LINK_UP if kind == LINK_UP else Use.LINK_DOWN))

    @property
    def under_way(self) -> int:
        """How many datagrams have neither come out nor been dropped."""
        return len(self._queue)

    @property
    def dropped(self) -> int:
        """How many datagrams never come out."""
        return sum(self.counts[FATES[fate]] for fate in (truth.LOST, truth.OUTAGE, truth.QUEUE_FULL, LINK_FULL))

    def send(self, data: bytes, time_ns: int) -> None:
        """Take in a datagram that enters the link at `time_ns`."""
        self.entered += 1  # also the order of datagrams that are due at one instant: first in, first out
        if self._stream is not None:
            self._send_drawn(data, time_ns, self._stream)
        elif len(self._queue) >= self._capacity:
            self._drop(data, time_ns, LINK_FULL)
        else:
            heapq.heappush(self._queue, (time_ns + self.least_delay_ns, self.entered, time_ns, data, PASSED, 0))
            self.next_due_ns = self._queue[0][0]

    def due(self, now_ns: int) -> list[Entry]:
        """The datagrams that have come out by now, in order."""
        out: list[Entry] = []
        queue = self._queue
        while queue and queue[0][0] <= now_ns:
            out.append(heapq.heappop(queue))
        self.next_due_ns = queue[0][0] if queue else NEVER_NS
        return out

    def row(self, entry: Entry, time_ns: int) -> Row:
        """The truth record of a datagram that left at `time_ns`."""
        due_ns, _, entered_ns, data, fate, queued_ns = entry
        return self.kind, self.system_id, message_id(data), time_ns, entered_ns, due_ns, fate, queued_ns

    def _send_drawn(self, data: bytes, time_ns: int, stream: Stream) -> None:
        found = outcome(self.behaviour, bad=self._bad, time_ns=time_ns - self.zero_ns, draws=stream.next())
        self._bad = found.bad
        begin_ns = end_ns = time_ns
        if found.fate & truth.OUTAGE:
            return self._drop(data, time_ns, truth.OUTAGE)
        if len(self._queue) >= self._capacity:
            return self._drop(data, time_ns, LINK_FULL)
        if self._channel is not None:
            sending_ns = self._channel.send(len(data), time_ns)
            if sending_ns is None:
                return self._drop(data, time_ns, truth.QUEUE_FULL)
            begin_ns, end_ns = sending_ns
        if found.fate & truth.LOST:
            return self._drop(data, time_ns, truth.LOST, begin_ns - time_ns)
        if found.fate & truth.CORRUPTED:
            self.counts[FATES[truth.CORRUPTED]] += 1
            data = flipped(data, found.flips)
        self._push(end_ns + found.delay_ns, time_ns, data, found.fate, begin_ns - time_ns)
        if found.duplicate_delay_ns >= 0:
            self.counts[FATES[DUPLICATE]] += 1
            if len(self._queue) >= self._capacity:
                return self._drop(data, time_ns, DUPLICATE | LINK_FULL)
            due_ns = end_ns + found.duplicate_delay_ns
            self._push(due_ns, time_ns, data, found.fate | DUPLICATE, begin_ns - time_ns)
        return None

    def _push(self, due_ns: int, entered_ns: int, data: bytes, fate: int, queued_ns: int) -> None:
        if not self.behaviour.reordering:
            self._last_due_ns = due_ns = max(due_ns, self._last_due_ns)
        heapq.heappush(self._queue, (due_ns, self.entered, entered_ns, data, fate, queued_ns))
        self.next_due_ns = self._queue[0][0]

    def _drop(self, data: bytes, time_ns: int, fate: int, queued_ns: int = 0) -> None:
        self.counts[FATES[fate & ~DUPLICATE]] += 1
        if self._record is not None:
            row = (self.kind, self.system_id, message_id(data), time_ns, time_ns, time_ns, fate, queued_ns)
            self._record(row)


class LinkSet:
    """The links of all vehicles of a scenario, with the channels they share and their common time."""

    def __init__(self, scenario: schema.Scenario, start_ns: int, *, record: Record | None = None) -> None:
        self._links = scenario.links
        self._seed = scenario.seed
        self._record = record
        self._channels: dict[tuple[str, int, int], Channel] = {}
        self._known = {channel.name: channel for channel in scenario.links.channels}
        self._pairs: dict[int, tuple[Link, Link]] = {}
        self.zero_ns = start_ns if scenario.links.times_from == "start" else NEVER_NS
        """Host time at which the links' time is 0; NEVER_NS before the flight has begun."""

    @property
    def have_channels(self) -> bool:
        """Whether links wait for one another, so that datagrams must enter in order of time."""
        return bool(self._channels)

    def of(self, system_id: int) -> tuple[Link, Link]:
        """The (up, down) links of a vehicle, the same at every call."""
        if system_id not in self._pairs:
            up, down = self._links.of(system_id)
            self._pairs[system_id] = self._made(up, system_id, LINK_UP), self._made(down, system_id, LINK_DOWN)
        return self._pairs[system_id]

    def hear(self, data: bytes, time_ns: int) -> None:
        """Look for the station's first set-point, which begins the flight and the links' time."""
        if is_set_point(data) and time_ns < self.zero_ns:
            self.zero_ns = time_ns
            for link in (link for pair in self._pairs.values() for link in pair):
                link.zero_ns = time_ns

    def counters(self) -> Counter[str]:
        """What happened on all links: `link_up_lost` and so on, as in Link.counts."""
        total: Counter[str] = Counter()
        for up, down in self._pairs.values():
            total.update({f"link_up_{name}": count for name, count in up.counts.items()})
            total.update({f"link_down_{name}": count for name, count in down.counts.items()})
            total["link_up_dropped"] += up.dropped
            total["link_down_dropped"] += down.dropped
        return total

    def _made(self, link: link_keys.Link, system_id: int, kind: int) -> Link:
        made = Link(
            link, seed=self._seed, system_id=system_id, kind=kind, channel=self._channel(link.channel, system_id, kind),
            record=self._record,
        )  # fmt: skip
        made.zero_ns = self.zero_ns
        return made

    def _channel(self, name: str | None, system_id: int, kind: int) -> Channel | None:
        if name is None:
            return None
        known = self._known[name]
        key = (name, 0 if known.shared else system_id, 0 if known.half_duplex else kind)
        if key not in self._channels:
            self._channels[key] = Channel(known)
        return self._channels[key]
