"""Gains of largest robustness by a linear matrix inequality, for one follower and for a centralised controller.

`robust_lmi` is the source's design of a follower (3.25-3.29); `gcs thesis` compares it with what was published.
`centralised_lmi` gives every vehicle the state of all: what decentralised designs are measured by. Its full Lyapunov
matrix grows with the number of vehicles, which decentralised designs avoid. The inclusion route does not use either:
`gains.design.search` finds the optimum by formula.

Sources: Sahoo 2012 (see `gains.formation.model`). Its LMI as printed has no solution: with a block-diagonal Y the
(2, 2) block of A Y + Y A' + B L + L'B' is identically zero. `robust_lmi` solves it in sheared coordinates, which keep
the structure of the gain. S. Boyd, L. El Ghaoui, E. Feron, V. Balakrishnan, "Linear Matrix Inequalities in System and
Control Theory", SIAM 1994, section 7.2, for the change of variables L = K Y.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError, SolverError
from gains.formation.pattern import Plant
from gains.performance.robust import (
    Certificate,
    SolverFacts,
    checked_certificate,
    disturbance_bound,
    negative,
    solved,
    subsystem_loop,
)

# Room for the solver's rounding, as a share, when the bound it claims is compared with the exact one; and slack asked
# of the inequality, above the solver's tolerance, so that rounding cannot turn a certificate indefinite.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class RobustGains:
    """Gains k1 (own velocity error, 1/s), k2 (that in front, 1/s), k3 (spacing error, 1/s²), and the α proved.

    The exact bound of these gains, `gains.performance.robust.robustness`, is as large or larger.
    """

    k1: float
    k2: float
    k3: float
    alpha: float
    certificate: Certificate


@dataclass(frozen=True, eq=False)
class CentralisedRobustGain:
    """K of shape (inputs, states) and the sector bound α (1/s for W = I) that the LMI proves."""

    K: FloatArray
    alpha: float
    solver: SolverFacts


def robust_lmi(*, shear: float, gain_bound: float, lyapunov_bound: float) -> RobustGains:
    """Return the gains of largest α (W = I) that a diagonal Lyapunov matrix in sheared coordinates can prove.

    In z = T E, T = [[1, 0, 0], [0, 1, 0], [0, c, 1]], c = `shear`, minimise γ = 1/α² subject to::

        [[A_z Y + Y A_z' + B_z L + L'B_z' + T T', Y T^{-T}], [T^{-1} Y, −γ I]] ≺ 0,   ‖L‖ ≤ κ_L,   Y ⪰ I / κ_Y
        Y = diag(y1, y2, y1),   L = [[l1, 0, 0], [l2, l3, l1]],   A_z = T A T^{-1},   B_z = T B

    One Schur complement less than the source: with its constant block −I kept, Clarabel often ends inaccurate.
    K = L Y^{-1} T = [[k1, 0, 0], [k2, k3z + c k1, k1]] has the wanted pattern, with the same k1 twice. Unbounded gains
    would reach α = |c| / √(1 + c²), the supremum; ‖K T^{-1}‖ is at most κ_L κ_Y.

    Parameters
    ----------
    shear
        c < 0, 1/s.
    gain_bound, lyapunov_bound
        κ_L and κ_Y.

    Raises
    ------
    BadModelError
        If c is not negative or a bound not positive.
    SolverError
        If the solver does not end with status "optimal", or the certificate fails its check.

    Examples
    --------
    Near to the supremum 1 / √2 = 0.7071 of c = −1:

    >>> from gains.design.robust_lmi import robust_lmi
    >>> found = robust_lmi(shear=-1.0, gain_bound=10.0, lyapunov_bound=10.0)
    >>> round(found.alpha, 3)
    0.707
    """
    import cvxpy as cp

    if not (np.isfinite(shear) and shear < 0):
        raise BadModelError(f"shear = {shear}; wanted a negative number, for example -2.5")
    T = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, shear, 1.0]])
    back = np.linalg.inv(T)
    A = T @ np.array([[0.0, 0.0, 0.0], [1.0, 0.0, -1.0], [0.0, 0.0, 0.0]]) @ back
    B = T @ np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    y1, y2, l1, l2, l3 = (cp.Variable() for _ in range(5))
    Y: Any = cp.diag(cp.hstack([y1, y2, y1]))
    L: Any = cp.bmat([[l1, 0.0, 0.0], [l2, l3, l1]])
    alpha, facts = _largest_alpha(
        A, B, Y, L, noise=T @ T.T, seen=back, gain_bound=gain_bound, lyapunov_bound=lyapunov_bound,
        advice=f", or move shear = {shear} to zero",
    )  # fmt: skip
    Y_value = np.asarray(Y.value, dtype=float)
    K_z = np.asarray(L.value, dtype=float) @ np.linalg.inv(Y_value)
    k1, k2, k3 = float(K_z[1, 2]), float(K_z[1, 0]), float(K_z[1, 1] + shear * K_z[1, 2])
    P = T.T @ np.linalg.inv(Y_value) @ T
    proof = checked_certificate(subsystem_loop(k1, k2, k3), np.eye(3), alpha, P, facts)
    return RobustGains(k1=k1, k2=k2, k3=k3, alpha=alpha, certificate=proof)


def centralised_lmi(plant: Plant, *, gain_bound: float, lyapunov_bound: float) -> CentralisedRobustGain:
    """Return the K of largest sector bound α (W = I) that one full Lyapunov matrix proves.

    Minimise γ = 1/α² subject to::

        [[A Y + Y A' + B L + L'B' + I, Y], [Y, −γ I]] ≺ 0,   ‖L‖ ≤ κ_L,   Y ⪰ I / κ_Y,   K = L Y⁻¹

    Parameters
    ----------
    gain_bound, lyapunov_bound
        κ_L and κ_Y; ‖K‖ is at most their product.

    Raises
    ------
    BadModelError
        If a bound is not a positive number.
    SolverError
        If the solver does not end with status "optimal", or the exact bound of K is below the one claimed.

    Examples
    --------
    x' = u + w: L = −2 and Y = 1/2 give K = −4 and γ = Y² / (−2 L − 1) = 1/12.

    >>> from gains.design.robust_lmi import centralised_lmi
    >>> from gains.formation.pattern import Plant
    >>> found = centralised_lmi(Plant([[0]], [[1]]), gain_bound=2.0, lyapunov_bound=2.0)
    >>> found.K.round(3).tolist(), round(found.alpha, 3)
    ([[-4.0]], 3.464)
    """
    import cvxpy as cp

    n, inputs = plant.B.shape
    identity = np.eye(n)
    Y, L = cp.Variable((n, n), symmetric=True), cp.Variable((inputs, n))
    alpha, facts = _largest_alpha(
        plant.A, plant.B, Y, L, noise=identity, seen=identity, gain_bound=gain_bound, lyapunov_bound=lyapunov_bound
    )
    K = np.linalg.solve(np.asarray(Y.value, dtype=float), np.asarray(L.value, dtype=float).T).T
    exact = disturbance_bound(plant.A + plant.B @ K, identity)
    if not exact >= alpha * (1.0 - _ROUNDING):
        raise SolverError(f"the LMI claims alpha = {alpha:.6g} for gains whose exact bound is {exact:.6g}")
    return CentralisedRobustGain(K=K, alpha=alpha, solver=facts)


def _largest_alpha(
    A: FloatArray,
    B: FloatArray,
    Y: Any,
    L: Any,
    *,
    noise: FloatArray,
    seen: FloatArray,
    gain_bound: float,
    lyapunov_bound: float,
    advice: str = "",
) -> tuple[float, SolverFacts]:
    """α = γ^{-1/2} of the least γ with [[A Y + Y A' + B L + L'B' + noise, Y seen'], [seen Y, −γ I]] ≺ 0 in bounds."""
    import cvxpy as cp

    for name, bound in (("gain_bound", gain_bound), ("lyapunov_bound", lyapunov_bound)):
        if not (np.isfinite(bound) and bound > 0):
            raise BadModelError(f"{name} = {bound}; wanted a positive number, for example 100")
    n, inputs = B.shape
    identity, gamma = np.eye(n), cp.Variable()
    drift = A @ Y + Y @ A.T + B @ L + L.T @ B.T + noise
    constraints: list[Any] = [
        negative(cp.bmat([[drift, Y @ seen.T], [seen @ Y, -gamma * identity]]), _ROUNDING * np.eye(2 * n)),
        cp.bmat([[gain_bound * identity, L.T], [L, gain_bound * np.eye(inputs)]]) >> 0,
        Y - identity / lyapunov_bound >> 0,
    ]
    facts = solved(
        cp.Problem(cp.Minimize(gamma), constraints),
        advice=f"raise gain_bound = {gain_bound} or lyapunov_bound = {lyapunov_bound}{advice}",
    )
    return float(np.asarray(gamma.value)) ** -0.5, facts
