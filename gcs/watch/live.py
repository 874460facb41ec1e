"""`gcs monitor`: the driver that watches the links of a socket and commands nothing.

All that it sends are TIMESYNC requests, one at a time to each address that vehicles send from, under a system id that
is not a station's. No heartbeat: a vehicle whose station has gone has to notice.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

from rich.live import Live

from gcs.drive.guard import Guard
from gcs.drive.udp import StationSocket, clock_ns
from gcs.link import mavlink
from gcs.views.console import plain_console
from gcs.watch.links import Requests, Watch
from gcs.watch.table import plain_line, render
from scenarios.schema import NS_PER_S

_SHOW_NS = NS_PER_S // 4
_PLAIN_NS = 5 * NS_PER_S
_WINDOW_LOOKS = 50
"""Looks in the live figures: those of the last five seconds."""


@dataclass(frozen=True)
class MonitorOptions:
    """How links are watched."""

    margin_s: float | None
    margin_of: str
    """Where the margin is from."""
    timesync_hz: float
    """Requests a second to each address; 0 to send nothing at all."""
    seconds: float
    shown: bool


class _Display:
    """The figures of the last seconds on standard output: a table on a terminal, else a line now and then."""

    def __init__(self, *, shown: bool, start_ns: int) -> None:
        self._console = plain_console(soft_wrap=False)
        self._shown = shown
        self._live: Live | None = None
        if shown and self._console.is_terminal:
            self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._period_ns = _SHOW_NS if self._live is not None else _PLAIN_NS
        self._due_ns = start_ns + self._period_ns

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, report: Callable[[int], dict[str, Any]], now_ns: int) -> None:
        """Show the report on the last so many looks, if that is due."""
        if now_ns < self._due_ns or not self._shown:
            return
        self._due_ns = now_ns + self._period_ns
        console, figures = self._console, report(_WINDOW_LOOKS)
        if self._live is None:
            print(plain_line(figures), flush=True)
        else:  # the last line stays free for the cursor
            self._live.update(render(figures, width=console.width, height=console.height - 1), refresh=True)


def monitor_links(
    link: StationSocket,
    watch: Watch,
    options: MonitorOptions,
    stop_reason: Callable[[], str],
    guard: Guard | None = None,
) -> dict[str, Any]:
    """Watch until the time is over or a reason to stop is given; returns the figures of the whole time."""
    requests = Requests(options.timesync_hz)
    start_ns = now_ns = clock_ns()
    end_ns = start_ns + round(options.seconds * NS_PER_S) if math.isfinite(options.seconds) else 1 << 62

    def report(last: int = 0) -> dict[str, Any]:
        return {
            "listening": "{}:{}".format(*link.address),
            "duration_s": round((now_ns - start_ns) / NS_PER_S, 3),
            "delay_margin_s": options.margin_s,
            "margin_of": options.margin_of,
            "silent": options.timesync_hz == 0,
            "sent": {"TIMESYNC": requests.sent},
            "send_errors": link.send_errors,
            "stations": sorted(watch.stations),
            "refused": dict(watch.counters),
            "vehicles": watch.figures(now_ns, options.margin_s, last),
        }

    with _Display(shown=options.shown, start_ns=start_ns) as display:
        look_ns = start_ns
        while now_ns < end_ns and not stop_reason():
            link.wait(min(look_ns, end_ns, requests.next_ns))  # not long: a signal does not end the wait
            datagrams = link.receive()
            if guard is not None:
                datagrams = guard.received(datagrams, clock_ns(), watch.counters)
            for datagram in datagrams:
                for frame in mavlink.decode_either(datagram.data, watch.counters):
                    watch.take(frame, datagram.received_ns, datagram.address)
            now_ns = clock_ns()
            look_ns = watch.look(now_ns)
            outgoing = requests.due(watch, now_ns)
            link.send(outgoing if guard is None else guard.sent(outgoing, now_ns))
            display.show(report, now_ns)
    return report()
