"""What a campaign found: as plain types for stress.json, and as one HTML page with its figures."""

import platform
import shlex
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
from gcs.stress.trial import Outcome, plan_loops
from gcs.views.page import data_uri, rendered

REPORT_FILE = "report.html"
_TEMPLATE = "stress_report.html.j2"
MOST_ROWS = 200
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

    With `allowed`, the campaign fails if the onset differs from the margin by more than this fraction, or was predicted
    and not found. `failure` then says why in one line.
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
    """How much the machine disturbed flights in real time: median and largest of each figure over the flights.

    `lateness` is how much later than due set-points were handed over. `loop_delay_spread_s` is the 90th percentile of
    the loop delay minus its median. Of the processor time, the host took away `steal_share`, and all processes together
    used `busy_share`.
    """
    names = ("lateness_s_p50", "lateness_s_p99", "loop_delay_spread_s", "steal_share", "busy_share")
    known = {name: [v for o in outcomes if (v := getattr(o, name)) is not None] for name in names}
    return {"flights": len(outcomes)} | {
        name: {"median": float(np.median(values)), "max": max(values)} for name, values in known.items() if values
    }


def provenance(seed: int) -> dict[str, Any]:
    """Seed, package versions, git commit (None outside a checkout) and type of machine."""
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
    """The commit of this checkout, with a + if files have changed since."""
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
    """Whether the models predict all flights over these axes exactly: no link is random."""
    at = {axis.name: max(axis.values) for axis in axes}
    return has_constant_links(at_coordinates(study.plan.scenario, at))


def _point(o: Outcome) -> dict[str, Any]:
    return {
        "id": o.id, "kind": o.kind, "seed": o.seed, "coordinates": o.coordinates, "verdict": o.verdict,
        "loop_delay_s": o.loop_delay_s, "growth_1_s": o.growth_1_s, "growth_error_1_s": o.growth_error_1_s,
        "predicted_growth_1_s": o.predicted_growth_1_s, "spacing_error_max_m": o.spacing_error_max_m,
    }  # fmt: skip


def write_report(
    folder: Path,
    result: dict[str, Any],
    *,
    study: Study,
    axes: Sequence[Axis],
    sweep: Sequence[Outcome],
    onset: Onset | None,
) -> Path:
    """Write report.html with its figures embedded, and the figures as PNG files beside it."""
    # matplotlib takes half a second to import
    from gcs.stress.boundary import map_figure
    from gcs.stress.figures import axis_figure, growth_figure, worst_figure

    probes = [outcome for outcome in sweep if outcome.kind == "probe"]
    own = [outcome for outcome in sweep if outcome.kind == "own"]
    points = probes or own
    fitted = _along_delay(axes) and bool(probes)
    flights = [*(probes if fitted else ()), *(onset.flights if onset is not None else ())]
    flights = list({outcome.id: outcome for outcome in flights}.values())
    large = [*own, *(onset.own if onset is not None else ())]
    everything = [*large, *probes, *(onset.flights if onset is not None else ())]
    figures: dict[str, tuple[str, Path | None]] = {
        "growth": (
            "Growth of errors against delay",
            growth_figure(folder / "growth.png", study=study, outcomes=flights, own=large, onset=onset),
        )
    }
    if len(axes) == 1 and not fitted:
        figures["axis"] = ("Growth of errors", axis_figure(folder / "axis.png", axis=axes[0], outcomes=points))
    if len(axes) == 2:
        drawn = map_figure(folder / "map.png", study=study, axes=axes, outcomes=points, verdicts=own or points)
        figures["map"] = ("Map", drawn)
    figures["worst"] = ("The worst flights", worst_figure(folder / "worst.png", everything))
    page = rendered(
        _TEMPLATE,
        result=result,
        onset=onset,
        figures={name: (title, data_uri(file)) for name, (title, file) in figures.items() if file is not None},
        large=large if len(axes) < 2 else [],
        points=points[:MOST_ROWS],
        left_out=max(0, len(points) - MOST_ROWS),
        worst=worst_of(everything),
        axes=axes,
        random=not exact(study, axes),
        coupled=any(len(loop.system_ids) > 1 for loop in plan_loops(study.plan)),
        again=refly_command(folder, result["worst"][0]) if result["worst"] else "",
    )
    file = folder / REPORT_FILE
    file.write_text(page, encoding="utf-8")
    return file


def refly_command(folder: Path, trial_id: str) -> str:
    """The command that flies a trial of a campaign again."""
    return shlex.join(["gcs", "stress", str(folder / "scenario.toml"), "--out", str(folder), "--trial", trial_id])


def _along_delay(axes: Sequence[Axis]) -> bool:
    return len(axes) == 1 and axes[0].name == "delay"
