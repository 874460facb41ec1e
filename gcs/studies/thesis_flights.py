"""The source's figures and their flights: flown by our station; those of chapter 5 use the nonlinear model."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray
from gains.core.requirement import Requirement
from gains.design.design import design
from gains.formation.model import FormationModel
from gains.sampled.onboard import own_part
from gcs.control.tick import TickArray
from gcs.drive.flown import fly_plan
from gcs.plan.design import Design
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.own_law import LawFormation
from gcs.plan.planner import flight_plan
from gcs.runs.summary import summarise
from gcs.views.page import figure_of, saved
from scenarios.files import load
from scenarios.shipped import FOLDER

PERIOD_S = 0.02
STEP_S = 1e-3
"""Step of the nonlinear model."""
ALPHA = 0.93
DELAYS_S = (0.17, 0.9, 1.1)
CHAIN, SINGLE = FormationModel((-1, 0, 1)), FormationModel((-1, 0, 1), axes=1)
"""The source's three vehicles, on both axes and on one."""
_IN_PLACE = LawFormation((1, 2, 3), CHAIN.predecessors, np.zeros((3, 2)), np.array([91.44, 0.0]), STEP_S)
"""These vehicles at 300 ft/s north. The wanted spacing cancels in their errors and is taken as zero."""
_COLOURS = ("#1f4e79", "#c1440e", "#5b8c3a", "#8a5a9c", "#8a6d1f")
_FT = 0.3048
_SHOTS = 7


@cache
def printed_gains() -> FloatArray:
    """K of section 5.2.2, with the slip "0.5003" corrected, from scenarios/thesis_gains.toml."""
    return flight_plan(load(FOLDER / "thesis_gains.toml"))[1].gain


@cache
def late_flight(delay_s: float) -> tuple[FloatArray, FloatArray]:
    """Times and errors of a nonlinear flight of 20 s with the printed gains, from initial errors of our choice."""
    start = np.array([2.0, -1.0, 10.0, 5.0, 0.0, 0.0, -6.0, 8.0, 0.0, 0.0])
    return fly_with_late_neighbours(printed_gains(), start, delay_s=delay_s, duration_s=20.0)


def nonlinear_response(delay_s: float) -> tuple[float, float]:
    """Growth rate (1/s) of the errors' envelope, and the time after which they stay within 2 % of their maximum."""
    time_s, errors = late_flight(delay_s)
    size = np.linalg.norm(errors, axis=1)
    outside = np.flatnonzero(size > 0.02 * size.max())
    settled_s = float(time_s[min(outside[-1] + 1, len(time_s) - 1)])
    # envelope: the largest error of each second, while it is above rounding
    whole = int(time_s[-1])
    envelope = size[: whole * 1000].reshape(whole, 1000).max(axis=1)
    kept = (envelope > 1e-9 * envelope.max()) & (np.arange(whole) >= whole // 4)
    slope = np.polyfit(np.arange(whole)[kept] + 0.5, np.log(envelope[kept]), 1)[0]
    return float(slope), settled_s


@cache
def flown(name: str, method: str) -> tuple[TickArray, float | None]:
    """Fly one of the triangle scenarios without link delay; returns its ticks and settling time."""
    designed, plan = planned(name, method)
    flight = fly_plan(plan)
    return flight.ticks, summarise(plan.scenario, designed, flight.ticks, flight.events).settling_time_s


@cache
def planned(name: str, method: str) -> tuple[Design, FlightPlan]:
    """Design and plan of a scenario without link delay, by inclusion with α = 0.93, or by a graph method with the same
    delay margin."""
    scenario = load(FOLDER / f"{name}.toml").with_link_delay(up_s=0.0, down_s=0.0).with_calm_monitor()
    if method == "inclusion":
        return flight_plan(scenario.with_keys(control={"delay_margin_s": None, "alpha": ALPHA}))
    margin_s = design(CHAIN, Requirement(alpha=ALPHA), period_s=PERIOD_S).delay_margin_s
    return flight_plan(scenario.with_keys(control={"alpha": None, "delay_margin_s": margin_s, "method": method}))


def fly_with_late_neighbours(
    K: FloatArray, start: FloatArray, *, delay_s: float, duration_s: float
) -> tuple[FloatArray, FloatArray]:
    """Times (k,) and errors e (k, states) of the source's nonlinear model with delayed data from neighbours, (5.1).

    X' = V cos ψ, Y' = V sin ψ, ψ' = ω, V' = a with (a, ω) = M(ξ) u, (2.2)-(2.6): with north + j east as one number and
    w = ln V + jψ, z' = e^w and w' = u e^-w, integrated by RK4. u_i(t) = K_ii x_i(t) + sum of K_ij x_j(t − h), held for
    one step of 1 ms. Before t = 0 the errors are constant at `start` (states,); the formation heads north. The model
    shares no code with the simulated vehicles.
    """
    steps, lag = round(duration_s / STEP_S), round(delay_s / STEP_S)
    own = own_part(CHAIN, K)
    others = K - own
    z, velocity = _IN_PLACE.states(start).view(np.complex128).T
    state = np.stack([z, np.log(velocity)])
    errors = np.empty((steps + 1, CHAIN.states))
    errors[0] = start
    for k in range(steps):
        u = own @ errors[k] + others @ errors[max(0, k - lag)]
        state = _rk4(state, u.view(np.complex128))
        errors[k + 1] = _IN_PLACE.errors(np.stack([state[0], np.exp(state[1])], axis=1).view(np.float64))
    return np.arange(steps + 1, dtype=np.float64) * STEP_S, errors


def _rk4(state: ComplexArray, u: ComplexArray) -> ComplexArray:
    k1 = _rates(state, u)
    k2 = _rates(state + 0.5 * STEP_S * k1, u)
    k3 = _rates(state + 0.5 * STEP_S * k2, u)
    k4 = _rates(state + STEP_S * k3, u)
    return state + STEP_S / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def _rates(state: ComplexArray, u: ComplexArray) -> ComplexArray:
    velocity = np.exp(state[1])
    return np.array([velocity, u / velocity])


def formation_figure(file: Path, method: str) -> Path:
    """Draw figures 3.2-3.6 (inclusion) or 4.3-4.7 (graph): superimposed snapshots and distances of three flights."""
    titles = {"triangle5": "first", "triangle5_scattered": "second", "triangle5_turns": "turns"}
    figure, plots = figure_of(2, (12.0, 7.0), heights=(1.3, 1.0), columns=3)
    for column, (name, title) in enumerate(titles.items()):
        ticks, settled_s = flown(name, method)
        above, below = plots[0][column], plots[1][column]
        until_s = 75.0 if name == "triangle5_turns" else 15.0
        _snapshots(above, ticks, until_s)
        _distances(below, ticks, until_s)
        above.set_title(f"{title}: settled after {settled_s:.1f} s" if settled_s is not None else title, fontsize=10)
    plots[0][0].set_ylabel("north [ft]")
    plots[1][0].set_ylabel("distance to the vehicle in front [ft]")
    plots[1][0].legend(frameon=False, fontsize=8)
    return saved(figure, file)


def _snapshots(plot: Any, ticks: TickArray, until_s: float) -> None:
    for time_s, strength in zip(np.linspace(0.0, until_s, _SHOTS), np.linspace(0.35, 1.0, _SHOTS), strict=True):
        tick = ticks["tick"][np.abs(ticks["time_s"] - time_s).argmin()]
        now = ticks[ticks["tick"] == tick]
        for row, colour in zip(now, _COLOURS, strict=False):
            plot.plot(row["east_m"] / _FT, row["north_m"] / _FT, "^", color=colour, alpha=strength, markersize=5)
    plot.set_xlabel("east [ft]")
    plot.locator_params(axis="x", nbins=5)
    plot.set_aspect("equal", adjustable="datalim")


def _distances(plot: Any, ticks: TickArray, until_s: float) -> None:
    within = ticks[(ticks["time_s"] >= 0.0) & (ticks["time_s"] <= until_s)]
    own = {k: within[within["system_id"] == k] for k in (1, 2, 3)}
    time_s = own[1]["time_s"]
    for one, other, colour in ((1, 2, _COLOURS[0]), (2, 3, _COLOURS[1])):
        apart = (own[one][name] - own[other][name] for name in ("north_m", "east_m"))
        distance = np.hypot(*apart) / _FT
        plot.plot(time_s, distance, color=colour, linewidth=1.3, label=f"V{one}-V{other}")
    plot.set_xlabel("time [s]")


def responses_figure(file: Path) -> Path:
    """Draw figures 5.2-5.4, the errors of the three vehicles at h = 0.17 s, and the same at 0.9 s and 1.1 s."""
    figure, plots = figure_of(3, (12.0, 8.0), heights=(1.0, 1.0, 1.0), columns=3)
    for column, delay_s in enumerate(DELAYS_S):
        time_s, errors = late_flight(delay_s)
        shown = time_s <= (8.0 if delay_s < 0.5 else 20.0)
        for i in range(3):
            plot = plots[i][column]
            part = errors[shown, CHAIN.output_slice(i)]
            names = ["v north", "v east"] if i == 0 else ["p north", "p east", "v north", "v east"]
            for values, name, colour in zip(part.T, names, _COLOURS, strict=False):
                plot.plot(time_s[shown], values, color=colour, linewidth=1.0, label=name)
            if column == 0:
                plot.set_ylabel(f"errors of vehicle {i + 1} [m, m/s]")
                plot.legend(frameon=False, fontsize=7, ncols=2)
        plots[0][column].set_title(f"h = {delay_s} s", fontsize=10)
        plots[2][column].set_xlabel("time [s]")
    return saved(figure, file)
