"""Rows of the tick log, put together as arrays of shape (ticks, vehicles)."""

from collections.abc import Sequence

import numpy as np

from gcs.control.tick import TICK, TickArray


class WholeTicks:
    """Collects rows as they are written and gives each tick once all its rows are there."""

    def __init__(self, system_ids: Sequence[int]) -> None:
        self._system_ids = tuple(system_ids)
        self._pending: TickArray = np.empty(0, TICK)

    def add(self, rows: TickArray) -> TickArray:
        """The ticks completed by `rows`: shape (ticks, vehicles), in the order of `system_ids`."""
        rows = np.concatenate([self._pending, rows])
        # Only the newest tick can still be growing, and only while rows of it are missing.
        newest = int(np.count_nonzero(rows["tick"] == rows["tick"][-1])) if rows.size else 0
        cut = rows.size if newest >= len(self._system_ids) else rows.size - newest
        self._pending = rows[cut:]
        return by_tick(rows[:cut], self._system_ids)

    def rest(self) -> TickArray:
        """What is left when the log has ended; unknown where a row was never written."""
        rows, self._pending = self._pending, np.empty(0, TICK)
        return by_tick(rows, self._system_ids)


def by_tick(rows: TickArray, system_ids: Sequence[int]) -> TickArray:
    """Rows as an array of shape (ticks, vehicles).

    Where a tick has no row for a vehicle, every float but the time is NaN and every counter 0. Rows of vehicles that
    are not in `system_ids` are left out.
    """
    column = np.full(256, -1)
    column[list(system_ids)] = np.arange(len(system_ids))
    rows = rows[column[rows["system_id"]] >= 0]
    ticks, first, line = np.unique(rows["tick"], return_index=True, return_inverse=True)
    grid = np.tile(unknown(system_ids), (ticks.size, 1))
    for name in ("tick", "time_s", "due_ns", "sent_ns", "key_ms"):
        grid[name] = rows[name][first][:, np.newaxis]
    grid[line, column[rows["system_id"]]] = rows
    return grid


def unknown(system_ids: Sequence[int]) -> TickArray:
    """One row for each vehicle, of which nothing is known."""
    rows = np.zeros(len(system_ids), TICK)
    for name in TICK.names or ():
        if TICK[name].kind == "f":
            rows[name] = np.nan
    rows["system_id"] = system_ids
    return rows
