"""The vehicles of one flight and everything that depends on their kind: here double integrators, launched in the air.

`gcs.autopilot.fleet` has multicopters with autopilots. Where the loop is closed is a separate choice, made in
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
    """The vehicles of one flight, in formation order: in the air from the beginning, in one common frame.

    `report` takes events of vehicles as (kind, text, system id). `law` is the user's own control law, if it is flown.
    `starts` holds each vehicle's start-up if they begin on the ground. For `strangers` see `Startup.stranger`.
    """

    speaks_mavlink_1_first = False
    """Whether a vehicle may speak MAVLink 1 until it hears MAVLink 2."""
    together_ns = 20_000_000
    """Longest time that a datagram may wait to be read together with others. Reading late delays only answers: stamps
    say when datagrams arrived, and decisions fall at ticks."""
    holds_when_left_alone = True
    """Whether a vehicle without set-points holds its velocity; an autopilot's failsafe may be to fly on."""

    def __init__(
        self,
        plan: FlightPlan,
        report: Report,
        law: FlownLaw | None = None,
        starts: Sequence[Startup] = (),
        *,
        strangers: bool = False,
    ) -> None:
        scenario, ids = plan.scenario, plan.formation.system_ids
        self.plan = plan
        """The flight plan; after identification, with margins for the identified responses."""
        self.loop = loop_of(plan, law)
        self.has_fast_path = type(self.loop) is Loop and not starts
        """Whether steps may take the fast path, `gcs.station.fast_path`."""
        launched = (
            LaunchedStartup(
                scenario.rates.telemetry_hz,
                self.loop.parameters(key),
                target_hz=scenario.target_hz,
                stranger=strangers and key != scenario.external_id,
            )
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
        """Why the flight cannot begin: a vehicle is refused, or took too long. Empty while it still may begin.

        A fleet that can fly without its late vehicles leaves them out and drops their reports from `history`.
        """
        late = [v for v in self.vehicles if not v.ready] if due_ns - start_ns > self._patience_ns else []
        return refusals(self.vehicles) or in_words("not ready: ", late)

    def begin(self) -> None:
        """Called when the vehicles are ready, to report what is known of them."""

    def end(self) -> None:
        """Called when the flight ends, to report what was counted."""
        if self._law is not None:
            self._law.report()

    def bound(self, controls: Records, blends: Records) -> None:
        """Limit the control law's commands to what the vehicles can follow: for these, scenario limits suffice."""

    def locate(self, history: StateHistory) -> None:
        """Update `frame_ned_m` once the origins of the vehicles' frames become known."""

    def identify(self, due_ns: int, history: StateHistory) -> str:  # noqa: ARG002 - their response is known
        """Advance the identification by one tick; returns why it failed, if it has."""
        return ""

    def set_points(self, orders: Orders, phase: Phase) -> Records:
        """The set-points of this tick (n, SET_POINT); `sent` marks the vehicles that get one."""
        del phase  # these vehicles take set-points in formation flight only
        return self.loop.set_points(orders)
