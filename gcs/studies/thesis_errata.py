"""Computations that contradict statements of the source; `gcs.studies.thesis` has those about its numbers."""

from collections.abc import Iterator, Sequence
from itertools import compress, islice, product

import numpy as np

from gains.core.arrays import FloatArray
from gains.delay.constant import delay_margin
from gains.delay.sweep import frequency_sweep_margin
from gains.formation.inclusion import Restriction, expand
from gains.formation.model import FormationModel
from gcs.studies.thesis_flights import SINGLE, printed_gains

PUBLISHED_S = (0.185, 0.195)
"""The values that round to the published 0.19 s."""


def controllable_dimensions(restriction: Restriction) -> tuple[int, int]:
    """Rank of [B, AB, A²B, ...] of the expanded chain of three, one axis, and that of [A, B].

    All eigenvalues are zero, so that by Hautus' test the system is controllable if and only if the second is full.
    """
    expansion = expand(SINGLE, restriction)
    A, B = expansion.A.toarray(), expansion.B.toarray()
    powers = [np.linalg.matrix_power(A, k) @ B for k in range(len(A))]
    return int(np.linalg.matrix_rank(np.hstack(powers))), int(np.linalg.matrix_rank(np.hstack([A, B])))


def s_procedure_counterexample() -> tuple[bool, bool, bool]:
    """For F = G = −1: whether F > 0 wherever G ≤ 0, whether F − τG > 0 for some τ ≥ 0, and whether F + τG > 0."""
    F = G = -1.0
    some = np.linspace(0.0, 100.0, 1001)
    return not (G <= 0.0) or F > 0.0, bool((F - some * G > 0.0).any()), bool((F + some * G > 0.0).any())


def pencil_moduli(own: float, late: float) -> tuple[float, float]:
    """Least and largest |λ(jωI − A0, A1)| over frequencies up to 100 rad/s, of x' = own x + late x(t − τ)."""
    moduli = np.abs((1j * np.linspace(0.0, 100.0, 100_001) - own) / late)
    return float(moduli.min()), float(moduli.max())


def first_crossing(own: float, late: float, sign: float) -> float:
    """θ / ω at which λ(jω − A0, A1) = e^{sign jθ}, θ in [0, 2π), of x' = own x + late x(t − τ)."""
    omega = float(np.sqrt(late**2 - own**2))
    return float(np.mod(sign * np.angle((1j * omega - own) / late), 2.0 * np.pi)) / omega


def late_choices(
    model: FormationModel, K: FloatArray, parts: Sequence[FloatArray]
) -> Iterator[tuple[tuple[bool, ...], tuple[FloatArray, FloatArray]]]:
    """Each choice of which parts of K are late, at least one, with (A0, A1) of the loop that has them late."""
    for chosen in islice(product((False, True), repeat=len(parts)), 1, None):
        late = np.sum(list(compress(parts, chosen)), axis=0)
        yield chosen, (model.A + model.B @ (K - late), model.B @ late)


def _late_entries() -> list[tuple[FloatArray, FloatArray]]:
    """(A0, A1) for each of the 4,095 choices of which of the twelve printed scalar gains are late.

    One axis: the blocks are multiples of the identity, except for entries of at most 0.0053.
    """
    K = printed_gains()[::2, ::2]
    places = np.flatnonzero(np.abs(K) > 0.1)
    assert len(places) == 12
    entries = [K * place.reshape(K.shape) for place in np.eye(K.size)[places]]
    return [loop for _, loop in late_choices(SINGLE, K, entries)]


def subset_margins() -> FloatArray:
    """The delay margin for each choice of which of the twelve printed scalar gains are late."""
    margins: list[float] = []
    for now, late in _late_entries():
        try:
            margins.append(delay_margin(now, late))
        except np.linalg.LinAlgError:  # the resolvent is singular on the axis
            margins.append(frequency_sweep_margin(now, late))
    return np.array(margins)


def subset_margin_by_sweep(number: int) -> float:
    """The margin of one of the subsets of `subset_margins` by the frequency sweep."""
    return frequency_sweep_margin(*_late_entries()[number])
