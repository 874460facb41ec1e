"""Signed flights in virtual time, with the same bytes as on real sockets, and what either end lets in."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.control.phases import Phase
from gcs.control.tick import TickArray
from gcs.drive.guard import Guard
from gcs.drive.lockstep import START_NS, Sent, fly_lockstep
from gcs.link.datagram import Datagram
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.planner import flight_plan
from gcs.station.station import Station
from scenarios.files import load
from scenarios.keys.part import Flavour
from scenarios.schema import FixedGains, Response
from scenarios.signing.keys import Key
from scenarios.signing.stamps import Stamps
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.drive.guard import signed_links
from tests.support.paths import SCENARIOS
from tests.support.signed_peer import EPOCH_NS, KEY, OTHER_KEY, a_sender, stamp


def a_plan(name: str, duration_s: float) -> FlightPlan:
    scenario = load(SCENARIOS / f"{name}.toml")
    control = scenario.control.model_copy(update={"gains": FixedGains(K1=-3.4, K2=0.6, K3=5.6)})
    _, plan = flight_plan(scenario.model_copy(update={"duration_s": duration_s, "control": control}))
    return plan


def a_guard(key: bytes = KEY, stamps: Stamps | None = None) -> Guard:
    return Guard(Key(key), epoch_ns=EPOCH_NS, stamps=stamps or Stamps())


def a_fleet(plan: FlightPlan, key: bytes | None = KEY) -> Fleet:
    if key is None:
        return Fleet(plan.scenario, START_NS)
    links = signed_links(Key(key), plan.formation.system_ids, epoch_ns=EPOCH_NS, stamps=Stamps())
    return Fleet(plan.scenario, START_NS, signed=links)


@dataclass
class Attacked:
    """Vehicles, and an attacker who hears every datagram and sends to both ends, from the right addresses."""

    fleet: Fleet
    up: list[tuple[int, bytes]] = field(default_factory=list[tuple[int, bytes]])
    down: list[tuple[int, bytes]] = field(default_factory=list[tuple[int, bytes]])
    sent: Counter[str] = field(default_factory=Counter[str])
    step_number: int = 0

    def step(self, received: Sent, now_ns: int) -> Sent:
        self.step_number += 1
        self.down += [(system_id, data) for system_id, data, _ in received]
        hostile = [(system_id, data, now_ns) for system_id, data in self.to_vehicles()]
        arrived = self.fleet.step(list(received) + hostile, now_ns)
        self.up += [(system_id, data) for system_id, data, _ in arrived]
        return [*arrived, *((system_id, data, now_ns) for system_id, data in self.to_station())]

    def to_vehicles(self) -> list[tuple[int, bytes]]:
        if self.step_number % 5 or len(self.down) < 400:
            return []
        forger = a_sender(key=OTHER_KEY, timestamp=10**14, system=255)
        plain = a_sender(key=None, system=255)
        plain_1 = dialect.MAVLink_command_long_message(2, 1, 400, 0, 0, 21196, 0, 0, 0, 0, 0)
        commands = {
            "wrong signature": plain_1.pack(forger),
            "unsigned": plain_1.pack(plain),
            "MAVLink 1": plain_1.pack(plain, force_mavlink1=True),
        }
        self.sent.update(f"down {reason}" for reason in commands)
        self.sent.update(["down replayed"])
        return [(2, data) for data in commands.values()] + [self.down[-300]]

    def to_station(self) -> list[tuple[int, bytes]]:
        if self.step_number % 5 or len(self.up) < 400:
            return []
        forger, plain = a_sender(key=OTHER_KEY, timestamp=10**14, system=2), a_sender(key=None, system=2)
        position = dialect.MAVLink_local_position_ned_message(2**32 - 1, 9e5, 9e5, 0.0, 0.0, 0.0, 0.0)
        frames = {
            "wrong signature": position.pack(forger),
            "unsigned": position.pack(plain),
            "MAVLink 1": position.pack(plain, force_mavlink1=True),
        }
        self.sent.update(f"up {reason}" for reason in frames)
        self.sent.update(["up replayed"])
        return [(2, data) for data in frames.values()] + [self.up[-300]]


def flown(plan: FlightPlan, vehicles: Any, guard: Guard | None) -> tuple[TickArray, Station]:
    station = Station(plan, start_ns=START_NS)
    return np.concatenate(list(fly_lockstep(plan, station=station, vehicles=vehicles, guard=guard))), station


def test_a_signed_flight_is_the_unsigned_flight_bit_by_bit() -> None:
    plan = a_plan("triangle5", 6.0)
    plain, plain_station = flown(plan, a_fleet(plan, None), None)
    signed, station = flown(plan, a_fleet(plan), a_guard())
    assert station.end_reason == "completed: duration reached"
    for name in plain.dtype.names or ():
        np.testing.assert_array_equal(signed[name], plain[name], err_msg=name)
    assert station.events == plain_station.events
    assert not station.counters


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_signed_copters_start_and_fly(flavour: Flavour) -> None:
    """Among them a PX4, which without signing speaks MAVLink 1 until it hears MAVLink 2."""
    scenario = load(SCENARIOS / "copters5.toml")
    autopilot = scenario.autopilot.model_copy(update={"flavour": flavour})
    response = Response(lag_s=0.15, velocity_gain_1_s=2.0)
    update = {"autopilot": autopilot, "response": response, "duration_s": 5.0}
    _, plan = flight_plan(scenario.model_copy(update=update))
    fleet = a_fleet(plan)
    ticks, station = flown(plan, fleet, a_guard())
    assert station.end_reason == "completed: duration reached"
    assert ticks["commanded"].sum() > 1000
    assert not station.counters
    assert not any(name.startswith("refused") for name in fleet.counters)


def test_attacks_at_both_ends_do_not_change_a_signed_flight() -> None:
    plan = a_plan("triangle5", 6.0)
    calm, calm_station = flown(plan, a_fleet(plan), a_guard())
    attacked = Attacked(a_fleet(plan))
    hit, station = flown(plan, attacked, a_guard())
    for name in calm.dtype.names or ():
        np.testing.assert_array_equal(hit[name], calm[name], err_msg=name)
    assert station.events == calm_station.events
    assert min(attacked.sent.values()) > 50
    for reason in ("wrong signature", "unsigned", "MAVLink 1", "replayed"):
        assert station.counters[reason] == attacked.sent[f"up {reason}"]
        found = attacked.fleet.counters[f"refused_{reason.lower().replace(' ', '_')}"]
        # Some are still on the link when the flight ends.
        assert attacked.sent[f"down {reason}"] - 10 <= found <= attacked.sent[f"down {reason}"]


@pytest.mark.parametrize(
    ("fleet_key", "station_key", "reason"),
    [(None, KEY, "unsigned"), (OTHER_KEY, KEY, "wrong signature"), (KEY, None, "")],
)
def test_ends_without_a_common_key_do_not_fly(fleet_key: Any, station_key: Any, reason: str) -> None:
    plan = a_plan("chain3", 1.0)
    fleet = a_fleet(plan, fleet_key)
    ticks, station = flown(plan, fleet, a_guard(station_key) if station_key else None)
    assert station.end_reason.startswith("not ready: vehicle 1 ")
    assert not ticks["commanded"].any()
    assert fleet.counters["setpoints"] == fleet.counters["commands"] == 0
    if reason:
        assert station.counters[reason] > 30
    else:  # a station without signing hears signed vehicles, but they do not listen to it
        assert fleet.counters["refused_unsigned"] > 30


def test_reordering_links_cost_frames_but_look_like_no_attack() -> None:
    plan = a_plan("wifi_bursts", 10.0)
    fleet = a_fleet(plan)
    _, station = flown(plan, fleet, a_guard())
    assert station.end_reason == "completed: duration reached"
    assert station.counters["overtaken"] > 0
    counters = fleet.counters
    assert station.counters["overtaken"] > 100
    assert station.counters["replayed"] == counters["link_up_duplicated"]
    # Flipped bits in a frame's last 13 bytes, its signature, show in no checksum: not all of these are attacks.
    assert station.counters["wrong signature"] <= counters["link_up_corrupted"]
    assert counters["refused_overtaken"] > 100
    assert counters["refused_replayed"] <= counters["link_down_duplicated"]
    assert counters["refused_wrong_signature"] <= counters["link_down_corrupted"]


def test_a_restarted_station_refuses_what_was_recorded_before() -> None:
    plan = a_plan("chain3", 1.0)
    memory = Stamps()
    attacked = Attacked(a_fleet(plan))
    flown(plan, attacked, a_guard(stamps=memory))
    recorded = [Datagram(data, system_id, START_NS) for system_id, data in attacked.up]
    refused: Counter[str] = Counter()
    again = a_guard(stamps=Stamps(memory.memory))
    assert again.received(recorded, START_NS + 10**9, refused) == []
    assert refused == {"replayed": len(recorded)}
    assert a_guard().received(recorded, START_NS + 10**9, Counter())


def test_an_earlier_copy_from_elsewhere_makes_no_frame_a_replay() -> None:
    plan = a_plan("chain3", 2.0)
    calm, _ = flown(plan, a_fleet(plan), a_guard())
    station, guard, fleet = Station(plan, start_ns=START_NS), a_guard(), a_fleet(plan)
    ticks: list[TickArray] = []
    down: Sent = []
    copies = 0
    while station.phase is not Phase.ENDED:
        now_ns = station.next_event_ns
        arrived = [Datagram(data, k, at_ns) for k, data, at_ns in fleet.step(down, now_ns)]
        first = [Datagram(d.data, 1_000_009, d.received_ns) for d in arrived] if now_ns > 2 * 10**9 else []
        copies += len(first)
        outgoing, tick = station.step(
            guard.received(first + arrived, now_ns, station.counters, station.is_another), now_ns
        )
        down = [(address, data, now_ns) for data, address in guard.sent(outgoing, now_ns)]
        if tick is not None:
            ticks.append(station.complete(tick, [now_ns] * len(outgoing)))
    for name in calm.dtype.names or ():
        np.testing.assert_array_equal(np.concatenate(ticks)[name], calm[name], err_msg=name)
    assert station.counters == {"known system id from another address": copies}


def test_a_mavlink_1_heartbeat_is_an_exception_only_without_signing() -> None:
    scenario = load(SCENARIOS / "copters5.toml")
    _, plan = flight_plan(scenario)
    heartbeat = dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3).pack(
        a_sender(key=None, system=scenario.vehicles[0].system_id), force_mavlink1=True
    )
    datagram = [Datagram(heartbeat, 9, START_NS)]
    open_station, guarded = Station(plan, start_ns=START_NS), Station(plan, start_ns=START_NS)
    open_station.step(datagram, START_NS)
    assert open_station.vehicles[0].address == 9
    guarded.step(a_guard().received(datagram, START_NS, guarded.counters), START_NS)
    assert guarded.vehicles[0].address is None
    assert guarded.counters == {"MAVLink 1": 1}


def test_what_is_logged_of_a_signed_flight_has_no_signatures() -> None:
    plan = a_plan("chain3", 0.5)
    station, guard, fleet = Station(plan, start_ns=START_NS), a_guard(), a_fleet(plan)
    down: Sent = []
    for _ in range(40):
        now_ns = station.next_event_ns
        arrived = [Datagram(data, k, at_ns) for k, data, at_ns in fleet.step(down, now_ns)]
        outgoing, _ = station.step(guard.received(arrived, now_ns, station.counters, station.is_another), now_ns)
        signed = guard.sent(outgoing, now_ns)
        assert all(stamp(data) > 0 and data[2] == 1 for data, _ in signed)
        down = [(address, data, now_ns) for data, address in signed]
    assert len([*station.frames]) > 20
    assert all(data[2] == 0 and len(data) == 12 + data[1] for data, _, _ in station.frames)
