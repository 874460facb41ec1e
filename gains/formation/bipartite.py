"""Block-diagonal form of a gain with an information pattern, one block for each complete bipartite subgraph.

The links of a pattern are the edges of a bipartite graph of inputs and outputs. A partition of the edges into complete
bipartite subgraphs (bicliques) expands the gain: K = φ1 K̄ φ2, where K̄ has one diagonal block for each subgraph and
the 0/1 matrices φ1, φ2 repeat inputs and outputs. The plant with B̄ = B φ1 and C̄ = φ2 C has the same closed loop. The
partition is not unique: the one by inputs has φ1 = I; finding the smallest one is NP-hard in general.

Source: Sahoo 2012 (see `gains.formation.model`), section 4, eqs. (4.3), (4.4), (4.6), (4.7).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import BoolArray, FloatArray
from gains.core.errors import BadModelError, DisagreementError
from gains.formation.pattern import Link, Pattern, Plant, check_fits, checked_pattern_gain

# exhaustive search is limited to patterns with this many links, equal rows and columns counted once,
LARGEST_SEARCH_LINKS = 40
# and to this many steps (some seconds); beyond them the best partition found is not known to be the smallest
_SEARCH_STEPS = 200_000


@dataclass(frozen=True)
class Subgraph:
    """A complete bipartite subgraph: each of its inputs uses each of its outputs."""

    inputs: tuple[int, ...]
    outputs: tuple[int, ...]

    @property
    def links(self) -> tuple[Link, ...]:
        """Every (i, j) of the subgraph."""
        return tuple((i, j) for i in self.inputs for j in self.outputs)


Partition = tuple[Subgraph, ...]
"""Subgraphs, sorted by their first link, that together hold every link of a pattern exactly once."""


@dataclass(frozen=True, eq=False)
class ExpandedGain:
    """The maps of K = φ1 K̄ φ2 for a partition."""

    pattern: Pattern
    phi1: FloatArray
    phi2: FloatArray
    """0/1 matrices, shapes (inputs, expanded inputs) and (expanded outputs, outputs)."""
    mask: BoolArray
    """Entries of K̄ that may be nonzero: block diagonal, shape (expanded inputs, expanded outputs)."""

    def expand(self, K: ArrayLike) -> FloatArray:
        """K̄ with φ1 K̄ φ2 = K (4.3); BadModelError if K does not have the pattern."""
        gain = checked_pattern_gain(self.pattern, K)
        # every link is in exactly one subgraph, so each entry of K has one place in the mask
        return np.where(self.mask, self.phi1.T @ gain @ self.phi2.T, 0.0)

    def expand_plant(self, plant: Plant) -> Plant:
        """The plant with B̄ = B φ1 and C̄ = φ2 C (4.4)."""
        check_fits(plant, self.pattern)
        return Plant(plant.A, plant.B @ self.phi1, self.phi2 @ plant.C)


def partition_by_input(pattern: Pattern) -> Partition:
    """The partition with one subgraph for each input and the outputs it uses: φ1 = I if every input uses an output.

    A partition is a tuple of `Subgraph`, sorted by their first link. The pattern (4.6) gives {K11}, {K21, K22},
    {K32, K33}.

    >>> from gains import FormationModel
    >>> from gains.formation.pattern import leader_follower
    >>> [graph.links for graph in partition_by_input(leader_follower(FormationModel((-1, 0, 1))))]
    [((0, 0),), ((1, 0), (1, 1)), ((2, 1), (2, 2))]
    """
    return tuple(_rows(pattern.blocks))


def smallest_partition(pattern: Pattern) -> Partition:
    """The partition with the fewest subgraphs, or the best one found if a search through all would take too long.

    The best of three heuristics (by input, by output, largest first) is the smallest if its size equals the rank of the
    pattern, a lower bound on all partitions (Graham and Pollak). Otherwise all smaller partitions are tried, up to
    `LARGEST_SEARCH_LINKS` links between distinct rows and columns and within a fixed number of steps.
    """
    row_class, column_class = _classes(pattern.blocks), _classes(pattern.blocks.T)
    core = pattern.blocks[np.ix_([rows[0] for rows in row_class], [columns[0] for columns in column_class])]
    bound = int(np.linalg.matrix_rank(core.astype(float)))
    by_output = [Subgraph(graph.outputs, graph.inputs) for graph in _rows(core.T)]
    best = min(_rows(core), by_output, _largest_first(core), key=len)
    if len(best) > bound and int(core.sum()) <= LARGEST_SEARCH_LINKS:
        steps = iter(range(_SEARCH_STEPS))
        while bound < len(best):
            found, exhausted = _search(core, bound, steps)
            best = best if found is None else found
            if not exhausted:
                break
            bound = bound + 1 if found is None else bound
    copied = [
        Subgraph(
            tuple(sorted(i for k in graph.inputs for i in row_class[k])),
            tuple(sorted(j for k in graph.outputs for j in column_class[k])),
        )
        for graph in best
    ]
    return tuple(sorted(copied, key=lambda graph: graph.links))


def expanded_gain(pattern: Pattern, partition: Partition) -> ExpandedGain:
    """φ1, φ2 and the mask of a partition; BadModelError if it does not hold every link of the pattern exactly once.

    This partition has the sizes of (4.7), and φ1 = I:

    >>> from gains import FormationModel
    >>> from gains.formation.pattern import leader_follower
    >>> pattern = leader_follower(FormationModel((-1, 0, 1)))
    >>> expanded = expanded_gain(pattern, partition_by_input(pattern))
    >>> expanded.mask.shape, expanded.phi2.shape, np.array_equal(expanded.phi1, np.eye(6))
    ((6, 16), (16, 10), True)
    """
    _check_partition(pattern, partition)
    phi1 = _stacked([i for graph in partition for i in graph.inputs], pattern.input_sizes).T
    phi2 = _stacked([j for graph in partition for j in graph.outputs], pattern.output_sizes)
    rows = [k for k, graph in enumerate(partition) for i in graph.inputs for _ in range(pattern.input_sizes[i])]
    columns = [k for k, graph in enumerate(partition) for j in graph.outputs for _ in range(pattern.output_sizes[j])]
    return ExpandedGain(pattern, phi1, phi2, np.equal.outer(rows, columns))


def verify_expansion(plant: Plant, expanded: ExpandedGain, K: ArrayLike) -> float:
    """Largest difference between the closed loops A + B K C and A + B̄ K̄ C̄, relative to the latter's largest entry.

    K has the shape (inputs, outputs). Raises BadModelError if it does not have the pattern or the plant does not fit,
    and DisagreementError if the difference exceeds rounding (1e-12).

    >>> pattern = Pattern([[1, 0], [1, 1]], (1, 1), (1, 1))
    >>> expanded = expanded_gain(pattern, partition_by_input(pattern))
    >>> verify_expansion(Plant([[0, 0], [1, 0]], [[1, 0], [0, 1]]), expanded, [[-1, 0], [2, -3]])
    0.0
    """
    gain = checked_pattern_gain(expanded.pattern, K)
    closed = plant.closed_loop(gain)
    expanded_closed = expanded.expand_plant(plant).closed_loop(expanded.expand(gain))
    residual = float(np.abs(closed - expanded_closed).max() / max(np.abs(expanded_closed).max(), np.finfo(float).tiny))
    if residual > 1e-12:
        raise DisagreementError(
            f"the closed loops with K and with the expanded gain differ by {residual:.3g} of their largest entry; "
            "rounding (1e-12) at most is wanted"
        )
    return residual


def _check_partition(pattern: Pattern, partition: Partition) -> None:
    links = [link for graph in partition for link in graph.links]
    twice = sorted({link for link in links if links.count(link) > 1}) if len(set(links)) < len(links) else []
    if twice:
        raise BadModelError(f"link {twice[0]} is in more than one subgraph; exactly one is wanted")
    difference = sorted(set(links) ^ set(pattern.links))
    if difference:
        where = "the pattern" if difference[0] in links else "any subgraph"
        raise BadModelError(f"link {difference[0]} is not in {where}; subgraphs are wanted that hold all links once")


def _stacked(vehicles: list[int], sizes: tuple[int, ...]) -> FloatArray:
    """0/1 matrix that stacks the parts of a vector that belong to these vehicles, in the order given."""
    starts = np.concatenate([[0], np.cumsum(sizes)])
    index = np.concatenate([np.arange(starts[k], starts[k + 1]) for k in vehicles] or [np.zeros(0, dtype=np.intp)])
    return np.eye(int(starts[-1]))[index.astype(np.intp)]


def _classes(rows: BoolArray) -> list[list[int]]:
    """Indices of the nonempty rows, grouped by equality."""
    found: dict[bytes, list[int]] = {}
    for k in np.flatnonzero(rows.any(axis=1)).tolist():
        found.setdefault(rows[k].tobytes(), []).append(k)
    return list(found.values())


def _rows(blocks: BoolArray) -> list[Subgraph]:
    return [Subgraph((i,), tuple(np.flatnonzero(row).tolist())) for i, row in enumerate(blocks) if row.any()]


def _largest_first(core: BoolArray) -> list[Subgraph]:
    """Greedy partition: repeatedly takes the largest subgraph on the common outputs of one or two inputs."""
    left = core.copy()
    graphs: list[Subgraph] = []
    while left.any():
        rows = np.unique(left[left.any(axis=1)], axis=0)
        common = np.unique((rows[:, np.newaxis, :] & rows[np.newaxis]).reshape(-1, rows.shape[1]), axis=0)
        # an input that uses all these outputs joins; the product of the two counts is the number of links
        lacking = common.astype(int) @ ~left.T
        best = int(np.argmax((lacking == 0).sum(axis=1) * common.sum(axis=1)))
        inputs, outputs = np.flatnonzero(lacking[best] == 0), np.flatnonzero(common[best])
        left[np.ix_(inputs, outputs)] = False
        graphs.append(Subgraph(tuple(inputs.tolist()), tuple(outputs.tolist())))
    return graphs


def _search(core: BoolArray, count: int, steps: Iterator[int]) -> tuple[list[Subgraph] | None, bool]:
    """A partition into at most `count` subgraphs, None if none was found, and whether the steps sufficed to decide.

    The first uncovered link joins an open subgraph, together with the links that then complete it, or opens a new
    one. Subgraphs are opened in the order of their first links, so no partition is tried twice.
    """
    links = [(int(i), int(j)) for i, j in np.argwhere(core)]
    allowed: list[list[bool]] = core.tolist()
    owner = np.full(core.shape, -1)
    graphs: list[tuple[set[int], set[int]]] = []

    def fill(first: int) -> bool | None:
        while first < len(links) and owner[links[first]] >= 0:
            first += 1
        if first == len(links):
            return True
        if next(steps, None) is None:
            return None
        i, j = links[first]
        for k in range(min(len(graphs) + 1, count)):
            rows, columns = graphs[k] if k < len(graphs) else (set[int](), set[int]())
            added = [(r, c) for r in rows | {i} for c in columns | {j} if owner[r, c] != k]
            if any(not allowed[r][c] or owner[r, c] >= 0 for r, c in added):
                continue
            for link in added:
                owner[link] = k
            graphs[k:] = [(rows | {i}, columns | {j}), *graphs[k + 1 :]]
            verdict = fill(first + 1)
            if verdict is not False:
                return verdict
            for link in added:
                owner[link] = -1
            graphs[k:] = [(rows, columns), *graphs[k + 1 :]] if rows else []
        return False

    verdict = fill(0)
    found = [Subgraph(tuple(sorted(rows)), tuple(sorted(columns))) for rows, columns in graphs] if verdict else None
    return found, verdict is not None
