"""The fast path in virtual time: steps of plain vehicles and their station that kernels do alone, many in one call.

In most flights nearly all steps are of this kind. Where the kernel stops, for example when a vehicle answers a command
or changes its mode, a step in Python continues from there (`gcs.drive.lockstep`).
"""

from collections.abc import Generator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gcs.control.tick import TICK, TickArray
from gcs.link.datagram import Arrivals
from gcs.station.fast_path import DONE, NOT_JUDGED, WITH_TICK, FastPathData, Sending, fast_rows, fast_step
from gcs.station.station import Station
from scenarios.kernel import Columns, Records, array_kernel, kernel
from scenarios.sockets import Bytes, Ints
from sim_vehicles.drive.datagrams import Datagram, Datagrams
from sim_vehicles.drive.fleet import Fleet, FleetArrays
from sim_vehicles.links.queue import copy_bytes
from sim_vehicles.links.truth import can_record
from sim_vehicles.services.frames import FRAME_BYTES
from sim_vehicles.vehicles.plain import step_all

if TYPE_CHECKING:
    from scenarios.handle import Handle

_NOT_YET = -1
NOT_LEFT, PAUSED = -1, -2
"""Progress of a call, in addition to the codes of `fast_step`. NOT_LEFT: Python must finish the vehicles' part of the
step. PAUSED: the steps are complete, but Python must take the rows and datagrams."""
_STEPS = 4
"""Number of steps whose datagrams the buffers hold."""
_MOST_TICKS, _MOST_ROWS = 128, 1024
"""Maximum number of ticks, and of their rows, flown in one call when nothing needs them one at a time."""
_WIRE = np.dtype(
    [
        ("arrived", "i8"), ("arrived_bytes", "i8"),  # datagrams not yet passed on to Python
        ("in_step", "i8"), ("taken", "i8"),  # arrivals of the last step, and how many of them the station processed
        ("sent", "i8"), ("sent_bytes", "i8"),  # datagrams that enter the links in the next step
        ("entered", "i8"), ("waiting", "i8"), ("leaving", "i8"),  # the results of `step_all`
        ("now_ns", "i8"), ("next_ns", "i8"),  # time of the last step, and when the next is due
        ("ticks", "i8"),  # ticks done in this call
    ]
)  # fmt: skip


class LinkBuffers(NamedTuple):
    """Buffers shared by both ends of the links."""

    state: Records
    """The state of the buffers and of the last step: one record of _WIRE."""
    arrived: Bytes
    arrivals: Ints
    """The table of the arrived datagrams, see `Datagrams`."""
    sent: Bytes
    to: Ints
    """The table of the sent datagrams."""
    none_queued: Ints
    """Zeros: no datagram has waited in a socket buffer."""
    rows: Records
    """The rows of the ticks done in this call, in order."""


class Ends(NamedTuple):
    """The arrays that a step works on: both ends of the links, and the buffers between them."""

    fleet: FleetArrays
    data: FastPathData
    places: Ints
    """The row in the fleet of each of the station's vehicles."""
    addresses: Ints
    """The address of each vehicle of the fleet."""
    wire: LinkBuffers


class Stopped(NamedTuple):
    """A step that Python must finish: its time, the datagrams that arrived, and how many of these are processed."""

    now_ns: int
    arrived: Datagrams | list[Datagram]
    taken: int


class FastPath:
    """Flies the fast steps of a station and a fleet, whose vehicles have these `addresses`. For `places` see `Ends`.

    With `ahead`, several ticks are flown before their rows are yielded, and received frames are not passed on.
    """

    def __init__(self, station: Station, fleet: Fleet, addresses: Ints, places: Ints, *, ahead: bool) -> None:
        self._station, self._fleet, self._addresses, self._places = station, fleet, addresses, places
        most, n = _STEPS * fleet.most_leaving, len(places)
        self._room, self._ahead = most - fleet.most_leaving, ahead
        arrived, sent = np.zeros((2, most * FRAME_BYTES), np.uint8)
        arrivals, to = np.zeros((2, 4, most), np.int64)
        ticks = max(1, min(_MOST_TICKS, _MOST_ROWS // n)) if ahead else 1
        self._wire = LinkBuffers(
            np.zeros(1, _WIRE), arrived, arrivals, sent, to, np.zeros(most, np.int64), np.empty(ticks * n, TICK)
        )
        self._state = Columns(self._wire.state)
        self._row_bytes = self._wire.rows.view(np.uint8)  # numpy copies bytes ten times faster than records
        self._tick_bytes = n * TICK.itemsize
        self._handle: Handle | None = None

    def fly(self, entering: Datagrams) -> Generator[TickArray, None, Stopped]:
        """Do steps and yield the rows of their control ticks; returns the first step that needs Python.

        `entering` holds the datagrams that the station has sent.
        """
        from scenarios.handle import handle  # imports Numba, which most commands do not need

        station, wire, state = self._station, self._wire, self._state
        now_ns = station.next_event_ns
        if entering.stream.size > wire.sent.size or len(entering) > wire.to.shape[1]:
            return Stopped(now_ns, self._fleet.step(entering, now_ns), 0)
        wire.sent[: entering.stream.size], wire.to[:, : len(entering)] = entering.stream, entering.table
        state["sent"][0], state["sent_bytes"][0], state["next_ns"][0] = len(entering), entering.stream.size, now_ns
        data = station.fast_path_data
        arrived, ticks, left = state["arrived"], state["ticks"], _NOT_YET

        def run(left: int) -> int:
            ends = Ends(self._fleet.arrays, data, self._places, self._addresses, wire)
            if self._handle is None or not _same(ends, self._handle.kept):
                self._handle = handle(ends)  # the vehicles' part in Python may have replaced arrays
            return _fly(self._handle, self._room, self._ahead, left)

        while True:
            station.look_ahead()
            self._fleet.make_ready()
            ticks[0] = 0
            how_far = run(_NOT_YET)
            while how_far == NOT_LEFT and self._fleet.all_left(left := self._leave()):
                how_far = run(left)
            if how_far in (NOT_LEFT, PAUSED, NOT_JUDGED):
                self._pass_on(arrived[0])
            if ticks[0]:
                yield self._row_bytes[: ticks[0] * self._tick_bytes].copy().view(TICK)
            if how_far == NOT_JUDGED:
                tick = station.unjudged(np.zeros(len(self._places), np.int64))
                yield station.complete(tick, [tick.due_ns])
            if how_far == NOT_LEFT:
                return Stopped(state["now_ns"][0], self._fleet.left(left, state["now_ns"][0]), 0)
            if how_far not in (PAUSED, NOT_JUDGED):
                return self._not_taken(state["now_ns"][0])
            if ticks[0] or how_far == NOT_JUDGED:
                station.frames.clear()

    def _pass_on(self, count: int) -> None:
        """Add the first `count` arrived datagrams to the station's frames, if wanted, and empty their buffer."""
        if count and not self._ahead:
            stream, table = self._arrived(0, count)
            table[2] = self._addresses[table[2]]
            self._station.frames.add(Arrivals(stream, table, self._wire.none_queued))
        self._state["arrived"][0] = self._state["arrived_bytes"][0] = 0

    def _arrived(self, first: int, stop: int) -> tuple[Bytes, Ints]:
        size = self._state["arrived_bytes"][0]
        return self._wire.arrived[:size].copy(), self._wire.arrivals[:, first:stop].copy()

    def _leave(self) -> int:
        """Finish the vehicles' part of the last step; returns how many datagrams leave the links."""
        state = self._state
        stream, table = self._wire.sent[: state["sent_bytes"][0]], self._wire.to[:, : state["sent"][0]]
        entering = Datagrams(stream, table.copy(), self._fleet.system_ids)
        entered, waiting, leaving, now_ns = (state[name][0] for name in ("entered", "waiting", "leaving", "now_ns"))
        return self._fleet.go_on(entering, entered, waiting, leaving, now_ns)

    def _not_taken(self, now_ns: int) -> Stopped:
        count, in_step = self._state["arrived"][0], self._state["in_step"][0]
        arrived = Datagrams(*self._arrived(count - in_step, count), self._fleet.system_ids)
        self._pass_on(count - in_step)
        return Stopped(now_ns, arrived, self._state["taken"][0])


def _same(one: Any, other: Any) -> bool:
    """Whether two nested tuples hold the same array objects."""
    return one is other or (isinstance(one, tuple) and all(map(_same, one, other)))


@array_kernel
def _fly(ends: Any, room: int, ahead: bool, left: int) -> int:
    """Do steps while they need no Python and there is room for rows; returns the code of the progress made.

    `ends` is a handle on `Ends`. While at most `room` datagrams have arrived, those of one more step fit into the
    buffer; with `ahead`, those of earlier steps are discarded. The vehicles' part of the first step is done if `left`,
    the number of datagrams that leave in it, is not _NOT_YET.
    """
    wire = ends.arrays[-1]
    state = wire.state[0]
    while True:
        if left == _NOT_YET and state.arrived > room:
            if not ahead:
                return PAUSED
            state.arrived = state.arrived_bytes = 0
        state.now_ns = state.next_ns
        how_far, left = _step(ends, left), _NOT_YET
        if how_far == WITH_TICK:
            state.ticks += 1
            if state.ticks * len(ends.arrays[2]) == len(wire.rows):
                return PAUSED
        elif how_far != DONE:
            return how_far


@array_kernel
def _step(ends: Any, leaving: int) -> int:
    """Do one step as far as it needs no Python; returns its progress as a code. For `leaving` see `left` of `_fly`."""
    fleet, data, places, addresses, wire = ends.arrays
    state, n = wire.state[0], len(places)
    now_ns, ticks = state.now_ns, state.ticks
    if leaving == _NOT_YET:
        entered, waiting, leaving = step_all(
            fleet.vehicles, fleet.links, fleet.entries, fleet.frames, fleet.draws, fleet.truth,
            wire.sent[: state.sent_bytes], wire.to[:, : state.sent].copy(),
            fleet.waiting, fleet.leaving, fleet.leaving_data, 0, now_ns,
        )  # fmt: skip
        if entered < state.sent or waiting or leaving == fleet.leaving.shape[1] or not can_record(fleet.truth):
            state.entered, state.waiting, state.leaving = entered, waiting, leaving
            return NOT_LEFT
    data.schedule[0].now_ns = now_ns
    table = _arrive(wire, fleet.leaving, fleet.leaving_data, leaving, addresses)
    how_far, state.taken, first, second, third = fast_step(
        data, wire.arrived, table, wire.none_queued[:leaving]
    )  # fmt: skip
    rows = wire.rows[ticks * n : (ticks + 1) * n]
    if how_far == WITH_TICK and not fast_rows(data, np.full(n, now_ns), rows):
        how_far = NOT_JUDGED
    state.sent = state.sent_bytes = 0
    _send(wire, first, places, now_ns)
    _send(wire, second, places, now_ns)
    _send(wire, third, places, now_ns)
    schedule = data.schedule[0]
    state.next_ns = min(schedule.next_tick_ns, schedule.next_heartbeat_ns, schedule.next_requests_ns)
    return how_far


@array_kernel
def _arrive(wire: LinkBuffers, leaving: Ints, data: Bytes, count: int, addresses: Ints) -> Ints:
    """Add `count` datagrams that leave the links to the arrivals, in order of time and row; returns their table.

    Its addresses are those of the vehicles in the rows.
    """
    state, order = wire.state[0], np.argsort(leaving[3, :count], kind="mergesort")
    before, size = state.arrived_bytes, leaving[1, count - 1] if count else 0
    copy_bytes(wire.arrived, before, data, 0, size)
    table = np.empty((4, count), np.int64)
    for place in range(count):
        for part in range(4):
            table[part, place] = leaving[part, order[place]] + (before if part < 2 else 0)
            wire.arrivals[part, state.arrived + place] = table[part, place]
        table[2, place] = addresses[table[2, place]]
    state.in_step, state.arrived, state.arrived_bytes = count, state.arrived + count, before + size
    return table


@kernel
def _send(wire: LinkBuffers, sending: Sending, places: Ints, now_ns: int) -> None:
    """Add frames to the datagrams that enter the links in the next step."""
    state = wire.state[0]
    for k in range(len(sending.rows)):
        begin, place, width = state.sent_bytes, state.sent, sending.frames.shape[1]
        for byte in range(width):
            wire.sent[begin + byte] = sending.frames[k, byte]
        wire.to[0, place], wire.to[1, place] = begin, begin + sending.sizes[k]
        wire.to[2, place], wire.to[3, place] = places[sending.rows[k]], now_ns
        state.sent, state.sent_bytes = place + 1, begin + width
