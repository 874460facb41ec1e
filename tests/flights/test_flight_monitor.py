"""The monitor in flight, in virtual time: it warns before errors grow, and its actions keep the formation stable.

`MONITOR_SEEDS=200 python3 make.py test tests/flights/test_flight_monitor.py` flies as many seeds; a few are flown by
default.
"""

import os
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.control.tick import Event, Mode, TickArray
from gcs.drive.flown import fly_plan
from gcs.drive.lockstep import START_NS, Sent, Vehicles, fly_lockstep, vehicles_of
from gcs.link import mavlink
from gcs.plan.at_delay import figures_at
from gcs.plan.design import Design
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.runs.summary import summarise
from gcs.station.station import Station
from scenarios.files import load
from scenarios.keys.link import Jitter, Link, Links
from scenarios.schema import Monitor, Safety
from tests.support.fleets.delay_ramp import ramp
from tests.support.known import known
from tests.support.paths import SCENARIOS

TRIANGLE = load(SCENARIOS / "triangle5.toml")
SEEDS = range(int(os.environ.get("MONITOR_SEEDS", "3")))
QUIET_S = 8.0
"""The formation has settled by then."""


@cache
def planned() -> FlightPlan:
    return flight_plan(TRIANGLE)[1]


def flown(**changes: Any) -> tuple[TickArray, Station]:
    plan = replace(planned(), scenario=TRIANGLE.model_copy(update=changes))
    station = Station(plan, start_ns=START_NS)
    return np.concatenate(list(fly_lockstep(plan, station=station))), station


def error_m(ticks: TickArray) -> Any:
    error = np.hypot(ticks["spacing_error_north_m"], ticks["spacing_error_east_m"])
    return np.where((ticks["time_s"] > QUIET_S) & ticks["commanded"], error, np.nan)


def first_time_s(station: Station, mode: Mode) -> float:
    return min(e.time_s for e in station.events if e.kind == "mode" and e.text.endswith(f"-> {mode.name}"))


@pytest.mark.slow(first=1)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_monitored_formation_survives_three_times_its_first_margin(seed: int) -> None:
    shipped = load(SCENARIOS / "delay_ramp.toml")
    assert (shipped.duration_s, shipped.links) == (75.0, ramp(0.44))
    ticks, station = flown(seed=seed, duration_s=75.0, links=ramp(0.44))
    assert station.end_reason == "completed: duration reached"
    assert np.nanmax(ticks["loop_delay_s"]) > 2.9 * planned().delay_margin_s
    assert np.nanmax(error_m(ticks)) < 0.01 * 172.4  # of the spacing
    last = ticks[ticks["time_s"] < 75.0][-5:]
    assert set(last["mode"]) == {Mode.NOMINAL}  # all the way back
    assert set(last["gain_set"]) == {0}


@pytest.mark.parametrize("seed", SEEDS)
def test_without_action_caution_and_critical_precede_error_and_break(seed: int) -> None:
    ticks, station = flown(seed=seed, duration_s=75.0, links=ramp(0.44), monitor=Monitor(act=False))
    assert station.end_reason.startswith("broken")
    out_s = float(ticks["time_s"][error_m(ticks) > 0.01 * 172.4].min())
    assert first_time_s(station, Mode.CAUTION) < first_time_s(station, Mode.CRITICAL) < out_s


@pytest.mark.parametrize("seed", sorted({*SEEDS, 105}))  # 105: slow telemetry before the flight was judged
def test_no_false_alarm_in_a_nominal_flight_with_jitter(seed: int) -> None:
    """20 ms each way, and 10 ms of exponential jitter on top of each: a loop delay of about 80 ms against 300 ms."""
    link = Link(delay_s=0.02, jitter=Jitter(distribution="exponential", scale_s=0.01))
    ticks, station = flown(seed=seed, duration_s=20.0, links=Links(up=link, down=link))
    assert station.end_reason == "completed: duration reached"
    assert set(ticks[(ticks["time_s"] > 0.1) & (ticks["time_s"] < 20.0)]["mode"]) == {Mode.NOMINAL}


def test_gains_change_without_a_jump_in_command() -> None:
    ticks, _ = flown(seed=1, duration_s=75.0, links=ramp(0.44))
    for system_id in (1, 2, 3, 4, 5):
        own = ticks[(ticks["system_id"] == system_id) & ticks["commanded"] & (ticks["time_s"] > QUIET_S)]
        changes = np.flatnonzero(np.diff(own["gain_set"].astype(int))) + 1
        assert changes.size == 4
        jump = np.abs(np.diff(own["command_north_m_s2"]))
        around = [float(jump[k - 1]) for k in changes]
        # The step is no larger than the command's steps in the second around it.
        for k, step in zip(changes.tolist(), around, strict=True):
            assert step <= 1.5 * float(np.max(np.delete(jump[k - 25 : k + 25], 24))) + 1e-3


def test_slowest_gains_without_headroom_release_vehicles_into_failsafe() -> None:
    # Released while the formation opens, vehicles drift apart; on the way back their spacing errors are large.
    safety = Safety(spacing_error_limit_m=2000.0)
    ticks, station = flown(seed=1, duration_s=90.0, links=ramp(0.9), safety=safety)
    assert station.end_reason == "completed: duration reached"
    modes = {Mode(int(mode)) for mode in np.unique(ticks["mode"])}
    assert Mode.FAILSAFE in modes
    assert float(np.nanmin(ticks["nearest_m"])) > 50.0
    last = ticks[ticks["time_s"] < 90.0][-5:]
    assert set(last["mode"]) <= {Mode.NOMINAL, Mode.CAUTION, Mode.RECOVERING}


@dataclass
class Overheard:
    """Vehicles, and all that the station sends them."""

    vehicles: Vehicles
    sent: list[bytes] = field(default_factory=list)

    def step(self, received: Sent, now_ns: int) -> Sent:
        self.sent += [data for _, data, _ in received]
        return self.vehicles.step(received, now_ns)


def test_mode_and_gain_changes_are_events_and_statustexts() -> None:
    plan = replace(planned(), scenario=TRIANGLE.model_copy(update={"duration_s": 45.0, "links": ramp(0.44)}))
    station, vehicles = Station(plan, start_ns=START_NS), Overheard(vehicles_of(plan.scenario))
    for _ in fly_lockstep(plan, station=station, vehicles=vehicles):
        pass
    changes = [
        f"vehicle {e.system_id}: {e.text.split('-> ')[-1].split(',')[0]}"
        for e in station.events
        if e.kind in ("mode", "gains")
    ]
    assert sum("gain set" in change for change in changes) > 5
    parsed = [dialect.MAVLink(None).parse_buffer(data) or [] for data in vehicles.sent]  # pymavlink's check
    messages: list[Any] = [message for some in parsed for message in some]
    told = [message for message in messages if message.get_type() == "STATUSTEXT"]
    # Messages about changes in the flight's last tick are not seen here.
    assert [message.text for message in told] == changes[: len(told)]
    assert len(told) >= len(changes) - len(plan.formation.system_ids)
    assert {m.severity for m in told if m.text.endswith("CRITICAL")} == {dialect.MAV_SEVERITY_CRITICAL}
    assert {m.severity for m in told if m.text.endswith("CAUTION")} == {dialect.MAV_SEVERITY_WARNING}


@dataclass
class Unanswering:
    """Vehicles, one of which loses its TIMESYNC replies from a time on: all of them or a share."""

    vehicles: Vehicles
    system_id: int
    share: float
    from_ns: int
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))

    def step(self, received: Sent, now_ns: int) -> Sent:
        return [
            (system_id, data, time_ns)
            for system_id, data, time_ns in self.vehicles.step(received, now_ns)
            if system_id != self.system_id
            or time_ns < self.from_ns
            or {frame.msg_id for frame in mavlink.decode(data, Counter())} != {mavlink.TIMESYNC}
            or self.rng.random() >= self.share
        ]


@pytest.mark.parametrize(("share", "tells"), [(1.0, True), (0.3, False)])
def test_a_vehicle_that_answers_no_timesync_is_critical(share: float, tells: bool) -> None:
    """Its loop delay may have any value. Occasional lost replies do not count."""
    plan = replace(planned(), scenario=TRIANGLE.model_copy(update={"duration_s": 40.0}))
    station = Station(plan, start_ns=START_NS)
    vehicles = Unanswering(vehicles_of(plan.scenario), 5, share, START_NS + 12_000_000_000)
    ticks = np.concatenate(list(fly_lockstep(plan, station=station, vehicles=vehicles)))
    told = [e for e in station.events if e.text == "does not answer TIMESYNC: its loop delay is unknown"]
    assert [e.system_id for e in told] == ([5] if tells else [])
    late = ticks[(ticks["system_id"] == 5) & (ticks["time_s"] > 15.0) & ticks["commanded"]]
    assert set(late["mode"]) == {Mode.CRITICAL if tells else Mode.NOMINAL}
    assert np.isnan(late["headroom"]).all() == tells
    others = ticks[(ticks["system_id"] != 5) & (ticks["time_s"] > 15.0) & ticks["commanded"]]
    assert set(others["mode"]) == {Mode.NOMINAL}
    events = [*station.events, Event(time_s=0.0, kind="end", text=station.end_reason)]
    assert summarise(plan.scenario, Design(delay_margin_s=0.3), ticks, events).verdict == (
        "unknown" if tells else "stable"
    )


def test_a_collision_breaks_the_flight_and_least_distance_is_summarised() -> None:
    # From the first tick of the flight on, vehicles are nearer to each other than allowed.
    ticks, station = flown(duration_s=5.0, safety=Safety(collision_distance_m=180.0))
    assert station.end_reason.startswith("broken: vehicles")
    assert "have collided" in station.end_reason
    events = [Event(time_s=0.0, kind="end", text=station.end_reason)]
    summary = summarise(planned().scenario, Design(delay_margin_s=0.3), ticks, events)
    assert summary.verdict == "unstable"
    assert 0.0 < known(summary.distance_min_m) < 180.0


def test_alpha_of_a_flight_is_that_of_gains_flown_longest() -> None:
    late = load(SCENARIOS / "chain3.toml").with_link_delay(up_s=0.17, down_s=0.17)
    designed, plan = flight_plan(late.model_copy(update={"duration_s": 20.0}))
    flight = fly_plan(plan)
    found = summarise(plan.scenario, designed, flight.ticks, flight.events).at_loop_delay
    longest = int(np.bincount(flight.ticks["gain_set"][flight.ticks["commanded"]]).argmax())
    assert longest > 0
    assert figures_at(designed, late, found.loop_delay_s).alpha == 0.0  # of the first gains, beyond their margin
    assert known(found.alpha) > 0.1
    assert found == figures_at(designed, late, found.loop_delay_s, longest)
