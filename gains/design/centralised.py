"""Centralised robust gains, every vehicle with the state of all: what decentralised ones are measured by.

The robust LMI (3.25-3.29) of the whole formation with a full Lyapunov matrix. It grows with the number of vehicles,
which is what the decentralised routes avoid. The centralised LQR is in `gains.design.lqr`.

Source: S. Boyd, L. El Ghaoui, E. Feron, V. Balakrishnan, "Linear Matrix Inequalities in System and Control Theory",
SIAM 1994, section 7.2, for the change of variables L = K Y.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from gains.core._semidefinite import SolverFacts, negative, solved
from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError, SolverError
from gains.formation.pattern import Plant
from gains.performance.robust import disturbance_bound

# Room for the solver's rounding, as a share, when the bound it claims is compared with the exact one.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class CentralisedRobustGain:
    """K of shape (inputs, states) and the sector bound α (1/s for W = I) that the LMI proves."""

    K: FloatArray
    alpha: float
    solver: SolverFacts


def centralised_lmi(plant: Plant, *, gain_bound: float, lyapunov_bound: float) -> CentralisedRobustGain:
    """K of the largest sector bound α (W = I) that one full Lyapunov matrix proves.

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

    >>> from gains.design.centralised import centralised_lmi
    >>> from gains.formation.pattern import Plant
    >>> found = centralised_lmi(Plant([[0]], [[1]]), gain_bound=2.0, lyapunov_bound=2.0)
    >>> found.K.round(3).tolist(), round(found.alpha, 3)
    ([[-4.0]], 3.464)
    """
    import cvxpy as cp

    for name, bound in (("gain_bound", gain_bound), ("lyapunov_bound", lyapunov_bound)):
        if not (np.isfinite(bound) and bound > 0):
            raise BadModelError(f"{name} = {bound}; wanted a positive number, for example 100")
    A, B = plant.A, plant.B
    n, inputs = B.shape
    identity = np.eye(n)
    Y, L, gamma = cp.Variable((n, n), symmetric=True), cp.Variable((inputs, n)), cp.Variable()
    drift: Any = A @ Y + Y @ A.T + B @ L + L.T @ B.T + identity
    constraints: list[Any] = [
        negative(cp.bmat([[drift, Y], [Y, -gamma * identity]]), _ROUNDING * np.eye(2 * n)),
        cp.bmat([[gain_bound * identity, L.T], [L, gain_bound * np.eye(inputs)]]) >> 0,
        Y - identity / lyapunov_bound >> 0,
    ]
    facts = solved(
        cp.Problem(cp.Minimize(gamma), constraints),
        advice=f"raise gain_bound = {gain_bound} or lyapunov_bound = {lyapunov_bound}",
    )
    K = np.linalg.solve(np.asarray(Y.value, dtype=float), np.asarray(L.value, dtype=float).T).T
    alpha = float(np.asarray(gamma.value)) ** -0.5
    exact = disturbance_bound(A + B @ K, identity)
    if not exact >= alpha * (1.0 - _ROUNDING):
        raise SolverError(f"the LMI claims alpha = {alpha:.6g} for gains whose exact bound is {exact:.6g}")
    return CentralisedRobustGain(K=K, alpha=alpha, solver=facts)
