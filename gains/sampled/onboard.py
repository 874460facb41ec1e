"""The onboard loop as it is flown: each vehicle feeds back its own errors, a station those of others, late.

Every vehicle uses its own errors at once and those of others tau late (Sahoo 2012, eqs. 5.1, 5.2)::

    x'(t) = (A + B K_own) x(t) + B K_others x(t - tau)

In flight both parts are sampled and held. T is the control period of the station, or the slower or the common period
if telemetry has another rate, as in `gains.sampled.multirate`:

* The vehicle computes its own part of the command `steps` times in T and holds it. It knows its velocity error at that
  instant. A sensor measures its spacing error at every `steps_per_sample`-th step; in between, the spacing is
  extrapolated with the relative velocity of the last measurement.
* The station computes its part from states that all vehicles sample at one instant t_k = k T, at the first of their
  steps. It acts from t_k + tau on and is held for T.

Over T the local loop is thus a linear map of the state alone, and the late part enters it as a held command enters a
plant (`_crossings`). Clocks that differ by less than a step change the margin only to second order in the step.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from math import ceil

import numpy as np

from gains.core.arrays import FloatArray, IntArray
from gains.core.errors import BadModelError
from gains.core.structure import balanced, distinct_blocks, positive_seconds
from gains.delay._loci import factor_rank
from gains.delay.constant import delay_margin
from gains.formation.model import FormationModel
from gains.sampled._crossings import block_delay_margin
from gains.sampled._loop import ByContent, matrix_exponentials
from gains.sampled.multirate import Timing, hardly_sampled, lifted_growth, lifted_margin

# instants this close to a step (in steps) coincide with it
_SAME_INSTANT = 1e-9


@dataclass(frozen=True)
class OnboardTiming:
    """The periods of the onboard loop: of the station, of the vehicles' steps and of their sensors."""

    control_s: float
    """Period (s) of the station's commands."""
    steps: int = 1
    """Steps of the vehicle's own loop in a control period."""
    steps_per_sample: int = 1
    """The sensor measures once in this many steps; a divisor of `steps`."""
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
        """When states are used."""
        return Timing(self.control_s, self.control_s if self.telemetry_s is None else self.telemetry_s)

    @property
    def common(self) -> "OnboardTiming":
        """The same loop with the common period of control and telemetry as the period of both."""
        common_s = self.rates.common_s
        times = round(common_s / self.control_s)
        return OnboardTiming(common_s, self.steps * times, self.steps_per_sample)


@dataclass(frozen=True, eq=False)
class OnboardLoop:
    """Matrices (n, n) of x' = A x + sensed x + known x + late x(t - tau), and when each part acts.

    `sensed` is B K_own on the spacing errors, `known` is B K_own on the velocity errors, `late` is B K_others.
    """

    A: FloatArray
    sensed: FloatArray
    known: FloatArray
    late: FloatArray
    timing: OnboardTiming

    def part(self, states: IntArray) -> "OnboardLoop":
        """The loop of some of the states: those of vehicles that act on each other."""
        at = np.ix_(states, states)
        return OnboardLoop(self.A[at], self.sensed[at], self.known[at], self.late[at], self.timing)

    def continuous_margin_s(self) -> float:
        """The least delay tau at which (5.2) loses stability."""
        return delay_margin(self.A + self.sensed + self.known, self.late)

    def sampled_margin_s(self) -> float:
        """The least delay tau at which the loop as flown loses stability; 0 if at once, `inf` if never.

        DisagreementError as of `gains.sampled.constant.sampled_delay_margin`.
        """
        plants, rates = self.plants(), self.timing.rates
        if rates.commands == 1:
            return min(block_delay_margin(plant) for plant in plants)
        continuous_s = self.continuous_margin_s()
        if hardly_sampled(rates, near_s=continuous_s):  # a command held for T stands for a delay of T / 2
            one_rate = replace(self, timing=replace(self.timing, telemetry_s=None))
            return max(0.0, one_rate.sampled_margin_s() - (rates.held_s - rates.control_s) / 2.0)
        return lifted_margin(plants, rates, near_s=continuous_s)

    def growth_1_s(self, delay_s: float) -> float:
        """Growth rate (1/s) of the loop as flown at a loop delay."""
        return lifted_growth(self.plants(), self.timing.rates, delay_s=delay_s)

    def continuous_terms(self) -> tuple[list[tuple[FloatArray, float]], FloatArray]:
        """What acts after delays that are known (s), and what acts tau late."""
        own_s = self.timing.control_s / self.timing.steps / 2.0  # a hold counts as half a step
        return [(self.A, 0.0), (self.sensed + self.known, own_s)], self.late

    def plants(self) -> "list[LocalPlant]":
        """The distinct strongly connected blocks, with or without late terms."""
        blocks = distinct_blocks(self.A, self.sensed, self.known, self.late)
        return [local_plant(balanced(*block.matrices), self.timing.common) for block in blocks]


@dataclass(frozen=True, eq=False)
class LocalPlant(ByContent):
    """One block with its local loop closed, as a `gains.sampled._loop.SampledPlant`; the late part B K is its input.

    A = `free` + `sensed` + `known` is what the sampled local loop approximates. Between steps the state x is followed
    by the last sensor measurement of it, and by what the vehicle itself adds to x'.
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
        """As of the protocol; both maps include the responses of the steps in between."""
        begin, n = (self.period_s - duration_s) / self._step_s, len(self.free)
        following = np.ceil(begin - _SAME_INSTANT).astype(np.int64)
        rest_s = np.maximum(following - begin, 0.0) * self._step_s
        # from the state alone: what the sensor saw at an earlier step does not depend on it
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
        """Maps to the period's end, of the state and the held input: from just before each step, and from the end."""
        [flow] = matrix_exponentials(self._generator, np.array([self._step_s]))
        maps = [np.eye(len(flow))]
        for number in reversed(range(self.timing.steps)):
            maps.append(maps[-1] @ flow @ self._step(number))
        return np.array(maps[::-1])

    @cached_property
    def _generator(self) -> FloatArray:
        """Of the flow between two steps."""
        n, inputs = self.B.shape
        generator = np.zeros((3 * n + inputs, 3 * n + inputs))
        generator[:n, :n], generator[:n, 2 * n : 3 * n], generator[:n, 3 * n :] = self.free, np.eye(n), self.B
        return generator

    def _step(self, number: int) -> FloatArray:
        """The map of the state and the held input over one step of the vehicle's loop."""
        n, age_steps = len(self.free), number % self.timing.steps_per_sample
        look, compute = np.eye(len(self._generator)), np.eye(len(self._generator))
        if age_steps == 0:
            look[n : 2 * n, :n], look[n : 2 * n, n : 2 * n] = np.eye(n), 0.0
        carried = np.eye(n) + age_steps * self._step_s * self.free
        compute[2 * n : 3 * n, : 3 * n] = np.hstack([self.known, self.sensed @ carried, np.zeros((n, n))])
        return compute @ look


def local_plant(parts: Sequence[FloatArray], timing: OnboardTiming) -> LocalPlant:
    """The plant of A, `sensed`, `known` and `late` (n, n) of an `OnboardLoop`, its input of full rank."""
    free, sensed, known, late = parts
    return LocalPlant(free, sensed, known, *factor_rank(late), timing)


def onboard_loop(model: FormationModel, K: FloatArray, timing: OnboardTiming) -> OnboardLoop:
    """The onboard loop of a formation with the gain K (inputs, states) of u = K e.

    The own part K_own are its blocks (i, i), by which vehicle i uses its own errors; the rest is K_others.

    A follower uses its own errors at once, and its leader needs nobody: no delay destabilises the pair.

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
    """A, B and K_others of x' = A x + B w, w = K_others x: what is left to a station that predicts.

    The vehicles' own loops are part of A: of all flows, it is the one that has the states of the sampled loops whenever
    the sensors measure. BadModelError if there is none, because the steps are too long for the gains. With it margins
    differ from those of `OnboardLoop` by 2 parts in 10^4 at 17 1/s and 50 Hz.

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
        wanted = "gains whose motion is slower than the steps of the vehicles' own loops"
        raise BadModelError(
            f"the own loops, at steps of {look_s:g} s, turn over from step to step; {wanted} are wanted"
        )
    return generator[:n, :n], generator[:n, n:], others


def own_part(model: FormationModel, K: FloatArray) -> FloatArray:
    """K (inputs, states) with its blocks (i, i) only, by which vehicle i uses its own errors.

    >>> own_part(FormationModel((-1, 0), axes=1), np.array([[-1.0, 0.0, 0.0], [0.5, 1.0, -1.0]])).tolist()
    [[-1.0, 0.0, 0.0], [0.0, 1.0, -1.0]]
    """
    own = np.zeros_like(K)
    for i in range(model.vehicles):
        block = model.input_slice(i), model.output_slice(i)
        own[block] = K[block]
    return own
