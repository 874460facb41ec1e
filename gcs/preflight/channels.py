"""Loop delays over links that wait for a channel, found by flying the start of the scenario in virtual time.

Which datagrams wait for which depends on the phases between vehicles and station. They stay about the same during a
flight but differ from flight to flight, so several are flown, each with its own seed.
"""

from dataclasses import replace
from math import inf
from typing import NamedTuple

import numpy as np

from gains.performance.response import Response
from gcs.control.phases import longest_round_trip_s
from gcs.control.tick import TickArray, in_sequence
from gcs.drive.flown import Flight, effective_delays_s
from gcs.drive.lockstep import START_NS, fly_lockstep, vehicles_of
from gcs.plan.expected_delay import DrawnDelays, planned_loop_delays_s
from gcs.plan.flight_plan import FlightPlan, Responses
from gcs.runs.grade import first_ns, true_loop_delays_s
from gcs.station.station import Station
from scenarios.schema import NS_PER_S
from sim_vehicles.links.truth import ACTED, MemoryRecorder

_FLIGHTS, _VEHICLES = 8, 24
"""Maximum number of flights, and of vehicles in all of them; the phases of many vehicles differ within one flight."""
_SECONDS, _PERIODS = 5.0, 20
"""Each flight lasts this long, or this many periods of telemetry if they are longer; its first half is not counted."""
_WIDE = 1e3
"""With the bandwidth multiplied by this, no datagram is dropped."""
_PATIENCE_S, _ROUND_TRIPS = 60.0, 40.0
"""A flight is given up if it has not begun after this time plus this many round trips."""
_ALTITUDE_M = 10.0
"""Vehicles take off to at most this altitude; their links do not depend on it. Autopilots refuse much lower ones."""

_ANY = Response(lag_s=0.1, velocity_gain_1_s=0.0)
"""Stands in for responses that a flight would have to identify first; they change no delay."""


class OverChannels(NamedTuple):
    """The loop delays of the vehicles by system id, and how full the channels are."""

    drawn: dict[int, DrawnDelays]
    """A row for each flight. A vehicle is left out if none of its commands acted in one of the flights."""
    effective_s: dict[int, float]
    """The effective loop delay, the mean over the flights; infinite if next to nothing arrived in one of them."""
    use: dict[str, float]
    """By the name of a channel: the time that it needs for all datagrams of a flight in which none is dropped, as a
    share of the flight. Of several channels of one name, the largest."""


def over_channels(plan: FlightPlan) -> OverChannels:
    """Fly the start of a plan, to see how long its commands take over channels of limited bandwidth."""
    ids, seed = [*planned_loop_delays_s(plan)], plan.scenario.seed
    use = {name: share * _WIDE for name, share in _start(_over_wide(plan), seed).use.items()}
    starts = list[OverChannels]()
    for k in range(max(1, min(_FLIGHTS, _VEHICLES // len(ids)))):
        starts.append(_start(plan, seed + k))
        if not starts[-1].use:
            break  # the flight did not begin
    drawn = {own: [start.drawn[own] for start in starts if own in start.drawn] for own in ids}
    return OverChannels(
        {own: _stacked(flown) for own, flown in drawn.items() if len(flown) == len(starts)},
        {own: float(np.mean([start.effective_s.get(own, inf) for start in starts])) for own in ids},
        use,
    )


def _over_wide(plan: FlightPlan) -> FlightPlan:
    """The plan over channels so wide that nothing is dropped."""
    channels = plan.scenario.links.channels
    wide = (each.model_copy(update={"bandwidth_bit_s": _WIDE * each.bandwidth_bit_s}) for each in channels)
    return replace(plan, scenario=plan.scenario.with_keys(links={"channels": tuple(wide)}))


def _start(plan: FlightPlan, seed: int) -> OverChannels:
    """The delays in the second half of one short flight without safety limits; empty if the flight does not begin."""
    calm = plan.scenario.with_calm_monitor()
    lasts_s = max(_SECONDS, _PERIODS / calm.rates.telemetry_hz)
    vehicles = (own.model_copy(update={"altitude_m": min(calm.altitude_of(own), _ALTITUDE_M)}) for own in calm.vehicles)
    endless = calm.safety.model_copy(update={"spacing_error_limit_m": inf, "collision_distance_m": 0.0})
    low = {"seed": seed, "duration_s": lasts_s, "vehicles": tuple(vehicles), "safety": endless}
    known = plan.responses or Responses("given", dict.fromkeys(plan.formation.system_ids, _ANY))
    plan, truth = replace(plan, scenario=calm.model_copy(update=low), responses=known), MemoryRecorder()
    station, fleet = Station(plan, start_ns=START_NS), vehicles_of(plan.scenario, recorder=truth)
    patience_s = _PATIENCE_S + _ROUND_TRIPS * longest_round_trip_s(plan.scenario)
    flown, since_ns, needed_s = list[TickArray](), 0, dict[str, float]()
    for rows in fly_lockstep(plan, station=station, vehicles=fleet):
        if rows["time_s"][0] >= 0.5 * lasts_s:
            needed_s, since_ns = needed_s or fleet.channel_needs_s, since_ns or station.next_event_ns
            flown.append(rows)
        elif rows["time_s"][0] < 0.0 and station.next_event_ns - START_NS > patience_s * NS_PER_S:
            break
    if not flown:
        return OverChannels({}, {}, {})
    ticks, ids = in_sequence(flown), plan.formation.system_ids
    span_s = (station.next_event_ns - since_ns) / NS_PER_S
    use = {name: (now_s - needed_s[name]) / span_s for name, now_s in fleet.channel_needs_s.items()}
    flight = Flight(ticks, [], truth.records)
    return OverChannels(_delays(flight), effective_delays_s(plan, ticks, flight, ids), use)


def _delays(flight: Flight) -> dict[int, DrawnDelays]:
    """The true delays in a flight of the vehicles with at least two commands that acted."""
    ticks, truth = flight.ticks, flight.truth
    assert truth is not None
    acted_ns = first_ns(truth, ACTED, ticks, "key_ms")
    loop_s = true_loop_delays_s(ticks, truth) - ticks["repeated_s"]
    down_s = (acted_ns - ticks["sent_ns"]) / NS_PER_S
    found = dict[int, DrawnDelays]()
    for own in np.unique(ticks["system_id"]).tolist():
        known = (ticks["system_id"] == own) & np.isfinite(loop_s)
        if np.count_nonzero(known) > 1:
            found[own] = DrawnDelays((loop_s - down_s)[np.newaxis, known], down_s[np.newaxis, known])
    return found


def _stacked(flights: list[DrawnDelays]) -> DrawnDelays:
    """The delays of several flights, each repeated up to the length of the longest."""
    most = max(flown.down_s.size for flown in flights)
    ages_s, down_s = (
        np.concatenate([np.resize(each, (1, most)) for each in column]) for column in zip(*flights, strict=True)
    )
    return DrawnDelays(ages_s, down_s)
