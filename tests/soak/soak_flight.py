"""One experiment of the soak, flown in virtual time with its faults; `soak_checks.py` says what must hold.

The flight is the product's own `fly_lockstep`. A `World` between station and vehicles makes the faults and hashes every
byte. The truth comes from the vehicles and links themselves.
"""

import hashlib
import math
import struct
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gcs.control.phases import Phase
from gcs.control.tick import Event, TickArray
from gcs.drive.flown import Flight
from gcs.drive.guard import Guard
from gcs.drive.lockstep import EPOCH_NS, START_NS, Sent, fly_lockstep
from gcs.link.datagram import Datagram
from gcs.plan.flight_plan import FlightPlan
from gcs.station.station import Station
from scenarios.schema import NS_PER_S
from scenarios.signing.keys import Key
from scenarios.signing.stamps import Stamps
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.drive.guard import signed_links
from sim_vehicles.links.truth import MemoryRecorder
from sim_vehicles.services.clock import BootClock
from tests.soak.soak_experiments import Experiment, Fault
from tests.soak.soak_scenarios import AUTOPILOT_START_S
from tests.support.hostile import TO_VEHICLES, any_message, changed, noise

CONNECT_S = 25.0
"""Longest start of double integrators. A flight that takes longer than its start and duration is told to end."""
GARBAGE_A_STEP = 10
KEY = Key(bytes(range(32)))
_HEARTBEAT, _SET_POINT = 0, 84
_SET_POINT_FIELDS = struct.Struct("<I11fHBBB")


@dataclass(frozen=True)
class SetPoint:
    """What a SET_POSITION_TARGET_LOCAL_NED on the wire asks for; NaN for what its mask leaves out."""

    time_ns: int
    velocity_m_s: float
    acceleration_m_s2: float


@dataclass(frozen=True, eq=False)
class Stretch:
    """What one station saw and did. A flight has several stretches if the station was replaced."""

    station: Station
    ticks: TickArray
    start_ns: int
    replaced: bool
    states_at_end: dict[int, tuple[float, float, float, float]] = field(default_factory=dict)
    """True position and velocity (north, east) of each vehicle when the station decided to end the flight."""
    ended_ns: int = 0
    """The instant of that decision."""

    def flight(self) -> Flight:
        """The stretch as a flight for `summarise`."""
        end = Event(time_s=float(self.ticks["time_s"][-1, 0]), kind="end", text=self.station.end_reason)
        return Flight(self.ticks.ravel(), [*self.station.events, end])


@dataclass(frozen=True, eq=False)
class Flown:
    """A flight and its truth."""

    plan: FlightPlan
    stretches: list[Stretch]
    truth: np.ndarray[Any, Any]
    """Records of sim_vehicles.links.truth.DTYPE."""
    clocks: dict[int, BootClock]
    """Clocks of the vehicles at the start, by system id."""
    steps_ns: dict[int, int]
    """When the clock of each vehicle was first set."""
    silences_s: list[float]
    """Length of each time during which vehicles or the station were not heard."""
    set_points: list[SetPoint]
    sha256: str


class World:
    """The vehicles and their links, and what goes wrong with them."""

    def __init__(self, experiment: Experiment, fleet: Fleet) -> None:
        self.fleet = fleet
        self.digest = hashlib.sha256()
        self.set_points: list[SetPoint] = []
        self.flying = False
        """Whether a formation is flown. Before that, garbage could pass for a vehicle that is not yet known."""
        self._faults = experiment.faults
        self._steps = deque(fault for fault in experiment.faults if fault.kind == "clock step")
        self._rng = np.random.default_rng(experiment.scenario.seed)
        self._up: deque[bytes] = deque(maxlen=100)
        self._down: deque[bytes] = deque(maxlen=100)

    def step(self, received: Sent, now_ns: int) -> Sent:
        """Like `Fleet.step`, with the faults."""
        for _, data, time_ns in received:
            self._note(data, time_ns)
        received = [*self._passed(received)]
        self._down.extend(data for _, data, _ in received)
        under_fire = self._under_fire(now_ns)
        for system_id in under_fire:
            received += [(system_id, data, now_ns) for data in self._garbage(self._down, TO_VEHICLES)]
        arrived = [*self._passed(self.fleet.step(received, now_ns))]
        self._up.extend(data for _, data, _ in arrived)
        for system_id, data, time_ns in arrived:
            self.digest.update(b"%d %d " % (system_id, time_ns) + data)
        for system_id in under_fire:
            arrived += [(system_id, data, now_ns) for data in self._garbage(self._up, None)]
        # last: setting a clock advances its vehicle to now, past what was received meanwhile
        while self._steps and _ns(self._steps[0].from_s) <= now_ns:
            self._set_clocks(self._steps.popleft(), now_ns)
        return arrived

    def strangers(self, now_ns: int) -> list[Datagram]:
        """Datagrams from an address that no vehicle has: any message from any vehicle, except heartbeats."""
        if not self._under_fire(now_ns):
            return []
        ids = [*self.fleet.system_ids, *range(1, 256)]
        frames = any_message(self._rng, GARBAGE_A_STEP, ids, {_HEARTBEAT}) + noise(self._rng, GARBAGE_A_STEP)
        return [Datagram(data, 1_000_009, now_ns) for data in frames]

    def _under_fire(self, now_ns: int) -> tuple[int, ...]:
        if not self.flying or len(self._up) < 20 or len(self._down) < 20:
            return ()
        hit = [fault.system_ids for fault in self._faults if fault.kind == "garbage" and _during(fault, now_ns)]
        return hit[0] if hit else ()

    def _garbage(self, real: deque[bytes], left_out: set[int] | None) -> list[bytes]:
        """Hostile datagrams, none of which is a valid new message from a sender that may send it."""
        rng, count = self._rng, GARBAGE_A_STEP
        data = changed(rng, count, list(real)) + noise(rng, count)
        if left_out is not None:
            data += any_message(rng, count, list(range(256)), left_out)
        return [bytes(one) for one in data]

    def _passed(self, datagrams: Sent) -> Sent:
        cut = [fault for fault in self._faults if fault.kind in ("silence", "killed")]
        if not cut:
            return list(datagrams)
        return [d for d in datagrams if not any(d[0] in fault.system_ids and _during(fault, d[2]) for fault in cut)]

    def _set_clocks(self, fault: Fault, now_ns: int) -> None:
        for system_id in fault.system_ids:
            self.fleet.state(system_id, now_ns)  # advances the vehicle to now
            vehicle = self.fleet.vehicle(system_id)
            clock = vehicle.radio.clock
            shown_ns = clock.boot_ns(now_ns)
            to_ns = max(1_000_000, shown_ns + round(fault.by_s * NS_PER_S))  # no clock shows a time before its boot
            vehicle.radio.set_clock(BootClock(now_ns, to_ns, clock.drift_ppb), now_ns)
            self.fleet.state(system_id, now_ns)

    def _note(self, data: bytes, time_ns: int) -> None:
        self.digest.update(b"%d " % time_ns + data)
        if data[0] != 0xFD or int.from_bytes(data[7:10], "little") != _SET_POINT:
            return
        payload = data[10 : 10 + data[1]].ljust(_SET_POINT_FIELDS.size, b"\0")
        fields = _SET_POINT_FIELDS.unpack(payload)
        mask = fields[12]
        velocity = math.nan if mask & 0x18 else math.hypot(fields[4], fields[5])
        acceleration = math.nan if mask & 0xC0 else math.hypot(fields[7], fields[8])
        if not mask & 0x18 and not math.isfinite(velocity):
            velocity = math.inf
        if not mask & 0xC0 and not math.isfinite(acceleration):
            acceleration = math.inf
        self.set_points.append(SetPoint(time_ns, velocity, acceleration))


def fly(experiment: Experiment, plan: FlightPlan) -> Flown:
    """Fly an experiment once."""
    scenario = plan.scenario
    recorder = MemoryRecorder()
    ids = plan.formation.system_ids
    signed = signed_links(KEY, ids, epoch_ns=EPOCH_NS, stamps=Stamps()) if experiment.signed else None
    guard = Guard(KEY, epoch_ns=EPOCH_NS, stamps=Stamps()) if experiment.signed else None
    fleet = Fleet(scenario, START_NS, recorder=recorder, signed=signed)
    clocks = {system_id: fleet.vehicle(system_id).radio.clock for system_id in ids}
    world = World(experiment, fleet)
    deaths = [fault for fault in experiment.faults if fault.kind == "station replaced"]
    stretches: list[Stretch] = []
    start_ns = START_NS
    for death in [*deaths, None]:
        stretch = _stretch(plan, world, guard, start_ns, _ns(death.from_s) if death else 2**62)
        stretches.append(stretch)
        if death is None or not stretch.replaced:
            break
        start_ns = max(_ns(death.until_s), int(stretch.ticks["due_ns"][-1, 0]) + 1)
    steps_ns = {i: _ns(f.from_s) for f in reversed(experiment.faults) if f.kind == "clock step" for i in f.system_ids}
    if scenario.dynamics == "autopilot" and scenario.autopilot.clock_jumps:
        first_ns = _ns(scenario.autopilot.clock_jumps[0].at_s)
        steps_ns = {system_id: min(first_ns, steps_ns.get(system_id, first_ns)) for system_id in ids}
    for stretch in stretches:
        world.digest.update(stretch.ticks.tobytes())
    truth = recorder.records
    silent = [fault for fault in experiment.faults if fault.kind in ("silence", "killed", "station replaced")]
    silences_s = [fault.until_s - fault.from_s for fault in silent]
    return Flown(plan, stretches, truth, clocks, steps_ns, silences_s, world.set_points, world.digest.hexdigest())


def _stretch(plan: FlightPlan, world: World, guard: Guard | None, start_ns: int, dies_ns: int) -> Stretch:
    """One station's part of a flight, until it ends or dies."""
    scenario = plan.scenario
    station = Station(plan, start_ns=start_ns)
    start_s = 2.0 * AUTOPILOT_START_S if scenario.dynamics == "autopilot" else CONNECT_S
    until_ns = start_ns + round((start_s + scenario.duration_s) * NS_PER_S)
    ticks: list[TickArray] = []
    states: dict[int, tuple[float, float, float, float]] = {}
    ended_ns = 0
    for rows in fly_lockstep(plan, station=station, vehicles=world, guard=guard):
        ticks.append(rows)
        now_ns = int(rows["due_ns"][0])
        if now_ns >= dies_ns:
            break
        world.flying = station.phase is Phase.FLYING
        if station.phase is Phase.ENDING and not ended_ns:
            ended_ns = now_ns
            for system_id in plan.formation.system_ids:
                state = world.fleet.state(system_id, now_ns)
                states[system_id] = (state.north_m, state.east_m, *state.velocity_ne_m_s())
        if now_ns >= until_ns:
            assert now_ns < until_ns + 20 * NS_PER_S, "the station does not end although it was told to"
            station.request_stop("soak: time is up")
        if guard is None and station.next_event_ns > now_ns:  # otherwise the step does more than answer
            answers, _ = station.step(world.strangers(now_ns), now_ns)
            assert not answers, f"the station answers a stranger: {answers}"
    replaced = station.phase is not Phase.ENDED
    return Stretch(station, np.stack(ticks), start_ns, replaced, states, ended_ns)


def _during(fault: Fault, now_ns: int) -> bool:
    return _ns(fault.from_s) <= now_ns < (_ns(fault.until_s) if fault.until_s < math.inf else 2**62)


def _ns(time_s: float) -> int:
    return START_NS + round(time_s * NS_PER_S)
