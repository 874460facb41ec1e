"""The constant loop delay that is equivalent to the varying delays of a vehicle's commands."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from gcs.control.tick import TickArray
from gcs.runs.grade import ACTED, SAMPLED, Truth, instants, true_loop_delays_s

_TRUTH = np.dtype([("kind", "u1"), ("system_id", "u1"), ("key", "<u4"), ("time_ns", "<i8")])


def truth_of(records: Iterable[Sequence[int]]) -> Truth:
    """Those records of simulated vehicles that say when states were sampled and set-points acted."""
    return np.array([tuple(record[:4]) for record in records if record[0] in (SAMPLED, ACTED)], _TRUTH)


def commands_of(ticks: TickArray, truth: Truth, system_id: int) -> NDArray[np.int64]:
    """(k, 2) instants in ns at which a vehicle's commands acted and at which the states used were sampled, in order."""
    sampled, acted = (instants(truth[truth["system_id"] == system_id], kind) for kind in (SAMPLED, ACTED))
    rows = ticks[(ticks["system_id"] == system_id) & ticks["commanded"]]
    known = [((system_id, key), (system_id, boot)) for key, boot in rows[["key_ms", "sample_boot_ms"]].tolist()]
    pairs = [(acted[key], sampled[boot]) for key, boot in known if key in acted and boot in sampled]
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def commands_on_board(ticks: TickArray, truth: Truth, system_id: int) -> NDArray[np.int64]:
    """The same with loops on board: what was streamed, and when the oldest state that it needed was sampled.

    `ticks` are whole: a row for every vehicle.
    """
    acted, delays_s = instants(truth, ACTED), true_loop_delays_s(ticks, truth)
    own = (ticks["system_id"] == system_id) & np.isfinite(delays_s)
    acted_ns = [acted[system_id, key] for key in ticks["key_ms"][own].tolist()]
    pairs = [(at, at - round(1e9 * late_s)) for at, late_s in zip(acted_ns, delays_s[own].tolist(), strict=True)]
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def effective_delay_s(commands: NDArray[np.int64], *, held_s: float) -> float:
    """The constant loop delay equivalent to these commands: the mean age of the state behind them, less T / 2.

    T = `held_s` is the slower of the periods of telemetry and control. The command in action ages until one from a
    newer state acts, T / 2 on average when all arrive (`gains.sampled.multirate`). Unlike the median of the loop
    delays, this accounts for commands that never arrived. Where delays change fast compared with the loop's motion,
    only the mean age matters, to first order.
    """
    if len(commands) < 2:
        return 0.0
    acted_ns, sampled_ns = commands[:, 0], commands[:-1, 1]
    acting_s, late_s = np.diff(acted_ns) * 1e-9, (acted_ns[:-1] - sampled_ns) * 1e-9
    return float((acting_s * (late_s + acting_s / 2.0)).sum() / acting_s.sum()) - held_s / 2.0
