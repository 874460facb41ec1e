"""What links draw: the distributions, against theory, and that seeds alone decide.

Statistical tolerances: a test with a fixed seed passes always or never, so they only have to be wide enough for an
honest seed and narrow enough to show a mistake. Kolmogorov-Smirnov at p = 0.001 lets 999 of 1000 honest seeds pass;
means are compared within four standard errors (1 honest seed in 16,000 is farther off).
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

from scenarios.keys import link as link_keys
from scenarios.keys.link import Jitter, LossBursts
from sim_vehicles.links.fate import BLOCK, DRAW, Stream
from sim_vehicles.links.links import Link, LinkSet
from sim_vehicles.links.queue import new_queues
from sim_vehicles.links.truth import CORRUPTED, DUPLICATE, MemoryRecorder
from sim_vehicles.services.clock import NEVER_NS
from tests.support.sim_client import scenario

MS = 1_000_000
COUNT = 20_000
SAMPLES = 2000
"""For Kolmogorov-Smirnov: enough to detect an error of 4 % in the distribution function."""


def delays_s(link: link_keys.Link, *, count: int, seed: int = 3) -> list[float]:
    """Delays of datagrams that enter one a ms, by their order of entry."""
    under_test = Link(link, capacity=count, seed=seed)
    for k in range(count):
        under_test.send(b"", k * MS)
    return [(entry[0] - entry[2]) * 1e-9 for entry in sorted(under_test.due(NEVER_NS), key=lambda entry: entry[1])]


@pytest.mark.parametrize(
    ("jitter", "expected"),
    [
        (Jitter(distribution="uniform", scale_s=0.02), stats.uniform(0.08, 0.04)),
        (Jitter(distribution="normal", scale_s=0.01), stats.norm(0.1, 0.01)),
        (Jitter(distribution="exponential", scale_s=0.03), stats.expon(0.1, 0.03)),
        (Jitter(distribution="gamma", scale_s=0.01, shape=2.5), stats.gamma(2.5, 0.1, 0.01)),
    ],
    ids=lambda value: value.distribution if isinstance(value, Jitter) else "",
)
def test_delays_have_the_distribution_that_is_documented(jitter: Jitter, expected: Any) -> None:
    found = delays_s(link_keys.Link(delay_s=0.1, jitter=jitter, reordering=True), count=SAMPLES)
    assert stats.kstest(found, expected.cdf).pvalue > 0.001
    assert np.mean(found) == pytest.approx(expected.mean(), abs=4 * expected.std() / math.sqrt(SAMPLES))
    # 10 %: the standard error of a standard deviation is below 3 % for each of these distributions.
    assert np.std(found) == pytest.approx(expected.std(), rel=0.1)


def test_the_delay_is_cut_off_at_zero() -> None:
    jitter = Jitter(distribution="normal", scale_s=0.01)
    found = np.array(delays_s(link_keys.Link(delay_s=0.005, jitter=jitter, reordering=True), count=SAMPLES))
    assert found.min() == 0.0
    share = stats.norm(0.005, 0.01).cdf(0.0)
    assert np.mean(found == 0.0) == pytest.approx(share, abs=4 * math.sqrt(share * (1 - share) / SAMPLES))


def test_a_delay_trace_repeats_in_its_order() -> None:
    trace = (0.01, 0.02, 0.05, 0.03, 0.0)
    link = link_keys.Link(delay_s=0.001, jitter=Jitter(distribution="trace", trace_s=trace), reordering=True)
    found = [round(delay_s - 0.001, 9) for delay_s in delays_s(link, count=300)]
    begin = trace.index(found[0])
    assert found == [trace[(begin + k) % 5] for k in range(300)]
    begins = {delays_s(link, count=1, seed=seed)[0] for seed in range(30)}
    assert len(begins) == 5


@pytest.mark.parametrize("wanted", [0.0, 0.03, 0.4, 1.0])
def test_independent_loss_duplication_and_corruption_have_their_probabilities(wanted: float) -> None:
    link = Link(
        link_keys.Link(loss_probability=0.1, duplicate_probability=wanted, corrupt_probability=wanted),
        capacity=2 * COUNT,
    )
    for k in range(COUNT):
        link.send(b"four", k)
    error = 4 * math.sqrt(wanted * (1 - wanted) / (0.9 * COUNT))
    arrived = [entry for entry in link.due(NEVER_NS) if not entry[4] & DUPLICATE]
    assert link.counts["lost"] == COUNT - len(arrived)
    assert len(arrived) / COUNT == pytest.approx(0.9, abs=4 * math.sqrt(0.09 / COUNT))
    assert link.counts["duplicated"] / len(arrived) == pytest.approx(wanted, abs=error)
    assert sum(bool(entry[4] & CORRUPTED) for entry in arrived) / len(arrived) == pytest.approx(wanted, abs=error)


def test_bursts_follow_the_gilbert_elliott_model() -> None:
    p, r = 0.02, 0.2
    recorder = MemoryRecorder()
    burst = LossBursts(to_bad_probability=p, to_good_probability=r)
    link = Link(link_keys.Link(loss_bursts=burst), capacity=COUNT, queues=new_queues(1, recorder))
    for k in range(COUNT):
        link.send(b"", k)
    lost = np.zeros(COUNT, bool)
    lost[recorder.records["time_ns"]] = True
    bad = p / (p + r)
    # Neighbours are correlated, c = 1 - p - r: the mean's variance is (1 + c) / (1 - c) times that of independence.
    error = math.sqrt(bad * (1 - bad) / COUNT * (2 - p - r) / (p + r))
    assert lost.mean() == pytest.approx(bad, abs=4 * error)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], lost, [False])).astype(int)))
    lengths = edges[1::2] - edges[::2]
    # A bad time's length is geometric: mean 1 / r, standard deviation sqrt(1 - r) / r.
    assert lengths.mean() == pytest.approx(1 / r, abs=4 * math.sqrt(1 - r) / r / math.sqrt(lengths.size))
    assert lengths.max() > 10  # independent loss of 9 % has a burst of 11 once in 10^11


def test_good_and_bad_state_lose_at_their_rates() -> None:
    burst = LossBursts(
        to_bad_probability=0.1, to_good_probability=0.1, loss_good_probability=0.02, loss_bad_probability=0.6
    )
    link = Link(link_keys.Link(loss_bursts=burst), capacity=COUNT)
    for k in range(COUNT):
        link.send(b"", k)
    # Half the time bad; c = 0.8 makes the error of that share sqrt(9) times that of independent states.
    assert link.dropped / COUNT == pytest.approx(0.31, abs=4 * 0.29 * 3 / math.sqrt(COUNT) + 4 * 0.5 / math.sqrt(COUNT))


def test_corruption_flips_one_to_four_bits_anywhere() -> None:
    link = Link(link_keys.Link(corrupt_probability=1.0), capacity=COUNT)
    for k in range(2000):
        link.send(bytes(6), k)
    words = [int.from_bytes(entry[3], "big") for entry in link.due(NEVER_NS)]
    flips = [word.bit_count() for word in words]
    assert set(flips) == {1, 2, 3, 4}
    for bit in range(48):
        # 2.5 of 48 bits, but for those drawn twice: 5 % of 2000 datagrams. Standard deviation 10.
        assert 60 < sum(word >> bit & 1 for word in words) < 140
    link.send(b"", 0)
    assert [entry[3] for entry in link.due(NEVER_NS)] == [b""]


def drawn_by(link: link_keys.Link, seed: int, others: int) -> list[list[tuple[int, ...]]]:
    """What the links of vehicle 2, up and down, do to the same datagrams while other vehicles send some of theirs."""
    changed = scenario(3, seed=seed)
    links = LinkSet(changed.model_copy(update={"links": link_keys.Links(up=link, down=link)}), 0)
    for k in range(200):
        for busy in (1, 3):
            for _ in range(others):
                links.of(busy)[0].send(b"other", k * MS)
        for own in links.of(2):
            own.send(b"own", k * MS)
    return [[(due, number, fate) for due, number, _, _, fate, _ in own.due(NEVER_NS)] for own in links.of(2)]


RESTLESS = link_keys.Link(
    delay_s=0.01,
    jitter=Jitter(distribution="exponential", scale_s=0.01),
    loss_probability=0.1,
    duplicate_probability=0.1,
    corrupt_probability=0.1,
)


def test_the_seed_decides_and_directions_draw_independently() -> None:
    first = drawn_by(RESTLESS, seed=1, others=0)
    assert first == drawn_by(RESTLESS, seed=1, others=0)
    assert first != drawn_by(RESTLESS, seed=2, others=0)
    assert first[0] != first[1]


def test_other_vehicles_traffic_does_not_change_a_links_draws() -> None:
    assert drawn_by(RESTLESS, seed=1, others=0) == drawn_by(RESTLESS, seed=1, others=3)


@pytest.mark.parametrize(
    "change",
    [{"loss_probability": 0.5}, {"duplicate_probability": 0.0}, {"corrupt_probability": 0.0}],
    ids=lambda change: next(iter(change)),
)
def test_an_added_effect_leaves_the_other_draws(change: dict[str, float]) -> None:
    """Delays of what arrives in both cases are equal: every datagram takes the same draws, used or not."""
    link = RESTLESS.model_copy(update={"reordering": True})
    by_number: Callable[[link_keys.Link], dict[int, int]] = lambda own: {  # noqa: E731 - two lines that are one
        number: due for due, number, fate in drawn_by(own, seed=1, others=0)[0] if not fate & DUPLICATE
    }
    before, after = by_number(link), by_number(link.model_copy(update=change))
    common = before.keys() & after.keys()
    assert len(common) > 80
    assert all(before[number] == after[number] for number in common)


def test_without_loss_only_jitter_is_drawn_and_stays_the_same() -> None:
    with_loss = link_keys.Link(jitter=Jitter(distribution="gamma", scale_s=0.01, shape=2.5), loss_probability=0.1)
    drawn: list[Any] = []
    for link in (with_loss, with_loss.model_copy(update={"loss_probability": 0.0})):
        stream, block = Stream(link, np.random.SeedSequence(3)), np.zeros(BLOCK, DRAW)
        stream.fill(block)
        drawn.append(block)
    assert drawn[0]["loss"].all()
    assert not drawn[1]["loss"].any()
    assert drawn[1]["jitter_ns"].tolist() == drawn[0]["jitter_ns"].tolist()
