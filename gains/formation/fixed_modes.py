"""Modes that no gain with a given information pattern can move, and the links that would free them.

λ is a fixed mode of x' = A x + B u, y = C x under a pattern if it is an eigenvalue of A + B K C for every K with the
pattern. If it lies in the closed right half plane, no such gain stabilises the plant. A mode that random gains do not
move is fixed, because the gains that leave a free mode in place have measure zero. Each strongly connected component of
plant and pattern is analysed on its own.

Source: Sahoo 2012 (see `gains.formation.model`), section 4, for the expanded decentralised plant, in which every input
is a control station.
"""

from dataclasses import dataclass

import numpy as np

from gains.core.arrays import ComplexArray, FloatArray
from gains.core.errors import InfeasibleError
from gains.core.structure import distinct_blocks, strongly_connected_blocks
from gains.formation.pattern import Link, Pattern, Plant, check_fits

# singular values below this share of the largest are zero: rounding is 1e-15, and the effect of a gain is far larger
_RANK_TOLERANCE = 1e-10
# eigenvalues of A within this share of its norm are one defective eigenvalue; their mean is exact to rounding
_SAME_EIGENVALUE = 1e-5
_RANDOM_GAINS = 3


@dataclass(frozen=True)
class FixedMode:
    """An eigenvalue of A + B K C that is the same for every K with the pattern."""

    mode: complex
    """λ, 1/s; of a complex pair, the one with positive imaginary part."""
    states: tuple[int, ...]
    """Indices of the states of the components in which λ is fixed."""
    remedies: tuple[tuple[Link, ...], ...]
    """Alternative sets of links; adding any one set to the pattern frees the mode. Empty if λ is uncontrollable or
    unobservable even with all inputs and outputs."""

    @property
    def unstable(self) -> bool:
        """Whether λ is in the closed right half plane, with a tolerance of 1e-9 for rounding."""
        return self.mode.real > -1e-9 * max(1.0, abs(self.mode))


def fixed_modes(plant: Plant, pattern: Pattern) -> tuple[FixedMode, ...]:
    """Every mode that no gain with the pattern moves, in ascending order of real part.

    The position of a formation's leader is not a state of its error model and therefore no fixed mode. Raises
    BadModelError if plant and pattern do not fit.

    The integrator of a leader that may not use its own velocity error is fixed, unless a link is added:

    >>> from gains import FormationModel
    >>> from gains.formation.pattern import formation_plant, leader_follower
    >>> from gains.formation.pattern import without_links
    >>> pair = FormationModel((-1, 0), axes=1)
    >>> [found] = fixed_modes(formation_plant(pair), without_links(leader_follower(pair), [(0, 0)]))
    >>> abs(found.mode) < 1e-9, found.states, found.remedies
    (True, (0,), (((0, 0),), ((0, 1),)))
    """
    check_fits(plant, pattern)
    gains = _random_gains(plant, pattern)
    feedbacks = [plant.B @ gain @ plant.C for gain in gains]
    linked = (plant.B != 0.0).astype(float) @ pattern.mask.astype(float) @ (plant.C != 0.0).astype(float)
    found: dict[complex, set[int]] = {}
    for states in strongly_connected_blocks(plant.A, linked):
        own = np.ix_(states, states)
        for mode in distinct_modes(plant.A[own]):
            if all(_is_eigenvalue(plant.A[own] + feedback[own], mode) for feedback in feedbacks):
                found.setdefault(mode, set()).update(states.tolist())
    return tuple(
        FixedMode(mode, tuple(sorted(states)), _remedies(plant, pattern, mode, gains[0]))
        for mode, states in sorted(found.items(), key=lambda item: (item[0].real, item[0].imag))
    )


def check_stabilisable(plant: Plant, pattern: Pattern) -> None:
    """Raise InfeasibleError if a fixed mode is unstable; the message names the links to add.

    If all are stable, a dynamic controller with the pattern stabilises the plant; a static gain need not exist. Raises
    BadModelError as `fixed_modes` does.
    """
    unstable = [mode for mode in fixed_modes(plant, pattern) if mode.unstable]
    if unstable:
        worst = max(unstable, key=lambda mode: mode.mode.real)
        raise InfeasibleError(
            f"no gain with this pattern moves the mode {_number(worst.mode)} 1/s (states {list(worst.states)}): "
            f"{_advice(worst.remedies)}"
        )


def distinct_modes(A: FloatArray) -> list[complex]:
    """The distinct eigenvalues (1/s) of A (n, n), one of each complex pair; those equal to rounding are merged.

    >>> distinct_modes(np.diag([-1.0, -1.0, -2.0]))
    [(-1+0j), (-2+0j)]
    """
    candidates: list[complex] = []
    tolerance = _SAME_EIGENVALUE * max(float(np.linalg.norm(A, 2)), 1e-300)
    for block in distinct_blocks(A):
        left = np.linalg.eigvals(block.matrices[0]).astype(complex).tolist()
        while left:
            close = [mode for mode in left if abs(mode - left[0]) <= tolerance]
            left = [mode for mode in left if abs(mode - left[0]) > tolerance]
            mean = complex(np.mean(close))
            mode = complex(mean.real + 0.0, 0.0 if abs(mean.imag) <= tolerance else mean.imag)
            if mode.imag >= 0.0 and all(abs(mode - other) > tolerance for other in candidates):
                candidates.append(mode)
    return candidates


def _is_eigenvalue(matrix: FloatArray, mode: complex) -> bool:
    """By the least singular value, because rounding moves a defective eigenvalue by far more than this value."""
    singular = np.linalg.svd(matrix - mode * np.eye(matrix.shape[0]), compute_uv=False)
    return float(singular[-1]) <= _RANK_TOLERANCE * float(np.linalg.norm(matrix, 2))


def _random_gains(plant: Plant, pattern: Pattern) -> list[FloatArray]:
    """Random gains with the pattern, scaled to move modes by about the distance between the plant's own modes."""
    rng = np.random.default_rng(0)
    scale = _size(plant.A) / (_size(plant.B) * _size(plant.C))
    mask = pattern.mask
    # magnitudes between 0.5 and 1.5: an entry close to 0 would barely count as a link
    draws = [rng.uniform(0.5, 1.5, mask.shape) * rng.choice([-1.0, 1.0], mask.shape) for _ in range(_RANDOM_GAINS)]
    return [scale * draw * mask for draw in draws]


def _remedies(plant: Plant, pattern: Pattern, mode: complex, gain: FloatArray) -> tuple[tuple[Link, ...], ...]:
    """Sets of links that free the mode: all single links that do, or if none does, one set built link by link.

    If M and N are the left and right null spaces of A + B K C − λI for a random K, a full block K_ij raises the rank by
    min(rank M'B_i, rank C_j N).
    """
    nullity, helpful = _links_that_help(plant, pattern, mode, gain)
    if alone := tuple((link,) for link, freed in helpful if freed == nullity):
        return alone
    chosen: list[Link] = []
    rng = np.random.default_rng(1)
    gain = gain.copy()
    while helpful:
        link = max(helpful, key=lambda entry: entry[1])[0]
        chosen.append(link)
        at = pattern.input_slice(link[0]), pattern.output_slice(link[1])
        gain[at] = float(np.abs(gain).max() or 1.0) * rng.uniform(0.5, 1.5, gain[at].shape)
        nullity, helpful = _links_that_help(plant, pattern, mode, gain)
        if nullity == 0:
            return (tuple(chosen),)
        helpful = [entry for entry in helpful if entry[0] not in chosen]
    return ()


def _links_that_help(
    plant: Plant, pattern: Pattern, mode: complex, gain: FloatArray
) -> tuple[int, list[tuple[Link, int]]]:
    """The nullity of A + B K C − λI, and every link outside the pattern that raises the rank, with the increase."""
    left, singular, right = np.linalg.svd(plant.closed_loop(gain) - mode * np.eye(plant.states))
    nullity = int(np.count_nonzero(singular <= _RANK_TOLERANCE * max(float(singular[0]), 1e-300)))
    if nullity == 0:
        return 0, []
    M, N = left[:, -nullity:].conj().T, right[-nullity:].conj().T
    moved = [_rank(M @ plant.B[:, pattern.input_slice(i)]) for i in range(len(pattern.input_sizes))]
    seen = [_rank(plant.C[pattern.output_slice(j)] @ N) for j in range(len(pattern.output_sizes))]
    gained = {(int(i), int(j)): min(moved[i], seen[j]) for i, j in np.argwhere(~pattern.blocks)}
    helpful = [(link, freed) for link, freed in gained.items() if freed > 0]
    return nullity, sorted(helpful, key=lambda entry: (abs(entry[0][0] - entry[0][1]), entry[0]))


def _rank(matrix: FloatArray | ComplexArray) -> int:
    """Rank of a matrix whose entries are either rounding errors or of order one."""
    if matrix.size == 0:
        return 0
    singular = np.linalg.svd(matrix, compute_uv=False)
    return int(np.count_nonzero(singular > _RANK_TOLERANCE * max(1.0, float(singular[0]))))


def _size(matrix: FloatArray) -> float:
    """Largest absolute entry, or 1 if all are zero: a scale to divide by."""
    largest = float(np.abs(matrix).max()) if matrix.size else 0.0
    return largest if largest > 0.0 else 1.0


def _advice(remedies: tuple[tuple[Link, ...], ...]) -> str:
    if not remedies:
        return "it is not controllable, or not observable, with all inputs and outputs; no link helps"
    named = [" and ".join(str(link) for link in links) for links in remedies[:6]]
    more = f" or one of {len(remedies) - 6} more" if len(remedies) > 6 else ""
    return f"add the link {' or '.join(named)}{more} (i, j): the input of vehicle i uses the output of vehicle j"


def _number(mode: complex) -> str:
    return f"{mode.real:.6g}" if mode.imag == 0.0 else f"{mode.real:.6g} ± {abs(mode.imag):.6g}j"
