"""Flies the identification manoeuvre tick by tick, and makes the flight plan with the identified responses."""

from collections.abc import Iterator, Sequence
from math import hypot
from typing import NamedTuple

import numpy as np

from gcs.autopilot import identify
from gcs.autopilot.identify import Flown, Identified, RunUp
from gcs.control.history import StateHistory
from gcs.link.vehicle import RemoteVehicle, Report
from gcs.plan.flight_plan import FlightPlan, Responses, margin_steps
from scenarios.schema import NS_PER_S

_UNNOTICED_NS = NS_PER_S
"""A clock jump is detected within this time: samples this recent may have wrong instants."""


class _Sample(NamedTuple):
    sampled_ns: int
    seen_ns: int
    velocity_m_s: float
    """In the direction of the manoeuvre."""


class Identification:
    """Collects the vehicles' velocities during the manoeuvre, then computes the result in steps, one per tick.

    The vehicles are first brought to the velocity at which the formation flight begins. The manoeuvre is perpendicular
    to it, or north at rest. If a vehicle did not follow it, the manoeuvre is flown once more: a gust may have passed,
    or a simulator stalled.
    """

    def __init__(self, plan: FlightPlan, vehicles: Sequence[RemoteVehicle], report: Report) -> None:
        self._plan = plan
        self._vehicles = vehicles
        self._report = report
        self._limit_m_s2 = plan.scenario.limits.acceleration_max_m_s2
        self._amplitude_m_s2 = identify.amplitude_m_s2(self._limit_m_s2)
        north, east = plan.scenario.nominal_velocity_at(0.0)
        speed_m_s = hypot(north, east)
        self._direction_ne = (-east / speed_m_s, north / speed_m_s) if speed_m_s > 0.0 else (1.0, 0.0)
        self._run_up: tuple[int, RunUp] | None = None
        """The start time (ns) of the run-up, and the run-up."""
        self._is_repeated = False
        self._begin()

    def _begin(self) -> None:
        self._begin_ns: int | None = None
        self._commands: list[tuple[int, float]] = []
        """Instant (ns) and acceleration (m/s²) of each command in the direction of the manoeuvre."""
        self._downs_ns: list[list[int]] = [[] for _ in self._vehicles]
        """The delay down of each command to each vehicle."""
        self._samples: list[list[_Sample]] = [[] for _ in self._vehicles]
        self._jumps = [vehicle.clock.jumps for vehicle in self._vehicles]
        self._steps = self._result()

    def command(self, due_ns: int) -> tuple[float, float]:
        """The acceleration commanded to all vehicles at a tick; the manoeuvre's part is recorded."""
        if self._run_up is None:
            return 0.0, 0.0
        began_ns, run_up = self._run_up
        since_s = (due_ns - began_ns) / NS_PER_S
        if since_s < run_up.duration_s:
            return run_up.acceleration_m_s2(since_s)
        if self._begin_ns is None:
            self._begin_ns = due_ns
        command = identify.manoeuvre_m_s2((due_ns - self._begin_ns) / NS_PER_S, self._amplitude_m_s2)
        if not self._commands or self._commands[-1][0] < due_ns:  # once for all vehicles
            self._commands.append((due_ns, command))
            for vehicle, downs_ns in zip(self._vehicles, self._downs_ns, strict=True):
                downs_ns.append(vehicle.clock.down_ns or 0)
        north, east = self._direction_ne
        return command * north, command * east

    def next(self, due_ns: int, history: StateHistory) -> FlightPlan | str | None:
        """The plan with the margins of the identified responses, or why there is none; None until either is known."""
        gone = next((v for v in self._vehicles if v.silent or v.taken_over or v.startup.stays_disarmed), None)
        if gone is not None:
            return f"not identified: vehicle {gone.system_id} {gone.missing}"
        if self._run_up is None:
            self._run_up = due_ns, self._run_up_from(history)
        if self._begin_ns is None or due_ns - self._begin_ns < identify.LONGEST_S * NS_PER_S:
            self._observe(due_ns, history)
            return None
        return next(self._steps)

    def _run_up_from(self, history: StateHistory) -> RunUp:
        """The run-up from the mean velocity to the nominal one; none behind a leader that somebody else flies."""
        scenario = self._plan.scenario
        states = [newest[1] for row in range(len(self._vehicles)) if (newest := history.newest(row))]
        if scenario.external_id is not None or not states:
            return identify.run_up((0.0, 0.0), None)
        north, east = np.array(scenario.nominal_velocity_at(0.0)) - np.mean(states, axis=0)[2:]
        return identify.run_up((float(north), float(east)), self._limit_m_s2)

    def _result(self) -> Iterator[FlightPlan | str | None]:
        """Yields None for each step of the computation, then the result."""
        found: dict[int, Identified] = {}
        for row, vehicle in enumerate(self._vehicles):
            seen = yield from identify.identify(self._flown(row))
            if seen is not None and seen.misfit > identify.MISFIT_MAX and not self._is_repeated:
                text = f"{seen.misfit:.0%} of its velocity is unexplained: the manoeuvre is flown once more"
                self._report("response", text, vehicle.system_id)
                self._is_repeated = True
                self._begin()
                yield None
                return
            if seen is None or seen.misfit > identify.MISFIT_MAX:
                yield f"not identified: vehicle {vehicle.system_id} {self._why_not(row, seen)}"
                return
            found[vehicle.system_id] = seen
            self._report("response", in_words(seen), vehicle.system_id)
        of = {system_id: seen.response for system_id, seen in found.items()}
        responses = Responses("identified", of, {system_id: seen.misfit for system_id, seen in found.items()})
        margins_s = yield from margin_steps(self._plan, responses)
        yield self._plan.with_margins(tuple(margins_s), responses)

    def _why_not(self, row: int, seen: Identified | None) -> str:
        way_on = "a [response] in the scenario replaces the manoeuvre"
        flown = self._flown(row)
        if seen is None and not flown.has_too_few_samples:
            return (
                f"reported the same velocity throughout a manoeuvre of {self._amplitude_m_s2:.2g} m/s^2; see that it "
                f"can move and that its LOCAL_POSITION_NED holds its velocity; {way_on}"
            )
        if seen is None:
            rate_hz, asked_hz = flown.sample_s.size / identify.LONGEST_S, self._plan.scenario.rates.telemetry_hz
            return (
                f"sent too little telemetry: {rate_hz:.1f} states a second in the manoeuvre, wanted "
                f"{identify.LEAST_RATE_HZ:g}; raise rates.telemetry_hz (now {asked_hz:g}) or what the link carries; "
                f"{way_on}"
            )
        return (
            f"does not follow a manoeuvre of {self._amplitude_m_s2:.2g} m/s^2: {seen.misfit:.0%} of its velocity is "
            f"unexplained by the best model ({seen.response.model}); see that no wind or limit disturbs it; {way_on}"
        )

    def _observe(self, due_ns: int, history: StateHistory) -> None:
        for row, vehicle in enumerate(self._vehicles):
            if vehicle.clock.jumps != self._jumps[row]:
                self._jumps[row] = vehicle.clock.jumps
                self._samples[row] = [s for s in self._samples[row] if s.seen_ns < due_ns - _UNNOTICED_NS]
            samples, newest = self._samples[row], history.newest(row)
            if newest is not None and (not samples or newest[0] > samples[-1].sampled_ns):
                (north, east), (_, _, v_north, v_east) = self._direction_ne, newest[1]
                samples.append(_Sample(newest[0], due_ns, north * v_north + east * v_east))

    def _flown(self, row: int) -> Flown:
        """The manoeuvre as flown by one vehicle, on the grid of control ticks; missed ticks repeat the previous one."""
        begin_ns, period_s = self._begin_ns or 0, 1.0 / self._plan.scenario.rates.control_hz
        sent_s = (np.array([at_ns for at_ns, _ in self._commands], dtype=np.int64) - begin_ns) / NS_PER_S
        ticks = np.arange(round(float(sent_s[-1]) / period_s) + 1)
        newest = np.searchsorted(np.rint(sent_s / period_s), ticks, side="right") - 1
        command = np.array([acceleration for _, acceleration in self._commands])[newest]
        acts_ns = begin_ns + round(float(np.median(self._downs_ns[row])))
        sampled_ns = np.array([s.sampled_ns for s in self._samples[row]], dtype=np.int64)
        sample_s = (sampled_ns - acts_ns) / NS_PER_S
        inside = (sample_s >= 0.0) & (sample_s <= ticks.size * period_s)
        velocity = np.array([s.velocity_m_s for s in self._samples[row]], dtype=np.float64)
        return Flown(period_s, command, sample_s[inside], velocity[inside])


def in_words(found: Identified) -> str:
    """Describes the response of a vehicle, its misfit and that of the other models."""
    response = found.response
    late = f", dead time {response.dead_time_s:.3f} s" if response.dead_time_s else ""
    if response.natural_frequency_rad_s is not None:
        late = f", natural frequency {response.natural_frequency_rad_s:.1f} rad/s, damping {response.damping:.2f}"
    lag = f"lag {response.lag_s:.3f} s"
    if response.lag_s < 1.001 * identify.LAG_S_LEAST:
        lag = f"lag at most {identify.LAG_S_LEAST:.3f} s, the shortest that is fitted"
    others = ", ".join(f"{name} {misfit:.1%}" for name, misfit in found.misfits.items() if name != response.model)
    return (
        f"{response.model}: {lag}{late}, velocity gain {response.velocity_gain_1_s:.2f} 1/s, "
        f"misfit {found.misfit:.1%} ({others})"
    )
