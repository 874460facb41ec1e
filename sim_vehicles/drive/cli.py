"""The command `sim-vehicles`: fly a scenario's vehicles on UDP until told to stop."""

import argparse
import contextlib
import json
import math
import os
import signal
import socket
import sys
import time  # noqa: TID251 - the command starts the vehicles' clock
from collections import Counter
from collections.abc import Callable, Generator
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Never

if TYPE_CHECKING:
    from scenarios.schema import Scenario
    from sim_vehicles.drive.fleet import Fleet
    from sim_vehicles.drive.udp import Sockets
    from sim_vehicles.links.truth import TruthLog
    from sim_vehicles.vehicles.shell import Change

SUCCESS, USAGE, INTERRUPTED = 0, 2, 130
NS_PER_S = 1_000_000_000
GOODBYE_NS = NS_PER_S
"""Time the program runs on after the last vehicle was told to shut down, so that its answer leaves the links."""

DESCRIPTION = """\
Fly the vehicles of a scenario: each is a MAVLink system of its own, behind emulated links. Each has its own UDP port,
or those of a network share one if the scenario sets links.one_port. They stay on the launcher, or on the ground, until
a MAVLink ground station arms and commands them.

With --links-only no vehicle is simulated: MAVLink vehicles that send to a --vehicle-port get the scenario's links for
their system ids, and the station hears each vehicle from a port of its own."""


def main() -> None:
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.links_only != bool(options.vehicle_port):
        parser.error("read one of --links-only and --vehicle-port, wanted both or neither")
    if options.links_only and options.key:
        parser.error("read --key with --links-only, wanted one of them: links pass signed frames on as they are")
    with _signals() as signals, contextlib.ExitStack() as opened:
        # imported after parsing, so that --help and a mistyped option answer at once
        from scenarios.errors import ScenarioError
        from scenarios.signing.keys import KeyFileError

        try:
            _run(options, signals, opened)
        except (_UsageError, ScenarioError, KeyFileError) as error:
            return _complain(str(error))
    return INTERRUPTED if signal.SIGINT in signals else SUCCESS


class _UsageError(Exception):
    """A file or an address that was given cannot be used."""


def _run(options: argparse.Namespace, signals: list[int], opened: contextlib.ExitStack) -> None:
    from scenarios.files import load
    from scenarios.own_code import refusal
    from scenarios.shipped import located
    from sim_vehicles.links.truth import TruthLog

    scenario, log = load(located(options.scenario)), None
    refused = None if options.allow_code or options.links_only else refusal(scenario, Path(options.scenario))
    if refused is not None:
        raise _UsageError(refused)
    if options.truth:
        try:
            log = TruthLog(options.truth)
        except (OSError, ValueError) as error:
            raise _UsageError(f"--truth: {error}, wanted a new file, or a truth log to continue") from None
        opened.callback(log.close)
    if options.counters:
        try:
            options.counters.open("ab").close()
        except OSError as error:
            text = f"--counters: {options.counters}: {error.strerror}, wanted a file that can be written"
            raise _UsageError(text) from None
    (_links_only if options.links_only else _fly)(scenario, log, signals, options, opened)


def _fly(
    scenario: "Scenario",
    log: "TruthLog | None",
    signals: list[int],
    options: argparse.Namespace,
    opened: contextlib.ExitStack,
) -> None:
    from sim_vehicles.drive.fleet import Fleet, prepare
    from sim_vehicles.drive.guard import open_links
    from sim_vehicles.drive.udp import Ports, run

    system_ids = tuple(sorted(v.system_id for v in scenario.vehicles))
    epoch_ns = time.time_ns() - time.monotonic_ns()
    signed = open_links(options.key, system_ids, epoch_ns=epoch_ns) if options.key else None
    try:
        ports = Ports(system_ids, options.station, one_port=scenario.links.one_port)
    except OSError as error:
        raise _UsageError(f"--station {_shown(options.station)}: {error.strerror or error}") from None
    opened.callback(ports.sockets.close)
    prepare(scenario)
    start_ns = time.monotonic_ns()
    fleet = Fleet(scenario, start_ns, recorder=log, signed=signed)
    lines = _Lines(start_ns)
    how = ", signed" if signed else ""
    if not signed:
        lines.warn_if_open([options.station], "others may send from there and nothing is signed; see --key")
    lines.print(f"{len(scenario.vehicles)} vehicles of {scenario.name}, to {_shown(options.station)}{how}")
    stop = _stop_rule(signals, start_ns, options, lines, fleet)

    def look(now_ns: int) -> bool:
        lines.news(fleet.take_changes(), ports.sockets, log)
        return stop(now_ns, fleet.commanded_ns)

    if not stop(start_ns, start_ns):
        run(ports.sockets, lambda now: ports.send(fleet.step(ports.receive(), now)), lambda: fleet.next_event_ns, look)
    lines.summary(fleet.counters + ports.sockets.counters, log, options.counters)


def _links_only(
    scenario: "Scenario",
    log: "TruthLog | None",
    signals: list[int],
    options: argparse.Namespace,
    opened: contextlib.ExitStack,
) -> None:
    from scenarios.networks import networks_of
    from sim_vehicles.drive.relay_udp import Peers
    from sim_vehicles.drive.udp import run
    from sim_vehicles.links.relay import Relay

    if (networks := networks_of(vehicle.system_id for vehicle in scenario.vehicles)) != [0]:
        read = f"vehicles in the networks {' '.join(map(str, networks))}"
        raise _UsageError(f"--links-only: read {read}, wanted those of network 0: frames do not name their network")
    try:
        peers = Peers(options.vehicle_port, options.station)
    except OSError as error:
        ports = ", ".join(map(_shown, options.vehicle_port))
        text = f"--vehicle-port {ports}, --station {_shown(options.station)}: {error.strerror or error}"
        raise _UsageError(text) from None
    opened.callback(peers.sockets.close)
    start_ns = time.monotonic_ns()
    links = Relay(scenario, start_ns, recorder=log)
    lines = _Lines(start_ns)
    ports = ", ".join(map(_shown, options.vehicle_port))
    lines.warn_if_open(options.vehicle_port, "links pass on what anybody sends; only stations and vehicles can sign")
    lines.print(f"the links of {scenario.name}, from vehicles at {ports}, to {_shown(options.station)}")
    stop = _stop_rule(signals, start_ns, options, lines)

    def look(now_ns: int) -> bool:
        lines.news(peers.take_changes(), peers.sockets, log)
        return stop(now_ns, links.last_heard_ns)

    run(peers.sockets, lambda now: peers.send(links.step(peers.receive(), now)), lambda: links.next_event_ns, look)
    lines.summary(links.counters + peers.sockets.counters, log, options.counters)


def _stop_rule(
    signals: list[int], start_ns: int, options: argparse.Namespace, lines: "_Lines", fleet: "Fleet | None" = None
) -> Callable[[int, int], bool]:
    """The rule that ends the program, given the time now and the time of a station's last command."""
    duration_ns, silence_ns = options.duration * NS_PER_S, options.stop_after_silence * NS_PER_S
    alone_since_ns = start_ns if options.parent is None else math.inf

    def stop(now_ns: int, commanded_ns: int) -> bool:
        nonlocal alone_since_ns
        if alone_since_ns == math.inf and os.getppid() != options.parent:
            alone_since_ns = now_ns
            lines.print("the process that started this one has ended")
            if commanded_ns == start_ns:
                return True  # nobody has flown them, so nobody will take them over
            if fleet is not None:
                fleet.mark_orphaned()
        if fleet is not None and now_ns - fleet.shut_down_ns >= GOODBYE_NS:
            return True
        silent = now_ns - max(commanded_ns, alone_since_ns) >= silence_ns
        return bool(signals) or now_ns - start_ns >= duration_ns or silent

    return stop


class _Lines:
    """Prints lines for a person, on the terminal or in the log of the parent process."""

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self._is_read = True
        self._late = 0
        self._late_line_ns = start_ns

    def print(self, text: str) -> None:
        if self._is_read:
            try:
                print(text, flush=True)
            except OSError:  # terminal or pipe was closed; the vehicles fly on
                self._is_read = False

    def warn_if_open(self, addresses: list[tuple[str, int]], why: str) -> None:
        """Warn of each address that other machines can reach."""
        for host, port in addresses:
            if not ip_address(host).is_loopback:
                self.print(f"warning: {host}:{port} is open: {why}")

    def news(self, changes: list["Change"], sockets: "Sockets", log: "TruthLog | None") -> None:
        """Print what has happened since the last call, and write out the truth log."""
        for change in changes:
            time_s = (change.time_ns - self._start_ns) / NS_PER_S
            self.print(f"{time_s:8.3f} s  vehicle {change.system_id}: {change.text}")
        self.lateness(sockets)
        if log:
            log.flush()

    def lateness(self, sockets: "Sockets") -> None:
        """Report, at most once a second, datagrams that left so late that the links differ from the scenario's."""
        late, now_ns = sockets.counters["left_late"], time.monotonic_ns()
        if late > self._late and now_ns - self._late_line_ns >= NS_PER_S:
            since_s = (now_ns - self._late_line_ns) / NS_PER_S
            self.print(
                f"{(now_ns - self._start_ns) / NS_PER_S:8.3f} s  this host cannot keep up: {late - self._late} "
                f"datagrams left more than 5 ms late in {since_s:.1f} s, the latest {sockets.latest_ns / 1e6:.1f} ms"
            )
            self._late, self._late_line_ns, sockets.latest_ns = late, now_ns, 0

    def summary(self, counters: Counter[str], log: "TruthLog | None", kept: Path | None) -> None:
        """Print the counters as the last line, and write them to the file `kept` as JSON."""
        counters += Counter(truth_lost=log.lost if log else 0)
        counts = ", ".join(f"{name} {count}" for name, count in sorted(counters.items()))
        self.print(f"received: {counts or 'nothing'}")
        if kept:
            with contextlib.suppress(OSError):  # all is over, and the counters have been printed
                kept.write_text(json.dumps(counters))


@contextlib.contextmanager
def _signals() -> Generator[list[int]]:
    """Collect the signals that end the program in a list, until the context is left; not SIGHUP under nohup."""
    caught: list[int] = []
    wanted = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        wanted.append(signal.SIGHUP)
    before = [signal.signal(number, lambda number, _: caught.append(number)) for number in wanted]
    try:
        yield caught
    finally:
        for number, handler in zip(wanted, before, strict=True):
            signal.signal(number, handler)


class _OneLineParser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> Never:
        sys.exit(_complain(message))


def _parser() -> argparse.ArgumentParser:
    parser = _OneLineParser(
        prog="sim-vehicles", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenario", metavar="SCENARIO", help="scenario file (TOML), or the name of one that ships")
    silence = "end when no station has commanded a vehicle for this long (never)"
    parent = "the parent process; with --stop-after-silence: silence counts only after it has ended"
    for name, kind, default, metavar, text in (
        ("--station", _address, ("127.0.0.1", 14550), "HOST:PORT", "where the station listens (127.0.0.1:14550)"),
        ("--key", Path, None, "FILE", "sign with this key, and accept only frames signed with it"),
        ("--truth", Path, None, "FILE", "write the truth log, or continue one"),
        ("--counters", Path, None, "FILE", "write the counters as JSON at the end"),
        ("--stop-after-silence", _seconds, math.inf, "SECONDS", silence),
        ("--parent", int, None, "PID", parent),
        ("--duration", _seconds, math.inf, "SECONDS", "end after this time (never)"),
    ):
        parser.add_argument(name, type=kind, default=default, metavar=metavar, help=text)
    parser.add_argument(
        "--links-only", action="store_true", help="simulate no vehicles; put the links in front of other vehicles"
    )
    parser.add_argument("--allow-code", action="store_true", help="run the Python code that the scenario names")
    parser.add_argument(
        "--vehicle-port",
        type=lambda text: _address(text if ":" in text else f"127.0.0.1:{text}"),
        action="append",
        default=[],
        metavar="[HOST:]PORT",
        help="with --links-only: vehicles send here (127.0.0.1); repeatable",
    )
    return parser


def _shown(address: tuple[str, int]) -> str:
    return f"{address[0]}:{address[1]}"


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isascii() or not port.isdigit() or not 1 <= int(port) <= 65535:
        raise argparse.ArgumentTypeError(f"read {text!r}, wanted HOST:PORT with a port from 1 to 65535")
    try:
        found = socket.getaddrinfo(host, int(port), socket.AF_INET, socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise argparse.ArgumentTypeError(f"read {text!r}, wanted a host that can be found ({error})") from None
    return str(found[0][4][0]), int(port)


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not seconds > 0:
        raise argparse.ArgumentTypeError(f"read {text!r}, wanted a number of seconds above 0")
    return seconds


def _complain(text: str) -> int:
    print(f"sim-vehicles: {text}", file=sys.stderr)
    return USAGE


if __name__ == "__main__":
    main()
