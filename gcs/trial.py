"""One trial: a formation flown once, and what that says of its stability. Pure, and picklable both ways.

A *probe* measures the growth rate of one loop, see `gcs.probe`. An *own* trial flies the scenario's own initial states,
large errors and all, and gives the verdict that `gcs fly` would give. In both the monitor only watches: the margin of
the designed gains is on trial, not what is done before it is reached.
"""

import hashlib
import json
import time  # noqa: TID251 - the time a trial takes is for the progress bar and the report; nothing flown depends on it
import traceback
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from gcs.growth import FOLLOWER_MODES, FloatArray, Growth, envelope_growth, fit_growth, motion_of
from gcs.lockstep import START_NS, fly_lockstep
from gcs.onset import Loop, critical_loop, loops_of
from gcs.plan import FlightPlan, plan_formation
from gcs.probe import PROBE_S, linear_until_s, probe_scenario
from gcs.record import DESIGN_FILE, SCENARIO_FILE, RunWriter, TickArray
from gcs.station import Station
from gcs.summary import summarise
from scenarios import files as scenario_files
from scenarios.schema import Scenario

Kind = Literal["probe", "own"]
CRITICAL = 0
"""In place of a system id: probe the loop that is predicted to be the first to break."""

AMPLITUDES = (1.0, 0.03, 0.001)
"""Initial error of a probe in m (the leader's in m/s); the next is for growth that leaves the linear range too soon."""
_PILOT_S = 1.0
_SETTLED_LOOP_DELAYS = 4.0
"""Modes other than the slowest are gone, or small enough to be fitted along, after this many loop delays."""
_BEGUN_LOOP_DELAYS = 2.0
"""Nothing that a vehicle did at the start is left to be acted on after this many."""
_WANTED_LOOP_DELAYS = 8.0
_WANTED_SAMPLES = 60
_WANTED_ERROR = 0.01
"""Standard error of a growth rate as a share of it: with several vehicles in a loop other modes take long to go."""
_TRACE_PERIOD_S = 0.25


@dataclass(frozen=True)
class Trial:
    """Everything a trial depends on. `coordinates` say where it stands in a campaign, and have no effect on it.

    `gain` holds the entries (row, column, value) of K that are not zero, `probe` the system id of a vehicle of the loop
    to be probed, or `CRITICAL`.
    """

    scenario: Scenario
    gain: tuple[tuple[int, int, float], ...]
    delay_margin_s: float
    kind: Kind
    probe: int = CRITICAL
    real_time: bool = False
    coordinates: tuple[tuple[str, float], ...] = ()

    @cached_property
    def id(self) -> str:
        """A hash of the inputs: the same trial has the same id anywhere."""
        inputs = [self.scenario.model_dump(mode="json"), self.gain, self.delay_margin_s, self.kind, self.probe]
        text = json.dumps([*inputs, self.real_time], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]


@dataclass(frozen=True)
class Outcome:
    """What came out of a trial: one row of the campaign's table. None where it is unknown or does not apply.

    `verdict` is that of the whole flight for an own trial, the sign of the growth rate for a probe. `probed` is the
    first vehicle of the loop that was measured; it stands for the loop of vehicle `critical`, whose `waiting_s` for
    the control tick it has. `loop_delay_s` is its median over the window of the fit, `loop_delay_spread_s` by how
    much the 90th percentile is above it; for an own trial its median in flight. `predicted_*` are the models' growth
    rates at that delay. The growth of an own trial is that of the envelope of all spacing errors, which is rough.
    `trace_m` is the largest spacing error of all vehicles, every `trace_period_s`. `error` holds a traceback if the
    trial itself failed.
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
    trace_period_s: float = _TRACE_PERIOD_S
    trace_m: list[float] = field(default_factory=list[float])
    elapsed_s: float = 0.0
    error: str | None = None

    def to_json(self) -> str:
        """One line."""
        return json.dumps(asdict(self), allow_nan=False)

    @classmethod
    def from_json(cls, line: str) -> Self:
        return cls(**json.loads(line))


@dataclass(frozen=True, eq=False)
class Flight:
    """A flight's log, whichever clock it was flown on."""

    ticks: TickArray
    events: list[dict[str, Any]]


def sparse_gain(K: FloatArray) -> tuple[tuple[int, int, float], ...]:
    """The entries of K that are not zero, as `Trial.gain` wants them."""
    return tuple((int(i), int(j), float(K[i, j])) for i, j in np.argwhere(K != 0.0))


def plan_of(trial: Trial) -> FlightPlan:
    """The plan of a trial as given, without the changes that a probe makes."""
    formation = plan_formation(trial.scenario)
    n = len(formation.system_ids)
    K = np.zeros((2 * n, 4 * n - 2))
    for row, column, value in trial.gain:
        K[row, column] = value
    calm = trial.scenario.monitor.model_copy(update={"act": False})
    scenario = trial.scenario.model_copy(update={"monitor": calm})
    return FlightPlan(scenario, formation, K, trial.delay_margin_s)


def plan_loops(plan: FlightPlan) -> list[Loop]:
    """The loops of a plan at its control period."""
    predecessors, system_ids = plan.formation.predecessor.tolist(), plan.formation.system_ids
    return loops_of(predecessors, system_ids, plan.gain, period_s=1.0 / plan.scenario.rates.control_hz)


def fly_trial(trial: Trial, folder: Path | None = None) -> Outcome:
    """Fly a trial and judge it; never raises: what it meets is in the outcome's `error`.

    With `folder` the files of its flight are left there as `gcs fly` leaves them, for a probe in one folder for each
    size of the initial error that was needed. In real time they are written anyway, and go again without `folder`.
    """
    began_s = time.perf_counter()
    outcome = Outcome(
        id=trial.id,
        kind=trial.kind,
        seed=trial.scenario.seed,
        coordinates=dict(trial.coordinates),
        real_time=trial.real_time,
        probe=trial.probe,
    )
    try:
        outcome = (_probe if trial.kind == "probe" else _own)(trial, outcome, folder)
    except Exception:  # noqa: BLE001 - a campaign of thousands goes on; what happened is recorded with its inputs
        outcome = replace(outcome, error=traceback.format_exc())
    return replace(outcome, elapsed_s=round(time.perf_counter() - began_s, 3))


def _own(trial: Trial, outcome: Outcome, folder: Path | None) -> Outcome:
    plan = plan_of(trial)
    flight, outcome = _fly(plan, trial, outcome, folder)
    outcome = _with_summary(plan, flight, outcome)
    flown = flight.ticks[flight.ticks["time_s"] >= 0.0]
    delays_s = _median_delays(flown, plan.formation.system_ids)
    loop = critical_loop(plan_loops(plan), delays_s)
    slowest = max(loop.system_ids, key=lambda system_id: delays_s[system_id])
    up, down = plan.scenario.link_of(slowest)
    outcome = replace(
        outcome,
        critical=loop.system_ids[0],
        link_delay_s=up.delay_s + down.delay_s,
        loop_delay_s=round(delays_s[slowest], 9),
        predicted_growth_1_s=_finite(loop.growth_1_s(delays_s[slowest])),
        predicted_growth_continuous_1_s=_finite(loop.growth_continuous_1_s(delays_s[slowest])),
    )
    start_s = _BEGUN_LOOP_DELAYS * delays_s[slowest]
    growth = envelope_growth(np.array(outcome.trace_m), period_s=_TRACE_PERIOD_S, start_s=start_s)
    return outcome if growth is None else _with_fit(outcome, growth)


def _probe(trial: Trial, outcome: Outcome, folder: Path | None) -> Outcome:
    base = plan_of(trial)
    pilot = fly_virtual(replace(base, scenario=base.scenario.model_copy(update={"duration_s": _PILOT_S})))
    probed, critical, waiting_s = _choose(base, _median_delays(pilot.ticks, base.formation.system_ids), trial.probe)
    up, down = links = base.scenario.link_of(critical.system_ids[0])
    outcome = replace(
        outcome,
        probed=probed.system_ids[0],
        critical=critical.system_ids[0],
        link_delay_s=up.delay_s + down.delay_s,
        waiting_s=round(waiting_s, 9),
    )
    for amplitude in AMPLITUDES:
        scenario = probe_scenario(base, probed.system_ids, amplitude=amplitude, links=links, waiting_s=waiting_s)
        plan = replace(base, scenario=scenario)
        flight, flown = _fly(plan, trial, outcome, None if folder is None else folder / f"error-{amplitude:g}-m")
        outcome = _with_growth(plan, probed, flight, replace(flown, amplitude_m=amplitude))
        outcome = _with_summary(plan, flight, outcome)
        if outcome.growth_1_s is not None:
            outcome = replace(outcome, verdict="unstable" if outcome.growth_1_s > 0.0 else "stable")
        if not _left_linear_range_too_soon(outcome):
            break
    return outcome


def _choose(plan: FlightPlan, loop_delay_s: dict[int, float], probe: int) -> tuple[Loop, Loop, float]:
    """The loop to be probed, the loop it stands for, and the waiting of the latter for the control tick.

    The first to break may be far down the tree, where whatever moves ahead of it would drive it, so the same loop
    nearest to the leader is probed for it, with its links and its waiting.
    """
    loops, links = plan_loops(plan), plan.scenario.links
    if probe == CRITICAL:
        critical = critical_loop(loops, loop_delay_s)
        probed = next(loop for loop in loops if loop.same_as(critical))
    else:
        probed = critical = next(loop for loop in loops if probe in loop.system_ids)
    slowest = max(critical.system_ids, key=lambda system_id: loop_delay_s[system_id])
    up, down = links.of(slowest)
    return probed, critical, (loop_delay_s[slowest] - up.delay_s - down.delay_s) % critical.period_s


def fly_virtual(plan: FlightPlan, folder: Path | None = None) -> Flight:
    """Fly a plan in virtual time; with a folder, which is made, its files are left there but for the summary."""
    station = Station(plan, start_ns=START_NS)
    writer = prepared_folder(plan, folder) if folder is not None else None
    rows: list[TickArray] = []
    for tick in fly_lockstep(plan, station=station):
        rows.append(tick)
        if writer is not None:
            writer.tick(tick)
            writer.frames(station.frames)
    events: list[dict[str, Any]] = [event._asdict() for event in station.events]
    events.append({"time_s": float(rows[-1]["time_s"][0]), "kind": "end", "text": station.end_reason})
    if writer is not None:
        for event in events:
            writer.event(**event)
        writer.close()
    return Flight(np.concatenate(rows), events)


def margins_of(plan: FlightPlan) -> dict[str, Any]:
    """The part of a design that a run's files need; what the continuous model says is in the campaign's report."""
    return {"delay_margin_s": plan.delay_margin_s, "delay_margin_continuous_s": None}


def prepared_folder(plan: FlightPlan, folder: Path) -> RunWriter:
    """A new run folder with its scenario and margins, and the writer of its logs."""
    folder.mkdir(parents=True)
    (folder / SCENARIO_FILE).write_text(scenario_files.dump(plan.scenario), encoding="utf-8")
    (folder / DESIGN_FILE).write_text(json.dumps(margins_of(plan), indent=2), encoding="utf-8")
    return RunWriter(folder)


def _fly(plan: FlightPlan, trial: Trial, outcome: Outcome, folder: Path | None) -> tuple[Flight, Outcome]:
    if not trial.real_time:
        return fly_virtual(plan, folder), outcome
    from gcs.trial_realtime import fly_real_time  # processes and sockets: not for trials in virtual time

    ticks, events, steal_share = fly_real_time(plan, margins_of(plan), folder)
    return Flight(ticks, events), replace(outcome, steal_share=steal_share)


def _median_delays(ticks: TickArray, system_ids: tuple[int, ...]) -> dict[int, float]:
    """Median loop delay of each vehicle; 0 for one that was never commanded."""
    delays: dict[int, float] = {}
    for system_id in system_ids:
        own = ticks["loop_delay_s"][(ticks["system_id"] == system_id) & ticks["commanded"]]
        known = own[np.isfinite(own)]
        delays[system_id] = float(np.median(known)) if known.size else 0.0
    return delays


def _with_growth(plan: FlightPlan, loop: Loop, flight: Flight, outcome: Outcome) -> Outcome:
    """The outcome with the growth rate of the probed loop, and the rates predicted at the loop delay it had."""
    ticks = flight.ticks
    own = ticks[np.isin(ticks["system_id"], loop.system_ids) & ticks["commanded"] & (ticks["time_s"] >= 0.0)]
    outcome = replace(outcome, growth_1_s=None, growth_error_1_s=None, fit_samples=None)
    if not own.size:
        return outcome
    since_s = own["time_s"] - own["time_s"][0]
    delay_s = max(_median_delays(own, loop.system_ids).values())
    start_s = _SETTLED_LOOP_DELAYS * delay_s + 2.0 * loop.period_s
    end_s = linear_until_s(plan.scenario, own)
    modes = len(loop.A) // 2 + 2  # those of one axis, and two of what is late; the other axis has the same
    motion = motion_of(ticks, loop.system_ids, period_s=loop.period_s)
    growth = fit_growth(motion, start_s=start_s, end_s=end_s, modes=max(modes, FOLLOWER_MODES))
    if growth is None:
        return replace(outcome, fit_start_s=round(start_s, 6), fit_end_s=round(min(end_s, since_s[-1]), 6))
    window = own[(since_s >= growth.start_s) & (since_s <= growth.end_s)]
    delay_s = max(_median_delays(window, loop.system_ids).values())
    return replace(
        _with_fit(outcome, growth),
        loop_delay_s=round(delay_s, 9),
        loop_delay_spread_s=round(float(np.nanpercentile(window["loop_delay_s"], 90) - delay_s), 9),
        predicted_growth_1_s=_finite(loop.growth_1_s(delay_s)),
        predicted_growth_continuous_1_s=_finite(loop.growth_continuous_1_s(delay_s)),
    )


def _with_fit(outcome: Outcome, growth: Growth) -> Outcome:
    return replace(
        outcome,
        growth_1_s=_finite(growth.growth_1_s),
        growth_error_1_s=_finite(growth.error_1_s),
        frequency_rad_s=_finite(growth.frequency_rad_s),
        fit_start_s=round(growth.start_s, 6),
        fit_end_s=round(growth.end_s, 6),
        fit_samples=growth.samples,
    )


def _left_linear_range_too_soon(outcome: Outcome) -> bool:
    """Whether a smaller error would show more: the flight grew, and left too short a window."""
    if outcome.fit_start_s is None or outcome.fit_end_s is None:
        return False
    if outcome.growth_1_s is None:
        return outcome.fit_end_s < PROBE_S / 2.0
    short = (outcome.fit_samples or 0) < _WANTED_SAMPLES
    short |= outcome.fit_end_s - outcome.fit_start_s < _WANTED_LOOP_DELAYS * (outcome.loop_delay_s or 0.0)
    short |= (
        outcome.fit_end_s < PROBE_S / 2.0 and (outcome.growth_error_1_s or 0.0) > _WANTED_ERROR * outcome.growth_1_s
    )
    return short and outcome.growth_1_s > 0.0


def _with_summary(plan: FlightPlan, flight: Flight, outcome: Outcome) -> Outcome:
    """The outcome with the verdict of the flight, its spacing errors and the driver's lateness."""
    summary = summarise(plan.scenario, margins_of(plan), flight.ticks, flight.events)
    largest = [v["spacing_error_max_m"] for v in summary["vehicles"] if v["spacing_error_max_m"] is not None]
    final = [v["spacing_error_final_m"] for v in summary["vehicles"] if v["spacing_error_final_m"] is not None]
    return replace(
        outcome,
        verdict=summary["verdict"],
        reason=summary["reason"],
        spacing_error_max_m=max(largest, default=None),
        spacing_error_final_m=max(final, default=None),
        lateness_s_p50=summary["control"]["lateness_s"]["p50"],
        lateness_s_p99=summary["control"]["lateness_s"]["p99"],
        trace_m=_trace(flight.ticks),
    )


def _trace(ticks: TickArray) -> list[float]:
    """The largest spacing error of all vehicles in each stretch of `_TRACE_PERIOD_S` of the flight, to four digits."""
    rows = ticks[(ticks["time_s"] >= 0.0) & (ticks["tick"] <= ticks["tick"][ticks["commanded"]].max(initial=-1))]
    error = np.hypot(rows["spacing_error_north_m"], rows["spacing_error_east_m"])
    rows, error = rows[np.isfinite(error)], error[np.isfinite(error)]
    if not error.size:
        return []
    stretch = (rows["time_s"] / _TRACE_PERIOD_S).astype(np.int64)
    largest = np.zeros(int(stretch.max()) + 1)
    np.maximum.at(largest, stretch, error)
    return [float(f"{value:.4g}") for value in largest]


def _finite(value: float) -> float | None:
    return round(float(value), 9) if np.isfinite(value) else None
