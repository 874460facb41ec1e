"""Ends a flight whose formation is broken: after a collision, or a spacing error beyond the limit.

A flight does not begin while a vehicle exceeds that limit (`not_formed`).

A vehicle that returns from its pilot, its failsafe or silence may be far from its place. So may the vehicles behind it,
whose places are relative to it. Their errors say nothing about the loop until they have had time to return. This time
is granted again only if the vehicle has been within the limit since, or if its pilot flew it: a formation that diverges
while its vehicles keep entering their failsafe is broken.
"""

from collections.abc import Mapping
from math import hypot, inf, isfinite, isnan, log, sqrt

import numpy as np

from gcs.control.history import Reports
from gcs.control.law import Nearest
from gcs.control.limits import any_beyond
from gcs.errors import beyond
from gcs.plan.flight_plan import FlightPlan
from scenarios.kernel import Record, Records

SURELY_WITHIN = 0.7
"""A vector whose two components are within this fraction of a limit is not longer than the limit."""
_TIME_CONSTANTS = 3.0
"""After this many time constants, an error has decayed to a twentieth."""


def not_formed(plan: FlightPlan, history: Reports) -> str:
    """Why the flight cannot begin: a vehicle is too far from its place behind the one in front. Empty if none is."""
    limit_m, ids = plan.scenario.safety.spacing_error_limit_m, plan.formation.system_ids
    followers = np.array(plan.model.followers, np.int64)
    times_ns, newest = history.every_newest()
    ahead = history.every_at(np.array(plan.model.predecessors)[followers], times_ns[followers])
    errors_ne_m = (newest[followers] - ahead)[:, :2] - plan.formation.offset_ne_m[followers]
    for row, error_m in zip(followers.tolist(), np.hypot(*errors_ne_m.T).tolist(), strict=True):
        if error_m > limit_m:
            far = beyond(error_m, limit_m)
            return f"not formed: vehicle {ids[row]} is {far} m from its place at the start, limit {limit_m:g} m"
    return ""


def too_far(system_id: int, error_m: float, limit_m: float) -> str:
    """The end reason of a flight in which a vehicle's spacing error exceeds the limit."""
    return f"broken: spacing error of vehicle {system_id} is {beyond(error_m, limit_m)} m, limit {limit_m:g} m"


class Breakage:
    """Decides at each tick whether the formation is broken, and tracks returning vehicles."""

    def __init__(self, plan: FlightPlan) -> None:
        n = len(plan.formation.system_ids)
        self._plan = plan
        self._safety = plan.scenario.safety
        self._decay_1_s = slowest_decay_1_s(plan)
        self._away = [False] * n
        self._judged_from_s = [-inf] * n
        self._has_returned = [True] * n
        """Whether the vehicle has been within the limit since it was last granted time to return."""
        self.all_back = True
        """Whether every vehicle has returned and none is away."""
        self._piloted = [False] * n
        self._behind: list[list[int]] = [[row] for row in range(n)]
        """The rows of each vehicle and of all its followers, direct and indirect."""
        for row in range(n - 1, 0, -1):
            self._behind[plan.model.predecessors[row]] += self._behind[row]

    def judge(self, controls: Records, away: Mapping[int, bool], nearest: Nearest, time_s: float) -> str:
        """Why the flight must end at this tick; empty if it may continue.

        The keys of `away` are the rows of vehicles that do not follow commands, its values whether pilots fly them.
        """
        ids, limit_m = self._plan.formation.system_ids, self._safety.spacing_error_limit_m
        closest_m = np.fmin.reduce(nearest.distance_m)
        if closest_m < self._safety.collision_distance_m:
            one, two = (ids[row] for row in nearest.two)
            return f"broken: vehicles {one} and {two} have collided, {closest_m:.1f} m apart"
        if not away and self.all_back and not any_beyond(controls["spacing_error_m"], SURELY_WITHIN * limit_m):
            return ""
        for row in range(len(controls)):
            if row in away:
                self._away[row] = True
                self._piloted[row] |= away[row]
            elif self._away[row]:
                self._come_back(row, controls, time_s)
        for row, error in enumerate(controls["spacing_error_m"].tolist()):
            error_m = hypot(*error)
            self._has_returned[row] |= not self._away[row] and not error_m > limit_m  # the leader has no spacing error
            if error_m > limit_m and not self._away[row] and time_s >= self._judged_from_s[row]:
                return too_far(ids[row], error_m, limit_m)
        self.all_back = all(self._has_returned) and not any(self._away)
        return ""

    def _come_back(self, row: int, controls: Records, time_s: float) -> None:
        """Give a vehicle and all behind it time to return, once their distances are known."""
        distances_m = [self._distance_ahead_m(controls[other]) for other in self._behind[row]]
        if not isfinite(distances_m[0]):
            return
        self._away[row] = False
        if not (self._has_returned[row] or self._piloted[row]):
            return
        self._has_returned[row] = self._piloted[row] = False
        way_m = max(distance for distance in distances_m if isfinite(distance))
        speed_m_s = hypot(*self._plan.scenario.nominal_velocity_at(time_s))
        until_s = time_s + recovery_time_s(self._plan, self._decay_1_s, way_m, speed_m_s)
        for other in self._behind[row]:
            self._judged_from_s[other] = max(self._judged_from_s[other], until_s)

    def _distance_ahead_m(self, control: Record) -> float:
        """The spacing error plus the distance covered while the velocity error decays; NaN while unknown."""
        spacing_m = hypot(*control["spacing_error_m"].tolist())
        carried_m = hypot(*control["velocity_error_m_s"].tolist()) / self._decay_1_s if self._decay_1_s > 0 else 0.0
        return carried_m + (0.0 if isnan(spacing_m) else spacing_m)  # the leader has no spacing error


def slowest_decay_1_s(plan: FlightPlan) -> float:
    """Decay rate in 1/s, without delay, of the slowest gains in the schedule, with which a vehicle returns."""
    model = plan.model
    closed_loop = model.A + model.feedback(plan.gains[-1])
    loops = [closed_loop]
    if plan.separable:
        own = [model.output_slice(row) for row in range(model.vehicles)]
        loops = [closed_loop[rows, rows] for rows in own]
    return -max(float(np.linalg.eigvals(loop).real.max()) for loop in loops)


def recovery_time_s(plan: FlightPlan, decay_1_s: float, way_m: float, speed_m_s: float) -> float:
    """Time granted to a vehicle to return over a distance before its spacing error is judged again.

    Three time constants of the slowest gains, plus the time for the error to decay to the spacing error limit. A limit
    of acceleration adds twice the time to speed up and slow down over the distance; a limit of speed adds twice the
    time to cover it at the speed in excess of the formation's own. 0 for gains that do not decay.
    """
    if decay_1_s <= 0:
        return 0.0
    limits = plan.scenario.limits
    time_s = (_TIME_CONSTANTS + log(max(1.0, way_m / plan.scenario.safety.spacing_error_limit_m))) / decay_1_s
    if limits.acceleration_max_m_s2 is not None:
        time_s += 2.0 * 2.0 * sqrt(way_m / limits.acceleration_max_m_s2)
    if limits.speed_max_m_s is not None and limits.speed_max_m_s > speed_m_s:
        time_s += 2.0 * way_m / (limits.speed_max_m_s - speed_m_s)
    return time_s
