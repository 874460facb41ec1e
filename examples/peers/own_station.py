"""This station in real time, without the observer beside it, started with the arguments of `plain`.

It logs and measures as in every flight; a plain station does neither.
"""

import sys
import time  # noqa: TID251 - the driver of a station

import numpy as np
from plain import ordered, report

from gcs.control.phases import Phase
from gcs.drive.lockstep import prepare
from gcs.drive.udp import StationSocket, clock_ns, drive
from gcs.plan.planner import flight_plan
from gcs.runs.files import read_ticks
from gcs.runs.record import RunWriter
from gcs.station.station import Station
from scenarios.schema import NS_PER_S
from scenarios.undisturbed import undisturbed


def main() -> None:
    scenario, port, out = ordered()
    _, plan = flight_plan(scenario)
    prepare(plan)
    writer, used_s = RunWriter(out.parent), list[float]()
    with StationSocket("127.0.0.1", port) as link, undisturbed(own_code=False):
        station = Station(plan, start_ns=clock_ns(), stopwatch_ns=time.perf_counter_ns)

        def stop() -> str:
            if station.phase is Phase.FLYING:
                used_s.append(time.process_time())
            return ""

        drive(station, link, writer, stop, lambda _: None)
    writer.close()
    rows = read_ticks(out.parent)
    rows = rows[rows["commanded"]]
    if not rows.size:
        sys.exit(station.end_reason)
    ticks, first = np.unique(rows["tick"], return_index=True)
    late_s = (np.maximum.reduceat(rows["sent_ns"], first) - rows["due_ns"][first]) / NS_PER_S
    last = rows[rows["tick"] == ticks[-1]]
    error_m = np.abs(np.nan_to_num([last["spacing_error_north_m"], last["spacing_error_east_m"]])).max()
    report(out, late_s, int(ticks[-1] - ticks[0] + 1), used_s[-1] - used_s[0], float(error_m))


if __name__ == "__main__":
    main()
