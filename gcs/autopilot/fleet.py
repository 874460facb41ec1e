"""A fleet of vehicles with autopilots: start-up, one common frame, identification, set-points."""

from collections.abc import Sequence
from math import hypot

import numpy as np

from gcs.autopilot.identify import LEAST_RATE_HZ
from gcs.autopilot.manoeuvre import Identification
from gcs.autopilot.startup import AutopilotStartup, between
from gcs.autopilot.vehicle_limits import Bounds
from gcs.autopilot.velocity_targets import VelocitySetPoint, VelocityTargets
from gcs.control.fleet import Fleet
from gcs.control.history import StateHistory
from gcs.control.loops import Orders
from gcs.control.phases import START_PATIENCE_S, Phase
from gcs.link import mavlink
from gcs.link.vehicle import RemoteVehicle, Report, in_words, refusals
from gcs.plan.flight_plan import FlightPlan
from scenarios.kernel import Records
from scenarios.schema import NS_PER_S

_UNANNOUNCED_S = 3.0
_LEAD_S = 0.5
"""The velocity target leads the vehicle's newest velocity by at most the velocity gained at its largest acceleration in
this time plus the age of that velocity plus the delay down. More would wind up while the vehicle cannot follow."""
_FRAME_RESOLUTION_M = 0.005
"""Half of the last digit of a latitude: an origin that moves by less is considered unchanged."""


class AutopilotFleet(Fleet):
    """Multicopters that start on the ground, each with its own local frame."""

    speaks_mavlink_1_first = True
    together_ns = 8_000_000  # PX4 ignores an answer that arrives over 10 ms after its TIMESYNC request
    holds_when_left_alone = False

    def __init__(self, plan: FlightPlan, report: Report) -> None:
        scenario = plan.scenario
        self.starts = [
            AutopilotStartup(
                altitude_m=scenario.altitude_of(vehicle),
                telemetry_hz=scenario.rates.telemetry_hz,
                target_hz=scenario.target_hz,
            )
            for vehicle in scenario.leader_first()
        ]
        super().__init__(plan, report, starts=self.starts)
        self._report = report
        self._lacks = [("", 0)] * len(self.vehicles)
        """What each vehicle lacks, and since when; the time is 0 once that has been reported."""
        self._located: set[int] = set()
        """The rows whose frame has been known."""
        self._frames: list[object] = []
        """What the frames were last computed from, once all origins are known."""
        self._bounds = Bounds(plan, [startup.limits for startup in self.starts])
        self._targets = VelocityTargets(self.starts, period_s=1.0 / scenario.rates.control_hz)
        self._identification = Identification(plan, self.vehicles, report) if plan.responses is None else None

    @property
    def identified(self) -> bool:
        return self._identification is None

    def startup_failure(self, due_ns: int, start_ns: int, history: StateHistory) -> str:
        if failure := refusals(self.vehicles):
            return failure
        rate_hz = self.plan.scenario.rates.telemetry_hz
        if not self.identified and rate_hz < LEAST_RATE_HZ:
            wanted = f"at least {LEAST_RATE_HZ:g}, or a [response] in the scenario"
            return f"not identified: rates.telemetry_hz is {rate_hz:g}; wanted {wanted}"
        self._report_lacks(due_ns)
        out_of_time = due_ns - start_ns > START_PATIENCE_S * NS_PER_S
        patience_ns = self.plan.scenario.safety.ready_patience_s * NS_PER_S

        def late(vehicle: RemoteVehicle) -> bool:
            first_ns = max(start_ns, vehicle.first_heard_ns or 0)  # what is heard first may wait long in the socket
            heard_ns = vehicle.heard_ns if vehicle.silent else first_ns
            return not vehicle.ready and (out_of_time or due_ns - heard_ns > patience_ns)

        too_late = [vehicle for vehicle in self.vehicles if vehicle.left_out or late(vehicle)]
        if len(too_late) == len(self.vehicles):
            return in_words("not ready: ", too_late)
        self._leave_out([vehicle for vehicle in too_late if not vehicle.left_out], history)
        return ""

    def _leave_out(self, vehicles: list[RemoteVehicle], history: StateHistory) -> None:
        """Fly without some vehicles, which get no commands until the flight ends."""
        for vehicle in vehicles:
            vehicle.left_out, vehicle.goal = True, None
            history.forget(self.vehicles.index(vehicle))
            self._report("vehicle", f"is left out: {vehicle.missing}", vehicle.system_id)
        if vehicles:
            self.locate(history)  # the first vehicle, whose frame is common to all, may be among them
        if vehicles and self._identification is not None:
            present = [vehicle for vehicle in self.vehicles if not vehicle.left_out]
            self._identification = Identification(self.plan, present, self._report)

    def _report_lacks(self, due_ns: int) -> None:
        """Report anything that a vehicle has lacked for longer than a start-up step usually takes."""
        for row, vehicle in enumerate(self.vehicles):
            if vehicle.left_out:
                continue
            lacks, _, _ = vehicle.missing.partition(",")  # drops the altitude reached, which changes all the time
            before, since_ns = self._lacks[row]
            if lacks != before:
                self._lacks[row] = lacks, due_ns
            elif since_ns and (not lacks or due_ns - since_ns > _UNANNOUNCED_S * NS_PER_S):
                self._lacks[row] = lacks, 0
                self._report("start", lacks or "is ready", vehicle.system_id)

    def begin(self) -> None:
        for vehicle, startup in zip(self.vehicles, self.starts, strict=True):
            self._report("limits", startup.limits.in_words(), vehicle.system_id)

    def locate(self, history: StateHistory) -> None:
        """Update the origins of the local frames. States reported before their frame moved are dropped."""
        first = next(start for start, vehicle in zip(self.starts, self.vehicles, strict=True) if not vehicle.left_out)
        frames: list[object] = [first, *((startup.origin, startup.origin_altitude_m) for startup in self.starts)]
        if frames == self._frames:
            return
        self._frames = frames if all(startup.origin for startup in self.starts) else []
        for row, startup in enumerate(self.starts):
            if startup.origin is None and row in self._located:  # the vehicle has restarted
                history.forget(row)
            if first.origin is None or startup.origin is None:
                continue
            self._located.add(row)
            north, east = between(first.origin, startup.origin)
            known_ned_m: list[float] = self.frame_ned_m[row].tolist()
            if hypot(north - known_ned_m[0], east - known_ned_m[1]) > _FRAME_RESOLUTION_M:
                history.forget(row)
            else:
                north, east, _ = known_ned_m
            self.frame_ned_m[row] = north, east, first.origin_altitude_m - startup.origin_altitude_m

    def identify(self, due_ns: int, history: StateHistory) -> str:
        if self._identification is None:
            return ""
        present = [row for row, vehicle in enumerate(self.vehicles) if not vehicle.left_out]
        found = self._identification.next(
            due_ns, history if len(present) == len(self.vehicles) else history.of(present)
        )
        if isinstance(found, str):
            return found
        if found is not None:
            self.plan, self._identification = found, None
        return ""

    def bound(self, controls: Records, blends: Records) -> None:
        self._bounds.bound(controls, blends)

    def _rest(self, row: int) -> None:
        self._targets.rest(row)
        self._bounds.rest(row)

    def set_points(self, orders: Orders, phase: Phase) -> Records:
        points = np.zeros(len(self.vehicles), mavlink.SET_POINT)
        points["type_mask"] = mavlink.IGNORE_ALL_BUT_VELOCITY_AND_ACCELERATION
        controls = orders.controls
        columns = controls["command_m_s2"].tolist(), controls["sample_ns"].tolist(), controls["state"].tolist()
        every = zip(*columns, orders.commanded.tolist(), strict=True)
        made = [self._set_point(row, *control, orders.due_ns, phase) for row, control in enumerate(every)]
        rows = [row for row, point in enumerate(made) if point is not None]
        if rows:
            velocities, accelerations = zip(*filter(None, made), strict=True)
            points["sent"][rows] = True
            points["velocity_ned_m_s"][rows], points["acceleration_ne_m_s2"][rows] = velocities, accelerations
        return points

    def _set_point(
        self,
        row: int,
        command_m_s2: Sequence[float],
        sample_ns: int,
        state: Sequence[float],
        commanded: bool,
        due_ns: int,
        phase: Phase,
    ) -> VelocitySetPoint | None:
        vehicle, command, known = self.vehicles[row], (command_m_s2[0], command_m_s2[1]), sample_ns > 0
        if vehicle.left_out:
            return None
        piloted = vehicle.taken_over and vehicle.kind.guided_first
        if vehicle.external or self.starts[row].stays_disarmed or piloted:
            self._rest(row)
            return None
        others = vehicle.taken_over and phase in (Phase.IDENTIFYING, Phase.FLYING)
        if (phase is Phase.CONNECTING and self.starts[row].airborne) or others:
            return self._targets.hover(row)  # PX4 enters OFFBOARD only while set-points arrive
        if phase is Phase.IDENTIFYING and self._identification is not None:
            command, commanded = self._identification.command(due_ns), True
            known = known or self._targets.steers(row)  # a clock that jumped does not interrupt the manoeuvre
        if not commanded or not known:
            self._rest(row)
            return None
        if not vehicle.guided:
            self._rest(row)  # set-points only show that a station is there; each starts from the vehicle's velocity
        self.loop.remember(row, due_ns, command)
        late_s = (due_ns - sample_ns + (vehicle.clock.down_ns or 0)) / NS_PER_S if sample_ns else 0.0
        lead_m_s = self._bounds.acceleration_m_s2(row) * (late_s + _LEAD_S)
        return self._targets.accelerate(row, command, (state[2], state[3]), lead_m_s=lead_m_s, now_ns=due_ns)
