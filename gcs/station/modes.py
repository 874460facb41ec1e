"""The mode and the gain set of one vehicle as its headroom changes; `next_state` is the whole decision.

As headroom shrinks, the vehicle's gains change to slower sets; finally it is released to its failsafe. When the link
recovers, these actions are undone in reverse order. The table in `next_state` lists all conditions.
"""

from math import inf
from typing import Any, NamedTuple

import numpy as np

from gcs.control.loop_delay import headroom
from gcs.control.tick import Mode
from scenarios.kernel import Array, Record, kernel
from scenarios.schema import Monitor

_NUMBERS: Any = tuple(int(mode) for mode in Mode)
_WAITING, _NOMINAL, _CAUTION, _CRITICAL, _FAILSAFE, _LOST, _RECOVERING = _NUMBERS
_headroom = kernel(headroom)
STATE = np.dtype(
    [
        ("mode", "i8"), ("gain_set", "i8"), ("former_set", "i8"), ("changed_s", "f8"),
        ("pressed_s", "f8"), ("eased_s", "f8"), ("released", "?"),
    ],
    align=True,
)  # fmt: skip
"""`VehicleState` as a record."""


class VehicleState(NamedTuple):
    """The monitor's state of one vehicle. Times are scenario times in s."""

    mode: Mode = Mode.WAITING
    gain_set: int = 0
    """Index in the schedule; 0 is the fastest."""
    former_set: int = 0
    """The set before the last change; blended out until `changed_s` + `blend_s`."""
    changed_s: float = -1e9
    pressed_s: float = inf
    """The time since which headroom has been low enough for slower gains; infinite if it is not."""
    eased_s: float = inf
    """The time since which headroom has been high enough for faster gains; infinite if it is not."""
    released: bool = False


class Observation(NamedTuple):
    """The monitor's inputs for one vehicle at a tick.

    `loop_delay_s` may be NaN (unknown). With prediction it is the part of the delay that counts against the margin:
    see `gcs.plan.mismatch.Tolerated.used_s`.
    """

    time_s: float
    flying: bool
    """Whether the formation is flown; the same for all vehicles."""
    silent: bool
    guided: bool
    failsafe: bool
    loop_delay_s: float


class Policy(NamedTuple):
    """The keys of `scenarios.schema.Monitor` that decide a vehicle's mode."""

    act: bool
    caution_headroom: float
    critical_headroom: float
    hysteresis: float
    hold_s: float
    ease_s: float
    blend_s: float


def policy_of(monitor: Monitor) -> Policy:
    return Policy(*(getattr(monitor, name) for name in Policy._fields))


@kernel
def next_state(state: Record, seen: Observation, margins_s: Array, policy: Policy) -> None:
    """Advance a vehicle's state, a record of STATE, by one tick. `margins_s` are the margins of its gain sets.

    h is the headroom of the set flown, h+ that of the next faster set. An unknown h, as of a vehicle that no longer
    answers TIMESYNC, counts as below critical but not as below 0. "For hold" and "for ease" mean that the condition has
    lasted `policy.hold_s` or `policy.ease_s`. The first matching row applies:

    ==================  ====================================================  ============================
    from                when                                                  to
    ==================  ====================================================  ============================
    any                 formation not flown, vehicle in failsafe              FAILSAFE
    any                 formation not flown                                   WAITING
    any                 silent                                                LOST
    any, released       h > caution + hysteresis for ease                     FAILSAFE, no longer released
    any, released       otherwise                                             FAILSAFE
    any                 not guided                                            FAILSAFE
    LOST, FAILSAFE      heard and guided again                                RECOVERING, slowest set
    WAITING             guided                                                NOMINAL, fastest set
    any                 h < critical for hold, a slower set exists            CRITICAL, next slower set
    CRITICAL            h < 0 for hold, slowest set                           FAILSAFE, released
    any                 h < critical for hold, slowest set                    CRITICAL
    any, slower set     h+ > caution + hysteresis for ease                    RECOVERING, next faster set
    CRITICAL            h > critical + hysteresis for hold                    CAUTION
    NOMINAL             h < caution                                           CAUTION
    CAUTION             h > caution + hysteresis for hold, fastest set        NOMINAL
    RECOVERING          gains blended in: fastest set / slower set            NOMINAL / CAUTION
    ==================  ====================================================  ============================

    Gains do not change again while they are being blended. With `policy.act` off, the modes are the same, but the
    fastest gains are kept and no vehicle is released.
    """
    away = state.mode == _LOST or state.mode == _FAILSAFE  # noqa: PLR1714 - Numba would make a tuple of them
    slowest = len(margins_s) - 1 if policy.act else 0
    if not seen.flying:
        state.mode, state.gain_set, state.former_set = (_FAILSAFE if seen.failsafe else _WAITING), 0, 0
        state.changed_s, state.pressed_s, state.eased_s, state.released = -1e9, inf, inf, False
    elif seen.silent or not (seen.guided or state.released):
        state.mode, state.pressed_s, state.eased_s = (_LOST if seen.silent else _FAILSAFE), inf, inf
    elif away and not state.released:
        state.mode = _RECOVERING
        _change_gains(state, slowest, seen.time_s)
    elif state.mode == _WAITING:
        state.mode = _NOMINAL
    else:
        own = _headroom(seen.loop_delay_s, margins_s[state.gain_set])
        if not is_settled(state) or not own >= policy.caution_headroom:
            # a released vehicle returns to the slowest set
            faster = own if state.released else _headroom(seen.loop_delay_s, margins_s[max(state.gain_set - 1, 0)])
            _by_headroom(state, own, faster, slowest, policy, seen.time_s)


@kernel
def _by_headroom(state: Record, own: float, faster: float, slowest: int, policy: Policy, now_s: float) -> None:
    """The rows of the table that depend on headroom; `own` is h, and `faster` is h+."""
    last_resort = state.gain_set == slowest and state.mode == _CRITICAL and not state.released
    pressed = own < 0.0 if last_resort else not own >= policy.critical_headroom
    state.pressed_s = _since(state.pressed_s, pressed, now_s)
    state.eased_s = _since(state.eased_s, faster > policy.caution_headroom + policy.hysteresis, now_s)
    blending = now_s < state.changed_s + policy.blend_s
    if not blending and now_s - state.pressed_s >= policy.hold_s and not state.released:
        state.mode, state.pressed_s, state.eased_s = _CRITICAL, inf, inf
        if state.gain_set < slowest:
            _change_gains(state, state.gain_set + 1, now_s)
        elif policy.act and last_resort:
            state.mode, state.released = _FAILSAFE, True
    elif not blending and now_s - state.eased_s >= policy.ease_s and (state.released or state.gain_set > 0):
        state.eased_s = inf
        if state.released:
            state.mode, state.released = _FAILSAFE, False
        else:
            state.mode = _RECOVERING
            _change_gains(state, state.gain_set - 1, now_s)
    else:
        state.mode = _steady_mode(state, own, blending, policy, now_s)


@kernel
def is_settled(state: Record) -> bool:
    """Whether a vehicle is NOMINAL and no timer runs."""
    return state.mode == _NOMINAL and state.pressed_s == inf and state.eased_s == inf


@kernel
def _steady_mode(state: Record, own: float, blending: bool, policy: Policy, now_s: float) -> Any:
    """The mode when the gains do not change."""
    fastest, mode = state.gain_set == 0, state.mode
    if state.released:
        return _FAILSAFE
    if mode == _CRITICAL and own > policy.critical_headroom + policy.hysteresis and not blending:
        return _CAUTION
    if mode == _NOMINAL and own < policy.caution_headroom:
        return _CAUTION
    if mode == _CAUTION and fastest and now_s - state.eased_s >= policy.hold_s:
        return _NOMINAL
    if mode == _RECOVERING and not blending:
        return _NOMINAL if fastest else _CAUTION
    return mode


@kernel
def _change_gains(state: Record, gain_set: int, now_s: float) -> None:
    if gain_set != state.gain_set:
        state.gain_set, state.former_set, state.changed_s = gain_set, state.gain_set, now_s


@kernel
def _since(since_s: float, holds: bool, now_s: float) -> float:
    return min(since_s, now_s) if holds else inf
