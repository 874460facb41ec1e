"""Matrices of the sampled and held loop: its blocks, hold integrals and one-period map."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from math import inf
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gains.core.arrays import BoolArray, ComplexArray, FloatArray, matrix_exponentials
from gains.core.structure import balanced, distinct_blocks
from gains.delay._loci import factor_rank

# a delay this close to a whole number of periods (in periods) is rounded to it: (3 * 0.02) / 0.02 is not exactly 3
_WHOLE = 1e-12
# most doublings of a stable map until its sum converges: motions that take 2^60 periods to decay count as unstable
_DOUBLINGS = 60
_ROUNDING, _MOST = 1e-15, 1e30


class ByContent:
    """Mix-in for dataclasses of arrays and other values that makes two with the same bits equal, with equal hashes."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)

    @property
    def _content(self) -> tuple[Any, ...]:
        every: Any = self
        values = (getattr(self, field.name) for field in fields(every))
        return tuple((own.shape, own.tobytes()) if isinstance(own, np.ndarray) else own for own in values)


class SampledPlant(Hashable, Protocol):
    """The plant under held commands: one block, linear, and the same in every period."""

    @property
    def A(self) -> FloatArray: ...  # noqa: N802 - the source's letter

    @property
    def B(self) -> FloatArray: ...  # noqa: N802 - the source's letter

    @property
    def K(self) -> FloatArray: ...  # noqa: N802 - the source's letter

    @property
    def period_s(self) -> float: ...

    def transition(self, duration_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Maps over the last `duration_s` (k,) of a period: of the state (k, n, n), of a held input (k, n, r)."""
        ...

    def between(self, instants: Sequence[float]) -> tuple[FloatArray, FloatArray]:
        """The same maps from each instant to the next, for a state whose first n entries are those K acts on."""
        ...


@dataclass(frozen=True, eq=False)
class HeldPlant(ByContent):
    """One strongly connected block of the loop: A (n, n), B (n, r), K (r, n) of full rank r, and the period.

    A predicting station computes states that are not `measured` (n,) from the commands; None if all are measured.
    """

    A: FloatArray
    B: FloatArray
    K: FloatArray
    period_s: float
    measured: BoolArray | None = None

    def transition(self, duration_s: FloatArray, *, less_one: bool = False) -> tuple[FloatArray, FloatArray]:
        """e^{A t} (k, n, n) and int_0^t e^{A s} ds B (k, n, r) for k durations t; `less_one`: e^{A t} - I."""
        n, inputs = self.B.shape
        generator = np.zeros((n + inputs, n + inputs))
        generator[:n, :n], generator[:n, n:] = self.A, self.B
        exponentials = matrix_exponentials(generator, duration_s, less_one=less_one)
        return exponentials[:, :n, :n], exponentials[:, :n, n:]

    def between(self, instants: Sequence[float]) -> tuple[FloatArray, FloatArray]:
        return self.transition(np.diff(instants))

    def carry(self, duration_s: FloatArray) -> FloatArray:
        """Maps (k, n, n) that carry a difference between measured and computed state over k durations.

        e^{A t} on the measured states; the others have no difference.
        """
        seen = np.arange(len(self.A)) if self.measured is None else np.flatnonzero(self.measured)
        maps = np.zeros((duration_s.size, *self.A.shape))
        maps[:, seen[:, np.newaxis], seen] = matrix_exponentials(self.A[np.ix_(seen, seen)], duration_s)
        return maps


def held_blocks(
    A: FloatArray, B: FloatArray, K: FloatArray, *, period_s: float, measured: NDArray[Any] | None = None
) -> list[HeldPlant]:
    """The distinct strongly connected blocks of the loop, balanced, with B K of each factored at full rank."""
    return [*_blocks_of(HeldPlant(A, B, K, period_s, measured))]


@lru_cache(maxsize=64)
def _blocks_of(whole: HeldPlant) -> list[HeldPlant]:
    """`held_blocks` of a loop as one block: the growth of one loop is asked for at many delays."""
    measured, plants = whole.measured, list[HeldPlant]()
    seen = np.ones(len(whole.A)) if measured is None else measured.astype(np.float64)
    for block in distinct_blocks(whole.A, whole.B @ whole.K, np.diag(seen)):
        A_block, BK_block = balanced(*block.matrices[:2])
        own = None if measured is None else np.diag(block.matrices[2]) > 0.0
        plants.append(HeldPlant(A_block, *factor_rank(BK_block), whole.period_s, own))
    return plants


def radius_of(step: FloatArray) -> float:
    """Spectral radius of a map."""
    return float(np.abs(np.linalg.eigvals(step)).max())


def sensitivity(step: FloatArray) -> float:
    """By how much a small error of a map, in its norm, moves the spectral radius: large near a multiple eigenvalue."""
    eigenvalues, vectors = np.linalg.eig(step)
    k = int(np.argmax(np.abs(eigenvalues)))
    left = np.linalg.svd(step - eigenvalues[k] * np.eye(len(step)))[0][:, -1]
    return 1.0 / max(abs(complex(left.conj() @ vectors[:, k])), 1e-300)


def block_radius(plant: SampledPlant, delay_s: float) -> float:
    """Spectral radius of the one-period map of one block."""
    return radius_of(lifted_map(plant, delay_s))


def settled_covariance(step: FloatArray, added: FloatArray) -> FloatArray | None:
    """The steady-state covariance P = F P F' + Q of a map F with noise Q per period, by doubling; None if unstable."""
    covariance, power = added.copy(), step
    for _ in range(_DOUBLINGS):
        more = power @ covariance @ power.T
        if not np.abs(more).max() <= _MOST * (np.abs(added).max() + 1.0):
            return None
        covariance += more
        if np.abs(more).max() <= _ROUNDING * np.abs(covariance).max():
            break
        power = power @ power
    return covariance


def rate_of(radius: float, period_s: float) -> float:
    """Exponential rate (1/s) of a motion that grows by the factor `radius` per period: negative when it decays."""
    return float(np.log(radius)) / period_s if radius > 0.0 else -inf


def held_entry(plant: SampledPlant, z: ComplexArray, delay_s: float | FloatArray) -> ComplexArray:
    """The effect of held, delayed commands on the state: (G0 z + G1) z^{-q-1}, (k, n, r), at points z (k, 1, 1).

    The delay is common to all inputs, or one for each (r,).
    """
    entry = np.zeros_like(plant.B) + 0j * z
    for own_s, of_own in _inputs_by_delay(delay_s, plant.B.shape[1]):
        whole, rest_s = split_delay(own_s, plant.period_s)
        G, newer = plant.transition(np.array([plant.period_s, plant.period_s - rest_s]))[1]
        entry += (newer * (z - 1.0) + G) * z ** (-whole - 1) * of_own
    return entry


def _inputs_by_delay(delay_s: float | FloatArray, inputs: int) -> list[tuple[float, FloatArray]]:
    """Each distinct delay, with ones (r,) at the inputs that have it."""
    if isinstance(delay_s, np.ndarray):
        return [(own_s, np.equal(delay_s, own_s).astype(np.float64)) for own_s in np.unique(delay_s).tolist()]
    return [(delay_s, np.ones(inputs))]


def split_delay(delay_s: float, period_s: float) -> tuple[int, float]:
    """q and e (s) with tau = q T + e, 0 <= e < T."""
    periods = delay_s / period_s
    whole = round(periods)
    if abs(periods - whole) <= _WHOLE * max(1.0, periods):
        return whole, 0.0
    whole = int(np.floor(periods))
    return whole, min(max(delay_s - whole * period_s, 0.0), period_s)


def lifted_map(plant: SampledPlant, delay_s: float | FloatArray) -> FloatArray:
    """The one-period map of (x_k, u_{k-1}, ..., u_{k-s}), see `gains.sampled.constant.period_map`.

    The delay is common to all inputs, or one for each (r,).
    """
    n, inputs = plant.B.shape
    splits = [(*split_delay(own_s, plant.period_s), of_own) for own_s, of_own in _inputs_by_delay(delay_s, inputs)]
    kept = max(whole + (1 if rest_s > 0.0 else 0) for whole, rest_s, _ in splits)
    Phi, G = plant.transition(np.array([plant.period_s, *(plant.period_s - rest_s for _, rest_s, _ in splits)]))
    lifted = np.zeros((n + kept * inputs, n + kept * inputs))
    lifted[:n, :n] = Phi[0]
    for (whole, _, of_own), acted in zip(splits, G[1:], strict=True):
        newer, older = acted * of_own, (G[0] - acted) * of_own
        # column block s holds u_{k-s}; u_k itself is K x_k
        for age, gain in ((whole, newer), (whole + 1, older)):
            if age == 0:
                lifted[:n, :n] += gain @ plant.K
            elif age <= kept:
                start = n + (age - 1) * inputs
                lifted[:n, start : start + inputs] += gain
    if kept > 0:
        lifted[n : n + inputs, :n] = plant.K
        lifted[n + inputs :, n : lifted.shape[1] - inputs] = np.eye((kept - 1) * inputs)
    return lifted
