"""The Rerun recording of a run and its screen layout. Only this file imports Rerun.

Everything is on the timeline sim_time, which starts with the flight; of the time before it, only events are kept, at 0.
An entity holds one value for each vehicle, in the scenario's order, so a tick of two hundred vehicles costs about as
much as a tick of two. The scene is recorded twice: formation/... relative to the leader, in m north, east and down of
it, and ground/... over the ground, in local NED.
"""

import errno
import math
import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TimelineColumn
from rerun.chunk import RrdReader
from rerun.experimental import ViewerClient

from gains.core.arrays import FloatArray
from gcs.control.phases import patience_s
from gcs.control.tick import TICK, Event, Mode, TickArray
from gcs.plan.design import Design
from gcs.plan.formation import plan_formation
from gcs.runs.record import RECORDING_FILE, UNFINISHED_FILE
from gcs.views import scene
from gcs.views.scene import Color
from gcs.views.table import event_text, merged
from scenarios.schema import Scenario

TIMELINE = "sim_time"
TRAIL_S = 20.0
LABELS_MAX = 40
"""Most vehicles with labels; more would cover the scene."""
LEGEND_MAX = 8
"""Most vehicles with a legend; more would cover the plot."""
_CURVES = {
    "delay/loop_ms": ("loop_delay_s", 1e3),
    "headroom/percent": ("headroom", 100.0),
    "command/north_m_s2": ("command_north_m_s2", 1.0),
    "command/east_m_s2": ("command_east_m_s2", 1.0),
}
"""Curves with one line for each vehicle: the column of the tick record, and the factor to the unit shown."""

LIMIT_COLOR: Color = (255, 72, 66)
PALE: Color = (130, 135, 145)


class Level(NamedTuple):
    """A horizontal line of a plot."""

    path: str
    name: str
    value: float
    limit: bool = False
    """Whether it is a limit that curves should not cross; drawn bold."""


class Recording:
    """Context manager that writes flight.rrd of one run: call `add` as often as wanted, `send` about once a second.

    The file has another name until the end, so a flight.rrd is always complete. A viewer, given by its URL, is sent the
    same data; if it is closed, writing to the file continues.
    """

    def __init__(self, folder: Path, scenario: Scenario, design: Design, viewer: str | None = None) -> None:
        count = len(scenario.vehicles)
        self._folder = folder
        self._scenario = scenario
        self._tree = scene.tree_of(scenario)
        self._labels = [str(vehicle.system_id) for vehicle in scenario.vehicles]
        self._levels = _levels(scenario)
        self._predicts = scenario.control.prediction != "off"
        self._before_s = patience_s(scenario)
        self._ticks: list[TickArray] = []
        self._events: list[Event] = []
        self._newest_m = scene.Newest(count, 3)
        self._newest_rtt_ms = scene.Newest(count)
        self._modes = np.full(count, -1)
        self._picture_times = scene.PictureTimes(scene.PICTURE_S)
        self._trail_times = scene.PictureTimes(scene.TRAIL_STEP_S)
        self._trail_ends_m: dict[str, FloatArray] = {}
        self._stream = rr.RecordingStream("formation-gcs")
        sinks = [rr.FileSink(folder / UNFINISHED_FILE), *([] if viewer is None else [rr.GrpcSink(viewer)])]
        self._is_live = viewer is not None
        self._stream.set_sinks(*sinks, default_blueprint=_blueprint(scenario, design, following=self._is_live))
        self._stream.send_recording_name(scenario.name)
        self._log_scene_styles()
        self._log_plot_styles()

    def __enter__(self) -> Self:
        return self

    def add(self, ticks: TickArray, events: list[Event]) -> None:
        """Buffer whole ticks, shape (ticks, vehicles), and events; `send` writes them."""
        if ticks.size:
            self._ticks.append(ticks)
        self._events += events

    def redesigned(self, design: Design) -> None:
        """Show the margins of another design in the plot titles."""
        self._stream.send_blueprint(_blueprint(self._scenario, design, following=self._is_live))

    def send(self) -> None:
        if said := merged(self._events):
            times_s = np.array([max(event.time_s, 0.0) for event, _ in said])
            texts = [event_text(event, system_ids, self._before_s) for event, system_ids in said]
            levels = [_event_level(event) for event, _ in said]
            self._columns("events", times_s, rr.TextLog.columns(text=texts, level=levels))
        ticks = np.concatenate(self._ticks) if self._ticks else np.empty((0, 1), TICK)
        self._events, self._ticks = [], []
        ticks = ticks[ticks["time_s"][:, 0] >= 0]
        if ticks.size:
            self._send_series(ticks)
            self._send_modes(ticks)
            self._send_scene(ticks)

    def __exit__(self, *_: object) -> None:
        """Write the rest and give the file its final name; raises OSError if not all of it could be written."""
        self.send()
        try:
            self._stream.flush()
        except RuntimeError as error:
            if "gRPC" not in str(error):  # the viewer was closed
                raise OSError(errno.EIO, f"the recording is not whole ({error})") from None
        self._stream.disconnect()
        os.replace(self._folder / UNFINISHED_FILE, self._folder / RECORDING_FILE)

    def _columns(self, path: str, times_s: FloatArray, columns: Any) -> None:
        self._stream.send_columns(path, [rr.TimeColumn(TIMELINE, duration=times_s)], columns)

    def _scalars(self, path: str, times_s: FloatArray, values: FloatArray) -> None:
        self._columns(path, times_s, rr.Scalars.columns(scalars=values))

    def _send_series(self, ticks: TickArray) -> None:
        times_s = ticks["time_s"][:, 0]
        if self._tree.followers:
            errors_m = np.hypot(ticks["spacing_error_north_m"], ticks["spacing_error_east_m"])
            self._scalars("spacing/error_m", times_s, errors_m[:, self._tree.followers])
        for path, (column, factor) in _CURVES.items():
            self._scalars(path, times_s, factor * ticks[column])
        margins_ms = 1e3 * ticks["delay_margin_s"]
        if np.isfinite(margins_ms).any():
            self._scalars("delay/margin_ms", times_s, np.where(np.isfinite(margins_ms), margins_ms, np.nan))
        if self._predicts:
            self._scalars("delay/assumed_ms", times_s, 1e3 * ticks["assumed_delay_s"])
        # Only some ticks have a new round trip: each is shown until the next.
        self._scalars("delay/rtt_ms", times_s, self._newest_rtt_ms.fill(1e3 * ticks["rtt_s"]))
        for level in self._levels:
            self._scalars(level.path, times_s[[0, -1]], np.full((2, 1), level.value))

    def _send_modes(self, ticks: TickArray) -> None:
        """Send mode changes only, and labels that show the mode of each vehicle that is not NOMINAL."""
        modes = np.vstack([self._modes, ticks["mode"]])
        times_s = ticks["time_s"][:, 0]
        for k, line in zip(*np.nonzero(np.diff(modes, axis=0).T), strict=True):
            state = Mode(int(ticks["mode"][line, k])).name
            self._columns(f"modes/{self._labels[k]}", times_s[[line]], rr.StateChange.columns(state=[state]))
        for line in np.nonzero(np.any(np.diff(modes, axis=0), axis=1))[0]:
            labels = [
                name if mode == Mode.NOMINAL else f"{name} {Mode(int(mode)).name}"
                for name, mode in zip(self._labels, ticks["mode"][line], strict=True)
            ]
            for root in ("formation", "ground"):
                columns = rr.Points3D.columns(labels=labels).partition([len(labels)])
                self._columns(f"{root}/vehicles", times_s[[line]], columns)
        self._modes = modes[-1]

    def _send_scene(self, ticks: TickArray) -> None:
        """Send positions at the instant of their tick, relative to the leader and over the ground."""
        all_m = self._newest_m.fill(scene.positions_m(ticks))
        shown = list(self._picture_times.pick(ticks["time_s"][:, 0]))
        if not shown:
            return
        times_s, ground_m = ticks["time_s"][shown, 0], all_m[shown]
        leader_m = ground_m[:, [self._tree.leader]]
        places_m = {"formation": ground_m - leader_m, "ground": ground_m}
        for root, place_m in places_m.items():
            self._send_places(root, times_s, place_m)
        if ends := list(self._trail_times.pick(times_s)):
            for root, place_m in places_m.items():
                self._send_trail(root, times_s[ends], place_m[ends])

    def _send_places(self, root: str, times_s: FloatArray, place_m: FloatArray) -> None:
        count, tree = place_m.shape[1], self._tree
        points = rr.Points3D.columns(positions=place_m.reshape(-1, 3)).partition([count] * times_s.size)
        self._columns(f"{root}/vehicles", times_s, points)
        if not tree.followers:
            return
        own_m, front_m = place_m[:, tree.followers], place_m[:, tree.fronts]
        wanted_m = front_m + tree.offsets_at_m(times_s)
        lengths = [len(tree.followers)] * times_s.size
        for name, end_m in (("follows", front_m), ("gaps", wanted_m)):
            lines = rr.LineStrips3D.columns(strips=_segments(own_m, end_m)).partition(lengths)
            self._columns(f"{root}/{name}", times_s, lines)
        centers = rr.Ellipsoids3D.columns(centers=wanted_m.reshape(-1, 3)).partition(lengths)
        self._columns(f"{root}/wanted", times_s, centers)

    def _send_trail(self, root: str, times_s: FloatArray, place_m: FloatArray) -> None:
        """Send the trail segments since the last call, each once; the view shows those of the last TRAIL_S."""
        ends_m = np.concatenate([self._trail_ends_m.get(root, place_m[:0]), place_m])
        self._trail_ends_m[root] = place_m[-1:]
        if (pieces := len(ends_m) - 1) > 0:
            strips = rr.LineStrips3D.columns(strips=_segments(ends_m[:-1], ends_m[1:]))
            self._columns(f"{root}/trails", times_s[-pieces:], strips.partition([place_m.shape[1]] * pieces))

    def _log_scene_styles(self) -> None:
        colors, few = scene.vehicle_colors(len(self._labels)), len(self._labels) <= LABELS_MAX
        own = [colors[k] for k in self._tree.followers]
        spacing_m = min((math.hypot(*offset) for offset in self._tree.offsets_m[:, :2]), default=1.0)
        ring_m = [0.06 * spacing_m, 0.06 * spacing_m, 0.0]
        points = rr.Points3D.from_fields(
            colors=colors, labels=self._labels, show_labels=few, radii=rr.Radius.ui_points(6.5 if few else 3.0)
        )
        wanted = rr.Ellipsoids3D.from_fields(
            half_sizes=[ring_m], colors=[PALE], line_radii=rr.Radius.ui_points(0.8), fill_mode="majorwireframe"
        )
        for root in ("formation", "ground"):
            self._stream.log(root, rr.ViewCoordinates.FRD, static=True)
            self._stream.log(f"{root}/vehicles", points, static=True)
            self._stream.log(f"{root}/wanted", wanted, static=True)
            for name, width, lines in (("trails", 1.0, colors), ("gaps", 1.5, own), ("follows", 0.7, [PALE])):
                strips = rr.LineStrips3D.from_fields(colors=lines, radii=rr.Radius.ui_points(width))
                self._stream.log(f"{root}/{name}", strips, static=True)

    def _log_plot_styles(self) -> None:
        def lines(path: str, names: list[str], colors: list[Color], width: float = 1.5) -> None:
            style = rr.SeriesLines(colors=colors, names=names, widths=[width] * len(names))
            self._stream.log(path, style, static=True)

        labels, colors = self._labels, scene.vehicle_colors(len(self._labels))
        followers = self._tree.followers
        lines("spacing/error_m", [labels[k] for k in followers], [colors[k] for k in followers])
        for path in _CURVES:
            lines(path, labels, colors)
        dimmed: list[Color] = [(r // 2 + 10, g // 2 + 10, b // 2 + 12) for r, g, b in colors]  # on the dark background
        lines("delay/rtt_ms", [f"{label} RTT" for label in labels], dimmed, 0.8)
        if self._predicts:
            lines("delay/assumed_ms", [f"{label} assumed" for label in labels], colors)
        lines("delay/margin_ms", [f"{label} margin" for label in labels], [LIMIT_COLOR] * len(labels), 3.5)
        for level in self._levels:
            lines(level.path, [level.name], [LIMIT_COLOR if level.limit else PALE], 3.5 if level.limit else 1.0)
        names = [mode.name for mode in Mode]
        lanes = rr.StateConfiguration(values=names, labels=names, colors=[scene.MODE_COLORS[mode] for mode in Mode])
        for label in labels:
            self._stream.log(f"modes/{label}", lanes, static=True)


def length_s(recording: Path) -> float | None:
    """The last scenario time (s) in a recording; None if nothing in it has a time."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a truncated file, the rest may suffice
        chunks = [chunk for chunk in RrdReader(recording).stream() if TIMELINE in chunk.timeline_names]
    columns = (chunk.to_record_batch().column(TIMELINE).cast("int64") for chunk in chunks)
    return max((1e-9 * time_ns for column in columns for time_ns in column.to_pylist()), default=None)


def viewer_client(address: str) -> Any:
    """A client that drives the Rerun viewer listening at an address."""
    return ViewerClient.connect(address)


def _levels(scenario: Scenario) -> list[Level]:
    """Reference lines for the curves, and lines at zero to keep it in view."""
    levels = [Level("delay/zero", "0", 0.0), Level("headroom/all", "100 %", 100.0)]
    levels.append(Level("headroom/none", "0 %: loop delay = margin", 0.0, limit=True))
    spacings_m = [math.hypot(*v.offset_ne_m) for v in scenario.vehicles if v.offset_ne_m is not None]
    settled_m = sorted({round(scenario.safety.settled_fraction * spacing_m, 6) for spacing_m in spacings_m})
    # If spacings have many lengths, only the least and the greatest bound are shown.
    ends_m = settled_m if len(settled_m) <= 2 else [settled_m[0], settled_m[-1]]
    return levels + [Level(f"spacing/settled_{k}_m", f"settled: < {end:.2f} m", end) for k, end in enumerate(ends_m)]


def _segments(start_m: FloatArray, end_m: FloatArray) -> Any:
    """Straight lines (lines, 2, 3) between start and end points of the same shape (..., 3)."""
    return np.stack([start_m, end_m], axis=-2).reshape(-1, 2, 3)


def _event_level(event: Event) -> str:
    """The log level of an event; for a change of mode, that of the new mode."""
    last = event.text.upper().split("->")[-1]
    if any(word in last for word in ("CRITICAL", "LOST", "FAILSAFE")):
        return "ERROR"
    return "WARN" if "CAUTION" in last else "INFO"


def _blueprint(scenario: Scenario, design: Design, *, following: bool) -> Any:
    """The screen layout: the scene with modes and events on the left, the plots on the right, the time panel below.

    With `following`, the cursor follows the newest time; without, it is paused.
    """

    # every plot shows the whole flight on the same time axis, wherever the cursor is, with room for a label at its end
    start, end = (rrb.TimeRangeBoundary.absolute(seconds=at_s) for at_s in (0.0, 1.03 * scenario.duration_s))
    whole = rrb.TimeAxis(view_range=rrb.TimeRange(start=start, end=end))

    def plot(name: str, *contents: str, legend: bool = False) -> Any:
        corner = rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend)
        return rrb.TimeSeriesView(name=name, origin="/", contents=list(contents), plot_legend=corner, axis_x=whole)

    named = (("sampled", design.delay_margin_s), ("continuous", design.delay_margin_continuous_s))
    known = ", ".join(f"{1e3 * s:.0f} ms {name}" for name, s in named if s is not None)
    margins = f"; of the fastest gains {known}" if known else ""
    few = len(scenario.vehicles) <= LEGEND_MAX
    predicts = scenario.control.prediction != "off"
    headroom = "mismatch / mismatch tolerated" if predicts else "loop delay / margin"
    events = rrb.TextLogColumns(
        timeline_columns=[TimelineColumn(timeline=TIMELINE, visible=False)],  # the text has the time, even before 0
        text_log_columns=[TextLogColumn(kind="loglevel"), TextLogColumn(kind="body")],
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Tabs(_scene_view("formation", scenario), _scene_view("ground", scenario)),
                rrb.Horizontal(
                    rrb.StateTimelineView(name="Modes", origin="/modes"),
                    rrb.TextLogView(name="Events", origin="/events", columns=events),
                    column_shares=[2, 3],
                ),
                row_shares=[11, 6],
            ),
            rrb.Vertical(
                plot("Spacing errors [m]", "/spacing/**", legend=few),
                plot(f"Loop delay, RTT (dim), margin (red{margins}) [ms]", "/delay/**"),
                plot(f"Headroom: 1 − {headroom} [%]", "/headroom/**"),
                rrb.Tabs(
                    plot("Command north [m/s²]", "/command/north_m_s2"),
                    plot("Command east [m/s²]", "/command/east_m_s2"),
                ),
                row_shares=[3, 3, 2, 2],
            ),
            column_shares=[1, 1],
        ),
        rrb.TimePanel(timeline=TIMELINE, expanded=False, play_state="following" if following else "paused"),
        rrb.SelectionPanel(expanded=False),
        rrb.BlueprintPanel(expanded=False),
    )


def _scene_view(root: str, scenario: Scenario) -> Any:
    """A 3D view from behind and above, far enough away to show the whole formation in its places."""
    place_m = plan_formation(scenario).place_ne_m()
    lowest_m, highest_m = place_m.min(axis=0), place_m.max(axis=0)
    middle_m, reach_m = (lowest_m + highest_m) / 2, (highest_m - lowest_m) / 2
    # The southern end of a formation that is long from north to south is near the eye, so it needs more distance.
    radius_m = max(math.hypot(*reach_m), 1.4 * reach_m[0]) or 50.0
    if root == "formation":
        name, tracked, down_m = "Formation, seen from the leader, north up [m]", None, 0.0
    else:
        name, tracked, down_m = "Over the ground, local NED [m]", "/ground/vehicles", -scenario.altitude_m
    trails = rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    return rrb.Spatial3DView(
        name=name,
        origin=f"/{root}",
        background=(18, 20, 26),
        eye_controls=rrb.EyeControls3D(
            position=(middle_m[0] - 1.1 * radius_m, middle_m[1], down_m - 1.35 * radius_m),
            look_target=(middle_m[0] - 0.18 * reach_m[0], middle_m[1], down_m),
            eye_up=(0.0, 0.0, -1.0),
            tracking_entity=tracked,
        ),
        line_grid=rrb.LineGrid3D(visible=True, spacing=10.0 ** round(math.log10(radius_m / 1.5)), color=(60, 66, 78)),
        overrides={f"/{root}/trails": rrb.VisibleTimeRanges([trails])},
    )
