"""Computes the latencies of vehicles from the frames on their links, without commanding anything.

It is pure: frames and times in, figures out. `gcs monitor` feeds it from a socket, `gcs replay` from a log.

A TIMESYNC exchange counts no matter who asked: this watch, or a ground station whose requests are on the same stream.
Before the first exchange the vehicle's clock is unknown. Delays are then measured against the fastest recent frame,
which makes them lower bounds.

A *look* samples how old the newest states are, as a station would at a control tick. Repetition of a state because
telemetry is slower than control is not counted as loop delay (`gcs.control.loop_delay.repeated_s`). Until a station
asks, vehicles send states at their own rate; repetition because it is below the scenario's rate is not counted either.
Without the scenario no rates are known, and all repetition counts. With loops on board, the delays are those of a
vehicle's own states, not of the oldest state that its command needs.
"""

from array import array
from collections import Counter
from collections.abc import Iterable
from math import nan

import numpy as np

from gcs.control.loop_delay import headroom, loop_delay_s, repeated_since_s
from gcs.link import mavlink
from gcs.link.clocks import UNANSWERED, UNANSWERED_NS, boot_ns_of, bound_at_ns, offset_at_ns, to_station_ns
from gcs.link.datagram import Address, Datagram, Outgoing
from gcs.link.kinds import SET_MESSAGE_INTERVAL
from gcs.link.startup import LaunchedStartup
from gcs.link.vehicle import SILENCE_S, RemoteVehicle
from gcs.plan.design import Design
from gcs.published import Published
from gcs.runs.summary import estimate
from gcs.runs.summary_record import Clock, Estimate
from gcs.station.reception import ANOTHER_ADDRESS, NOT_FINITE
from scenarios.schema import NS_PER_S, Rates

SYSTEM_ID = 254
"""System id of the watch's requests. It differs from a station's, whose sequence numbers vehicles track."""
SILENT_NS = 3 * NS_PER_S
"""A vehicle not heard for this long counts as silent."""
_GAP_NS = round(SILENCE_S * NS_PER_S)
"""A longer gap between two states is a silence: the vehicle would be lost in flight, and get no set-points."""
SAMPLE_NS = NS_PER_S // 10
"""Mean time between two looks, each of which records the age of the newest states."""
PAST = "p99 past the margin"
LOWER_BOUND = "lower bound"
"""Status of a delay measured against the fastest frame for lack of an exchange."""
_GOLDEN = 0.6180339887498949
_ASKED = 4096
"""Most requests remembered: those to 250 vehicles at 10 Hz over 1.6 s, or to five over 80 s."""
_LEAST_NS = 10 * NS_PER_S
"""The fastest frame is sought over the last one to two spans of this length; 20 ppm of drift adds 0.4 ms in two."""
_AUTOPILOT, _NO_AUTOPILOT, _STATION = 1, 8, 6
"""Component id of an autopilot; MAV_AUTOPILOT_INVALID; MAV_TYPE_GCS."""
ASK_AGAIN_NS = 2 * NS_PER_S
"""Time between two requests for positions to the same vehicle."""
_POSITIONS = (mavlink.LOCAL_POSITION_NED, mavlink.GLOBAL_POSITION_INT)


class LinkFigures(Published):
    """The figures of one vehicle's links. Without a TIMESYNC exchange, delays are lower bounds."""

    system_id: int
    status: str
    telemetry_hz: float | None
    rtt_s: Estimate
    telemetry_age_s: Estimate
    loop_delay_s: Estimate
    headroom: float | None
    """1 - 99th percentile of the loop delay / margin."""
    effective_loop_delay_s: float | None
    """The mean loop delay, on which stability depends. Lost positions lengthen it; lost set-points, which cannot be
    seen here, would lengthen it further."""
    effective_headroom: float | None
    """1 - effective loop delay / margin."""
    unjudged: bool
    """Whether there is a margin, but the loop delay was unknown or a lower bound in most of the last quarter."""
    received: int
    lost: int
    late: int
    duplicate: int
    clock: Clock


class WatchReport(Published):
    """The links that `gcs monitor` watches, and the messages that it sent."""

    listening: str
    duration_s: float
    delay_margin_s: float | None
    margin_of: str
    """Where the margin comes from."""
    silent: bool
    sent: dict[str, int]
    send_errors: int
    stations: tuple[int, ...]
    refused: dict[str, int]
    vehicles: tuple[LinkFigures, ...]
    scenario_telemetry_hz: float | None = None
    """None without a scenario."""

    @property
    def failed(self) -> bool:
        """Whether a vehicle was never heard, or a loop delay exceeded the margin or could not be compared with it."""
        bad = any(v.unjudged or v.status in ("not heard", PAST) or (v.headroom or 0.0) < 0.0 for v in self.vehicles)
        return bad or not self.vehicles


class WatchedVehicle:
    """One vehicle as seen by a passive observer: what it sent, and how late that arrived."""

    def __init__(self, system_id: int, rates: Rates | None = None) -> None:
        self.remote = RemoteVehicle(system_id, startup=LaunchedStartup(1.0))
        self.remote.goal = None  # it is commanded nothing
        self.rtt_s = array("d")
        self._exchanged_ns = 0, 0
        """When the first and the newest reply came."""
        self.age_s = array("d")
        self.loop_delay_s = array("d")
        """Ages and loop delays, one for each look; NaN where unknown and during a silence, which is not a latency."""
        self._judged = 0
        """Number of looks up to the newest state. Later looks saw a latency or a silence; the next state decides."""
        self.states = 0
        """Position reports received."""
        self.first_state_ns = 0
        self.state_ns = 0
        """When the newest state was received."""
        self.boot_ns = 0
        """When the newest state was sampled, on the vehicle's clock."""
        self._interval_ns = 1 << 62
        """Shortest interval between two states on the vehicle's clock, which losses do not lengthen."""
        self._rates = rates
        self._kind = mavlink.GLOBAL_POSITION_INT
        self._least_since_ns = 0
        self._least_ns: tuple[int, int] = (1 << 62, 1 << 62)

    def state(self, frame: mavlink.Frame, received_ns: int) -> None:
        """Take in a position report. Once local positions arrive, only they count, because formations fly by them."""
        if frame.msg_id == mavlink.LOCAL_POSITION_NED != self._kind:
            self._kind, self.states = mavlink.LOCAL_POSITION_NED, 0
        boot_ns = boot_ns_of(self.remote.clock.estimate, frame.fields[0], received_ns)
        if frame.msg_id != self._kind or (self.states and boot_ns == self.boot_ns):
            return
        if boot_ns < self.boot_ns < boot_ns + NS_PER_S and not self.remote.newest:
            return  # overtaken by a newer state
        self.remote.clock.sampled_ns(frame.fields[0], received_ns, newest=self.remote.newest)  # detects a clock jump
        if boot_ns < self.boot_ns:
            self._least_ns = (1 << 62, 1 << 62)  # the vehicle's clock has restarted
        if self.states and boot_ns > self.boot_ns:
            self._interval_ns = min(self._interval_ns, boot_ns - self.boot_ns)
        if self._has_gap(received_ns):
            self.first_state_ns += received_ns - self.state_ns  # a silence does not lower the rate
            for looks in (self.age_s, self.loop_delay_s):
                looks[self._judged :] = array("d", [nan]) * (len(looks) - self._judged)
        self._judged = len(self.age_s)
        self.first_state_ns = self.first_state_ns if self.states else received_ns
        self.states += 1
        self.state_ns, self.boot_ns = received_ns, boot_ns
        if received_ns - self._least_since_ns > _LEAST_NS:
            self._least_since_ns, self._least_ns = received_ns, (1 << 62, self._least_ns[0])
        self._least_ns = min(self._least_ns[0], received_ns - boot_ns), self._least_ns[1]

    def _has_gap(self, now_ns: int) -> bool:
        """Whether the newest state is so old that the next was lost or not sent. Some vehicles send one every 2 s."""
        usual_ns = self._interval_ns if self.states > 1 else 0
        return self.states > 0 and now_ns - self.state_ns > max(_GAP_NS, 2 * usual_ns)

    @property
    def least_delay_ns(self) -> int:
        """Least reception time minus boot time among recent frames: the least delay minus the clock offset."""
        return min(self._least_ns)

    def reply(self, rtt_ns: int, received_ns: int) -> None:
        """Take in the round trip of an exchange."""
        self.rtt_s.append(rtt_ns * 1e-9)
        self._exchanged_ns = self._exchanged_ns[0] or received_ns, received_ns

    def answers(self, now_ns: int) -> bool:
        """Whether it still answers requests: its newest reply is no older than `UNANSWERED` replies usually take."""
        (first_ns, newest_ns), count = self._exchanged_ns, len(self.rtt_s)
        usual_ns = UNANSWERED * (newest_ns - first_ns) // max(1, count - 1)
        return count > 0 and now_ns - newest_ns <= max(UNANSWERED_NS, usual_ns) + 3 * (self.remote.clock.rtt_ns or 0)

    def look(self, now_ns: int, *, asked: bool = True) -> None:
        """Sample the age of the newest state, and the loop delay of a command computed from it now.

        `asked` says whether a station may have requested the scenario's telemetry rates.
        """
        clock = self.remote.clock
        age_s, down_s, sampled_ns, repeated_s = nan, 0.0, 0, 0.0
        if self.states:
            if self._rates is not None:
                interval_ns = 0 if asked else self._interval_ns
                repeated_s = repeated_since_s(self._rates, self.state_ns, now_ns, interval_ns)
            sampled_ns = self.boot_ns + self.least_delay_ns
            if clock.samples:
                sampled_ns = to_station_ns(clock.estimate, self.boot_ns)
                down_s = clock.down_ns * 1e-9 if clock.down_ns is not None and self.answers(now_ns) else nan
            age_s = (now_ns - sampled_ns) * 1e-9
            if clock.samples and clock.exchange_due:  # the vehicle's clock may have restarted
                age_s = down_s = nan
        self.age_s.append(age_s)
        self.loop_delay_s.append(loop_delay_s(sampled_ns, now_ns, down_s, repeated_s))

    def figures(self, now_ns: int, margin_s: float | None, last: int = 0) -> LinkFigures:
        """The figures over the whole time, or over the `last` looks, which then stand for the last quarter."""
        clock, frames = self.remote.clock, self.remote.frames
        known = clock.estimate if clock.samples else None
        age_s, loop_s = (_spread(looks[: self._judged], last) for looks in (self.age_s, self.loop_delay_s))
        if known is None:
            bounds = {"status": LOWER_BOUND if self.states else "unknown"}
            age_s, loop_s = (looks.model_copy(update=bounds) for looks in (age_s, loop_s))
        span_s = (self.state_ns - self.first_state_ns) * 1e-9
        effective_s = _mean_s(self.loop_delay_s[: self._judged], last)
        left, effective_left = (
            None if margin_s is None or late_s is None else headroom(late_s, margin_s)
            for late_s in (loop_s.p99, effective_s)
        )
        return LinkFigures(
            system_id=self.remote.system_id,
            status=self._status(now_ns, loop_s.p99, left),
            telemetry_hz=round((self.states - 1) / span_s, 3) if self.states > 1 and span_s > 0 else None,
            rtt_s=_spread(self.rtt_s, last),
            telemetry_age_s=age_s,
            loop_delay_s=loop_s,
            headroom=left if margin_s else None,
            effective_loop_delay_s=effective_s,
            effective_headroom=effective_left if margin_s else None,
            unjudged=margin_s is not None and (known is None or not self._known_late(now_ns, last)),
            received=frames.received,
            lost=frames.lost,
            late=frames.late,
            duplicate=frames.duplicate,
            clock=Clock(
                status="unknown" if known is None else "measured",
                samples=len(self.rtt_s),
                offset_s=None if known is None else offset_at_ns(known, now_ns) * 1e-9,
                bound_s=None if known is None else bound_at_ns(known, now_ns) * 1e-9,
                skew_ppm=None if known is None else round(known.skew * 1e6, 3),
                jumps=clock.jumps,
            ),
        )

    def _known_late(self, now_ns: int, last: int) -> bool:
        """Whether the loop delay is known at half of the last quarter of the looks, or of the `last` ones."""
        count, late = len(self.loop_delay_s), last or -(-len(self.loop_delay_s) // 4)
        judged = self._judged if self._has_gap(now_ns) else count
        known = np.isfinite(np.array(self.loop_delay_s[max(0, count - late) : judged]))
        return 2 * int(known.sum()) >= min(late, count) > 0

    def _status(self, now_ns: int, loop_delay_s: float | None, left: float | None) -> str:
        if not self.remote.heard_ns:
            return "not heard"
        if now_ns - self.remote.heard_ns > SILENT_NS:
            return "silent"
        if left is not None and left < 0:
            return PAST
        if not self.remote.clock.samples or not self.answers(now_ns):
            return "no exchange"
        return "no position" if loop_delay_s is None or self._has_gap(now_ns) else "measured"


class Watch:
    """All vehicles of a stream. Those in `system_ids` are expected; others are added at their first heartbeat."""

    def __init__(self, system_ids: Iterable[int] = (), rates: Rates | None = None) -> None:
        self.rates = rates
        """The rates of the scenario; None if it is not known."""
        self.vehicles = {system_id: WatchedVehicle(system_id, rates) for system_id in system_ids}
        self.stations: set[int] = set()
        """System ids of the ground stations on the stream."""
        self.counters: Counter[str] = Counter()
        self._asked: dict[int, int] = {}
        self._looks = 0
        self._look_ns = 0

    def ask(self, now_ns: int) -> int:
        """Register a TIMESYNC request of our own that is sent now; returns its ts1."""
        while now_ns in self._asked:
            now_ns += 1
        self._note_request(now_ns, now_ns)
        return now_ns

    def sent(self, datagrams: Iterable[Datagram]) -> None:
        """Record the exact send times of our own requests among these datagrams."""
        for data, _, sent_ns, _ in datagrams:
            for frame in mavlink.decode(data, Counter()):
                if frame.msg_id == mavlink.TIMESYNC:
                    self._asked[frame.fields[1]] = sent_ns

    def take(self, frame: mavlink.Frame, time_ns: int, address: Address | None = None) -> WatchedVehicle | None:
        """Take in a frame of a vehicle or a station; returns the vehicle, or None if the frame has no news of one."""
        vehicle = self._vehicle(frame)
        if vehicle is None:
            if frame.msg_id == mavlink.TIMESYNC and frame.fields[0] == 0:
                self._note_request(frame.fields[1], time_ns)
            return None
        remote = vehicle.remote
        if frame.component_id != _AUTOPILOT:
            self.counters["other component"] += 1
            return None
        if address is not None and remote.is_elsewhere(address, time_ns):
            self.counters[ANOTHER_ADDRESS] += 1
            return None
        remote.heard_ns, remote.address = time_ns, address
        if remote.is_replay(frame, time_ns):
            return None
        if not mavlink.is_finite(frame):
            self.counters[NOT_FINITE] += 1
            return None
        if frame.msg_id == mavlink.HEARTBEAT:
            remote.heartbeat(frame.fields, time_ns)
        elif frame.msg_id in _POSITIONS:
            vehicle.state(frame, time_ns)
        elif frame.msg_id == mavlink.TIMESYNC and frame.fields[0] != 0:
            self._reply(vehicle, frame.fields[0], frame.fields[1], time_ns)
        return vehicle

    def look(self, now_ns: int) -> int:
        """Sample the ages of all vehicles' states if a look is due; returns when the next is due.

        Looks are unevenly spaced, so they never lock to a telemetry rate.
        """
        if now_ns >= self._look_ns:
            self._looks += 1
            self._look_ns = now_ns + round(SAMPLE_NS * (0.5 + self._looks * _GOLDEN % 1.0))
            for vehicle in self.vehicles.values():
                vehicle.look(now_ns, asked=bool(self.stations))
        return self._look_ns

    def figures(self, now_ns: int, design: Design | None, last: int = 0) -> list[LinkFigures]:
        """The figures of each vehicle, in order of system id, with the headroom to its margin in a design, if given."""
        margins_s = {own: None if design is None else design.margin_of(own) for own in sorted(self.vehicles)}
        return [self.vehicles[own].figures(now_ns, margin_s, last) for own, margin_s in margins_s.items()]

    def _vehicle(self, frame: mavlink.Frame) -> WatchedVehicle | None:
        known = self.vehicles.get(frame.system_id)
        if known is not None or frame.msg_id != mavlink.HEARTBEAT:
            return known
        _, vehicle_type, autopilot = frame.fields[:3]
        if vehicle_type == _STATION:
            self.stations.add(frame.system_id)
        if autopilot == _NO_AUTOPILOT or frame.component_id != _AUTOPILOT:
            return None
        return self.vehicles.setdefault(frame.system_id, WatchedVehicle(frame.system_id, self.rates))

    def _note_request(self, ts1_ns: int, time_ns: int) -> None:
        self._asked.setdefault(ts1_ns, time_ns)
        if len(self._asked) > _ASKED:
            del self._asked[next(iter(self._asked))]

    def _reply(self, vehicle: WatchedVehicle, tc1_ns: int, ts1_ns: int, received_ns: int) -> None:
        asked_ns = self._asked.get(ts1_ns)
        if asked_ns is None:
            self.counters["reply to an unseen request"] += 1
            return
        clock = vehicle.remote.clock
        rtt_ns = clock.reply(tc1_ns=tc1_ns, ts1_ns=clock.request(asked_ns), received_ns=received_ns)
        if rtt_ns is not None:
            vehicle.reply(rtt_ns, received_ns)


def prepare() -> None:
    """Compile all kernels before links are measured, by taking in a few frames."""
    watch, sequence = Watch([1]), 0
    for now_ns in range(NS_PER_S, 4 * NS_PER_S, NS_PER_S):
        for msg_id, fields in (
            (mavlink.HEARTBEAT, mavlink.heartbeat()),
            (mavlink.TIMESYNC, mavlink.timesync(tc1_ns=now_ns, ts1_ns=watch.ask(now_ns))),
            (mavlink.LOCAL_POSITION_NED, (now_ns // 1_000_000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
        ):
            sequence += 1
            [frame] = mavlink.decode(mavlink.encode(msg_id, fields, sequence=sequence, system_id=1), Counter())
            watch.take(frame._replace(component_id=_AUTOPILOT), now_ns)
        watch.look(now_ns)
    watch.figures(4 * NS_PER_S, None)


class Requests:
    """Makes TIMESYNC requests to each address that vehicles send from, in turn; all vehicles behind it answer.

    `timesync_hz` is the rate to each address; 0 sends none. With a `position_hz`, each vehicle that sends no position
    is asked for LOCAL_POSITION_NED at that rate, every `ASK_AGAIN_NS` until it complies.
    """

    def __init__(self, timesync_hz: float, position_hz: float = 0.0) -> None:
        self.sent = self.positions_asked = 0
        self._position_interval_us = round(1e6 / position_hz) if position_hz else 0
        self._asked_ns: dict[int, int] = {}
        self.next_ns = 0 if timesync_hz else 1 << 62
        self._period_ns = NS_PER_S / (timesync_hz or 1.0)
        self._sequences: Counter[Address] = Counter()

    def due(self, watch: Watch, now_ns: int) -> list[Outgoing]:
        asked = self._for_positions(watch, now_ns) if self._position_interval_us else []
        if now_ns < self.next_ns:
            return asked
        addresses = {address for vehicle in watch.vehicles.values() if (address := vehicle.remote.address) is not None}
        self.next_ns = now_ns + round(self._period_ns / max(1, len(addresses)))
        if not addresses:
            return asked
        address = min(addresses, key=lambda address: (self._sequences[address], address))
        self.sent += 1
        return [*asked, self._numbered(mavlink.TIMESYNC, mavlink.timesync(tc1_ns=0, ts1_ns=watch.ask(now_ns)), address)]

    def _for_positions(self, watch: Watch, now_ns: int) -> list[Outgoing]:
        asked: list[Outgoing] = []
        for system_id, vehicle in watch.vehicles.items():
            address, waited_ns = vehicle.remote.address, now_ns - self._asked_ns.get(system_id, 0)
            if address is None or now_ns - vehicle.state_ns < SILENT_NS or waited_ns < ASK_AGAIN_NS:
                continue
            self._asked_ns[system_id] = now_ns
            self.positions_asked += 1
            parameters = float(mavlink.LOCAL_POSITION_NED), float(self._position_interval_us)
            fields = mavlink.command_long(
                SET_MESSAGE_INTERVAL, target_system=vehicle.remote.wire_id, confirmation=0, parameters=parameters
            )
            asked.append(self._numbered(mavlink.COMMAND_LONG, fields, address))
        return asked

    def _numbered(self, msg_id: int, fields: tuple[object, ...], address: Address) -> Outgoing:
        self._sequences[address] += 1
        data = mavlink.encode(msg_id, fields, sequence=self._sequences[address], system_id=SYSTEM_ID)
        return data, address


def _spread(values: "array[float]", last: int) -> Estimate:
    return estimate(np.array(values[-last:] if last else values, dtype=np.float64))


def _mean_s(values: "array[float]", last: int) -> float | None:
    known = np.array(values[-last:] if last else values, dtype=np.float64)
    known = known[np.isfinite(known)]
    return float(known.mean()) if known.size else None
