"""How fast flights are computed: virtual time against real time, the station's share of its period, and its codec."""

import os
import tempfile
import time  # noqa: TID251 - run time is what is measured; nothing flown depends on it
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path
from statistics import mean, median
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.drive.flown import fly_real_time
from gcs.drive.lockstep import Sent, Vehicles, fly_lockstep, prepare, signed_ends, vehicles_of
from gcs.interrupts import raised
from gcs.link import mavlink
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.published import Published
from gcs.runs.grade import Grade, grade
from gcs.runs.summary_record import Control
from scenarios.keys.course import Course
from scenarios.networks import ids_of, wire_id
from scenarios.schema import FixedGains, Scenario, Vehicle
from scenarios.signing.keys import KEY_BYTES, Key

GAINS = FixedGains(K1=-3.4, K2=0.6, K3=5.6)
"""The gains of all benchmark flights."""
_COLUMN = 10
"""Vehicles in each column of a large formation; all columns follow one leader."""
_SPACING_M = 100.0
_PARSES = 20
"""How often pymavlink parses the frames of a tick after each flight."""
_REHEARSED_S = 1.0
_FRAMES, _REPEATS = 250, 20
"""Number of frames in a timing of the codecs, and of repetitions."""


class SigningCost(Published):
    """Run time of signed over unsigned flights, whole and station alone: ratios of the fastest and of medians."""

    time_ratio: float
    time_ratio_p50: float
    station_time_ratio: float
    station_time_ratio_p50: float


class Benchmark(Published):
    """How fast flights of a scenario are computed: figures of the fastest flight, and the median speed.

    `station_s_per_tick` and `vehicles_s_per_tick` come from flights in which station and vehicles take turns and are
    timed separately; kernels that run both at once fly small formations faster. `core_share` is the share of one
    processor that the fastest flight had. `pymavlink_parse_s` is the time that pymavlink takes in the same run to parse
    one LOCAL_POSITION_NED of each vehicle. `tick_over_parse` is the time of a whole tick of the station over that: a
    ratio that tells on any machine how fast the station is.
    """

    vehicles: int
    control_hz: float
    real_time_factor: float
    real_time_factor_p50: float
    core_share: float
    station_s_per_tick: float
    vehicles_s_per_tick: float
    station_share_of_period: float
    pymavlink_parse_s: float
    tick_over_parse: float
    ticks: int
    flights: int
    signed: SigningCost | None


class RealTimeBenchmark(Grade):
    """Punctuality of a flight over UDP, load of the machine, and errors of the latencies that the flight measured."""

    control: Control
    reason: str
    steal_share: float
    load_average: float


class _Flown(NamedTuple):
    ticks: int
    core_share: float
    s_per_tick: float
    station_s_per_tick: float
    vehicles_s_per_tick: float
    """These two are NaN if the flight was not timed."""


class Seconds(NamedTuple):
    """The run time of the same work by the station and by pymavlink."""

    ours: float
    theirs: float


@dataclass
class _Timed:
    """Vehicles, with their accumulated run time."""

    vehicles: Vehicles
    taken_s: float = 0.0

    def step(self, received: Sent, now_ns: int) -> Sent:
        begun_s = time.perf_counter()
        sent = self.vehicles.step(received, now_ns)
        self.taken_s += time.perf_counter() - begun_s
        return sent


def with_vehicles(scenario: Scenario, count: int) -> Scenario:
    """The scenario with this many vehicles in columns behind one leader, all in place, and without manoeuvres."""
    if scenario.manoeuvres:
        scenario = scenario.in_steady_flight().model_copy(update={"course": Course()})
    velocity = scenario.nominal_velocity[0].velocity_ne_m_s
    ids = ids_of(count)
    vehicles = [Vehicle(system_id=ids[0], position_ne_m=(0.0, 0.0), velocity_ne_m_s=velocity)]
    for k in range(count - 1):
        column, place = divmod(k, _COLUMN)
        aside = _SPACING_M * (column + 1)
        vehicles.append(
            Vehicle(
                system_id=ids[k + 1],
                follows=ids[0 if place == 0 else k],
                offset_ne_m=(-_SPACING_M, aside if place == 0 else 0.0),
                position_ne_m=(-_SPACING_M * (place + 1), aside),
                velocity_ne_m_s=velocity,
            )
        )
    return scenario.model_copy(update={"vehicles": tuple(vehicles)})


def benchmark(scenario: Scenario, *, seconds: float, repeat: int, signed: bool = False) -> Benchmark:
    """Fly `seconds` of a scenario `repeat` times in virtual time.

    With `signed`, unsigned and signed flights alternate, and the result includes the cost of signing.
    """
    _, plan = flight_plan(without_solver(scenario, seconds))
    _flight(replace(plan, scenario=plan.scenario.model_copy(update={"duration_s": _REHEARSED_S})))
    prepare(plan)
    flights: list[_Flown] = []
    timed: list[_Flown] = []
    signed_flights: list[_Flown] = []
    parse_s: list[float] = []
    frames = position_frames(len(scenario.vehicles))
    for _ in range(repeat):
        flights.append(_flight(plan))
        timed.append(_flight(plan, timed=True))
        parse_s.append(mean(pymavlink_parse_s(frames) for _ in range(_PARSES)))
        if signed:
            signed_flights.append(_flight(plan, timed=True, key=Key(os.urandom(KEY_BYTES))))
    fastest = min(flights, key=lambda flight: flight.s_per_tick)
    station_s = min(flight.station_s_per_tick for flight in timed)
    period_s = 1.0 / scenario.rates.control_hz
    return Benchmark(
        vehicles=len(scenario.vehicles),
        control_hz=scenario.rates.control_hz,
        real_time_factor=period_s / fastest.s_per_tick,
        real_time_factor_p50=period_s / median(flight.s_per_tick for flight in flights),
        core_share=fastest.core_share,
        station_s_per_tick=station_s,
        vehicles_s_per_tick=min(flight.vehicles_s_per_tick for flight in timed),
        station_share_of_period=station_s / period_s,
        pymavlink_parse_s=min(parse_s),
        tick_over_parse=station_s / min(parse_s),
        ticks=fastest.ticks,
        flights=repeat,
        signed=_cost(signed_flights, timed) if signed else None,
    )


def start_and_speed(plan: FlightPlan, *, seconds: float) -> tuple[float, float]:
    """Time (s) that a plan's vehicles take to start, take-off included, and seconds flown per second of run time."""
    short = replace(plan, scenario=plan.scenario.model_copy(update={"duration_s": seconds}))
    _, flown = _flight(short), _flight(short)  # the first loads or compiles the kernels
    period_s = 1.0 / plan.scenario.rates.control_hz
    return flown.ticks * period_s - seconds, period_s / flown.s_per_tick


def _cost(signed: list[_Flown], plain: list[_Flown]) -> SigningCost:
    (whole, whole_plain), (own, own_plain) = (
        ([getattr(flight, name) for flight in flights] for flights in (signed, plain))
        for name in ("s_per_tick", "station_s_per_tick")
    )
    return SigningCost(
        time_ratio=min(whole) / min(whole_plain),
        time_ratio_p50=median(whole) / median(whole_plain),
        station_time_ratio=min(own) / min(own_plain),
        station_time_ratio_p50=median(own) / median(own_plain),
    )


def benchmark_real_time(scenario: Scenario, *, seconds: float) -> RealTimeBenchmark:
    from gcs.runs.summary import finish

    designed, plan = flight_plan(without_solver(scenario, seconds))
    with raised(), tempfile.TemporaryDirectory(prefix="bench-") as name:
        folder = Path(name) / "run"
        flight = fly_real_time(plan, designed, folder)
        summary = finish(folder)
        if summary.reason.startswith("interrupted"):
            raise KeyboardInterrupt
        graded = grade(folder)
    assert summary.control is not None
    assert flight.steal_share is not None
    return RealTimeBenchmark(
        **vars(graded),
        control=summary.control,
        reason=summary.reason,
        steal_share=flight.steal_share,
        load_average=os.getloadavg()[0],
    )


def without_solver(scenario: Scenario, seconds: float) -> Scenario:
    """The scenario, shortened to `seconds` and with given gains, whose design needs no solver."""
    requirement = dict.fromkeys(("alpha", "delay_margin_s", "decay_rate_1_s"))
    given = {"method": "inclusion", "gains": GAINS, "blocks": ()}
    return scenario.with_keys(control=requirement | given).model_copy(update={"duration_s": seconds})


def first_unsupported_key(scenario: Scenario) -> str | None:
    """The key of the scenario that a plain station cannot fly, with what was read and wanted; None if there is none."""
    for key, read, wanted in (
        ("dynamics", scenario.dynamics, "double_integrator"),
        ("control.loop", scenario.control.loop, "ground"),
        ("control.prediction", scenario.control.prediction, "off"),
        ("control.feed_forward", scenario.control.feed_forward, 0.0),
    ):
        if read != wanted:
            return f"{key}: read {read!r}, wanted {wanted!r} for this benchmark"
    return None


def _flight(plan: FlightPlan, *, timed: bool = False, key: Key | None = None) -> _Flown:
    ends, guard = (vehicles_of(plan.scenario), None) if key is None else signed_ends(plan, key)
    vehicles = _Timed(ends) if timed else ends
    begun_s, used_s = time.perf_counter(), time.process_time()
    rows = sum(map(len, fly_lockstep(plan, vehicles=vehicles, guard=guard, ahead=True)))
    taken_s, used_s = time.perf_counter() - begun_s, time.process_time() - used_s
    ticks = rows // len(plan.formation.system_ids)
    own_s = vehicles.taken_s if isinstance(vehicles, _Timed) else nan
    return _Flown(ticks, min(1.0, used_s / taken_s), taken_s / ticks, (taken_s - own_s) / ticks, own_s / ticks)


def position_frames(count: int) -> list[bytes]:
    """One LOCAL_POSITION_NED of each of `count` vehicles in flight, at full length: no trailing zeros are cut."""
    states = [(1000 + k, 100.5 * k, -3.25 * k, -1000.0, 91.44, 0.125, -0.5) for k in range(count)]
    position = mavlink.LOCAL_POSITION_NED
    numbered = zip(map(wire_id, ids_of(count)), states, strict=True)
    return [mavlink.encode(position, state, sequence=0, system_id=own) for own, state in numbered]


def pymavlink_parse_s(frames: Sequence[bytes]) -> float:
    """The time pymavlink's parser takes for the frames, each in its own datagram."""
    parser: Any = dialect.MAVLink(None)
    return _taken_s(lambda: [parser.parse_char(frame) for frame in frames])


def decode_s() -> Seconds:
    """The time to decode one LOCAL_POSITION_NED and verify its checksum: the minimum of several runs."""
    frames, refused = position_frames(_FRAMES), Counter[str]()
    return _least(
        lambda: _taken_s(lambda: [mavlink.decode(frame, refused) for frame in frames]),
        lambda: pymavlink_parse_s(frames),
    )


def encode_s() -> Seconds:
    """The time to encode one set-point, SET_POSITION_TARGET_LOCAL_NED: the minimum of several runs."""
    packer: Any = dialect.MAVLink(None, mavlink.STATION_SYSTEM_ID, mavlink.STATION_COMPONENT_ID)
    return _least(
        lambda: _taken_s(lambda: station_set_points(_FRAMES, key_ms=7)),
        lambda: _taken_s(lambda: [pymavlink_set_point(packer, k) for k in range(_FRAMES)]),
    )


def station_set_points(count: int, key_ms: int) -> list[bytes]:
    """Acceleration-only set-points to `count` vehicles, encoded by the station."""
    points = np.zeros(count, mavlink.SET_POINT)
    points["type_mask"], points["acceleration_ne_m_s2"] = mavlink.IGNORE_ALL_BUT_ACCELERATION, (0.5, -0.25)
    rows = np.arange(count)
    frames = mavlink.set_point_frames(points, rows, np.full(count, -1), np.ones(count, np.int64), key_ms)
    return [frame.tobytes() for frame in frames]


def pymavlink_set_point(packer: Any, key_ms: int) -> bytes:
    """The same set-point, encoded by pymavlink."""
    numbers = key_ms, 1, 1, dialect.MAV_FRAME_LOCAL_NED, mavlink.IGNORE_ALL_BUT_ACCELERATION
    fields = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5, -0.25, 0.0, 0.0, 0.0
    return dialect.MAVLink_set_position_target_local_ned_message(*numbers, *fields).pack(packer)


def _taken_s(work: Callable[[], object]) -> float:
    begun_s = time.perf_counter()
    work()
    return time.perf_counter() - begun_s


def _least(ours: Callable[[], float], theirs: Callable[[], float]) -> Seconds:
    """The minimum time per frame of each. They are measured alternately, so a busy machine slows both."""
    taken = [Seconds(ours(), theirs()) for _ in range(_REPEATS)]
    return Seconds(min(each.ours for each in taken) / _FRAMES, min(each.theirs for each in taken) / _FRAMES)
