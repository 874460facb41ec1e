"""The latencies in a summary: with status and sample count, and nothing for what is unknown."""

import numpy as np

from gcs.control.tick import CLOCK_JUMPED, Event
from gcs.runs.summary import summarise
from tests.support.fleets.flown_run import DESIGN, line, ticks_of


def test_estimates_have_status_and_samples_and_unknown_ones_are_none() -> None:
    scenario = line(2)
    ticks = ticks_of(scenario, start_s=0.0, count=200).ravel()
    ticks["commanded"] = True
    ticks["queue_s"] = 0.0002
    ticks["clock_offset_s"], ticks["clock_offset_bound_s"] = 3.0, 0.02
    ticks["down_bound_s"] = 0.004
    blind = ticks["system_id"] == 1
    for name in ("rtt_s", "down_delay_s", "telemetry_age_s", "loop_delay_s", "clock_offset_s"):
        ticks[name][blind] = np.nan
    ticks["rtt_s"][~blind] = np.arange(1, 201) * 1e-3
    events = [Event(time_s=1.0, kind="vehicle", text=CLOCK_JUMPED, system_id=2)]
    of = {vehicle.system_id: vehicle for vehicle in summarise(scenario, DESIGN, ticks, events).vehicles}
    rtt = of[2].rtt_s
    # numpy's percentile of 1..200 ms: 1 + 199 * 0.95
    assert (rtt.status, rtt.samples, rtt.max, rtt.p95) == ("measured", 200, 0.2, 0.19005)
    clock = of[2].clock
    assert (clock.status, clock.samples, clock.jumps) == ("measured", 200, 1)
    assert (clock.offset_s, clock.bound_s) == (3.0, 0.02)
    assert of[2].station_queue_s.p50 == 0.0002
    nothing = {"p50": None, "p95": None, "p99": None, "max": None, "samples": 0, "status": "unknown"}
    for unknown in (of[1].rtt_s, of[1].telemetry_age_s, of[1].loop_delay_s):
        assert unknown.to_dict() == nothing
    assert of[1].down_delay_s.to_dict() == nothing | {"bound_s": None}
    assert of[2].down_delay_s.bound_s == 0.004
    assert of[1].clock.offset_s is None
