"""Loss, late and duplicate counts survive reordering."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gcs.sequence import SequenceCounter


def counted(numbers: list[int]) -> SequenceCounter:
    counter = SequenceCounter()
    for number in numbers:
        counter.add(number & 0xFF)
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


@given(st.integers(0, 2**32), st.floats(0.0, 0.6))
def test_random_losses_are_counted_exactly(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    kept = [n for n in range(500) if n in (0, 499) or rng.random() >= share]
    gaps = np.diff(kept)
    if gaps.max() < 128:  # more in a row than the number can hold
        assert counts(counted(kept)) == (len(kept), 500 - len(kept), 0, 0)


@given(st.integers(0, 2**32))
def test_reordering_within_the_window_is_never_loss(seed: int) -> None:
    rng = np.random.default_rng(seed)
    order = np.argsort(np.arange(400) + rng.uniform(0, 20, 400))
    order = [0, *[int(n) for n in order if n != 0]]
    counter = counted(order)
    assert (counter.lost, counter.duplicate) == (0, 0)
    newest = np.maximum.accumulate(order)
    assert counter.late == int((np.array(order) < newest).sum())
