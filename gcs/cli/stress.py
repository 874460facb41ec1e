"""`gcs stress`: fly the formation at many link delays, and see whether it breaks where the margin predicts.

The work is in `gcs.stress`; what is printed is in `gcs.cli.stress_output`.
"""

import contextlib
import itertools
import os
from collections.abc import Callable, Generator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gcs.cli import FAILED
from gcs.cli.options import (
    AsJson,
    LoopOption,
    LoopPlace,
    OutFolder,
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

_AXIS = "FROM:TO:N"


def stress(
    scenario_file: ScenarioFile,
    delay: Annotated[str, typer.Option(metavar=_AXIS, help="link delay in s, up + down")] = "",
    delay_of: Annotated[
        list[str] | None, typer.Option(metavar=f"ID={_AXIS}", help="link delay in s of one vehicle; repeatable")
    ] = None,
    jitter: Annotated[
        str, typer.Option(metavar=_AXIS, help="scale of the jitter in s, each way; uniform on links without jitter")
    ] = "",
    loss: Annotated[str, typer.Option(metavar=_AXIS, help="fraction of datagrams lost, each way")] = "",
    rate: Annotated[str, typer.Option(metavar=_AXIS, help="control rate in Hz; the gains stay as designed")] = "",
    loop: LoopOption = None,
    onset: Annotated[bool, typer.Option("--onset", help="find the delay at which the formation breaks")] = False,
    tolerance: Annotated[
        float, typer.Option(metavar="FRACTION", help="how close to the onset the last flights are")
    ] = 0.02,
    seeds: Annotated[int, typer.Option(metavar="N", min=1, help="flights at each point, each with its own seed")] = 1,
    workers: Annotated[
        int,
        typer.Option(
            metavar="N", min=0, show_default=False, help="processes; default one per processor, one in real time"
        ),
    ] = 0,
    dask: Annotated[str, typer.Option(metavar="ADDRESS", help="fly on the workers of this Dask scheduler")] = "",
    resume: Annotated[bool, typer.Option("--resume", help="resume the campaign in --out")] = False,
    trial: Annotated[
        str, typer.Option(metavar="ID", help="fly one trial of the campaign in --out again and record it")
    ] = "",
    real_time: Annotated[bool, typer.Option("--real-time", help="fly over UDP on the real clock")] = False,
    assert_onset: Annotated[
        float | None,
        typer.Option(metavar="FRACTION", help="exit with code 1 if onset and margin differ by more; implies --onset"),
    ] = None,
    junit: Annotated[Path | None, typer.Option(metavar="FILE", help="write JUnit XML for CI")] = None,
    out: OutFolder = None,
    as_json: AsJson = False,
) -> None:
    """Raise the link delay until the formation breaks.

    --delay, --delay-of, --jitter, --loss and --rate take FROM:TO:N (N values, ends included) or a list (0.1,0.2,0.4).
    One of them makes a sweep, two make a map. The loop delay is the link delay plus the wait for the control tick. The
    measured onset is compared with the delay margin.

    Exit code 1 if --assert-onset is missed, a trial failed, or a trial flown again differs.
    """
    options = {"--delay": [delay], "--delay-of": delay_of, "--jitter": [jitter], "--loss": [loss], "--rate": [rate]}
    given = [(option, text) for option, texts in options.items() for text in texts or () if text]
    onset = onset or assert_onset is not None
    if (trial or resume) and (out is None or not out.is_dir()):
        flag = "--trial" if trial else "--resume"
        raise InputError(f"--out: read {out}, wanted the folder of a campaign, which {flag} needs")
    if not (trial or onset or given):
        raise InputError("nothing to fly; wanted --onset, or an axis such as --delay 0:0.6:13")
    if len(given) > 2:
        raise InputError(f"read {len(given)} axes, wanted one (a sweep) or two (a map)")
    for name, value in (("--tolerance", tolerance), ("--assert-onset", assert_onset)):
        if value is not None and not 0.0 < value < 1.0:
            raise InputError(f"{name}: read {value:g}, wanted a fraction between 0 and 1, such as 0.02")
    outlive_readers()
    if junit is not None:
        out_file("--junit", junit)
    from gcs.cli.stress_output import checks_of, print_reflown, print_result
    from gcs.drive.preflight import endless_link
    from gcs.stress.axes import parse_axis
    from gcs.stress.campaign import dask_workers, local_workers
    from gcs.stress.refly import refly
    from gcs.views.junit import write_junit

    study, design = _study(scenario_file, loop, real_time=real_time)
    if trial:
        assert out is not None
        reflown = refly(study, out, trial)
        typer.echo(reflown.outcome.to_json()) if as_json else print_reflown(reflown)
        raise typer.Exit(FAILED if reflown.outcome.error is not None or reflown.differs else 0)
    axes = [parse_axis(option, text, study.plan.formation.system_ids) for option, text in given]
    refuse(scenario_file, *(endless_link(one.scenario) for one in (study.sweep(axes, seeds=1) if axes else [])))
    result, folder = _campaign(
        study,
        design,
        axes,
        # flights in real time disturb each other: one at a time unless the user knows better
        dask_workers(dask) if dask else local_workers(workers or (1 if real_time else len(os.sched_getaffinity(0)))),
        out,
        resume=resume,
        seeds=seeds,
        tolerance=tolerance if onset else None,
        allowed=assert_onset,
        shown=not as_json,
    )
    if junit is not None:
        write_junit(junit, f"gcs stress {result.scenario}", checks_of(result), time_s=result.flight_time_s)
    answer(result, partial(print_result, folder=folder), as_json=as_json)
    raise typer.Exit(0 if result.passed else FAILED)


def _study(file: Path, loop: LoopPlace | None, *, real_time: bool) -> "tuple[Study, Design]":
    from gcs.drive.preflight import bad_start, unstable_loop
    from gcs.plan.planner import flight_plan
    from gcs.stress.study import Study

    scenario = load_scenario(file, loop)
    if scenario.dynamics == "autopilot":
        wanted = "double_integrator: gcs stress flies no vehicles that have to take off"
        raise InputError(f"{file}: dynamics: read 'autopilot', wanted {wanted}")
    if scenario.control.prediction == "measured":
        wanted = "off, or a number of seconds: gcs stress tests an assumed delay that is fixed"
        raise InputError(f"{file}: control.prediction: read 'measured', wanted {wanted}")
    # a campaign does not fly the slower gains of the schedule, so they need not be designed
    refuse(file, bad_start(scenario))
    design, plan = flight_plan(scenario.with_calm_monitor())
    refuse(file, unstable_loop(plan))
    return Study(plan, real_time=real_time), design


def _campaign(
    study: "Study",
    design: "Design",
    axes: "list[Axis]",
    workers: "contextlib.AbstractContextManager[Fly]",
    out: Path | None,
    *,
    resume: bool,
    seeds: int,
    tolerance: float | None,
    allowed: float | None,
    shown: bool,
) -> "tuple[CampaignResult, Path]":
    """Fly the sweep over the axes and, with a tolerance, search for the onset; returns the result and its folder."""
    from gcs.drive.fly import new_folder
    from gcs.runs.record import SCENARIO_FILE, write_whole
    from gcs.stress.campaign import Store, check_campaign, run_campaign, write_table
    from gcs.stress.report import result_of, write_report
    from gcs.stress.study import NoOnset, find_onset
    from scenarios.files import dump

    scenario = dump(study.plan.scenario)
    if resume:
        assert out is not None
        check_campaign(out, "--resume", scenario)
    sweep: list[Outcome] = []
    onset: Onset | NoOnset | None = None
    onset_shorter: Onset | None = None
    with raised(), contextlib.ExitStack() as stack:
        fly = stack.enter_context(workers)
        if out is None:
            folder = new_folder(f"{study.plan.scenario.name}-stress")
        else:
            folder = out if resume else out_folder(out, "a new or empty folder, or --resume")
        write_whole(folder / SCENARIO_FILE, scenario.encode())
        store = stack.enter_context(contextlib.closing(Store(folder)))
        progress = stack.enter_context(_progress(shown))
        try:
            if axes:
                trials = study.sweep(axes, seeds=seeds)
                sweep = run_campaign(trials, store, fly, ended=progress("flights", len(trials)))
            if tolerance is not None:
                run = partial(run_campaign, store=store, fly=fly, ended=progress("onset", None))
                onset = find_onset(study, run, tolerance=tolerance)
                if study.window_s[0] > 0.0:
                    onset_shorter = find_onset(study, run, tolerance=tolerance, shorter=True)
        except NoOnset as reason:
            onset = reason
        except KeyboardInterrupt:
            typer.echo(store.resume, err=True)
            raise
    outcomes = list(store.outcomes.values())
    write_table(outcomes, folder)
    result = result_of(
        study, design, outcomes, axes=axes, sweep=sweep, onset=onset, onset_shorter=onset_shorter, allowed=allowed
    )
    write_report(folder, result, study=study, axes=axes)
    return result, folder


@contextlib.contextmanager
def _progress(shown: bool) -> "Generator[Callable[[str, int | None], Callable[[Outcome, int], None]]]":
    """While entered, provides a function (name, total or None) -> callback that advances a progress bar."""
    from rich import progress

    from gcs.views.console import plain_console

    console = plain_console(stderr=True, soft_wrap=False)
    columns = (
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TimeElapsedColumn(),
        progress.TextColumn("left"),
        progress.TimeRemainingColumn(),
    )
    with progress.Progress(*columns, console=console, disable=not (shown and console.is_terminal)) as bar:

        def begin(name: str, total: int | None) -> Any:
            task = bar.add_task(name, total=total)
            begun = itertools.count(1)

            def ended(_: "Outcome", left: int) -> None:
                done = next(begun) if total is None else total - left
                bar.update(task, completed=done, total=done + left)

            return ended

        yield begin
