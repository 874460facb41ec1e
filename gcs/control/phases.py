"""The phases of a flight, as a pure function. `gcs.station.monitor` decides the mode of each vehicle."""

from enum import StrEnum

from scenarios.schema import Scenario


class Phase(StrEnum):
    """The phase of a flight."""

    CONNECTING = "connecting"  # until every vehicle is heard, armed and guided, and its clock is known
    IDENTIFYING = "identifying"  # the response of vehicles with autopilots to set-points is measured
    FLYING = "flying"
    ENDING = "ending"  # no more set-points, until every vehicle reports that it holds or lands
    ENDED = "ended"


def next_phase(
    phase: Phase, *, all_ready: bool, stop: bool, all_holding: bool, waited_s: float, identified: bool = True
) -> Phase:
    """The phase that follows.

    Once all vehicles are ready, CONNECTING is followed by FLYING, or by IDENTIFYING if they are not identified yet. A
    stop for any reason leads from each of these to ENDING; ENDED follows when all hold, or after `END_PATIENCE_S`.
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
"""Timeout for vehicles with autopilots to become ready."""
_LAUNCHED_PATIENCE_S = 20.0
"""Timeout for vehicles launched in the air to become ready."""
_ROUND_TRIPS = 40.0
"""Round trips that a start-up may take on slow links: each command awaits the previous answer, and some are resent."""


def patience_s(scenario: Scenario) -> float:
    """Timeout for a flight to begin. Until it begins, scenario time is the time since the start minus this."""
    least_s = START_PATIENCE_S if scenario.starts_on_ground else _LAUNCHED_PATIENCE_S
    return max(least_s, _ROUND_TRIPS * longest_round_trip_s(scenario))


def longest_round_trip_s(scenario: Scenario) -> float:
    """The longest round trip on the links of a scenario, without jitter."""
    links = (scenario.link_of(vehicle.system_id) for vehicle in scenario.vehicles)
    return max(up.delay_max_s + down.delay_max_s for up, down in links)


END_PATIENCE_S = 6.0
"""How long the station waits for the vehicles to hold: their timeouts plus a heartbeat over a slow link."""
