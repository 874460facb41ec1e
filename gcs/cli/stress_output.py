"""What `gcs stress` prints, and what it checks for CI."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.text import Text

from gcs.runs.junit import Check
from gcs.stress.axes import place_text
from gcs.stress.campaign import Reflown
from gcs.stress.disturbance import DisturbanceOnset, DisturbanceResult
from gcs.stress.report import MOST_ROWS, REPORT_FILE, RESULT_FILE, CampaignResult, Noise, refly_command
from gcs.stress.study import Onset
from gcs.stress.trial import Outcome
from gcs.views.console import UNKNOWN, ms_text, plain_console, table_of
from gcs.views.console import number_text as _number
from gcs.views.report import response_text

_ms = partial(ms_text, form=".2f")
_FILE_WIDTH = 120
_ID = 8
"""Characters of an id that are shown; `--trial` accepts the beginning of an id."""
_KINDS = {"probe": "probes with small errors", "own": "flights from the scenario's initial states"}


def _wide_console() -> Console:
    """A console; in a file, where no terminal is narrow, it is wide."""
    console = plain_console()
    if not console.is_terminal:
        console.width = _FILE_WIDTH
    return console


def print_result(result: CampaignResult, folder: Path) -> None:
    console = _wide_console()
    margin_s, points = result.delay_margin_s, result.points
    if result.gains.margin_unknown:
        console.print(f"margin   unknown: {result.gains.margin_unknown}")
    else:
        console.print(f"margin   {'no limit' if margin_s is None else f'{_ms(margin_s)} of loop delay'}, sampled")
    console.print(response_text(result.response), end="")
    kinds = ", ".join(f"{count} {_KINDS[kind]}" for kind, count in sorted(result.trials_of_kind.items(), reverse=True))
    console.print(f"trials   {result.trials}: {kinds}")
    for onset in (found for found in (result.onset, result.onset_shorter) if found is not None):
        breaks = "" if onset.frequency_rad_s is None else f"; breaks at {onset.frequency_rad_s:.2f} rad/s"
        found = f"{_ms(onset.loop_delay_s)} ± {1e3 * onset.error_s:.2f} ms in flight"
        console.print(f"onset    {found}{_against(result, onset)}")
        console.print(
            f"         {_ms(onset.link_delay_s)} of link delay, up + down: vehicle {onset.critical} waits "
            f"{_ms(onset.waiting_s)} for the control tick{breaks}"
        )
    if result.onset_missing:
        found = "none, as predicted" if result.onset_missing_as_predicted else "not found"
        console.print(f"onset    {found}: {result.onset_missing}")
    if result.curve_error is not None:
        console.print(f"curve    measured and predicted growth differ by at most {result.curve_error:.3%} of the range")
    if result.past_limits:
        console.print(
            f"limits   the links alone push vehicles past [limits] in {result.past_limits} probes, which fly without "
            "limits; where limits bind, errors persist that would otherwise decay",
            markup=False,
        )
    _print_noise(console, result.noise)
    if points := [point for point in points if point.kind == "probe"] or points:
        console.print(table_of(points[:MOST_ROWS], _columns(list(points[0].coordinates)), dense=True))
    for failed in result.trials_failed:
        fault = (failed.error or "").strip().splitlines()[-1]
        console.print(f"failed   {failed.id}, seed {failed.seed}, {place_text(failed.coordinates)}: {fault}")
    console.print(f"files    {folder}: {REPORT_FILE}, {RESULT_FILE}, trials.jsonl, trials.parquet")
    if result.worst:
        console.print(f"again    {refly_command(folder, result.worst[0])}")
    if result.failure:
        console.print(Text.assemble(("failed", "bold red"), f"   {result.failure}"))


def _against(result: CampaignResult, onset: Onset) -> str:
    """How far an onset is from what was computed, as far as anything was."""
    if onset.difference is None:
        return ", with no margin to compare it with"
    text = f", {onset.difference:+.3%} from the {_limit(result)} of this loop, {_ms(onset.predicted_s)}"
    if onset.predicted_continuous_s is None:
        return text
    return f"{text}; continuous model less half a period for the hold: {_ms(onset.predicted_continuous_s)}"


def _limit(result: CampaignResult) -> str:
    return "sampled margin" if result.gains.prediction is None else "end of the mismatch window"


def _print_noise(console: Console, noise: Noise | None) -> None:
    if noise is None or not (noise.lateness_s_p50 and noise.lateness_s_p99 and noise.steal_share and noise.busy_share):
        return
    latest = noise.lateness_s_p99
    console.print(
        f"noise    set-points {_ms(noise.lateness_s_p50.median)} late at the median, {_ms(latest.median)} at the 99th "
        f"percentile (at worst {_ms(latest.max)}); the host took {noise.steal_share.median:.1%} of the processors, "
        f"all processes together used {noise.busy_share.median:.0%}"
    )


def _columns(axes: list[str]) -> dict[str, Callable[[Outcome], str]]:
    return {
        "trial": lambda point: point.id[:_ID],
        **{name: lambda point, name=name: f"{point.coordinates[name]:g}" for name in axes},
        "loop, ms": lambda point: _ms(point.loop_delay_s, unit=""),
        "growth, 1/s": lambda point: _number(point.growth_1_s),
        "±": lambda point: _number(point.growth_error_1_s, "0.1g"),
        "model": lambda point: _number(point.predicted_growth_1_s),
        "verdict": lambda point: point.verdict or UNKNOWN,
    }


def print_reflown(reflown: Reflown) -> None:
    console, outcome = plain_console(), reflown.outcome
    console.print(f"trial    {outcome.id}, {outcome.kind}, seed {outcome.seed}, {place_text(outcome.coordinates)}")
    console.print(f"verdict  {outcome.verdict}: {outcome.reason}")
    if outcome.growth_1_s is not None:
        of = f" of vehicle {outcome.probed}" if outcome.probed is not None else ""
        console.print(
            f"growth   {_number(outcome.growth_1_s)} ± {_number(outcome.growth_error_1_s, '0.1g')} 1/s{of}, "
            f"predicted {_number(outcome.predicted_growth_1_s)} at {_ms(outcome.loop_delay_s)}"
        )
    if outcome.real_time:
        console.print("again    in real time, where no two flights are the same")
    elif reflown.differs:
        console.print(f"again    differs from the first flight in: {', '.join(reflown.differs)}")
    else:
        console.print(f"again    identical to the last bit, tick log {outcome.ticks_sha256}")
    for run in reflown.runs:
        console.print(f"look     gcs view {run}")
    if outcome.error is not None:
        console.print(outcome.error)


def checks_of(result: CampaignResult) -> list[Check]:
    """One check that onset and margin agree, and one for every trial that could not be flown."""
    skipped = "" if result.failure or result.assert_onset is not None else "--assert-onset was not given"
    agrees = Check("the onset is where the margin says", failure=result.failure or "", skipped=skipped)
    return [agrees, *(Check(f"trial {outcome.id}", error=outcome.error or "") for outcome in result.trials_failed)]


def print_disturbances(result: DisturbanceResult) -> None:
    console = _wide_console()
    columns: dict[str, Callable[[DisturbanceOnset], str]] = {
        "errors of": lambda o: "one follower" if len(o.vehicles) == 2 else "all vehicles",
        "disturbance": lambda o: o.kind,
        "radius, 1/s": lambda o: _number(o.radius_1_s, ".5f"),
        "at, rad/s": lambda o: f"{o.frequency_rad_s:.2f}",
        "onset flown, 1/s": lambda o: _number(o.onset_1_s, ".5f"),
        "±": lambda o: _number(o.error_1_s, "0.1g"),
        "apart": lambda o: UNKNOWN if o.difference is None else f"{o.difference:+.3%}",
        "flights": lambda o: str(o.flights),
    }
    title = f"disturbances that break {result.scenario} at {ms_text(result.loop_delay_s)} of loop delay"
    console.print(table_of(result.onsets, columns, title=title))
    console.print("dynamic: any stable filter, alpha is its radius; constant: a matrix, the same north and east")
    if result.failure:
        console.print(f"failed   {result.failure}")
