"""Semidefinite programs: modelled with cvxpy, solved by Clarabel, verified by plain linear algebra.

A solver status is not a proof. `solved` accepts only "optimal", and its callers verify the certificate themselves.
`positive_definite_solution` verifies its own solution, whatever the status. Calling Clarabel without cvxpy gives the
same bounds in `gains.varying` to the last bit, seven of them in 11 s instead of 21 s: not worth a second code path.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.errors import SolverError

Inequalities = Callable[[Sequence[FloatArray]], Sequence[FloatArray]]

# With Clarabel's own tolerance of 1e-8 and its longest step, larger synthesis problems (bounds of 300 on two axes)
# sometimes end "optimal_inaccurate". Feasibility problems need more digits: 1e-8 costs 1 % of some delay bounds.
_SYNTHESIS_TOLERANCE, _SYNTHESIS_STEP, _FEASIBILITY_TOLERANCE = 1e-7, 0.9, 1e-11
# eigenvalues of a symmetric matrix of size n are known to n eps times its norm
_EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class SolverFacts:
    """Record of an optimiser run: enough to repeat it and to see that it ended properly.

    `variables` and `constraints` count the scalars of the problem as modelled.
    """

    name: str
    version: str
    modelling_version: str
    status: str
    seconds: float
    iterations: int
    variables: int
    constraints: int


@dataclass(frozen=True)
class Unknown:
    """An unknown matrix of shape (rows, columns); symmetric if only `rows` is given."""

    rows: int
    columns: int = 0

    @property
    def count(self) -> int:
        """The number of independent entries."""
        return self.rows * self.columns or self.rows * (self.rows + 1) // 2

    def matrix(self, entries: FloatArray) -> FloatArray:
        """The matrix with these independent entries (count,)."""
        if self.columns:
            return entries.reshape(self.rows, self.columns)
        matrix = np.zeros((self.rows, self.rows))
        matrix[np.triu_indices(self.rows)] = entries
        return matrix + np.triu(matrix, 1).T


def solved(problem: Any, *, advice: str) -> SolverFacts:
    """Solve a cvxpy problem with Clarabel; any status but "optimal" raises a SolverError that ends with `advice`."""
    from importlib.metadata import version

    import cvxpy as cp

    try:
        _run(problem, tolerance=_SYNTHESIS_TOLERANCE, max_step_fraction=_SYNTHESIS_STEP)
    except cp.SolverError as error:
        raise SolverError(f"Clarabel stopped: {error}; {advice}") from error
    if problem.status != cp.OPTIMAL:
        raise SolverError(f"Clarabel ended with status {problem.status!r}; wanted 'optimal': {advice}")
    facts = (
        float(problem.solver_stats.solve_time),
        int(problem.solver_stats.num_iters),
        int(problem.size_metrics.num_scalar_variables),
        sum(int(constraint.size) for constraint in problem.constraints),
    )
    return SolverFacts("Clarabel", version("clarabel"), f"cvxpy {version('cvxpy')}", str(problem.status), *facts)


def _run(problem: Any, *, tolerance: float, **settings: float) -> None:
    import cvxpy as cp

    tolerances = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), tolerance)
    # silence cvxpy's warning of an inaccurate solution: its status or certificate is checked instead
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        problem.solve(solver=cp.CLARABEL, **tolerances, **settings)


def negative(matrix: Any, slack: Any) -> Any:
    """Constraint matrix ⪯ −slack; averaging with the transpose shows cvxpy that the matrix is symmetric."""
    return (matrix + matrix.T) / 2 + slack << 0


def positive_definite_solution(unknowns: Sequence[Unknown], inequalities: Inequalities) -> list[FloatArray] | None:
    """Unknowns with entries in [-1, 1] that make every matrix positive definite; None if none were found.

    The solver maximises the least eigenvalue. Its solution counts only if numpy finds the matrices positive definite;
    None does not prove that no solution exists. `inequalities` maps the unknown matrices, in the order of `unknowns`,
    to symmetric matrices; it is linear and homogeneous.
    """
    import cvxpy as cp

    ends = np.cumsum([unknown.count for unknown in unknowns])

    def matrices_at(entries: FloatArray) -> list[FloatArray]:
        parts = np.split(entries, ends[:-1])
        return list(inequalities([unknown.matrix(part) for unknown, part in zip(unknowns, parts, strict=True)]))

    columns = [matrices_at(unit) for unit in np.eye(ends[-1])]
    entries, least = cp.Variable(int(ends[-1])), cp.Variable()
    constraints: list[Any] = [entries <= 1, entries >= -1]
    for parts in zip(*columns, strict=True):
        size = len(parts[0])
        matrix: Any = cp.reshape(np.reshape(parts, (-1, size * size)).T @ entries, (size, size), order="C")
        constraints.append(negative(-matrix, least * np.eye(size)))
    try:
        _run(cp.Problem(cp.Maximize(least), constraints), tolerance=_FEASIBILITY_TOLERANCE)
    except cp.SolverError:
        return None
    if entries.value is None:
        return None
    found = np.asarray(entries.value, dtype=np.float64)
    for matrix in matrices_at(found):
        eigenvalues = np.linalg.eigvalsh(matrix)
        if not eigenvalues[0] > 4.0 * matrix.shape[0] * _EPS * float(np.abs(eigenvalues).max()):
            return None
    return [unknown.matrix(part) for unknown, part in zip(unknowns, np.split(found, ends[:-1]), strict=True)]
