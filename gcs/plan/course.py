"""The planned motion of a manoeuvring formation: place, velocity and acceleration of each vehicle over time.

The nominal velocity v_d(t) has the heading psi(t), and formation changes move the places b_k(t) relative to the leader.
Vehicle k is to fly

    r_k = integral of v_d + R b_k,    R = 1 with fixed offsets, the rotation by psi with offsets in the heading frame.

`PlannedMotion` gives R b_k and the first two derivatives of r_k. Only flights that manoeuvre are controlled by one.
"""

from bisect import bisect_right
from collections.abc import Iterator
from itertools import combinations
from math import cos, hypot, inf, sin
from typing import NamedTuple

import numpy as np

from gains.core.arrays import FloatArray
from gcs.plan.formation import Formation, plan_formation
from scenarios.schema import Scenario
from scenarios.smooth import smooth_step

Vector = tuple[float, float]
_MOMENTS = 200
"""Number of intervals into which each change is divided to evaluate planned motions."""


class Reference(NamedTuple):
    """The planned motion of one vehicle at one time, north and east."""

    place_m: Vector
    """Relative to the leader's planned position."""
    velocity_m_s: Vector
    acceleration_m_s2: Vector


class Largest(NamedTuple):
    """The extremes of one vehicle's planned motion."""

    speed_min_m_s: float
    speed_max_m_s: float
    acceleration_max_m_s2: float
    turn_rate_max_rad_s: float


class _Span(NamedTuple):
    """Places before and after a formation change, in the frame of the offsets."""

    from_s: float
    duration_s: float
    before: list[complex]
    after: list[complex]


class PlannedMotion:
    """The motion that a scenario asks of its vehicles; rows are in the order of the formation.

    If the leader is flown externally, velocities are relative to the leader's.
    """

    def __init__(self, scenario: Scenario, formation: Formation) -> None:
        self._course = scenario.smooth_course() if scenario.course.is_smooth else None
        self._scenario = scenario
        self._behind_another = scenario.course.leader == "external"
        self._turns = scenario.course.offsets == "heading"
        self._spans = list(_spans(scenario, formation))
        self._from_s = [span.from_s for span in self._spans[1:]]

    def reference(self, row: int, time_s: float, opening: float = 1.0) -> Reference:
        """The planned motion of a vehicle at a scenario time, with all spacings multiplied by `opening`."""
        place, velocity, acceleration = self._place(row, time_s)
        if self._behind_another:
            nominal = nominal_acceleration = 0j
        elif self._course is None:
            nominal, nominal_acceleration = complex(*self._scenario.nominal_velocity_at(time_s)), 0j
        else:
            at = self._course.at(time_s)
            nominal, nominal_acceleration = complex(*at.velocity_ne_m_s), complex(*at.acceleration_ne_m_s2)
            if self._turns:
                turned, w = complex(cos(at.heading_rad), sin(at.heading_rad)), at.turn_rate_rad_s
                acceleration += 2j * w * velocity + (1j * at.turn_acceleration_rad_s2 - w * w) * place
                velocity += 1j * w * place
                place, velocity, acceleration = turned * place, turned * velocity, turned * acceleration
        nominal += opening * velocity
        nominal_acceleration += opening * acceleration
        return Reference(
            (opening * place.real, opening * place.imag),
            (nominal.real, nominal.imag),
            (nominal_acceleration.real, nominal_acceleration.imag),
        )

    def _place(self, row: int, time_s: float) -> tuple[complex, complex, complex]:
        """Place relative to the leader, with its derivatives, in the frame of the offsets: north + 1j east."""
        span = self._spans[bisect_right(self._from_s, time_s)]
        before, change = span.before[row], span.after[row] - span.before[row]
        if not change:
            return before, 0j, 0j
        s, ds, dds = smooth_step((time_s - span.from_s) / span.duration_s)
        return before + s * change, ds / span.duration_s * change, dds / span.duration_s**2 * change

    def places_ne_m(self, time_s: float) -> FloatArray:
        """Places relative to the leader at a time, (n, 2)."""
        return np.array([self.reference(row, time_s).place_m for row in range(len(self._spans[0].before))])

    def changes(self) -> list[tuple[float, float, FloatArray, FloatArray]]:
        """The start and each formation change: its time and duration, and the places (n, 2) before and after it.

        The places are in the frame of the offsets.
        """
        return [(span.from_s, span.duration_s, _array(span.before), _array(span.after)) for span in self._spans]

    def largest(self, row: int) -> Largest:
        """The extremes at the start and over every change, sampled densely; between changes the motion is steady."""
        changes = [(span.from_s, span.duration_s) for span in self._spans[1:]]
        if self._course is not None:
            changes += [(change.from_s, change.duration_s) for change in self._course.changes]
        moments = {from_s + duration_s * k / _MOMENTS for from_s, duration_s in changes for k in range(_MOMENTS + 1)}
        moments |= {0.0, *(entry.from_s for entry in self._scenario.nominal_velocity)}
        slowest, fastest, most, fastest_turn = inf, 0.0, 0.0, 0.0
        for time_s in sorted(t for t in moments if t <= self._scenario.duration_s):
            _, (v_n, v_e), (a_n, a_e) = self.reference(row, time_s)
            speed = hypot(v_n, v_e)
            slowest, fastest, most = min(slowest, speed), max(fastest, speed), max(most, hypot(a_n, a_e))
            fastest_turn = max(fastest_turn, abs(v_n * a_e - v_e * a_n) / max(speed, 1e-9) ** 2)
        return Largest(slowest, fastest, most, fastest_turn)


def _array(places: list[complex]) -> FloatArray:
    return np.array([[place.real, place.imag] for place in places])


def _spans(scenario: Scenario, formation: Formation) -> Iterator[_Span]:
    """The places at the start, then those before and after each formation change."""
    offsets = {v.system_id: complex(*(v.offset_ne_m or (0.0, 0.0))) for v in scenario.vehicles}

    def places() -> list[complex]:
        found: list[complex] = []
        for row, ahead in enumerate(formation.model.predecessors):
            found.append((found[ahead] if ahead >= 0 else 0j) + offsets[formation.system_ids[row]])
        return found

    now = places()
    yield _Span(0.0, 1.0, now, now)
    for change in scenario.formation_changes:
        before = now
        offsets |= {changed.system_id: complex(*changed.offset_ne_m) for changed in change.offsets}
        now = places()
        yield _Span(change.at_s, change.duration_s, before, now)


class Nearest(NamedTuple):
    """The least distance between any two vehicles in the planned motion, and when and between which it occurs."""

    distance_m: float
    time_s: float
    system_ids: tuple[int, int]


def nearest_planned(scenario: Scenario) -> Nearest | None:
    """The least distance between the planned places of any two vehicles over the whole flight, altitudes included.

    None for a single vehicle. During a change, two places move along a line relative to each other, and all places turn
    together, so the least distance has a closed form.
    """
    formation = plan_formation(scenario)
    motion = PlannedMotion(scenario, formation)
    altitudes = [scenario.altitude_of(vehicle) for vehicle in scenario.leader_first()]
    ids, found = formation.system_ids, list[Nearest]()
    for from_s, duration_s, before, after in motion.changes():
        if from_s > scenario.duration_s:
            break
        for i, k in combinations(range(len(ids)), 2):
            apart, moved = before[k] - before[i], (after[k] - after[i]) - (before[k] - before[i])
            length = float(moved @ moved)
            share = min(1.0, max(0.0, -float(apart @ moved) / length)) if length else 0.0
            distance_m = hypot(*(apart + share * moved), altitudes[k] - altitudes[i])
            found.append(Nearest(distance_m, from_s + duration_s * _time_of(share), (ids[i], ids[k])))
    return min(found, default=None)


def _time_of(share: float) -> float:
    """The x at which `smooth_step` reaches a share of its rise, by bisection."""
    if share == 0.0:
        return 0.0
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = (low + high) / 2.0
        low, high = (middle, high) if smooth_step(middle)[0] < share else (low, middle)
    return high
