"""A scenario before its flight: places, errors and commands at the start, and the expected loop delay."""

from itertools import combinations
from math import hypot, inf

import numpy as np

from gcs.control.loop_delay import headroom
from gcs.plan.at_delay import expected_loop_delay_s
from gcs.plan.flight_plan import FlightPlan
from gcs.published import Published


class VehicleCheck(Published):
    """One vehicle at the start."""

    system_id: int
    follows: int | None
    place_ne_m: tuple[float, float]
    """Wanted position relative to the leader."""
    spacing_error_m: float | None
    """None for the leader."""
    command_m_s2: float
    """Magnitude of the first command, before any limit."""
    command_max_m_s2: float | None
    """The acceleration that the vehicle can fly at its initial speed; None without a limit."""


class ScenarioCheck(Published):
    """A scenario before its flight."""

    expected_loop_delay_s: float
    delay_margin_s: float | None
    """None if no delay makes the loop unstable; with prediction the upper end of the mismatch window."""
    headroom: float
    """1 - expected loop delay / margin; with prediction 1 - mismatch / distance to the end of its window."""
    closest_m: float | None
    """Least distance between two vehicles in their places; None for a single vehicle."""
    vehicles: tuple[VehicleCheck, ...]


def check(plan: FlightPlan) -> ScenarioCheck:
    """The vehicles of a plan at the start, and the headroom that the scenario's links leave."""
    scenario, formation, model = plan.scenario, plan.formation, plan.model
    ordered = scenario.leader_first()
    place = formation.place_ne_m()
    errors = np.zeros(model.states)
    for row, vehicle in enumerate(ordered):
        velocity = np.array(vehicle.velocity_ne_m_s)
        errors[model.velocity_slice(row)] = velocity - scenario.nominal_velocity_at(0.0)
        if row > 0:
            ahead = ordered[model.predecessors[row]]
            apart = np.array(ahead.position_ne_m) - vehicle.position_ne_m
            errors[model.spacing_slice(row)] = apart + formation.offset_ne_m[row]
    commands = plan.gain @ errors
    limits = scenario.limits
    vehicles: list[VehicleCheck] = []
    for row, vehicle in enumerate(ordered):
        north_m, east_m = place[row].tolist()
        turning = (limits.turn_rate_max_rad_s or inf) * hypot(*vehicle.velocity_ne_m_s)
        most = min(limits.acceleration_max_m_s2 or inf, turning)
        vehicles.append(
            VehicleCheck(
                system_id=vehicle.system_id,
                follows=vehicle.follows,
                place_ne_m=(north_m, east_m),
                spacing_error_m=float(hypot(*errors[model.spacing_slice(row)])) if row else None,
                command_m_s2=float(hypot(*commands[model.input_slice(row)])),
                command_max_m_s2=most if most < inf else None,
            )
        )
    delay_s = expected_loop_delay_s(scenario)
    known_s = {"off": 0.0, "measured": delay_s}
    assumed_s = plan.assumed_s or known_s[str(scenario.control.prediction)]
    tolerated = plan.tolerance.at(assumed_s)
    margin_s = tolerated.longer_s[0]
    return ScenarioCheck(
        expected_loop_delay_s=delay_s,
        delay_margin_s=assumed_s + margin_s if margin_s < inf else None,
        headroom=headroom(tolerated.used_s(0, delay_s - assumed_s), margin_s),
        closest_m=min((float(hypot(*(a - b))) for a, b in combinations(place, 2)), default=None),
        vehicles=tuple(vehicles),
    )
