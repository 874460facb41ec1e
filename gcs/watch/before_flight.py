"""Measures the links of a scenario just before its flight, for `control.for_link`. Nothing is commanded.

All vehicles are sent TIMESYNC requests, as by `gcs monitor`. The measurement ends MEASURED_S after every vehicle has
answered one and has sent a position; it is evaluated like a log. No set-points are sent, so links that set-points fill
are slower in flight. If `gcs fly` starts the vehicles, it starts them for the measurement alone.
"""

import contextlib
from pathlib import Path
from tempfile import TemporaryDirectory

from gcs.control.phases import patience_s
from gcs.drive.lockstep import START_NS, Sent, vehicles_of, virtual_address
from gcs.drive.sitl import VehicleProcess
from gcs.drive.udp import StationSocket, clock_ns
from gcs.errors import InputError
from gcs.interrupts import raised
from gcs.link import mavlink
from gcs.link.datagram import NUMBER_BITS
from gcs.plan.design import LinkPart
from gcs.runs.files import write_scenario
from gcs.runs.record import SCENARIO_FILE
from gcs.watch.for_link import delays_of
from gcs.watch.links import Requests, Watch
from gcs.watch.live import watch_links
from gcs.watch.saved_links import LinkRecorder
from scenarios.networks import network_of
from scenarios.schema import NS_PER_S, Scenario

MEASURED_S = 5.0
_TIMESYNC_HZ = 20.0


class _Measurement:
    """A measurement in progress: the observed links of a scenario's vehicles, and since when all have been heard."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self.watch = Watch((vehicle.system_id for vehicle in scenario.vehicles), scenario.rates)
        self.recorder = LinkRecorder()
        self.patience_s = patience_s(scenario) + MEASURED_S
        self._complete_ns = 0

    def is_long_enough(self, now_ns: int) -> bool:
        if not self._complete_ns and all(own.states and own.rtt_s for own in self.watch.vehicles.values()):
            self._complete_ns = now_ns
        return bool(self._complete_ns) and now_ns - self._complete_ns >= MEASURED_S * NS_PER_S

    def delays(self, complaint: str = "") -> LinkPart:
        """The measured loop delays. Raises InputError if any vehicle's links could not be measured."""
        measured = self.recorder.measured
        if missing := [str(system_id) for system_id in self.watch.vehicles if system_id not in measured]:
            read = complaint or f"too few TIMESYNC exchanges with vehicle{'s' * (len(missing) > 1)} {' '.join(missing)}"
            wanted = f"{MEASURED_S:g} s of them with every vehicle before the flight"
            raise InputError(f"{self._scenario.name}: control.for_link: read {read}, wanted {wanted}")
        return delays_of(self.recorder, f"the {MEASURED_S:g} s before the flight", self._scenario)


def measured_now(
    scenario: Scenario, link: StationSocket | None, *, start_vehicles: bool, key_file: Path | None, shown: bool
) -> LinkPart:
    """The loop delays that the scenario would have over the links of the vehicles that send to this socket.

    With `start_vehicles` these are simulated and end with the measurement. Without a socket, vehicles and links run on
    a virtual clock. `shown` displays the links meanwhile. Raises InputError if any vehicle's links cannot be measured,
    KeyboardInterrupt if a signal ends the measurement.
    """
    found, complaint = _Measurement(scenario), ""
    if link is None:
        _watch_virtually(found, scenario)
        return found.delays()
    with raised(), contextlib.ExitStack() as stack:
        started: VehicleProcess | None = None
        if start_vehicles:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="links-")))
            write_scenario(folder, scenario)
            started = VehicleProcess(folder / SCENARIO_FILE, station=link.address, folder=folder, key_file=key_file)
            stack.enter_context(started)

        def ended() -> str:
            nonlocal complaint
            complaint = "" if started is None else started.complaint()
            return complaint or ("measured" if found.is_long_enough(clock_ns()) else "")

        watch_links(
            link,
            found.watch,
            ended,
            design=None,
            margin_of="",
            timesync_hz=_TIMESYNC_HZ,
            position_hz=scenario.rates.telemetry_hz,
            seconds=found.patience_s,
            shown=shown,
            recorder=found.recorder,
        )
    link.receive()  # discards what these vehicles sent last: it is not part of the flight
    return found.delays(complaint)


def _watch_virtually(found: _Measurement, scenario: Scenario) -> None:
    requests, vehicles = Requests(_TIMESYNC_HZ, scenario.rates.telemetry_hz), vehicles_of(scenario)
    now_ns = START_NS
    to_vehicles: Sent = []
    while not found.is_long_enough(now_ns) and now_ns - START_NS < found.patience_s * NS_PER_S:
        for system_id, data, time_ns in vehicles.step(to_vehicles, now_ns):
            for frame in mavlink.in_network(mavlink.decode(data, found.watch.counters), network_of(system_id)):
                if (vehicle := found.watch.take(frame, time_ns, virtual_address(system_id))) is not None:
                    found.recorder.note(vehicle, frame, time_ns)
        to_vehicles = [(address & NUMBER_BITS, data, now_ns) for data, address in requests.due(found.watch, now_ns)]
        now_ns = requests.next_ns
