"""The figures of a campaign, as PNG files."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gains.core.arrays import FloatArray
from gains.sampled.coupled_block import first_of_each_kind
from gcs.plan.expected_delay import planned_loop_delays_s
from gcs.plan.loops import growth_of, is_modelled, plan_loops
from gcs.stress.axes import Axis, place_text
from gcs.stress.study import Onset, Study
from gcs.stress.trial import Outcome
from gcs.views.page import figure_of, saved

SAMPLED, CONTINUOUS, MEASURED, LIMIT = "#1f4e79", "#8aa9c4", "#c1440e", "#444444"
_RATES = "growth_1_s", "predicted_growth_1_s", "growth_error_1_s"
_WORST = 6
_SPARSE = 6
"""Step between the delays at which the continuous model is drawn: with a dead time, its root takes 0.3 s to find."""
_FLIGHTS = {"own": "from the scenario's start", "probe": "a small error"}


def growth_figure(
    file: Path, *, study: Study, outcomes: Sequence[Outcome], own: Sequence[Outcome], onset: Onset | None
) -> Path | None:
    """Growth rate against loop delay: both models, the flights with their errors, and the residuals below.

    A line marks the loop delay expected over the scenario's links: that of the onset's vehicle, or of the slowest. The
    flights `own`, from the scenario's own initial states, are marked along the lower edge. Returns the file, or None
    without drawing anything if no flight has a growth rate.
    """
    probes = [o for o in outcomes if o.growth_1_s is not None and o.loop_delay_s is not None]
    if not probes:
        return None
    delay_s = _column(probes, "loop_delay_s")
    measured, predicted, error = (_column(probes, name) for name in _RATES)
    figure, (above, below) = figure_of(2, (9.0, 6.4), heights=(3.2, 1.0))
    expected_s = planned_loop_delays_s(study.plan)
    here_s = max(expected_s.values()) if onset is None or onset.vehicle is None else expected_s[onset.vehicle]
    first_s, last_s = min(here_s, float(delay_s.min())), max(here_s, float(delay_s.max()))
    room_s = 0.03 * (last_s - first_s or 0.1)
    grid_s = np.linspace(max(0.0, first_s - room_s), last_s + room_s, 241)
    # the formation's growth rate is the largest of its loops'
    above.axhline(0.0, color=LIMIT, linewidth=0.8)
    if is_modelled(study.plan):
        _draw_models(above, study, grid_s, None if onset is None else onset.vehicle)
    style: dict[str, Any] = {"fmt": "o", "color": MEASURED, "markersize": 4.0, "elinewidth": 1.0, "capsize": 2.0}
    above.errorbar(delay_s, measured, yerr=error, label="flights", zorder=3, **style)
    _mark_own(above, own)
    margin_s = study.window_s[1] if onset is None or onset.vehicle is None else onset.predicted_s or np.inf
    if grid_s[0] <= margin_s <= grid_s[-1]:
        above.axvline(margin_s, color=SAMPLED, linestyle="--", linewidth=1.0)
        _note(above, f"margin {margin_s:.4f} s ", (margin_s, 0.08), SAMPLED, ha="right")
    above.axvline(here_s, color=LIMIT, linestyle=":", linewidth=1.2)
    _note(above, f" over the scenario's links {here_s:.3f} s", (here_s, 0.92), LIMIT)
    if onset is not None:
        above.plot([onset.loop_delay_s], [0.0], marker="D", color="none", markeredgecolor=MEASURED, markersize=11)
        text = f"onset in flight {onset.loop_delay_s:.4f} s"
        at = (onset.loop_delay_s, 0.0)
        above.annotate(text, at, xytext=(12, -16), textcoords="offset points", color=MEASURED, ha="left", fontsize=9)
        waiting_s = onset.waiting_s
        top = above.secondary_xaxis("top", functions=(partial(np.add, -waiting_s), partial(np.add, waiting_s)))
        top.set_xlabel(f"link delay of vehicle {onset.critical}, up + down [s]: {1e3 * waiting_s:.1f} ms less")
    above.set_ylabel("growth rate of errors [1/s]\n< 0 they die away, > 0 they grow")
    figure.legend(loc="outside upper left", ncols=3, frameon=False, fontsize=9)
    below.axhline(0.0, color=LIMIT, linewidth=0.8)
    below.errorbar(delay_s, measured - predicted, yerr=error, **style)
    below.set(xlabel="loop delay of the flight [s]", ylabel="flight − sampled\n[1/s]")
    below.ticklabel_format(axis="y", scilimits=(-2, 2))
    above.sharex(below)
    return saved(figure, file)


def _note(plot: Any, text: str, at: tuple[float, float], color: str, *, ha: str = "left") -> None:
    """Write a text at a loop delay and a fraction of the plot's height."""
    plot.annotate(text, at, xycoords=plot.get_xaxis_transform(), color=color, ha=ha, va="center", fontsize=9)


def _draw_models(above: Any, study: Study, delays_s: FloatArray, vehicle: int | None) -> None:
    """Draw the growth of the loop that grows fastest at each loop delay, or of one vehicle's loop, by both models."""
    some_s, blocks = delays_s[::_SPARSE], plan_loops(study.plan)
    if vehicle is not None:
        blocks = [block for block in blocks if vehicle in block.system_ids]
    if vehicle is not None and len(blocks[0].system_ids) > 1:
        rates, label = map(growth_of(study.plan, vehicle), some_s.tolist()), "model, the other links as in the scenario"
        above.plot(some_s, list(rates), color=SAMPLED, linewidth=1.4, label=label)
        return
    kinds = first_of_each_kind(blocks)
    sampled = np.array([[kind.growth_1_s(at) for at in delays_s.tolist()] for kind in kinds])
    fastest = [kinds[k] for k in sampled.argmax(axis=0)[::_SPARSE]]
    continuous = [kind.growth_continuous_1_s(at) for kind, at in zip(fastest, some_s.tolist(), strict=True)]
    above.plot(some_s, continuous, color=CONTINUOUS, linewidth=3.5, label="continuous model, hold = half a period")
    above.plot(delays_s, sampled.max(axis=0), color=SAMPLED, linewidth=1.4, label="sampled model, exact")


def axis_figure(file: Path, *, axis: Axis, outcomes: Sequence[Outcome]) -> Path | None:
    """Growth rate against one axis: the flights, and the sampled model at the loop delay of each."""
    probes = [o for o in outcomes if o.growth_1_s is not None]
    if not probes:
        return None
    figure, (plot,) = figure_of(1, (9.0, 4.2))
    at = [o.coordinates[axis.name] for o in probes]
    plot.axhline(0.0, color=LIMIT, linewidth=0.8)
    measured, predicted, error = (_column(probes, name) for name in _RATES)
    plot.plot(at, predicted, "_", color=SAMPLED, markersize=14, label="sampled model")
    plot.errorbar(at, measured, yerr=error, fmt="o", color=MEASURED, markersize=4.0, capsize=2.0, label="flights")
    plot.set(xlabel=axis.label, ylabel="growth rate of errors [1/s]")
    plot.legend(frameon=False)
    return saved(figure, file)


def _column(outcomes: Sequence[Outcome], name: str) -> FloatArray:
    """A field of the outcomes as an array; NaN for None."""
    return np.array([getattr(outcome, name) for outcome in outcomes], dtype=float)


def worst_figure(file: Path, outcomes: Sequence[Outcome]) -> Path | None:
    """The largest spacing error over time, for the worst flights."""
    worst = worst_of(outcomes)
    if not worst:
        return None
    from matplotlib.ticker import LogFormatter

    figure, (plot,) = figure_of(1, (9.0, 5.0))
    for outcome in worst:
        error_m = np.maximum(np.array(outcome.trace_m), 1e-6)
        time_s = outcome.trace_period_s * (np.arange(error_m.size) + 0.5)
        flight = _FLIGHTS[outcome.kind]
        label = f"{place_text(outcome.coordinates)}: {outcome.verdict or 'failed'}; {flight}, trial {outcome.id[:8]}"
        plot.semilogy(time_s, error_m, linewidth=1.3, label=label)
    plot.yaxis.set_major_formatter("{x:g}")
    plot.yaxis.set_minor_formatter(LogFormatter())
    plot.set(xlabel="scenario time [s]", ylabel="largest spacing error of all vehicles [m]")
    plot.set_xlim(0.0, max(outcome.trace_period_s * len(outcome.trace_m) for outcome in worst))
    plot.legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    return saved(figure, file)


def worst_of(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """The flights that broke soonest, then those with the largest errors; probes only if there are no own trials."""
    flown = [outcome for outcome in outcomes if outcome.trace_m]
    own = [outcome for outcome in flown if outcome.kind == "own"]

    def badness(outcome: Outcome) -> tuple[bool, float, float]:
        broke = (outcome.reason or "").startswith("broken")
        return broke, -float(len(outcome.trace_m)) if broke else 0.0, outcome.spacing_error_max_m or 0.0

    ordered = sorted(own or flown, key=badness, reverse=True)
    # the varied quantity may have no effect: list only the first of identical flights
    apart: dict[tuple[float, ...], Outcome] = {}
    for outcome in ordered:
        apart.setdefault(tuple(outcome.trace_m), outcome)
    return list(apart.values())[:_WORST]


def _mark_own(plot: Any, own: Sequence[Outcome]) -> None:
    """Mark the verdicts of own trials at their loop delays, along the lower edge."""
    for verdict, marker, color in (("stable", "o", SAMPLED), ("unstable", "x", MEASURED)):
        at = [o.loop_delay_s for o in own if o.verdict == verdict and o.loop_delay_s is not None]
        if at:
            label = f"from the scenario's start: {verdict}"
            edge = {"transform": plot.get_xaxis_transform(), "clip_on": False}
            plot.plot(at, [0.02] * len(at), marker, color=color, markersize=5, fillstyle="none", label=label, **edge)
