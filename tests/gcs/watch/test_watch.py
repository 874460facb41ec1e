"""Links watched without commanding: their reported delays against the truth, and what is not sent, in virtual time."""

import io
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from gcs.link import mavlink
from gcs.link.datagram import Datagram
from gcs.link.kinds import SET_MESSAGE_INTERVAL
from gcs.plan.design import Design, OwnMargins
from gcs.plan.expected_delay import effective_loop_delays_s
from gcs.plan.planner import flight_plan
from gcs.watch.links import SYSTEM_ID, LinkFigures, Requests, Watch, WatchReport
from gcs.watch.table import NOT_ASKED, RATES_UNKNOWN, links_table, render
from scenarios.files import load
from scenarios.keys.link import Jitter, Link, Links
from scenarios.schema import Rates, Scenario
from sim_vehicles.drive.fleet import Fleet
from sim_vehicles.links.truth import SAMPLED, MemoryRecorder
from tests.support.fleets.flown_copters import three
from tests.support.known import known
from tests.support.paths import SCENARIOS
from tests.support.sim_client import arm, command, guided, heartbeat, setpoint

START_NS = 1_000_000_000
MS = 1_000_000
CHAIN = load(SCENARIOS / "chain3.toml")


def linked(up: Link, down: Link) -> Scenario:
    return CHAIN.model_copy(update={"links": Links(up=up, down=down)})


class Watched:
    """A fleet that nobody flies, and a watch of it; a test can add the datagrams of a station."""

    def __init__(
        self,
        scenario: Scenario,
        *,
        timesync_hz: float,
        position_hz: float = 0.0,
        late_ns: int = 0,
        rates: Rates | None = None,
    ) -> None:
        self.truth = MemoryRecorder()
        self.fleet = Fleet(scenario, START_NS, recorder=self.truth)
        self.watch = Watch(rates=rates)
        self.requests = Requests(timesync_hz, position_hz)
        self.now_ns, self._late_ns = START_NS, late_ns
        self.sent: list[bytes] = []
        self.true_ages_s: list[float] = []
        """The age of the first vehicle's newest state at each look."""

    def run(self, seconds: float, station: list[tuple[int, bytes, int]] | None = None) -> None:
        """Advance in steps of a millisecond. `station`: datagrams (system id, bytes, ns) of a station alongside."""
        due = sorted(station or [], key=lambda entry: entry[2])
        end_ns = self.now_ns + round(seconds * 1e9)
        to_vehicles: list[tuple[int, bytes, int]] = []
        while self.now_ns < end_ns:
            self.now_ns += MS
            while due and due[0][2] < self.now_ns:
                system_id, data, time_ns = due.pop(0)
                to_vehicles.append((system_id, data, time_ns))
                for frame in mavlink.decode(data, Counter()):
                    self.watch.take(frame, time_ns)
            for system_id, data, time_ns in self.fleet.step(to_vehicles, self.now_ns):
                for frame in mavlink.decode_either(data, self.watch.counters):
                    self.watch.take(frame, time_ns, system_id)
            looks = len(self.true_ages_s)
            self.watch.look(self.now_ns)
            if 1 in self.watch.vehicles and len(self.watch.vehicles[1].age_s) > looks:
                self.true_ages_s += [self._true_age_s()] * (len(self.watch.vehicles[1].age_s) - looks)
            outgoing = self.requests.due(self.watch, self.now_ns)
            self.sent += [data for data, _ in outgoing]
            sent_ns = self.now_ns + self._late_ns
            self.watch.sent(Datagram(data, address, sent_ns) for data, address in outgoing)
            to_vehicles = [(system_id, data, sent_ns) for data, system_id in outgoing]

    def _true_age_s(self) -> float:
        boot_ms = self.watch.vehicles[1].boot_ns // MS
        sampled = [row[3] for row in self.truth.records.tolist() if row[:3] == (SAMPLED, 1, boot_ms)]
        return (self.now_ns - sampled[-1]) * 1e-9 if sampled else np.nan


class Peer:
    """A vehicle that sends what a test wants."""

    def __init__(self, system_id: int, port: int = 1) -> None:
        self._system_id, self._address, self._sequence = system_id, port, 0

    def say(
        self, watch: Watch, msg_id: int, fields: tuple[object, ...], time_ns: int, *, component_id: int = 1
    ) -> None:
        self._sequence += 1
        data = mavlink.encode(msg_id, fields, sequence=self._sequence, system_id=self._system_id)
        [frame] = mavlink.decode(data, Counter())
        watch.take(frame._replace(component_id=component_id), time_ns, self._address)


def report_of(vehicles: list[LinkFigures]) -> WatchReport:
    return WatchReport(
        listening="", duration_s=8.0, delay_margin_s=0.3, margin_of="", silent=False, send_errors=0, stations=(),
        sent={"TIMESYNC": 1}, refused={}, vehicles=tuple(vehicles),
    )  # fmt: skip


@pytest.mark.parametrize("late_ns", [0, MS // 2])
def test_round_trips_and_loop_delays_match_links_to_the_microsecond(late_ns: int) -> None:
    """Also if requests are sent later than they were made."""
    watched = Watched(linked(Link(delay_s=0.07), Link(delay_s=0.03)), timesync_hz=10.0, late_ns=late_ns)
    watched.run(8.0)
    vehicle = watched.watch.vehicles[1]
    assert len(vehicle.rtt_s) > 60
    np.testing.assert_allclose(vehicle.rtt_s, 0.1, atol=1e-6)
    # Up was slower than down by 40 ms, so the clock is off by 20 ms; the loop delay is not.
    late_s = np.array(vehicle.age_s) - watched.true_ages_s
    settled = np.isfinite(late_s) & (np.arange(late_s.size) > 30)
    assert settled.sum() > 30
    np.testing.assert_allclose(late_s[settled], -0.02, atol=1e-5)
    np.testing.assert_allclose((np.array(vehicle.loop_delay_s) - watched.true_ages_s)[settled], 0.03, atol=1e-5)
    figures = watched.watch.figures(watched.now_ns, Design(delay_margin_s=0.5))[0]
    # Half a round trip, and what a clock may drift since the newest reply was read, by then 0.05 to 0.2 s ago.
    assert 0.05 < known(figures.clock.bound_s) < 0.05 + 1e-3 * 0.25
    assert figures.headroom == pytest.approx(1 - known(figures.loop_delay_s.p99) / 0.5)
    assert figures.status == "measured"
    own = OwnMargins(system_id=1, delay_margins_s=(0.05, 0.1))
    figures = watched.watch.figures(watched.now_ns, Design(delay_margin_s=0.5, own_margins=(own,)))[0]
    assert figures.status == "p99 past the margin"


@pytest.mark.parametrize(
    ("telemetry_hz", "station", "longest_s"),
    [(4.0, False, 0.35), (4.0, True, 0.35), (20.0, False, 0.35), (20.0, True, 0.55)],
)
def test_repetition_is_no_loop_delay_to_an_onlooker_either(
    telemetry_hz: float, station: bool, longest_s: float
) -> None:
    """Vehicles report at 4 Hz, over 150 ms each way; the tick, at 20 Hz, adds at most 50 ms.

    If a station asks for 20 Hz, the states that it does not get count as late.
    """
    far = linked(Link(delay_s=0.15), Link(delay_s=0.15))
    watched = Watched(far, timesync_hz=10.0, rates=Rates(control_hz=20.0, telemetry_hz=telemetry_hz))
    watched.run(20.0, [(1, heartbeat(), START_NS)] if station else [])
    assert bool(watched.watch.stations) == station
    loop_s = np.array(watched.watch.vehicles[1].loop_delay_s)[20:]
    assert loop_s.min() == pytest.approx(0.3, abs=0.008)
    assert loop_s.max() == pytest.approx(longest_s, abs=0.008)
    assert np.median(loop_s) == pytest.approx((0.3 + longest_s) / 2.0, abs=0.008)


def test_silence_gives_lower_bounds_that_hold_and_rise_with_jitter() -> None:
    jitter = Jitter(distribution="uniform", scale_s=0.02)
    watched = Watched(linked(Link(delay_s=0.05, jitter=jitter), Link(delay_s=0.05)), timesync_hz=0.0)
    watched.run(10.0)
    assert watched.sent == []
    vehicle = watched.watch.vehicles[1]
    assert not vehicle.rtt_s
    true_s, bound_s = np.array(watched.true_ages_s), np.array(vehicle.loop_delay_s)
    known = np.isfinite(bound_s) & np.isfinite(true_s)
    assert known.sum() > 50
    short_s = (true_s - bound_s)[known]
    assert (short_s > 0).all()
    # After some seconds a frame with nearly the least delay, 30 ms, has come: that much is never seen.
    assert 0.03 - 0.001 < short_s[-30:].min() <= short_s[-30:].max() < 0.04
    assert watched.watch.figures(watched.now_ns, Design(delay_margin_s=0.3))[0].status == "no exchange"


def test_another_stations_exchanges_on_the_stream_are_used_without_asking() -> None:
    watched = Watched(linked(Link(delay_s=0.02), Link(delay_s=0.02)), timesync_hz=0.0)
    asked = [(system_id, START_NS + k * 100 * MS + system_id) for k in range(40) for system_id in (1, 2, 3)]
    station = [
        (to, mavlink.encode(mavlink.TIMESYNC, (0, 77_000_000_000 + time_ns), sequence=0), time_ns)
        for to, time_ns in asked
    ]
    watched.run(4.0, station)
    for vehicle in watched.watch.vehicles.values():
        assert len(vehicle.rtt_s) > 25
        np.testing.assert_allclose(vehicle.rtt_s, 0.04, atol=1e-6)
    assert watched.sent == []


def test_only_timesync_requests_are_sent_at_the_rate_asked_for() -> None:
    watched = Watched(CHAIN, timesync_hz=5.0)
    watched.run(10.0)
    frames = [frame for data in watched.sent for frame in mavlink.decode(data, Counter())]
    assert {(frame.msg_id, frame.system_id, frame.fields[0]) for frame in frames} == {(mavlink.TIMESYNC, SYSTEM_ID, 0)}
    assert 3 * 5 * 8 < len(frames) <= 3 * 5 * 10 + 3


def test_without_its_station_a_watched_vehicle_goes_to_failsafe() -> None:
    watched = Watched(CHAIN, timesync_hz=10.0)
    watched.run(1.0)
    start_ns = watched.now_ns
    flown = [(1, frame, start_ns + MS) for frame in (heartbeat(), arm(), guided(), setpoint())]
    flown += [(1, frame, start_ns + k * 20 * MS) for k in range(1, 50) for frame in (heartbeat(), setpoint())]
    watched.run(1.0, flown)
    assert watched.watch.vehicles[1].remote.guided
    watched.run(CHAIN.safety.heartbeat_timeout_s + 2.0)
    assert watched.watch.vehicles[1].remote.critical
    assert len(watched.watch.vehicles[1].rtt_s) > 40


def test_silence_is_shown_and_does_not_make_a_delay_grow() -> None:
    watched = Watched(linked(Link(delay_s=0.01), Link(delay_s=0.01)), timesync_hz=10.0)
    watched.run(5.0)
    before = watched.watch.figures(watched.now_ns, None)[0]
    later_ns = watched.now_ns
    for _ in range(600):
        later_ns += 100 * MS
        watched.watch.look(later_ns)
    after = watched.watch.figures(later_ns, None)[0]
    assert (before.status, after.status) == ("measured", "silent")
    assert after.loop_delay_s == before.loop_delay_s
    assert after.headroom is None


def test_looks_are_uneven_and_in_step_with_no_telemetry_rate() -> None:
    watch = Watch([1])
    times = [0]
    while len(times) < 500:
        times.append(watch.look(times[-1]))
    steps = np.array([b - a for a, b in pairwise(times)])
    assert 50 * MS <= steps.min() < 55 * MS
    assert 145 * MS < steps.max() <= 150 * MS
    assert np.mean(steps) == pytest.approx(100 * MS, rel=0.01)
    phase = np.exp(2j * np.pi * np.array(times) / (250 * MS))  # of telemetry at 4 Hz
    assert abs(phase.mean()) < 0.05


@given(
    st.lists(
        st.tuples(
            st.sampled_from([mavlink.HEARTBEAT, mavlink.TIMESYNC, mavlink.LOCAL_POSITION_NED]),
            st.integers(0, 2**63 - 1),
            st.integers(0, 255),
            st.integers(0, 10**12),
        ),
        max_size=40,
    )
)
def test_any_stream_is_taken_and_figures_are_plain_numbers(
    said: list[tuple[int, int, int, int]],
) -> None:
    watch = Watch([1])
    now_ns = START_NS
    for msg_id, number, sequence, step_ns in said:
        now_ns += step_ns
        fields = {
            mavlink.HEARTBEAT: (0, 2, 3, number & 0xFF, 4, 3),
            mavlink.TIMESYNC: (number, watch.ask(now_ns) if number % 2 else number),
            mavlink.LOCAL_POSITION_NED: (number & 0xFFFFFFFF, *(0.0,) * 6),
        }[msg_id]
        data = mavlink.encode(msg_id, fields, sequence=sequence, system_id=1)
        for frame in mavlink.decode(data, Counter()):
            watch.take(frame, now_ns)
        watch.look(now_ns)
    [figures] = watch.figures(now_ns, Design(delay_margin_s=0.3))
    assert figures.system_id == 1
    figures.to_json()  # JSON has no infinity


@pytest.mark.parametrize("width", [50, 72, 73, 80, 83, 84, 145, 146, 200])
def test_the_links_table_fits_the_terminal_with_headroom_and_status(width: int) -> None:
    watched = Watched(CHAIN, timesync_hz=10.0)
    watched.run(1.5)
    figures = watched.watch.figures(watched.now_ns, Design(delay_margin_s=0.3))
    console = Console(file=io.StringIO(), width=width, color_system=None)
    with console.capture() as capture:
        console.print(links_table(figures, width))
    lines = [line.rstrip() for line in capture.get().splitlines()]
    assert max(map(len, lines)) <= width
    assert sum(line.endswith(" measured") for line in lines) == 3
    for line, vehicle in zip(lines[-3:], figures, strict=True):
        assert f"{100 * known(vehicle.headroom):.0f}" in line.split()


def test_lost_positions_lengthen_the_effective_loop_delay() -> None:
    """Against the model of a whole flight over the same links, which lose no set-point."""
    rates = Rates(control_hz=20.0, telemetry_hz=20.0)
    lossy = linked(Link(delay_s=0.03, loss_probability=0.3), Link(delay_s=0.02)).model_copy(update={"rates": rates})
    watched = Watched(lossy, timesync_hz=10.0, rates=rates)
    interval = command(SET_MESSAGE_INTERVAL, float(mavlink.LOCAL_POSITION_NED), 50_000.0)
    watched.run(30.0, [(1, heartbeat(), START_NS), (1, interval, START_NS + 100 * MS)])
    [expected_s] = set(effective_loop_delays_s(flight_plan(lossy)[1]).values())
    figures = watched.watch.figures(watched.now_ns, Design(delay_margin_s=0.3))[0]
    effective_s = known(figures.effective_loop_delay_s)
    assert effective_s == pytest.approx(expected_s, rel=0.05)  # 600 positions, of which 150 to 200 are lost
    assert figures.effective_headroom == pytest.approx(1.0 - effective_s / 0.3)
    assert known(figures.loop_delay_s.p50) < 0.93 * effective_s < 0.7 * known(figures.loop_delay_s.p99)


@pytest.mark.parametrize("asked", [False, True])
def test_positions_come_if_requested_or_else_a_reason_is_given(asked: bool) -> None:
    """Like ArduPilot, copters send none unasked. Those that send positions are not asked again."""
    watched = Watched(three(), timesync_hz=10.0, position_hz=20.0 if asked else 0.0)
    watched.run(8.0)
    vehicles = watched.watch.figures(watched.now_ns, None)
    report = WatchReport(
        listening="", duration_s=8.0, delay_margin_s=None, margin_of="", silent=False, send_errors=0, stations=(),
        sent={"TIMESYNC": 1, "SET_MESSAGE_INTERVAL": watched.requests.positions_asked}, refused={},
        vehicles=tuple(vehicles),
    )  # fmt: skip
    text = io.StringIO()
    Console(file=text, width=120).print(render(report, width=120))
    if asked:
        assert [vehicle.status for vehicle in vehicles] == ["measured"] * 3
        assert [vehicle.telemetry_hz for vehicle in vehicles] == pytest.approx([20.0] * 3, rel=0.02)
        assert 3 <= watched.requests.positions_asked <= 9
        assert "no position" not in text.getvalue()
    else:
        assert [vehicle.status for vehicle in vehicles] == ["no position"] * 3
        assert f"no position from 1 2 3: {NOT_ASKED}" in text.getvalue()


@pytest.mark.parametrize(
    ("wanted_hz", "stations", "said"),
    [
        (50.0, (), "positions at 4 Hz from 1 2 3 until a station asks; loop delays are for 50 Hz"),
        (50.0, (255,), "positions at 4 Hz from 1 2 3, not 50 Hz: the difference counts as loop delay"),
        (4.0, (), ""),
        (None, (), RATES_UNKNOWN),
    ],
)
def test_slow_positions_are_reported_with_their_effect(
    wanted_hz: float | None, stations: tuple[int, ...], said: str
) -> None:
    watched = Watched(CHAIN, timesync_hz=10.0)
    watched.run(3.0)
    report = WatchReport(
        listening="", duration_s=3.0, delay_margin_s=0.3, margin_of="", silent=False, send_errors=0, stations=stations,
        sent={"TIMESYNC": 1}, refused={}, vehicles=tuple(watched.watch.figures(watched.now_ns, None)),
        scenario_telemetry_hz=wanted_hz,
    )  # fmt: skip
    text = io.StringIO()
    Console(file=text, width=80).print(render(report, width=80))
    printed = [line for line in text.getvalue().splitlines() if "position" in line]
    assert printed == ([said] if said else [])


@pytest.mark.parametrize(("delay_s", "failed"), [(0.2, True), (0.01, False)])
def test_delays_past_the_margin_fail_though_the_vehicle_is_silent(delay_s: float, failed: bool) -> None:
    watched = Watched(linked(Link(delay_s=delay_s), Link(delay_s=delay_s)), timesync_hz=10.0)
    watched.run(5.0)
    figures = watched.watch.figures(watched.now_ns + 4_000 * MS, Design(delay_margin_s=0.3))
    assert {vehicle.status for vehicle in figures} == {"silent"}
    assert report_of(figures).failed == failed


def test_a_camera_is_not_its_vehicle() -> None:
    watch, peer = Watch([2]), Peer(2)
    peer.say(watch, mavlink.HEARTBEAT, (0, 30, 8, 0, 4, 3), START_NS, component_id=100)
    figures = watch.figures(START_NS, None)
    assert [vehicle.status for vehicle in figures] == ["not heard"]
    assert report_of(figures).failed
    assert not Requests(10.0, 10.0).due(watch, START_NS)


@pytest.mark.parametrize("by_s", [0.5, 60.0])
@pytest.mark.parametrize("asks", [False, True])
def test_a_clock_set_back_shows_in_no_delay(asks: bool, by_s: float) -> None:
    """States at 20 Hz and exchanges at 2 Hz, over links without delay."""
    watch, peer, now_ns, by_ns = Watch([1]), Peer(1), 0, round(by_s * 1e9)
    for tick in range(400):
        now_ns = 100 * START_NS + 50 * MS * tick
        boot_ns = 100_000 * MS + now_ns - (by_ns if tick >= 201 else 0)
        peer.say(watch, mavlink.LOCAL_POSITION_NED, (boot_ns // MS, *(0.0,) * 6), now_ns)
        watch.look(now_ns + MS)
        if asks and tick % 10 == 0:
            peer.say(watch, mavlink.TIMESYNC, (boot_ns, watch.ask(now_ns)), now_ns)
        watch.look(now_ns + 45 * MS)
    [figures] = watch.figures(now_ns + 46 * MS, None)
    assert known(figures.loop_delay_s.max) < 0.05
    assert figures.loop_delay_s.samples > 150


def test_a_second_vehicle_with_the_same_id_is_counted_apart() -> None:
    watch, peers, now_ns = Watch([1]), [Peer(1, port=1), Peer(1, port=2)], 0
    for tick in range(100):
        for k, peer in enumerate(peers):
            now_ns = START_NS + 50 * MS * tick + k
            boot_ms = (now_ns + k * 30_000 * MS) // MS
            peer.say(watch, mavlink.LOCAL_POSITION_NED, (boot_ms, *(0.0,) * 6), now_ns)
    [figures] = watch.figures(now_ns, None)
    assert figures.telemetry_hz == pytest.approx(20.0)
    assert (figures.received, figures.late) == (100, 0)
    assert watch.counters == {"known system id from another address": 100}
    text, report = io.StringIO(), report_of([figures]).model_copy(update={"refused": dict(watch.counters)})
    Console(file=text, width=50).print(render(report, width=50))  # what is printed at the end is whole
    assert "left out: 100 known system id from another address" in " ".join(text.getvalue().split())


def test_a_delay_is_unknown_once_exchanges_have_stopped() -> None:
    """The links may have become slower since."""
    watched = Watched(linked(Link(delay_s=0.02), Link(delay_s=0.02)), timesync_hz=10.0)
    for timesync_hz, status in ((10.0, "measured"), (0.0, "no exchange")):
        watched.requests = Requests(timesync_hz)
        watched.run(5.0)
        vehicle = watched.watch.figures(watched.now_ns, Design(delay_margin_s=0.3), last=20)[0]
        assert (vehicle.status, vehicle.headroom is None) == (status, status == "no exchange")
    assert vehicle.telemetry_age_s.p50 is not None


@pytest.mark.parametrize(("stopped_s", "status"), [(1.0, "measured"), (2.0, "no position")])
def test_positions_that_have_stopped_are_not_measured(stopped_s: float, status: str) -> None:
    """The vehicle still answers."""
    watch, peer, now_ns = Watch([1]), Peer(1), 0
    for tick in range(200):
        now_ns = 100 * START_NS + 50 * MS * tick
        if tick < 200 - 20 * stopped_s:
            peer.say(watch, mavlink.LOCAL_POSITION_NED, (now_ns // MS, *(0.0,) * 6), now_ns)
        peer.say(watch, mavlink.TIMESYNC, (now_ns, watch.ask(now_ns)), now_ns)
        watch.look(now_ns)
    assert [figures.status for figures in watch.figures(now_ns, None)] == [status]


def test_positions_that_are_not_finite_are_refused_but_not_lost() -> None:
    watch, peer = Watch([1]), Peer(1)
    for tick in range(100):
        now_ns = 100 * START_NS + 50 * MS * tick
        north_m = float("nan") if tick % 2 else 0.0
        peer.say(watch, mavlink.LOCAL_POSITION_NED, (now_ns // MS, north_m, *(0.0,) * 5), now_ns)
    [figures] = watch.figures(100 * START_NS, None)
    assert (figures.received, figures.lost, watch.vehicles[1].states) == (100, 0, 50)
    assert watch.counters == {"not finite": 50}


@pytest.mark.parametrize("margin_s", [None, 0.3])
@pytest.mark.parametrize(("stopped_s", "judged"), [(0.0, True), (3.0, True), (5.0, False), (10.0, False)])
def test_link_with_margin_passes_only_if_last_delay_is_known(
    margin_s: float | None, stopped_s: float, judged: bool
) -> None:
    """Of 10 s, the last 2.5 count. Exchanges that stopped are missed after two seconds."""
    watched = Watched(linked(Link(delay_s=0.02), Link(delay_s=0.02)), timesync_hz=10.0)
    watched.run(10.0 - stopped_s)
    watched.requests = Requests(0.0)
    watched.run(stopped_s)
    figures = watched.watch.figures(watched.now_ns, Design(delay_margin_s=margin_s))
    assert {vehicle.unjudged for vehicle in figures} == {margin_s is not None and not judged}
    report = report_of(figures)
    assert report.failed == (margin_s is not None and not judged)
    text = io.StringIO()
    Console(file=text, width=120).print(render(report, width=120))
    assert ("not judged: 1 2 3; loop delay unknown" in text.getvalue()) == report.failed


@pytest.mark.parametrize(("silent_s", "longest_s"), [(1.2, 1.2), (1.8, 0.05), (2.5, 0.05)])
def test_silence_that_would_lose_a_vehicle_is_no_latency(silent_s: float, longest_s: float) -> None:
    """States at 20 Hz. The looks before the gap ends are up to 0.15 s early."""
    watch, peer, now_ns = Watch([1]), Peer(1), 0
    for tick in range(400):
        now_ns = 100 * START_NS + 50 * MS * tick + (round(silent_s * 1e9) if tick >= 200 else 0)
        if tick == 200:
            for early_ns in range(round(silent_s * 1e9), 0, -10 * MS):
                watch.look(now_ns - early_ns)
        peer.say(watch, mavlink.LOCAL_POSITION_NED, (now_ns // MS, *(0.0,) * 6), now_ns)
        peer.say(watch, mavlink.TIMESYNC, (now_ns, watch.ask(now_ns)), now_ns)
        watch.look(now_ns + 49 * MS)
    [figures] = watch.figures(now_ns, Design(delay_margin_s=0.3))
    assert longest_s - 0.16 < known(figures.loop_delay_s.max) < longest_s + 0.06
    assert figures.telemetry_hz == pytest.approx(20.0, rel=0.01 if silent_s > 1.5 else 0.07)
    assert not figures.unjudged


def test_states_that_come_every_two_seconds_are_no_silence() -> None:
    watch, peer, now_ns = Watch([1]), Peer(1), 0
    for tick in range(200):
        now_ns = 100 * START_NS + 100 * MS * tick
        if tick % 20 == 0:
            peer.say(watch, mavlink.LOCAL_POSITION_NED, (now_ns // MS, *(0.0,) * 6), now_ns)
        peer.say(watch, mavlink.TIMESYNC, (now_ns, watch.ask(now_ns)), now_ns)
        watch.look(now_ns + 50 * MS)
    [figures] = watch.figures(now_ns, Design(delay_margin_s=5.0))
    assert known(figures.loop_delay_s.max) == pytest.approx(2.0, abs=0.2)
    assert not figures.unjudged
