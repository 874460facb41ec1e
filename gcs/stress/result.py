"""What a campaign found, as plain types for JSON: onset, curve, points, the machine's noise, and what was run."""

import platform
import subprocess
from collections import Counter
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from gcs.plan.design import Design
from gcs.stress.axes import Axis, at_coordinates, has_constant_links
from gcs.stress.figures import worst_of
from gcs.stress.study import NoOnset, Onset, Study, curve_error
from gcs.stress.trial import Outcome

_GAINS = ("K1_1_s", "K2_1_s", "K3_1_s2", "blocks")
_PACKAGES = ("formation-gcs", "numpy", "scipy", "clarabel", "cvxpy", "pymavlink")


def result_of(
    study: Study,
    design: Design,
    outcomes: Sequence[Outcome],
    *,
    axes: Sequence[Axis],
    sweep: Sequence[Outcome],
    onset: Onset | None,
    no_onset: NoOnset | None,
    allowed: float | None,
) -> dict[str, Any]:
    """The result of a campaign: `outcomes` are all of its trials, `sweep` those of its points.

    With `allowed` it has not passed if the onset is farther than this part from the margin, or was not found though
    there should be one. `failure` then says why in one line.
    """
    failed = [outcome for outcome in outcomes if outcome.error is not None]
    failure = ""
    if allowed is not None and onset is not None:
        failure = _parted(onset, allowed)
    elif allowed is not None and no_onset is not None and not no_onset.as_predicted:
        failure = str(no_onset)
    worst = worst_of(outcomes)
    return {
        "scenario": study.plan.scenario.name,
        "delay_margin_s": design.delay_margin_s,
        "delay_margin_continuous_s": design.delay_margin_continuous_s,
        "period_s": design.period_s,
        "gains": {name: gain for name, gain in design.to_dict().items() if name in _GAINS},
        "real_time": study.real_time,
        "axes": {axis.name: list(axis.values) for axis in axes},
        "onset": None if onset is None else onset.to_dict(),
        "onset_missing": str(no_onset or ""),
        "onset_missing_as_predicted": no_onset is not None and no_onset.as_predicted,
        "curve_error": curve_error([*(sweep if exact(study, axes) else ()), *(onset.flights if onset else ())]),
        "assert_onset": allowed,
        "failure": failure,
        "passed": not failure and not failed,
        "trials": len(outcomes),
        "trials_of_kind": dict(Counter(outcome.kind for outcome in outcomes)),
        "trials_failed": [{"id": o.id, "seed": o.seed, "coordinates": o.coordinates, "error": o.error} for o in failed],
        "worst": [o.id for o in worst],
        "flight_time_s": round(sum(outcome.elapsed_s for outcome in outcomes), 3),
        "points": [_point(outcome) for outcome in sweep],
        "past_limits": sum(outcome.past_limits for outcome in outcomes),
        "noise": noise_of(outcomes) if study.real_time else None,
        "provenance": provenance(study.plan.scenario.seed),
    }


def noise_of(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """What the machine did to flights in real time: median and largest of each figure over the flights.

    `lateness` is by how much set-points were handed over later than due, `loop_delay_spread_s` by how much the 90th
    percentile of the loop delay lies above its median; `steal_share` of the processor time was taken away by the host,
    `busy_share` used by anyone.
    """
    names = ("lateness_s_p50", "lateness_s_p99", "loop_delay_spread_s", "steal_share", "busy_share")
    known = {name: [v for o in outcomes if (v := getattr(o, name)) is not None] for name in names}
    return {"flights": len(outcomes)} | {
        name: {"median": float(np.median(values)), "max": max(values)} for name, values in known.items() if values
    }


def provenance(seed: int) -> dict[str, Any]:
    """Seed, package versions, git commit (None outside a checkout) and kind of machine."""
    return {
        "seed": seed,
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in _PACKAGES},
        "git_commit": _commit(),
        "machine": f"{platform.system()} {platform.machine()}",
    }


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The commit that this code was checked out from, with a + if files were changed since."""
    git = ("git", "-C", str(Path(__file__).parent))
    try:
        commit = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=True)
        changed = subprocess.run([*git, "status", "--porcelain", "-uno"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return commit.stdout.strip() + ("+" if changed.stdout.strip() else "")


def _parted(onset: Onset, allowed: float) -> str:
    if abs(onset.difference) <= allowed:
        return ""
    return (
        f"the onset is at {onset.loop_delay_s:.5f} s of loop delay, {onset.difference:+.3%} from the margin "
        f"{onset.predicted_s:.5f} s; {100.0 * allowed:.3g}% is allowed"
    )


def exact(study: Study, axes: Sequence[Axis]) -> bool:
    """Whether the models predict all flights over these axes exactly: no link loses or delays at random."""
    at = {axis.name: max(axis.values) for axis in axes}
    return has_constant_links(at_coordinates(study.plan.scenario, at))


def _point(o: Outcome) -> dict[str, Any]:
    return {
        "id": o.id, "kind": o.kind, "seed": o.seed, "coordinates": o.coordinates, "verdict": o.verdict,
        "loop_delay_s": o.loop_delay_s, "growth_1_s": o.growth_1_s, "growth_error_1_s": o.growth_error_1_s,
        "predicted_growth_1_s": o.predicted_growth_1_s, "spacing_error_max_m": o.spacing_error_max_m,
    }  # fmt: skip
