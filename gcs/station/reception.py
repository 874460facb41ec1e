"""Processes received datagrams: updates each vehicle's clock, states, link statistics and start-up.

Nearly all datagrams hold one LOCAL_POSITION_NED, a TIMESYNC, or a heartbeat like the last one. One kernel processes
these, up to the first datagram that is anything else. That one is decoded frame by frame in Python, with the same
kernels where they apply.
"""

from collections import Counter
from collections.abc import Sequence
from math import isfinite, nan
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray
from gcs.control.fleet import Fleet
from gcs.control.history import StateHistory, add_report
from gcs.control.tick import CLOCK_JUMPED
from gcs.link import mavlink
from gcs.link.clocks import MOST_PENDING, UNKNOWN, bound_at_ns, estimate_of, reply, request, sampled_ns
from gcs.link.datagram import NETWORK_BIT, Arrivals, Datagram, Frames, Outbox, arrivals_of, network_at
from gcs.link.mavlink import (
    HEARTBEAT,
    LOCAL_POSITION_NED,
    TIMESYNC,
    common_message,
    float_at,
    unsigned_at,
)
from gcs.link.sequence import DUPLICATE, NEW, count
from gcs.link.vehicle import (
    FORGET_NUMBERS_NS,
    MAVLINK_1,
    RemoteVehicle,
    Report,
    delivery_ns,
    heartbeat_state,
    note_ports,
)
from scenarios.kernel import Array, Records, array_kernel, int64, kernel
from scenarios.networks import LAST_NETWORK, network_of, system_id_of, wire_id

AUTOPILOT_COMPONENT = 1
"""Component id of the autopilot. A camera, gimbal or companion has the vehicle's system id and sends its own
heartbeats, perhaps from another port: they show neither where the autopilot is nor that it is alive."""
ANOTHER_ADDRESS = "known system id from another address"
NOT_FINITE = "not finite"
_HEADER_BYTES, _CHECKSUM_BYTES = 10, 2
REPORTED = np.dtype(
    [
        ("boot_ms", "i8"),
        ("down_m", "f8"),
        ("velocity_down_m_s", "f8"),
        ("queue_s", "f8"),  # wait in the socket buffer
        ("received_ns", "i8"),  # the operating system's receive timestamp
        ("bound_s", "f8"),  # largest error of the instant at which the state was sampled
    ]
)
"""Data received with a vehicle's newest state."""
_ORDER, _DELIVERY, _JUMP, _EXCHANGE, ANSWER = range(5)
_NEWS = np.dtype([("kind", "i8"), ("row", "i8"), ("value_ns", "i8"), ("sent_ns", "i8")])
"""Work that a kernel leaves to Python. _ORDER: report a frame order (value_ns); _DELIVERY: pass to the loop the one-way
delay (value_ns) of a message sent at sent_ns; _JUMP: begin anew; _EXCHANGE: send the request with ts1 = value_ns;
ANSWER: answer the request with ts1 = sent_ns that arrived at value_ns. One frame makes at most NEWS_OF_A_FRAME."""
NEWS_OF_A_FRAME = 3


class Tables(NamedTuple):
    """The tables on which kernels work, one row for each of n vehicles."""

    links: Records
    clocks: Records
    exchanges: Records
    pending_ns: NDArray[np.int64]
    counters: Records
    reports: Records
    report_counts: NDArray[np.int64]
    reported: Records
    telemetry_ns: NDArray[np.int64]
    """When the newest state arrived."""
    frame_ned_m: FloatArray
    fresh_ns: NDArray[np.int64]
    """Round trips not yet in any tick, oldest first; `fresh_counts` holds their number in each row."""
    fresh_counts: NDArray[np.int64]
    news: Records
    news_count: NDArray[np.int64]
    """Number of valid entries in `news`, (1,)."""


class Now(NamedTuple):
    """The time of a step, and parameters common to all vehicles."""

    now_ns: int
    start_ns: int
    """The zero of the stamps in set-points."""
    period_ns: int
    """Minimum time between two exchanges requested because of refused states."""
    heeds_deliveries: bool
    """Whether the loop heeds deliveries."""


def new_reported(n: int) -> Records:
    """An array of REPORTED for vehicles that have reported nothing yet."""
    reported = np.zeros(n, REPORTED)
    for name in ("down_m", "velocity_down_m_s", "queue_s", "bound_s"):
        reported[name] = nan
    return reported


class Reception:
    """Receives what the vehicles of a fleet send. `report` takes events."""

    def __init__(self, fleet: Fleet, report: Report, *, start_ns: int, period_ns: int) -> None:
        self._fleet, self._report = fleet, report
        self._start_ns, self._period_ns = start_ns, period_ns
        n = len(fleet.vehicles)
        self.history = StateHistory(n)
        self.reported = new_reported(n)
        self.telemetry_ns = np.zeros(n, np.int64)
        """When the newest state of each vehicle arrived."""
        self.frames = Frames()
        """Frames received since the driver last took them."""
        self.counters: Counter[str] = Counter()
        """Number of refused frames, by reason."""
        self.touched: set[int] = set()
        """Rows of vehicles that have sent something kernels do not handle since `touched` was last cleared."""
        self._claimed_twice: set[int] = set()
        """Rows of vehicles whose second sender has been reported."""
        self._fresh = np.zeros((n, MOST_PENDING), np.int64), np.zeros(n, np.int64)
        self._row = {vehicle.system_id: row for row, vehicle in enumerate(fleet.vehicles)}
        self._wire_ids = np.array([*map(wire_id, self._row)])
        self.row_of = np.full((LAST_NETWORK + 1, 256), -1)
        for system_id, row in self._row.items():
            self.row_of[network_of(system_id), wire_id(system_id)] = row
        self._news_of(1)

    def _news_of(self, datagrams: int) -> None:
        """Allocate room for the news of this many datagrams."""
        links, history = self._fleet.links, self.history
        news = np.zeros(max(64, 2 * NEWS_OF_A_FRAME * datagrams), _NEWS)
        self.tables = Tables(
            links.known, *links.clocks, links.counters, history.reports, history.counts, self.reported,
            self.telemetry_ns, self._fleet.frame_ned_m, *self._fresh, news, np.zeros(1, np.int64),
        )  # fmt: skip

    def is_another(self, system_id: int, datagram: Datagram) -> bool:
        """Whether this system id, as on the wire, belongs to a vehicle that is known to send from another address."""
        row = self._row.get(system_id_of(network_at(datagram.address), system_id))
        return row is not None and self._fleet.vehicles[row].is_elsewhere(datagram.address, datagram.received_ns)

    def take(self, datagrams: Arrivals | Sequence[Datagram], now_ns: int, taken: int = 0) -> Outbox:
        """Process datagrams, except the first `taken`, which a kernel has processed; returns the answers to all."""
        outgoing = Outbox()
        if not len(datagrams):
            return outgoing
        arrivals = datagrams if isinstance(datagrams, Arrivals) else arrivals_of(datagrams)
        count, place = arrivals.table.shape[1], taken
        if taken:
            self.frames.add(arrivals, 0, taken)
            self._follow_up(outgoing)
        if NEWS_OF_A_FRAME * count > len(self.tables.news):
            self._news_of(count)
        now = Now(now_ns, self._start_ns, self._period_ns, self._fleet.loop.heeds_deliveries)
        while place < count:
            stop = take_common(
                self.tables, arrivals.stream, arrivals.table, arrivals.queued_ns, place, self.row_of, now
            )
            if stop > place:
                self.frames.add(arrivals, place, stop)
            self._follow_up(outgoing)
            if stop < count:
                self._take(arrivals.datagram(stop), now, outgoing)
            place = stop + 1
        return outgoing

    def _take(self, datagram: Datagram, now: Now, outgoing: Outbox) -> None:
        """Process one datagram with any content."""
        is_1 = datagram.data[:1] == b"\xfe"
        frames = mavlink.decode_either(datagram.data, self.counters)
        for frame in mavlink.in_network(frames, network_at(datagram.address)):
            row = self._row.get(frame.system_id)
            if row is None:
                self.counters["unknown system id"] += 1
                continue
            vehicle = self._fleet.vehicles[row]
            # PX4 sends heartbeats in MAVLink 1 until it is answered in MAVLink 2
            is_early = self._fleet.speaks_mavlink_1_first and frame.msg_id == HEARTBEAT
            if frame.component_id == AUTOPILOT_COMPONENT and not (is_1 and is_early):
                vehicle.unusable = MAVLINK_1 if is_1 else ""
            if is_1 and not is_early:
                self.counters["not MAVLink 2"] += 1
                continue
            if frame.component_id != AUTOPILOT_COMPONENT:
                self.counters["other component"] += 1
                if vehicle.address is None:
                    vehicle.unusable = f"is heard only as component {frame.component_id}, wanted 1, the autopilot"
                if vehicle.address == datagram.address:
                    self.frames.append((frame.data, datagram.received_ns, datagram.address))
                continue
            if vehicle.address != datagram.address:
                if not vehicle.accepts_address(datagram.address, frame.msg_id, datagram.received_ns):
                    self.counters["before a first heartbeat" if vehicle.address is None else ANOTHER_ADDRESS] += 1
                    if vehicle.is_elsewhere(datagram.address, datagram.received_ns) and row not in self._claimed_twice:
                        self._claimed_twice.add(row)
                        self._report("link", "has a second sender, whose frames are refused", vehicle.system_id)
                    continue
                vehicle.address = datagram.address
                note_ports(self._fleet.links.known, self._wire_ids)
                self._report("vehicle", "found", vehicle.system_id)
            vehicle.heard_ns = datagram.received_ns
            vehicle.first_heard_ns = vehicle.first_heard_ns or datagram.received_ns
            self.touched.add(row)
            self.frames.append((frame.data, datagram.received_ns, datagram.address))
            if vehicle.is_replay(frame, datagram.received_ns):
                continue
            if not mavlink.is_finite(frame):
                self.counters[NOT_FINITE] += 1
                continue
            self._handle(row, vehicle, frame, datagram, now, outgoing)

    def _handle(
        self,
        row: int,
        vehicle: RemoteVehicle,
        frame: mavlink.Frame,
        datagram: Datagram,
        now: Now,
        outgoing: Outbox,
    ) -> None:
        received_ns = datagram.received_ns
        fields: Any = frame.fields
        match frame.msg_id:
            case mavlink.LOCAL_POSITION_NED:
                boot_ms, *state = fields
                _take_position(self.tables, row, boot_ms, tuple(state), received_ns, datagram.queued_ns, now)
                self._follow_up(outgoing)
            case mavlink.POSITION_TARGET_LOCAL_NED:
                at_ns = vehicle.clock.station_ns(fields[0], received_ns)
                if at_ns is not None:
                    self._fleet.loop.active(row, at_ns, fields)
            case mavlink.TIMESYNC:
                tc1_ns, ts1_ns = fields
                if tc1_ns == 0:
                    vehicle.send_timesync(received_ns, ts1_ns, outgoing)
                else:
                    _take_reply(self.tables, row, tc1_ns, ts1_ns, received_ns, now)
                    self._follow_up(outgoing)
            case mavlink.HEARTBEAT:
                vehicle.heartbeat(fields, received_ns)
            case mavlink.COMMAND_ACK:
                vehicle.acknowledge(fields, received_ns)
            case mavlink.NAMED_VALUE_INT:
                possible = vehicle.named_int(fields, (received_ns - self._start_ns) // 1_000_000, received_ns)
                self.counters.update([] if possible else ["impossible LAG_MS"])
            case mavlink.STATUSTEXT:
                text = mavlink.text_of(fields[1])
                if vehicle.startup.is_news(text):
                    self._report("statustext", text, vehicle.system_id)
            case _:
                pass
        vehicle.pass_to_startup(frame.msg_id, fields)

    def _follow_up(self, outgoing: Outbox) -> None:
        """Do the work that kernels have left to Python."""
        count = self.tables.news_count.item()
        if not count:
            return
        news = self.tables.news[:count].tolist()
        self.tables.news_count[0] = 0
        for kind, row, value_ns, sent_ns in news:
            vehicle = self._fleet.vehicles[row]
            if kind == _ORDER:
                vehicle.report_order(value_ns)
            elif kind == _DELIVERY:
                self._fleet.loop.delivered(row, max(0, value_ns), sent_ns)
            elif kind == _JUMP:
                self.touched.add(row)
                vehicle.begin_anew()
                self._report("vehicle", CLOCK_JUMPED, vehicle.system_id)
            elif kind == ANSWER:
                vehicle.send_timesync(value_ns, sent_ns, outgoing)
            else:
                vehicle.send_timesync(0, value_ns, outgoing)


@kernel
def _note(all_news: Records, count: Array, kind: int, row: int, value_ns: int, sent_ns: int) -> None:
    news = all_news[count[0]]
    news.kind, news.row, news.value_ns, news.sent_ns = kind, row, value_ns, sent_ns
    count[0] += 1


@array_kernel
def take_fresh(fresh_ns: Array, counts: Array) -> FloatArray:
    """Remove and return each vehicle's oldest fresh round trip, in s; NaN if there is none."""
    found_s = np.empty(len(counts))
    for row in range(len(counts)):
        found_s[row] = nan
        if counts[row]:
            found_s[row] = fresh_ns[row, 0] * 1e-9
            counts[row] -= 1
            for place in range(counts[row]):
                fresh_ns[row, place] = fresh_ns[row, place + 1]
    return found_s


@kernel
def take_common(
    tables: Tables, stream: Array, table: Array, queued_ns: Array, first: int, row_of: Array, now: Now
) -> int:
    """Process datagrams from `first` on; returns the index of the first that needs Python, else their number.

    Stream, table and `queued_ns` are those of `Arrivals`.
    """
    for place in range(first, table.shape[1]):
        begin, end, address, received_ns = table[0, place], table[1, place], table[2, place], table[3, place]
        msg_id = common_message(stream, begin, end)
        if msg_id < 0 or stream[begin + 6] != AUTOPILOT_COMPONENT:
            return place
        row = row_of[address >> NETWORK_BIT, stream[begin + 5]]
        if row < 0 or tables.links[row].address != address:
            return place
        if not _take_frame(tables, row, msg_id, stream, begin, end, received_ns, queued_ns[place], now):
            return place
    return table.shape[1]


@kernel
def _take_frame(
    tables: Tables,
    row: int,
    msg_id: int,
    stream: Array,
    begin: int,
    end: int,
    received_ns: int,
    queued_ns: int,
    now: Now,
) -> bool:
    """Process a frame of a common message; does nothing and returns False if it may need more than kernels can do."""
    link, payload, payload_end = tables.links[row], begin + _HEADER_BYTES, end - _CHECKSUM_BYTES
    state = _state_at(stream, payload, payload_end)
    tc1_ns = int64(unsigned_at(stream, payload, 8, payload_end))
    if msg_id == LOCAL_POSITION_NED:
        known = isfinite(sum(state))
    elif msg_id == TIMESYNC:
        known = tc1_ns != 0 or link.launched  # a reply, or a request
    elif msg_id == HEARTBEAT:
        shown = heartbeat_state(int64(unsigned_at(stream, payload, 8, payload_end)))
        same = link.heartbeat != 0 and shown == link.heartbeat
        known = link.launched and same and received_ns - link.heartbeat_ns <= FORGET_NUMBERS_NS
    else:
        known = link.launched
    if not known:
        return False
    link.heard_ns = received_ns
    link.first_heard_ns = link.first_heard_ns or received_ns
    order = count(tables.counters[row], int64(stream[begin + 4]), received_ns)
    if order != NEW and not link.orders_reported >> order & 1:
        link.orders_reported |= 1 << order
        _note(tables.news, tables.news_count, _ORDER, row, order, 0)
    link.newest = order == NEW
    if order == DUPLICATE:
        return True
    if msg_id == LOCAL_POSITION_NED:
        boot_ms = int64(unsigned_at(stream, payload, 4, payload_end))
        _take_position(tables, row, boot_ms, state, received_ns, queued_ns, now)
    elif msg_id == TIMESYNC:
        ts1_ns = int64(unsigned_at(stream, payload + 8, 8, payload_end))
        if tc1_ns:
            _take_reply(tables, row, tc1_ns, ts1_ns, received_ns, now)
        else:
            _note(tables.news, tables.news_count, ANSWER, row, received_ns, ts1_ns)
    elif msg_id == HEARTBEAT and order == NEW:
        link.heartbeat_ns = received_ns
    return True


@kernel
def _state_at(stream: Array, payload: int, end: int) -> tuple[float, ...]:
    """Position and velocity, north, east and down, in the payload of a LOCAL_POSITION_NED."""
    return (
        float_at(stream, payload + 4, end), float_at(stream, payload + 8, end), float_at(stream, payload + 12, end),
        float_at(stream, payload + 16, end), float_at(stream, payload + 20, end), float_at(stream, payload + 24, end),
    )  # fmt: skip


@kernel
def _take_position(
    tables: Tables, row: int, boot_ms: int, state: tuple[float, ...], received_ns: int, queued_ns: int, now: Now
) -> None:
    """Process the fields of a LOCAL_POSITION_NED; `state` is position and velocity, north, east and down."""
    link, clock = tables.links[row], tables.clocks[row]
    link.local_ms, link.local_is_new = boot_ms, True
    for k in range(6):
        link.local[k] = state[k]
    sample_ns = sampled_ns(clock, boot_ms, received_ns, link.newest)
    if link.left_out:
        tables.telemetry_ns[row] = received_ns
        return  # its states are not used: others may fly over it while it is on the ground
    if sample_ns == UNKNOWN:
        if not (clock.lost or clock.doubtful_state):
            tables.telemetry_ns[row] = received_ns  # heard, though before the first exchange
        elif now.now_ns - clock.asked_ns >= now.period_ns:
            _note(tables.news, tables.news_count, _EXCHANGE, row, request(clock, tables.pending_ns[row], now.now_ns), 0)
        return
    origin = tables.frame_ned_m[row]
    north, east = state[0] + origin[0], state[1] + origin[1]
    if not add_report(tables.reports, tables.report_counts, row, sample_ns, north, east, state[3], state[4]):
        return
    tables.telemetry_ns[row] = received_ns  # new states only: a replay does not end a silence
    reported = tables.reported[row]
    reported.boot_ms, reported.down_m, reported.velocity_down_m_s = boot_ms, state[2] + origin[2], state[5]
    reported.queue_s, reported.received_ns = queued_ns * 1e-9, received_ns
    reported.bound_s = bound_at_ns(estimate_of(clock), sample_ns) * 1e-9


@kernel
def _take_reply(tables: Tables, row: int, tc1_ns: int, ts1_ns: int, received_ns: int, now: Now) -> None:
    """Process a reply to a TIMESYNC request."""
    link, clock = tables.links[row], tables.clocks[row]
    jumps = clock.jumps
    rtt_ns = reply(clock, tables.exchanges[row], tables.pending_ns[row], tc1_ns, ts1_ns, received_ns)
    if rtt_ns != UNKNOWN:
        if tables.fresh_counts[row] < len(tables.fresh_ns[row]):
            tables.fresh_ns[row, tables.fresh_counts[row]] = rtt_ns
            tables.fresh_counts[row] += 1
        if now.heeds_deliveries:
            key_ms = (ts1_ns - now.start_ns) // 1_000_000
            delivered_ns = delivery_ns(link, clock, key_ms, now.start_ns + key_ms * 1_000_000)
            _note(tables.news, tables.news_count, _DELIVERY, row, delivered_ns, ts1_ns)
    if clock.jumps != jumps:
        tables.report_counts[row] = 0
        _note(tables.news, tables.news_count, _JUMP, row, 0, 0)
