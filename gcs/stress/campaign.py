"""Fly many trials on all processors or on a cluster, and store each as soon as it ends.

The store is one file of JSON lines. A finished trial is appended with one system call, so a killed campaign loses no
finished trial. A resumed campaign does not fly trials whose id is stored, unless they ended in an error. `refly` flies
one of them again, with files and a Rerun recording; in virtual time it repeats to the last bit.
"""

import contextlib
import ctypes
import fcntl
import hashlib
import json
import os
import signal
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Generic, TypeVar

from gcs.errors import InputError
from gcs.interrupts import FROM_TERMINAL, held_back
from gcs.output import DISK_FULL
from gcs.runs.record import SCENARIO_FILE, RecordLog, write_parquet
from gcs.stress.measure import fly_trial
from gcs.stress.study import Study
from gcs.stress.trial import Outcome, Trial
from scenarios.files import dump
from scenarios.keys.own import CodeFile
from scenarios.own_code import as_flown
from scenarios.schema import Scenario

TRIALS_FILE = "trials.jsonl"
PARQUET_FILE = "trials.parquet"
_PR_SET_PDEATHSIG = 1
_TRIALS_IN_TASK, _TASKS_OF_THREAD = 16, 4
"""Maximum number of trials in one Dask task, and minimum number of tasks for each of its threads."""
_Record = TypeVar("_Record")

Fly = Callable[[Sequence[Trial]], Iterator[Outcome]]
"""Flies trials and yields their outcomes as they end, in any order."""


class Store(Generic[_Record]):
    """The finished flights of a study by key, in a file of JSON lines.

    Raises InputError if another process has the file open: both would fly the same trials.
    """

    def __init__(self, file: Path, kind: Callable[..., _Record], key: Callable[[_Record], Any]) -> None:
        self.file, self._key = file, key
        self.flown: dict[Any, _Record] = {}
        self._log = RecordLog(file)
        try:
            fcntl.flock(self._log.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._log.close()
            raise InputError(f"{file.parent}: another gcs works there; wanted a folder of its own") from None
        text = file.read_bytes()
        for line in text.splitlines():
            with contextlib.suppress(ValueError, TypeError):  # a kill cut this line short; its flight is flown again
                record = kind(**json.loads(line))
                self.flown[key(record)] = record
        if text and not text.endswith(b"\n"):
            self._log.add(b"\n")

    def add(self, record: _Record) -> None:
        """Store a flight; it is in the file when this returns. Raises InputError if it cannot be written."""
        try:
            self._log.add((json.dumps(vars(record), allow_nan=False) + "\n").encode())
        except OSError as error:
            raise InputError(f"{self.file}: {error.strerror}; {self.resume}") from None
        self.flown[self._key(record)] = record

    @property
    def resume(self) -> str:
        """A sentence that tells the user how to resume the study."""
        return f"{len(self.flown)} flights are stored; continue with --resume --out {self.file.parent}"

    def close(self) -> None:
        self._log.close()


def trials_of(folder: Path) -> Store[Outcome]:
    """The store of finished trials in a campaign's folder."""
    return Store(folder / TRIALS_FILE, Outcome, lambda outcome: outcome.id)


def check_study(flag: str, file: Path, kind: str = "campaign", scenario: Scenario | None = None) -> None:
    """Raise InputError unless the folder of `file` holds this kind of study, of this scenario and its code."""
    for name in (SCENARIO_FILE, file.name):
        if not file.with_name(name).is_file():
            raise InputError(f"{flag}: read no {name} in {file.parent}, wanted the folder of a {kind}")
    known = file.with_name(SCENARIO_FILE)
    if scenario is not None and known.read_text(encoding="utf-8") != dump(scenario):
        raise InputError(f"{flag}: {file.parent} holds a {kind} of another scenario or loop, wanted {known}")
    for code in () if scenario is None else as_flown(scenario).code:
        kept = file.with_name(code.name)
        if not kept.is_file() or CodeFile(name=code.name, text=kept.read_text(encoding="utf-8")).sha256 != code.sha256:
            raise InputError(f"{flag}: {file.parent} holds a {kind} flown with other code, wanted {kept}")


def run_campaign(
    trials: Sequence[Trial], store: Store[Outcome], fly: Fly, *, ended: Callable[[int], None] = lambda _: None
) -> list[Outcome]:
    """Return the outcomes of trials in the given order; those not stored, or stored with an error, are flown first.

    `ended` is called after each trial with the number left. Raises KeyboardInterrupt also if Ctrl-C ended a flight in
    real time; that flight is not stored.
    """
    missing = {t.id: t for t in trials if t.id not in store.flown or store.flown[t.id].error is not None}
    left = len(missing)
    try:
        for outcome in fly(list(missing.values())) if missing else ():
            if (outcome.reason or "").startswith("interrupted"):
                raise KeyboardInterrupt
            store.add(outcome)
            left -= 1
            ended(left)
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        raise InputError(f"{error.filename}: {error.strerror}; {store.resume}") from None
    # the same trial may have other coordinates in another sweep
    return [replace(store.flown[trial.id], coordinates=dict(trial.coordinates)) for trial in trials]


@dataclass(frozen=True)
class Reflown:
    """A trial flown again.

    `differs` names the fields that differ from its first flight. It is empty in real time, where any may differ.
    """

    outcome: Outcome
    runs: list[Path]
    differs: list[str]


def refly(study: Study, folder: Path, wanted: str) -> Reflown:
    """Fly again the one trial in a campaign's folder whose id begins with `wanted`.

    Its runs are left in `flights` beside the campaign's table. A study in real time flies it over UDP, even if it was
    first flown in virtual time. Raises InputError unless exactly one id begins with `wanted`, or if the trial was
    flown with another scenario.
    """
    from gcs.views.observer import recover_run  # slow to import, and workers need none of it

    check_study("--trial", folder / TRIALS_FILE)
    with contextlib.closing(trials_of(folder)) as store:
        found = [outcome for outcome in store.flown.values() if outcome.id.startswith(wanted)]
    if len(found) != 1:
        raise InputError(f"--trial: read {wanted!r}, wanted the id of one trial in {folder}")
    [stored] = found
    first = replace(study, real_time=stored.real_time)
    trial = first.trial(stored.kind, stored.coordinates, seed=stored.seed, probe=stored.probe)
    if trial.id != stored.id:
        raise InputError(
            f"--trial: {stored.id} was flown with another scenario or design; wanted {folder / SCENARIO_FILE}"
        )
    again = replace(trial, real_time=trial.real_time or study.real_time)
    flights, stem = folder / "flights", f"{stored.id}{'-real-time' if again.real_time else ''}"
    flights.mkdir(parents=True, exist_ok=True)
    names = (stem if count == 1 else f"{stem}-{count}" for count in range(1, 1000))
    run = next(flights / name for name in names if not (flights / name).exists())  # `fly_trial` creates it
    outcome = fly_trial(again, run)
    runs = [run] if (run / SCENARIO_FILE).exists() else sorted(run.iterdir()) if run.is_dir() else []
    for flight in runs:
        recover_run(flight)
    was, now = (vars(replace(one, elapsed_s=0.0, coordinates={}, error=None)) for one in (stored, outcome))
    return Reflown(outcome, runs, [name for name in was if was[name] != now[name] and not again.real_time])


@contextlib.contextmanager
def local_workers(
    count: int, run: Callable[[Any], Any] = fly_trial
) -> Generator[Callable[[Sequence[Any]], Iterator[Any]]]:
    """While entered, fly trials in `count` processes, in this one if `count` is 1. `run` is called for each trial."""
    if count == 1:
        yield partial(map, run)
        return
    with contextlib.ExitStack() as stack:
        pools: list[ProcessPoolExecutor] = []

        def fly(trials: Sequence[Any]) -> Iterator[Any]:
            if not pools:
                # spawn: a fork would copy locks held by threads of libraries that the user's process has loaded
                spawn = get_context("spawn")
                with held_back():  # multiprocessing's resource tracker, which starts here, would die of SIGHUP
                    pools.append(ProcessPoolExecutor(count, spawn, _prepare_worker, (os.getpid(),)))
                stack.callback(pools[0].shutdown, cancel_futures=True)
            try:
                with held_back():  # workers that are still starting must leave Ctrl-C to this process
                    futures = [pools[0].submit(run, trial) for trial in trials]
                for future in as_completed(futures):
                    yield future.result()
            except BrokenProcessPool:
                raise InputError(
                    "a worker process was killed, perhaps for want of memory; try fewer --workers, with --resume"
                ) from None

        yield fly


@contextlib.contextmanager
def dask_workers(address: str, run: Callable[[Trial], Outcome] = fly_trial) -> Generator[Fly]:
    """While entered, fly trials on the workers of a Dask cluster, where this package is installed.

    A worker calls `run` for each trial. Raises InputError if `distributed` is not installed or no scheduler answers at
    the address.
    """
    try:
        from distributed import Client
        from distributed import as_completed as dask_as_completed
    except ImportError:
        raise InputError("--dask: the package distributed is not installed, wanted the extra [cluster]") from None
    try:
        client: Any = Client(address, timeout=10)
    except (OSError, ValueError) as error:
        raise InputError(f"--dask: read {address!r} ({error}), wanted the address of a Dask scheduler") from None

    def fly(trials: Sequence[Trial]) -> Iterator[Outcome]:
        threads = sum(client.nthreads().values())
        in_task = min(_TRIALS_IN_TASK, max(1, len(trials) // (_TASKS_OF_THREAD * max(1, threads))))
        futures: list[Any] = []
        for part in (trials[k : k + in_task] for k in range(0, len(trials), in_task)):
            # keyed by the ids: a scheduler that still holds the result of an earlier client returns it without flying
            key = hashlib.sha256("".join(trial.id for trial in part).encode()).hexdigest()
            futures.append(client.submit(_fly_part, run, part, key=f"trials-{key}", pure=True))
        for _, outcomes in dask_as_completed(futures, with_results=True):
            yield from outcomes

    with client:
        yield fly


def _fly_part(run: Callable[[Trial], Outcome], part: Sequence[Trial]) -> list[Outcome]:
    return [run(trial) for trial in part]


def write_table(outcomes: Iterable[Outcome], folder: Path) -> None:
    """Write all outcomes as one table: a column for each field, and `at_<axis>` for each axis."""
    rows = [vars(o) | {f"at_{name}": value for name, value in o.coordinates.items()} for o in outcomes]
    names = dict.fromkeys(name for row in rows for name in row if name != "coordinates")
    write_parquet(folder / PARQUET_FILE, {name: [row.get(name) for row in rows] for name in names})


def _prepare_worker(parent: int) -> None:
    """Leave signals of the terminal to the parent, and die with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # under nohup it stays ignored
        signal.signal(signal.SIGHUP, lambda _, __: None)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, FROM_TERMINAL)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # the parent died while this process was starting
        os._exit(1)
