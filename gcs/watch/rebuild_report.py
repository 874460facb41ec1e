"""Makes the summary of a telemetry log that `gcs replay` shows."""

from collections.abc import Callable
from dataclasses import dataclass
from math import hypot
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
from pydantic import PlainSerializer

from gcs.control.tick import Event, TickArray
from gcs.errors import InputError
from gcs.plan.design import Design
from gcs.published import Published
from gcs.runs.files import read_design, read_summary
from gcs.runs.record import DESIGN_FILE, END, SCENARIO_FILE, SUMMARY_FILE, TLOG_FILE, tlog_file
from gcs.runs.summary import summarise
from gcs.runs.summary_record import Summary
from gcs.station.absence import end_reason
from gcs.station.breakage import too_far
from gcs.watch.links import LinkFigures
from gcs.watch.rebuild import Rebuilt, rebuild, watched
from gcs.watch.tlog import TelemetryLog
from scenarios import files
from scenarios.schema import Scenario

_COMPARED = {"verdict", "loop", "delay_margin_s", "loop_delay_s", "headroom_min", "settling_time_s", "distance_min_m"}

_Found = TypeVar("_Found")


@dataclass(frozen=True)
class LogSource:
    """A telemetry log and the contents of the files beside it; None for each file that is missing."""

    log_file: Path
    scenario: Scenario | None
    design: Design | None
    recorded: Summary | None
    """The summary of the run that wrote the log."""


def find_log(run_or_file: Path) -> LogSource:
    """A log, with the files beside it if it is a run's only log.

    Raises InputError for the folder of a run in several networks, which has a log for each.
    """
    log_file = run_or_file / TLOG_FILE if run_or_file.is_dir() else run_or_file
    others = sorted(log_file.parent.glob(tlog_file("*")))
    if run_or_file.is_dir() and others:
        raise InputError(
            f"{run_or_file}: read a telemetry log for each network ({', '.join(file.name for file in others)}), wanted "
            "a run of network 0 alone, or one of its logs"
        )

    def beside(name: str, read: Callable[[Path], _Found]) -> _Found | None:
        file = log_file.with_name(name)
        return read(file) if log_file.name == TLOG_FILE and not others and file.exists() else None

    scenario, design = beside(SCENARIO_FILE, files.load), beside(DESIGN_FILE, read_design)
    return LogSource(log_file, scenario, design, beside(SUMMARY_FILE, read_summary))


class LogContents(Published):
    """How much of a log could be read."""

    file: str
    frames: int
    duration_s: float
    left_out: dict[str, int]


class RebuildReport(Published):
    """The summary of a log: its links, and the flight if the scenario is known."""

    log: LogContents
    delay_margin_s: float | None
    stations: tuple[int, ...]
    links: tuple[LinkFigures, ...]
    flight: Summary | None = None
    recorded: Annotated[Summary, PlainSerializer(lambda s: s.model_dump(mode="json", include=_COMPARED))] | None = None
    """The station's own summary of the same flight."""


def rebuild_report(log: TelemetryLog, source: LogSource) -> RebuildReport:
    """The summary of a log; for one in a run's folder, with the figures recorded in flight."""
    first_ns, last_ns = log.frames[0][0], log.frames[-1][0]
    scenario, design = source.scenario, source.design or Design(delay_margin_s=None)
    rebuilt = None if scenario is None else rebuild(log.frames, scenario, design)
    watch = watched(log.frames) if rebuilt is None else rebuilt.links
    flight = None if rebuilt is None or scenario is None else _flight(scenario, design, rebuilt)
    parts = {"flight": flight, "recorded": source.recorded}
    return RebuildReport(
        log=LogContents(
            file=str(source.log_file),
            frames=len(log.frames),
            duration_s=(last_ns - first_ns) * 1e-9,
            left_out=dict(log.counters + watch.counters),
        ),
        delay_margin_s=design.delay_margin_s,
        stations=tuple(sorted(watch.stations)),
        links=tuple(watch.figures(last_ns, design)),
        **{name: part for name, part in parts.items() if part is not None},
    )


def _flight(scenario: Scenario, design: Design, rebuilt: Rebuilt) -> Summary:
    end = Event(time_s=0.0, kind=END, text=_reason(scenario, rebuilt))
    summary = summarise(scenario, design, rebuilt.ticks, [*rebuilt.events, end])
    if rebuilt.own:
        return summary
    return summary.model_copy(update={"verdict": "not judged", "settling_time_s": None, "control": None})


def _reason(scenario: Scenario, rebuilt: Rebuilt) -> str:
    """Why the flight ended, judged by its last tick."""
    flown = rebuilt.ticks[rebuilt.ticks["commanded"] & (rebuilt.ticks["time_s"] >= 0)]
    if not rebuilt.own:
        return "the log has no set-points of this station"
    if not flown.size:
        return "nothing was flown"
    last = flown[flown["tick"] == flown["tick"][-1]]
    if broken := _broken(scenario, last):
        return broken
    known = {vehicle.system_id for vehicle in scenario.vehicles} - {scenario.external_id}
    left = sorted(known - set(last["system_id"].tolist()) - rebuilt.grounded.keys())
    if left:
        return f"vehicles {', '.join(map(str, left))} are sent nothing at the end"  # lost, or flown by their pilots
    end_s = float(last["time_s"][0])
    if end_s < scenario.duration_s - 1.5 / scenario.rates.control_hz:
        return f"interrupted: set-points end after {end_s:.1f} s of {scenario.duration_s:g} s"
    vehicles = [watched.remote for watched in rebuilt.links.vehicles.values()]
    return end_reason(vehicles, [rebuilt.grounded.get(vehicle.system_id, "") for vehicle in vehicles])


def _broken(scenario: Scenario, last: TickArray) -> str:
    """The first safety limit that the last tick violates, as a reason to end the flight; "" if none."""
    closest_m, limit_m = float(np.fmin.reduce(last["nearest_m"])), scenario.safety.spacing_error_limit_m
    if closest_m < scenario.safety.collision_distance_m:
        two = " and ".join(map(str, sorted(last["system_id"][last["nearest_m"] == closest_m].tolist())))
        return f"broken: vehicles {two} have collided, {closest_m:.1f} m apart"
    for row in last:
        error_m = hypot(row["spacing_error_north_m"], row["spacing_error_east_m"])
        if error_m > limit_m:
            return too_far(row["system_id"], error_m, limit_m)
    return ""
