"""`gcs grade`, `view`, `export` and `recover`: commands that work on the folder of a run."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gcs.cli import FAILED
from gcs.cli.options import AsJson, RunFolder, answer, out_file, out_folder
from gcs.errors import InputError

if TYPE_CHECKING:
    from gcs.runs.grade import Grade


def grade(run: RunFolder, as_json: AsJson = False) -> None:
    """Compare the latencies measured in a flight with the true ones.

    The vehicles that the station started log the true ones. Also shows the errors of the emulated link delays.
    """
    from gcs.runs.grade import grade as graded

    answer(graded(run), print_grade, as_json=as_json)


def print_grade(result: "Grade") -> None:
    from gcs.views.console import ms_text

    print(f"errors against the truth, {result.vehicles} vehicles, ms")
    rows = {
        "loop delay, measured": result.loop_delay,
        "round trip, measured": result.rtt,
        "delay of the up links, emulated": result.link_delay,
    }
    if result.down_jitter.error_max_s:
        rows["jitter of the down links"] = result.down_jitter
    for title, own in rows.items():
        errors_s = own.error_p50_s, own.error_p99_s, own.error_max_s
        p50, p99, largest = (ms_text(error_s, ".3f", unit="") for error_s in errors_s)
        print(f"{title:<32} p50 {p50}  p99 {p99}  max {largest}  of {own.samples}")
    if result.down_jitter.error_max_s:
        print("a loop delay is also off by the difference in delay between the last TIMESYNC request and its set-point")


def view(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="run folder, or a .rrd file")],
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="write a picture to this file instead of opening a window")
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="serve it to browsers on this machine until Ctrl-C")] = False,
    at: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            min=0,
            max=1_000_000,
            help="scenario time of the picture; default 10, or the end if sooner",
        ),
    ] = None,
) -> None:
    """Open a recording in Rerun or a browser, or make a picture.

    A picture needs no screen.

    Exit code 1 if the viewer reports a fault in the picture.
    """
    from gcs.views.viewer import find_recording, picture_time_s, refuse_without_viewer, screenshot, serve
    from gcs.views.viewer import view as open_viewer

    if picture is not None:
        out_file("--picture", picture)
        if picture.suffix.lower() != ".png":
            raise InputError(f"--picture: read {picture}, wanted a name that ends in .png")
    refuse_without_viewer()
    recording = find_recording(run)
    if web:
        if picture is not None:
            raise InputError("read --web and --picture, wanted one of them")
        raise typer.Exit(serve(recording))
    if picture is None:
        raise typer.Exit(open_viewer(recording))
    time_s = picture_time_s(recording, at)
    complaints = screenshot(recording, picture, time_s=time_s)
    typer.echo(f"picture  {picture}: {recording} at {time_s:g} s")
    for complaint in complaints:
        typer.echo(complaint, err=True)
    raise typer.Exit(FAILED if complaints else 0)


def export(
    source: Annotated[
        Path, typer.Argument(metavar="RUN|FILE.tlog", help="run folder, or a telemetry log from any tool")
    ],
    mcap: Annotated[
        Path | None, typer.Option(metavar="FILE.mcap", help="write MCAP, which Foxglove and PlotJuggler read")
    ] = None,
    csv: Annotated[Path | None, typer.Option(metavar="DIR", help="write one CSV file per table to this folder")] = None,
) -> None:
    """Export a run or a telemetry log to other tools."""
    from gcs.watch.export import messages_of, write_csv, write_mcap

    if mcap is None and csv is None:
        raise InputError("read neither --mcap nor --csv, wanted at least one of them")
    if not source.exists():
        raise InputError(f"{source}: read no such file, wanted a run folder or a telemetry log")
    if mcap is not None:
        out_file("--mcap", mcap)
    messages = messages_of(source)
    if mcap is not None:
        write_mcap(mcap, messages)
        typer.echo(f"mcap     {mcap}: {len(messages)} messages")
    if csv is not None:
        files = write_csv(out_folder(csv, option="--csv"), messages)
        typer.echo(f"csv      {csv}: {', '.join(file.name for file in files)}")


def recover(run: Annotated[Path, typer.Argument(metavar="RUN", help="folder of a run that was killed")]) -> None:
    """Finish the files of a run whose processes were killed.

    Writes ticks.parquet, summary.json and flight.rrd.
    """
    from gcs.views.observer import recover_run
    from gcs.views.report import print_summary

    print_summary(recover_run(run), run)
