"""A simulated leader flown by somebody else: a vehicle whose pilot flies the scenario's course.

The pilot takes off, waits until the station's first set-point for another vehicle begins the flight, and then flies the
nominal velocity. The station may ask for messages; whatever else it commands is denied.
"""

import math
from collections.abc import Mapping

from scenarios import schema
from scenarios.schema import NS_PER_S
from sim_vehicles.services import mavlink
from sim_vehicles.services.clock import NEVER_NS
from sim_vehicles.services.earth import ORIGIN_ALTITUDE_M
from sim_vehicles.services.parameters import Parameters
from sim_vehicles.vehicles.copter import Copter
from sim_vehicles.vehicles.double_integrator import DoubleIntegrator
from sim_vehicles.vehicles.setpoints import VELOCITY_ACCELERATION, YAW_IGNORED, YAW_RATE_IGNORED
from sim_vehicles.vehicles.shell import Answer

STEP_NS = 20_000_000
"""Time between two corrections of the pilot."""
_UP_FRACTION = 0.95
"""A take-off is over at this fraction of its altitude."""
_ABOUT_FLYING = (
    mavlink.COMMAND_ARM,
    mavlink.COMMAND_MODE,
    mavlink.COMMAND_TAKEOFF,
    mavlink.COMMAND_LAND,
    mavlink.COMMAND_RETURN,
)
_PILOT = (0, 0)


class ExternallyFlown:
    """The craft in the shell: it wraps the craft that its pilot flies."""

    def __init__(self, scenario: schema.Scenario, craft: DoubleIntegrator | Copter, altitude_m: float) -> None:
        self.craft = craft
        self.parameters: Parameters = craft.parameters
        self.version: tuple[int, int, int] = craft.version
        self.is_plain = False
        self.version_1_first: bool = craft.version_1_first
        self.intervals_us: Mapping[int, int] = craft.intervals_us
        self.reports_from_ns: int = craft.reports_from_ns
        self.state_at, self.acts_at, self.move = craft.state_at, craft.acts_at, craft.move
        self.parameters_set, self.report = craft.parameters_set, craft.report
        self.begin_ns = NEVER_NS
        """When the flight along the course begins; the fleet sets it."""
        self._scenario, self._altitude_m = scenario, altitude_m
        self._next_ns = craft.reports_from_ns

    @property
    def deadline_ns(self) -> int:
        return min(self.craft.deadline_ns, self._next_ns)

    def happen(self, time_ns: int) -> None:
        if time_ns < self._next_ns:
            self.craft.happen(time_ns)
            return
        self._next_ns = time_ns + STEP_NS
        self.craft.hear_heartbeat(time_ns)
        craft = self.craft
        if isinstance(craft, Copter) and craft.landed:
            self._take_off(craft, time_ns)
        elif isinstance(craft, Copter) and craft.motion.altitude_m < _UP_FRACTION * self._altitude_m:
            craft.acts_at(time_ns)
        elif time_ns >= self.begin_ns:
            self._steer(time_ns)

    def begin(self, time_ns: int) -> None:
        """Fly the course from now on."""
        self.begin_ns = self._next_ns = time_ns

    def _take_off(self, copter: Copter, time_ns: int) -> None:
        if copter.rules.takeoff_mode == copter.rules.guided_mode:
            copter.change_mode(copter.rules.guided_mode, time_ns)
        copter.command(_command(mavlink.COMMAND_ARM, 1.0), time_ns)
        above_m = 0.0 if copter.rules.takeoff_mode == copter.rules.guided_mode else ORIGIN_ALTITUDE_M
        copter.command(_command(mavlink.COMMAND_TAKEOFF, altitude_m=self._altitude_m + above_m), time_ns)

    def _steer(self, time_ns: int) -> None:
        """Command the course's velocity and acceleration at the middle of the step."""
        craft, middle_s = self.craft, (time_ns - self.begin_ns + STEP_NS // 2) / NS_PER_S
        velocity, acceleration = self._scenario.nominal_velocity_at(middle_s), (0.0, 0.0)
        if self._scenario.course.is_smooth:
            acceleration = self._scenario.smooth_course().at(middle_s).acceleration_ne_m_s2
        guided = mavlink.MODE_GUIDED
        if isinstance(craft, Copter):
            guided = craft.rules.guided_mode
        elif not craft.flight.armed:
            craft.flight.arm(True)
        mask = VELOCITY_ACCELERATION | YAW_IGNORED | YAW_RATE_IGNORED
        setpoint = mavlink.Setpoint(0, (*velocity, 0.0), (*acceleration, 0.0), type_mask=mask)
        if (craft.mode if isinstance(craft, Copter) else craft.flight.mode) != guided:
            craft.take_setpoint(setpoint, time_ns)  # PX4 enters OFFBOARD only while set-points arrive
            craft.change_mode(guided, time_ns)
        craft.take_setpoint(setpoint, time_ns)

    # As the station sees it

    def hear_heartbeat(self, time_ns: int) -> None: ...  # without effect

    def take_setpoint(self, setpoint: mavlink.Setpoint, time_ns: int) -> str:
        del setpoint, time_ns
        return "ignored_not_guided"

    def command(self, command: mavlink.Command, time_ns: int) -> Answer | None:
        del time_ns
        return (mavlink.DENIED, "is flown by its pilot") if command.command in _ABOUT_FLYING else None

    def change_mode(self, mode: int | None, time_ns: int) -> Answer:
        del mode, time_ns
        return mavlink.DENIED, "is flown by its pilot"


def _command(number: int, param1: float = 0.0, *, altitude_m: float = 0.0) -> mavlink.Command:
    """A command of the pilot; NaN as latitude and longitude means where the vehicle is."""
    return mavlink.Command(_PILOT, 0, 0, number, param1, 0.0, 0.0, math.nan, math.nan, altitude_m)
