"""Minimisation of functions with kinks by evolution of a normal distribution (CMA-ES).

The search compares points and takes no derivatives: a peak over frequencies, a rightmost root or an active limit has
none at the optimum. Draws are seeded, so the same search finds the same point.

Source: N. Hansen, "The CMA Evolution Strategy: A Tutorial", arXiv:1604.00772, with its default constants.
"""

from collections.abc import Callable, Iterable, Sequence
from heapq import heapify, heappop, heapreplace

import numpy as np

from gains.core.arrays import FloatArray

# the search ends when the standard deviation of the draws along their longest axis falls below this
_RESOLUTION = 1e-7

Rank = tuple[float, float]
"""Merit of a point, the smaller the better: how far it violates the constraints (0 if all hold), then its cost."""
Bounds = Callable[[FloatArray], Iterable[Rank]]
"""Lower bounds on the rank of a point, computed one by one as they are read; the largest is the rank."""


def first_of(bounds: Bounds, points: Sequence[FloatArray], count: int) -> list[tuple[Rank, int]]:
    """The ranks and indices of the best `count` points, best first; bounds of the others are read only until they lose.

    >>> first_of(lambda x: [(0.0, 0.0), (0.0, float(x[0]))], [np.array([3.0]), np.array([2.0])], 1)
    [((0.0, 2.0), 1)]
    """
    found: list[tuple[Rank, int]] = []
    left = [iter(bounds(point)) for point in points]
    lowest = [(next(each), k) for k, each in enumerate(left)]
    heapify(lowest)
    while len(found) < count:
        rank, k = lowest[0]
        if (bound := next(left[k], None)) is None:  # it was exact, and no bound of the others is lower
            found.append(heappop(lowest))
        else:
            heapreplace(lowest, (max(rank, bound), k))
    return found


def best_of(bounds: Bounds, start: FloatArray, *, step: float, evaluations: int) -> tuple[FloatArray, Rank]:
    """Return the best point found from `start` (n,) and its rank.

    `step` is the standard deviation of the first draws along every axis. About `evaluations` points are compared,
    fewer if the draws contract sooner.

    >>> point, _ = best_of(lambda x: [(0.0, abs(x[0] - 1.0) + abs(x[1]))], np.zeros(2), step=0.5, evaluations=600)
    >>> (point**2).round(3).tolist()
    [1.0, 0.0]
    """
    n = start.size
    population = 4 + int(3 * np.log(n))
    parents = population // 2
    weights = np.log((population + 1) / 2) - np.log(np.arange(1, parents + 1))
    weights /= weights.sum()
    mass = 1.0 / float((weights**2).sum())
    c_sigma = (mass + 2) / (n + mass + 5)
    damping = 1 + 2 * max(0.0, ((mass - 1) / (n + 1)) ** 0.5 - 1) + c_sigma
    c_path = (4 + mass / n) / (n + 4 + 2 * mass / n)
    c_one = 2 / ((n + 1.3) ** 2 + mass)
    c_many = min(1 - c_one, 2 * (mass - 2 + 1 / mass) / ((n + 2) ** 2 + mass))
    usual = n**0.5 * (1 - 1 / (4 * n) + 1 / (21 * n * n))

    rng = np.random.default_rng(0)
    mean, covariance, sigma = start.astype(np.float64), np.eye(n), step
    path, sigma_path = np.zeros(n), np.zeros(n)
    best = mean, first_of(bounds, [mean], 1)[0][0]
    for turn in range(max(1, evaluations // population)):
        values, axes = np.linalg.eigh((covariance + covariance.T) / 2)
        lengths = np.sqrt(values.clip(min=1e-20))
        if sigma * float(lengths.max()) < _RESOLUTION:
            break
        draws = rng.standard_normal((population, n)) * lengths @ axes.T
        points = mean + sigma * draws
        first = first_of(bounds, [*points], parents)
        (rank, k), *_ = first
        if rank < best[1]:
            best = points[k], rank
        chosen = draws[[k for _, k in first]]
        shift = weights @ chosen
        mean = mean + sigma * shift
        sigma_path = (1 - c_sigma) * sigma_path + (c_sigma * (2 - c_sigma) * mass) ** 0.5 * (
            axes @ ((axes.T @ shift) / lengths)
        )
        length = float(np.linalg.norm(sigma_path))
        steady = length / (1 - (1 - c_sigma) ** (2 * turn + 2)) ** 0.5 < (1.4 + 2 / (n + 1)) * usual
        path = (1 - c_path) * path + steady * (c_path * (2 - c_path) * mass) ** 0.5 * shift
        kept = 1 - c_one - c_many + (0.0 if steady else c_one * c_path * (2 - c_path))
        covariance = kept * covariance + c_one * np.outer(path, path) + c_many * (chosen.T * weights) @ chosen
        sigma *= float(np.exp(min(1.0, c_sigma / damping * (length / usual - 1))))
    return best
