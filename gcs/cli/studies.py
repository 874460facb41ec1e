"""`gcs compare`, `thesis`, `bench` and `capacity`; what they print is in `gcs.cli.study_output`."""

from typing import Annotated

import typer

from gcs.cli import FAILED
from gcs.cli.options import AsJson, OutFolder, ScenarioFile, answer, load_scenario, print_json, refuse, run_folder
from gcs.errors import InputError
from gcs.output import outlive_readers


def compare(
    scenario_file: ScenarioFile,
    out: OutFolder = None,
    sizes: Annotated[bool, typer.Option(help="also time the designs of longer and longer chains")] = True,
    as_json: AsJson = False,
) -> None:
    """Design and fly a scenario by every method, side by side.

    Exit code 1 if no route could be designed.
    """
    from gcs.cli.study_output import print_comparison
    from gcs.drive.preflight import bad_start, endless_link
    from gcs.studies import compare as comparing
    from gcs.studies.compare_cost import design_costs

    outlive_readers()
    scenario = load_scenario(scenario_file)
    refuse(scenario_file, bad_start(scenario), endless_link(scenario))
    folder = run_folder(out, f"{scenario.name}-compare")
    routes, flights = comparing.compare(scenario)
    grown = design_costs() if sizes else []
    comparing.write_comparison(folder, scenario, routes, flights, grown)
    if as_json:
        print_json({"routes": routes, "files": str(folder)})
    else:
        print_comparison(scenario, routes, grown)
        typer.echo(f"files    {folder}: {comparing.REPORT_FILE}, {comparing.RESULT_FILE}, PNG")
    raise typer.Exit(0 if flights else FAILED)


def thesis(
    out: OutFolder = None,
    as_json: AsJson = False,
) -> None:
    """Reproduce the thesis: published and computed figures side by side."""
    from gcs.studies import thesis as source

    folder = run_folder(out, "thesis")
    found = source.claims()
    page = source.write_page(folder, found)
    if as_json:
        print_json(found)
        return
    for claim in found:
        typer.echo(f"{claim.place}  {claim.subject}: {claim.verdict}")
        typer.echo(f"    published {claim.published}; computed {claim.computed}; {claim.second}")
    typer.echo(f"files    {page} and its figures")


def bench(
    scenario_file: ScenarioFile,
    vehicles: Annotated[
        int, typer.Option(metavar="N", min=0, max=250, help="number of vehicles, in columns behind a leader")
    ] = 0,
    seconds: Annotated[float, typer.Option(metavar="S", min=0.1, max=86400, help="duration of each flight")] = 8.0,
    repeat: Annotated[int, typer.Option(metavar="N", min=1, help="number of flights; the fastest counts")] = 10,
    real_time: Annotated[
        bool,
        typer.Option("--real-time", help="fly once over UDP; shows punctuality and the errors of measured latencies"),
    ] = False,
    signed: Annotated[bool, typer.Option("--signed", help="also measure what signing costs")] = False,
    as_json: AsJson = False,
) -> None:
    """Measure how much faster than real time flights are computed.

    Also measures how much of its control period the station needs.
    """
    from gcs.cli.study_output import print_benchmark, print_real_time
    from gcs.drive.preflight import bad_start, endless_link
    from gcs.studies import benchmark

    scenario = load_scenario(scenario_file)
    if vehicles:
        scenario = benchmark.with_vehicles(scenario, vehicles)
    refuse(scenario_file, bad_start(scenario), endless_link(scenario))
    if real_time:
        answer(benchmark.benchmark_real_time(scenario, seconds=seconds), print_real_time, as_json=as_json)
    else:
        result = benchmark.benchmark(scenario, seconds=seconds, repeat=repeat, signed=signed)
        answer(result, print_benchmark, as_json=as_json)


def capacity(
    scenario_file: ScenarioFile,
    rates: Annotated[str, typer.Option(metavar="HZ,HZ,...", help="telemetry and control rates")] = "2,5,10,20",
    most: Annotated[int, typer.Option(metavar="N", min=2, max=250, help="largest formation tried")] = 100,
    seeds: Annotated[
        int, typer.Option(metavar="N", min=1, help="flights of each formation, all of which must succeed")
    ] = 3,
    as_json: AsJson = False,
) -> None:
    """Find how many vehicles the links carry at each rate.

    The links carry a formation if its loop delay stays within the delay margin.
    """
    from gcs.cli.study_output import print_capacity
    from gcs.studies.capacity import capacity as capacity_of

    scenario = load_scenario(scenario_file)
    found = capacity_of(scenario, rates_hz=_rates(rates), most=most, seeds=seeds)
    if as_json:
        print_json({"capacities": found})
    else:
        print_capacity(scenario, found)


def _rates(text: str) -> list[float]:
    try:
        rates = [float(part) for part in text.split(",")]
    except ValueError:
        rates = []
    if not rates or not all(0.1 <= rate <= 1000.0 for rate in rates):
        raise InputError(f"--rates: {text}, wanted numbers from 0.1 to 1000 separated by commas, such as 2,5,10")
    return rates
