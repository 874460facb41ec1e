"""Hostile datagrams change nothing but counters, at both ends: a flight under fire is flown as without it.

`FUZZ_DATAGRAMS=1000000 python3 make.py test tests/flights/hostile/test_fuzz.py` sends as many to each end of each
flight; a sample is sent by default. The flight lasts as long as that takes: a step gets no more than the emulated links
hold.

Without a key, two kinds of frames cannot be told from real ones and are left out: new valid frames from the station's
or a vehicle's own address, and replays older than the 128 frames that a sequence number can tell apart. They must still
raise nothing, which is a test of its own.
"""

import math
import os
from collections import Counter, deque
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from gcs.control.phases import Phase
from gcs.control.tick import Event, TickArray
from gcs.drive.guard import Guard
from gcs.drive.lockstep import EPOCH_NS, START_NS
from gcs.link import mavlink
from gcs.link.datagram import Datagram
from gcs.plan.design import Design
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.station.station import Station
from gcs.watch.links import Requests, Watch
from gcs.watch.rebuild_report import LogSource, rebuild_report
from gcs.watch.tlog import parse_tlog
from scenarios.files import load, with_loop
from scenarios.schema import FixedGains, Scenario
from scenarios.signing.keys import Key
from scenarios.signing.stamps import Stamps
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.drive.guard import signed_links
from tests.support.fleets.flown_copters import three
from tests.support.fleets.logged_flight import flown as logged
from tests.support.fleets.logged_flight import log_bytes
from tests.support.hostile import (
    SAID_BY_STATIONS,
    SAID_BY_VEHICLES,
    TO_VEHICLES,
    any_message,
    changed,
    extreme,
    in_version_1,
    noise,
    timesync_reply,
)
from tests.support.paths import SCENARIOS

COUNT = int(os.environ.get("FUZZ_DATAGRAMS", "20000"))
BATCH = min(3000, max(100, COUNT // 1800 * 10))
"""Datagrams to each end at each step. Three links hold 10,000 each, and those of two steps are under way at a time."""
SECONDS = max(4.0, math.ceil(COUNT / BATCH / 50) + 1.0)
COUNTERS = ["received", "lost", "late", "duplicate"]
CHAIN3 = load(SCENARIOS / "chain3.toml")
GIVEN = CHAIN3.control.model_copy(update={"gains": FixedGains(K1=-3.4, K2=0.6, K3=5.6)})


def scenario_of(kind: str, seconds: float) -> Scenario:
    """Three vehicles of a kind."""
    if kind == "plain":
        return CHAIN3.model_copy(update={"duration_s": seconds, "control": GIVEN})
    if kind == "onboard":
        return with_loop(CHAIN3, "onboard", SCENARIOS).model_copy(update={"duration_s": seconds})
    return three(flavour=kind, duration_s=seconds)


@dataclass
class Fire:
    """Hostile datagrams for both ends at each step, made from what passed lately."""

    system_ids: list[int]
    signed: bool
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(20))
    fired: Counter[str] = field(default_factory=Counter[str])
    up: deque[tuple[int, bytes]] = field(default_factory=lambda: deque[tuple[int, bytes]](maxlen=300))
    down: deque[tuple[int, bytes]] = field(default_factory=lambda: deque[tuple[int, bytes]](maxlen=500))

    def at_station(self, now_ns: int) -> list[Datagram]:
        """From a stranger: anything, under any system id. From the vehicles' addresses: nothing new that is valid."""
        if self.fired["station"] >= COUNT or len(self.up) < 50:
            return []
        tenth, rng, ids = BATCH // 10, self.rng, self.system_ids
        real = [data for _, data in self.up]
        stranger = any_message(rng, 2 * tenth, [*ids, *range(1, 256)], set()) + list(rng.permuted(real)[:tenth])
        own = changed(rng, 4 * tenth, real) + noise(rng, 2 * tenth)
        own += any_message(rng, tenth, [k for k in range(1, 256) if self.signed or k not in ids], set())
        if self.signed:
            own += extreme(rng, tenth, SAID_BY_VEHICLES, source=ids[0], targets=[0, 255])
        fired = [Datagram(bytes(data), 1_000_009, now_ns) for data in stranger]
        fired += [Datagram(data, ids[k % 3], now_ns) for k, data in enumerate(own)]
        replays = [self.up[k] for k in rng.integers(len(self.up), size=tenth).tolist()]
        fired += [Datagram(data, system_id, now_ns) for system_id, data in replays]
        self.fired["station"] += len(fired)
        return fired

    def at_vehicles(self, now_ns: int) -> list[tuple[int, bytes, int]]:
        """Anything that no vehicle can take for a message of the station."""
        if self.fired["vehicles"] >= COUNT or len(self.down) < 50:
            return []
        tenth, rng = BATCH // 10, self.rng
        data = any_message(rng, 3 * tenth, list(range(256)), set() if self.signed else TO_VEHICLES)
        data += changed(rng, 5 * tenth, [data for _, data in self.down]) + noise(rng, 2 * tenth)
        if self.signed:
            data += extreme(rng, tenth, SAID_BY_STATIONS, source=255, targets=self.system_ids)
        fired = [(self.system_ids[k % 3], one, now_ns) for k, one in enumerate(data)]
        if self.signed:
            # each to the vehicle that it was for: another that has heard fewer frames would accept a heartbeat
            fired += [(*self.down[k], now_ns) for k in rng.integers(len(self.down), size=tenth).tolist()]
        self.fired["vehicles"] += len(fired)
        return fired


def flown(plan: FlightPlan, fire: Fire | None, key: Key | None) -> tuple[TickArray, Station, Fleet]:
    """A flight in virtual time, as gcs.drive.lockstep flies it, with what is fired at both ends."""
    links, guard = None, None
    if key is not None:
        links = signed_links(key, plan.formation.system_ids, epoch_ns=EPOCH_NS, stamps=Stamps())
        guard = Guard(key, epoch_ns=EPOCH_NS, stamps=Stamps())
    station, fleet = Station(plan, start_ns=START_NS), Fleet(plan.scenario, START_NS, signed=links)
    ticks: list[TickArray] = []
    down: list[tuple[int, bytes, int]] = []
    while station.phase is not Phase.ENDED:
        now_ns = station.next_event_ns
        arrived = fleet.step(down, now_ns)
        datagrams = [Datagram(data, system_id, time_ns) for system_id, data, time_ns in arrived]
        if fire is not None:
            fire.up.extend((system_id, data) for system_id, data, _ in arrived)
            datagrams += fire.at_station(now_ns)
        if guard is not None:
            datagrams = guard.received(datagrams, now_ns, station.counters, station.is_another)
        outgoing, tick = station.step(datagrams, now_ns)
        if guard is not None:
            outgoing = guard.sent(outgoing, now_ns)
        down = [(address, data, now_ns) for data, address in outgoing]
        if fire is not None:
            fire.down.extend((system_id, data) for system_id, data, _ in down)
            down += fire.at_vehicles(now_ns)
        if tick is not None:
            ticks.append(station.complete(tick, [now_ns] * len(outgoing)))
            station.frames.clear()
    # vehicles advance only when something is due: this brings all to the same instant
    for system_id in fleet.system_ids:
        fleet.state(system_id, station.next_event_ns)
    return np.concatenate(ticks), station, fleet


def refused(counters: Counter[str]) -> int:
    return sum(count for name, count in counters.items() if name.startswith(("refused", "ignored")))


def of_the_flight(station: Station) -> list[Event]:
    """The events, except reports of duplicate frames, which replays cause."""
    return [event for event in station.events if event.kind != "link"]


@pytest.mark.timeout(600 + COUNT // 200)
@pytest.mark.parametrize(
    ("kind", "key"),
    [
        ("plain", None),
        ("plain", Key(bytes(32))),
        ("onboard", None),
        ("ardupilot", None),
        ("px4", Key(bytes(32))),
    ],
    ids=["plain", "plain, signed", "onboard", "ardupilot", "px4, signed"],
)
def test_a_flight_under_fire_is_the_flight_without_it(kind: str, key: Key | None) -> None:
    _, plan = flight_plan(scenario_of(kind, SECONDS))
    calm, calm_station, calm_fleet = flown(plan, None, key)
    fire = Fire(list(plan.formation.system_ids), key is not None)
    hit, station, fleet = flown(plan, fire, key)
    assert min(fire.fired["station"], fire.fired["vehicles"]) > 0.9 * COUNT
    assert fleet.counters["link_down_dropped"] == 0  # no datagram of the station was dropped for what was fired
    for name in hit.dtype.names or ():
        if name not in COUNTERS:
            np.testing.assert_array_equal(hit[name], calm[name], err_msg=name)
    assert of_the_flight(station) == of_the_flight(calm_station)
    unmatched = sum(
        vehicle.clock.unmatched + vehicle.frames.duplicate + vehicle.frames.late for vehicle in station.vehicles
    )
    counted = station.counters.total() + unmatched
    assert counted > 0.8 * fire.fired["station"]  # what is refused is counted by name
    for name in ("setpoints", "heartbeats"):
        assert fleet.counters[name] == calm_fleet.counters[name]
    assert refused(fleet.counters) - refused(calm_fleet.counters) >= 0.95 * fire.fired["vehicles"]
    replays = "replayed" if key is not None else ""
    assert hit["duplicate"].max() + hit["late"].max() + station.counters[replays] > 0  # replays were recognised


@pytest.mark.parametrize("kind", ["plain", "onboard", "ardupilot", "px4"])
@pytest.mark.parametrize("from_second", [0, 3])
def test_the_worst_values_from_the_right_address_raise_nothing(kind: str, from_second: int) -> None:
    """Without a key, whoever speaks as a vehicle or as the station can ruin a flight, but must not crash a program."""
    _, plan = flight_plan(scenario_of(kind, 4.0))
    rng, ids = np.random.default_rng(from_second), list(plan.formation.system_ids)
    station, fleet = Station(plan, start_ns=START_NS), Fleet(plan.scenario, START_NS)
    down: list[tuple[int, bytes, int]] = []
    asked: dict[int, int] = {}
    for _ in range(900):
        now_ns = station.next_event_ns
        datagrams = [Datagram(data, own, time_ns) for own, data, time_ns in fleet.step(down, now_ns)]
        if now_ns >= START_NS + from_second * 10**9:
            for own in ids:
                frames = extreme(rng, 2, SAID_BY_VEHICLES, source=own, targets=[0, 255, own])
                if own in asked:  # replies are read only if they answer a request
                    tc1_ns = int(rng.choice([-(2**63), -1, 1, 2**62 - 1, 2**63 - 1]))
                    frames.insert(0, timesync_reply(tc1_ns, asked.pop(own), own, 200))
                frames += [in_version_1(frame) for frame in frames if frame[8:10] == b"\0\0"]
                datagrams += [Datagram(frame, own, now_ns) for frame in frames]
        outgoing, tick = station.step(datagrams, now_ns)
        if tick is not None:
            rows = station.complete(tick, [now_ns] * len(outgoing))
            station.frames.clear()
            commands = np.hypot(rows["command_north_m_s2"], rows["command_east_m_s2"])[rows["commanded"]]
            assert np.isfinite(commands).all()
        down = [(address, data, now_ns) for data, address in outgoing]
        for own, data, _ in down:
            for frame in mavlink.decode(data, Counter()):
                if frame.msg_id == mavlink.TIMESYNC and frame.fields[0] == 0:
                    asked[own] = frame.fields[1]
        if from_second:
            for own in ids:
                source = (255, 255, 254)[int(rng.integers(3))]
                down += [
                    (own, data, now_ns) for data in extreme(rng, 2, SAID_BY_STATIONS, source=source, targets=[0, own])
                ]
    for own in ids:
        assert all(map(math.isfinite, fleet.state(own, station.next_event_ns)))


@pytest.mark.parametrize("timesync_hz", [0.0, 10.0], ids=["silent", "asking"])
@pytest.mark.parametrize("version", [1, 2])
def test_a_watched_link_under_fire_is_still_watched(timesync_hz: float, version: int) -> None:
    rng, watch, requests, now_ns = np.random.default_rng(version), Watch([1, 5]), Requests(timesync_hz), START_NS
    for step in range(COUNT // 40):
        now_ns += 10_000_000
        frames = extreme(rng, 8, [*SAID_BY_VEHICLES, 111, 111], source=step % 4, targets=[0, 254, 255])
        for sent, _ in requests.due(watch, now_ns):
            (asked,) = mavlink.decode(sent, Counter())
            for k, tc1_ns in enumerate((-(2**63), 2**63 - 1, 1)):
                frames.append(timesync_reply(tc1_ns, asked.fields[1], 5, 3 * step + k))
        if version == 1:
            frames = [in_version_1(frame) for frame in frames if frame[8:10] == b"\0\0"]
        for data in (*frames, *changed(rng, 8, frames), *noise(rng, 8)):
            for frame in mavlink.decode_either(data, watch.counters):
                watch.take(frame, now_ns, 9 + step % 3)
        watch.look(now_ns)
    for figures in watch.figures(now_ns, Design(delay_margin_s=0.3)):
        figures.to_json()
    assert watch.counters["bad checksum"] > 0
    assert watch.counters["truncated"] > 0


@pytest.mark.parametrize("hurt", ["frames", "stamps", "bits", "stamps of no time"])
def test_a_log_of_hostile_frames_and_stamps_is_read_through(hurt: str) -> None:
    scenario = scenario_of("plain", 2.0)
    design, _, _, entries = logged(scenario)
    for seed in range(4):
        rng, shift_ns, hit = np.random.default_rng(seed), 0, list[tuple[int, bytes]]()
        fired = extreme(
            rng, len(entries), SAID_BY_VEHICLES + SAID_BY_STATIONS, source=(1, 2, 255, 9)[seed], targets=[0, 1]
        )
        for (time_ns, data), hostile in zip(entries, fired, strict=True):
            if hurt == "stamps" and rng.random() < 0.005:
                shift_ns = int(rng.choice([-(10**18), -(10**12), 0, 10**12, 2**62]))
            stamp_ns = max(0, time_ns + shift_ns)
            hit += [(stamp_ns, data), (stamp_ns, hostile)][: 1 + (rng.random() < 0.3)]
        if hurt == "stamps of no time":
            hit = [((2**64 - 1) * 1000, data) for _, data in hit]
        data = bytearray(log_bytes(hit))
        for at in rng.integers(len(data), size=300 if hurt == "bits" else 0).tolist():
            data[at] ^= 1 << at % 8
        log = parse_tlog(bytes(data))
        assert bool(log.frames) == (hurt != "stamps of no time")
        for known in (None, scenario) if log.frames else ():
            rebuild_report(log, LogSource(Path("a.tlog"), known, design if known else None, None)).to_json()
