"""Strict linear matrix inequalities: find unknowns that make symmetric matrices positive definite, and prove it.

The caller writes the inequalities once, as a function from the unknown matrices to the matrices that must be positive
definite, linear and homogeneous in the unknowns. Clarabel is handed their coefficients; what it returns counts only if
the same function, evaluated at the solution, gives matrices that numpy finds positive definite. The solver's status is
therefore no part of the proof.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np

from gains.core.arrays import FloatArray

Inequalities = Callable[[Sequence[FloatArray]], Sequence[FloatArray]]

# Clarabel's tolerances; its own 1e-8 costs a per cent of some delay bounds
_TOLERANCE = 1e-11
# eigenvalues of a symmetric matrix of size n are known to n eps times its norm
_EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class Unknown:
    """An unknown matrix: symmetric of one size, or any of shape (rows, columns).

    Examples
    --------
    A symmetric 2×2 matrix has three independent entries:

    >>> from gains.varying._lmi import Unknown
    >>> Unknown(2).count, Unknown(2, 3).count
    (3, 6)
    """

    rows: int
    columns: int = 0

    @property
    def is_symmetric(self) -> bool:
        """Whether it was given one size only."""
        return self.columns == 0

    @property
    def count(self) -> int:
        """How many independent entries it has."""
        return self.rows * (self.rows + 1) // 2 if self.is_symmetric else self.rows * self.columns

    def matrix(self, entries: FloatArray) -> FloatArray:
        """The matrix with these independent entries (count,)."""
        if not self.is_symmetric:
            return entries.reshape(self.rows, self.columns)
        matrix = np.zeros((self.rows, self.rows))
        matrix[np.triu_indices(self.rows)] = entries
        return matrix + np.triu(matrix, 1).T


def positive_definite_solution(unknowns: Sequence[Unknown], inequalities: Inequalities) -> list[FloatArray] | None:
    """Values of the unknowns, entries up to 1, that make every matrix positive definite; None if none were found.

    None is not a proof that there are none: the least eigenvalue is made as large as the solver can.

    Parameters
    ----------
    unknowns
        Their shapes, in the order in which `inequalities` takes them.
    inequalities
        Unknown matrices to symmetric matrices, linear and homogeneous.

    Examples
    --------
    x' = a x is stable if there is a p > 0 with −2 a p > 0:

    >>> import numpy as np
    >>> from gains.varying._lmi import Unknown, positive_definite_solution
    >>> [
    ...     positive_definite_solution([Unknown(1)], lambda x: [x[0], -2 * a * x[0]]) is not None
    ...     for a in (-1.0, 1.0)
    ... ]
    [True, False]
    """
    entries = _largest_least_eigenvalue(unknowns, inequalities)
    if entries is None:
        return None
    solution = _matrices(unknowns, entries)
    for matrix in inequalities(solution):
        eigenvalues = np.linalg.eigvalsh(matrix)
        if not eigenvalues[0] > 4.0 * matrix.shape[0] * _EPS * float(np.abs(eigenvalues).max()):
            return None
    return solution


def _matrices(unknowns: Sequence[Unknown], entries: FloatArray) -> list[FloatArray]:
    ends = np.cumsum([unknown.count for unknown in unknowns])
    return [unknown.matrix(part) for unknown, part in zip(unknowns, np.split(entries, ends[:-1]), strict=True)]


def _largest_least_eigenvalue(unknowns: Sequence[Unknown], inequalities: Inequalities) -> FloatArray | None:
    """Maximise t subject to F_i(x) - t I >= 0 and |x_j| <= 1; the best x, or None if the solver gives none."""
    from importlib import import_module

    from scipy.sparse import csc_matrix

    # compiled, and without names that a type checker could read
    clarabel: Any = import_module("clarabel")
    count = sum(unknown.count for unknown in unknowns)
    columns = [_svec(inequalities(_matrices(unknowns, unit))) for unit in np.eye(count)]
    shapes = [matrix.shape[0] for matrix in inequalities(_matrices(unknowns, np.zeros(count)))]
    identity = _svec([np.eye(size) for size in shapes])
    box = np.vstack([np.eye(count), -np.eye(count)])
    # s = b - A z in the cone, with z = (x, t)
    A = np.vstack(
        [
            np.hstack([-np.array(columns).T, identity[:, np.newaxis]]),
            np.hstack([box, np.zeros((2 * count, 1))]),
        ]
    )
    b = np.concatenate([np.zeros(identity.size), np.ones(2 * count)])
    q = np.zeros(count + 1)
    q[-1] = -1.0
    cones = [*(clarabel.PSDTriangleConeT(size) for size in shapes), clarabel.NonnegativeConeT(2 * count)]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = _TOLERANCE
    solver = clarabel.DefaultSolver(csc_matrix((count + 1, count + 1)), q, csc_matrix(A), b, cones, settings)
    entries = np.array(solver.solve().x)[:-1]
    return entries if np.isfinite(entries).all() else None


def _svec(matrices: Sequence[FloatArray]) -> FloatArray:
    """Upper triangles column by column, off-diagonal entries times sqrt(2), one after the other."""
    parts: list[FloatArray] = []
    for matrix in matrices:
        columns, rows = np.tril_indices(matrix.shape[0])
        parts.append(matrix[rows, columns] * np.where(rows == columns, 1.0, sqrt(2.0)))
    return np.concatenate(parts)
