"""The result of a campaign: its record in stress.json, and one HTML page with its figures."""

import platform
import shlex
import subprocess
from collections import Counter
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import PlainSerializer

from gcs.errors import extra_wanted
from gcs.plan.design import Design, ResponsePart
from gcs.plan.loops import plan_loops
from gcs.published import Published
from gcs.runs.record import write_whole
from gcs.stress.axes import Axis, at_coordinates, has_constant_links
from gcs.stress.figures import worst_of
from gcs.stress.study import NoOnset, Onset, Study, curve_error
from gcs.stress.trial import Outcome
from gcs.views.page import data_uri, rendered
from scenarios.own_code import ALLOW

REPORT_FILE = "report.html"
_TEMPLATE = "stress_report.html.j2"
MOST_ROWS = 200
RESULT_FILE = "stress.json"
_GAINS = {"K1_1_s", "K2_1_s", "K3_1_s2", "blocks"}
_POINT = (
    "id", "kind", "seed", "coordinates", "verdict", "loop_delay_s", "growth_1_s", "growth_error_1_s",
    "predicted_growth_1_s", "spacing_error_max_m",
)  # fmt: skip
_FAILED = ("id", "seed", "coordinates", "error")
_PACKAGES = ("formation-gcs", "numpy", "scipy", "clarabel", "cvxpy", "pymavlink")


def _gains(design: Design) -> dict[str, Any]:
    return design.model_dump(mode="json", include=_GAINS, exclude_unset=True)


def _only(*names: str) -> PlainSerializer:
    return PlainSerializer(lambda record: {name: getattr(record, name) for name in names})


class Typical(Published):
    """Median and maximum of a figure over the flights of a campaign."""

    median: float
    max: float


class Noise(Published):
    """How much the machine disturbed flights in real time.

    `lateness` is the time from when a set-point was due until it had been sent. `loop_delay_spread_s` is the
    90th percentile of the loop delay minus its median. `steal_share` is the share of the processor time that the host
    took away, and `busy_share` the share that all processes together used.
    """

    flights: int
    lateness_s_p50: Typical | None = None
    lateness_s_p99: Typical | None = None
    loop_delay_spread_s: Typical | None = None
    steal_share: Typical | None = None
    busy_share: Typical | None = None


class Provenance(Published):
    """The seed, software and machine of a campaign; the commit is None outside a checkout."""

    seed: int
    versions: dict[str, str | None]
    git_commit: str | None
    machine: str


class CampaignResult(Published):
    """The result of a campaign. `points` are the outcomes of its sweep; `failure` says in one line why it failed."""

    scenario: str
    delay_margin_s: float | None
    delay_margin_continuous_s: float | None
    period_s: float
    gains: Annotated[Design, PlainSerializer(_gains)]
    real_time: bool
    axes: dict[str, tuple[float, ...]]
    onset: Onset | None
    onset_shorter: Onset | None = None
    """Where a loop that is predicted over a fixed delay breaks because the true delay is too short."""
    onset_shorter_missing: str = ""
    """Why that was not found, in one line."""
    response: ResponsePart | None = None
    """How the vehicles respond to set-points, which the margin takes into account; None if they respond at once."""
    onset_missing: str
    onset_missing_as_predicted: bool
    onset_contradicted: str
    """The probe in which errors grow most although its loop delay is before the onset, in one line; "" if none."""
    curve_error: float | None
    assert_onset: float | None
    failure: str
    passed: bool
    trials: int
    trials_of_kind: dict[str, int]
    trials_failed: tuple[Annotated[Outcome, _only(*_FAILED)], ...]
    worst: tuple[str, ...]
    flight_time_s: float
    points: tuple[Annotated[Outcome, _only(*_POINT)], ...]
    past_limits: int
    noise: Noise | None
    provenance: Provenance


def result_of(
    study: Study,
    design: Design,
    outcomes: Sequence[Outcome],
    *,
    axes: Sequence[Axis],
    sweep: Sequence[Outcome],
    onset: Onset | NoOnset | None,
    onset_shorter: Onset | NoOnset | None = None,
    allowed: float | None,
) -> CampaignResult:
    """The result of a campaign: `outcomes` are all of its trials, `sweep` those of its points.

    With `allowed`, the campaign fails if an onset differs from the margin by more than this fraction, if it was
    predicted but not found, or if errors grow in a probe before it. It also fails if the standard error of an onset
    exceeds this fraction of the margin: its flights cannot tell whether the onset is that close. The error is not added
    to the difference: a sufficiently certain onset is judged by its measured value. A campaign in which every trial was
    aborted fails, too.
    """
    failed = tuple(outcome for outcome in outcomes if outcome.error is not None)
    onset, missing = (None, onset) if isinstance(onset, NoOnset) else (onset, None)
    onset_shorter, missing_shorter = (
        (None, onset_shorter) if isinstance(onset_shorter, NoOnset) else (onset_shorter, None)
    )
    failure = ""
    onsets = [each for each in (onset, onset_shorter) if each is not None]
    searched = [flight for each in onsets for flight in each.flights]
    swept = sweep if [axis.name for axis in axes] == ["delay"] and exact(study, axes) else ()
    contradicted = ""
    if onset is not None and has_constant_links(study.plan.scenario):
        begins_s = study.window_s[0] if onset_shorter is None else onset_shorter.loop_delay_s
        contradicted = growth_before(onset, (*searched, *onset.checks, *swept), begins_s=begins_s)
    if allowed is not None:
        unknown = (str(each) for each in (missing, missing_shorter) if each is not None and not each.as_predicted)
        failure = "; ".join(filter(None, (*unknown, contradicted, *(_missed(each, allowed) for each in onsets))))
    failure = "; ".join(filter(None, (failure, _nothing_measured(sweep) or _nothing_measured(outcomes))))
    return CampaignResult(
        scenario=study.plan.scenario.name,
        delay_margin_s=design.delay_margin_s,
        delay_margin_continuous_s=design.delay_margin_continuous_s,
        period_s=design.period_s,
        gains=design,
        real_time=study.real_time,
        axes={axis.name: tuple(axis.values) for axis in axes},
        onset=onset,
        **({} if onset_shorter is None else {"onset_shorter": onset_shorter}),
        response=design.response,
        onset_missing=str(missing or ""),
        onset_shorter_missing=str(missing_shorter or ""),
        onset_missing_as_predicted=missing is not None and missing.as_predicted,
        onset_contradicted=contradicted,
        curve_error=curve_error([*(sweep if exact(study, axes) else ()), *searched]),
        assert_onset=allowed,
        failure=failure,
        passed=not failure and not failed,
        trials=len(outcomes),
        trials_of_kind=dict(Counter[str](outcome.kind for outcome in outcomes)),
        trials_failed=failed,
        worst=tuple(outcome.id for outcome in worst_of(outcomes)),
        flight_time_s=round(sum(outcome.elapsed_s for outcome in outcomes), 3),
        points=tuple(sweep),
        past_limits=sum(outcome.past_limits for outcome in outcomes),
        noise=_noise(outcomes) if study.real_time else None,
        provenance=Provenance(
            seed=study.plan.scenario.seed,
            versions={"python": platform.python_version()} | {name: _version(name) for name in _PACKAGES},
            git_commit=_commit(),
            machine=f"{platform.system()} {platform.machine()}",
        ),
    )


def growth_before(onset: Onset, probes: Iterable[Outcome], *, begins_s: float) -> str:
    """The probe in which errors grow most, although its loop delay is between `begins_s` and the onset; "" if none.

    Growth counts only if it exceeds three standard errors, its own and the onset's, and a hundredth of the range of the
    rates from which the onset was located.
    """
    near = [own.growth_1_s for own in onset.flights if own.growth_1_s is not None]
    spread, late_s = float(np.ptp(near)) if near else 0.0, onset.loop_delay_s + onset.error_s

    def excess_1_s(own: Outcome) -> float:
        if own.kind != "probe" or own.growth_1_s is None or not begins_s < (own.loop_delay_s or 0.0) <= late_s:
            return 0.0
        past_s = max(0.0, (own.loop_delay_s or 0.0) - onset.loop_delay_s + 3.0 * onset.error_s)
        return own.growth_1_s - 3.0 * (own.growth_error_1_s or 0.0) - abs(onset.slope_1_s2) * past_s - 0.01 * spread

    worst = max((own for own in probes if excess_1_s(own) > 0.0), key=excess_1_s, default=None)
    if worst is None or worst.loop_delay_s is None:
        return ""
    return (
        f"errors of vehicle {worst.critical} grow at {worst.growth_1_s:+.4g} 1/s already at {worst.loop_delay_s:.5f} s "
        f"of loop delay (trial {worst.id})"
    )


def _missed(onset: Onset, allowed: float) -> str:
    """Why an onset is not, or not certainly, as close to its margin as allowed; empty if it is."""
    if onset.difference is None or onset.predicted_s is None:
        return ""
    at, margin = f"the onset is at {onset.loop_delay_s:.5f} s of loop delay", f"the margin {onset.predicted_s:.5f} s"
    limit = f"{100.0 * allowed:.3g}% is allowed"
    if abs(onset.difference) > allowed:
        return f"{at}, {onset.difference:+.3%} from {margin}; {limit}"
    share = onset.error_s / onset.predicted_s
    return f"{at} ± {onset.error_s:.5f} s, an error of {share:.3%} of {margin}; {limit}" if share > allowed else ""


def _nothing_measured(flown: Sequence[Outcome]) -> str:
    """Says that every trial was aborted, and why; empty if one was not."""
    if not flown or any(outcome.verdict != "aborted" for outcome in flown):
        return ""
    return f"nothing was measured: all {len(flown)} trials were aborted, the first: {flown[0].reason}"


def _noise(outcomes: Sequence[Outcome]) -> Noise:
    names = ("lateness_s_p50", "lateness_s_p99", "loop_delay_spread_s", "steal_share", "busy_share")
    known = {name: [v for o in outcomes if (v := getattr(o, name)) is not None] for name in names}
    figures = {name: Typical(median=float(np.median(own)), max=max(own)) for name, own in known.items() if own}
    return Noise(flights=len(outcomes), **figures)


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The commit of this checkout, with a + if files have changed since; None outside a checkout."""
    named = ("git", "-C", str(Path(__file__).parent), "describe", "--always", "--exclude=*", "--abbrev=12", "--dirty=+")
    try:
        return subprocess.run(named, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def exact(study: Study, axes: Sequence[Axis]) -> bool:
    """Whether the models predict all flights over these axes exactly: no link is random."""
    at = {axis.name: max(axis.values) for axis in axes}
    return has_constant_links(at_coordinates(study.plan.scenario, at))


def write_report(folder: Path, result: CampaignResult, *, study: Study, axes: Sequence[Axis]) -> str:
    """Write stress.json, the figures as PNG files, and report.html with the figures embedded.

    Returns why there are no figures if a package that draws them is not installed, else an empty string.
    """
    write_whole(folder / RESULT_FILE, result.to_json().encode())
    onset = result.onset
    probes, own = ([outcome for outcome in result.points if outcome.kind == kind] for kind in ("probe", "own"))
    onsets = [each for each in (onset, result.onset_shorter) if each is not None]
    points, searched = probes or own, [flight for each in onsets for flight in each.flights]
    fitted = len(axes) == 1 and axes[0].name == "delay" and bool(probes)
    flights = list({outcome.id: outcome for outcome in (*(probes if fitted else ()), *searched)}.values())
    large = [*own, *(flight for each in onsets for flight in each.own)]
    everything = [*large, *probes, *searched]

    figures, not_drawn = dict[str, tuple[str, Path | None]](), ""
    try:
        from gcs.stress.boundary import map_figure
        from gcs.stress.figures import axis_figure, growth_figure, worst_figure

        growth = growth_figure(folder / "growth.png", study=study, outcomes=flights, own=large, onset=onset)
        figures["growth"] = ("Growth of errors against delay", growth)
        if len(axes) == 1 and not fitted:
            figures["axis"] = ("Growth of errors", axis_figure(folder / "axis.png", axis=axes[0], outcomes=points))
        if len(axes) > 1:
            map_ = map_figure(folder / "map.png", study=study, axes=axes, outcomes=points, verdicts=own or points)
            figures["map"] = ("Map", map_)
        figures["worst"] = ("The worst flights", worst_figure(folder / "worst.png", everything))
    except ModuleNotFoundError as error:
        figures, not_drawn = {}, extra_wanted(error.name)
        if not not_drawn:
            raise
    page = rendered(
        _TEMPLATE,
        result=result,
        onset=onset,
        figures={name: (title, data_uri(file)) for name, (title, file) in figures.items() if file is not None},
        not_drawn=not_drawn,
        large=large if len(axes) < 2 else [],
        points=points[:MOST_ROWS],
        left_out=max(0, len(points) - MOST_ROWS),
        worst=worst_of(everything),
        axes=axes,
        random=not exact(study, axes),
        coupled=any(len(loop.system_ids) > 1 for loop in plan_loops(study.plan)),
        gains=_gains(result.gains),
        again=refly_command(folder, result) if result.worst else "",
    )
    (folder / REPORT_FILE).write_text(page, encoding="utf-8")
    return not_drawn


def refly_command(folder: Path, result: CampaignResult) -> str:
    """The command that flies the worst trial of a campaign again."""
    allowed = [ALLOW] if result.gains.code else []
    scenario = str(folder / "scenario.toml")
    return shlex.join(["gcs", "stress", scenario, *allowed, "--out", str(folder), "--trial", result.worst[0]])
