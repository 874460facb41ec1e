"""Campaigns: nothing finished is lost or flown twice, whatever is killed, and wherever it is flown."""

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from gcs.errors import InputError
from gcs.runs.record import SCENARIO_FILE
from gcs.stress.campaign import (
    PARQUET_FILE,
    TRIALS_FILE,
    check_study,
    dask_workers,
    local_workers,
    run_campaign,
    trials_of,
    write_table,
)
from gcs.stress.measure import fly_trial
from gcs.stress.trial import Outcome, Trial
from scenarios.files import dump
from scenarios.own_code import write_code
from tests.support.fleets.own_code import LAW, coded
from tests.support.fleets.stress_pair import trials
from tests.support.paths import ROOT


class Here:
    """Flies trials in this process, notes which, and can be interrupted."""

    def __init__(self, *, stop_after: int = 10**9) -> None:
        self.flown: list[str] = []
        self.stop_after = stop_after

    def __call__(self, wanted: Sequence[Trial]) -> Iterator[Outcome]:
        for trial in wanted:
            if len(self.flown) >= self.stop_after:
                raise KeyboardInterrupt
            self.flown.append(trial.id)
            yield fly_trial(trial)


def same(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Outcomes without the time that they took."""
    return [replace(outcome, elapsed_s=0.0) for outcome in outcomes]


def test_an_interrupted_campaign_continues_where_it_stopped(tmp_path: Path) -> None:
    wanted = trials(5)
    first = Here(stop_after=2)
    store = trials_of(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run_campaign(wanted, store, first)
    store.close()
    second, again = Here(), trials_of(tmp_path)
    outcomes = run_campaign(wanted, again, second)
    again.close()
    assert (len(first.flown), len(second.flown)) == (2, 3)
    assert set(first.flown) | set(second.flown) == {trial.id for trial in wanted}
    assert [outcome.id for outcome in outcomes] == [trial.id for trial in wanted]
    assert same(outcomes) == same([fly_trial(trial) for trial in wanted])


def test_a_trial_at_two_coordinates_is_flown_once(tmp_path: Path) -> None:
    [trial] = trials(1)
    fly, store = Here(), trials_of(tmp_path)
    outcomes = run_campaign([trial, replace(trial, coordinates=(("x", 1.0),))], store, fly)
    store.close()
    assert len(fly.flown) == 1
    assert [outcome.coordinates for outcome in outcomes] == [{"delay": 0.0}, {"x": 1.0}]


def test_two_campaigns_do_not_fly_in_one_folder(tmp_path: Path) -> None:
    first = trials_of(tmp_path)
    with pytest.raises(InputError, match="another gcs works"):
        trials_of(tmp_path)
    first.close()
    trials_of(tmp_path).close()


def test_a_campaign_is_not_resumed_with_other_code(tmp_path: Path) -> None:
    file, first = tmp_path / TRIALS_FILE, coded(law="soft")
    (tmp_path / SCENARIO_FILE).write_text(dump(first))
    write_code(first, tmp_path)
    file.touch()
    check_study("--resume", file, scenario=first)
    with pytest.raises(InputError, match=r"--resume: .* holds a campaign flown with other code, wanted .*own\.py"):
        check_study("--resume", file, scenario=coded(LAW.replace("-5.0", "-4.0"), law="soft"))


def test_a_line_cut_short_costs_its_own_trial_only(tmp_path: Path) -> None:
    wanted, store = trials(3), trials_of(tmp_path)
    run_campaign(wanted, store, Here())
    store.close()
    file = tmp_path / TRIALS_FILE
    file.write_bytes(file.read_bytes()[:-40])
    fly, store = Here(), trials_of(tmp_path)
    run_campaign(wanted, store, fly)
    store.close()
    assert fly.flown == [wanted[2].id]
    assert set(trials_of(tmp_path).flown) == {trial.id for trial in wanted}


def test_a_trial_that_raises_is_recorded_and_the_others_fly(tmp_path: Path) -> None:
    wanted, store, left = trials(3, bad=1), trials_of(tmp_path), list[int]()
    outcomes = run_campaign(wanted, store, Here(), ended=left.append)
    store.close()
    assert [outcome.error is None for outcome in outcomes] == [True, False, True]
    assert "IndexError" in (outcomes[1].error or "")
    assert outcomes[1].seed == 7
    assert left == [2, 1, 0]


def test_a_resumed_campaign_flies_failed_trials_again(tmp_path: Path) -> None:
    wanted, store = trials(2), trials_of(tmp_path)
    store.add(replace(fly_trial(wanted[0]), error="MemoryError"))
    store.add(fly_trial(wanted[1]))
    store.close()
    fly, store = Here(), trials_of(tmp_path)
    outcomes = run_campaign(wanted, store, fly)
    store.close()
    assert fly.flown == [wanted[0].id]
    assert [outcome.error for outcome in outcomes] == [None, None]
    assert trials_of(tmp_path).flown[wanted[0].id].error is None


def test_the_table_has_trials_as_rows_axes_as_columns(tmp_path: Path) -> None:
    outcomes = [fly_trial(trial) for trial in trials(2, bad=1)]
    write_table(outcomes, tmp_path)
    table = pq.read_table(tmp_path / PARQUET_FILE).to_pydict()
    assert table["id"] == [outcome.id for outcome in outcomes]
    assert table["at_delay"] == [0.0, 0.01]
    assert table["verdict"] == [outcomes[0].verdict, None]
    assert len(table["trace_m"][0]) == 4


def test_a_flight_ended_by_ctrl_c_is_not_stored(tmp_path: Path) -> None:
    [trial] = trials(1)

    def interrupted(wanted: Sequence[Trial]) -> Iterator[Outcome]:
        yield from (replace(fly_trial(one), reason="interrupted: SIGINT") for one in wanted)

    store = trials_of(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run_campaign([trial], store, interrupted)
    store.close()
    assert trials_of(tmp_path).flown == {}


KILLED = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from tests.support.fleets.stress_pair import trials
from gcs.stress.campaign import local_workers, run_campaign, trials_of
if __name__ == "__main__":
    store = trials_of(Path(sys.argv[1]))
    with local_workers(2) as fly:
        run_campaign(trials(40), store, fly, ended=lambda left: print(left, flush=True))
"""


def running_in_group(group: int) -> list[int]:
    """Processes of a group that still run; those that have ended and were not waited for (zombies) do not count."""
    running: list[int] = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it ended meanwhile
            state, _, of_group = stat.read_text().rpartition(")")[2].split()[:3]
            if int(of_group) == group and state != "Z":
                running.append(int(stat.parent.name))
    return running


def test_kill_9_loses_nothing_finished_and_leaves_no_workers(tmp_path: Path) -> None:
    script = tmp_path / "killed.py"
    script.write_text(KILLED, encoding="utf-8")
    process = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path), str(ROOT)], stdout=subprocess.PIPE, start_new_session=True
    )
    assert process.stdout is not None
    seen = [process.stdout.readline() for _ in range(3)]
    assert seen[0] == b"39\n"
    process.kill()
    process.stdout.read()  # until the pipe closes: the workers hold it open too, so they have ended
    process.stdout.close()
    process.wait()
    while running_in_group(process.pid):  # multiprocessing's resource tracker still has to clean up
        pass
    store, fly, wanted = trials_of(tmp_path), Here(), trials(6)
    kept = set(store.flown)
    assert len(kept) >= 3
    run_campaign(wanted, store, fly)
    store.close()
    assert set(fly.flown) == {trial.id for trial in wanted} - kept
    lines = (tmp_path / TRIALS_FILE).read_text(encoding="utf-8").splitlines()
    assert len([json.loads(line)["id"] for line in lines]) == len(store.flown)


def test_processes_and_a_dask_cluster_give_what_one_process_gives(tmp_path: Path) -> None:
    """A real scheduler and worker, as processes of their own, as `dask scheduler` and `dask worker` start them."""
    wanted = trials(4, bad=2)
    here = same([fly_trial(trial) for trial in wanted])
    with local_workers(2) as fly:
        by_id = {outcome.id: outcome for outcome in fly(wanted)}
    assert [failing_line(by_id[trial.id]) for trial in wanted] == [failing_line(outcome) for outcome in here]
    with cluster(tmp_path) as address, dask_workers(address) as fly:
        by_id = {outcome.id: outcome for outcome in fly(wanted)}
    assert [failing_line(by_id[trial.id]) for trial in wanted] == [failing_line(outcome) for outcome in here]


def failing_line(outcome: Outcome) -> Outcome:
    """The outcome with only the last line of its traceback: the paths of files are not part of the claim."""
    error = outcome.error and outcome.error.strip().splitlines()[-1]
    return replace(outcome, elapsed_s=0.0, error=error)


class cluster:  # noqa: N801 - used as a function
    """A Dask scheduler and one worker as processes; gives the scheduler's address."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.processes: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> str:
        file = self.folder / "scheduler.json"
        place = ["--scheduler-file", str(file)]
        quiet = ["--no-dashboard", "--interface", "lo"]
        free = ["--port", "0", "--dashboard-address", "127.0.0.1:0"]  # the HTTP server runs without a dashboard too
        self._start("distributed.cli.dask_scheduler", *place, *quiet, *free)
        self._start(
            "distributed.cli.dask_worker", *place, *quiet, "--nthreads", "1", "--local-directory", str(self.folder)
        )
        while not file.exists() or not file.read_text(encoding="utf-8").strip():
            assert all(process.poll() is None for process in self.processes)
        return json.loads(file.read_text(encoding="utf-8"))["address"]

    def __exit__(self, *_: object) -> None:
        for process in reversed(self.processes):
            process.terminate()
            process.wait()

    def _start(self, module: str, *arguments: str) -> None:
        command = [sys.executable, "-m", module, *arguments]
        log, environment = subprocess.DEVNULL, os.environ | {"PYTHONPATH": str(ROOT)}
        self.processes.append(subprocess.Popen(command, stdout=log, stderr=log, env=environment))


def test_a_missing_scheduler_is_reported_in_one_line() -> None:
    with pytest.raises(InputError, match="wanted the address of a Dask scheduler"), dask_workers("no address"):
        pass
