"""Fly one trial of a campaign again: the same to the last bit in virtual time, with files and a Rerun recording."""

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path

from gcs.errors import InputError
from gcs.runs.record import SCENARIO_FILE
from gcs.stress.campaign import Store, check_campaign
from gcs.stress.measure import fly_trial
from gcs.stress.study import Study
from gcs.stress.trial import Outcome
from gcs.views.observer import recover_run


@dataclass(frozen=True)
class Reflown:
    """A trial flown again.

    `differs` names the figures that changed since its first flight. It is empty in real time, where any may change.
    """

    outcome: Outcome
    runs: list[Path]
    differs: list[str]


def refly(study: Study, folder: Path, wanted: str) -> Reflown:
    """Fly again the one trial in a campaign's folder whose id begins with `wanted`.

    Its runs are left in `flights` beside the campaign's table. A study in real time flies it over UDP, even if it was
    first flown in virtual time. Raises InputError if not exactly one id begins so, or the trial was flown with another
    scenario.
    """
    check_campaign(folder, "--trial")
    with contextlib.closing(Store(folder)) as store:
        found = [outcome for outcome in store.outcomes.values() if outcome.id.startswith(wanted)]
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
