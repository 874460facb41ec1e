"""An emulated link: exact due times, order, bounds."""

from hypothesis import given
from hypothesis import strategies as st

from scenarios import schema
from sim_vehicles.links import NEVER_NS, Link

MS = 1_000_000


def test_a_datagram_comes_out_exactly_its_delay_later_and_not_before() -> None:
    link = Link(schema.Link(delay_s=0.0123))
    assert link.next_due_ns == NEVER_NS
    link.send(b"a", 5)
    assert link.next_due_ns == 12_300_005
    assert link.due(12_300_004) == []
    assert link.due(20_000_000) == [(b"a", 12_300_005)]
    assert link.due(20_000_000) == []
    assert link.next_due_ns == NEVER_NS


@given(st.lists(st.integers(0, 50), max_size=40), st.lists(st.integers(0, 80), max_size=10))
def test_all_come_out_once_in_order_of_time_and_of_entry(entered: list[int], looks: list[int]) -> None:
    link = Link(schema.Link(delay_s=10e-9))
    for number, time_ns in enumerate(entered):
        link.send(bytes([number]), time_ns)
    out = [datagram for now_ns in [*sorted(looks), 100] for datagram in link.due(now_ns)]
    expected = sorted((time_ns + 10, number) for number, time_ns in enumerate(entered))
    assert out == [(bytes([number]), due_ns) for due_ns, number in expected]


def test_a_full_link_drops_what_comes_and_counts_it() -> None:
    link = Link(schema.Link(delay_s=1.0), capacity=3)
    for number in range(5):
        link.send(bytes([number]), number)
    assert (link.sent, link.dropped) == (3, 2)
    assert [data for data, _ in link.due(10**10)] == [b"\0", b"\1", b"\2"]
    link.send(b"again", 0)
    assert link.dropped == 2
