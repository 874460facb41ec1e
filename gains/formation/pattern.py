"""Information patterns of a decentralised static feedback u = K y, y = C x: which input may use which output.

A pattern is a binary block matrix: block (i, j) is 1 if the input of vehicle i may use the output of vehicle j. The
gain may have any entries in these blocks and is zero elsewhere.

Source: Sahoo 2012 (see `gains.formation.model`), section 4, eq. (4.6), and section 5.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import BoolArray, FloatArray
from gains.core.errors import BadModelError
from gains.core.structure import real_matrix, square_matrices
from gains.formation.model import FormationModel

Link = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Plant:
    """Linear plant x' = A x + B u, y = C x with A (n, n), B (n, inputs) and C (outputs, n); C is the identity if None.

    BadModelError if a matrix is not finite and real, or the shapes do not fit.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray

    def __init__(self, A: ArrayLike, B: ArrayLike, C: ArrayLike | None = None) -> None:
        [state] = square_matrices(A=A)
        control = real_matrix("B", B)
        output = np.eye(state.shape[0]) if C is None else real_matrix("C", C)
        if control.shape[0] != state.shape[0]:
            raise BadModelError(f"B has shape {control.shape}; {state.shape[0]} rows are wanted, to match A")
        if output.shape[1] != state.shape[0]:
            raise BadModelError(f"C has shape {output.shape}; {state.shape[0]} columns are wanted, to match A")
        for name, matrix in (("A", state), ("B", control), ("C", output)):
            object.__setattr__(self, name, matrix)

    @property
    def states(self) -> int:
        """Length n of x."""
        return self.A.shape[0]

    def closed_loop(self, K: FloatArray) -> FloatArray:
        """A + B K C, shape (n, n)."""
        return self.A + self.B @ K @ self.C


@dataclass(frozen=True, eq=False)
class Pattern:
    """Binary block matrix of the gain K: which outputs each input may use.

    BadModelError if an entry is not 0 or 1, a size is not a positive whole number, or sizes do not match the blocks.
    """

    blocks: BoolArray
    """Shape (vehicles with an input, vehicles with an output); True at (i, j) if u_i may use y_j."""
    input_sizes: tuple[int, ...]
    output_sizes: tuple[int, ...]
    """Length of every u_i and y_j; they may differ from vehicle to vehicle."""

    def __post_init__(self) -> None:
        matrix = real_matrix("blocks", self.blocks)
        if not np.isin(matrix, (0.0, 1.0)).all():
            raise BadModelError("blocks has entries other than 0 and 1; a binary matrix is wanted")
        blocks = matrix.astype(bool)
        for name, wanted in zip(("input_sizes", "output_sizes"), blocks.shape, strict=True):
            sizes = tuple(getattr(self, name))
            if len(sizes) != wanted:
                raise BadModelError(f"{name} = {sizes} has {len(sizes)} entries; {wanted} are wanted, to match blocks")
            if any(size != int(size) or size < 1 for size in sizes):
                raise BadModelError(f"{name} = {sizes}; positive whole numbers are wanted")
            object.__setattr__(self, name, tuple(int(size) for size in sizes))
        object.__setattr__(self, "blocks", blocks)

    @property
    def links(self) -> tuple[Link, ...]:
        """Every (i, j) such that u_i may use y_j, row by row."""
        return tuple((int(i), int(j)) for i, j in np.argwhere(self.blocks))

    @property
    def mask(self) -> BoolArray:
        """Entries of K that may differ from zero, shape (inputs, outputs)."""
        return np.repeat(np.repeat(self.blocks, self.input_sizes, axis=0), self.output_sizes, axis=1)

    @property
    def inputs(self) -> int:
        """Length of u."""
        return sum(self.input_sizes)

    @property
    def outputs(self) -> int:
        """Length of y."""
        return sum(self.output_sizes)

    def input_slice(self, i: int) -> slice:
        """Slice of u that holds u_i."""
        return _place(self.input_sizes, i)

    def output_slice(self, j: int) -> slice:
        """Slice of y that holds y_j."""
        return _place(self.output_sizes, j)


def leader_follower(formation: FormationModel) -> Pattern:
    """The pattern (4.6): every vehicle uses its own output and that of the vehicle in front.

    With C = I, the leader's output is its velocity error; a follower's is its spacing and velocity errors.

    >>> leader_follower(FormationModel((-1, 0, 1))).links
    ((0, 0), (1, 0), (1, 1), (2, 1), (2, 2))
    """
    blocks = np.eye(formation.vehicles, dtype=bool)
    for i in formation.followers:
        blocks[i, formation.predecessors[i]] = True
    return Pattern(blocks, *_formation_sizes(formation))


def bidirectional(formation: FormationModel) -> Pattern:
    """The pattern of section 5: every vehicle uses its own output and those of the vehicles in front and behind.

    >>> bidirectional(FormationModel((-1, 0, 1))).blocks.astype(int).tolist()
    [[1, 1, 0], [1, 1, 1], [0, 1, 1]]
    """
    pattern = leader_follower(formation)
    return replace(pattern, blocks=pattern.blocks | pattern.blocks.T)


def overlapping(formation: FormationModel, *, ahead: int = 1, behind: bool = False, leader: bool = False) -> Pattern:
    """Every vehicle uses its own output and those of `ahead` vehicles in front.

    `behind` adds the vehicles behind it, `leader` adds the leader. BadModelError if `ahead` is below 1.

    >>> overlapping(FormationModel((-1, 0, 1, 2)), ahead=2, leader=True).blocks.astype(int).tolist()
    [[1, 0, 0, 0], [1, 1, 0, 0], [1, 1, 1, 0], [1, 1, 1, 1]]
    """
    if ahead < 1:
        raise BadModelError(f"ahead is {ahead}; 1 vehicle in front or more is wanted")
    pattern = bidirectional(formation) if behind else leader_follower(formation)
    blocks = pattern.blocks.copy()
    for i in formation.followers:
        front = i
        for _ in range(ahead):
            front = max(formation.predecessors[front], 0)
            blocks[i, front] = True
        blocks[i, 0] |= leader
    return replace(pattern, blocks=blocks)


def all_to_all(formation: FormationModel) -> Pattern:
    """Every vehicle uses all outputs: the centralised controller.

    >>> all_to_all(FormationModel((-1, 0))).links
    ((0, 0), (0, 1), (1, 0), (1, 1))
    """
    return Pattern(np.ones((formation.vehicles, formation.vehicles), dtype=bool), *_formation_sizes(formation))


def with_links(pattern: Pattern, links: Iterable[Link]) -> Pattern:
    """The pattern with these links (i, j) added; BadModelError if one names a vehicle that is not in the pattern.

    Here vehicle 2 uses the leader's output as well:

    >>> with_links(leader_follower(FormationModel((-1, 0, 1))), [(2, 0)]).blocks.astype(int).tolist()
    [[1, 0, 0], [1, 1, 0], [1, 1, 1]]
    """
    return replace(pattern, blocks=_set(pattern, links, True))


def without_links(pattern: Pattern, links: Iterable[Link]) -> Pattern:
    """The pattern without these links (i, j). Exceptions as for `with_links`.

    >>> without_links(leader_follower(FormationModel((-1, 0, 1))), [(2, 1)]).links
    ((0, 0), (1, 0), (1, 1), (2, 2))
    """
    return replace(pattern, blocks=_set(pattern, links, False))


def formation_plant(formation: FormationModel, C: ArrayLike | None = None) -> Plant:
    """The error model of the formation with outputs y = C e, C of shape (outputs, states); C = I if None.

    >>> plant = formation_plant(FormationModel((-1, 0, 1)))
    >>> plant.A.shape, plant.B.shape, plant.C.shape
    ((10, 10), (10, 6), (10, 10))
    """
    return Plant(formation.A, formation.B, C)


def checked_pattern_gain(pattern: Pattern, K: ArrayLike) -> FloatArray:
    """K as a finite array of the pattern's shape; BadModelError if it is not, or is nonzero outside the pattern."""
    gain = real_matrix("K", K)
    mask = pattern.mask
    if gain.shape != mask.shape:
        raise BadModelError(f"K has shape {gain.shape}; {mask.shape} is wanted, to match the pattern")
    foreign = np.argwhere((gain != 0.0) & ~mask)
    if foreign.size:
        row, column = (int(k) for k in foreign[0])
        i, j = _block_of(pattern.input_sizes, row), _block_of(pattern.output_sizes, column)
        raise BadModelError(
            f"K[{row}, {column}] = {gain[row, column]}, in block ({i}, {j}); the pattern has no link ({i}, {j}): "
            "0 is wanted there, or with_links"
        )
    return gain


def check_fits(plant: Plant, pattern: Pattern) -> None:
    """Raise BadModelError unless plant and pattern have the same numbers of inputs and outputs."""
    if (plant.B.shape[1], plant.C.shape[0]) != (pattern.inputs, pattern.outputs):
        raise BadModelError(
            f"the pattern has {pattern.inputs} inputs and {pattern.outputs} outputs; {plant.B.shape[1]} and "
            f"{plant.C.shape[0]} are wanted, to match the plant"
        )


def _formation_sizes(formation: FormationModel) -> tuple[tuple[int, ...], tuple[int, ...]]:
    n, vehicles = formation.axes, formation.vehicles
    return (n,) * vehicles, (n,) + (2 * n,) * (vehicles - 1)


def _set(pattern: Pattern, links: Iterable[Link], value: bool) -> BoolArray:
    blocks = pattern.blocks.copy()
    for i, j in links:
        if not (0 <= i < blocks.shape[0] and 0 <= j < blocks.shape[1]):
            raise BadModelError(
                f"link ({i}, {j}) is not in the pattern; an input 0 to {blocks.shape[0] - 1} and an output 0 to "
                f"{blocks.shape[1] - 1} are wanted"
            )
        blocks[i, j] = value
    return blocks


def _place(sizes: tuple[int, ...], k: int) -> slice:
    start = sum(sizes[:k])
    return slice(start, start + sizes[k])


def _block_of(sizes: tuple[int, ...], index: int) -> int:
    return int(np.searchsorted(np.cumsum(sizes), index, side="right"))
