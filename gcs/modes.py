"""Who may fly and what state a flight is in: pure functions, tested as tables."""

from enum import StrEnum

from gcs.record import Mode

CAUTION_HEADROOM = 0.25
"""Below this headroom a vehicle is in CAUTION."""


class Phase(StrEnum):
    """Where the flight stands."""

    CONNECTING = "connecting"  # until every vehicle is heard, its clock known, armed and guided
    FLYING = "flying"
    ENDING = "ending"  # no more set-points; until every vehicle is seen to hold its velocity
    ENDED = "ended"


def vehicle_mode(*, silent: bool, guided: bool, failsafe: bool, flying: bool, headroom: float) -> Mode:
    """What the station thinks of one vehicle.

    ======  ======  ======  ========  ==============  ========
    flying  silent  guided  failsafe  headroom        mode
    ======  ======  ======  ========  ==============  ========
    no      any     any     no        any             WAITING
    no      any     any     yes       any             FAILSAFE
    yes     yes     any     any       any             LOST
    yes     no      no      any       any             FAILSAFE
    yes     no      yes     any       < 0             CRITICAL
    yes     no      yes     any       0 to 0.25       CAUTION
    yes     no      yes     any       more, unknown   NOMINAL
    ======  ======  ======  ========  ==============  ========
    """
    if not flying:
        return Mode.FAILSAFE if failsafe else Mode.WAITING
    if silent:
        return Mode.LOST
    if not guided:
        return Mode.FAILSAFE
    if headroom < 0:
        return Mode.CRITICAL
    if headroom < CAUTION_HEADROOM:
        return Mode.CAUTION
    return Mode.NOMINAL


def next_phase(phase: Phase, *, all_ready: bool, stop: bool, all_holding: bool, waited_s: float) -> Phase:
    """The phase that follows.

    CONNECTING goes to FLYING when all are ready; both go to ENDING when the flight is to stop, for whatever reason;
    ENDING goes to ENDED when all vehicles hold, or after `END_PATIENCE_S`.
    """
    match phase:
        case Phase.CONNECTING | Phase.FLYING if stop:
            return Phase.ENDING
        case Phase.CONNECTING if all_ready:
            return Phase.FLYING
        case Phase.ENDING if all_holding or waited_s > END_PATIENCE_S:
            return Phase.ENDED
        case _:
            return phase


END_PATIENCE_S = 6.0
"""How long the station waits to see that the vehicles hold: their time-outs, a heartbeat and a slow link fit in."""
