"""The least value of an integer function of subsets, such as the rank of the chosen columns of a matrix.

A rank is submodular: a column raises the rank of a set by no more than that of any of its subsets. This is why
`gains.formation.fixed_modes` can find the least rank without trying all 2^m sets.
"""

from collections.abc import Callable

import numpy as np

from gains.core.arrays import FloatArray
from gains.core.errors import DisagreementError

SetFunction = Callable[[frozenset[int]], int]

_ROUNDS = 1000


def least_exhaustive(value_of: SetFunction, size: int) -> tuple[int, frozenset[int]]:
    """The least value of a function of subsets of range(size), and a set with that value, by trying all 2^size."""
    subsets = [frozenset(k for k in range(size) if code >> k & 1) for code in range(2**size)]
    return min(((value_of(subset), subset) for subset in subsets), key=lambda item: item[0])


def least_submodular(value_of: SetFunction, size: int) -> tuple[int, frozenset[int]]:
    """The least value of an integer submodular function of subsets of range(size), and a set with that value.

    Wolfe's algorithm approaches the point x of least norm in the base polytope of f − f(∅). Every x on the way proves
    the lower bound f(∅) + Σ min(x_k, 0), and every set on the way gives an upper bound. Values are integers, so a gap
    below one closes. (S. Fujishige, Submodular Functions and Optimization, 2nd ed. 2005, section 7.1.)

    Raises
    ------
    DisagreementError
        If the gap does not close: a rank that rounding decides need not be submodular.
    """
    empty = value_of(frozenset())
    best = (empty, frozenset[int]())

    def vertex(x: FloatArray) -> FloatArray:
        """The vertex of the base polytope least in the direction x (Edmonds' greedy algorithm)."""
        nonlocal best
        point, subset, value = np.zeros(size), frozenset[int](), empty
        for k in np.argsort(x, kind="stable").tolist():
            subset |= {k}
            next_value = value_of(subset)
            point[k], value = next_value - value, next_value
            best = min(best, (value, subset), key=lambda item: item[0])
        return point

    points = vertex(np.zeros(size))[np.newaxis]
    weights = np.ones(1)
    for _ in range(_ROUNDS):
        x = weights @ points
        if empty + np.minimum(x, 0.0).sum() > best[0] - 1 + 1e-6:
            return best
        points, weights = _nearest_to_origin(np.vstack([points, vertex(x)]), np.append(weights, 0.0))
    raise DisagreementError(
        f"the least rank is between {empty + np.minimum(weights @ points, 0.0).sum():.3f} and {best[0]}; the ranks are "
        "decided by rounding: scale the plant so that its entries are of like size"
    )


def _nearest_to_origin(points: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Wolfe's minor cycle: the points whose hull holds the point of least norm, and the weights of that point."""
    while True:
        count = len(points)
        # least norm in the affine hull, by Lagrange's conditions; least squares because points may be dependent
        system = np.block([[points @ points.T, np.ones((count, 1))], [np.ones((1, count)), np.zeros((1, 1))]])
        affine = np.linalg.lstsq(system, np.append(np.zeros(count), 1.0), rcond=None)[0][:count]
        if affine.min() > -1e-10:
            kept = affine > 1e-10
            return points[kept], affine[kept] / affine[kept].sum()
        outward = affine < weights - 1e-14
        outward &= affine < 1e-10
        step = float((weights[outward] / (weights[outward] - affine[outward])).min()) if outward.any() else 0.0
        weights = weights + min(step, 1.0) * (affine - weights)
        kept = weights > 1e-12
        if kept.all():
            kept[np.argmin(weights)] = False
        points, weights = points[kept], weights[kept] / weights[kept].sum()
