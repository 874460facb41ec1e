"""Sampled margin of one vehicle's own loop by a frequency sweep: takes milliseconds, needs no state matrix.

With u = -k1 v - k3 x, sampled and held for T, its loop is

    L(w) = sum over n of P(s_n) (1 - e^{-s_n T}) / (s_n T) e^{-s_n tau},  s_n = j (w + 2 pi n / T)
    P(s) = (k1 s + k3) / s^2 h(s)

with the response h = a / u, dead time included. The least delay tau at which L = -1 is the margin. A station computes
it in flight, where `gains.performance.response.sampled_margin`, which shares no algebra with it, would take too long.

The sum stops where |P| is below 1e-4. If P is not small above half the sampling frequency, as with a short lag and
gains near 1 / T, |L| depends on the delay; the margin is then that of `gains.sampled.constant.sampled_delay_margin`.
"""

from collections.abc import Callable
from dataclasses import replace
from math import inf, pi

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray
from gains.formation.model import FormationModel
from gains.performance.response import Response, formation_loop
from gains.sampled.constant import growth_rate, sampled_delay_margin

_FREQUENCIES, _LOWEST, _ALIASES, _ROUNDS = 300, 1e-3, 6, 12
# largest |P| above half the sampling frequency, and at the first omitted alias: about three times the truncation error
_MOST_BEYOND, _LEFT_OUT = 0.05, 1e-4


def lone_margin(k1: float, k3: float, response: Response, *, period_s: float) -> float:
    """Return the least loop delay (s) at which u = -k1 v - k3 x loses stability; 0 if unstable at once, `inf` if never.

    `k1` > 0 is in 1/s, `k3` >= 0 in 1/s² (0 for a leader). The relative accuracy is 1e-5, but with dead time, velocity
    gain and a short lag together, the rational function of `own_dynamics` makes it wrong by milliseconds.

    The leader in the example of `gains.performance.response.sampled_margin`:

    >>> round(lone_margin(1.0, 0.0, Response(1.0, 0.0), period_s=0.02), 3)
    1.141
    """
    if not k1 > 0.0:
        return 0.0
    # without a velocity gain a dead time is just additional delay, and needs no rational function
    late_s = response.dead_time_s if response.velocity_gain_1_s == 0.0 else 0.0
    own = replace(response, dead_time_s=response.dead_time_s - late_s)
    flown = formation_loop(FormationModel((-1,), axes=1), np.array([[-k1]]), (own,))
    A, B, K = _with_position(*flown, k3) if k3 > 0.0 else flown
    if growth_rate(A, B, K, period_s=period_s, delay_s=late_s) >= 0.0:
        return 0.0

    def size(omega: float) -> float:
        return abs(k1 * 1j * omega + k3) / omega**2 * float(np.abs(response.transfer(np.array([omega])))[0])

    half = pi / period_s
    if max(size(half), size(max(half, response.natural_frequency_rad_s or 0.0))) > _MOST_BEYOND:
        return max(0.0, sampled_delay_margin(A, B, K, period_s=period_s) - late_s)
    aliases = _ALIASES
    while size((2 * aliases + 1) * half) > _LEFT_OUT:
        aliases *= 2
    bands = 2.0 * half * np.arange(-aliases, aliases + 1.0)[:, np.newaxis]

    def loop(omega: FloatArray, delay_s: float) -> ComplexArray:
        w = omega + bands
        s = 1j * w
        held = (1.0 - np.exp(-s * period_s)) / (s * period_s)
        total = (k1 * s + k3) / s**2 * response.transfer(w) * held * np.exp(-s * delay_s)
        return total.sum(axis=0)

    slowest = min(k1, k3 / k1) if k3 > 0.0 else k1
    omega = np.append(np.geomspace(_LOWEST * slowest, 0.999 * pi / period_s, _FREQUENCIES), pi / period_s)
    beyond = np.abs(loop(omega, 0.0)) >= 1.0
    crossed = np.flatnonzero(beyond[1:] != beyond[:-1])
    return min((_at_crossing(loop, float(omega[k]), float(omega[k + 1])) for k in crossed), default=inf)


def _with_position(A: FloatArray, B: FloatArray, K: FloatArray, k3: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The loop with the position, x' = v, as its last state, fed back by k3."""
    with_x = np.pad(A, (0, 1))
    with_x[-1, 0] = 1.0
    return with_x, np.pad(B, ((0, 1), (0, 0))), np.append(K, [[-k3]], axis=1)


def _at_crossing(loop: Callable[[FloatArray, float], ComplexArray], low: float, high: float) -> float:
    """The delay at which the loop equals -1, near the frequency where its magnitude passes one."""
    delay_s = 0.0
    for _ in range(_ROUNDS):
        at = np.linspace(low, high, 9)
        value = loop(at, delay_s)
        size = np.log(np.abs(value))
        # the magnitude hardly depends on the delay, so search close to the last crossing
        crossing = float(np.interp(0.0, *(size, at) if size[0] < size[-1] else (size[::-1], at[::-1])))
        phase = float(np.angle(-loop(np.array([crossing]), delay_s)[0]))
        if delay_s == 0.0 and phase < 0.0:
            phase += 2.0 * pi
        delay_s += phase / crossing
        width = max((high - low) / 8.0, 1e-9 * crossing)
        low, high = crossing - width, crossing + width
        if abs(phase) < 1e-10:
            break
    return delay_s
