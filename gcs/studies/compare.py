"""`gcs compare`: the design routes side by side, computed and flown.

Each route designs for the requirement with the information it may use, and flies the scenario in virtual time
from the same initial states. Robustness and string peak are computed for all routes on the whole formation.
"""

import time  # noqa: TID251 - design time is one of the figures; nothing flown depends on it
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Literal

import numpy as np

from gains.core.errors import GainsError
from gains.design.dk_iteration import LARGEST_STATES, abscissa
from gains.performance.robust import disturbance_bound
from gains.performance.string_stability import formation_string_peak
from gains.sampled.constant import forget_margins
from gcs.control.tick import TickArray
from gcs.drive.flown import fly_plan
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.published import json_text
from gcs.runs.files import write_scenario
from gcs.runs.summary import summarise
from gcs.studies.compare_cost import RATIO, DesignCost, left_out, ratios
from gcs.views.console import UNKNOWN, ms_text, number_text
from gcs.views.page import data_uri, figure_of, rendered, saved
from scenarios.schema import Control, Scenario

Method = Literal["inclusion", "graph-lqr", "graph-dk"]
METHODS: tuple[Method, ...] = ("inclusion", "graph-lqr", "graph-dk")
REPORT_FILE, RESULT_FILE = "compare.html", "compare.json"
_COLOURS = ("#1f4e79", "#c1440e", "#5b8c3a", "#8a5a9c", "#777777", "#b8860b")
_FLOOR = 1e-3
"""Lower end of the figure's axes: smaller values are rounding of the telemetry."""


@dataclass(frozen=True)
class Route:
    """The figures of one route; None where a figure is not available. `failed` says why the design failed."""

    method: Method
    failed: str = ""
    design_s: float | None = None
    verdict: str | None = None
    settling_time_s: float | None = None
    overshoot: float | None = None
    """Largest spacing error opposite to its initial direction, as a share of the initial error, over all vehicles."""
    effort_m2_s3: float | None = None
    """Integral of the squared commands of all vehicles over the flight. None with the loop on board, as is the largest
    command: the station sends only a part of each command."""
    command_max_m_s2: float | None = None
    spacing_error_max_m: float | None = None
    alpha: float | None = None
    """1 / ‖(sI − A − BK)^{-1}‖∞ of the whole formation."""
    delay_margin_s: float | None = None
    delay_margin_continuous_s: float | None = None
    decay_rate_1_s: float | None = None
    string_peak: float | None = None
    """Largest amplification of a spacing error from one follower to the next over all frequencies, when the leader is
    disturbed and there is no delay."""
    links: int | None = None
    """Ordered pairs of vehicles in which the first uses errors of the second."""
    numbers_used: int | None = None
    """Number of other vehicles' errors that a vehicle uses, added over all vehicles."""


Flights = dict[Method, TickArray]


def compare(scenario: Scenario, *, ended: Callable[[int], None] = lambda _: None) -> tuple[list[Route], Flights]:
    """Design and fly the scenario by every route; `ended` is called after each with the number left."""
    routes: list[Route] = []
    flights: Flights = {}
    for left, method in zip(reversed(range(len(METHODS))), METHODS, strict=True):
        update = {"method": method, "gains": None, "blocks": ()}
        control = Control.model_validate(scenario.control.model_dump() | update)
        vehicles = scenario.vehicles
        if method == "inclusion":  # it uses nothing that a vehicle `hears`
            vehicles = tuple(vehicle.model_copy(update={"hears": ()}) for vehicle in vehicles)
        try:
            if method == "graph-dk" and 2 * len(vehicles) - 1 > LARGEST_STATES:
                raise GainsError(f"more than {LARGEST_STATES} states an axis")
            route, ticks = _route(method, scenario.model_copy(update={"control": control, "vehicles": vehicles}))
        except GainsError as error:
            routes.append(Route(method, failed=str(error)))
        else:
            routes.append(route)
            flights[method] = ticks
        ended(left)
    return routes, flights


def _route(method: Method, scenario: Scenario) -> tuple[Route, TickArray]:
    forget_margins()
    begun_s = time.perf_counter()
    designed, plan = flight_plan(scenario.with_calm_monitor())
    design_s = time.perf_counter() - begun_s
    flight = fly_plan(plan)
    summary = summarise(plan.scenario, designed, flight.ticks, flight.events)
    flown = flight.ticks[(flight.ticks["time_s"] >= 0.0) & flight.ticks["commanded"]]
    model, K = plan.model, plan.gain
    squared = flown["command_north_m_s2"] ** 2 + flown["command_east_m_s2"] ** 2
    sends_all = plan.onboard is None
    pairs = permutations(range(model.vehicles), 2)
    used = [K[model.input_slice(i), model.output_slice(j)].any(axis=0) for i, j in pairs]
    route = Route(
        method=method,
        design_s=design_s,
        verdict=summary.verdict,
        settling_time_s=summary.settling_time_s,
        overshoot=_overshoot(plan, flown),
        effort_m2_s3=float(squared.sum() / scenario.rates.control_hz) if sends_all else None,
        command_max_m_s2=float(np.sqrt(squared.max(initial=0.0))) if sends_all else None,
        spacing_error_max_m=summary.spacing_error_max_m,
        alpha=disturbance_bound(model.A + model.B @ K, np.eye(model.states)),
        delay_margin_s=summary.delay_margin_s,
        delay_margin_continuous_s=summary.delay_margin_continuous_s,
        decay_rate_1_s=-abscissa(model.A + model.B @ K),
        string_peak=formation_string_peak(model, K),
        links=sum(bool(numbers.any()) for numbers in used),
        numbers_used=sum(int(numbers.sum()) for numbers in used),
    )
    return route, flight.ticks


def _overshoot(plan: FlightPlan, flown: TickArray) -> float | None:
    shares: list[float] = []
    for system_id in plan.formation.system_ids[1:]:
        own = flown[flown["system_id"] == system_id]
        error = np.stack([own["spacing_error_north_m"], own["spacing_error_east_m"]], axis=1)
        error = error[np.isfinite(error).all(axis=1)]
        first = float(np.linalg.norm(error[0])) if len(error) else 0.0
        if first > 0.1:  # smaller initial errors are noise
            shares.append(max(0.0, float(-(error @ error[0]).min()) / first**2))
    return max(shares, default=None)


def write_comparison(
    folder: Path, scenario: Scenario, routes: list[Route], flights: Flights, grown: list[DesignCost]
) -> None:
    write_scenario(folder, scenario)
    result = {"scenario": scenario.name, "routes": routes, "sizes": grown}
    (folder / RESULT_FILE).write_text(json_text(result, default=vars), encoding="utf-8")
    figures = {"Spacing errors and commands sent in flight": errors_figure(folder / "flights.png", flights.items())}
    if grown:
        figures["Cost of a design against the number of vehicles"] = sizes_figure(folder / "sizes.png", grown)
    page = rendered(
        "compare.html.j2",
        scenario=scenario,
        rows=rows(scenario, routes),
        methods=[route.method for route in routes],
        failed=[route for route in routes if route.failed],
        sizes=list(zip(grown, ratios(grown), strict=True)),
        left_out=left_out(grown),
        ratio=RATIO,
        figures={title: data_uri(file) for title, file in figures.items()},
    )
    (folder / REPORT_FILE).write_text(page, encoding="utf-8")


def rows(scenario: Scenario, routes: list[Route]) -> list[tuple[str, list[str]]]:
    """The rows of the table: the name of a figure, and its value for each route."""

    def margin(route: Route, margin_s: float | None) -> str:
        return "no limit" if margin_s is None and not route.failed else ms_text(margin_s, unit="")

    name = "delay margin" if scenario.control.prediction == "off" else "margin without prediction"
    texts: dict[str, Callable[[Route], str]] = {
        "verdict of the flight": lambda route: route.verdict or UNKNOWN,
        "settling time, s": lambda route: number_text(route.settling_time_s, ".2f"),
        "overshoot, %": lambda route: number_text(route.overshoot, ".1f", factor=100),
        "control effort, m²/s³": lambda route: number_text(route.effort_m2_s3, ".0f"),
        "largest command, m/s²": lambda route: number_text(route.command_max_m_s2, ".1f"),
        "largest spacing error, m": lambda route: number_text(route.spacing_error_max_m, ".1f"),
        f"{name}, sampled, ms": lambda route: margin(route, route.delay_margin_s),
        f"{name}, continuous, ms": lambda route: margin(route, route.delay_margin_continuous_s),
        "alpha of the whole formation": lambda route: number_text(route.alpha, ".4f"),
        "decay without delay, 1/s": lambda route: number_text(route.decay_rate_1_s, ".3f"),
        "string peak": lambda route: number_text(route.string_peak, ".3f"),
        "links between vehicles": lambda route: number_text(route.links, "d"),
        "numbers used over them": lambda route: number_text(route.numbers_used, "d"),
        "design time, s": lambda route: number_text(route.design_s, ".2f"),
    }
    return [(title, [text(route) for route in routes]) for title, text in texts.items()]


def errors_figure(file: Path, flights: Iterable[tuple[str, TickArray]]) -> Path:
    """Draw the largest spacing error and the largest command sent to a vehicle over time, for each route."""
    figure, (above, below) = figure_of(2, (9.0, 6.0), heights=(1.4, 1.0))
    for (method, ticks), colour in zip(flights, _COLOURS, strict=False):
        flown = ticks[(ticks["time_s"] >= 0.0) & ticks["commanded"]]
        time_s, place = np.unique(flown["time_s"], return_inverse=True)
        error, command = np.full((2, time_s.size), _FLOOR)
        spacing = np.hypot(flown["spacing_error_north_m"], flown["spacing_error_east_m"])
        np.fmax.at(error, place, spacing)
        np.fmax.at(command, place, np.hypot(flown["command_north_m_s2"], flown["command_east_m_s2"]))
        above.semilogy(time_s, error, color=colour, linewidth=1.4, label=method)
        below.semilogy(time_s, command, color=colour, linewidth=1.4)
    for plot in (above, below):
        plot.set_ylim(bottom=_FLOOR)
        plot.margins(x=0.0)
    above.set(ylabel="largest spacing error [m]")
    below.set(xlabel="time of flight [s]", ylabel="largest command sent [m/s²]")
    above.legend(frameon=False)
    return saved(figure, file)


def sizes_figure(file: Path, grown: list[DesignCost]) -> Path:
    """Draw the design time against the number of vehicles in a chain."""
    figure, (plot,) = figure_of(1, (9.0, 3.8))
    labels = list(dict.fromkeys(size.method for size in grown))
    for label, colour in zip(labels, _COLOURS, strict=False):
        own = [size for size in grown if size.method == label]
        plot.loglog([s.vehicles for s in own], [s.design_s for s in own], "o-", color=colour, label=label)
    ticks = sorted({size.vehicles for size in grown})
    plot.set_xticks(ticks, [str(tick) for tick in ticks])
    plot.minorticks_off()
    plot.set(xlabel="vehicles in the chain", ylabel="time of the design [s]")
    plot.legend(frameon=False)
    return saved(figure, file)
