"""Flights that feed forward a share of the command in front: errors do not grow down the chain; the margin is kept."""

from functools import cache

import numpy as np
import pytest

from gains.criteria.predicted import PredictedFigures
from gains.performance.scalar_gains import PAIR, ScalarGains
from gcs.control.tick import TickArray
from gcs.drive.flown import fly_plan
from gcs.plan.at_delay import figures_at
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.stress.axes import at_coordinates
from gcs.stress.measure import fly_trial
from gcs.stress.study import Study
from scenarios.files import load
from scenarios.schema import Control, FixedGains, NominalVelocity, Scenario, Vehicle
from tests.support.known import known
from tests.support.paths import SCENARIOS

CHAIN = load(SCENARIOS / "chain3.toml")
K1, K3 = 3.408, 5.608


def scenario(share: float, K2: float | None) -> Scenario:
    """With given gains, or with designed ones if K2 is None."""
    wanted = {"delay_margin_s": 0.3} if K2 is None else {"gains": FixedGains(K1=-K1, K2=K2, K3=K3)}
    control = Control.model_validate(wanted | {"feed_forward": share})
    return CHAIN.model_copy(update={"control": control})


@cache
def planned(share: float, K2: float) -> FlightPlan:
    return flight_plan(scenario(share, K2).with_calm_monitor())[1]


def stepped(share: float, K2: float | None, *, link_s: float, leader_m_s: float = 0.0) -> TickArray:
    """A flight in place: the nominal velocity steps by 2 m/s, or with `leader_m_s` = 2 the leader alone is faster."""
    speed = CHAIN.nominal_velocity[0].velocity_ne_m_s[0]
    steps = tuple(
        NominalVelocity(from_s=t, velocity_ne_m_s=(v, 0.0)) for t, v in ((0.0, speed), (2.0, speed + 2.0 - leader_m_s))
    )
    plan = flight_plan(at_coordinates(scenario(share, K2), {"delay": link_s}))[1]
    place, [leader] = plan.formation.place_ne_m(), [v for v in CHAIN.vehicles if v.follows is None]

    def placed(vehicle: Vehicle) -> Vehicle:
        position = np.array(leader.position_ne_m) + place[plan.formation.row(vehicle.system_id)]
        own = speed + (leader_m_s if vehicle is leader else 0.0)
        return vehicle.model_copy(update={"position_ne_m": tuple(position.tolist()), "velocity_ne_m_s": (own, 0.0)})

    vehicles = tuple(placed(vehicle) for vehicle in CHAIN.vehicles)
    update = {"nominal_velocity": steps, "vehicles": vehicles, "duration_s": 12.0}
    changed = plan.scenario.model_copy(update=update)
    return fly_plan(flight_plan(changed)[1]).ticks


def peaks_m(ticks: TickArray) -> list[float]:
    """The largest spacing error of each follower, in the order of the chain."""
    flown = ticks[ticks["time_s"] > 2.0]
    error = np.hypot(flown["spacing_error_north_m"], flown["spacing_error_east_m"])
    return [float(error[flown["system_id"] == v.system_id].max()) for v in CHAIN.leader_first()[1:]]


def sizes_m(ticks: TickArray) -> list[float]:
    """The rms spacing error of each follower, in the order of the chain: string peaks bound how this grows."""
    flown = ticks[ticks["time_s"] > 0.5]  # the first set-points have arrived
    error = np.hypot(flown["spacing_error_north_m"], flown["spacing_error_east_m"])
    return [float(np.sqrt((error[flown["system_id"] == v.system_id] ** 2).mean())) for v in CHAIN.leader_first()[1:]]


def test_copying_the_vehicle_in_front_keeps_distance_at_any_delay() -> None:
    alike = peaks_m(stepped(1.0, K1, link_s=0.25))
    apart = peaks_m(stepped(0.0, K1, link_s=0.25))
    assert max(alike) < 2.0 * 2.0 * 0.04  # a step of 2 m/s, at which each of two vehicles may be two ticks apart
    assert min(apart) > 3.0 * max(alike)


def test_behind_a_disturbed_leader_errors_never_grow_down_the_chain() -> None:
    """With k_ff = 0.9 and k2 = 3.13 the peak is 1.00 up to 0.25 s: docs/explanation/prediction.md."""
    first, second = sizes_m(stepped(0.9, 3.13, link_s=0.23, leader_m_s=2.0))
    assert second < first
    first, second = sizes_m(stepped(0.0, 0.631, link_s=0.23, leader_m_s=2.0))
    assert second > 1.2 * first


def test_feed_forward_changes_neither_margin_nor_growth_of_a_loop() -> None:
    plan, bare = planned(0.9, 3.13), planned(0.0, 3.13)
    assert plan.delay_margin_s == bare.delay_margin_s
    assert np.abs(plan.gain - bare.gain).max() > 1.0
    fed, without = (fly_trial(Study(p).trial("probe", {"delay": 0.27}, seed=1)) for p in (plan, bare))
    assert known(fed.growth_1_s) == pytest.approx(known(fed.predicted_growth_1_s), abs=5e-3)
    assert fed.predicted_growth_1_s == without.predicted_growth_1_s


def test_designed_gains_keep_errors_from_growing_at_long_delay() -> None:
    """At 0.23 s of link delay; there the gains designed without feed-forward let them grow 2.2 times."""
    first, second = sizes_m(stepped(0.9, None, link_s=0.23, leader_m_s=2.0))
    assert second < first
    first, second = sizes_m(stepped(0.0, None, link_s=0.23, leader_m_s=2.0))
    assert second > 1.2 * first


def test_figures_at_a_delay_are_the_fed_forward_loops() -> None:
    flown = scenario(0.9, 3.13)
    found = figures_at(flight_plan(flown)[0], flown, 0.25)
    K, period_s = ScalarGains(K1, 3.13, K3, 0.0).K, 1.0 / flown.rates.control_hz
    loop = PredictedFigures(PAIR, K, period_s, 0.0, (0.25,), chain=True, feed_forward=0.9)
    assert found.string_peak == pytest.approx(loop.string_peak)
    assert found.alpha == pytest.approx(loop.alpha_at_delay)
    bare = scenario(0.0, 0.631)
    assert known(figures_at(flight_plan(bare)[0], bare, 0.25).string_peak) > 2.0
