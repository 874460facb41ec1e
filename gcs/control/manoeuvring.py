"""The loop of a manoeuvring formation: an inner loop, fed with states relative to the planned motion.

With the planned motion r_k of vehicle k (`gcs.plan.course`), the inner loop sees

    x~_k = x_k - (place_k(t) - place_k(0), r_k'(t)),   each at the instant t of the state,

and computes commands as if the formation flew straight on in its initial shape: its law, gains and margins do not
change. The planned acceleration r_k'' is added to its command, evaluated in the middle of the interval in which the
set-point acts, one-way delay included. So a vehicle that follows the plan has no errors, however long the delay.

Behind a leader flown by somebody else, v_d is the velocity that the leader reports. Its acceleration is unknown, so
none is added for it, and errors grow in its turns.
"""

from collections.abc import Sequence
from math import nan

import numpy as np

from gains.core.arrays import FloatArray
from gcs.control.history import Instants, Report, Reports, State
from gcs.control.law import FeedbackLaw
from gcs.control.loops import Loop, Orders, TickInputs, steady_loop
from gcs.control.own_law import FlownLaw, OwnLawLoop
from gcs.plan.course import PlannedMotion
from gcs.plan.flight_plan import FlightPlan
from scenarios.kernel import Records
from scenarios.schema import NS_PER_S


def loop_of(plan: FlightPlan, law: FlownLaw | None = None) -> Loop:
    """The loop for which a plan is made; the user's own `law`, if given, computes the commands."""
    loop = steady_loop(plan) if law is None else OwnLawLoop(plan, law)
    return ManoeuvringLoop(plan, loop) if plan.scenario.manoeuvres else loop


class ManoeuvringLoop(Loop):
    """The loop `inner`, closed around the planned motion."""

    heeds_deliveries = True

    def __init__(self, plan: FlightPlan, inner: Loop) -> None:
        super().__init__(plan)
        self._inner = inner
        self.motion = PlannedMotion(plan.scenario, plan.formation)
        self.start_m = plan.formation.place_ne_m().tolist()
        self.follows_another = plan.scenario.course.leader == "external"
        vehicles = range(plan.model.vehicles)
        self._down_ns = [0 for _ in vehicles]
        self._half_period_ns = round(plan.timing.step_s * NS_PER_S / 2.0)
        self._velocity_m_s, self._more_m_s2 = (np.zeros((plan.model.vehicles, 2)) for _ in range(2))
        """Planned velocity and acceleration of each vehicle while the set-point of the newest tick acts."""
        self.law, self.parameters = inner.law, inner.parameters
        self.sent, self.active = inner.sent, inner.active  # use only differences, in which the planned motion cancels

    def control(self, history: Reports, law: FeedbackLaw, blends: Records, now: TickInputs) -> Records:
        still = now._replace(nominal_velocity_m_s=(0.0, 0.0))  # the nominal velocity is part of the planned motion
        controls = self._inner.control(_RelativeStates(self, history, now), law, blends, still)
        for row, down_ns in enumerate(self._down_ns):
            acts_s = now.time_s + (down_ns + self._half_period_ns) * 1e-9
            _, self._velocity_m_s[row], self._more_m_s2[row] = self.motion.reference(row, acts_s, now.opening)
        controls["command_m_s2"] += self._more_m_s2
        if self.follows_another:
            controls["command_m_s2"][0] = nan
        controls["state"] = history.every_newest()[1]
        return controls

    def delivered(self, row: int, down_ns: int, sent_ns: int) -> None:
        self._down_ns[row] = down_ns
        self._inner.delivered(row, down_ns, sent_ns)

    def remember(self, row: int, due_ns: int, acceleration_m_s2: Sequence[float]) -> None:
        (more_north, more_east), (north, east) = self._more_m_s2[row].tolist(), acceleration_m_s2
        self._inner.remember(row, due_ns, (north - more_north, east - more_east))

    def set_points(self, orders: Orders) -> Records:
        """The inner loop's set-points, made from its own part of the commands, with the planned part added."""
        own = orders.controls.copy()
        own["command_m_s2"] -= self._more_m_s2
        points = self._inner.set_points(orders._replace(controls=own, nominal_velocity_m_s=self._velocity_m_s))
        points["acceleration_ne_m_s2"] = orders.controls["command_m_s2"]
        return points


class _RelativeStates(Reports):
    """`gcs.control.history.Reports` relative to the planned motion, as of one tick."""

    def __init__(self, loop: ManoeuvringLoop, history: Reports, now: TickInputs) -> None:
        self._loop, self._history, self._now = loop, history, now

    def newest(self, vehicle: int) -> Report | None:
        report = self._history.newest(vehicle)
        return None if report is None else (report[0], self._relative(vehicle, report[1], report[0]))

    def at(self, vehicle: int, time_ns: int) -> State | None:
        state = self._history.at(vehicle, time_ns)
        return None if state is None else self._relative(vehicle, state, time_ns)

    def every_newest(self) -> tuple[Instants, FloatArray]:
        times_ns, states = self._history.every_newest()
        for row in np.flatnonzero(times_ns).tolist():
            north, east, v_north, v_east = states[row].tolist()
            states[row] = self._relative(row, (north, east, v_north, v_east), times_ns.item(row))
        return times_ns, states

    def _relative(self, vehicle: int, state: State, instant_ns: int) -> State:
        time_s, opening = self._now.time_s + (instant_ns - self._now.due_ns) * 1e-9, self._now.opening
        place, velocity, _ = self._loop.motion.reference(vehicle, time_s, opening)
        start_north, start_east = self._loop.start_m[vehicle]
        north, east, v_north, v_east = state
        leader = self._history.at(0, instant_ns) if self._loop.follows_another else None
        if leader is not None:
            velocity = velocity[0] + leader[2], velocity[1] + leader[3]
        return (
            north - (place[0] - opening * start_north),
            east - (place[1] - opening * start_east),
            v_north - velocity[0],
            v_east - velocity[1],
        )
