"""A telemetry log alone gives the figures of its flight."""

from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gcs.control.tick import Event, TickArray
from gcs.drive.lockstep import START_NS, Sent, Vehicles, fly_lockstep
from gcs.link import mavlink
from gcs.plan.design import Design
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan, over_own_links
from gcs.runs.summary import summarise
from gcs.runs.summary_record import Summary
from gcs.station.absence import COMPLETED
from gcs.station.station import Station
from gcs.watch.rebuild import rebuild
from gcs.watch.rebuild_report import LogSource, rebuild_report
from gcs.watch.tlog import parse_tlog
from scenarios.files import load
from scenarios.keys.course import Course
from scenarios.keys.link import Link, Links, VehicleLinks
from scenarios.schema import NS_PER_S, NominalVelocity, Scenario
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.vehicles.copter_rules import RULES
from tests.support.fleets.delay_ramp import ramp
from tests.support.fleets.flown_copters import plan_for
from tests.support.fleets.logged_flight import EPOCH_NS, Logged, flown, log_bytes
from tests.support.fleets.pilots import PilotsVehicle, flight_s
from tests.support.fleets.pilots import flown as pilots_flight
from tests.support.known import known
from tests.support.paths import SCENARIOS

pytestmark = pytest.mark.xdist_group("rebuild")  # they share flights

FLIGHTS: dict[str, tuple[str, float, float | None]] = {
    "chain3": ("chain3", 6.0, None),
    "broken": ("triangle5", 10.0, 0.4),
    "jitter and loss": ("wifi_bursts", 8.0, None),
    "gains change": ("triangle5", 40.0, None),
    "autopilots": ("copters5", 5.0, None),
    "loops on board": ("chain3", 5.0, None),
    "predicted on board": ("chain3", 5.0, 0.1),
    "links that differ": ("chain3_bidirectional", 8.0, None),
}
"""Scenario, duration in s, link delay in s."""
MICROSECOND = 2e-6
"""Times in a log are whole µs, and a delay is the difference of two."""


def scenario_of(flight: str) -> Scenario:
    name, duration_s, delay_s = FLIGHTS[flight]
    scenario = load(SCENARIOS / f"{name}.toml").model_copy(update={"duration_s": duration_s})
    if flight == "gains change":
        return scenario.model_copy(update={"links": ramp(0.44)})
    if flight == "links that differ":
        quick, slow = Link(delay_s=0.02), Link(delay_s=0.12)
        unlike = Links(up=quick, down=quick, vehicles=(VehicleLinks(system_id=3, up=slow, down=slow),))
        return scenario.model_copy(update={"links": unlike})
    if flight.endswith("on board"):
        prediction = 0.2 if flight.startswith("predicted") else "off"
        changed = {"loop": "onboard", "prediction": prediction}
        scenario = scenario.model_copy(update={"control": scenario.control.model_copy(update=changed)})
    return scenario if delay_s is None else scenario.with_link_delay(up_s=delay_s, down_s=delay_s)


@cache
def both(flight: str) -> tuple[Summary, Summary]:
    """The summary of a flight, and the one made of its log."""
    scenario = scenario_of(flight)
    design, summary, _, entries = flown(scenario)
    rebuilt = rebuild_report(parse_tlog(log_bytes(entries)), LogSource(Path("flight.tlog"), scenario, design, None))
    assert rebuilt.flight is not None
    return summary, rebuilt.flight


@pytest.mark.parametrize("flight", FLIGHTS)
def test_verdict_reason_and_ticks_are_those_of_the_flight(flight: str) -> None:
    summary, rebuilt = both(flight)
    assert rebuilt.verdict == summary.verdict
    assert rebuilt.reason == summary.reason
    assert rebuilt.settling_time_s == summary.settling_time_s
    assert rebuilt.control is not None
    assert summary.control is not None
    assert rebuilt.control.ticks == summary.control.ticks
    assert rebuilt.control.deadline_misses == summary.control.deadline_misses
    assert rebuilt.duration_s == pytest.approx(summary.duration_s, abs=1e-9)


@pytest.mark.parametrize("flight", FLIGHTS)
def test_latencies_and_headroom_are_those_of_the_flight(flight: str) -> None:
    summary, rebuilt = both(flight)
    # Where delays vary, one exchange more or less before or after the flight moves a median to another sample.
    bound_s = 1e-3 if flight == "jitter and loss" else MICROSECOND
    pairs: list[tuple[Any, Any, str]] = [(summary, rebuilt, "loop_delay_s")]
    for was, found in zip(summary.vehicles, rebuilt.vehicles, strict=True):
        pairs += [(was, found, name) for name in ("rtt_s", "loop_delay_s", "down_delay_s", "telemetry_age_s")]
        assert abs(found.rtt_s.samples - was.rtt_s.samples) <= 1
        assert found.clock.bound_s == pytest.approx(was.clock.bound_s, abs=bound_s)
        assert found.clock.jumps == was.clock.jumps
    for was, found, name in pairs:
        for quantile in ("p50", "p95", "p99", "max"):
            expected = pytest.approx(getattr(getattr(was, name), quantile), abs=bound_s)
            assert getattr(getattr(found, name), quantile) == expected, (name, quantile)
    if flight != "autopilots":  # their margins are known only once they have been identified
        for was, found in ((summary, rebuilt), *zip(summary.vehicles, rebuilt.vehicles, strict=True)):
            assert found.headroom_min == pytest.approx(was.headroom_min, abs=10 * bound_s)


@pytest.mark.parametrize("flight", FLIGHTS)
def test_errors_and_distances_are_those_of_the_flight(flight: str) -> None:
    summary, rebuilt = both(flight)
    # A µs at 100 m/s is 0.1 mm; a state of the vehicle ahead from before a late exchange is off by more.
    bound_m = 2e-3 if flight == "jitter and loss" else 2e-4
    assert rebuilt.distance_min_m == pytest.approx(summary.distance_min_m, abs=bound_m)
    for was, found in zip(summary.vehicles, rebuilt.vehicles, strict=True):
        assert found.spacing_error_final_m == pytest.approx(was.spacing_error_final_m, abs=bound_m)
        assert found.spacing_error_max_m == pytest.approx(was.spacing_error_max_m, abs=bound_m)


@pytest.mark.parametrize("flight", FLIGHTS)
def test_modes_losses_and_lateness_are_those_of_the_flight(flight: str) -> None:
    summary, rebuilt = both(flight)
    period_s = 0.02

    def changes(of: Summary) -> list[tuple[int | None, str]]:
        return [(event.system_id, event.text) for event in of.mode_changes]

    count = min(len(changes(summary)), len(changes(rebuilt)))  # what is decided last is no longer sent
    assert count >= len(changes(summary)) - len(summary.vehicles)
    assert changes(rebuilt)[:count] == changes(summary)[:count]
    for was, found in zip(summary.mode_changes, rebuilt.mode_changes, strict=False):
        assert found.time_s == pytest.approx(was.time_s, abs=period_s)
    for was, found in zip(summary.vehicles, rebuilt.vehicles, strict=True):
        for name in ("lost", "late", "duplicate"):
            assert abs(getattr(found, name) - getattr(was, name)) <= 2  # of what arrives after the last tick


def test_the_flight_named_gains_change_does_change_gains() -> None:
    summary, rebuilt = both("gains change")
    assert "CAUTION -> CRITICAL" in {event.text for event in summary.mode_changes}
    assert known(rebuilt.loop_delay_s.max) > 2 * known(rebuilt.delay_margin_s)
    assert known(rebuilt.headroom_min) > 0  # against the margins of the slower gains; against the first it would be -1


def overheard(*, requests: bool) -> tuple[bytes, TickArray]:
    """The log of a tool that hears the vehicles of a flight, with or without its station's TIMESYNC; and the ticks."""
    _, _, ticks, entries = flown(scenario_of("chain3"))
    frames = [(time_ns, frame) for time_ns, data in entries for frame in mavlink.decode(data, Counter())]
    kept = [
        (time_ns, frame.data)
        for time_ns, frame in frames
        if frame.system_id != mavlink.STATION_SYSTEM_ID or (requests and frame.msg_id == mavlink.TIMESYNC)
    ]
    return log_bytes(kept), ticks


@pytest.mark.parametrize("requests", [True, False], ids=["with exchanges", "telemetry only"])
def test_another_tools_log_gives_links_and_errors_but_no_verdict(requests: bool) -> None:
    scenario = scenario_of("chain3")
    data, ticks = overheard(requests=requests)
    log = parse_tlog(data)
    result = rebuild_report(log, LogSource(Path("other.tlog"), scenario, Design(delay_margin_s=0.3), None))
    assert result.flight is not None
    assert (result.flight.verdict, result.flight.control) == ("not judged", None)
    for links in result.links:
        assert links.rtt_s.p50 == (pytest.approx(0.04, abs=MICROSECOND) if requests else None)
        assert links.loop_delay_s.status == ("measured" if requests else "lower bound")
        assert (known(links.loop_delay_s.p50) < 0.04) != requests
    rebuilt = rebuild(log.frames, scenario, Design(delay_margin_s=0.3)).ticks
    for system_id in (2, 3):
        was, found = (rows[rows["system_id"] == system_id] for rows in (ticks[ticks["time_s"] >= 0], rebuilt))
        log_ns = was["due_ns"] + EPOCH_NS
        found = found[(found["due_ns"] >= log_ns[0] + 500_000_000) & (found["due_ns"] <= log_ns[-1])]
        assert found.size > 250
        for axis in ("spacing_error_north_m", "spacing_error_east_m"):
            at_the_same_time = np.interp(found["due_ns"] - log_ns[0], log_ns - log_ns[0], was[axis])
            # Errors change at up to 20 m/s, and the two are up to a tick apart.
            assert np.abs(found[axis] - at_the_same_time).max() < 0.4
            assert np.median(np.abs(found[axis] - at_the_same_time)) < 0.01


def test_vehicle_sent_nothing_at_the_end_is_not_called_lost() -> None:
    """Its pilot may fly it: the log does not say."""
    scenario = scenario_of("chain3")
    design, _, _, entries = flown(scenario)
    last_ns, kept = entries[-1][0], list[tuple[int, bytes]]()
    for time_ns, data in entries:
        own = [mavlink.target_system(frame) for frame in mavlink.decode(data, Counter())]
        if time_ns < last_ns - 2_000_000_000 or own != [3]:
            kept.append((time_ns, data))
    source = LogSource(Path("flight.tlog"), scenario, design, None)
    rebuilt = rebuild_report(parse_tlog(log_bytes(kept)), source).flight
    assert rebuilt is not None
    assert (rebuilt.verdict, rebuilt.reason) == ("aborted", "vehicles 3 are sent nothing at the end")


def test_a_leader_flown_by_somebody_else_is_not_missed() -> None:
    scenario = scenario_of("chain3").model_copy(update={"course": Course(leader="external")})
    summary, rebuilt = rebuilt_with(scenario, Fleet(scenario, START_NS))
    assert (rebuilt.verdict, rebuilt.reason) == (summary.verdict, summary.reason) == ("stable", COMPLETED)


class Unanswering:
    """The vehicles of a scenario, of which the third stops answering TIMESYNC after two seconds."""

    def __init__(self, scenario: Scenario) -> None:
        self._fleet = Fleet(scenario, START_NS)

    def step(self, received: Sent, now_ns: int) -> Sent:
        return [
            (system_id, data, at_ns)
            for system_id, data, at_ns in self._fleet.step(received, now_ns)
            if (system_id, data[7]) != (3, mavlink.TIMESYNC) or at_ns < START_NS + 2 * NS_PER_S
        ]


def rebuilt_with(scenario: Scenario, vehicles: Vehicles, plan: FlightPlan | None = None) -> tuple[Summary, Summary]:
    """The summary of a flight with these vehicles, and the one made of its log."""
    design, planned = over_own_links(*flight_plan(scenario))
    plan = plan or planned
    station, logged = Station(plan, start_ns=START_NS), Logged(vehicles)
    ticks = np.concatenate(list(fly_lockstep(plan, station=station, vehicles=logged)))
    end = Event(time_s=0.0, kind="end", text=station.end_reason)
    source = LogSource(Path("flight.tlog"), scenario, design, None)
    rebuilt = rebuild_report(parse_tlog(log_bytes(logged.entries)), source).flight
    assert rebuilt is not None
    return summarise(scenario, design, ticks, [*station.events, end]), rebuilt


def test_silence_on_timesync_leaves_no_delay_in_the_log_either() -> None:
    scenario = scenario_of("chain3").model_copy(update={"duration_s": 12.0})
    summary, rebuilt = rebuilt_with(scenario, Unanswering(scenario))
    assert (rebuilt.verdict, rebuilt.reason) == (summary.verdict, summary.reason) == ("unknown", COMPLETED)
    for was, found in zip(summary.vehicles, rebuilt.vehicles, strict=True):
        assert found.loop_delay_s.samples == pytest.approx(was.loop_delay_s.samples, abs=10)


def test_a_vehicle_on_the_ground_is_known_from_its_log() -> None:
    """Its pilot lands it; the others fly over it."""
    speeds = ((0.0, 0.0), (25.0, 3.0))
    over = tuple(NominalVelocity(from_s=at_s, velocity_ne_m_s=(-speed, speed)) for at_s, speed in speeds)
    scenario = pilots_flight("ardupilot").model_copy(update={"duration_s": 32.0, "nominal_velocity": over})
    land = {flight_s("ardupilot") + 1.0: RULES["ardupilot"].land_mode}
    summary, rebuilt = rebuilt_with(
        scenario, PilotsVehicle(Fleet(scenario, START_NS), "ardupilot", land), plan_for(scenario)
    )
    assert (rebuilt.verdict, rebuilt.reason) == (summary.verdict, summary.reason)
    assert rebuilt.reason == "landed: vehicles 3"
    assert rebuilt.distance_min_m == pytest.approx(summary.distance_min_m, abs=0.01)


def test_without_a_scenario_only_the_links_are_reported() -> None:
    data, _ = overheard(requests=True)
    result = rebuild_report(parse_tlog(data), LogSource(Path("other.tlog"), None, None, None))
    assert "flight" not in result.to_dict()
    assert [links.system_id for links in result.links] == [1, 2, 3]
    assert {links.headroom for links in result.links} == {None}
