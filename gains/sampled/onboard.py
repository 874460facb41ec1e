"""The onboard loop as flown: each vehicle feeds back its own errors; the station feeds back those of others, late.

Every vehicle uses its own errors without delay and those of others with the delay tau (Sahoo 2012, eqs. 5.1, 5.2)::

    x'(t) = (A + B K_own) x(t) + B K_others x(t - tau)

In flight both parts are sampled and held. T is the control period of the station, or the slower or the common period
if telemetry has another rate, as in `gains.sampled.multirate`:

* The vehicle computes its own part of the command `steps` times in T and holds it. It knows its velocity error at that
  instant. A sensor measures its spacing error at every `steps_per_sample`-th step; in between, the spacing is
  extrapolated with the relative velocity of the last measurement.
* The station computes its part from states that all vehicles sample at the same instant t_k = k T, at the first of
  their steps. This part acts from t_k + tau on and is held for T.

Over T the local loop is thus a linear map of the state alone, and the late part enters it as a held command enters a
plant (`_crossings`). Clock offsets below a step change the margin only to second order in the step.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from math import ceil

import numpy as np

from gains.core.arrays import FloatArray, IntArray, matrix_exponentials
from gains.core.errors import BadModelError
from gains.core.structure import balanced, distinct_blocks, positive_seconds
from gains.delay._loci import factor_rank
from gains.delay.constant import delay_margin
from gains.formation.model import FormationModel
from gains.sampled._crossings import block_delay_margin
from gains.sampled._loop import ByContent
from gains.sampled.multirate import Timing, is_nearly_continuous, lifted_growth, lifted_margin

# instants this close to a step (in steps) coincide with it
_SAME_INSTANT = 1e-9


@dataclass(frozen=True)
class OnboardTiming:
    """The periods of the onboard loop: of the station, of the vehicles' steps and of their sensors."""

    control_s: float
    """Period (s) of the station's commands."""
    steps: int = 1
    """Steps of the vehicle's own loop per control period."""
    steps_per_sample: int = 1
    """Steps per sensor measurement; a divisor of `steps`."""
    telemetry_s: float | None = None
    """Period (s) of telemetry; `control_s` if None."""

    def __post_init__(self) -> None:
        positive_seconds("control_s", self.control_s)
        if self.steps < 1 or self.steps_per_sample < 1 or self.steps % self.steps_per_sample:
            raise BadModelError(
                f"steps is {self.steps} and steps_per_sample {self.steps_per_sample}; positive whole numbers are "
                "wanted, the second a divisor of the first"
            )

    @property
    def rates(self) -> Timing:
        """The rates of control and telemetry."""
        return Timing(self.control_s, self.control_s if self.telemetry_s is None else self.telemetry_s)

    @property
    def common(self) -> "OnboardTiming":
        """The same loop with both periods set to the common period of control and telemetry."""
        common_s = self.rates.common_s
        times = round(common_s / self.control_s)
        return OnboardTiming(common_s, self.steps * times, self.steps_per_sample)


@dataclass(frozen=True, eq=False)
class OnboardLoop:
    """Matrices (n, n) of x' = A x + sensed x + known x + late x(t - tau), and the timing of each part.

    `sensed` is B K_own for the spacing errors, `known` is B K_own for the velocity errors, `late` is B K_others.
    """

    A: FloatArray
    sensed: FloatArray
    known: FloatArray
    late: FloatArray
    timing: OnboardTiming

    def part(self, states: IntArray) -> "OnboardLoop":
        """The loop of a subset of the states: those of vehicles that act on each other."""
        at = np.ix_(states, states)
        return OnboardLoop(self.A[at], self.sensed[at], self.known[at], self.late[at], self.timing)

    def continuous_margin_s(self) -> float:
        """The least delay tau (s) at which the continuous loop (5.2) loses stability."""
        return delay_margin(self.A + self.sensed + self.known, self.late)

    def sampled_margin_s(self) -> float:
        """The least delay tau (s) at which the loop as flown is unstable; 0 if unstable without delay, `inf` if never.

        DisagreementError as for `gains.sampled.constant.sampled_delay_margin`.
        """
        plants, rates = self.plants(), self.timing.rates
        if rates.commands == 1:
            return min(block_delay_margin(plant) for plant in plants)
        continuous_s = self.continuous_margin_s()
        if is_nearly_continuous(rates, near_s=continuous_s):  # holding a command for T counts as a delay of T / 2
            one_rate = replace(self, timing=replace(self.timing, telemetry_s=None))
            return max(0.0, one_rate.sampled_margin_s() - (rates.held_s - rates.control_s) / 2.0)
        return lifted_margin(plants, rates, near_s=continuous_s)

    def growth_1_s(self, delay_s: float) -> float:
        """Growth rate (1/s) of the loop as flown at a loop delay."""
        return lifted_growth(self.plants(), self.timing.rates, delay_s=delay_s)

    def continuous_terms(self) -> tuple[list[tuple[FloatArray, float]], FloatArray]:
        """Pairs (matrix, known delay in s), and the matrix that acts tau late."""
        own_s = self.timing.control_s / self.timing.steps / 2.0  # a hold counts as half a step
        return [(self.A, 0.0), (self.sensed + self.known, own_s)], self.late

    def plants(self) -> "list[LocalPlant]":
        """The distinct strongly connected blocks, with or without late terms."""
        blocks = distinct_blocks(self.A, self.sensed, self.known, self.late)
        return [local_plant(balanced(*block.matrices), self.timing.common) for block in blocks]


@dataclass(frozen=True, eq=False)
class LocalPlant(ByContent):
    """One block with its local loop closed, as a `gains.sampled._loop.SampledPlant`; the late part B K is its input.

    The sampled local loop approximates A = `free` + `sensed` + `known`. Between steps the state x is augmented by its
    last sensor measurement and by the contribution of the vehicle's own command to x'.
    """

    free: FloatArray
    sensed: FloatArray
    known: FloatArray
    B: FloatArray
    K: FloatArray
    timing: OnboardTiming

    @property
    def A(self) -> FloatArray:  # noqa: N802 - the source's letter
        return self.free + self.sensed + self.known

    @property
    def period_s(self) -> float:
        return self.timing.control_s

    @property
    def _step_s(self) -> float:
        return self.period_s / self.timing.steps

    def transition(self, duration_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As in the protocol; both maps include the steps of the local loop in between."""
        begin, n = (self.period_s - duration_s) / self._step_s, len(self.free)
        following = np.ceil(begin - _SAME_INSTANT).astype(np.int64)
        rest_s = np.maximum(following - begin, 0.0) * self._step_s
        # response to the state alone: earlier sensor measurements do not depend on it
        whole = self._ends[following] @ matrix_exponentials(self._generator, rest_s)
        return whole[:, :n, :n], whole[:, :n, 3 * n :]

    def between(self, instants: Sequence[float]) -> tuple[FloatArray, FloatArray]:
        inside, maps = 3 * len(self.free), list[FloatArray]()
        for begin_s, end_s in pairwise(instants):
            first, last = (ceil(instant / self._step_s - _SAME_INSTANT) for instant in (begin_s, end_s))
            stops = np.array([begin_s, *(self._step_s * k for k in range(first, last)), end_s])
            whole = np.eye(len(self._generator))
            for k, flow in enumerate(matrix_exponentials(self._generator, np.diff(stops))):
                whole = flow @ (whole if k == 0 else self._step(first + k - 1) @ whole)
            maps.append(whole)
        every = np.array(maps)
        return every[:, :inside, :inside], every[:, :inside, inside:]

    @cached_property
    def _ends(self) -> FloatArray:
        """Maps of the state and the held input to the period's end, from just before each step and from the end."""
        [flow] = matrix_exponentials(self._generator, np.array([self._step_s]))
        maps = [np.eye(len(flow))]
        for number in reversed(range(self.timing.steps)):
            maps.append(maps[-1] @ flow @ self._step(number))
        return np.array(maps[::-1])

    @cached_property
    def _generator(self) -> FloatArray:
        """Generator of the continuous motion between two steps."""
        n, inputs = self.B.shape
        generator = np.zeros((3 * n + inputs, 3 * n + inputs))
        generator[:n, :n], generator[:n, 2 * n : 3 * n], generator[:n, 3 * n :] = self.free, np.eye(n), self.B
        return generator

    def _step(self, number: int) -> FloatArray:
        """The jump of the state and the held input at one step of the vehicle's loop."""
        n, age_steps = len(self.free), number % self.timing.steps_per_sample
        look, compute = np.eye(len(self._generator)), np.eye(len(self._generator))
        if age_steps == 0:
            look[n : 2 * n, :n], look[n : 2 * n, n : 2 * n] = np.eye(n), 0.0
        carried = np.eye(n) + age_steps * self._step_s * self.free
        compute[2 * n : 3 * n, : 3 * n] = np.hstack([self.known, self.sensed @ carried, np.zeros((n, n))])
        return compute @ look


def local_plant(parts: Sequence[FloatArray], timing: OnboardTiming) -> LocalPlant:
    """The plant of A, `sensed`, `known` and `late` (n, n) of an `OnboardLoop`, with an input of full rank."""
    free, sensed, known, late = parts
    return LocalPlant(free, sensed, known, *factor_rank(late), timing)


def onboard_loop(model: FormationModel, K: FloatArray, timing: OnboardTiming) -> OnboardLoop:
    """The onboard loop of a formation with the gain K (inputs, states) of u = K e.

    K_own consists of its blocks (i, i), by which vehicle i uses its own errors; the rest is K_others.

    The follower uses its own errors without delay and the leader uses no others, so no delay destabilises the pair:

    >>> K = np.array([[-1.0, 0.0, 0.0], [0.5, 1.0, -1.0]])
    >>> loop = onboard_loop(FormationModel((-1, 0), axes=1), K, OnboardTiming(control_s=0.1, steps=5))
    >>> loop.late.tolist(), loop.continuous_margin_s(), loop.sampled_margin_s()
    ([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.5, 0.0, 0.0]], inf, inf)
    """
    B, own = model.B, own_part(model, K)
    return OnboardLoop(
        A=model.A,
        sensed=B @ np.where(model.spacing_mask, own, 0.0),
        known=B @ np.where(model.spacing_mask, 0.0, own),
        late=B @ (K - own),
        timing=timing,
    )


def streamed_loop(
    model: FormationModel, K: FloatArray, timing: OnboardTiming
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A, B and K_others of x' = A x + B w, w = K_others x: the part left to a predicting station.

    A includes the vehicles' own loops: it is the continuous system whose states equal those of the sampled loops at
    every sensor measurement. BadModelError if none exists, because the steps are too long for the gains. Margins
    computed with it differ from those of `OnboardLoop` by 2 parts in 10^4 for gains of 17 1/s at 50 Hz.

    >>> K = np.array([[-1.0, 0.0, 0.0], [0.5, 1.0, -1.0]])
    >>> A, _, others = streamed_loop(FormationModel((-1, 0), axes=1), K, OnboardTiming(control_s=0.1, steps=5))
    >>> round(float(A[0, 0]), 4), others.tolist()
    (-1.0101, [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    """
    from scipy.linalg import logm  # takes longer to import than most commands to run

    loop, others = onboard_loop(model, K, timing), K - own_part(model, K)
    look_s = timing.control_s / timing.steps * timing.steps_per_sample
    one_look = OnboardTiming(look_s, timing.steps_per_sample, timing.steps_per_sample)
    plant = LocalPlant(loop.A, loop.sensed, loop.known, model.B, others, one_look)
    Phi, hold = (maps[0] for maps in plant.transition(np.array([look_s])))
    n, step = len(Phi), np.eye(len(Phi) + hold.shape[1])
    step[:n, :n], step[:n, n:] = Phi, hold
    generator = np.asarray(logm(step)) / look_s
    if np.iscomplexobj(generator) or not np.isfinite(generator).all():
        raise BadModelError(
            f"the motion of the vehicles' own loops changes sign at each sensor measurement, {look_s:g} s apart; "
            "gains with a slower motion are wanted"
        )
    return generator[:n, :n], generator[:n, n:], others


def own_part(model: FormationModel, K: FloatArray) -> FloatArray:
    """K (inputs, states) reduced to its blocks (i, i), by which vehicle i uses its own errors.

    >>> own_part(FormationModel((-1, 0), axes=1), np.array([[-1.0, 0.0, 0.0], [0.5, 1.0, -1.0]])).tolist()
    [[-1.0, 0.0, 0.0], [0.0, 1.0, -1.0]]
    """
    own = np.zeros_like(K)
    for i in range(model.vehicles):
        block = model.input_slice(i), model.output_slice(i)
        own[block] = K[block]
    return own
