"""Inclusion principle: from overlapping to disjoint subsystems and back, for any leader-follower chain or tree.

The subsystems {e_0^v} and, for every follower i behind j, {e_j^v, e_i^p, e_i^v} overlap: they share velocity errors. In
the expanded space each has its own copy of the shared errors, so gains can be designed for one subsystem at a time;
contraction takes them back to the formation. All matrices are sparse.

Source: Sahoo 2012 (see `gains.formation.model`), section 3, Theorems 2 and 3, eqs. (3.5)-(3.19), (3.25), (3.26).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array, eye_array

from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError
from gains.formation.model import FormationModel

# a two-dimensional sparse array of scipy, which ships no types
Sparse = Any
Restriction = Literal["a", "b"]


@dataclass(frozen=True, eq=False)
class Expansion:
    """The expanded system x~' = A~ x~ + B~ u~ and the maps to and from it.

    x~ = V x and u~ = R u expand; x = U x~ and u = Q u~ contract, with UV = I and QR = I (3.5, 3.6). U = (V'V)^{-1} V'
    and Q = (R'R)^{-1} R' average the copies.
    """

    V: Sparse
    U: Sparse
    """State maps, shapes (expanded states, states) and (states, expanded states)."""
    R: Sparse
    Q: Sparse
    """Input maps, shapes (expanded inputs, inputs) and (inputs, expanded inputs)."""
    A: Sparse
    B: Sparse
    """A~ and B~ of the expanded system."""
    restriction: Restriction
    """"a": A~V = VA and B~R = VB. "b": A~V = VA and B~ = VBQ (Theorem 2)."""


def expand(formation: FormationModel, restriction: Restriction = "a") -> Expansion:
    """The expanded system, in which the subsystems of the formation are disjoint.

    The expanded state is e_0^v, followed by (e_j^v, e_i^p, e_i^v) for every follower i behind j; the expanded input is
    u_0, followed by (u_j, u_i) (3.11-3.13). For type (a), A~ and B~ are block diagonal with the blocks (3.25). For
    type (b), A~ is the same and B~ = VBQ drives all copies of a vehicle by the mean of its copied inputs. BadModelError
    for any other type.

    In a chain of three, e_0^v, e_1^v, u_0 and u_1 have two copies each; U averages those of the states:

    >>> expansion = expand(FormationModel((-1, 0, 1)))
    >>> expansion.V.shape, expansion.R.shape, np.array_equal((expansion.U @ expansion.V).toarray(), np.eye(10))
    ((14, 10), (10, 6), True)
    """
    if restriction not in ("a", "b"):
        raise BadModelError(f"restriction = {restriction!r}; wanted 'a' or 'b'")
    state_source, input_source = _copied_blocks(formation)
    V = _selection(state_source, formation.states, formation.axes)
    R = _selection(input_source, formation.inputs, formation.axes)
    U, Q = _mean_of_copies(V), _mean_of_copies(R)
    A = _disjoint(formation, lambda subsystem: subsystem.A)
    B = _disjoint(formation, lambda subsystem: subsystem.B) if restriction == "a" else V @ csr_array(formation.B) @ Q
    return Expansion(V=V, U=U, R=R, Q=Q, A=A, B=B, restriction=restriction)


def expanded_gain(formation: FormationModel, K1: ArrayLike, K2: ArrayLike, K3: ArrayLike) -> Sparse:
    """The block-diagonal gain K~ of the disjoint subsystems, sparse, shape (expanded inputs, expanded states).

    The block of {e_0^v} is K1, that of every follower [K1 0 0; K2 K3 K1] (3.26). Arguments and exceptions are those of
    `gains.formation.model.FormationModel.overlapping_gain`.

    >>> expanded_gain(FormationModel((-1, 0), axes=1), [[-3]], [[2]], [[1]]).toarray().tolist()
    [[-3.0, 0.0, 0.0, 0.0], [0.0, -3.0, 0.0, 0.0], [0.0, 2.0, 1.0, -3.0]]
    """
    return _disjoint(formation, lambda subsystem: subsystem.overlapping_gain(K1, K2, K3))


def modified_gain(formation: FormationModel, gain: Sparse) -> Sparse:
    """K~_M: the expanded gain in which every copy of an input gets the command of the vehicle's own subsystem.

    In the gain of `expanded_gain` the copies of u_j disagree: K1 e_j^v in the subsystem of the vehicle behind j, the
    full law in j's own subsystem. K~V = RK then has no solution K, and contraction would mix both laws (3.17-3.19).

    In a chain of three, the copy of u_1 in the subsystem of vehicle 2 gets the law of vehicle 1:

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
    """K = Q K~ V, shape (inputs, states), for a gain K~ of shape (expanded inputs, expanded states).

    The result is the gain (3.19) of the formation, u_1 = 2 e_0^v + e_1^p − 3 e_1^v:

    >>> pair = FormationModel((-1, 0), axes=1)
    >>> contracted_gain(expand(pair), modified_gain(pair, expanded_gain(pair, [[-3]], [[2]], [[1]]))).tolist()
    [[-3.0, 0.0, 0.0], [2.0, 1.0, -3.0]]
    """
    return np.asarray((expansion.Q @ csr_array(gain) @ expansion.V).toarray(), dtype=float)


def verify_inclusion(
    expansion: Expansion, A: ArrayLike, B: ArrayLike, *, K: ArrayLike, K_expanded: Sparse, tolerance: float = 1e-9
) -> float:
    """Largest absolute residual of the conditions under which the expanded closed loop includes the original one.

    The conditions are UV = I, QR = I (3.5, 3.6), A~V = VA, K = QK~V and, for restriction (a), B~R = VB and K~V = RK;
    for (b), B~ = VBQ. A (states, states), B (states, inputs) and K are the original system and its gain, `K_expanded`
    is the gain of the expanded system. `tolerance` is relative to the largest entry of A, B and `K_expanded`, or to 1
    if that is larger. Raises BadModelError with the name and residual of a condition that is not met.

    >>> chain, gains = FormationModel((-1, 0, 1), axes=1), ([[-3]], [[2]], [[1]])
    >>> K, K_expanded = chain.overlapping_gain(*gains), modified_gain(chain, expanded_gain(chain, *gains))
    >>> verify_inclusion(expand(chain), chain.A, chain.B, K=K, K_expanded=K_expanded)
    0.0
    """
    V, U, R, Q = expansion.V, expansion.U, expansion.R, expansion.Q
    A_, B_, K_, K_e = csr_array(A), csr_array(B), csr_array(K), csr_array(K_expanded)
    conditions = {
        "UV = I": U @ V - eye_array(V.shape[1]),
        "QR = I": Q @ R - eye_array(R.shape[1]),
        "A~V = VA": expansion.A @ V - V @ A_,
        "K = QK~V": Q @ K_e @ V - K_,
    }
    if expansion.restriction == "a":
        conditions["B~R = VB"] = expansion.B @ R - V @ B_
        conditions["K~V = RK (do all copies of an input get the same command?)"] = K_e @ V - R @ K_
    else:
        conditions["B~ = VBQ"] = expansion.B - V @ B_ @ Q
    allowed = tolerance * max(1.0, _largest(A_), _largest(B_), _largest(K_e))
    residuals = {condition: _largest(missed) for condition, missed in conditions.items()}
    for condition, residual in residuals.items():
        if not residual <= allowed:
            raise BadModelError(
                f"the inclusion misses {condition} by {residual:.3g}; wanted at most {allowed:.3g} "
                f"(restriction type {expansion.restriction})"
            )
    return max(residuals.values())


def _disjoint(formation: FormationModel, matrix: Callable[[FormationModel], FloatArray]) -> Sparse:
    """Block diagonal matrix over the subsystems (3.25): the leader, and each follower with its predecessor."""
    leader, pair = (matrix(FormationModel(who, formation.axes)) for who in ((-1,), (-1, 0)))
    (top, left), (row, column) = leader.nonzero(), pair.nonzero()
    copies = np.arange(len(formation.followers))[:, np.newaxis]
    rows = np.concatenate([top, (len(leader) + copies * len(pair) + row).ravel()])
    columns = np.concatenate([left, (leader.shape[1] + copies * pair.shape[1] + column).ravel()])
    values = np.concatenate([leader[top, left], np.tile(pair[row, column], len(copies))])
    height, width = np.array(leader.shape) + len(copies) * np.array(pair.shape)
    return csr_array((values, (rows, columns)), shape=(height, width))


def _copied_blocks(formation: FormationModel) -> tuple[list[int], list[int]]:
    """For each block of the expanded state, and of the expanded input, the index of the original block it copies."""
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
    """(V'V)^{-1} V' of a selection matrix V; V'V is diagonal and counts the copies."""
    counts = np.asarray(copies.sum(axis=0)).ravel()
    return csr_array(copies.T.multiply(1.0 / counts[:, None]))


def _largest(matrix: Sparse) -> float:
    """Largest absolute entry; 0 if none is stored, NaN if one is NaN."""
    entries = np.abs(matrix.data)
    return float(entries.max()) if entries.size else 0.0
