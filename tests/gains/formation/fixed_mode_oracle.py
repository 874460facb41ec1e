"""An oracle for fixed modes by rank, which shares no gain with `gains.formation.fixed_modes`.

λ is a fixed mode of one strongly connected component of plant and pattern, with n states, if and only if the inputs can
be split into two sets D and E such that, with C_E the outputs that the inputs in E use,

    rank [[A − λI, B_D], [C_E, 0]] < n                                                              (1)

Source: B. D. O. Anderson and D. J. Clements, "Algebraic characterization of fixed modes in decentralized control",
Automatica 17 (1981), 703-712.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from gains.core.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from gains.core.structure import strongly_connected_blocks
from gains.formation.fixed_modes import distinct_modes
from gains.formation.pattern import Pattern, Plant

# up to this many inputs in one component, all subsets are tried (256 ranks); beyond, Wolfe's algorithm is used
_LARGEST_EXHAUSTIVE = 8
# singular values below this share of the largest are zero: rounding is 1e-15, and what a gain moves is far larger
_RANK_TOLERANCE = 1e-10
# rounds of Wolfe's algorithm
_ROUNDS = 1000

SetFunction = Callable[[frozenset[int]], int]


class NearlyFixedError(Exception):
    """Rounding decides the ranks."""


@dataclass(frozen=True, eq=False)
class _Component:
    """One diagonal block of the closed loop: the inputs that act on it and, for each, the rows of C it uses."""

    states: IntArray
    A: FloatArray
    B: tuple[FloatArray, ...]
    C: FloatArray
    rows: tuple[BoolArray, ...]


def fixed_by_rank(plant: Plant, pattern: Pattern) -> dict[complex, tuple[int, ...]]:
    """The fixed modes of a pattern, and the states of the components in which each is fixed."""
    found: dict[complex, set[int]] = {}
    for component in _components(plant, pattern):
        for mode in distinct_modes(component.A):
            if _least_rank(component, mode) < component.states.size:
                found.setdefault(mode, set()).update(component.states.tolist())
    return {mode: tuple(sorted(states)) for mode, states in found.items()}


def _components(plant: Plant, pattern: Pattern) -> list[_Component]:
    feedback = (plant.B != 0.0).astype(float) @ pattern.mask.astype(float) @ (plant.C != 0.0).astype(float)
    found: list[_Component] = []
    for states in strongly_connected_blocks(plant.A, feedback):
        B = [plant.B[states, pattern.input_slice(i)] for i in range(len(pattern.input_sizes))]
        C = plant.C[:, states]
        inputs = [i for i, block in enumerate(B) if block.any()]
        rows = tuple(np.repeat(pattern.blocks[i], pattern.output_sizes) & C.any(axis=1) for i in inputs)
        found.append(_Component(states, plant.A[np.ix_(states, states)], tuple(B[i] for i in inputs), C, rows))
    return found


def _least_rank(component: _Component, mode: complex) -> int:
    """Least rank of (1) over all D."""
    n = component.states.size
    shifted = component.A - mode * np.eye(n)
    left, singular, right = np.linalg.svd(shifted)
    kept = int(np.count_nonzero(singular > _RANK_TOLERANCE * max(float(singular[0]), 1e-300)))
    # eliminating the regular part of A − λI once leaves a small matrix for every D:
    # rank (1) = rank(A − λI) + rank [[0, M B_D], [C_E N, −C_E (A − λI)⁺ B_D]]
    inverse = (right[:kept].conj().T / singular[:kept]) @ left[:, :kept].conj().T
    M, N = left[:, kept:].conj().T, right[kept:].conj().T
    B = [block * (_size(shifted) / _size(block)) for block in component.B]
    C = component.C * (_size(shifted) / _size(component.C))
    moved, through = [M @ block for block in B], [-C @ inverse @ block for block in B]
    seen = C @ N

    def rank(cut: frozenset[int]) -> int:
        others = [rows for k, rows in enumerate(component.rows) if k not in cut]
        rows = np.any(others, axis=0) if others else np.zeros(C.shape[0], dtype=bool)
        acting = sorted(cut)
        below = np.hstack([seen[rows], *(through[k][rows] for k in acting)])
        above = np.hstack([np.zeros((n - kept, n - kept)), *(moved[k] for k in acting)])
        return kept + _rank(np.vstack([above, below]), _size(shifted))

    size = len(component.B)
    if size > _LARGEST_EXHAUSTIVE:
        return least_submodular(rank, size)
    return min(rank(frozenset(k for k in range(size) if code >> k & 1)) for code in range(2**size))


def _rank(matrix: FloatArray | ComplexArray, scale: float = 1.0) -> int:
    """Rank of a matrix whose entries are either rounding or of the order of the scale."""
    if matrix.size == 0:
        return 0
    singular = np.linalg.svd(matrix, compute_uv=False)
    return int(np.count_nonzero(singular > _RANK_TOLERANCE * max(scale, float(singular[0]))))


def _size(matrix: FloatArray | ComplexArray) -> float:
    """Largest absolute entry, or 1 if there is none: a scale to divide by."""
    largest = float(np.abs(matrix).max()) if matrix.size else 0.0
    return largest if largest > 0.0 else 1.0


def least_submodular(value_of: SetFunction, size: int) -> int:
    """The least value of an integer submodular function of subsets of range(size).

    A rank is submodular: a column raises the rank of a set by no more than that of any of its subsets. Wolfe's
    algorithm approaches the point x of least norm in the base polytope of f − f(∅). Every x on the way proves the lower
    bound f(∅) + Σ min(x_k, 0), and every set on the way gives an upper bound. Values are integers, so a gap below one
    closes; a rank that rounding decides need not be submodular. (S. Fujishige, Submodular Functions and Optimization,
    2nd ed. 2005, section 7.1.)
    """
    best = empty = value_of(frozenset())

    def vertex(x: FloatArray) -> FloatArray:
        """The vertex of the base polytope least in the direction x (Edmonds' greedy algorithm)."""
        nonlocal best
        point, subset, value = np.zeros(size), frozenset[int](), empty
        for k in np.argsort(x, kind="stable").tolist():
            subset |= {k}
            next_value = value_of(subset)
            point[k], value = next_value - value, next_value
            best = min(best, value)
        return point

    points = vertex(np.zeros(size))[np.newaxis]
    weights = np.ones(1)
    for _ in range(_ROUNDS):
        x = weights @ points
        if empty + np.minimum(x, 0.0).sum() > best - 1 + 1e-6:
            return best
        points = np.vstack([points, vertex(x)])
        # the point of least norm in the hull of the points, as a problem of nonnegative least squares
        weights = nnls(np.vstack([points.T, np.ones(len(points))]), np.append(np.zeros(size), 1.0))[0]
        points, weights = points[weights > 0.0], weights[weights > 0.0] / weights.sum()
    raise NearlyFixedError(
        f"the least rank is between {empty + np.minimum(weights @ points, 0.0).sum():.3f} and {best}; the ranks are "
        "decided by rounding"
    )
