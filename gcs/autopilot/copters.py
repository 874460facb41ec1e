"""What the station does for vehicles with autopilots only: patience, one common frame, identification, set-points."""

from collections.abc import Callable, Sequence
from math import hypot
from typing import Any

from gcs.autopilot.manoeuvre import Identification
from gcs.autopilot.pilots import Pilots
from gcs.control.history import StateHistory
from gcs.control.law import VehicleControl
from gcs.control.phases import START_PATIENCE_S, Phase
from gcs.link.startup import Startup, between
from gcs.link.vehicle import RemoteVehicle
from gcs.plan.flight_plan import FlightPlan
from scenarios.schema import NS_PER_S

PATIENCE_S = 120.0
"""How long a vehicle may take from its first heartbeat until it is in the air and takes set-points, or be silent."""
_SILENT_S = 3.0
_FRAME_RESOLUTION_M = 0.005
"""Half of the last digit of a latitude: smaller changes of an origin are none."""


class Copters:
    """The autopilots of a flight. `plan` becomes that with the margins of what was identified."""

    def __init__(
        self, plan: FlightPlan, vehicles: list[RemoteVehicle], report: Callable[[str, str, int], None]
    ) -> None:
        self.plan = plan
        self.frame_ned_m = [(0.0, 0.0, 0.0)] * len(vehicles)
        """Where each vehicle's local frame begins, in that of the first vehicle."""
        self._vehicles = vehicles
        self._report = report
        self._waits_for = [("", 0)] * len(vehicles)
        """What each vehicle is missing, and since when; 0 when that has been said."""
        self._pilots = Pilots(len(vehicles), period_s=1.0 / plan.scenario.rates.control_hz)
        self._identification = Identification(plan, vehicles, report) if plan.responses is None else None

    def impatience(self, due_ns: int, start_ns: int) -> str:
        """Why the start has to be given up: a vehicle cannot be flown or has had its time. Empty if it has not."""
        refused = [v for v in self._vehicles if v.startup is not None and v.startup.refusal]
        if refused:
            return "refused: " + "; ".join(f"vehicle {v.system_id} {v.missing}" for v in refused)
        self._say_what_is_missing(due_ns)
        out_of_time = due_ns - start_ns > START_PATIENCE_S * NS_PER_S

        def late(vehicle: RemoteVehicle) -> bool:
            first_ns = start_ns if vehicle.first_heard_ns is None else vehicle.first_heard_ns
            heard_ns = vehicle.heard_ns if vehicle.silent else first_ns
            return not vehicle.ready and (out_of_time or due_ns - heard_ns > PATIENCE_S * NS_PER_S)

        unready = [f"vehicle {v.system_id} {v.missing}" for v in self._vehicles if late(v)]
        return "not ready: " + "; ".join(unready) if unready else ""

    def _say_what_is_missing(self, due_ns: int) -> None:
        """A line for what a vehicle has waited for long enough that somebody would ask."""
        for row, vehicle in enumerate(self._vehicles):
            missing, _, _ = vehicle.missing.partition(",")  # without how far it has climbed
            before, since_ns = self._waits_for[row]
            if missing != before:
                self._waits_for[row] = missing, due_ns
            elif since_ns and (not missing or due_ns - since_ns > _SILENT_S * NS_PER_S):
                self._waits_for[row] = missing, 0
                self._report("start", missing or "is ready", vehicle.system_id)

    def locate(self, history: StateHistory) -> None:
        """Bring the vehicles' local frames to that of the first one, as their origins become known."""
        locate([vehicle.startup for vehicle in self._vehicles], self.frame_ned_m, history)

    @property
    def identified(self) -> bool:
        """Whether it is known how all vehicles answer."""
        return self._identification is None

    def identify(self, due_ns: int, history: StateHistory) -> str:
        """Move the identification on by a tick; why it failed, if it has."""
        if self._identification is None:
            return ""
        found = self._identification.next(due_ns, history)
        if isinstance(found, str):
            return found
        if found is not None:
            self.plan, self._identification = found, None
        return ""

    def set_point(
        self, row: int, control: VehicleControl, phase: Phase, *, commanded: bool, key_ms: int, due_ns: int
    ) -> tuple[Any, ...] | None:
        """Fields of the set-point that a vehicle is sent at this tick, if any: to hover, to be identified, to fly."""
        vehicle, command = self._vehicles[row], control.command_m_s2
        airborne = vehicle.startup is not None and vehicle.startup.airborne
        if vehicle.taken_over and vehicle.kind.guided_first:
            self._pilots.rest(row)
            return None
        others = vehicle.taken_over and phase in (Phase.IDENTIFYING, Phase.FLYING)
        if (phase is Phase.CONNECTING and airborne) or others:  # PX4 enters OFFBOARD only while set-points come
            return self._pilots.hover(row, vehicle, key_ms=key_ms)
        known = control.sample_ns > 0
        if phase is Phase.IDENTIFYING and self._identification is not None:
            command, commanded = self._identification.command(due_ns), True
            known = known or self._pilots.steers(row)  # the manoeuvre goes on while a clock that jumped is found again
        if not commanded or not known:
            self._pilots.rest(row)
            return None
        if not vehicle.guided:
            self._pilots.rest(row)  # what it is told shows that set-points come; it begins where the vehicle is
        velocity = control.state[2:4]
        return self._pilots.accelerate(row, vehicle, command, velocity, key_ms=key_ms, now_ns=due_ns)


def locate(
    starts: Sequence[Startup | None], frame_ned_m: list[tuple[float, float, float]], history: StateHistory
) -> None:
    """Say where each vehicle's local frame begins in that of the first one, as far as their origins are known.

    What a vehicle whose frame has moved reported before is forgotten.
    """
    first = starts[0]
    for row, startup in enumerate(starts):
        if first is None or first.origin is None or startup is None or startup.origin is None:
            continue
        north, east = between(first.origin, startup.origin)
        known_north, known_east, _ = frame_ned_m[row]
        if hypot(north - known_north, east - known_east) > _FRAME_RESOLUTION_M:
            history.forget(row)
        else:
            north, east = known_north, known_east
        frame_ned_m[row] = north, east, first.origin_altitude_m - startup.origin_altitude_m
