"""Loss, late and duplicate counts survive reordering and outages."""

import itertools
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gcs.link.sequence import SequenceCounter

MS = 1_000_000


def counted(numbers: list[int], times_ms: Iterable[float] | None = None) -> SequenceCounter:
    """The counter after frames received at these times, by default 20 ms apart."""
    counter = SequenceCounter()
    for number, time_ms in zip(numbers, times_ms or itertools.count(0, 20), strict=times_ms is not None):
        counter.add(number & 0xFF, round(time_ms * MS))
    return counter


def counts(counter: SequenceCounter) -> tuple[int, int, int, int]:
    return counter.received, counter.lost, counter.late, counter.duplicate


def test_whole_stream_over_many_turns_of_the_counter_loses_nothing() -> None:
    assert counts(counted(list(range(1000)))) == (1000, 0, 0, 0)


def test_one_swapped_pair_is_one_late_frame_and_no_loss() -> None:
    numbers = list(range(300))
    numbers[150], numbers[151] = numbers[151], numbers[150]
    assert counts(counted(numbers)) == (300, 0, 1, 0)


def test_duplicates_are_counted_apart() -> None:
    assert counts(counted([0, 1, 1, 2, 0, 3])) == (6, 0, 0, 2)


@pytest.mark.parametrize("newer", [63, 64, 127])
def test_copies_are_recognised_among_the_newest_128_frames(newer: int) -> None:
    """A replayed frame that counted as late would be used again."""
    assert counts(counted([*range(newer + 1), 0])) == (newer + 2, 0, 0, 1)


def test_a_clock_that_jumps_by_centuries_fills_the_count() -> None:
    centuries_ms = 2e2 * 365 * 24 * 3600 * 1e3
    assert counted(list(range(101)), [*(20.0 * n for n in range(100)), centuries_ms]).lost == 2**32 - 1


@given(st.integers(0, 2**32), st.floats(0.0, 0.6))
def test_random_losses_are_counted_exactly(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    kept = [n for n in range(500) if n in (0, 499) or rng.random() >= share]
    assert np.diff(kept).max() < 128
    assert counts(counted(kept, [20.0 * n for n in kept])) == (len(kept), 500 - len(kept), 0, 0)


@example(323, 290.9375, 55.265625, 0.0)
@given(st.integers(0, 2**32), st.floats(20.0, 300.0), st.floats(0.0, 60.0), st.floats(0.0, 0.3))
def test_losses_in_outages_up_to_a_minute_are_counted_whole(
    seed: int, rate_hz: float, outage_s: float, share: float
) -> None:
    rng = np.random.default_rng(seed)
    count = round((outage_s + 10.0) * rate_hz)
    sent_s = np.arange(count) / rate_hz
    came = (rng.random(count) >= share) & ((sent_s < 5.0) | (sent_s >= 5.0 + outage_s))
    came[0] = came[-1] = True
    kept = np.flatnonzero(came)
    delay_s = rng.uniform(0.02, 0.03, kept.size)
    order = np.argsort(sent_s[kept] + delay_s)
    order = np.concatenate(([0], order[order != 0]))
    counter = counted(kept[order].tolist(), (1e3 * (sent_s[kept] + delay_s)[order]).tolist())
    # Of the last frames, one that has overtaken others leaves these out.
    assert abs(counter.lost - (count - kept.size)) <= 0.01 * rate_hz + 1
    assert counter.duplicate == 0


def test_frames_overtaken_by_two_hundred_are_neither_lost_nor_duplicates() -> None:
    """50 frames a second, each up to 3 s late: the signed difference of two numbers would be wrong by 256."""
    rng = np.random.default_rng(4)
    arrival_ms = 20.0 * np.arange(4000) + rng.uniform(0.0, 3000.0, 4000)
    arrival_ms[0] = 0.0
    order = np.argsort(arrival_ms)
    counter = counted(order.tolist(), arrival_ms[order].tolist())
    newest = np.maximum.accumulate(order)
    assert counter.late == int((order < newest).sum())
    assert counter.lost <= 150  # what is still under way behind the last
    assert counter.duplicate == 0


@given(st.integers(0, 2**32))
def test_reordering_within_the_window_is_never_loss(seed: int) -> None:
    rng = np.random.default_rng(seed)
    order = np.argsort(np.arange(400) + rng.uniform(0, 20, 400))
    order = [0, *[int(n) for n in order if n != 0]]
    counter = counted(order)
    assert (counter.lost, counter.duplicate) == (0, 0)
    newest = np.maximum.accumulate(order)
    assert counter.late == int((np.array(order) < newest).sum())


@pytest.mark.parametrize("lost_between", [0, 2])
def test_a_very_late_frame_makes_only_eight_good_ones_late(lost_between: int) -> None:
    numbers = [*range(300), 150, *range(300, 600, lost_between + 1)]  # 150 is taken for 256 + 150
    counter = counted(numbers, [20.0 * max(n, 299) for n in numbers])
    assert (counter.late, counter.duplicate) == (8, 0)


def test_a_burst_hidden_in_time_counts_once_reordering_has_ended() -> None:
    rng = np.random.default_rng(4)
    arrival_ms = 20.0 * np.arange(1000) + rng.uniform(0.0, 2000.0, 1000)  # overtaken by up to a hundred
    arrival_ms[0] = 0.0
    order = np.argsort(arrival_ms)
    steady = np.arange(1000, 3000)
    numbers = [*order.tolist(), *steady.tolist(), 3100]
    times_ms = [*arrival_ms[order].tolist(), *(2000.0 + 20.0 * steady).tolist(), 2000.0 + 20.0 * 3000]
    assert counted(numbers, times_ms).lost == 100


def test_a_senders_pause_does_not_spoil_the_next_outages_count() -> None:
    before, after = np.arange(260), np.arange(1260, 1400)  # 50 frames a second; a pause of 1.9 s after 250
    times_ms = [20.0 * n + 1900.0 * (n >= 250) for n in [*before.tolist(), *after.tolist()]]
    assert counted([*before.tolist(), *after.tolist()], times_ms).lost == 1000
