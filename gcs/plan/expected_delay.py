"""The loop delay that a scenario's links lead to, before it is flown.

On links that only delay it is a sum. Jitter needs more than its mean: no delay is negative, a datagram that must not
overtake waits for the one before it, and a state that arrives after a newer one is not used. Datagrams are therefore
drawn as the links would carry them, with a seed of their own, and the median is taken, which flights report as p50 of
the slowest vehicle. Where datagrams may overtake each other and jitter is as large as the delay, flights were up to 8 %
faster than this.
"""

from collections.abc import Collection, Mapping, Sequence
from math import ceil
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from gains.core.arrays import FloatArray
from gains.sampled.onboard import own_part
from gcs.plan.flight_plan import FlightPlan
from scenarios.keys.link import Link
from scenarios.keys.part import HELD_SHARE
from scenarios.schema import Scenario

_SECONDS = 200.0
"""Time over which datagrams are drawn: at 50 Hz the median then has a standard error of about 1 % of the spread."""
_MOST = 20_000
"""Most datagrams drawn in one direction."""


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
    if any(link.jitter or link.loss_probability or link.loss_bursts for ups, down in unlike for link in (*ups, down)):
        around_s = {way: float(np.median(drawn.loop_s)) for way, drawn in _drawn(scenario, unlike).items()}
    else:
        waiting_s = 0.5 / max(scenario.rates.telemetry_hz, scenario.rates.control_hz)
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
    ages_s = {up: _ages_s(scenario, up, rng) for up in dict.fromkeys(up for ups, _ in ways for up in ups)}
    late_s = {down: _arrival_delays_s(scenario, down, rng) for down in dict.fromkeys(down for _, down in ways)}
    drawn: dict[_Way, DrawnDelays] = {}
    for ups, down in ways:
        oldest_s = _oldest_s([ages_s[up] for up in ups], rng)
        drawn[ups, down] = DrawnDelays(oldest_s, rng.choice(late_s[down], len(oldest_s)))
    return drawn


def _oldest_s(ages_s: Sequence[FloatArray], rng: np.random.Generator) -> FloatArray:
    """The ages (s) of the oldest of several states, drawn independently of each other."""
    first, *others = ages_s
    return np.maximum.reduce([first, *(rng.permutation(own) for own in others)])


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
    lost = rng.random(len(enters)) < _loss(link)
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


def _ages_s(scenario: Scenario, link: Link, rng: np.random.Generator) -> FloatArray:
    """Ages of the newest state at random ticks, less how long slower telemetry was repeated."""
    rates = scenario.rates
    enters, out, main = _stream(link, rates.telemetry_hz, scenario, rng)
    known = (main > 0.0) & np.isfinite(out)
    sampled, out = enters[known], out[known]
    ticks = rng.uniform(0.0, enters[-1], _MOST // 2)
    if not len(out):
        return np.full(len(ticks), link.delay_max_s)
    order = np.argsort(out, kind="stable")
    arrived, newest = out[order], np.maximum.accumulate(sampled[order])
    place = np.searchsorted(arrived, ticks, side="right") - 1
    ticks, place = ticks[place >= 0], place[place >= 0]
    first = np.searchsorted(newest, newest[place], side="left")  # the arrival that brought this state
    period_s = 1.0 / rates.control_hz
    longest_s = (ceil(rates.control_hz / rates.telemetry_hz * (1.0 - 1e-4)) - 1) * period_s
    repeated = np.minimum(np.floor((ticks - arrived[first]) / period_s) * period_s, longest_s)
    ages = ticks - newest[place] - repeated
    return np.resize(ages, _MOST // 2) if len(ages) else np.full(_MOST // 2, link.delay_max_s)


def _loss(link: Link) -> float:
    """Mean fraction of datagrams that are lost."""
    if (bursts := link.loss_bursts) is None:
        return link.loss_probability
    bad = bursts.to_bad_probability / (bursts.to_bad_probability + bursts.to_good_probability)
    return bad * bursts.loss_bad_probability + (1.0 - bad) * bursts.loss_good_probability
