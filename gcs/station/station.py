"""The ground station as a pure machine: datagrams and the time in, datagrams and tick records out.

One loop: receive, decide, command, record. No socket, clock or file is touched here; a driver feeds `step` in real time
or in virtual time, with the same bytes.
"""

from collections import Counter, deque
from collections.abc import Callable, Sequence
from math import hypot, isfinite, nan

import numpy as np

from gcs.control.history import StateHistory
from gcs.control.law import VehicleControl, distances_m
from gcs.control.limits import SetPointLimits
from gcs.control.loop_delay import Repetitions
from gcs.control.loops import Moment, Order
from gcs.control.own_law import LawHooks
from gcs.control.phases import Phase, next_phase, patience_s
from gcs.control.tick import CLOCK_JUMPED, GAIN_SET, SEVERITY, Mode, TickArray
from gcs.link import mavlink
from gcs.link.datagram import Datagram, Outgoing
from gcs.link.kinds import Goal
from gcs.link.vehicle import SILENCE_S, RemoteVehicle
from gcs.plan.flight_plan import FlightPlan
from gcs.plan.mismatch import Tolerated
from gcs.station.absence import absence, describe_change, end_reason
from gcs.station.breakage import Breakage, not_formed
from gcs.station.fleet_kind import fleet_of
from gcs.station.journal import Journal
from gcs.station.monitor import FormationMonitor
from gcs.station.tick_rows import Reported, Tick, tick_rows
from scenarios.schema import NS_PER_S

AUTOPILOT_COMPONENT = 1
"""A camera or gimbal of a vehicle has its system id, and heartbeats of its own."""
ANOTHER_ADDRESS = "known system id from another address"
_HEARTBEAT_NS = NS_PER_S
_REQUESTS_APART_NS = 7_000_000
"""Least time between two wake-ups for TIMESYNC requests, or a third of the control period if that is shorter."""
_NEAR = 0.1
"""A vehicle that returns is near its place within this share of the spacing error limit."""


class Station:
    """Flies one formation. `start_ns` is the time of the first control tick.

    `stopwatch_ns` is a clock that times the calls of the user's own control law; None in virtual time.
    """

    def __init__(self, plan: FlightPlan, *, start_ns: int, stopwatch_ns: Callable[[], int] | None = None) -> None:
        scenario = plan.scenario
        rates = scenario.rates
        self.plan = plan
        self.phase = Phase.CONNECTING
        self.end_reason = ""
        self._journal = journal = Journal(start_ns, patience_s(scenario))
        self.events, self._report, self.scenario_time_s = journal.events, journal.report, journal.scenario_time_s
        """See `Journal`."""
        self.frames: list[tuple[bytes, int]] = []
        """Frames received since the driver last took them, each with the time at which it was received."""
        self.counters: Counter[str] = Counter()
        self._fleet = fleet_of(plan, journal.report, LawHooks(journal.request_stop, journal.note_law, stopwatch_ns))
        self.vehicles = self._fleet.vehicles
        n = len(self.vehicles)
        self._row = {vehicle.system_id: row for row, vehicle in enumerate(self.vehicles)}
        self._history = StateHistory(n)
        self._law = self._fleet.loop.law([False] * n)
        self._breakage = Breakage(plan)
        self._has_slots = scenario.has_altitude_slots
        self._limits = SetPointLimits.of(scenario.limits)
        self._period_ns = round(NS_PER_S / rates.control_hz)
        period_s = self._period_ns / NS_PER_S
        self._monitor = FormationMonitor(
            n, plan.margins_s, scenario.monitor, separable=plan.separable, period_s=period_s
        )
        self._timesync_ns = round(NS_PER_S / min(rates.timesync_hz, rates.control_hz))
        self._start_ns = start_ns
        self._phase_since_ns = start_ns
        self.next_tick_ns = start_ns
        """When the next control tick is due."""
        self._next_heartbeat_ns = start_ns
        # Requests are spread evenly, off the ticks, so that they do not wait behind set-points. Some of those to many
        # vehicles are sent together.
        self._next_timesync_ns = self._next_requests_ns = start_ns + self._period_ns // 2
        self._timesync_spacing_ns = max(1, self._timesync_ns // n)
        self._requests_apart_ns = min(self._period_ns // 3, _REQUESTS_APART_NS)
        self._timesync_row = 0
        self._tick_count = 0
        self._now_ns = start_ns
        self._reported = [Reported()] * n
        self._repetitions = Repetitions(rates, n)
        self._telemetry_ns = [0] * n
        self._fresh_rtt_s = [deque[float]() for _ in range(n)]
        self._used_s = [nan] * n
        self._absent = [""] * n
        self._returning: dict[int, bool] = {}
        """Vehicles that take part again, by row, and whether they were far from their places when last looked at. The
        others do without them until they are near."""

    @property
    def next_event_ns(self) -> int:
        """When `step` next has something to do even if nothing is received."""
        return min(self.next_tick_ns, self._next_heartbeat_ns, self._next_requests_ns)

    def request_stop(self, reason: str) -> None:
        """End the flight at the next tick: command the vehicles to hold, and wait until they do."""
        self._journal.request_stop(reason)

    def step(self, datagrams: list[Datagram], now_ns: int) -> tuple[list[Outgoing], Tick | None]:
        """Take datagrams in and do what is due.

        Returns
        -------
        datagrams to send, and the control tick if one was due. The driver passes the tick to `complete` once the
        datagrams are sent.
        """
        self._now_ns = self._journal.now_ns = now_ns
        outgoing: list[Outgoing] = []
        for datagram in datagrams:
            self._receive(datagram, outgoing)
        if now_ns >= self.next_tick_ns:
            return outgoing, self._tick(outgoing)  # set-points do not wait for what may come in a step of its own
        if now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + _HEARTBEAT_NS
            for vehicle in self.vehicles:
                self._send(vehicle, mavlink.HEARTBEAT, mavlink.heartbeat(), outgoing)
        if now_ns >= self._next_requests_ns:
            while now_ns >= self._next_timesync_ns:
                self._request_timesync(outgoing)
            self._next_requests_ns = max(self._next_timesync_ns, self._next_requests_ns + self._requests_apart_ns)
        return outgoing, None

    def complete(self, tick: Tick, sent_ns: Sequence[int]) -> TickArray:
        """The rows of a tick whose set-points have been sent, with ages, loop delays and headroom.

        `sent_ns` says when each datagram of the step was sent. What set-points need not wait for is judged here:
        whether the formation is broken, and who is back near its place.
        """
        slots_m = [reported.down_m for reported in tick.reported] if self._has_slots else None
        distance_m = distances_m(tick.controls, tick.due_ns, slots_m)
        nearest_m: list[float] = np.fmin.reduce(distance_m, axis=1).tolist()
        if self.phase is Phase.FLYING:
            self._take_back(tick.controls)
            self.request_stop(
                self._breakage.judge(tick.controls, tick.monitored, self._absent, distance_m, nearest_m, tick.time_s)
            )
        newest_ns = sent_ns[-1] if sent_ns else self._now_ns
        own_ns = [newest_ns if index < 0 else sent_ns[index] for index in tick.set_point_indices]
        rows, self._used_s = tick_rows(tick, nearest_m, own_ns)
        return rows

    def is_another(self, system_id: int, datagram: Datagram) -> bool:
        """Whether a frame claims the system id of a vehicle that is known to send from another address."""
        row = self._row.get(system_id)
        return row is not None and self.vehicles[row].is_elsewhere(datagram.address, datagram.received_ns)

    # -- receive ---------------------------------------------------------------------------------------------------

    def _receive(self, datagram: Datagram, outgoing: list[Outgoing]) -> None:
        if self._fleet.speaks_mavlink_1_first and datagram.data[:1] == b"\xfe":
            # once answered in MAVLink 2, the vehicle uses that
            frames = mavlink.first_heartbeats(datagram.data, self.counters)
        else:
            frames = mavlink.decode(datagram.data, self.counters)
        for frame in frames:
            row = self._row.get(frame.system_id)
            if row is None:
                self.counters["unknown system id"] += 1
                continue
            vehicle = self.vehicles[row]
            if vehicle.address != datagram.address:
                if not vehicle.may_speak_from(datagram.address, frame.msg_id, datagram.received_ns):
                    self.counters["before a first heartbeat" if vehicle.address is None else ANOTHER_ADDRESS] += 1
                    continue
                vehicle.address = datagram.address
                self._report("vehicle", "found", vehicle.system_id)
            vehicle.heard_ns = datagram.received_ns
            vehicle.first_heard_ns = vehicle.first_heard_ns or datagram.received_ns
            self.frames.append((frame.data, datagram.received_ns))
            if frame.component_id != AUTOPILOT_COMPONENT:
                self.counters["other component"] += 1
                continue
            if vehicle.is_replay(frame, datagram.received_ns):
                continue
            self._handle(row, vehicle, frame, datagram, outgoing)

    def _handle(
        self, row: int, vehicle: RemoteVehicle, frame: mavlink.Frame, datagram: Datagram, outgoing: list[Outgoing]
    ) -> None:
        fields = frame.fields
        match frame.msg_id:
            case mavlink.LOCAL_POSITION_NED:
                self._position(row, vehicle, frame, datagram, outgoing)
            case mavlink.POSITION_TARGET_LOCAL_NED:
                at_ns = vehicle.clock.station_ns(fields[0], datagram.received_ns)
                if at_ns is not None:
                    self._fleet.loop.active(row, at_ns, fields)
            case mavlink.TIMESYNC:
                tc1_ns, ts1_ns = fields
                if tc1_ns == 0:
                    reply = mavlink.timesync(tc1_ns=datagram.received_ns, ts1_ns=ts1_ns)
                    self._send(vehicle, mavlink.TIMESYNC, reply, outgoing)
                else:
                    self._timesync_reply(row, vehicle, tc1_ns, ts1_ns, datagram.received_ns)
            case mavlink.HEARTBEAT:
                vehicle.heartbeat(fields, datagram.received_ns)
            case mavlink.COMMAND_ACK:
                vehicle.acknowledge(fields, datagram.received_ns)
            case mavlink.NAMED_VALUE_INT:
                vehicle.named_int(fields)
            case mavlink.STATUSTEXT:
                text = fields[1].split(b"\0")[0].decode(errors="replace")
                if vehicle.startup.is_news(text):
                    self._report("statustext", text, vehicle.system_id)
            case _:
                pass
        vehicle.startup.take(frame.msg_id, fields)

    def _position(
        self, row: int, vehicle: RemoteVehicle, frame: mavlink.Frame, datagram: Datagram, outgoing: list[Outgoing]
    ) -> None:
        boot_ms, north, east, down, v_north, v_east, v_down = frame.fields
        clock = vehicle.clock
        sample_ns = clock.sampled_ns(boot_ms, datagram.received_ns, newest=vehicle.newest)
        if vehicle.left_out:
            return  # on the ground, others may fly over it
        if sample_ns is None:
            if not clock.exchange_due:
                self._telemetry_ns[row] = datagram.received_ns  # heard before the first exchange
            elif self._now_ns - clock.asked_ns >= self._period_ns:
                self._exchange(vehicle, outgoing)
            return
        origin_north, origin_east, origin_down = self._fleet.frame_ned_m[row]
        if not self._history.add(row, sample_ns, (north + origin_north, east + origin_east, v_north, v_east)):
            return
        self._telemetry_ns[row] = datagram.received_ns  # new states only: a replay does not end a silence
        bound_s = clock.estimate.bound_at_ns(sample_ns) * 1e-9
        queue_s, received_ns = datagram.queued_ns * 1e-9, datagram.received_ns
        self._reported[row] = Reported(boot_ms, down + origin_down, v_down, queue_s, received_ns, bound_s)

    def _timesync_reply(self, row: int, vehicle: RemoteVehicle, tc1_ns: int, ts1_ns: int, received_ns: int) -> None:
        jumps = vehicle.clock.jumps
        rtt_ns = vehicle.clock.reply(tc1_ns=tc1_ns, ts1_ns=ts1_ns, received_ns=received_ns)
        if rtt_ns is not None:
            self._fresh_rtt_s[row].append(rtt_ns * 1e-9)
            key_ms = (ts1_ns - self._start_ns) // 1_000_000
            delivery_ns = vehicle.delivery_ns(key_ms, self._start_ns + key_ms * 1_000_000)
            self._fleet.loop.delivered(row, delivery_ns or 0, ts1_ns)
        if vehicle.clock.jumps != jumps:
            self._history.forget(row)
            vehicle.begin_anew()
            self._report("vehicle", CLOCK_JUMPED, vehicle.system_id)

    # -- the control tick ------------------------------------------------------------------------------------------

    def _tick(self, outgoing: list[Outgoing]) -> Tick:
        due_ns = self.next_tick_ns
        behind = (self._now_ns - due_ns) // self._period_ns
        self.next_tick_ns = due_ns + (behind + 1) * self._period_ns  # missed ticks are skipped
        self._decide(due_ns, outgoing)
        if self.phase is Phase.CONNECTING:
            self._fleet.locate(self._history)
        flying = self.phase is Phase.FLYING
        time_s = self.scenario_time_s(due_ns)
        nominal_m_s = self.plan.scenario.nominal_velocity_at(time_s)
        blends = self._monitor.blends(time_s)
        now = Moment(due_ns, time_s, nominal_m_s, self._monitor.opening)
        controls = self._fleet.loop.control(self._history, self._law, blends, now)
        controls = self._fleet.bounded(controls, blends)
        controls = [self._limited(control) for control in controls]
        key_ms = (due_ns - self._start_ns) // 1_000_000 & 0xFFFFFFFF
        followed: list[bool] = []
        indices: list[int] = []
        tolerated: list[Tolerated] = []
        for row, (vehicle, control, monitored) in enumerate(
            zip(self.vehicles, controls, self._monitor.states, strict=True)
        ):
            north, east = control.command_m_s2
            commanded = flying and not monitored.released and isfinite(north) and isfinite(east)
            order = Order(control, commanded, nominal_m_s, key_ms, due_ns)
            fields = self._fleet.set_point(row, order, self.phase)
            index = len(outgoing)
            if fields is not None:
                fields = self._limits.set_point(fields)  # last, so that it holds whoever computed them
                self._fleet.loop.sent(row, due_ns, fields)
                self._send(vehicle, mavlink.SET_POSITION_TARGET_LOCAL_NED, fields, outgoing)
            indices.append(index if len(outgoing) > index else -1)
            followed.append(commanded)
            tolerated.append(self.plan.tolerance(control.assumed_s))
        self._monitor.margins_s = [each.longer_s for each in tolerated]
        for vehicle in self.vehicles:
            frame = vehicle.next_frame(self._now_ns)
            if frame is not None and vehicle.address is not None:
                outgoing.append((frame, vehicle.address))
        tick = Tick(
            self._tick_count, time_s, due_ns, key_ms, self.vehicles, self._monitor.states, controls,
            self._reported.copy(), [fresh_s.popleft() if fresh_s else nan for fresh_s in self._fresh_rtt_s],
            followed, tolerated, self._repetitions.repeated_s([each.used_ns for each in controls], due_ns), indices,
        )  # fmt: skip
        self._tick_count += 1 + behind
        return tick

    def _take_back(self, controls: Sequence[VehicleControl]) -> None:
        """Let the others fly again with vehicles that have come near their places."""
        near_m = _NEAR * self.plan.scenario.safety.spacing_error_limit_m
        for row, was_far in [*self._returning.items()]:
            control = controls[row]
            if not control.sample_ns or hypot(*control.spacing_error_m) > near_m:
                self._returning[row] = True
                continue
            del self._returning[row]  # near, or with nobody ahead to be far from
            self._set_law()
            if was_far:
                self._report("vehicle", "is back near its place", self.vehicles[row].system_id)

    def _set_law(self) -> None:
        self._law = self._fleet.loop.law(
            [why != "" for why in self._absent], [row in self._returning for row in range(len(self._absent))]
        )

    def _limited(self, control: VehicleControl) -> VehicleControl:
        command_m_s2 = self._limits.command(control.command_m_s2)
        return control if command_m_s2 is control.command_m_s2 else control._replace(command_m_s2=command_m_s2)

    def _decide(self, due_ns: int, outgoing: list[Outgoing]) -> None:
        """Update modes, absent vehicles and the flight's phase."""
        flying = self.phase is Phase.FLYING
        silence_ns = SILENCE_S * NS_PER_S
        silent = [self._now_ns - heard_ns > silence_ns for heard_ns in self._telemetry_ns]
        both = zip(self.vehicles, silent, strict=True)
        absent = [absence(vehicle, gone=gone) if flying else "" for vehicle, gone in both]
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
            self._set_law()
        time_s = self.scenario_time_s(due_ns)
        guided, critical = (
            [vehicle.guided for vehicle in self.vehicles],
            [vehicle.critical for vehicle in self.vehicles],
        )
        for row, before, after in self._monitor.update(time_s, silent, guided, critical, self._used_s, flying=flying):
            vehicle = self.vehicles[row]
            if flying:
                vehicle.goal = None if after.released or vehicle.left_out else Goal.FLY
            if after.mode is not before.mode:
                self._report("mode", f"{before.mode.name} -> {after.mode.name}", vehicle.system_id)
                self._tell(vehicle, after.mode, after.mode.name, outgoing)
            if after.released != before.released and flying:
                text = "is released to its failsafe" if after.released else "is called back"
                self._report("vehicle", text, vehicle.system_id)
            if after.gain_set != before.gain_set and flying:
                margin_s = self._monitor.margins_s[row][after.gain_set]
                self._report("gains", f"gain set {after.gain_set}, delay margin {margin_s:.3f} s", vehicle.system_id)
                self._tell(vehicle, after.mode, f"{GAIN_SET}{after.gain_set}", outgoing)
        self._next_phase(due_ns)

    def _next_phase(self, due_ns: int) -> None:
        waited_s = (due_ns - self._phase_since_ns) / NS_PER_S
        if self.phase is Phase.CONNECTING:
            self.request_stop(self._fleet.startup_failure(due_ns, self._start_ns, self._history))
        if self.phase is Phase.IDENTIFYING:
            self.request_stop(self._fleet.identify(due_ns, self._history))
            self.plan = self._fleet.plan
        if self.phase is Phase.FLYING and (waited_s >= self.plan.scenario.duration_s or all(self._absent)):
            self.request_stop(end_reason(self.vehicles, self._absent))
        all_ready = self.phase is Phase.CONNECTING and all(
            v.left_out or (v.ready and self._history.newest(row)) for row, v in enumerate(self.vehicles)
        )
        if all_ready:
            self.request_stop(not_formed(self.plan, self._history))
        phase = next_phase(
            self.phase,
            all_ready=all_ready,
            stop=bool(self._journal.stop),
            all_holding=all(v.ended for v in self.vehicles if v.address is not None),
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
            # A broken formation is left to its failsafe, if that holds the vehicles: what broke may be the link.
            alone = self._journal.stop.startswith("broken") and self._fleet.holds_when_left_alone
            for vehicle in self.vehicles:
                vehicle.goal = None if alone else Goal.END
        self._report("phase", str(phase))

    # -- sending and reporting -------------------------------------------------------------------------------------

    def _request_timesync(self, outgoing: list[Outgoing]) -> None:
        vehicle = self.vehicles[self._timesync_row]
        self._timesync_row = (self._timesync_row + 1) % len(self.vehicles)
        self._next_timesync_ns += self._timesync_spacing_ns
        if vehicle.address is not None:
            self._exchange(vehicle, outgoing)

    def _exchange(self, vehicle: RemoteVehicle, outgoing: list[Outgoing]) -> None:
        ts1_ns = vehicle.clock.request(self._now_ns)
        self._send(vehicle, mavlink.TIMESYNC, mavlink.timesync(tc1_ns=0, ts1_ns=ts1_ns), outgoing)

    def _send(self, vehicle: RemoteVehicle, msg_id: int, fields: tuple[object, ...], outgoing: list[Outgoing]) -> None:
        if vehicle.address is not None:
            outgoing.append((vehicle.encode(msg_id, fields), vehicle.address))

    def _tell(self, vehicle: RemoteVehicle, mode: Mode, text: str, outgoing: list[Outgoing]) -> None:
        """Announce a change on the link, for other listeners and the telemetry log."""
        if vehicle.external:
            return
        fields = mavlink.statustext(SEVERITY[mode], f"vehicle {vehicle.system_id}: {text}")
        self._send(vehicle, mavlink.STATUSTEXT, fields, outgoing)
