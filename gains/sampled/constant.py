"""The loop as flown: sampled, delayed and held.

The plant x' = A x + B u is sampled at t_k = k T. The command u_k = K x(t_k) acts from t_k + tau until the next one
replaces it at t_k + tau + T (zero-order hold). tau >= 0 is the whole loop delay: uplink, waiting, computation and
downlink. With tau = q T + e, 0 <= e < T, the state at the next sample is

    x_{k+1} = Phi x_k + G0 u_{k-q} + G1 u_{k-q-1},
    Phi = e^{A T},  G0 = int_0^{T-e} e^{A s} ds B,  G1 = int_{T-e}^{T} e^{A s} ds B,

the modified z-transform in state space. The loop is stable exactly if the spectral radius of this one-period map is
below one. For small T the margin in tau is that of the continuous loop minus T / 2, up to terms in T^2.
"""

from numpy.typing import ArrayLike

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.core.structure import positive_seconds, real_matrix, seconds, square_matrices
from gains.sampled._crossings import block_delay_margin
from gains.sampled._loop import HeldPlant, block_radius, held_blocks, lifted_map, rate_of


def period_map(A: ArrayLike, B: ArrayLike, K: ArrayLike, *, period_s: float, delay_s: float) -> FloatArray:
    """The one-period map of (x_k, u_{k-1}, ..., u_{k-s}), a matrix of size n + s p for p inputs.

    s is q for a delay of exactly q periods, else q + 1. A (n, n), B (n, p) and K (p, n) are real, with the feedback
    u = +K x; T = `period_s` > 0 and tau = `delay_s` >= 0 are in s. BadModelError names an invalid argument.

    For x' = u, u = -x at tau = T / 2, x_{k+1} = x_k + (u_{k-1} + u_k) T / 2:

    >>> period_map([[0]], [[1]], [[-1]], period_s=0.5, delay_s=0.25).tolist()
    [[0.75, 0.25], [-1.0, 0.0]]
    """
    plant = HeldPlant(*checked_loop(A, B, K), positive_seconds("period_s", period_s))
    return lifted_map(plant, seconds("delay_s", delay_s))


def spectral_radius(A: ArrayLike, B: ArrayLike, K: ArrayLike, *, period_s: float, delay_s: float) -> float:
    """Factor by which the slowest motion decays (< 1) or grows (> 1) in one period. Arguments as for `period_map`.

    Strongly connected blocks are taken one by one, so that equal followers do not spoil each other's eigenvalues.
    """
    plants = held_blocks(*checked_loop(A, B, K), period_s=positive_seconds("period_s", period_s))
    return max(block_radius(plant, seconds("delay_s", delay_s)) for plant in plants)


def growth_rate(A: ArrayLike, B: ArrayLike, K: ArrayLike, *, period_s: float, delay_s: float) -> float:
    """Exponential rate (1/s) of the slowest motion, ln(spectral radius) / T: negative when stable.

    For a loop that comes to rest in finitely many periods (deadbeat) it is -inf or, with rounding, very negative.
    Arguments as for `period_map`.

    For x' = u, u = -x without delay, x_{k+1} = (1 - T) x_k:

    >>> round(growth_rate([[0]], [[1]], [[-1]], period_s=0.5, delay_s=0.0), 6)
    -1.386294
    """
    return rate_of(spectral_radius(A, B, K, period_s=period_s, delay_s=delay_s), period_s)


def sampled_delay_margin(A: ArrayLike, B: ArrayLike, K: ArrayLike, *, period_s: float) -> float:
    """The least delay tau (s) at which the sampled and held loop loses stability.

    0 if it is unstable at tau = 0, `inf` if it is stable at every delay. The relative accuracy is about 1e-12, or 1e-6
    if the spectral radius passes one with zero slope. A (n, n), B (n, p) and K (p, n) are real, with the feedback
    u = +K x; `period_s` is the period T of telemetry and control. BadModelError names an invalid argument;
    DisagreementError if the spectral radius of the one-period map below or above the margin contradicts it.

    x' = u, u = -x has a margin of 1 s at a period of 1 s, and of about pi / 2 - T / 2 at a short period T:

    >>> [round(sampled_delay_margin([[0]], [[1]], [[-1]], period_s=period_s), 3) for period_s in (1.0, 0.02)]
    [1.0, 1.561]
    """
    plants = held_blocks(*checked_loop(A, B, K), period_s=positive_seconds("period_s", period_s))
    return min(block_delay_margin(plant) for plant in plants)


def forget_margins() -> None:
    """Clear the cache of sampled margins, so that a timing includes their computation.

    >>> forget_margins()
    """
    block_delay_margin.cache_clear()


def checked_loop(A: ArrayLike, B: ArrayLike, K: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A (n, n), B (n, p), K (p, n) as finite real matrices; BadModelError names one that does not fit."""
    [plant] = square_matrices(A=A)
    entry, feedback = real_matrix("B", B), real_matrix("K", K)
    if entry.shape[0] != plant.shape[0]:
        raise BadModelError(f"B has shape {entry.shape}; {plant.shape[0]} rows are wanted, to match A")
    if feedback.shape != entry.shape[::-1]:
        raise BadModelError(f"K has shape {feedback.shape}; {entry.shape[::-1]} is wanted, the transpose of B's")
    return plant, entry, feedback
