"""Splitting of a linear model into its blocks of interacting states.

A leader-follower tree is block triangular. Its identical followers share one defective eigenvalue, whose multiplicity
N is the depth of the tree, and rounding spreads it over a circle of radius eps^(1/N): from about eight vehicles on,
every method that works on the whole matrix returns wrong verdicts. The strongly connected components of the pattern of
nonzero entries are the diagonal blocks of the triangular form. The spectrum, with or without delays, is the union of
their spectra, so each block is analysed on its own, and equal blocks only once.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import inf, log2
from numbers import Real
from sys import float_info
from typing import TypeGuard, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import ComplexArray, FloatArray, IntArray, RealArray
from gains.core.errors import BadModelError

# longer texts are truncated in messages
_SHOWN = 60

_Any = TypeVar("_Any")


@dataclass(frozen=True)
class Block:
    """A diagonal block of the triangular form, standing for `copies` equal ones.

    `matrices` holds this block (n, n) of each of the given matrices, in their order.
    """

    copies: int
    matrices: tuple[FloatArray, ...]


def square_matrices(**matrices: ArrayLike) -> list[FloatArray]:
    """The arguments as finite real square matrices of one size; BadModelError names the one that is not."""
    checked: list[FloatArray] = []
    for name, value in matrices.items():
        matrix = real_matrix(name, value)
        if matrix.shape[0] != matrix.shape[1]:
            raise BadModelError(f"{name} has shape {matrix.shape}; a square matrix is wanted")
        checked.append(matrix)
        size = len(checked[0])
        if len(matrix) != size:
            raise BadModelError(f"{name} has shape {matrix.shape}; {size}x{size} is wanted, to match the others")
    return checked


def real_matrix(name: str, value: ArrayLike) -> FloatArray:
    """`value` as a matrix of finite real numbers with at least one entry; BadModelError names it otherwise."""
    try:
        matrix = np.array(value)  # a copy: the caller may change what it passed
    except (OverflowError, ValueError) as error:
        raise BadModelError(f"{name} is ragged; rows of equal length are wanted") from error
    if matrix.dtype.kind not in "fiub":
        raise BadModelError(f"{name} has entries of type {matrix.dtype}; real numbers are wanted")
    if matrix.ndim != 2 or matrix.size == 0:
        raise BadModelError(f"{name} has shape {matrix.shape}; a matrix with at least one row and column is wanted")
    if not np.isfinite(matrix).all():
        raise BadModelError(f"{name} has entries that are not finite; finite numbers are wanted")
    return matrix.astype(np.float64, copy=False)


def positive_seconds(name: str, value: float) -> float:
    """`value` if it is positive and finite; BadModelError names it otherwise."""
    return positive_number(name, value, "number of seconds")


def positive_number(name: str, value: float, what: str = "number") -> float:
    """`value` if it is positive and finite; otherwise BadModelError says that a positive `what` is wanted."""
    if not (is_number(value) and 0.0 < value < inf):
        raise BadModelError(f"{name} is {shown(value)}; a positive {what} is wanted")
    return float(value)


def seconds(name: str, value: float) -> float:
    """`value` if it is finite and not negative; BadModelError names it otherwise."""
    if not (is_number(value) and 0.0 <= value < inf):
        raise BadModelError(f"{name} is {shown(value)}; a number of seconds >= 0 is wanted")
    return float(value)


def is_number(value: object) -> TypeGuard[float]:
    """Whether `value` is a real number that a float can hold, perhaps infinite, but not nan.

    >>> [is_number(value) for value in (2, float("inf"), 10**400, float("nan"), "2", None, [2.0])]
    [True, True, False, False, False, False, False]
    """
    return isinstance(value, Real) and (abs(value) <= float_info.max or abs(value) == inf)  # type: ignore[operator]


def of_type(name: str, value: _Any, *kinds: type) -> _Any:
    """`value` if it is of one of the kinds; BadModelError says what was read and which is wanted.

    >>> of_type("assumed_s", 0.1, int, float)
    0.1
    """
    if not isinstance(value, kinds):
        raise BadModelError(f"{name} is {shown(value)}; a {' or '.join(kind.__name__ for kind in kinds)} is wanted")
    return value


def shown(value: object) -> str:
    """The value in one short line, for a message.

    >>> shown(0.1), shown("0.1"), shown(np.zeros((2, 1)))
    ('0.1', "'0.1'", 'array([[0.], [0.]])')
    """
    text = " ".join((str(value) if isinstance(value, Real) else repr(value)).split())
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def strongly_connected_blocks(*matrices: RealArray) -> list[IntArray]:
    """Index sets of the strongly connected components of the union of the patterns of square matrices.

    State j drives state i if the entry (i, j) of any matrix is not exactly zero. Sets are ordered with drivers first:
    in this order of states every matrix is block lower triangular. Indices within a set ascend.

    x_1 and x_2 drive each other, x_0 drives x_1:

    >>> [block.tolist() for block in strongly_connected_blocks(np.array([[-1, 0, 0], [1, 0, 1], [0, 1, 0]]))]
    [[0], [1, 2]]
    """
    pattern = matrices[0] != 0.0
    for matrix in matrices[1:]:
        pattern |= matrix != 0.0
    np.fill_diagonal(pattern, True)  # a state is connected to itself
    return [*_blocks_of_pattern(len(pattern), pattern.tobytes())]


@lru_cache(maxsize=8)
def _blocks_of_pattern(size: int, content: bytes) -> list[IntArray]:
    """`strongly_connected_blocks` of a pattern: a search asks for many loops of the same pattern."""
    pattern = np.frombuffer(content, dtype=np.bool_).reshape(size, size)
    # shortcut for dense loops: every state drives the first one and is driven by it
    if bool(pattern[0].all() and pattern[:, 0].all()):
        return [np.arange(len(pattern))]
    driven, driver = np.nonzero(pattern)
    label = _components(len(pattern), driven, driver)
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


def distinct_blocks(*matrices: RealArray) -> list[Block]:
    """The diagonal blocks of `strongly_connected_blocks`, equal ones listed once with the number of copies.

    Two blocks are equal if they agree to the last bit with the states in ascending order. 400 identical followers,
    described one after the other, give one block.
    """
    blocks = strongly_connected_blocks(*matrices)
    if len(blocks) == 1:
        return [Block(1, tuple(matrix.astype(np.float64, order="C") for matrix in matrices))]
    first: dict[bytes, IntArray] = {}
    copies: dict[bytes, int] = {}
    for indices in blocks:
        rows = indices[:, np.newaxis]
        # + 0.0 turns -0.0 into 0.0: the same number, but different bytes
        key = b"".join((matrix[rows, indices] + 0.0).tobytes() for matrix in matrices)
        first.setdefault(key, indices)
        copies[key] = copies.get(key, 0) + 1
    return [
        Block(copies[key], tuple(matrix[np.ix_(indices, indices)].astype(np.float64) for matrix in matrices))
        for key, indices in first.items()
    ]


def roots_of(A: FloatArray) -> ComplexArray:
    """Return the eigenvalues of A (n, n), those of equal strongly connected blocks once.

    Computed from the whole matrix, the eigenvalues of equal followers would spoil each other.

    >>> roots_of(np.diag([-1.0, -1.0, -2.0])).real.tolist()
    [-1.0, -2.0]
    """
    blocks = distinct_blocks(A)
    return np.concatenate([np.linalg.eigvals(block.matrices[0]) for block in blocks]).astype(np.complex128)


def without_fixed_roots(*matrices: ArrayLike) -> tuple[tuple[FloatArray, ...], int]:
    """The matrices without the directions along which nothing ever acts, and the number of states removed.

    A consensus loses its common value; a formation at constant velocity loses its position, then its velocity. A
    direction v with A_k v = 0 for every k (or w with w'A_k = 0, a conserved quantity) carries a root at s = 0 of
    det(sI - A_0 - A_1 e^{-s tau} - ...) at every delay. Such directions are split off by an orthonormal basis, in each
    strongly connected block, until none is left; all other roots stay. A motion split off after another, such as that
    velocity, may drive it: the position then grows with time. A block with no other motion (an integrator without
    feedback) stays as it is. BadModelError unless the matrices are square, finite and of one size.
    """
    checked = square_matrices(**{f"A{k}": matrix for k, matrix in enumerate(matrices)})
    moving = [(block.copies, _moving_part(list(block.matrices))) for block in distinct_blocks(*checked)]
    left = sum(copies * len(part[0]) for copies, part in moving)
    if left == len(checked[0]):
        # unchanged, couplings between blocks included
        return tuple(checked), 0
    return block_diagonal([part for copies, part in moving for _ in range(copies)]), len(checked[0]) - left


def block_diagonal(blocks: Sequence[Sequence[FloatArray]]) -> tuple[FloatArray, ...]:
    """Block diagonal matrices: matrix k has blocks[0][k], blocks[1][k], ... on its diagonal."""
    ends = np.cumsum([len(block[0]) for block in blocks])
    whole = tuple(np.zeros((ends[-1], ends[-1])) for _ in blocks[0])
    for block, end in zip(blocks, ends.tolist(), strict=True):
        place = slice(end - len(block[0]), end)
        for target, matrix in zip(whole, block, strict=True):
            target[place, place] = matrix
    return whole


def balanced(*matrices: FloatArray) -> tuple[FloatArray, ...]:
    """The matrices after a common diagonal similarity that evens out the rows and columns of sum |A_k|.

    With units as different as rad and W, a norm, and a tolerance relative to it, says little about the dynamics. The
    similarity is exact: its entries are powers of two.
    """
    if len(matrices[0]) == 1:
        return matrices
    weight = sum((np.abs(matrix) for matrix in matrices[1:]), np.abs(matrices[0]))
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
    """Whether the sum of the matrices is singular to rounding: s = 0 is then a root at every delay.

    Each row is scaled to its own size, so a motion that is merely slow beside others does not count as singular.
    """
    stacked = np.array(list(matrices))
    size = np.linalg.norm(stacked, axis=(0, 2))
    total = stacked.sum(axis=0) / np.where(size > 0.0, size, 1.0)[:, np.newaxis]
    return bool(np.linalg.svd(total, compute_uv=False)[-1] < 2e-15 * len(size))


def _complement_of_common_kernel(matrices: list[FloatArray]) -> FloatArray:
    """Orthonormal basis (n, n - k) of the complement of the k-dimensional common kernel of the matrices."""
    stacked = np.vstack(matrices)
    size = np.linalg.norm(stacked, axis=1, keepdims=True)
    # each row scaled to its own size, as above
    _, singular, rows = np.linalg.svd(stacked / np.where(size > 0.0, size, 1.0))
    # a kernel known to rounding has singular values of a few eps
    rank = int(np.count_nonzero(singular > 1e-12 * singular[0]))
    return rows[:rank].T


def _projected(matrix: FloatArray, basis: FloatArray) -> FloatArray:
    """The matrix in the coordinates of an orthonormal basis, with entries at rounding level set to zero."""
    projected = basis.T @ matrix @ basis
    return np.where(np.abs(projected) > 1e-14 * np.abs(matrix).max(), projected, 0.0)


def _moving_part(block: list[FloatArray]) -> list[FloatArray]:
    """The block, balanced, without its fixed roots; the block itself if it has nothing else."""
    left = list(balanced(*block))
    while left[0].size > 0:
        size = left[0].shape[0]
        basis = _complement_of_common_kernel(left)
        if basis.shape[1] == size:
            basis = _complement_of_common_kernel([matrix.T for matrix in left])
        if basis.shape[1] == size:
            return left
        left = [_projected(matrix, basis) for matrix in left]
    return block


def _components(size: int, driven: IntArray, driver: IntArray) -> IntArray:
    """Label of the strongly connected component of each state, from edges in ascending order of the driven state.

    Labels count from 0, drivers first: the search goes from a state to its drivers and labels what it has left.

    R. Tarjan, "Depth-first search and linear graph algorithms", SIAM J. Comput. 1 (1972), 146-160, without recursion.
    """
    ends = np.cumsum(np.bincount(driven, minlength=size)).tolist()
    following, drivers = [0, *ends[:-1]], driver.tolist()
    number, lowest, label = [0] * size, [0] * size, [-1] * size
    visited, found = 0, 0
    unlabelled: list[int] = []
    for start in range(size):
        path = [] if number[start] else [start]
        while path:
            state = path[-1]
            if not number[state]:
                visited += 1
                number[state] = lowest[state] = visited
                unlabelled.append(state)
            if following[state] < ends[state]:
                towards = drivers[following[state]]
                following[state] += 1
                if not number[towards]:
                    path.append(towards)
                elif label[towards] < 0:
                    lowest[state] = min(lowest[state], number[towards])
                continue
            path.pop()
            if path:
                lowest[path[-1]] = min(lowest[path[-1]], lowest[state])
            if lowest[state] == number[state]:
                while label[state] < 0:
                    label[unlabelled.pop()] = found
                found += 1
    return np.array(label)
