"""What the station does for vehicles with loops of their own: uploads their gains, and streams what they cannot know.

All errors in what is streamed to a vehicle are those of one instant: that of the oldest among the newest states that it
needs. So nothing is extrapolated, and its loop delay is from that instant until the set-point acts.
"""

from collections.abc import Sequence
from typing import Any

from gains.sampled.onboard import own_part
from gcs.control.history import StateHistory
from gcs.control.law import Blend, FeedbackLaw, VehicleControl, VehicleLaw, command_at, feedback_law, formation_control
from gcs.link import mavlink
from gcs.link.upload import Upload
from gcs.link.vehicle import RemoteVehicle
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.onboard import own_parameters


def law_of(plan: FlightPlan, lost: Sequence[bool]) -> FeedbackLaw:
    """What the station computes of each vehicle's command, around lost vehicles: all of it, or what is streamed."""
    gains = plan.around_loss if any(lost) and plan.around_loss else plan.gains
    if plan.scenario.control.loop == "onboard":
        gains = tuple(K - own_part(plan.model, K) for K in gains)
    return feedback_law(plan.formation, gains, lost)


def upload_of(plan: FlightPlan, system_id: int) -> Upload | None:
    """The parameters that a vehicle has to have before it is armed, if it has a loop of its own."""
    if plan.scenario.control.loop != "onboard":
        return None
    return Upload(own_parameters(plan.formation, plan.gain, plan.formation.system_ids.index(system_id)))


class Stream:
    """What the station sends to vehicles with loops of their own."""

    def __init__(self, plan: FlightPlan) -> None:
        own, model = own_part(plan.model, plan.gain), plan.model
        self._opened_m_s2 = [(0.0, 0.0)] * model.vehicles
        """What the vehicle's own loop wants too much of when the spacing is doubled: K_ii^p times its offset."""
        for i in model.followers:
            on_spacing = own[model.input_slice(i), model.spacing_slice(i)]
            north, east = (on_spacing @ plan.formation.offset_ne_m[i]).tolist()
            self._opened_m_s2[i] = north, east

    def control(
        self,
        history: StateHistory,
        law: FeedbackLaw,
        blends: Sequence[Blend],
        *,
        nominal_velocity_m_s: tuple[float, float],
        opening: float = 1.0,
    ) -> list[VehicleControl]:
        """Errors of every vehicle, and what is streamed to it. As `gcs.control.law.formation_control`, with the law of
        what is streamed, and but for the instant of the errors that a command is computed from.
        """
        controls = formation_control(
            history,
            law,
            blends,
            nominal_velocity_m_s=nominal_velocity_m_s,
            opening=opening,
        )
        for row, (own, blend) in enumerate(zip(law, blends, strict=True)):
            control = controls[row]
            used_ns = _oldest_needed(history, own)
            if own is not None and used_ns not in (0, control.sample_ns):
                velocity = nominal_velocity_m_s
                command = command_at(history, own, row, used_ns, blend, velocity, opening)
                control = control._replace(command_m_s2=command, used_ns=used_ns)
            north, east = control.command_m_s2
            more_north, more_east = self._opened_m_s2[row]
            command = north + (opening - 1.0) * more_north, east + (opening - 1.0) * more_east
            controls[row] = control._replace(command_m_s2=command)
        return controls


def set_point(
    vehicle: RemoteVehicle, control: VehicleControl, nominal_velocity_m_s: tuple[float, float], *, key_ms: int
) -> tuple[Any, ...]:
    """Fields of what is streamed to a vehicle with a loop of its own."""
    return mavlink.velocity_set_point(
        key_ms=key_ms,
        target_system=vehicle.system_id,
        velocity_ned_m_s=(*nominal_velocity_m_s, 0.0),
        acceleration_ne_m_s2=control.command_m_s2,
    )


def _oldest_needed(history: StateHistory, law: VehicleLaw | None) -> int:
    """The oldest instant of the newest states that a law needs; 0 if it needs none, or one that is unknown."""
    if law is None:
        return 0
    newest = [history.newest(term.source) for term in law.terms if any(map(any, term.gains))]
    return min((0 if report is None else report[0] for report in newest), default=0)
