"""Loop delay, the quantity that the whole project is about, and headroom.

The loop delay of a command counts from the instant at which the vehicle's state was sampled to the instant at which the
command computed from it acts:

    loop delay = up + waiting + computing + down - repetition

* *up*: the delay of the telemetry. *Waiting*: for the control tick. *Computing*: until the set-point has been handed
  to the kernel. Together they are the age of the state when the set-point is sent.
* *down*: the delay of the set-point. It is not measured for each set-point but taken from the newest TIMESYNC request,
  so jitter makes the two differ.
  With `control.execute_at` vehicles hold set-points: then it lasts until the set-point acts, as the vehicle reports.
* *repetition*: when telemetry is slower than control, several commands are computed from one state. The repetition
  does not count as delay, because the margin already accounts for the telemetry period. The extra age that lost
  telemetry causes does count.
* With the loop on the ground the state is the vehicle's newest. With loops on board it is the oldest among the newest
  states that the streamed command needs (`used_ns` of `gcs.control.law.CONTROL`).

Error: up and down depend on the estimated offset of the vehicle's clock, and each may be wrong by `sample_bound_s` and
`down_bound_s` of the tick record. If both use the same offset, its error cancels: it lengthens one by as much as it
shortens the other. What remains is `loop_delay_bound_s`: the millisecond in which `time_boot_ms` counts, the error of
the stamps in TIMESYNC replies, and what the estimate changed between the two. Where a command on board counts from the
state of another vehicle, two clocks are involved and nothing cancels: it is `down_bound_s` plus the largest
`sample_bound_s` of all.
"""

from math import ceil, inf, nan

import numpy as np

from gains.core.arrays import FloatArray
from scenarios.kernel import Array, array_kernel
from scenarios.schema import NS_PER_S, Rates

_SAME_RATE = 1e-4
"""A ratio of rates this close to a whole number, relatively, counts as that number."""


def loop_delay_s(used_ns: int, sent_ns: int, down_s: float, repeated_s: float = 0.0) -> float:
    """Loop delay of a command sent at `sent_ns` from a state sampled at `used_ns`; NaN while either way is unknown.

    Both instants are on the station's clock; `used_ns` is 0 while there is no state.
    """
    return (sent_ns - used_ns) * 1e-9 + down_s - repeated_s if used_ns > 0 else nan


def headroom(delay_s: float, delay_margin_s: float) -> float:
    """1 - loop delay / margin; NaN while one of them is unknown, minus infinity if the margin is 0."""
    return -inf if delay_margin_s <= 0 else 1.0 - delay_s / delay_margin_s


def longest_repetition_ns(rates: Rates, interval_ns: int = 0) -> int:
    """How long set-points repeat the same state at most because telemetry is slower than control.

    States come at the scenario's rate, or at `interval_ns` if that is longer.
    """
    step_ns = _step_ns(rates)
    ticks = max(max(rates.control_hz, rates.telemetry_hz) / rates.telemetry_hz, interval_ns / step_ns)
    return max(0, ceil(ticks * (1.0 - _SAME_RATE)) - 1) * step_ns


def repeated_since_s(rates: Rates, received_ns: int, due_ns: int, interval_ns: int = 0) -> float:
    """How long a state received at an instant has been repeated (s) if a tick is due now, as an onlooker sees it.

    Vehicles that no station has asked yet may send states at longer intervals than the scenario's.
    """
    step_ns = _step_ns(rates)
    return min((due_ns - received_ns) // step_ns * step_ns, longest_repetition_ns(rates, interval_ns)) * 1e-9


def _step_ns(rates: Rates) -> int:
    return round(NS_PER_S / max(rates.control_hz, rates.telemetry_hz))


@array_kernel
def repeated_s(known_ns: Array, longest_ns: int, used_ns: Array, due_ns: int) -> FloatArray:
    """How long the set-points of n vehicles have repeated the same state, in s, at most `longest_ns`.

    That is the time from the first tick that used the state, `used_ns` (n,), to the tick due now. `known_ns` (2, n)
    holds for each vehicle the instant of the state used last, and the tick that used it first; it is updated.
    """
    repeated = np.empty(len(used_ns))
    for row in range(len(used_ns)):
        if used_ns[row] != known_ns[0, row]:
            known_ns[0, row], known_ns[1, row] = used_ns[row], due_ns
        repeated[row] = min(due_ns - known_ns[1, row], longest_ns) * 1e-9
    return repeated
