"""What a campaign shows: lines on the terminal, one HTML page that needs nothing else, JUnit XML for CI."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from gcs.page import data_uri, rendered
from gcs.page import milliseconds_text as _ms
from gcs.report import UNKNOWN
from gcs.report import number_text as _number
from gcs.stress_axes import Axis
from gcs.study import Onset, Study
from gcs.trial import Outcome

REPORT_FILE = "report.html"
_TEMPLATE = "stress_report.html.j2"
_MOST_ROWS = 200


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
    from gcs.stress_figures import axis_figure, growth_figure, worst_figure, worst_of
    from gcs.stress_map import map_figure

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
        points=points[:_MOST_ROWS],
        left_out=max(0, len(points) - _MOST_ROWS),
        worst=worst_of(everything),
        axes=axes,
        again=f"gcs stress {folder / 'scenario.toml'} --out {folder} --trial ID",
    )
    file = folder / REPORT_FILE
    file.write_text(page, encoding="utf-8")
    return file


def print_result(result: dict[str, Any], folder: Path) -> None:
    """The onset beside the margin, the sweep, and where the files are."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False, soft_wrap=True)
    onset = result["onset"]
    console.print(f"margin   {_ms(result['delay_margin_s'])} of loop delay, sampled; {result['trials']} trials flown")
    if onset is not None:
        console.print(
            f"onset    {_ms(onset['loop_delay_s'])} ± {1e3 * onset['error_s']:.2f} ms in flight, "
            f"[bold]{onset['difference']:+.3%}[/] from the sampled margin of this loop, {_ms(onset['predicted_s'])}; "
            f"continuous {_ms(onset['predicted_continuous_s'])}"
        )
        console.print(
            f"         {_ms(onset['link_delay_s'])} of link delay, up + down: vehicle {onset['critical']} waits "
            f"{_ms(onset['waiting_s'])} for the control tick; breaks at {onset['frequency_rad_s']:.2f} rad/s"
        )
    if result["onset_missing"]:
        console.print(f"onset    not found: {result['onset_missing']}")
    if result["curve_error"] is not None:
        console.print(
            f"curve    measured and predicted growth differ by at most {result['curve_error']:.3%} of the range"
        )
    points = [point for point in result["points"] if point["kind"] == "probe"] or result["points"]
    if points:
        table = Table(box=box.SIMPLE_HEAD)
        names = list(points[0]["coordinates"])
        for name in ("trial", *names, "loop delay, ms", "growth, 1/s", "±", "predicted", "verdict"):
            table.add_column(name, justify="right", no_wrap=True)
        for point in points[:_MOST_ROWS]:
            table.add_row(
                point["id"],
                *(f"{point['coordinates'][name]:g}" for name in names),
                _ms(point["loop_delay_s"], unit=""),
                _number(point["growth_1_s"]),
                _number(point["growth_error_1_s"], "0.1g"),
                _number(point["predicted_growth_1_s"]),
                point["verdict"] or UNKNOWN,
            )
        console.print(table)
    for failed in result["trials_failed"]:
        last = failed["error"].strip().splitlines()[-1]
        console.print(f"failed   {failed['id']}, seed {failed['seed']}, {failed['coordinates']}: {last}", markup=False)
    console.print(f"files    {folder}: {REPORT_FILE}, stress.json, trials.jsonl, trials.parquet")
    console.print(f"again    gcs stress {folder / 'scenario.toml'} --out {folder} --trial ID")
    if result["failure"]:
        console.print(f"[bold red]failed[/]   {result['failure']}")


def print_outcome(outcome: Outcome) -> None:
    """One trial that was flown again."""
    from rich.console import Console

    console = Console(highlight=False, soft_wrap=True, markup=False)
    console.print(f"trial    {outcome.id}, {outcome.kind}, seed {outcome.seed}, {outcome.coordinates}")
    console.print(f"verdict  {outcome.verdict}: {outcome.reason}")
    if outcome.growth_1_s is not None:
        of = f" of vehicle {outcome.probed}" if outcome.probed is not None else ""
        console.print(
            f"growth   {_number(outcome.growth_1_s)} ± {_number(outcome.growth_error_1_s, '0.1g')} 1/s{of}, "
            f"predicted {_number(outcome.predicted_growth_1_s)} at {_ms(outcome.loop_delay_s)}"
        )
    if outcome.error is not None:
        console.print(outcome.error)


def write_junit(result: dict[str, Any], file: Path) -> None:
    """Test cases for CI: that onset and margin agree, and that every trial could be flown."""
    failed = {entry["id"]: entry for entry in result["trials_failed"]}
    name = f"gcs stress {result['scenario']}"
    count = 1 + len(failed)
    suite = ElementTree.Element(
        "testsuite",
        name=name,
        tests=str(count),
        failures=str(int(bool(result["failure"]))),
        errors=str(len(failed)),
        time=str(result["flight_time_s"]),
    )
    case = ElementTree.SubElement(suite, "testcase", classname=name, name="the onset is where the margin says")
    if result["failure"]:
        ElementTree.SubElement(case, "failure", message=result["failure"])
    elif result["assert_onset"] is None:
        ElementTree.SubElement(case, "skipped", message="--assert-onset was not given")
    for trial_id, entry in failed.items():
        case = ElementTree.SubElement(suite, "testcase", classname=name, name=f"trial {trial_id}")
        error = ElementTree.SubElement(case, "error", message=entry["error"].strip().splitlines()[-1])
        error.text = entry["error"]
    file.parent.mkdir(parents=True, exist_ok=True)
    ElementTree.ElementTree(suite).write(file, encoding="utf-8", xml_declaration=True)


def _along_delay(axes: Sequence[Axis]) -> bool:
    return len(axes) == 1 and axes[0].name == "delay"
