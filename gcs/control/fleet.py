"""The vehicles of one flight, and all that depends on their kind: here double integrators, launched in the air.

`gcs.autopilot.fleet` has multicopters with autopilots. Where the loop is closed is another choice, see
`gcs.control.loops`.
"""

from collections.abc import Sequence

import numpy as np

from gcs.control.history import StateHistory
from gcs.control.loops import Loop, Orders
from gcs.control.manoeuvring import loop_of
from gcs.control.own_law import FlownLaw
from gcs.control.phases import Phase, patience_s
from gcs.link.startup import LaunchedStartup, Startup
from gcs.link.vehicle import RemoteVehicle, Report, in_words, new_links, refusals
from gcs.plan.flight_plan import FlightPlan
from scenarios.kernel import Records
from scenarios.schema import NS_PER_S


class Fleet:
    """The vehicles of one flight, in the order of the formation: in the air from the beginning, in one frame.

    `report` takes events of vehicles as (kind, text, system id). `law` is the user's own control law, if it is flown.
    `starts` is the start-up of each vehicle that is not in the air yet.
    """

    speaks_mavlink_1_first = False
    """Whether a vehicle may speak MAVLink 1 until it hears MAVLink 2."""
    holds_when_left_alone = True
    """Whether a vehicle without set-points holds its velocity; the failsafe of an autopilot may be to fly on."""

    def __init__(
        self, plan: FlightPlan, report: Report, law: FlownLaw | None = None, starts: Sequence[Startup] = ()
    ) -> None:
        scenario, ids = plan.scenario, plan.formation.system_ids
        self.plan = plan
        """The flight plan; once the vehicles are identified, with margins for their responses."""
        self.loop = loop_of(plan, law)
        self.is_usual = type(self.loop) is Loop and not starts
        """Whether steps may be usual: see `gcs.station.usual`."""
        launched = (
            LaunchedStartup(scenario.rates.telemetry_hz, self.loop.parameters(key), target_hz=scenario.target_hz)
            for key in ids
        )
        self.links = new_links(len(ids))
        self.vehicles = [
            RemoteVehicle(
                system_id,
                startup=startup,
                report=report,
                land=scenario.at_end == "land",
                external=system_id == scenario.external_id,
                holds=scenario.control.execute_at,
                links=self.links,
                row=row,
            )
            for row, (system_id, startup) in enumerate(zip(ids, starts or launched, strict=True))
        ]
        self.frame_ned_m = np.zeros((len(ids), 3))
        """Origin (n, 3) of each vehicle's local frame, in the frame of the first vehicle."""
        self._law, self._patience_ns = law, patience_s(scenario) * NS_PER_S

    @property
    def identified(self) -> bool:
        """Whether the response of every vehicle is known."""
        return True

    def startup_failure(self, due_ns: int, start_ns: int, history: StateHistory) -> str:  # noqa: ARG002
        """Why the flight cannot begin: a vehicle cannot be flown, or took too long. Empty while it still may begin.

        Vehicles that others can fly without are left out, and what they reported is forgotten.
        """
        late = [v for v in self.vehicles if not v.ready] if due_ns - start_ns > self._patience_ns else []
        return refusals(self.vehicles) or in_words("not ready: ", late)

    def begin(self) -> None:
        """The vehicles are ready: report what is known of them."""

    def end(self) -> None:
        """The flight ends: report what was counted."""
        if self._law is not None:
            self._law.report()

    def bound(self, controls: Records, blends: Records) -> None:
        """Limit the commands of the control law to what the vehicles are known to follow: here all within the limits
        of the scenario."""

    def locate(self, history: StateHistory) -> None:
        """Update `frame_ned_m` as the origins of the vehicles' frames become known."""

    def identify(self, due_ns: int, history: StateHistory) -> str:  # noqa: ARG002 - their response is known
        """Advance the identification by one tick; returns why it failed, if it has."""
        return ""

    def set_points(self, orders: Orders, phase: Phase) -> Records:
        """The set-points of this tick (n, SET_POINT), and which vehicles are sent one."""
        del phase  # they take set-points in formation flight only
        return self.loop.set_points(orders)
