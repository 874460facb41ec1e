"""The phases of a flight, as a pure function. The mode of each vehicle is up to `gcs.station.monitor`."""

from enum import StrEnum

from scenarios.schema import Scenario


class Phase(StrEnum):
    """The phase of a flight."""

    CONNECTING = "connecting"  # until every vehicle is heard, armed and guided, and its clock is known
    IDENTIFYING = "identifying"  # vehicles with autopilots show how they respond to set-points
    FLYING = "flying"
    ENDING = "ending"  # no more set-points, until every vehicle is seen to hold or land
    ENDED = "ended"


def next_phase(
    phase: Phase, *, all_ready: bool, stop: bool, all_holding: bool, waited_s: float, identified: bool = True
) -> Phase:
    """The phase that follows.

    CONNECTING is followed by FLYING once all are ready, or by IDENTIFYING if they are not identified yet. A stop for
    any reason leads from each of these to ENDING, and ENDED follows when all hold, or after `END_PATIENCE_S`.
    """
    match phase:
        case Phase.CONNECTING | Phase.IDENTIFYING | Phase.FLYING if stop:
            return Phase.ENDING
        case Phase.CONNECTING if all_ready:
            return Phase.FLYING if identified else Phase.IDENTIFYING
        case Phase.IDENTIFYING if identified:
            return Phase.FLYING
        case Phase.ENDING if all_holding or waited_s > END_PATIENCE_S:
            return Phase.ENDED
        case _:
            return phase


START_PATIENCE_S = 360.0
"""How long vehicles with autopilots may take until all are ready."""
_LAUNCHED_PATIENCE_S = 20.0
"""The same for vehicles that are launched in the air."""
_ROUND_TRIPS = 40.0
"""On slow links a start-up may take this many round trips: commands await each other's answers and are repeated."""


def patience_s(scenario: Scenario) -> float:
    """How long a flight may take to begin. Until it begins, scenario time is the time since the start minus this."""
    least_s = START_PATIENCE_S if scenario.dynamics == "autopilot" else _LAUNCHED_PATIENCE_S
    return max(least_s, _ROUND_TRIPS * longest_round_trip_s(scenario))


def longest_round_trip_s(scenario: Scenario) -> float:
    """The longest round trip on the links of a scenario, without jitter."""
    links = (scenario.link_of(vehicle.system_id) for vehicle in scenario.vehicles)
    return max(up.delay_max_s + down.delay_max_s for up, down in links)


END_PATIENCE_S = 6.0
"""How long the station waits until the vehicles hold: their time-outs plus a heartbeat over a slow link."""
