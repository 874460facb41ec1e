"""Hostile datagrams change nothing but counters, at both ends: a flight under fire is flown as without it.

`FUZZ_DATAGRAMS=1000000 python3 make.py test tests/test_fuzz.py` sends as many to each end; a sample is sent by default.

Grammar-aware: frames of every message of the dialect with any content and a right checksum, and the flight's own frames
replayed, changed, cut short and glued together. Random: bytes, half of which begin as a frame does. New valid frames
from the station's or a vehicle's own address, and replays older than the 128 frames that a sequence number can tell
apart, are not meant: without signing those cannot be told from the real ones.
"""

import os
from collections import Counter, deque
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import ardupilotmega as dialect

from gcs.lockstep import START_NS
from gcs.modes import Phase
from gcs.plan import FlightPlan, flight_plan
from gcs.record import TickArray
from gcs.station import Datagram, Station
from scenarios.files import load
from scenarios.schema import FixedGains
from sim_vehicles.fleet import Fleet

COUNT = int(os.environ.get("FUZZ_DATAGRAMS", "20000"))
SECONDS = 4.0
BATCH = max(10, COUNT // round(SECONDS * 50) // 10 * 10 + 10)
CRC_EXTRA = {number: message.crc_extra for number, message in sorted(dialect.mavlink_map.items())}
TO_VEHICLES = {0, 76, 84, 111}
"""HEARTBEAT, COMMAND_LONG, SET_POSITION_TARGET_LOCAL_NED, TIMESYNC: a vehicle takes these from its station."""
COUNTERS = ["received", "lost", "late", "duplicate"]


def any_message(rng: np.random.Generator, count: int, system_ids: list[int], left_out: set[int]) -> list[bytes]:
    """Frames of any message but some, with any content and length, and the checksum right."""
    messages = [number for number in CRC_EXTRA if number not in left_out]
    lengths = rng.integers(0, 256, size=count).tolist()
    sources = rng.choice(system_ids, size=count).tolist()
    noise = rng.bytes(256 * count)
    frames: list[bytes] = []
    for k, number in enumerate(rng.choice(messages, size=count).tolist()):
        own = noise[256 * k : 256 * k + lengths[k]]
        body = bytes([lengths[k], 0, k & 0xFF, k >> 8 & 0xFF, sources[k], 1]) + number.to_bytes(3, "little") + own
        frames.append(b"\xfd" + body + mcrf4xx(body + bytes([CRC_EXTRA[number]])).to_bytes(2, "little"))
    return frames


def changed(rng: np.random.Generator, count: int, real: list[bytes]) -> list[bytes]:
    """Real frames with a byte changed, cut short, with bytes put in or written over, or with another glued behind."""
    places = rng.random(size=count).tolist()
    picks = rng.integers(len(real), size=(count, 2)).tolist()
    noise = rng.bytes(8 * count)
    out: list[bytes] = []
    for k, (one, two) in enumerate(picks):
        frame, own = real[one], noise[8 * k : 8 * k + 8]
        at = int(places[k] * len(frame))
        broken = frame[:at] + bytes([frame[at] ^ (own[0] or 1)]) + frame[at + 1 :]
        glued = broken + real[two][: int(places[k] * len(real[two]))]
        ways = (broken, frame[:at], frame[:at] + own + frame[at:], frame[:at] + own + frame[at + 8 :], glued)
        out.append(ways[k % 5])
    return [data for data in out if not holds_a_frame(data)]


def noise(rng: np.random.Generator, count: int) -> list[bytes]:
    """Random bytes, 0 to 300; half begin as a frame of MAVLink 1 or 2 does."""
    lengths = rng.integers(0, 300, size=count).tolist()
    whole, starts = rng.bytes(300 * count), (b"", b"\xfd", b"", b"\xfe")
    out = [starts[k % 4] + whole[300 * k : 300 * k + length] for k, length in enumerate(lengths)]
    return [data for data in out if not holds_a_frame(data)]


def holds_a_frame(data: bytes) -> bool:
    """Whether a valid MAVLink 2 frame begins anywhere: one change in 65,536 happens to leave the checksum right."""
    at = data.find(b"\xfd")
    while 0 <= at <= len(data) - 12:
        end = at + 10 + data[at + 1]
        extra = CRC_EXTRA.get(int.from_bytes(data[at + 7 : at + 10], "little"))
        if end + 2 <= len(data) and extra is not None:
            checksum = mcrf4xx(data[at + 1 : end] + bytes([extra]))
            if checksum == int.from_bytes(data[end : end + 2], "little"):
                return True
        at = data.find(b"\xfd", at + 1)
    return False


@dataclass
class Fire:
    """What is sent to both ends at each step, made from what passed lately."""

    system_ids: list[int]
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(20))
    fired: Counter[str] = field(default_factory=Counter[str])
    up: deque[tuple[int, bytes]] = field(default_factory=lambda: deque[tuple[int, bytes]](maxlen=300))
    down: deque[bytes] = field(default_factory=lambda: deque[bytes](maxlen=500))

    def at_station(self, now_ns: int) -> list[Datagram]:
        """From a stranger: anything, under any system id. From the vehicles' addresses: nothing new that is valid."""
        if self.fired["station"] >= COUNT or len(self.up) < 50:
            return []
        tenth, rng = BATCH // 10, self.rng
        real = [data for _, data in self.up]
        known_and_not = [*self.system_ids, *range(1, 256)]
        stranger = any_message(rng, 2 * tenth, known_and_not, set()) + list(self.rng.permuted(real)[:tenth])
        own = changed(rng, 4 * tenth, real) + noise(rng, 2 * tenth)
        own += any_message(rng, tenth, [k for k in range(1, 256) if k not in self.system_ids], set())
        fired = [Datagram(bytes(data), ("stranger", 9), now_ns) for data in stranger]
        fired += [Datagram(data, ("virtual", self.system_ids[k % 3]), now_ns) for k, data in enumerate(own)]
        fired += [Datagram(data, ("virtual", system_id), now_ns) for system_id, data in self.replays(tenth)]
        self.fired["station"] += len(fired)
        return fired

    def replays(self, count: int) -> list[tuple[int, bytes]]:
        return [self.up[k] for k in self.rng.integers(len(self.up), size=count).tolist()]

    def at_vehicles(self, now_ns: int) -> list[tuple[int, bytes, int]]:
        """All that does not pass for a message of the station to a vehicle."""
        if self.fired["vehicles"] >= COUNT or len(self.down) < 50:
            return []
        tenth = BATCH // 10
        data = any_message(self.rng, 3 * tenth, list(range(256)), TO_VEHICLES)
        data += changed(self.rng, 5 * tenth, list(self.down)) + noise(self.rng, 2 * tenth)
        self.fired["vehicles"] += len(data)
        return [(self.system_ids[k % 3], one, now_ns) for k, one in enumerate(data)]


def flown(plan: FlightPlan, fire: Fire | None) -> tuple[TickArray, Station, Fleet]:
    """A flight in virtual time, as gcs.lockstep flies it, with what is fired at both ends."""
    station, fleet = Station(plan, start_ns=START_NS), Fleet(plan.scenario, START_NS)
    ticks: list[TickArray] = []
    down: list[tuple[int, bytes, int]] = []
    while station.phase is not Phase.ENDED:
        now_ns = station.next_event_ns
        arrived = fleet.step(down, now_ns)
        datagrams = [Datagram(data, ("virtual", system_id), time_ns) for system_id, data, time_ns in arrived]
        if fire is not None:
            fire.up.extend((system_id, data) for system_id, data, _ in arrived)
            datagrams += fire.at_station(now_ns)
        outgoing, tick = station.step(datagrams, now_ns)
        down = [(int(address[1]), data, now_ns) for data, address in outgoing]
        if fire is not None:
            fire.down.extend(data for _, data, _ in down)
            down += fire.at_vehicles(now_ns)
        if tick is not None:
            ticks.append(station.complete(tick, now_ns))
            station.frames.clear()
    return np.concatenate(ticks), station, fleet


def refused(counters: Counter[str]) -> int:
    return sum(count for name, count in counters.items() if name.startswith(("refused", "ignored")))


def test_a_flight_under_fire_is_the_flight_without_it() -> None:
    scenario = load(Path(__file__).parent.parent / "scenarios" / "chain3.toml")
    control = scenario.control.model_copy(update={"gains": FixedGains(K1=-3.4, K2=0.6, K3=5.6)})
    _, plan = flight_plan(scenario.model_copy(update={"duration_s": SECONDS, "control": control}))
    calm, calm_station, calm_fleet = flown(plan, None)
    fire = Fire(list(plan.formation.system_ids))
    hit, station, fleet = flown(plan, fire)
    assert min(fire.fired["station"], fire.fired["vehicles"]) > 0.9 * COUNT
    for name in hit.dtype.names or ():
        if name not in COUNTERS:
            np.testing.assert_array_equal(hit[name], calm[name], err_msg=name)
    assert station.events == calm_station.events
    unmatched = sum(
        vehicle.clock.unmatched + vehicle.frames.duplicate + vehicle.frames.late for vehicle in station.vehicles
    )
    counted = station.counters.total() + unmatched
    assert counted > 0.8 * fire.fired["station"]  # what is refused bears a name
    for name in ("setpoints", "heartbeats"):
        assert fleet.counters[name] == calm_fleet.counters[name]
    assert refused(fleet.counters) - refused(calm_fleet.counters) >= 0.95 * fire.fired["vehicles"]
    assert hit["duplicate"].max() + hit["late"].max() > 0  # the replays were seen to be replays
