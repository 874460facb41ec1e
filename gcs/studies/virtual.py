"""Flights in virtual time from Python: takes a scenario, and returns the flight's design, verdict and record."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gains.core.arrays import FloatArray
from gcs.control.tick import Event, TickArray, in_sequence
from gcs.drive.lockstep import START_NS, fly_lockstep
from gcs.errors import InputError
from gcs.plan.design import Design
from gcs.plan.planner import described, flight_plan, over_own_links
from gcs.preflight.faults import bad_start, endless_link, unstable_loop, without_actions
from gcs.runs.record import END
from gcs.runs.summary import summarise
from gcs.runs.summary_record import Summary
from gcs.station.station import Station
from gcs.watch.before_flight import measured_now
from gcs.watch.for_link import best_for
from scenarios.files import load
from scenarios.own_code import refusal
from scenarios.schema import Scenario
from scenarios.shipped import located


@dataclass(frozen=True, eq=False)
class VirtualFlight:
    """A flight in virtual time. Arrays have one row for each control tick and one column for each vehicle.

    Values that the station does not know are NaN: for example, the leader has no spacing error.
    """

    scenario: Scenario
    design: Design
    """As in design.json."""
    summary: Summary
    """As in summary.json: `summary.verdict`, `summary.headroom_min`, `summary.vehicles` and so on."""
    ticks: TickArray
    """The whole record, shape (ticks, vehicles); its fields are the columns of ticks.parquet."""
    events: tuple[Event, ...]

    @property
    def system_ids(self) -> tuple[int, ...]:
        """The vehicles, in the order of the columns."""
        return tuple(self.ticks["system_id"][0].tolist())

    @property
    def time_s(self) -> FloatArray:
        """Scenario time, shape (ticks,); negative before the formation flight begins."""
        return self.ticks["time_s"][:, 0]

    @property
    def position_ne_m(self) -> FloatArray:
        """Reported positions, local NED, shape (ticks, vehicles, 2)."""
        return self._north_east("{}_m")

    @property
    def velocity_ne_m_s(self) -> FloatArray:
        """Reported velocities, shape (ticks, vehicles, 2)."""
        return self._north_east("velocity_{}_m_s")

    @property
    def spacing_error_ne_m(self) -> FloatArray:
        """Spacing errors, shape (ticks, vehicles, 2)."""
        return self._north_east("spacing_error_{}_m")

    @property
    def command_ne_m_s2(self) -> FloatArray:
        """Accelerations sent, shape (ticks, vehicles, 2)."""
        return self._north_east("command_{}_m_s2")

    @property
    def loop_delay_s(self) -> FloatArray:
        """Measured loop delays, shape (ticks, vehicles)."""
        return self.ticks["loop_delay_s"]

    @property
    def headroom(self) -> FloatArray:
        """1 - loop delay / delay margin, shape (ticks, vehicles)."""
        return self.ticks["headroom"]

    def table(self) -> Any:
        """The record as a pyarrow.Table, one row for each tick and vehicle.

        `flight.table().to_pandas()` and `polars.from_arrow(flight.table())` make data frames of it.
        """
        import pyarrow as pa

        rows = self.ticks.ravel()
        return pa.table({name: np.ascontiguousarray(rows[name]) for name in rows.dtype.names or ()})

    def _north_east(self, name: str) -> FloatArray:
        return np.stack([self.ticks[name.format(axis)] for axis in ("north", "east")], axis=-1)


def load_scenario(scenario: Path | str) -> Scenario:
    """The scenario in a file, or a shipped one by name. Raises scenarios.errors.ScenarioError if there is neither."""
    return load(located(str(scenario)))


def fly_virtual(
    scenario: Scenario | Path | str, *, allow_unstable: bool = False, allow_code: bool = False
) -> VirtualFlight:
    """Fly a scenario in virtual time: real MAVLink bytes, emulated links, no sockets, no files.

    `scenario` is a scenario, its file, or the name of a shipped one (`gcs scenarios`). `allow_unstable` flies gains
    whose loop is unstable even without delay, and `allow_code` runs the Python code that a scenario names. Vehicles
    that share a loop over different links have the margin over these links (`gcs.plan.planner`).

    Raises scenarios.errors.ScenarioError if the file is not a scenario, gcs.errors.InputError if `gcs fly` would refuse
    it, and gains.GainsError if its requirement cannot be met.

    >>> flight = fly_virtual("chain3")
    >>> flight.summary.verdict, flight.spacing_error_ne_m.shape[1:]
    ('stable', (3, 2))
    """
    if not isinstance(scenario, Scenario):
        scenario = load_scenario(scenario)
    if not allow_code and (refused := refusal(scenario, Path(scenario.name))):
        raise InputError(refused)
    if fault := bad_start(scenario) or endless_link(scenario):
        raise InputError(f"{scenario.name}: {fault}")
    measured = None
    if scenario.control.for_link == "measured":
        delays = measured_now(scenario, None, start_vehicles=False, key_file=None, shown=False)
        scenario, measured = best_for(scenario, delays)
    design, plan = flight_plan(scenario, measured)
    if (unstable := unstable_loop(plan)) is not None:
        if not allow_unstable:
            raise InputError(f"{scenario.name}: {unstable}")
        plan = without_actions(plan)
    else:
        design, plan = over_own_links(design, plan)
    station = Station(plan, start_ns=START_NS)
    ticks = in_sequence([*fly_lockstep(plan, station=station, ahead=True)]).reshape(-1, len(station.vehicles))
    if station.plan is not plan:
        design = described(design, station.plan)
    events = (*station.events, Event(time_s=float(ticks["time_s"][-1, 0]), kind=END, text=station.end_reason))
    return VirtualFlight(scenario, design, summarise(scenario, design, ticks.ravel(), events), ticks, events)
