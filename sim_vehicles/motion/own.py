"""The user's own dynamics of a vehicle: a Python function that the scenario names, in place of the double integrator.

The function is `step(state, command, dt_s, memory)`, which returns the state `dt_s` seconds later:

    state    (4,): position north and east in m, velocity north and east in m/s
    command  (2,): the commanded acceleration north and east in m/s²
    dt_s     at most `LONGEST_STEP_S`; it may be as short as the time between two messages
    memory   a dict of this vehicle's own, empty at the start: the only place to keep anything between calls

If a step raises an exception, or returns anything but four finite numbers within FARTHEST_M and FASTEST_M_S, the
vehicle keeps its velocity and the fault is counted.
"""

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from scenarios.own_code import function_of
from scenarios.schema import Scenario
from sim_vehicles.motion.double_integrator import Bounds, Command, State, state_from

LONGEST_STEP_S = 0.01
FARTHEST_M, FASTEST_M_S = 1e7, 1e5
"""A state beyond these is a fault of the model: messages carry single precision."""
Floats = npt.NDArray[np.float64]


class OwnMotion:
    """The motion of one vehicle by its step function, with the function's memory."""

    def __init__(self, scenario: Scenario, on_fault: Callable[[str], None]) -> None:
        """`on_fault` is called with each fault, as one line."""
        self._step = function_of(scenario, "dynamics")
        self._on_fault: Callable[[str], None] = on_fault
        self._memory: dict[str, Any] = {}

    def advance(self, state: State, command: Command, bounds: Bounds, duration_s: float) -> State:
        """The state after `duration_s` with the command held, as `double_integrator.advance`."""
        del bounds  # the model has its own limits
        flown: Floats = np.array([state.north_m, state.east_m, *state.velocity_ne_m_s()])
        steps = max(1, math.ceil(duration_s / LONGEST_STEP_S))
        dt_s = duration_s / steps
        for _ in range(steps):
            after = self._after(flown, command, dt_s)
            flown = np.concatenate([flown[:2] + dt_s * flown[2:], flown[2:]]) if after is None else after
        north, east, v_north, v_east = flown.tolist()
        return state_from((north, east), (v_north, v_east))

    def foreseen(self, state: State, command: Command, bounds: Bounds, duration_s: float) -> State:
        """As `advance`, but the memory stays as it is, and faults are not reported."""
        ahead = copy.copy(self)
        ahead._memory = copy.deepcopy(self._memory)
        ahead._on_fault = lambda _: None
        return ahead.advance(state, command, bounds, duration_s)

    def _after(self, flown: Floats, command: Command, dt_s: float) -> Floats | None:
        """The state a step later; None if the model raises an exception or returns an invalid state."""
        wanted = np.array(command[:2]) + command.velocity_gain_1_s * (np.array(command[2:4]) - flown[2:])
        try:
            with np.errstate(all="ignore"):
                answer: object = self._step(flown.copy(), wanted, dt_s, self._memory)
            found: Floats = np.array(answer, dtype=np.float64)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever the user's model raises
            self._on_fault(f"{type(error).__name__}: {error}")
            return None
        if found.shape != (4,):
            self._on_fault(f"returned shape {found.shape}, wanted (4,)")
        elif not (np.abs(found[:2]).max() <= FARTHEST_M and np.abs(found[2:]).max() <= FASTEST_M_S):
            self._on_fault(f"returned {found.tolist()}")
        else:
            return found
        return None
