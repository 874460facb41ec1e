"""A simulated multicopter that behaves like ArduCopter or PX4 as seen from outside.

It boots, sends heartbeats, then telemetry, then has a position. It can be armed, takes off to an altitude, follows
velocity and acceleration set-points with a lag, and lands. The fleet flies it if the scenario has `dynamics =
"autopilot"`.
"""

import heapq
import math
from collections.abc import Mapping

import numpy as np

from scenarios import schema
from scenarios.kernel import Cell
from scenarios.schema import NS_PER_S
from sim_vehicles.links.truth import ACTED
from sim_vehicles.motion.air import Air
from sim_vehicles.motion.copter import ALTITUDE, Motion, Target, advance, fly_to_at, pair, pushed
from sim_vehicles.motion.double_integrator import State, state_from
from sim_vehicles.motion.lagged import inner_of, length, limits_of
from sim_vehicles.motion.navigation import Navigator
from sim_vehicles.services import frames, mavlink, messages
from sim_vehicles.services.clock import NEVER_NS, BootClock
from sim_vehicles.services.draws import Use, draws_of
from sim_vehicles.services.earth import GRAVITY_M_S2, ORIGIN_ALTITUDE_M, degrees
from sim_vehicles.services.sitl import slips
from sim_vehicles.vehicles import copter_rules
from sim_vehicles.vehicles.flight_mode import set_deadline_at
from sim_vehicles.vehicles.setpoints import ABSURD, POSITION_AXES, VELOCITY_AXES, YAW_IGNORED, YAW_RATE_IGNORED
from sim_vehicles.vehicles.shell import Answer, Radio

TAKEN_OFF_M = 0.3
HOME_M = 0.5
"""Distance to home at which a return becomes a landing."""
SINK_FAST_M_S, SINK_M_S, SINK_SLOWLY_BELOW_M = 1.5, 0.7, 5.0
REPORTED = (
    frames.LOCAL_POSITION, mavlink.POSITION_TARGET,
    frames.GLOBAL_POSITION, mavlink.GLOBAL_ORIGIN, mavlink.HOME_POSITION,
)  # fmt: skip
"""Messages that can be requested besides the estimator's and those of every vehicle."""
READY_FLAGS, NOT_READY_FLAGS = 0x33F, 0x481
"""Estimator flags when ready; and when not: attitude only, constant position mode, uninitialised."""
_NO_POSITION = "Need Position Estimate"
_NO_JUMP = NEVER_NS, 0, ""
_ACCEPTED: Answer = mavlink.ACCEPTED, ""


class Copter:
    """The craft in the shell: its motion and the autopilot's modes."""

    armed = Cell[bool]()
    flying = Cell[bool]()
    mode = Cell[int]()
    _stopped = Cell[bool]()
    _state_ns, _ready_ns, _alarm_ns = Cell[int](), Cell[int](), Cell[int]()
    _setpoint_ns = Cell[int | None](NEVER_NS)
    _setpoint_timeout_ns = Cell[int]()
    _pushed = Cell[bool]()

    def __init__(self, scenario: schema.Scenario, own: schema.Vehicle, radio: Radio) -> None:
        start_ns = radio.start_ns
        self._vehicles, self._columns, self._row = radio.place
        self.settings = scenario.autopilot
        self.rules = copter_rules.RULES[own.flavour or scenario.autopilot.flavour]
        self.version, self.version_1_first = self.rules.version, self.rules.version_1_first
        self.parameters = copter_rules.parameters(self.rules, own.system_id, self.settings)
        self.intervals_us: Mapping[int, int] = dict.fromkeys((*REPORTED, self.rules.estimator_message), 0)
        self.reports_from_ns = start_ns + round(self.settings.telemetry_after_s * NS_PER_S)
        self.mode = self.rules.first_mode
        self.home_m = complex(*own.position_ne_m)
        self.motion = Motion(self.home_m, inner=inner_of(self.settings))
        drawn = draws_of(scenario.seed, own.system_id, Use.ORIGIN).random(3)
        spread = (2.0 * drawn - 1.0) * self.settings.origin_spread_m
        north_m, east_m, up_m = spread.tolist()
        self.origin_neu_m: tuple[float, float, float] = (north_m, east_m, up_m)
        """Origin of its local frame, in the scenario's frame."""
        self._radio = radio
        still, exact = scenario.disturbance is None, scenario.navigation is None
        self._air = None if still else Air(scenario, own.system_id, start_ns, radio.recorder)
        self._navigator = None if exact else Navigator(scenario, own.system_id, radio.recorder)
        self.is_plain = exact and not self.settings.sitl.timesync_back_s
        self._target = Target()
        self._takeoff_m: float | None = None
        self._state_ns, self._setpoint_ns = start_ns, None
        self._armed_ns = NEVER_NS
        self._read_timeouts()
        self._refusals_left = self.settings.arming_refusals
        self._ready_ns = start_ns + round(self.settings.ready_after_s * NS_PER_S)
        jumps = ((start_ns + round(j.at_s * NS_PER_S), round(j.by_s * NS_PER_S)) for j in self.settings.clock_jumps)
        slipping = slips(scenario, own.system_id, start_ns)
        self._jumps = heapq.merge(((*jump, "clock jumped") for jump in jumps), ((*slip, "") for slip in slipping))
        self._jump = next(self._jumps, _NO_JUMP)
        self._complains_ns = start_ns + self._complaint_ns if self.rules.complains_every_s else NEVER_NS
        for name, value in {
            "copter": True, "guided_mode": self.rules.guided_mode, "heartbeat_timeout_ns": NEVER_NS,
            "limits": limits_of(self.settings), "velocity_gain_1_s": self.settings.velocity_gain_1_s,
            "growth": float(self.rules.velocity_grows), "autopilot": self.rules.autopilot,
            "origin_neu_m": self.origin_neu_m,
        }.items():  # fmt: skip
            self._vehicles[name][self._row] = value

    @property
    def landed(self) -> bool:
        return not self.flying

    @property
    def failsafe(self) -> bool:
        """Whether set-points have stopped in flight and PX4 holds."""
        return self._stopped

    @property
    def motion(self) -> Motion:
        own = self._vehicles["motion"][self._row].tolist()
        return Motion(complex(*own[0:2]), complex(*own[2:4]), complex(*own[4:6]), *own[6:], inner=self._inner)

    @motion.setter
    def motion(self, motion: Motion) -> None:
        place, velocity, acceleration, *rest, self._inner = motion
        self._vehicles["motion"][self._row] = *pair(place), *pair(velocity), *pair(acceleration), *rest

    @property
    def _target(self) -> Target:
        own = self._vehicles["target"][self._row].tolist()
        return Target(complex(*own[0:2]), complex(*own[2:4]), *own[4:10], place_m=complex(*own[10:]))

    @_target.setter
    def _target(self, target: Target) -> None:
        acceleration, velocity, *rest, place = target
        self._vehicles["target"][self._row] = *pair(acceleration), *pair(velocity), *rest, *pair(place)

    def state_at(self, time_ns: int) -> State:
        """The true state in the scenario's frame at a time after the last event, if nothing arrives until then."""
        motion = self.motion
        if self.flying and time_ns > self._state_ns:
            motion, _ = self._flown(time_ns, foreseen=True)
        return state_from(pair(motion.place_m), pair(motion.velocity_m_s))

    # Timed events

    @property
    def deadline_ns(self) -> int:
        """Time of the next event that is not a report. Also records for kernels this time and if they may move it."""
        ends = self._takeoff_m is not None or self.mode in (self.rules.land_mode, self.rules.return_mode)
        self._pushed = ends or self._air is not None or self._inner is not None
        alarm_ns = min(self._jump[0], self._complains_ns)
        if self.armed and self.landed:
            alarm_ns = min(alarm_ns, self._armed_ns + self._ground_disarm_ns)
        self._alarm_ns = alarm_ns
        set_deadline_at(self._vehicles, self._row)
        return self._columns["deadline_ns"][self._row]

    def happen(self, time_ns: int) -> None:
        """Run the event at the deadline: a clock jump, a complaint, disarming on the ground, or lost set-points."""
        self.move(time_ns)
        if time_ns == self._jump[0]:
            _, by_ns, text = self._jump
            self._jump = next(self._jumps, _NO_JUMP)
            clock = self._radio.clock
            self._radio.set_clock(BootClock(time_ns, clock.boot_ns(time_ns) + by_ns, clock.drift_ppb), time_ns)
            if text:
                self._radio.note_change(time_ns, text)
        elif time_ns == self._complains_ns:
            self._complains_ns = NEVER_NS if self._ready(time_ns) else time_ns + self._complaint_ns
            if not self._ready(time_ns):
                self._radio.send_text(time_ns, f"PreArm: {_NO_POSITION}")
        elif self.armed and self.landed:
            self.armed = False
            self._radio.note_change(time_ns, "disarmed: not taken off")
        else:
            self._lose_setpoints(time_ns)

    @property
    def _complaint_ns(self) -> int:
        return round(self.rules.complains_every_s * NS_PER_S)

    def _lose_setpoints(self, time_ns: int) -> None:
        """Stop: ArduCopter stays in guided mode, PX4 leaves offboard and holds."""
        self._setpoint_ns = None
        self._target = self._own_target()
        if self.rules.guided_mode != self.rules.takeoff_mode:
            self.mode, self._stopped = self.rules.hold_mode, True
        self._radio.note_change(time_ns, "set-points stopped")
        self._radio.send_text(time_ns, "No offboard signal" if self.failsafe else "Guided: no set-points, stopping")

    # What arrives

    def acts_at(self, time_ns: int) -> int:
        """When a message that arrives at `time_ns` acts, in ns: never before one that has already acted."""
        self.move(time_ns)
        return self._state_ns

    def hear_heartbeat(self, time_ns: int) -> None: ...  # without effect

    def take_setpoint(self, setpoint: mavlink.Setpoint, time_ns: int) -> str:
        """Fly a set-point from now on, if in guided mode and off the ground."""
        gain = self.settings.velocity_gain_1_s
        reason, target = copter_rules.setpoint_target(
            setpoint, self.rules, yaw_rad=self.motion.yaw_rad, velocity_gain_1_s=gain
        )
        guided = self.mode == self.rules.guided_mode
        if reason:
            if guided and self.rules.velocity_grows and self.flying:
                # ArduCopter stops at a set-point that it refuses
                self._takeoff_m, self._target = None, self._own_target()
            return reason
        self._setpoint_ns = time_ns  # PX4 also counts those before offboard: they allow it to enter that mode
        if not guided or not self.armed:
            return "ignored_not_guided" if not guided else "ignored_not_armed"
        if self.flying:
            self._takeoff_m = None  # a set-point ends a guided take-off at the present altitude
            self._target = target
            self._radio.record(ACTED, setpoint.time_boot_ms, time_ns)
        return "setpoints"

    def parameters_set(self, time_ns: int) -> None:
        before = self._setpoint_timeout_ns, self._ground_disarm_ns
        self._read_timeouts()
        if (self._setpoint_timeout_ns, self._ground_disarm_ns) != before:
            self._armed_ns = time_ns  # restart the timers, so that none ends in the past
            self._setpoint_ns = None if self._setpoint_ns is None else time_ns

    def _read_timeouts(self) -> None:
        self._setpoint_timeout_ns = round(self.parameters[self.rules.setpoint_timeout_parameter] * NS_PER_S)
        self._ground_disarm_ns = round(self.parameters[self.rules.ground_disarm_parameter] * NS_PER_S)

    # Commands

    def command(self, command: mavlink.Command, time_ns: int) -> Answer | None:
        """Answer a command about arming, modes, take-off and landing; None if it is about something else."""
        match command.command:
            case mavlink.COMMAND_ARM:
                return self._arm(command, time_ns)
            case mavlink.COMMAND_MODE:
                return self.change_mode(copter_rules.commanded_mode(command, self.rules), time_ns)
            case mavlink.COMMAND_TAKEOFF:
                return self._take_off(command, time_ns), ""
            case mavlink.COMMAND_LAND | mavlink.COMMAND_RETURN as asked:
                land = asked == mavlink.COMMAND_LAND
                return self.change_mode(self.rules.land_mode if land else self.rules.return_mode, time_ns)
            case _:
                return None

    def _ready(self, time_ns: int) -> bool:
        return time_ns >= self._ready_ns

    def _arm(self, command: mavlink.Command, time_ns: int) -> Answer:
        if command.param1 == 0.0:
            if self.flying:
                return copter_rules.FAILED, ""
            self.armed = False
            return _ACCEPTED
        if self.armed:
            return _ACCEPTED
        if not self._ready(time_ns):
            return self.rules.arming_refused, f"Arm: {_NO_POSITION}"
        if self._refusals_left:
            self._refusals_left -= 1
            return self.rules.arming_refused, "Arm: Accels inconsistent"
        self.armed, self._armed_ns = True, time_ns
        self._radio.note_change(time_ns, "armed")
        if self._takeoff_m is not None:
            self._leave_ground(self._takeoff_m, time_ns)
        return _ACCEPTED

    def change_mode(self, mode: int | None, time_ns: int) -> Answer:
        """Change the mode on command, if the autopilot has it."""
        if mode is None or mode not in self.rules.modes:
            return mavlink.DENIED, ""
        if mode == self.mode:
            return _ACCEPTED
        if mode != self.rules.first_mode and not self._ready(time_ns):
            return self.rules.arming_refused, ""  # these modes need a position
        streamed = self._setpoint_ns is not None and time_ns - self._setpoint_ns < self._setpoint_timeout_ns
        if mode == self.rules.guided_mode != self.rules.takeoff_mode and not streamed:
            return copter_rules.TEMPORARILY_REJECTED, "Offboard needs set-points"
        self.mode, self._stopped, self._takeoff_m = mode, False, None
        self._target = self._own_target()
        if mode == self.rules.guided_mode == self.rules.takeoff_mode:
            self._setpoint_ns = time_ns  # the timeout starts with the mode
        self._radio.note_change(time_ns, self.rules.modes[mode])
        return _ACCEPTED

    def _take_off(self, command: mavlink.Command, time_ns: int) -> int:
        """Take off: ArduCopter when armed and guided, to an altitude above home; PX4 in any mode, above sea level."""
        own_mode = self.rules.takeoff_mode == self.rules.guided_mode
        altitude_m = command.param7 - (0.0 if own_mode else ORIGIN_ALTITUDE_M)
        if not own_mode and math.isnan(altitude_m):
            altitude_m = self.parameters[copter_rules.PX4_TAKEOFF_ALTITUDE]
        if own_mode and not (self.armed and self.mode == self.rules.guided_mode):
            return copter_rules.FAILED
        if not own_mode and math.isfinite(command.param5 + command.param6):
            return mavlink.DENIED  # a take-off towards a latitude and longitude is not simulated
        if not (self.landed and self._ready(time_ns) and 0.0 < altitude_m < ABSURD):
            return copter_rules.FAILED if own_mode else copter_rules.TEMPORARILY_REJECTED
        self.mode, self._takeoff_m = self.rules.takeoff_mode, altitude_m
        if self.armed:
            self._leave_ground(altitude_m, time_ns)
        return mavlink.ACCEPTED

    # What it sends

    def report(self, message_id: int, time_ns: int, boot_ms: int) -> bytes | None:
        """The frame of one of its messages; None if it has nothing to report, such as a position before it has one."""
        encoder, motion, ready = self._radio.encoder, self.motion, self._ready(time_ns)
        origin_north_m, origin_east_m, origin_up_m = self.origin_neu_m
        boot_ms &= frames.UINT32
        if message_id == frames.HEARTBEAT:
            kind, flying = self.rules.autopilot, self.flying
            return encoder.heartbeat(self.mode, armed=self.armed, flying=flying, critical=self.failsafe, autopilot=kind)
        if message_id == frames.LOCAL_POSITION and ready:
            down_m = origin_up_m - motion.altitude_m
            place, velocity = pair(motion.place_m - complex(*self.origin_neu_m[:2])), pair(motion.velocity_m_s)
            if self._navigator is not None:
                place, velocity = self._navigator.reported(place, velocity, time_ns, boot_ms)
            return encoder.local_position(boot_ms, (*place, down_m), (*velocity, -motion.climb_m_s))
        if message_id == frames.GLOBAL_POSITION:
            return encoder.global_position(self._condition(boot_ms, has_position=ready))
        if message_id == self.rules.estimator_message:
            message = messages.estimator_flags(message_id, boot_ms * 1000, READY_FLAGS if ready else NOT_READY_FLAGS)
        elif message_id in messages.EXTRA:
            message = messages.report(message_id, self._condition(boot_ms, has_position=ready))
        elif message_id == mavlink.GLOBAL_ORIGIN and ready:
            message = messages.global_origin(degrees(origin_north_m, origin_east_m), ORIGIN_ALTITUDE_M + origin_up_m)
        elif message_id == mavlink.POSITION_TARGET and self._steers:
            message = self._active_target(boot_ms)
        elif message_id == mavlink.HOME_POSITION and ready:
            local = *pair(self.home_m - complex(*self.origin_neu_m[:2])), origin_up_m
            message = messages.home_position(degrees(*pair(self.home_m)), local)
        else:
            return None
        return encoder.pack(message)

    @property
    def _steers(self) -> bool:
        """Whether it follows set-points, or hovers because they have stopped."""
        return self.mode == self.rules.guided_mode and self.flying and self._takeoff_m is None

    def _active_target(self, boot_ms: int) -> messages.Message:
        """Its target as it reports it: the velocity and the acceleration of the set-point.

        In ArduCopter the velocity has since integrated the acceleration, which itself was rounded when converted to cm
        and back in float32. PX4 reports the acceleration that its velocity loop wants.
        """
        target, acceleration = self._target, self._target.acceleration_m_s2
        if self.rules.velocity_grows:
            in_cm = np.array(pair(acceleration), np.float32) * np.float32(100.0)
            acceleration = complex(*(in_cm * np.float32(0.01)).tolist())
        else:
            acceleration += target.velocity_gain_1_s * (target.velocity_m_s - self.motion.velocity_m_s)
        mask = POSITION_AXES | YAW_IGNORED | YAW_RATE_IGNORED | (0 if target.velocity_gain_1_s else VELOCITY_AXES)
        velocity = *pair(target.velocity_m_s), -target.climb_m_s
        return messages.position_target(boot_ms, mask, velocity, pair(acceleration))

    def _condition(self, boot_ms: int, *, has_position: bool) -> messages.Condition:
        """Its state as reported to other ground stations; the tilt follows from the acceleration."""
        motion = self.motion
        cosine, sine = math.cos(motion.yaw_rad), math.sin(motion.yaw_rad)
        north, east = pair(motion.acceleration_m_s2 / GRAVITY_M_S2)
        roll_rad, pitch_rad = math.atan(cosine * east - sine * north), -math.atan(cosine * north + sine * east)
        return messages.Condition(
            boot_ms,
            degrees(*pair(motion.place_m)),
            ORIGIN_ALTITUDE_M + motion.altitude_m,
            (*pair(motion.velocity_m_s), -motion.climb_m_s),
            (roll_rad, pitch_rad, motion.yaw_rad),
            flying=self.flying,
            has_position=has_position,
        )

    # Motion

    def _own_target(self) -> Target:
        """The target of a mode without set-points: stop, sink, or fly home."""
        climb_m_s = -SINK_FAST_M_S if self.mode == self.rules.land_mode else 0.0
        target = Target(velocity_gain_1_s=self.settings.velocity_gain_1_s, climb_m_s=climb_m_s)
        return target._replace(place_m=self.home_m) if self.mode == self.rules.return_mode else target

    def _leave_ground(self, altitude_m: float, time_ns: int) -> None:
        self.flying = True
        self._target = self._own_target()._replace(altitude_m=altitude_m)
        self._setpoint_ns = None
        self._radio.note_change(time_ns, "takes off")

    def _flown(self, time_ns: int, *, foreseen: bool = False) -> tuple[Motion, Target]:
        """Motion and target at a later time."""
        if self._air is None:
            return advance(self.motion, self._target, self.settings, (time_ns - self._state_ns) / NS_PER_S)
        own = self.motion, self._target
        for piece in self._air.pieces(self._state_ns, time_ns, foreseen=foreseen):
            own = pushed(*own, self.settings, piece)
        return own

    def move(self, time_ns: int) -> None:
        if time_ns <= self._state_ns:
            return
        if self.flying and (self._air is not None or self._inner is not None):
            self.motion, self._target = self._flown(time_ns)
            self._state_ns = time_ns
        else:
            fly_to_at(self._vehicles, self._row, time_ns)
        if self.landed:
            return
        altitude_m = self._columns["motion"][self._row, ALTITUDE]
        if self._takeoff_m is not None and altitude_m > self._takeoff_m - TAKEN_OFF_M:
            self._takeoff_m = None
            if self.rules.takeoff_mode != self.rules.guided_mode:
                self.mode = self.rules.hold_mode
                self._target = self._own_target()
            self._radio.note_change(time_ns, "taken off")
        elif self.mode == self.rules.land_mode:
            sink = SINK_M_S if altitude_m < SINK_SLOWLY_BELOW_M else SINK_FAST_M_S
            self._target = self._target._replace(climb_m_s=-sink)
            if altitude_m <= 0.0:
                self.flying = self.armed = False
                where_m, yaw_rad = self.motion.place_m, self.motion.yaw_rad
                self.motion = Motion(where_m, yaw_rad=yaw_rad, inner=inner_of(self.settings))
                self._radio.note_change(time_ns, "landed")
        elif self.mode == self.rules.return_mode and length(self.motion.place_m - self.home_m) < HOME_M:
            self.mode = self.rules.land_mode
            self._target = self._own_target()
            self._radio.note_change(time_ns, self.rules.modes[self.mode])
