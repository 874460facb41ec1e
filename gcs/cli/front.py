"""What `--front`, `--at` and `--links-of` of `gcs design` do, and what they print."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from gcs.cli.options import answer, out_file
from gcs.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from gains.design.front import Method
    from gcs.drive.takeover import Presence
    from gcs.drive.udp import StationSocket
    from gcs.plan.design import GainsAtDelay, LinkPart
    from gcs.studies.front import Comparison, FrontFields
    from scenarios.schema import Scenario

LinksOf = Annotated[
    Path | None,
    typer.Option(
        "--links-of",
        metavar="RUN|FILE.tlog",
        help="choose gains for the links measured in this run or log; the scenario keeps its own links",
    ),
]

# whose gains a comparison uses
_GAINS = {
    "fastest": "the static gains that decay fastest at the delay",
    "least": "the smallest gains with this decay, which tolerate the longest delay",
    "own": "the scenario's gains",
}


def chosen_for(scenario: "Scenario", links_of: Path | None) -> "tuple[Scenario, LinkPart | None]":
    """The scenario with gains for the links in --links-of, and why these gains; without that option, unchanged.

    A scenario without `for_link` loses its gains, its method and its requirements on margin, alpha and decay.
    """
    if links_of is None:
        return scenario, None
    from gcs.watch.for_link import OPTION, for_measured_links
    from scenarios.files import checked

    control = scenario.control
    if control.for_link == "off":
        kept = {name: getattr(control, name) for name in ("loop", "string_peak_max", "criteria", "link_headroom")}
        control = type(control)(for_link="measured", **kept)
    asked = checked(scenario.model_copy(update={"control": control}), Path(OPTION))
    return for_measured_links(asked, links_of)


def chosen_now(
    scenario: "Scenario",
    link: "StationSocket | None",
    presence: "Presence | None",
    key_file: Path | None,
    *,
    shown: bool,
) -> "tuple[Scenario, LinkPart]":
    """Measure the links of a scenario now, and return it with gains for them and the reason for these gains.

    The links are measured through `link`, or in virtual time if it is None. `presence` takes over simulated vehicles
    that run already; if none do, they are started. It is None if other vehicles are to be flown.
    """
    from gcs.watch.before_flight import measured_now
    from gcs.watch.for_link import best_for

    starts = presence is not None and not presence.taken_over()
    return best_for(scenario, measured_now(scenario, link, start_vehicles=starts, key_file=key_file, shown=shown))


def show_front(scenario: "Scenario", method: str | None, picture_file: Path | None, *, as_json: bool) -> None:
    """Search the front and print it."""
    from gcs.interrupts import raised
    from gcs.studies.front import DELAYS_S, METHODS, front, picture
    from gcs.views.console import progress

    _refuse_graph_dk(scenario)
    if picture_file is not None:
        out_file("--picture", picture_file)
        if picture_file.suffix not in {".svg", ".png", ".pdf"}:
            raise InputError(f"--picture: read {picture_file}, wanted a file name that ends in .svg, .png or .pdf")
    wanted = method or ("inclusion" if scenario.response is not None else None)
    methods: Sequence[Method] = [own for own in METHODS if wanted in (None, own)]
    with raised(), progress(shown=not as_json) as begin:
        found = front(scenario, methods, DELAYS_S, workers=os.cpu_count() or 1, ended=begin("front"))
    if picture_file is not None:
        picture(found, picture_file)
    answer(found, _print_front, as_json=as_json)


def _refuse_graph_dk(scenario: "Scenario") -> None:
    """Refuse graph-dk, which cannot search gains for a delay, whether the scenario or --method names it."""
    if scenario.control.method == "graph-dk":
        wanted = "--method inclusion or graph-lqr, with --front or --at"
        raise InputError(f"{scenario.name}: read method graph-dk, wanted {wanted}")


def _print_front(found: "FrontFields") -> None:
    from gcs.views.console import number_text, plain_console, table_of

    console = plain_console()
    around = f"stable at every constant delay within {found.tolerated:.0%} of the loop delay"
    console.print(f"front    each {around}; string peak at most {found.string_peak_max:g} by inclusion")
    for line in (
        "ms of loop delay; what is best there; method; predicted or not; alpha as the method reports it and",
        "of the whole formation; decay in 1/s; string peak; gain from disturbance to spacing error in s²;",
        "noise from measurements to commands; whether on the front",
    ):
        console.print(f"         {line}")
    columns: dict[str, Callable[[GainsAtDelay], str]] = {
        "ms": lambda p: f"{1e3 * p.loop_delay_s:.0f}",
        "best": lambda p: p.maximised,
        "method": lambda p: p.method,
        "pred": lambda p: "on" if p.prediction else "off",
        "alpha": lambda p: number_text(p.alpha_design, ".3f"),
        "whole": lambda p: number_text(p.alpha, ".3f"),
        "decay": lambda p: number_text(p.decay_rate_1_s, ".2f"),
        "peak": lambda p: number_text(p.string_peak, ".2f"),
        "gain": lambda p: number_text(p.spacing_gain_s2, ".2g"),
        "noise": lambda p: number_text(p.noise_gain, ".3g"),
        "front": lambda p: "refused" if p.refused else "yes" if p.is_efficient else "",
    }
    console.print(table_of(found.points, columns, dense=True))
    for point in (point for point in found.points if point.refused):
        console.print(
            f"refused  {point.method}, largest {point.maximised} at {point.loop_delay_s:g} s: {point.refused}"
        )


def print_comparison(found: "Comparison") -> None:
    """Print the loop delays with prediction and without."""
    from gcs.views.console import ms_text, number_text, plain_console, table_of

    columns: dict[str, Callable[[GainsAtDelay], str]] = {
        "pred": lambda w: "off" if w.tolerated is None else f"±{w.tolerated:.0%}",
        "gains": lambda w: w.gains,
        "delay": lambda w: ms_text(w.loop_delay_s, unit=""),
        "ratio": lambda w: number_text(w.ratio, ".2f"),
        "stable, ms": lambda w: " to ".join(ms_text(end_s, ".0f", unit="") for end_s in w.stable_s or ()),
        "half": lambda w: number_text(w.decay_rate_half_way_1_s, ".2f"),
        "peak": lambda w: number_text(w.string_peak, ".2f"),
        "alpha": lambda w: number_text(w.alpha, ".3f"),
        "gain": lambda w: number_text(w.spacing_gain_s2, ".2f"),
        "noise": lambda w: number_text(w.noise_gain, ".1f"),
    }
    console = plain_console()
    for line in (
        f"decay    {found.ways[0].decay_rate_1_s:.3f} 1/s of every row, without mismatch",
        *(
            f"{name:8} {_GAINS[name]}: K1 {way.K1:.3f}, K2 {way.K2:.3f}, K3 {way.K3:.3f}"
            for name, way in {way.gains: way for way in found.ways}.items()
        ),
        "pred     off, or by how much the delay may differ from the assumed one",
        "delay    the longest loop delay in ms: of any static gains, or with prediction",
        "stable   the loop delays at which it stays stable",
        "half     decay in 1/s at a mismatch of half of pred",
        "peak     string peak; gain: from disturbance to spacing error in s²; noise: to commands",
    ):
        console.print(line)
    console.print(table_of(found.ways, columns, dense=True))


def scenario_at(
    scenario: "Scenario", delay_s: float, maximise: str, predict: Literal["on", "off"] | None
) -> "Scenario":
    """The scenario with the gains of one point of the front, by the scenario's method."""
    from gcs.studies.front import point_at

    own: Method = "graph-lqr" if scenario.control.method == "graph-lqr" else "inclusion"
    _refuse_graph_dk(scenario)
    aim = "alpha_at_delay" if maximise == "alpha" else "decay_rate_at_delay_1_s"
    return point_at(scenario, delay_s, own, aim, predict)[0]
