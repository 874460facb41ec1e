"""The free response of one loop, as flown: what its errors do after it alone was disturbed.

On constant links one flight shows it, see `gcs.stress.probe`. Links that lose or delay at random push the vehicles all
the time, by what the station knows wrongly of clocks and instants, and errors travel down the chain. But the loops are
linear and the links draw the same delays whatever they carry. So the formation is flown twice with the same seed, in
place and with one loop disturbed, and the difference of the two flights is the free response of that loop through the
delays that were drawn, with everything else gone to the last digit of telemetry.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gains.core.arrays import IntArray
from gcs.control.tick import TickArray
from gcs.drive.flown import Flight, fly_plan, fly_virtual, median_delays_s
from gcs.plan.flight_plan import FlightPlan
from gcs.runs.effective_delay import commands_of, commands_on_board, effective_delay_s
from gcs.stress.axes import has_constant_links
from gcs.stress.growth import CHANNELS
from gcs.stress.probe import in_place, linear_until_s
from scenarios.schema import Scenario

_LINEAR_SHARE = 0.8
"""Part of the nominal speed that an error may reach: the vehicles' linearisation is exact, but not at speed zero."""


@dataclass(frozen=True, eq=False)
class FreeResponse:
    """Errors of one loop's vehicles in rows of ticks, in order of time, with the flight that they are from.

    Up to `until_s` after the first row no limit and no singularity was near; the same of the calm flight of a pair,
    which no smaller disturbance outlasts, is `calm_until_s`. `varying` says that the delays vary.
    """

    plan: FlightPlan
    flight: Flight
    errors: TickArray
    until_s: float
    varying: bool = False
    calm_until_s: float = np.inf

    def loop_delays_s(self, rows: TickArray, system_ids: tuple[int, ...]) -> dict[int, float]:
        """Loop delays in some of the rows: the effective ones where the truth is known, else the measured medians."""
        if self.flight.truth is None:
            return median_delays_s(rows, system_ids)
        return effective_delays_s(self.plan, rows, self.flight, system_ids)


def response_alone(
    plan: FlightPlan, scenario: Scenario, system_ids: tuple[int, ...], *, real_time: bool, folder: Path | None
) -> FreeResponse:
    """Fly a probe's scenario, see `gcs.stress.probe.probe_scenario`."""
    probe = replace(plan, scenario=scenario)
    # loop delays that differ from command to command count with their mean, which only the truth has exactly
    flight = fly_plan(probe, real_time=real_time, folder=folder, with_truth=plan.timing.commands > 1)
    errors = _rows_of(flight.ticks, system_ids)
    return FreeResponse(probe, flight, errors, linear_until_s(scenario, errors, share=_LINEAR_SHARE))


def fly_calm(plan: FlightPlan, folder: Path | None) -> Flight:
    """The formation in place on the scenario's own links: the first flight of a pair."""
    return fly_virtual(replace(plan, scenario=in_place(plan, (), amplitude=0.0)), folder, with_truth=True)


def response_paired(
    plan: FlightPlan, calm: Flight, system_ids: tuple[int, ...], *, amplitude: float, folder: Path | None
) -> FreeResponse:
    """Fly the second of a pair, with an error of the given vehicles, and take the first from it."""
    disturbed = replace(plan, scenario=in_place(plan, system_ids, amplitude=amplitude))
    flight = fly_virtual(disturbed, folder, with_truth=True)
    rows, calm_rows = _rows_of(flight.ticks, system_ids), _rows_of(calm.ticks, system_ids)
    count = _alike(rows, calm_rows)
    rows, calm_rows = rows[:count], calm_rows[:count]
    until_s, calm_until_s = (
        linear_until_s(disturbed.scenario, each, share=_LINEAR_SHARE) for each in (rows, calm_rows)
    )
    errors = rows.copy()
    for name in CHANNELS:
        errors[name] -= calm_rows[name]
    varying = not has_constant_links(plan.scenario)
    return FreeResponse(disturbed, flight, errors, min(until_s, calm_until_s), varying, calm_until_s)


def effective_delays_s(
    plan: FlightPlan, rows: TickArray, flight: Flight, system_ids: tuple[int, ...]
) -> dict[int, float]:
    """The constant loop delay that each vehicle's commands in these rows stand for."""
    truth = flight.truth
    assert truth is not None
    whole = flight.ticks[np.isin(flight.ticks["tick"], rows["tick"])]
    on_board, held_s = plan.scenario.control.loop == "onboard", plan.timing.held_s

    def commands(system_id: int) -> IntArray:
        return commands_on_board(whole, truth, system_id) if on_board else commands_of(rows, truth, system_id)

    return {system_id: effective_delay_s(commands(system_id), held_s=held_s) for system_id in system_ids}


def _rows_of(ticks: TickArray, system_ids: tuple[int, ...]) -> TickArray:
    return ticks[np.isin(ticks["system_id"], system_ids) & ticks["commanded"] & (ticks["time_s"] >= 0.0)]


def _alike(rows: TickArray, others: TickArray) -> int:
    """How many rows from the first on are of the same ticks and used the same states: until one flight broke."""
    count = min(len(rows), len(others))
    same = np.ones(count, dtype=bool)
    for name in ("tick", "system_id", "sample_boot_ms"):
        same &= rows[name][:count] == others[name][:count]
    return count if same.all() else int(np.argmin(same))
