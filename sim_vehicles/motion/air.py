"""Pushes on a vehicle in flight, besides its own acceleration: wind, gusts, and what the fleet adds.

A push is constant over an interval: an acceleration, and a velocity that carries the vehicle along but does not show in
its own velocity. Half of the velocity change is applied before the vehicle's own motion in the interval and half after
it. This is exact for a double integrator within its limits; where motion depends on velocity, the error is of second
order in the interval, which gusts limit to 10 ms.

Gusts are a first-order process with the exact stationary variance, drawn every `STEP_NS` and held. Their times count
from the start of the vehicles, so common gusts push all of them at once.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

from scenarios.keys import disturbance
from scenarios.schema import NS_PER_S, Scenario
from sim_vehicles.links.truth import CARRIED, PUSHED, Recorder, disturbance_row
from sim_vehicles.services.clock import NEVER_NS
from sim_vehicles.services.draws import Use, draws_of

STEP_NS = 10_000_000
"""How long gusts are held."""
_BLOCK = 512


class Push(NamedTuple):
    """A constant acceleration, and a velocity at which the vehicle is carried along."""

    acceleration_north_m_s2: float = 0.0
    acceleration_east_m_s2: float = 0.0
    carried_north_m_s: float = 0.0
    carried_east_m_s: float = 0.0


STILL = Push()
Piece = tuple[float, float, float, float, float]
"""An interval in s; half the change of velocity in it, north and east; and how far the vehicle is carried in it."""


class Gusts:
    """The gusts of one vehicle, north and east, by step number."""

    def __init__(self, gusts: disturbance.Gusts, seed: int, system_id: int) -> None:
        self._draw = draws_of(seed, 0 if gusts.common else system_id, Use.GUSTS)
        self._fades = math.exp(-STEP_NS / NS_PER_S / gusts.correlation_time_s)
        self._deviation_m_s2 = gusts.deviation_m_s2
        north, east = (self._deviation_m_s2 * self._draw.standard_normal(2)).tolist()
        self._first, self._known = 0, [(north, east)]

    def at(self, number: int) -> tuple[float, float]:
        """The gust of a step that has not been forgotten."""
        while number - self._first >= len(self._known):
            (north, east), spread = self._known[-1], self._deviation_m_s2 * math.sqrt(1.0 - self._fades**2)
            for to_north, to_east in (spread * self._draw.standard_normal((_BLOCK, 2))).tolist():
                north, east = self._fades * north + to_north, self._fades * east + to_east
                self._known.append((north, east))
        return self._known[number - self._first]

    def forget(self, number: int) -> None:
        """Forget the steps before this one."""
        old = min(number - self._first, len(self._known) - 1)  # the next gusts continue from the newest
        if old > _BLOCK:
            del self._known[:old]
            self._first += old


class Air:
    """Everything that pushes one vehicle. `add` sets what the fleet adds from now on."""

    def __init__(self, scenario: Scenario, system_id: int, start_ns: int, recorder: Recorder | None) -> None:
        found = scenario.disturbance or disturbance.Disturbance()
        self._wind = found.wind_ne_m_s2
        self._gusts = None if found.gusts is None else Gusts(found.gusts, scenario.seed, system_id)
        self._added = STILL
        self._system_id, self._start_ns, self._recorder = system_id, start_ns, recorder
        self._recorded: Push | None = None

    def add(self, push: Push) -> None:
        """Set what the fleet adds, until the next call; the vehicle must be up to date."""
        self._added = push

    def pieces(self, from_ns: int, to_ns: int, *, foreseen: bool = False) -> Iterator[Piece]:
        """The intervals of constant push, in order. They must be consumed at once.

        In each, half the change of velocity comes before the vehicle's own motion; the other half and the distance that
        it is carried come after it.
        `foreseen`: a look ahead over an interval that will be computed again, so nothing is recorded or forgotten.
        """
        while from_ns < to_ns:
            push, until_ns = self._at(from_ns)
            if not foreseen:
                self._note(push, from_ns)
            until_ns = min(until_ns, to_ns)
            t = (until_ns - from_ns) / NS_PER_S
            yield t, 0.5 * t * push[0], 0.5 * t * push[1], t * push[2], t * push[3]
            from_ns = until_ns

    def _at(self, time_ns: int) -> tuple[Push, int]:
        """The push on the vehicle from a time on, and until when it is constant."""
        (north, east), until_ns = self._wind, NEVER_NS
        if self._gusts is not None:
            number = (time_ns - self._start_ns) // STEP_NS
            gust, until_ns = self._gusts.at(number), self._start_ns + (number + 1) * STEP_NS
            north, east = north + gust[0], east + gust[1]
        added = self._added
        return Push(north + added[0], east + added[1], added[2], added[3]), until_ns

    def _note(self, push: Push, time_ns: int) -> None:
        if self._gusts is not None:
            self._gusts.forget((time_ns - self._start_ns) // STEP_NS)
        if self._recorder is None or push == self._recorded:
            return
        before, self._recorded = self._recorded or STILL, push
        if push[:2] != before[:2]:
            self._recorder.add(disturbance_row(PUSHED, self._system_id, 0, time_ns, push[0], push[1]))
        if push[2:] != before[2:]:
            self._recorder.add(disturbance_row(CARRIED, self._system_id, 0, time_ns, push[2], push[3]))
