"""The free response of one loop in flight: how its errors evolve when only that loop is disturbed.

A *probe* is a flight in which the formation starts exactly in place at its nominal velocity, except for a small error
of the vehicles of one loop. The vehicles ahead are undisturbed, so the flight shows the free response of that loop
alone. If every vehicle had an error, identical loops along the chain would drive each other at resonance (t^k e^{st}),
and growth could be read only after a long time. A probe removes everything that would mask this response:

* Clock drift, which moves the sampling instants and with them the loop delay. It stays on links with random loss or
  delay, where the loop delay varies in any case.
* Differences between clocks and between links. The station extrapolates states to one instant, so vehicles that report
  a velocity while still on the launcher would show errors of up to v T, and asymmetric links half their asymmetry. All
  vehicles therefore share one clock and the links of the probed vehicle. Moving less than one period of delay between
  the up and down links restores the probed loop's wait for the control tick.
* Changes of the nominal velocity, wind, gusts, sensor and navigation noise, the failsafe, which lossy links would
  trigger, and the limit on the spacing error, because a growing error must be observed for long enough to be measured.
* The vehicles' limits: a clipped response is not linear, and random links push vehicles by more than an error of a
  millimetre. `past_limits` tells whether they do. Autopilots keep their limits; only the part far from them is used.
* With autopilots, the offsets between local frames (up to 5 mm each), clocks that jump, and the start from rest: the
  formation hovers in place, where the loop is the same as at any velocity.

On constant links one flight is enough. Links with random loss or delay push the vehicles all the time. But the loops
are linear, and the links draw the same delays whatever they carry. So the formation is flown twice with the same seed,
once in place and once with one loop disturbed. The difference of the two flights is the free response of that loop
under the drawn delays, exact to the last digit of telemetry.
"""

from dataclasses import dataclass, replace
from math import ceil, isfinite
from pathlib import Path

import numpy as np

from gains.core.arrays import FloatArray
from gcs.control.limits import LARGEST_COMMAND_M_S2
from gcs.control.tick import TickArray, chosen
from gcs.drive.flown import Flight, effective_delays_s, fly_plan, median_delays_s
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.loops import is_modelled
from gcs.stress.axes import has_constant_links
from gcs.stress.growth import CHANNELS
from scenarios.keys.autopilot import Sitl
from scenarios.keys.disturbance import Disturbance
from scenarios.keys.link import Link
from scenarios.schema import Limits, NominalVelocity, Safety, Scenario, Vehicle

PROBE_S, _HIDDEN_MODE_S = 20.0, 60.0
"""Duration of a probe on constant links; the second is for predicted autopilots. At the upper end of their window these
break in a mode that a position error hardly excites and that takes long to outgrow the others."""
_RANDOM_LOOP_DELAYS, _LONGEST_S = 66.0, 120.0
"""On links with random loss or delay, a probe shows a mean growth rate, whose error falls with the number of loop
delays flown. The probe lasts this many loop delays, but at most this many seconds."""
_SPEED_MIN_M_S = 1e-3
"""The kinematics are singular at speed 0."""
_DIRECTION_NE = np.array([1.0, -0.8])
"""Direction of a probe's error: near a diagonal, but not on it. Modes of gains that couple north and east lie on the
diagonals. Both are excited, but unequally: nearly equal modes are hard to separate if both are large."""
_LINEAR_SHARE = 0.8
"""Largest velocity error as a share of the nominal speed: the linearisation is exact at any speed but zero."""
LINEAR_COMMAND_M_S2 = 0.9 * LARGEST_COMMAND_M_S2
_SMALL_M_S = 1.0
"""Velocity error up to which a user's own law or dynamics are assumed linear."""
_LIMIT_SHARE = 0.25
"""Largest command as a share of an autopilot's acceleration. The jerk limit and the velocity loop need the rest."""


@dataclass(frozen=True, eq=False)
class FreeResponse:
    """The errors of one loop's vehicles as rows of the tick record, in time order, and the flight they are from.

    Until `until_s` after the first row, no limit and no singularity was near. `calm_until_s` is the same for the calm
    flight of a pair, and bounds `until_s`. `varying` says whether the delays vary.
    """

    plan: FlightPlan
    flight: Flight
    errors: TickArray
    until_s: float
    varying: bool = False
    calm_until_s: float = np.inf

    def loop_delays_s(self, rows: TickArray, system_ids: tuple[int, ...]) -> dict[int, float]:
        """Loop delay of each vehicle over these rows: effective if the truth is known, else the measured median."""
        if self.flight.truth is None:
            return median_delays_s(rows, system_ids)
        return effective_delays_s(self.plan, rows, self.flight, system_ids)


def response_alone(
    plan: FlightPlan, scenario: Scenario, system_ids: tuple[int, ...], *, real_time: bool, folder: Path | None
) -> FreeResponse:
    """Fly a probe's scenario (see `probe_scenario`); returns the errors of the vehicles `system_ids`."""
    probe = replace(plan, scenario=scenario)
    # if loop delays differ between commands, the loop responds to their mean, which only the truth gives exactly
    flight = fly_plan(probe, real_time=real_time, folder=folder, with_truth=plan.timing.commands > 1)
    errors = _rows_of(flight.ticks, system_ids)
    return FreeResponse(probe, flight, errors, linear_until_s(errors, *_linear_range(plan)))


def fly_calm(plan: FlightPlan, folder: Path | None) -> Flight:
    """Fly the undisturbed formation, in place, on the scenario's own links: the first flight of a pair."""
    return fly_plan(replace(plan, scenario=in_place(plan, (), amplitude=0.0)), folder, with_truth=True)


def response_paired(
    plan: FlightPlan, calm: Flight, system_ids: tuple[int, ...], *, amplitude: float, folder: Path | None
) -> FreeResponse:
    """Fly the second flight of a pair, where the given vehicles start with an error, and subtract the first, `calm`.

    `amplitude` is that of `in_place`. The result ends where the two flights begin to use different states.
    """
    disturbed = replace(plan, scenario=in_place(plan, system_ids, amplitude=amplitude))
    flight = fly_plan(disturbed, folder, with_truth=True)
    rows, calm_rows = _rows_of(flight.ticks, system_ids), _rows_of(calm.ticks, system_ids)
    # keep the leading rows with the same ticks and the same states used: until one of the flights broke
    count = min(len(rows), len(calm_rows))
    same = [rows[name][:count] == calm_rows[name][:count] for name in ("tick", "system_id", "sample_boot_ms")]
    count = int(np.logical_and.accumulate(np.all(same, axis=0)).sum())
    rows, calm_rows = rows[:count], calm_rows[:count]
    until_s, calm_until_s = (linear_until_s(each, *_linear_range(plan)) for each in (rows, calm_rows))
    errors = rows.copy()
    for name in CHANNELS:
        errors[name] -= calm_rows[name]
    varying = not has_constant_links(plan.scenario)
    return FreeResponse(disturbed, flight, errors, min(until_s, calm_until_s), varying, calm_until_s)


def _linear_range(plan: FlightPlan) -> tuple[float, float]:
    """The velocity error (m/s) and the command (m/s²) up to which the loop is linear."""
    if (own := plan.scenario.simulated_autopilot) is not None:
        return np.inf, _LIMIT_SHARE * own.acceleration_max_m_s2
    error_m_s = linear_error_m_s(plan.scenario)
    return error_m_s if is_modelled(plan) else min(error_m_s, _SMALL_M_S), LINEAR_COMMAND_M_S2


def linear_error_m_s(scenario: Scenario) -> float:
    """The velocity error beyond which a vehicle without autopilot is too near the singularity at zero speed."""
    return _LINEAR_SHARE * float(np.hypot(*scenario.nominal_velocity_at(0.0)))


def _rows_of(ticks: TickArray, system_ids: tuple[int, ...]) -> TickArray:
    return chosen(ticks, np.isin(ticks["system_id"], system_ids) & ticks["commanded"] & (ticks["time_s"] >= 0.0))


def in_place(plan: FlightPlan, system_ids: tuple[int, ...], *, amplitude: float) -> Scenario:
    """The plan's scenario with all vehicles in place at nominal velocity, except for an error of the given ones.

    No vehicle enters its failsafe or reaches a limit, and on constant links clocks do not drift. The error is in the
    position of a follower (m), and in the velocity of the leader (m/s), whose position is not controlled. It points in
    `_DIRECTION_NE` and differs from vehicle to vehicle. Vehicles with autopilots start at rest. Their nominal velocity
    is zero or, to give the leader an error, the opposite of that error; followers then have the same velocity error,
    but those outside the leader's loop do not affect it.
    """
    scenario, place, duration_s = plan.scenario.in_steady_flight(), plan.formation.place_ne_m(), PROBE_S
    if scenario.starts_on_ground:
        scenario, duration_s = _at_rest(scenario), PROBE_S if plan.assumed_s is None else _HIDDEN_MODE_S
    if has_constant_links(scenario):
        scenario = scenario.with_keys(clocks={"drift_max_ppm": 0.0})
    elif isfinite(plan.delay_margin_s):
        duration_s = max(PROBE_S, min(ceil(_RANDOM_LOOP_DELAYS * plan.delay_margin_s), _LONGEST_S))
    sector = scenario.disturbance and scenario.disturbance.sector
    [leader] = [vehicle for vehicle in scenario.vehicles if vehicle.follows is None]
    vehicles: list[Vehicle] = []
    for vehicle in scenario.vehicles:
        position = np.array(leader.position_ne_m) + place[plan.formation.row(vehicle.system_id)]
        velocity = np.array(scenario.nominal_velocity_at(0.0))
        if vehicle.system_id in system_ids:
            k = system_ids.index(vehicle.system_id)
            error = amplitude * (1.0 + 0.3 * k) * (-1.0) ** k * _DIRECTION_NE
            if vehicle is leader and scenario.starts_on_ground:
                still = NominalVelocity(from_s=0.0, velocity_ne_m_s=(-float(error[0]), -float(error[1])))
                scenario = scenario.model_copy(update={"nominal_velocity": (still,)})
            elif vehicle is leader:
                velocity += error
            else:
                position += error
        update = {"position_ne_m": tuple(position.tolist()), "velocity_ne_m_s": tuple(velocity.tolist())}
        vehicles.append(vehicle.model_copy(update=update))
    update = {
        "vehicles": tuple(vehicles),
        "limits": Limits(speed_min_m_s=_SPEED_MIN_M_S),
        "duration_s": duration_s,
        "disturbance": sector and Disturbance(sector=sector),  # it depends on the errors, so it is part of the loop
        "navigation": None,
    }
    return scenario.model_copy(update=update).with_keys(
        onboard={"position_noise_m": 0.0, "velocity_noise_m_s": 0.0},
        safety={
            "setpoint_timeout_s": 2.0 * duration_s,
            "heartbeat_timeout_s": 2.0 * duration_s,
            "spacing_error_limit_m": Safety().spacing_error_limit_m,
        },
    )


def _at_rest(scenario: Scenario) -> Scenario:
    """The scenario with hovering autopilots whose local frames share an origin and whose clocks do not jump."""
    still = NominalVelocity(from_s=0.0, velocity_ne_m_s=(0.0, 0.0))
    exact = {"origin_spread_m": 0.0, "clock_jumps": (), "sitl": Sitl()}
    return scenario.model_copy(update={"nominal_velocity": (still,)}).with_keys(autopilot=exact)


def probe_scenario(
    plan: FlightPlan, system_ids: tuple[int, ...], *, amplitude: float, links: tuple[Link, Link], waiting_s: float
) -> Scenario:
    """The plan's scenario `in_place`, with equal clocks and the same `links` (up, down) for all vehicles.

    Delay is moved between the links so that telemetry waits `waiting_s` for the control tick.
    """
    scenario = in_place(plan, system_ids, amplitude=amplitude)
    up, down = with_waiting(*links, period_s=plan.timing.step_s, waiting_s=waiting_s)
    return scenario.with_keys(
        links={"up": up, "down": down, "vehicles": ()}, clocks={"drift_max_ppm": 0.0, "offset_max_s": 0.0}
    )


def with_waiting(up: Link, down: Link, *, period_s: float, waiting_s: float) -> tuple[Link, Link]:
    """Move delay between the links until telemetry sampled at whole periods waits `waiting_s` for the control tick.

    The up link then takes a whole number of periods minus the wait, and the sum of both delays is unchanged. If the
    links are too short for that, the wait stays as it is, and the down link makes up the difference from `waiting_s`.
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


def linear_until_s(own: TickArray, most_m_s: float, most_m_s2: float) -> float:
    """Time from the first row until a velocity error or a command exceeds its bound; infinity if neither does.

    `own` are rows of the probed vehicles, in time order.
    """
    error_m_s, size_m_s2 = _sizes(own)
    beyond = np.flatnonzero((error_m_s > most_m_s) | (size_m_s2 > most_m_s2))
    return float(own["time_s"][beyond[0]] - own["time_s"][0]) if beyond.size else np.inf


def past_limits(scenario: Scenario, own: TickArray) -> bool:
    """Whether these rows show a motion beyond the scenario's limits."""
    limits = scenario.limits
    if limits == Limits():
        return False
    speed_m_s = np.hypot(own["velocity_north_m_s"], own["velocity_east_m_s"])
    _, size_m_s2 = _sizes(own)
    most_m_s2 = np.minimum(
        limits.acceleration_max_m_s2 or np.inf, (limits.turn_rate_max_rad_s or np.inf) * np.maximum(speed_m_s, 1e-9)
    )
    slow = speed_m_s < limits.speed_min_m_s * (not scenario.starts_on_ground)
    fast = speed_m_s > (limits.speed_max_m_s or np.inf)
    return bool((slow | fast | (size_m_s2 > most_m_s2)).any())


def _sizes(own: TickArray) -> tuple[FloatArray, FloatArray]:
    """Velocity errors (m/s) and commands (m/s²)."""
    error_m_s = np.hypot(own["velocity_error_north_m_s"], own["velocity_error_east_m_s"])
    return error_m_s, np.hypot(own["command_north_m_s2"], own["command_east_m_s2"])
