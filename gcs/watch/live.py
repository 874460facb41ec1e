"""The driver of `gcs monitor`: watches the links at a socket and commands nothing.

It sends only TIMESYNC requests and, on request, asks for positions, under a system id that is not a station's. It sends
no heartbeat, which could hide from a vehicle that its station is gone.
"""

import math
from collections.abc import Callable
from functools import partial

from gcs.drive.udp import StationSocket, clock_ns
from gcs.link import mavlink
from gcs.link.datagram import network_at
from gcs.plan.design import Design
from gcs.views.console import draw, live_display
from gcs.watch.links import Requests, Watch, WatchReport, prepare
from gcs.watch.saved_links import LinkRecorder
from gcs.watch.table import plain_line, render
from scenarios.schema import NS_PER_S

_SHOW_NS = NS_PER_S // 4
_PLAIN_NS = 5 * NS_PER_S
_WINDOW_LOOKS = 50
"""Looks in the live figures: those of the last five seconds, on average."""


def watch_links(
    link: StationSocket,
    watch: Watch,
    stop_reason: Callable[[], str],
    *,
    design: Design | None,
    margin_of: str,
    timesync_hz: float,
    position_hz: float,
    seconds: float,
    shown: bool,
    recorder: LinkRecorder | None = None,
) -> WatchReport:
    """Watch the links for a number of seconds, or until there is a reason to stop; returns the figures over that time.

    `margin_of` says where the margins of `design` come from. `timesync_hz` is the rate of TIMESYNC requests to each
    address, 0 for none. Vehicles that send no position are asked for it at `position_hz`, unless that is 0. `recorder`
    notes every frame that `watch` takes.
    """
    prepare()
    requests = Requests(timesync_hz, position_hz)
    start_ns = now_ns = clock_ns()
    end_ns = start_ns + round(seconds * NS_PER_S) if math.isfinite(seconds) else 1 << 62

    def report(last: int = 0) -> WatchReport:
        return WatchReport(
            listening="{}:{}".format(*link.address),
            duration_s=round((now_ns - start_ns) / NS_PER_S, 3),
            delay_margin_s=None if design is None else design.delay_margin_s,
            margin_of=margin_of,
            silent=timesync_hz == 0,
            sent={"TIMESYNC": requests.sent, "SET_MESSAGE_INTERVAL": requests.positions_asked},
            send_errors=link.send_errors,
            stations=tuple(sorted(watch.stations)),
            refused=dict(watch.counters),
            vehicles=tuple(watch.figures(now_ns, design, last)),
            **({} if watch.rates is None else {"scenario_telemetry_hz": watch.rates.telemetry_hz}),
        )

    with live_display(shown=shown, transient=True) as live:
        period_ns = _PLAIN_NS if live is None else _SHOW_NS
        look_ns, show_ns = start_ns, start_ns + period_ns if shown else 1 << 62
        while now_ns < end_ns and not stop_reason():
            link.wait(min(look_ns, end_ns, requests.next_ns))  # short waits, because a signal does not end one
            for datagram in link.receive(watch.counters):
                frames = mavlink.decode_either(datagram.data, watch.counters)
                for frame in mavlink.in_network(frames, network_at(datagram.address)):
                    vehicle = watch.take(frame, datagram.received_ns, datagram.address)
                    if recorder is not None and vehicle is not None:
                        recorder.note(vehicle, frame, datagram.received_ns)
            now_ns = clock_ns()
            look_ns = watch.look(now_ns)
            watch.sent(link.send(requests.due(watch, now_ns)))
            if now_ns >= show_ns:
                show_ns = now_ns + period_ns
                figures = report(_WINDOW_LOOKS)
                if live is None:
                    print(plain_line(figures), flush=True)
                else:
                    draw(live, partial(render, figures))
    return report()
