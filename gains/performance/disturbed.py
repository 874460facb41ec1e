"""Effect of gusts and noise on a formation in flight: the stationary spread of its errors, exact at a loop delay.

The loop is sampled and held (`gains.sampled.constant`), with all disturbances::

    x' = A x + B u + E w,     w' = −w / τ_w + white noise     gusts: accelerations, standard deviation σ_w
    u_k = K (x_k + M (ν_k + b_k))                              noise and bias in the states known to the station
    b_{k+1} = e^{−T/τ_b} b_k + white noise

ν is white, b has the correlation time τ_b, and M maps errors of positions and velocities to errors of e. Vehicles may
sample at different instants: the station then interpolates between two reports of another vehicle, which averages their
noise, and ν_{k−1} is one more state. A predicting station feeds back the state that it expects at its assumed loop
delay, from its own commands; it starts from the newest report of each vehicle and does not interpolate.

With gusts and late commands added to the state, one period is s_{k+1} = F s_k + noise of covariance Q, and the
stationary covariance is P = F P F' + Q, which doubling solves: P = Q + F Q F' + F² Q F²' + ... A steady wind adds a
mean.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil, exp

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray, matrix_exponentials
from gains.core.errors import BadModelError
from gains.formation.model import FormationModel
from gains.sampled._loop import (
    HeldPlant,
    held_entry,
    lifted_map,
    radius_of,
    rate_of,
    settled_covariance,
)
from gains.sampled.multirate import Predictor, Timing, multirate_map


@dataclass(frozen=True)
class Gusts:
    """First-order gusts: an independent acceleration on each axis of each vehicle, or one common to all vehicles."""

    deviation_m_s2: float
    correlation_s: float
    common: bool = False


@dataclass(frozen=True)
class Sensing:
    """Errors of reported positions and velocities on each axis: white noise and a first-order bias."""

    position_noise_m: float = 0.0
    velocity_noise_m_s: float = 0.0
    position_bias_m: float = 0.0
    velocity_bias_m_s: float = 0.0
    bias_time_s: float = 60.0


@dataclass(frozen=True, eq=False)
class Spread:
    """Stationary means and standard deviations of the errors e, in the order of the model's states."""

    mean: FloatArray
    true: FloatArray
    """Standard deviations of the errors themselves."""
    reported: FloatArray
    """Standard deviations of the errors as reported, noise and bias included."""


@dataclass(frozen=True, eq=False)
class DisturbedFormation:
    """A formation flown by a station at a loop delay, with gusts and sensing errors.

    A, B and K are those of e' = A e + B u, u = K e; further states (`gains.performance.response.formation_loop`) follow
    the model's. With `assumed_s` the station predicts over that loop delay. A leader alone with u = −e, in gusts of
    deviation 1 m/s² and correlation time 1 s, has the variance 1 / (1 (1 + 1)) in continuous time:

    >>> leader = FormationModel((-1,), axes=1)
    >>> flown = DisturbedFormation(leader, leader.A, leader.B, np.array([[-1.0]]), 0.001, 0.0, Gusts(1.0, 1.0))
    >>> round(float(flown.spread().true[0] ** 2), 3)
    0.5
    """

    model: FormationModel
    A: FloatArray
    B: FloatArray
    K: FloatArray
    period_s: float
    delay_s: float | FloatArray
    """Loop delay, s: common to all vehicles, or one for each (vehicles,). With prediction, common to all."""
    gusts: Gusts | None = None
    sensing: Sensing = Sensing()
    wind_m_s2: FloatArray | None = None
    """Steady acceleration of every vehicle, one for each axis."""
    assumed_s: float | None = None
    pushed: FloatArray | None = None
    """Map (n, inputs) from external accelerations to the rates of all states, as from
    `gains.performance.response.pushed_states`; None if there are no further states."""
    older: FloatArray | None = None
    """(2, vehicles, vehicles): weight of the second newest report in the interpolated position, and in the velocity, of
    vehicle k at the instant of vehicle i's newest state. None if all vehicles sample at one instant."""

    def spread(self) -> Spread:
        """The stationary spread. Raises BadModelError if the loop is not stable."""
        F, Q, entry, seen, noise = self._lifted
        covariance = settled_covariance(F, Q)
        if covariance is None:
            slowest_s = np.max(self.delay_s)
            raise BadModelError(f"the loop is not stable at {slowest_s:g} s of loop delay; wanted a stable one")
        n = self.model.states
        reported = np.diag(seen @ covariance @ seen.T) + np.diag(noise @ noise.T)
        mean = np.linalg.solve(np.eye(len(F)) - F, entry)[:n].astype(np.float64) if entry.any() else np.zeros(n)
        return Spread(mean, np.sqrt(np.maximum(np.diag(covariance)[:n], 0.0)), np.sqrt(reported))

    def decay_1_s(self) -> float:
        """Decay rate of the errors, 1/s: that of the slowest root of the loop without gusts and bias."""
        calm = replace(self, gusts=None, sensing=Sensing())
        return -rate_of(radius_of(calm.period_map()), self.period_s)

    def period_map(self) -> FloatArray:
        """F: the map of states, gusts, late commands and bias over one period."""
        return self._lifted[0]

    def closed(self, z: ComplexArray) -> ComplexArray:
        """(zI − Φ − G(z) K)^{−1} at points z (k, 1, 1): from what is added to the states in a period to the states.

        G(z) is the effect of late, held commands; the states include the gusts.
        """
        T, size = self.period_s, len(self._pushed.A)
        Phi, acts = self._pushed.transition(np.array([T]))[0][0], held_entry(self._pushed, z, self._late_s)
        reach, held = self._expected
        back = sum((hold * z ** (-age) for age, hold in held.items()), np.zeros_like(self.B) + 0j * z)
        command = np.linalg.inv(np.eye(self.B.shape[1]) - self.K @ back) @ self.K @ reach
        feedback = np.concatenate([command, np.zeros((*command.shape[:2], self._entry.shape[1]))], axis=2)
        return np.linalg.inv(z * np.eye(size) - Phi - acts @ feedback).astype(np.complex128)

    @cached_property
    def _entry(self) -> FloatArray:
        """E: from gusts to the states, (n, gusts)."""
        model, gusts = self.model, self.gusts
        if gusts is None or gusts.deviation_m_s2 == 0.0:
            return np.zeros((len(self.A), 0))
        each = self._acts
        return each @ np.kron(np.ones((model.vehicles, 1)), np.eye(model.axes)) if gusts.common else each

    @property
    def _acts(self) -> FloatArray:
        return self.model.B if self.pushed is None else self.pushed

    @cached_property
    def _pushed(self) -> HeldPlant:
        """The plant with the gusts among its states."""
        n, count = self._entry.shape
        A = np.zeros((n + count, n + count))
        A[:n, :n], A[:n, n:] = self.A, self._entry
        if self.gusts is not None:
            A[n:, n:] = -np.eye(count) / self.gusts.correlation_s
        B = np.vstack([self.B, np.zeros((count, self.B.shape[1]))])
        return HeldPlant(A, B, np.hstack([self.K, np.zeros((len(self.K), count))]), self.period_s)

    @cached_property
    def _push_covariance(self) -> FloatArray:
        """Covariance added by gusts in a period: ∫ e^{A s} W e^{A' s} ds, by the exponential of Van Loan (1978)."""
        A, n = self._pushed.A, len(self.A)
        size = len(A)
        W = np.zeros((size, size))
        if self.gusts is not None:
            W[n:, n:] = np.eye(size - n) * 2.0 * self.gusts.deviation_m_s2**2 / self.gusts.correlation_s
        block = np.zeros((2 * size, 2 * size))
        block[:size, :size], block[:size, size:], block[size:, size:] = -A, W, A.T
        whole = matrix_exponentials(block, np.array([self.period_s]))[0]
        covariance = whole[size:, size:].T @ whole[:size, size:]
        return (covariance + covariance.T) / 2.0

    def _of_vehicles(self, position_m: float, velocity_m_s: float) -> FloatArray:
        """Map (states, 2 inputs) from each vehicle's position and velocity errors, in these units, to errors of e."""
        model = self.model
        M = np.zeros((model.states, 2 * model.inputs))
        for i in range(model.vehicles):
            place = model.input_slice(i)
            speed = slice(place.start + model.inputs, place.stop + model.inputs)
            M[model.velocity_slice(i), speed] = velocity_m_s * np.eye(model.axes)
            if i > 0:
                ahead = model.input_slice(model.predecessors[i])
                M[model.spacing_slice(i), place] = -position_m * np.eye(model.axes)
                M[model.spacing_slice(i), ahead] = position_m * np.eye(model.axes)
        return M

    @cached_property
    def _noise(self) -> FloatArray:
        return self._of_vehicles(self.sensing.position_noise_m, self.sensing.velocity_noise_m_s)

    @cached_property
    def _bias(self) -> FloatArray:
        return self._of_vehicles(self.sensing.position_bias_m, self.sensing.velocity_bias_m_s)

    @cached_property
    def _expected(self) -> tuple[FloatArray, dict[int, FloatArray]]:
        """(reach, held) of x^ = reach x_k + Σ held[j] u_{k−j}, the predicted state that the station feeds back."""
        n = len(self.A)
        if self.assumed_s is None:
            return np.eye(n), {}
        T, plant = self.period_s, HeldPlant(self.A, self.B, self.K, self.period_s)
        held: dict[int, FloatArray] = {}
        for age in range(1, ceil(self.assumed_s / T - 1e-9) + 1):
            # by assumption u_{k−j} acts for one period, from jT to (j − 1)T before t_k + τ^
            ends_s = np.array([min(age * T, self.assumed_s), (age - 1) * T])
            longer, shorter = plant.transition(ends_s)[1]
            held[age] = longer - shorter
        return plant.transition(np.array([self.assumed_s]))[0][0], held

    @cached_property
    def _lifted(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """F and Q of s = (x, w, u_{k−1}, ..., ν_{k−1}, b), the effect of a steady wind in a period, and two maps.

        The reported errors are the fourth matrix times s plus the fifth times ν_k.
        """
        T, model, n = self.period_s, self.model, len(self.A)
        step, calm = self._stepped(self.K), self._stepped(np.zeros_like(self.K))
        # the effect of an error in e over a period
        wrong = (step - calm)[:, : model.states]
        by_noise, seen, noise = wrong @ self._noise, np.eye(model.states, len(step)), self._noise
        if self.older is not None and noise.any():
            u_before, e_before = self._of_older(self.older)
            commands = (self._stepped(np.eye(*self.K.shape)) - calm)[:, : model.inputs]
            before = commands @ u_before if self.assumed_s is None else np.zeros_like(by_noise)
            kept = np.eye(noise.shape[1])
            by_noise, noise, seen = np.vstack([by_noise - before, kept]), noise - e_before, np.hstack([seen, e_before])
            step = np.block([[step, before], [np.zeros((len(kept), step.shape[1])), 0.0 * kept]])
            wrong = np.vstack([wrong, np.zeros((len(kept), model.states))])
        added = by_noise @ by_noise.T
        added[: len(self._push_covariance), : len(self._push_covariance)] += self._push_covariance
        if self._bias.any():
            drifts, fades = np.eye(self._bias.shape[1]), exp(-T / self.sensing.bias_time_s)
            none = np.zeros((len(drifts), len(step)))
            step = np.block([[step, wrong @ self._bias], [none, fades * drifts]])
            added = np.block([[added, none.T], [none, (1.0 - fades**2) * drifts]])
            seen = np.hstack([seen, self._bias])
        steady = np.zeros(len(step))
        if self.wind_m_s2 is not None:
            acts = self._acts
            hold = HeldPlant(self.A, acts, acts.T, T).transition(np.array([T]))[1][0]
            steady[:n] = hold @ np.tile(self.wind_m_s2, model.vehicles)
        return step, added, steady, seen, noise

    def _of_older(self, share: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Effects of the noise of the second newest reports on the commands, and on e as reported."""
        model, commands, errors = self.model, np.zeros((self.model.inputs, self._noise.shape[1])), 0.0 * self._noise
        for i in range(model.vehicles):
            seen = self._noise * np.repeat(share[:, i].ravel(), model.axes)
            rows = model.input_slice(i)
            commands[rows] = self.K[rows, : model.states] @ seen
            for own in (model.velocity_slice(i), model.spacing_slice(i) if i > 0 else slice(0)):
                errors[own] = seen[own]
        return commands, errors

    @property
    def _late_s(self) -> float | FloatArray:
        """The loop delay common to all inputs, or one for each."""
        return np.repeat(self.delay_s, self.model.axes) if isinstance(self.delay_s, np.ndarray) else self.delay_s

    def _stepped(self, K: FloatArray) -> FloatArray:
        """The map of (x, w, u_{k−1}, ...) over one period with another gain; the station's model has no gusts."""
        plant = replace(self._pushed, K=np.hstack([K, np.zeros((len(K), self._entry.shape[1]))]))
        if self.assumed_s is None:
            return lifted_map(plant, self._late_s)
        calm = np.zeros_like(plant.A)
        calm[: len(self.A), : len(self.A)] = self.A
        predictor = Predictor(replace(plant, A=calm), self.assumed_s)
        timing = Timing(self.period_s, self.period_s)
        return multirate_map(plant, timing, delay_s=float(self.delay_s), predictor=predictor)
