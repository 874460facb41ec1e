"""`gcs capacity`: how many vehicles a scenario's links carry at each rate before the margin is used up.

For each rate, growing formations fly in virtual time over the scenario's own links and channels, until the loop delay
exceeds the margin of the gains designed for that rate, or the formation no longer flies. Losses are random, so each
formation flies with several seeds, and counts as carried only if it holds with all of them. With a folder, each flight
is stored as soon as it ends, and a study can be resumed.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from math import ceil, log2
from pathlib import Path

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.errors import GainsError
from gcs.control.tick import TickArray, in_sequence
from gcs.drive.lockstep import START_NS, Sent, Vehicles, fly_lockstep, vehicles_of
from gcs.plan.planner import flight_plan
from gcs.preflight.faults import bad_start, endless_link, unstable_loop
from gcs.published import json_text
from gcs.runs.files import write_scenario
from gcs.runs.record import write_whole
from gcs.station.station import Station
from gcs.stress.campaign import Store, check_study
from gcs.studies.benchmark import with_vehicles
from scenarios.schema import Scenario

LOADS_FILE, RESULT_FILE = "loads.jsonl", "capacity.json"
_START_ERROR_M = 2.0
"""Initial displacement of every second vehicle to the east."""
_DECAYED = 0.1
"""By the last third of a flight, a formation under control has reduced its errors to this share."""
FEWEST = 2
SECONDS = 180.0
"""Duration of each flight."""


@dataclass(frozen=True)
class Load:
    """One flight of a formation at a rate, and the headroom left in it."""

    rate_hz: float
    vehicles: int
    seed: int
    delay_margin_s: float
    loop_delay_p50_s: float | None
    loop_delay_p99_s: float | None
    headroom_p01: float | None
    """First percentile of the headroom, 1 − loop delay / margin, over the ticks."""
    station_bytes_s: float
    """MAVLink bytes per second that the station sends and receives, added."""
    lost_up: float
    """True fraction of the datagrams from vehicles that the links lost; `lost_down` is the same to vehicles."""
    lost_down: float
    error_end_m: float
    """Largest spacing error of all vehicles: the median over the last third of the flight, because one lost set-point
    affects it for seconds."""
    reason: str
    """What the flight showed: that the margin was gone, the final error, or why it ended early."""
    holds: bool
    """Errors fell to a tenth of their initial size, and 99 of 100 ticks had headroom."""


@dataclass(frozen=True)
class Capacity:
    """The largest formation carried at one rate, and the smallest one tried that was not; None if there is none."""

    rate_hz: float
    most: Load | None
    next: Load | None
    failed: str = ""


@dataclass
class _Counted:
    """Vehicles behind links, with a count of the bytes that the station exchanges with them."""

    vehicles: Vehicles
    bytes_both_ways: int = 0

    def step(self, received: Sent, now_ns: int) -> Sent:
        arrived = self.vehicles.step(received, now_ns)
        self.bytes_both_ways += sum(len(data) for sent in (received, arrived) for _, data, _ in sent)
        return arrived


def capacity(
    scenario: Scenario,
    *,
    rates_hz: list[float],
    most: int,
    seeds: int = 3,
    seconds: float = SECONDS,
    store: Store[Load] | None = None,
    ended: Callable[[int], None] = lambda _: None,
) -> list[Capacity]:
    """Find the capacity at each rate, up to `most` vehicles: double the size until one fails, then bisect.

    Each formation flies with `seeds` successive seeds, beginning with the scenario's. Flights last `seconds`, a long
    time because errors decay slowly near the margin. Those in `store` are not flown again; the others are added to it.
    `ended` is called after each formation with the maximum number left. The scenario must not be `unflyable`.
    """
    scenario = scenario.model_copy(update={"duration_s": seconds})
    found: list[Capacity] = []
    for k, rate_hz in enumerate(rates_hz):
        own, low, count = Capacity(rate_hz, most=None, next=None), FEWEST - 1, FEWEST
        while count > low:
            try:
                load = worst_load(scenario, rate_hz, count, seeds, store)
            except GainsError as error:
                own, count = replace(own, failed=str(error)), 0
            else:
                own, low = (replace(own, most=load), count) if load.holds else (replace(own, next=load), low)
                count = min(2 * low, most) if own.next is None else (low + own.next.vehicles) // 2
            ended(_at_most(low, count, own.next, most) + formations_at_most(len(rates_hz) - 1 - k, most))
        found.append(own)
    return found


def unflyable(scenario: Scenario, most: int) -> str | None:
    """Why formations of up to `most` vehicles cannot be flown with this scenario; None if they can.

    They cannot if its gains fit only its own formation, its vehicles take off first, or its start or links are refused.
    """
    if blocks := len(scenario.control.blocks):
        return f"control.blocks: read {blocks} of them, wanted gains for any number of vehicles"
    if scenario.dynamics != "double_integrator":
        wanted = "double_integrator: gcs capacity does not fly vehicles that take off first"
        return f"dynamics: read {scenario.dynamics!r}, wanted {wanted}"
    formed = _displaced(with_vehicles(scenario.model_copy(update={"duration_s": SECONDS}), most))
    return bad_start(formed) or endless_link(formed)


def formations_at_most(rates: int, most: int) -> int:
    """The maximum number of formations that a study of this many rates flies, of up to `most` vehicles each."""
    return rates * _at_most(FEWEST - 1, FEWEST, None, most)


def _at_most(low: int, count: int, beyond: Load | None, most: int) -> int:
    """The maximum number of formations that a search may still fly, from `count` vehicles on."""
    if count <= low:
        return 0
    doublings = 0 if beyond is not None else ceil(log2(most / count)) + 1
    return doublings + ceil(log2(max(1, (most + 1 if beyond is None else beyond.vehicles) - low)))


def worst_load(scenario: Scenario, rate_hz: float, vehicles: int, seeds: int, store: Store[Load] | None = None) -> Load:
    """Fly each seed until a flight does not hold, and return that one; if all hold, the one with the least headroom."""
    loads: list[Load] = []
    for seed in range(scenario.seed, scenario.seed + seeds):
        load = None if store is None else store.flown.get((rate_hz, vehicles, seed))
        if load is None:
            load = fly_loaded(scenario.model_copy(update={"seed": seed}), rate_hz, vehicles)
            if store is not None:
                store.add(load)
        if not load.holds:
            return load
        loads.append(load)
    return min(loads, key=lambda load: load.headroom_p01 or 0.0)


def fly_loaded(scenario: Scenario, rate_hz: float, vehicles: int) -> Load:
    """Fly this many vehicles with telemetry and control at the rate, and measure.

    Raises GainsError if no gains meet the scenario's requirement at this rate, or given gains are unstable at it.
    """
    formed = with_vehicles(scenario.with_calm_monitor().at_rates(control_hz=rate_hz, telemetry_hz=rate_hz), vehicles)
    _, plan = flight_plan(_displaced(formed))
    if (unstable := unstable_loop(plan)) is not None:
        raise GainsError(unstable)
    station, fleet = Station(plan, start_ns=START_NS), vehicles_of(plan.scenario)
    counted = _Counted(fleet)
    ticks = in_sequence([*fly_lockstep(plan, vehicles=counted, station=station)])
    flown = ticks[ticks["time_s"] >= 0.0]
    commanded = flown[flown["commanded"]]
    headroom_p01 = _percentile(commanded["headroom"], 1)
    completed = station.end_reason.startswith("completed")
    error_end_m = _error_end_m(flown)
    return Load(
        rate_hz=rate_hz,
        vehicles=vehicles,
        seed=scenario.seed,
        delay_margin_s=plan.delay_margin_s,
        loop_delay_p50_s=_percentile(commanded["loop_delay_s"], 50),
        loop_delay_p99_s=_percentile(commanded["loop_delay_s"], 99),
        headroom_p01=headroom_p01,
        station_bytes_s=counted.bytes_both_ways / float(ticks["time_s"][-1] - ticks["time_s"][0]),
        lost_up=fleet.lost_share(up=True),
        lost_down=fleet.lost_share(up=False),
        error_end_m=error_end_m,
        reason=_reason(station.end_reason, error_end_m, headroom_p01),
        holds=completed and error_end_m < _DECAYED * _START_ERROR_M and headroom_p01 is not None and headroom_p01 > 0.0,
    )


def _reason(end_reason: str, error_end_m: float, headroom_p01: float | None) -> str:
    if not end_reason.startswith("completed"):
        return end_reason
    if headroom_p01 is None:
        return "no loop delay measured"
    return "margin gone" if headroom_p01 <= 0.0 else f"off by {error_end_m:.2g} m"


def _error_end_m(flown: TickArray) -> float:
    if not flown.size:  # the flight did not begin
        return _START_ERROR_M
    last = flown[flown["time_s"] >= 2.0 / 3.0 * flown["time_s"][-1]]
    error_m = np.nan_to_num(np.hypot(last["spacing_error_north_m"], last["spacing_error_east_m"]))
    _, first = np.unique(last["tick"], return_index=True)
    return float(np.median(np.maximum.reduceat(error_m, first)))


def _percentile(values: FloatArray, percent: float) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, percent)) if known.size else None


def _displaced(scenario: Scenario) -> Scenario:
    """The scenario with initial errors, and without disturbances and navigation errors, which would outlast them."""
    vehicles = [
        vehicle.model_copy(update={"position_ne_m": (north, east + _START_ERROR_M * (k % 2))})
        for k, vehicle in enumerate(scenario.vehicles)
        for north, east in [vehicle.position_ne_m]
    ]
    return scenario.model_copy(update={"vehicles": tuple(vehicles), "disturbance": None, "navigation": None})


def loads_of(folder: Path, scenario: Scenario, *, resume: bool) -> Store[Load]:
    """The store of finished flights in a study's folder, by rate, vehicles and seed.

    Raises InputError if `resume` is set and the folder holds no study of this scenario.
    """
    if resume:
        check_study("--resume", folder / LOADS_FILE, "capacity study", scenario)
    write_scenario(folder, scenario)
    return Store(folder / LOADS_FILE, Load, lambda load: (load.rate_hz, load.vehicles, load.seed))


def write_result(folder: Path, found: list[Capacity]) -> None:
    write_whole(folder / RESULT_FILE, json_text({"capacities": [asdict(each) for each in found]}).encode())
