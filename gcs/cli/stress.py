"""`gcs stress`: fly the formation at many link delays, and see whether it breaks where the margin predicts.

The work is done in `gcs.stress`; the output is in `gcs.cli.results`.
"""

import contextlib
import json
import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gcs.cli import FAILED, options
from gcs.errors import InputError, usable
from gcs.interrupts import raised
from gcs.output import outlive_readers

if TYPE_CHECKING:
    from gcs.plan.design import Design
    from gcs.plan.flight_plan import FlightPlan
    from gcs.stress.axes import Axis
    from gcs.stress.campaign import Fly
    from gcs.stress.report import CampaignResult
    from gcs.stress.study import NoOnset, Onset, Study
    from gcs.stress.trial import Outcome, Run

_AXIS = "FROM:TO:N"
_OUT_WANTED = "a new or empty folder, or --resume"
DISTURBANCE_FILE = "disturbance.json"


def stress(
    scenario_file: options.ScenarioFile,
    delay: Annotated[
        str, typer.Option(metavar=_AXIS, help="link delay in s, up + down; --link-delay of gcs fly is each way")
    ] = "",
    delay_of: Annotated[
        list[str] | None, typer.Option(metavar=f"ID={_AXIS}", help="link delay of one vehicle; may be repeated")
    ] = None,
    jitter: Annotated[
        str,
        typer.Option(
            metavar=_AXIS, help="scale of the jitter in s, each way; uniform on links without jitter; not for traces"
        ),
    ] = "",
    loss: Annotated[
        str, typer.Option(metavar=_AXIS, help="fraction of datagrams lost, each way; replaces bursts")
    ] = "",
    rate: Annotated[
        str,
        typer.Option(metavar=_AXIS, help="control rate in Hz; gains stay as designed, a loop on board gets no slower"),
    ] = "",
    prediction: Annotated[
        str,
        typer.Option(metavar="S,S", help="with two axes: one map for each assumed loop delay in s; 0 is off"),
    ] = "",
    loop: options.LoopOption = None,
    links: options.LinksOption = None,
    disturbance: Annotated[
        bool, typer.Option("--disturbance", help="raise the worst disturbance, not the delay; needs --onset")
    ] = False,
    onset: Annotated[bool, typer.Option("--onset", help="find the delay at which the formation breaks")] = False,
    onset_of: Annotated[
        int | None,
        typer.Option(metavar="ID", help="like --onset, but slow only this vehicle's link; the others stay as they are"),
    ] = None,
    tolerance: Annotated[
        float, typer.Option(metavar="FRACTION", help="how near the onset the last flights are, as a fraction of it")
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
        typer.Option(
            metavar="FRACTION",
            help="exit with code 1 if onset and margin differ by more, or the onset's error is larger; implies --onset",
        ),
    ] = None,
    allow_code: options.AllowCode = False,
    junit: Annotated[Path | None, typer.Option(metavar="FILE", help="write JUnit XML for CI")] = None,
    out: options.OutFolder = None,
    as_json: options.AsJson = False,
) -> None:
    """Raise the link delay until the formation breaks.

    --delay, --delay-of, --jitter, --loss and --rate take FROM:TO:N (N values, ends included) or a list (0.1,0.2,0.4).
    One of them makes a sweep, two make a map; --prediction then draws one map for each assumed delay, side by side. The
    loop delay is the link delay plus the wait for the control tick. The measured onset is compared with the delay
    margin. --onset gives all vehicles' links the same delay; --onset-of finds how much more delay the link of one
    vehicle can take, with all other links as in the scenario.

    With --disturbance and --onset, every vehicle is disturbed by w = D e, where e are the errors, at one link delay:
    the scenario's, or a single --delay. The worst D is scaled up, and its onset compared with the stability radii.

    Simulated autopilots fly in virtual time. Their response is identified first, and the margin takes it into account.

    Exit code 1 if --assert-onset is missed, a trial failed, all trials were aborted, a trial flown again differs, or,
    with --disturbance, onsets were predicted but none was measured.
    """
    texts_of = {"--delay": [delay], "--delay-of": delay_of, "--jitter": [jitter], "--loss": [loss], "--rate": [rate]}
    given = [(option, text) for option, texts in texts_of.items() for text in texts or () if text]
    onset = onset or onset_of is not None or assert_onset is not None
    if trial or resume:
        out = options.campaign_folder(out, "--trial" if trial else "--resume", "campaign")
    elif out is not None:
        options.refuse_out(out, _OUT_WANTED)
    _refuse_axes(given, prediction, seeds, searches=bool(trial or onset or disturbance))
    given += [("--prediction", prediction)] if prediction else []
    for name, value in (("--tolerance", tolerance), ("--assert-onset", assert_onset)):
        if value is not None and not 0.0 < value < 1.0:
            raise InputError(f"{name}: read {value:g}, wanted a fraction between 0 and 1, such as 0.02")
    outlive_readers()
    if disturbance:
        more = {
            "--onset-of": onset_of,
            "--resume": resume,
            "--trial": trial,
            "--dask": dask,
            "--real-time": real_time,
            "--junit": junit,
        }
        others = [option for option, value in (*given, *more.items()) if value and option != "--delay"]
        if not onset or others:
            read = f"and {others[0]}" if others else "without --onset"
            raise InputError(f"read --disturbance {read}, wanted --disturbance with --onset and at most one --delay")
        study, _ = _study(scenario_file, loop, links, disturbance=True, allow_code=allow_code)
        _disturb(scenario_file, study.plan, delay, tolerance=tolerance, allowed=assert_onset, out=out, as_json=as_json)
    if junit is not None:
        options.out_file("--junit", junit)
    from gcs.cli.results import checks_of, print_reflown, print_result
    from gcs.preflight.faults import endless_link
    from gcs.runs.junit import write_junit
    from gcs.stress.axes import parse_axis
    from gcs.stress.campaign import dask_workers, local_workers, refly

    study, design = _study(scenario_file, loop, links, real_time=real_time, allow_code=allow_code)
    if assert_onset is not None and design.margin_unknown:
        raise InputError(f"--assert-onset: read {assert_onset:g}, wanted no such option: the margin is unknown")
    if onset_of is not None:
        _refuse_vehicle(onset_of, study, given)
    if trial:
        assert out is not None
        reflown = refly(study, out, trial)
        options.print_json(reflown.outcome) if as_json else print_reflown(reflown)
        raise typer.Exit(FAILED if reflown.outcome.error is not None or reflown.differs else 0)
    axes = [parse_axis(option, text, study.plan.formation.system_ids) for option, text in given]
    swept = study.sweep(axes, seeds=1) if axes else []
    options.refuse(scenario_file, *(endless_link(one.scenario) for one in swept), in_file=False)
    # flights in real time disturb each other: one at a time unless the user knows better
    at_once = workers or (1 if real_time else len(os.sched_getaffinity(0)))
    if axes and not (as_json or dask):
        _say_how_long(study, axes, seeds, at_once)
    result, folder = _campaign(
        study,
        design,
        axes,
        dask_workers(dask) if dask else local_workers(at_once),
        out,
        resume=resume,
        seeds=seeds,
        tolerance=tolerance if onset else None,
        vehicle=onset_of,
        allowed=assert_onset,
        shown=not as_json,
    )
    if junit is not None:
        write_junit(junit, f"gcs stress {result.scenario}", checks_of(result), time_s=result.flight_time_s)
    options.answer(result, partial(print_result, folder=folder), as_json=as_json)
    raise typer.Exit(0 if result.passed else FAILED)


def _refuse_axes(given: list[tuple[str, str]], prediction: str, seeds: int, *, searches: bool) -> None:
    if not (given or searches):
        raise InputError("nothing to fly; wanted --onset, or an axis such as --delay 0:0.6:13")
    if seeds > 1 and not given:
        raise InputError(f"--seeds: read {seeds}, wanted it with an axis: a search draws its own seeds")
    if len(given) > 2:
        raise InputError(f"read {len(given)} axes, wanted one (a sweep) or two (a map)")
    vehicles = [text.partition("=")[0] for option, text in given if option == "--delay-of"]
    if len(set(vehicles)) < len(vehicles):
        raise InputError(f"--delay-of: read vehicle {vehicles[0]} twice, wanted two vehicles")
    if prediction and (len(given) != 2 or searches):
        raise InputError(f"--prediction: read {prediction}, wanted it with two other axes (a map) and no search")


def _refuse_vehicle(system_id: int, study: "Study", given: list[tuple[str, str]]) -> None:
    from gcs.plan.loops import plan_loops

    loops = plan_loops(study.plan)
    known = [own for loop in loops for own in loop.system_ids]
    if system_id not in known:
        raise InputError(f"--onset-of: read {system_id}, wanted one of the system ids {' '.join(map(str, known))}")
    if given:
        raise InputError(f"read --onset-of and {given[0][0]}, wanted one of them")
    shared = next(loop.system_ids for loop in loops if system_id in loop.system_ids)
    if len(shared) > 1 and (study.real_time or study.plan.onboard is not None):
        place = "with --real-time" if study.real_time else "with loops on board"
        alone = f"a vehicle that shares its loop with no other (vehicles {' '.join(map(str, shared))} share one)"
        flown = "" if study.real_time else f"; --delay-of {system_id}=FROM:TO:N flies its link delays"
        raise InputError(f"--onset-of: read {system_id} {place}, wanted {alone}{flown}")


def _study(
    file: Path,
    loop: options.LoopPlace | None,
    links: str | None,
    *,
    allow_code: bool,
    real_time: bool = False,
    disturbance: bool = False,
) -> "tuple[Study, Design]":
    from gcs.drive.flown import identified_in_flight
    from gcs.plan.planner import described, flight_plan
    from gcs.preflight.faults import bad_start, unstable_loop
    from gcs.stress.study import Study

    scenario = options.load_scenario(file, loop, links=links, allow_code=allow_code)
    if (disturbance and scenario.dynamics != "double_integrator") or (real_time and scenario.dynamics == "autopilot"):
        option = "--disturbance" if disturbance else "--real-time"
        options.refuse(file, f"dynamics: read {scenario.dynamics!r}, wanted double_integrator with {option}")
    if scenario.control.prediction == "measured":
        wanted = "off, or a number of seconds: gcs stress tests an assumed delay that is fixed"
        options.refuse(file, f"control.prediction: read 'measured', wanted {wanted}")
    options.refuse(file, bad_start(scenario))
    # the calm monitor has no slower gains, which a campaign does not fly
    design, planned = flight_plan(scenario.with_calm_monitor())
    plan = identified_in_flight(planned)
    if plan is not planned:
        design = described(design, plan)
    options.refuse(file, unstable_loop(plan))
    return Study(plan, real_time=real_time), design


def _say_how_long(study: "Study", axes: "list[Axis]", seeds: int, workers: int) -> None:
    """Print how many flights a sweep has and how long they will take, from the speed of a flight of one second."""
    from gcs.stress.free_response import in_place
    from gcs.studies.benchmark import start_and_speed

    trials = study.sweep(axes, seeds=seeds)
    start_s, factor = start_and_speed(study.plan, seconds=1.0)
    probe_s = in_place(study.plan, (), amplitude=0.0).duration_s
    flown_s = sum(start_s + (probe_s if trial.kind == "probe" else trial.scenario.duration_s) for trial in trials)
    expected = _duration_text(flown_s / (1.0 if study.real_time else factor) / workers)
    typer.echo(f"flights  {len(trials)}, {flown_s:.0f} s in all: about {expected} with {workers} at a time", err=True)


def _disturb(
    file: Path,
    plan: "FlightPlan",
    delay: str,
    *,
    tolerance: float,
    allowed: float | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Find the disturbances that break the formation at the link delay of the scenario or of --delay, then exit."""
    from gcs.cli.results import print_disturbances
    from gcs.runs.record import write_whole
    from gcs.stress.axes import at_coordinates, parse_axis
    from gcs.stress.disturbance import find_disturbance_onsets, refusal

    delays_s = parse_axis("--delay", delay).values if delay else ()
    if len(delays_s) > 1:
        raise InputError(f"--delay: read {len(delays_s)} values, wanted one with --disturbance")
    if plan.scenario.code:
        raise InputError(f"{file}: read code, wanted gains and double integrators: the radii are theirs")
    for delay_s in delays_s:
        plan = replace(plan, scenario=at_coordinates(plan.scenario, {"delay": delay_s}))
    options.refuse(file, refusal(plan.scenario))
    folder = None if out is None else options.out_folder(out)

    def ended() -> None:
        if not as_json and typer.get_text_stream("stderr").isatty():
            typer.echo(".", err=True, nl=False)

    result = find_disturbance_onsets(plan, tolerance=tolerance, allowed=allowed, ended=ended)
    if folder is not None:
        write_whole(folder / DISTURBANCE_FILE, result.to_json().encode())
    options.answer(result, print_disturbances, as_json=as_json)
    raise typer.Exit(FAILED if result.failure else 0)


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
    vehicle: int | None,
    allowed: float | None,
    shown: bool,
) -> "tuple[CampaignResult, Path]":
    """Fly the sweep over the axes and, with a tolerance, search for the onset; returns the result and its folder."""
    from gcs.drive.fly import new_folder
    from gcs.runs.files import write_scenario
    from gcs.stress.campaign import TRIALS_FILE, check_study, run_campaign, trials_of, write_table
    from gcs.stress.report import result_of, write_report
    from gcs.stress.study import NoOnset
    from gcs.views.console import progress

    if resume:
        assert out is not None
        check_study("--resume", out / TRIALS_FILE, scenario=study.plan.scenario)
        _keep_onset(out, vehicle, searches=tolerance is not None)
    sweep: list[Outcome] = []
    onset: Onset | NoOnset | None = None
    onset_shorter: Onset | NoOnset | None = None
    with raised(), contextlib.ExitStack() as stack:
        fly = stack.enter_context(workers)
        if out is None:
            folder = new_folder(f"{study.plan.scenario.name}-stress")
        else:
            folder = out if resume else options.out_folder(out, _OUT_WANTED)
        write_scenario(folder, study.plan.scenario)
        store = stack.enter_context(contextlib.closing(trials_of(folder)))
        begin = stack.enter_context(progress(shown=shown))
        try:
            if axes:
                trials = study.sweep(axes, seeds=seeds)
                sweep = run_campaign(trials, store, fly, ended=begin("flights"))
            if tolerance is not None:
                run = partial(run_campaign, store=store, fly=fly, ended=begin("onset"))
                onset = _onset_or_why(study, run, tolerance=tolerance, vehicle=vehicle)
                if not isinstance(onset, NoOnset) and study.window_of(vehicle)[0] > 0.0:
                    onset_shorter = _onset_or_why(study, run, tolerance=tolerance, shorter=True, vehicle=vehicle)
        except KeyboardInterrupt:
            typer.echo(store.resume, err=True)
            raise
    outcomes = list(store.flown.values())
    write_table(outcomes, folder)
    result = result_of(
        study, design, outcomes, axes=axes, sweep=sweep, onset=onset, onset_shorter=onset_shorter, allowed=allowed
    )
    if why := write_report(folder, result, study=study, axes=axes):
        typer.echo(f"no figures: {why}", err=True)
    return result, folder


def _keep_onset(folder: Path, vehicle: int | None, *, searches: bool) -> None:
    """Refuse to replace the onset in a campaign's folder by that of other links, or by none."""
    from gcs.stress.report import RESULT_FILE

    file = folder / RESULT_FILE
    with usable(file, "the result of a campaign"):
        onset = json.loads(file.read_bytes())["onset"] if file.is_file() else None
    if onset is None or (searches and onset["vehicle"] == vehicle):
        return
    known = "--onset" if onset["vehicle"] is None else f"--onset-of {onset['vehicle']}"
    raise InputError(f"--resume: {file} holds the onset of {known}, wanted {known} again, or a folder of its own")


def _onset_or_why(
    study: "Study", run: "Run", *, tolerance: float, vehicle: int | None, shorter: bool = False
) -> "Onset | NoOnset":
    from gcs.stress.study import NoOnset, find_onset

    try:
        return find_onset(study, run, tolerance=tolerance, shorter=shorter, vehicle=vehicle)
    except NoOnset as reason:
        return reason


def _duration_text(seconds: float) -> str:
    """A rough duration in words: about 20 s, 3 min, 2 h.

    >>> _duration_text(0.4), _duration_text(23.4), _duration_text(200.0), _duration_text(9000.0)
    ('a second', '23 s', '3 min', '2.5 h')
    """
    if seconds < 1.5:
        return "a second"
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.2g} h"
