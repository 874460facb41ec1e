"""Selects the kind of vehicles, once, when the station is built.

Nothing else in the station reads the scenario's `dynamics`.
"""

from gcs.autopilot.fleet import AutopilotFleet
from gcs.control.fleet import Fleet
from gcs.control.own_law import FlownLaw
from gcs.link.vehicle import Report
from gcs.plan.flight_plan import FlightPlan


def fleet_of(plan: FlightPlan, report: Report, law: FlownLaw | None = None) -> Fleet:
    """The fleet for which a plan is made; `report` takes events of its vehicles as (kind, text, system id).

    `law` is the user's own control law, if it is to be flown.
    """
    return AutopilotFleet(plan, report) if plan.scenario.dynamics == "autopilot" else Fleet(plan, report, law)
