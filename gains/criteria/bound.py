"""The largest α that any controller can reach through a delay.

A vehicle is disturbed by w, |w| ≤ α |E|, and its command acts with a delay h: E' = A E + B u(t − h) + w. α is the
reciprocal of the least ‖E / w‖ that a controller with knowledge of E can reach, however large its commands.

With X of A'X + X A + I + X (I/γ² − B B'/ε²) X = 0, γ is reached without delay. Completing the squares leaves

    ∫ |E|² − γ² |w|² + ε² |u|² dt = ∫ |ε u − F E|² − γ² |w − X E / γ²|² dt,   F = −B'X / ε,

so the command, which knows w only up to t − h, must match F E except for the effect of w in the last h. That part
cannot be matched: γ is reached if and only if w → F E over [0, h], E' = (A + X/γ²) E + w from E = 0, has a norm below γ
(Sarason: the least distance of an operator from those delayed by h is the norm of its compression to [0, h]). That
holds if and only if the lower right block of exp(t H), H = [[A + X/γ², I/γ²], [−F'F, −(A + X/γ²)']], is regular on
(0, h]. ε → 0 removes the price of commands.

Derived here. For a follower without price, X is known in closed form; with it, the tests find the same numbers.
"""

from math import inf

import numpy as np
from scipy import linalg

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.core.structure import positive_number, real_matrix, seconds, square_matrices

# ε, the price of commands, in units of the states: below this, four digits of α no longer change
_PRICE = 1e-4
# instants at which the block must be regular, and bisections of γ
_INSTANTS, _HALVINGS = 100, 40
_LEAST_GAMMA, _LARGEST_GAMMA = 0.1, 1e4


def alpha_bound(A: FloatArray, B: FloatArray, delay_s: float, *, price: float = _PRICE) -> float:
    """Return the α (1/s) that no controller of E' = A E + B u(t − delay) + w exceeds; 0 if it is below 1e-4.

    A is (n, n), B (n, inputs), of full rank; the delay is in s and includes half a hold. `price` > 0 is ε; the default
    makes α too small by up to 1e-3 of itself. BadModelError if an argument is not as described. Without delay, and
    with as many inputs as states, α is `inf`.

    A follower at 0.31 s (0.3 s of loop delay and half a period of 20 ms), and without delay, where the bound is 1:

    >>> A, B = np.array([[0.0, -1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    >>> round(alpha_bound(A, B, 0.31), 4), round(alpha_bound(A, B, 0.0), 3)
    (0.9538, 1.0)
    """
    [state], entry = square_matrices(A=A), real_matrix("B", B)
    seconds("delay_s", delay_s)
    n = len(state)
    if len(entry) != n:
        raise BadModelError(f"B has shape {entry.shape}; {n} rows are wanted, to match A")
    if (rank := int(np.linalg.matrix_rank(entry))) < min(entry.shape):
        raise BadModelError(f"B has the rank {rank}; {min(entry.shape)} is wanted")
    positive_number("price", price)
    if delay_s == 0.0 and rank == n:
        return inf
    low, high = _LEAST_GAMMA, _LARGEST_GAMMA
    if not _is_reached(state, entry, high, delay_s, price):
        return 0.0
    if _is_reached(state, entry, low, delay_s, price):  # in a time unit ten times shorter, at the same price
        return 10.0 * alpha_bound(state / 10.0, entry, 10.0 * delay_s, price=price)
    for _ in range(_HALVINGS):
        middle = (low * high) ** 0.5
        low, high = (low, middle) if _is_reached(state, entry, middle, delay_s, price) else (middle, high)
    return 1.0 / high


def _is_reached(A: FloatArray, B: FloatArray, gamma: float, delay_s: float, price: float) -> bool:
    """Whether some controller keeps ‖E / w‖ below γ."""
    n = len(A)
    identity = np.eye(n)
    hamiltonian = np.block([[A, identity / gamma**2 - B @ B.T / price**2], [-identity, -A.T]])
    eigenvalues, eigenvectors = np.linalg.eig(hamiltonian)
    values, vectors = eigenvalues.astype(np.complex128), eigenvectors.astype(np.complex128)
    stable = np.argsort(values.real)[:n]
    if values[stable].real.max() > -1e-9:
        return False
    halves = np.real(vectors[n:, stable] @ np.linalg.inv(vectors[:n, stable])) / 2
    X: FloatArray = (halves + halves.T).astype(np.float64)
    if float(np.linalg.eigvalsh(X)[0]) < 0.0:
        return False
    drift, F = A + X / gamma**2, B.T @ X / price
    step = linalg.expm(np.block([[drift, identity / gamma**2], [-F.T @ F, -drift.T]]) * (delay_s / _INSTANTS))
    reached = np.eye(2 * n)
    for _ in range(_INSTANTS if delay_s else 0):
        reached = step @ reached
        if float(np.linalg.det(reached[n:, n:])) <= 0.0:
            return False
    return True
