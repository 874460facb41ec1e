"""A trial, one flight of a formation under given conditions, and its outcome: what it says about stability.

Both can be pickled. `gcs.stress.measure` flies trials.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from gains.core.arrays import FloatArray
from gcs.control.tick import TickArray, chosen
from gcs.drive.flown import Flight
from gcs.plan.flight_plan import FlightPlan, Responses
from gcs.plan.formation import plan_formation
from gcs.plan.loops import unlimited
from gcs.plan.own_law import law_of
from gcs.runs.summary import control_of, judge
from gcs.runs.summary_record import rounded
from scenarios.schema import Scenario

Kind = Literal["probe", "own"]
CRITICAL = 0
"""Stands for a system id: probe the loop that is predicted to break first."""

TRACE_PERIOD_S = 0.25


@dataclass(frozen=True)
class Trial:
    """Everything a trial depends on, and its `coordinates` in the campaign, which do not affect the flight.

    `gain` holds the nonzero entries (row, column, value) of K. `probe` is the system id of a vehicle in the loop to be
    probed, or `CRITICAL`. `responses` were identified before the campaign, or given.
    """

    scenario: Scenario
    gain: tuple[tuple[int, int, float], ...]
    delay_margin_s: float
    kind: Kind
    probe: int = CRITICAL
    real_time: bool = False
    coordinates: tuple[tuple[str, float], ...] = ()
    responses: Responses | None = None

    @cached_property
    def id(self) -> str:
        """A hash of the inputs: the same trial has the same id anywhere."""
        inputs = [self.scenario.model_dump(mode="json"), self.gain, self.delay_margin_s, self.kind, self.probe]
        known = self.responses
        found = [] if known is None or known.source == "given" else [{k: asdict(own) for k, own in known.of.items()}]
        text = json.dumps([*inputs, self.real_time, *found], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]


@dataclass(frozen=True)
class Outcome:
    """The outcome of a trial: one row of the campaign's table. None where a value is unknown or does not apply.

    `verdict` is that of the whole flight for an own trial. For a probe it follows from the sign of the growth rate.
    A probe without a growth rate is "aborted" if its flight was, else "unknown", even if its errors broke a limit.
    `probed` is the first vehicle of the measured loop. That loop stands in for the loop of vehicle `critical`, of
    several that share it the slowest or the one whose link alone was slowed, with the same wait for the control tick
    (`waiting_s`). `loop_delay_s` is the effective loop delay over the window of the fit (see `gains.sampled.multirate`;
    on constant links every command has it); for an own trial it is the measured median. `loop_delay_spread_s` is the
    90th percentile of the measured loop delays minus their median. `predicted_*` are the models' growth rates at
    `loop_delay_s`. The growth of an own trial is that of the envelope of all spacing errors, a rough figure.
    `ticks_sha256` is the hash of the tick log in virtual time; it is the same in any process. `past_limits` says that
    random links alone, without any initial error, push vehicles past the scenario's limits; a probe is flown without
    these limits. `trace_m` is the largest spacing error of all vehicles, every `trace_period_s`. `error` holds a
    traceback if the trial failed.
    """

    id: str
    kind: Kind
    seed: int
    coordinates: dict[str, float]
    real_time: bool
    probe: int = CRITICAL
    probed: int | None = None
    critical: int | None = None
    verdict: str | None = None
    reason: str | None = None
    growth_1_s: float | None = None
    growth_error_1_s: float | None = None
    frequency_rad_s: float | None = None
    predicted_growth_1_s: float | None = None
    predicted_growth_continuous_1_s: float | None = None
    loop_delay_s: float | None = None
    loop_delay_spread_s: float | None = None
    link_delay_s: float | None = None
    waiting_s: float | None = None
    fit_start_s: float | None = None
    fit_end_s: float | None = None
    fit_samples: int | None = None
    amplitude_m: float | None = None
    spacing_error_max_m: float | None = None
    spacing_error_final_m: float | None = None
    lateness_s_p50: float | None = None
    lateness_s_p99: float | None = None
    steal_share: float | None = None
    busy_share: float | None = None
    past_limits: bool = False
    ticks_sha256: str | None = None
    trace_period_s: float = TRACE_PERIOD_S
    trace_m: list[float] = field(default_factory=list[float])
    elapsed_s: float = 0.0
    error: str | None = None


Run = Callable[[Sequence[Trial]], list[Outcome]]
"""Returns the outcomes of trials in their order; flies those that are not stored."""


def sparse_gain(K: FloatArray) -> tuple[tuple[int, int, float], ...]:
    """The nonzero entries of K, as in `Trial.gain`."""
    return tuple((int(i), int(j), float(K[i, j])) for i, j in np.argwhere(K != 0.0))


def plan_of(trial: Trial) -> FlightPlan:
    """The flight plan of a trial, before the changes that a probe makes."""
    formation = plan_formation(trial.scenario)
    K = np.zeros((formation.model.inputs, formation.model.states))
    for row, column, value in trial.gain:
        K[row, column] = value
    scenario = trial.scenario.with_calm_monitor()
    law = law_of(scenario)
    separable = len(formation.model.coupled_vehicles(K)) == formation.model.vehicles
    plan = FlightPlan(
        scenario, formation, K, trial.delay_margin_s, separable=separable, responses=trial.responses, law=law
    )
    return replace(plan, own_margins_s=unlimited(plan))


def with_verdict(plan: FlightPlan, flight: Flight, outcome: Outcome) -> Outcome:
    """The outcome with the verdict of the flight, its spacing errors and the driver's lateness."""
    judged = judge(plan.scenario, flight.ticks, flight.events)
    lateness_s = control_of(plan.scenario, judged.flown).lateness_s
    return replace(
        outcome,
        verdict=judged.verdict,
        reason=judged.reason,
        spacing_error_max_m=rounded(max((most_m for most_m, _ in judged.spacing_errors_m), default=None)),
        spacing_error_final_m=rounded(max((last_m for _, last_m in judged.spacing_errors_m), default=None)),
        lateness_s_p50=lateness_s.p50,
        lateness_s_p99=lateness_s.p99,
        steal_share=flight.steal_share,
        busy_share=flight.busy_share,
        ticks_sha256=None if outcome.real_time else hashlib.sha256(flight.ticks.view(np.uint8).data).hexdigest(),
        trace_m=_trace(flight.ticks),
    )


def _trace(ticks: TickArray) -> list[float]:
    """The largest spacing error of all vehicles in each `TRACE_PERIOD_S` of the flight, to four digits."""
    last = ticks["tick"][ticks["commanded"]].max(initial=-1)
    rows = chosen(ticks, (ticks["time_s"] >= 0.0) & (ticks["tick"] <= last))
    error = np.hypot(rows["spacing_error_north_m"], rows["spacing_error_east_m"])
    times_s, error = rows["time_s"][np.isfinite(error)], error[np.isfinite(error)]
    if not error.size:
        return []
    stretch = (times_s / TRACE_PERIOD_S).astype(np.int64)
    largest = np.zeros(int(stretch.max()) + 1)
    np.maximum.at(largest, stretch, error)
    return [float(f"{value:.4g}") for value in largest]
