"""Where the loop around each vehicle is closed, which decides what the station computes, uploads and sends.

`gcs.control.manoeuvring.loop_of` chooses once; nothing else in the station asks for the scenario's `loop`. With the
loop on board, a vehicle feeds back its own errors and the station streams the rest: K_ij e_j of the other vehicles. All
errors streamed to a vehicle are taken at one instant, that of the oldest among the newest states it needs. The loop
delay counts from that instant; nothing is extrapolated, unless the station predicts.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from gains.sampled.onboard import own_part
from gcs.control.acted import ActiveTargets
from gcs.control.history import Reports
from gcs.control.law import Blend, FeedbackLaw, VehicleControl, VehicleLaw, command_at, feedback_law, formation_control
from gcs.control.predicted_stream import StreamPrediction
from gcs.control.prediction import CommandHistory, Delivery, FixedDelivery, MeasuredDelivery, PredictedStates
from gcs.control.responding import Responding
from gcs.link import mavlink
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.onboard import own_parameters
from scenarios.schema import NS_PER_S

Vector = tuple[float, float]


class Moment(NamedTuple):
    """What all vehicles have in common at a control tick."""

    due_ns: int
    time_s: float
    """Scenario time."""
    nominal_velocity_m_s: Vector
    opening: float = 1.0
    """Factor on the formation's spacing."""


class Order(NamedTuple):
    """What a set-point is made from: one vehicle at one tick."""

    control: VehicleControl
    commanded: bool
    """Whether the vehicle is to follow the control law at this tick."""
    nominal_velocity_m_s: Vector
    key_ms: int
    """The set-point's time_boot_ms."""
    due_ns: int


class Loop(Protocol):
    """What depends on where the loop is closed."""

    def law(self, lost: Sequence[bool], returning: Sequence[bool] | None = None) -> FeedbackLaw:
        """The station's share of each vehicle's command, without the lost ones: see `law.feedback_law`."""
        ...

    def control(self, history: Reports, law: FeedbackLaw, blends: Sequence[Blend], now: Moment) -> list[VehicleControl]:
        """Errors of every vehicle at a tick, and the acceleration it is sent: see `law.formation_control`."""
        ...

    def delivered(self, row: int, down_ns: int, sent_ns: int) -> None:
        """Take in the one-way delay that was measured for a vehicle, of a message sent at `sent_ns`."""
        ...

    def set_point(self, system_id: int, order: Order) -> tuple[Any, ...]:
        """Fields of the set-point that carries a command."""
        ...

    def remember(self, row: int, due_ns: int, acceleration_m_s2: Vector) -> None:
        """Take in the acceleration that a vehicle is sent."""
        ...

    def sent(self, row: int, due_ns: int, fields: tuple[Any, ...]) -> None:
        """Take in the fields of a set-point as it was sent."""
        ...

    def active(self, row: int, at_ns: int, fields: tuple[Any, ...]) -> None:
        """Take in the fields of a POSITION_TARGET_LOCAL_NED: what a vehicle followed at an instant."""
        ...

    def parameters(self, system_id: int) -> dict[str, float]:
        """The parameters that must be set on a vehicle before it is armed."""
        ...


def steady_loop(plan: FlightPlan) -> Loop:
    """The loop of a formation that keeps its shape and whose nominal velocity changes in steps."""
    control = plan.scenario.control
    if control.loop == "onboard":
        return StreamedLoop(plan) if control.prediction == "off" else PredictingStreamedLoop(plan)
    return GroundLoop(plan) if control.prediction == "off" else PredictingGroundLoop(plan)


class GroundLoop:
    """The station closes every loop: it sends each vehicle its whole command."""

    def __init__(self, plan: FlightPlan) -> None:
        self._plan = plan

    def law(self, lost: Sequence[bool], returning: Sequence[bool] | None = None) -> FeedbackLaw:
        return feedback_law(self._plan.formation, _gains(self._plan, lost, returning), lost, returning)

    def control(self, history: Reports, law: FeedbackLaw, blends: Sequence[Blend], now: Moment) -> list[VehicleControl]:
        return formation_control(
            history, law, blends, nominal_velocity_m_s=now.nominal_velocity_m_s, opening=now.opening
        )

    def delivered(self, row: int, down_ns: int, sent_ns: int) -> None:
        """Nothing to do: the newest states are fed back as they are."""

    def remember(self, row: int, due_ns: int, acceleration_m_s2: Vector) -> None:
        """Nothing to do either."""

    def sent(self, row: int, due_ns: int, fields: tuple[Any, ...]) -> None: ...
    def active(self, row: int, at_ns: int, fields: tuple[Any, ...]) -> None: ...

    def set_point(self, system_id: int, order: Order) -> tuple[Any, ...]:
        north, east = order.control.command_m_s2
        return mavlink.acceleration_set_point(
            key_ms=order.key_ms, target_system=system_id, north_m_s2=north, east_m_s2=east
        )

    def parameters(self, system_id: int) -> dict[str, float]:
        del system_id
        return {}


class PredictingGroundLoop:
    """The ground loop, fed with the errors at the instant at which each set-point acts (`gcs.control.prediction`)."""

    def __init__(self, plan: FlightPlan) -> None:
        self._ground, self._row = GroundLoop(plan), plan.formation.row
        self.law, self.parameters = self._ground.law, self._ground.parameters
        vehicles = range(plan.model.vehicles)
        every = plan.responses_in_order
        held_ns = round(plan.scenario.safety.setpoint_timeout_s * NS_PER_S)
        self._sent = [CommandHistory(held_ns, None if every is None else Responding(every[row])) for row in vehicles]
        period_ns = round(NS_PER_S / plan.scenario.rates.control_hz)
        self._targets = [ActiveTargets(own, period_ns=period_ns, held_ns=held_ns) for own in self._sent]
        self._deliveries = _deliveries(plan)
        self._states = PredictedStates(self._sent, self._deliveries, plan.timing)

    def control(self, history: Reports, law: FeedbackLaw, blends: Sequence[Blend], now: Moment) -> list[VehicleControl]:
        nominal_m_s, opening = now.nominal_velocity_m_s, now.opening
        controls = self._ground.control(history, law, blends, now)
        for row, (acts_ns, assumed_s) in enumerate(self._states.look(history, now.due_ns)):
            own = law[row]
            if own is not None and acts_ns > 0:
                command = command_at(self._states, own, row, acts_ns, blends[row], nominal_m_s, opening)
                controls[row] = controls[row]._replace(command_m_s2=command, assumed_s=assumed_s, acts_ns=acts_ns)
        return controls

    def delivered(self, row: int, down_ns: int, sent_ns: int) -> None:
        self._deliveries[row].measured(down_ns, sent_ns)

    def set_point(self, system_id: int, order: Order) -> tuple[Any, ...]:
        self.remember(self._row(system_id), order.due_ns, order.control.command_m_s2)
        return self._ground.set_point(system_id, order)

    def remember(self, row: int, due_ns: int, acceleration_m_s2: Vector) -> None:
        self._sent[row].add(due_ns, acceleration_m_s2)

    def sent(self, row: int, due_ns: int, fields: tuple[Any, ...]) -> None:
        self._targets[row].sent(due_ns, fields)

    def active(self, row: int, at_ns: int, fields: tuple[Any, ...]) -> None:
        self._targets[row].reported(at_ns, fields)


class StreamedLoop:
    """Vehicles close loops of their own: the station uploads their gains and streams what they cannot know."""

    def __init__(self, plan: FlightPlan) -> None:
        self._plan = plan
        own, model = own_part(plan.model, plan.gain), plan.model
        self._opened_m_s2 = [(0.0, 0.0)] * model.vehicles
        """K_ii^p times the offset: added when the spacing is doubled, which the vehicle's own loop does not know."""
        for i in model.followers:
            on_spacing = own[model.input_slice(i), model.spacing_slice(i)]
            north, east = (on_spacing @ plan.formation.offset_ne_m[i]).tolist()
            self._opened_m_s2[i] = north, east

    def law(self, lost: Sequence[bool], returning: Sequence[bool] | None = None) -> FeedbackLaw:
        streamed = tuple(K - own_part(self._plan.model, K) for K in _gains(self._plan, lost, returning))
        return feedback_law(self._plan.formation, streamed, lost, returning)

    def control(self, history: Reports, law: FeedbackLaw, blends: Sequence[Blend], now: Moment) -> list[VehicleControl]:
        nominal_m_s, opening = now.nominal_velocity_m_s, now.opening
        controls = formation_control(history, law, blends, nominal_velocity_m_s=nominal_m_s, opening=opening)
        for row, (own, blend) in enumerate(zip(law, blends, strict=True)):
            control = controls[row]
            used_ns = _oldest_needed(history, own)
            if own is not None and used_ns not in (0, control.sample_ns):
                command = command_at(history, own, row, used_ns, blend, nominal_m_s, opening)
                control = control._replace(command_m_s2=command, used_ns=used_ns)
            controls[row] = self.opened(row, control, control.command_m_s2, opening)
        return controls

    def opened(self, row: int, control: VehicleControl, command_m_s2: Vector, opening: float) -> VehicleControl:
        """The control with this command and what a wider spacing adds, of which the vehicle knows nothing."""
        (north, east), (more_north, more_east) = command_m_s2, self._opened_m_s2[row]
        command = north + (opening - 1.0) * more_north, east + (opening - 1.0) * more_east
        return control._replace(command_m_s2=command)

    def delivered(self, row: int, down_ns: int, sent_ns: int) -> None:
        """Nothing to do: nothing is predicted."""

    def remember(self, row: int, due_ns: int, acceleration_m_s2: Vector) -> None:
        """Nothing to do either."""

    def sent(self, row: int, due_ns: int, fields: tuple[Any, ...]) -> None: ...
    def active(self, row: int, at_ns: int, fields: tuple[Any, ...]) -> None: ...

    def set_point(self, system_id: int, order: Order) -> tuple[Any, ...]:
        return mavlink.velocity_set_point(
            key_ms=order.key_ms,
            target_system=system_id,
            velocity_ned_m_s=(*order.nominal_velocity_m_s, 0.0),
            acceleration_ne_m_s2=order.control.command_m_s2,
        )

    def parameters(self, system_id: int) -> dict[str, float]:
        formation = self._plan.formation
        return own_parameters(formation, self._plan.gain, formation.row(system_id))


class PredictingStreamedLoop:
    """The same, fed with the errors at the instant at which each set-point acts (`gcs.control.predicted_stream`)."""

    def __init__(self, plan: FlightPlan) -> None:
        self._streamed, self._row = StreamedLoop(plan), plan.formation.row
        self.law, self.parameters = self._streamed.law, self._streamed.parameters
        self.sent, self.active = self._streamed.sent, self._streamed.active
        self._prediction = StreamPrediction(plan, _deliveries(plan))

    def control(self, history: Reports, law: FeedbackLaw, blends: Sequence[Blend], now: Moment) -> list[VehicleControl]:
        controls = self._streamed.control(history, law, blends, now)
        nominal_m_s, opening = now.nominal_velocity_m_s, now.opening
        self._prediction.look(history, law, now.due_ns, nominal_m_s)
        for row, own in enumerate(law):
            found = None if own is None else self._prediction.states(row)
            if own is not None and found is not None:
                acts_ns, assumed_s, states = found
                command = command_at(states, own, row, acts_ns, blends[row], nominal_m_s, opening)
                used_ns = self._prediction.used_ns(row)
                control = controls[row]._replace(used_ns=used_ns, assumed_s=assumed_s, acts_ns=acts_ns)
                controls[row] = self._streamed.opened(row, control, command, opening)
        return controls

    def delivered(self, row: int, down_ns: int, sent_ns: int) -> None:
        self._prediction.deliveries[row].measured(down_ns, sent_ns)

    def set_point(self, system_id: int, order: Order) -> tuple[Any, ...]:
        self.remember(self._row(system_id), order.due_ns, order.control.command_m_s2)
        return self._streamed.set_point(system_id, order)

    def remember(self, row: int, due_ns: int, acceleration_m_s2: Vector) -> None:
        del due_ns  # that of the tick begun
        self._prediction.remember(row, acceleration_m_s2)


def _deliveries(plan: FlightPlan) -> list[Delivery]:
    assumed = plan.scenario.control.prediction
    return [
        MeasuredDelivery() if isinstance(assumed, str) else FixedDelivery(assumed) for _ in range(plan.model.vehicles)
    ]


def _gains(plan: FlightPlan, lost: Sequence[bool], returning: Sequence[bool] | None) -> tuple[Any, ...]:
    """The gain schedule, or what replaces it while others do without a vehicle."""
    return plan.around_loss if plan.around_loss and any((*lost, *(returning or ()))) else plan.gains


def _oldest_needed(history: Reports, law: VehicleLaw | None) -> int:
    """The instant of the oldest among the newest states that a law needs; 0 if it needs none or one is unknown."""
    if law is None:
        return 0
    newest = [history.newest(term.source) for term in law.terms if any(map(any, term.gains))]
    return min((0 if report is None else report[0] for report in newest), default=0)
