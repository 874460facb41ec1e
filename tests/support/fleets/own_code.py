"""A leader and a follower at 20 Hz whose law or dynamics are code, for tests."""

from typing import Any

from scenarios.keys.own import CodeFile
from scenarios.schema import Clocks, Control, FixedGains, Rates, Scenario
from tests.support.fleets.stress_pair import SCENARIO

LAW = """
import numpy as np

K1, K2, K3 = -5.0, 0.5, 9.0
LAG_S = 0.1


def linear(t_s, states, formation, memory):
    velocity = formation.velocity_error_m_s(states)
    command = K1 * velocity + K3 * formation.spacing_error_m(states)
    command[1:] += K2 * velocity[list(formation.predecessors[1:])]
    return command


def matrices(formation):
    return formation.model.overlapping_gain(*(gain * np.eye(2) for gain in (K1, K2, K3)))


def soft(t_s, states, formation, memory):
    return 20.0 * np.tanh(linear(t_s, states, formation, memory) / 20.0)


def step(state, command, dt_s, memory):
    position, velocity = state[:2], state[2:]
    return np.concatenate([position + dt_s * velocity + dt_s**2 / 2.0 * command, velocity + dt_s * command])


def lagged(state, command, dt_s, memory):
    position, velocity, was = state[:2], state[2:], memory.get("acceleration", np.zeros(2))
    left = np.exp(-dt_s / LAG_S)
    gone = LAG_S * (1.0 - left)
    memory["acceleration"] = command + (was - command) * left
    velocity_after = velocity + dt_s * command + gone * (was - command)
    moved = dt_s * velocity + dt_s**2 / 2.0 * command + LAG_S * (dt_s - gone) * (was - command)
    return np.concatenate([position + moved, velocity_after])
"""
"""The law with the gains of `given`, exact and saturating; as dynamics, the double integrator, exact and with a lag."""
GIVEN = FixedGains(K1=-5.0, K2=0.5, K3=9.0)


def given(**changes: Any) -> Scenario:
    """The formation with gains, without any code. All vehicles sample at the same instants."""
    parts: dict[str, Any] = {
        "rates": Rates(control_hz=20.0, telemetry_hz=20.0, timesync_hz=5.0),
        "clocks": Clocks(offset_max_s=0.0, drift_max_ppm=0.0),
        "control": Control(gains=GIVEN),
    }
    return SCENARIO.model_copy(update=parts | changes)


def coded(text: str = LAW, *, law: str = "", linear: str = "", dynamics: str = "", **changes: Any) -> Scenario:
    """The formation with functions of a text as law, matrices and dynamics."""
    parts: dict[str, Any] = {"code": (CodeFile(name="own.py", text=text),)}
    if law:
        stated = f"own.py:{linear}" if linear else None
        parts["control"] = Control(method="python", controller=f"own.py:{law}", linear=stated)
    if dynamics:
        parts["dynamics"] = f"own.py:{dynamics}"
    return given(**parts, **changes)
