"""The report of a campaign: figures as PNG, and one HTML page that needs nothing else."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gcs.stress.axes import Axis
from gcs.stress.result import exact
from gcs.stress.study import Onset, Study
from gcs.stress.trial import Outcome, plan_loops
from gcs.views.page import data_uri, rendered

REPORT_FILE = "report.html"
_TEMPLATE = "stress_report.html.j2"
MOST_ROWS = 200


def write_report(
    folder: Path,
    result: dict[str, Any],
    *,
    study: Study,
    axes: Sequence[Axis],
    sweep: Sequence[Outcome],
    onset: Onset | None,
) -> Path:
    """The page report.html with its figures inside, and the figures as PNG files beside it."""
    # matplotlib takes half a second to import: only when there is something to draw
    from gcs.stress.boundary import map_figure
    from gcs.stress.figures import axis_figure, growth_figure, worst_figure, worst_of

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
