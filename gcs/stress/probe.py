"""A flight that measures one loop and nothing else.

The formation starts exactly in place at its nominal velocity but for the vehicles of one loop, which have a small
error. Nothing acts on the vehicles ahead, so what follows is the free response of that loop alone. In a formation with
errors of its own, identical loops along the chain drive each other at resonance (t^k e^{st}), and growth can be read
only after a long time.

What would hide the loop is taken out:

* Drift of the clocks moves the sampling instants, and with them the loop delay while it is being measured.
* Vehicles on the launcher report a velocity but do not move. The station brings their states to one instant, so it
  would see errors of up to v T where there are none, and push every vehicle at the start. Vehicles that sample at one
  instant do not have this error, so all clocks are one. The time that the probed loop waits for the control tick,
  which its clock decides otherwise, is kept by moving less than one period of delay between its up and down links.
* Links that differ start the vehicles at different instants, and leave clocks that are wrong by different halves of the
  links' asymmetry, which the station sees as errors too. So all vehicles have the links of the one that is probed.
  Its loop is the same for that: what the station uses of the others is brought to the instant of its own state.
* Changes of the nominal velocity, and the noise of the vehicles' sensors.
* The vehicles' failsafe, which lossy links would now and then call for: it opens the loop.
* The scenario's limit of the spacing error: a growing error has to be seen for long enough to be measured.
* The vehicles' limits. A small error stays within them, and so within them the loop is this one; but links that lose or
  delay at random push vehicles by more than an error of a millimetre, and what is cut off then is no linear response.
  `past_limits` says when they do.
"""

from math import ceil, isfinite

import numpy as np

from gains.core.arrays import FloatArray
from gcs.control.limits import LARGEST_COMMAND_M_S2
from gcs.control.tick import TickArray
from gcs.plan.flight_plan import FlightPlan
from gcs.stress.axes import has_constant_links
from scenarios.schema import Limits, Link, Safety, Scenario, Vehicle

PROBE_S = 20.0
"""How long a probe is flown, if that is enough."""
_RANDOM_LOOP_DELAYS, _LONGEST_S = 66.0, 120.0
"""On links that lose or delay at random a probe shows a mean rate, the better the more loop delays it lasts; up to so
many seconds."""
_SPEED_MIN_M_S = 1e-3
"""The kinematics are singular at speed 0 only."""
_DIRECTION_NE = np.array([1.0, -0.8])
"""Of a probe's error: no diagonal, as gains that couple north and east have modes in just these; and near one, as two
modes that are nearly the same are told apart badly where both are large."""


def probe_duration_s(plan: FlightPlan) -> float:
    """How long a probe is flown: on random links so many loop delays at the margin, where that is more."""
    if has_constant_links(plan.scenario) or not isfinite(plan.delay_margin_s):
        return PROBE_S
    return max(PROBE_S, min(ceil(_RANDOM_LOOP_DELAYS * plan.delay_margin_s), _LONGEST_S))


def in_place(plan: FlightPlan, system_ids: tuple[int, ...], *, amplitude: float) -> Scenario:
    """The plan's scenario with every vehicle in place at its nominal velocity, but for an error of the given vehicles.

    No vehicle goes to its failsafe or meets a limit.

    The error is in the position of a follower (m) and in the velocity of the leader (m/s), whose position is not
    controlled; in `_DIRECTION_NE`, and different for each vehicle.
    """
    scenario, place, duration_s = plan.scenario, plan.formation.place_ne_m(), probe_duration_s(plan)
    row = {system_id: k for k, system_id in enumerate(plan.formation.system_ids)}
    [leader] = [vehicle for vehicle in scenario.vehicles if vehicle.follows is None]
    vehicles: list[Vehicle] = []
    for vehicle in scenario.vehicles:
        position = np.array(leader.position_ne_m) + place[row[vehicle.system_id]]
        velocity = np.array(scenario.nominal_velocity[0].velocity_ne_m_s)
        if vehicle.system_id in system_ids:
            k = system_ids.index(vehicle.system_id)
            error = amplitude * (1.0 + 0.3 * k) * (-1.0) ** k * _DIRECTION_NE
            if vehicle is leader:
                velocity += error
            else:
                position += error
        update = {"position_ne_m": tuple(position.tolist()), "velocity_ne_m_s": tuple(velocity.tolist())}
        vehicles.append(vehicle.model_copy(update=update))
    update = {
        "vehicles": tuple(vehicles),
        "nominal_velocity": scenario.nominal_velocity[:1],
        "limits": Limits(speed_min_m_s=_SPEED_MIN_M_S),
        "duration_s": duration_s,
        "onboard": scenario.onboard.model_copy(update={"position_noise_m": 0.0, "velocity_noise_m_s": 0.0}),
        "safety": scenario.safety.model_copy(
            update={
                "setpoint_timeout_s": 2.0 * duration_s,
                "heartbeat_timeout_s": 2.0 * duration_s,
                "spacing_error_limit_m": Safety().spacing_error_limit_m,
            }
        ),
    }
    return scenario.model_copy(update=update)


def probe_scenario(
    plan: FlightPlan, system_ids: tuple[int, ...], *, amplitude: float, links: tuple[Link, Link], waiting_s: float
) -> Scenario:
    """The plan's scenario `in_place`, with one clock, and for all vehicles the same `links` (up, down).

    The links are changed so that telemetry waits `waiting_s` for the control tick.
    """
    scenario = in_place(plan, system_ids, amplitude=amplitude)
    up, down = with_waiting(*links, period_s=plan.timing.step_s, waiting_s=waiting_s)
    update = {
        "links": scenario.links.model_copy(update={"up": up, "down": down, "vehicles": ()}),
        "clocks": scenario.clocks.model_copy(update={"drift_max_ppm": 0.0, "offset_max_s": 0.0}),
    }
    return scenario.model_copy(update=update)


def with_waiting(up: Link, down: Link, *, period_s: float, waiting_s: float) -> tuple[Link, Link]:
    """The links with delay moved between them so that telemetry sampled at whole periods waits for so long.

    The up link then takes a whole number of periods less the waiting; up and down together take what they did. Links
    too short to move delay keep the loop delay instead: the down link takes the time that telemetry does not wait.
    """
    if up.delay_points or down.delay_points:
        return up, down
    to_down_s = (up.delay_s + waiting_s) % period_s
    to_down_s -= period_s if to_down_s > up.delay_s else 0.0
    from_up_s = to_down_s
    if down.delay_s + to_down_s < 0.0:
        from_up_s, to_down_s = 0.0, waiting_s - (-up.delay_s) % period_s

    def moved(link: Link, by_s: float) -> Link:
        return link.model_copy(update={"delay_s": max(0.0, link.delay_s + by_s)})

    return moved(up, -from_up_s), moved(down, to_down_s)


def linear_until_s(scenario: Scenario, own: TickArray, *, share: float) -> float:
    """Time since the first of the rows at which an error comes near the singularity at speed zero.

    `own` are rows of the probed vehicles, in order of time; infinity if none does. `share` is the part of the nominal
    speed that an error may reach.
    """
    speed = float(np.hypot(*scenario.nominal_velocity[0].velocity_ne_m_s))
    error_m_s, size_m_s2 = _sizes(own)
    beyond = np.flatnonzero((error_m_s > share * speed) | (size_m_s2 > 0.9 * LARGEST_COMMAND_M_S2))
    return float(own["time_s"][beyond[0]] - own["time_s"][0]) if beyond.size else np.inf


def past_limits(scenario: Scenario, own: TickArray) -> bool:
    """Whether vehicles with the scenario's limits could not have done what is in these rows."""
    limits = scenario.limits
    if limits == Limits():
        return False
    speed_m_s = np.hypot(own["velocity_north_m_s"], own["velocity_east_m_s"])
    _, size_m_s2 = _sizes(own)
    most_m_s2 = np.minimum(limits.acceleration_max_m_s2 or np.inf, (limits.turn_rate_max_rad_s or np.inf) * speed_m_s)
    slow, fast = speed_m_s < limits.speed_min_m_s, speed_m_s > (limits.speed_max_m_s or np.inf)
    return bool((slow | fast | (size_m_s2 > most_m_s2)).any())


def _sizes(own: TickArray) -> tuple[FloatArray, FloatArray]:
    """Velocity errors (m/s) and commands (m/s²)."""
    error_m_s = np.hypot(own["velocity_error_north_m_s"], own["velocity_error_east_m_s"])
    return error_m_s, np.hypot(own["command_north_m_s2"], own["command_east_m_s2"])
