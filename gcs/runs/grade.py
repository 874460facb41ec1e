"""Grades measured latencies against the truth recorded by vehicles and emulated links, for `gcs grade`.

A round trip is that of one TIMESYNC exchange: the request's time in the down link plus the reply's in the up link. A
loop delay, repetition included, runs from when the state was sampled until the set-point computed from it acts. The
truth log has both times, keyed by the time_boot_ms of the messages.
"""

import itertools
from collections import defaultdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray, IntArray
from gcs.control.tick import TickArray
from gcs.errors import InputError, usable
from gcs.published import Published
from gcs.runs.files import by_vehicle, read_ticks
from gcs.runs.record import TRUTH_FILE
from sim_vehicles.links.truth import ACTED, DROPPED, LINK_DOWN, LINK_UP, SAMPLED, read_truth

Truth = NDArray[np.void]
"""Records of dtype sim_vehicles.links.truth.DTYPE."""

_TIMESYNC, NEVER = 111, -1


class Graded(Published):
    """Percentiles of the absolute error of measurements against the truth; None without a sample."""

    status: str
    samples: int
    error_p50_s: float | None
    error_p99_s: float | None
    error_max_s: float | None


class Grade(Published):
    """The errors of a run's loop delays and round trips, and the lateness and the jitter of its emulated links."""

    vehicles: int
    loop_delay: Graded
    rtt: Graded
    link_delay: Graded
    down_jitter: Graded
    """How far the delays of the down links are from their vehicle's median. A loop delay is also off by the difference
    between that of its own set-point, which cannot be known when it is sent, and that of the last TIMESYNC request."""


def grade(folder: Path) -> Grade:
    """Grade a run: the loop delays and round trips that it measured, and the lateness of its emulated up links.

    Raises InputError if the folder is not a run, or has no truth log.
    """
    with usable(folder / TRUTH_FILE, "the truth log in a run's folder"):
        try:
            truth = read_truth(folder / TRUTH_FILE)
        except FileNotFoundError:
            wanted = "the folder of a run whose vehicles the station started"
            raise InputError(f"{folder}: read no {TRUTH_FILE}, wanted {wanted}") from None
        except ValueError as error:
            raise InputError(f"{error}, wanted the truth log of a run's vehicles") from None
    if not truth.size:
        raise InputError(f"{folder / TRUTH_FILE}: read no record, wanted the truth log of a run's vehicles")
    ticks = read_ticks(folder)
    flown = ticks[ticks["time_s"] >= 0.0]
    system_ids = np.unique(ticks["system_id"]).tolist()
    ticks_of, truth_of = by_vehicle(ticks), by_vehicle(truth[truth["key"] == _TIMESYNC])
    trips_s = [_trip_errors_s(ticks_of[system_id], truth_of[system_id], system_id) for system_id in system_ids]
    trip_errors_s = np.concatenate(trips_s)
    left = truth[(truth["kind"] == LINK_UP) & (truth["fate"] & DROPPED == 0)]
    late_s = (left["time_ns"] - left["due_ns"]) * 1e-9
    down = truth[(truth["kind"] == LINK_DOWN) & (truth["fate"] & DROPPED == 0)]
    downs_s = [(own["due_ns"] - own["entered_ns"]) * 1e-9 for own in by_vehicle(down).values()]
    jitter_s = np.concatenate([np.zeros(0), *(own_s - np.median(own_s) for own_s in downs_s)])
    return Grade(
        vehicles=len(system_ids),
        loop_delay=graded(flown["loop_delay_s"] + flown["repeated_s"], true_loop_delays_s(flown, truth)),
        rtt=graded(trip_errors_s, np.zeros(len(trip_errors_s))),
        link_delay=graded(late_s, np.zeros(len(late_s))),
        down_jitter=graded(jitter_s, np.zeros(len(jitter_s))),
    )


def _trip_errors_s(ticks: TickArray, truth: Truth, system_id: int) -> FloatArray:
    """The error of each measured round trip against the nearest true one whose reply was due before its tick.

    Both lists are in order of time and each reply is matched once: of several replies between two ticks, the later ones
    are logged by later ticks.
    """
    rows = ticks[np.isfinite(ticks["rtt_s"])]
    due_ns, trip_s = true_round_trips(truth, system_id)
    left = np.searchsorted(due_ns, rows["sent_ns"])
    errors_s: list[float] = []
    taken = 0
    for measured_s, end in zip(rows["rtt_s"].tolist(), left.tolist(), strict=True):
        if taken < end:
            off_s = measured_s - trip_s[taken:end]
            nearest = int(np.abs(off_s).argmin())
            errors_s.append(float(off_s[nearest]))
            taken += nearest + 1
    return np.array(errors_s)


def true_round_trips(truth: Truth, system_id: int) -> tuple[NDArray[np.int64], FloatArray]:
    """TIMESYNC exchanges that the vehicle answered at once: when each reply was due (ns), and its round trip (s)."""
    own = truth[(truth["system_id"] == system_id) & (truth["key"] == _TIMESYNC) & (truth["fate"] & DROPPED == 0)]
    asked, answered = own[own["kind"] == LINK_DOWN], own[own["kind"] == LINK_UP]
    # On a link that does not reorder, several requests may arrive at one instant; they are answered in order. If one of
    # them is the station's answer to the vehicle instead, it cannot be told which, and none of them counts.
    sent_ns: dict[int, list[int]] = defaultdict(list)
    left_ns: dict[int, list[int]] = defaultdict(list)
    for entered_ns, due_ns in sorted(asked[["entered_ns", "due_ns"]].tolist()):
        sent_ns[due_ns].append(entered_ns)
    for entered_ns, due_ns in sorted(answered[["entered_ns", "due_ns"]].tolist()):
        left_ns[entered_ns].append(due_ns)
    replies: list[tuple[int, int, int]] = []  # replies that arrive together were sent in this order
    for at_ns, dues_ns in left_ns.items():
        if len(sent_ns[at_ns]) in (1, len(dues_ns)):  # one request may have two replies, the second a copy
            replies += zip(dues_ns, itertools.repeat(at_ns), itertools.cycle(sent_ns[at_ns]), strict=False)
    replies.sort()
    due = np.array([due_ns for due_ns, _, _ in replies], dtype=np.int64)
    return due, np.array([(due_ns - asked_ns) * 1e-9 for due_ns, _, asked_ns in replies])


def true_loop_delays_s(ticks: TickArray, truth: Truth) -> FloatArray:
    """The true age (s) of the state behind each row's set-point when the set-point acted.

    NaN where the set-point never acted, or its state is unknown. Each tick must have a row for every vehicle.
    """
    acted_ns = first_ns(truth, ACTED, ticks, "key_ms")
    sampled_ns = first_ns(truth, SAMPLED, ticks[_rows_used(ticks)], "sample_boot_ms")
    known = ticks["commanded"] & (acted_ns != NEVER) & (sampled_ns != NEVER)
    return np.where(known, (acted_ns - sampled_ns) * 1e-9, np.nan)


def _rows_used(ticks: TickArray) -> NDArray[np.int64]:
    """For each row, the row of the same tick with the state from which its loop delay is counted.

    With the loop on the ground that is the row itself; with loops on board it is the row of the oldest state needed,
    identified by its age.
    """
    vehicles = len(np.unique(ticks["system_id"]))
    age_s = ticks["telemetry_age_s"].reshape(-1, vehicles)
    used_s = (ticks["loop_delay_s"] + ticks["repeated_s"] - ticks["down_delay_s"]).reshape(-1, vehicles)
    own, nearest = np.arange(vehicles), np.empty(age_s.shape, np.int64)
    for k in range(len(age_s)):  # tick by tick: all at once would take 8 GB for 20 s of 1,000 vehicles
        apart_s = np.abs(age_s[k] - used_s[k, :, np.newaxis])
        apart_s[own, own] -= 1e-9  # of equally old states, prefer the vehicle's own
        nearest[k] = np.argmin(np.where(np.isnan(apart_s), np.inf, apart_s), axis=1)
    return (np.arange(len(age_s))[:, np.newaxis] * vehicles + nearest).ravel()


def first_ns(truth: Truth, kind: int, rows: TickArray, column: str) -> IntArray:
    """For each row, the first instant that a kind of record has for its vehicle and time_boot_ms; NEVER if none."""
    of_kind = truth[truth["kind"] == kind]
    known, first = np.unique(_keys(of_kind, "key"), return_index=True)
    keys = _keys(rows, column)
    place = np.searchsorted(known, keys)
    found_ns = np.append(of_kind["time_ns"][first], NEVER)
    return found_ns[np.where(np.append(known, -1)[place] == keys, place, -1)]


def _keys(records: Truth, column: str) -> IntArray:
    return records["system_id"].astype(np.int64) << 32 | records[column]


def graded(measured_s: FloatArray, true_s: FloatArray) -> Graded:
    """The errors of those measurements for which the truth is known."""
    both = np.isfinite(measured_s) & np.isfinite(true_s)
    error_s = np.abs(measured_s - true_s)[both]
    if not error_s.size:
        return Graded(status="unknown", samples=0, error_p50_s=None, error_p99_s=None, error_max_s=None)
    p50, p99 = np.percentile(error_s, [50, 99]).tolist()
    largest = float(error_s.max())
    return Graded(status="measured", samples=error_s.size, error_p50_s=p50, error_p99_s=p99, error_max_s=largest)


def commands_of(ticks: TickArray, truth: Truth, system_id: int) -> NDArray[np.int64]:
    """When a vehicle's commands acted and when the states behind them were sampled: (k, 2), ns, in order of time."""
    own, truth = ticks[(ticks["system_id"] == system_id) & ticks["commanded"]], truth[truth["system_id"] == system_id]
    acted_ns, sampled_ns = first_ns(truth, ACTED, own, "key_ms"), first_ns(truth, SAMPLED, own, "sample_boot_ms")
    known = (acted_ns != NEVER) & (sampled_ns != NEVER)
    pairs = np.stack([acted_ns, sampled_ns], axis=1)[known]
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def commands_on_board(ticks: TickArray, truth: Truth, system_id: int) -> NDArray[np.int64]:
    """`commands_of` for loops on board: the states are the oldest that each streamed command needed.

    Each tick must have a row for every vehicle.
    """
    delays_s = true_loop_delays_s(ticks, truth)
    own = (ticks["system_id"] == system_id) & np.isfinite(delays_s)
    acted_ns = first_ns(truth, ACTED, ticks[own], "key_ms").tolist()
    pairs = [(at, at - round(1e9 * late_s)) for at, late_s in zip(acted_ns, delays_s[own].tolist(), strict=True)]
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)
