"""Kernels alone, and steps in Python, fly the same flight."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from gcs.control.tick import TickArray, in_sequence
from gcs.drive.lockstep import START_NS, Sent, Vehicles, fly_lockstep, vehicles_of
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.station.station import Station
from scenarios.files import load
from scenarios.keys.link import Jitter, Link, Outage
from scenarios.schema import Limits, Rates, Scenario
from sim_vehicles.links.truth import MemoryRecorder, Recorder
from tests.support.paths import SCENARIOS

WILD = {
    "jitter": Jitter(distribution="normal", scale_s=0.012), "reordering": True,
    "loss_probability": 0.05, "duplicate_probability": 0.03, "corrupt_probability": 0.02,
}  # fmt: skip
SILENT = {"outages": (Outage(from_s=2.0, until_s=4.5),)}


@dataclass
class StepByStep:
    """Vehicles in a wrapper, which makes the driver take their steps in Python."""

    vehicles: Vehicles

    def step(self, received: Sent, now_ns: int) -> Sent:
        return self.vehicles.step(received, now_ns)


class Counting(Station):
    """A station that counts its steps in Python; `plainly` turns off the kernel for usual ticks."""

    steps, plainly = 0, False

    @property
    def has_fast_path(self) -> bool:
        return super().has_fast_path and not self.plainly

    def step(self, datagrams: Any, now_ns: int, taken: int = 0) -> Any:
        self.steps += 1
        return super().step(datagrams, now_ns, taken)


def flown(
    plan: FlightPlan, *, step_by_step: bool = False, ahead: bool = False, recorder: Recorder | None = None
) -> tuple[list[TickArray], list[Any], Counting]:
    station, fleet = Counting(plan, start_ns=START_NS), vehicles_of(plan.scenario, recorder=recorder)
    ticks: list[TickArray] = []
    frames: list[Any] = []
    station.plainly = step_by_step
    vehicles = StepByStep(fleet) if step_by_step else fleet
    for rows in fly_lockstep(plan, station=station, vehicles=vehicles, ahead=ahead):
        ticks.append(rows)
        frames += station.frames
    return ticks, frames, station


def changed(name: str, delay_s: float | None = None, link: dict[str, Any] | None = None, **changes: Any) -> Scenario:
    def with_changes(own: Link) -> Link:
        return own.model_copy(update=link or {})

    scenario = load(SCENARIOS / f"{name}.toml").with_links(with_changes, with_changes)
    if delay_s is not None:
        scenario = scenario.with_link_delay(up_s=delay_s / 2, down_s=delay_s / 2)
    return scenario.model_copy(update={"duration_s": 6.0, **changes})


def never_heard() -> Scenario:
    scenario = changed("chain3", link={"loss_probability": 1.0})
    return scenario.model_copy(update={"links": scenario.links.model_copy(update={"times_from": "start"})})


def ends_in_failsafe() -> Scenario:
    """A vehicle that holds already when the flight ends, and stays in the mode in which the monitor saw it."""
    alone = changed("chain3", vehicles=load(SCENARIOS / "chain3.toml").vehicles[:1], seed=14, duration_s=3.0)
    return alone.with_links(lambda up: up, lambda down: down.model_copy(update={"loss_probability": 0.93}))


FLIGHTS = {
    "calm": changed("triangle5"),
    "coupled": changed("chain3_bidirectional"),
    "jitter": changed("triangle5", link={"jitter": Jitter(distribution="uniform", scale_s=0.01)}),
    "wild links": changed("triangle5", link=WILD),
    "slow telemetry": changed("triangle5", rates=Rates(control_hz=50.0, telemetry_hz=12.5)),
    "limits": changed("triangle5_scattered", limits=Limits(acceleration_max_m_s2=0.5)),
    "altitudes": changed("copters5", dynamics="double_integrator", response=None),
    "gains change": changed("triangle5", 0.3, duration_s=25.0),
    "silence": changed("chain3", link=SILENT),
    "breaks": changed("triangle5", 0.6).with_calm_monitor(),
    "start-up over slow links": changed("triangle5", 0.8, link=WILD, duration_s=2.0),
    "never heard": never_heard(),
    "ends in failsafe": ends_in_failsafe(),
    "turns round": changed("chain3", 0.9, limits=Limits(speed_min_m_s=0.001), duration_s=20.0).with_calm_monitor(),
}


@pytest.mark.parametrize("name", FLIGHTS)
def test_kernels_alone_and_python_fly_the_same_flight(name: str) -> None:
    plan = flight_plan(FLIGHTS[name])[1]
    ticks, frames, station = flown(plan)
    others, other_frames, other = flown(plan, step_by_step=True)
    assert [rows.tobytes() for rows in ticks] == [rows.tobytes() for rows in others]
    assert frames == other_frames
    assert station.events == other.events
    assert (station.counters, station.end_reason) == (other.counters, other.end_reason)
    if name == "calm":
        assert station.steps < 0.03 * other.steps
    if name == "jitter":  # a step for each unusual frame to the station, and for the tick after it; none to vehicles
        assert station.steps < 35
    if name in {"breaks", "turns round"}:
        assert station.steps < 0.2 * other.steps


@pytest.mark.parametrize("name", FLIGHTS)
def test_a_flight_ahead_of_its_caller_has_the_same_rows(name: str) -> None:
    plan = flight_plan(FLIGHTS[name])[1]
    ticks, _, station = flown(plan, ahead=True)
    others, _, other = flown(plan)
    assert in_sequence(ticks).tobytes() == in_sequence(others).tobytes()
    if name == "calm":
        assert len(ticks) < 0.1 * len(others)
    assert station.events == other.events
    assert (station.counters, station.end_reason) == (other.counters, other.end_reason)


def test_kernels_alone_record_the_same_truth() -> None:
    plan, recorders = flight_plan(FLIGHTS["wild links"])[1], (MemoryRecorder(100), MemoryRecorder())
    for recorder, step_by_step in zip(recorders, (False, True), strict=True):
        flown(plan, step_by_step=step_by_step, recorder=recorder)
    one, other = (np.sort(recorder.records) for recorder in recorders)
    assert len(one) > 5_000
    assert one.tobytes() == other.tobytes()
