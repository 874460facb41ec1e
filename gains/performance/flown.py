"""Robustness and string stability of a formation as flown, at a loop delay.

In flight a command acts after the loop delay τ and is held for a control period T, which adds T/2 on average::

    x'(t) = A x(t) + B K_own x(t − τ_own) + B K_others x(t − τ − T/2) + w

    ground    τ_own = τ + T/2: the station closes every loop
    onboard   τ_own is half a step of the vehicle's own loop: only the errors of other vehicles are late

The loop stays stable under any disturbance |w| ≤ α |x| up to α(τ), the least singular value over all frequencies of
its characteristic matrix (the complex stability radius). A complex disturbance of one axis is a real one of two axes,
so no larger real bound exists for north and east together. The sampled loop differs to second order in T. At slow
rates this model loses stability before the sampled loop does; between the two margins α is that of the sampled loop.
"""

from dataclasses import dataclass
from functools import cached_property
from math import inf
from typing import Literal

import numpy as np

from gains.core._bracketing import highest, met_end
from gains.core.arrays import ComplexArray, FloatArray, least_singular_values, spectral_norms
from gains.formation.model import FormationModel
from gains.performance.disturbed import DisturbedFormation
from gains.performance.radii import SectorLoop
from gains.performance.response import Response, formation_loop
from gains.performance.scalar_gains import PAIR, ScalarGains
from gains.performance.string_stability import largest_magnitude, string_peak
from gains.sampled.onboard import own_part

# If no α is required, α counts as kept down to this share of its value without delay.
ALPHA_KEPT = 0.99
# Frequencies in the first scan of σ_min; delays in the first scan for the limit of α, up to the margin or at most this
# many times the slowest time constant.
_FREQUENCIES, _DELAYS, _LONGEST = 400, 32, 50.0
# Relative accuracy of α at its limit.
_ALPHA_RESOLUTION = 1e-7
# Relative growth above the limit that is rounding; relative to k1, a gain this small is zero.
_ROUNDING, _NOTHING = 1e-9, 1e-12


@dataclass(frozen=True)
class FlownTiming:
    """Timing of the feedback in flight.

    A hold of 20 ms adds a delay of 10 ms; on board a vehicle feeds back its own errors without delay:

    >>> FlownTiming(0.3, 0.02).delays_s(0.1), FlownTiming(0.3, 0.02, "onboard").delays_s(0.1)
    ((0.11, 0.11), (0.0, 0.11))

    A continuous margin of 1.25 s, less half a hold of 1 s, is less than the sampled one, 0.8 s:

    >>> [FlownTiming(0.8, 1.0, delay_margin_continuous_s=1.25).is_misjudged(delay_s) for delay_s in (0.7, 0.78, 0.8)]
    [False, True, False]
    """

    delay_margin_s: float
    """Least loop delay (s) at which the loop as flown is unstable; `inf` if there is none."""
    period_s: float
    """Control period T, for which commands are held."""
    loop: Literal["ground", "onboard"] = "ground"
    """Where the vehicles' own loops are closed."""
    step_s: float = 0.0
    """Period of the loop on board."""
    delay_margin_continuous_s: float = inf
    """The same margin in continuous time, without the hold; `inf` if there is none or it is not known."""

    def delays_s(self, delay_s: float) -> tuple[float, float]:
        """Delays (s) of a vehicle's own errors and of those of others at a loop delay (s), including holds."""
        late_s = delay_s + self.period_s / 2.0
        return (late_s if self.all_late else self.step_s / 2.0), late_s

    def is_misjudged(self, delay_s: float) -> bool:
        """Whether half a hold as delay makes a loop unstable at a loop delay (s) at which the sampled one is stable."""
        late_s = self.delays_s(delay_s)[1]
        return self.all_late and self.delay_margin_continuous_s <= late_s and delay_s < self.delay_margin_s

    @property
    def all_late(self) -> bool:
        """Whether all feedback acts after the loop delay; on board, a vehicle's own errors do not."""
        return self.loop == "ground"


@dataclass(frozen=True, eq=False)
class FlownFormation:
    """A formation flown by a station with the gain K (inputs, states) of u = K e.

    Its `responses` are in the order of the model; without them vehicles respond at once.

    For a vehicle alone σ_min is |jω + e^{−jωτ}|, least where the phase of the loop is closest to −π:

    >>> lone = FlownFormation(FormationModel((-1,), axes=1), np.array([[-1.0]]), FlownTiming(np.pi / 2, period_s=0.0))
    >>> [round(lone.alpha(delay_s), 3) for delay_s in (0.0, 1.0, 1.5)]
    [1.0, 0.43, 0.039]
    """

    model: FormationModel
    K: FloatArray
    timing: FlownTiming
    responses: tuple[Response, ...] | None = None

    def alpha(self, delay_s: float) -> float:
        """α at a loop delay (s); 0 from the margin on."""
        if not delay_s < self.timing.delay_margin_s:
            return 0.0
        if self.timing.is_misjudged(delay_s):
            model, K = self._narrowed
            flown = DisturbedFormation(model, *formation_loop(model, K, self.responses), self.timing.period_s, delay_s)
            return SectorLoop(flown, tuple(range(model.states))).complex_radius().radius_1_s
        return -highest(lambda omega: -self.singular_value(omega, delay_s), self.frequencies())[1]

    def alpha_limit_s(self, alpha: float) -> float:
        """The largest loop delay (s) up to which α is at least `alpha`; `inf` if it always is, 0 if it never is."""
        margin_s, omega = self.timing.delay_margin_s, self.frequencies()
        longest_s = min(margin_s, _LONGEST / self._slowest)
        delays = np.linspace(0.0, longest_s, _DELAYS, endpoint=False).tolist()
        lost = (k for k, delay_s in enumerate(delays) if not self.singular_value(omega, delay_s).min() >= alpha)
        first = next(lost, _DELAYS)
        at_rest = self.alpha(0.0) - alpha
        if at_rest < 0.0 or first == 0:
            return 0.0
        if first == _DELAYS and margin_s == inf:
            return inf
        ends = [(delay_s, self.alpha(delay_s) - alpha) for delay_s in (delays[first - 1], [*delays, longest_s][first])]
        if ends[0][1] < 0.0:  # the first scan missed a valley between frequencies
            ends = [(0.0, at_rest), ends[0]]
        return met_end(lambda delay_s: self.alpha(delay_s) - alpha, *ends, resolution=_ALPHA_RESOLUTION * alpha)

    def frequencies(self) -> FloatArray:
        """Frequencies (rad/s) that show every valley of σ_min. Beyond the last one σ_min is larger than at ω = 0."""
        highest = 4.0 * float(spectral_norms(np.stack(self._matrices)).sum())
        return np.concatenate([[0.0], np.geomspace(self._slowest * 1e-2, highest, _FREQUENCIES)])

    def singular_value(self, omega: FloatArray, delay_s: float) -> FloatArray:
        """σ_min of the characteristic matrix at each frequency, for a loop delay (s)."""
        return least_singular_values(self.characteristic(omega, delay_s))

    def characteristic(self, omega: FloatArray, delay_s: float) -> ComplexArray:
        """jωI − A − B h (K_own e^{−jωτ_own} + K_others e^{−jω(τ + T/2)}), shape (k, n, n); h are the responses.

        If the gains act on every axis alike, it is that of one axis, which has the same singular values.
        """
        A, own, others = self._matrices
        own_s, late_s = self.timing.delays_s(delay_s)
        s = 1j * omega[:, None, None]
        feedback = own * np.exp(-s * own_s) + others * np.exp(-s * late_s)
        return s * np.eye(len(A)) - A - self._answers(omega) * feedback

    @cached_property
    def _matrices(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A, B K_own and B K_others."""
        model, K = self._narrowed
        own = own_part(model, K)
        return model.A, model.B @ own, model.B @ (K - own)

    @cached_property
    def _narrowed(self) -> tuple[FormationModel, FloatArray]:
        return self.model.narrowed(self.K)

    @cached_property
    def _slowest(self) -> float:
        """Magnitude of the slowest motion without delay, 1/s."""
        magnitudes = np.abs(np.linalg.eigvals(sum(self._matrices)))
        return float(max(magnitudes.min(), 1e-6 * magnitudes.max()))

    def _answers(self, omega: FloatArray) -> ComplexArray:
        """Factor (k, n, 1) of each row of B K, from commanded to real accelerations."""
        model, _ = self._narrowed
        factors = np.ones((len(omega), model.states, 1), dtype=np.complex128)
        for vehicle, response in enumerate(self.responses or ()):
            factors[:, model.velocity_slice(vehicle)] = response.transfer(omega)[:, None, None]
        return factors


@dataclass(frozen=True)
class FlownLoop:
    """A follower behind another, flown by a station; it represents all followers of a tree with equal gains.

    `gains` are k1, k2 and k3, which act on every axis alike; their α is not used. Without a `response`, the vehicle
    responds at once.

    A loop with a margin of 0.71 s, in which errors grow more as the delay approaches it:

    >>> loop = FlownLoop(ScalarGains(1.0, 0.0, 1.0, 0.0), FlownTiming(delay_margin_s=0.711119, period_s=0.0))
    >>> [round(loop.string_peak(delay_s), 2) for delay_s in (0.0, 0.4, 0.6)]
    [1.15, 1.69, 4.39]
    >>> [round(loop.pair.alpha(delay_s), 3) for delay_s in (0.0, 0.4, 0.711)]
    [0.364, 0.235, 0.0]
    """

    gains: ScalarGains
    timing: FlownTiming
    response: Response | None = None

    @cached_property
    def pair(self) -> FlownFormation:
        """The follower and the vehicle in front as a formation of one axis, which has the same α as all axes."""
        responses = None if self.response is None else (self.response, self.response)
        return FlownFormation(PAIR, self.gains.K, self.timing, responses)

    def string_peak(self, delay_s: float) -> float:
        """Largest growth of a spacing error from one vehicle to the next at a loop delay (s); `inf` past the margin."""
        if not delay_s < self.timing.delay_margin_s:
            return inf
        own_s, front_s = self.timing.delays_s(delay_s)
        k1, k2, k3 = self._k
        gains = np.array([[-k1]]), np.array([[k2]]), np.array([[k3]])
        return string_peak(gains, own_s, front_delay_s=front_s, answer=self._answer)

    def string_limit_s(self, peak: float) -> float:
        """The largest loop delay up to which no spacing error grows by more than `peak` >= 1 from vehicle to vehicle.

        `inf` if that holds at every delay, 0 if not even without delay. In closed form at each frequency: one part of
        Γ = N / D rotates by e^{−jθ}, θ = ωτ, as the delay grows, so |N|² ≤ peak² |D|² is cos(θ + ψ) ≥ c. If it holds
        at θ = 0, |ψ| ≤ acos c, it holds up to θ = acos c − ψ. The least θ / ω is the limit.
        """
        k1, k2, k3 = self._k
        own_s, hold_s = self.timing.delays_s(0.0)
        # at low frequencies |N|² − |D|² is (k2² + 2 k2 k3 (front − own delay) + 2 k3 − k1²) ω², too flat to sweep
        spare = k1**2 - k2**2 - 2 * k3
        if abs(spare) <= _ROUNDING * k1**2:
            spare = 0.0
        if peak == 1.0 and spare < 0.0:
            return 0.0
        at_rest_s = (
            own_s - hold_s + spare / (2 * k2 * k3)
            if peak == 1.0 and not self.timing.all_late and k2 > _NOTHING * k1
            else inf
        )
        slowest = min(k1, k3**0.5, k3 / k1)
        steepest = largest_magnitude(lambda omega: self._turn(omega, peak, spare), near_rad_s=10.0 * slowest)
        limit_s = min(1.0 / steepest if steepest > 0.0 else inf, max(at_rest_s, 0.0))
        return min(limit_s, self.timing.delay_margin_s) if limit_s > _ROUNDING else 0.0

    def _turn(self, omega: FloatArray, peak: float, spare: float) -> FloatArray:
        """ω / θ, the reciprocal of the loop delay up to which the growth at a frequency is within `peak`."""
        k1, k2, k3 = self._k
        x, h = omega**2, self._answer(omega)
        power = np.real(h * np.conj(h))
        level = peak**2
        own_s, hold_s = self.timing.delays_s(0.0)
        # difference of |N|² and peak² |D|² apart from the rotating part, exact for small ω
        flat = (level - 1.0) * k3**2 + x * ((level - 1.0) * k1**2 + spare + 2 * k3)
        own = (1j * k1 * omega + k3) * h
        if self.timing.all_late:
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
        angle = np.where(turns & (np.abs(psi) <= end), end - psi, 0.0)
        never = np.where(turns, c <= -1.0, excess <= _ROUNDING * k1**2 * x)
        return np.where(never, 0.0, omega / np.maximum(angle, _ROUNDING * omega))

    @property
    def _k(self) -> tuple[float, float, float]:
        return self.gains.k1, self.gains.k2, self.gains.k3

    def _answer(self, omega: FloatArray) -> ComplexArray:
        return np.ones_like(omega, dtype=np.complex128) if self.response is None else self.response.transfer(omega)
