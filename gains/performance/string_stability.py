"""Do spacing errors grow from vehicle to vehicle? A verdict of its own, next to the delay margin.

Every follower repeats the motion of the vehicle in front through one transfer function Gamma(s). A loop that is stable
for each vehicle may still amplify errors down the chain: |Gamma(j omega)| <= 1 at every frequency is wanted. As
Gamma(0) = 1, the limit of (|Gamma|^2 - 1) / omega^2 decides at low frequencies, where a peak is easily missed, and the
peak decides elsewhere.

For two integrators, a controller that sees the vehicle in front only, constant spacing and a loop delay tau,
the integral of ln|Gamma| / omega^2 over all frequencies is (pi/2) (tau - h) with h the headway: without headway some
frequency is amplified whatever the gains, and delay makes it worse. Ways out: headway, or a velocity error that is
taken against the known velocity of the formation instead of that of the vehicle in front.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gains.core._bracketing import peaks
from gains.core.arrays import ComplexArray, FloatArray
from gains.core.errors import BadModelError
from gains.delay.constant import delay_margin

Response = Callable[[FloatArray], ComplexArray]

# the sweep of a peak: frequencies in each of its decades
_POINTS_PER_DECADE, _DECADES_BELOW, _DECADES_ABOVE = 300, 4, 2
# |Gamma| this little above one is rounding
_ROUNDING = 1e-9
# the limit at zero is extrapolated from these shares of the natural frequency: rounding 1e-16 / 1e-6 and the fourth
# power of the share, each around 1e-9
_SMALL = (2e-3, 4e-3)


@dataclass(frozen=True)
class Follower:
    """One axis of a follower behind another vehicle, u = k1 (v_d - v) + k2 (v_front - v_d) + k3 (spacing error).

    Attributes
    ----------
    own, front, spacing
        k1 and k2 (1/s) and k3 (1/s^2), all of the sign that is stable: k1, k3 > 0. In the letters of
        `gains.formation.model` k1 = -K1, k2 = K2, k3 = K3. k2 = k1 is the velocity relative to the vehicle in front.
    delay_s
        Delay (s) of all feedback.
    headway_s
        h (s): the wanted spacing grows by h times the own speed, the command passing a filter 1 / (h s + 1).

    Raises
    ------
    BadModelError
        A gain is not finite, or a time is negative or not finite.

    Examples
    --------
    Stable for k2² ≤ k1² − 2 k3, which is k2 ≤ √2 here:

    >>> from gains.performance.string_stability import Follower
    >>> round(Follower(own=2.0, front=2.0, spacing=1.0).low_frequency_coefficient, 6)
    2.0
    """

    own: float
    front: float
    spacing: float
    delay_s: float = 0.0
    headway_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("own", "front", "spacing"):
            if not isfinite(getattr(self, name)):
                raise BadModelError(f"{name} is {getattr(self, name)}; a finite gain is wanted")
        for name in ("delay_s", "headway_s"):
            if not (isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise BadModelError(f"{name} is {getattr(self, name)}; a number of seconds >= 0 is wanted")

    def response(self, omega: FloatArray) -> ComplexArray:
        """Gamma(j omega) = (k2 s + k3) e^{-s tau} / (s^2 + (k1 s + k3) e^{-s tau}) / (h s + 1)."""
        s = 1j * omega
        late = np.exp(-s * self.delay_s)
        loop = s * s + (self.own * s + self.spacing) * late
        return (self.front * s + self.spacing) * late / loop / (self.headway_s * s + 1.0)

    @property
    def low_frequency_coefficient(self) -> float:
        """Limit of (|Gamma|^2 - 1) / omega^2 (s^2): (k2^2 - k1^2 + 2 k3) / k3^2 - h^2; no delay in it."""
        return (self.front**2 - self.own**2 + 2.0 * self.spacing) / self.spacing**2 - self.headway_s**2

    @property
    def natural_frequency(self) -> float:
        """A frequency (rad/s) around which the response changes."""
        return abs(self.own) + abs(self.spacing) ** 0.5


@dataclass(frozen=True)
class StringVerdict:
    """Whether errors grow down the chain.

    Attributes
    ----------
    is_loop_stable
        Whether one follower by itself is stable at its delay; the rest means nothing if not.
    is_string_stable
        The loop is stable, the coefficient is not positive and the peak is not above one.
    low_frequency_coefficient
        Limit of (|Gamma|^2 - 1) / omega^2 at zero, s^2.
    peak, peak_rad_s
        Largest |Gamma(j omega)| >= 1 and its frequency; 0 rad/s when it is |Gamma(0)| = 1.
    """

    is_loop_stable: bool
    is_string_stable: bool
    low_frequency_coefficient: float
    peak: float
    peak_rad_s: float


def string_verdict(follower: Follower) -> StringVerdict:
    """Verdict on a chain of equal followers, with the peak of |Gamma| and its frequency.

    Raises
    ------
    BadModelError
        The spacing gain is zero: nothing holds the distance.

    Examples
    --------
    Velocity relative to the vehicle in front lets errors grow whatever the gains, velocity relative to v_d need not:

    >>> from gains.performance.string_stability import Follower, string_verdict
    >>> relative, to_v_d = (string_verdict(Follower(own=2.0, front=front, spacing=1.0)) for front in (2.0, 0.0))
    >>> relative.is_string_stable, round(relative.peak, 4), to_v_d.is_string_stable, to_v_d.peak
    (False, 1.1547, True, 1.0)
    """
    if follower.spacing == 0.0:
        raise BadModelError("spacing is 0; a gain that holds the distance is wanted")
    margin_s = delay_margin([[0.0, -1.0], [0.0, 0.0]], [[0.0, 0.0], [follower.spacing, -follower.own]])
    stable = follower.delay_s < margin_s
    coefficient = follower.low_frequency_coefficient
    peak, peak_rad_s = response_peak(follower.response, near_rad_s=follower.natural_frequency)
    return StringVerdict(
        is_loop_stable=stable,
        is_string_stable=stable and coefficient <= 0.0 and peak <= 1.0 + _ROUNDING,
        low_frequency_coefficient=coefficient,
        peak=peak,
        peak_rad_s=peak_rad_s,
    )


def response_peak(response: Response, *, near_rad_s: float) -> tuple[float, float]:
    """Largest |Gamma(j omega)| over all frequencies and where, at least 1 at 0 rad/s for Gamma(0) = 1.

    Frequencies from four decades below `near_rad_s` to two above, every local maximum refined: a search, not a proof.

    Parameters
    ----------
    response
        Frequencies (k,) in rad/s to the complex Gamma (k,).
    near_rad_s
        A frequency around which the response changes.

    Raises
    ------
    BadModelError
        `near_rad_s` is not a positive number.

    Examples
    --------
    |1 / (s² + s + 1)| peaks at 2 / √3, where ω² = 1/2:

    >>> from gains.performance.string_stability import response_peak
    >>> peak, peak_rad_s = response_peak(lambda omega: 1 / (1 - omega**2 + 1j * omega), near_rad_s=1.0)
    >>> round(peak, 6), round(peak_rad_s, 4)
    (1.154701, 0.7071)
    """
    peak, at = largest_magnitude(response, near_rad_s=near_rad_s)
    return (peak, at) if peak > 1.0 else (1.0, 0.0)


def largest_magnitude(response: Callable[[FloatArray], NDArray[Any]], *, near_rad_s: float) -> tuple[float, float]:
    """Largest magnitude of any response and its frequency (rad/s). Arguments and exceptions as of `response_peak`.

    Examples
    --------
    |s / (s² + s + 1)| is largest, 1, at 1 rad/s:

    >>> from gains.performance.string_stability import largest_magnitude
    >>> peak, at = largest_magnitude(lambda omega: omega / (1 - omega**2 + 1j * omega), near_rad_s=1.0)
    >>> round(peak, 9), round(at, 6)
    (1.0, 1.0)
    """
    return _largest(lambda at: np.abs(response(at)), _frequencies(near_rad_s))


def low_frequency_coefficient(response: Response, *, near_rad_s: float) -> float:
    """Limit of (|Gamma(j omega)|^2 - 1) / omega^2 at zero (s^2) of any response with Gamma(0) = 1, to about 1e-8.

    Arguments as of `response_peak`.

    Examples
    --------
    |1 / (s² + s + 1)|² is 1 + ω² near zero:

    >>> from gains.performance.string_stability import low_frequency_coefficient
    >>> round(low_frequency_coefficient(lambda omega: 1 / (1 - omega**2 + 1j * omega), near_rad_s=1.0), 6)
    1.0
    """
    omega = near_rad_s * np.array(_SMALL)
    # even in the frequency: one step of Richardson's extrapolation
    near, far = (np.abs(response(omega)) ** 2 - 1.0) / omega**2
    ratio = (_SMALL[1] / _SMALL[0]) ** 2
    return float((ratio * near - far) / (ratio - 1.0))


def least_headway(response: Response, *, near_rad_s: float) -> float:
    """The least headway h (s) that makes a predecessor-following chain string stable.

    With spacing that grows by h times the speed, Gamma = Q / (h s + 1), Q the complementary sensitivity of the loop
    (the response without headway), so h^2 is the least upper bound of (|Q|^2 - 1) / omega^2, its limit at zero
    included. 0 if no headway is needed. Q includes the delay and the lag of the vehicle. Arguments and exceptions as of
    `response_peak`, with Q in place of Gamma.

    Examples
    --------
    Q = 1 / (s² + s + 1): (|Q|² − 1) / ω² = (1 − ω²) / (1 − ω² + ω⁴) is largest, 1, at zero.

    >>> from gains.performance.string_stability import least_headway
    >>> round(least_headway(lambda omega: 1 / (1 - omega**2 + 1j * omega), near_rad_s=1.0), 6)
    1.0
    """
    omega = _frequencies(near_rad_s)
    # below this the difference to one is rounding; the limit stands for it
    omega = omega[omega > near_rad_s * _SMALL[0]]

    def value(at: FloatArray) -> FloatArray:
        return (np.abs(response(at)) ** 2 - 1.0) / at**2

    highest = max(_largest(value, omega)[0], low_frequency_coefficient(response, near_rad_s=near_rad_s))
    return highest**0.5 if highest > 0.0 else 0.0


def vehicle_with_lag(*, proportional: float, derivative: float, lag_s: float, delay_s: float) -> Response:
    """Q of a vehicle e^{-s delay} / (s^2 (lag s + 1)) behind another under proportional + derivative s, no headway.

    J. Ploeg et al.'s vehicle for adaptive cruise control; gains in 1/s² and 1/s, times in s.

    Examples
    --------
    The limit at zero frequency decides, which is 2 / proportional whatever the rest:

    >>> from gains.performance.string_stability import least_headway, vehicle_with_lag
    >>> vehicle = vehicle_with_lag(proportional=0.2, derivative=0.7, lag_s=0.1, delay_s=0.2)
    >>> round(least_headway(vehicle, near_rad_s=1.0) ** 2, 4)
    10.0
    """

    def response(omega: FloatArray) -> ComplexArray:
        s = 1j * omega
        loop = (proportional + derivative * s) * np.exp(-s * delay_s) / (s * s * (lag_s * s + 1.0))
        return loop / (1.0 + loop)

    return response


def _frequencies(near_rad_s: float) -> FloatArray:
    if not (isfinite(near_rad_s) and near_rad_s > 0.0):
        raise BadModelError(f"near_rad_s is {near_rad_s}; a positive frequency is wanted")
    decades = _DECADES_BELOW + _DECADES_ABOVE
    return near_rad_s * np.logspace(-_DECADES_BELOW, _DECADES_ABOVE, decades * _POINTS_PER_DECADE)


def _largest(value: Callable[[FloatArray], FloatArray], omega: FloatArray) -> tuple[float, float]:
    """Largest value on the grid and its place, every local maximum refined by golden section."""
    values = value(omega)
    inner = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:])) + 1
    best = int(np.argmax(values))
    found = [(float(values[best]), float(omega[best]))]
    if inner.size > 0:
        at = peaks(value, omega[inner - 1], omega[inner + 1])
        found += zip(value(at).tolist(), at.tolist(), strict=True)
    return max(found, default=(-inf, 0.0))
