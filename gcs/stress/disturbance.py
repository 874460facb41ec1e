"""How large a disturbance w = D e breaks the formation in flight: `gcs stress --disturbance`.

The stability radii of the loop as flown (`gains.performance.radii`) give the smallest disturbance that breaks it: its
size and its form. The vehicles apply it to themselves, from their true errors (`sim_vehicles.motion.sector`).
Flights at sizes around the radius each measure the growth; the size at which growth passes zero is the onset.

The flights are probes as in `gcs.stress.free_response`, but every vehicle has an error at the start.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite, pi
from typing import Literal

import numpy as np

from gains.performance.disturbed import DisturbedFormation
from gains.performance.radii import SectorLoop, Worst
from gcs.drive.flown import first_uses, fly_plan, median_delays_s
from gcs.errors import InputError
from gcs.plan.flight_plan import FlightPlan
from gcs.published import Published
from gcs.stress.axes import has_constant_links
from gcs.stress.free_response import LINEAR_COMMAND_M_S2, linear_error_m_s, linear_until_s, probe_scenario
from gcs.stress.growth import GrowthPoint, fit_growth, locate_zero, motion_of
from scenarios.keys.disturbance import Disturbance, Sector
from scenarios.schema import Scenario

Kind = Literal["dynamic", "constant"]
KINDS: tuple[Kind, ...] = "dynamic", "constant"

_AMPLITUDES = (5.0, 0.5, 0.05)
"""Initial errors of a flight in m (m/s for the leader); the next is flown if errors leave the linear range."""
_PILOT_S = 2.0
_SIZES = (-1.0, 0.1, 1.0)
"""Sizes flown in a round, as distances from its middle in tolerances."""
_ROUNDS = 6
_SETTLED_S, _TURNS, _SHORTEST_S, _LONGEST_S = 8.0, 2.0, 20.0, 120.0
"""A flight lasts until all other modes, filters included, have decayed, plus some cycles of the growing mode."""
_MODES = 12


class DisturbanceOnset(Published):
    """Where one kind of disturbance breaks the formation: predicted, and flown."""

    kind: Kind
    vehicles: tuple[int, ...]
    """The vehicles whose errors cause the disturbance and are disturbed by it."""
    radius_1_s: float | None
    """None: no disturbance of this kind is predicted to break the formation. Then nothing is flown."""
    frequency_rad_s: float
    onset_1_s: float | None
    error_1_s: float | None
    difference: float | None
    flights: int
    measured: int
    """The flights with a growth rate."""
    missing: str = ""
    """Why no onset was found, in one line; empty if one was."""


class DisturbanceResult(Published):
    """The onsets of a scenario at one loop delay."""

    scenario: str
    loop_delay_s: float
    onsets: tuple[DisturbanceOnset, ...]
    assert_onset: float | None = None
    failure: str | None = None


@dataclass(frozen=True)
class Case:
    """One onset to find: the loop of one axis, whose errors are disturbed, and its worst disturbance."""

    kind: Kind
    vehicles: tuple[int, ...]
    loop: SectorLoop
    worst: Worst

    def scenario(self, probe: Scenario, size_1_s: float, *, duration_s: float) -> Scenario:
        """The probe's scenario with the worst disturbance, scaled to this size."""
        count, chosen = self.loop.formation.model.states, list(self.loop.errors)
        whole = np.zeros((count, count))
        whole[np.ix_(chosen, chosen)] = self.worst.direction

        def spread(coefficients: tuple[float, ...]) -> tuple[float, ...]:
            if not coefficients:
                return ()
            every = np.ones(count)
            every[chosen] = coefficients
            return tuple(every.tolist())

        sector = Sector(
            norm_1_s=size_1_s,
            direction=tuple(tuple(row) for row in whole.tolist()),
            all_pass_in=spread(self.worst.all_pass_in),
            all_pass_out=spread(self.worst.all_pass_out),
        )
        return probe.model_copy(update={"disturbance": Disturbance(sector=sector), "duration_s": duration_s})


def find_disturbance_onsets(
    plan: FlightPlan,
    *,
    tolerance: float,
    allowed: float | None = None,
    kinds: Sequence[Kind] = KINDS,
    counts: Sequence[int] = (),
    ended: Callable[[], None] = lambda: None,
) -> DisturbanceResult:
    """Fly the worst disturbances at sizes around their stability radii, and locate the onset of each.

    For each of `counts`, that many vehicles are disturbed, the leader first: by default two, and all. As shares of the
    radius, `tolerance` is half the range of sizes in a round, and `allowed` bounds the standard error of an onset and
    its distance from the radius. Calls `ended` after each flight. Raises InputError if the loop has no such radii.
    """
    probes, delay_s = _probes(plan)
    onsets = tuple(
        _onset(plan, probes, case, tolerance, ended) for case in cases(plan, delay_s, kinds=kinds, counts=counts)
    )
    failure = None
    if allowed is not None or all(onset.difference is None for onset in onsets if onset.radius_1_s is not None):
        failure = missed(onsets, inf if allowed is None else allowed)
    return DisturbanceResult(
        scenario=plan.scenario.name, loop_delay_s=delay_s, onsets=onsets, assert_onset=allowed, failure=failure
    )


def missed(onsets: Sequence[DisturbanceOnset], allowed: float) -> str | None:
    """How many onsets with a radius are not measured, too far from it, or too uncertain; None if none is."""
    unknown = [o for o in onsets if o.difference is None and o.radius_1_s is not None]
    off = [o for o in onsets if o.difference is not None and abs(o.difference) > allowed]
    rough = [o for o in onsets if o not in off and (o.error_1_s or 0.0) > allowed * (o.radius_1_s or inf)]
    reasons = (
        (unknown, "not measured"),
        (off, "farther than {} from the radius"),
        (rough, "known less well than to {} of the radius"),
    )
    told = [f"{len(own)} of {len(onsets)} onsets are {why.format(f'{allowed:.3%}')}" for own, why in reasons if own]
    return "; ".join(told) or None


def refusal(scenario: Scenario) -> str | None:
    """Why this scenario cannot be flown with a disturbance, as key, read and wanted; None if it can."""
    control, links = scenario.control, {scenario.link_of(vehicle.system_id) for vehicle in scenario.vehicles}
    wanted = "with --disturbance"
    if len(scenario.vehicles) < 2:
        return f"vehicles: read 1 vehicle, wanted two or more {wanted}"
    if control.loop == "onboard":
        return f"control.loop: read 'onboard', wanted ground {wanted}"
    if scenario.rates.control_hz != scenario.rates.telemetry_hz:
        return f"rates.telemetry_hz: read {scenario.rates.telemetry_hz:g}, wanted rates.control_hz {wanted}"
    if len(links) > 1 or not has_constant_links(scenario):
        return f"links: read several or random ones, wanted one constant delay for all vehicles {wanted}"
    return None


def cases(plan: FlightPlan, delay_s: float, *, kinds: Sequence[Kind] = KINDS, counts: Sequence[int] = ()) -> list[Case]:
    """The onsets to find at a loop delay (s); `counts` as in `find_disturbance_onsets`.

    Raises InputError if gains differ between north and east, or couple them.
    """
    model, K = plan.model.narrowed(plan.gain)
    if model.axes > 1:
        raise InputError("gains: read gains that differ north and east, wanted the same on both with --disturbance")
    T = plan.timing.control_s
    formation = DisturbedFormation(model, model.A, model.B, K, T, delay_s, assumed_s=plan.assumed_s)
    found: list[Case] = []
    for count in dict.fromkeys(counts or (2, model.vehicles)):
        loop = SectorLoop(formation, tuple(range(2 * count - 1)))
        ids = plan.formation.system_ids[:count]
        radii = {"dynamic": loop.complex_radius, "constant": loop.real_radius}
        found += [Case(kind, ids, loop, radii[kind]()) for kind in kinds]
    return found


def _probes(plan: FlightPlan) -> tuple[list[Scenario], float]:
    """The flights that the disturbance is added to, one for each amplitude, and their loop delay (s)."""
    ids = plan.formation.system_ids
    pilot = fly_plan(replace(plan, scenario=_calm(plan.scenario, _PILOT_S)))
    up, down = plan.scenario.link_of(ids[0])
    waiting_s = max(median_delays_s(first_uses(pilot.ticks), ids).values()) - up.delay_s - down.delay_s
    waits_s = round(waiting_s, 6) % plan.timing.step_s
    probes = [
        probe_scenario(plan, ids, amplitude=amplitude, links=(up, down), waiting_s=waits_s) for amplitude in _AMPLITUDES
    ]
    calm = fly_plan(replace(plan, scenario=_calm(probes[0], _PILOT_S)))
    return probes, round(max(median_delays_s(first_uses(calm.ticks), ids).values()), 6)


def _calm(scenario: Scenario, duration_s: float) -> Scenario:
    return scenario.model_copy(update={"disturbance": None, "navigation": None, "duration_s": duration_s})


def _onset(
    plan: FlightPlan, probes: Sequence[Scenario], case: Case, tolerance: float, ended: Callable[[], None]
) -> DisturbanceOnset:
    radius, omega = case.worst.radius_1_s, case.worst.frequency_rad_s
    turns_s = _TURNS * 2.0 * pi / omega if omega > 0.0 else 0.0
    duration_s = min(max(_SETTLED_S + turns_s, _SHORTEST_S), _LONGEST_S)
    points: list[GrowthPoint] = []
    sizes: list[float] = []
    probe, *smaller = probes
    zero, middle, width, linear = None, radius, tolerance * radius, True
    for _ in range(_ROUNDS if radius < inf else 0):
        for part in _SIZES:
            size = max(0.0, middle + part * width)
            while True:
                measured, linear = _flown(plan, case.scenario(probe, size, duration_s=duration_s), size)
                sizes.append(size)
                ended()
                if linear or not smaller:
                    break
                probe = smaller.pop(0)
            points += measured
        zero = locate_zero([point for point in points if abs(point.varied - middle) <= 1.001 * width])
        if not points or (zero is not None and zero.inside):
            break
        if zero is not None:  # move to where growth seems to pass zero, by three widths at most
            middle += float(np.clip(zero.varied - middle, -3.0 * width, 3.0 * width))
        else:  # nothing is known but the side: growth above zero everywhere says that the onset is at a smaller size
            middle += -2.0 * width if min(point.growth_1_s for point in points) > 0.0 else 2.0 * width
    inside = zero if zero is not None and zero.inside else None
    onset = None if inside is None else inside.varied
    missing = ""
    if not sizes:
        missing = "no disturbance of this kind breaks the formation"
    elif not points:
        span = f"velocity errors up to {linear_error_m_s(probe):g} m/s, commands up to {LINEAR_COMMAND_M_S2:g} m/s²"
        missing = f"no growth rate in {len(sizes)} flights"
        missing += "" if linear else f", which left the linear range: {span}"
    elif onset is None:
        missing = f"growth did not pass zero in {len(sizes)} flights with {min(sizes):.5f} to {max(sizes):.5f} 1/s"
    return DisturbanceOnset(
        kind=case.kind,
        vehicles=case.vehicles,
        radius_1_s=radius if radius < inf else None,
        frequency_rad_s=omega,
        onset_1_s=onset,
        error_1_s=None if inside is None else inside.error,
        difference=None if onset is None else onset / radius - 1.0,
        flights=len(sizes),
        measured=len(points),
        missing=missing,
    )


def _flown(plan: FlightPlan, scenario: Scenario, size_1_s: float) -> tuple[list[GrowthPoint], bool]:
    """The growth in one flight with a disturbance of a size, empty if not measured, and whether it stayed linear."""
    flight, ids = fly_plan(replace(plan, scenario=scenario)), plan.formation.system_ids
    rows = flight.ticks[flight.ticks["commanded"] & (flight.ticks["time_s"] >= 0.0)]
    motion = motion_of(flight.ticks, ids, period_s=plan.timing.control_s)
    until_s = linear_until_s(rows, linear_error_m_s(scenario), LINEAR_COMMAND_M_S2)
    growth = fit_growth(motion, start_s=_SETTLED_S, end_s=until_s, modes=_MODES)
    points = [] if growth is None else [GrowthPoint(size_1_s, growth.growth_1_s, growth.error_1_s)]
    return points, not isfinite(until_s)
