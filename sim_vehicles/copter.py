"""A simulated multicopter with an autopilot of its own: what ArduCopter or PX4 looks like from outside.

It boots, sends heartbeats, then telemetry, then has a position; it may be armed, takes off to an altitude, follows
velocity and acceleration set-points with a lag, and lands. Bytes and time in, bytes and time out, as `vehicle.Vehicle`,
in whose place the fleet takes it when the scenario's dynamics are `autopilot`.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Iterable

import numpy as np

from scenarios import schema
from scenarios.schema import NS_PER_S
from sim_vehicles import mavlink
from sim_vehicles.authority import Authority
from sim_vehicles.clock import BootClock
from sim_vehicles.copter_dynamics import Motion, Target, advance
from sim_vehicles.copter_reports import Facts, intervals_us, report
from sim_vehicles.copter_rules import (
    FAILED,
    PX4_TAKEOFF_ALTITUDE,
    RULES,
    TEMPORARILY_REJECTED,
    commanded_mode,
    parameters,
    setpoint_target,
)
from sim_vehicles.dynamics import State, state_from
from sim_vehicles.earth import ORIGIN_ALTITUDE_M
from sim_vehicles.links import NEVER_NS
from sim_vehicles.schedule import Schedule
from sim_vehicles.service_messages import PARAMETER_VALUE, ParameterSet, Request, SetMode
from sim_vehicles.services import Services
from sim_vehicles.setpoints import ABSURD
from sim_vehicles.truth import ACTED, SAMPLED, Record
from sim_vehicles.vehicle import (
    HEARTBEAT_INTERVAL_US,
    LONGEST_HISTORY,
    TIMESYNC_INTERVAL_US,
    Change,
)

ORIGIN_STREAM = 7
"""Last word of the spawn key of the random stream of a vehicle's local origin."""
TAKEN_OFF_M = 0.3
HOME_M = 0.5
"""Nearer to home than this, it lands."""
SINK_FAST_M_S, SINK_M_S, SINK_SLOWLY_BELOW_M = 1.5, 0.7, 5.0


class Copter:
    """A multicopter with its autopilot, boot clock and counters; the latter as those of `vehicle.Vehicle`."""

    def __init__(
        self,
        scenario: schema.Scenario,
        own: schema.Vehicle,
        start_ns: int,
        *,
        record: Record | None = None,
        signed: bool = False,
        experiment: str = "",
    ) -> None:
        self.system_id = own.system_id
        self.settings = scenario.autopilot
        self.rules = RULES[own.flavour or scenario.autopilot.flavour]
        self.counters: Counter[str] = Counter()
        self.changes: deque[Change] = deque(maxlen=LONGEST_HISTORY)
        self.clock = BootClock.draw(scenario.clocks, scenario.seed, own.system_id, start_ns)
        self.parameters = parameters(self.rules, own.system_id)
        self.authority = Authority(scenario.safety.heartbeat_timeout_s)
        self.mode = self.rules.first_mode
        self.armed = self.failsafe = False
        self.landed = True
        self.home_ne_m = own.position_ne_m
        self.motion = Motion(*own.position_ne_m)
        stream = np.random.SeedSequence(scenario.seed, spawn_key=(own.system_id, ORIGIN_STREAM))
        spread = (2.0 * np.random.default_rng(stream).random(3) - 1.0) * self.settings.origin_spread_m
        north_m, east_m, up_m = spread.tolist()
        self.origin_neu_m: tuple[float, float, float] = (north_m, east_m, up_m)
        """Where its local frame begins, in the frame of the scenario."""
        self._record = record
        self._encoder = mavlink.Encoder(own.system_id)
        self._target = Target()
        self._takeoff_m: float | None = None
        self._motion_ns = start_ns
        self._setpoint_ns: int | None = None
        self._armed_ns = NEVER_NS
        self._read_timeouts()
        self._refusals_left = self.settings.arming_refusals
        self._ready_ns = start_ns + round(self.settings.ready_after_s * NS_PER_S)
        self._jumps = deque(
            (start_ns + round(j.at_s * NS_PER_S), round(j.by_s * NS_PER_S)) for j in self.settings.clock_jumps
        )
        self._speaks_version_1 = self.rules.version_1_first and not signed  # MAVLink 1 cannot be signed
        self._timesync_ts1 = -1
        self._out: list[tuple[bytes, int]] = []
        self._answers: dict[int, Callable[[mavlink.Command, int], int]] = {
            mavlink.COMMAND_ARM: self._arm,
            mavlink.COMMAND_MODE: self._set_mode,
            mavlink.COMMAND_TAKEOFF: self._take_off,
            mavlink.COMMAND_LAND: lambda _, time_ns: self._change_mode(self.rules.land_mode, time_ns),
            mavlink.COMMAND_RETURN: lambda _, time_ns: self._change_mode(self.rules.return_mode, time_ns),
        }
        telemetry_ns = start_ns + round(self.settings.telemetry_after_s * NS_PER_S)
        self._schedule = Schedule(self.clock)
        self._schedule.add_once(mavlink.HEARTBEAT, start_ns)
        self._schedule.set_interval(mavlink.HEARTBEAT, HEARTBEAT_INTERVAL_US, start_ns)
        self._schedule.set_interval(mavlink.TIMESYNC, TIMESYNC_INTERVAL_US, telemetry_ns)
        self.services = Services(
            self._encoder,
            self._schedule,
            self.parameters,
            self.rules.version,
            intervals_us(self.rules),
            telemetry_ns,
            experiment,
        )

    @property
    def next_event_ns(self) -> int:
        """When it next does something if nothing arrives."""
        return min(self._schedule.next_ns, self._deadline_ns())

    def state_at(self, time_ns: int) -> State:
        """The true state in the scenario's frame at a time not before the last event, if nothing arrives until then."""
        motion = self.motion
        if not self.landed and time_ns > self._motion_ns:
            motion, _ = advance(motion, self._target, self.settings, (time_ns - self._motion_ns) / NS_PER_S)
        return state_from(motion[0:2], motion[2:4])

    def step(self, datagrams: Iterable[tuple[bytes, int]], now_ns: int) -> list[tuple[bytes, int]]:
        """Live until now: what arrives, as (datagram, instant) in order of time, to what is sent, likewise."""
        self._out = []
        for data, time_ns in datagrams:
            self._run(time_ns)
            self._receive(data, time_ns)
        self._run(now_ns + 1)
        return self._out

    def _run(self, end_ns: int) -> None:
        """Do what is due before the end."""
        while (next_ns := self.next_event_ns) < end_ns:
            if self._schedule.next_ns <= next_ns:
                time_ns, message_id, boot_ms = self._schedule.pop()
                self._advance(time_ns)
                self._report(message_id, time_ns, boot_ms & 0xFFFFFFFF)
            else:
                self._advance(next_ns)
                self._happen(next_ns)

    # What happens by itself

    def _deadline_ns(self) -> int:
        """The next instant at which something happens that is not a report."""
        deadline_ns = self._jumps[0][0] if self._jumps else NEVER_NS
        if self._setpoint_ns is not None and not self.landed and self.mode == self.rules.guided_mode:
            deadline_ns = min(deadline_ns, self._setpoint_ns + self._setpoint_timeout_ns)
        if self.armed and self.landed:
            deadline_ns = min(deadline_ns, self._armed_ns + self._ground_disarm_ns)
        return deadline_ns

    def _happen(self, time_ns: int) -> None:
        if self._jumps and time_ns == self._jumps[0][0]:
            _, by_ns = self._jumps.popleft()
            self.clock = BootClock(time_ns, self.clock.boot_ns(time_ns) + by_ns, self.clock.drift_ppb)
            self._schedule.set_clock(self.clock, time_ns)
            self._tell(time_ns, "clock jumped")
        elif self.armed and self.landed:
            self.armed = False
            self._tell(time_ns, "disarmed: not taken off")
        else:
            self._lose_setpoints(time_ns)

    def _lose_setpoints(self, time_ns: int) -> None:
        """ArduCopter stays guided and stops; PX4 leaves offboard and holds."""
        self._setpoint_ns = None
        self._target = self._stopped()
        if self.rules.guided_mode != self.rules.takeoff_mode:
            self.mode, self.failsafe = self.rules.hold_mode, True
        self._tell(time_ns, "set-points stopped")
        self._say(time_ns, "No offboard signal" if self.failsafe else "Guided: no set-points, stopping")

    # What arrives

    def _receive(self, data: bytes, time_ns: int) -> None:
        for source, message in mavlink.read_datagram(data, self.counters):
            self._speaks_version_1 = False
            if isinstance(message, mavlink.Heartbeat):
                if message.vehicle_type == mavlink.TYPE_GCS and self.authority.hears(source, time_ns):
                    self.counters["heartbeats"] += 1
                continue
            if isinstance(message, mavlink.Timesync):
                self._take_timesync(message, time_ns)
                continue
            if message.target_system != self.system_id or message.target_component not in (
                0,
                mavlink.COMPONENT_AUTOPILOT,
            ):
                self.counters["ignored_not_addressed"] += 1
                continue
            if not self.authority.obeys(source, message, time_ns):
                self._refuse(source, time_ns)
                continue
            at_ns = max(time_ns, self._motion_ns)
            self._advance(at_ns)
            if isinstance(message, mavlink.Setpoint):
                self._take_setpoint(message, at_ns)
            elif not isinstance(message, mavlink.Command):
                self._take_request(message, at_ns)
            else:
                self.counters["commands"] += 1
                at = len(self._out)
                answer = self._answers.get(message.command)
                if answer is None:
                    result, frames = self.services.command(message, at_ns)
                else:
                    result, frames = answer(message, at_ns), []
                ack = self._encoder.command_ack(message.command, result, message.source)
                self._out.insert(at, (ack, at_ns))
                self._out += [(frame, at_ns) for frame in frames]

    def _refuse(self, source: int, time_ns: int) -> None:
        text = self.authority.refusal(source, self.counters)
        if text:
            self._tell(time_ns, text)
            self._send(self._encoder.statustext(mavlink.SEVERITY_WARNING, text), time_ns)

    def _take_timesync(self, message: mavlink.Timesync, time_ns: int) -> None:
        if message.target_system not in (0, self.system_id):
            self.counters["ignored_not_addressed"] += 1
        elif message.tc1 == 0:
            self.counters["timesync_requests"] += 1
            self._send(self._encoder.timesync(max(1, self.clock.boot_ns(time_ns)), message.ts1), time_ns)
        else:
            known = message.ts1 == self._timesync_ts1
            self.counters["timesync_replies" if known else "ignored_timesync_reply"] += 1

    def _take_setpoint(self, setpoint: mavlink.Setpoint, time_ns: int) -> None:
        gain = self.settings.velocity_gain_1_s
        reason, target = setpoint_target(setpoint, self.rules, yaw_rad=self.motion.yaw_rad, velocity_gain_1_s=gain)
        guided = self.mode == self.rules.guided_mode
        if reason:
            self.counters[reason] += 1
            if guided and self.rules.velocity_grows and not self.landed:
                self._takeoff_m, self._target = None, self._stopped()  # ArduCopter's answer to what it does not take
            return
        self._setpoint_ns = time_ns  # PX4 also counts those that come before offboard: they let it enter
        if not guided or not self.armed:
            self.counters["ignored_not_guided" if not guided else "ignored_not_armed"] += 1
            return
        self.counters["setpoints"] += 1
        if self.landed:
            return
        self._takeoff_m = None  # a set-point ends a guided take-off where it is
        self._target = target
        if self._record is not None:
            self._record((ACTED, self.system_id, setpoint.time_boot_ms, time_ns, time_ns, time_ns))

    def _take_request(self, request: Request, time_ns: int) -> None:
        if isinstance(request, SetMode):
            if request.base_mode & mavlink.BASE_MODE_CUSTOM:
                self._change_mode(request.custom_mode, time_ns)
            return
        for frame in self.services.answer(request, self.counters, time_ns):
            self._send(frame, time_ns)
        if isinstance(request, ParameterSet):
            before = self._setpoint_timeout_ns, self._ground_disarm_ns
            self._read_timeouts()
            if (self._setpoint_timeout_ns, self._ground_disarm_ns) != before:
                self._armed_ns = time_ns  # timers begin anew, so that none ends in the past
                self._setpoint_ns = None if self._setpoint_ns is None else time_ns

    def _read_timeouts(self) -> None:
        self._setpoint_timeout_ns = round(self.parameters[self.rules.setpoint_timeout_parameter] * NS_PER_S)
        self._ground_disarm_ns = round(self.parameters[self.rules.ground_disarm_parameter] * NS_PER_S)

    # Commands

    def _ready(self, time_ns: int) -> bool:
        return time_ns >= self._ready_ns

    def _arm(self, command: mavlink.Command, time_ns: int) -> int:
        if command.param1 == 0.0:
            if not self.landed:
                return FAILED
            self.armed = False
            return mavlink.ACCEPTED
        if self.armed:
            return mavlink.ACCEPTED
        if not self._ready(time_ns):
            self._say(time_ns, "PreArm: Need Position Estimate")
            return self.rules.arming_refused
        if self._refusals_left:
            self._refusals_left -= 1
            self._say(time_ns, "Arm: Accels inconsistent")
            return self.rules.arming_refused
        self.armed, self._armed_ns = True, time_ns
        self._tell(time_ns, "armed")
        if self._takeoff_m is not None:
            self._leave_ground(time_ns)
        return mavlink.ACCEPTED

    def _set_mode(self, command: mavlink.Command, time_ns: int) -> int:
        return self._change_mode(commanded_mode(command, self.rules), time_ns)

    def _change_mode(self, mode: int | None, time_ns: int) -> int:
        if mode not in self.rules.modes:
            return mavlink.DENIED
        if mode == self.mode:
            return mavlink.ACCEPTED
        if mode != self.rules.first_mode and not self._ready(time_ns):
            return self.rules.arming_refused  # these modes need a position
        streamed = self._setpoint_ns is not None and time_ns - self._setpoint_ns < self._setpoint_timeout_ns
        if mode == self.rules.guided_mode != self.rules.takeoff_mode and not streamed:
            self._say(time_ns, "Offboard needs set-points")
            return TEMPORARILY_REJECTED
        self.mode, self.failsafe, self._takeoff_m = mode, False, None
        self._target = self._stopped()
        if mode == self.rules.guided_mode == self.rules.takeoff_mode:
            self._setpoint_ns = time_ns  # the time-out begins with the mode
        self._tell(time_ns, self.rules.modes[mode])
        return mavlink.ACCEPTED

    def _take_off(self, command: mavlink.Command, time_ns: int) -> int:
        """ArduCopter wants the altitude above home, armed and guided; PX4 the one above sea level, in any mode."""
        own_mode = self.rules.takeoff_mode == self.rules.guided_mode
        altitude_m = command.param7 - (0.0 if own_mode else ORIGIN_ALTITUDE_M)
        if not own_mode and math.isnan(altitude_m):
            altitude_m = self.parameters[PX4_TAKEOFF_ALTITUDE]
        if own_mode and not (self.armed and self.mode == self.rules.guided_mode):
            return FAILED
        if not own_mode and math.isfinite(command.param5 + command.param6):
            return mavlink.DENIED  # it would take off towards that latitude and longitude, which is not simulated
        if not (self.landed and self._ready(time_ns) and 0.0 < altitude_m < ABSURD):
            return FAILED if own_mode else TEMPORARILY_REJECTED
        self.mode, self._takeoff_m = self.rules.takeoff_mode, altitude_m
        if self.armed:
            self._leave_ground(time_ns)
        return mavlink.ACCEPTED

    # What it sends

    def _report(self, message_id: int, time_ns: int, boot_ms: int) -> None:
        if self._speaks_version_1 and message_id != mavlink.HEARTBEAT:
            return  # nobody listens yet who could want it
        if message_id == mavlink.TIMESYNC:
            self._timesync_ts1 = self.clock.boot_ns(time_ns)
            self._send(self._encoder.timesync(0, self._timesync_ts1), time_ns)
            return
        if message_id == PARAMETER_VALUE:
            self._send(self.services.next_parameter(time_ns), time_ns)
            return
        state = self.mode, self.armed, self.landed, self.failsafe, self.home_ne_m
        facts = Facts(self.motion, self.origin_neu_m, *state, self._ready(time_ns))
        frame = report(message_id, self._encoder, self.rules, facts, boot_ms)
        if frame is None:
            return
        if self._speaks_version_1:
            frame = mavlink.in_version_1(frame)
        if message_id == mavlink.LOCAL_POSITION and self._record is not None:
            self._record((SAMPLED, self.system_id, boot_ms, time_ns, time_ns, time_ns))
        self._send(frame, time_ns)

    # Motion

    def _stopped(self) -> Target:
        """What it does in a mode by itself: nothing, sink, or fly home."""
        gain, place = self.settings.velocity_gain_1_s, self.home_ne_m if self.mode == self.rules.return_mode else None
        climb_m_s = -SINK_FAST_M_S if self.mode == self.rules.land_mode else 0.0
        return Target(velocity_gain_1_s=gain, climb_m_s=climb_m_s, place_ne_m=place)

    def _leave_ground(self, time_ns: int) -> None:
        self.landed = False
        self._target = self._stopped()._replace(altitude_m=self._takeoff_m)
        self._setpoint_ns = None
        self._tell(time_ns, "takes off")

    def _advance(self, time_ns: int) -> None:
        if time_ns <= self._motion_ns:
            return
        duration_s, self._motion_ns = (time_ns - self._motion_ns) / NS_PER_S, time_ns
        if self.landed:
            return
        self.motion, self._target = advance(self.motion, self._target, self.settings, duration_s)
        altitude_m = self.motion.altitude_m
        if self._takeoff_m is not None and altitude_m > self._takeoff_m - TAKEN_OFF_M:
            self._takeoff_m = None
            if self.rules.takeoff_mode != self.rules.guided_mode:
                self.mode = self.rules.hold_mode
                self._target = self._stopped()
            self._tell(time_ns, "taken off")
        elif self.mode == self.rules.land_mode:
            sink = SINK_M_S if altitude_m < SINK_SLOWLY_BELOW_M else SINK_FAST_M_S
            self._target = self._target._replace(climb_m_s=-sink)
            if altitude_m <= 0.0:
                self.landed, self.armed = True, False
                self.motion = Motion(self.motion.north_m, self.motion.east_m, yaw_rad=self.motion.yaw_rad)
                self._tell(time_ns, "landed")
        elif self.mode == self.rules.return_mode and math.dist(self.motion[:2], self.home_ne_m) < HOME_M:
            self.mode = self.rules.land_mode
            self._target = self._stopped()
            self._tell(time_ns, self.rules.modes[self.mode])

    def _send(self, frame: bytes, time_ns: int) -> None:
        self._out.append((frame, time_ns))

    def _say(self, time_ns: int, text: str) -> None:
        self._send(self._encoder.statustext(mavlink.SEVERITY_CRITICAL, text), time_ns)

    def _tell(self, time_ns: int, text: str) -> None:
        self.changes.append(Change(time_ns, self.system_id, text))
