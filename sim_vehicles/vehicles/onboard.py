"""The loop on board (thesis eq. 5.1): a vehicle feeds back its own errors at once, at its own rate.

    u = K_p (Z_ahead^p - Z^p - d) + K_v (Z^v - v_d) + w

Each step computes the first two terms and holds them. The spacing comes from a sensor that measures the vehicle ahead
every few steps; between measurements it is extrapolated with the measured relative velocity. The set-points bring what
the vehicle cannot know by itself: v_d in their velocity field and w in their acceleration field. w acts when it
arrives, v_d from the next step.

When set-points stop, w is dropped and the other terms stay in force: what the station computed from other vehicles is
stale, but the measured spacing is not, and a vehicle that only coasted would drift among others that keep their places.
"""

import math
from collections.abc import Callable

from scenarios import schema
from scenarios.networks import LARGEST_ID
from scenarios.schema import NS_PER_S
from sim_vehicles.motion.double_integrator import Command, State
from sim_vehicles.services.draws import Use, draws_of
from sim_vehicles.services.parameters import Parameter, Parameters

STEP = -1
"""Stands for a step of this loop among the message ids of the vehicle's schedule."""
LARGEST_GAIN, LARGEST_OFFSET_M = 1e4, 1e6
_AXES = "NE"
_NAMES_P, _NAMES_V = ([f"FORM_{kind}_{i}{j}" for i in _AXES for j in _AXES] for kind in ("KP", "KV"))

Look = tuple[float, float, float, float]
"""A measurement of the sensor: position and velocity of another vehicle relative to this one, north and east."""


def formation_parameters() -> list[Parameter]:
    """The parameters that a station sets before the flight; the loop starts switched off."""
    gains = [Parameter(name, 0.0, -LARGEST_GAIN, LARGEST_GAIN) for name in (*_NAMES_P, *_NAMES_V)]
    offsets = [Parameter(f"FORM_OFF_{axis}", 0.0, -LARGEST_OFFSET_M, LARGEST_OFFSET_M) for axis in _AXES]
    ahead = Parameter("FORM_AHEAD", 0.0, 0.0, float(LARGEST_ID), whole=True)
    return [*gains, *offsets, ahead, Parameter("FORM_LOOP", 0.0, 0.0, 1.0, whole=True)]


class VehicleLoop:
    """The loop of one vehicle. `state_of` gives the true state of another vehicle at a time, for the sensor."""

    def __init__(self, scenario: schema.Scenario, system_id: int, state_of: Callable[[int, int], State | None]) -> None:
        own = scenario.onboard
        self.interval_us = round(1e6 / own.rate_hz)
        self.on = False
        self._look_every = round(own.rate_hz / own.sensor_hz)
        self._state_of = state_of
        self._draw = draws_of(scenario.seed, system_id, Use.SENSOR)
        self._noise = own.position_noise_m, own.velocity_noise_m_s
        self._ahead = 0
        self._offset_m = 0.0, 0.0
        self._on_spacing = self._on_velocity = [0.0] * 4
        self._seen: tuple[int, Look] | None = None
        self._nominal_m_s: tuple[float, float] | None = None
        self._streamed_m_s2 = self._own_m_s2 = (0.0, 0.0)

    def set(self, parameters: Parameters) -> None:
        """Read the gains and the wanted offset from the parameters."""
        self.on = parameters["FORM_LOOP"] == 1.0
        self._ahead = int(parameters["FORM_AHEAD"])
        self._offset_m = parameters["FORM_OFF_N"], parameters["FORM_OFF_E"]
        self._on_spacing, self._on_velocity = ([parameters[name] for name in names] for names in (_NAMES_P, _NAMES_V))

    def stream(self, velocity_m_s: tuple[float, float], acceleration_m_s2: tuple[float, float]) -> None:
        """Take v_d and w from a set-point."""
        self._nominal_m_s, self._streamed_m_s2 = velocity_m_s, acceleration_m_s2

    def drop_stream(self) -> None:
        """Drop w: set-points have stopped, or the mode has changed."""
        self._streamed_m_s2 = 0.0, 0.0

    def step(self, time_ns: int, boot_ms: int, own: State) -> None:
        """Measure the spacing if that is due, and compute the first two terms."""
        if self._ahead and (self._seen is None or boot_ms * 1000 // self.interval_us % self._look_every == 0):
            self._seen = self._look(time_ns, own)
        if self._nominal_m_s is None:
            return
        v_north, v_east = own.velocity_ne_m_s()
        x, y = v_north - self._nominal_m_s[0], v_east - self._nominal_m_s[1]
        g = self._on_velocity
        north, east = g[0] * x + g[1] * y, g[2] * x + g[3] * y
        if self._seen is not None:
            seen_ns, (relative_north, relative_east, closing_north, closing_east) = self._seen
            age_s = (time_ns - seen_ns) / NS_PER_S
            x = relative_north + closing_north * age_s + self._offset_m[0]
            y = relative_east + closing_east * age_s + self._offset_m[1]
            g = self._on_spacing
            north, east = north + g[0] * x + g[1] * y, east + g[2] * x + g[3] * y
        self._own_m_s2 = north, east

    def command(self) -> Command:
        """The command u; zero until the first set-point has brought v_d."""
        (own_north, own_east), (north, east) = self._own_m_s2, self._streamed_m_s2
        whole = own_north + north, own_east + east
        return Command(*whole) if math.isfinite(sum(whole)) else Command()

    def _look(self, time_ns: int, own: State) -> tuple[int, Look] | None:
        other = self._state_of(self._ahead, time_ns)
        if other is None:
            return None
        (v_north, v_east), (own_north, own_east) = other.velocity_ne_m_s(), own.velocity_ne_m_s()
        position_m, velocity_m_s = self._noise
        a, b, c, d = self._draw.standard_normal(4).tolist()
        return time_ns, (
            other.north_m - own.north_m + position_m * a,
            other.east_m - own.east_m + position_m * b,
            v_north - own_north + velocity_m_s * c,
            v_east - own_east + velocity_m_s * d,
        )
