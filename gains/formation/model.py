"""The error model of a leader-follower formation, for any chain or tree of vehicles.

Source: P. R. Sahoo, "Decentralized Control Design Approaches for Formation Control of Unmanned Aerial Vehicles",
M.Tech thesis, NIT Rourkela, 2012, eqs. (2.10)-(2.12), written there for a chain of three vehicles.
"""

from dataclasses import dataclass
from numbers import Integral

import numpy as np
from numpy.typing import ArrayLike

from gains.core.arrays import BoolArray, FloatArray
from gains.core.errors import BadModelError
from gains.core.structure import real_matrix, shown, strongly_connected_blocks

LEADER = -1


@dataclass(frozen=True)
class FormationModel:
    """Linear error model e' = A e + B u of vehicles that each follow the vehicle in front.

    Vehicle 0 is the leader; its velocity error is e_0^v = Z_0^v − v_d, and its position is not controlled. A follower i
    behind vehicle j, with desired spacing d_i and positions and velocities Z^p, Z^v (thesis 2.10, 2.11), has::

        e_i^p = Z_j^p − Z_i^p − d_i     spacing error,  e_i^p' = e_j^v − e_i^v
        e_i^v = Z_i^v − v_d             velocity error, e_i^v' = u_i

    The state is e = (e_0^v, e_1^p, e_1^v, e_2^p, e_2^v, ...), the input u = (u_0, u_1, ...), each entry with `axes`
    components. BadModelError unless `predecessors` are whole numbers: −1 for the leader, which comes first, then an
    earlier vehicle for each of the others.

    In this chain of a leader and two followers, with K1 = −1 and K3 = 1 per axis, a follower has the characteristic
    equation s² + (s + 1) e^{−sτ} = 0 and a delay margin of 0.711119 s:

    >>> from gains import FormationModel, delay_margin
    >>> chain = FormationModel((-1, 0, 1))
    >>> chain.states, chain.inputs
    (10, 6)
    >>> round(delay_margin(*chain.ground_loop(-np.eye(2), 0 * np.eye(2), np.eye(2))), 6)
    0.711119
    """

    predecessors: tuple[int, ...]
    """For each vehicle, the index of the vehicle it follows, −1 for the leader."""
    axes: int = 2
    """Number of controlled axes, 2 for north and east."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "predecessors", _checked_predecessors(self.predecessors))
        if not (isinstance(self.axes, Integral) and self.axes >= 1):
            raise BadModelError(f"axes = {shown(self.axes)}; wanted 1 or more (2 for north and east)")

    @property
    def vehicles(self) -> int:
        """Number of vehicles, including the leader."""
        return len(self.predecessors)

    @property
    def followers(self) -> range:
        """Indices of all vehicles but the leader."""
        return range(1, self.vehicles)

    @property
    def states(self) -> int:
        """Length of the error vector e."""
        return self.axes * (2 * self.vehicles - 1)

    @property
    def inputs(self) -> int:
        """Length of the input vector u."""
        return self.axes * self.vehicles

    def velocity_slice(self, vehicle: int) -> slice:
        """Slice of the state that holds e_i^v."""
        start = 2 * self.axes * self._known(vehicle)
        return slice(start, start + self.axes)

    def spacing_slice(self, vehicle: int) -> slice:
        """Slice of the state that holds e_i^p; BadModelError for the leader, which has none."""
        if self._known(vehicle) == 0:
            raise BadModelError("vehicle 0 is the leader and has no spacing error; wanted a follower")
        start = self.axes * (2 * vehicle - 1)
        return slice(start, start + self.axes)

    @property
    def spacing_mask(self) -> BoolArray:
        """Mask (states,) of the spacing errors in the state."""
        mask = np.zeros(self.states, dtype=np.bool_)
        for i in self.followers:
            mask[self.spacing_slice(i)] = True
        return mask

    def output_slice(self, vehicle: int) -> slice:
        """Slice of the state that holds all errors of a vehicle: e_i^p and e_i^v, for the leader e_0^v."""
        start = 0 if self._known(vehicle) == 0 else self.spacing_slice(vehicle).start
        return slice(start, self.velocity_slice(vehicle).stop)

    def input_slice(self, vehicle: int) -> slice:
        """Slice of the input that holds u_i."""
        start = self.axes * self._known(vehicle)
        return slice(start, start + self.axes)

    @property
    def A(self) -> FloatArray:  # noqa: N802 - the source's letter
        """State matrix of (2.12), shape (states, states): e_i^p' = e_j^v − e_i^v, velocity errors driven by u only."""
        A = np.zeros((self.states, self.states))
        identity = np.eye(self.axes)
        for i in self.followers:
            A[self.spacing_slice(i), self.velocity_slice(self.predecessors[i])] = identity
            A[self.spacing_slice(i), self.velocity_slice(i)] = -identity
        return A

    @property
    def B(self) -> FloatArray:  # noqa: N802 - the source's letter
        """Input matrix of (2.12), shape (states, inputs): u_i is the acceleration of vehicle i."""
        B = np.zeros((self.states, self.inputs))
        for i in range(self.vehicles):
            B[self.velocity_slice(i), self.input_slice(i)] = np.eye(self.axes)
        return B

    def overlapping_gain(self, K1: ArrayLike, K2: ArrayLike, K3: ArrayLike) -> FloatArray:
        """Gain K of u = K e with the leader-follower pattern (3.19), shape (inputs, states).

        ::

            u_0 = K1 e_0^v
            u_i = K1 e_i^v + K2 e_j^v + K3 e_i^p     for a follower i behind j

        K1 (1/s) acts on the vehicle's own velocity error, K2 (1/s) on that of the vehicle in front, and K3 (1/s²) on
        the spacing error. In a stable loop K1 is negative and K3 positive (definite), because e_i^p grows as vehicle i
        falls behind. BadModelError unless each is a finite matrix of shape (axes, axes).
        """
        own, front, spacing = checked_gains(K1, K2, K3, self.axes)
        K = np.zeros((self.inputs, self.states))
        for i in range(self.vehicles):
            K[self.input_slice(i), self.velocity_slice(i)] = own
        for i in self.followers:
            K[self.input_slice(i), self.velocity_slice(self.predecessors[i])] = front
            K[self.input_slice(i), self.spacing_slice(i)] = spacing
        return K

    def ground_loop(self, K1: ArrayLike, K2: ArrayLike, K3: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """(A0, A1) of e'(t) = A0 e(t) + A1 e(t − τ) if the ground station closes every loop.

        All feedback is late: A0 = A, A1 = B K, both (states, states). Arguments as for `overlapping_gain`.
        """
        return self.A, self.feedback(self.overlapping_gain(K1, K2, K3))

    def feedback(self, K: FloatArray) -> FloatArray:
        """B K, (states, states), for a gain K (inputs, states). Its rows are placed: large matrices multiply slowly."""
        product = np.zeros((self.states, self.states))
        product[~self.spacing_mask] = K
        return product

    def narrowed(self, K: FloatArray) -> tuple["FormationModel", FloatArray]:
        """The formation and gain of one axis, if K (inputs, states) acts on every axis alike; else both unchanged."""
        one = K[:: self.axes, :: self.axes]
        if self.axes == 1 or not np.array_equal(K, np.kron(one, np.eye(self.axes))):
            return self, K
        return FormationModel(self.predecessors, axes=1), one

    def coupled_vehicles(self, K: FloatArray) -> list[list[int]]:
        """Groups of vehicles that act on each other under the gain K (inputs, states), driving groups first."""
        starts = [self.output_slice(i).start for i in range(self.vehicles)]
        pattern = np.abs(self.A) + np.abs(self.feedback(K))
        acts = np.add.reduceat(np.add.reduceat(pattern, starts, axis=0), starts, axis=1)
        return [members.tolist() for members in strongly_connected_blocks(acts)]

    def _known(self, vehicle: int) -> int:
        if not 0 <= vehicle < self.vehicles:
            raise BadModelError(f"vehicle {vehicle} is not in the formation; wanted 0 to {self.vehicles - 1}")
        return vehicle


def checked_gains(K1: ArrayLike, K2: ArrayLike, K3: ArrayLike, axes: int) -> list[FloatArray]:
    """The gains as finite arrays of shape (axes, axes); BadModelError names one that is not."""
    gains = {name: real_matrix(name, gain) for name, gain in (("K1", K1), ("K2", K2), ("K3", K3))}
    for name, gain in gains.items():
        if gain.shape != (axes, axes):
            raise BadModelError(f"{name} has shape {gain.shape}; wanted ({axes}, {axes})")
    return [*gains.values()]


def _checked_predecessors(predecessors: ArrayLike) -> tuple[int, ...]:
    try:
        array = np.array(predecessors)
    except ValueError as error:
        raise BadModelError(f"predecessors = {shown(predecessors)}; wanted one number for each vehicle") from error
    if array.ndim != 1 or array.size == 0:
        raise BadModelError(f"predecessors has shape {array.shape}; wanted one number for each vehicle")
    if not np.issubdtype(array.dtype, np.integer):
        raise BadModelError(f"predecessors = {array.tolist()}; wanted whole numbers, -1 for the leader")
    if array[0] != LEADER:
        raise BadModelError(f"vehicle 0 follows vehicle {array[0]}; wanted the leader (-1) to come first")
    for i, j in enumerate(array.tolist()[1:], start=1):
        if j == LEADER:
            raise BadModelError(f"vehicle {i} is a second leader (-1); wanted exactly one, and it is vehicle 0")
        if not 0 <= j < i:
            raise BadModelError(f"vehicle {i} follows vehicle {j}; wanted one that comes before it, 0 to {i - 1}")
    return tuple(int(j) for j in array)
