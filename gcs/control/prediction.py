"""Prediction of each vehicle's state at the instant when its next set-point acts, from the set-points already sent.

A set-point that is due at tick t_k acts at t_k + D. The *delivery delay* D of a vehicle is an estimate of computing +
down (`gcs.control.loop_delay`). The newest state (x, v), sampled at s, is propagated to that instant under the
accelerations u that act in between:

    h = t_k + D - s,   v^ = v + V(t_k) - V(s - D),   x^ = x + v h + P(t_k) - P(s - D) - V(s - D) h,

where V' = u and P' = V, as functions of the time when set-points were due, each held until the next. With a response,
V' is the acceleration with which the vehicle follows u (`gcs.control.responding`). This is x^ = Phi(h) x + sum_j
Gamma_j u_{k-j} of `gains.sampled.prediction`, with fractions of a period if s lies between ticks. V and P are kept as
running sums, so the cost does not grow with the delay.

The assumed loop delay is the mean age of the states at their first use, plus D.
"""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence
from math import ceil, exp
from typing import NamedTuple

import numpy as np

from gains.core.arrays import FloatArray
from gains.sampled.multirate import Timing
from gcs.control.history import Instants, Reports, State, StateHistory, States
from scenarios.keys.part import PREDICTION_MAX_S
from scenarios.schema import NS_PER_S

KEPT_S = 3.0 * PREDICTION_MAX_S
"""How long set-points are remembered: longer than any assumed delay, because states may be older than assumed."""
FASTEST = 0.1
"""Largest rate of change of an assumed delay, in s/s."""
_SMOOTHED_S = 2.0
"""Time constant of the filter for measured delivery delays, and averaging time of the ages from which D is derived."""
_AHEAD_S = 5.0
"""Longest extrapolation of the trend of the measured delivery delays without a new measurement."""


Motion = tuple[complex, complex, tuple[complex, ...]]
"""V, P and further states of a vehicle's motion; vectors are north + 1j * east."""


class LaglessMotion:
    """The motion of a vehicle that follows accelerations without lag: V' = u.

    The velocity change of a lost set-point is never made up.
    """

    rest: Motion = 0j, 0j, ()

    def moved(self, motion: Motion, u: complex, duration_s: float) -> Motion:
        """The motion after a duration under a constant acceleration."""
        velocity, position, none = motion
        return velocity + u * duration_s, position + (velocity + 0.5 * u * duration_s) * duration_s, none

    def returned(self, motion: Motion, astray_m_s: complex) -> Motion:
        """The motion when the vehicle takes a set-point again, after its velocity has strayed by `astray_m_s`."""
        del astray_m_s
        return motion


class _Sent(NamedTuple):
    """A set-point, with the motion at the time when it is due."""

    due_ns: int
    u: complex
    motion: Motion
    off: complex = 0j
    """By how much u has been altered."""
    astray_m_s: complex = 0j
    """The integral of `off` since the vehicle last took a set-point."""


class CommandHistory:
    """The accelerations sent to one vehicle, each held until the next, but for at most `held_ns`.

    Without set-points for that long, a vehicle enters its failsafe, in which it holds its velocity.
    """

    def __init__(self, held_ns: int, responds: LaglessMotion | None = None) -> None:
        self._held_ns, self._responds = held_ns, responds or LaglessMotion()
        self._sent: list[_Sent] = [_Sent(0, 0j, self._responds.rest)]
        self._due_ns = [0]
        self._known = 1
        """Number of set-points, from the oldest on, whose motion is up to date."""

    def add(self, due_ns: int, acceleration_m_s2: Sequence[float]) -> None:
        """Record the set-point of a tick; ticks must be in order."""
        self._settle()
        self._sent.append(self._after(self._sent[-1], _Sent(due_ns, complex(*acceleration_m_s2), self._responds.rest)))
        self._due_ns.append(due_ns)
        long_ago = bisect_right(self._due_ns, due_ns - round(KEPT_S * NS_PER_S)) - 1
        if 2 * long_ago > len(self._sent):  # many at once, because deleting from the front moves all the rest
            del self._sent[:long_ago], self._due_ns[:long_ago]
        self._known = len(self._sent)

    def alter(self, due_ns: int, by_m_s2: complex) -> None:
        """Change the acceleration of the set-point due at a time, if still remembered: a different one acted."""
        place = bisect_left(self._due_ns, due_ns)
        if place < len(self._sent) and self._due_ns[place] == due_ns:
            own = self._sent[place]
            self._sent[place] = own._replace(u=own.u + by_m_s2, off=own.off + by_m_s2)
            self._known = min(self._known, max(1, place))

    def sums(self, time_ns: int) -> tuple[complex, complex]:
        """V (m/s) and P (m) at a time."""
        self._settle()
        velocity, position, _ = self._moved(self._sent[max(0, bisect_right(self._due_ns, time_ns) - 1)], time_ns)
        return velocity, position

    def _settle(self) -> None:
        for place in range(self._known, len(self._sent)):
            self._sent[place] = self._after(self._sent[place - 1], self._sent[place])
        self._known = len(self._sent)

    def _after(self, last: _Sent, own: _Sent) -> _Sent:
        motion, astray_m_s = self._moved(last, own.due_ns), 0j
        if last.off or last.astray_m_s:
            astray_m_s = last.astray_m_s + last.off * ((own.due_ns - last.due_ns) * 1e-9)
            if not own.off:
                motion, astray_m_s = self._responds.returned(motion, astray_m_s), 0j
        return own._replace(motion=motion, astray_m_s=astray_m_s)

    def _moved(self, last: _Sent, time_ns: int) -> Motion:
        since_ns = max(0, time_ns - last.due_ns)
        motion = self._responds.moved(last.motion, last.u, min(since_ns, self._held_ns) * 1e-9)
        beyond_ns = since_ns - self._held_ns
        return self._responds.moved(motion, 0j, beyond_ns * 1e-9) if beyond_ns > 0 else motion


def carried(sent: CommandHistory, state: State, from_ns: int, to_ns: int) -> State:
    """A state propagated from one time to another under the set-points due in between."""
    (velocity, position), (later_velocity, later_position) = sent.sums(from_ns), sent.sums(to_ns)
    north, east, v_north, v_east = state
    for_s = (to_ns - from_ns) * 1e-9
    gained, moved = later_velocity - velocity, later_position - position - velocity * for_s
    return (
        north + v_north * for_s + moved.real,
        east + v_east * for_s + moved.imag,
        v_north + gained.real,
        v_east + gained.imag,
    )


class FixedDelivery:
    """The delivery delay D of one vehicle for a given loop delay: that delay minus the mean age of the states."""

    def __init__(self, assumed_s: float) -> None:
        self._assumed_ns = round(assumed_s * NS_PER_S)

    def measured(self, down_ns: int, sent_ns: int) -> None:
        """Ignore a measured one-way delay: the delay is given."""

    def assumed_ns(self, due_ns: int, age_ns: int) -> int:
        """D of the set-point due now; `age_ns` is the mean age of states at their first use."""
        del due_ns
        return self._assumed_ns - age_ns


class MeasuredDelivery:
    """The delivery delay D of one vehicle from measured one-way delays, smoothed along their trend.

    A second-order fading-memory filter: it tracks a steadily growing delay without lag, although a measurement is known
    only one round trip after its request was sent. D changes at the rate `FASTEST` at most. R. Morrison, "Introduction
    to sequential smoothing and prediction" (1969), ch. 9.
    """

    def __init__(self) -> None:
        self._level_ns = self._trend = 0.0
        self._at_ns = 0
        self._assumed: tuple[int, float] | None = None
        """The last tick for which D was computed, and its value."""

    def measured(self, down_ns: int, sent_ns: int) -> None:
        """Process the one-way delay of a request that left at `sent_ns`."""
        since_ns = sent_ns - self._at_ns
        if self._at_ns == 0:
            self._level_ns, self._at_ns = float(down_ns), sent_ns
        elif since_ns > 0:
            fading = exp(-since_ns * 1e-9 / _SMOOTHED_S)
            level_ns = self._level_ns + self._trend * since_ns
            off_ns = down_ns - level_ns
            self._level_ns, self._at_ns = level_ns + (1.0 - fading**2) * off_ns, sent_ns
            trend = self._trend + (1.0 - fading) ** 2 * off_ns / since_ns
            self._trend = min(FASTEST, max(-FASTEST, trend))

    def assumed_ns(self, due_ns: int, age_ns: int) -> int | None:
        """D of the set-point due now; None while nothing has been measured."""
        del age_ns
        if self._at_ns == 0:
            return None
        ahead_ns = min(due_ns - self._at_ns, _AHEAD_S * NS_PER_S)
        aim_ns = max(0.0, self._level_ns + self._trend * ahead_ns)
        if self._assumed is not None:
            before_ns, assumed_ns = self._assumed
            most_ns = FASTEST * (due_ns - before_ns)
            aim_ns = min(assumed_ns + most_ns, max(assumed_ns - most_ns, aim_ns))
        self._assumed = due_ns, aim_ns
        return round(aim_ns)


Delivery = FixedDelivery | MeasuredDelivery


class FirstUses:
    """Moving average of the age of one vehicle's states at their first use by a tick.

    The window is one common period of the control and telemetry rates; if D is a given loop delay minus this age, about
    `_SMOOTHED_S`. Each state's age is known, so its jitter must not change D (`gains.varying.predicted`).
    """

    def __init__(self, timing: Timing, *, given: bool) -> None:
        periods = ceil(_SMOOTHED_S / timing.common_s) if given else 1
        self._ages_ns = deque[int](maxlen=periods * timing.commands)
        self._sample_ns = 0

    def age_ns(self, sample_ns: int, due_ns: int) -> int:
        """The mean age, including the state used at the tick due now."""
        if sample_ns != self._sample_ns:
            self._sample_ns = sample_ns
            self._ages_ns.append(due_ns - sample_ns)
        return round(sum(self._ages_ns) / len(self._ages_ns))


class PredictedStates(States):
    """States predicted beyond the newest reports, as of the last call of `look`."""

    def __init__(self, sent: Sequence[CommandHistory], deliveries: Sequence[Delivery], timing: Timing) -> None:
        self.deliveries, self._sent = deliveries, sent
        self._first_uses = [FirstUses(timing, given=isinstance(own, FixedDelivery)) for own in deliveries]
        self._delivery_ns: list[int | None] = [None] * len(sent)
        self._history: Reports = StateHistory(len(sent))

    def look(self, history: Reports, due_ns: int) -> tuple[Instants, FloatArray]:
        """Read the newest states. Returns when each vehicle's set-point acts (ns) and the assumed loop delay (s).

        Both are 0 while its state or D is unknown.
        """
        self._history = history
        n = len(self.deliveries)
        acts_ns, assumed_s = np.zeros(n, np.int64), np.zeros(n)
        for row, delivery in enumerate(self.deliveries):
            newest = history.newest(row)
            age_ns = 0 if newest is None else self._first_uses[row].age_ns(newest[0], due_ns)
            delivery_ns = None if newest is None else delivery.assumed_ns(due_ns, age_ns)
            self._delivery_ns[row] = delivery_ns
            if delivery_ns is not None:
                acts_ns[row], assumed_s[row] = due_ns + delivery_ns, (age_ns + delivery_ns) * 1e-9
        return acts_ns, assumed_s

    def at(self, vehicle: int, time_ns: int) -> State | None:
        """The state of a vehicle at an instant; None if it has reported nothing."""
        newest, delivery_ns = self._history.newest(vehicle), self._delivery_ns[vehicle]
        if newest is None or delivery_ns is None or time_ns <= newest[0]:
            return self._history.at(vehicle, time_ns)
        sample_ns, state = newest
        return carried(self._sent[vehicle], state, sample_ns - delivery_ns, time_ns - delivery_ns)
