"""Gains with the largest robustness by a linear matrix inequality, for one follower and a centralised controller.

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
from gains.core.semidefinite import negative, solved
from gains.formation.model import FormationModel
from gains.formation.pattern import Plant
from gains.performance.robust import disturbance_bound

# Allowance for the solver's rounding: slack in the inequality, and relative tolerance when the claimed bound is
# compared with the exact one.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class RobustGain:
    """K of u = K x, shape (inputs, states), and the sector bound α (1/s for W = I) that the inequality proves."""

    K: FloatArray
    alpha: float


def robust_lmi(*, shear: float, gain_bound: float, lyapunov_bound: float) -> RobustGain:
    """Return the gain of largest α (W = I) that a diagonal Lyapunov matrix in sheared coordinates can prove.

    For E = (e_j^v, e_i^p, e_i^v) of a follower i behind j and z = T E, T = [[1, 0, 0], [0, 1, 0], [0, c, 1]], minimise
    γ = 1/α² subject to::

        [[A_z Y + Y A_z' + B_z L + L'B_z' + T T', Y T^{-T}], [T^{-1} Y, −γ I]] ≺ 0,   ‖L‖ ≤ κ_L,   Y ⪰ I / κ_Y
        Y = diag(y1, y2, y1),   L = [[l1, 0, 0], [l2, l3, l1]],   A_z = T A T^{-1},   B_z = T B

    This has one Schur complement less than the source, whose constant block −I often makes Clarabel end inaccurate.
    K = L Y^{-1} T = [[k1, 0, 0], [k2, k3, k1]] has the wanted pattern, with the same k1 twice. Unbounded gains would
    reach the supremum α = |c| / √(1 + c²); ‖K T^{-1}‖ is at most κ_L κ_Y. `shear` is c < 0 in 1/s, `gain_bound` is κ_L
    and `lyapunov_bound` is κ_Y; BadModelError for other signs. SolverError if the solver does not end with status
    "optimal", or if the exact bound of K is below the claimed one.

    With c = −1, α is close to the supremum 1 / √2 = 0.7071:

    >>> found = robust_lmi(shear=-1.0, gain_bound=10.0, lyapunov_bound=10.0)
    >>> round(found.alpha, 3)
    0.707
    """
    import cvxpy as cp

    if not (np.isfinite(shear) and shear < 0):
        raise BadModelError(f"shear = {shear}; wanted a negative number, for example -2.5")
    pair = FormationModel((-1, 0), axes=1)
    T = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, shear, 1.0]])
    y1, y2, l1, l2, l3 = (cp.Variable() for _ in range(5))
    Y, L = cp.diag(cp.hstack([y1, y2, y1])), cp.bmat([[l1, 0.0, 0.0], [l2, l3, l1]])
    advice = f"raise gain_bound = {gain_bound} or lyapunov_bound = {lyapunov_bound}, or move shear = {shear} towards 0"
    return _largest_alpha(pair.A, pair.B, T, Y, L, bounds=(gain_bound, lyapunov_bound), advice=advice)


def centralised_lmi(plant: Plant, *, gain_bound: float, lyapunov_bound: float) -> RobustGain:
    """Return the K with the largest sector bound α (W = I) that a full Lyapunov matrix proves, using all states.

    The inequality is that of `robust_lmi` with T = I and full Y and L; arguments and exceptions are the same. ‖K‖ is at
    most κ_L κ_Y.

    For x' = u + w, L = −2 and Y = 1/2 give K = −4 and γ = Y² / (−2 L − 1) = 1/12:

    >>> found = centralised_lmi(Plant([[0]], [[1]]), gain_bound=2.0, lyapunov_bound=2.0)
    >>> found.K.round(3).tolist(), round(found.alpha, 3)
    ([[-4.0]], 3.464)
    """
    import cvxpy as cp

    n, inputs = plant.B.shape
    Y, L = cp.Variable((n, n), symmetric=True), cp.Variable((inputs, n))
    advice = f"raise gain_bound = {gain_bound} or lyapunov_bound = {lyapunov_bound}"
    return _largest_alpha(plant.A, plant.B, np.eye(n), Y, L, bounds=(gain_bound, lyapunov_bound), advice=advice)


def _largest_alpha(
    A: FloatArray, B: FloatArray, T: FloatArray, Y: Any, L: Any, *, bounds: tuple[float, float], advice: str
) -> RobustGain:
    """Solve the inequality of `robust_lmi` for structured unknowns Y and L, and check its α."""
    import cvxpy as cp

    for name, bound in zip(("gain_bound", "lyapunov_bound"), bounds, strict=True):
        if not (np.isfinite(bound) and bound > 0):
            raise BadModelError(f"{name} = {bound}; wanted a positive number, for example 100")
    n, inputs = B.shape
    identity, back, gamma = np.eye(n), np.linalg.inv(T), cp.Variable()
    drift = T @ A @ back @ Y + T @ B @ L
    sector = cp.bmat([[drift + drift.T + T @ T.T, Y @ back.T], [back @ Y, -gamma * identity]])
    constraints: list[Any] = [
        negative(sector, _ROUNDING * np.eye(2 * n)),
        cp.bmat([[bounds[0] * identity, L.T], [L, bounds[0] * np.eye(inputs)]]) >> 0,
        Y - identity / bounds[1] >> 0,
    ]
    solved(cp.Problem(cp.Minimize(gamma), constraints), advice=advice)
    K = np.linalg.solve(np.asarray(Y.value, dtype=float), np.asarray(L.value, dtype=float).T).T @ T
    alpha = float(np.asarray(gamma.value)) ** -0.5
    exact = disturbance_bound(A + B @ K, identity)
    if not exact >= alpha * (1.0 - _ROUNDING):
        raise SolverError(f"the LMI claims alpha = {alpha:.6g} for gains whose exact bound is {exact:.6g}")
    return RobustGain(K, alpha)
