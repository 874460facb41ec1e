"""Prediction with the loop on board: the state of the formation at the instant when a streamed acceleration acts.

Vehicles feed back their own errors, so the motion of each depends on those in front of it. The state z of the formation
holds each vehicle's velocity minus the initial nominal velocity, and each spacing error p_i = Z_ahead - Z_i +
offset_i. With the vehicles' own loops in A (`gains.sampled.onboard.streamed_loop`), and w_i and v_d sent to vehicle i,

    z' = A z + B u,   u_i = w_i - K_ii^v v_d.

The set-point sent to vehicle i at tick t_k acts at t_k + D_i, where D_i is its delivery delay
(`gcs.control.prediction`). With X_i the response to u_i alone, as a function of the time when set-points were due,

    z^(t) = e^{A (t - s)} (z(s) - sum_i X_i(s - D_i)) + sum_i X_i(t - D_i).

s is the instant of the oldest among the newest states that the command needs.
"""

from bisect import bisect_right
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from gains.core.arrays import FloatArray, matrix_exponentials
from gains.sampled.onboard import own_part, streamed_loop
from gcs.control.history import Reports, State
from gcs.control.law import FeedbackLaw
from gcs.control.prediction import KEPT_S, Delivery, FirstUses, FixedDelivery
from gcs.plan.flight_plan import FlightPlan
from scenarios.schema import NS_PER_S

_GRID_S = 1e-3
"""Exponentials are computed for whole milliseconds; a second-order series adds the rest, within 1e-9 at 20 1/s."""


class StreamPrediction:
    """The commands sent to each vehicle, and the formation state predicted from them."""

    def __init__(self, plan: FlightPlan, deliveries: Sequence[Delivery]) -> None:
        model, timing = plan.model, plan.onboard
        assert timing is not None
        A, B, _ = streamed_loop(model, plan.gain, timing)
        own = own_part(model, plan.gain)
        self.deliveries, self._model, self._offset_m = deliveries, model, plan.formation.offset_ne_m
        self._on_velocity = [own[model.input_slice(i), model.velocity_slice(i)] for i in range(model.vehicles)]
        self._origin_m_s = np.array(plan.scenario.nominal_velocity_at(0.0))
        self._held_ns = round(plan.scenario.safety.setpoint_timeout_s * NS_PER_S)
        self._flow = _Flow(A, B)
        self._uses = [FirstUses(plan.timing, given=isinstance(own, FixedDelivery)) for own in deliveries]
        self._due_ns: list[int] = []
        self._responses: list[FloatArray] = []
        """X_i at each tick as the columns of a matrix (states, vehicles)."""
        self._inputs: list[FloatArray] = []
        """u at each tick (vehicles, 2), held until the next."""
        self._streamed, self._sent_ns = np.zeros((model.vehicles, 2)), [0] * model.vehicles
        self._needs: tuple[FeedbackLaw | None, list[list[int]]] = None, []

    def look(self, history: Reports, law: FeedbackLaw, due_ns: int, nominal_m_s: Sequence[float]) -> None:
        """Begin a tick: the last command to each vehicle remains in effect until `remember` replaces it."""
        if self._needs[0] is not law:
            self._needs = law, [self._needed(law, row) for row in range(len(law.ahead))]
            self._flown: list[bool] = law.flown.tolist()
        self._now_ns, self._history = due_ns, history
        target = np.array(nominal_m_s) - self._origin_m_s
        if self._due_ns:
            self._responses.append(self._flow.moved(self._responses[-1], self._inputs[-1], due_ns - self._due_ns[-1]))
        else:
            self._responses.append(np.zeros((self._model.states, self._model.vehicles)))
        self._due_ns.append(due_ns)
        held = np.array([due_ns - sent_ns <= self._held_ns for sent_ns in self._sent_ns])
        self._streamed[~held] = 0.0
        self._inputs.append(self._streamed - np.array([K @ target for K in self._on_velocity]))
        self._target = target
        if self._due_ns[0] < due_ns - 2.0 * KEPT_S * NS_PER_S:  # many at once, see `CommandHistory.add`
            old = bisect_right(self._due_ns, due_ns - round(KEPT_S * NS_PER_S))
            del self._due_ns[:old], self._responses[:old], self._inputs[:old]
        self._delivery_ns: list[int | None] = []
        self._age_ns: list[int] = []
        for row, delivery in enumerate(self.deliveries):
            used_ns = self.used_ns(row)
            self._age_ns.append(self._uses[row].age_ns(used_ns, due_ns) if used_ns else 0)
            self._delivery_ns.append(delivery.assumed_ns(due_ns, self._age_ns[row]) if used_ns else None)

    def remember(self, row: int, acceleration_m_s2: Sequence[float]) -> None:
        """Record the acceleration streamed to a vehicle at this tick."""
        self._sent_ns[row], self._streamed[row] = self._now_ns, acceleration_m_s2
        self._inputs[-1][row] = self._streamed[row] - self._on_velocity[row] @ self._target

    def used_ns(self, row: int) -> int:
        """The instant of the oldest among the newest states that a command needs; 0 if it needs none, or lacks one."""
        newest = [self._history.newest(k) for k in self._needs[1][row]]
        return min((0 if report is None else report[0] for report in newest), default=0)

    def states(self, row: int) -> tuple[int, float, list[State]] | None:
        """When a vehicle's set-point acts (ns), its assumed loop delay (s), and all states then relative to the leader.

        None while a needed state or the vehicle's own delivery delay is unknown, or a needed vehicle is lost.
        """
        model, needed, used_ns = self._model, self._needs[1][row], self.used_ns(row)
        delays = [self._delivery_ns[k] for k in needed]
        own_ns = self._delivery_ns[row]
        if own_ns is None or not used_ns or not all(self._flown[k] for k in needed):
            return None
        z = np.zeros(model.states)
        seen = {k: self._history.at(k, used_ns) or (0.0, 0.0, 0.0, 0.0) for k in needed}
        for k in needed:
            z[model.velocity_slice(k)] = np.array(seen[k][2:]) - self._origin_m_s
            if k:
                ahead = seen[model.predecessors[k]]
                z[model.spacing_slice(k)] = np.subtract(ahead[:2], seen[k][:2]) + self._offset_m[k]
        acts_ns = self._now_ns + own_ns
        late = [(k, own_ns if delay_ns is None else delay_ns) for k, delay_ns in zip(needed, delays, strict=True)]
        before, after = (
            sum((self._response(k, at_ns - delay_ns) for k, delay_ns in late), np.zeros(model.states))
            for at_ns in (used_ns, acts_ns)
        )
        z = self._flow.extrapolated(z - before, acts_ns - used_ns) + after
        return acts_ns, (self._age_ns[row] + own_ns) * 1e-9, self._places(z, needed)

    def _places(self, z: FloatArray, needed: Sequence[int]) -> list[State]:
        model, (north_m_s, east_m_s) = self._model, self._origin_m_s.tolist()
        states: list[State] = [(0.0, 0.0, north_m_s, east_m_s)] * model.vehicles
        for k in needed:
            v_north, v_east = z[model.velocity_slice(k)].tolist()
            north, east = 0.0, 0.0
            if k:
                ahead, (off_north, off_east) = states[model.predecessors[k]], self._offset_m[k].tolist()
                p_north, p_east = z[model.spacing_slice(k)].tolist()
                north, east = ahead[0] + off_north - p_north, ahead[1] + off_east - p_east
            states[k] = north, east, v_north + north_m_s, v_east + east_m_s
        return states

    def _response(self, vehicle: int, time_ns: int) -> FloatArray:
        """X_i at a time."""
        place = bisect_right(self._due_ns, time_ns) - 1
        if place < 0:
            return np.zeros(self._model.states)
        own, one = np.zeros_like(self._inputs[place]), self._responses[place][:, [vehicle]]
        own[vehicle] = self._inputs[place][vehicle]
        return self._flow.pushed(one[:, 0], own.ravel(), time_ns - self._due_ns[place])

    def _needed(self, law: FeedbackLaw, row: int) -> list[int]:
        """The vehicles on whose motion the command depends: its sources, and all vehicles in front of them."""
        found: set[int] = {*law.source[law.needed & (law.to == row)].tolist()}
        for vehicle in reversed(range(self._model.vehicles)):  # those in front have lower numbers
            if vehicle in found:
                found.add(max(0, self._model.predecessors[vehicle]))
        return sorted(found)


class _Flow:
    """The solution of z' = A z + B u with constant u over any duration."""

    def __init__(self, A: FloatArray, B: FloatArray) -> None:
        self._n = len(A)
        self._generator = np.zeros((self._n + B.shape[1], self._n + B.shape[1]))
        self._generator[: self._n, : self._n], self._generator[: self._n, self._n :] = A, B
        self._grid = lru_cache(maxsize=1024)(self._exponential)

    def moved(self, responses: FloatArray, inputs: FloatArray, duration_ns: int) -> FloatArray:
        """Every X_i after a duration."""
        vehicles, each = inputs.shape
        spread = np.zeros((vehicles * each, vehicles))
        for k in range(vehicles):
            spread[k * each : (k + 1) * each, k] = inputs[k]
        return self._on(np.vstack([responses, spread]), duration_ns)[: self._n]

    def pushed(self, z: FloatArray, u: FloatArray, duration_ns: int) -> FloatArray:
        """z after a duration under a constant u."""
        return self._on(np.concatenate([z, u]), duration_ns)[: self._n]

    def extrapolated(self, z: FloatArray, duration_ns: int) -> FloatArray:
        """e^{A t} z."""
        return self.pushed(z, np.zeros(len(self._generator) - self._n), duration_ns)

    def _on(self, z: FloatArray, duration_ns: int) -> FloatArray:
        steps = round(duration_ns * 1e-9 / _GRID_S)
        rest_s = duration_ns * 1e-9 - steps * _GRID_S
        z = self._grid(steps) @ z
        slope = self._generator @ z
        return z + rest_s * slope + 0.5 * rest_s * rest_s * (self._generator @ slope)

    def _exponential(self, steps: int) -> FloatArray:
        return matrix_exponentials(self._generator, np.array([steps * _GRID_S]))[0]
