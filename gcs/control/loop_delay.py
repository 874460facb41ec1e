"""Loop delay and headroom, the central quantities of this project.

The loop delay of a command is the time from the instant at which the vehicle's state was sampled until the command
computed from it acts:

    loop delay = up + waiting + computing + down - repetition

* *up*: the telemetry delay. *Waiting*: until the control tick. *Computing*: until the set-point has been handed to the
  kernel. Their sum is the age of the state when the set-point is sent.
* *down*: the set-point delay. It is not measured for each set-point but taken from the newest TIMESYNC request; with
  jitter, the two delays differ.
  With `control.execute_at`, vehicles hold set-points: *down* then ends when the set-point acts, as the vehicle reports.
* *repetition*: when telemetry is slower than control, several commands are computed from one state. The repetition
  does not count as delay, because the margin already accounts for the telemetry period. The extra age caused by lost
  telemetry does count.
* With the loop on the ground, the state is the vehicle's newest. With loops on board, it is the oldest among the newest
  states that the streamed command needs (`used_ns` of `gcs.control.law.CONTROL`).

Error: up and down depend on the estimated offset of the vehicle's clock; their error bounds are `sample_bound_s` and
`down_bound_s` of the tick record. If both use the same offset, its error cancels: it lengthens one by as much as it
shortens the other. The remaining error is at most `loop_delay_bound_s`: the millisecond resolution of `time_boot_ms`,
the error of the stamps in TIMESYNC replies, and the change of the estimate between the two. If a command to a loop on
board counts from the state of another vehicle, two clocks are involved and nothing cancels: the bound is then
`down_bound_s` plus the largest `sample_bound_s` of all.
"""

from math import ceil, inf, nan

import numpy as np

from gains.core.arrays import FloatArray
from scenarios.kernel import Array, array_kernel
from scenarios.schema import NS_PER_S, Rates

_SAME_RATE = 1e-4
"""A ratio of rates within this relative distance of an integer counts as that integer."""


def loop_delay_s(used_ns: int, sent_ns: int, down_s: float, repeated_s: float = 0.0) -> float:
    """Loop delay of a command sent at `sent_ns` from a state sampled at `used_ns`; NaN while either delay is unknown.

    Both instants are on the station's clock; `used_ns` is 0 while there is no state.
    """
    return (sent_ns - used_ns) * 1e-9 + down_s - repeated_s if used_ns > 0 else nan


def headroom(delay_s: float, delay_margin_s: float) -> float:
    """1 - loop delay / margin; NaN while one of them is unknown, minus infinity if the margin is 0."""
    return -inf if delay_margin_s <= 0 else 1.0 - delay_s / delay_margin_s


def longest_repetition_ns(rates: Rates, interval_ns: int = 0) -> int:
    """The longest time for which set-points repeat the same state because telemetry is slower than control.

    States arrive at the scenario's rate, or every `interval_ns` if that is longer.
    """
    step_ns = _step_ns(rates)
    ticks = max(max(rates.control_hz, rates.telemetry_hz) / rates.telemetry_hz, interval_ns / step_ns)
    return max(0, ceil(ticks * (1.0 - _SAME_RATE)) - 1) * step_ns


def repeated_since_s(rates: Rates, received_ns: int, due_ns: int, interval_ns: int = 0) -> float:
    """How long (s) the newest state, received at `received_ns`, has been repeated at a tick due now, for an observer.

    Vehicles whose telemetry rate no station has set yet may send states less often than the scenario's rate.
    """
    step_ns = _step_ns(rates)
    return min((due_ns - received_ns) // step_ns * step_ns, longest_repetition_ns(rates, interval_ns)) * 1e-9


def _step_ns(rates: Rates) -> int:
    return round(NS_PER_S / max(rates.control_hz, rates.telemetry_hz))


@array_kernel
def repeated_s(known_ns: Array, longest_ns: int, used_ns: Array, due_ns: int) -> FloatArray:
    """How long (s) the set-points of n vehicles have repeated the same state, capped at `longest_ns`.

    The time runs from the first tick that used the state sampled at `used_ns` (n,) to the tick due now. `known_ns`
    (2, n) holds, for each vehicle, the instant of the last state used and the tick that first used it; it is updated.
    """
    repeated = np.empty(len(used_ns))
    for row in range(len(used_ns)):
        if used_ns[row] != known_ns[0, row]:
            known_ns[0, row], known_ns[1, row] = used_ns[row], due_ns
        repeated[row] = min(due_ns - known_ns[1, row], longest_ns) * 1e-9
    return repeated
