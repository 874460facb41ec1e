"""What delay leaves of the robustness of a whole formation, with gains on any information pattern.

`gains.performance.flown_loop` is about one follower behind another, which says it all for a leader-follower tree whose
followers have the same gains. On another pattern vehicles act on each other both ways, and there is the formation only:

    x'(t) = A x(t) + B K_own x(t − τ_own) + B K_others x(t − τ − T/2) + w

with τ_own = τ + T/2 if the station closes every loop, and half a step of the vehicle's own loop on board. T is the
control period; a hold counts as a delay of half of it, so that the sampled loop differs in the second order of T.
The growth of spacing errors from vehicle to vehicle is not defined: there is no chain down which they would run.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import FloatArray
from gains.formation.model import FormationModel
from gains.performance.delayed_alpha import alpha_at, alpha_limit_s
from gains.performance.response import Response
from gains.sampled.onboard import own_part

# Frequencies of the first look at σ_min.
_FREQUENCIES, _DECADES_BELOW = 400, 2
# Where there is no margin, delays are looked at up to this many times the slowest time constant.
_LONGEST = 20.0


@dataclass(frozen=True, eq=False)
class FlownFormation:
    """A formation flown by a station with the gain matrix of u = K e.

    Attributes
    ----------
    model, K
        K is of shape (inputs, states) of the model.
    delay_margin_s
        Least loop delay (s) at which the loop as flown is unstable; `inf` if there is none.
    period_s
        Control period T: commands are held for it.
    loop
        Where it is closed.
    step_s
        Period of the vehicle's own loop, on board.
    responses
        How each vehicle answers, in the order of the model; at once if None.

    Examples
    --------
    A vehicle alone: σ_min is |jω + e^{−jωτ}|, least where the phase of the loop is nearest to −π:

    >>> import numpy as np
    >>> from gains.formation.model import FormationModel
    >>> from gains.performance.flown_formation import FlownFormation
    >>> lone = FlownFormation(FormationModel((-1,), axes=1), np.array([[-1.0]]), np.pi / 2, period_s=0.0)
    >>> [round(lone.alpha(delay_s), 3) for delay_s in (0.0, 1.0, 1.5)]
    [1.0, 0.43, 0.039]
    """

    model: FormationModel
    K: FloatArray
    delay_margin_s: float
    period_s: float
    loop: Literal["ground", "onboard"] = "ground"
    step_s: float = 0.0
    responses: tuple[Response, ...] | None = None

    def alpha(self, delay_s: float) -> float:
        """α at a loop delay (s); 0 from the margin on."""
        return alpha_at(self, delay_s)

    def alpha_limit_s(self, alpha: float) -> float:
        """The largest loop delay up to which α is kept: `inf` if at every one, 0 if not even without delay."""
        return alpha_limit_s(self, alpha)

    @property
    def longest_s(self) -> float:
        return _LONGEST / self._slowest

    def frequencies(self) -> FloatArray:
        A, own, others = self._matrices
        highest = 4.0 * float(np.linalg.norm(A, 2) + np.linalg.norm(own, 2) + np.linalg.norm(others, 2))
        return np.concatenate([[0.0], np.geomspace(self._slowest * 10.0**-_DECADES_BELOW, highest, _FREQUENCIES)])

    def singular_value(self, omega: FloatArray, delay_s: float) -> FloatArray:
        sigma = np.linalg.svd(self.characteristic(omega, delay_s), compute_uv=False)
        return sigma[:, -1].astype(np.float64)

    def characteristic(self, omega: FloatArray, delay_s: float) -> NDArray[np.complex128]:
        """jωI − A − B h (K_own e^{−jωτ_own} + K_others e^{−jω(τ + T/2)}), shape (k, n, n); h are the responses.

        Of one axis if the gains act on every axis alike, which is as large as that of all of them.
        """
        A, own, others = self._matrices
        late_s = delay_s + self.period_s / 2.0
        own_s = self.step_s / 2.0 if self.loop == "onboard" else late_s
        s = 1j * omega[:, None, None]
        feedback = own * np.exp(-s * own_s) + others * np.exp(-s * late_s)
        return s * np.eye(len(A)) - A - self._answers(omega) * feedback

    @cached_property
    def _matrices(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A, B K_own and B K_others."""
        model = self._model
        step = self.model.axes // model.axes
        K = self.K[::step, ::step]
        own = own_part(model, K)
        return model.A, model.B @ own, model.B @ (K - own)

    @cached_property
    def _model(self) -> FormationModel:
        """The formation of one axis, if the gains act on every axis alike."""
        axes = self.model.axes
        alike = np.array_equal(self.K, np.kron(self.K[::axes, ::axes], np.eye(axes)))
        return FormationModel(self.model.predecessors, axes=1) if alike and axes > 1 else self.model

    @cached_property
    def _slowest(self) -> float:
        """Magnitude of the slowest motion without delay, 1/s."""
        magnitudes = np.abs(np.linalg.eigvals(sum(self._matrices)))
        return float(max(magnitudes.min(), 1e-6 * magnitudes.max()))

    def _answers(self, omega: FloatArray) -> NDArray[np.complex128]:
        """From wanted to real accelerations, (k, n, 1): the factor of each row of B K."""
        model = self._model
        factors = np.ones((len(omega), model.states, 1), dtype=np.complex128)
        for vehicle, response in enumerate(self.responses or ()):
            factors[:, model.velocity_slice(vehicle)] = response.transfer(omega)[:, None, None]
        return factors
