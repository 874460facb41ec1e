"""Turns a run's logs into its verdict: writes ticks.parquet and summary.json.

It works from the files alone, so the same code finishes a run whose station was killed and one that ended well.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from gains.core.arrays import FloatArray
from gcs.control.own_law import BAD, BUDGET_SHARE, CALLS, LAW, OVER
from gcs.control.tick import CLOCK_JUMPED, NOT_CONFIRMED, TICK, Event, Mode, TickArray, chosen
from gcs.errors import InputError
from gcs.plan.at_delay import figures_at
from gcs.plan.design import Design
from gcs.plan.disturbed import predicted_spread
from gcs.plan.formation import plan_formation
from gcs.plan.own_law import code_records
from gcs.runs import record
from gcs.runs.files import RunTail, by_vehicle, read_design, read_scenario, read_ticks
from gcs.runs.refusals import REFUSED, counted_by_vehicles, counts_of, refused_by_vehicles
from gcs.runs.summary_record import (
    Clock,
    Control,
    Estimate,
    FlownSpread,
    LawRecord,
    MarginRange,
    OneWayDelay,
    Spread,
    Summary,
    VehicleFlownSpread,
    VehicleSummary,
)  # fmt: skip
from scenarios.schema import NS_PER_S, Scenario

_SKEW_SPAN_S = 1.0
"""Shortest time over which a clock's skew is estimated."""
_SETTLED_SHARE = 0.05
"""Vehicles must stay settled over this last share of the flight."""
_DECAYS = 7.0
"""The initial errors count as gone after this many time constants of the slowest decay: e^-7 of them are left."""
Errors = tuple[FloatArray, FloatArray]
"""Times (s) and the norm of one vehicle's error at each: spacing (m) or velocity (m/s)."""
SILENT_END = "interrupted: the station ended without recording why"


def finish(folder: Path, *, unwritten: Sequence[Event] | None = None) -> Summary:
    """Write ticks.parquet and summary.json of a run that has ended, and return the summary.

    `unwritten`, given only at the end of a flight, holds the events that could not be written. Files that cannot be
    written now are then named in `not_logged`, and without a Parquet file the tick log is kept. Raises InputError if
    the folder is not a run or has a damaged file, and OSError if a file cannot be written and `unwritten` is None.
    """
    scenario = read_scenario(folder)
    design = read_design(folder / record.DESIGN_FILE)
    ticks = read_ticks(folder)
    if strangers := set(ticks["system_id"].tolist()) - {vehicle.system_id for vehicle in scenario.vehicles}:
        wanted = f"wanted those of its {record.SCENARIO_FILE} only"
        raise InputError(f"{folder}: read ticks of vehicles {sorted(strangers)}, {wanted}")
    summary = summarise(scenario, design, ticks, [*RunTail(folder).events(), *(unwritten or ())])
    not_logged = list(summary.not_logged)
    if unwritten:
        not_logged.append(f"{record.EVENTS_FILE}: the last {len(unwritten)}")
    recorded = (folder / record.RECORDING_FILE).exists() or find_spec("rerun") is None  # without Rerun none is expected
    if unwritten is not None and not recorded:
        not_logged.append(f"{record.RECORDING_FILE}: see gcs recover")
    if lost := (counted_by_vehicles(folder) or {}).get("truth_lost"):
        not_logged.append(f"{record.TRUTH_FILE}: {lost} records")

    def write(name: str, how: Callable[[], None]) -> None:
        try:
            how()
        except OSError as error:
            if unwritten is None:
                raise
            not_logged.append(f"{name}: {error.strerror or error}")

    def whole(files: set[str]) -> Summary:
        parts = {"not_logged": tuple(not_logged), "files": tuple(sorted(files))}
        return summary.model_copy(update=parts | {"refused_by_vehicles": refused_by_vehicles(folder)})

    def there() -> set[str]:
        return {file.name for file in folder.iterdir() if not file.name.startswith(".")}

    def columns() -> None:  # deletes the tick log only once the Parquet file is complete
        names = TICK.names or ()
        record.write_parquet(folder / record.PARQUET_FILE, {name: np.ascontiguousarray(ticks[name]) for name in names})
        (folder / record.TICKS_FILE).unlink(missing_ok=True)

    write(record.PARQUET_FILE, columns)
    text = whole(there() | {record.SUMMARY_FILE}).to_json().encode()
    write(record.SUMMARY_FILE, lambda: record.write_whole(folder / record.SUMMARY_FILE, text))
    return whole(there())


@dataclass(frozen=True, eq=False)
class Judgement:
    """The verdict on a flight and the evidence for it.

    `flown` holds the rows of the flight. `flown_of` holds these rows, and `errors` the spacing errors, by system id.
    """

    verdict: str
    reason: str
    settling_time_s: float | None
    headroom_end: float | None
    not_logged: tuple[str, ...]
    flown: TickArray
    flown_of: Mapping[int, TickArray]
    errors: dict[int, Errors]

    @property
    def spacing_errors_m(self) -> list[tuple[float, float]]:
        """The largest and the last spacing error of each follower that has any."""
        return [(float(error_m.max()), float(error_m[-1])) for _, error_m in self.errors.values() if error_m.size]


def judge(scenario: Scenario, ticks: TickArray, events: Sequence[Event]) -> Judgement:
    """Judge a flight by its ticks and events, as described in `verdict`."""
    commanded = ticks["tick"][ticks["commanded"]]
    flown = chosen(ticks, (ticks["time_s"] >= 0) & (ticks["tick"] <= (commanded[-1] if commanded.size else -1)))
    reason = ([event.text for event in events if event.kind == record.END] or [SILENT_END])[-1]
    not_logged = tuple(
        f"{event.text}, from {event.time_s:.2f} s on" for event in events if event.kind == record.LOG_ENDED
    )
    flown_of = by_vehicle(flown)
    errors = {
        v.system_id: _error(flown_of[v.system_id], "spacing_error_{}_m")
        for v in scenario.vehicles
        if v.follows is not None
    }
    settled = _settling_time_s(scenario, errors, flown_of)
    late = chosen(flown, flown["commanded"] & (flown["time_s"] >= 0.75 * flown["time_s"].max(initial=0.0)))
    headroom_end = min(_medians(late, "headroom").values(), default=None)
    logged = not any(text.startswith(record.TICKS_FILE) for text in not_logged)
    known = all(np.isfinite(own["loop_delay_s"]).mean() >= 0.5 for own in by_vehicle(late).values() if own.size)
    found = verdict(reason, settled, headroom_end=headroom_end, known=logged and known)
    return Judgement(found, reason, settled, headroom_end, not_logged, flown, flown_of, errors)


def summarise(scenario: Scenario, design: Design, ticks: TickArray, events: Sequence[Event]) -> Summary:
    """The summary of a run, without its files and its vehicles' refusals."""
    judged, ticks_of = judge(scenario, ticks, events), by_vehicle(ticks)
    flown = judged.flown
    sent = chosen(flown, flown["commanded"])
    jumps: dict[int | None, list[float]] = defaultdict(list)
    for event in events:
        if event.text == CLOCK_JUMPED:
            jumps[event.system_id].append(event.time_s)
    delays_s = {system_id: round(delay_s, 9) for system_id, delay_s in _medians(sent, "loop_delay_s").items()}
    slowest = max(delays_s, key=delays_s.__getitem__, default=0)  # alpha is computed for its delay and its gains
    longest_flown = int(np.bincount(sent["gain_set"][sent["system_id"] == slowest], minlength=1).argmax())
    return Summary(
        scenario=scenario.name,
        verdict=judged.verdict,
        reason=judged.reason,
        fleet=([event.text for event in events if event.kind == record.FLEET] or [record.STARTED])[-1],
        not_logged=judged.not_logged,
        not_confirmed=([event.text for event in events if event.kind == NOT_CONFIRMED] or [""])[-1],
        loop=scenario.control.loop,
        prediction=scenario.control.prediction,
        delay_margin_s=design.delay_margin_s,
        delay_margin_continuous_s=design.delay_margin_continuous_s,
        response=design.response,
        loop_delay_s=_spread(sent["loop_delay_s"]),
        loop_delay_bound_s=np.fmax.reduce(sent["loop_delay_bound_s"], initial=np.nan),
        at_loop_delay=figures_at(design, scenario, delays_s.get(slowest), longest_flown),
        spread=_flown_spread(scenario, design, flown, delays_s),
        headroom_min=np.fmin.reduce(sent["headroom"], initial=np.nan),
        headroom_end=judged.headroom_end,
        settling_time_s=judged.settling_time_s,
        distance_min_m=np.fmin.reduce(flown["nearest_m"], initial=np.nan),
        duration_s=flown["time_s"].max(initial=0.0),
        vehicles=tuple(
            _vehicle(
                ticks_of[v.system_id],
                judged.flown_of[v.system_id],
                v.system_id,
                judged.errors.get(v.system_id),
                jumps_s=jumps[v.system_id],
                completed=judged.reason.startswith("completed"),
            )
            for v in scenario.vehicles
        ),
        control=control_of(scenario, flown),
        refused=counts_of(events, REFUSED),
        mirror=counts_of(events, record.MIRROR),
        mode_changes=tuple(event for event in events if event.kind == "mode" and event.time_s >= 0),
        **_own_code(scenario, design, events),
    )


def _medians(rows: TickArray, name: str) -> dict[int, float]:
    columns = {system_id: own[name] for system_id, own in by_vehicle(rows[["system_id", name]]).items()}
    return {key: float(np.median(known)) for key, own in columns.items() if (known := own[np.isfinite(own)]).size}


def verdict(
    reason: str, settling_time_s: float | None, *, headroom_end: float | None = None, known: bool = True
) -> str:
    """ "stable", "unstable", "aborted" or "unknown".

    Stable: flown to the end of its duration, every spacing error settled, and the loop delay within the margin at the
    end. Unstable: a limit was broken; or a spacing error had not settled, because it grows, circles in a limit cycle or
    shrinks too slowly; or errors were small but the loop delay was past the margin at the end, where errors grow slowly
    or limits hold them in a small cycle. Aborted: ended early for any other reason. Unknown: flown to the end, but the
    log of ticks is incomplete, or the loop delay of a vehicle was unknown for most of the last quarter.
    """
    if reason.startswith("broken"):
        return "unstable"
    if not reason.startswith("completed"):
        return "aborted"
    if not known:
        return "unknown"
    return "unstable" if settling_time_s is None or (headroom_end or 0.0) < 0.0 else "stable"


def _error(rows: TickArray, column: str) -> Errors:
    """The norm over north and east of one vehicle's error, where it is known."""
    error = np.hypot(rows[column.format("north")], rows[column.format("east")])
    known = np.isfinite(error)
    return rows["time_s"][known], error[known]


def _settling_time_s(scenario: Scenario, errors: dict[int, Errors], flown_of: Mapping[int, TickArray]) -> float | None:
    """The time from which every follower's error stays within a fraction of its spacing; None if one does not.

    It must stay there for the last `_SETTLED_SHARE` of the flight: errors that oscillate or grow come near zero, too.
    A single vehicle has settled when its velocity error is within that fraction of its speed, or of 1 m/s if slower.
    """
    whole = {v.system_id: float(np.hypot(*v.offset_ne_m)) for v in scenario.vehicles if v.offset_ne_m is not None}
    if not whole:
        [alone] = (vehicle.system_id for vehicle in scenario.vehicles)
        whole = {alone: max(float(np.hypot(*scenario.nominal_velocity_at(scenario.duration_s))), 1.0)}
        errors = {alone: _error(flown_of[alone], "velocity_error_{}_m_s")}
    latest = 0.0
    for system_id, (time_s, error) in errors.items():
        outside = np.flatnonzero(error > scenario.safety.settled_fraction * whole[system_id])
        if not time_s.size or (outside.size and outside[-1] == time_s.size - 1):
            return None
        if outside.size:
            latest = max(latest, float(time_s[outside[-1] + 1]))
    last_s = max(float(time_s[-1]) for time_s, _ in errors.values())
    return round(latest, 6) if latest <= (1.0 - _SETTLED_SHARE) * last_s else None


def _vehicle(
    rows: TickArray, own: TickArray, system_id: int, error: Errors | None, *, jumps_s: list[float], completed: bool
) -> VehicleSummary:
    """The figures of a vehicle, from all its `rows` and from those of the flight, `own`.

    Rows after the flight count for the final mode only if the flight was not `completed`.
    """
    sent = chosen(own, own["commanded"])
    error_m = error[1] if error is not None and error[1].size else None
    counted = {name: int(rows[name][-1]) if rows.size else None for name in ("received", "lost", "late", "duplicate")}
    margins_s, rtt = sent["delay_margin_s"], estimate(rows["rtt_s"])
    with np.errstate(invalid="ignore"):  # at a margin of 0 the headroom is minus infinity
        # the unused part of the margin; with prediction, of the distance to the window's end
        headroom_s = sent["headroom"] * (margins_s - sent["assumed_delay_s"])
    modes = (own if completed else rows)["mode"]
    if (modes != Mode.WAITING).any():  # every vehicle returns to WAITING once it is told to hold at the end
        modes = modes[modes != Mode.WAITING]
    return VehicleSummary(
        system_id=system_id,
        spacing_error_final_m=None if error_m is None else error_m[-1],
        spacing_error_max_m=None if error_m is None else error_m.max(),
        rtt_s=rtt,
        loop_delay_s=estimate(sent["loop_delay_s"]),
        delay_margin_s=MarginRange(min=margins_s.min(initial=np.inf), max=margins_s.max(initial=-np.inf)),
        headroom_min=np.fmin.reduce(sent["headroom"], initial=np.nan),
        headroom_min_s=np.fmin.reduce(headroom_s, initial=np.nan),
        up_delay_s=_one_way(sent["up_delay_s"], sent["sample_bound_s"]),
        down_delay_s=_one_way(sent["down_delay_s"], sent["down_bound_s"]),
        telemetry_age_s=estimate(sent["telemetry_age_s"]),
        station_queue_s=estimate(sent["queue_s"]),
        clock=_clock(own, rtt.samples, jumps_s),
        mode_final=Mode(int(modes[-1])).name if modes.size else None,
        **counted,
    )


def estimate(values: FloatArray) -> Estimate:
    """The spread of samples, their number, and whether there are any."""
    samples = int(np.isfinite(values).sum())
    return Estimate(**vars(_spread(values)), samples=samples, status="measured" if samples else "unknown")


def _one_way(delay_s: FloatArray, bound_s: FloatArray) -> OneWayDelay:
    known_s = bound_s[np.isfinite(delay_s) & np.isfinite(bound_s)]
    return OneWayDelay(**vars(estimate(delay_s)), bound_s=known_s.max(initial=-np.inf))


def _clock(own: TickArray, exchanges: int, jumps_s: list[float]) -> Clock:
    """The last estimate of a clock's offset, its skew since the last jump, and the bounds of both.

    The skew is the slope between the first and the last offset; each is wrong by at most its own bound.
    """
    known = chosen(own, np.isfinite(own["clock_offset_s"]))
    if not known.size:
        nothing = dict.fromkeys(("offset_s", "bound_s", "skew_ppm", "skew_bound_ppm"))
        return Clock(status="unknown", samples=0, **nothing, jumps=len(jumps_s))
    offset_s, bound_s, due_ns = known["clock_offset_s"], known["clock_offset_bound_s"], known["due_ns"]
    skew_ppm = skew_bound_ppm = None
    steady = np.flatnonzero(known["time_s"] > max(jumps_s, default=-np.inf))
    if steady.size and (span_s := (due_ns[-1] - due_ns[steady[0]]) * 1e-9) > _SKEW_SPAN_S:
        skew_ppm = 1e6 * (offset_s[-1] - offset_s[steady[0]]) / span_s
        skew_bound_ppm = 1e6 * (bound_s[-1] + bound_s[steady[0]]) / span_s
    return Clock(
        status="measured",
        samples=exchanges,
        offset_s=offset_s[-1],
        bound_s=bound_s[-1],
        skew_ppm=skew_ppm,
        skew_bound_ppm=skew_bound_ppm,
        jumps=len(jumps_s),
    )


def _flown_spread(
    scenario: Scenario, design: Design, flown: TickArray, delays_s: dict[int, float]
) -> FlownSpread | None:
    """The rms of each follower's reported spacing error after the transients of the start and the last turn.

    None if nothing disturbs the vehicles, no prediction can be computed, or the flight ended during the transient.
    """
    if (scenario.disturbance is None and scenario.navigation is None) or not delays_s:
        return None
    slowest_s, ids = max(delays_s.values()), plan_formation(scenario).system_ids
    delay_s = np.array([delays_s.get(system_id, slowest_s) for system_id in ids])
    predicted = predicted_spread(design, scenario, delay_s, _older_shares(flown, ids, scenario))
    if predicted is None:
        return None
    from_s = scenario.nominal_velocity[-1].from_s + _DECAYS / predicted.decay_rate_1_s
    flown = chosen(flown, flown["time_s"] >= from_s)
    vehicles: list[VehicleFlownSpread] = []
    flown_of = by_vehicle(flown)
    for own in predicted.vehicles:
        rows = flown_of[own.system_id]
        square = rows["spacing_error_north_m"] ** 2 + rows["spacing_error_east_m"] ** 2
        square = square[np.isfinite(square)]
        if not square.size:
            return None
        vehicles.append(
            VehicleFlownSpread(
                system_id=own.system_id,
                reported_rms_m=float(np.sqrt(square.mean())),
                predicted_rms_m=own.reported_rms_m,
                predicted_true_rms_m=own.spacing_error_rms_m,
            )
        )
    return FlownSpread(loop_delay_s=predicted.loop_delay_s, from_s=from_s, vehicles=tuple(vehicles))


def _older_shares(flown: TickArray, ids: Sequence[int], scenario: Scenario) -> FloatArray:
    """(2, n, n): weight w of the older report where k's position and velocity are interpolated to i's newest state.

    See `history.state_at`. w varies as clocks drift; this one gives white noise its mean variance, w^2 + (1 - w)^2.
    """
    period_ns = NS_PER_S / scenario.rates.telemetry_hz
    ticks, at = np.unique(flown["tick"], return_inverse=True)
    sample_ns = np.full((ticks.size, len(ids)), np.nan)
    for column, system_id in enumerate(ids):
        own = (flown["system_id"] == system_id) & np.isfinite(flown["telemetry_age_s"])
        sample_ns[at[own], column] = (flown["sample_ns"] - flown["due_ns"][:1])[own]
    shares = np.zeros((2, len(ids), len(ids)))
    for row in range(len(ids)):
        newer = (sample_ns - sample_ns[:, [row]]) / period_ns
        x = np.where(newer > 0.0, newer % 1.0, 0.0)  # time back from the newer of the two reports, in periods
        known = np.maximum(np.isfinite(newer).sum(axis=0), 1)
        for share, of_older in zip(shares, (x * x * (3.0 - 2.0 * x), x), strict=True):
            both = (of_older * (1.0 - of_older)).sum(axis=0) / known
            share[row] = 0.5 - np.sqrt(np.maximum(0.25 - both, 0.0))
    return shares


def control_of(scenario: Scenario, flown: TickArray) -> Control:
    """Ticks flown and deadline misses: ticks skipped, or whose last set-point was sent over half a period late."""
    ticks, first = np.unique(flown["tick"], return_index=True)
    last_ns = np.maximum.reduceat(flown["sent_ns"], first) if first.size else flown["sent_ns"]
    late_s = (last_ns - flown["due_ns"][first]) * 1e-9
    skipped = int(ticks[-1] - ticks[0] + 1 - ticks.size) if ticks.size else 0
    return Control(
        rate_hz=scenario.rates.control_hz,
        ticks=int(ticks.size),
        deadline_misses=skipped + int((late_s > 0.5 / scenario.rates.control_hz).sum()),
        lateness_s=_spread(late_s),
    )


def _spread(values: FloatArray) -> Spread:
    known = values[np.isfinite(values)]
    if not known.size:
        return Spread(p50=None, p95=None, p99=None, max=None)
    p50, p95, p99 = np.percentile(known, [50, 95, 99]).tolist()
    return Spread(p50=p50, p95=p95, p99=p99, max=known.max())


def _own_code(scenario: Scenario, design: Design, events: Sequence[Event]) -> dict[str, Any]:
    if not scenario.code:
        return {}
    fields: dict[str, Any] = {"code": code_records(scenario)}
    if design.margin_unknown:
        fields["margin_unknown"] = design.margin_unknown
    if counts := counts_of(events, LAW):
        fields["law"] = LawRecord(
            calls=counts[CALLS],
            unusable=counts[BAD],
            over_budget=counts.get(OVER),
            budget_s=BUDGET_SHARE / scenario.rates.control_hz,
        )
    return fields
