"""A leader and a follower with given gains: the cheapest formation, for tests of campaigns."""

from dataclasses import replace

from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.stress.study import Study
from gcs.stress.trial import Trial
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


def trials(count: int, *, bad: int = -1) -> list[Trial]:
    """Short own flights at different delays; one of them may have a gain matrix that does not fit."""
    study = Study(pair_plan())
    study = replace(study, plan=replace(study.plan, scenario=SCENARIO.model_copy(update={"duration_s": 1.0})))
    made = [study.trial("own", {"delay": round(0.01 * k, 3)}, seed=7) for k in range(count)]
    return [replace(trial, gain=((99, 0, 1.0),)) if k == bad else trial for k, trial in enumerate(made)]
