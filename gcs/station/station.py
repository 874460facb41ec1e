"""The ground station as a pure state machine: datagrams and the time in, datagrams and tick records out.

One loop: receive, decide, command, record. It uses no socket, clock or file; a driver calls `step` in real time or in
virtual time, with the same bytes.
"""

from collections.abc import Callable, Iterable, Sequence
from math import hypot, inf, nan
from operator import is_

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray, IntArray
from gcs.control.law import nearest
from gcs.control.limits import LARGEST_COMMAND_M_S2, shorten
from gcs.control.loop_delay import repeated_s
from gcs.control.loops import Orders, TickInputs
from gcs.control.own_law import FlownLaw
from gcs.control.phases import END_PATIENCE_S, Phase, next_phase, patience_s
from gcs.control.tick import GAIN_SET, NOT_CONFIRMED, SEVERITY, Mode, TickArray
from gcs.link import mavlink
from gcs.link.clocks import UNANSWERED
from gcs.link.datagram import Arrivals, Block, Datagram, Outbox
from gcs.link.kinds import Goal
from gcs.link.vehicle import HEARTBEAT, RemoteVehicle, heartbeats_to, in_words, note_requests, set_points_to
from gcs.plan.flight_plan import FlightPlan
from gcs.station.absence import LEFT_OUT, LOST, PILOTED, absence, describe_change, end_reason, off_the_ground
from gcs.station.breakage import Breakage, not_formed
from gcs.station.fast_path import (
    COMING,
    HEARTBEAT_NS,
    SCHEDULE,
    FastPathData,
    commanded,
    fast_set_points,
    limits_of,
    new_scratch,
    requested,
)
from gcs.station.fleet_kind import fleet_of
from gcs.station.journal import Journal
from gcs.station.monitor import FormationMonitor, Seen
from gcs.station.reception import Reception, take_fresh
from gcs.station.tick_rows import Judged, Tick, tick_rows
from scenarios.kernel import Cell, Columns, Records
from scenarios.schema import NS_PER_S

_REQUESTS_APART_NS = 7_000_000
"""Minimum time between two wake-ups for TIMESYNC requests, or a third of the control period if that is shorter."""
_IN_A_TICK = 50
"""Maximum number of vehicles that are started or told of a change in one tick; if there are more, they take turns."""
Tolerances = tuple[FloatArray, FloatArray]
"""How much shorter and longer than assumed each vehicle's loop delay may be, both (n, sets)."""
_NEAR = 0.1
"""A returning vehicle is near its place if its spacing error is within this fraction of the limit."""


class Station:
    """Flies one formation. `start_ns` is the time of the first control tick.

    `stopwatch_ns` is a clock that times the calls of the user's own control law; None in virtual time. `strangers`:
    whether vehicles must say that they are simulated before they are commanded.
    """

    next_tick_ns = Cell[int]()
    """When the next control tick is due."""
    _next_heartbeat_ns, _next_requests_ns = Cell[int](), Cell[int]()
    _tick_count = Cell[int]()

    def __init__(
        self,
        plan: FlightPlan,
        *,
        start_ns: int,
        stopwatch_ns: Callable[[], int] | None = None,
        strangers: bool = False,
    ) -> None:
        scenario = plan.scenario
        rates = scenario.rates
        self.plan = plan
        self.phase = Phase.CONNECTING
        self.end_reason = ""
        self._start_patience_s = patience_s(scenario)
        self._journal = journal = Journal(start_ns, self._start_patience_s)
        self.events, self._report, self.scenario_time_s = journal.events, journal.report, journal.scenario_time_s
        """See `Journal`."""
        own = None if plan.law is None else FlownLaw(plan, journal.report, journal.request_stop, stopwatch_ns)
        self._fleet = fleet_of(plan, journal.report, own, strangers=strangers)
        self.vehicles, self.together_ns = self._fleet.vehicles, self._fleet.together_ns
        n = len(self.vehicles)
        self.period_ns = round(NS_PER_S / rates.control_hz)
        self._reception = Reception(self._fleet, journal.report, start_ns=start_ns, period_ns=self.period_ns)
        self._history = self._reception.history
        self.frames, self.counters = self._reception.frames, self._reception.counters
        self.is_another = self._reception.is_another
        """See `Reception`."""
        self._law = self._fleet.loop.law([False] * n)
        self._breakage = Breakage(plan)
        self._limits = limits_of(plan)
        self._speed_max_m_s = scenario.limits.speed_max_m_s or LARGEST_COMMAND_M_S2
        period_s, timesync_ns = self.period_ns / NS_PER_S, round(NS_PER_S / min(rates.timesync_hz, rates.control_hz))
        self._monitor = FormationMonitor(
            n, plan.margins_s, scenario.monitor, separable=plan.separable, period_s=period_s
        )
        self._start_ns = self._phase_since_ns = start_ns
        self._schedule = np.zeros(1, SCHEDULE)
        self._columns, self._row = Columns(self._schedule), 0
        # Requests are spread evenly between ticks, to avoid waiting behind set-points. With many vehicles, several are
        # sent together.
        for name, value in {
            "now_ns": start_ns, "start_ns": start_ns, "next_tick_ns": start_ns, "next_heartbeat_ns": start_ns,
            "next_timesync_ns": start_ns + self.period_ns // 2, "next_requests_ns": start_ns + self.period_ns // 2,
            "period_ns": self.period_ns, "timesync_spacing_ns": max(1, timesync_ns // n),
            "requests_apart_ns": min(self.period_ns // 3, _REQUESTS_APART_NS),
        }.items():  # fmt: skip
            self._schedule[name] = value
        self._used_s, self._repeated_ns = np.full(n, nan), np.zeros((2, n), np.int64)
        self._scratch, self._coming = new_scratch(n), np.zeros(1, COMING)
        self._data: FastPathData | None = None
        """The last `fast_path_data`."""
        self._system_ids = np.array([vehicle.system_id for vehicle in self.vehicles])
        self._targets = np.array([vehicle.wire_id for vehicle in self.vehicles])
        measured = scenario.control.prediction == "measured"
        self._tolerated = None if measured else self._tolerances(np.zeros(n))
        """The tolerances at every tick, unless they depend on a measured delay."""
        self._guided, self._critical = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
        self._why_absent = [""] * n
        """Why each vehicle is absent, unless it is silent."""
        self._rows, self._to_check, self._busy = range(n), [*range(n)], set(range(n))
        """`_to_check`: rows that `_all_ready` has to check; `_busy`: those for which a command may be due."""
        self._announcements: list[tuple[RemoteVehicle, Mode, str]] = []
        """Changes that are not announced yet."""
        self._absent, self._gone = [""] * n, dict[int, bool]()
        """Why each vehicle is absent, "" if it is not; and those absent, by row, with whether pilots fly them."""
        self._returning: dict[int, bool] = {}
        """Rows of vehicles that take part again, with whether they were far from their places at the last check. The
        others fly without them until they are near."""

    @property
    def next_event_ns(self) -> int:
        """When `step` next has something to do if nothing is received."""
        return min(self.next_tick_ns, self._next_heartbeat_ns, self._next_requests_ns)

    def request_stop(self, reason: str) -> None:
        """End the flight at the next tick: command the vehicles to hold, and wait until they do."""
        self._journal.request_stop(reason)

    def abandoned(self) -> Outbox:
        """Commands to hold or land for every vehicle in flight: what a driver sends when an exception ends it."""
        commands = [(vehicle.final_command(), vehicle.address) for vehicle in self.vehicles]
        return Outbox([(frame, address) for frame, address in commands if frame is not None and address is not None])

    def step(self, datagrams: Arrivals | Sequence[Datagram], now_ns: int, taken: int = 0) -> tuple[Outbox, Tick | None]:
        """Process datagrams, except the first `taken`, which a fast step has processed, and do what is due.

        Returns
        -------
        datagrams to send, and the control tick if one was due. The driver passes the tick to `complete` once the
        datagrams are sent.
        """
        self._columns["now_ns"][0] = self._journal.now_ns = now_ns
        outgoing = self._reception.take(datagrams, now_ns, taken)
        if now_ns >= self.next_tick_ns:
            # set-points do not wait for heartbeats and requests, which can have their own step
            return outgoing, self._fast_tick(outgoing) or self._tick(outgoing)
        if now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + HEARTBEAT_NS
            outgoing.add(heartbeats_to(self._fleet.links))
        if now_ns >= self._next_requests_ns:
            links = self._fleet.links
            asked = requested(self._schedule, links.known, links.clocks.known, links.clocks.pending_ns)
            outgoing.add(Block(*asked, links.to))
        return outgoing, None

    @property
    def fast_path_data(self) -> FastPathData:
        """The data of fast steps; valid until the next step in Python, which may replace parts of them."""
        monitor, tolerated, data = self._monitor, self._tolerated, self._data
        assert tolerated is not None
        replaced = self._reception.tables, self._law, monitor.newest_blends, tolerated[0]
        if data is None or not all(map(is_, replaced, (data.tables, data.law, data.blends, data.shorter_s))):
            data = self._data = FastPathData(
                self._schedule, self._coming, self._limits, self._reception.tables, self._reception.row_of, self._law,
                monitor.newest_blends, monitor.watched._replace(margins_s=tolerated[1]), monitor.policy, self._guided,
                self._critical, tolerated[0], self._used_s, self._repeated_ns, self._system_ids, self._targets,
                HEARTBEAT, self._scratch,
            )  # fmt: skip
        return data

    @property
    def has_fast_path(self) -> bool:
        """Whether steps may take the fast path of `gcs.station.fast_path`."""
        return self._fleet.has_fast_path and self._tolerated is not None

    def look_ahead(self) -> bool:
        """Fill in what fast steps need of the coming ticks; a step in Python invalidates it.

        Returns whether the next tick may be fast.
        """
        time_s, flying = self.scenario_time_s(self.next_tick_ns), self.phase is Phase.FLYING
        self._coming["quiet_until_ns"] = 0.0
        waiting = self._reception.touched or self._gone or self._returning or self._announcements
        if waiting or not self._monitor.is_calm(time_s, flying=flying):
            return False
        if flying and (self._journal.stop or self._busy or not self._breakage.all_back):
            return False
        scenario, clock_row = self.plan.scenario, -1 if flying else self._awaited_clock
        quiet_until_ns = inf if flying else self._quiet_until_ns(awaits_clock=clock_row >= 0)
        steady_until_s = min((new.from_s for new in scenario.nominal_velocity if new.from_s > time_s), default=inf)
        self._coming[0] = (
            flying, scenario.nominal_velocity_at(time_s), *self._journal.zero, self._phase_since_ns, quiet_until_ns,
            self._longest_phase_s, steady_until_s, clock_row,
        )  # fmt: skip
        return quiet_until_ns > 0.0

    def _quiet_until_ns(self, *, awaits_clock: bool) -> float:
        """The time before which ticks outside the flight have nothing to do, if vehicles send only what kernels handle.

        0 if unknown; see also `_longest_phase_s`.
        """
        if len(self.vehicles) > _IN_A_TICK:
            return 0
        if self.phase is Phase.ENDING:
            waits = not self._all_ended
        else:
            connects = self.phase is Phase.CONNECTING and not self._journal.stop
            waits = connects and (awaits_clock or any(vehicle.awaits_message for vehicle in self.vehicles))
        return min(vehicle.quiet_until_ns for vehicle in self.vehicles) if waits else 0

    @property
    def _awaited_clock(self) -> int:
        """The row of a vehicle that only `awaits_clock`; -1 if there is none."""
        return next((row for row, vehicle in enumerate(self.vehicles) if vehicle.awaits_clock), -1)

    def unjudged(self, indices: IntArray) -> Tick:
        """The last tick whose set-points kernels have made; for `indices` see `Tick`."""
        self._journal.now_ns = self._columns["now_ns"][0]
        due_ns = self._columns["due_ns"][0]
        time_s, key_ms = self.scenario_time_s(due_ns), self._key_ms(due_ns)
        return Tick(self._columns["tick"][0], time_s, due_ns, key_ms, None, indices)

    def _judged_by_kernels(self, due_ns: int) -> Judged:
        """The results behind set-points that kernels have made."""
        _, _, rtt_s, _, followed, _ = scratch = self._scratch
        return self._judged(scratch.controls, rtt_s, followed, self._tolerated or self._tolerances(rtt_s), due_ns)

    def _key_ms(self, due_ns: int) -> int:
        """The `time_boot_ms` of the set-points of a tick."""
        return (due_ns - self._start_ns) // 1_000_000 & 0xFFFFFFFF

    @property
    def _longest_phase_s(self) -> float:
        """The maximum duration of CONNECTING, FLYING or ENDING."""
        if self.phase is Phase.FLYING:
            return self.plan.scenario.duration_s
        return END_PATIENCE_S if self.phase is Phase.ENDING else self._start_patience_s

    @property
    def _all_ended(self) -> bool:
        """Whether every vehicle that was ever heard has `ended`."""
        return all(vehicle.ended for vehicle in self.vehicles if vehicle.address is not None)

    def _waited_s(self, due_ns: int) -> float:
        """Duration of the current phase at a tick."""
        return (due_ns - self._phase_since_ns) / NS_PER_S

    def _judged(
        self, controls: Records, rtt_s: FloatArray, followed: NDArray[np.bool_], tolerated: Tolerances, due_ns: int
    ) -> Judged:
        return Judged(
            self._system_ids, self._monitor.modes, self._monitor.gain_sets, controls, self._reception.reported, rtt_s,
            followed, *tolerated,
            repeated_s(self._repeated_ns, self._limits.repetition_ns, controls["used_ns"], due_ns),
        )  # fmt: skip

    def sent(self, outbox: Outbox, sent_ns: NDArray[np.int64]) -> None:
        """Record when each datagram of a step was sent, if later than the time of the step."""
        note_requests(self._fleet.links, outbox, sent_ns)

    def complete(self, tick: Tick, sent_ns: Sequence[int] | NDArray[np.int64]) -> TickArray:
        """The rows of a tick whose set-points have been sent, with ages, loop delays and headroom.

        `sent_ns` holds the send time of each datagram of the step. Checks that must not delay set-points are made here:
        whether the formation is broken, and which vehicles are back near their places.
        """
        judged = tick.judged or self._judged_by_kernels(tick.due_ns)
        down_m = judged.reported["down_m"] if self._limits.has_slots else np.empty(0)
        near = nearest(off_the_ground(judged.controls, self._why_absent), tick.due_ns, down_m)
        if self.phase is Phase.FLYING:
            self._take_back(judged.controls)
            away = dict.fromkeys(self._monitor.away, False)
            away |= self._gone
            self.request_stop(self._breakage.judge(judged.controls, away, near, tick.time_s))
        at_ns = np.asarray(sent_ns, np.int64) if len(sent_ns) else np.array([self._journal.now_ns])
        own_ns = at_ns[tick.set_point_indices]  # -1, for vehicles that were sent none, selects the last one
        rows, self._used_s[:] = tick_rows(tick, judged, self._fleet.links, near.distance_m, own_ns)
        return rows

    # -- the control tick ------------------------------------------------------------------------------------------

    def _fast_tick(self, outgoing: Outbox) -> Tick | None:
        """Do the tick due now with a kernel if possible, else return None."""
        if self.phase is not Phase.FLYING or not self.has_fast_path or not self.look_ahead():
            return None
        done, set_points = fast_set_points(self.fast_path_data)
        if not done:
            return None
        indices = self._add_set_points(Block(*set_points, self._fleet.links.to), outgoing)
        return self.unjudged(indices)

    def _tick(self, outgoing: Outbox) -> Tick:
        due_ns = self.next_tick_ns
        behind = (self._journal.now_ns - due_ns) // self.period_ns
        self.next_tick_ns = due_ns + (behind + 1) * self.period_ns  # missed ticks are skipped
        self._decide(due_ns)
        self._fleet.locate(self._history)
        flying = self.phase is Phase.FLYING
        time_s = self.scenario_time_s(due_ns)
        nominal_m_s = self.plan.scenario.nominal_velocity_at(time_s)
        blends = self._monitor.blends(time_s)
        now = TickInputs(due_ns, time_s, nominal_m_s, self._monitor.opening)
        controls = self._fleet.loop.control(self._history, self._law, blends, now)
        self._fleet.bound(controls, blends)
        shorten(controls["command_m_s2"], self._limits.acceleration_m_s2)
        key_ms = self._key_ms(due_ns)
        followed = commanded(controls, self._monitor.released, flying)
        orders = Orders(controls, followed, nominal_m_s, due_ns)
        points = self._fleet.set_points(orders, self.phase)
        shorten(points["velocity_ned_m_s"], self._speed_max_m_s)  # last, to apply to all set-points alike
        shorten(points["acceleration_ne_m_s2"], self._limits.acceleration_m_s2)
        self._fleet.loop.sent(due_ns, points)
        few = len(self.vehicles) <= _IN_A_TICK
        if few:
            self._announce(outgoing)
        indices = self._add_set_points(set_points_to(self._fleet.links, points, self._targets, key_ms), outgoing)
        if not few:
            self._announce(outgoing)  # last, as the set-points of many vehicles take milliseconds to send
        for row in self._in_turn(sorted(self._busy)):
            frame = self.vehicles[row].next_frame(self._journal.now_ns)
            if frame is not None and (address := self.vehicles[row].address) is not None:
                outgoing.append((frame, address))
            if self.vehicles[row].idle:
                self._busy.discard(row)
        tolerated = self._tolerated or self._tolerances(controls["assumed_s"])
        self._monitor.margins_s = tolerated[1]
        rtt_s = take_fresh(self._reception.tables.fresh_ns, self._reception.tables.fresh_counts)
        judged = self._judged(controls, rtt_s, followed, tolerated, due_ns)
        tick = Tick(self._tick_count, time_s, due_ns, key_ms, judged, indices)
        self._tick_count += 1 + behind
        return tick

    def _add_set_points(self, set_points: Block, outgoing: Outbox) -> IntArray:
        """Queue set-points; returns each vehicle's index in the queue, -1 for none."""
        indices = np.full(len(self.vehicles), -1)
        indices[set_points.rows] = np.arange(len(outgoing), len(outgoing) + len(set_points.rows))
        outgoing.add(set_points)
        return indices

    def _tolerances(self, assumed_s: FloatArray) -> Tolerances:
        """How much shorter and longer than assumed each vehicle's loop delay may be, both (n, sets)."""
        each = [self.plan.tolerance_of(row, at_s) for row, at_s in enumerate(assumed_s.tolist())]
        return np.array([own.shorter_s for own in each]), np.array([own.longer_s for own in each])

    def _take_back(self, controls: Records) -> None:
        """Restore the coupling of the others to returning vehicles that are near their places again."""
        near_m = _NEAR * self.plan.scenario.safety.spacing_error_limit_m
        for row, was_far in [*self._returning.items()]:
            control = controls[row]
            if not control["sample_ns"] or hypot(*control["spacing_error_m"].tolist()) > near_m:
                self._returning[row] = True
                continue
            del self._returning[row]  # near, or with nobody ahead, which leaves it without a spacing error
            self._set_law()
            if was_far:
                self._report("vehicle", "is back near its place", self.vehicles[row].system_id)

    def _set_law(self) -> None:
        self._law = self._fleet.loop.law(
            [why != "" for why in self._absent], [row in self._returning for row in range(len(self._absent))]
        )

    def _decide(self, due_ns: int) -> None:
        """Update modes, absent vehicles and the phase of the flight."""
        flying = self.phase is Phase.FLYING
        silent = self._journal.now_ns - self._reception.telemetry_ns > self._limits.silence_ns
        self._look_at(self._reception.touched if flying else self._reception.touched | {*self._in_turn(self._rows)})
        self._reception.touched.clear()
        absent = [*self._why_absent] if flying else [""] * len(self.vehicles)
        for row in silent.nonzero()[0].tolist() if flying else ():
            absent[row] = absent[row] if absent[row] == LEFT_OUT else LOST
        if absent != self._absent:
            for vehicle, now, was in zip(self.vehicles, absent, self._absent, strict=True):
                if now != was and flying:
                    self._report("vehicle", describe_change(was, now), vehicle.system_id)
            for row in self.plan.model.followers:
                if absent[row]:
                    self._returning.pop(row, None)
                elif self._absent[row]:
                    self._returning[row] = False
            self._absent = absent
            self._gone = {row: why in PILOTED for row, why in enumerate(absent) if why}
            self._set_law()
        time_s = self.scenario_time_s(due_ns)
        seen = Seen(time_s, flying, silent, self._guided, self._critical, self._used_s)
        for row, before, after in self._monitor.update(seen):
            vehicle = self.vehicles[row]
            if flying:
                vehicle.goal = None if after.released or vehicle.left_out else Goal.FLY
                self._busy.add(row)
            if after.mode is not before.mode:
                self._change_mode(row, before.mode, after.mode)
            if after.released != before.released and flying:
                text = "is released to its failsafe" if after.released else "is called back"
                self._report("vehicle", text, vehicle.system_id)
            if after.gain_set != before.gain_set and flying:
                margin_s = self._monitor.margins_s[row][after.gain_set]
                self._report("gains", f"gain set {after.gain_set}, delay margin {margin_s:.3f} s", vehicle.system_id)
                self._announcements.append((vehicle, after.mode, f"{GAIN_SET}{after.gain_set}"))
        self._next_phase(due_ns)

    def _in_turn(self, rows: Sequence[int]) -> Sequence[int]:
        """The rows to process at this tick: all, or of many the next in turn, as start-up takes 20 µs a vehicle."""
        first = self._tick_count * _IN_A_TICK % max(1, len(rows))
        return rows if len(rows) <= _IN_A_TICK else [*rows, *rows][first : first + _IN_A_TICK]

    def _all_ready(self) -> bool:
        """Whether all vehicles are ready or left out: of many, some are checked at each call.

        The one that was not ready at the last call is checked first, and all others after it.
        """
        for row in self._to_check[:_IN_A_TICK]:
            vehicle = self.vehicles[row]
            if not (vehicle.left_out or (vehicle.ready and self._history.newest(row))):
                self._to_check = [*self._rows[row:], *self._rows[:row]]
                return False
        del self._to_check[:_IN_A_TICK]
        return not self._to_check

    def _look_at(self, rows: Iterable[int]) -> None:
        """Update the state derived from these vehicles, which may have changed."""
        for row in rows:
            vehicle = self.vehicles[row]
            self._guided[row], self._critical[row] = vehicle.guided and not vehicle.left_out, vehicle.critical
            self._why_absent[row] = absence(vehicle, gone=False)
            self._busy.add(row)

    def _next_phase(self, due_ns: int) -> None:
        waited_s = self._waited_s(due_ns)
        if self.phase is Phase.CONNECTING:
            self.request_stop(self._fleet.startup_failure(due_ns, self._start_ns, self._history))
        if self.phase is Phase.IDENTIFYING:
            self.request_stop(self._fleet.identify(due_ns, self._history))
            if self.plan is not self._fleet.plan:
                self.plan = self._fleet.plan
                self._tolerated = self._tolerated and self._tolerances(np.zeros(len(self.vehicles)))
        if self.phase is Phase.FLYING and (waited_s >= self._longest_phase_s or all(self._absent)):
            self.request_stop(end_reason(self.vehicles, self._absent))
        if self.phase is Phase.FLYING and not self._journal.stop:
            return
        all_ready = self.phase is Phase.CONNECTING and self._all_ready()
        if all_ready:
            self.request_stop(not_formed(self.plan, self._history))
        phase = next_phase(
            self.phase,
            all_ready=all_ready,
            stop=bool(self._journal.stop),
            all_holding=self._all_ended,
            waited_s=waited_s,
            identified=self._fleet.identified,
        )
        if phase is self.phase:
            return
        if self.phase is Phase.CONNECTING and not self._journal.stop:
            self._fleet.begin()
        self.phase, self._phase_since_ns = phase, due_ns
        if phase is Phase.FLYING:
            self._journal.flight_start_ns = due_ns
        if phase is Phase.ENDING:
            self.end_reason = self._journal.stop
            self._fleet.end()
            # A broken formation is left to its failsafe, if that holds the vehicles: the cause may be the link.
            alone = self._journal.stop.startswith("broken") and self._fleet.holds_when_left_alone
            for vehicle in self.vehicles:
                vehicle.end(alone=alone)
            self._busy.update(range(len(self.vehicles)))
        self._report_not_confirmed()
        self._report("phase", str(phase))

    # -- sending and reporting -------------------------------------------------------------------------------------

    def _change_mode(self, row: int, before: Mode, after: Mode) -> None:
        """Report a change of mode; the vehicle may be CRITICAL because its headroom is unknown."""
        vehicle = self.vehicles[row]
        self._report("mode", f"{before.name} -> {after.name}", vehicle.system_id)
        self._announcements.append((vehicle, after, after.name))
        if after is Mode.CRITICAL and vehicle.clock.unanswered >= UNANSWERED and np.isnan(self._used_s[row]):
            self._report("vehicle", "does not answer TIMESYNC: its loop delay is unknown", vehicle.system_id)

    def _report_not_confirmed(self) -> None:
        """After the flight, report the vehicles that were told to hold or land and have not confirmed it."""
        told = (vehicle for vehicle in self.vehicles if vehicle.address is not None and vehicle.goal is Goal.END)
        late = [vehicle for vehicle in told if not vehicle.ended]
        if self.phase is Phase.ENDED and late:
            self._report(NOT_CONFIRMED, in_words("", late))

    def _announce(self, outgoing: Outbox) -> None:
        """Announce changes on the link, for other listeners and the telemetry log; of many, the oldest."""
        for vehicle, mode, text in self._announcements[:_IN_A_TICK]:
            if not vehicle.external:
                fields = mavlink.statustext(SEVERITY[mode], f"vehicle {vehicle.system_id}: {text}")
                vehicle.send(mavlink.STATUSTEXT, fields, outgoing)
        del self._announcements[:_IN_A_TICK]
