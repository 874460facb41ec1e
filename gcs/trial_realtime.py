"""A trial flown as `gcs fly` flies it: processes, UDP sockets and the real clock, the machine's noise on record."""

import shutil
import tempfile
from pathlib import Path
from typing import Any

from gcs.fly import FlyOptions, fly
from gcs.plan import FlightPlan
from gcs.record import RunTail, TickArray
from gcs.summary import read_ticks
from gcs.udp import StationSocket

_STEAL = 7
"""Place of the time that the host took away in the cpu line of /proc/stat."""


def fly_real_time(
    plan: FlightPlan, design: dict[str, Any], folder: Path | None
) -> tuple[TickArray, list[dict[str, Any]], float]:
    """Fly a plan in real time.

    With a folder, which is made, the run is left there; without, it goes when it has been read.

    Returns
    -------
    the ticks, the events, and the part of all processor time that the host took away during the flight
    """
    kept = folder is not None
    folder = folder if folder is not None else Path(tempfile.mkdtemp(prefix="stress-"))
    folder.mkdir(parents=True, exist_ok=True)
    try:
        before = _processor_times()
        with StationSocket("127.0.0.1", 0) as link:
            fly(plan, design, link, FlyOptions(folder=folder, start_vehicles=True, show_table=False))
        spent = [after - former for after, former in zip(_processor_times(), before, strict=True)]
        return read_ticks(folder), RunTail(folder).events(), spent[_STEAL] / max(1, sum(spent))
    finally:
        if not kept:
            shutil.rmtree(folder, ignore_errors=True)


def _processor_times() -> list[int]:
    """Ticks of all processors since boot: user, nice, system, idle, iowait, irq, softirq, steal."""
    line = Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0]
    return [int(word) for word in line.split()[1:9]]
