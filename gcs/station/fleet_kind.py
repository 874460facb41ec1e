"""What depends on the kind of vehicles: double integrators or multicopters with autopilots.

`fleet_of` chooses once, when the station is built; nothing else in the station reads the scenario's `dynamics`. Where
the loop is closed is another choice, see `gcs.control.loops`.
"""

from typing import Protocol

import numpy as np

from gains.core.arrays import FloatArray
from gcs.autopilot.fleet import AutopilotFleet
from gcs.control.history import StateHistory
from gcs.control.loops import Loop, Orders
from gcs.control.manoeuvring import loop_of
from gcs.control.own_law import FlownLaw
from gcs.control.phases import Phase, patience_s
from gcs.link.startup import LaunchedStartup
from gcs.link.vehicle import Links, RemoteVehicle, Report, in_words, new_links, refusals
from gcs.plan.flight_plan import FlightPlan
from scenarios.kernel import Records
from scenarios.schema import NS_PER_S


class FleetKind(Protocol):
    """The vehicles of one flight, in the order of the formation, and all that depends on their kind."""

    plan: FlightPlan
    """The flight plan; once the vehicles are identified, with margins for their responses."""
    vehicles: list[RemoteVehicle]
    links: Links
    loop: Loop
    frame_ned_m: FloatArray
    """Origin (n, 3) of each vehicle's local frame, in the frame of the first vehicle."""
    speaks_mavlink_1_first: bool
    """Whether a vehicle may speak MAVLink 1 until it hears MAVLink 2."""
    holds_when_left_alone: bool
    """Whether a vehicle without set-points holds its velocity; the failsafe of an autopilot may be to fly on."""

    @property
    def is_usual(self) -> bool:
        """Whether steps may be usual: see `gcs.station.usual`."""
        ...

    @property
    def identified(self) -> bool:
        """Whether the response of every vehicle is known."""
        ...

    def startup_failure(self, due_ns: int, start_ns: int, history: StateHistory) -> str:
        """Why the flight cannot begin: a vehicle cannot be flown, or took too long. Empty while it still may begin.

        Vehicles that others can fly without are left out, and what they reported is forgotten.
        """
        ...

    def begin(self) -> None:
        """The vehicles are ready: report what is known of them."""
        ...

    def end(self) -> None:
        """The flight ends: report what was counted."""
        ...

    def bound(self, controls: Records, blends: Records) -> None:
        """Limit the commands of the control law to what the vehicles are known to follow."""
        ...

    def locate(self, history: StateHistory) -> None:
        """Update `frame_ned_m` as the origins of the vehicles' frames become known."""
        ...

    def identify(self, due_ns: int, history: StateHistory) -> str:
        """Advance the identification by one tick; returns why it failed, if it has."""
        ...

    def set_points(self, orders: Orders, phase: Phase) -> Records:
        """The set-points of this tick (n, SET_POINT), and which vehicles are sent one."""
        ...


def fleet_of(plan: FlightPlan, report: Report, law: FlownLaw | None = None) -> FleetKind:
    """The fleet that a plan is made for; `report` takes events of its vehicles as (kind, text, system id).

    `law` is the user's own control law, if it is to be flown.
    """
    return AutopilotFleet(plan, report) if plan.scenario.dynamics == "autopilot" else LaunchedFleet(plan, report, law)


class LaunchedFleet:
    """Vehicles that are in the air from the beginning, in one frame."""

    speaks_mavlink_1_first = False
    holds_when_left_alone = True
    identified = True

    @property
    def is_usual(self) -> bool:
        return type(self.loop) is Loop

    def __init__(self, plan: FlightPlan, report: Report, law: FlownLaw | None = None) -> None:
        scenario = plan.scenario
        self.plan = plan
        self._law = law
        self.loop = loop_of(plan, law)
        self.links = new_links(len(plan.formation.system_ids))
        self.vehicles = [
            RemoteVehicle(
                system_id,
                startup=LaunchedStartup(
                    scenario.rates.telemetry_hz, self.loop.parameters(system_id), target_hz=scenario.target_hz
                ),
                report=report,
                land=scenario.at_end == "land",
                external=system_id == scenario.external_id,
                links=self.links,
                row=row,
            )
            for row, system_id in enumerate(plan.formation.system_ids)
        ]
        self.frame_ned_m = np.zeros((len(self.vehicles), 3))
        self._patience_ns = patience_s(scenario) * NS_PER_S

    def startup_failure(self, due_ns: int, start_ns: int, history: StateHistory) -> str:  # noqa: ARG002
        late = [v for v in self.vehicles if not v.ready] if due_ns - start_ns > self._patience_ns else []
        return refusals(self.vehicles) or in_words("not ready: ", late)

    def begin(self) -> None:
        """Nothing to report."""

    def end(self) -> None:
        if self._law is not None:
            self._law.report()

    def bound(self, controls: Records, blends: Records) -> None:
        """Nothing to do: they follow any command within the scenario's limits."""

    def locate(self, history: StateHistory) -> None:
        """Nothing to do: all frames are the same."""

    def identify(self, due_ns: int, history: StateHistory) -> str:  # noqa: ARG002 - their response is known
        return ""

    def set_points(self, orders: Orders, phase: Phase) -> Records:
        del phase  # they take set-points in formation flight only
        return self.loop.set_points(orders)
