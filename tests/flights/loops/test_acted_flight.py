"""Flights in which set-points are lost or clipped, with and without the vehicles' reports of what acted."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from gains.core.arrays import FloatArray
from gcs.drive.lockstep import START_NS, Sent, fly_lockstep
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.station.station import Station
from scenarios.files import load
from scenarios.keys.link import Link, Links
from scenarios.schema import Control, FixedGains, NominalVelocity, Rates, Scenario
from sim_vehicles.drive.fleet import Fleet
from tests.support.fleets.flown_copters import TRUTH, three
from tests.support.paths import SCENARIOS

FAST, SLOW = FixedGains(K1=-3.408, K2=0.631, K3=5.608), FixedGains(K1=-1.898, K2=0.0, K3=1.642)
REPORT = b"\x55\x00\x00"
"""Message id of POSITION_TARGET_LOCAL_NED, as in a frame."""


class Unheard:
    """Vehicles whose reports never arrive, while the links draw the same losses."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet

    def step(self, received: Sent, now_ns: int) -> Sent:
        return [sent for sent in self._fleet.step(received, now_ns) if sent[1][7:10] != REPORT]


def errors_m(plan: FlightPlan, *, heard: bool, vehicles: Scenario | None = None) -> tuple[FloatArray, FloatArray]:
    """Time (ticks,) and spacing errors of the followers (ticks, followers, 2)."""
    fleet = Fleet(vehicles or plan.scenario, START_NS)
    station = Station(plan, start_ns=START_NS)
    ticks = np.stack(list(fly_lockstep(plan, station=station, vehicles=fleet if heard else Unheard(fleet))))
    assert station.end_reason == "completed: duration reached"
    flown = ticks[ticks["commanded"].any(axis=1)]
    return flown["time_s"][:, 0], np.stack([flown[f"spacing_error_{to}_m"] for to in ("north", "east")], axis=-1)[:, 1:]


def rms(error_m: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(error_m))))


def stepped(base: Scenario, gains: FixedGains, *, link_s: float, step_m_s: float) -> Scenario:
    """The scenario at 10 Hz, with a step of the nominal velocity at 4 s."""
    north, east = base.nominal_velocity_at(0.0)
    faster = NominalVelocity(from_s=4.0, velocity_ne_m_s=(north + step_m_s, east))
    link = Link(delay_s=link_s)
    changes = {
        "control": Control.model_validate({"gains": gains, "prediction": "measured"}),
        "links": Links(up=link, down=link),
        "rates": Rates(control_hz=10.0, telemetry_hz=10.0),
        "nominal_velocity": (NominalVelocity(from_s=0.0, velocity_ne_m_s=(north, east)), faster),
        "duration_s": 14.0,
    }
    return base.model_copy(update=changes).with_calm_monitor()


def launched() -> Scenario:
    return stepped(load(SCENARIOS / "chain3.toml"), SLOW, link_s=0.05, step_m_s=5.0)


def copters(flavour: str) -> Scenario:
    base = three(flavour=flavour).model_copy(update={"response": TRUTH})
    return stepped(base, SLOW, link_s=0.1, step_m_s=1.5)


@pytest.mark.slow(first=2)
@pytest.mark.parametrize(
    ("make", "share"),
    [(launched, 0.99), (lambda: copters("ardupilot"), 0.85), (lambda: copters("px4"), 0.85)],
    ids=["launched", "ardupilot", "px4"],
)
def test_losses_disturb_less_when_vehicles_report_what_acted(make: Callable[[], Scenario], share: float) -> None:
    """With 20 % of the set-points lost: rms difference of the spacing errors from those of the flight without losses.

    Reports reduce it to a share of its value without them: for our own vehicles to 98 % of 0.176 m, for simulated
    ArduPilots to 76 % of 0.0123 m, and for simulated PX4s to 71 % of 0.0125 m.
    """
    plan = flight_plan(make())[1]
    found: dict[bool, list[float]] = {False: [], True: []}
    for seed in (1, 2):
        whole = plan.scenario.model_copy(update={"seed": seed})
        time_s, expected = errors_m(replace(plan, scenario=whole), heard=False)
        _, same = errors_m(replace(plan, scenario=whole), heard=True)
        assert np.array_equal(same, expected)  # without losses nothing is corrected
        down = whole.links.down.model_copy(update={"loss_probability": 0.2})
        lossy = whole.model_copy(update={"links": Links(up=whole.links.up, down=down)})
        for heard, every in found.items():
            _, error_m = errors_m(replace(plan, scenario=lossy), heard=heard)
            every.append(rms((error_m - expected)[time_s >= 4.0]))
    assert rms(np.array(found[True])) < share * rms(np.array(found[False]))


def test_clipping_that_only_vehicles_know_of_is_learnt() -> None:
    """The vehicles can do 3 m/s², while the station believes 29.4; the loop delay is 1 s.

    After 10 s the errors are 0.025 mm rms with reports, and a limit cycle of 0.67 m without.
    """
    base, link = load(SCENARIOS / "triangle5.toml"), Link(delay_s=0.5)
    changes = {
        "control": Control.model_validate({"gains": FAST, "prediction": "measured"}),
        "links": Links(up=link, down=link),
        "duration_s": 16.0,
    }
    scenario = base.model_copy(update=changes).with_calm_monitor()
    weak = scenario.model_copy(update={"limits": scenario.limits.model_copy(update={"acceleration_max_m_s2": 3.0})})
    plan = flight_plan(scenario)[1]
    late: dict[bool, float] = {}
    for heard in (True, False):
        time_s, error_m = errors_m(plan, heard=heard, vehicles=weak)
        late[heard] = rms(error_m[time_s > 10.0])
    assert late[True] < 1e-3
    assert late[False] > 0.5
