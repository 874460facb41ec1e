"""Splits a linear model into the blocks that really interact.

A leader-follower tree is block triangular. Its identical followers form one defective eigenvalue chain as long as
the tree is deep, and rounding spreads a defective eigenvalue of multiplicity N over a circle of radius eps^(1/N):
from about eight vehicles on, every method that looks at the whole matrix returns wrong verdicts. The strongly
connected components of the pattern are the diagonal blocks of the triangular form. The spectrum, with or without
delays, is the union of theirs, so each block is analysed on its own, and equal blocks once.
"""

import heapq
from collections.abc import Iterable
from dataclasses import dataclass
from math import log2

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gains.core.arrays import FloatArray, IntArray, RealArray
from gains.core.errors import BadModelError

# states up to which the components are found by squaring the pattern
_LARGEST_CLOSURE = 64


@dataclass(frozen=True)
class Block:
    """A diagonal block of the triangular form, which stands for all its equal copies.

    `indices` are the states of the first copy, `copies` the number of equal blocks, `matrices` the diagonal blocks of
    the given matrices, in their order.
    """

    indices: IntArray
    copies: int
    matrices: tuple[FloatArray, ...]


def square_matrices(**matrices: ArrayLike) -> list[FloatArray]:
    """The arguments as finite real square matrices of one size.

    Raises
    ------
    BadModelError
        Naming the matrix, what was read and what was wanted.
    """
    checked: list[FloatArray] = []
    size = None
    for name, value in matrices.items():
        matrix = real_matrix(name, value)
        if matrix.shape[0] != matrix.shape[1]:
            raise BadModelError(f"{name} has shape {matrix.shape}; a square matrix is wanted")
        size = matrix.shape[0] if size is None else size
        if matrix.shape[0] != size:
            raise BadModelError(f"{name} has shape {matrix.shape}; {size}x{size} is wanted, as the other matrices")
        checked.append(matrix)
    return checked


def real_matrix(name: str, value: ArrayLike) -> FloatArray:
    """`value` as a two-dimensional array of finite real numbers with at least one entry.

    Raises
    ------
    BadModelError
        Naming the matrix, what was read and what was wanted.
    """
    try:
        matrix = np.array(value)
    except ValueError as error:
        raise BadModelError(f"{name} is ragged; rows of equal length are wanted") from error
    if matrix.dtype.kind not in "fiub":
        raise BadModelError(f"{name} has entries of type {matrix.dtype}; real numbers are wanted")
    if matrix.ndim != 2 or matrix.size == 0:
        raise BadModelError(f"{name} has shape {matrix.shape}; a matrix with at least one row and column is wanted")
    if not np.isfinite(matrix).all():
        raise BadModelError(f"{name} has entries that are not finite; finite numbers are wanted")
    return matrix.astype(np.float64)


def strongly_connected_blocks(*matrices: RealArray) -> list[IntArray]:
    """Index sets of the strongly connected components of the union of the patterns of square matrices.

    State j drives state i where the entry (i, j) of any matrix is not exactly zero. The sets come drivers first, so
    that taking the states in this order makes every matrix block lower triangular; ties are broken by the lowest
    index. Indices within a set ascend.

    Examples
    --------
    x_1 and x_2 drive each other, x_0 drives both:

    >>> import numpy as np
    >>> from gains.core.structure import strongly_connected_blocks
    >>> [block.tolist() for block in strongly_connected_blocks(np.array([[-1, 0, 0], [1, 0, 1], [0, 1, 0]]))]
    [[0], [1, 2]]
    """
    pattern = np.any([matrix != 0.0 for matrix in matrices], axis=0)
    label = _labels_by_closure(pattern) if pattern.shape[0] <= _LARGEST_CLOSURE else _labels_by_graph(pattern)
    count = int(label.max()) + 1
    if count == 1:
        return [np.arange(label.size)]
    order = np.argsort(label, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
    driven, driver = np.nonzero(pattern & (label[:, np.newaxis] != label))
    edges = set(zip(label[driver].tolist(), label[driven].tolist(), strict=True))
    return [members[k] for k in _drivers_first([int(block[0]) for block in members], edges)]


def distinct_blocks(*matrices: RealArray) -> list[Block]:
    """The diagonal blocks of `strongly_connected_blocks`, equal ones listed once with the number of copies.

    Equal means equal to the last bit with the states in ascending order, as identical vehicles described one after
    the other are. 400 identical followers give one block.

    Examples
    --------
    A chain of three equal followers:

    >>> import numpy as np
    >>> from gains.core.structure import distinct_blocks
    >>> [block] = distinct_blocks(np.array([[-1, 0, 0], [1, -1, 0], [0, 1, -1]]))
    >>> block.copies, block.indices.tolist(), block.matrices[0].tolist()
    (3, [0], [[-1.0]])
    """
    first: dict[bytes, IntArray] = {}
    copies: dict[bytes, int] = {}
    for indices in strongly_connected_blocks(*matrices):
        rows = indices[:, np.newaxis]
        # + 0.0 turns -0.0 into 0.0, which is the same number in other bytes
        key = b"".join((matrix[rows, indices] + 0.0).tobytes() for matrix in matrices)
        first.setdefault(key, indices)
        copies[key] = copies.get(key, 0) + 1
    return [
        Block(
            indices=indices,
            copies=copies[key],
            matrices=tuple(matrix[np.ix_(indices, indices)].astype(np.float64) for matrix in matrices),
        )
        for key, indices in first.items()
    ]


def project_out_equilibria(*matrices: ArrayLike) -> tuple[FloatArray, ...]:
    """The matrices without the directions along which nothing ever acts: a consensus without its common value.

    Directions v with A_k v = 0 for every k (or, for conserved quantities, w'A_k = 0) carry a root of
    det(sI - A_0 - A_1 e^{-s tau} - ...) at s = 0 for every delay. An orthonormal basis whose first columns span them
    makes all matrices block triangular; the remaining diagonal block is returned, repeatedly until no such direction
    is left (a formation at constant velocity has two, one after the other). All other roots are kept.

    Raises
    ------
    BadModelError
        The matrices are not square, finite and of one size, or nothing but equilibria is left.

    Examples
    --------
    x_1' = x_2 - x_1, x_2' = x_1 - x_2: the difference decays like e^{-2t}.

    >>> from gains.core.structure import project_out_equilibria
    >>> [difference] = project_out_equilibria([[-1, 1], [1, -1]])
    >>> difference.round(6).tolist()
    [[-2.0]]
    """
    left = list(balanced(*square_matrices(**{f"A{k}": matrix for k, matrix in enumerate(matrices)})))
    while True:
        basis = _complement_of_common_kernel(left)
        if basis.shape[1] == left[0].shape[0]:
            basis = _complement_of_common_kernel([matrix.T for matrix in left])
        if basis.shape[1] == left[0].shape[0]:
            return tuple(left)
        if basis.shape[1] == 0:
            raise BadModelError("the matrices have nothing but equilibria; at least one moving state is wanted")
        left = [_projected(matrix, basis) for matrix in left]


def without_equilibria(*matrices: ArrayLike) -> tuple[tuple[FloatArray, ...], int]:
    """The matrices after `project_out_equilibria` in each strongly connected block, and the number of states removed.

    The blocks are put side by side, which keeps the spectrum. A block in which nothing moves at all (an integrator
    that nobody feeds back) stays as it is.

    Raises
    ------
    BadModelError
        The matrices are not square, finite and of one size.

    Examples
    --------
    A consensus of two vehicles beside a loop of its own:

    >>> from gains.core.structure import without_equilibria
    >>> [moving], taken_out = without_equilibria([[-1, 1, 0], [1, -1, 0], [0, 0, -3]])
    >>> moving.round(6).tolist(), taken_out
    ([[-2.0, 0.0], [0.0, -3.0]], 1)
    """
    checked = square_matrices(**{f"A{k}": matrix for k, matrix in enumerate(matrices)})
    size = checked[0].shape[0]
    kept = [np.zeros((size, size)) for _ in checked]
    filled = 0
    for indices in strongly_connected_blocks(*checked):
        block = [matrix[np.ix_(indices, indices)] for matrix in checked]
        if any(matrix.any() for matrix in block):
            block = _moving_part(block)
        place = slice(filled, filled + block[0].shape[0])
        for target, matrix in zip(kept, block, strict=True):
            target[place, place] = matrix
        filled = place.stop
    if filled == size:
        # with the couplings between blocks, which a reader of the matrices expects
        return tuple(checked), 0
    return tuple(matrix[:filled, :filled] for matrix in kept), size - filled


def balanced(*matrices: FloatArray) -> tuple[FloatArray, ...]:
    """The matrices after one diagonal similarity by powers of two that evens out rows and columns of sum |A_k|.

    Units as unlike as rad and W make norms, and every tolerance relative to them, say little about the dynamics.
    Powers of two make the similarity exact.
    """
    weight = np.sum([np.abs(matrix) for matrix in matrices], axis=0)
    np.fill_diagonal(weight, 0.0)
    size = weight.shape[0]
    exponent = np.zeros(size)
    for _ in range(20):
        settled = True
        for i in range(size):
            column, row = float(weight[:, i].sum()), float(weight[i].sum())
            if column == 0.0 or row == 0.0:
                continue
            step = round(log2(row / column) / 2.0)
            if step != 0:
                settled = False
                exponent[i] += step
                weight[:, i] *= 2.0**step
                weight[i] *= 2.0**-step
        if settled:
            break
    if not exponent.any():
        return matrices
    scale = np.exp2(exponent)
    return tuple(matrix * scale / scale[:, np.newaxis] for matrix in matrices)


def is_singular_for_any_delay(matrices: Iterable[FloatArray] | FloatArray) -> bool:
    """Whether the sum of the matrices is singular to rounding: s = 0 is then a root however late each one acts.

    Each row is judged in its own unit, so a motion that is merely slow beside others does not count as a standstill.

    Examples
    --------
    x'(t) = -x(t) + x(t - tau) stays where it is; a slow decay beside a fast one does not:

    >>> import numpy as np
    >>> from gains.core.structure import is_singular_for_any_delay
    >>> is_singular_for_any_delay([np.array([[-1]]), np.array([[1]])])
    True
    >>> is_singular_for_any_delay([np.diag([-1e9, -1e-9])])
    False
    """
    stacked = np.array(list(matrices))
    size = np.linalg.norm(stacked, axis=(0, 2))
    total = stacked.sum(axis=0) / np.where(size > 0.0, size, 1.0)[:, np.newaxis]
    return bool(np.linalg.svd(total, compute_uv=False)[-1] < 2e-15 * len(size))


def _complement_of_common_kernel(matrices: list[FloatArray]) -> FloatArray:
    """Orthonormal basis (n, n - k) of the complement of the k-dimensional common kernel of the matrices."""
    stacked = np.vstack(matrices)
    size = np.linalg.norm(stacked, axis=1, keepdims=True)
    # each row in its own unit, as above
    _, singular, rows = np.linalg.svd(stacked / np.where(size > 0.0, size, 1.0))
    # a kernel known to rounding shows at a few eps
    rank = int(np.count_nonzero(singular > 1e-12 * singular[0]))
    return rows[:rank].T


def _projected(matrix: FloatArray, basis: FloatArray) -> FloatArray:
    """The matrix in the coordinates of an orthonormal basis, with what rounding leaves of zeros set to zero."""
    projected = basis.T @ matrix @ basis
    return np.where(np.abs(projected) > 1e-14 * np.abs(matrix).max(), projected, 0.0)


def _moving_part(block: list[FloatArray]) -> list[FloatArray]:
    """`project_out_equilibria`, or the block itself if it has none or nothing else."""
    try:
        return list(project_out_equilibria(*block))
    except BadModelError:
        return block


def _labels_by_closure(pattern: NDArray[np.bool_]) -> IntArray:
    """Component number of each state, from who reaches whom: quick for small models, without the graph library."""
    size = pattern.shape[0]
    reach = pattern | np.eye(size, dtype=bool)
    # paths double in length with every squaring
    for _ in range((size - 1).bit_length()):
        reach = (reach.astype(np.float64) @ reach) > 0.0
    # the lowest state of each component stands for it
    lowest = np.argmax(reach & reach.T, axis=1)
    return np.unique(lowest, return_inverse=True)[1]


def _labels_by_graph(pattern: NDArray[np.bool_]) -> IntArray:
    # its import costs more than the analysis of a small model
    from scipy.sparse import csgraph, csr_array

    return csgraph.connected_components(csr_array(pattern), directed=True, connection="strong")[1]


def _drivers_first(lowest_index: list[int], edges: Iterable[tuple[int, int]]) -> list[int]:
    """Topological order of components (Kahn's algorithm), the component of the lowest state index first in a tie."""
    followers: dict[int, list[int]] = {}
    waiting = [0] * len(lowest_index)
    for driver, driven in edges:
        followers.setdefault(driver, []).append(driven)
        waiting[driven] += 1
    ready = [(lowest_index[k], k) for k, drivers in enumerate(waiting) if drivers == 0]
    heapq.heapify(ready)
    order: list[int] = []
    while ready:
        _, component = heapq.heappop(ready)
        order.append(component)
        for driven in followers.get(component, []):
            waiting[driven] -= 1
            if waiting[driven] == 0:
                heapq.heappush(ready, (lowest_index[driven], driven))
    assert len(order) == len(lowest_index), "components of a graph cannot form a cycle"
    return order
