"""Steps of plain vehicles and their station in virtual time that kernels do alone, in one call each.

In most flights these are all steps but for some each second, such as those in which a vehicle's mode changes. Where a
kernel stops, the steps in Python go on from there (`gcs.drive.lockstep`).
"""

from collections.abc import Generator, Sequence
from typing import Any, NamedTuple

import numpy as np

from gcs.control.tick import TICK, TickArray
from gcs.link.datagram import Address, Arrivals
from gcs.station.station import Station
from gcs.station.usual import DONE, NOT_DUE, NOT_JUDGED, WITH_TICK, Due, Sending, Usual, usual_step
from scenarios.kernel import Columns, Records, array_kernel, kernel
from scenarios.sockets import Bytes, Ints
from sim_vehicles.drive.datagrams import Datagram, Datagrams
from sim_vehicles.drive.fleet import Fleet, FleetArrays
from sim_vehicles.links.queue import copy_bytes
from sim_vehicles.links.truth import can_record
from sim_vehicles.services.frames import FRAME_BYTES
from sim_vehicles.vehicles.plain import step_all

NOT_LEFT = -1
"""How far a step came, beside what `usual_step` returns: not all that leaves the vehicles' links has left."""
_USUAL = DONE, WITH_TICK, NOT_JUDGED
_STEPS = 4
"""Steps whose datagrams there is room for."""
_WIRE = np.dtype(
    [
        ("arrived", "i8"), ("arrived_bytes", "i8"),  # datagrams that have not been passed on
        ("in_step", "i8"), ("taken", "i8"),  # those of the last step, and how many of these the station has taken in
        ("sent", "i8"), ("sent_bytes", "i8"),  # datagrams that enter the links in the next step
        ("entered", "i8"), ("waiting", "i8"), ("leaving", "i8"),  # what `step_all` returned
        ("next_ns", "i8"),  # when the next step is due
    ]
)  # fmt: skip


class Wire(NamedTuple):
    """What passes between both ends of the links, and what Python learns of a step."""

    state: Records
    """Of _WIRE, (1,)."""
    arrived: Bytes
    arrivals: Ints
    """The table of what has arrived, see `Datagrams`."""
    sent: Bytes
    to: Ints
    """The table of what is sent."""
    rows: Records
    """Those of the last tick."""


class Ends(NamedTuple):
    """All that a step works on."""

    fleet: FleetArrays
    usual: Usual
    places: Ints
    """The vehicles' rows in the fleet, by their rows in the station."""
    senders: Ints
    """What `Reception.numbered` returns of the fleet's vehicles."""
    wire: Wire


class Stopped(NamedTuple):
    """A step that is not usual: when, the datagrams that arrived, and how many of these are taken in."""

    now_ns: int
    arrived: Datagrams | list[Datagram]
    taken: int


class UsualSteps:
    """The usual steps of a station and a fleet. `addresses` are those of the fleet's vehicles, `places` see `Ends`."""

    def __init__(self, station: Station, fleet: Fleet, addresses: Sequence[Address], places: Ints) -> None:
        self._station, self._fleet, self._addresses, self._places = station, fleet, addresses, places
        most = _STEPS * fleet.most_leaving
        self._none_queued = np.zeros(most, np.int64)
        self._room = most - fleet.most_leaving
        arrived, sent = np.zeros((2, most * FRAME_BYTES), np.uint8)
        arrivals, to = np.zeros((2, 4, most), np.int64)
        self._wire = Wire(np.zeros(1, _WIRE), arrived, arrivals, sent, to, np.empty(len(places), TICK))
        self._state = Columns(self._wire.state)
        self._row_bytes = self._wire.rows.view(np.uint8)  # numpy copies bytes ten times faster than records

    def fly(self, entering: Datagrams) -> Generator[TickArray, None, Stopped]:
        """Do steps until one is not usual, which is returned; yields the rows of each control tick.

        `entering` is what the station has sent.
        """
        from scenarios.handle import handle  # with Numba, which most commands need not load

        station, wire, arrived, next_ns = self._station, self._wire, self._state["arrived"], self._state["next_ns"]
        now_ns = station.next_event_ns
        if entering.stream.size > wire.sent.size or len(entering) > wire.to.shape[1]:
            return Stopped(now_ns, self._fleet.step(entering, now_ns), 0)
        wire.sent[: entering.stream.size], wire.to[:, : len(entering)] = entering.stream, entering.table
        self._state["sent"][0], self._state["sent_bytes"][0] = len(entering), entering.stream.size
        ends = handle(Ends(self._fleet.arrays, station.usual, self._places, station.senders(self._addresses), wire))
        next_tick_ns = station.next_tick_ns
        while True:
            due = NOT_DUE if now_ns < next_tick_ns else station.due
            how_far = _step(ends, now_ns, due.is_usual, due.time_s, *due.nominal_velocity_m_s)
            if how_far not in _USUAL:
                return self._stopped(how_far, now_ns)
            if how_far != DONE:
                self._pass_on(arrived[0])
                rows = self._row_bytes.copy().view(TICK) if how_far == WITH_TICK else None
                yield station.complete(station.unjudged(due), [now_ns]) if rows is None else rows
                station.frames.clear()
                next_tick_ns = station.next_tick_ns
            elif arrived[0] > self._room:
                self._pass_on(arrived[0])
            now_ns = next_ns[0]

    def _pass_on(self, count: int) -> None:
        """Pass so many datagrams that have arrived, the first ones, on to the station's frames."""
        if count:
            self._station.frames.add(Arrivals(*self._arrived(0, count), self._none_queued, self._addresses))
        self._state["arrived"][0] = self._state["arrived_bytes"][0] = 0

    def _arrived(self, first: int, stop: int) -> tuple[Bytes, Ints]:
        size = self._state["arrived_bytes"][0]
        return self._wire.arrived[:size].copy(), self._wire.arrivals[:, first:stop].copy()

    def _stopped(self, how_far: int, now_ns: int) -> Stopped:
        found = self._wire.state[0]
        ids, count, in_step = self._fleet.system_ids, int(found["arrived"]), int(found["in_step"])
        if how_far == NOT_LEFT:
            self._pass_on(count)
            stream, table = self._wire.sent[: found["sent_bytes"]], self._wire.to[:, : found["sent"]]
            entered, waiting, leaving = found[["entered", "waiting", "leaving"]].item()
            entering = Datagrams(stream, table.copy(), ids)
            return Stopped(now_ns, self._fleet.go_on(entering, entered, waiting, leaving, now_ns), 0)
        arrived = Datagrams(*self._arrived(count - in_step, count), ids)
        self._pass_on(count - in_step)
        return Stopped(now_ns, arrived, int(found["taken"]))


@array_kernel
def _step(ends: Any, now_ns: int, is_usual: bool, time_s: float, north_m_s: float, east_m_s: float) -> int:
    """One step, as far as it is usual; returns how far it came. `ends` is a handle on `Ends`; the rest is as `Due`."""
    fleet, usual, places, senders, wire = ends.arrays
    state = wire.state[0]
    entered, waiting, leaving = step_all(
        fleet.vehicles, fleet.links, fleet.entries, fleet.frames, fleet.draws, fleet.truth,
        wire.sent[: state.sent_bytes], _columns(wire.to, state.sent),
        fleet.waiting, fleet.leaving, fleet.leaving_data, 0, now_ns,
    )  # fmt: skip
    if entered < state.sent or waiting or leaving == fleet.leaving.shape[1] or not can_record(fleet.truth):
        state.entered, state.waiting, state.leaving = entered, waiting, leaving
        return NOT_LEFT
    usual.schedule[0].now_ns = now_ns
    table = _arrive(wire, fleet.leaving, fleet.leaving_data, leaving)
    due = Due(is_usual, time_s, (north_m_s, east_m_s))
    queued_ns = np.zeros(leaving, np.int64)
    how_far, state.taken, first, second = usual_step(usual, wire.arrived, table, queued_ns, senders, due, wire.rows)
    state.sent = state.sent_bytes = 0
    _send(wire, first, places, now_ns)
    _send(wire, second, places, now_ns)
    schedule = usual.schedule[0]
    state.next_ns = min(schedule.next_tick_ns, schedule.next_heartbeat_ns, schedule.next_requests_ns)
    return how_far


@array_kernel
def _columns(table: Ints, count: int) -> Ints:
    """A copy of the first columns of a table."""
    some = np.empty((4, count), np.int64)
    for part in range(4):
        for place in range(count):
            some[part, place] = table[part, place]
    return some


@array_kernel
def _arrive(wire: Wire, leaving: Ints, data: Bytes, count: int) -> Ints:
    """Let so many datagrams arrive that leave the links, in order of time and row; returns their table."""
    table = np.empty((4, count), np.int64)
    _arrive_in(table, wire, leaving, data, np.argsort(leaving[3, :count], kind="mergesort"))
    return table


@kernel
def _arrive_in(table: Ints, wire: Wire, leaving: Ints, data: Bytes, order: Ints) -> None:
    state, count = wire.state[0], len(order)
    before, size = state.arrived_bytes, leaving[1, count - 1] if count else 0
    copy_bytes(wire.arrived, before, data, 0, size)
    for place in range(count):
        for part in range(4):
            table[part, place] = leaving[part, order[place]] + (before if part < 2 else 0)
            wire.arrivals[part, state.arrived + place] = table[part, place]
    state.in_step, state.arrived, state.arrived_bytes = count, state.arrived + count, before + size


@kernel
def _send(wire: Wire, sending: Sending, places: Ints, now_ns: int) -> None:
    """Add frames to those that enter the links in the next step."""
    state = wire.state[0]
    for k in range(len(sending.rows)):
        begin, place, width = state.sent_bytes, state.sent, sending.frames.shape[1]
        for byte in range(width):
            wire.sent[begin + byte] = sending.frames[k, byte]
        wire.to[0, place], wire.to[1, place] = begin, begin + sending.sizes[k]
        wire.to[2, place], wire.to[3, place] = places[sending.rows[k]], now_ns
        state.sent, state.sent_bytes = place + 1, begin + width
