"""All vehicles of a scenario with their links, as one function of datagrams and time.

The drivers on real UDP and on a virtual clock both call `Fleet.step`; the same seed, start and datagrams give the same
bytes at the same times.
"""

import heapq
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from scenarios import schema
from scenarios.files import fingerprint
from scenarios.kernel import Columns, Records
from scenarios.keys.link import Links
from scenarios.schema import NS_PER_S
from scenarios.signing.link import SignedLink
from scenarios.sockets import Bytes, Ints
from sim_vehicles.drive.datagrams import Datagram, Datagrams, datagrams_of
from sim_vehicles.links.links import Link, LinkSet, is_set_point
from sim_vehicles.links.truth import MemoryRecorder, Recorder, can_record
from sim_vehicles.motion.copter import Motion, Target, advance
from sim_vehicles.motion.double_integrator import State
from sim_vehicles.motion.lagged import inner_of
from sim_vehicles.motion.sector import SectorBound
from sim_vehicles.services.clock import NEVER_NS
from sim_vehicles.services.frames import FRAME_BYTES
from sim_vehicles.services.hot import Place, new_vehicles
from sim_vehicles.services.mavlink import rehearsal
from sim_vehicles.services.services import LONGEST_TEXT
from sim_vehicles.vehicles.copter import Copter
from sim_vehicles.vehicles.double_integrator import DoubleIntegrator
from sim_vehicles.vehicles.external import ExternallyFlown
from sim_vehicles.vehicles.onboard import VehicleLoop
from sim_vehicles.vehicles.plain import leave_all, next_leaving_ns, run_at, step_all
from sim_vehicles.vehicles.shell import Change, Radio, Shell

_DUE_THEN_SYSTEM_ID = itemgetter(2, 0)


@dataclass(slots=True)
class _Member:
    row: int
    vehicle: Shell[DoubleIntegrator | Copter | ExternallyFlown]
    up: Link
    down: Link
    signed: SignedLink | None = None


class FleetArrays(NamedTuple):
    """The arrays on which a kernel runs the common events of a fleet."""

    vehicles: Records
    links: Records
    entries: Records
    frames: Bytes
    draws: Records
    truth: Records
    waiting: Ints
    leaving: Ints
    leaving_data: Bytes


class Fleet:
    """The vehicles and links of a scenario.

    Vehicles do not affect each other, so each is brought up to date only when one of its datagrams can leave, in order
    of that time and of system id. This delays nothing: every event carries its exact time. There are three exceptions:
    in a shared channel one vehicle's datagrams delay another's, a sensor sees another vehicle, and a disturbance may
    depend on the errors of all. With any of these, events run in order of time; at equal times the station's datagrams
    enter their links first, then the disturbance acts, then the vehicles by system id.

    One kernel call (`vehicles.plain`) lets the station's datagrams enter, runs the common events of all plain vehicles
    and collects what leaves. Python runs the rest, vehicle by vehicle: the other events of plain vehicles, and all
    events of the others.

    `signed` holds the vehicles' ends of signed links by system id: they sign what the vehicles send, and pass on to the
    vehicles only what they could verify.
    """

    def __init__(
        self,
        scenario: schema.Scenario,
        start_ns: int,
        *,
        recorder: Recorder | None = None,
        signed: Mapping[int, SignedLink] | None = None,
    ) -> None:
        self._refused: Counter[str] = Counter()
        self._recorder = recorder
        self._start_ns = start_ns
        self._members: dict[int, _Member] = {}
        self._external: ExternallyFlown | None = None
        """The leader, until the flight begins, if somebody else flies it."""
        count = len(scenario.vehicles)
        self._links = LinkSet(scenario, start_ns, recorder=recorder, most=count)
        self._vehicles = new_vehicles(count)
        self._columns = Columns(self._vehicles)
        self._waiting = np.zeros((count, 2), np.int64)
        self._acts_ns = np.zeros(count, np.int64)
        """When each vehicle next acts, or a datagram reaches it. Used only if events run in order of time."""
        most = max(64, 2 * count)  # datagrams that leave in one call; the kernel returns more of them in parts
        self._leaving, self._leaving_data = np.zeros((4, most), np.int64), np.zeros(most * FRAME_BYTES, np.uint8)
        self._edge = self._waiting, self._leaving, self._leaving_data
        self._entering: list[tuple[int, int, int, bytes]] = []
        """The station's datagrams if events run in order of time: (time, system id, number, data), earliest first."""
        self._entered = 0
        sensors = scenario.control.loop == "onboard"
        experiment = f"{fingerprint(scenario)} {scenario.name}"[:LONGEST_TEXT]
        disturbance = scenario.disturbance
        self._sector = None if disturbance is None or disturbance.sector is None else SectorBound(scenario)
        self._disturbs_ns = NEVER_NS if self._sector is None else start_ns
        """When the disturbance that depends on the errors of all vehicles next acts."""
        self._in_order = sensors or self._links.have_channels or self._sector is not None
        for row, own in enumerate(sorted(scenario.vehicles, key=lambda vehicle: vehicle.system_id)):
            radio = Radio(scenario, own, start_ns, recorder, Place(self._vehicles, self._columns, row))
            craft: DoubleIntegrator | Copter | ExternallyFlown
            if scenario.dynamics == "autopilot":
                craft = Copter(scenario, own, radio)
            else:
                onboard = VehicleLoop(scenario, own.system_id, self._seen) if sensors else None
                craft = DoubleIntegrator(scenario, own, radio, onboard)
            if own.system_id == scenario.external_id:
                craft = self._external = ExternallyFlown(scenario, craft, scenario.altitude_of(own))
            vehicle = Shell(scenario, radio, craft, signed=bool(signed), experiment=experiment)
            up, down = self._links.of(own.system_id)
            self._members[own.system_id] = _Member(row, vehicle, up, down, signed[own.system_id] if signed else None)
            self._columns["plain"][row] = craft.is_plain and up.plain and not signed and not self._in_order
        self._in_rows, self.system_ids = [*self._members.values()], tuple(self._members)
        self._rows = {system_id: row for row, system_id in enumerate(self._members)}
        for member in self._in_rows:
            self._plan(member)

    @property
    def next_event_ns(self) -> int:
        """Until this time in ns, `step` returns nothing unless datagrams arrive."""
        return next_leaving_ns(*self._arrays()[:2])

    @property
    def commanded_ns(self) -> int:
        """When a station last commanded a vehicle; the start if never."""
        return max(self._start_ns, int(self._vehicles["commanded_ns"].max()))

    @property
    def shut_down_ns(self) -> int:
        """When the last vehicle was told to shut down; NEVER_NS until all have been."""
        told_ns = [member.vehicle.services.shut_down_ns for member in self._members.values()]
        return NEVER_NS if None in told_ns else max(ns for ns in told_ns if ns is not None)

    def mark_orphaned(self) -> None:
        """From now on the vehicles obey a command to shut down: the station that started them has gone."""
        for member in self._members.values():
            member.vehicle.services.orphaned = True

    @property
    def counters(self) -> Counter[str]:
        """The sum of the vehicles' counters, and those of the links (LinkSet.counters)."""
        total = self._links.counters()
        total.update({f"refused_{reason.lower().replace(' ', '_')}": count for reason, count in self._refused.items()})
        for member in self._members.values():
            total.update(member.vehicle.counters)
        return total

    def lost_share(self, *, up: bool) -> float:
        """Fraction of datagrams lost on up links (from vehicles) or down links; those still under way do not count."""
        links = [member.up if up else member.down for member in self._in_rows]
        ended = sum(link.entered + link.counts["duplicated"] - link.under_way for link in links)
        return sum(link.dropped for link in links) / max(ended, 1)

    @property
    def channel_needs_s(self) -> dict[str, float]:
        """See LinkSet.channel_needs_s."""
        return self._links.channel_needs_s()

    def vehicle(self, system_id: int) -> Shell[DoubleIntegrator | Copter | ExternallyFlown]:
        """One vehicle, as of the last time it was brought up to date; `state` is exact at any time."""
        return self._members[system_id].vehicle

    def take_changes(self) -> list[Change]:
        """The changes of all vehicles since the last call, in order of time."""
        changes: list[Change] = []
        for member in self._members.values():
            if member.vehicle.changes:
                changes += member.vehicle.changes
                member.vehicle.changes.clear()
        return sorted(changes)

    def step(self, received: Datagrams | Sequence[Datagram], now_ns: int) -> Datagrams | list[Datagram]:
        """The datagrams that leave the up links by now, with their exact times, in order of time.

        `received` are datagrams of the station, with the times at which each enters its vehicle's down link.
        """
        if self._links.zero_ns == NEVER_NS or self._external is not None:
            for _, data, time_ns in received:
                self._links.hear(data, time_ns)
                self._begin(data, time_ns)
        if self._in_order:
            self._run_in_order(received, now_ns)
            received = ()
        entering = received if isinstance(received, Datagrams) else datagrams_of(received, self._rows)
        begun = step_all(*self._arrays(), entering.stream, entering.table, *self._edge, 0, now_ns)
        return self.left(self.go_on(entering, *begun, now_ns), now_ns)

    def go_on(self, entering: Datagrams, entered: int, waiting: int, leaving: int, now_ns: int) -> int:
        """Continue a step begun by `step_all`, which returned the three numbers; returns how many datagrams have left.

        These datagrams are in `arrays`. More may leave, see `all_left` and `left`.
        """
        while entered < len(entering):
            begin, end, row, time_ns = entering.table[:, entered].tolist()
            self._in_rows[row].down.send(entering.stream[begin:end].tobytes(), time_ns)
            stream, table = entering.stream, entering.table
            entered, waiting, leaving = step_all(*self._arrays(), stream, table, *self._edge, entered + 1, now_ns)
        if waiting:
            self._run_waiting(waiting, now_ns)
            leaving = self._leave(now_ns)
        return leaving

    def all_left(self, count: int) -> bool:
        """Whether the `count` datagrams that have left in `go_on` are all that leave by its time."""
        return count < self.most_leaving and (self._recorder is None or can_record(self._recorder.rows))

    def left(self, count: int, now_ns: int) -> Datagrams | list[Datagram]:
        """The `count` datagrams that have left in `go_on`, and all others that leave by its time, in order of time."""
        left = self._left(count)
        if self.all_left(count):
            return left
        out = [*left]
        while count := self._leave(now_ns):
            out += self._left(count)
        out.sort(key=_DUE_THEN_SYSTEM_ID)
        return out

    @property
    def has_fast_path(self) -> bool:
        """Whether `step` does nothing before `step_all` except notice when the links' time begins."""
        return self._external is None and not self._in_order

    @property
    def knows_link_time(self) -> bool:
        """Whether the zero of the links' time is known: by default, the station's first set-point."""
        return self._links.zero_ns != NEVER_NS

    def make_ready(self) -> None:
        """Make random draws ahead, enough for kernels to run some steps."""
        self._links.draw()

    @property
    def arrays(self) -> FleetArrays:
        """The arrays of `step_all`. A step may replace some of them, unless it runs in kernels alone."""
        return FleetArrays(*self._arrays(), *self._edge)

    @property
    def most_leaving(self) -> int:
        """How many datagrams can leave in one call of `step_all`."""
        return self._leaving.shape[1]

    def _leave(self, now_ns: int) -> int:
        if self._recorder is not None:
            self._recorder.make_room()
        vehicles, links, entries, frames, _, truth = self._arrays()
        return leave_all(vehicles, links, entries, frames, truth, self._leaving, self._leaving_data, now_ns)

    def _left(self, count: int) -> Datagrams:
        """The first `count` datagrams that the kernel let leave, in order of time and row."""
        table = self._leaving[:, :count]
        size = table[1, -1] if count else 0
        in_order = table.take(table[3].argsort(kind="stable"), axis=1)
        return Datagrams(self._leaving_data[:size].copy(), in_order, self.system_ids)

    def _arrays(self) -> tuple[Records, Records, Records, Bytes, Records, Records]:
        """The arrays of the kernels."""
        queues = self._links.queues
        return self._vehicles, queues.links, queues.entries, queues.frames, queues.draws, queues.truth

    def _run_waiting(self, count: int, now_ns: int) -> None:
        """Bring up to date the vehicles that the kernel has left to Python."""
        for _, row in sorted(self._waiting[:count].tolist()):
            member = self._in_rows[row]
            while self._columns["plain"][row]:
                member.up.make_ready()
                if run_at(*self._arrays(), row, now_ns):
                    break
                self._catch_up(member, min(self._columns["acts_ns"][row], member.down.next_due_ns))  # one event
            else:
                self._catch_up(member, now_ns)
                self._plan(member)

    def _begin(self, data: bytes, time_ns: int) -> None:
        """Begin the flight of a leader flown by somebody else, at the station's first set-point."""
        if self._external is not None and is_set_point(data):
            self._external.begin(time_ns)
            self._external = None
            for member in self._members.values():
                self._plan(member)

    def state(self, system_id: int, now_ns: int) -> State:
        """The true state of a vehicle now, after everything that has reached it by now."""
        if self._in_order:
            self._run_in_order((), now_ns)
        member = self._members[system_id]
        self._catch_up(member, now_ns)
        self._plan(member)
        return member.vehicle.craft.state_at(now_ns)

    def _seen(self, system_id: int, now_ns: int) -> State | None:
        """What a sensor sees of a vehicle: its true state now; None if there is no such vehicle."""
        member = self._members.get(system_id)
        return None if member is None else member.vehicle.craft.state_at(now_ns)

    def _run_in_order(self, received: Iterable[Datagram], now_ns: int) -> None:
        """Run everything until now in order of time: the station's datagrams, and the vehicles."""
        for system_id, data, time_ns in received:
            self._entered += 1
            heapq.heappush(self._entering, (time_ns, system_id, self._entered, data))
        entering = self._entering
        while True:
            row = self._acts_ns.argmin()
            first_ns = min(self._disturbs_ns, self._acts_ns.item(row))
            enters_ns = entering[0][0] if entering else NEVER_NS
            if enters_ns <= first_ns and enters_ns <= now_ns:
                time_ns, system_id, _, data = heapq.heappop(entering)
                member = self._members[system_id]
                member.down.send(data, time_ns)
            elif first_ns > now_ns:
                return
            elif first_ns == self._disturbs_ns:
                self._disturb(first_ns)
                continue
            else:
                member = self._in_rows[row]
                self._catch_up(member, first_ns)
            self._plan(member)

    def _disturb(self, now_ns: int) -> None:
        """Set each vehicle's push for the next period from the true errors now."""
        assert self._sector is not None
        crafts = {system_id: member.vehicle.craft for system_id, member in self._members.items()}
        for system_id, push in self._sector.pushes(lambda system_id: crafts[system_id].state_at(now_ns)).items():
            craft = crafts[system_id]
            assert isinstance(craft, DoubleIntegrator)  # checked when the scenario was read
            craft.push(push, now_ns)
        self._disturbs_ns = now_ns + self._sector.period_ns

    def _catch_up(self, member: _Member, now_ns: int) -> None:
        """Bring a vehicle up to date; what it sends enters its up link."""
        arrived: list[tuple[bytes, int]] = []
        if member.down.next_due_ns <= now_ns:
            for entry in member.down.due(now_ns):
                arrived.append((entry[3], entry[0]))
                if self._recorder is not None:
                    self._recorder.add(member.down.row(entry, entry[0]))
        if member.signed is not None:
            arrived = [(member.signed.verify(data, time_ns, self._refused), time_ns) for data, time_ns in arrived]
            arrived = [(data, time_ns) for data, time_ns in arrived if data]
        for data, time_ns in member.vehicle.step(arrived, now_ns):
            member.up.send(data if member.signed is None else member.signed.sign(data, time_ns), time_ns)

    def _plan(self, member: _Member) -> None:
        """Note when the vehicle next acts."""
        self._columns["acts_ns"][member.row] = acts_ns = member.vehicle.next_event_ns
        if self._in_order:
            self._acts_ns[member.row] = min(acts_ns, member.down.next_due_ns)


def prepare(scenario: schema.Scenario) -> None:
    """Compile the kernels before real time begins.

    Plain vehicles fly for seconds, with a log and without; copters, if any, stand on the ground and move once.
    """
    if scenario.dynamics == "autopilot":
        advance(Motion(0j, inner=inner_of(scenario.autopilot)), Target(), scenario.autopilot, 0.02)
        Fleet(scenario.model_copy(update={"links": Links()}), 0).step((), NS_PER_S)
    plain = {"dynamics": "double_integrator", "links": Links()}
    for recorder in (None, MemoryRecorder()):
        fleet = Fleet(scenario.model_copy(update=plain), 0, recorder=recorder)
        for tenth, frames in enumerate(zip(*map(rehearsal, fleet.system_ids), strict=True)):
            now_ns = tenth * NS_PER_S // 10
            fleet.step([(key, data, now_ns) for key, data in zip(fleet.system_ids, frames, strict=True)], now_ns)
        fleet.step((), 3 * NS_PER_S)
        fleet.vehicle(fleet.system_ids[0]).radio.encoder.timesync(1, 1)  # as in answer to a datagram of several frames
