"""The phases of a flight, as a pure function. What the station thinks of each vehicle is in `gcs.station.monitor`."""

from enum import StrEnum

from scenarios.schema import Link, Scenario


class Phase(StrEnum):
    """Where the flight stands."""

    CONNECTING = "connecting"  # until every vehicle is heard, its clock known, armed and guided
    IDENTIFYING = "identifying"  # vehicles with autopilots show how they answer to set-points
    FLYING = "flying"
    ENDING = "ending"  # no more set-points; until every vehicle is seen to hold its velocity
    ENDED = "ended"


def next_phase(
    phase: Phase, *, all_ready: bool, stop: bool, all_holding: bool, waited_s: float, identified: bool = True
) -> Phase:
    """The phase that follows.

    CONNECTING goes to FLYING when all are ready, by way of IDENTIFYING unless all are identified; all three go to
    ENDING when the flight is to stop, for whatever reason; ENDING goes to ENDED when all vehicles hold, or after
    `END_PATIENCE_S`.
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


CONNECT_PATIENCE_S, START_PATIENCE_S = 20.0, 360.0
"""How long it may take until all vehicles are ready: those that are simulated, and those with an autopilot."""
_ROUND_TRIPS = 40.0
"""Or so many round trips: commands are answered one after the other, and sent again after three without an answer."""


def patience_s(scenario: Scenario) -> float:
    """How long a flight may take to begin. Until then scenario time is that since the station's start less this."""
    least_s = START_PATIENCE_S if scenario.dynamics == "autopilot" else CONNECT_PATIENCE_S
    return max(least_s, _ROUND_TRIPS * longest_round_trip_s(scenario))


def longest_round_trip_s(scenario: Scenario) -> float:
    """The longest time that a question and its answer are on the links of a scenario, without jitter."""
    links = (scenario.link_of(vehicle.system_id) for vehicle in scenario.vehicles)
    return max(_longest_s(up) + _longest_s(down) for up, down in links)


def _longest_s(link: Link) -> float:
    return max([link.delay_s, *(point.delay_s for point in link.delay_points)])


END_PATIENCE_S = 6.0
"""How long the station waits to see that the vehicles hold: their time-outs, a heartbeat and a slow link fit in."""
