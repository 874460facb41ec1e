"""Flies a plan as `gcs fly` does, with processes, UDP sockets and the real clock, and measures the machine's load."""

import errno
import shutil
import tempfile
from pathlib import Path
from typing import NamedTuple

from gcs.control.tick import Event, TickArray
from gcs.drive.fly import FlyOptions, fly
from gcs.drive.udp import StationSocket
from gcs.plan.design import Design
from gcs.plan.flight_plan import FlightPlan
from gcs.runs.files import RunTail, read_ticks
from gcs.runs.grade import Truth, read_truth
from gcs.runs.record import EVENTS_FILE, TICKS_FILE, TRUTH_FILE

_IDLE, _WAITING, _STEAL = 3, 4, 7
"""Fields of the cpu line of /proc/stat: idle, waiting for a disk, and time taken by the host."""


class ProcessorShares(NamedTuple):
    """Fractions of the time of all processors: taken away by the host, and not idle, which includes the former."""

    steal: float
    busy: float


def fly_real_time(
    plan: FlightPlan, design: Design, folder: Path | None
) -> tuple[TickArray, list[Event], Truth, ProcessorShares]:
    """Fly a plan in real time.

    With a folder, which is created, the run is left there; otherwise it is deleted once read.

    Returns
    -------
    the ticks, the events, the vehicles' truth, and the load of the processors during the flight
    """
    kept = folder is not None
    folder = folder if folder is not None else Path(tempfile.mkdtemp(prefix="stress-"))
    folder.mkdir(parents=True, exist_ok=True)
    try:
        before = _processor_times()
        with StationSocket("127.0.0.1", 0) as link:
            summary = fly(plan, design, link, FlyOptions(folder=folder, show_table=False))
        needed = (TICKS_FILE, EVENTS_FILE, TRUTH_FILE)
        if lost := [text for text in summary.not_logged if text.startswith(needed)]:
            raise OSError(errno.ENOSPC, "; ".join(lost), str(folder))
        spent = [after - former for after, former in zip(_processor_times(), before, strict=True)]
        total = max(1, sum(spent))
        shares = ProcessorShares(spent[_STEAL] / total, 1.0 - (spent[_IDLE] + spent[_WAITING]) / total)
        return read_ticks(folder), RunTail(folder).events(), read_truth(folder / TRUTH_FILE), shares
    finally:
        if not kept:
            shutil.rmtree(folder, ignore_errors=True)


def _processor_times() -> list[int]:
    """Ticks of all processors since boot: user, nice, system, idle, iowait, irq, softirq, steal."""
    line = Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0]
    return [int(word) for word in line.split()[1:9]]
