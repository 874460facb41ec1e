"""Stability of a loop with several independent delays, one for each link.

x'(t) = A0 x(t) + A1 x(t - tau_1) + A2 x(t - tau_2) has a root j omega where det(j omega I - A0 - A1 e^{-j alpha} -
A2 e^{-j beta}) = 0 with alpha = omega tau_1, beta = omega tau_2. `_curves` follows the solutions (omega, alpha, beta).
Each maps to the delays ((alpha + 2 pi p) / omega, (beta + 2 pi q) / omega) for whole p and q, which form curves in the
plane of delays. The number of unstable roots changes across them; the edge of the stable region consists of the pieces
on which no root lies right of the axis. If each block has only one delay, as in a leader-follower tree with one delay
for each vehicle, the region is a rectangle (`delay_box`).

E. Jarlebring, "Critical delays and polynomial eigenvalue problems", arXiv:0706.1634, parameterises the same curves.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import inf, isfinite, pi

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import BoolArray, FloatArray
from gains.core.errors import BadModelError
from gains.core.structure import distinct_blocks, of_type, real_matrix, square_matrices
from gains.delay._curves import at_delay, crossing_solutions
from gains.delay.constant import delay_margin
from gains.delay.rightmost import rightmost_root

# a rightmost root is on the axis if it is this close to it, relative to its own size
_ON_AXIS = 1e-6
# a piece of a crossing curve with fewer points merely touches a corner of the box
_LEAST_POINTS = 2


@dataclass(frozen=True, eq=False)
class Polyline:
    """Curve of delays (tau_1, tau_2), `delays_s` (k, 2), with roots +-j `omega_rad_s` (k,) on the imaginary axis."""

    delays_s: FloatArray
    omega_rad_s: FloatArray


@dataclass(frozen=True)
class DelayBox:
    """The delays tau_1, ..., tau_m that the loop tolerates independently of each other.

    `limits_s` holds, for each delay, the limit set by the blocks in which no other delay acts: `inf` for no limit, all
    zero if a block is unstable without delay. `coupled` lists the sets of delays (by index) that act in one block,
    where the limit of each depends on the others. If it is empty, the box is exact: the loop is stable at all delays
    inside and loses stability on its faces.
    """

    limits_s: tuple[float, ...]
    coupled: tuple[frozenset[int], ...]

    @property
    def is_exact(self) -> bool:
        """Whether every limit is independent of the other delays."""
        return not self.coupled


def delay_box(A0: ArrayLike, late: Sequence[ArrayLike]) -> DelayBox:
    """The rectangle of delays that x'(t) = A0 x(t) + sum_k late[k] x(t - tau_k) tolerates, block by block.

    Couplings between strongly connected blocks do not matter: in a leader-follower tree with one delay for each vehicle
    every block has one delay, and the box is exact. A0 acts without delay and late[k] with tau_k; all are real matrices
    (n, n) in 1/s. BadModelError unless they are square, finite and of one size.

    x_1' = -x_1(t - tau_1), x_2' = x_1 - 2 x_2(t - tau_2) is stable up to pi / 2 and pi / 4, whatever the other delay:

    >>> box = delay_box([[0, 0], [1, 0]], [[[-1, 0], [0, 0]], [[0, 0], [0, -2]]])
    >>> [round(limit_s, 6) for limit_s in box.limits_s], box.is_exact
    ([1.570796, 0.785398], True)
    """
    listed = list(of_type("late", late, Sequence, np.ndarray))
    now, *delayed = square_matrices(A0=A0, **{f"late[{k}]": matrix for k, matrix in enumerate(listed)})
    limits_s = [inf] * len(delayed)
    coupled: list[frozenset[int]] = []
    for block in distinct_blocks(now, *delayed):
        here, *parts = block.matrices
        acting = [k for k, part in enumerate(parts) if part.any()]
        if float(np.linalg.eigvals(here + sum(parts, np.zeros_like(here))).real.max()) >= 0.0:
            return DelayBox((0.0,) * len(delayed), ())
        if len(acting) == 1:
            limits_s[acting[0]] = min(limits_s[acting[0]], delay_margin(here, parts[acting[0]]))
        elif len(acting) > 1 and frozenset(acting) not in coupled:
            coupled.append(frozenset(acting))
    return DelayBox(tuple(limits_s), tuple(coupled))


def late_by_vehicle(B: ArrayLike, K: ArrayLike, inputs: Sequence[slice]) -> list[FloatArray]:
    """Split B K into one matrix (n, n) for each vehicle's command, so that each can have a delay of its own.

    B is (n, p), K is (p, n), u = K x. `inputs` holds the slice of u with each vehicle's command, as given by
    `gains.formation.model.FormationModel.input_slice`. Raises BadModelError if B and K do not fit.

    Two vehicles on one axis:

    >>> [late.tolist() for late in late_by_vehicle([[1, 0], [0, 1]], [[-1, 0], [1, -1]], [slice(0, 1), slice(1, 2)])]
    [[[-1.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [1.0, -1.0]]]
    """
    entry, feedback = real_matrix("B", B), real_matrix("K", K)
    if feedback.shape != entry.shape[::-1]:
        raise BadModelError(f"K has shape {feedback.shape}; {entry.shape[::-1]} is wanted, the transpose of B's")
    return [entry[:, place] @ feedback[place] for place in inputs]


def crossing_curves(
    A0: ArrayLike, A1: ArrayLike, A2: ArrayLike, *, longest_s: tuple[float, float]
) -> tuple[Polyline, ...]:
    """All curves in the plane of two delays (s) along which roots lie on the imaginary axis, up to `longest_s`.

    Curves start from crossings on a grid of angles: a search, not a proof. Arguments as for `boundary_of_two_delays`.
    """
    if not all(isfinite(longest) and longest > 0.0 for longest in longest_s):
        raise BadModelError(f"longest_s is {longest_s}; two positive numbers of seconds are wanted")
    now, first, second = square_matrices(A0=A0, A1=A1, A2=A2)
    lines: list[Polyline] = []
    for block in distinct_blocks(now, first, second):
        for curve in crossing_solutions(*block.matrices):
            lines += _images(block.matrices, curve, longest_s)
    return tuple(lines)


def boundary_of_two_delays(
    A0: ArrayLike, A1: ArrayLike, A2: ArrayLike, *, longest_s: tuple[float, float]
) -> tuple[Polyline, ...]:
    """The edge of the stable region in the plane of two delays, up to `longest_s`: pieces of `crossing_curves`.

    A piece is part of the edge if no root lies right of the axis on it. The edge may surround several regions; where it
    has no piece, the axes and `longest_s` bound them. A search, not a proof. A0, A1 and A2 are real matrices (n, n) in
    1/s that act without delay, with tau_1 and with tau_2; BadModelError unless they are square, finite and of one size
    and both entries of `longest_s` are positive and finite.

    At tau_2 = 0, x'(t) = -x(t - tau_1) - 0.5 x(t - tau_2) is stable up to tau_1 = acos(-0.5) / sqrt(0.75) = 2.4184:

    >>> edge = boundary_of_two_delays([[0]], [[-1]], [[-0.5]], longest_s=(3.0, 3.0))
    >>> at_once = min((pair for line in edge for pair in line.delays_s.tolist()), key=lambda pair: pair[1])
    >>> round(at_once[0], 4), at_once[1]
    (2.4184, 0.0)
    """
    pieces: list[Polyline] = []
    for line in crossing_curves(A0, A1, A2, longest_s=longest_s):
        roots = [rightmost_root([(A0, 0.0), (A1, first_s), (A2, second_s)]) for first_s, second_s in line.delays_s]
        edge = np.array([root.real <= _ON_AXIS * abs(root) for root in roots])
        pieces += [
            Polyline(line.delays_s[begin:end], line.omega_rad_s[begin:end])
            for begin, end in _runs(edge)
            if end - begin >= _LEAST_POINTS
        ]
    return tuple(pieces)


def _images(matrices: tuple[FloatArray, ...], curve: FloatArray, longest_s: tuple[float, float]) -> Iterator[Polyline]:
    """The polylines of delays that one curve of solutions has in the box, for all whole turns p and q."""
    omega, angles = curve[:, :1], curve[:, 1:]
    first = np.ceil((-angles / (2.0 * pi)).min(axis=0)).astype(int)
    last = np.floor(((np.array(longest_s) * omega - angles) / (2.0 * pi)).max(axis=0)).astype(int)
    for p in range(first[0], last[0] + 1):
        for q in range(first[1], last[1] + 1):
            yield from _Image(matrices, curve, (p, q), longest_s).inside()


@dataclass(frozen=True, eq=False)
class _Image:
    """The curve of delays that a curve of solutions maps to with p and q whole turns added to its angles."""

    matrices: tuple[FloatArray, ...]
    curve: FloatArray
    turns: tuple[int, int]
    longest_s: tuple[float, float]

    def inside(self) -> Iterator[Polyline]:
        """The pieces inside the box, each including the points where the curve enters and leaves it."""
        delays_s = self._delays_s(self.curve)
        for begin, end in _runs(self._is_inside(delays_s)):
            points, omega = delays_s[begin:end], self.curve[begin:end, 0]
            for last, beyond in ((begin, begin - 1), (end - 1, end)):
                edge = self._edge_point(last, beyond) if 0 <= beyond < len(delays_s) else None
                if edge is not None:
                    place = 0 if beyond < begin else len(points)
                    points, omega = np.insert(points, place, edge[0], axis=0), np.insert(omega, place, edge[1])
            if len(points) >= _LEAST_POINTS:
                yield Polyline(points, omega)

    def _delays_s(self, solutions: FloatArray) -> FloatArray:
        """Delays (..., 2) of solutions (..., 3)."""
        return (solutions[..., 1:] + 2.0 * pi * np.array(self.turns)) / solutions[..., :1]

    def _is_inside(self, delays_s: FloatArray) -> BoolArray:
        return np.all((delays_s >= 0.0) & (delays_s <= np.array(self.longest_s)), axis=-1)

    def _edge_point(self, last: int, beyond: int) -> tuple[FloatArray, float] | None:
        """Delays and frequency where the curve meets the edge of the box between a vertex inside and one outside."""
        here, there = self._delays_s(self.curve[[last, beyond]])
        # the edge that the chord meets first
        met = [
            ((bound_s - float(here[which])) / float(there[which] - here[which]), which, bound_s)
            for which in (0, 1)
            for bound_s in (0.0, self.longest_s[which])
            if ((there[which] < 0.0) if bound_s == 0.0 else (there[which] > bound_s))
        ]
        if not met or min(met)[0] <= 0.0:
            return None
        share, which, bound_s = min(met)
        start = self.curve[last] + share * (self.curve[beyond] - self.curve[last])
        found = at_delay(self.matrices, start, which=which, delay_s=bound_s, turns=self.turns[which])
        if found is None:
            return None
        pair_s = self._delays_s(found)
        pair_s[which] = bound_s
        # the curve may have left by another edge before
        return (pair_s, float(found[0])) if self._is_inside(pair_s) else None


def _runs(kept: BoolArray) -> Iterator[tuple[int, int]]:
    """Begin and end (exclusive) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], kept, [False]]).astype(np.int8)))
    return zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
