"""`gcs capacity`: how many vehicles, at which rate, a scenario's links carry before the margin is gone.

For each rate, growing formations fly in virtual time over the scenario's own links and channels, until the loop delay
exceeds the margin of the gains designed for that rate, or the formation no longer flies. Losses are random, so each
formation flies with several seeds, and is carried only if it holds with all of them.
"""

from dataclasses import dataclass, replace

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.errors import GainsError
from gcs.control.tick import TickArray
from gcs.drive.lockstep import LINK_DOWN, LINK_UP, START_NS, LinkLosses, Sent, Vehicles, fly_lockstep, vehicles_of
from gcs.drive.preflight import bad_start, endless_link, unstable_loop
from gcs.errors import InputError
from gcs.plan.planner import flight_plan
from gcs.station.station import Station
from gcs.studies.benchmark import with_vehicles
from scenarios.schema import Scenario

_START_ERROR_M = 2.0
"""Initial displacement of every second vehicle to the east."""
_DECAYED = 0.1
"""A formation under control has reduced its errors to this share by the last third of a flight."""
FEWEST = 2


@dataclass(frozen=True)
class Load:
    """One flight of a formation at a rate, and what was left of its margin."""

    rate_hz: float
    vehicles: int
    seed: int
    delay_margin_s: float
    loop_delay_p50_s: float | None
    loop_delay_p99_s: float | None
    headroom_p01: float | None
    """Least headroom, 1 − loop delay / margin, of all but the worst hundredth of the ticks."""
    station_bytes_s: float
    """MAVLink bytes per second that the station sends and receives, summed."""
    lost_up: float
    """True fraction of the datagrams from vehicles that the links lost; `lost_down` is that of those to vehicles."""
    lost_down: float
    error_end_m: float
    """Largest spacing error of all vehicles: the median over the last third of the flight, because one lost set-point
    affects it for seconds."""
    reason: str
    """How the flight ended."""
    holds: bool
    """Errors fell to a tenth of their initial size, and 99 of 100 ticks had headroom."""


@dataclass(frozen=True)
class Capacity:
    """The largest formation carried at one rate, and the smallest tried that was not; None if there is none."""

    rate_hz: float
    most: Load | None
    next: Load | None
    failed: str = ""


@dataclass
class _Counted:
    """Vehicles behind links, with the station's bytes counted."""

    vehicles: Vehicles
    bytes_both_ways: int = 0

    def step(self, received: Sent, now_ns: int) -> Sent:
        arrived = self.vehicles.step(received, now_ns)
        self.bytes_both_ways += sum(len(data) for sent in (received, arrived) for _, data, _ in sent)
        return arrived


def capacity(
    scenario: Scenario, *, rates_hz: list[float], most: int, seeds: int = 3, seconds: float = 180.0
) -> list[Capacity]:
    """The capacity at each rate, up to `most` vehicles: the size doubles until one fails, then bisection.

    Each formation flies with the scenario's seed and those that follow it. Flights last `seconds`, long because errors
    decay slowly near the margin. Raises InputError if the scenario gives gains as blocks of its own formation, its
    vehicles take off first, or it cannot fly.
    """
    if blocks := len(scenario.control.blocks):
        wanted = "gains for any number of vehicles"
        raise InputError(f"{scenario.name}: control.blocks: read {blocks} of them, wanted {wanted}")
    if scenario.dynamics != "double_integrator":
        wanted = "double_integrator: gcs capacity does not fly vehicles that take off first"
        raise InputError(f"{scenario.name}: dynamics: read {scenario.dynamics!r}, wanted {wanted}")
    scenario = scenario.model_copy(update={"duration_s": seconds})
    formed = _displaced(with_vehicles(scenario, most))
    for fault in (bad_start(formed), endless_link(formed)):
        if fault is not None:
            raise InputError(f"{scenario.name}: {fault}")
    return [_capacity_of(scenario, rate_hz, most, seeds) for rate_hz in rates_hz]


def _capacity_of(scenario: Scenario, rate_hz: float, most: int, seeds: int) -> Capacity:
    found = Capacity(rate_hz, most=None, next=None)
    low, count = FEWEST - 1, FEWEST
    try:
        while count > low:
            load = worst_load(scenario, rate_hz, count, seeds)
            found = replace(found, most=load) if load.holds else replace(found, next=load)
            low = count if load.holds else low
            count = min(2 * low, most) if found.next is None else (low + found.next.vehicles) // 2
    except GainsError as error:
        return replace(found, failed=str(error))
    return found


def worst_load(scenario: Scenario, rate_hz: float, vehicles: int, seeds: int) -> Load:
    """The first flight that does not hold; if all do, the one of least headroom."""
    loads: list[Load] = []
    for seed in range(scenario.seed, scenario.seed + seeds):
        loads.append(fly_loaded(scenario.model_copy(update={"seed": seed}), rate_hz, vehicles))
        if not loads[-1].holds:
            return loads[-1]
    return min(loads, key=lambda load: load.headroom_p01 or 0.0)


def fly_loaded(scenario: Scenario, rate_hz: float, vehicles: int) -> Load:
    """Fly this many vehicles with telemetry and control at the rate, and measure.

    Raises GainsError if no gains meet the scenario's requirement at this rate, or the given ones are unstable at it.
    """
    rates = scenario.rates.model_copy(update={"control_hz": rate_hz, "telemetry_hz": rate_hz})
    formed = with_vehicles(scenario.with_calm_monitor().model_copy(update={"rates": rates}), vehicles)
    _, plan = flight_plan(_displaced(formed))
    if (unstable := unstable_loop(plan)) is not None:
        raise GainsError(unstable)
    losses = LinkLosses()
    station, counted = Station(plan, start_ns=START_NS), _Counted(vehicles_of(plan, record=losses.record))
    ticks = np.concatenate(list(fly_lockstep(plan, vehicles=counted, station=station)))
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
        lost_up=losses.share(LINK_UP),
        lost_down=losses.share(LINK_DOWN),
        error_end_m=error_end_m,
        reason=f"off by {error_end_m:.2g} m" if completed else "limit broken",
        holds=completed and error_end_m < _DECAYED * _START_ERROR_M and headroom_p01 is not None and headroom_p01 > 0.0,
    )


def _error_end_m(flown: TickArray) -> float:
    last = flown[flown["time_s"] >= 2.0 / 3.0 * flown["time_s"][-1]]
    error_m = np.nan_to_num(np.hypot(last["spacing_error_north_m"], last["spacing_error_east_m"]))
    _, first = np.unique(last["tick"], return_index=True)
    return float(np.median(np.maximum.reduceat(error_m, first)))


def _percentile(values: FloatArray, percent: float) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, percent)) if known.size else None


def _displaced(scenario: Scenario) -> Scenario:
    vehicles = [
        vehicle.model_copy(update={"position_ne_m": (north, east + _START_ERROR_M * (k % 2))})
        for k, vehicle in enumerate(scenario.vehicles)
        for north, east in [vehicle.position_ne_m]
    ]
    return scenario.model_copy(update={"vehicles": tuple(vehicles)})
