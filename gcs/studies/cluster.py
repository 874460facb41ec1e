"""A map of trials on Dask with one local worker and with several: the cost of distribution, and how far it scales."""

import logging
import pickle
import time  # noqa: TID251 - run time is what is measured; nothing flown depends on it
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from gcs.interrupts import raised
from gcs.plan.planner import flight_plan
from gcs.published import Published
from gcs.stress.campaign import dask_workers
from gcs.stress.study import Study
from gcs.stress.trial import Outcome, Trial
from gcs.studies.benchmark import without_solver
from scenarios.schema import Scenario

_DELAYS_S, _JITTERS_S = np.linspace(0.15, 0.375, 10).round(9).tolist(), (0.0, 0.02, 0.04, 0.06, 0.08)
"""Link delays, up + down, and scales of the jitter: the map of docs/how-to/cluster.md."""


class ClusterMap(Published):
    """A map flown by one local worker and by all; each worker is a process with one thread.

    `efficiency` is the time with one worker over `workers` times the time with all. `trial_s` is the mean run time of a
    trial with one worker, and `worker_overhead_s` the additional time per trial that this worker took. `central_s` is
    the processor time of scheduler and client per trial, from a map of trials that are not flown. Scheduler and client
    are one Python process here, which more workers do not speed up. `cores_served` is `trial_s` / `central_s`, the
    number of workers that would keep this process fully busy. Sizes are those of pickled trials and outcomes.
    """

    trials: int
    workers: int
    seconds: float
    one_worker_s: float
    all_workers_s: float
    efficiency: float
    trial_s: float
    worker_overhead_s: float
    central_s: float
    cores_served: float
    trial_bytes: float
    outcome_bytes: float


_TRACE = 120
"""Number of values in the trace of a flight of 30 s."""
_UNFLOWN = 500
"""Number of trials in the map that measures the cost of scheduler and client."""


class _Flown(NamedTuple):
    """The outcomes of a map, the time it took, and this process's processor time per trial that is not flown."""

    outcomes: list[Outcome]
    taken_s: float
    central_s: float


def map_on_cluster(scenario: Scenario, *, trials: int, workers: int, seconds: float) -> ClusterMap:
    """Fly a map over link delay and jitter with one worker and with `workers`; each trial flies for `seconds`."""
    _, plan = flight_plan(without_solver(scenario.with_calm_monitor(), seconds))
    study, points = Study(plan), list(product(_DELAYS_S, _JITTERS_S))
    wanted: list[Trial] = []
    for k in range(trials + _UNFLOWN):
        delay_s, jitter_s = points[k % len(points)]
        seed = scenario.seed + k // len(points)
        wanted.append(study.trial("own", {"delay": delay_s, "jitter": jitter_s}, seed=seed))
    with raised():
        one, several = (_flown(wanted[:trials], wanted[trials:], count) for count in (1, workers))
    trial_s = sum(outcome.elapsed_s for outcome in one.outcomes) / trials
    central_s = min(one.central_s, several.central_s)
    return ClusterMap(
        trials=trials,
        workers=workers,
        seconds=seconds,
        one_worker_s=one.taken_s,
        all_workers_s=several.taken_s,
        efficiency=one.taken_s / several.taken_s / workers,
        trial_s=trial_s,
        worker_overhead_s=one.taken_s / trials - trial_s,
        central_s=central_s,
        cores_served=trial_s / central_s,
        trial_bytes=_bytes(wanted[:trials]),
        outcome_bytes=_bytes(several.outcomes),
    )


def _flown(wanted: list[Trial], unflown: list[Trial], workers: int) -> _Flown:
    """Fly the trials `wanted` on this many workers, after a map of the trials `unflown`, which are not flown."""
    from distributed import LocalCluster

    make: Any = LocalCluster  # its type hints do not allow synchronous use
    # its HTTP server runs even without a dashboard; without an explicit port it takes 8787, and warns if that is in use
    http = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}
    quiet = {"silence_logs": logging.CRITICAL}  # interrupted workers log tracebacks as errors
    with make(n_workers=workers, threads_per_worker=1, host="127.0.0.1", scheduler_kwargs=http, **quiet) as cluster:
        with dask_workers(cluster.scheduler_address, _not_flown) as answer:
            list(answer(unflown[:1]))  # the workers' imports
            used_s = time.process_time()
            list(answer(unflown[1:]))
            central_s = (time.process_time() - used_s) / (len(unflown) - 1)
        with dask_workers(cluster.scheduler_address) as fly:
            begun_s = time.perf_counter()
            outcomes = list(fly(wanted))
            return _Flown(outcomes, time.perf_counter() - begun_s, central_s)


def _not_flown(trial: Trial) -> Outcome:
    return Outcome(trial.id, trial.kind, trial.scenario.seed, {}, real_time=False, trace_m=[0.5] * _TRACE)


def _bytes(records: list[Any]) -> float:
    return sum(len(pickle.dumps(record)) for record in records) / len(records)
