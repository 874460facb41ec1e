"""A vehicle that never becomes ready, or that the user leaves out, does not keep the others from flying."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gcs.control.phases import Phase
from gcs.control.tick import Mode
from gcs.drive.lockstep import START_NS
from gcs.plan.planner import flight_plan
from gcs.runs.summary import verdict
from gcs.station.absence import LEFT_OUT
from gcs.station.station import Station
from scenarios.keys.link import Link, Outage, VehicleLinks
from scenarios.left_out import without
from scenarios.schema import NominalVelocity, Scenario
from tests.support.fleets.flown_copters import TRUTH, Flight, fly, plan_for, three
from tests.support.station_peer import Peer

DEAD = Link(loss_probability=1.0)


def lacking(system_id: int, link: Link = DEAD, *, patience_s: float = 20.0, **changes: Any) -> Scenario:
    """Three copters, one of them on a link of its own, which by default loses every datagram."""
    scenario = three(**changes)
    own = VehicleLinks(system_id=system_id, up=link, down=link)
    return scenario.model_copy(
        update={
            "links": scenario.links.model_copy(update={"vehicles": (own,), "times_from": "start"}),
            "safety": scenario.safety.model_copy(update={"ready_patience_s": patience_s}),
        }
    )


def began_s(flight: Flight) -> float:
    return float(flight.flown["due_ns"][0] - START_NS) * 1e-9


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_others_fly_without_a_vehicle_that_is_never_heard(flavour: str) -> None:
    flight = fly(plan_for(lacking(3, flavour=flavour)))
    assert flight.station.end_reason == "left out: vehicles 3"
    assert verdict(flight.station.end_reason, 1.0) == "aborted"  # a gate must notice
    assert flight.error_m(2)[-1] < 0.17
    assert 27.0 < began_s(flight) < 37.0  # the patience, then run-up and manoeuvre of the others
    found, others = flight.station.plan, fly(plan_for(three(duration_s=1.0))).station.plan
    assert found.responses is not None
    assert sorted(found.responses.of) == [1, 2]
    assert found.margins_s == pytest.approx(others.margins_s, rel=0.01)  # all respond alike
    assert flight.texts("vehicle").count("is left out: not heard") == 1
    rows = flight.ticks[flight.ticks["system_id"] == 3]
    assert not rows["commanded"].any()


def test_follower_of_a_left_out_vehicle_keeps_both_offsets() -> None:
    flight = fly(plan_for(lacking(2)))
    assert flight.station.end_reason == "left out: vehicles 2"
    last = {k: flight.flown[flight.flown["system_id"] == k][-1] for k in (1, 3)}
    apart = [float(last[3][name] - last[1][name]) for name in ("north_m", "east_m")]
    assert apart == pytest.approx([-24.0, 24.0], abs=0.2)


def test_without_the_leader_the_others_hold_the_nominal_velocity() -> None:
    flight = fly(plan_for(lacking(1)))
    assert flight.station.end_reason == "left out: vehicles 1"
    last = {k: flight.flown[flight.flown["system_id"] == k][-1] for k in (2, 3)}
    assert float(last[2]["velocity_north_m_s"]) == pytest.approx(4.0, abs=0.05)
    assert flight.error_m(3)[-1] < 0.17


def test_a_vehicle_that_fell_silent_climbing_is_left_alone() -> None:
    """It may be anywhere: it counts in no collision, and is sent no command when it is heard again."""
    gone = Link(delay_s=0.02, outages=(Outage(from_s=6.0, until_s=40.0),))
    scenario = lacking(3, gone, duration_s=30.0).model_copy(update={"response": TRUTH})
    flight = fly(plan_for(scenario))
    assert flight.station.end_reason == "left out: vehicles 3"
    assert not flight.ticks["commanded"][flight.ticks["system_id"] == 3].any()
    assert "is left out: is silent" in flight.texts("vehicle")
    assert LEFT_OUT in flight.texts("vehicle")
    assert flight.copter(3).mode == flight.copter(3).rules.hold_mode  # at the end it is told to hold, like the others


def test_a_left_out_vehicle_that_is_heard_is_not_lost() -> None:
    """It is heard but hears nothing itself, so that it never arms."""
    scenario = lacking(3, duration_s=1.0)
    deaf = VehicleLinks(system_id=3, down=Link(delay_s=0.02, outages=(Outage(from_s=2.0, until_s=1e6),)))
    links = scenario.links.model_copy(update={"vehicles": (deaf,)})
    flight = fly(plan_for(scenario.model_copy(update={"links": links})))
    assert flight.station.end_reason == "left out: vehicles 3"
    modes = flight.flown["mode"][flight.flown["system_id"] == 3]
    assert (modes[1:] == Mode.FAILSAFE).all()  # the first tick still has the modes of the phase before


def test_nobody_ready_is_no_flight() -> None:
    scenario = lacking(3, patience_s=10.0, ready_after_s=1e6)
    flight = fly(plan_for(scenario))
    assert flight.station.end_reason.startswith("not ready: vehicle 1 has no position yet")
    assert not flight.ticks["commanded"].any()


def test_formation_without_left_out_vehicles_is_flown_as_its_own() -> None:
    scenario = without(three(), [2], Path("copters5.toml"))
    design, plan = flight_plan(scenario)
    flight = fly(plan)
    assert flight.station.end_reason == "completed: duration reached"
    assert plan.formation.system_ids == (1, 3)
    assert flight.error_m(3)[-1] < 0.34  # 1 % of 34 m
    assert design.delay_margin_s == pytest.approx(plan.delay_margin_s)


def test_copters_stand_in_formation_at_zero_velocity() -> None:
    standing = (NominalVelocity(from_s=0.0, velocity_ne_m_s=(0.0, 0.0)),)
    scenario = three(duration_s=20.0).model_copy(update={"nominal_velocity": standing})
    flight = fly(plan_for(scenario))
    assert flight.station.end_reason == "completed: duration reached"
    late = flight.flown[flight.flown["time_s"] > 18.0]
    assert np.hypot(late["velocity_north_m_s"], late["velocity_east_m_s"]).max() < 0.05
    assert max(float(flight.error_m(k)[-1]) for k in (2, 3)) < 0.17


def test_copters_stop_in_flight_and_fly_on() -> None:
    speeds = ((0.0, 4.0), (5.0, 0.0), (15.0, 4.0))
    steps = tuple(NominalVelocity(from_s=at_s, velocity_ne_m_s=(north, 0.0)) for at_s, north in speeds)
    flight = fly(plan_for(three(duration_s=25.0).model_copy(update={"nominal_velocity": steps})))
    assert flight.station.end_reason == "completed: duration reached"
    for at_s, speed in ((14.0, 0.0), (24.0, 4.0)):
        rows = flight.flown[np.abs(flight.flown["time_s"] - at_s) < 0.011]
        assert rows["velocity_north_m_s"].tolist() == pytest.approx([speed] * len(rows), abs=0.1)


def test_patience_ignores_datagrams_that_arrived_before_the_start() -> None:
    station = Station(plan_for(lacking(3, patience_s=8.0)), start_ns=START_NS)
    peers = [Peer(k, 5000 + k) for k in (1, 2, 3)]
    waited = [peer.heartbeat(START_NS - before_ns) for before_ns in (30_000_000_000, 1_000_000) for peer in peers]
    for step in range(10):
        station.step(waited if step == 0 else [], station.next_event_ns)
    assert [event.text for event in station.events] == ["found"] * 3
    assert station.phase is Phase.CONNECTING
