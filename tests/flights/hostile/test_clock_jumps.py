"""Flights in which boot clocks are set: nothing is extrapolated over the jump, and no figure is made from it."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.control.tick import CLOCK_JUMPED
from gcs.drive.lockstep import START_NS, Sent, fly_lockstep
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.station.station import Station
from scenarios.keys.link import Link, Links
from scenarios.schema import ClockJump, Rates, Scenario, Vehicle
from sim_vehicles.drive.fleet import Fleet
from tests.support.fleets.flown_copters import COPTERS5, TRUTH, Flight, fly
from tests.support.sim_client import parse

SECOND = 1_000_000_000


def column(*, clock_jumps: tuple[ClockJump, ...], timesync_hz: float = 10.0, flavour: str = "ardupilot") -> Scenario:
    """Three copters one behind the other, 12 m apart, flying north at 4 m/s."""
    vehicles = tuple(
        Vehicle(
            system_id=k + 1,
            follows=k or None,
            offset_ne_m=(-12.0, 0.0) if k else None,
            position_ne_m=(-13.0 * k, 0.5 * k),
            velocity_ne_m_s=(0.0, 0.0),
        )
        for k in range(3)
    )
    autopilot = COPTERS5.autopilot.model_copy(update={"clock_jumps": clock_jumps, "flavour": flavour})
    changes: dict[str, Any] = {"vehicles": vehicles, "autopilot": autopilot, "duration_s": 20.0, "response": TRUTH}
    rates = Rates(control_hz=50.0, telemetry_hz=50.0, timesync_hz=timesync_hz)
    return COPTERS5.model_copy(update=changes | {"rates": rates})


@cache
def planned() -> FlightPlan:
    return flight_plan(column(clock_jumps=()))[1]


def flown(**changes: Any) -> Flight:
    return fly(replace(planned(), scenario=column(**changes)))


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
@pytest.mark.parametrize("timesync_hz", [10.0, 0.2])
@pytest.mark.parametrize("by_s", [3.0, -3.0, -1000.0, 700.0])
def test_clock_jumps_neither_end_a_flight_nor_show_in_figures(by_s: float, timesync_hz: float, flavour: str) -> None:
    """-1000 s sets a clock to before its boot, so that time_boot_ms wraps."""
    at_s = 22.0 if timesync_hz > 1.0 else 45.0  # at 0.2 Hz the clocks are known after 25 s
    flight = flown(clock_jumps=(ClockJump(at_s=at_s, by_s=by_s),), timesync_hz=timesync_hz, flavour=flavour)
    assert flight.station.end_reason == "completed: duration reached"
    assert flight.texts("vehicle").count(CLOCK_JUMPED) == 3
    rows = flight.flown
    jumped_s = at_s - (float(rows["due_ns"][0]) - START_NS) * 1e-9
    assert 2.0 < jumped_s < 18.0
    known = rows[np.isfinite(rows["loop_delay_s"])]
    assert known["loop_delay_s"].min() > 0.039
    assert known["loop_delay_s"].max() < 0.2  # a round trip, the tick after it, and the state after that
    assert known["up_delay_s"].min() > 0.0
    # what the station computes with, at every tick, is where the vehicles are
    for system_id in (2, 3):
        assert flight.error_m(system_id)[-1] < 0.12
        calm = rows[(rows["system_id"] == system_id) & (rows["time_s"] > max(jumped_s, 5.0))]
        assert np.nanmax(np.hypot(calm["spacing_error_north_m"], calm["spacing_error_east_m"])) < 0.5
    commands = np.hypot(rows["command_north_m_s2"], rows["command_east_m_s2"])
    assert np.nanmax(commands[rows["time_s"] > max(jumped_s, 5.0)]) < 1.0


def test_known_offsets_are_within_their_bound_at_every_tick() -> None:
    """Except in the round trip in which only the vehicle knows that its clock has been set."""
    flight = flown(clock_jumps=(ClockJump(at_s=45.0, by_s=3.0),), timesync_hz=0.2)
    rows = flight.ticks[flight.ticks["system_id"] == 2]
    rows = rows[np.isfinite(rows["clock_offset_s"])]
    clock = flight.fleet.vehicle(2).radio.clock
    truth_s = np.array([(clock.boot_ns(int(ns)) - int(ns)) * 1e-9 for ns in rows["sent_ns"]])
    before = (rows["sent_ns"] - START_NS) * 1e-9 < 45.0
    truth_s[before] -= 3.0
    bad = np.abs(rows["clock_offset_s"] - truth_s) > rows["clock_offset_bound_s"] + 1e-6
    assert np.count_nonzero(bad) <= 2  # a state is on its way for 20 ms


class BackdatedReplies:
    """A fleet that backdates its TIMESYNC replies as ArduCopter does."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._rng = np.random.default_rng(3)
        self.backdated = 0

    def step(self, received: Sent, now_ns: int) -> Sent:
        return [(k, self._back(k, data), time_ns) for k, data, time_ns in self._fleet.step(received, now_ns)]

    def _back(self, system_id: int, data: bytes) -> bytes:
        message = parse(data)
        if message.get_type() != "TIMESYNC" or message.tc1 == 0 or self._rng.random() > 0.4:
            return data
        self.backdated += 1
        link = dialect.MAVLink(None, srcSystem=system_id, srcComponent=1)
        link.seq = message.get_seq()
        later_ns = int(self._rng.uniform(0.0, 3.5e6))
        return bytes(dialect.MAVLink_timesync_message(message.tc1 - later_ns, message.ts1).pack(link))


def ticks_of(scenario: Scenario, vehicles: BackdatedReplies, station: Station) -> Iterator[Any]:
    return fly_lockstep(replace(planned(), scenario=scenario), station=station, vehicles=vehicles)


def test_backdated_replies_are_not_taken_for_jumps() -> None:
    """ArduCopter backdates them by up to 3.5 ms; on direct links up to half of the exchanges contradict the rest."""
    direct = column(clock_jumps=()).model_copy(update={"links": Links(up=Link(delay_s=1e-4), down=Link(delay_s=1e-4))})
    station, vehicles = (
        Station(replace(planned(), scenario=direct), start_ns=START_NS),
        BackdatedReplies(Fleet(direct, START_NS)),
    )
    rows = np.concatenate(list(ticks_of(direct, vehicles, station)))
    assert vehicles.backdated > 100
    assert station.end_reason == "completed: duration reached"
    assert CLOCK_JUMPED not in [event.text for event in station.events]
    known = rows[np.isfinite(rows["up_delay_s"]) & (rows["time_s"] > 0.0)]
    assert (known["up_delay_s"] + known["sample_bound_s"]).min() >= 0.0
