"""Inclusion principle: from overlapping to disjoint subsystems and back, for any leader-follower chain or tree.

The overlapping subsystems {e_0^v} and {e_j^v, e_i^p, e_i^v} of every follower i behind j share velocity errors. In an
expanded space each subsystem gets its own copy, the subsystems are disjoint, and gains are designed for one of them at
a time; contraction brings them back. All matrices are built from the tree and are sparse, so that verification of some
hundred vehicles takes milliseconds.

Source: Sahoo 2012 (see `gains.formation.model`), section 3, Theorems 2 and 3, eqs. (3.5)-(3.19), (3.25), (3.26).
"""

from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.formation.model import FormationModel, checked_gain

# scipy has no types: any of its two-dimensional sparse arrays
Sparse = Any
Restriction = Literal["a", "b"]


@dataclass(frozen=True, eq=False)
class Expansion:
    """The expanded system x~' = A~ x~ + B~ u~ and the maps to and from it.

    x~ = V x, u~ = R u expand; x = U x~, u = Q u~ contract; UV = I, QR = I (3.5, 3.6). U = (V'V)^{-1} V' and
    Q = (R'R)^{-1} R' take the mean of the copies.

    Attributes
    ----------
    V, U
        State maps, shapes (expanded states, states) and (states, expanded states).
    R, Q
        Input maps, shapes (expanded inputs, inputs) and (inputs, expanded inputs).
    A, B
        A~ and B~ of the expanded system.
    M, N
        Complementary matrices: A~ = V A U + M, B~ = V B Q + N. Restriction needs MV = 0 and, of type (a), NR = 0, of
        type (b), N = 0.
    restriction
        "a": A~V = VA and B~R = VB. "b": A~V = VA and B~ = VBQ (Theorem 2).

    Examples
    --------
    U takes the mean of the copies that V makes, UV = I:

    >>> import numpy as np
    >>> from gains.formation.model import FormationModel
    >>> from gains.formation.inclusion import expand
    >>> expansion = expand(FormationModel((-1, 0, 1)))
    >>> np.array_equal((expansion.U @ expansion.V).toarray(), np.eye(10))
    True
    """

    V: Sparse
    U: Sparse
    R: Sparse
    Q: Sparse
    A: Sparse
    B: Sparse
    M: Sparse
    N: Sparse
    restriction: Restriction


@dataclass(frozen=True)
class InclusionResiduals:
    """Largest absolute entry by which each condition of the inclusion is missed; 0 where it holds exactly.

    Attributes
    ----------
    state_inverse, input_inverse
        UV = I and QR = I (3.5, 3.6).
    state_map
        A~V = VA.
    input_map
        B~R = VB for restriction (a), B~ = VBQ for (b).
    gain_map
        K~V = RK for restriction (a); for (b) it follows from the contraction and is the same number.
    contraction
        K = QK~V.
    """

    state_inverse: float
    input_inverse: float
    state_map: float
    input_map: float
    gain_map: float
    contraction: float


def expand(formation: FormationModel, restriction: Restriction = "a") -> Expansion:
    """Return the expanded system in which the subsystems of the formation are disjoint.

    The expanded state is (e_0^v) and then (e_j^v, e_i^p, e_i^v) for every follower i behind j, the expanded input (u_0)
    and then (u_j, u_i) (3.11-3.13). Of type (a), A~ and B~ are block diagonal with the blocks (3.25). Of type (b), A~
    is the same and B~ = VBQ, which is not block diagonal: a vehicle's copies move by the mean of its inputs' copies.

    Raises
    ------
    BadModelError
        If the restriction is neither "a" nor "b".

    Examples
    --------
    A chain of three: e_0^v, e_1^v, u_0 and u_1 are there twice.

    >>> from gains.formation.model import FormationModel
    >>> from gains.formation.inclusion import expand
    >>> expansion = expand(FormationModel((-1, 0, 1)))
    >>> expansion.V.shape, expansion.R.shape
    ((14, 10), (10, 6))
    """
    if restriction not in ("a", "b"):
        raise BadModelError(f"restriction = {restriction!r}; wanted 'a' or 'b'")
    n = formation.axes
    state_source, input_source = _copied_blocks(formation)
    V = _selection(state_source, formation.states, n)
    R = _selection(input_source, formation.inputs, n)
    U, Q = _mean_of_copies(V), _mean_of_copies(R)
    A, B = csr_array(formation.A), csr_array(formation.B)
    A_expanded, B_disjoint = _disjoint_subsystems(formation)
    mean_input = V @ B @ Q
    B_expanded = B_disjoint if restriction == "a" else mean_input
    return Expansion(
        V=V, U=U, R=R, Q=Q, A=A_expanded, B=B_expanded,
        M=A_expanded - V @ A @ U, N=B_expanded - mean_input, restriction=restriction,
    )  # fmt: skip


def expanded_gain(formation: FormationModel, K1: ArrayLike, K2: ArrayLike, K3: ArrayLike) -> Sparse:
    """Return the block-diagonal gain K~ of the disjoint subsystems, sparse, shape (expanded inputs, expanded states).

    The block of {e_0^v} is K1, that of every follower [K1 0 0; K2 K3 K1] (3.26): in its subsystem the vehicle in front
    is governed by K1 alone. Arguments and exceptions as of `gains.formation.model.FormationModel.overlapping_gain`.

    Examples
    --------
    A leader and one follower of one axis: [K1] and [K1 0 0; K2 K3 K1].

    >>> from gains.formation.model import FormationModel
    >>> from gains.formation.inclusion import expanded_gain
    >>> expanded_gain(FormationModel((-1, 0), axes=1), [[-3]], [[2]], [[1]]).toarray().tolist()
    [[-3.0, 0.0, 0.0, 0.0], [0.0, -3.0, 0.0, 0.0], [0.0, 2.0, 1.0, -3.0]]
    """
    n = formation.axes
    own, front, spacing = (checked_gain(name, gain, n) for name, gain in (("K1", K1), ("K2", K2), ("K3", K3)))
    entries = [(0, 0, own)]
    for i in formation.followers:
        row, column = 2 * i - 1, 3 * i - 2
        entries += [(row, column, own), (row + 1, column, front)]
        entries += [(row + 1, column + 1, spacing), (row + 1, column + 2, own)]
    return _blocks(entries, (2 * formation.vehicles - 1, 3 * formation.vehicles - 2), n)


def modified_gain(formation: FormationModel, gain: Sparse) -> Sparse:
    """Return K~_M: the expanded gain in which every copy of an input gets the command of the vehicle's own subsystem.

    Without this the copies of u_j disagree (K1 e_j^v in the subsystem of the vehicle behind j, the full law in j's
    own), K~V = RK has no solution K, and the contracted gain would be a mean of the two (3.17-3.19). `gain` is that of
    `expanded_gain`.

    Examples
    --------
    In a chain of three the copy of u_1 in the subsystem behind gets the law of vehicle 1:

    >>> from gains.formation.model import FormationModel
    >>> from gains.formation.inclusion import expanded_gain, modified_gain
    >>> chain = FormationModel((-1, 0, 1), axes=1)
    >>> modified_gain(chain, expanded_gain(chain, [[-3]], [[2]], [[1]])).toarray()[3].tolist()
    [0.0, 2.0, 1.0, -3.0, 0.0, 0.0, 0.0]
    """
    n = formation.axes
    own_row = [0] + [2 * i for i in formation.followers]
    rows = [0]
    for i in formation.followers:
        rows += [own_row[formation.predecessors[i]], own_row[i]]
    index = (np.array(rows)[:, None] * n + np.arange(n)).ravel()
    return csr_array(gain)[index, :]


def contracted_gain(expansion: Expansion, gain: Sparse) -> FloatArray:
    """Return K = Q K~ V as an array of shape (inputs, states), K~ of shape (expanded inputs, expanded states).

    Examples
    --------
    Back to the gain (3.19) of the formation, u_1 = 2 e_0^v + e_1^p − 3 e_1^v:

    >>> from gains.formation.model import FormationModel
    >>> from gains.formation.inclusion import contracted_gain, expand, expanded_gain, modified_gain
    >>> pair = FormationModel((-1, 0), axes=1)
    >>> contracted_gain(expand(pair), modified_gain(pair, expanded_gain(pair, [[-3]], [[2]], [[1]]))).tolist()
    [[-3.0, 0.0, 0.0], [2.0, 1.0, -3.0]]
    """
    return np.asarray((expansion.Q @ csr_array(gain) @ expansion.V).toarray(), dtype=float)


def verify_inclusion(
    expansion: Expansion,
    A: ArrayLike,
    B: ArrayLike,
    *,
    K: ArrayLike,
    K_expanded: Sparse,
    tolerance: float = 1e-9,
) -> InclusionResiduals:
    """Check every condition under which the closed loop is included in the expanded closed loop.

    Parameters
    ----------
    expansion
        Maps and expanded system.
    A, B
        The original system, shapes (states, states) and (states, inputs).
    K, K_expanded
        The gain of the original system and of the expanded one.
    tolerance
        Largest residual accepted, relative to the largest entry of the matrices compared (at least 1).

    Raises
    ------
    BadModelError
        If a condition is missed; the message names it, its residual and the tolerance.

    Examples
    --------
    >>> from gains.formation.model import FormationModel
    >>> from gains.formation.inclusion import expand, expanded_gain, modified_gain, verify_inclusion
    >>> chain, gains = FormationModel((-1, 0, 1), axes=1), ([[-3]], [[2]], [[1]])
    >>> K, K_expanded = chain.overlapping_gain(*gains), modified_gain(chain, expanded_gain(chain, *gains))
    >>> verify_inclusion(expand(chain), chain.A, chain.B, K=K, K_expanded=K_expanded).gain_map
    0.0
    """
    V, U, R, Q = expansion.V, expansion.U, expansion.R, expansion.Q
    A_, B_, K_, K_e = csr_array(A), csr_array(B), csr_array(K), csr_array(K_expanded)
    type_a = expansion.restriction == "a"
    contraction = _largest(Q @ K_e @ V - K_)
    residuals = InclusionResiduals(
        state_inverse=_largest(U @ V - csr_array(np.eye(V.shape[1]))),
        input_inverse=_largest(Q @ R - csr_array(np.eye(R.shape[1]))),
        state_map=_largest(expansion.A @ V - V @ A_),
        input_map=_largest(expansion.B @ R - V @ B_ if type_a else expansion.B - V @ B_ @ Q),
        gain_map=_largest(K_e @ V - R @ K_) if type_a else contraction,
        contraction=contraction,
    )
    conditions = {
        "state_inverse": "UV = I",
        "input_inverse": "QR = I",
        "state_map": "A~V = VA",
        "input_map": "B~R = VB" if type_a else "B~ = VBQ",
        "gain_map": "K~V = RK (do all copies of an input get the same command?)",
        "contraction": "K = QK~V",
    }
    allowed = tolerance * max(1.0, _largest(A_), _largest(B_), _largest(K_e))
    for field in fields(residuals):
        residual = getattr(residuals, field.name)
        if not residual <= allowed:
            raise BadModelError(
                f"the inclusion misses {conditions[field.name]} by {residual:.3g}; wanted at most {allowed:.3g} "
                f"(restriction type {expansion.restriction})"
            )
    return residuals


def _copied_blocks(formation: FormationModel) -> tuple[list[int], list[int]]:
    """Block index of the original state and input that each block of the expanded state and input is a copy of."""
    states, inputs = [0], [0]
    for i in formation.followers:
        front = formation.predecessors[i]
        states += [2 * front, 2 * i - 1, 2 * i]
        inputs += [front, i]
    return states, inputs


def _selection(source_blocks: list[int], columns: int, n: int) -> Sparse:
    """0/1 matrix that copies the given blocks of size n."""
    column = (np.array(source_blocks)[:, None] * n + np.arange(n)).ravel()
    rows = column.size
    return csr_array((np.ones(rows), (np.arange(rows), column)), shape=(rows, columns))


def _mean_of_copies(copies: Sparse) -> Sparse:
    """(V'V)^{-1} V' of a selection matrix; V'V is diagonal and counts the copies."""
    counts = np.asarray(copies.sum(axis=0)).ravel()
    return csr_array(copies.T.multiply(1.0 / counts[:, None]))


def _disjoint_subsystems(formation: FormationModel) -> tuple[Sparse, Sparse]:
    """Block-diagonal A~ and B~ of the subsystems (3.25)."""
    n = formation.axes
    identity = np.eye(n)
    state_entries: list[tuple[int, int, FloatArray]] = []
    input_entries = [(0, 0, identity)]
    for i in formation.followers:
        front, spacing, own = 3 * i - 2, 3 * i - 1, 3 * i
        state_entries += [(spacing, front, identity), (spacing, own, -identity)]
        input_entries += [(front, 2 * i - 1, identity), (own, 2 * i, identity)]
    states, inputs = 3 * formation.vehicles - 2, 2 * formation.vehicles - 1
    return _blocks(state_entries, (states, states), n), _blocks(input_entries, (states, inputs), n)


def _blocks(entries: list[tuple[int, int, FloatArray]], shape: tuple[int, int], n: int) -> Sparse:
    """Sparse matrix of n×n blocks given as (block row, block column, block); `shape` counts blocks."""
    full_shape = (shape[0] * n, shape[1] * n)
    if not entries:
        return csr_array(full_shape)
    row = np.array([entry[0] for entry in entries])[:, None, None] * n + np.arange(n)[None, :, None]
    column = np.array([entry[1] for entry in entries])[:, None, None] * n + np.arange(n)[None, None, :]
    value = np.array([entry[2] for entry in entries])
    row, column = np.broadcast_to(row, value.shape), np.broadcast_to(column, value.shape)
    return csr_array((value.ravel(), (row.ravel(), column.ravel())), shape=full_shape)


def _largest(matrix: Sparse) -> float:
    """Largest absolute entry; 0 for a matrix without entries, NaN if one is NaN."""
    entries = np.abs(matrix.data)
    return float(entries.max()) if entries.size else 0.0
