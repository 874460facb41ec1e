"""An emulated link: exact due times, order, bounds, and nothing invented or forgotten."""

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenarios.keys import link as link_keys
from scenarios.keys.link import DelayPoint, Jitter, LossBursts, Outage
from sim_vehicles.links.links import Entry, Link
from sim_vehicles.links.queue import new_queues
from sim_vehicles.links.truth import CORRUPTED, DROPPED, DUPLICATE, LINK_FULL, LINK_UP, OUTAGE, MemoryRecorder
from sim_vehicles.services.clock import NEVER_NS

MS = 1_000_000
SECOND = 1_000_000_000


def times(out: list[Entry]) -> list[tuple[bytes, int]]:
    """(data, when it came out)."""
    return [(entry[3], entry[0]) for entry in out]


def test_a_datagram_leaves_exactly_its_delay_later() -> None:
    link = Link(link_keys.Link(delay_s=0.0123))
    assert link.next_due_ns == NEVER_NS
    link.send(b"a", 5)
    assert link.next_due_ns == 12_300_005
    assert link.due(12_300_004) == []
    assert times(link.due(20_000_000)) == [(b"a", 12_300_005)]
    assert link.due(20_000_000) == []
    assert link.next_due_ns == NEVER_NS


@given(st.lists(st.integers(0, 50), max_size=40), st.lists(st.integers(0, 80), max_size=10))
def test_datagrams_leave_once_in_order_of_time_and_entry(entered: list[int], looks: list[int]) -> None:
    link = Link(link_keys.Link(delay_s=10e-9))
    for number, time_ns in enumerate(entered):
        link.send(bytes([number]), time_ns)
    out = [datagram for now_ns in [*sorted(looks), 100] for datagram in times(link.due(now_ns))]
    expected = sorted((time_ns + 10, number) for number, time_ns in enumerate(entered))
    assert out == [(bytes([number]), due_ns) for due_ns, number in expected]


@pytest.mark.parametrize("jitter", [None, Jitter(distribution="uniform", scale_s=1e-9)])
def test_a_full_link_drops_what_comes_and_counts_it(jitter: Jitter | None) -> None:
    recorder = MemoryRecorder()
    link = Link(link_keys.Link(delay_s=1.0, jitter=jitter), capacity=3, queues=new_queues(1, recorder))
    for number in range(5):
        link.send(bytes([number]), number)
    assert (link.entered, link.dropped, link.under_way) == (5, 2, 3)
    assert [data for data, _ in times(link.due(10**10))] == [b"\0", b"\1", b"\2"]
    assert recorder.records.tolist() == [(LINK_UP, 0, 0xFFFFFF, k, k, k, LINK_FULL, 0) for k in (3, 4)]
    link.send(b"again", 0)
    assert link.dropped == 2


def test_a_ramp_is_exact_at_given_instants() -> None:
    points = ((1.0, 0.02), (3.0, 0.42), (3.0, 0.1), (4.0, 0.1), (6.0, 0.0))
    schedule = tuple(DelayPoint(at_s=at_s, delay_s=delay_s) for at_s, delay_s in points)
    link = Link(link_keys.Link(delay_points=schedule, reordering=True))
    link.zero_ns = 7 * SECOND
    expected_ms = {
        0.0: 20,
        1.0: 20,
        1.5: 120,
        2.0: 220,
        2.75: 370,
        3.0: 100,
        3.7: 100,
        5.0: 50,
        5.5: 25,
        6.0: 0,
        99.0: 0,
    }
    for at_s in expected_ms:
        link.send(str(at_s).encode(), 7 * SECOND + round(at_s * SECOND))
    found = {float(data): (due_ns, entered_ns) for due_ns, _, entered_ns, data, _, _ in link.due(NEVER_NS)}
    assert {at_s: due_ns - entered_ns for at_s, (due_ns, entered_ns) in found.items()} == {
        at_s: delay_ms * MS for at_s, delay_ms in expected_ms.items()
    }


def test_datagram_longer_than_a_frame_fares_as_a_short_one() -> None:
    behaviour = link_keys.Link(
        delay_s=0.1,
        jitter=Jitter(distribution="normal", scale_s=0.1),
        reordering=True,
        loss_probability=0.1,
        duplicate_probability=0.3,
        corrupt_probability=0.3,
    )
    short, long = Link(behaviour, seed=3, capacity=100), Link(behaviour, seed=3, capacity=100)
    for number in range(200):
        short.send(bytes(10), number)
        long.send(bytes(5000), number)
    of_short, of_long = short.due(NEVER_NS), long.due(NEVER_NS)
    assert [(*entry[:3], *entry[4:]) for entry in of_short] == [(*entry[:3], *entry[4:]) for entry in of_long]
    assert short.counts == long.counts
    assert all(short.counts[name] for name in ("lost", "corrupted", "duplicated", "link_full"))
    flips = {entry[1]: entry[3] for entry in of_long}
    for _, number, _, data, fate, _ in of_long:
        assert len(data) == 5000
        assert bool(int.from_bytes(data).bit_count()) == bool(fate & CORRUPTED)
        assert data == flips[number]


def test_before_link_time_zero_the_first_delay_applies_without_outage() -> None:
    points = (DelayPoint(at_s=0.0, delay_s=0.02), DelayPoint(at_s=1.0, delay_s=0.5))
    link = Link(link_keys.Link(delay_points=points, outages=(Outage(from_s=0.0, until_s=9.0),)))
    link.send(b"early", 5 * SECOND)
    assert times(link.due(NEVER_NS)) == [(b"early", 5 * SECOND + 20 * MS)]


def test_an_outage_includes_its_start_not_its_end() -> None:
    recorder = MemoryRecorder()
    link = Link(
        link_keys.Link(outages=(Outage(from_s=1.0, until_s=2.0), Outage(from_s=3.0, until_s=4.0))),
        queues=new_queues(1, recorder),
    )
    link.zero_ns = 0
    for time_ns in (0, SECOND - 1, SECOND, 2 * SECOND - 1, 2 * SECOND, 3 * SECOND, 4 * SECOND):
        link.send(b"x", time_ns)
    assert [due_ns for _, due_ns in times(link.due(NEVER_NS))] == [0, SECOND - 1, 2 * SECOND, 4 * SECOND]
    assert [(row[3], row[6:]) for row in recorder.records.tolist()] == [
        (t, (OUTAGE, 0)) for t in (SECOND, 2 * SECOND - 1, 3 * SECOND)
    ]


probability = st.sampled_from([0.0, 0.05, 0.5, 1.0])
jitters = st.one_of(
    st.none(),
    st.builds(Jitter, distribution=st.sampled_from(["uniform", "normal", "exponential"]), scale_s=st.just(0.01)),
    st.builds(Jitter, distribution=st.just("gamma"), scale_s=st.just(0.01), shape=st.floats(0.1, 5)),
    st.builds(Jitter, distribution=st.just("trace"), trace_s=st.just((0.001, 0.03, 0.0))),
)
bursts = st.builds(LossBursts, to_bad_probability=probability, to_good_probability=st.sampled_from([0.1, 1.0]))
misbehaving = st.builds(
    link_keys.Link,
    delay_s=st.sampled_from([0.0, 0.004]),
    jitter=jitters,
    reordering=st.booleans(),
    loss_bursts=st.one_of(st.none(), bursts),
    duplicate_probability=probability,
    corrupt_probability=probability,
    outages=st.sampled_from([(), (Outage(from_s=0.01, until_s=0.02),)]),
)
arrivals = st.lists(st.integers(0, 50 * MS), max_size=60).map(sorted)


def passed(
    behaviour: link_keys.Link, entered: list[int], seed: int, recorder: MemoryRecorder | None = None
) -> tuple[Link, list[Entry]]:
    """The link, and all that came out of it when numbered datagrams entered at these times."""
    link = Link(behaviour, capacity=20, seed=seed, queues=new_queues(1, recorder))
    link.zero_ns = 0
    out: list[Entry] = []
    for number, time_ns in enumerate(entered):
        out += link.due(time_ns)
        link.send(b"%03d" % number, time_ns)
        assert link.under_way <= 20
        assert link.entered + link.counts["duplicated"] == len(out) + link.dropped + link.under_way
    out += link.due(NEVER_NS)
    return link, out


@given(misbehaving, arrivals, st.integers(0, 2**32))
def test_nothing_is_invented_and_nothing_disappears_unrecorded(
    behaviour: link_keys.Link, entered: list[int], seed: int
) -> None:
    recorder = MemoryRecorder()
    link, out = passed(behaviour, entered, seed, recorder)
    assert link.under_way == 0
    fates = recorder.records["fate"]
    assert link.entered + link.counts["duplicated"] == len(out) + len(fates)
    assert len(fates) == link.dropped
    assert (fates & DROPPED != 0).all()
    whole = Counter(data for _, _, _, data, fate, _ in out if not fate & CORRUPTED)
    assert all(0 <= int(data) < len(entered) for data in whole)
    twice = Counter(data for _, _, _, data, fate, _ in out if fate & DUPLICATE and not fate & CORRUPTED)
    assert all(count == 1 + twice[data] for data, count in whole.items() if twice[data])
    assert all(count == 1 for data, count in whole.items() if not twice[data])
    for due_ns, number, entered_ns, data, fate, _ in out:
        assert entered_ns == entered[number - 1]
        assert due_ns >= entered_ns + link.least_delay_ns
        assert (data != b"%03d" % (number - 1)) == bool(fate & CORRUPTED)


@given(misbehaving.filter(lambda link: not link.reordering), arrivals, st.integers(0, 2**32))
def test_without_reordering_no_datagram_leaves_before_an_earlier_one(
    behaviour: link_keys.Link, entered: list[int], seed: int
) -> None:
    _, out = passed(behaviour, entered, seed)
    numbers = [number for _, number, *_ in out]
    assert numbers == sorted(numbers)


def test_with_reordering_some_datagrams_overtake_earlier_ones() -> None:
    jitter = Jitter(distribution="uniform", scale_s=0.03)
    link = link_keys.Link(delay_s=0.03, jitter=jitter, reordering=True)
    _, out = passed(link, [k * MS for k in range(20)], 1)
    numbers = [number for _, number, *_ in out]
    assert sorted(numbers) == list(range(1, 21))
    assert numbers != sorted(numbers)
