"""Emulated one-way radio links: each is a queue of datagrams ordered by due time.

A datagram's fate is decided once, when it enters (`Link.send`): `fate` draws it, `queue` applies it, and `Channel` says
how long the datagram waits for bandwidth. A link that only delays by a constant draws no random numbers.
"""

from collections import Counter, deque

import numpy as np

from scenarios import schema
from scenarios.kernel import Cell, kernel
from scenarios.keys import link as link_keys
from scenarios.networks import MOST_IN_NETWORK
from scenarios.schema import NS_PER_S
from sim_vehicles.links import truth
from sim_vehicles.links.fate import BLOCK, Stream, constant, delay_at, flip, flips_of, in_outage
from sim_vehicles.links.queue import NOT_READY, Queues, enter_at, has_room, new_queues, take_due_at
from sim_vehicles.links.truth import DROPPED, DUPLICATE, FATES, LINK_DOWN, LINK_FULL, LINK_UP, PASSED, Recorder, Row
from sim_vehicles.services.clock import NEVER_NS
from sim_vehicles.services.draws import Use, seeds_of
from sim_vehicles.services.frames import FRAME_BYTES
from sim_vehicles.services.mavlink import message_id

CAPACITY = 10_000
"""Maximum number of datagrams under way: twice what 100 s of delay at 50 Hz need. Any more are dropped and counted."""

SETPOINT_IDS = (82, 84, 86)
"""SET_ATTITUDE_TARGET and SET_POSITION_TARGET_LOCAL_NED and _GLOBAL_INT: the first such message begins the flight."""


def is_set_point(data: bytes) -> bool:
    """Whether a frame is one of the messages that begin the flight."""
    return message_id(data) in SETPOINT_IDS


Entry = tuple[int, int, int, bytes, int, int]
"""(due_ns, number, entered_ns, data, fate, queued_ns). A duplicate has the number of its original."""


class Channel:
    """Limited bandwidth, of one link or shared by several: a drop-tail queue before one transmitter.

    It sends one datagram at a time, in order of arrival; at equal times, in order of the calls of `send`.
    """

    def __init__(self, channel: link_keys.Channel) -> None:
        self._ns_per_byte = channel.bits_per_byte * NS_PER_S / channel.bandwidth_bit_s
        self._most_bytes = channel.queue_bytes
        self._most_datagrams = channel.queue_datagrams
        self._free_ns = 0
        """When everything accepted so far has been sent."""
        self.needed_ns = 0
        """The time that it takes to send everything offered so far, dropped or not."""
        self._waiting: deque[tuple[int, int]] = deque()
        """(when its sending begins, bytes) of each datagram that was waiting at the last call, in order."""
        self._waiting_bytes = 0

    def send(self, size_bytes: int, time_ns: int) -> tuple[int, int] | None:
        """Start and end of a datagram's transmission, or None if the queue is full.

        Calls must be in order of time.
        """
        waiting, takes_ns = self._waiting, round(size_bytes * self._ns_per_byte)
        self.needed_ns += takes_ns
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
        self._free_ns = begin_ns + takes_ns
        return begin_ns, self._free_ns


class Link:
    """One direction of a vehicle's link: a row of `Queues`.

    `counts` holds the numbers of datagrams `duplicated`, `corrupted`, and dropped for each reason. Datagrams that
    entered, plus duplicates, equal those that came out, were dropped, or are under way.
    """

    next_due_ns = Cell[int]()
    entered = Cell[int]()
    least_delay_ns = Cell[int]()
    """Lower bound of every datagram's delay."""
    under_way = Cell[int]()
    """How many datagrams have neither come out nor been dropped."""
    plain = Cell[bool]()
    """Whether kernels alone can run it: it has no channel and no outages, and its delay without jitter is constant."""
    _drawn, _made = Cell[int](), Cell[int]()
    _barred, _corrupt = Cell[int](), Cell[float]()

    def __init__(
        self,
        link: link_keys.Link,
        *,
        capacity: int = CAPACITY,
        seed: int = 0,
        system_id: int = 0,
        kind: int = LINK_UP,
        channel: Channel | None = None,
        queues: Queues | None = None,
        row: int = 0,
    ) -> None:
        self.kind = kind
        self.system_id = system_id
        self.zero_ns = NEVER_NS
        """Host time at which the link's own time is 0."""
        points_s = [(point.at_s, point.delay_s) for point in link.delay_points] or [(0.0, link.delay_s)]
        self._points_ns = [(_ns(time_s), _ns(delay_s)) for time_s, delay_s in points_s]
        self._outages_ns = [(_ns(outage.from_s), _ns(outage.until_s)) for outage in link.outages]
        self._capacity = capacity
        self._channel = channel
        self._queues, self._row = new_queues(1) if queues is None else queues, row
        self._columns = self._queues.columns
        self._long: dict[tuple[int, int], bytes] = {}
        """Datagrams longer than a frame, by (number, DUPLICATE or 0)."""
        self._stream: Stream | None = None
        if channel is not None or not constant(link):
            self._stream = Stream(link, seeds_of(seed, system_id, Use.LINK_UP if kind == LINK_UP else Use.LINK_DOWN))
            self._made = 0
        self._delay_ns = self._points_ns[0][1]
        least_jitter_ns = 0 if link.jitter is None else _ns(link.jitter.least_s)
        least_delay_ns = max(0, min(delay_ns for _, delay_ns in self._points_ns) + least_jitter_ns)
        plain = channel is None and len(self._points_ns) == 1 and not self._outages_ns
        values = {"kind": kind, "system_id": system_id, "plain": plain}
        values |= {"capacity": capacity, "random": self._stream is not None, "reordering": link.reordering}
        values |= {"delay_ns": self._delay_ns, "least_delay_ns": least_delay_ns}
        values |= {"duplicate": link.duplicate_probability, "corrupt": link.corrupt_probability}
        loss = link.loss_bursts or link_keys.LossBursts(
            to_bad_probability=0.0, to_good_probability=1.0, loss_good_probability=link.loss_probability
        )
        values |= {"to_bad": loss.to_bad_probability, "to_good": loss.to_good_probability}
        values |= {"loss_good": loss.loss_good_probability, "loss_bad": loss.loss_bad_probability}
        for name, value in values.items():
            self._columns[name][row] = value

    @property
    def counts(self) -> Counter[str]:
        return Counter({name: count for name in FATES.values() if (count := self._columns[name][self._row])})

    @property
    def dropped(self) -> int:
        """Number of datagrams dropped, for whatever reason."""
        return sum(self.counts[FATES[fate]] for fate in (truth.LOST, truth.OUTAGE, truth.QUEUE_FULL, LINK_FULL))

    def send(self, data: bytes, time_ns: int) -> None:
        """Take in a datagram that enters the link at `time_ns`."""
        begin_ns = end_ns = time_ns
        delay_ns = self._delay_ns
        if not self.plain:
            link_time_ns = time_ns - self.zero_ns
            delay_ns, self._barred = delay_at(self._points_ns, link_time_ns), PASSED
            if in_outage(self._outages_ns, link_time_ns):
                self._barred = truth.OUTAGE
            elif self._channel is not None and self.under_way < self._capacity:
                sending_ns = self._channel.send(len(data), time_ns)
                begin_ns, end_ns = sending_ns or (time_ns, time_ns)
                self._barred = PASSED if sending_ns else truth.QUEUE_FULL
        entering = np.frombuffer(data, np.uint8), time_ns, begin_ns, end_ns, delay_ns
        pool, fate = self._queues, NOT_READY
        while fate == NOT_READY:
            fate = enter_at(pool.links, pool.entries, pool.frames, pool.draws, pool.truth, self._row, *entering)
            if fate == NOT_READY:
                self.make_ready()
        if len(data) > FRAME_BYTES:
            self._keep(data, fate)

    def due(self, now_ns: int) -> list[Entry]:
        """Remove and return the datagrams due by now, in order."""
        out: list[Entry] = []
        queues = self._queues
        while self.next_due_ns <= now_ns and (entry := take_due_at(queues.links, queues.entries, self._row, now_ns)):
            due_ns, number, entered_ns, fate, queued_ns, size, _, _ = queues.entries[entry].item()
            if size <= FRAME_BYTES:
                data = queues.frames[entry, :size].tobytes()
            else:
                data = self._long.pop((number, fate & DUPLICATE))
            out.append((due_ns, number, entered_ns, data, fate, queued_ns))
        return out

    def row(self, entry: Entry, time_ns: int) -> Row:
        """The truth record of a datagram that left at `time_ns`."""
        due_ns, _, entered_ns, data, fate, queued_ns = entry
        return self.kind, self.system_id, message_id(data), time_ns, entered_ns, due_ns, fate, queued_ns

    def draw(self) -> None:
        """Make the next block of draws, unless a whole block is left."""
        if self._stream is not None and self._made - self._drawn < BLOCK:
            draws = self._queues.draws[self._row]
            place = self._made % len(draws)
            self._stream.fill(draws[place : place + BLOCK])
            self._made += BLOCK

    def make_ready(self) -> None:
        """Make sure that a datagram and a duplicate can enter: that draws, free entries and free records are left."""
        self.draw()
        if not has_room(self._queues.entries):
            self._queues.grow()
        if self._queues.recorder is not None:
            self._queues.recorder.make_room()

    def _keep(self, data: bytes, fate: int) -> None:
        """Store a datagram longer than a frame, with its corruption and its duplicate, unless it is dropped."""
        if fate & DROPPED and not fate & DUPLICATE:
            return
        if fate & truth.CORRUPTED:
            draws, changed = self._queues.draws[self._row], np.frombuffer(bytearray(data), np.uint8)
            draw = draws[(self._drawn - 1) % len(draws)]
            flip(changed, len(data), draw["flips"], flips_of(self._corrupt, float(draw["corrupt"])))
            data = changed.tobytes()
        self._long[self.entered, 0] = data
        if fate & DUPLICATE and not fate & DROPPED:
            self._long[self.entered, DUPLICATE] = data


@kernel
def row_of(number: int, kind: int) -> int:
    """Row of a vehicle's link in the queues of a `LinkSet`, which numbers vehicles in the order of their first use."""
    return 2 * number + (kind == LINK_DOWN)


class LinkSet:
    """The links of all vehicles of a scenario, with the channels they share and their common time.

    `most` is the maximum number of vehicles.
    """

    def __init__(
        self, scenario: schema.Scenario, start_ns: int, *, recorder: Recorder | None = None, most: int = MOST_IN_NETWORK
    ) -> None:
        self._scenario = scenario
        self._channels: dict[tuple[str, int, int], Channel] = {}
        self._known = {channel.name: channel for channel in scenario.links.channels}
        self._pairs: dict[int, tuple[Link, Link]] = {}
        self._in_rows: list[Link] = []
        self.queues = new_queues(2 * most, recorder)
        """Queues of all links, indexed by `row_of`."""
        self.zero_ns = start_ns if scenario.links.times_from == "start" else NEVER_NS
        """Host time at which the links' time is 0; NEVER_NS before the flight has begun."""

    @property
    def have_channels(self) -> bool:
        """Whether links use channels, so that datagrams must enter in order of time."""
        return bool(self._channels)

    def channel_needs_s(self) -> dict[str, float]:
        """The time (s) that the channel of each name needs for everything offered; the longest of several."""
        needs_s = dict[str, float]()
        for (name, _, _), channel in self._channels.items():
            needs_s[name] = max(needs_s.get(name, 0.0), channel.needed_ns / NS_PER_S)
        return needs_s

    def of(self, system_id: int) -> tuple[Link, Link]:
        """The (up, down) links of a vehicle, the same at every call."""
        if system_id not in self._pairs:
            up, down = self._scenario.link_of(system_id)
            pair = self._new(up, system_id, LINK_UP), self._new(down, system_id, LINK_DOWN)
            self._pairs[system_id] = pair
            self._in_rows += pair
        return self._pairs[system_id]

    @property
    def next_due_ns(self) -> int:
        """When the next datagram of any link comes out; NEVER_NS if none is under way."""
        return int(self.queues.links["next_due_ns"].min())

    def due(self, now_ns: int) -> list[Link]:
        """The links with a datagram due by now."""
        due = self.queues.links["next_due_ns"] <= now_ns
        return [self._in_rows[row] for row in due.nonzero()[0].tolist()]

    def draw(self) -> None:
        """Make the next block of draws of each link that has less than a block left."""
        links = self.queues.links
        for row in (links["made"] - links["drawn"] < BLOCK).nonzero()[0].tolist():
            self._in_rows[row].draw()

    def hear(self, data: bytes, time_ns: int) -> None:
        """Begin the flight and the links' time, if this is the station's first set-point."""
        if is_set_point(data) and time_ns < self.zero_ns:
            self.zero_ns = time_ns
            for link in self._in_rows:
                link.zero_ns = time_ns

    def counters(self) -> Counter[str]:
        """Counts of all links: `link_up_lost` and so on, as in Link.counts."""
        total: Counter[str] = Counter()
        for up, down in self._pairs.values():
            total.update({f"link_up_{name}": count for name, count in up.counts.items()})
            total.update({f"link_down_{name}": count for name, count in down.counts.items()})
            total["link_up_dropped"] += up.dropped
            total["link_down_dropped"] += down.dropped
        return total

    def _new(self, link: link_keys.Link, system_id: int, kind: int) -> Link:
        row, channel = row_of(len(self._pairs), kind), self._channel(link.channel, system_id, kind)
        made = Link(
            link, seed=self._scenario.seed, system_id=system_id, kind=kind, channel=channel, queues=self.queues, row=row
        )
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


def _ns(time_s: float) -> int:
    return round(time_s * NS_PER_S)
