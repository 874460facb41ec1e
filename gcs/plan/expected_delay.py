"""The loop delay that a scenario's links lead to, before it is flown.

On links that only delay it is a sum. Jitter needs more than its mean: no delay is negative, a datagram that must not
overtake waits for the one before it, and a state that arrives after a newer one is not used. Datagrams are therefore
drawn as the links would carry them, with a seed of their own, and the median is taken, which flights report as p50 of
the slowest vehicle. Where datagrams may overtake each other and jitter is as large as the delay, flights were up to 8 %
faster than this. The median says nothing of lost datagrams; what they amount to is `effective_loop_delays_s`.
"""

from collections.abc import Collection, Mapping, Sequence
from math import ceil, inf
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray
from gains.sampled.multirate import effective_delay_s
from gains.sampled.onboard import own_part
from gcs.plan.flight_plan import FlightPlan
from scenarios.keys.link import Link
from scenarios.keys.part import HELD_SHARE
from scenarios.schema import NS_PER_S, Scenario

_SECONDS = 200.0
"""Time over which datagrams are drawn: at 50 Hz the median then has a standard error of about 1 % of the spread."""
_MOST = 20_000
"""Most datagrams drawn in one direction."""
_PHASES = 25
"""Draws of the phases at which several vehicles report."""
_SAME_S, _NEVER = 1e-9, 1e-12
"""Instants (s) closer than this are one, and a probability this small stands for none."""
_Way = tuple[tuple[Link, ...], Link]
"""The links up of the states that a vehicle's commands need, and its link down."""


class DrawnDelays(NamedTuple):
    """Delays at random ticks, each (k,): the ages of states (s) and the one-way delays of set-points (s)."""

    ages_s: FloatArray
    down_s: FloatArray

    @property
    def loop_s(self) -> FloatArray:
        return self.ages_s + self.down_s


def expected_loop_delay_s(scenario: Scenario) -> float:
    """The expected loop delay (s) of the vehicle with the slowest links."""
    return max(expected_loop_delays_s(scenario).values())


def planned_loop_delays_s(plan: FlightPlan) -> dict[int, float]:
    """The expected loop delays (s) of a plan's vehicles: with the loop on board, of the states that commands need."""
    return expected_loop_delays_s(plan.scenario, _heard(plan))


def _heard(plan: FlightPlan) -> dict[int, set[int]]:
    """With the loop on board the vehicles whose states each streamed command needs: a spacing error has two ends."""
    if plan.scenario.control.loop == "ground":
        return {}
    model, ids = plan.model, plan.formation.system_ids
    streamed, heard = plan.gain - own_part(model, plan.gain), {own: set[int]() for own in ids}
    for i, own in enumerate(ids):
        used = streamed[model.input_slice(i)]
        for j, other in enumerate(ids):
            if used[:, model.output_slice(j)].any():
                heard[own].add(other)
            if j and used[:, model.spacing_slice(j)].any():
                heard[own].add(ids[model.predecessors[j]])
    return heard


def expected_loop_delays_s(
    scenario: Scenario, heard: Mapping[int, Collection[int]] = MappingProxyType({})
) -> dict[int, float]:
    """The expected loop delay (s) of each vehicle by its system id, at the slowest delay points of its links.

    On links that only delay, it is the delay up and down plus half the shorter period of telemetry and control: the
    first command computed from a state waits from nothing to a whole period, as the phases of vehicle and station
    happen to be. With jitter or losses it is the median over drawn datagrams. Where `heard` names others for a vehicle,
    it counts from the oldest of their states in place of its own. The time that datagrams wait for a channel is not
    included (`waits_for_channels`).
    """
    ways = _ways(scenario, heard)
    unlike = dict.fromkeys(ways.values())
    rates = scenario.rates
    in_turn = rates.telemetry_hz < rates.control_hz and any(len(ups) > 1 for ups, _ in unlike)
    if in_turn or any(link.jitter or _loses(link) for ups, down in unlike for link in (*ups, down)):
        around_s = {way: float(np.median(drawn.loop_s)) for way, drawn in _drawn(scenario, unlike).items()}
    else:
        waiting_s = 0.5 / max(rates.telemetry_hz, rates.control_hz)
        around_s = {
            (ups, down): max(up.delay_max_s for up in ups) + down.delay_max_s + waiting_s for ups, down in unlike
        }
    return {own: around_s[way] for own, way in ways.items()}


def drawn_delays(plan: FlightPlan) -> dict[int, DrawnDelays]:
    """Delays drawn over the links of each of a plan's vehicles, of which `planned_loop_delays_s` are the medians."""
    ways = _ways(plan.scenario, _heard(plan))
    drawn = _drawn(plan.scenario, dict.fromkeys(ways.values()))
    return {own: drawn[way] for own, way in ways.items()}


def drawn_loop_delays_s(scenario: Scenario, up: Link, down: Link) -> FloatArray:
    """Loop delays (s) drawn over one vehicle's links, at random ticks (k,), as `expected_loop_delay_s` draws them."""
    way = (up,), down
    return _drawn(scenario, [way])[way].loop_s


def _ways(scenario: Scenario, heard: Mapping[int, Collection[int]]) -> dict[int, _Way]:
    """The links up whose states count for each vehicle, and its link down."""
    links = {vehicle.system_id: scenario.link_of(vehicle.system_id) for vehicle in scenario.vehicles}
    states_of = {own: sorted(heard.get(own) or [own]) for own in links}
    return {own: (tuple(links[k][0] for k in states_of[own]), down) for own, (_, down) in links.items()}


def _drawn(scenario: Scenario, ways: Collection[_Way]) -> dict[_Way, DrawnDelays]:
    rng = np.random.default_rng(0)
    ages_s = {ups: _ages_s(scenario, ups, rng) for ups in dict.fromkeys(ups for ups, _ in ways)}
    late_s = {down: _arrival_delays_s(scenario, down, rng) for down in dict.fromkeys(down for _, down in ways)}
    return {(ups, down): DrawnDelays(ages_s[ups], rng.choice(late_s[down], len(ages_s[ups]))) for ups, down in ways}


def effective_loop_delays_s(plan: FlightPlan) -> dict[int, float]:
    """The constant loop delays (s) that those of a plan's vehicles amount to.

    They are the expected ones but for loops on the ground over links that lose datagrams: where no newer command
    arrives, the one before it acts on (`gains.sampled.multirate.effective_delay_s`). They are infinite if next to
    nothing arrives. A prediction knows the age of each state, whatever was lost.
    """
    scenario, delays_s = plan.scenario, planned_loop_delays_s(plan)
    links = {own: scenario.link_of(own) for own in delays_s}
    is_late = scenario.control.loop == "ground" and scenario.control.prediction == "off"
    if not is_late or not any(_loses(link) for way in links.values() for link in way):
        return delays_s
    rng, held_s = np.random.default_rng(0), plan.timing.held_s
    found = {way: _effective_s(scenario, *way, held_s, rng) for way in dict.fromkeys(links.values())}
    return {own: found[way] for own, way in links.items()}


def _effective_s(scenario: Scenario, up: Link, down: Link, held_s: float, rng: np.random.Generator) -> float:
    heard, period_s = _heard_over(scenario, up, rng), 1.0 / scenario.rates.control_hz
    enters, out, main = _stream(down, scenario.rates.control_hz, scenario, rng)
    late_s = (out - enters)[main > 0.0]
    if not len(heard.arrived_s):
        return inf
    at_all_phases_s = period_s + held_s / len(late_s)
    ticks = heard.arrived_s[0] + np.arange(len(late_s)) * at_all_phases_s
    kept = np.isfinite(late_s) & (ticks < heard.newest_s[-1])
    if kept.sum() < 2:
        return inf
    ticks, late_s = ticks[kept], late_s[kept]
    sampled_s = heard.newest_s[np.searchsorted(heard.arrived_s, ticks, side="right") - 1]
    commands = np.rint(NS_PER_S * np.column_stack([ticks + late_s, sampled_s])).astype(np.int64)
    return effective_delay_s(commands[np.argsort(commands[:, 0], kind="stable")], held_s=held_s)


def _loses(link: Link) -> bool:
    return bool(link.loss_probability or link.loss_bursts)


def waits_for_channels(scenario: Scenario) -> bool:
    """Whether datagrams wait for limited bandwidth, which the expected loop delay does not include."""
    return any(
        link.channel is not None for vehicle in scenario.vehicles for link in scenario.link_of(vehicle.system_id)
    )


def _stream(
    link: Link, rate_hz: float, scenario: Scenario, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Datagrams of a link in order: when each enters, when it comes out, and 1.0 for those at `rate_hz`.

    The others are TIMESYNC exchanges. A lost datagram never comes out; it delays nobody.
    """
    span_s = min(_SECONDS, _MOST / rate_hz)
    often = np.arange(0.0, span_s, 1.0 / rate_hz)
    exchanges = np.arange(0.37 / rate_hz, span_s, 1.0 / min(scenario.rates.timesync_hz, rate_hz))
    enters = np.concatenate([often, exchanges])
    order = np.argsort(enters, kind="stable")
    enters, main = enters[order], (order < len(often)).astype(float)
    jitter_s = 0.0 if link.jitter is None else link.jitter.drawn_s(len(enters), rng)
    out = enters + np.maximum(0.0, link.delay_max_s + jitter_s)
    lost = _lost(link, len(enters), rng)
    out[lost] = -np.inf
    if not link.reordering:
        out = np.maximum.accumulate(out)
    out[lost] = np.inf
    return enters, out, main


def _arrival_delays_s(scenario: Scenario, link: Link, rng: np.random.Generator) -> FloatArray:
    """One-way delays of the datagrams that come out."""
    enters, out, _ = _stream(link, scenario.rates.control_hz, scenario, rng)
    arrived_s = (out - enters)[np.isfinite(out)] if np.isfinite(out).any() else np.array([link.delay_max_s])
    if not scenario.control.execute_at:
        return arrived_s
    return np.maximum(arrived_s, np.percentile(arrived_s, 100.0 * HELD_SHARE))


class _Heard(NamedTuple):
    """When states arrived at the station (s), in order, and the instant of the newest one known then (s), both (k,)."""

    arrived_s: FloatArray
    newest_s: FloatArray


def _heard_over(scenario: Scenario, link: Link, rng: np.random.Generator) -> _Heard:
    enters, out, main = _stream(link, scenario.rates.telemetry_hz, scenario, rng)
    known = (main > 0.0) & np.isfinite(out)
    order = np.argsort(out[known], kind="stable")
    return _Heard(out[known][order], np.maximum.accumulate(enters[known][order]))


def _longest_repetition(scenario: Scenario) -> int:
    """For how many ticks a state is repeated at most because telemetry is slower."""
    return ceil(scenario.rates.control_hz / scenario.rates.telemetry_hz * (1.0 - 1e-4)) - 1


def _ages_s(scenario: Scenario, ups: Sequence[Link], rng: np.random.Generator) -> FloatArray:
    """Ages of the newest state at random ticks, less how long slower telemetry was repeated; of several, the oldest."""
    every, period_s = [_heard_over(scenario, up, rng) for up in ups], 1.0 / scenario.rates.control_hz
    if not all(len(own.arrived_s) for own in every):
        return np.full(_MOST // 2, max(up.delay_max_s for up in ups))
    if len(every) > 1:
        ages = _oldest_s(scenario, every, rng)
        return ages if len(ages) else np.full(_MOST // 2, max(up.delay_max_s for up in ups))
    [heard] = every
    ticks = rng.uniform(0.0, heard.newest_s[-1], _MOST // 2)
    place = np.searchsorted(heard.arrived_s, ticks, side="right") - 1
    ticks, place = ticks[place >= 0], place[place >= 0]
    first = np.searchsorted(heard.newest_s, heard.newest_s[place], side="left")  # the arrival that brought this state
    repeated = np.minimum(np.floor((ticks - heard.arrived_s[first]) / period_s), _longest_repetition(scenario))
    ages = ticks - heard.newest_s[place] - repeated * period_s
    return np.resize(ages, _MOST // 2) if len(ages) else np.full(_MOST // 2, ups[0].delay_max_s)


def _oldest_s(scenario: Scenario, every: Sequence[_Heard], rng: np.random.Generator) -> FloatArray:
    """Ages (s) of the oldest of the newest states of several vehicles, less how long it was repeated.

    Whose state is the oldest changes within a period of slower telemetry, with the phases of the vehicles, which are
    drawn anew `_PHASES` times. Empty if next to nothing arrives.
    """
    period_s, longest = 1.0 / scenario.rates.control_hz, _longest_repetition(scenario)
    room_s = min(float(own.newest_s[-1] - own.arrived_s[0]) for own in every)
    count = max(0, min(max(_MOST // 2 // _PHASES, 4 * longest), int(0.5 * room_s / period_s)))
    k, found = np.arange(count), list[FloatArray]()
    for _ in range(_PHASES):
        ages_s = np.zeros(count)
        for own in every:
            ticks = rng.uniform(own.arrived_s[0], own.newest_s[-1] - count * period_s) + k * period_s
            ages_s = np.maximum(ages_s, ticks - own.newest_s[np.searchsorted(own.arrived_s, ticks, side="right") - 1])
        changed = np.diff(k * period_s - ages_s, prepend=-1.0) > _SAME_S
        first = np.maximum.accumulate(np.where(changed, k, 0))
        found.append((ages_s - np.minimum(k - first, longest) * period_s)[longest:])
    return np.concatenate(found)


def _lost(link: Link, count: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    if (bursts := link.loss_bursts) is None:
        return rng.random(count) < link.loss_probability
    to_bad, to_good = max(bursts.to_bad_probability, _NEVER), bursts.to_good_probability
    lasts = np.column_stack([rng.geometric(to_bad, count), rng.geometric(to_good, count)])
    is_bad = np.searchsorted(np.cumsum(lasts.ravel()), np.arange(count), side="right") % 2 == 1
    return rng.random(count) < np.where(is_bad, bursts.loss_bad_probability, bursts.loss_good_probability)
