"""The double integrator: a UAV that follows the commanded acceleration at once, with the modes of ArduCopter.

It starts on a launcher, where it reports its initial position and velocity without moving. Its flight begins when,
armed and in GUIDED, it accepts a take-off command or its first set-point.
"""

import math
from collections.abc import Callable, Mapping

from scenarios import schema
from scenarios.kernel import Cell, at_row
from scenarios.keys.own import BUILT_IN, aircraft_of, names_code
from scenarios.networks import wire_id
from scenarios.schema import NS_PER_S
from sim_vehicles.links.truth import ACTED
from sim_vehicles.motion import double_integrator as motion
from sim_vehicles.motion.air import Air, Push
from sim_vehicles.motion.aircraft import Aircraft, Attitude
from sim_vehicles.motion.double_integrator import COAST, VELOCITY_GAIN_1_S, Bounds, Command, State
from sim_vehicles.motion.navigation import Navigator
from sim_vehicles.motion.own import OwnMotion
from sim_vehicles.services import frames, mavlink, messages
from sim_vehicles.services.earth import GRAVITY_M_S2, ORIGIN_ALTITUDE_M, degrees
from sim_vehicles.services.parameters import ARDUPILOT_SETUP, Parameters, fixed, timeout
from sim_vehicles.services.services import whole
from sim_vehicles.vehicles import setpoints
from sim_vehicles.vehicles.flight_mode import MODE_NAMES, FlightMode
from sim_vehicles.vehicles.hold import Hold
from sim_vehicles.vehicles.onboard import STEP, VehicleLoop, formation_parameters
from sim_vehicles.vehicles.shell import Answer, Radio

CANNOT_LAND: Answer = mavlink.DENIED, "cannot land or return, LOITER holds the course"
"""Also sent as STATUSTEXT: a person who asks for this may not see the result code."""

_ACCELERATION_ONLY = setpoints.ACCELERATION | setpoints.YAW_IGNORED | setpoints.YAW_RATE_IGNORED


Step = Callable[[State, Command, Bounds, float], State]
LAG_INTERVAL_US = 200_000
"""Time between two reports of the lag after which held set-points act."""


_push_on_at, _advance_to_at = at_row(motion.move_under_push), at_row(motion.advance_to)


class DoubleIntegrator:
    """The craft in the shell: its motion and modes, and its loop on board if it has one."""

    version: tuple[int, int, int] = (4, 6, 0)
    """The version of ArduCopter whose messages and modes it has."""
    version_1_first: bool = False
    intervals_us: Mapping[int, int] = {
        frames.LOCAL_POSITION: 250_000,
        frames.GLOBAL_POSITION: 1_000_000,
        mavlink.HOME_POSITION: 0,
        mavlink.POSITION_TARGET: 0,
    }
    """Slow defaults, as on an autopilot's telemetry port. MAV_CMD_SET_MESSAGE_INTERVAL changes the rates."""

    _state_ns = Cell[int]()
    _altitude_m = Cell[float]()

    def __init__(
        self, scenario: schema.Scenario, own: schema.Vehicle, radio: Radio, onboard: VehicleLoop | None = None
    ) -> None:
        safety = scenario.safety
        self._vehicles, self._columns, self._row = radio.place
        self.flight = FlightMode(safety, radio.place)
        timeouts = (
            timeout("GUID_TIMEOUT", safety.setpoint_timeout_s),
            timeout("FS_GCS_TIMEOUT", safety.heartbeat_timeout_s),
        )
        formation = [] if onboard is None else formation_parameters()
        number = fixed("SYSID_THISMAV", wire_id(own.system_id))
        self.parameters = Parameters([number, *timeouts, *ARDUPILOT_SETUP, *formation])
        self.reports_from_ns = radio.start_ns
        self._radio = radio
        self._onboard = onboard
        self._bounds = motion.bounds_of(scenario.limits)
        self._vehicles["bounds"][self._row] = self._bounds
        self._altitude_m = scenario.altitude_of(own)
        self._state = motion.state_from(own.position_ne_m, own.velocity_ne_m_s)
        self._state_ns = radio.start_ns
        still = scenario.disturbance is None and scenario.dynamics in BUILT_IN
        self._air = None if still else Air(scenario, own.system_id, radio.start_ns, radio.recorder)
        self._aircraft = Aircraft(scenario, own) if aircraft_of(scenario.dynamics) else None
        self._own = OwnMotion(scenario, self._note_fault) if names_code(scenario.dynamics) else self._aircraft
        """Dynamics in place of the double integrator's; `_air` is then set, too."""
        self._hold = Hold() if scenario.control.execute_at and own.system_id != scenario.external_id else None
        if self._hold is not None:
            self.intervals_us = {**self.intervals_us, messages.NAMED_INT: LAG_INTERVAL_US}
        self._navigator = None if scenario.navigation is None else Navigator(scenario, own.system_id, radio.recorder)
        if onboard is not None:
            radio.schedule.set_interval(STEP, onboard.interval_us, radio.start_ns)
        self.is_plain = all(part is None for part in (self._own, self._hold, self._navigator, onboard))
        self._columns["pushed"][self._row] = self._air is not None

    @property
    def _state(self) -> State:
        return State(*self._vehicles["state"][self._row].tolist())

    @_state.setter
    def _state(self, state: State) -> None:
        self._vehicles["state"][self._row] = state

    @property
    def _command(self) -> Command:
        return Command(*self._vehicles["command"][self._row].tolist())

    @_command.setter
    def _command(self, command: Command) -> None:
        self._vehicles["command"][self._row] = command

    @property
    def deadline_ns(self) -> int:
        """When the first held set-point acts, or the failsafe begins unless the station is heard first."""
        if self._hold is not None and self._hold.next_ns <= self.flight.deadline_ns:
            return self._hold.next_ns  # a set-point on the deadline is in time
        return self.flight.deadline_ns

    def state_at(self, time_ns: int) -> State:
        """The true state at a time after the last event, if nothing arrives until then."""
        if not self.flight.flying or time_ns <= self._state_ns:
            return self._state
        if self._air is None:
            return motion.advance(self._state, self._command, self._bounds, (time_ns - self._state_ns) / NS_PER_S)
        own = motion.advance if self._own is None else self._own.foreseen
        return self._moved(own, self._air, time_ns, foreseen=True)

    def acts_at(self, time_ns: int) -> int:
        """The time at which a message that arrives now acts: never before one that has already acted."""
        return max(time_ns, self._state_ns)

    def hear_heartbeat(self, time_ns: int) -> None:
        self.flight.hear_heartbeat(max(time_ns, self._state_ns))

    def take_setpoint(self, setpoint: mavlink.Setpoint, time_ns: int) -> str:
        """Fly a valid and allowed set-point from now on or, if set-points are held, from its due time on."""
        if self._hold is None:
            return self._fly(setpoint, time_ns)
        if self._hold.take(setpoint, time_ns, self._radio.clock):
            return "setpoints_held"
        self._radio.counters["setpoints_late"] += 1
        return self._fly(setpoint, time_ns)

    def _fly(self, setpoint: mavlink.Setpoint, time_ns: int) -> str:
        """Fly a set-point from now on, if it is valid and allowed; the first one begins the flight."""
        on_launcher = not self.flight.flying
        counts = setpoint.type_mask & setpoints.AXES
        onboard = self._onboard if self._onboard is not None and self._onboard.on else None
        reason = setpoints.fault(setpoint)
        if onboard is not None and counts != setpoints.VELOCITY_ACCELERATION:
            reason = reason or "refused_mask"  # the loop on board needs the formation's velocity
        reason = reason or self.flight.accept_setpoint(time_ns)
        if reason:
            return reason
        if on_launcher:
            self._state_ns = time_ns  # the launcher has held it until now
            self._radio.note_change(time_ns, "flying")
        self.move(time_ns)
        if setpoint.frame != frames.LOCAL_NED:
            setpoint = setpoints.to_local(setpoint, self._state.yaw_rad)
        north, east, _ = setpoint.acceleration_ned_m_s2
        if onboard is not None:
            onboard.stream(setpoint.velocity_ned_m_s[:2], (north, east))
            self._command = onboard.command()
        elif counts == setpoints.ACCELERATION:
            self._command = Command(north, east)
        elif counts == setpoints.VELOCITY:
            self._command = Command(0.0, 0.0, *setpoint.velocity_ned_m_s[:2], VELOCITY_GAIN_1_S)
        else:
            self._command = Command(north, east, *setpoint.velocity_ned_m_s[:2], VELOCITY_GAIN_1_S)
        self._radio.record(ACTED, setpoint.time_boot_ms, time_ns)
        return "setpoints"

    def parameters_set(self, time_ns: int) -> None:
        """Read the timeouts and the loop's gains from the parameters."""
        timeouts_s = self.parameters["GUID_TIMEOUT"], self.parameters["FS_GCS_TIMEOUT"]
        self.flight.set_timeouts(*timeouts_s, time_ns)
        if self._onboard is not None:
            self._onboard.set(self.parameters)

    # Commands

    def command(self, command: mavlink.Command, time_ns: int) -> Answer | None:
        """Answer a command about arming, modes, take-off and landing; None if it is about something else."""
        match command.command:
            case mavlink.COMMAND_ARM:
                return self._arm(command, time_ns), ""
            case mavlink.COMMAND_MODE:
                own_modes = (whole(command.param1) or 0) & mavlink.BASE_MODE_CUSTOM
                return self.change_mode(whole(command.param2) if own_modes else None, time_ns)
            case mavlink.COMMAND_TAKEOFF:
                return self._take_off(time_ns), ""
            case mavlink.COMMAND_LAND | mavlink.COMMAND_RETURN:
                return CANNOT_LAND
            case _:
                return None

    def _arm(self, command: mavlink.Command, time_ns: int) -> int:
        if command.param1 not in (0.0, 1.0):
            return mavlink.DENIED
        was = self.flight.armed
        result = self.flight.arm(command.param1 == 1.0)
        if self.flight.armed != was:
            self._radio.note_change(time_ns, "armed" if self.flight.armed else "disarmed")
        return result

    def _take_off(self, time_ns: int) -> int:
        """Leave the launcher with the initial altitude and velocity, whatever altitude the command asks for."""
        result = self.flight.take_off(time_ns)
        if result == mavlink.ACCEPTED:
            self._state_ns = time_ns
            self._radio.note_change(time_ns, "flying")
        return result

    def change_mode(self, mode: int | None, time_ns: int) -> Answer:
        if mode is None:
            return mavlink.DENIED, ""
        if mode in (mavlink.MODE_LAND, mavlink.MODE_RETURN):
            return CANNOT_LAND
        before = (self.flight.mode, self.flight.failsafe)
        result = self.flight.set_mode(mode, time_ns)
        if (self.flight.mode, self.flight.failsafe) != before:
            self.move(time_ns)
            self._command = self._alone()
            self._radio.note_change(time_ns, MODE_NAMES[mode] + (", failsafe over" if before[1] else ""))
        return result, ""

    # Timed events

    def happen(self, time_ns: int) -> None:
        if self._hold is not None and self._hold.next_ns <= time_ns:
            self._radio.counters[self._fly(self._hold.pop(), max(time_ns, self._state_ns))] += 1
            return
        self.move(time_ns)
        self.flight.fail()
        self._command = self._alone()
        text = f"failsafe: {self.flight.failsafe} stopped"
        self._radio.note_change(time_ns, text)
        self._radio.send_text(time_ns, text)

    def _alone(self) -> Command:
        """The command without set-points: that of the loop on board, if it may fly, else constant velocity."""
        onboard = self._onboard
        if onboard is None:
            return COAST
        onboard.drop_stream()
        return onboard.command() if self._own_loop_flies(onboard) else COAST

    def _own_loop_flies(self, onboard: VehicleLoop) -> bool:
        flight = self.flight
        return onboard.on and flight.flying and (flight.mode == mavlink.MODE_GUIDED or flight.failsafe != "")

    def _step_onboard(self, time_ns: int, boot_ms: int) -> None:
        onboard = self._onboard
        if onboard is None or not onboard.on:
            return
        self.move(time_ns)
        onboard.step(time_ns, boot_ms, self._state)
        if self._own_loop_flies(onboard):
            self._command = onboard.command()

    def report(self, message_id: int, time_ns: int, boot_ms: int) -> bytes | None:
        """A report; or a step of the loop on board, which sends nothing."""
        if message_id == STEP:
            self._step_onboard(time_ns, boot_ms)
            return None
        boot_ms &= frames.UINT32
        encoder = self._radio.encoder
        if message_id == frames.HEARTBEAT:
            flight, critical = self.flight, self.flight.failsafe != ""
            guided = flight.mode == mavlink.MODE_GUIDED
            return encoder.heartbeat(
                flight.mode, armed=flight.armed, flying=flight.flying, critical=critical, guided=guided
            )
        if message_id == mavlink.HOME_POSITION:
            return encoder.pack(messages.home_position())
        self.move(time_ns)
        if message_id == frames.LOCAL_POSITION:
            state = self._state
            place, velocity = state[0:2], state.velocity_ne_m_s()
            if self._navigator is not None:
                place, velocity = self._navigator.reported(place, velocity, time_ns, boot_ms)
            climbed_m, climb_m_s = (0.0, 0.0) if self._aircraft is None else self._aircraft.attitude()[:2]
            down_m_s = 0.0 - climb_m_s  # not -0.0, whose sign bit would be sent
            return encoder.local_position(boot_ms, (*place, -self._altitude_m - climbed_m), (*velocity, down_m_s))
        if message_id in (mavlink.POSITION_TARGET, messages.NAMED_INT):
            return self._active_target(boot_ms) if message_id == mavlink.POSITION_TARGET else self._lag(boot_ms)
        condition = self._condition(boot_ms)
        is_global = message_id == frames.GLOBAL_POSITION
        return encoder.global_position(condition) if is_global else encoder.pack(messages.report(message_id, condition))

    def _lag(self, boot_ms: int) -> bytes | None:
        """The lag after which held set-points act; None before the first."""
        lag_ms = None if self._hold is None else self._hold.lag_ms
        if lag_ms is None:
            return None
        return self._radio.encoder.pack(messages.named_int(boot_ms, "LAG_MS", lag_ms))

    def _active_target(self, boot_ms: int) -> bytes | None:
        """The acceleration that it follows within its limits; None unless it takes set-points."""
        flight = self.flight
        if not flight.flying or flight.mode != mavlink.MODE_GUIDED or flight.failsafe:
            return None
        followed = motion.limited(self._state, self._command, self._bounds)
        return self._radio.encoder.pack(
            messages.position_target(boot_ms, _ACCELERATION_ONLY, (0.0, 0.0, 0.0), followed)
        )

    def _attitude(self) -> Attitude:
        """Height, climb rate and angles; in flight a double integrator has the roll of a coordinated turn."""
        if self._aircraft is not None:
            return self._aircraft.attitude()
        state, roll_rad = self._state, 0.0
        if self.flight.flying:
            _, _, turn_rate_rad_s, _ = motion.rates(state.yaw_rad, state.speed_m_s, self._command, self._bounds)
            roll_rad = math.atan2(state.speed_m_s * turn_rate_rad_s, GRAVITY_M_S2)
        return Attitude(0.0, 0.0, roll_rad, 0.0, math.remainder(state.yaw_rad, math.tau))

    def _condition(self, boot_ms: int) -> messages.Condition:
        """Its state as reported to other ground stations."""
        state, attitude = self._state, self._attitude()
        return messages.Condition(
            boot_ms,
            degrees(state.north_m, state.east_m),
            ORIGIN_ALTITUDE_M + self._altitude_m + attitude.climbed_m,
            (*state.velocity_ne_m_s(), 0.0 - attitude.climb_m_s),
            (attitude.roll_rad, attitude.pitch_rad, math.remainder(attitude.heading_rad, math.tau)),
            flying=self.flight.flying,
            has_position=True,
        )

    def move(self, time_ns: int) -> None:
        if self._air is None or not self.flight.flying:
            _advance_to_at(self._vehicles, self._row, time_ns)
        elif time_ns > self._state_ns:
            if self._own is None:
                for piece in self._air.pieces(self._state_ns, time_ns):
                    _push_on_at(self._vehicles, self._row, piece)
            else:
                self._state = self._moved(self._own.advance, self._air, time_ns)
            self._state_ns = time_ns

    def push(self, push: Push, time_ns: int) -> None:
        """Set the push that acts from now on, in addition to wind and gusts."""
        assert self._air is not None
        self.move(time_ns)
        self._air.add(push)

    def _moved(self, own: Step, air: Air, time_ns: int, *, foreseen: bool = False) -> State:
        """The state at a later time in flight, by its own motion and what the air adds."""
        state, command = self._state, self._command
        for t, half_north, half_east, north, east in air.pieces(self._state_ns, time_ns, foreseen=foreseen):
            pushed = motion.shifted(state, 0.0, 0.0, half_north, half_east)
            state = motion.shifted(own(pushed, command, self._bounds, t), north, east, half_north, half_east)
        return state

    def _note_fault(self, text: str) -> None:
        """Count a step in which the user's own dynamics failed, and report the first."""
        counters = self._radio.counters
        counters["model_faults"] += 1
        if counters["model_faults"] == 1:
            self._radio.note_change(self._state_ns, f"fault in its dynamics: {text}")
            self._radio.send_text(self._state_ns, f"dynamics: {text}"[:50])  # at most the characters of one chunk
