"""Vehicles with autopilots: their start, one common frame, identification, set-points."""

from math import hypot
from typing import Any

from gcs.autopilot.manoeuvre import Identification
from gcs.autopilot.startup import AutopilotStartup, between
from gcs.autopilot.velocity_targets import VelocityTargets
from gcs.control.history import StateHistory
from gcs.control.loops import Order, loop_of
from gcs.control.phases import START_PATIENCE_S, Phase
from gcs.link.vehicle import RemoteVehicle, Report, in_words, refusals
from gcs.plan.flight_plan import FlightPlan
from scenarios.schema import NS_PER_S

PATIENCE_S = 120.0
"""Longest time from a vehicle's first heartbeat until it takes set-points in the air; longest silence in between."""
_UNANNOUNCED_S = 3.0
_FRAME_RESOLUTION_M = 0.005
"""Half of the last digit of a latitude: an origin that seems to move by less has not moved."""


class AutopilotFleet:
    """See `gcs.station.fleet_kind.FleetKind`."""

    speaks_mavlink_1_first = True
    holds_when_left_alone = False

    def __init__(self, plan: FlightPlan, report: Report) -> None:
        scenario, ids = plan.scenario, plan.formation.system_ids
        self.plan = plan
        self.loop = loop_of(plan)
        self.starts = [
            AutopilotStartup(altitude_m=scenario.altitude_m, telemetry_hz=scenario.rates.telemetry_hz) for _ in ids
        ]
        self.vehicles = [
            RemoteVehicle(system_id, startup=startup, report=report, land=scenario.at_end == "land")
            for system_id, startup in zip(ids, self.starts, strict=True)
        ]
        self.frame_ned_m = [(0.0, 0.0, 0.0)] * len(ids)
        self._report = report
        self._lacks = [("", 0)] * len(ids)
        """What each vehicle lacks, and since when; 0 once that has been reported."""
        self._targets = VelocityTargets(self.vehicles, self.starts, period_s=1.0 / scenario.rates.control_hz)
        self._identification = Identification(plan, self.vehicles, report) if plan.responses is None else None

    @property
    def identified(self) -> bool:
        return self._identification is None

    def startup_failure(self, due_ns: int, start_ns: int) -> str:
        if failure := refusals(self.vehicles):
            return failure
        self._report_lacks(due_ns)
        out_of_time = due_ns - start_ns > START_PATIENCE_S * NS_PER_S

        def late(vehicle: RemoteVehicle) -> bool:
            first_ns = start_ns if vehicle.first_heard_ns is None else vehicle.first_heard_ns
            heard_ns = vehicle.heard_ns if vehicle.silent else first_ns
            return not vehicle.ready and (out_of_time or due_ns - heard_ns > PATIENCE_S * NS_PER_S)

        return in_words("not ready: ", [vehicle for vehicle in self.vehicles if late(vehicle)])

    def _report_lacks(self, due_ns: int) -> None:
        """Report what a vehicle has lacked for longer than a start-up step usually takes."""
        for row, vehicle in enumerate(self.vehicles):
            lacks, _, _ = vehicle.missing.partition(",")  # without how far it has climbed
            before, since_ns = self._lacks[row]
            if lacks != before:
                self._lacks[row] = lacks, due_ns
            elif since_ns and (not lacks or due_ns - since_ns > _UNANNOUNCED_S * NS_PER_S):
                self._lacks[row] = lacks, 0
                self._report("start", lacks or "is ready", vehicle.system_id)

    def locate(self, history: StateHistory) -> None:
        """States reported in a frame that has moved since are forgotten."""
        first = self.starts[0]
        for row, startup in enumerate(self.starts):
            if first.origin is None or startup.origin is None:
                continue
            north, east = between(first.origin, startup.origin)
            known_north, known_east, _ = self.frame_ned_m[row]
            if hypot(north - known_north, east - known_east) > _FRAME_RESOLUTION_M:
                history.forget(row)
            else:
                north, east = known_north, known_east
            self.frame_ned_m[row] = north, east, first.origin_altitude_m - startup.origin_altitude_m

    def identify(self, due_ns: int, history: StateHistory) -> str:
        if self._identification is None:
            return ""
        found = self._identification.next(due_ns, history)
        if isinstance(found, str):
            return found
        if found is not None:
            self.plan, self._identification = found, None
        return ""

    def set_point(self, row: int, order: Order, phase: Phase) -> tuple[Any, ...] | None:
        vehicle, (control, commanded, _, key_ms, due_ns) = self.vehicles[row], order
        command, known = control.command_m_s2, control.sample_ns > 0
        if vehicle.taken_over and vehicle.kind.guided_first:
            self._targets.rest(row)
            return None
        others = vehicle.taken_over and phase in (Phase.IDENTIFYING, Phase.FLYING)
        if (phase is Phase.CONNECTING and self.starts[row].airborne) or others:
            return self._targets.hover(row, key_ms=key_ms)  # PX4 enters OFFBOARD only while set-points arrive
        if phase is Phase.IDENTIFYING and self._identification is not None:
            command, commanded = self._identification.command(due_ns), True
            known = known or self._targets.steers(row)  # a clock that jumped does not interrupt the manoeuvre
        if not commanded or not known:
            self._targets.rest(row)
            return None
        if not vehicle.guided:
            self._targets.rest(row)  # set-points show it that a station is there; they start from its own velocity
        return self._targets.accelerate(row, command, control.state[2:4], key_ms=key_ms, now_ns=due_ns)
