"""`gcs compare`, `identify`, `thesis`, `bench` and `capacity`; most of their output is in `gcs.cli.results`."""

import contextlib
import os
from pathlib import Path
from typing import Annotated

import typer

from gcs.cli import FAILED, options
from gcs.errors import InputError
from gcs.output import outlive_readers
from scenarios.networks import MOST_VEHICLES

_SLOWEST_HZ, _FASTEST_HZ = 1.0, 500.0
"""Bounds of `rates.control_hz`."""


def compare(
    scenario_file: options.ScenarioFile,
    out: options.OutFolder = None,
    sizes: Annotated[bool, typer.Option(help="also time designs for chains of growing length")] = True,
    as_json: options.AsJson = False,
) -> None:
    """Design and fly a scenario by every method, side by side.

    Exit code 1 if no method gives a design.
    """
    from gcs.cli.results import print_comparison
    from gcs.preflight.faults import bad_start, endless_link
    from gcs.studies import compare as comparing
    from gcs.studies.compare_cost import design_costs
    from gcs.views.console import progress

    outlive_readers()
    scenario = options.load_scenario(scenario_file, allow_code="a scenario without code: gcs compare designs gains")
    options.refuse(scenario_file, bad_start(scenario), endless_link(scenario))
    folder = options.run_folder(out, f"{scenario.name}-compare")
    with progress(shown=not as_json) as begin:
        routes, flights = comparing.compare(scenario, ended=begin("methods"))
        grown = design_costs(begin("longer chains")) if sizes else []
    comparing.write_comparison(folder, scenario, routes, flights, grown)
    if as_json:
        options.print_json({"routes": routes, "files": str(folder)})
    else:
        print_comparison(scenario, routes, grown)
        typer.echo(f"files    {folder}: {comparing.REPORT_FILE}, {comparing.RESULT_FILE}, PNG")
    raise typer.Exit(0 if flights else FAILED)


def identify(scenario_file: options.ScenarioFile, allow_code: options.AllowCode = False) -> None:
    """Find how the vehicles of a scenario respond to set-points.

    The leader flies briefly in virtual time, and its response is printed as the table [response] of a scenario.

    For dynamics = "jsbsim" and dynamics in a Python file; autopilots are identified in flight.
    """
    from gcs.studies.identification import as_toml, responses_of

    typer.echo(as_toml(responses_of(options.load_scenario(scenario_file, allow_code=allow_code))))


def thesis(out: options.OutFolder = None, as_json: options.AsJson = False) -> None:
    """Reproduce Sahoo's thesis: published against computed figures."""
    from gcs.studies import thesis as source
    from gcs.views.console import progress

    folder = options.run_folder(out, "thesis")
    with progress(shown=not as_json) as begin:
        found = source.claims(begin("parts"))
        page = source.write_page(folder, found)
    if as_json:
        options.print_json({"claims": found})
        return
    for claim in found:
        typer.echo(f"{claim.place}  {claim.subject}: {claim.verdict}")
        typer.echo(f"    published {claim.published}; computed {claim.computed}; {claim.second}")
    typer.echo(f"files    {page} and its figures")


def bench(
    scenario_file: options.ScenarioFile = Path("triangle5"),
    vehicles: Annotated[
        int, typer.Option(metavar="N", min=0, max=MOST_VEHICLES, help="N vehicles in columns; 0: those of the scenario")
    ] = 0,
    seconds: Annotated[float, typer.Option(metavar="S", min=0.1, max=86400, help="duration of each flight")] = 8.0,
    repeat: Annotated[int, typer.Option(metavar="N", min=1, help="number of flights; the fastest counts")] = 10,
    real_time: Annotated[
        bool,
        typer.Option("--real-time", help="fly once over UDP; show punctuality and the errors of measured latencies"),
    ] = False,
    one_port: Annotated[
        bool, typer.Option("--one-port", help="with --real-time: set links.one_port, so that frames share datagrams")
    ] = False,
    signed: Annotated[bool, typer.Option("--signed", help="also measure the cost of signing")] = False,
    peers: Annotated[
        bool, typer.Option("--peers", help="do the same work with other people's tools and print ratios")
    ] = False,
    cluster: Annotated[
        int, typer.Option(metavar="TRIALS", min=0, show_default=False, help="fly a map of this many trials on Dask")
    ] = 0,
    workers: Annotated[
        int,
        typer.Option(
            metavar="N", min=0, show_default=False, help="with --cluster: local workers; default one per processor"
        ),
    ] = 0,
    allow_code: options.AllowCode = False,
    as_json: options.AsJson = False,
) -> None:
    """Measure how much faster than real time a flight is computed.

    Also measures the share of its control period that the station needs, and compares the time of its whole tick with
    the time that pymavlink takes to parse the positions.

    With --peers, the same work is done by this station and by pymavlink, MAVSDK, JSBSim, python-control and solvers, if
    they are installed. Formations of 5, 20 and 100 vehicles fly over UDP; with --vehicles, only one of that size.

    With --cluster, a map is flown twice on Dask: by one local worker, then by all. Each trial flies for --seconds.
    """
    from gcs.cli.results import print_benchmark, print_cluster, print_peers, print_real_time
    from gcs.preflight.faults import bad_start, endless_link
    from gcs.studies import benchmark

    given = [name for name, on in (("--peers", peers), ("--cluster", cluster), ("--real-time", real_time)) if on]
    if len(given) > 1:
        raise InputError(f"read {' and '.join(given)}, wanted one of them")
    options.refuse_alone("--workers", workers or None, "--cluster", cluster or None)
    options.refuse_alone("--one-port", one_port or None, "--real-time", real_time or None)
    scenario = options.load_scenario(scenario_file, allow_code=allow_code)
    if vehicles:
        scenario = benchmark.with_vehicles(scenario, vehicles)
    if one_port:
        scenario = scenario.with_keys(links={"one_port": True})
    options.refuse(scenario_file, bad_start(scenario), endless_link(scenario))
    if peers or cluster:
        options.refuse(scenario_file, benchmark.first_unsupported_key(scenario))
    if peers:
        from gcs.studies.peers import SIZES, side_by_side
        from gcs.views.console import progress

        sizes = (vehicles,) if vehicles else SIZES
        with progress(shown=not as_json) as begin:
            table = side_by_side(scenario, seconds=seconds, sizes=sizes, ended=begin("peers"))
        options.answer(table, print_peers, as_json=as_json)
    elif cluster:
        from gcs.studies.cluster import map_on_cluster

        at_once = workers or len(os.sched_getaffinity(0))
        found = map_on_cluster(scenario, trials=cluster, workers=at_once, seconds=seconds)
        options.answer(found, print_cluster, as_json=as_json)
    elif real_time:
        options.answer(benchmark.benchmark_real_time(scenario, seconds=seconds), print_real_time, as_json=as_json)
    else:
        result = benchmark.benchmark(scenario, seconds=seconds, repeat=repeat, signed=signed)
        options.answer(result, print_benchmark, as_json=as_json)


def capacity(
    scenario_file: options.ScenarioFile,
    rates: Annotated[str, typer.Option(metavar="HZ,HZ,...", help="telemetry and control rates")] = "2,5,10,20",
    most: Annotated[int, typer.Option(metavar="N", min=2, max=MOST_VEHICLES, help="largest formation tried")] = 100,
    seeds: Annotated[int, typer.Option(metavar="N", min=1, help="flights of each formation; all must succeed")] = 3,
    links: options.LinksOption = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="store flights in this new or empty folder")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="resume the study in --out")] = False,
    as_json: options.AsJson = False,
) -> None:
    """Find how many vehicles the links carry at each rate.

    The links carry a formation if its loop delay stays within the delay margin.
    """
    from gcs.cli.results import print_capacity
    from gcs.studies.capacity import SECONDS, formations_at_most, loads_of, unflyable, write_result
    from gcs.studies.capacity import capacity as capacity_of
    from gcs.views.console import progress

    if resume:
        out = options.campaign_folder(out, "--resume", "study")
    rates_hz = _rates(rates)
    wanted = "a scenario without code: gcs capacity changes its formation"
    scenario = options.load_scenario(scenario_file, links=links, allow_code=wanted)
    options.refuse(scenario_file, unflyable(scenario, most))
    with contextlib.ExitStack() as stack:
        store = None
        if out is not None:
            folder = out if resume else options.out_folder(out, "a new or empty folder, or --resume")
            store = stack.enter_context(contextlib.closing(loads_of(folder, scenario, resume=resume)))
        if not as_json:
            each = f"up to {seeds} flights of {SECONDS:g} s" if seeds > 1 else f"one flight of {SECONDS:g} s"
            count = formations_at_most(len(rates_hz), most)
            typer.echo(f"flights  at most {count} formations, {each} each", err=True)
        begin = stack.enter_context(progress(shown=not as_json))
        found = capacity_of(
            scenario,
            rates_hz=rates_hz,
            most=most,
            seeds=seeds,
            store=store,
            ended=begin("formations, at most"),
        )
        if out is not None:
            write_result(out, found)
    if as_json:
        options.print_json({"capacities": found})
    else:
        print_capacity(scenario, found)


def _rates(text: str) -> list[float]:
    try:
        rates = [float(part) for part in text.split(",")]
    except ValueError:
        rates = []
    if not rates or not all(_SLOWEST_HZ <= rate <= _FASTEST_HZ for rate in rates):
        wanted = f"numbers from {_SLOWEST_HZ:g} to {_FASTEST_HZ:g} separated by commas, such as 2,5,10"
        raise InputError(f"--rates: read {text}, wanted {wanted}")
    return rates
