"""Rebuilds the ticks of a flight, with their latencies, errors and modes, from its telemetry log alone.

The frames of the log are fed in order to the station's own code for clocks, sequence numbers and states at one instant.
In a log of this station, the time_boot_ms of its set-points identifies the ticks; in any other log, ticks are placed at
the scenario's control rate.

A log does not record how long telemetry waited in the station's socket, nor by how much the monitor had widened the
formation; errors are therefore relative to the formation as designed. Lateness is relative to the most punctual tick.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import inf, nan
from typing import NamedTuple

import numpy as np

from gcs.control.history import StateHistory
from gcs.control.law import nearest, unblended
from gcs.control.loop_delay import longest_repetition_ns, repeated_s
from gcs.control.loops import TickInputs, Vector
from gcs.control.tick import CLOCK_JUMPED, GAIN_SET, TICK, Event, Mode, TickArray, in_sequence
from gcs.link import mavlink
from gcs.link.clocks import UNANSWERED, bound_at_ns
from gcs.link.vehicle import SILENCE_S, ignored
from gcs.plan.design import Design
from gcs.plan.flight_plan import FlightPlan, onboard_timing
from gcs.plan.formation import plan_formation
from gcs.plan.planner import flight_plan
from gcs.station.absence import GROUNDED, absence, off_the_ground
from gcs.station.fleet_kind import fleet_of
from gcs.station.modes import VehicleState
from gcs.station.reception import new_reported
from gcs.station.tick_rows import Judged, Tick, tick_rows
from gcs.watch.links import Watch, WatchedVehicle
from scenarios.schema import NS_PER_S, Scenario

Frames = list[tuple[int, mavlink.Frame]]

_ANNOUNCED = re.compile(rf"vehicle (\d+): (?:{GAIN_SET}(\d+)|(\w+))")
_LONGEST_GAP_NS = 10 * NS_PER_S
"""Longer gaps in a log are not filled with ticks."""
_LEAST_TICKS = 3


@dataclass(frozen=True)
class Rebuilt:
    """A flight rebuilt from a log: ticks and events in the form of a run's, and the links."""

    ticks: TickArray
    events: list[Event]
    links: Watch
    own: bool
    """Whether this station wrote the log, so that its ticks and the flight's end are known."""
    grounded: dict[int, str]
    """Why vehicles were on the ground at the flight's last tick, by system id, as of `gcs.station.absence`."""


class _Outline(NamedTuple):
    """The result of a first pass over a log."""

    base_ns: int
    """Log time of key 0, from the most punctual set-point."""
    keys: list[int]
    """time_boot_ms of this station's set-points, one for each tick; empty for a log of another station."""
    start_key: int
    """The key of the flight's first tick."""
    exchanges: bool
    """Whether TIMESYNC requests are in the log."""


_Commands = dict[int, tuple[int, Vector]]
"""The set-points of one tick by system id: when each was sent, and its acceleration."""


def rebuild(frames: Frames, scenario: Scenario, design: Design) -> Rebuilt:
    """Rebuild the flight of a scenario from a log, judged by the margins of a design."""
    flight = _Rebuilding(scenario, design, _outline(frames, scenario))
    for time_ns, frame in frames:
        flight.take(time_ns, frame)
    return flight.finished()


def watched(frames: Iterable[tuple[int, mavlink.Frame]]) -> Watch:
    """The links in a log of any tool."""
    watch = Watch()
    for time_ns, frame in frames:
        watch.take(frame, time_ns)
        watch.look(time_ns)
    return watch


def _outline(frames: Frames, scenario: Scenario) -> _Outline:
    vehicles = {vehicle.system_id for vehicle in scenario.vehicles}
    sent_ns: dict[int, int] = {}
    start_key = None
    exchanges = False
    for time_ns, frame in frames:
        if frame.system_id in vehicles:
            continue
        if frame.msg_id == mavlink.SET_POSITION_TARGET_LOCAL_NED:
            sent_ns.setdefault(frame.fields[0], time_ns)
        elif frame.msg_id == mavlink.STATUSTEXT and start_key is None and sent_ns:
            announced = _announced(frame)
            if announced is not None and announced[1] == Mode.NOMINAL.name:
                start_key = list(sent_ns)[-1]  # the tick before, because the station announces it one tick later
        exchanges = exchanges or (frame.msg_id == mavlink.TIMESYNC and frame.fields[0] == 0)
    keys = list(sent_ns)
    period_ms = 1e3 / scenario.rates.control_hz
    own = len(keys) >= _LEAST_TICKS and abs(float(np.median(np.diff(keys))) - period_ms) < 1.5
    if not own:
        return _Outline(frames[0][0], [], 0, exchanges)
    base_ns = min(time_ns - key * 1_000_000 for key, time_ns in sent_ns.items())
    return _Outline(base_ns, keys, keys[0] if start_key is None else start_key, exchanges)


def _announced(frame: mavlink.Frame) -> tuple[int, str] | None:
    """What a STATUSTEXT of the station says about a vehicle: its mode, or the number of its gain set."""
    found = _ANNOUNCED.match(mavlink.text_of(frame.fields[1]))
    return None if found is None else (int(found[1]), found[2] or found[3])


def _plan(scenario: Scenario, design: Design) -> FlightPlan:
    """The plan that defines the errors and margins of the flight; its gains are 0 unless latencies depend on them."""
    # the gains decide which states a streamed command needs, and the mismatch window of a predicted loop
    if onboard_timing(scenario) is not None or scenario.control.prediction != "off":
        plan = flight_plan(scenario)[1]
        if len(design.margins_s) == len(plan.margins_s):
            plan = plan.with_margins(design.margins_s, plan.responses)
    else:
        formation, (margin_s, *slower_s) = plan_formation(scenario), design.margins_s
        K = np.zeros((formation.model.inputs, formation.model.states))
        plan = FlightPlan(scenario, formation, K, margin_s, tuple((K, own_s) for own_s in slower_s))
    row = plan.formation.row
    own_s = {
        row(own.system_id): tuple(inf if s is None else s for s in own.delay_margins_s) for own in design.own_margins
    }
    return replace(plan, own_margins_s={**plan.own_margins_s, **own_s})


class _Rebuilding:
    """Rebuilds, frame by frame, what the station knew about the vehicles."""

    def __init__(self, scenario: Scenario, design: Design, outline: _Outline) -> None:
        self._scenario, self._outline = scenario, outline
        self._fleet = fleet_of(_plan(scenario, design), ignored)
        ids = self._fleet.plan.formation.system_ids
        self._repeated_ns = np.zeros((2, len(ids)), np.int64)
        self.watch = Watch(ids, scenario.rates)
        self._vehicles = [self.watch.vehicles[system_id] for system_id in ids]
        self._row = {system_id: row for row, system_id in enumerate(ids)}
        for vehicle, remote in zip(self._vehicles, self._fleet.vehicles, strict=True):
            vehicle.remote, remote.goal = remote, None
        self._history = StateHistory(len(ids))
        self._lost = [False] * len(ids)
        self._law = self._fleet.loop.law(self._lost)
        self._telemetry_ns = [0] * len(ids)
        self._grounded: dict[int, str] = {}
        self._reported = new_reported(len(ids))
        self._states = [VehicleState()] * len(ids)
        self._jumps = [0] * len(ids)
        self._exchanges = [0] * len(ids)
        """For each vehicle, the number of exchanges that earlier ticks hold."""
        self._period_ns = round(NS_PER_S / scenario.rates.control_hz)
        self._start_ns = outline.base_ns + outline.start_key * 1_000_000
        first_key, last_key = (outline.keys[0], outline.keys[-1]) if outline.keys else (0, -1)
        half_ns = self._period_ns // 2
        self._own_ns = (outline.base_ns + first_key * 1_000_000 - half_ns, outline.base_ns + last_key * 1_000_000)
        self._grid_ns = self._newest_ns = 0
        self._key_ms, self._commands = 0, _Commands()
        """The key of the tick whose set-points are being read, and those read so far."""
        self._rows: list[TickArray] = []
        self._events: list[Event] = []

    def take(self, time_ns: int, frame: mavlink.Frame) -> None:
        self._newest_ns = time_ns
        station = frame.system_id not in self._row
        if station and frame.msg_id == mavlink.SET_POSITION_TARGET_LOCAL_NED and self._outline.keys:
            self._set_point(time_ns, frame)
            return
        self._close_tick()
        self._look(time_ns)
        if station and frame.msg_id == mavlink.STATUSTEXT:
            self._apply_announced(time_ns, frame)
        vehicle = self.watch.take(frame, time_ns)
        self.watch.look(time_ns)
        row = self._row.get(frame.system_id)
        if vehicle is None or row is None:
            return
        self._take_telemetry(row, vehicle, time_ns, frame)

    def finished(self) -> Rebuilt:
        self._close_tick()
        self._look(self._newest_ns + self._period_ns)  # one more tick, which shows what arrived after the last one
        rows = in_sequence(self._rows) if self._rows else np.empty(0, TICK)
        rows = rows[np.argsort(rows["tick"], kind="stable")]
        return Rebuilt(rows, self._events, self.watch, bool(self._outline.keys), self._grounded)

    def _set_point(self, time_ns: int, frame: mavlink.Frame) -> None:
        key_ms, command, target = frame.fields[0], frame.fields[7:9], frame.fields[13]
        if key_ms != self._key_ms:
            self._close_tick()
        self._key_ms, self._commands[target] = key_ms, (time_ns, command)

    def _close_tick(self) -> None:
        if self._commands:
            self._tick(self._outline.base_ns + self._key_ms * 1_000_000, self._commands, self._key_ms)
            self._commands = _Commands()

    def _look(self, time_ns: int) -> None:
        """Add ticks without set-points: those before and after this station's, or all in another station's log."""
        if time_ns - self._grid_ns > _LONGEST_GAP_NS:
            behind = (time_ns - self._outline.base_ns) // self._period_ns
            self._grid_ns = self._outline.base_ns + behind * self._period_ns
        while self._grid_ns < time_ns:
            if not self._outline.keys:  # vehicles count as commanded once all have reported
                unknown = self._grid_ns, (nan, nan)
                self._tick(self._grid_ns, dict.fromkeys(self._row, unknown) if self._history.complete else {}, 0)
            elif not self._own_ns[0] <= self._grid_ns <= self._own_ns[1]:
                self._tick(self._grid_ns, {}, 0)
            self._grid_ns += self._period_ns

    def _apply_announced(self, time_ns: int, frame: mavlink.Frame) -> None:
        """Apply a mode or a gain set that the station announced."""
        system_id, announced = _announced(frame) or (0, "")
        row = self._row.get(system_id)
        if row is None:
            return
        state = self._states[row]
        if announced.isdecimal():
            gain_set = min(int(announced), len(self._fleet.plan.margins_s) - 1)
            self._states[row] = VehicleState(mode=state.mode, gain_set=gain_set)
        elif announced in Mode.__members__:
            self._states[row] = VehicleState(mode=Mode[announced], gain_set=state.gain_set)
            self._event(time_ns, "mode", f"{state.mode.name} -> {announced}", system_id)

    def _take_telemetry(self, row: int, vehicle: WatchedVehicle, time_ns: int, frame: mavlink.Frame) -> None:
        clock = vehicle.remote.clock
        vehicle.remote.startup.take(frame.msg_id, frame.fields)
        if clock.jumps > self._jumps[row]:
            self._jumps[row] = clock.jumps
            self._history.forget(row)
            self._event(time_ns, "vehicle", CLOCK_JUMPED, vehicle.remote.system_id)
        if frame.msg_id == mavlink.TIMESYNC and frame.fields[0] != 0 and clock.down_ns is not None and vehicle.rtt_s:
            asked_ns, base_ns = time_ns - round(vehicle.rtt_s[-1] * NS_PER_S), self._outline.base_ns
            key_ms = (asked_ns - base_ns) // 1_000_000 if self._outline.keys else 0
            delivery_ns = vehicle.remote.delivery_ns(key_ms, base_ns + key_ms * 1_000_000)
            self._fleet.loop.delivered(row, delivery_ns or 0, asked_ns)
        if frame.msg_id == mavlink.NAMED_VALUE_INT:
            vehicle.remote.named_int(frame.fields, (time_ns - self._outline.base_ns) // 1_000_000, time_ns)
        if frame.msg_id != mavlink.LOCAL_POSITION_NED:
            return
        boot_ms, north, east, down, v_north, v_east, v_down = frame.fields
        bound_s = nan
        sample_ns = clock.sampled_ns(boot_ms, time_ns, newest=vehicle.remote.newest)
        if sample_ns is not None:
            bound_s = bound_at_ns(clock.estimate, sample_ns) * 1e-9
        elif self._outline.exchanges:
            if not clock.exchange_due:
                self._telemetry_ns[row] = time_ns
            return
        else:
            sample_ns = boot_ms * 1_000_000 + vehicle.least_delay_ns
        origin_north, origin_east, origin_down = self._fleet.frame_ned_m[row].tolist()
        if self._history.add(row, sample_ns, (north + origin_north, east + origin_east, v_north, v_east)):
            self._telemetry_ns[row] = time_ns
            self._reported[row] = boot_ms, down + origin_down, v_down, nan, time_ns, bound_s

    def _tick(self, due_ns: int, commands: _Commands, key_ms: int) -> None:
        sent_ns = max((own_ns for own_ns, _ in commands.values()), default=due_ns)
        time_s = (due_ns - self._start_ns) / NS_PER_S
        flying = bool(commands) and time_s >= 0
        self._fleet.locate(self._history)
        lost = [flying and sent_ns - heard_ns > SILENCE_S * NS_PER_S for heard_ns in self._telemetry_ns]
        if lost != self._lost:
            self._lost, self._law = lost, self._fleet.loop.law(lost)
        now = TickInputs(due_ns, time_s, self._scenario.nominal_velocity_at(time_s))
        controls = self._fleet.loop.control(self._history, self._law, unblended(len(lost)), now)
        why = [absence(own.remote, gone=gone) for own, gone in zip(self._vehicles, lost, strict=True)]
        grounded = {
            own.remote.system_id: text for own, text in zip(self._vehicles, why, strict=True) if text in GROUNDED
        }
        self._grounded = grounded if flying else self._grounded
        down_m = self._reported["down_m"] if self._scenario.has_altitude_slots else np.empty(0)
        near = nearest(off_the_ground(controls, why), due_ns, down_m)
        ids = [vehicle.remote.system_id for vehicle in self._vehicles]
        if self._outline.exchanges:
            self._judge_silence(due_ns)
        sent = [commands.get(system_id, (sent_ns, None)) for system_id in ids]
        controls["command_m_s2"] = [one or (nan, nan) for _, one in sent]
        tolerated = [self._fleet.plan.tolerance_of(*own) for own in enumerate(controls["assumed_s"].tolist())]
        judged = Judged(
            np.array(ids), np.array([int(state.mode) for state in self._states]),
            np.array([state.gain_set for state in self._states]), controls, self._reported,
            np.array([self._fresh_rtt_s(row, vehicle) for row, vehicle in enumerate(self._vehicles)]),
            np.array([one is not None for _, one in sent]),
            np.array([own.shorter_s for own in tolerated]), np.array([own.longer_s for own in tolerated]),
            repeated_s(self._repeated_ns, longest_repetition_ns(self._scenario.rates), controls["used_ns"], due_ns),
        )  # fmt: skip
        number = round((due_ns - self._start_ns) / self._period_ns)
        tick = Tick(number, time_s, due_ns, key_ms, judged, np.empty(0, np.int64))
        rows, _ = tick_rows(tick, judged, self._fleet.links, near.distance_m, np.array([own_ns for own_ns, _ in sent]))
        self._rows.append(rows)

    def _judge_silence(self, now_ns: int) -> None:
        """Note which vehicles no longer answer TIMESYNC. A request in the log does not say which vehicle it is for.

        So the time since the newest reply decides, not the number of requests. A vehicle that sends nothing is silent.
        """
        for vehicle, heard_ns in zip(self._vehicles, self._telemetry_ns, strict=True):
            if vehicle.rtt_s and not vehicle.answers(now_ns) and now_ns - heard_ns <= SILENCE_S * NS_PER_S:
                vehicle.remote.clock.unanswered = UNANSWERED  # until the next reply

    def _fresh_rtt_s(self, row: int, vehicle: WatchedVehicle) -> float:
        """The oldest round trip that no earlier tick holds; NaN if there is none."""
        taken = self._exchanges[row]
        if taken == len(vehicle.rtt_s):
            return nan
        self._exchanges[row] = taken + 1
        return vehicle.rtt_s[taken]

    def _event(self, time_ns: int, kind: str, text: str, system_id: int | None = None) -> None:
        time_s = round((time_ns - self._start_ns) / NS_PER_S, 6)
        self._events.append(Event(time_s=time_s, kind=kind, system_id=system_id, text=text))
