"""Clock errors of a vehicle in SITL: backdated TIMESYNC replies, and slips when the simulator lags."""

from collections.abc import Iterator

from scenarios.schema import NS_PER_S, Scenario
from sim_vehicles.services.draws import Use, draws_of


def backdating_ns(scenario: Scenario, system_id: int) -> Iterator[int]:
    """How far (ns) each of a vehicle's TIMESYNC replies is backdated: an endless series; empty if they are exact."""
    most_ns = round(scenario.autopilot.sitl.timesync_back_s * NS_PER_S)
    rng = draws_of(scenario.seed, system_id, Use.BACKDATING)
    while scenario.dynamics == "autopilot" and scenario.autopilot.sitl.timesync_back_s > 0.0:
        yield int(rng.random() * most_ns)


def slips(scenario: Scenario, system_id: int, start_ns: int) -> Iterator[tuple[int, int]]:
    """The slips of a boot clock, (host time in ns, change in ns): an endless series, or empty if it never slips."""
    sitl, time_ns = scenario.autopilot.sitl, start_ns
    rng = draws_of(scenario.seed, system_id, Use.SLIPS)
    while sitl.slip_s:
        waited, lost = rng.exponential(size=2).tolist()
        time_ns += 1 + round(waited * sitl.slip_every_s * NS_PER_S)
        yield time_ns, -round(lost * sitl.slip_s * NS_PER_S)
