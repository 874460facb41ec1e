"""The linear quadratic cost of a gain with a given pattern, its gradient, and the centralised optimum.

For x' = A x + B u, y = C x, u = K y the cost (4.5) is the mean of ∫ x'Qx + u'Ru dt over initial states with covariance
I, or over white noise of intensity I (the squared H2 norm)::

    J(K) = trace(P),   A_K'P + P A_K + Q + C'K'RKC = 0,   A_K = A + B K C
    ∇J(K) = 2 (R K C + B'P) L C',   A_K L + L A_K' + I = 0

Sources: Sahoo 2012 (see `gains.formation.model`), section 4, eq. (4.5); W. S. Levine and M. Athans, "On the
determination of the optimal constant output feedback gains for linear multivariable systems", IEEE Trans. Automatic
Control 15 (1970), 44-48, for the gradient.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import linalg

from gains.core.arrays import BoolArray, FloatArray, IntArray
from gains.core.errors import BadModelError, InfeasibleError
from gains.core.structure import real_matrix, strongly_connected_blocks
from gains.formation.pattern import Plant

# rounding error of an eigenvalue, relative to the norm
_ROUNDING = 1e-15


class Weights(NamedTuple):
    """Symmetric weights: Q (n, n) on states, positive semidefinite; R (inputs, inputs) on inputs, positive definite."""

    Q: FloatArray
    R: FloatArray

    def fitting(self, plant: Plant) -> "Weights":
        """The weights as arrays; raises BadModelError unless they are as above and match the plant's size."""
        arrays = Weights(real_matrix("Q", self.Q), real_matrix("R", self.R))
        for name, weight, size in (("Q", arrays.Q, plant.states), ("R", arrays.R, plant.B.shape[1])):
            least, wanted = (-1e-12, "semidefinite") if name == "Q" else (1e-14, "definite")
            symmetric = weight.shape == (size, size) and np.allclose(weight, weight.T, rtol=1e-12, atol=0.0)
            if not symmetric or np.linalg.eigvalsh(weight)[0] < least * max(np.abs(weight).max(), 1e-300):
                wanted = f"a symmetric, positive {wanted} matrix of {size} rows is wanted"
                raise BadModelError(f"{name}, of shape {weight.shape}, does not fit: {wanted}")
        return arrays


@dataclass(frozen=True, eq=False)
class CostPoint:
    """A stabilising gain, its cost, projected gradient and the covariance C L C' of the outputs."""

    K: FloatArray
    cost: float
    gradient: FloatArray
    covariance: FloatArray


class LyapunovEquations:
    """Solver of both Lyapunov equations of a closed loop, from a Schur form that keeps its block triangular form.

    Eigenvalues are computed by strongly connected blocks: as a whole, a chain of identical followers has one defective
    eigenvalue, which rounding would spread into the right half plane. `abscissa` is their largest real part, 1/s.
    """

    def __init__(self, A: FloatArray, blocks: list[IntArray]) -> None:
        # ordering driven blocks first makes the matrix block upper triangular
        order = np.concatenate(blocks[::-1])
        self._basis = np.zeros(A.shape)
        triangular = A[np.ix_(order, order)]
        self.abscissa = -np.inf
        start = 0
        for block in blocks[::-1]:
            place = slice(start, start + block.size)
            schur = linalg.schur(triangular[place, place])
            diagonal, vectors = schur[0], schur[1]
            self._basis[order[place], place] = vectors
            triangular[:, place] = triangular[:, place] @ vectors
            triangular[place] = vectors.T @ triangular[place]
            triangular[place, place] = diagonal
            # in LAPACK's standard form, both diagonal entries of a 2×2 block are the real part
            self.abscissa = max(self.abscissa, float(diagonal.diagonal().max()))
            start = place.stop
        self._triangular = triangular

    def observed(self, Q: FloatArray) -> FloatArray:
        """P with A'P + P A + Q = 0."""
        return self._solve(Q, "T", "N")

    def reached(self) -> FloatArray:
        """L with A L + L A' + I = 0."""
        return self._solve(np.eye(len(self._basis)), "N", "T")

    def _solve(self, constant: FloatArray, left: str, right: str) -> FloatArray:
        Z = self._basis
        [trsyl] = linalg.get_lapack_funcs(["trsyl"], (Z,))
        solution, scale, _ = trsyl(self._triangular, self._triangular, -Z.T @ constant @ Z, trana=left, tranb=right)
        full = Z @ (solution / scale) @ Z.T
        return (full + full.T) / 2


class Cost:
    """J and its gradient for one plant, pattern and weights."""

    def __init__(self, plant: Plant, mask: BoolArray, weights: Weights) -> None:
        self.plant, self.mask, self.weights = plant, mask, weights
        feedback = (plant.B != 0.0).astype(float) @ mask.astype(float) @ (plant.C != 0.0).astype(float)
        self.blocks = strongly_connected_blocks(plant.A, feedback)
        # rows of K with the same free columns share one system of equations
        self._row_groups = [
            (np.flatnonzero((mask == free).all(axis=1)), np.flatnonzero(free))
            for free in np.unique(mask, axis=0)
            if free.any()
        ]

    def lyapunov(self, K: FloatArray) -> LyapunovEquations:
        return LyapunovEquations(self.plant.closed_loop(K), self.blocks)

    def at(self, K: FloatArray) -> CostPoint | None:
        """The `CostPoint` of a gain, None if it does not stabilise."""
        plant, weights = self.plant, self.weights
        equations = self.lyapunov(K)
        if equations.abscissa >= 0.0:
            return None
        F = K @ plant.C
        P = equations.observed(weights.Q + F.T @ weights.R @ F)
        L = equations.reached()
        gradient = 2.0 * (weights.R @ F + plant.B.T @ P) @ L @ plant.C.T
        cost = float(np.trace(P))
        # near the stability limit rounding decides; a negative covariance gives it away
        if not (np.isfinite(cost) and np.trace(L) > 0.0 and np.diag(L).min() > -1e-9 * np.trace(L)):
            return None
        return CostPoint(K, cost, np.where(self.mask, gradient, 0.0), plant.C @ L @ plant.C.T)

    def scaled(self, point: CostPoint, gradient: FloatArray) -> FloatArray:
        """M⁻¹g with M the curvature of the cost at fixed P and L: 2 R_aa (C L C') on the free entries of every row a.

        −M⁻¹g is the step of Anderson and Moore; M makes the descent independent of units and of the vehicles' speed of
        response.
        """
        direction = np.zeros_like(gradient)
        for rows, columns in self._row_groups:
            covariance = point.covariance[np.ix_(columns, columns)]
            # outputs that never move, or hardly move relative to others, leave the covariance singular to rounding
            values, vectors = np.linalg.eigh(covariance)
            values = values.clip(min=1e-13 * max(float(np.trace(covariance)), 1e-300))
            solved = gradient[np.ix_(rows, columns)] @ vectors / values @ vectors.T
            direction[np.ix_(rows, columns)] = solved / (2.0 * self.weights.R[rows, rows][:, np.newaxis])
        return direction


def centralised_lqr(plant: Plant, weights: Weights) -> tuple[FloatArray, float]:
    """Return the optimal K = −R⁻¹B'P, shape (inputs, states), and its cost trace(P), from the Riccati equation.

    Raises BadModelError if a weight does not fit, and InfeasibleError if the Riccati equation has no stabilising
    solution.

    >>> integrator = Plant(A=np.zeros((1, 1)), B=np.eye(1), C=np.eye(1))
    >>> K, cost = centralised_lqr(integrator, Weights(Q=4 * np.eye(1), R=np.eye(1)))
    >>> K.round(12).tolist(), round(cost, 12)
    ([[-2.0]], 2.0)
    """
    weights = weights.fitting(plant)
    try:
        P = linalg.solve_continuous_are(plant.A, plant.B, weights.Q, weights.R)
        K = -np.linalg.solve(weights.R, plant.B.T @ P)
        closed = plant.A + plant.B @ K
        # a mode on the axis without weight in Q stays there, to rounding
        if (slowest := float(np.linalg.eigvals(closed).real.max())) >= -_ROUNDING * np.linalg.norm(closed):
            raise np.linalg.LinAlgError(f"a root has the real part {slowest:.3g}")
    except np.linalg.LinAlgError as error:
        raise InfeasibleError(
            f"the Riccati equation has no stabilising solution ({error}): (A, B) must be stabilisable and Q must weigh "
            "every mode on the imaginary axis"
        ) from error
    return K, float(np.trace(P))
