"""Ground loop and streamed loop: where the loop is closed decides what the station computes, uploads and sends.

`gcs.control.manoeuvring.loop_of` selects the loop; nothing else in the station reads the scenario's `loop`. With the
loop on board, a vehicle feeds back its own errors and the station streams the rest: K_ij e_j of the other vehicles. All
errors streamed to a vehicle are taken at one instant, that of the oldest among the newest states it needs. The loop
delay counts from that instant; nothing is extrapolated, unless the station predicts.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray
from gains.sampled.onboard import own_part
from gcs.control.acted import ActiveTargets
from gcs.control.history import Instants, Reports
from gcs.control.law import (
    FeedbackLaw,
    TickInputs,
    Vector,
    commands_at,
    commands_of,
    feedback_law,
    formation_control,
)
from gcs.control.predicted_stream import StreamPrediction
from gcs.control.prediction import CommandHistory, Delivery, FixedDelivery, MeasuredDelivery, PredictedStates
from gcs.control.responding import Responding
from gcs.link.mavlink import (
    IGNORE_ALL_BUT_ACCELERATION,
    IGNORE_ALL_BUT_VELOCITY_AND_ACCELERATION,
    SET_POINT,
)
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.onboard import own_parameters
from scenarios.kernel import Array, Records, kernel
from scenarios.schema import NS_PER_S

_NEVER_NS = np.iinfo(np.int64).max


class Orders(NamedTuple):
    """Commands of a tick, from which its set-points are made."""

    controls: Records
    """Of `gcs.control.law.CONTROL`, for each vehicle."""
    commanded: NDArray[np.bool_]
    """Whether each vehicle is to follow the control law at this tick."""
    nominal_velocity_m_s: Vector | FloatArray
    """Common to all vehicles, or one for each (n, 2)."""
    due_ns: int


class Loop:
    """The ground loop: the station closes the loop around each vehicle and sends the whole command.

    Subclasses override what depends on where the loop is closed and on prediction.
    """

    heeds_deliveries = False
    """Whether `delivered` has any effect."""

    def __init__(self, plan: FlightPlan) -> None:
        self._plan = plan

    def law(self, lost: Sequence[bool], returning: Sequence[bool] | None = None) -> FeedbackLaw:
        """The station's part of each vehicle's command, without lost vehicles: see `law.feedback_law`."""
        return feedback_law(self._plan.formation, _gains(self._plan, lost, returning), lost, returning)

    def control(self, history: Reports, law: FeedbackLaw, blends: Records, now: TickInputs) -> Records:
        """Errors of every vehicle at a tick and the acceleration to send: see `law.formation_control`."""
        return formation_control(history, law, blends, now)

    def delivered(self, row: int, down_ns: int, sent_ns: int) -> None:
        """Process a measured one-way delay to a vehicle, of a message sent at `sent_ns`."""

    def set_points(self, orders: Orders) -> Records:
        """The set-points (n, SET_POINT), marked `sent` for the vehicles that are commanded."""
        points = np.zeros(len(orders.controls), SET_POINT)
        accelerations(points, orders.controls, orders.commanded)
        return points

    def remember(self, row: int, due_ns: int, acceleration_m_s2: Sequence[float]) -> None:
        """Record the acceleration commanded to a vehicle, for prediction."""

    def sent(self, due_ns: int, points: Records) -> None:
        """Record the set-points as they were sent."""

    def active(self, row: int, at_ns: int, fields: tuple[Any, ...]) -> None:
        """Process the fields of a POSITION_TARGET_LOCAL_NED: the target that a vehicle followed at `at_ns`."""

    def parameters(self, system_id: int) -> dict[str, float]:
        """The parameters that must be set on a vehicle before it is armed."""
        del system_id
        return {}


def steady_loop(plan: FlightPlan) -> Loop:
    """The loop of a formation that keeps its shape and whose nominal velocity is piecewise constant."""
    control = plan.scenario.control
    if control.loop == "onboard":
        return StreamedLoop(plan) if control.prediction == "off" else PredictingStreamedLoop(plan)
    return Loop(plan) if control.prediction == "off" else PredictingGroundLoop(plan)


@kernel
def accelerations(points: Records, controls: Records, commanded: Array) -> None:
    """Fill empty set-points with the commanded accelerations."""
    for row in range(len(points)):
        points[row].sent, points[row].type_mask = commanded[row], IGNORE_ALL_BUT_ACCELERATION
        for k in range(2):
            points[row].acceleration_ne_m_s2[k] = controls[row].command_m_s2[k]


class PredictingGroundLoop(Loop):
    """The ground loop, fed with errors predicted for when each set-point acts (`gcs.control.prediction`)."""

    heeds_deliveries = True

    def __init__(self, plan: FlightPlan) -> None:
        super().__init__(plan)
        vehicles = range(plan.model.vehicles)
        every = plan.responses_in_order
        held_ns = round(plan.scenario.safety.setpoint_timeout_s * NS_PER_S)
        self._sent = [CommandHistory(held_ns, None if every is None else Responding(every[row])) for row in vehicles]
        period_ns = round(NS_PER_S / plan.scenario.rates.control_hz)
        self._targets = [ActiveTargets(own, period_ns=period_ns, held_ns=held_ns) for own in self._sent]
        self._deliveries = _deliveries(plan)
        self._states = PredictedStates(self._sent, self._deliveries, plan.timing)

    def control(self, history: Reports, law: FeedbackLaw, blends: Records, now: TickInputs) -> Records:
        controls = super().control(history, law, blends, now)
        acts_ns, assumed_s = self._states.look(history, now.due_ns)
        commands = commands_at(self._states, law, acts_ns, blends, now)
        _replace(controls, (acts_ns > 0) & law.flown, command_m_s2=commands, assumed_s=assumed_s, acts_ns=acts_ns)
        return controls

    def delivered(self, row: int, down_ns: int, sent_ns: int) -> None:
        self._deliveries[row].measured(down_ns, sent_ns)

    def set_points(self, orders: Orders) -> Records:
        _remember_all(self, orders)
        return super().set_points(orders)

    def remember(self, row: int, due_ns: int, acceleration_m_s2: Sequence[float]) -> None:
        self._sent[row].add(due_ns, acceleration_m_s2)

    def sent(self, due_ns: int, points: Records) -> None:
        velocities, accelerations = points["velocity_ned_m_s"].tolist(), points["acceleration_ne_m_s2"].tolist()
        for row in np.flatnonzero(points["sent"]).tolist():
            self._targets[row].sent(due_ns, velocities[row][:2], accelerations[row])

    def active(self, row: int, at_ns: int, fields: tuple[Any, ...]) -> None:
        self._targets[row].reported(at_ns, fields)


class StreamedLoop(Loop):
    """Loops on board: the station uploads the vehicles' own gains and streams what depends on other vehicles."""

    def __init__(self, plan: FlightPlan) -> None:
        super().__init__(plan)
        own, model = own_part(plan.model, plan.gain), plan.model
        self._opened_m_s2 = np.zeros((model.vehicles, 2))
        """K_ii^p times the offset: to be added at doubled spacing, as the loop on board keeps the designed spacing."""
        for i in model.followers:
            on_spacing = own[model.input_slice(i), model.spacing_slice(i)]
            self._opened_m_s2[i] = on_spacing @ plan.formation.offset_ne_m[i]

    def law(self, lost: Sequence[bool], returning: Sequence[bool] | None = None) -> FeedbackLaw:
        streamed = tuple(K - own_part(self._plan.model, K) for K in _gains(self._plan, lost, returning))
        return feedback_law(self._plan.formation, streamed, lost, returning)

    def control(self, history: Reports, law: FeedbackLaw, blends: Records, now: TickInputs) -> Records:
        controls = super().control(history, law, blends, now)
        used_ns = _oldest_needed_ns(law, controls["sample_ns"])
        commands = commands_at(history, law, used_ns, blends, now)
        others = (used_ns > 0) & (used_ns != controls["sample_ns"])
        _replace(controls, others & law.flown, command_m_s2=commands, used_ns=used_ns)
        self._open(controls["command_m_s2"], now.opening)
        return controls

    def _open(self, commands_m_s2: FloatArray, opening: float) -> None:
        """Add to commands (n, 2) the part for a wider spacing, as the loops on board keep the designed spacing."""
        commands_m_s2 += (opening - 1.0) * self._opened_m_s2

    def set_points(self, orders: Orders) -> Records:
        points = np.zeros(len(orders.controls), SET_POINT)
        points["sent"], points["type_mask"] = orders.commanded, IGNORE_ALL_BUT_VELOCITY_AND_ACCELERATION
        points["velocity_ned_m_s"][:, :2] = orders.nominal_velocity_m_s
        points["acceleration_ne_m_s2"] = orders.controls["command_m_s2"]
        return points

    def parameters(self, system_id: int) -> dict[str, float]:
        formation = self._plan.formation
        return own_parameters(formation, self._plan.gain, formation.row(system_id))


class PredictingStreamedLoop(StreamedLoop):
    """The streamed loop, fed with errors predicted for when each set-point acts (`gcs.control.predicted_stream`)."""

    heeds_deliveries = True

    def __init__(self, plan: FlightPlan) -> None:
        super().__init__(plan)
        self._prediction = StreamPrediction(plan, _deliveries(plan))

    def control(self, history: Reports, law: FeedbackLaw, blends: Records, now: TickInputs) -> Records:
        controls = super().control(history, law, blends, now)
        self._prediction.look(history, law, now.due_ns, now.nominal_velocity_m_s)
        own, seen = np.zeros((len(controls), 4)), np.zeros((len(law.source), 4))
        acts_ns, assumed_s = np.zeros(len(controls), np.int64), np.zeros(len(controls))
        for row in range(len(controls)):
            found = self._prediction.states(row)
            if found is not None:
                acts_ns[row], assumed_s[row], states = found
                terms = slice(law.begin[row], law.begin[row + 1])
                own[row], seen[terms] = states[row], [states[source] for source in law.source[terms].tolist()]
        commands = commands_of(law, own, seen, blends, now)
        self._open(commands, now.opening)
        used_ns = np.array([self._prediction.used_ns(row) for row in range(len(controls))])
        _replace(
            controls, acts_ns > 0, command_m_s2=commands, used_ns=used_ns, assumed_s=assumed_s, acts_ns=acts_ns
        )  # fmt: skip
        return controls

    def delivered(self, row: int, down_ns: int, sent_ns: int) -> None:
        self._prediction.deliveries[row].measured(down_ns, sent_ns)

    def set_points(self, orders: Orders) -> Records:
        _remember_all(self, orders)
        return super().set_points(orders)

    def remember(self, row: int, due_ns: int, acceleration_m_s2: Sequence[float]) -> None:
        del due_ns  # the prediction knows the current tick
        self._prediction.remember(row, acceleration_m_s2)


def _replace(controls: Records, which: NDArray[np.bool_], **fields: NDArray[Any]) -> None:
    """Replace fields of the selected controls."""
    for name, values in fields.items():
        controls[name][which] = values[which]


def _oldest_needed_ns(law: FeedbackLaw, sample_ns: Instants) -> Instants:
    """The instant of the oldest among the newest states that each law needs; 0 if it needs none or one is unknown."""
    needed, oldest_ns = law.needed, np.full(len(law.ahead), _NEVER_NS)
    np.minimum.at(oldest_ns, law.to[needed], sample_ns[law.source[needed]])
    return np.where(oldest_ns == _NEVER_NS, 0, oldest_ns)


def _remember_all(loop: Loop, orders: Orders) -> None:
    commands = orders.controls["command_m_s2"].tolist()
    for row in np.flatnonzero(orders.commanded).tolist():
        loop.remember(row, orders.due_ns, commands[row])


def _deliveries(plan: FlightPlan) -> list[Delivery]:
    assumed = plan.scenario.control.prediction
    return [
        MeasuredDelivery() if isinstance(assumed, str) else FixedDelivery(assumed) for _ in range(plan.model.vehicles)
    ]


def _gains(plan: FlightPlan, lost: Sequence[bool], returning: Sequence[bool] | None) -> tuple[Any, ...]:
    """The gain schedule, or the one that replaces it while vehicles are lost or returning."""
    return plan.around_loss if plan.around_loss and any((*lost, *(returning or ()))) else plan.gains
