"""The monitor turns measured loop delays into modes, and acts before the delay margin is reached.

`monitored` is the whole decision for one vehicle, as a pure function. Gains are blended over time when they change, so
that commands do not jump.

As headroom shrinks, the monitor acts in this order:

1. CRITICAL: the vehicle's gains change to the next slower set of the schedule, which has a larger margin.
2. Still CRITICAL on the slowest set: the whole formation opens to `open_factor` times its spacing.
3. No headroom on the slowest set: vehicles are released to their failsafe, those farthest down the tree first.

When the link recovers, these actions are undone in the reverse order.
"""

from dataclasses import dataclass, replace
from math import inf, isnan, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray
from gcs.control.law import unblended
from gcs.control.loop_delay import headroom
from gcs.control.tick import Mode
from scenarios.kernel import Array, Records, kernel
from scenarios.schema import Monitor

_AWAY = (Mode.FAILSAFE, Mode.LOST)
_TROUBLED = (Mode.CRITICAL, *_AWAY)
_headroom = kernel(headroom)


@dataclass(frozen=True)
class VehicleState:
    """What the monitor remembers of one vehicle. Times are scenario times in s."""

    mode: Mode = Mode.WAITING
    gain_set: int = 0
    """Place in the schedule, 0 the fastest."""
    former_set: int = 0
    """The set before the last change; blended out until `changed_s` + `blend_s`."""
    changed_s: float = -1e9
    pressed_s: float | None = None
    """Since when headroom has been low enough for slower gains; None if it is not."""
    eased_s: float | None = None
    """Since when headroom has been high enough for faster gains; None if it is not."""
    released: bool = False

    @property
    def at_ease(self) -> bool:
        """Whether it is NOMINAL and no timer runs."""
        return self.mode is Mode.NOMINAL and self.pressed_s is None and self.eased_s is None


class Observation(NamedTuple):
    """What is known of one vehicle at a tick.

    `loop_delay_s` may be NaN (unknown). With prediction it is the part of the delay that counts against the margin,
    see `gcs.plan.mismatch.Tolerated.used_s`.
    """

    time_s: float
    flying: bool
    """Whether the formation is flown; the same for all vehicles."""
    silent: bool
    guided: bool
    failsafe: bool
    loop_delay_s: float


_WAITING = VehicleState()
"""The state of every vehicle that is not flown and not in its failsafe."""


def monitored(state: VehicleState, seen: Observation, margins_s: tuple[float, ...], policy: Monitor) -> VehicleState:
    """The state after one tick.

    h is the headroom of the set flown, h+ that of the next faster set. "For hold" and "for ease" mean that the
    condition has lasted `policy.hold_s` or `policy.ease_s`. The first row that fits applies:

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

    Gains do not change again while they are being blended. With `policy.act` off the modes are the same, but the gains
    stay the fastest set and no vehicle is released.
    """
    if not seen.flying:
        return replace(_WAITING, mode=Mode.FAILSAFE) if seen.failsafe else _WAITING
    if seen.silent:
        return replace(state, mode=Mode.LOST, pressed_s=None, eased_s=None)
    slowest = len(margins_s) - 1 if policy.act else 0
    if not seen.guided and not state.released:
        return replace(state, mode=Mode.FAILSAFE, pressed_s=None, eased_s=None)
    if state.mode in (Mode.LOST, Mode.FAILSAFE) and not state.released:
        return _changed(replace(state, mode=Mode.RECOVERING), slowest, seen.time_s)
    if state.mode is Mode.WAITING:
        return replace(state, mode=Mode.NOMINAL)
    calm = _is_calm(state, seen.loop_delay_s, margins_s, policy)
    return state if calm else _by_headroom(state, seen, margins_s, slowest, policy)


def _is_calm(state: VehicleState, loop_delay_s: float, margins_s: tuple[float, ...], policy: Monitor) -> bool:
    """Whether the vehicle is at ease and its headroom enough or unknown: true of most ticks."""
    return state.at_ease and not headroom(loop_delay_s, margins_s[state.gain_set]) < policy.caution_headroom


def _by_headroom(
    state: VehicleState, seen: Observation, margins_s: tuple[float, ...], slowest: int, policy: Monitor
) -> VehicleState:
    """The rows of the table that depend on headroom."""
    now_s = seen.time_s
    own = headroom(seen.loop_delay_s, margins_s[state.gain_set])
    faster = headroom(seen.loop_delay_s, margins_s[max(state.gain_set - 1, 0)])
    if state.released:
        faster = own  # it returns to the slowest set
    last_resort = state.gain_set == slowest and state.mode is Mode.CRITICAL and not state.released
    limit = 0.0 if last_resort else policy.critical_headroom
    pressed_s = _since(state.pressed_s, own < limit, now_s)
    eased_s = _since(state.eased_s, faster > policy.caution_headroom + policy.hysteresis, now_s)
    if (pressed_s, eased_s) != (state.pressed_s, state.eased_s):  # a copy costs more than all other steps
        state = replace(state, pressed_s=pressed_s, eased_s=eased_s)
    blending = now_s < state.changed_s + policy.blend_s
    if not blending and _lasted(state.pressed_s, policy.hold_s, now_s) and not state.released:
        pressed = replace(state, mode=Mode.CRITICAL, pressed_s=None, eased_s=None)
        if state.gain_set < slowest:
            return _changed(pressed, state.gain_set + 1, now_s)
        if policy.act and last_resort:
            return replace(pressed, mode=Mode.FAILSAFE, released=True)
        return pressed
    if not blending and _lasted(state.eased_s, policy.ease_s, now_s):
        if state.released:
            return replace(state, released=False, mode=Mode.FAILSAFE, eased_s=None)
        if state.gain_set > 0:
            return _changed(replace(state, mode=Mode.RECOVERING, eased_s=None), state.gain_set - 1, now_s)
    mode = _calm_mode(state, own, blending=blending, policy=policy, now_s=now_s)
    return state if mode is state.mode else replace(state, mode=mode)


def _calm_mode(state: VehicleState, own: float, *, blending: bool, policy: Monitor, now_s: float) -> Mode:
    """The mode when the gains do not change."""
    if state.released:
        return Mode.FAILSAFE
    fastest = state.gain_set == 0
    match state.mode:
        case Mode.CRITICAL if own > policy.critical_headroom + policy.hysteresis and not blending:
            return Mode.CAUTION
        case Mode.NOMINAL if own < policy.caution_headroom:
            return Mode.CAUTION
        case Mode.CAUTION if fastest and _lasted(state.eased_s, policy.hold_s, now_s):
            return Mode.NOMINAL
        case Mode.RECOVERING if not blending:
            return Mode.NOMINAL if fastest else Mode.CAUTION
        case _:
            return state.mode


@kernel
def _not_calm(
    at_ease: Array, guided: Array, silent: Array, delays_s: Array, seen: int, rank: int, margins_s: Array,
    gain_sets: Array, caution: float,
) -> NDArray[np.int64]:  # fmt: skip
    """The vehicles that are not heard, guided and at ease, or are short of headroom.

    Headroom is judged by the delay of a rank among those seen of each vehicle.
    """
    rows, found = np.empty(len(at_ease), np.int64), 0
    for row in range(len(at_ease)):
        known, enough, margin_s = 0, 0, margins_s[row, gain_sets[row]]
        for place in range(seen):
            delay_s = delays_s[row, place]
            known += not isnan(delay_s)
            enough += _headroom(delay_s, margin_s) >= caution
        calm = at_ease[row] and guided[row] and not silent[row]
        if not calm or (known > rank and enough <= rank):
            rows[found] = row
            found += 1
    return rows[:found]


def _changed(state: VehicleState, gain_set: int, now_s: float) -> VehicleState:
    if gain_set == state.gain_set:
        return state
    return replace(state, former_set=state.gain_set, gain_set=gain_set, changed_s=now_s)


def _since(since_s: float | None, holds: bool, now_s: float) -> float | None:
    if not holds:
        return None
    return now_s if since_s is None else since_s


def _lasted(since_s: float | None, wanted_s: float, now_s: float) -> bool:
    return since_s is not None and now_s - since_s >= wanted_s


class FormationMonitor:
    """The monitor of a whole formation: one state for each vehicle, and how far the formation is opened.

    `separable` says that every vehicle's loop has its own margin, as in a leader-follower tree. If not, the largest
    loop delay counts for all vehicles, and all change gains together.
    """

    def __init__(
        self, vehicles: int, margins_s: tuple[float, ...], policy: Monitor, *, separable: bool, period_s: float
    ) -> None:
        self.states = [_WAITING] * vehicles
        self.modes, self.gain_sets = np.zeros(vehicles, np.int64), np.zeros(vehicles, np.int64)
        """Those of `states`."""
        self.released = np.zeros(vehicles, np.bool_)
        self.margins_s = np.tile(margins_s, (vehicles, 1))
        """How much of its loop delay each gain set tolerates, (vehicles, sets)."""
        self.opening = 1.0
        """Factor on the formation's spacing."""
        self._policy = policy
        self._separable = separable
        self._period_s = period_s
        self._delays_s = np.full((vehicles, max(1, round(policy.window_s / period_s))), nan)
        self._judged = 0
        """Ticks of this flight so far."""
        self._at_ease = np.zeros(vehicles, np.bool_)
        self._troubled: dict[int, VehicleState] = {}
        """Those, by row, on whose account the formation may open."""
        self._blends, self._settled_s = unblended(vehicles), -inf
        """The newest blends, and when gains stop changing."""

    def update(
        self,
        time_s: float,
        silent: NDArray[np.bool_],
        guided: NDArray[np.bool_],
        failsafe: NDArray[np.bool_],
        loop_delay_s: FloatArray,
        *,
        flying: bool,
    ) -> list[tuple[int, VehicleState, VehicleState]]:
        """Judge a tick, of which is known what an `Observation` holds, of each vehicle.

        Returns row, old and new state of each vehicle whose mode, gain set or release changed.
        """
        if flying:
            self._delays_s[:, self._judged % self._delays_s.shape[1]] = loop_delay_s
            self._judged += 1
        else:
            self._judged = 0  # before the flight telemetry is slow and the loop is not closed
        changes: list[tuple[int, VehicleState, VehicleState]] = []
        states = [*self.states]
        rows = self._not_calm(silent, guided) if flying else self._not_waiting(failsafe)
        delays_s = self._judged_delay_s() if rows else np.empty(0)
        for row in rows:
            before, margins_s = self.states[row], tuple(self.margins_s[row].tolist())
            seen = Observation(
                time_s, flying, bool(silent[row]), bool(guided[row]), bool(failsafe[row]), delays_s.item(row)
            )
            after = monitored(before, seen, margins_s, self._policy)
            if after is not before:
                if after.released and not before.released and row != self._next_to_release():
                    after = replace(after, mode=Mode.CRITICAL, released=False)  # a vehicle behind goes first
                if (before.mode, before.gain_set, before.released) != (after.mode, after.gain_set, after.released):
                    changes.append((row, before, after))
                states[row] = after
                self._note(row, after)
        self.states = states
        self._open(time_s, flying=flying)
        return changes

    def _note(self, row: int, state: VehicleState) -> None:
        self.modes[row], self.gain_sets[row], self.released[row] = state.mode, state.gain_set, state.released
        self._at_ease[row] = state.at_ease
        if state.mode in _TROUBLED:
            self._troubled[row] = state
        else:
            self._troubled.pop(row, None)
        self._settled_s = inf

    def blends(self, time_s: float) -> Records:
        """The gains (n, BLEND) that each vehicle is flown with."""
        blend_s = self._policy.blend_s
        if time_s >= self._settled_s:
            return self._blends
        self._blends = unblended(len(self.states))
        self._settled_s = -inf
        for row, s in enumerate(self.states):
            share = 1.0
            if time_s - s.changed_s < blend_s:
                share, self._settled_s = min(1.0, max(0.0, (time_s - s.changed_s) / blend_s)), inf
            self._blends[row] = s.gain_set, s.former_set if share < 1.0 else s.gain_set, share
        return self._blends

    @property
    def away(self) -> list[int]:
        """The vehicles that do not follow their commands, by row."""
        return [row for row, state in self._troubled.items() if state.mode in _AWAY]

    def _not_waiting(self, failsafe: NDArray[np.bool_]) -> list[int]:
        """The vehicles of which `monitored` may say something new before the flight and after it."""
        critical = failsafe.tolist()
        return [row for row, state in enumerate(self.states) if state is not _WAITING or critical[row]]

    def _not_calm(self, silent: NDArray[np.bool_], guided: NDArray[np.bool_]) -> list[int]:
        """The same in flight."""
        delays_s, seen, rank = self._delays_s, self._seen, self._rank
        if not self._separable:
            delays_s, seen, rank = self._judged_delay_s()[:, None], 1, 0
        rows: list[int] = _not_calm(
            self._at_ease, guided, silent, delays_s, seen, rank, self.margins_s, self.gain_sets,
            self._policy.caution_headroom,
        ).tolist()  # fmt: skip
        return rows

    @property
    def _seen(self) -> int:
        """How many ticks count."""
        return min(self._judged, self._delays_s.shape[1])

    @property
    def _rank(self) -> int:
        """The place of the judged delay among those in ascending order, NaN last.

        So a vehicle with more than a tenth of unknown ticks has an unknown delay.
        """
        return min(self._seen - 1, int(0.9 * self._seen))

    def _judged_delay_s(self) -> FloatArray:
        if not self._seen:
            return np.full(len(self.states), nan)
        judged: FloatArray = np.partition(self._delays_s[:, : self._seen], self._rank, axis=1)[:, self._rank]
        return judged if self._separable else np.full(len(judged), judged.max())

    def _next_to_release(self) -> int:
        """The vehicle that may be released now: the CRITICAL one farthest down the tree; -1 if there is none."""
        for row in range(len(self.states) - 1, -1, -1):
            state = self.states[row]
            if not state.released and state.mode is Mode.CRITICAL:
                return row
        return -1

    def _open(self, time_s: float, *, flying: bool) -> None:
        """Open the formation gradually while a vehicle on the slowest gains is CRITICAL or absent, else close it."""
        slowest = self.margins_s.shape[1] - 1
        settled_s = time_s - self._policy.blend_s  # gives the slowest gains time to take effect
        wide = self._policy.act and any(
            s.gain_set == slowest and s.changed_s < settled_s for s in self._troubled.values()
        )
        goal = self._policy.open_factor if wide and flying else 1.0
        step = (self._policy.open_factor - 1.0) * self._period_s / self._policy.open_s
        self.opening += min(step, max(-step, goal - self.opening))
