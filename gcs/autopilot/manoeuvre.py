"""The identification manoeuvre of all vehicles, tick by tick, and the flight plan with the responses found."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from gains.performance.response import Response, sampled_margin
from gcs.autopilot.identify import LONGEST_S, MISFIT_MAX, PROFILE, Identified, amplitude_m_s2, identify, manoeuvre_m_s2
from gcs.control.history import StateHistory
from gcs.link.vehicle import RemoteVehicle, Report
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.responses import Responses
from scenarios.schema import NS_PER_S

_UNNOTICED_NS = NS_PER_S
"""A clock jump is noticed within this time; samples since then have wrong instants."""


class _Sample(NamedTuple):
    sampled_ns: int
    seen_ns: int
    velocity_north_m_s: float


class Identification:
    """Collects the vehicles' velocities during the manoeuvre, then computes the result in steps, one per tick."""

    def __init__(self, plan: FlightPlan, vehicles: Sequence[RemoteVehicle], report: Report) -> None:
        self._plan = plan
        self._vehicles = vehicles
        self._report = report
        self._amplitude_m_s2 = amplitude_m_s2(plan.scenario.limits.acceleration_max_m_s2)
        self._begin_ns: int | None = None
        self._acted_ns: list[list[int]] = [[] for _ in vehicles]
        """When each change of the acceleration acted."""
        self._samples: list[list[_Sample]] = [[] for _ in vehicles]
        self._jumps = [vehicle.clock.jumps for vehicle in vehicles]
        self._steps = self._result()

    def command(self, due_ns: int) -> tuple[float, float]:
        """The acceleration that all vehicles are commanded at a tick; notes when it changes."""
        if self._begin_ns is None:
            self._begin_ns = due_ns
        since_s = (due_ns - self._begin_ns) / NS_PER_S
        begun = sum(at_s <= since_s for at_s, _ in PROFILE)
        for vehicle, acted in zip(self._vehicles, self._acted_ns, strict=True):
            if len(acted) < begun:
                acted.append(due_ns + (vehicle.clock.down_ns or 0))
        return manoeuvre_m_s2(since_s, self._amplitude_m_s2)

    def next(self, due_ns: int, history: StateHistory) -> FlightPlan | str | None:
        """The plan with the margins of the responses found, or why there is none; None while it takes longer."""
        gone = next((v for v in self._vehicles if v.silent or v.taken_over), None)
        if gone is not None:
            return f"not identified: vehicle {gone.system_id} {gone.missing}"
        if self._begin_ns is None or due_ns - self._begin_ns < LONGEST_S * NS_PER_S:
            self._observe(due_ns, history)
            return None
        return next(self._steps)

    def _result(self) -> Iterator[FlightPlan | str | None]:
        """The result, after a None for each step before it."""
        found: dict[int, Response] = {}
        for row, vehicle in enumerate(self._vehicles):
            seen = self._fit(row)
            if seen is None:
                yield f"not identified: vehicle {vehicle.system_id} sent too little telemetry in the manoeuvre"
                return
            if seen.misfit > MISFIT_MAX:
                yield (
                    f"not identified: vehicle {vehicle.system_id} does not respond with a lag: {seen.misfit:.0%} of "
                    "its velocity is unexplained; [response] in the scenario replaces the manoeuvre"
                )
                return
            response = found[vehicle.system_id] = seen.response
            answer = f"lag {response.lag_s:.3f} s, velocity gain {response.velocity_gain_1_s:.2f} 1/s"
            self._report("response", f"{answer}, misfit {seen.misfit:.1%}", vehicle.system_id)
            yield None
        responses = Responses("identified", found)
        of, margins_s = responses.in_order(self._plan.formation.system_ids), list[float]()
        for K in self._plan.gains:
            margins_s.append(sampled_margin(self._plan.model, K, of, timing=self._plan.timing))
            yield None
        yield self._plan.with_margins(tuple(margins_s), responses)

    def _observe(self, due_ns: int, history: StateHistory) -> None:
        for row, vehicle in enumerate(self._vehicles):
            if vehicle.clock.jumps != self._jumps[row]:
                self._jumps[row] = vehicle.clock.jumps
                self._samples[row] = [s for s in self._samples[row] if s.seen_ns < due_ns - _UNNOTICED_NS]
            samples, newest = self._samples[row], history.newest(row)
            if newest is not None and (not samples or newest[0] > samples[-1].sampled_ns):
                samples.append(_Sample(newest[0], due_ns, newest[1][2]))

    def _fit(self, row: int) -> Identified | None:
        begin_ns = self._begin_ns or 0
        acted_s = (np.array(self._acted_ns[row], dtype=np.int64) - begin_ns) / NS_PER_S
        change = self._amplitude_m_s2 * np.array([size for _, size in PROFILE[: acted_s.size]])
        samples = [s for s in self._samples[row] if s.sampled_ns >= begin_ns]
        sample_s = (np.array([s.sampled_ns for s in samples], dtype=np.int64) - begin_ns) / NS_PER_S
        return identify(acted_s, change, sample_s, np.array([s.velocity_north_m_s for s in samples], dtype=np.float64))
