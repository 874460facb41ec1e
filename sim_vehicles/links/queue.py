"""Kernels for the datagrams under way on links: how they enter, their fate, and when they come out.

The datagrams of all links share one pool of entries. Those of one link form a linked list ordered by due time, and by
order of entry at equal times. Entry 0 is a sentinel; its `after` is the head of the list of free entries.
"""

from dataclasses import dataclass

import numpy as np

from scenarios.kernel import Columns, Record, Records, kernel
from scenarios.sockets import Bytes
from sim_vehicles.links.fate import BLOCK, BLOCKS, DRAW, drawn_bad, flip, flips_of
from sim_vehicles.links.truth import (
    CORRUPTED,
    DUPLICATE,
    LINK_FULL,
    LOST,
    OUTAGE,
    PASSED,
    QUEUE_FULL,
    Recorder,
    can_record,
    note,
    rows_of,
)
from sim_vehicles.services.clock import NEVER_NS
from sim_vehicles.services.frames import FRAME_BYTES, first_message

LINK = np.dtype(
    [
        ("kind", "i8"), ("system_id", "i8"),  # LINK_UP or LINK_DOWN of this vehicle
        ("next_due_ns", "i8"), ("first", "i8"), ("last", "i8"),  # the list of its entries
        ("under_way", "i8"), ("capacity", "i8"),
        ("entered", "i8"),
        ("plain", "?"),  # see `Link.plain`
        ("random", "?"),  # whether it does more than delay by a constant
        ("reordering", "?"),
        ("delay_ns", "i8"), ("least_delay_ns", "i8"),  # without jitter, and a lower bound of every delay
        ("to_bad", "f8"), ("to_good", "f8"), ("loss_good", "f8"), ("loss_bad", "f8"),
        ("duplicate", "f8"), ("corrupt", "f8"),
        ("bad", "?"),  # whether the last datagram found it in its bad state
        ("barred", "i8"),  # why the datagram that enters next is dropped: OUTAGE, QUEUE_FULL, or PASSED if it is not
        ("last_due_ns", "i8"),
        ("drawn", "i8"), ("made", "i8"),  # how many draws it has used, and how many are made: NEVER_NS if it needs none
        # what happened to its datagrams, by the names of `truth.FATES`
        ("duplicated", "i8"), ("corrupted", "i8"), ("lost", "i8"), ("outage", "i8"), ("queue_full", "i8"),
        ("link_full", "i8"),
    ],
    align=True,
)  # fmt: skip
ENTRY = np.dtype(
    [
        ("due_ns", "i8"), ("number", "i8"), ("entered_ns", "i8"), ("fate", "i8"), ("queued_ns", "i8"),
        ("size", "i8"),  # in bytes; a datagram longer than FRAME_BYTES is kept in `Link`
        ("before", "i8"), ("after", "i8"),
    ]
)  # fmt: skip
"""A datagram under way. A duplicate has the number of its original."""
_FIRST_SIZE = 64


@dataclass(slots=True)
class Queues:
    """The links of one simulation, a row each, and the pool of their datagrams, which grows as needed."""

    links: Records
    """Records of LINK."""
    entries: Records
    """Records of ENTRY."""
    frames: Bytes
    """The bytes of each entry, (k, FRAME_BYTES)."""
    draws: Records
    """Records of DRAW, (n, BLOCKS * BLOCK): a ring buffer for each link; draw k is in column k modulo its length."""
    columns: Columns
    """Columns of `links`."""
    recorder: Recorder | None
    """Records what happens, if given."""
    truth: Records
    """Rows of the recorder."""

    def grow(self) -> None:
        """Double the pool."""
        size = len(self.entries)
        entries, frames = np.zeros(2 * size, ENTRY), np.zeros((2 * size, FRAME_BYTES), np.uint8)
        entries[:size], frames[:size] = self.entries, self.frames
        self.entries, self.frames = entries, frames
        _free_from(entries, size)


def new_queues(count: int, recorder: Recorder | None = None) -> Queues:
    """Empty queues for `count` links."""
    links, entries = np.zeros(count, LINK), np.zeros(_FIRST_SIZE, ENTRY)
    links["next_due_ns"], links["made"] = NEVER_NS, NEVER_NS
    _free_from(entries, 1)
    frames, draws = np.zeros((_FIRST_SIZE, FRAME_BYTES), np.uint8), np.zeros((count, BLOCKS * BLOCK), DRAW)
    return Queues(links, entries, frames, draws, Columns(links), recorder, rows_of(recorder))


def _free_from(entries: Records, first: int) -> None:
    """Prepend the entries from `first` on to the list of free ones."""
    free = entries["after"][0]
    entries["after"][first:] = np.arange(first + 1, len(entries) + 1)
    entries["after"][-1], entries["after"][0] = free, first


@kernel
def has_room(entries: Records) -> bool:
    free = entries[0].after
    return free != 0 and entries[free].after != 0


@kernel
def ready(link: Record, entries: Records, truth: Records) -> bool:
    """Whether one more datagram, and a duplicate of it, can enter: there are draws, free entries and free records."""
    return has_room(entries) and can_record(truth) and link.drawn < link.made


@kernel
def copy_bytes(to: Bytes, at: int, data: Bytes, begin: int, count: int) -> None:
    """Copy bytes; a loop, because slices compile slowly."""
    for k in range(count):
        to[at + k] = data[begin + k]


@kernel
def new_entry(entries: Records) -> int:
    """Take a free entry; there must be one."""
    entry = entries[0].after
    entries[0].after = entries[entry].after
    return entry


@kernel
def free(entries: Records, entry: int) -> None:
    entries[entry].after = entries[0].after
    entries[0].after = entry


@kernel
def enter(
    link: Record, entries: Records, frames: Bytes, draws: Records, truth: Records, entry: int, time_ns: int
) -> int:
    """Let the datagram in a new entry enter a plain link; returns its fate."""
    return enter_later(link, entries, frames, draws, truth, entry, time_ns, time_ns, time_ns, link.delay_ns)


@kernel
def enter_later(
    link: Record, entries: Records, frames: Bytes, draws: Records, truth: Records, entry: int,
    time_ns: int, begin_ns: int, end_ns: int, delay_ns: int,
) -> int:  # fmt: skip
    """Let a datagram enter, given the start and end of its transmission and its delay without jitter.

    Returns its fate; with DUPLICATE and LINK_FULL together, only its duplicate was dropped.
    """
    link.entered += 1  # also the order of datagrams that are due at the same time: first in, first out
    datagram = entries[entry]
    datagram.number, datagram.entered_ns, datagram.queued_ns = link.entered, time_ns, begin_ns - time_ns
    datagram.fate = PASSED
    dropped = LINK_FULL if link.barred != OUTAGE and link.under_way >= link.capacity else link.barred
    if not link.random:
        if dropped != PASSED:
            return _drop(link, entries, frames, truth, entry, dropped)
        _insert(link, entries, entry, end_ns + delay_ns)
        return PASSED
    draw = draws[link.drawn % len(draws)]
    link.drawn += 1
    link.bad = drawn_bad(link, draw)
    if dropped == PASSED and draw.loss < (link.loss_bad if link.bad else link.loss_good):
        dropped = LOST
    if dropped != PASSED:
        return _drop(link, entries, frames, truth, entry, dropped)
    if draw.corrupt < link.corrupt:
        link.corrupted += 1
        datagram.fate = CORRUPTED
        if datagram.size <= FRAME_BYTES:
            flip(frames[entry], datagram.size, draw.flips, flips_of(link.corrupt, draw.corrupt))
    _insert(link, entries, entry, _in_turn(link, end_ns + max(0, delay_ns + draw.jitter_ns)))
    if draw.duplicate < link.duplicate:
        link.duplicated += 1
        if link.under_way >= link.capacity:
            link.link_full += 1
            record_datagram(truth, link, datagram, frames[entry], time_ns, time_ns, DUPLICATE | LINK_FULL)
            return datagram.fate | DUPLICATE | LINK_FULL
        copy = new_entry(entries)
        second = entries[copy]
        second.number, second.entered_ns, second.queued_ns = datagram.number, time_ns, datagram.queued_ns
        second.fate, second.size = datagram.fate | DUPLICATE, datagram.size
        copy_bytes(frames[copy], 0, frames[entry], 0, min(datagram.size, FRAME_BYTES))
        _insert(link, entries, copy, _in_turn(link, end_ns + max(0, delay_ns + draw.duplicate_jitter_ns)))
        return second.fate
    return datagram.fate


@kernel
def _in_turn(link: Record, due_ns: int) -> int:
    """Due time of a datagram: as given, but without reordering no earlier than those of the datagrams before it."""
    if link.reordering:
        return due_ns
    link.last_due_ns = max(due_ns, link.last_due_ns)
    return link.last_due_ns


@kernel
def _drop(link: Record, entries: Records, frames: Bytes, truth: Records, entry: int, fate: int) -> int:
    free(entries, entry)
    entered_ns = entries[entry].entered_ns
    record_datagram(truth, link, entries[entry], frames[entry], entered_ns, entered_ns, fate)
    if fate == LOST:
        link.lost += 1
    elif fate == OUTAGE:
        link.outage += 1
    elif fate == QUEUE_FULL:
        link.queue_full += 1
    else:
        link.link_full += 1
    return fate


@kernel
def _insert(link: Record, entries: Records, entry: int, due_ns: int) -> None:
    """Put an entry into a link's list, after all that are due by its time."""
    before, after = link.last, 0
    while before != 0 and entries[before].due_ns > due_ns:
        before, after = entries[before].before, before
    entries[entry].due_ns, entries[entry].before, entries[entry].after = due_ns, before, after
    if before == 0:
        link.first, link.next_due_ns = entry, due_ns
    else:
        entries[before].after = entry
    if after == 0:
        link.last = entry
    else:
        entries[after].before = entry
    link.under_way += 1


@kernel
def record_datagram(
    truth: Records, link: Record, datagram: Record, frame: Bytes, time_ns: int, due_ns: int, fate: int
) -> None:
    """Record in the truth log that a datagram left a link at a time, or was dropped."""
    if len(truth) > 1:
        key, entered_ns = first_message(frame, datagram.size), datagram.entered_ns
        note(truth, link.kind, link.system_id, key, time_ns, entered_ns, due_ns, fate, datagram.queued_ns)


@kernel
def take(link: Record, entries: Records) -> int:
    """Remove the first entry of a link and return it; it keeps its content until another one enters."""
    entry = link.first
    link.first = entries[entry].after
    if link.first == 0:
        link.last, link.next_due_ns = 0, NEVER_NS
    else:
        entries[link.first].before = 0
        link.next_due_ns = entries[link.first].due_ns
    link.under_way -= 1
    free(entries, entry)
    return entry


@kernel
def take_in(entries: Records, frames: Bytes, data: Bytes, begin: int, size: int) -> int:
    """A new entry that holds `size` bytes of `data`, from `begin`."""
    entry = new_entry(entries)
    entries[entry].size = size
    copy_bytes(frames[entry], 0, data, begin, min(size, FRAME_BYTES))
    return entry


NOT_READY = -1


@kernel
def enter_at(
    links: Records, entries: Records, frames: Bytes, draws: Records, truth: Records, row: int, data: Bytes,
    time_ns: int, begin_ns: int, end_ns: int, delay_ns: int,
) -> int:  # fmt: skip
    """Let a datagram enter the link in `row` as `enter_later` does; NOT_READY unless the link is `ready`."""
    if not ready(links[row], entries, truth):
        return NOT_READY
    entry = take_in(entries, frames, data, 0, len(data))
    return enter_later(
        links[row], entries, frames, draws[row], truth, entry, time_ns, begin_ns, end_ns, delay_ns
    )  # fmt: skip


@kernel
def take_due_at(links: Records, entries: Records, row: int, now_ns: int) -> int:
    """Remove and return the first entry of the link in `row` if it is due by now, else return 0."""
    link = links[row]
    return take(link, entries) if link.under_way > 0 and link.next_due_ns <= now_ns else 0
