"""The tick record."""

import numpy as np
import pytest

from gcs.control.tick import TICK, chosen

ROWS = np.zeros(20, TICK)
ROWS["tick"], ROWS["system_id"] = np.arange(20) // 5, np.arange(20) % 5


@pytest.mark.parametrize(
    ("which", "copied"),
    [
        (ROWS["tick"] > 1, False), (ROWS["system_id"] == 3, False), (np.arange(20), False), (ROWS["tick"] > 9, True),
        (ROWS["system_id"] > 2, True), (np.arange(20)[::-1], True), (np.array([4, 4]), True), (np.array([7]), True),
    ],
)  # fmt: skip
def test_chosen_rows_match_numpy_without_copies_if_equally_spaced(which: np.ndarray, copied: bool) -> None:
    assert chosen(ROWS, which).tolist() == ROWS[which].tolist()
    assert np.shares_memory(chosen(ROWS, which), ROWS) is not copied
