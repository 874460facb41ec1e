"""The map of a campaign with two axes: where the formation breaks, in flight and by prediction, and provably cannot."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.delay.several import boundary_of_two_delays, late_by_vehicle
from gains.performance.response import formation_loop
from gains.sampled.coupled_block import CoupledBlock, first_of_each_kind
from gains.varying.bounds import varying_delay_bound
from gains.varying.jitter import spread_bound
from gains.varying.predicted import PredictedSpread
from gcs.plan.loops import plan_loops
from gcs.stress.axes import PREDICTION, Axis, at_coordinates
from gcs.stress.figures import MEASURED
from gcs.stress.study import Study
from gcs.stress.trial import Outcome
from gcs.views.page import figure_of, saved
from scenarios.link_files import each_link

_PREDICTED, _GUARANTEED, _SEVERAL, _BLANK = "black", "#1b7837", "#7b3294", "#c8c8c8"
_POINTS = 60
_HALVINGS = 16
_MOST_TICKS = 12


def map_figure(
    file: Path, *, study: Study, axes: Sequence[Axis], outcomes: Sequence[Outcome], verdicts: Sequence[Outcome]
) -> Path | None:
    """Measured growth over two axes, averaged over the seeds, with the measured and the predicted boundaries.

    The mark of each cell shows the worst verdict of its flights in `verdicts`. With a third axis, the assumed delay of
    a station that predicts, there is one map for each of its values, side by side in the same colours.
    """
    shown = [replace(axis, values=tuple(sorted(axis.values))) for axis in axes if axis.name != PREDICTION]
    maps = [
        (_predicting(study, at), _at_assumed(at, outcomes), _at_assumed(at, verdicts))
        for at in next((axis.values for axis in axes if axis.name == PREDICTION), (None,))
    ]
    growth = [_cells(shown, own, "growth_1_s") for _, own, _ in maps]
    if not np.isfinite(growth).any():
        return None
    figure, plots = figure_of(1, (9.0 if len(maps) == 1 else 7.0 * len(maps), 6.2), columns=len(maps))
    reach = max(1e-6, min(float(np.nanmax(np.abs(growth))), 1.0))
    colors = None
    for plot, (own_study, own, own_verdicts), measured in zip(np.ravel(plots), maps, growth, strict=True):
        colors = _draw_map(plot, own_study, shown, own, measured, reach)
        _mark(plot, shown, own_verdicts, dark=np.abs(measured) > 0.6 * reach, decays=measured < 0.0)
        if len(maps) > 1:
            assumed_s = own_study.plan.assumed_s
            plot.set_title("without prediction" if assumed_s is None else f"predicted over {assumed_s:g} s")
    figure.colorbar(colors, ax=plots, label="growth of small errors [1/s]: red grows, blue dies away", extend="both")
    entries = [entry for plot in np.ravel(plots) for entry in zip(*plot.get_legend_handles_labels(), strict=True)]
    handles = {label: handle for handle, label in entries}
    figure.legend(handles.values(), handles.keys(), loc="outside upper left", ncols=2, frameon=False, fontsize=9)
    return saved(figure, file)


def _predicting(study: Study, assumed_s: float | None) -> Study:
    """The study with prediction over this delay, without prediction for 0, or unchanged for None."""
    if assumed_s is None:
        return study
    scenario = at_coordinates(study.plan.scenario, {PREDICTION: assumed_s})
    return replace(study, plan=replace(study.plan, scenario=scenario))


def _at_assumed(assumed_s: float | None, outcomes: Sequence[Outcome]) -> list[Outcome]:
    """The outcomes at this assumed delay, without it in their coordinates; all outcomes if the map has no such axis."""
    return [
        replace(own, coordinates={name: at for name, at in own.coordinates.items() if name != PREDICTION})
        for own in outcomes
        if own.coordinates.get(PREDICTION) == assumed_s
    ]


def _draw_map(
    plot: Any, study: Study, axes: Sequence[Axis], outcomes: Sequence[Outcome], measured: FloatArray, reach: float
) -> Any:
    """Draw the cells and the boundaries of one map; returns its colours for the colour bar."""
    predicted = _cells(axes, outcomes, "predicted_growth_1_s")
    across, up = (np.array(axis.values) for axis in axes)
    plot.set_facecolor(_BLANK)
    plot.grid(visible=False)
    colors = plot.pcolormesh(cell_edges(across), cell_edges(up), measured.T, cmap="RdBu_r", vmin=-reach, vmax=reach)
    for values, color, dashes, label in (
        (measured, MEASURED, "solid", "boundary in flight"),
        (predicted, _PREDICTED, "dashed", "predicted: sampled model at the loop delay of each flight"),
    ):
        if np.nanmin(values) < 0.0 < np.nanmax(values) and min(values.shape) > 1:
            plot.contour(across, up, values.T, levels=[0.0], colors=[color], linestyles=[dashes], linewidths=2.0)
            plot.plot([], [], color=color, linestyle=dashes, linewidth=2.0, label=label)
    for line in two_delays_lines(study, axes, outcomes):
        plot.plot(*line.T, color=_SEVERAL, linestyle="dotted", linewidth=3.0, label="predicted: two delays, continuous")
    line = guaranteed_line(study, axes)
    if line is not None:
        label = "guaranteed below, however the delay varies"
        plot.plot(*line.T, color=_GUARANTEED, linestyle="dashdot", linewidth=2.0, label=label)
    if np.isnan(measured).any():
        plot.plot([], [], "s", color=_BLANK, markersize=9, label="no growth rate could be measured")
    plot.set(xlabel=axes[0].label, ylabel=axes[1].label, xlim=cell_edges(across)[[0, -1]], ylim=cell_edges(up)[[0, -1]])
    for axis, values in ((plot.xaxis, across), (plot.yaxis, up)):
        flown = values[:: 1 + (values.size - 1) // _MOST_TICKS].tolist()
        axis.set_ticks(flown, [f"{value:g}" for value in flown])
    return colors


def guaranteed_line(study: Study, axes: Sequence[Axis]) -> FloatArray | None:
    """(k, 2) link delays, and the jitter below which the formation is proved stable however the delay varies.

    None if the axes are not delay and jitter, if jitter is unbounded, and for loops to which no proof applies: loops on
    board and, with prediction, loops over the measured delay, of several vehicles, or over reordering links.
    """
    scenario, names = study.plan.scenario, [axis.name for axis in axes]
    if names != ["delay", "jitter"] or len(axes[0].values) < 2 or study.plan.onboard is not None:
        return None
    jittery = [link for _, link in each_link(at_coordinates(scenario, {"jitter": 1.0}).links)]
    if any(link.jitter is None or link.jitter.distribution != "uniform" for link in jittery):
        return None
    delays_s = np.linspace(axes[0].values[0], axes[0].values[-1], _POINTS)
    blocks = first_of_each_kind(plan_loops(study.plan))
    if scenario.control.prediction == "off":
        jitter_s = _proved_s(blocks, study.plan.timing.held_s, delays_s)
    else:
        assumed_s = study.plan.assumed_s
        shared = any(len(block.system_ids) > 1 for block in blocks)
        if assumed_s is None or shared or any(link.reordering for link in jittery):
            return None
        jitter_s = np.min([_proved_predicted_s(block, assumed_s, delays_s) for block in blocks], axis=0)
    jitter_s = np.minimum(jitter_s, delays_s / 2.0)  # delays cannot be negative
    return np.stack([delays_s, jitter_s], axis=1)[jitter_s >= 0.0]


def _proved_s(blocks: Sequence[CoupledBlock], period_s: float, delays_s: FloatArray) -> FloatArray:
    """The jitter proved stable at each link delay without prediction; negative where nothing is proved.

    With link delay d, jitter of at most j each way, and period T of telemetry and control, the command in force was
    computed from a state that is d - 2 j to d + 2 j + 2 T old. Two bounds cover that: one for deviations from the
    middle (`gains.varying.jitter.spread_bound`, a search on a grid of frequencies), and one for any variation between
    0 and a maximum (`gains.varying.bounds.varying_delay_bound`).
    """
    loops = [(block.A, block.B @ block.K) for block in blocks]
    try:
        any_s = min(varying_delay_bound(A0, A1, rate=inf) for A0, A1 in loops)
    except BadModelError:  # the loop is too large for a proof
        any_s = 0.0
    around_s = [min(spread_bound(A0, A1, mean_s=delay + period_s) for A0, A1 in loops) for delay in delays_s.tolist()]
    return np.maximum((np.array(around_s) - period_s) / 2.0, (any_s - 2.0 * period_s - delays_s) / 2.0)


def _proved_predicted_s(block: CoupledBlock, assumed_s: float, delays_s: FloatArray) -> FloatArray:
    """The jitter proved stable at each link delay for one predicted vehicle; negative where nothing is proved.

    With jitter of at most j each way, a state is between up - j and up + j + T old when it is first used. The assumed
    delivery delay is the assumed loop delay minus the mean of these ages, which may lie anywhere in that range. A
    set-point then acts later than assumed by d - 2 j to d + 2 j + T minus the assumed loop delay, where d is the delay
    of both links. See `gains.varying.predicted.PredictedSpread`.
    """
    wait_s = block.timing.control_s
    spread = PredictedSpread(block.A, block.B, block.K, block.timing, assumed_s, block.measured)

    def proved(delay_s: float, jitter_s: float) -> bool:
        bound_s = spread.bound_s(mean_s=delay_s + wait_s / 2.0, telemetry_s=jitter_s)
        return bound_s >= 2.0 * jitter_s + wait_s / 2.0

    found = list[float]()
    for delay_s in delays_s.tolist():
        low_s, high_s = -1.0, delay_s / 2.0
        for _ in range(_HALVINGS):
            middle_s = (max(low_s, 0.0) + high_s) / 2.0
            low_s, high_s = (middle_s, high_s) if proved(delay_s, middle_s) else (low_s, middle_s)
        found.append(low_s)
    return np.array(found)


def two_delays_lines(study: Study, axes: Sequence[Axis], outcomes: Sequence[Outcome]) -> list[FloatArray]:
    """The stability boundary over the link delays of two vehicles, from the continuous model of the whole formation.

    Empty for other axes, for loops with feedback that is not delayed, and for vehicles that share a loop with others,
    because the delays of those matter too.
    """
    plan = study.plan
    if not all(axis.name.startswith("delay_") for axis in axes) or not plan.all_late:
        return []
    ids = [int(axis.name.removeprefix("delay_")) for axis in axes]
    if any(system_id in loop.system_ids and len(loop.system_ids) > 1 for loop in plan_loops(plan) for system_id in ids):
        return []
    model, places = plan.model, [plan.formation.row(system_id) for system_id in ids]
    A, B, K = formation_loop(model, plan.gain, plan.responses_in_order)
    late = late_by_vehicle(B, K, [model.input_slice(k) for k in range(model.vehicles)])
    others = sum((late[k] for k in range(model.vehicles) if k not in places), A)
    # link delay = the model's delay - hold - wait for the control tick
    less_s = np.array([plan.timing.held_s / 2.0 + _waiting_s(outcomes, system_id) for system_id in ids])
    longest_s = (axes[0].values[-1] + float(less_s[0]), axes[1].values[-1] + float(less_s[1]))
    lines = boundary_of_two_delays(others, late[places[0]], late[places[1]], longest_s=longest_s)
    return [line.delays_s - less_s for line in lines]


def _waiting_s(outcomes: Sequence[Outcome], system_id: int) -> float:
    waits = [o.waiting_s for o in outcomes if o.critical == system_id and o.waiting_s is not None]
    return float(np.median(waits)) if waits else 0.0


def _mark(
    plot: Any, axes: Sequence[Axis], verdicts: Sequence[Outcome], *, dark: NDArray[np.bool_], decays: NDArray[np.bool_]
) -> None:
    """Mark each cell with the worst verdict of its flights; light marks on dark cells.

    An error that persists where small errors decay is not an instability of the loop: large initial errors reached a
    limit, or random links keep pushing the vehicles.
    """
    across, up = (np.array(axis.values) for axis in axes)
    flown = [{outcome.verdict for outcome in cell} for cell in _of_cells(axes, verdicts)]
    worst = [next((v for v in ("unstable", "aborted", "stable") if v in own), "") for own in flown]
    found = np.array(worst).reshape([len(axis.values) for axis in axes])
    for cells, marker, size, filled, meaning in (
        ((found == "unstable") & ~decays, "x", 22, True, "unstable"),
        ((found == "unstable") & decays, "o", 22, False, "an error stays, though small ones die away"),
        (found == "stable", "o", 8, True, "stable"),
        (found == "aborted", "+", 22, True, "aborted"),
    ):
        at = np.argwhere(cells)
        if not at.size:
            continue
        ink = np.where(dark[at[:, 0], at[:, 1]], "white", "#222222")
        for place, color in ((at, ink), (at[:0], np.array(["#222222"]))):  # the second for the legend
            inside = {"color": color} if filled else {"facecolors": "none", "edgecolors": color}
            label = None if len(place) else f"from the scenario's start: {meaning}"
            plot.scatter(
                across[place[:, 0]], up[place[:, 1]], marker=marker, s=size, linewidths=0.9, label=label, **inside
            )


def cell_edges(values: FloatArray) -> FloatArray:
    """The edges of cells around rising values: halfway between neighbours, and equally far beyond the outer values."""
    if values.size < 2:
        half = 0.1 * abs(float(values[0])) or 0.01
        return np.array([values[0] - half, values[0] + half])
    between = (values[:-1] + values[1:]) / 2.0
    return np.r_[2.0 * values[0] - between[0], between, 2.0 * values[-1] - between[-1]]


def _of_cells(axes: Sequence[Axis], outcomes: Sequence[Outcome]) -> list[list[Outcome]]:
    """The outcomes of each cell, the second axis varying fastest."""
    points = [dict(zip([axis.name for axis in axes], at, strict=True)) for at in product(*(a.values for a in axes))]
    return [[outcome for outcome in outcomes if outcome.coordinates == point] for point in points]


def _cells(axes: Sequence[Axis], outcomes: Sequence[Outcome], field: str) -> FloatArray:
    """A field of the outcomes as an array over two axes, averaged over the seeds; NaN where no seed has it."""
    known = [[v for o in cell if (v := getattr(o, field)) is not None] for cell in _of_cells(axes, outcomes)]
    means = [float(np.mean(values)) if values else np.nan for values in known]
    return np.array(means).reshape([len(axis.values) for axis in axes])
