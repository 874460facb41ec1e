"""Linear quadratic gains with a given information pattern, to first-order optimality.

For x' = A x + B u, y = C x, u = K y with K in the pattern, minimise the mean of ∫ x'Qx + u'Ru dt (4.5) over initial
states with covariance X0, or over white noise of intensity X0 (the squared H2 norm)::

    J(K) = trace(P X0),   A_K'P + P A_K + Q + C'K'RKC = 0,   A_K = A + B K C
    ∇J(K) = 2 (R K C + B'P) L C',   A_K L + L A_K' + X0 = 0

The gradient is exact and is projected on the pattern. J has no minimum outside the stabilising gains: it grows without
bound towards their border, so a descent never leaves them. It need not be convex; what is found is a local minimum, and
the centralised optimum, with all states for every input, says how much better any other could be.

Sources: Sahoo 2012 (see `gains.formation`), section 4, eq. (4.5), which solves it by other means; W. S. Levine and
M. Athans, "On the determination of the optimal constant output feedback gains for linear multivariable systems", IEEE
Trans. Automatic Control 15 (1970), 44-48, for the gradient.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from gains.errors import BadModelError, InfeasibleError, SolverError
from gains.pattern import FloatArray, Pattern, Plant, check_fits, checked_pattern_gain
from gains.structure import real_matrix, strongly_connected_blocks

# The decrement g'M⁻¹g / J estimates the share of the cost that is still to be gained. Costs are known to about 1e-13.
_DECREMENT = 1e-13
# a line search that fails above this has failed; below, rounding is what stopped it
_DECREMENT_ACCEPTED = 1e-9
_ITERATIONS = 2000
_MEMORY = 20
_LINE_STEPS = 50
_HOMOTOPY_ROUNDS = 200
# share of the way to the border of stability that the homotopy keeps as distance
_HOMOTOPY_DISTANCE = 0.1


@dataclass(frozen=True, eq=False)
class Weights:
    """Weights of the cost: Q (n, n) on states, R (inputs, inputs), and the covariance X0 (n, n) of initial states.

    X0 = I if not given.

    Raises
    ------
    BadModelError
        If a weight is not symmetric, Q or X0 not positive semidefinite, or R not positive definite.

    Examples
    --------
    >>> from gains.structured_lqr import Weights
    >>> Weights([[1, 0], [0, 2]], [[1]]).X0.tolist()
    [[1.0, 0.0], [0.0, 1.0]]
    """

    Q: FloatArray
    R: FloatArray
    X0: FloatArray

    def __init__(self, Q: ArrayLike, R: ArrayLike, X0: ArrayLike | None = None) -> None:
        state = _checked_weight("Q", Q, definite=False)
        object.__setattr__(self, "Q", state)
        object.__setattr__(self, "R", _checked_weight("R", R, definite=True))
        spread = np.eye(len(state)) if X0 is None else _checked_weight("X0", X0, definite=False)
        object.__setattr__(self, "X0", spread)

    def check_fits(self, plant: Plant) -> None:
        """Raise BadModelError unless the sizes are those of the plant."""
        for name, matrix, wanted in (("Q", self.Q, plant.states), ("X0", self.X0, plant.states)):
            if len(matrix) != wanted:
                raise BadModelError(f"{name} has shape {matrix.shape}; ({wanted}, {wanted}) is wanted, as A")
        if len(self.R) != plant.B.shape[1]:
            raise BadModelError(f"R has shape {self.R.shape}; one row for each of {plant.B.shape[1]} inputs is wanted")


@dataclass(frozen=True, eq=False)
class StructuredLqr:
    """A gain with the pattern at which the cost is stationary, and lower than at the start.

    Attributes
    ----------
    K
        Shape (inputs, outputs).
    cost
        J(K).
    cost_centralised
        Least cost of all gains on the full state, a lower bound of J.
    decrement
        g'M⁻¹g / J at the end, with the gradient g and the curvature M of the cost at fixed P and L: an estimate of the
        share of the cost that is still to be gained.
    gradient_norm
        Frobenius norm of the projected gradient.
    costs
        J after every iteration, falling; the first is that of the start.
    """

    K: FloatArray
    cost: float
    cost_centralised: float
    decrement: float
    gradient_norm: float
    costs: tuple[float, ...]

    @property
    def loss(self) -> float:
        """Share by which the cost is above the centralised one: 0.1 is 10 %."""
        return self.cost / self.cost_centralised - 1.0


@dataclass(frozen=True, eq=False)
class _Point:
    """A stabilising gain, its cost, projected gradient and the covariance C L C' of the outputs."""

    K: FloatArray
    cost: float
    gradient: FloatArray
    covariance: FloatArray


class _Lyapunov:
    """Both Lyapunov equations of one closed loop from one Schur form that follows the loop's block triangular form.

    The eigenvalues of the strongly connected blocks are computed block by block: a chain of identical followers is one
    defective eigenvalue as a whole, which rounding would spread into the right half plane.
    """

    def __init__(self, A: FloatArray, blocks: list[NDArray[np.intp]]) -> None:
        # driven blocks first makes the matrix block upper triangular
        order = np.concatenate(blocks[::-1])
        self._basis = np.zeros(A.shape)
        triangular = A[np.ix_(order, order)]
        self._abscissa = -np.inf
        start = 0
        for block in blocks[::-1]:
            place = slice(start, start + block.size)
            schur = linalg.schur(triangular[place, place])
            diagonal, vectors = schur[0], schur[1]
            self._basis[order[place], place] = vectors
            triangular[:, place] = triangular[:, place] @ vectors
            triangular[place] = vectors.T @ triangular[place]
            triangular[place, place] = diagonal
            # LAPACK's standard form has equal diagonal entries, the real parts, in every 2×2 block
            self._abscissa = max(self._abscissa, float(diagonal.diagonal().max()))
            start = place.stop
        self._triangular = triangular

    @property
    def abscissa(self) -> float:
        """Largest real part of an eigenvalue of A, 1/s."""
        return self._abscissa

    def observed(self, Q: FloatArray) -> FloatArray:
        """P with A'P + P A + Q = 0."""
        return self._solve(Q, "T", "N")

    def reached(self, X0: FloatArray) -> FloatArray:
        """L with A L + L A' + X0 = 0."""
        return self._solve(X0, "N", "T")

    def _solve(self, constant: FloatArray, left: str, right: str) -> FloatArray:
        Z = self._basis
        [trsyl] = linalg.get_lapack_funcs(["trsyl"], (Z,))
        solution, scale, _ = trsyl(self._triangular, self._triangular, -Z.T @ constant @ Z, trana=left, tranb=right)
        full = Z @ (solution / scale) @ Z.T
        return (full + full.T) / 2


class _Cost:
    """J and its gradient for one plant, pattern and weights."""

    def __init__(self, plant: Plant, mask: NDArray[np.bool_], weights: Weights) -> None:
        self.plant, self.mask, self.weights = plant, mask, weights
        feedback = (plant.B != 0.0).astype(float) @ mask.astype(float) @ (plant.C != 0.0).astype(float)
        self.blocks = strongly_connected_blocks(plant.A, feedback)
        # rows of K with the same free columns share one system of equations
        self._row_groups = [
            (np.flatnonzero((mask == free).all(axis=1)), np.flatnonzero(free))
            for free in np.unique(mask, axis=0)
            if free.any()
        ]

    def lyapunov(self, K: FloatArray) -> _Lyapunov:
        return _Lyapunov(self.plant.closed_loop(K), self.blocks)

    def at(self, K: FloatArray) -> _Point | None:
        """The point of a gain, None if it does not stabilise."""
        plant, weights = self.plant, self.weights
        equations = self.lyapunov(K)
        if equations.abscissa >= 0.0:
            return None
        F = K @ plant.C
        P = equations.observed(weights.Q + F.T @ weights.R @ F)
        L = equations.reached(weights.X0)
        gradient = 2.0 * (weights.R @ F + plant.B.T @ P) @ L @ plant.C.T
        cost = float(np.sum(P * weights.X0))
        if not np.isfinite(cost):
            return None
        return _Point(K, cost, np.where(self.mask, gradient, 0.0), plant.C @ L @ plant.C.T)

    def scaled(self, point: _Point, gradient: FloatArray) -> FloatArray:
        """M⁻¹g with M the curvature of the cost at fixed P and L: 2 R_aa (C L C') on the free entries of every row a.

        A step of −M⁻¹g is the one of Anderson and Moore; M makes the descent indifferent to units and to how fast the
        vehicles are.
        """
        direction = np.zeros_like(gradient)
        for rows, columns in self._row_groups:
            covariance = point.covariance[np.ix_(columns, columns)]
            # outputs that never move leave the covariance singular
            covariance = covariance + 1e-13 * max(float(np.trace(covariance)), 1e-300) * np.eye(columns.size)
            solved = linalg.solve(covariance, gradient[np.ix_(rows, columns)].T, assume_a="pos").T
            direction[np.ix_(rows, columns)] = solved / (2.0 * self.weights.R[rows, rows][:, np.newaxis])
        return direction


def structured_lqr(
    plant: Plant, pattern: Pattern, weights: Weights, *, start: ArrayLike | None = None
) -> StructuredLqr:
    """Return a gain with the pattern at which the quadratic cost has a local minimum.

    Parameters
    ----------
    plant, pattern, weights
        For 50 vehicles of one axis (99 states) it takes a few seconds.
    start
        A stabilising gain with the pattern; found by `stabilising_gain` if not given.

    Raises
    ------
    BadModelError
        If sizes do not fit or the start does not stabilise.
    InfeasibleError
        If no stabilising gain is found.
    SolverError
        If the descent ends where the cost is not stationary.

    Examples
    --------
    x' = u with ∫ x² + u² dt: u = −x, and the cost is x(0)².

    >>> from gains.pattern import Pattern, Plant
    >>> from gains.structured_lqr import Weights, structured_lqr
    >>> found = structured_lqr(Plant([[0]], [[1]]), Pattern([[1]], (1,), (1,)), Weights([[1]], [[1]]))
    >>> found.K.round(4).tolist(), round(found.cost, 6)
    ([[-1.0]], 1.0)
    """
    check_fits(plant, pattern)
    weights.check_fits(plant)
    cost = _Cost(plant, pattern.mask, weights)
    K = stabilising_gain(plant, pattern, weights) if start is None else checked_pattern_gain(pattern, start)
    first = cost.at(K)
    if first is None:
        raise BadModelError(
            f"the start does not stabilise: the rightmost eigenvalue of A + B K C has real part "
            f"{cost.lyapunov(K).abscissa:.3g} 1/s; a negative one is wanted"
        )
    point, decrement, costs = _descend(cost, first, _ITERATIONS, _DECREMENT)
    if decrement > _DECREMENT_ACCEPTED:
        raise SolverError(
            f"the descent ended after {len(costs) - 1} iterations with decrement {decrement:.3g} (wanted "
            f"{_DECREMENT_ACCEPTED}): scale states and inputs to like size, or give another start"
        )
    return StructuredLqr(
        K=point.K,
        cost=point.cost,
        cost_centralised=centralised_lqr(plant, weights)[1],
        decrement=decrement,
        gradient_norm=float(np.linalg.norm(point.gradient)),
        costs=tuple(costs),
    )


def lqr_cost(plant: Plant, pattern: Pattern, weights: Weights, K: ArrayLike) -> tuple[float, FloatArray]:
    """J(K) and its gradient, zero outside the pattern; infinity and zeros for a gain that does not stabilise.

    Both K and the gradient are of shape (inputs, outputs).

    Raises
    ------
    BadModelError
        If sizes do not fit or K does not have the pattern.

    Examples
    --------
    x' = u, u = −2 x: ∫ (1 + 4) e^{−4t} dt.

    >>> from gains.pattern import Pattern, Plant
    >>> from gains.structured_lqr import Weights, lqr_cost
    >>> cost, gradient = lqr_cost(Plant([[0]], [[1]]), Pattern([[1]], (1,), (1,)), Weights([[1]], [[1]]), [[-2]])
    >>> round(cost, 6), gradient.round(6).tolist()
    (1.25, [[-0.375]])
    """
    check_fits(plant, pattern)
    weights.check_fits(plant)
    point = _Cost(plant, pattern.mask, weights).at(checked_pattern_gain(pattern, K))
    return (np.inf, np.zeros(pattern.mask.shape)) if point is None else (point.cost, point.gradient)


def centralised_lqr(plant: Plant, weights: Weights) -> tuple[FloatArray, float]:
    """The optimal K = −R⁻¹B'P, shape (inputs, states), and its cost trace(P X0), of the algebraic Riccati equation.

    Raises
    ------
    InfeasibleError
        If the Riccati equation has no stabilising solution.

    Examples
    --------
    >>> import numpy as np
    >>> from gains.pattern import Plant
    >>> from gains.structured_lqr import Weights, centralised_lqr
    >>> integrator = Plant(A=np.zeros((1, 1)), B=np.eye(1), C=np.eye(1))
    >>> K, cost = centralised_lqr(integrator, Weights(Q=4 * np.eye(1), R=np.eye(1), X0=np.eye(1)))
    >>> K.round(12).tolist(), round(cost, 12)
    ([[-2.0]], 2.0)
    """
    weights.check_fits(plant)
    try:
        P = linalg.solve_continuous_are(plant.A, plant.B, weights.Q, weights.R)
    except np.linalg.LinAlgError as error:
        raise InfeasibleError(
            f"the Riccati equation has no stabilising solution ({error}): (A, B) must be stabilisable and Q must weigh "
            "every mode on the imaginary axis"
        ) from error
    return -np.linalg.solve(weights.R, plant.B.T @ P), float(np.sum(P * weights.X0))


def stabilising_gain(plant: Plant, pattern: Pattern, weights: Weights) -> FloatArray:
    """A gain with the pattern that stabilises, found from K = 0 by a homotopy.

    A − σI is stable for large σ. Its cost is lowered for a while; the gain then stabilises more than was asked for, and
    σ is lowered nearly as far, until it is 0.

    Raises
    ------
    InfeasibleError
        If the homotopy stops at a σ > 0. To decide whether any static gain stabilises is NP-hard in general: there
        may be one all the same, but none exists if `gains.fixed_modes` finds an unstable mode.

    Examples
    --------
    x' = x + u needs a gain below −1:

    >>> from gains.pattern import Pattern, Plant
    >>> from gains.structured_lqr import Weights, stabilising_gain
    >>> gain = stabilising_gain(Plant([[1]], [[1]]), Pattern([[1]], (1,), (1,)), Weights([[1]], [[1]]))
    >>> bool(gain[0, 0] < -1)
    True
    """
    check_fits(plant, pattern)
    weights.check_fits(plant)
    full_spread = Weights(weights.Q + 1e-6 * np.eye(plant.states), weights.R, np.eye(plant.states))
    gain = np.zeros(pattern.mask.shape)
    cost = _Cost(plant, pattern.mask, full_spread)
    abscissa = cost.lyapunov(gain).abscissa
    shift = max(abscissa, 0.0) + max(1.0, float(np.linalg.norm(plant.A, 1)))
    for _ in range(_HOMOTOPY_ROUNDS):
        if abscissa < 0.0:
            return gain
        shift = abscissa + _HOMOTOPY_DISTANCE * (shift - abscissa)
        shifted = Plant(plant.A - shift * np.eye(plant.states), plant.B, plant.C)
        cost = _Cost(shifted, pattern.mask, full_spread)
        point = cost.at(gain)
        if point is None:
            break
        point = _descend(cost, point, 30, 1e-4)[0]
        gain = point.K
        abscissa = cost.lyapunov(gain).abscissa + shift
    raise InfeasibleError(
        f"no static gain with this pattern was found that stabilises: the best leaves a mode at {abscissa:.3g} 1/s; "
        "add links, or outputs, or give a stabilising start"
    )


def _descend(cost: _Cost, point: _Point, iterations: int, tolerance: float) -> tuple[_Point, float, list[float]]:
    """Quasi-Newton descent (L-BFGS) in the metric M; the last point, its decrement and all costs."""
    steps: list[tuple[FloatArray, FloatArray]] = []
    costs = [point.cost]
    while True:
        newton_like = cost.scaled(point, point.gradient)
        decrement = float(np.sum(point.gradient * newton_like)) / max(point.cost, 1e-300)
        if decrement <= tolerance or len(costs) > iterations:
            return point, decrement, costs
        direction = -_quasi_newton(point, steps, cost.scaled)
        if float(np.sum(direction * point.gradient)) >= 0.0:
            steps, direction = [], -newton_like
        following = _line_search(cost, point, direction)
        if following is None:
            if not steps:
                return point, decrement, costs
            steps = []
            continue
        step, change = following.K - point.K, following.gradient - point.gradient
        if float(np.sum(step * change)) > 0.0:
            steps = [*steps[1 - _MEMORY :], (step, change)]
        point = following
        costs.append(point.cost)


def _quasi_newton(
    point: _Point,
    steps: list[tuple[FloatArray, FloatArray]],
    scaled: Callable[[_Point, FloatArray], FloatArray],
) -> FloatArray:
    """Two-loop recursion of L-BFGS with M⁻¹ for the inverse Hessian at the far end (Nocedal and Wright, alg. 7.4)."""
    q = point.gradient.copy()
    factors: list[float] = []
    for step, change in reversed(steps):
        factors.append(float(np.sum(step * q) / np.sum(step * change)))
        q -= factors[-1] * change
    result = scaled(point, q)
    for (step, change), factor in zip(steps, reversed(factors), strict=True):
        result += (factor - float(np.sum(change * result) / np.sum(step * change))) * step
    return result


def _line_search(cost: _Cost, point: _Point, direction: FloatArray) -> _Point | None:
    """A stabilising point on the ray that meets the weak Wolfe conditions, by bisection; None if rounding hides it."""
    slope = float(np.sum(point.gradient * direction))
    low, high, length = 0.0, np.inf, 1.0
    best: _Point | None = None
    for _ in range(_LINE_STEPS):
        trial = cost.at(point.K + length * direction)
        if trial is None or trial.cost > point.cost + 1e-4 * length * slope:
            high = length
        elif float(np.sum(trial.gradient * direction)) < 0.9 * slope:
            low, best = length, trial
        else:
            return trial
        length = 2.0 * low if np.isinf(high) else (low + high) / 2.0
    return best


def _checked_weight(name: str, value: ArrayLike, *, definite: bool) -> FloatArray:
    matrix = real_matrix(name, value)
    if matrix.shape[0] != matrix.shape[1] or not np.allclose(matrix, matrix.T, rtol=1e-12, atol=0.0):
        raise BadModelError(f"{name} is not symmetric; a symmetric matrix is wanted")
    least, largest = float(np.linalg.eigvalsh(matrix)[0]), float(np.abs(matrix).max())
    if least < -1e-12 * largest or (definite and least <= 1e-14 * largest):
        wanted = "positive definite" if definite else "positive semidefinite"
        raise BadModelError(f"{name} has the eigenvalue {least:.3g}; a {wanted} matrix is wanted")
    return matrix
