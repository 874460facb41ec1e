"""Why a scenario or its plan cannot be flown at all.

Each function returns one fault as one line (the scenario's key, what was read, what was wanted), or None.
"""

from dataclasses import replace
from itertools import combinations
from math import dist, hypot

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.structure import strongly_connected_blocks
from gains.performance.response import formation_loop
from gains.sampled.constant import growth_rate
from gains.sampled.onboard import onboard_loop
from gcs.errors import beyond
from gcs.link.clocks import REQUEST_LIFETIME_NS
from gcs.plan.course import nearest_planned
from gcs.plan.expected_delay import expected_loop_delay_s
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.formation import plan_formation
from scenarios.schema import NS_PER_S, Scenario


def unstable_loop(plan: FlightPlan) -> str | None:
    """The fault of a loop that is unstable even without delay; None if it has a delay margin, or an unknown one.

    It names the unstable root of the continuous loop, or the growth rate of a loop that only sampling destabilises.
    """
    if not plan.delay_margin_s <= 0.0:  # also true of NaN, an unknown margin
        return None
    control = plan.scenario.control
    key = "control.blocks" if control.blocks else "control.gains" if control.gains is not None else "control"
    root, system_ids = _rightmost_root(plan)
    who = f"vehicle{'s' * (len(system_ids) > 1)} {' '.join(map(str, system_ids))}"
    if root.real >= -1e-12 * abs(root):
        at = f"{root.real:+.4g}" + (f" ± {abs(root.imag):.4g}j" if root.imag else "")
        read = f"a loop that is unstable without any delay: root {at} 1/s, {who}"
    else:
        rate_1_s = _sampled_growth_1_s(plan)
        read = f"a loop that only sampling makes unstable: it grows at {rate_1_s:+.4g} 1/s without any delay"
    return f"{key}: read {read}; wanted a stable loop (gcs check, design and fly accept it with --allow-unstable)"


def without_actions(plan: FlightPlan) -> FlightPlan:
    """The plan with a monitor that only watches, for a loop without a margin to keep."""
    return replace(plan, scenario=plan.scenario.with_keys(monitor={"act": False}))


def _rightmost_root(plan: FlightPlan) -> tuple[complex, list[int]]:
    """The rightmost root of the continuous loop without delay, and the vehicles of the coupled block it belongs to."""
    model, ids = plan.model, plan.formation.system_ids
    A, B, K = _matrices(plan)
    closed = A + B @ K
    found: list[tuple[complex, list[int]]] = []
    for block in strongly_connected_blocks(closed):
        roots = np.linalg.eigvals(closed[np.ix_(block, block)])
        own = set(block.tolist())
        members = [ids[i] for i in range(model.vehicles) if own & set(range(model.states)[model.output_slice(i)])]
        found.append((complex(roots[np.argmax(roots.real)]), members))
    return max(found, key=lambda entry: entry[0].real)


def _sampled_growth_1_s(plan: FlightPlan) -> float:
    timing = plan.onboard
    if timing is not None:
        return onboard_loop(plan.model, plan.gain, timing).growth_1_s(0.0)
    return growth_rate(*_matrices(plan), period_s=1.0 / plan.scenario.rates.control_hz, delay_s=0.0)


def _matrices(plan: FlightPlan) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A, B and K of the loop as flown, with the vehicles' responses if these are known."""
    if plan.responses is None:
        return plan.model.A, plan.model.B, plan.gain
    return formation_loop(plan.model, plan.gain, plan.responses.in_order(plan.formation.system_ids))


def bad_start(scenario: Scenario) -> str | None:
    """The fault of a start that violates a safety limit at the first tick: a collision, or too large a spacing error.

    It also refuses a nominal or course speed that simulated autopilots cannot fly, and places that are too close
    together at any time in the flight.
    """
    safety, vehicles, offset_ne_m = scenario.safety, scenario.leader_first(), plan_formation(scenario).offset_ne_m
    for one, two in combinations(vehicles, 2):
        above_m = scenario.altitude_of(one) - scenario.altitude_of(two) if not scenario.starts_on_ground else 0.0
        apart_m = hypot(dist(one.position_ne_m, two.position_ne_m), above_m)
        if apart_m < safety.collision_distance_m:
            least_m = safety.collision_distance_m
            read = f"vehicles {one.system_id} and {two.system_id} {beyond(apart_m, least_m)} m apart"
            wanted = f"at least safety.collision_distance_m = {least_m:g} m between any two"
            return f"vehicle {two.system_id}: position_ne_m: read {read}, wanted {wanted}"
    speeds_m_s = [("nominal_velocity", hypot(*entry.velocity_ne_m_s)) for entry in scenario.nominal_velocity]
    own = scenario.simulated_autopilot
    for key, speed_m_s in (*speeds_m_s, ("course.speed_m_s", scenario.course.speed_m_s or 0.0)):
        if own is not None and speed_m_s > own.speed_max_m_s:
            wanted = f"at most autopilot.speed_max_m_s = {own.speed_max_m_s:g} m/s"
            return f"{key}: read {speed_m_s:g} m/s, wanted {wanted}"
    place = {vehicle.system_id: vehicle.position_ne_m for vehicle in vehicles}
    for vehicle, offset in zip(vehicles, offset_ne_m.tolist(), strict=True):
        if vehicle.follows is None:
            continue
        ahead = place[vehicle.follows]
        wanted_ne_m = [a + o for a, o in zip(ahead, offset, strict=True)]
        error_m = dist(wanted_ne_m, vehicle.position_ne_m)
        if error_m > safety.spacing_error_limit_m:
            read = f"a spacing error of {beyond(error_m, safety.spacing_error_limit_m)} m"
            wanted = f"at most safety.spacing_error_limit_m = {safety.spacing_error_limit_m:g} m"
            return f"vehicle {vehicle.system_id}: position_ne_m: read {read}, wanted {wanted}"
    return _close_places(scenario)


def _close_places(scenario: Scenario) -> str | None:
    """The fault of two places that are too close to each other, in the formation or during a formation change."""
    nearest, least_m = nearest_planned(scenario), scenario.safety.collision_distance_m
    if nearest is None or nearest.distance_m >= least_m:
        return None
    one, two = nearest.system_ids
    read = (
        f"places of vehicles {one} and {two} {beyond(nearest.distance_m, least_m, 2)} m apart at {nearest.time_s:.1f} s"
    )
    key = "formation_changes" if scenario.formation_changes else f"vehicle {two}: offset_ne_m"
    return f"{key}: read {read}, wanted at least safety.collision_distance_m = {least_m:g} m"


def endless_link(scenario: Scenario) -> str | None:
    """The fault of a link that loses everything, or is too slow for the flight to begin or for any command to act.

    A TIMESYNC reply that arrives after its request has expired is ignored, so no clock would ever be known.
    """
    lifetime_s = REQUEST_LIFETIME_NS / NS_PER_S
    for vehicle in scenario.leader_first():
        links = scenario.link_of(vehicle.system_id)
        if any(link.loss_probability >= 1.0 for link in links):
            return f"links: read loss_probability 1 to vehicle {vehicle.system_id}, wanted less than 1"
        first_s = sum(link.delay_points[0].delay_s if link.delay_points else link.delay_s for link in links)
        least_s = sum(min((point.delay_s for point in link.delay_points), default=link.delay_s) for link in links)
        read = f"links: read a round trip of {{:g}} s to vehicle {vehicle.system_id}, wanted less than"
        if first_s >= lifetime_s:
            return f"{read.format(first_s)} the {lifetime_s:g} s that the station waits for an answer"
        if least_s >= scenario.duration_s:
            return f"{read.format(least_s)} duration_s = {scenario.duration_s:g} s"
    links = [link for vehicle in scenario.vehicles for link in scenario.link_of(vehicle.system_id)]
    jitters = any(link.jitter for link in links) and not any(link.delay_points for link in links)
    if jitters and (usual_s := expected_loop_delay_s(scenario)) >= lifetime_s:
        wanted = f"less than the {lifetime_s:g} s that the station waits for an answer"
        return f"links: read delays and jitter that make a loop delay of {usual_s:.3g} s, wanted {wanted}"
    return None
