"""Motion of an aircraft with six degrees of freedom: a model of the package jsbsim, and its autopilot.

The autopilot filters the commanded acceleration w into a reference that an aircraft can fly:

    a_r'' = ω² (w - a_r) - 2 ζ ω a_r',   v_r' = a_r,   ω = 2 rad/s, ζ = 0.8

It aims at a_r + k (v_r - v), k = 3 1/s. The component along the course sets the throttle, the component across it the
bank angle of a coordinated turn. The elevator holds the altitude, the rudder keeps the turn coordinated. The
effectiveness of each control at this speed is measured on the model before the flight. Gains are divided by it, so that
one set of gains flies different models.

Autopilot and model run every 10 ms, with the mean of the commands since the last step. Between steps, and when looking
ahead, the acceleration is held. Vectors in the plane are complex numbers, north + j east.
"""

import cmath
import math
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from scenarios.errors import ScenarioError
from scenarios.keys.own import aircraft_of
from scenarios.schema import Scenario, Vehicle
from sim_vehicles.motion.double_integrator import Bounds, Command, State, state_from
from sim_vehicles.services.earth import GRAVITY_M_S2, ORIGIN_ALTITUDE_M

STEP_S = 0.01
FOOT_M = 0.3048
_OMEGA_RAD_S, _DAMPING, _VELOCITY_1_S = 2.0, 0.8, 3.0
_OWED_M_S = 0.5
"""Largest difference of velocity between the reference and an aircraft that cannot follow it."""
_BANK_1_S, _ROLL_1_S, _BANK_MAX_RAD = 5.0, 12.0, math.radians(60.0)
_CLIMB_1_S, _CLIMB_1_S2 = 0.5, 0.05
"""Gains to climb rate, from the height error and from its integral."""
_PITCH_1_S, _PITCH_RATE_1_S, _PITCH_RATE_1_S2 = 1.5, 4.0, 4.0
_YAW_1_S, _SIDESLIP_1_S = 6.0, 1.0
_NUDGES = (
    ("throttle", "velocities/vt-fps", 1.0, FOOT_M),
    *(
        (control, f"velocities/{rate}-rad_sec", 0.2, 1.0)
        for control, rate in (("aileron", "p"), ("elevator", "q"), ("rudder", "r"))
    ),
)
"""Each control, the quantity that it changes, how long that is observed in s, and its unit in SI."""
_NUDGE = 0.05
_FULL_TRIM = 1


class Attitude(NamedTuple):
    """Height gained, climb rate and angles of an aircraft at its last step; angles as in MAVLink's ATTITUDE."""

    climbed_m: float
    climb_m_s: float
    roll_rad: float
    pitch_rad: float
    heading_rad: float


class Aircraft:
    """The motion of one aircraft. A push moves the air, which carries the aircraft along."""

    def __init__(self, scenario: Scenario, own: Vehicle) -> None:
        """Raises ScenarioError if the package or the model is missing, or cannot fly level at the vehicle's speed."""
        velocity, altitude_m = complex(*own.velocity_ne_m_s), ORIGIN_ALTITUDE_M + scenario.altitude_of(own)
        how = aircraft_of(scenario.dynamics), abs(velocity), altitude_m
        try:
            self._effects = _effects(*how)
            self._model = _levelled(*how, cmath.phase(velocity))
        except _FlightError as error:
            raise ScenarioError(Path(scenario.name), "dynamics", scenario.dynamics, str(error)) from None
        self._trim = {control: self._model[f"fcs/{control}-cmd-norm"] for control, *_ in _NUDGES}
        self._height_m, self._pitch_rad = self._model["position/h-sl-ft"] * FOOT_M, self._model["attitude/theta-rad"]
        self._place, self._velocity = complex(*own.position_ne_m), _velocity(self._model)
        self._acceleration = self._followed = self._jerk = 0.0j
        self._reference = self._velocity
        self._height_sum = self._pitch_sum = 0.0
        self._air_place = self._air_velocity = 0.0j
        """Displacement and velocity of the air."""
        self._since_s, self._commanded = 0.0, 0.0j
        """Time since the last step, and the integral of the commands over it."""
        self._shown: State | None = None

    def advance(self, state: State, command: Command, bounds: Bounds, duration_s: float) -> State:
        """The state after `duration_s` with the command held, as `double_integrator.advance`."""
        if self._shown is not None and state is not self._shown:
            self._air_place += complex(state.north_m - self._shown.north_m, state.east_m - self._shown.east_m)
            self._air_velocity += complex(*state.velocity_ne_m_s()) - complex(*self._shown.velocity_ne_m_s())
        self._air_place += duration_s * self._air_velocity
        while duration_s > 0.0:
            t = min(duration_s, STEP_S - self._since_s)
            owed = complex(*command[2:4]) - self._velocity - self._air_velocity
            self._commanded += t * (complex(*command[:2]) + command.velocity_gain_1_s * owed)
            self._since_s += t
            duration_s -= t
            if self._since_s > STEP_S - 1e-9:
                self._step(self._commanded / STEP_S)
                self._since_s, self._commanded = 0.0, 0.0j
        place, velocity = self._place + self._air_place, self._velocity + self._air_velocity
        place -= self._since_s * self._air_velocity
        stepped = state_from((place.real, place.imag), (velocity.real, velocity.imag))
        self._shown = self.foreseen(stepped, command, bounds, self._since_s)
        return self._shown

    def foreseen(self, state: State, command: Command, bounds: Bounds, duration_s: float) -> State:
        """The state after `duration_s` at the present acceleration; the aircraft itself is not advanced."""
        del command, bounds  # the model has its own limits
        north, east = state.velocity_ne_m_s()
        t, a_north, a_east = duration_s, self._acceleration.real, self._acceleration.imag
        half = 0.5 * t
        place = state.north_m + t * (north + half * a_north), state.east_m + t * (east + half * a_east)
        return state_from(place, (north + t * a_north, east + t * a_east))

    def attitude(self) -> Attitude:
        """Height gained since the start, climb rate and angles, at the last step."""
        climbed_m = self._model["position/h-sl-ft"] * FOOT_M - self._height_m
        roll, pitch, heading = (self._model[f"attitude/{angle}-rad"] for angle in ("phi", "theta", "psi"))
        return Attitude(climbed_m, self._model["velocities/h-dot-fps"] * FOOT_M, roll, pitch, heading)

    def _step(self, wanted: complex) -> None:
        """Run autopilot and model for one step."""
        pull = _OMEGA_RAD_S**2 * (wanted - self._followed)
        self._jerk += STEP_S * (pull - 2.0 * _DAMPING * _OMEGA_RAD_S * self._jerk)
        self._followed += STEP_S * self._jerk
        owed = self._reference + STEP_S * self._followed - self._velocity
        self._reference = self._velocity + owed * min(1.0, _OWED_M_S / max(abs(owed), 1e-9))
        _set(self._model, self._controls())
        self._model.run()
        before, self._velocity = self._velocity, _velocity(self._model)
        self._place += 0.5 * STEP_S * (before + self._velocity)
        self._acceleration = (self._velocity - before) / STEP_S

    def _controls(self) -> dict[str, float]:
        get, ahead = self._model, self._velocity / abs(self._velocity)
        speed, roll_rad = abs(self._velocity), self._model["attitude/phi-rad"]
        target = (self._followed + _VELOCITY_1_S * (self._reference - self._velocity)) * ahead.conjugate()
        bank = max(-_BANK_MAX_RAD, min(_BANK_MAX_RAD, math.atan2(target.imag, GRAVITY_M_S2)))
        banking = (self._jerk * ahead.conjugate()).imag / GRAVITY_M_S2
        roll = banking + _BANK_1_S * (bank - roll_rad) - get["velocities/p-rad_sec"]

        to_go = self._height_m - get["position/h-sl-ft"] * FOOT_M
        self._height_sum += STEP_S * to_go
        climb = _CLIMB_1_S * to_go + _CLIMB_1_S2 * self._height_sum - get["velocities/h-dot-fps"] * FOOT_M
        pitch = _PITCH_1_S * (self._pitch_rad + climb / speed - get["attitude/theta-rad"]) - get["velocities/q-rad_sec"]
        self._pitch_sum += STEP_S * pitch

        yaw = GRAVITY_M_S2 * math.sin(roll_rad) / speed - get["velocities/r-rad_sec"]
        yaw += _SIDESLIP_1_S * get["aero/beta-rad"]
        wanted = {
            "throttle": target.real,
            "aileron": _ROLL_1_S * roll,
            "elevator": _PITCH_RATE_1_S * pitch + _PITCH_RATE_1_S2 * self._pitch_sum,
            "rudder": _YAW_1_S * yaw,
        }
        return {control: self._trim[control] + wanted[control] / self._effects[control] for control in wanted}


class _FlightError(Exception):
    """A model cannot be flown; the text names what was wanted."""


def _levelled(name: str, speed_m_s: float, altitude_m: float, course_rad: float) -> Any:
    """A model of the package, trimmed to steady level flight on a course."""
    try:
        jsbsim: Any = import_module("jsbsim")  # has no type stubs
    except ModuleNotFoundError:
        raise _FlightError("the package jsbsim: pip install 'formation-gcs[jsbsim]'") from None
    folder = Path(jsbsim.__file__).parent
    if not (folder / "aircraft" / name / f"{name}.xml").exists():
        raise _FlightError(f"jsbsim:MODEL with a folder of {folder / 'aircraft'}")
    jsbsim.set_logger(jsbsim.DefaultLogger(jsbsim.LogLevel.FATAL))  # it prints to standard output otherwise
    model = jsbsim.FGFDMExec(str(folder))
    model.set_debug_level(0)
    try:
        model.load_model(name)
        model.disable_output()  # the model's own output files, which would be written into the working directory
        model.set_dt(STEP_S)
        for key, value in (
            ("ic/h-sl-ft", altitude_m / FOOT_M),
            ("ic/vt-fps", speed_m_s / FOOT_M),
            ("ic/psi-true-deg", math.degrees(course_rad)),
            ("ic/gamma-deg", 0.0),
            ("gear/gear-cmd-norm", 0.0),
            ("gear/gear-pos-norm", 0.0),
            ("propulsion/fuel_freeze", 1.0),
        ):
            model[key] = value
        model.run_ic()
        model.get_propulsion().init_running(-1)
        model.do_trim(_FULL_TRIM)
    except (jsbsim.BaseError, RuntimeError) as error:
        wanted = f"a model that flies level at {speed_m_s:g} m/s and {altitude_m:g} m ({' '.join(str(error).split())})"
        raise _FlightError(wanted) from None
    model.set_trim_status(False)  # while it is set, engines respond at once
    return model


@lru_cache(maxsize=16)
def _effects(name: str, speed_m_s: float, altitude_m: float) -> dict[str, float]:
    """Control effectiveness: the acceleration (m/s² or rad/s²) that full deflection adds to steady flight."""
    found: dict[str, float] = {}
    for control, rate, duration_s, unit in _NUDGES:
        ends: list[float] = []
        for nudge in (0.0, _NUDGE):
            model = _levelled(name, speed_m_s, altitude_m, 0.0)
            trim = model[f"fcs/{control}-cmd-norm"]
            for _ in range(round(duration_s / STEP_S)):
                _set(model, {control: trim + nudge})
                model.run()
            ends.append(model[rate] * unit)
        found[control] = (ends[1] - ends[0]) / (_NUDGE * duration_s)
        if abs(found[control]) < 1e-2:
            raise _FlightError(f"a model whose {control} acts at {speed_m_s:g} m/s")
    return found


def _set(model: Any, controls: dict[str, float]) -> None:
    for control, value in controls.items():
        if control == "throttle":
            for engine in range(model.get_propulsion().get_num_engines()):
                model[f"fcs/throttle-cmd-norm[{engine}]"] = max(0.0, min(1.0, value))
        else:
            model[f"fcs/{control}-cmd-norm"] = max(-1.0, min(1.0, value))


def _velocity(model: Any) -> complex:
    return complex(model["velocities/v-north-fps"], model["velocities/v-east-fps"]) * FOOT_M
