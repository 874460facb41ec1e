"""`gcs identify`: how a scenario's vehicles respond to accelerations, from flights of one of them in virtual time.

For each axis, the leader flies alone, without delay and undisturbed. Its nominal velocity jumps along or across its
course, and a weak loop follows it, at no less than LEAST_RATE_HZ: slower control would leave too few samples. The
models of `gcs.autopilot.identify` are fitted to commands and velocities.
"""

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from gcs.autopilot.identify import LEAST_RATE_HZ, MISFIT_MAX, RESOLUTION, Flown, Identified, identify
from gcs.autopilot.manoeuvre import in_words
from gcs.drive.flown import fly_plan
from gcs.errors import InputError
from gcs.plan.flight_plan import at_once
from gcs.plan.planner import flight_plan
from gcs.runs.grade import commands_of
from gcs.runs.record import END
from scenarios.keys.own import BUILT_IN, names_code
from scenarios.schema import Clocks, Control, FixedGains, Limits, Links, NominalVelocity, Scenario

_AXES = "along", "across"
_LEAST = 0.001
_WHERE_RAD_S = 1.0
"""Frequency of comparison: the slower axis is the one that lags more here. A misfit m leaves m rad of phase open."""
_GAINS = FixedGains(K1=-0.5, K2=0.0, K3=0.1)
_JUMPS, _JUMP_S = (1, -1, -1, 1, 1, -1, 1, 0), 4.0
_JUMP_M_S = 0.5


def responses_of(scenario: Scenario) -> Mapping[str, Identified]:
    """The responses along the course and across it.

    Raises InputError if the vehicle does not fly to the end, or if no model explains its velocity.
    """
    if scenario.dynamics in BUILT_IN:
        wanted = "jsbsim, or dynamics in a Python file: double integrators respond at once, autopilots are identified"
        raise InputError(f"{scenario.name}: dynamics: read {scenario.dynamics!r}, wanted {wanted} in flight")
    return {axis: _identified(scenario, axis) for axis in _AXES}


def _identified(scenario: Scenario, axis: str) -> Identified:
    [leader] = [vehicle for vehicle in scenario.vehicles if vehicle.follows is None]
    nominal, rates = np.array(scenario.nominal_velocity_at(0.0)), scenario.rates
    ahead = nominal / np.hypot(*nominal)
    direction = ahead if axis == _AXES[0] else np.array([-ahead[1], ahead[0]])
    jumps = [nominal + jump * _JUMP_M_S * direction for jump in _JUMPS]
    course = [
        NominalVelocity(from_s=k * _JUMP_S, velocity_ne_m_s=(float(north), float(east)))
        for k, (north, east) in enumerate(jumps)
    ]
    changes = {
        "vehicles": (leader.model_copy(update={"velocity_ne_m_s": tuple(nominal.tolist()), "hears": ()}),),
        "nominal_velocity": tuple(course),
        "duration_s": len(_JUMPS) * _JUMP_S,
        "control": Control(gains=_GAINS),
        "clocks": Clocks(offset_max_s=0.0, drift_max_ppm=0.0),
        "at_end": type(scenario).model_fields["at_end"].default,
        "links": Links(),
        "limits": Limits(),
        "response": None,
        "disturbance": None,
        "navigation": None,
    }
    control_hz, telemetry_hz = (max(own, LEAST_RATE_HZ) for own in (rates.control_hz, rates.telemetry_hz))
    alone = scenario.in_steady_flight().with_calm_monitor().model_copy(update=changes)
    alone = alone.at_rates(control_hz=control_hz, telemetry_hz=telemetry_hz)
    alone = alone.with_keys(safety={"setpoint_timeout_s": alone.duration_s})  # it is the response that is looked for
    flight = fly_plan(flight_plan(alone)[1], with_truth=True)
    assert flight.truth is not None
    rows = flight.ticks[flight.ticks["commanded"]]
    instants_s = commands_of(rows, flight.truth, leader.system_id) / 1e9
    if len(instants_s) < len(rows) or len(rows) < alone.duration_s * alone.rates.control_hz:
        end = next(event.text for event in flight.events if event.kind == END)
        raise InputError(f"{scenario.name}: the leader, alone, did not fly to the end: {end}")
    command, velocity = (
        np.stack([rows[f"{name}_north_{unit}"], rows[f"{name}_east_{unit}"]], axis=1) @ direction
        for name, unit in (("command", "m_s2"), ("velocity", "m_s"))
    )
    sample_s = instants_s[:, 1] - instants_s[0, 0]
    inside = sample_s >= 0.0
    period_s, velocity_commanded = 1.0 / alone.rates.control_hz, not names_code(scenario.dynamics)
    found = at_once(identify(Flown(period_s, command, sample_s[inside], velocity[inside], velocity_commanded)))
    if found is None or found.misfit > MISFIT_MAX:
        read = "no motion"
        if found is not None:
            read = f"{found.misfit:.0%} of its velocity unexplained by {found.response.model}"
        raise InputError(f"{scenario.name}: dynamics: read {read} {axis} the course, wanted at most {MISFIT_MAX:.0%}")
    return found


def as_toml(found: Mapping[str, Identified]) -> str:
    """The results as TOML comments, followed by the response of the slower axis as a table of a scenario."""
    phases = {axis: float(np.angle(one.response.transfer(np.array(_WHERE_RAD_S)))) for axis, one in found.items()}
    slower = min(phases, key=phases.__getitem__)
    lags = f"{slower} the course it lags more at {_WHERE_RAD_S:g} rad/s"
    if max(phases.values()) - phases[slower] <= sum(max(one.misfit, RESOLUTION) for one in found.values()):
        lags = (
            f"both lag alike at {_WHERE_RAD_S:g} rad/s, within their misfits; this is the response {slower} the course"
        )
    values = {name: round(value, 3) for name, value in asdict(found[slower].response).items() if value}
    lines = [
        *(f"# {axis} the course: {in_words(one)}" for axis, one in found.items()),
        f"# {lags}",
        "[response]",
        *(f"{name} = {value}" for name, value in values.items() if value > _LEAST),
    ]
    return "\n".join(lines)
