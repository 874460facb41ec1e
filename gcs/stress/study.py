"""The trials that a campaign flies: over its axes, and in search of the onset."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import Annotated

import numpy as np
from pydantic import PlainSerializer

from gains.sampled.coupled_block import first_of_each_kind
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.loops import is_modelled, plan_loops, unstable_over_links, window_of
from gcs.plan.mismatch import Window
from gcs.stress.axes import Axis, at_coordinates, has_constant_links
from gcs.stress.growth import GrowthPoint, Zero, locate_zero
from gcs.stress.trial import CRITICAL, Kind, Outcome, Run, Trial, sparse_gain
from scenarios.schema import Scenario

_BRACKET_LINKS_S = (0.0, 0.05, 0.1, 0.2), (0.4, 0.8, 1.6)
"""Link delays (s), up plus down, flown to bracket where errors begin to grow: the second group if errors do not grow in
the first."""
_ROUNDS = 8
_FLIGHTS_A_ROUND = 5
_LIMITLESS_LINKS_S = (0.0, 0.5, 1.0, 1.5, 2.0)
"""Link delays flown where no delay is predicted to break the formation."""
_FIRST_WIDTH, _FINEST_WIDTH = 3.0, 0.1
"""Half widths of the first and the finest round of an onset search, in tolerances."""
_LARGEST_ERROR = 0.1
"""Largest standard error of an onset as a share of the prediction; with a larger one, no onset was measured."""
_SMOOTH_MISFIT = 3.0
"""Root mean square misfit, in standard errors, above which flights do not lie on a parabola."""
_AT_ONCE = "the formation breaks without any link delay"
_NONE_SHORT = "no link delay is short enough to break the formation"


@dataclass(frozen=True)
class Study:
    """The trials of a scenario. They all use one plan, whose gains stay the same whatever else varies."""

    plan: FlightPlan
    real_time: bool = False

    @cached_property
    def window_s(self) -> Window:
        """Range of loop delays in which the plan is predicted to be stable; it starts at 0 without prediction."""
        assumed_s, tolerated = self.plan.assumed_s or 0.0, self.plan.tolerance(0.0)
        return max(0.0, assumed_s - tolerated.shorter_s[0]), assumed_s + tolerated.longer_s[0]

    def window_of(self, vehicle: int | None) -> Window:
        """The range of loop delays if only the link of `vehicle` is slowed; None slows all links, as `window_s`."""
        return self.window_s if vehicle is None else window_of(self.plan, vehicle)

    def trial(self, kind: Kind, coordinates: dict[str, float], *, seed: int, probe: int = CRITICAL) -> Trial:
        """The trial at one point. `seed` is that of its scenario, from which clocks, jitter and loss are drawn."""
        scenario = at_coordinates(self.plan.scenario, coordinates).model_copy(update={"seed": seed})
        return Trial(
            scenario=scenario,
            gain=sparse_gain(self.plan.gain),
            delay_margin_s=self.plan.delay_margin_s,
            kind=kind,
            probe=probe,
            real_time=self.real_time,
            coordinates=tuple(coordinates.items()),
            responses=self.plan.responses,
        )

    def sweep(self, axes: Sequence[Axis], *, seeds: int) -> list[Trial]:
        """The trials of a sweep (one axis) or map (two), with `seeds` successive seeds, beginning with the scenario's.

        Every point gets a probe and an own trial. In real time on random links it gets only the own trial: no two
        flights have the same delays, so there is no free response to probe.
        """
        points = [dict(zip([a.name for a in axes], at, strict=True)) for at in product(*(a.values for a in axes))]
        constant = all(has_constant_links(at_coordinates(self.plan.scenario, point)) for point in points)
        kinds: tuple[Kind, ...] = ("own",) if self.real_time and not constant else ("probe", "own")
        first = self.plan.scenario.seed
        return [self.trial(kind, point, seed=first + k) for kind, point, k in product(kinds, points, range(seeds))]


_Flights = tuple[Annotated[Outcome, PlainSerializer(lambda outcome: outcome.id)], ...]
"""Outcomes, which are written to JSON as their ids."""


@dataclass(frozen=True)
class Onset:
    """Where the formation breaks, in flight and in the models.

    Delays are loop delays of the vehicle that breaks first. Only `link_delay_s` is a link delay, up plus down: the loop
    delay minus `waiting_s`, the median wait of the flights. `link_delay_range_s` holds the link delays by their longest
    and their shortest wait; `waits_for` says in words what datagrams wait for. `predicted_s` is the sampled margin of
    the design or, with prediction, the end of its mismatch window; for a loop shared over different links it is where
    the growth predicted for the flights passes zero. `difference` is `loop_delay_s` / `predicted_s` − 1.
    `predicted_continuous_s` is the same for the continuous model, less half a period for the hold. The predictions are
    None without a linear model: for a nonlinear law, or for the user's own dynamics.

    `loop` lists the vehicles of the loop that breaks. `vehicle` is the one whose link alone was slowed: all delays are
    then its own, and `link_delay_left_s` is how much longer its link delay may be than in the scenario. Both are None
    if all links were slowed alike.
    """

    loop_delay_s: float
    error_s: float
    predicted_s: float | None
    predicted_continuous_s: float | None
    difference: float | None
    link_delay_s: float
    link_delay_range_s: tuple[float, float]
    waiting_s: float
    waits_for: str
    slope_1_s2: float
    frequency_rad_s: float | None
    probed: int
    critical: int
    rounds: int
    flights: _Flights
    checks: _Flights
    """Probes of the other kinds of loops and of the last vehicle, at the onset."""
    vehicle: int | None
    link_delay_left_s: float | None
    loop: tuple[int, ...]
    own: _Flights
    """Own trials at 0.9 and 1.1 times the onset's link delay; with prediction, half the mismatch to either side."""


class NoOnset(Exception):  # noqa: N818 - a finding about the formation, not a fault
    """No delay breaks the formation, or none was found; the text is one line that says why.

    `as_predicted` says that the prediction has none either, and that the flights confirm it.
    """

    def __init__(self, line: str, *, as_predicted: bool = False) -> None:
        super().__init__(line)
        self.as_predicted = as_predicted


def find_onset(study: Study, run: Run, *, tolerance: float, shorter: bool = False, vehicle: int | None = None) -> Onset:
    """Fly probes ever closer around the predicted onset, until the zero of their growth rates is located.

    The flights of the first round are spread evenly over three tolerances to either side, those of the next over one,
    and those of later rounds over a fraction of one if no smooth curve fits. Flights that scatter, as over random
    links, are spread farther until the standard error is a quarter of their range. The search follows the measured
    growth; the prediction only gives its start. Without a prediction, flights give the start (`bracketed`). `shorter`
    looks for the onset below the assumed delay of a station that predicts, where growth falls as the delay rises. If
    `vehicle` is given, its link alone is slowed, else all links alike. Raises NoOnset with the reason.
    """
    slowed = _Slowed(study, vehicle)
    expected_s, way = study.window_of(vehicle)[0 if shorter else 1], -1.0 if shorter else 1.0
    if vehicle is not None and (unstable := unstable_over_links(study.plan, but=vehicle)):
        who = f"vehicle{'s' * (len(unstable) > 1)} {' '.join(map(str, unstable))}"
        raise NoOnset(f"the links of the scenario alone make {who} unstable, by prediction")
    if expected_s == np.inf:
        raise _no_limit(slowed, run, tolerance=tolerance)
    if expected_s <= 0.0:
        raise NoOnset(f"the predicted margin is {expected_s:g} s: there is no delay at which it is stable")
    first_seed = study.plan.scenario.seed
    centre_s, width_s = expected_s - study.plan.timing.faster_s / 2.0, _FIRST_WIDTH * tolerance * expected_s
    if np.isnan(expected_s):
        found = bracketed(partial(slowed.probe, seed=first_seed), run)
        if isinstance(found, str):
            raise NoOnset(found)
        expected_s, width_s = (found[0] + found[1]) / 2.0, (found[1] - found[0]) / 2.0
        centre_s = expected_s
    flights: dict[str, Outcome] = {}
    zero, scatters = None, False
    random_links = not has_constant_links(study.plan.scenario)
    noisy = study.real_time or random_links  # closer flights would show only noise
    for round_number in range(1, _ROUNDS + 1):
        spread = centre_s + width_s * np.linspace(-1.0, 1.0, _FLIGHTS_A_ROUND)
        links_s = dict.fromkeys(round(float(delay_s), 6) for delay_s in np.maximum(spread, 0.0))
        # On random links each flight draws its own delays. With the same draws, all rates would have the same error,
        # and their scatter would not show it.
        trials = [
            slowed.probe(link_s, seed=first_seed + (len(flights) + k if random_links else 0))
            for k, link_s in enumerate(links_s)
        ]
        flights |= _flown(trials, run)
        near = [o for o in flights.values() if abs((o.link_delay_s or 0.0) - centre_s) <= 1.001 * width_s]
        grown = (
            GrowthPoint(way * o.loop_delay_s, o.growth_1_s, o.growth_error_1_s or 0.0)
            for o in near
            if o.loop_delay_s is not None and o.growth_1_s is not None
        )
        zero = locate_zero(list(grown))
        if zero is None:
            all_grow = min((o.growth_1_s for o in near if o.growth_1_s is not None), default=0.0) > 0.0
            centre_s, width_s = centre_s + way * (-width_s if all_grow else width_s), 2.0 * width_s
            continue
        zero = replace(zero, varied=way * zero.varied)
        waiting_s = _waiting_s(near)
        ahead_s = max(0.0, zero.varied - waiting_s) - centre_s
        scatters = zero.error > min(width_s / 2.0, _LARGEST_ERROR * expected_s)
        if scatters:
            width_s = min(2.0 * width_s, expected_s)
            continue
        wanted_s = tolerance * expected_s
        fine = width_s <= 1.001 * wanted_s or zero.error > wanted_s  # closer flights would show only noise
        close = noisy or zero.misfit <= _SMOOTH_MISFIT or width_s <= 1.001 * _FINEST_WIDTH * wanted_s
        if zero.inside and close and fine:
            return _found(slowed, run, zero, near, tuple(flights.values()), rounds=round_number, shorter=shorter)
        if centre_s <= 0.0 and ahead_s <= 0.0:
            break
        # at most twice the width at once: extrapolating farther would be a guess
        centre_s += float(np.clip(ahead_s, -2.0 * width_s, 2.0 * width_s))
        if abs(ahead_s) < width_s:
            width_s = wanted_s if width_s > 1.001 * wanted_s else _FINEST_WIDTH * wanted_s
    raise _not_located(list(flights.values()), zero if scatters else None, shorter=shorter)


def _flown(trials: list[Trial], run: Run) -> dict[str, Outcome]:
    """The outcomes of a round by their ids; raises NoOnset if all its flights were aborted."""
    outcomes = run(trials)
    if all(outcome.verdict == "aborted" for outcome in outcomes):
        raise NoOnset(f"all {len(outcomes)} flights were aborted, the first: {outcomes[0].reason}")
    return {outcome.id: outcome for outcome in outcomes}


def _not_located(flights: Sequence[Outcome], scattered: Zero | None, *, shorter: bool) -> NoOnset:
    flown_s = [outcome.link_delay_s or 0.0 for outcome in flights]
    count = f"{len(flights)} flight{'s' * (len(flights) != 1)}"
    flown = f"in {count} with {min(flown_s):.3f} to {max(flown_s):.3f} s of link delay"
    if not shorter and min(flown_s) == 0.0 and all((own.growth_1_s or 0.0) > 0.0 for own in flights):
        return NoOnset(f"{_AT_ONCE}: errors grow {flown}, and waiting alone takes {_waiting_s(flights):.3f} s")
    if shorter and min(flown_s) == 0.0 and all((own.growth_1_s or 0.0) < 0.0 for own in flights):
        expected = all((own.predicted_growth_1_s or 0.0) < 0.0 for own in flights)
        return NoOnset(f"{_NONE_SHORT}: errors decay {flown}", as_predicted=expected)
    if scattered is not None:
        at = f"{scattered.varied:.3f} s ± {scattered.error:.3f} s of loop delay"
        return NoOnset(f"growth rates scatter too much {flown}: they pass zero at {at}")
    failed = sum(outcome.growth_1_s is None for outcome in flights)
    return NoOnset(f"growth did not pass zero {flown} ({failed} without a growth rate)")


@dataclass(frozen=True)
class _Slowed:
    """The links that a search slows down: those of one vehicle, or all alike."""

    study: Study
    vehicle: int | None

    def at(self, link_s: float) -> dict[str, float]:
        """The coordinates of a link delay, up plus down."""
        return {"delay" if self.vehicle is None else f"delay_{self.vehicle}": link_s}

    def probe(self, link_s: float, *, seed: int) -> Trial:
        return self.study.trial("probe", self.at(link_s), seed=seed, probe=self.vehicle or CRITICAL)


def _no_limit(slowed: _Slowed, run: Run, *, tolerance: float) -> NoOnset:
    """Fly a loop that no delay is predicted to break, and report what the flights show."""
    flown = run([slowed.probe(d, seed=slowed.study.plan.scenario.seed) for d in _LIMITLESS_LINKS_S])
    known = _growth_pairs(flown)
    off = max((abs(measured - predicted) / abs(predicted) for measured, predicted in known), default=np.inf)
    steady = len(known) == len(flown) and off <= tolerance and all(measured < 0.0 for measured, _ in known)
    first_s, *_, last_s = _LIMITLESS_LINKS_S
    said = f"the margin has no limit; in {len(flown)} flights with {first_s:g} to {last_s:g} s of link delay"
    if not known:
        return NoOnset(f"{said} no growth rate could be measured")
    slowest, expected = max(known)
    unknown = f"; {len(flown) - len(known)} flights have no growth rate" if len(known) < len(flown) else ""
    return NoOnset(
        f"{said} errors decay at {-slowest:.5f} 1/s or faster, predicted {-expected:.5f} 1/s, at most {off:.3%} "
        f"apart{unknown}",
        as_predicted=steady,
    )


def _growth_pairs(outcomes: Sequence[Outcome]) -> list[tuple[float, float]]:
    pairs = ((outcome.growth_1_s, outcome.predicted_growth_1_s) for outcome in outcomes)
    return [(measured, predicted) for measured, predicted in pairs if measured is not None and predicted is not None]


def curve_error(outcomes: Sequence[Outcome]) -> float | None:
    """Largest difference between measured and predicted growth rates, as a share of the range of the predicted ones."""
    pairs = _growth_pairs([outcome for outcome in outcomes if outcome.kind == "probe"])
    if len(pairs) < 2:
        return None
    measured, predicted = np.array(pairs, dtype=float).T
    spread = float(np.ptp(predicted))
    return float(np.abs(measured - predicted).max()) / spread if spread > 0.0 else None


def _waits_s(outcomes: Sequence[Outcome]) -> list[float]:
    return [o.loop_delay_s - o.link_delay_s for o in outcomes if o.loop_delay_s and o.link_delay_s is not None] or [0.0]


def _waiting_s(outcomes: Sequence[Outcome]) -> float:
    return float(np.median(_waits_s(outcomes)))


def _waits_for(scenario: Scenario, system_id: int) -> str:
    """What the datagrams of a vehicle wait for, beside their link delay."""
    links = scenario.link_of(system_id)
    causes = {
        "the queue of its channel": any(link.channel for link in links),
        "jitter": any(link.jitter for link in links),
        "lost datagrams": any(link.loss_probability or link.loss_bursts or link.corrupt_probability for link in links),
    }
    found = ", ".join(cause for cause, there in causes.items() if there)
    return f"{found} and the control tick" if found else "the control tick"


def _found(
    slowed: _Slowed,
    run: Run,
    zero: Zero,
    near: Sequence[Outcome],
    flights: tuple[Outcome, ...],
    *,
    rounds: int,
    shorter: bool,
) -> Onset:
    waiting_s = _waiting_s(near)
    if zero.varied < waiting_s:
        what = _NONE_SHORT if shorter else _AT_ONCE
        at = f"{zero.varied:.3f} s ± {zero.error:.3f} s of loop delay"
        raise NoOnset(f"{what}: growth passes zero at {at}, and waiting alone takes {waiting_s:.3f} s")
    study, vehicle, blocks = slowed.study, slowed.vehicle, plan_loops(slowed.study.plan)
    nearest = min(near, key=lambda outcome: abs((outcome.loop_delay_s or np.inf) - zero.varied))
    assert nearest.probed is not None
    assert nearest.critical is not None
    block = next(block for block in blocks if nearest.probed in block.system_ids)
    end, way = (0, -1.0) if shorter else (1, 1.0)
    ends_s = [way * kind.window_s()[end] for kind in first_of_each_kind(blocks)]
    # for the loop that breaks first, test the margin that the station flies by
    own_s = block.window_s()[end]
    predicted_s = study.window_s[end] if way * own_s == min(ends_s) or not is_modelled(study.plan) else own_s
    continuous_s = block.window_continuous_s()[end] if is_modelled(study.plan) else None
    seed, link_s = study.plan.scenario.seed, zero.varied - waiting_s
    at_onset = slowed.at(round(link_s, 6))
    at_links = at_coordinates(study.plan.scenario, at_onset)
    if len({at_links.link_of(own) for own in block.system_ids}) > 1:  # the margin depends on the delays of all
        predicted_s, continuous_s = (
            _zero_of(near, name, way) for name in ("predicted_growth_1_s", "predicted_growth_continuous_1_s")
        )
    others = [unlike.system_ids[0] for unlike in first_of_each_kind(blocks) if unlike.kind != block.kind]
    others = dict.fromkeys([*others, blocks[-1].system_ids[-1]])
    others = [own for own in others if vehicle is None or own not in block.system_ids]
    checks = run([study.trial("probe", at_onset, seed=seed, probe=system_id) for system_id in others])
    # with prediction, stay away from the other end of the window
    assumed_s = study.plan.assumed_s
    aside_s = 0.1 * link_s if assumed_s is None or np.isnan(predicted_s) else 0.5 * abs(predicted_s - assumed_s)
    beside_s = [round(max(0.0, link_s + part * aside_s), 6) for part in (-1.0, 1.0)]
    own = run([study.trial("own", slowed.at(delay_s), seed=seed) for delay_s in beside_s])
    links = () if vehicle is None else study.plan.scenario.link_of(vehicle)
    waits_s = _waits_s(near)
    frequencies = [outcome.frequency_rad_s for outcome in near if outcome.frequency_rad_s is not None]
    critical = nearest.critical if vehicle is None else vehicle
    return Onset(
        loop_delay_s=zero.varied,
        error_s=zero.error,
        predicted_s=None if np.isnan(predicted_s) else predicted_s,
        predicted_continuous_s=continuous_s,
        difference=None if np.isnan(predicted_s) else zero.varied / predicted_s - 1.0,
        link_delay_s=link_s,
        link_delay_range_s=(max(0.0, zero.varied - max(waits_s)), max(0.0, zero.varied - min(waits_s))),
        waiting_s=waiting_s,
        waits_for=_waits_for(study.plan.scenario, critical),
        slope_1_s2=zero.slope,
        frequency_rad_s=float(np.median(frequencies)) if frequencies else None,
        probed=nearest.probed,
        critical=critical,
        rounds=rounds,
        flights=tuple(sorted(flights, key=lambda outcome: outcome.link_delay_s or 0.0)),
        checks=tuple(checks),
        vehicle=vehicle,
        loop=block.system_ids,
        link_delay_left_s=link_s - sum(link.delay_max_s for link in links) if links else None,
        own=tuple(own),
    )


def _zero_of(flights: Sequence[Outcome], growth: str, way: float) -> float:
    """The loop delay (s) at which the growth rate predicted for these flights passes zero; NaN if it does not."""
    known = [(o.loop_delay_s, getattr(o, growth)) for o in flights]
    zero = locate_zero(
        [GrowthPoint(way * at_s, rate, 0.0) for at_s, rate in known if at_s is not None and rate is not None]
    )
    return np.nan if zero is None else way * zero.varied


def bracketed(trial_at: Callable[[float], Trial], run: Run) -> tuple[float, float] | str:
    """Fly link delays until two bracket where errors begin to grow; returns these, or one line that says why not."""
    before_s = None
    for links_s in _BRACKET_LINKS_S:
        outcomes = run([trial_at(link_s) for link_s in links_s])
        for link_s, growth_1_s in zip(links_s, (outcome.growth_1_s for outcome in outcomes), strict=True):
            if growth_1_s is None:
                return f"the margin is unknown, and no growth rate could be measured at {link_s:g} s of link delay"
            if growth_1_s > 0.0:
                if before_s is None:
                    return f"errors grow at {growth_1_s:+.4g} 1/s with the shortest link delay: no delay is stable"
                return before_s, link_s
            before_s = link_s
    return f"the margin is unknown, and errors decay in flights with up to {before_s:g} s of link delay"
