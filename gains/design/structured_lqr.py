"""Linear quadratic gains with a given information pattern, to first-order optimality.

The gradient of the cost J(K) of `gains.design.lqr` is exact and is projected on the pattern. J grows without bound
towards the boundary of the stabilising gains, so a descent never leaves them. It finds a local minimum; the centralised
optimum, in which every input uses all states, bounds how much better any other gain could be.

Source: Sahoo 2012 (see `gains.formation.model`), section 4, eq. (4.5), solved there by other means.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.errors import InfeasibleError, SolverError
from gains.design.lqr import Cost, CostPoint, Weights, centralised_lqr
from gains.formation.pattern import Pattern, Plant, check_fits

# The decrement g'M⁻¹g / J estimates the remaining reduction of the cost, relative. Costs are known to about 1e-13.
_DECREMENT = 1e-13
# a line search that fails above this decrement is an error; below it, rounding has stopped the search
_DECREMENT_ACCEPTED = 1e-9
_ITERATIONS = 2000
_MEMORY = 20
_LINE_STEPS = 50
_HOMOTOPY_ROUNDS = 200
# share of the distance to the stability boundary that the homotopy keeps
_HOMOTOPY_DISTANCE = 0.1
# random starts for the descent of the abscissa; of the three-vehicle patterns that a static gain stabilises but the
# homotopy does not, the hardest takes 22
_ABSCISSA_STARTS = 60
# share of the norm of A; a negative abscissa closer to zero may be rounding of a defective eigenvalue
_CLEARLY_STABLE = 1e-4


@dataclass(frozen=True, eq=False)
class StructuredLqr:
    """A gain with the pattern at which the cost is stationary, and lower than at the start.

    `cost` is J(K); `cost_centralised` is the least cost of any gain on the full state, a lower bound on J.
    """

    K: FloatArray
    cost: float
    cost_centralised: float

    @property
    def loss(self) -> float:
        """Relative excess of the cost over the centralised one: 0.1 is 10 %."""
        return self.cost / self.cost_centralised - 1.0


def structured_lqr(plant: Plant, pattern: Pattern, weights: Weights) -> StructuredLqr:
    """Return a gain with the pattern at which the quadratic cost has a local minimum.

    The descent starts from `stabilising_gain`. 50 vehicles on one axis (99 states) take a few seconds. Raises
    BadModelError if sizes do not fit, InfeasibleError if no stabilising gain is found, and SolverError if the descent
    ends at a point where the cost is not stationary.
    """
    start = stabilising_gain(plant, pattern, weights)
    cost = Cost(plant, pattern.mask, weights)
    first = cost.at(start)
    if first is None:
        raise SolverError(
            f"the start is too near its limit of stability: its rightmost eigenvalue has real part "
            f"{cost.lyapunov(start).abscissa:.3g} 1/s; scale states and inputs to like size"
        )
    point, decrement, iterations = _descend(cost, first, _ITERATIONS, _DECREMENT)
    if decrement > _DECREMENT_ACCEPTED:
        raise SolverError(
            f"the descent ended after {iterations} iterations with decrement {decrement:.3g} (wanted "
            f"{_DECREMENT_ACCEPTED}): scale states and inputs to like size"
        )
    return StructuredLqr(point.K, point.cost, centralised_lqr(plant, weights)[1])


def stabilising_gain(plant: Plant, pattern: Pattern, weights: Weights) -> FloatArray:
    """Return a stabilising gain with the pattern, found from K = 0 by a homotopy, or from random gains.

    A − σI is stable for large σ. A few descent steps on its cost give a gain that also stabilises a smaller σ; σ is
    then lowered almost that far, until it is 0. If that ends at σ > 0, as in patterns in which vehicles steer only each
    other, the real part of the rightmost eigenvalue itself is lowered, from seeded random gains. InfeasibleError if no
    gain is found. Deciding whether a static gain stabilises is NP-hard, so one may still exist, but not if
    `gains.formation.fixed_modes` finds an unstable mode.
    """
    check_fits(plant, pattern)
    weights = weights.fitting(plant)
    observable = Weights(weights.Q + 1e-6 * np.eye(plant.states), weights.R)
    gain = np.zeros(pattern.mask.shape)
    cost = Cost(plant, pattern.mask, observable)
    abscissa = cost.lyapunov(gain).abscissa
    shift = max(abscissa, 0.0) + max(1.0, float(np.linalg.norm(plant.A, 1)))
    for _ in range(_HOMOTOPY_ROUNDS):
        if abscissa < 0.0:
            return gain
        shift = abscissa + _HOMOTOPY_DISTANCE * (shift - abscissa)
        shifted = Plant(plant.A - shift * np.eye(plant.states), plant.B, plant.C)
        cost = Cost(shifted, pattern.mask, observable)
        point = cost.at(gain)
        if point is None:
            break
        point = _descend(cost, point, 30, 1e-4)[0]
        gain = point.K
        abscissa = cost.lyapunov(gain).abscissa + shift
    gain, found = _gain_of_least_abscissa(plant, pattern)
    if found < 0.0:
        return gain
    raise InfeasibleError(
        f"no static gain with this pattern was found that stabilises: the best leaves a mode at "
        f"{min(abscissa, found):.3g} 1/s; add links or outputs"
    )


def _gain_of_least_abscissa(plant: Plant, pattern: Pattern) -> tuple[FloatArray, float]:
    """The first gain that stabilises by more than rounding, otherwise the best, with its abscissa (1/s).

    The abscissa is lowered by quasi-Newton descent. Its derivative for an eigenvalue with left and right vectors w, v
    is Re w B dK C v / w v. It is not smooth where eigenvalues meet and has many local minima, hence many starts.
    """
    from scipy import optimize

    minimize: Any = optimize.minimize
    mask = pattern.mask
    rng = np.random.default_rng(0)
    scale = max(float(np.linalg.norm(plant.A, 2)), 1e-300)
    best, least = np.zeros(mask.shape), np.inf

    def gain(entries: FloatArray) -> FloatArray:
        K = np.zeros(mask.shape)
        K[mask] = entries
        return K

    def abscissa(entries: FloatArray) -> tuple[float, FloatArray]:
        roots, right = np.linalg.eig(plant.closed_loop(gain(entries)))
        real_parts = np.real(roots)
        at = int(np.argmax(real_parts))
        left = np.linalg.pinv(right)[at]
        slope = np.real(np.outer(left @ plant.B, plant.C @ right[:, at]))
        return float(real_parts[at]), slope[mask].astype(np.float64)

    for _ in range(_ABSCISSA_STARTS):
        start = scale * rng.normal(size=int(mask.sum())) * 10.0 ** rng.uniform(-1.0, 1.0)
        found = minimize(abscissa, start, jac=True, method="BFGS", options={"maxiter": 200})
        if found.fun < least:
            best, least = gain(found.x), float(found.fun)
        if least < -_CLEARLY_STABLE * scale:
            return best, least
    return best, max(least, 0.0)


def _descend(cost: Cost, point: CostPoint, most: int, tolerance: float) -> tuple[CostPoint, float, int]:
    """Quasi-Newton descent (L-BFGS) in the metric M: returns the last point, its decrement, the iteration count."""
    steps: list[tuple[FloatArray, FloatArray]] = []
    iterations = 0
    while True:
        newton_like = cost.scaled(point, point.gradient)
        decrement = float(np.sum(point.gradient * newton_like)) / max(point.cost, 1e-300)
        if decrement <= tolerance or iterations >= most:
            return point, decrement, iterations
        direction = -_quasi_newton(point, steps, cost.scaled)
        if float(np.sum(direction * point.gradient)) >= 0.0:
            steps, direction = [], -newton_like
        following = _line_search(cost, point, direction)
        if following is None:
            if not steps:
                return point, decrement, iterations
            steps = []
            continue
        step, change = following.K - point.K, following.gradient - point.gradient
        if float(np.sum(step * change)) > 0.0:
            steps = [*steps[1 - _MEMORY :], (step, change)]
        point = following
        iterations += 1


def _quasi_newton(
    point: CostPoint, steps: list[tuple[FloatArray, FloatArray]], scaled: Callable[[CostPoint, FloatArray], FloatArray]
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


def _line_search(cost: Cost, point: CostPoint, direction: FloatArray) -> CostPoint | None:
    """A stabilising point on the ray that meets the weak Wolfe conditions, by bisection; None if rounding prevents."""
    slope = float(np.sum(point.gradient * direction))
    low, high, length = 0.0, np.inf, 1.0
    best: CostPoint | None = None
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
