"""Selects the kind of vehicles, once, when the station is built.

Nothing else in the station reads the scenario's `dynamics`.
"""

from gcs.autopilot.fleet import AutopilotFleet
from gcs.control.fleet import Fleet
from gcs.control.own_law import FlownLaw
from gcs.link.vehicle import Report
from gcs.plan.flight_plan import FlightPlan


def fleet_of(plan: FlightPlan, report: Report, law: FlownLaw | None = None, *, strangers: bool = False) -> Fleet:
    """The fleet for a plan; `report` takes events of its vehicles as (kind, text, system id).

    `law` is the user's own control law, if it is flown. With `strangers`, vehicles must say that they are simulated,
    unless the plan is for vehicles with autopilots.
    """
    if plan.scenario.dynamics == "autopilot":
        return AutopilotFleet(plan, report)
    return Fleet(plan, report, law, strangers=strangers)
