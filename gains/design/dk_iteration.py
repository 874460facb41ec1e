"""Gains with a given information pattern by alternating between a Lyapunov matrix and the gain (D-K type iteration).

For x' = A x + B u, y = C x, u = K y find K with the pattern and the smallest possible α with a proof P::

    (A + B K C)'P + P (A + B K C) ⪯ α P,    I ⪯ P ⪯ κ I,    ‖K‖ ≤ k̄                         (1)

so that every motion of the loop decays at least like e^{αt/2}. (1) is linear in P for fixed K, and in K and α for fixed
P; each step can only lower α. The iteration starts from K = 0 and the α of P = I. P is perturbed by ε 11' before every
gain step, because no gain helps if P decouples states from inputs.

Source: Sahoo 2012 (see `gains.formation.model`), section 4.4. It prints "… + αI ⪯ 0, minimise α", which is unbounded
below; with αP and P normalised, stopping at α < 0 is the stability test that it intends. Its bound on K only allows
‖K‖ < 10, less than the gains it prints; here k̄ bounds ‖K‖ itself. Its fixed ε = 0.1 can raise α; here ε is halved
until it does not.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import linalg

from gains.core.arrays import BoolArray, FloatArray
from gains.core.errors import BadModelError, DisagreementError, InfeasibleError, SolverError
from gains.core.semidefinite import SolverFacts, solved
from gains.core.structure import roots_of
from gains.formation.pattern import Pattern, Plant, check_fits

# With 40 states an iteration takes the solver seconds, with 60 a minute. A formation needs only the states of one axis.
LARGEST_STATES = 40
# k̄, κ and the first ε
_GAIN_BOUND, _LYAPUNOV_BOUND, _PERTURBATION = 20.0, 100.0, 0.1
_ADVICE = "scale states and inputs to like size, or add links"
_ITERATIONS = 200
_HALVINGS = 12
# the iteration has settled when α falls by less than this share of its scale in this many consecutive iterations
_SETTLED, _SETTLED_IN_A_ROW = 1e-3, 3


@dataclass(frozen=True)
class DkIterate:
    """One iteration: the α proved and the rightmost eigenvalue, both in 1/s."""

    alpha: float
    abscissa: float


@dataclass(frozen=True, eq=False)
class DecayProof:
    """P of (1) and its checked eigenvalues: V = x'Px proves that motions decay like e^{αt/2}."""

    P: FloatArray
    """Symmetric, shape (n, n)."""
    alpha: float
    """1/s; negative, which proves the loop stable."""
    P_eigenvalue_min: float
    """Positive."""
    inequality_eigenvalue_max: float
    """Largest eigenvalue of A_K'P + P A_K − αP, not positive."""


@dataclass(frozen=True, eq=False)
class DkDesign:
    """Gain found by the D-K type iteration."""

    K: FloatArray
    """Shape (inputs, outputs), with the pattern's zeros."""
    proof: DecayProof
    """Proof of the last α; the decay rate is at least −α/2."""
    iterates: tuple[DkIterate, ...]
    """All iterations, the first with K = 0; α decreases."""
    solver: SolverFacts | None
    """Facts of all steps together: seconds and iterations are sums, sizes maxima. None if K = 0 is stable."""


def dk_iteration(plant: Plant, pattern: Pattern) -> DkDesign:
    """Return the first gain of the iteration that is proved to stabilise.

    Raises BadModelError if sizes do not fit or there are more than `LARGEST_STATES` states; InfeasibleError, with α, if
    the iteration settles before it proves stability; SolverError if the solver ends a step with a status other than
    "optimal".

    A double integrator with both states measured:

    >>> found = dk_iteration(Plant([[0, 1], [0, 0]], [[0], [1]]), Pattern([[1]], (1,), (2,)))
    >>> found.proof.alpha < 0, found.iterates[-1].abscissa < 0
    (True, True)
    """
    check_fits(plant, pattern)
    if plant.states > LARGEST_STATES:
        raise BadModelError(
            f"the plant has {plant.states} states; at most {LARGEST_STATES} are wanted for the D-K iteration: use "
            "gains.design.structured_lqr"
        )
    effort: list[SolverFacts] = []
    lyapunov_step, gain_step = _lyapunov_step(plant.states, effort), _gain_step(plant, pattern.mask, effort)
    gain, lyapunov = np.zeros(pattern.mask.shape), np.eye(plant.states)
    iterates = [_iterate(plant, gain, lyapunov)]
    slow = 0
    while iterates[-1].alpha >= 0.0:
        if slow == _SETTLED_IN_A_ROW or len(iterates) > _ITERATIONS:
            raise InfeasibleError(
                f"the iteration settles at alpha = {iterates[-1].alpha:.4g} 1/s after {len(iterates) - 1} iterations, "
                f"which does not prove stability (wanted < 0) with gains of norm {_GAIN_BOUND} at most: {_ADVICE}"
            )
        centre = lyapunov_step(plant.closed_loop(gain), iterates[-1].alpha)
        gain, lyapunov, following = _best_gain(plant, gain_step, (gain, centre, iterates[-1].alpha))
        slow = slow + 1 if iterates[-1].alpha - following.alpha < _SETTLED * (1 + abs(following.alpha)) else 0
        iterates.append(following)
    proof = decay_proof(plant.closed_loop(gain), lyapunov)
    return DkDesign(K=gain, proof=proof, iterates=tuple(iterates), solver=_together(effort))


def _together(effort: list[SolverFacts]) -> SolverFacts | None:
    if not effort:
        return None
    return replace(
        effort[0],
        seconds=sum(facts.seconds for facts in effort),
        iterations=sum(facts.iterations for facts in effort),
        variables=max(facts.variables for facts in effort),
        constraints=max(facts.constraints for facts in effort),
    )


def _lyapunov_step(states: int, effort: list[SolverFacts]) -> Callable[[FloatArray, float], FloatArray]:
    """A function from closed loop and α to the P, I ⪯ P ⪯ κI, with the largest slack in (1); compiled once."""
    import cvxpy as cp

    identity = np.eye(states)
    shifted = cp.Parameter((states, states))
    P, spare = cp.Variable((states, states), symmetric=True), cp.Variable()
    left: Any = P @ shifted
    inequality = left + left.T + spare * identity << 0
    problem = cp.Problem(cp.Maximize(spare), [inequality, P - identity >> 0, _LYAPUNOV_BOUND * identity - P >> 0])

    def step(closed_loop: FloatArray, alpha: float) -> FloatArray:
        shifted.value = closed_loop - alpha / 2 * identity
        effort.append(solved(problem, advice=f"Lyapunov step; {_ADVICE}"))
        value = np.asarray(P.value, dtype=float)
        return (value + value.T) / 2

    return step


def _gain_step(plant: Plant, mask: BoolArray, effort: list[SolverFacts]) -> Callable[[FloatArray], FloatArray]:
    """A function from P to the K with the pattern, ‖K‖ ≤ k̄, that has the least α in (1); compiled once."""
    import cvxpy as cp

    rows, columns = mask.shape
    free = np.flatnonzero(mask)
    P, alpha = cp.Parameter((plant.states, plant.states), symmetric=True), cp.Variable()
    K = cp.reshape(np.eye(mask.size)[:, free] @ cp.Variable(free.size), mask.shape, order="C")
    half: Any = P @ plant.A + P @ plant.B @ K @ plant.C
    limit = cp.bmat([[_GAIN_BOUND * np.eye(rows), K], [K.T, _GAIN_BOUND * np.eye(columns)]])
    problem = cp.Problem(cp.Minimize(alpha), [half + half.T - alpha * P << 0, limit >> 0])

    def step(lyapunov: FloatArray) -> FloatArray:
        P.value = lyapunov
        effort.append(solved(problem, advice=f"gain step; {_ADVICE}"))
        return np.where(mask, np.asarray(K.value, dtype=float), 0.0)

    return step


def _best_gain(
    plant: Plant, gain_step: Callable[[FloatArray], FloatArray], held: tuple[FloatArray, FloatArray, float]
) -> tuple[FloatArray, FloatArray, DkIterate]:
    """Gain step at P + ε 11' with the largest of ε, ε/2, ε/4, ..., 0 that lowers α; otherwise the current gain."""
    K_held, P, alpha_held = held
    for halving in range(_HALVINGS):
        perturbed = P + (_PERTURBATION / 2**halving if halving < _HALVINGS - 1 else 0.0)
        K = gain_step(perturbed)
        found = _iterate(plant, K, perturbed)
        if found.alpha < alpha_held:
            return K, perturbed, found
    return K_held, P, _iterate(plant, K_held, P)


def _iterate(plant: Plant, K: FloatArray, P: FloatArray) -> DkIterate:
    """The α that P proves for K, checked against the eigenvalues of the loop."""
    closed_loop = plant.closed_loop(K)
    alpha = _proved_alpha(closed_loop, P)
    rightmost = abscissa(closed_loop)
    # α is at least twice the abscissa for every P; a defective eigenvalue is known to the square root of rounding
    if 2 * rightmost > alpha + 1e-6 * (1 + float(np.linalg.norm(closed_loop, 2))):
        raise DisagreementError(
            f"the Lyapunov matrix proves alpha = {alpha:.6g} 1/s, but the rightmost eigenvalue is {rightmost:.6g} 1/s; "
            "alpha cannot be less than twice that"
        )
    return DkIterate(alpha, rightmost)


def _proved_alpha(closed_loop: FloatArray, P: FloatArray) -> float:
    """Least α with A_K'P + P A_K ⪯ α P: the largest generalised eigenvalue."""
    derivative = closed_loop.T @ P + P @ closed_loop
    return float(linalg.eigh(derivative, P, eigvals_only=True)[-1])


def abscissa(closed_loop: FloatArray) -> float:
    """Return the largest real part (1/s) of an eigenvalue, by strongly connected blocks (`gains.core.structure`).

    >>> round(abscissa(np.array([[0.0, 1.0], [-2.0, -3.0]])), 6)
    -1.0
    """
    return float(roots_of(closed_loop).real.max())


def decay_proof(closed_loop: FloatArray, P: FloatArray) -> DecayProof:
    """Return the least α that P proves for a closed loop A_K, both (n, n), checked by numpy's eigenvalues alone.

    SolverError if P is not positive definite or proves no decay.
    """
    P_min = float(np.linalg.eigvalsh(P)[0])
    if P_min <= 0:
        raise SolverError(f"the Lyapunov matrix has the eigenvalue {P_min:.3g}; positive ones are wanted")
    least_alpha = _proved_alpha(closed_loop, P)
    # allowance for rounding in the check, far below the resolution of any figure shown
    alpha = least_alpha + 1e-9 * abs(least_alpha)
    inequality = closed_loop.T @ P + P @ closed_loop - alpha * P
    inequality_max = float(np.linalg.eigvalsh(inequality)[-1])
    if not (inequality_max <= 0 and alpha < 0):
        raise SolverError(
            f"the proof of alpha = {alpha:.6g} (wanted < 0) fails its check: the largest eigenvalue of the "
            f"inequality is {inequality_max:.3g} (wanted <= 0); ask for a little faster decay"
        )
    return DecayProof(P=P, alpha=alpha, P_eigenvalue_min=P_min, inequality_eigenvalue_max=inequality_max)
