"""The clock of a vehicle in SITL: replies that are dated back, and a simulator that cannot always keep up."""

from collections.abc import Iterator

import numpy as np

from scenarios.schema import NS_PER_S, Scenario

BACKDATING_STREAM, SLIP_STREAM = 8, 9
"""Last words of the spawn keys of these random streams."""


def backdating_ns(scenario: Scenario, system_id: int) -> Iterator[int]:
    """By how much each TIMESYNC reply of a vehicle is dated back, for ever; nothing where replies are right."""
    most_ns = round(scenario.autopilot.sitl.timesync_back_s * NS_PER_S)
    rng = _stream(scenario, system_id, BACKDATING_STREAM)
    while scenario.dynamics == "autopilot" and scenario.autopilot.sitl.timesync_back_s > 0.0:
        yield int(rng.random() * most_ns)


def slips(scenario: Scenario, system_id: int, start_ns: int) -> Iterator[tuple[int, int]]:
    """The instants at which a boot clock falls behind, and by how much: (host time in ns, change in ns), for ever."""
    sitl, time_ns = scenario.autopilot.sitl, start_ns
    rng = _stream(scenario, system_id, SLIP_STREAM)
    while sitl.slip_s:
        waited, lost = rng.exponential(size=2).tolist()
        time_ns += 1 + round(waited * sitl.slip_every_s * NS_PER_S)
        yield time_ns, -round(lost * sitl.slip_s * NS_PER_S)


def _stream(scenario: Scenario, system_id: int, number: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(scenario.seed, spawn_key=(system_id, number)))
