"""How fast flights are computed: virtual time against real time, and the station's share of its control period."""

import os
import tempfile
import time  # noqa: TID251 - run time is what is measured; nothing flown depends on it
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from gcs.drive.lockstep import Sent, Vehicles, fly_lockstep, signed_ends, vehicles_of
from gcs.interrupts import raised
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.station import station
from scenarios.schema import FixedGains, Scenario, Vehicle
from scenarios.signing.keys import KEY_BYTES, Key

_COLUMN = 10
"""Vehicles behind one another in a large formation, whose columns follow one leader."""
_SPACING_M = 100.0


@dataclass
class _Timed:
    """Vehicles, with the sum of their own run time."""

    vehicles: Vehicles
    taken_s: float = 0.0

    def step(self, received: Sent, now_ns: int) -> Sent:
        begun_s = time.perf_counter()
        sent = self.vehicles.step(received, now_ns)
        self.taken_s += time.perf_counter() - begun_s
        return sent


def with_vehicles(scenario: Scenario, count: int) -> Scenario:
    """The scenario with this many vehicles in columns behind one leader, all in place."""
    velocity = scenario.nominal_velocity[0].velocity_ne_m_s
    vehicles = [Vehicle(system_id=1, position_ne_m=(0.0, 0.0), velocity_ne_m_s=velocity)]
    for k in range(count - 1):
        column, place = divmod(k, _COLUMN)
        aside = _SPACING_M * (column + 1)
        vehicles.append(
            Vehicle(
                system_id=k + 2,
                follows=1 if place == 0 else k + 1,
                offset_ne_m=(-_SPACING_M, aside if place == 0 else 0.0),
                position_ne_m=(-_SPACING_M * (place + 1), aside),
                velocity_ne_m_s=velocity,
            )
        )
    return scenario.model_copy(update={"vehicles": tuple(vehicles)})


def benchmark(scenario: Scenario, *, seconds: float, repeat: int, signed: bool = False) -> dict[str, Any]:
    """Fly `seconds` of a scenario `repeat` times in virtual time: figures of the fastest and of the median flight.

    With `signed`, unsigned and signed flights alternate, and the result's `signed` is the cost of signing.
    """
    _, plan = flight_plan(_without_solver(scenario, seconds))
    flights: list[dict[str, float]] = []
    signed_flights: list[dict[str, float]] = []
    for _ in range(repeat):
        flights.append(_flight(plan))
        if signed:
            signed_flights.append(_flight(plan, key=Key(os.urandom(KEY_BYTES))))
    fastest = min(flights, key=lambda flight: flight["s_per_tick"])
    period_s = 1.0 / scenario.rates.control_hz
    return {
        "vehicles": len(scenario.vehicles),
        "control_hz": scenario.rates.control_hz,
        "compiled": not str(Path(station.__file__)).endswith(".py"),
        "real_time_factor": period_s / fastest["s_per_tick"],
        "real_time_factor_p50": period_s / median(flight["s_per_tick"] for flight in flights),
        "core_share": fastest["core_share"],
        "station_s_per_tick": fastest["station_s_per_tick"],
        "station_share_of_period": fastest["station_s_per_tick"] / period_s,
        "ticks": fastest["ticks"],
        "flights": repeat,
        "signed": _cost(signed_flights, flights) if signed else None,
    }


def _cost(signed: list[dict[str, float]], plain: list[dict[str, float]]) -> dict[str, float]:
    """Run time of signed flights over that of unsigned ones, for all and for the station: best and median."""
    names = {"time_ratio": "s_per_tick", "station_time_ratio": "station_s_per_tick"}
    return {
        f"{ratio}{suffix}": pick(flight[name] for flight in signed) / pick(flight[name] for flight in plain)
        for ratio, name in names.items()
        for suffix, pick in (("", min), ("_p50", median))
    }


def benchmark_real_time(scenario: Scenario, *, seconds: float) -> dict[str, Any]:
    """Fly `seconds` of a scenario over UDP: the station's punctuality, and its latencies against the truth."""
    from gcs.drive.realtime_flight import fly_real_time
    from gcs.runs.grade import grade
    from gcs.runs.summary import finish

    designed, plan = flight_plan(_without_solver(scenario, seconds))
    with raised(), tempfile.TemporaryDirectory(prefix="bench-") as name:
        folder = Path(name) / "run"
        _, _, _, spent = fly_real_time(plan, designed, folder)
        summary = finish(folder)
        if summary.reason.startswith("interrupted"):
            raise KeyboardInterrupt
        graded = grade(folder)
    assert summary.control is not None
    return {
        "control": summary.control.to_dict(),
        "reason": summary.reason,
        "steal_share": spent.steal,
        "load_average": os.getloadavg()[0],
        **graded.to_dict(),
    }


def _without_solver(scenario: Scenario, seconds: float) -> Scenario:
    gains = FixedGains(K1=-3.4, K2=0.6, K3=5.6)
    requirement = dict.fromkeys(("alpha", "delay_margin_s", "decay_rate_1_s"))
    given = {"method": "inclusion", "gains": gains, "blocks": ()}
    control = scenario.control.model_copy(update=requirement | given)
    return scenario.model_copy(update={"duration_s": seconds, "control": control})


def _flight(plan: FlightPlan, key: Key | None = None) -> dict[str, float]:
    ends, guard = (vehicles_of(plan), None) if key is None else signed_ends(plan, key)
    vehicles = _Timed(ends)
    begun_s, used_s = time.perf_counter(), time.process_time()
    ticks = sum(1 for _ in fly_lockstep(plan, vehicles=vehicles, guard=guard))
    taken_s, used_s = time.perf_counter() - begun_s, time.process_time() - used_s
    return {
        "ticks": ticks,
        "core_share": min(1.0, used_s / taken_s),
        "s_per_tick": taken_s / ticks,
        "station_s_per_tick": (taken_s - vehicles.taken_s) / ticks,
    }
