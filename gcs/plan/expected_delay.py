"""The loop delay to be expected over a scenario's links, before it is flown.

On links with only a constant delay it is a sum. With jitter the mean is not enough: no delay is negative, a datagram
that must not overtake waits for the one before it, and a state that arrives after a newer one is not used. Datagrams
are therefore drawn as the links would carry them, with a fixed seed. Their median is what flights report as p50 of the
slowest vehicle. If datagrams may overtake each other and jitter is as large as the delay, loop delays in flight were up
to 8 % shorter. The median says nothing about datagrams that are lost or very late; `effective_loop_delays_s` takes them
into account.
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

_SECONDS = 1000.0
"""Longest time over which datagrams are drawn."""
_MOST = 20_000
"""Maximum number of datagrams drawn in one direction."""
_PHASES, _DRAWS = 25, 200
"""Number of tick phases that are evaluated, and of draws of the phases at which several vehicles report."""
_SAME_S, _NEVER = 1e-9, 1e-12
"""Times (s) closer than this are equal, and a probability this small stands for zero."""
_Path = tuple[tuple[Link, ...], Link]
"""The up links of the states that a vehicle's commands need, and its down link."""


class DrawnDelays(NamedTuple):
    """Delays at random ticks: the ages of states (s) and the one-way delays of set-points (s).

    Each is (phases, k): during a flight, the phase between ticks and telemetry stays about the same.
    """

    ages_s: FloatArray
    down_s: FloatArray

    @property
    def loop_s(self) -> FloatArray:
        return self.ages_s + self.down_s


def expected_loop_delay_s(scenario: Scenario) -> float:
    """The expected loop delay (s) of the vehicle with the slowest links."""
    return max(expected_loop_delays_s(scenario).values())


def planned_loop_delays_s(plan: FlightPlan) -> dict[int, float]:
    """The expected loop delays (s) of a plan's vehicles; on board, from the oldest state that each command needs.

    A leader flown by somebody else has none.
    """
    expected_s = expected_loop_delays_s(plan.scenario, _heard(plan))
    return {own: at_s for own, at_s in expected_s.items() if own != plan.scenario.external_id}


def _heard(plan: FlightPlan) -> dict[int, set[int]]:
    """The vehicles whose states each streamed command needs, two for a spacing error; empty for the ground loop."""
    if plan.onboard is None:
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

    On links with only a constant delay, it is the delay up and down plus half the shorter period of telemetry and
    control: the first command computed from a state waits between zero and a whole period, depending on the phases of
    vehicle and station. With jitter or losses it is the median over drawn datagrams, averaged over the phases. If
    `heard` names other vehicles for a vehicle, its delay counts from the oldest of their states, not its own. The time
    that datagrams wait for a channel is not included (`waits_for_channels`, `gcs.preflight.channels`).
    """
    paths = _paths(scenario, heard)
    unlike = dict.fromkeys(paths.values())
    rates = scenario.rates
    in_turn = rates.telemetry_hz < rates.control_hz and any(len(ups) > 1 for ups, _ in unlike)
    if in_turn or any(_is_random(link) for ups, down in unlike for link in (*ups, down)):
        around_s = {
            path: float(np.median(drawn.loop_s, axis=1).mean()) for path, drawn in _drawn(scenario, unlike).items()
        }
    else:
        waiting_s = 0.5 / max(rates.telemetry_hz, rates.control_hz)
        around_s = {
            (ups, down): max(up.delay_max_s for up in ups) + down.delay_max_s + waiting_s for ups, down in unlike
        }
    return {own: around_s[path] for own, path in paths.items()}


def drawn_delays(plan: FlightPlan) -> dict[int, DrawnDelays]:
    """Delays drawn over the links of each of a plan's vehicles; `planned_loop_delays_s` has their medians."""
    paths = _planned_paths(plan)
    drawn = _drawn(plan.scenario, dict.fromkeys(paths.values()))
    return {own: drawn[path] for own, path in paths.items()}


def drawn_loop_delays_s(scenario: Scenario, up: Link, down: Link) -> FloatArray:
    """Loop delays (s) at random ticks (k,), drawn over one vehicle's links as `expected_loop_delay_s` draws them."""
    path = (up,), down
    return _drawn(scenario, [path])[path].loop_s.ravel()


def _paths(scenario: Scenario, heard: Mapping[int, Collection[int]]) -> dict[int, _Path]:
    """For each vehicle the up links of the states that its commands need, and its down link."""
    links = {vehicle.system_id: scenario.link_of(vehicle.system_id) for vehicle in scenario.vehicles}
    states_of = {own: sorted(heard.get(own) or [own]) for own in links}
    return {own: (tuple(links[k][0] for k in states_of[own]), down) for own, (_, down) in links.items()}


def _planned_paths(plan: FlightPlan) -> dict[int, _Path]:
    """The paths of the vehicles that the station commands."""
    paths = _paths(plan.scenario, _heard(plan))
    return {own: path for own, path in paths.items() if own != plan.scenario.external_id}


def _drawn(scenario: Scenario, paths: Collection[_Path]) -> dict[_Path, DrawnDelays]:
    rng = np.random.default_rng(0)
    ages_s = {ups: _ages_s(scenario, ups, rng) for ups in dict.fromkeys(ups for ups, _ in paths)}
    late_s = {down: _arrival_delays_s(scenario, down, rng) for down in dict.fromkeys(down for _, down in paths)}
    return {(ups, down): DrawnDelays(ages_s[ups], rng.choice(late_s[down], ages_s[ups].shape)) for ups, down in paths}


def effective_loop_delays_s(plan: FlightPlan) -> dict[int, float]:
    """The effective loop delays (s) of a plan's vehicles: the equivalent constant ones.

    They differ from the expected delays only on random links. There, if a datagram is late or lost, the previous
    command stays in force (`gains.sampled.multirate.effective_delay_s`). They are infinite if next to nothing arrives.
    A prediction knows the age of each state, whatever was lost, so only the mean delay of set-points counts.
    """
    scenario, paths, expected_s = plan.scenario, _planned_paths(plan), planned_loop_delays_s(plan)
    rng, found = np.random.default_rng(0), dict[_Path, float]()
    for own, (ups, down) in paths.items():
        counting = (down,) if scenario.control.prediction != "off" else (*ups, down)
        if (ups, down) not in found and any(_is_random(link) for link in counting):
            found[ups, down] = _effective_s(plan, ups, down, expected_s[own], rng)
    return {own: found.get(path, expected_s[own]) for own, path in paths.items()}


def _effective_s(
    plan: FlightPlan, ups: Sequence[Link], down: Link, expected_s: float, rng: np.random.Generator
) -> float:
    scenario, is_predicted = plan.scenario, plan.scenario.control.prediction != "off"
    period_s = 1.0 / scenario.rates.control_hz
    held_s = period_s if is_predicted else plan.timing.held_s
    late_s = _set_points(scenario, down, rng)[1]
    ticks = np.arange(len(late_s)) * (period_s + held_s / len(late_s))  # at all phases
    ages_s = np.zeros(len(ticks))
    for k, up in enumerate(() if is_predicted else ups, start=1):
        heard = _heard_over(scenario, up, rng)
        if not len(heard.arrived_s):
            return inf
        # the vehicles' phases to each other change as well
        own_ticks = heard.arrived_s[0] + np.arange(len(late_s)) * (period_s + k * held_s / len(late_s))
        own_ticks[own_ticks > heard.newest_s[-1]] = np.nan
        sampled_s = heard.newest_s[np.searchsorted(heard.arrived_s, own_ticks, side="right") - 1]
        ages_s = np.maximum(ages_s, own_ticks - sampled_s)
    kept = np.isfinite(late_s + ages_s)
    if kept.sum() < 2:
        return inf
    acts_s, sampled_s = (ticks + late_s)[kept], (ticks - ages_s)[kept]
    commands = np.rint(NS_PER_S * np.column_stack([acts_s, sampled_s])).astype(np.int64)
    effective_s = effective_delay_s(commands[np.argsort(commands[:, 0], kind="stable")], held_s=held_s)
    return expected_s + effective_s - float(late_s[kept].mean()) if is_predicted else effective_s


def setpoint_gaps(scenario: Scenario) -> float:
    """Expected number of times in a flight, over all vehicles, that set-points stop for `safety.setpoint_timeout_s`.

    The vehicle then enters failsafe. A gap just as long as the timeout counts as half: on real clocks, every other one
    is a little longer. In virtual time over constant links none is. Outages of links and bandwidth are not included.
    """
    rng, often = np.random.default_rng(0), dict[Link, float]()
    commanded = [vehicle.system_id for vehicle in scenario.vehicles if vehicle.system_id != scenario.external_id]
    downs = [scenario.link_of(system_id)[1] for system_id in commanded]
    for down in dict.fromkeys(downs):
        enters_s, late_s = _set_points(scenario, down, rng)
        arrived_s = np.sort((enters_s + late_s)[np.isfinite(late_s)])
        gaps_s = np.diff(arrived_s, append=max(enters_s[-1], arrived_s.max(initial=0.0)))
        longer_s = gaps_s - scenario.safety.setpoint_timeout_s
        longer_s[np.abs(longer_s) < _SAME_S] = 0.0
        often[down] = float(np.heaviside(longer_s, 0.5).sum()) / float(enters_s[-1])
    return scenario.duration_s * sum(often[down] for down in downs)


def _set_points(scenario: Scenario, down: Link, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """The time at which each set-point is sent (s), and its one-way delay (s): infinite if it is lost."""
    enters, out, main = _stream(down, scenario.rates.control_hz, scenario, rng)
    late_s = (out - enters)[main > 0.0]
    if scenario.control.execute_at and np.isfinite(late_s).any():
        late_s = np.maximum(late_s, np.percentile(late_s[np.isfinite(late_s)], 100.0 * HELD_SHARE))
    return enters[main > 0.0], late_s


def _is_random(link: Link) -> bool:
    return bool(link.jitter or link.loss_probability or link.loss_bursts or link.corrupt_probability)


def waits_for_channels(scenario: Scenario) -> bool:
    """Whether datagrams wait for limited bandwidth, which the expected loop delays here do not include."""
    return any(
        link.channel is not None for vehicle in scenario.vehicles for link in scenario.link_of(vehicle.system_id)
    )


def _stream(
    link: Link, rate_hz: float, scenario: Scenario, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Datagrams of a link in the order sent: when each enters, when it leaves, and 1.0 for those at `rate_hz`.

    The others are TIMESYNC exchanges. A lost datagram never leaves, and delays no other.
    """
    span_s = min(_SECONDS, _MOST / rate_hz)
    often = np.arange(0.0, span_s, 1.0 / rate_hz)
    exchanges = np.arange(0.37 / rate_hz, span_s, 1.0 / min(scenario.rates.timesync_hz, scenario.rates.control_hz))
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
    """One-way delays of the set-points that arrive; the link's delay if none does."""
    late_s = _set_points(scenario, link, rng)[1]
    arrived_s = late_s[np.isfinite(late_s)]
    return arrived_s if len(arrived_s) else np.array([link.delay_max_s])


class _Heard(NamedTuple):
    """Times of arrival of states at the station, ascending, and the sampling time of the newest so far, both (k,)."""

    arrived_s: FloatArray
    newest_s: FloatArray


def _heard_over(scenario: Scenario, link: Link, rng: np.random.Generator) -> _Heard:
    enters, out, main = _stream(link, scenario.rates.telemetry_hz, scenario, rng)
    known = (main > 0.0) & np.isfinite(out)
    order = np.argsort(out[known], kind="stable")
    return _Heard(out[known][order], np.maximum.accumulate(enters[known][order]))


def _longest_repetition(scenario: Scenario) -> int:
    """Maximum number of ticks for which a state is used again because telemetry is slower than control."""
    return ceil(scenario.rates.control_hz / scenario.rates.telemetry_hz * (1.0 - 1e-4)) - 1


def _ages_s(scenario: Scenario, ups: Sequence[Link], rng: np.random.Generator) -> FloatArray:
    """Ages of the newest state at random ticks, less the time since its first use; of several vehicles, the oldest."""
    every, rates = [_heard_over(scenario, up, rng) for up in ups], scenario.rates
    shape, period_s = (_PHASES, _MOST // 2 // _PHASES), 1.0 / rates.control_hz
    constant_s = np.full(shape, max(up.delay_max_s for up in ups))
    if not all(len(own.arrived_s) for own in every):
        return constant_s
    if len(every) > 1:
        ages = _oldest_s(scenario, every, rng)
        return ages if ages.size else constant_s
    [heard] = every
    count = int((heard.newest_s[-1] - heard.arrived_s[0]) / period_s)
    if count < 1:
        return constant_s
    phases_s = np.linspace(0.005, 0.995, _PHASES)[:, np.newaxis] / max(rates.telemetry_hz, rates.control_hz)
    ticks = heard.arrived_s[0] + rng.integers(count, size=shape) * period_s + phases_s
    place = np.searchsorted(heard.arrived_s, ticks, side="right") - 1
    first = np.searchsorted(heard.newest_s, heard.newest_s[place], side="left")  # the arrival that brought this state
    repeated = np.minimum(np.floor((ticks - heard.arrived_s[first]) / period_s), _longest_repetition(scenario))
    return ticks - heard.newest_s[place] - repeated * period_s


def _oldest_s(scenario: Scenario, every: Sequence[_Heard], rng: np.random.Generator) -> FloatArray:
    """Ages (s) of the oldest of the newest states of several vehicles, less the time since its first use.

    Which vehicle's state is the oldest changes within a period of slower telemetry, and depends on the phases of the
    vehicles, which are drawn `_DRAWS` times. Empty if next to nothing arrives.
    """
    period_s, longest = 1.0 / scenario.rates.control_hz, _longest_repetition(scenario)
    room_s = min(float(own.newest_s[-1] - own.arrived_s[0]) for own in every)
    count = max(0, min(max(_MOST // 2 // _DRAWS, 4 * longest), int(0.5 * room_s / period_s)))
    k, found = np.arange(count), list[FloatArray]()
    for _ in range(_DRAWS):
        ages_s = np.zeros(count)
        for own in every:
            ticks = rng.uniform(own.arrived_s[0], own.newest_s[-1] - count * period_s) + k * period_s
            ages_s = np.maximum(ages_s, ticks - own.newest_s[np.searchsorted(own.arrived_s, ticks, side="right") - 1])
        changed = np.diff(k * period_s - ages_s, prepend=-1.0) > _SAME_S
        first = np.maximum.accumulate(np.where(changed, k, 0))
        found.append((ages_s - np.minimum(k - first, longest) * period_s)[longest:])
    return np.stack(found)


def _lost(link: Link, count: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which of `count` datagrams are lost or corrupt; receivers drop corrupt ones."""
    lost = rng.random(count) < 1.0 - (1.0 - link.loss_probability) * (1.0 - link.corrupt_probability)
    if (bursts := link.loss_bursts) is None:
        return lost
    to_bad, to_good = max(bursts.to_bad_probability, _NEVER), bursts.to_good_probability
    lasts = np.column_stack([rng.geometric(to_bad, count), rng.geometric(to_good, count)])
    is_bad = np.searchsorted(np.cumsum(lasts.ravel()), np.arange(count), side="right") % 2 == 1
    return lost | (rng.random(count) < np.where(is_bad, bursts.loss_bad_probability, bursts.loss_good_probability))
