"""Formations of several networks, in which MAVLink system ids repeat."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.drive.flown import fly_plan
from gcs.drive.lockstep import START_NS, fly_lockstep, signed_ends
from gcs.errors import InputError
from gcs.link.datagram import Datagram
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.runs.record import tlog_file
from gcs.station.station import Station
from gcs.studies.benchmark import with_vehicles, without_solver
from gcs.watch.rebuild_report import find_log
from gcs.watch.tlog import read_tlog
from scenarios.files import dump, load, parse
from scenarios.networks import ids_of, networks_of
from scenarios.schema import Scenario
from scenarios.signing.keys import KEY_BYTES, Key
from tests.support.commands import complaint
from tests.support.fleets.logged_flight import log_bytes
from tests.support.paths import SCENARIOS
from tests.support.station_peer import address_at

IDS = {1: 1, 2: 2, 3: 1001, 4: 1002, 5: 9002}
"""Vehicles 1 and 2 of networks 0 and 1, and a vehicle 2 of network 9."""
_OWN: Any = dialect.MAVLink(None, srcSystem=2, srcComponent=1)
HEARTBEAT: bytes = _OWN.heartbeat_encode(2, 3, 1, 0, 3).pack(_OWN)
"""From a vehicle 2, in whichever network."""


def renumbered(duration_s: float, **changes: Any) -> Scenario:
    text = (SCENARIOS / "triangle5.toml").read_text(encoding="utf-8")
    for before, after in IDS.items():
        for key in ("system_id", "follows"):
            text = text.replace(f"{key} = {before}\n", f"{key} = {after}\n")
    return parse(text, Path("networks.toml")).model_copy(update={"duration_s": duration_s, **changes})


def planned(scenario: Scenario) -> FlightPlan:
    return flight_plan(without_solver(scenario, scenario.duration_s))[1]


def senders(folder: Path, network: int) -> set[int]:
    """The system ids in the frames of a network's telemetry log."""
    return {frame.system_id for _, frame in read_tlog(folder / tlog_file(network)).frames}


@pytest.mark.parametrize(
    "real_time",
    [False, pytest.param(True, marks=[pytest.mark.realtime, pytest.mark.xdist_group("realtime")])],
)
def test_vehicles_of_the_same_id_fly_in_their_own_networks(real_time: bool, tmp_path: Path) -> None:
    flight = fly_plan(planned(renumbered(2.0)), tmp_path / "run", real_time=real_time)
    assert flight.events[-1].text == "completed: duration reached"
    flown = flight.ticks[flight.ticks["time_s"] > 1.0]
    assert set(flown["system_id"].tolist()) == set(IDS.values())
    assert flown["commanded"].mean() > 0.9
    assert np.isfinite(flown["loop_delay_s"]).mean() > 0.9
    assert not flown["lost"].any()
    logs = {network: senders(tmp_path / "run", network) - {255} for network in networks_of(IDS.values())}
    assert logs == {0: {1, 2}, 1: {1, 2}, 9: {2}}
    with pytest.raises(InputError, match=r"a telemetry log for each network \(flight-1\.tlog, flight-9\.tlog\)"):
        find_log(tmp_path / "run")
    of_one = find_log(tmp_path / "run" / tlog_file(0))
    assert of_one.scenario is None  # or the vehicles of other networks would count as lost


def test_a_signed_flight_in_networks_is_the_unsigned_one() -> None:
    plan = planned(renumbered(2.0))
    vehicles, guard = signed_ends(plan, Key(bytes(range(KEY_BYTES))))
    station = Station(plan, start_ns=START_NS)
    signed = np.concatenate(list(fly_lockstep(plan, station=station, vehicles=vehicles, guard=guard)))
    assert signed.tobytes() == np.concatenate(list(fly_lockstep(plan))).tobytes()
    assert not station.counters


def test_a_vehicle_is_heard_in_its_own_network_only() -> None:
    station = Station(planned(renumbered(2.0)), start_ns=START_NS)
    for network in (0, 1, 2, 9):
        station.step([Datagram(HEARTBEAT, address_at("127.0.0.1", 7000 + network, network), START_NS)], START_NS)
    heard = {vehicle.system_id: vehicle.address for vehicle in station.vehicles if vehicle.address is not None}
    assert heard == {
        2: address_at("127.0.0.1", 7000, 0),
        1002: address_at("127.0.0.1", 7001, 1),
        9002: address_at("127.0.0.1", 7009, 9),
    }
    assert station.counters == {"unknown system id": 1}


def test_loops_on_board_know_whom_they_follow_in_another_network() -> None:
    scenario = renumbered(2.0)
    onboard = scenario.model_copy(update={"control": scenario.control.model_copy(update={"loop": "onboard"})})
    flight = fly_plan(planned(onboard))
    assert flight.events[-1].text == "completed: duration reached"
    last = flight.ticks[-5:]
    assert np.nanmax(np.abs(last["spacing_error_north_m"])) < np.nanmax(np.abs(flight.ticks["spacing_error_north_m"]))


def test_the_benchmarks_formation_fills_one_network_after_the_other() -> None:
    scenario = with_vehicles(load(SCENARIOS / "triangle5.toml"), 600)
    assert [vehicle.system_id for vehicle in scenario.vehicles] == ids_of(600)
    assert networks_of(ids_of(600)) == [0, 1, 2]
    assert ids_of(600)[248:252] == [249, 250, 1001, 1002]


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (
            "fly networks.toml --listen 127.0.0.1:0 --mirror 127.0.0.1:9",
            "--mirror: read vehicles in the networks 0 1 9, wanted one",
        ),
        ("fly networks.toml --listen 127.0.0.1:65530", "there is no port 65539 for network 9, wanted free UDP ports"),
        (
            "replay flight-1.tlog networks.toml",
            "networks.toml: read vehicles in the networks 0 1 9, wanted network 0",
        ),
        ("fly wrong.toml", "line 17: vehicle 1251: system_id: read 1251, wanted at most 250, or 1001 to 1250 in"),
    ],
)
def test_what_networks_cannot_do_is_refused_in_one_line(
    arguments: str, wanted: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("networks.toml").write_text(dump(renumbered(2.0)))
    Path("flight-1.tlog").write_bytes(log_bytes([(0, HEARTBEAT)]))
    text = (SCENARIOS / "triangle5.toml").read_text(encoding="utf-8")
    Path("wrong.toml").write_text(text.replace("system_id = 1\n", "system_id = 1251\n"))
    assert wanted in complaint(monkeypatch, capsys, *arguments.split())
