"""A leader and a follower with given gains: the cheapest formation, for tests of campaigns."""

from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from scenarios.schema import Control, FixedGains, Monitor, NominalVelocity, Scenario, Vehicle

SCENARIO = Scenario(
    name="pair",
    seed=7,
    duration_s=4.0,
    vehicles=(
        Vehicle(system_id=1, position_ne_m=(0.0, 0.0), velocity_ne_m_s=(60.0, 0.0)),
        Vehicle(
            system_id=2, follows=1, offset_ne_m=(-50.0, 50.0), position_ne_m=(-60.0, 55.0), velocity_ne_m_s=(60.0, 0.0)
        ),
    ),
    nominal_velocity=(NominalVelocity(from_s=0.0, velocity_ne_m_s=(60.0, 0.0)),),
    control=Control(gains=FixedGains(K1=-5.0, K2=0.5, K3=9.0)),
    monitor=Monitor(act=False, time_scales=(1.0,)),
)


def pair_plan() -> FlightPlan:
    _, plan = flight_plan(SCENARIO)
    return plan
