"""Robustness of given gains: exact, by frequency response, and proved, by a Lyapunov function.

The subsystem E = (e_j^v, e_i^p, e_i^v) of a follower i behind j is disturbed by w (wind, model error) within a sector,
w'w ≤ α² E'W'W E (3.25-3.29). All followers have the same subsystem, so nothing here grows with the number of vehicles.
α is in 1/s for W = I with the state in m and m/s.

Source: Sahoo 2012 (see `gains.formation.model`), eqs. (3.20)-(3.29).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import FloatArray, spectral_norms
from gains.core.errors import BadModelError, InfeasibleError
from gains.core.structure import real_matrix
from gains.formation.model import FormationModel

# The level-set search stops when no frequency exceeds the largest gain found by this share: far above the rounding of a
# 6×6 eigenvalue problem, and far below the resolution of any figure shown to a user.
_LEVEL_STEP = 1e-10
_LEVEL_ROUNDS = 60
# relative slack ε by which the Riccati equation demands more than α, in every direction
_SLACK = 4e-5


@dataclass(frozen=True, eq=False)
class Certificate:
    """Lyapunov function V = E'PE that proves the sector bound α, with its checked eigenvalues."""

    P: FloatArray
    """Symmetric, shape (3 n, 3 n)."""
    alpha: float
    """The bound proved."""
    P_eigenvalue_min: float
    """Positive."""
    s_procedure_eigenvalue_max: float
    """Largest eigenvalue of [[A_cl'P + P A_cl + α² W'W, P], [P, −I]]; negative."""


def subsystem_loop(K1: ArrayLike, K2: ArrayLike, K3: ArrayLike) -> FloatArray:
    """Return the closed loop A_cl = [[K1, 0, 0], [I, 0, −I], [K2, K3, K1]] of (3.25, 3.26), shape (3 n, 3 n).

    It is the loop of a leader and one follower. Arguments and exceptions as for `robustness`.
    """
    given = {"K1": K1, "K2": K2, "K3": K3}
    gains = [real_matrix(name, gain if isinstance(gain, list) else np.atleast_2d(gain)) for name, gain in given.items()]
    A0, A1 = FormationModel((-1, 0), axes=len(gains[0])).ground_loop(*gains)
    return A0 + A1


def robustness(K1: ArrayLike, K2: ArrayLike, K3: ArrayLike, W: ArrayLike | None = None) -> float:
    """Return the exact α of the gains, 1 / ‖W (sI − A_cl)^{-1}‖∞; 0 if the undisturbed loop is not stable.

    The sector bound α can be proved by a quadratic Lyapunov function, with a full matrix, if and only if
    α ‖W (sI − A_cl)^{-1}‖∞ < 1 (Kalman-Yakubovich-Popov). For W = I, 1 / ‖·‖∞ is the complex stability radius of A_cl,
    the minimum of σ_min(jωI − A_cl) over ω, which the SLICOT routine AB13FD also computes. K1, K2 and K3 have the shape
    (n, n), or are numbers; the weight W of the sector has the shape (q, 3 n), the identity if None. BadModelError if
    one is not finite or has another shape.

    These gains are weakest at ω = 0, where α is the least singular value of A_cl:

    >>> least = np.linalg.svd(subsystem_loop(-3, 2, 2), compute_uv=False)[-1]
    >>> round(robustness(-3, 2, 2), 6), round(float(least), 6)
    (0.532094, 0.532094)
    """
    A = subsystem_loop(K1, K2, K3)
    return disturbance_bound(A, _checked_weight(W, A.shape[0]))


def disturbance_bound(A: FloatArray, W: FloatArray) -> float:
    """Return 1 / ‖W (sI − A)^{-1}‖∞ by level sets of the frequency response, 0 if A is not Hurwitz.

    A and W are finite, of shapes (n, n) and (q, n).

    γ is a singular value of W (jωI − A)^{-1} if and only if jω is an eigenvalue of [[A, I/γ], [−W'W/γ, −A']]. Given a
    lower bound γ, the frequencies at which the response crosses it bound the intervals above it; the response at their
    midpoints gives the next γ, until no crossing is left. The result is on the safe side by at most 1e-10 of itself.

    x' = −2 x + w stays stable for w² ≤ α² x² up to α = 2:

    >>> round(disturbance_bound(np.array([[-2.0]]), np.eye(1)), 6)
    2.0
    """
    n = A.shape[0]
    eigenvalues = np.linalg.eigvals(A)
    if eigenvalues.real.max() >= 0:
        return 0.0
    identity = np.eye(n)
    weight_squared = W.T @ W
    frequencies = np.concatenate([[0.0], np.abs(eigenvalues), np.abs(eigenvalues.imag)])
    gamma = 0.0
    for _ in range(_LEVEL_ROUNDS):
        response = W @ np.linalg.inv(1j * frequencies[:, None, None] * identity - A)
        peak = float(spectral_norms(response).max())
        if peak <= gamma:
            break
        gamma = peak * (1 + _LEVEL_STEP)
        hamiltonian = np.block([[A, identity / gamma], [-weight_squared / gamma, -A.T]])
        crossing = np.linalg.eigvals(hamiltonian)
        # A crossing that is nearly a touch leaves the axis by the square root of the rounding error. Taking too many is
        # harmless: they are only frequencies at which the response is then computed.
        on_axis = np.abs(crossing.real) <= 1e-6 * np.abs(crossing).max()
        levels = np.unique(np.abs(crossing.imag[on_axis]))
        if levels.size == 0:
            break
        frequencies = np.concatenate([levels, (levels[:-1] + levels[1:]) / 2, levels[:1] / 2])
    return float("inf") if gamma == 0.0 else 1.0 / gamma


def certify(K1: ArrayLike, K2: ArrayLike, K3: ArrayLike, alpha: float, W: ArrayLike | None = None) -> Certificate:
    """Prove that the gains withstand the sector bound α, by a full P from a Riccati equation, checked by eigenvalues.

    P is the stabilising solution of A_cl'P + P A_cl + P P + (1 + ε) α² W'W + ε α² I = 0 with ε = 4e-5, which makes the
    S-procedure matrix [[A_cl'P + P A_cl + α² W'W, P], [P, −I]] negative definite. It exists for α up to a relative
    distance of about ε below the exact bound of `robustness`, which is found in another way. Gains and W as for
    `robustness`. Raises BadModelError if α is not positive, or a gain or W is not finite or has a wrong shape, and
    InfeasibleError if the equation has no such solution or P fails the check.
    """
    if not (np.isfinite(alpha) and alpha > 0):
        raise BadModelError(f"alpha = {alpha}; wanted a positive number")
    from scipy import linalg

    A = subsystem_loop(K1, K2, K3)
    m = len(A)
    weight = _checked_weight(W, m)
    wanted = alpha**2 * ((1.0 + _SLACK) * weight.T @ weight + _SLACK * np.eye(m))
    try:
        P = linalg.solve_continuous_are(A, np.eye(m), wanted, -np.eye(m))
    except linalg.LinAlgError as error:
        raise InfeasibleError(f"found no proof of alpha = {alpha:.6g} for these gains: {error}; lower alpha") from error
    return _checked_certificate(A, weight, alpha, np.asarray(P, dtype=np.float64))


def _checked_weight(W: ArrayLike | None, m: int) -> FloatArray:
    if W is None:
        return np.eye(m)
    weight = real_matrix("W", W)
    if weight.shape[1] != m:
        raise BadModelError(f"W has shape {weight.shape}; wanted (any, {m})")
    return weight


def _checked_certificate(A: FloatArray, W: FloatArray, alpha: float, P: FloatArray) -> Certificate:
    """Check P ≻ 0 and the S-procedure matrix ≺ 0 by numpy's eigenvalues alone, allowing for their rounding."""
    P_ = (P + P.T) / 2
    s_procedure = np.block([[A.T @ P_ + P_ @ A + alpha**2 * W.T @ W, P_], [P_, -np.eye(A.shape[0])]])
    P_min = float(np.linalg.eigvalsh(P_).min())
    s_max = float(np.linalg.eigvalsh(s_procedure).max())
    rounding = 1e-15 * float(np.abs(s_procedure).max())
    if not (P_min > rounding and s_max < -rounding):
        raise InfeasibleError(
            f"found no proof of alpha = {alpha:.6g} for these gains: least eigenvalue of P {P_min:.3g} (wanted > 0), "
            f"largest of the S-procedure matrix {s_max:.3g} (wanted < 0); lower alpha"
        )
    return Certificate(P=P_, alpha=alpha, P_eigenvalue_min=P_min, s_procedure_eigenvalue_max=s_max)
