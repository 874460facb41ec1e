"""One simulated UAV: a MAVLink system of its own that flies. Bytes and time in, bytes and time out.

It starts on the launcher: held at its initial state, and reporting the initial position and velocity, until it has
been armed, is in GUIDED and the first set-point is accepted; from that instant on it flies. Everything happens at its
exact instant, however late `step` is called.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import NamedTuple

from scenarios import schema
from scenarios.schema import NS_PER_S
from sim_vehicles import mavlink
from sim_vehicles.authority import Authority
from sim_vehicles.autopilot import MODE_NAMES, Autopilot
from sim_vehicles.clock import BootClock
from sim_vehicles.dynamics import COAST, VELOCITY_GAIN_1_S, Command, State, advance, bounds_of, rates, state_from
from sim_vehicles.earth import ORIGIN_ALTITUDE_M, ORIGIN_LATITUDE_DEG, ORIGIN_LONGITUDE_DEG, degrees
from sim_vehicles.onboard import STEP, OnboardLoop, formation_parameters
from sim_vehicles.parameters import Parameters, of_vehicle
from sim_vehicles.schedule import Schedule
from sim_vehicles.service_messages import PARAMETER_VALUE, ParameterSet, Request, SetMode
from sim_vehicles.services import EXTRA, Condition, Services, report, whole
from sim_vehicles.setpoints import ACCELERATION, AXES, VELOCITY, VELOCITY_ACCELERATION, fault, to_local
from sim_vehicles.setup_parameters import of_ardupilot
from sim_vehicles.truth import ACTED, SAMPLED, Record

TIMESYNC_INTERVAL_US = 10_000_000
HEARTBEAT_INTERVAL_US = 1_000_000
DEFAULT_INTERVAL_US = {
    mavlink.HEARTBEAT: HEARTBEAT_INTERVAL_US,
    mavlink.LOCAL_POSITION: 250_000,
    mavlink.GLOBAL_POSITION: 1_000_000,
    mavlink.HOME_POSITION: 0,
}
"""Sent unasked, slowly, as an autopilot does on a telemetry port; MAV_CMD_SET_MESSAGE_INTERVAL changes it."""
VERSION = (4, 6, 0)
"""Of the ArduCopter whose messages and modes it has."""
GRAVITY_M_S2 = 9.80665
LONGEST_HISTORY = 1000
"""Changes kept if nobody reads them; a hostile sender can cause them without end."""


class Change(NamedTuple):
    """Something a person watching would want to know, such as "failsafe: set-points stopped"."""

    time_ns: int
    system_id: int
    text: str


class Vehicle:
    """A UAV with its autopilot, boot clock and counters.

    `counters` says what came in: `heartbeats`, `commands`, `timesync_requests`, `timesync_replies`, `setpoints`, and
    by reason what was not obeyed: `refused_...` for what is wrong with it, `ignored_...` for what is well formed but
    not for this vehicle or not now.
    """

    def __init__(
        self,
        scenario: schema.Scenario,
        own: schema.Vehicle,
        start_ns: int,
        *,
        record: Record | None = None,
        onboard: OnboardLoop | None = None,
        experiment: str = "",
    ) -> None:
        self.system_id = own.system_id
        self.counters: Counter[str] = Counter()
        self.changes: deque[Change] = deque(maxlen=LONGEST_HISTORY)
        """Appended to; whoever reads may clear it."""
        self.clock = BootClock.draw(scenario.clocks, scenario.seed, own.system_id, start_ns)
        self.autopilot = Autopilot(scenario.safety)
        self.authority = Authority(scenario.safety.heartbeat_timeout_s)
        formation = [] if onboard is None else formation_parameters()
        self.parameters = Parameters([*of_vehicle(own.system_id, scenario.safety), *of_ardupilot(), *formation])
        self._onboard = onboard
        self._record = record
        self._encoder = mavlink.Encoder(own.system_id)
        self._altitude_m = scenario.altitude_m
        self._bounds = bounds_of(scenario.limits)
        self._state = state_from(own.position_ne_m, own.velocity_ne_m_s)
        self._state_ns = start_ns
        self._command = COAST
        self._timesync_ts1 = -1
        self._out: list[tuple[bytes, int]] = []
        self._answers: dict[int, Callable[[mavlink.Command, int], int]] = {
            mavlink.COMMAND_ARM: self._arm,
            mavlink.COMMAND_MODE: self._set_mode,
            mavlink.COMMAND_TAKEOFF: self._take_off,
            mavlink.COMMAND_LAND: lambda _, time_ns: self._cannot_land(time_ns),
            mavlink.COMMAND_RETURN: lambda _, time_ns: self._cannot_land(time_ns),
        }
        self._schedule = Schedule(self.clock)
        self._schedule.add_once(mavlink.HEARTBEAT, start_ns)  # found at once, not after up to a second
        self._schedule.set_interval(mavlink.TIMESYNC, TIMESYNC_INTERVAL_US, start_ns)
        for message_id, interval_us in DEFAULT_INTERVAL_US.items():
            self._schedule.set_interval(message_id, interval_us, start_ns)
        self.services = Services(
            self._encoder, self._schedule, self.parameters, VERSION, DEFAULT_INTERVAL_US, start_ns, experiment
        )
        if onboard is not None:
            self._schedule.set_interval(STEP, onboard.interval_us, start_ns)

    @property
    def next_event_ns(self) -> int:
        """When the vehicle next does something if nothing arrives."""
        scheduled_ns, deadline_ns = self._schedule.next_ns, self.autopilot.deadline_ns
        return deadline_ns if deadline_ns < scheduled_ns else scheduled_ns

    def state_at(self, time_ns: int) -> State:
        """The true state at a time not before the last event, if nothing arrives until then."""
        if not self.autopilot.flying or time_ns <= self._state_ns:
            return self._state
        return advance(self._state, self._command, self._bounds, (time_ns - self._state_ns) / NS_PER_S)

    def step(self, datagrams: Iterable[tuple[bytes, int]], now_ns: int) -> list[tuple[bytes, int]]:
        """Live until now: what arrives, as (datagram, instant) in order of time, to what is sent, likewise.

        A datagram with an instant that is already behind acts at once. One that arrives at the very instant of
        something scheduled comes first: a set-point on the deadline is in time.
        """
        self._out = []
        for data, time_ns in datagrams:
            self._run(time_ns)
            self._receive(data, time_ns)
        self._run(now_ns + 1)
        return self._out

    def _run(self, end_ns: int) -> None:
        """Do what is scheduled before the end."""
        schedule, autopilot = self._schedule, self.autopilot
        while True:
            if autopilot.deadline_ns <= schedule.next_ns:
                if autopilot.deadline_ns >= end_ns:
                    return
                self._fail(autopilot.deadline_ns)
            elif schedule.next_ns >= end_ns:
                return
            else:
                self._report(*schedule.pop())

    # What arrives

    def _receive(self, data: bytes, time_ns: int) -> None:
        for source, message in mavlink.read_datagram(data, self.counters):
            if isinstance(message, mavlink.Timesync):
                self._take_timesync(message, time_ns)
                continue
            if isinstance(message, mavlink.Heartbeat):
                self._take_heartbeat(source, message, time_ns)
                continue
            if not self._is_for_us(message.target_system, message.target_component):
                continue
            if not self.authority.obeys(source, message, time_ns):
                self._refuse(source, time_ns)
                continue
            if isinstance(message, mavlink.Setpoint):
                self._take_setpoint(message, time_ns)
            elif isinstance(message, mavlink.Command):
                self._take_command(message, time_ns)
            else:
                self._take_request(message, max(time_ns, self._state_ns))

    def _is_for_us(self, target_system: int, target_component: int) -> bool:
        if target_system == self.system_id and target_component in (0, mavlink.COMPONENT_AUTOPILOT):
            return True
        self.counters["ignored_not_addressed"] += 1
        return False

    def _refuse(self, source: int, time_ns: int) -> None:
        """No COMMAND_ACK: the station has no way to tell it from the answer to an equal command of its own."""
        text = self.authority.refusal(source, self.counters)
        if text:
            self._tell(time_ns, text)
            self._send(self._encoder.statustext(mavlink.SEVERITY_WARNING, text), time_ns)

    def _take_heartbeat(self, source: int, heartbeat: mavlink.Heartbeat, time_ns: int) -> None:
        if heartbeat.vehicle_type != mavlink.TYPE_GCS:
            self.counters["ignored_heartbeat"] += 1
        elif not self.authority.hears(source, time_ns):
            self.counters["ignored_not_the_station"] += 1
        else:
            self.counters["heartbeats"] += 1
            self.autopilot.hear_heartbeat(max(time_ns, self._state_ns))

    def _take_setpoint(self, setpoint: mavlink.Setpoint, time_ns: int) -> None:
        time_ns = max(time_ns, self._state_ns)
        on_launcher = not self.autopilot.flying
        counts = setpoint.type_mask & AXES
        onboard = self._onboard if self._onboard is not None and self._onboard.on else None
        reason = fault(setpoint)
        if onboard is not None and counts != VELOCITY_ACCELERATION:
            reason = reason or "refused_mask"  # its own loop wants to know the formation's velocity
        reason = reason or self.autopilot.accept_setpoint(time_ns)
        if reason:
            self.counters[reason] += 1
            return
        self.counters["setpoints"] += 1
        if on_launcher:
            self._state_ns = time_ns  # its state is the initial one until now
            self._tell(time_ns, "flying")
        self._advance(time_ns)
        if setpoint.frame != mavlink.FRAME_LOCAL_NED:
            setpoint = to_local(setpoint, self._state.yaw_rad)
        north, east, _ = setpoint.acceleration_ned_m_s2
        if onboard is not None:
            onboard.stream(setpoint.velocity_ned_m_s[:2], (north, east))
            self._command = onboard.command()
        elif counts == ACCELERATION:
            self._command = Command(north, east)
        elif counts == VELOCITY:
            self._command = Command(0.0, 0.0, *setpoint.velocity_ned_m_s[:2], VELOCITY_GAIN_1_S)
        else:
            self._command = Command(north, east, *setpoint.velocity_ned_m_s[:2], VELOCITY_GAIN_1_S)
        if self._record is not None:
            self._record((ACTED, self.system_id, setpoint.time_boot_ms, time_ns, time_ns, time_ns))

    def _take_timesync(self, message: mavlink.Timesync, time_ns: int) -> None:
        if message.target_system not in (0, self.system_id):
            self.counters["ignored_not_addressed"] += 1
        elif message.tc1 == 0:
            self.counters["timesync_requests"] += 1
            # Not 0 even at the very boot: that would make the reply a request.
            tc1 = max(1, self.clock.boot_ns(time_ns))
            self._send(self._encoder.timesync(tc1, message.ts1), time_ns)
        elif message.ts1 == self._timesync_ts1:
            self.counters["timesync_replies"] += 1
        else:
            self.counters["ignored_timesync_reply"] += 1  # to another vehicle, or a duplicate

    def _take_request(self, request: Request, time_ns: int) -> None:
        if isinstance(request, SetMode):
            self._change_mode(request.base_mode, request.custom_mode, time_ns)
            return
        for frame in self.services.answer(request, self.counters, time_ns):
            self._send(frame, time_ns)
        if isinstance(request, ParameterSet):
            timeouts_s = self.parameters["GUID_TIMEOUT"], self.parameters["FS_GCS_TIMEOUT"]
            self.autopilot.set_timeouts(*timeouts_s, time_ns)
            if self._onboard is not None:
                self._onboard.set(self.parameters)

    # Commands

    def _take_command(self, command: mavlink.Command, time_ns: int) -> None:
        self.counters["commands"] += 1
        answer = self._answers.get(command.command)
        time_ns = max(time_ns, self._state_ns)
        if answer is None:
            result, frames = self.services.command(command, time_ns)
        else:
            result, frames = answer(command, time_ns), []
        # The acknowledgement goes before what the command asks for, as request and reply are read.
        self._send(self._encoder.command_ack(command.command, result, command.source), time_ns)
        for frame in frames:
            self._send(frame, time_ns)

    def _arm(self, command: mavlink.Command, time_ns: int) -> int:
        if command.param1 not in (0.0, 1.0):
            return mavlink.DENIED
        was = self.autopilot.armed
        result = self.autopilot.arm(command.param1 == 1.0)
        if self.autopilot.armed != was:
            self._tell(time_ns, "armed" if self.autopilot.armed else "disarmed")
        return result

    def _take_off(self, _: mavlink.Command, time_ns: int) -> int:
        """Leave the launcher, at the altitude and with the velocity that it has there, whatever altitude is wanted."""
        result = self.autopilot.take_off(time_ns)
        if result == mavlink.ACCEPTED:
            self._state_ns = time_ns
            self._tell(time_ns, "flying")
        return result

    def _set_mode(self, command: mavlink.Command, time_ns: int) -> int:
        return self._change_mode(whole(command.param1), whole(command.param2), time_ns)

    def _change_mode(self, base_mode: int | None, mode: int | None, time_ns: int) -> int:
        if base_mode is None or mode is None or not base_mode & mavlink.BASE_MODE_CUSTOM:
            return mavlink.DENIED
        if mode in (mavlink.MODE_LAND, mavlink.MODE_RETURN):
            return self._cannot_land(time_ns)
        before = (self.autopilot.mode, self.autopilot.failsafe)
        result = self.autopilot.set_mode(mode, time_ns)
        if (self.autopilot.mode, self.autopilot.failsafe) != before:
            self._advance(time_ns)
            self._command = self._alone()
            self._tell(time_ns, MODE_NAMES[mode] + (", failsafe over" if before[1] else ""))
        return result

    def _cannot_land(self, time_ns: int) -> int:
        """Said in words as well: a person who asks for this may not see the result."""
        text = "cannot land or return, LOITER holds the course"
        self._send(self._encoder.statustext(mavlink.SEVERITY_WARNING, text), time_ns)
        return mavlink.DENIED

    # What happens by itself

    def _fail(self, time_ns: int) -> None:
        self._advance(time_ns)
        self.autopilot.fail()
        self._command = self._alone()
        text = f"failsafe: {self.autopilot.failsafe} stopped"
        self._tell(time_ns, text)
        self._send(self._encoder.statustext(mavlink.SEVERITY_CRITICAL, text), time_ns)

    def _alone(self) -> Command:
        """What it does without set-points: its own loop, if it has one and is not told to hold, or fly straight on."""
        onboard = self._onboard
        if onboard is None:
            return COAST
        onboard.drop_stream()
        return onboard.command() if self._own_loop_flies(onboard) else COAST

    def _own_loop_flies(self, onboard: OnboardLoop) -> bool:
        autopilot = self.autopilot
        return onboard.on and autopilot.flying and (autopilot.mode == mavlink.MODE_GUIDED or autopilot.failsafe != "")

    def _step_onboard(self, time_ns: int, boot_ms: int) -> None:
        onboard = self._onboard
        if onboard is None or not onboard.on:
            return
        self._advance(time_ns)
        onboard.step(time_ns, boot_ms, self._state)
        if self._own_loop_flies(onboard):
            self._command = onboard.command()

    def _report(self, time_ns: int, message_id: int, boot_ms: int) -> None:
        if message_id == STEP:
            self._step_onboard(time_ns, boot_ms)
            return
        boot_ms &= 0xFFFFFFFF
        if message_id == mavlink.LOCAL_POSITION:
            self._advance(time_ns)
            state = self._state
            velocity = state.velocity_ne_m_s()
            frame = self._encoder.local_position(boot_ms, state[0], state[1], -self._altitude_m, velocity)
            if self._record is not None:
                self._record((SAMPLED, self.system_id, boot_ms, time_ns, time_ns, time_ns))
        elif message_id == mavlink.GLOBAL_POSITION:
            self._advance(time_ns)
            frame = self._global_position(boot_ms)
        elif message_id == mavlink.TIMESYNC:
            self._timesync_ts1 = self.clock.boot_ns(time_ns)
            frame = self._encoder.timesync(0, self._timesync_ts1)
        elif message_id == PARAMETER_VALUE:
            frame = self.services.next_parameter(time_ns)
        elif message_id == mavlink.HOME_POSITION:
            frame = self._encoder.home_position(ORIGIN_LATITUDE_DEG, ORIGIN_LONGITUDE_DEG, ORIGIN_ALTITUDE_M)
        elif message_id in EXTRA:
            self._advance(time_ns)
            frame = report(message_id, self._encoder, self._condition(boot_ms))
        else:
            autopilot = self.autopilot
            frame = self._encoder.heartbeat(autopilot.base_mode, autopilot.mode, autopilot.system_status)
        self._send(frame, time_ns)

    def _condition(self, boot_ms: int) -> Condition:
        """What it reports to other stations: in flight it banks as in a coordinated turn."""
        state, roll_rad = self._state, 0.0
        if self.autopilot.flying:
            _, _, turn_rate_rad_s, _ = rates(state.yaw_rad, state.speed_m_s, self._command, self._bounds)
            roll_rad = math.atan2(state.speed_m_s * turn_rate_rad_s, GRAVITY_M_S2)
        return Condition(
            boot_ms,
            degrees(state.north_m, state.east_m),
            ORIGIN_ALTITUDE_M + self._altitude_m,
            (*state.velocity_ne_m_s(), 0.0),
            (roll_rad, 0.0, math.remainder(state.yaw_rad, math.tau)),
            flying=self.autopilot.flying,
            has_position=True,
        )

    def _global_position(self, boot_ms: int) -> bytes:
        state = self._state
        latitude_deg, longitude_deg = degrees(state.north_m, state.east_m)
        return self._encoder.global_position(
            time_boot_ms=boot_ms,
            latitude_deg=latitude_deg,
            longitude_deg=longitude_deg,
            altitude_m=ORIGIN_ALTITUDE_M + self._altitude_m,
            relative_altitude_m=self._altitude_m,
            velocity_ne_m_s=state.velocity_ne_m_s(),
            heading_deg=math.degrees(state.yaw_rad) % 360.0,
        )

    def _advance(self, time_ns: int) -> None:
        if time_ns > self._state_ns:
            if self.autopilot.flying:
                self._state = advance(self._state, self._command, self._bounds, (time_ns - self._state_ns) / NS_PER_S)
            self._state_ns = time_ns

    def _send(self, frame: bytes, time_ns: int) -> None:
        self._out.append((frame, time_ns))

    def _tell(self, time_ns: int, text: str) -> None:
        self.changes.append(Change(time_ns, self.system_id, text))
