"""`gcs stress`: fly the formation at many link delays, and see whether it breaks where the margin says.

The work is in `gcs.stress`; what is printed is in `gcs.cli.stress_output`.
"""

import contextlib
import itertools
import os
from collections.abc import Generator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gcs.cli import FAILED
from gcs.cli.options import (
    AsJson,
    Loop,
    LoopOption,
    ScenarioFile,
    answer,
    load_scenario,
    out_file,
    out_folder,
    refuse,
)
from gcs.errors import InputError
from gcs.interrupts import raised
from gcs.output import outlive_readers

if TYPE_CHECKING:
    from gcs.plan.design import Design
    from gcs.stress.axes import Axis
    from gcs.stress.campaign import Fly
    from gcs.stress.report import CampaignResult
    from gcs.stress.study import Onset, Study
    from gcs.stress.trial import Outcome

RESULT_FILE = "stress.json"
SCENARIO_FILE = "scenario.toml"


@dataclass(frozen=True)
class StressOptions:
    """The options of a campaign, as `stress` documents them."""

    scenario_file: Path
    loop: Loop | None
    axes: tuple[tuple[str, str], ...]
    onset: bool
    tolerance: float
    seeds: int
    workers: int
    dask: str
    resume: bool
    real_time: bool
    assert_onset: float | None


def stress(
    scenario_file: ScenarioFile,
    delay: Annotated[
        str,
        typer.Option(
            metavar="FROM:TO:N",
            help="total link delay in s, up + down (the loop delay is this and the waiting for the control tick)",
        ),
    ] = "",
    delay_of: Annotated[
        list[str] | None, typer.Option(metavar="ID=FROM:TO:N", help="total link delay in s of one vehicle; repeatable")
    ] = None,
    jitter: Annotated[
        str, typer.Option(metavar="FROM:TO:N", help="jitter each way in s: half width, or scale of the link's own kind")
    ] = "",
    loss: Annotated[str, typer.Option(metavar="FROM:TO:N", help="fraction of the datagrams lost, each way")] = "",
    rate: Annotated[
        str, typer.Option(metavar="FROM:TO:N", help="control rate in Hz, with the gains designed for the scenario's")
    ] = "",
    loop: LoopOption = None,
    onset: Annotated[bool, typer.Option("--onset", help="find the delay at which it breaks")] = False,
    tolerance: Annotated[
        float, typer.Option(metavar="FRACTION", help="half width of the last round of flights around the onset")
    ] = 0.02,
    seeds: Annotated[
        int, typer.Option(metavar="N", min=1, help="flights at each point, each with a seed of its own")
    ] = 1,
    workers: Annotated[
        int,
        typer.Option(metavar="N", min=0, show_default=False, help="processes; default all processors, 1 in real time"),
    ] = 0,
    dask: Annotated[str, typer.Option(metavar="ADDRESS", help="fly on the workers of this Dask scheduler")] = "",
    resume: Annotated[bool, typer.Option("--resume", help="resume the campaign in --out")] = False,
    trial: Annotated[
        str, typer.Option(metavar="ID", help="fly one trial of the campaign in --out again, with a recording")
    ] = "",
    real_time: Annotated[bool, typer.Option("--real-time", help="over UDP, in processes, on the real clock")] = False,
    assert_onset: Annotated[
        float | None,
        typer.Option(metavar="FRACTION", help="exit 1 if onset and margin differ by more; implies --onset"),
    ] = None,
    junit: Annotated[Path | None, typer.Option(metavar="FILE", help="write JUnit XML for CI")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="default runs/<scenario>-stress-<time>")] = None,
    as_json: AsJson = False,
) -> None:
    """Turn the link delay up until the formation breaks, and compare with the margin.

    An axis (--delay, --delay-of, --jitter, --loss, --rate) is FROM:TO:N, N values with the ends, or a list as
    0.1,0.2,0.4. One axis is a sweep, two make a map.

    Exit code 1 if --assert-onset is missed, a trial failed, or one flown again is not the same.
    """
    named = [("delay", delay), *(("delay_of", text) for text in delay_of or ())]
    named += [("jitter", jitter), ("loss", loss), ("rate", rate)]
    options = StressOptions(
        scenario_file=scenario_file,
        loop=loop,
        axes=tuple((name, text) for name, text in named if text),
        onset=onset or assert_onset is not None,
        tolerance=tolerance,
        seeds=seeds,
        workers=workers,
        dask=dask,
        resume=resume,
        real_time=real_time,
        assert_onset=assert_onset,
    )
    _check(options, out, trial)
    outlive_readers()
    if junit is not None:
        out_file("--junit", junit)
    from gcs.cli.stress_output import print_result, write_junit

    if trial:
        assert out is not None
        raise typer.Exit(_refly(options, out, trial, as_json=as_json))
    result, folder = _campaign(options, out, shown=not as_json)
    if junit is not None:
        write_junit(result, junit)
    answer(result, partial(print_result, folder=folder), as_json=as_json)
    raise typer.Exit(0 if result.passed else FAILED)


def _check(options: StressOptions, out: Path | None, trial: str) -> None:
    """Refuse combinations of options that contradict each other."""
    if (trial or options.resume) and (out is None or not out.is_dir()):
        flag = "--trial" if trial else "--resume"
        raise InputError(f"--out: read {out}, wanted the folder of a campaign, as {flag} is given")
    if not (trial or options.onset or options.axes):
        raise InputError("nothing to fly; wanted --onset, or an axis as --delay 0:0.6:13")
    if len(options.axes) > 2:
        raise InputError(f"read {len(options.axes)} axes, wanted one (a sweep) or two (a map)")
    for name, value in (("--tolerance", options.tolerance), ("--assert-onset", options.assert_onset)):
        if value is not None and not 0.0 < value < 1.0:
            raise InputError(f"{name}: read {value:g}, wanted a fraction between 0 and 1, as 0.02")


def _campaign(options: StressOptions, out: Path | None, *, shown: bool) -> "tuple[CampaignResult, Path]":
    """Fly the campaign; returns its result, and the folder that holds it."""
    from gcs.drive.fly import new_folder
    from gcs.runs.record import write_whole
    from gcs.stress.campaign import Store, check_campaign, run_campaign, write_parquet
    from gcs.stress.report import result_of, write_report
    from gcs.stress.study import NoOnset, find_onset
    from scenarios.files import dump

    study, design = _study(options)
    scenario = dump(study.plan.scenario)
    if options.resume:
        assert out is not None
        check_campaign(out, "--resume", scenario)
    axes = _axes(options, study)
    onset: Onset | None = None
    no_onset: NoOnset | None = None
    with raised(), contextlib.ExitStack() as stack:
        fly = stack.enter_context(_workers(options))
        if out is None:
            folder = new_folder(f"{study.plan.scenario.name}-stress")
        else:
            folder = out if options.resume else out_folder(out, "a new or empty folder, or --resume")
        write_whole(folder / SCENARIO_FILE, scenario.encode())
        store = stack.enter_context(contextlib.closing(Store(folder)))
        progress = stack.enter_context(_progress(shown))
        try:
            sweep: list[Outcome] = []
            if axes:
                trials = study.sweep(axes, seeds=options.seeds)
                sweep = run_campaign(trials, store, fly, ended=progress("flights", len(trials)))
            if options.onset:
                ended = progress("onset", None)
                try:
                    onset = find_onset(
                        study, lambda trials: run_campaign(trials, store, fly, ended=ended), tolerance=options.tolerance
                    )
                except NoOnset as reason:
                    no_onset = reason
        except KeyboardInterrupt:
            typer.echo(store.resume, err=True)
            raise
        outcomes = list(store.outcomes.values())
        write_parquet(outcomes, folder)
    allowed = options.assert_onset
    result = result_of(study, design, outcomes, axes=axes, sweep=sweep, onset=onset, no_onset=no_onset, allowed=allowed)
    write_whole(folder / RESULT_FILE, result.to_json().encode())
    write_report(folder, result, study=study, axes=axes)
    return result, folder


def _study(options: StressOptions) -> "tuple[Study, Design]":
    from gcs.drive.preflight import bad_start, unstable_loop
    from gcs.plan.planner import flight_plan
    from gcs.stress.study import Study

    scenario = load_scenario(options.scenario_file, options.loop)
    if scenario.dynamics == "autopilot":
        wanted = "double_integrator: gcs stress does not fly vehicles that take off first"
        raise InputError(f"{options.scenario_file}: dynamics: read 'autopilot', wanted {wanted}")
    # a campaign does not fly the slower gains of the schedule, so they need not be designed
    refuse(options.scenario_file, bad_start(scenario))
    design, plan = flight_plan(scenario.with_calm_monitor())
    refuse(options.scenario_file, unstable_loop(plan))
    return Study(plan, real_time=options.real_time), design


def _axes(options: StressOptions, study: "Study") -> "list[Axis]":
    from gcs.stress.axes import AxisError, parse_axis, parse_vehicle_axis

    ids = study.plan.formation.system_ids
    axes: list[Axis] = []
    for name, text in options.axes:
        try:
            axes.append(parse_vehicle_axis(text, ids) if name == "delay_of" else parse_axis(name, text))
        except AxisError as error:
            raise InputError(f"--{name.replace('_', '-')}: {error}") from None
    return axes


def _workers(options: StressOptions) -> "contextlib.AbstractContextManager[Fly]":
    from gcs.stress.campaign import dask_workers, local_workers

    # flights in real time disturb each other: one at a time unless the user knows better
    count = options.workers or (1 if options.real_time else len(os.sched_getaffinity(0)))
    return dask_workers(options.dask) if options.dask else local_workers(count)


@contextlib.contextmanager
def _progress(shown: bool) -> Generator[Any]:
    """While entered, provides a function (name, total or None) -> callback that advances a progress bar."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from gcs.views.console import plain_console

    console = plain_console(stderr=True, soft_wrap=False)
    columns = (
        TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TextColumn("left"), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console, disable=not (shown and console.is_terminal)) as bar:

        def begin(name: str, total: int | None) -> Any:
            task = bar.add_task(name, total=total)
            begun = itertools.count(1)

            def ended(_: "Outcome", left: int) -> None:
                done = next(begun) if total is None else total - left
                bar.update(task, completed=done, total=done + left)

            return ended

        yield begin


def _refly(options: StressOptions, folder: Path, wanted: str, *, as_json: bool) -> int:
    """Fly a stored trial again, print how it went, and return the exit code."""
    from gcs.cli.stress_output import print_reflown
    from gcs.stress.refly import refly

    study, _ = _study(options)
    reflown = refly(study, folder, wanted, real_time=options.real_time)
    if as_json:
        typer.echo(reflown.outcome.to_json())
    else:
        print_reflown(reflown)
    return FAILED if reflown.outcome.error is not None or reflown.differs else 0
