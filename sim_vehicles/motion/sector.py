"""A disturbance that depends on the formation's true errors: w = D e, every control period (thesis eq. 3.20).

e is in the order of `scenarios.schema.Scenario.leader_first`: the leader's velocity error, then spacing error and
velocity error of each other vehicle. w is added to the time derivative of e. For a velocity error, that is an
acceleration. For a spacing error, it is the velocity of the vehicle in front minus the vehicle's own: each vehicle is
carried along at the velocity at which the one in front is carried, minus w.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from scenarios.schema import NS_PER_S, Scenario
from sim_vehicles.motion.air import Push
from sim_vehicles.motion.double_integrator import State

Floats = npt.NDArray[np.float64]


class SectorBound:
    """The disturbance of a formation, with the state of its filters."""

    def __init__(self, scenario: Scenario) -> None:
        assert scenario.disturbance is not None
        sector = scenario.disturbance.sector
        assert sector is not None
        self.period_ns = round(NS_PER_S / scenario.rates.control_hz)
        self._vehicles = scenario.leader_first()
        self._nominal_m_s = np.array(scenario.nominal_velocity[0].velocity_ne_m_s)
        direction = np.array(sector.direction)
        self._gain = sector.norm_1_s * direction / np.linalg.norm(direction, 2)
        self._into = AllPass(sector.all_pass_in, len(direction))
        self._out = AllPass(sector.all_pass_out, len(direction))

    def pushes(self, state_of: Callable[[int], State]) -> dict[int, Push]:
        """The push on each vehicle for one period, by system id, from the true states now."""
        errors: list[Floats] = []
        states = {vehicle.system_id: state_of(vehicle.system_id) for vehicle in self._vehicles}
        for vehicle in self._vehicles:
            own = states[vehicle.system_id]
            if vehicle.follows is not None and vehicle.offset_ne_m is not None:
                ahead = states[vehicle.follows]
                apart = np.array([ahead.north_m - own.north_m, ahead.east_m - own.east_m])
                errors.append(apart + np.array(vehicle.offset_ne_m))
            errors.append(np.array(own.velocity_ne_m_s()) - self._nominal_m_s)
        rates = iter(self._out.passed(self._gain @ self._into.passed(np.array(errors))).tolist())
        found: dict[int, Push] = {}
        for vehicle in self._vehicles:
            carried_north = carried_east = 0.0
            if vehicle.follows is not None:
                ahead_push, (north, east) = found[vehicle.follows], next(rates)
                carried_north, carried_east = ahead_push[2] - north, ahead_push[3] - east
            north, east = next(rates)
            found[vehicle.system_id] = Push(north, east, carried_north, carried_east)
        return found


class AllPass:
    """All-pass filters (c + 1/z) / (1 + c/z), one for each row of a signal (k, 2); c = 1 leaves a row unchanged."""

    def __init__(self, coefficients: tuple[float, ...], count: int) -> None:
        self._c = np.array(coefficients or (1.0,) * count)[:, np.newaxis]
        self._still = self._c == 1.0
        self._before = self._after = np.zeros((count, 2))

    def passed(self, signal: Floats) -> Floats:
        """Filter the signal of one more period: y_k = c x_k + x_{k−1} − c y_{k−1}."""
        out = self._c * signal + self._before - self._c * self._after
        self._before = signal
        self._after = np.where(self._still, signal, out)
        return self._after
