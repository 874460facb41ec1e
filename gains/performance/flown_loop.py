"""What delay leaves of robustness and of string stability: one follower's loop as it is flown.

`gains.performance.robust` and the requirement's `string_peak_max` speak of a loop without delay. In flight a vehicle's
commands are late by the loop delay τ, and each is held for a control period, which delays by half of it more. Here α
and the growth of spacing errors down the chain are those at τ, and the largest τ up to which each of them holds:

    ground    all feedback is late:               own and front errors by τ + T/2
    onboard   only the vehicle in front is late:  own errors by half a step of the vehicle's loop, front by τ + T/2

α(τ) is the least singular value over all frequencies of the characteristic matrix of the subsystem (3.25, 3.26) with
these delays, its complex stability radius. A complex disturbance of one axis is a real one of two axes, so that for
north and east together no larger real bound exists. Both treat the hold as a delay of T/2: the sampled loop differs
from that in the second order of T.
"""

from dataclasses import dataclass
from math import inf
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray
from gains.performance.behaviour import string_peak
from gains.performance.delayed_alpha import alpha_at, alpha_limit_s
from gains.performance.response import Response
from gains.performance.scalar_gains import ScalarGains, delayed_singular_value
from gains.performance.string_stability import largest_magnitude

# Frequencies of the first look at σ_min; its least ones are refined by golden section.
_FREQUENCIES, _DECADES_BELOW = 400, 3
# Where there is no margin, delays are looked at up to this many times the slowest time constant.
_LONGEST = 50.0
# A growth this little above the limit is rounding.
_ROUNDING = 1e-9
# A gain this small beside k1 is none.
_NOTHING = 1e-12


@dataclass(frozen=True)
class FlownLoop:
    """One follower behind another, flown by a station.

    Attributes
    ----------
    gains
        k1, k2 and k3, which act on every axis alike; their α is not used.
    delay_margin_s
        Least loop delay (s) at which the loop as flown is unstable; `inf` if there is none.
    period_s
        Control period T: commands are held for it.
    loop
        Where it is closed.
    step_s
        Period of the vehicle's own loop, on board.
    response
        How the vehicle answers; at once if None.

    Examples
    --------
    A loop with a margin of 0.71 s keeps its α at first and has none at its margin:

    >>> from gains.performance.flown_loop import FlownLoop
    >>> from gains.performance.scalar_gains import ScalarGains
    >>> loop = FlownLoop(ScalarGains(1.0, 0.0, 1.0, 0.0), delay_margin_s=0.711119, period_s=0.0)
    >>> [round(loop.alpha(delay_s), 3) for delay_s in (0.0, 0.4, 0.711)]
    [0.364, 0.235, 0.0]
    """

    gains: ScalarGains
    delay_margin_s: float
    period_s: float
    loop: Literal["ground", "onboard"] = "ground"
    step_s: float = 0.0
    response: Response | None = None

    def alpha(self, delay_s: float) -> float:
        """α at a loop delay (s); 0 from the margin on."""
        return alpha_at(self, delay_s)

    def string_peak(self, delay_s: float) -> float:
        """Largest growth of a spacing error from one vehicle to the next at a loop delay (s); `inf` past the margin."""
        if not delay_s < self.delay_margin_s:
            return inf
        own_s, front_s = self._delays_s(delay_s)
        gains = np.array([[-self.gains.k1]]), np.array([[self.gains.k2]]), np.array([[self.gains.k3]])
        return string_peak(gains, own_s, front_delay_s=front_s, answer=self._answer)

    def alpha_limit_s(self, alpha: float) -> float:
        """The largest loop delay up to which α is kept: `inf` if at every one, 0 if not even without delay."""
        return alpha_limit_s(self, alpha)

    def string_limit_s(self, peak: float) -> float:
        """The largest loop delay up to which no spacing error grows by more than `peak` >= 1 from vehicle to vehicle.

        `inf` if that holds at every delay, 0 if not even without. In closed form at each frequency: one part of
        Γ = N / D turns by e^{−jθ}, θ = ωτ, as the delay grows, so that |N|² ≤ peak² |D|² is cos(θ + ψ) ≥ c, which holds
        from |ψ| ≤ acos c up to θ = acos c − ψ. The least θ / ω is the limit.
        """
        k1, k2, k3 = self.gains.k1, self.gains.k2, self.gains.k3
        own_s, hold_s = self._delays_s(0.0)
        # |N|² − |D|² is k2² + 2 k2 k3 (front − own delay) + 2 k3 − k1² times ω² at low frequencies, too flat to see
        spare = k1**2 - k2**2 - 2 * k3
        if abs(spare) <= _ROUNDING * k1**2:
            spare = 0.0
        if peak == 1.0 and spare < 0.0:
            return 0.0
        at_rest_s = (
            own_s - hold_s + spare / (2 * k2 * k3)
            if peak == 1.0 and self.loop == "onboard" and k2 > _NOTHING * k1
            else inf
        )
        steepest, _ = largest_magnitude(lambda omega: self._turn(omega, peak, spare), near_rad_s=10.0 * self._slowest())
        limit_s = min(1.0 / steepest if steepest > 0.0 else inf, max(at_rest_s, 0.0))
        return min(limit_s, self.delay_margin_s) if limit_s > _ROUNDING else 0.0

    def _turn(self, omega: FloatArray, peak: float, spare: float) -> FloatArray:
        """ω / θ, 1 over the loop delay up to which the growth at a frequency is within `peak`."""
        k1, k2, k3 = self.gains.k1, self.gains.k2, self.gains.k3
        x, h = omega**2, self._answer(omega)
        power = np.real(h * np.conj(h))
        level = peak**2
        own_s, hold_s = self._delays_s(0.0)
        # what |N|² and peak² |D|² differ by beside the part that turns, exact for small ω
        flat = (level - 1.0) * k3**2 + x * ((level - 1.0) * k1**2 + spare + 2 * k3)
        own = (1j * k1 * omega + k3) * h
        if self.loop == "ground":
            still, turning, sign = -x + 0j, own, 1.0
            excess = -(flat * power / level + x**2)
        else:
            own = own * np.exp(-1j * omega * own_s)
            still, turning, sign = k3 * np.exp(-1j * omega * own_s), 1j * k2 * omega + 0j, -1.0
            excess = -(flat + level * (x**2 - 2 * x * own.real) / power)
        size = 2 * np.abs(still * turning)
        psi = np.angle(sign * still * np.conj(turning) * np.exp(1j * omega * hold_s))
        turns = np.abs(turning) > _NOTHING * k1 * omega
        c = excess / np.where(turns, size, 1.0)
        end = np.arccos(np.clip(c, -1.0, 1.0))
        angle = np.where(np.abs(psi) <= end, end - psi, 0.0)
        never = np.where(turns, c <= -1.0, excess <= _ROUNDING * k1**2 * x)
        return np.where(never, 0.0, omega / np.maximum(angle, _ROUNDING * omega))

    @property
    def longest_s(self) -> float:
        return _LONGEST / self._slowest()

    def _slowest(self) -> float:
        k1, k3 = self.gains.k1, self.gains.k3
        return min(k1, k3**0.5, k3 / k1)

    def frequencies(self) -> FloatArray:
        k1, k2, k3 = self.gains.k1, self.gains.k2, self.gains.k3
        highest = 4.0 * (1.0 + abs(k1) + abs(k2) + abs(k3))
        return np.concatenate([[0.0], np.geomspace(self._slowest() * 10.0**-_DECADES_BELOW, highest, _FREQUENCIES)])

    def _delays_s(self, delay_s: float) -> tuple[float, float]:
        """Delays of own errors and of those of the vehicle in front, holds included."""
        late_s = delay_s + self.period_s / 2.0
        return (self.step_s / 2.0 if self.loop == "onboard" else late_s), late_s

    def _answer(self, omega: FloatArray) -> NDArray[np.complex128]:
        return np.ones_like(omega, dtype=np.complex128) if self.response is None else self.response.transfer(omega)

    def singular_value(self, omega: FloatArray, delay_s: float) -> FloatArray:
        own_s, front_s = self._delays_s(delay_s)
        answer = self._answer(omega)
        own, front = answer * np.exp(-1j * omega * own_s), answer * np.exp(-1j * omega * front_s)
        return delayed_singular_value(self.gains, omega, own, front)
