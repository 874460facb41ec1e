"""The monitor turns measured loop delays into modes, and acts before the delay margin is reached.

`gcs.station.modes.next_state` is the whole decision for one vehicle. When gains change, they are blended over time to
avoid jumps in the commands.

As headroom shrinks, the monitor acts in this order:

1. CRITICAL, as also if headroom is unknown: the vehicle's gains change to the next slower set of the schedule, which
   has a larger margin.
2. Still CRITICAL on the slowest set: the whole formation opens to `open_factor` times its spacing.
3. No headroom on the slowest set: vehicles are released to their failsafe, those farthest down the tree first.

When the link recovers, these actions are undone in reverse order.
"""

from math import inf, isinf, isnan, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray
from gcs.control.law import unblended
from gcs.control.loop_delay import headroom
from gcs.control.tick import Mode
from gcs.station.modes import STATE, Observation, Policy, VehicleState, is_settled, next_state, policy_of
from scenarios.kernel import Array, Record, Records, kernel
from scenarios.schema import Monitor

_AWAY = (Mode.FAILSAFE, Mode.LOST)
_TROUBLED = (Mode.CRITICAL, *_AWAY)
_headroom = kernel(headroom)


class Watched(NamedTuple):
    """The monitor's data of n vehicles as arrays, for kernels."""

    states: Records
    """Of STATE."""
    after: Records
    """Of STATE: the next states, computed by `judge`."""
    delays_s: FloatArray
    """The loop delays of the last ticks, (n, ticks): a ring buffer for each vehicle."""
    judged: NDArray[np.int64]
    """Ticks of this flight so far, (1,)."""
    margins_s: FloatArray
    """The largest `Seen.loop_delay_s` that each gain set tolerates, (n, sets)."""
    largest: FloatArray
    """Work array for one vehicle's largest delays, (ticks,)."""
    changed: NDArray[np.int64]
    """Buffer for the rows that `judge` changes, (n,)."""


class Seen(NamedTuple):
    """The monitor's inputs for n vehicles at a tick: see `Observation`."""

    time_s: float
    flying: bool
    silent: NDArray[np.bool_]
    guided: NDArray[np.bool_]
    failsafe: NDArray[np.bool_]
    loop_delay_s: FloatArray


@kernel
def _rank(seen: int) -> int:
    """Index of the judged delay, the 90th percentile, among those seen, sorted in ascending order with NaN last.

    So the delay of a vehicle is unknown if it is unknown at a tenth or more of the ticks.
    """
    return min(seen - 1, int(0.9 * seen))


@kernel
def _judged_delay_s(delays_s: Array, row: int, seen: int, largest: Array) -> float:
    """The delay by which a vehicle is judged: see `_rank`. Only the delays from there up are sorted, largest first."""
    known, most = 0, seen - _rank(seen)
    for place in range(seen):
        delay_s = delays_s[row, place]
        if not isnan(delay_s):
            later = min(known, most - 1)
            while later > 0 and largest[later - 1] < delay_s:
                largest[later] = largest[later - 1]
                later -= 1
            if known < most or largest[later] < delay_s:
                largest[later] = delay_s
            known += 1
    return largest[known - 1 - _rank(seen)] if known > _rank(seen) >= 0 else nan


@kernel
def _scaled(delay_s: float, margin_s: float, other_s: float) -> float:
    """The delay that uses the same fraction of the margin `other_s`; unchanged if that is infinite."""
    if margin_s == other_s or isinf(other_s):
        return delay_s
    if isinf(margin_s):
        return 0.0
    return delay_s * other_s / margin_s if margin_s > 0.0 else inf


@kernel
def judge(watched: Watched, seen: Seen, policy: Policy, separable: bool) -> int:
    """Record the delays of a tick and compute the next states.

    Returns the number of vehicles whose mode, gain set or release changes; their rows are in `changed`.
    """
    states, after, delays_s, width = watched.states, watched.after, watched.delays_s, watched.delays_s.shape[1]
    place, found, largest_s = watched.judged[0] % width, 0, nan if separable else -inf
    margins_s, least_s = watched.margins_s, inf
    for row in range(0 if separable else len(states)):
        least_s = min(least_s, margins_s[row, 0])
    watched.judged[0] = watched.judged[0] + 1 if seen.flying else 0  # before the flight the loop is not closed
    known = min(watched.judged[0], width)
    for row in range(len(states)):
        after[row] = states[row]
        if seen.flying:
            delays_s[row, place] = seen.loop_delay_s[row]
        if not separable:
            delay_s = _judged_delay_s(delays_s, row, known, watched.largest)
            delay_s = _scaled(delay_s, margins_s[row, 0], least_s)
            largest_s = nan if isnan(delay_s) or isnan(largest_s) else max(largest_s, delay_s)
    for row in range(len(states)):
        own_s, state, new = margins_s[row], states[row], after[row]
        scaled_s = largest_s if separable else _scaled(largest_s, least_s, own_s[0])
        if seen.flying and _is_calm(state, seen, row, delays_s, known, separable, scaled_s, own_s, policy):
            continue
        delay_s = _judged_delay_s(delays_s, row, known, watched.largest) if separable else scaled_s
        own = Observation(
            seen.time_s, seen.flying, seen.silent[row], seen.guided[row], seen.failsafe[row], delay_s
        )  # fmt: skip
        next_state(new, own, own_s, policy)
        if new.mode != state.mode or new.gain_set != state.gain_set or new.released != state.released:
            watched.changed[found] = row
            found += 1
    return found


@kernel
def _is_calm(
    state: Record, seen: Seen, row: int, delays_s: Array, seen_ticks: int, separable: bool, largest_s: float,
    margins_s: Array, policy: Policy,
) -> bool:  # fmt: skip
    """Whether a vehicle is heard, guided and settled, with enough headroom: true at most ticks."""
    if seen.silent[row] or not seen.guided[row] or not is_settled(state):
        return False
    margin_s, caution = margins_s[state.gain_set], policy.caution_headroom
    if not separable:
        return _headroom(largest_s, margin_s) >= caution
    enough = 0
    for place in range(seen_ticks):
        enough += _headroom(delays_s[row, place], margin_s) >= caution
    return enough > _rank(seen_ticks)


@kernel
def settle(watched: Watched) -> None:
    """Adopt the next states as the current ones."""
    for row in range(len(watched.states)):
        watched.states[row] = watched.after[row]


@kernel
def _blend(blends: Records, states: Records, time_s: float, blend_s: float) -> bool:
    """Fill in the gains with which each vehicle is flown; returns whether any are still being blended."""
    blending = False
    for row in range(len(states)):
        state, blend, share = states[row], blends[row], 1.0
        if time_s - state.changed_s < blend_s:
            share, blending = min(1.0, max(0.0, (time_s - state.changed_s) / blend_s)), True
        blend.flown, blend.former, blend.share = state.gain_set, state.former_set, share
        if share >= 1.0:
            blend.former = state.gain_set
    return blending


class FormationMonitor:
    """The monitor of a whole formation: one state for each vehicle, and how far the formation is opened.

    `separable`: every vehicle's loop has its own margin, as in a leader-follower tree. Otherwise the loop delay that
    uses the largest fraction of its margin counts for all vehicles, and all change gains together.
    """

    def __init__(
        self, vehicles: int, margins_s: tuple[float, ...], policy: Monitor, *, separable: bool, period_s: float
    ) -> None:
        self._states, self._after = np.zeros(vehicles, STATE), np.zeros(vehicles, STATE)
        self._states[:] = VehicleState()
        self.modes, self.gain_sets, self.released = (self._states[name] for name in ("mode", "gain_set", "released"))
        """Views of the fields of the vehicles' states."""
        self.margins_s = np.tile(margins_s, (vehicles, 1))
        """The largest `Seen.loop_delay_s` that each gain set tolerates, (vehicles, sets)."""
        self.opening = 1.0
        """Factor on the formation's spacing."""
        self.policy, self._keys = policy_of(policy), policy
        self.separable = separable
        self._period_s = period_s
        self._delays_s = np.full((vehicles, max(1, round(policy.window_s / period_s))), nan)
        self._judged, self._changed = np.zeros(1, np.int64), np.zeros(vehicles, np.int64)
        self._largest = np.zeros(self._delays_s.shape[1])
        self.away: list[int] = []
        """The rows of the vehicles that do not follow commands."""
        self._troubled: list[int] = []
        """The rows of the vehicles for which the formation may open."""
        self.newest_blends, self._settled_s = unblended(vehicles), -inf
        """The last result of `blends`, and when gains stop changing."""

    @property
    def states(self) -> list[VehicleState]:
        return _in_python(self._states)

    def update(self, seen: Seen) -> list[tuple[int, VehicleState, VehicleState]]:
        """Judge a tick. Returns row, old and new state of each vehicle whose mode, gain set or release changed."""
        changes: list[tuple[int, VehicleState, VehicleState]] = []
        count = judge(self.watched, seen, self.policy, self.separable)
        changed: list[int] = self._changed[:count].tolist()
        first = self._next_to_release() if changed else -1
        for row, before, judged in zip(
            changed, _in_python(self._states[changed]), _in_python(self._after[changed]), strict=True
        ):
            after = judged
            if after.released and not before.released and row != first:  # a vehicle behind it is released first
                self._after[row] = after = after._replace(mode=Mode.CRITICAL, released=False)
            if (before.mode, before.gain_set, before.released) != (after.mode, after.gain_set, after.released):
                changes.append((row, before, after))
        self._states[:] = self._after
        if changed:
            self.away, self._troubled, self._settled_s = self._rows(_AWAY), self._rows(_TROUBLED), inf
        self._open(seen.time_s, flying=seen.flying)
        return changes

    def _rows(self, modes: tuple[Mode, ...]) -> list[int]:
        """The rows of the vehicles in any of these modes."""
        return [row for row, mode in enumerate(self.modes.tolist()) if mode in modes]

    def blends(self, time_s: float) -> Records:
        """The gains (n, BLEND) with which each vehicle is flown."""
        if time_s >= self._settled_s:
            return self.newest_blends
        self.newest_blends = unblended(len(self._states))
        self._settled_s = inf if _blend(self.newest_blends, self._states, time_s, self.policy.blend_s) else -inf
        return self.newest_blends

    @property
    def watched(self) -> Watched:
        return Watched(
            self._states, self._after, self._delays_s, self._judged, self.margins_s, self._largest, self._changed
        )  # fmt: skip

    def is_calm(self, time_s: float, *, flying: bool) -> bool:
        """Whether gains and spacing are constant and, in flight, no vehicle is away."""
        if time_s < self._settled_s or self.opening != 1.0:
            return False
        return not flying or not ((self._keys.act and self._troubled) or self.away)

    def _next_to_release(self) -> int:
        """The vehicle that may be released now: the CRITICAL one farthest down the tree; -1 if there is none."""
        critical = (self.modes == Mode.CRITICAL) & ~self.released
        return int(critical.nonzero()[0].max(initial=-1))

    def _open(self, time_s: float, *, flying: bool) -> None:
        """Open the formation gradually while a vehicle on the slowest gains is CRITICAL or absent, else close it.

        A CRITICAL vehicle whose headroom is unknown does not open it: its loop may be stable, and its gains are slow.
        """
        if not self._troubled and self.opening == 1.0:
            return
        slowest = self.margins_s.shape[1] - 1
        settled_s = time_s - self.policy.blend_s  # gives the slowest gains time to take effect
        changed_s = self._states["changed_s"]
        newest_s = self._delays_s[:, (self._judged[0] - 1) % self._delays_s.shape[1]]
        unknown = (self.modes == Mode.CRITICAL) & np.isnan(newest_s)
        late = any(
            self.gain_sets[row] == slowest and changed_s[row] < settled_s and not unknown[row] for row in self._troubled
        )
        goal = self._keys.open_factor if late and self._keys.act and flying else 1.0
        step = (self._keys.open_factor - 1.0) * self._period_s / self._keys.open_s
        self.opening += min(step, max(-step, goal - self.opening))


def _in_python(states: Records) -> list[VehicleState]:
    return [VehicleState(Mode(mode), *rest) for mode, *rest in states.tolist()]
