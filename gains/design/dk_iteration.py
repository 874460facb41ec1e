"""Gains with a given information pattern by alternating between a Lyapunov matrix and the gain (D-K type iteration).

For x' = A x + B u, y = C x, u = K y find K with the pattern and a small α with a proof P::

    (A + B K C)'P + P (A + B K C) ⪯ α P,    I ⪯ P ⪯ κ I,    ‖K‖ ≤ k̄                         (1)

so that every motion of the loop decays at least like e^{αt/2}. With K fixed (1) is linear in P, with P fixed in K and
α; each step can only lower α. The start is K = 0 and the α of P = I. P is not block diagonal: the pattern is imposed on
K alone, and P is perturbed by ε 11' before every gain step, because where P decouples states from inputs no gain helps.

Source: Sahoo 2012 (see `gains.formation.model`), section 4.4. It prints "… + αI ⪯ 0, minimise α", which is unbounded
below; with αP and P normalised, "stop when α < 0" is the test of stability that is meant. Its bound of ‖K‖, 0.1 < k̄ <
100 in [[k̄, K], [K', I]] ≻ 0, allows ‖K‖ < 10 only, less than the gains it prints; here k̄ bounds ‖K‖ itself. Its fixed
ε = 0.1 can raise α; here ε is halved until it does not.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from gains.core._semidefinite import SolverFacts, solved, summed
from gains.core.arrays import FloatArray
from gains.core.errors import BadModelError, DisagreementError, InfeasibleError, SolverError
from gains.core.structure import strongly_connected_blocks
from gains.formation.pattern import Pattern, Plant, check_fits

# At 40 states an iteration takes the solver seconds, at 60 a minute. A formation needs its states along one axis only.
LARGEST_STATES = 40
DEFAULT_GAIN_BOUND = 20.0
DEFAULT_LYAPUNOV_BOUND = 100.0
DEFAULT_PERTURBATION = 0.1
_ITERATIONS = 200
_HALVINGS = 12
# the iteration has settled when α falls by less than this share of its scale in each of some iterations in a row
_SETTLED, _SETTLED_IN_A_ROW = 1e-3, 3


@dataclass(frozen=True)
class DkIterate:
    """One iteration: the α proved, the rightmost eigenvalue (1/s), the ε that was added to P, and ‖K‖."""

    alpha: float
    abscissa: float
    perturbation: float
    gain_norm: float


@dataclass(frozen=True, eq=False)
class DecayProof:
    """P of (1) with the eigenvalues that were checked: V = x'Px proves that motions decay like e^{αt/2}.

    Attributes
    ----------
    P
        Symmetric, shape (n, n).
    alpha
        1/s; negative: the loop is stable.
    P_eigenvalue_min
        Positive.
    inequality_eigenvalue_max
        Largest eigenvalue of A_K'P + P A_K − αP, not positive.
    """

    P: FloatArray
    alpha: float
    P_eigenvalue_min: float
    inequality_eigenvalue_max: float


@dataclass(frozen=True, eq=False)
class DkDesign:
    """Gain of the D-K type iteration.

    Attributes
    ----------
    K
        Shape (inputs, outputs), with the pattern's zeros.
    alpha
        The last α, 1/s; the decay rate is −α/2 or more.
    proof
        Checked by eigenvalues, independent of the solver.
    iterates
        All of them, the first with K = 0; α falls.
    solver
        Of all steps together: seconds and iterations are sums.
    """

    K: FloatArray
    alpha: float
    proof: DecayProof
    iterates: tuple[DkIterate, ...]
    solver: SolverFacts


def _solve(problem: Any, effort: list[SolverFacts], *, step: str) -> None:
    advice = f"in the {step} step; lower gain_bound or lyapunov_bound, or scale states and inputs to like size"
    effort.append(solved(problem, advice=advice))


class _LyapunovStep:
    """K and α fixed: the P, I ⪯ P ⪯ κI, for which (1) holds with most to spare. Compiled once."""

    def __init__(self, states: int, lyapunov_bound: float) -> None:
        import cvxpy as cp

        identity = np.eye(states)
        self._shifted = cp.Parameter((states, states))
        self._P, spare = cp.Variable((states, states), symmetric=True), cp.Variable()
        left: Any = self._P @ self._shifted
        inequality = left + left.T + spare * identity << 0
        bounds = [self._P - identity >> 0, lyapunov_bound * identity - self._P >> 0]
        self._problem = cp.Problem(cp.Maximize(spare), [inequality, *bounds])

    def solve(self, closed_loop: FloatArray, alpha: float, effort: list[SolverFacts]) -> FloatArray:
        self._shifted.value = closed_loop - alpha / 2 * np.eye(len(closed_loop))
        _solve(self._problem, effort, step="Lyapunov")
        P = np.asarray(self._P.value, dtype=float)
        return (P + P.T) / 2


class _GainStep:
    """P fixed: the K with the pattern and ‖K‖ ≤ k̄ for which (1) holds with the least α. Compiled once."""

    def __init__(self, plant: Plant, mask: NDArray[np.bool_], gain_bound: float) -> None:
        import cvxpy as cp

        rows, columns = mask.shape
        free = np.flatnonzero(mask)
        scatter = np.eye(mask.size)[:, free]
        self._mask = mask
        self._P, alpha = cp.Parameter((plant.states, plant.states), symmetric=True), cp.Variable()
        entries = cp.Variable(free.size)
        self._K = cp.reshape(scatter @ entries, mask.shape, order="C")
        half: Any = self._P @ plant.A + self._P @ plant.B @ self._K @ plant.C
        inequality = half + half.T - alpha * self._P << 0
        limit = cp.bmat([[gain_bound * np.eye(rows), self._K], [self._K.T, gain_bound * np.eye(columns)]])
        self._problem = cp.Problem(cp.Minimize(alpha), [inequality, limit >> 0])

    def solve(self, P: FloatArray, effort: list[SolverFacts]) -> FloatArray:
        self._P.value = P
        _solve(self._problem, effort, step="gain")
        return np.where(self._mask, np.asarray(self._K.value, dtype=float), 0.0)


def dk_iteration(
    plant: Plant,
    pattern: Pattern,
    *,
    decay_rate_1_s: float = 0.0,
    gain_bound: float = DEFAULT_GAIN_BOUND,
    lyapunov_bound: float = DEFAULT_LYAPUNOV_BOUND,
    perturbation: float = DEFAULT_PERTURBATION,
) -> DkDesign:
    """Return the first gain of the iteration that is proved to decay faster than at the wanted rate.

    Parameters
    ----------
    plant, pattern
        At most `LARGEST_STATES` states.
    decay_rate_1_s
        The iteration stops when α < −2 `decay_rate_1_s`; with 0, when stability is proved.
    gain_bound
        k̄, limit of ‖K‖.
    lyapunov_bound
        κ > 1.
    perturbation
        ε, at least 0.

    Raises
    ------
    BadModelError
        If sizes do not fit or a number is out of range.
    InfeasibleError
        If the iteration settles before; the message says at which rate.
    SolverError
        If the solver ends a step with a status other than "optimal".

    Examples
    --------
    Two integrators in a row, both measured:

    >>> from gains.design.dk_iteration import dk_iteration
    >>> from gains.formation.pattern import Pattern, Plant
    >>> found = dk_iteration(Plant([[0, 1], [0, 0]], [[0], [1]]), Pattern([[1]], (1,), (2,)), decay_rate_1_s=0.5)
    >>> found.alpha < -1, found.iterates[-1].abscissa < -0.5
    (True, True)
    """
    check_fits(plant, pattern)
    _check_numbers(plant, decay_rate_1_s, gain_bound, lyapunov_bound, perturbation)
    effort: list[SolverFacts] = []
    lyapunov_step = _LyapunovStep(plant.states, lyapunov_bound)
    gain_step = _GainStep(plant, pattern.mask, gain_bound)
    gain, lyapunov = np.zeros(pattern.mask.shape), np.eye(plant.states)
    iterates = [_iterate(plant, gain, lyapunov, 0.0)]
    slow = 0
    for _ in range(_ITERATIONS):
        if iterates[-1].alpha < -2 * decay_rate_1_s:
            proof = decay_proof(plant.closed_loop(gain), lyapunov)
            return DkDesign(K=gain, alpha=proof.alpha, proof=proof, iterates=tuple(iterates), solver=summed(effort))
        centre = lyapunov_step.solve(plant.closed_loop(gain), iterates[-1].alpha, effort)
        held = (gain, centre, iterates[-1].alpha)
        gain, lyapunov, following = _best_gain(plant, gain_step, held, perturbation, effort)
        slow = slow + 1 if iterates[-1].alpha - following.alpha < _SETTLED * (1 + abs(following.alpha)) else 0
        iterates.append(following)
        if slow == _SETTLED_IN_A_ROW:
            break
    raise InfeasibleError(
        f"the iteration settles at alpha = {iterates[-1].alpha:.4g} 1/s after {len(iterates) - 1} iterations, which "
        f"proves a decay rate of {max(-iterates[-1].alpha / 2, 0.0):.4g} 1/s; wanted more than {decay_rate_1_s} 1/s: "
        f"raise gain_bound = {gain_bound} or lyapunov_bound = {lyapunov_bound}, or add links"
    )


def _best_gain(
    plant: Plant,
    gain_step: _GainStep,
    held: tuple[FloatArray, FloatArray, float],
    perturbation: float,
    effort: list[SolverFacts],
) -> tuple[FloatArray, FloatArray, DkIterate]:
    """Gain step at P + ε 11', with the largest ε, ε/2, ε/4, ... that does not raise α; else the gain held."""
    K_held, P, alpha_held = held
    ones = np.ones_like(P)
    for halving in range(_HALVINGS):
        epsilon = perturbation / 2**halving if halving < _HALVINGS - 1 else 0.0
        perturbed = P + epsilon * ones
        K = gain_step.solve(perturbed, effort)
        found = _iterate(plant, K, perturbed, epsilon)
        if found.alpha < alpha_held:
            return K, perturbed, found
    return K_held, P, _iterate(plant, K_held, P, 0.0)


def _iterate(plant: Plant, K: FloatArray, P: FloatArray, epsilon: float) -> DkIterate:
    """The α that P proves for K, and its check against the eigenvalues of the loop."""
    closed_loop = plant.closed_loop(K)
    alpha = _proved_alpha(closed_loop, P)
    rightmost = abscissa(closed_loop)
    # α is at least twice the abscissa for every P; a defective eigenvalue has the root of the rounding as its error
    if 2 * rightmost > alpha + 1e-6 * (1 + float(np.linalg.norm(closed_loop, 2))):
        raise DisagreementError(
            f"the Lyapunov matrix proves alpha = {alpha:.6g} 1/s, but the rightmost eigenvalue is {rightmost:.6g} 1/s; "
            "alpha cannot be less than twice that"
        )
    return DkIterate(alpha, rightmost, epsilon, float(np.linalg.norm(K, 2)))


def _proved_alpha(closed_loop: FloatArray, P: FloatArray) -> float:
    """Least α with A_K'P + P A_K ⪯ α P: the largest generalised eigenvalue."""
    derivative = closed_loop.T @ P + P @ closed_loop
    return float(linalg.eigh(derivative, P, eigvals_only=True)[-1])


def abscissa(closed_loop: FloatArray) -> float:
    """Largest real part of an eigenvalue (1/s) of A (n, n), by strongly connected blocks: see `gains.core.structure`.

    Examples
    --------
    >>> import numpy as np
    >>> from gains.design.dk_iteration import abscissa
    >>> round(abscissa(np.array([[0.0, 1.0], [-2.0, -3.0]])), 6)
    -1.0
    """
    blocks = strongly_connected_blocks(closed_loop)
    return max(float(np.linalg.eigvals(closed_loop[np.ix_(block, block)]).real.max()) for block in blocks)


def decay_proof(closed_loop: FloatArray, P: FloatArray) -> DecayProof:
    """The least α that P proves for a closed loop A_K, both (n, n), checked by numpy's eigenvalues alone.

    Raises
    ------
    SolverError
        If P is not positive definite or proves no decay.

    Examples
    --------
    V = x'x proves that x' = −x decays like e^{−t}:

    >>> import numpy as np
    >>> from gains.design.dk_iteration import decay_proof
    >>> round(decay_proof(-np.eye(2), np.eye(2)).alpha, 6)
    -2.0
    """
    P_min = float(np.linalg.eigvalsh(P)[0])
    if P_min <= 0:
        raise SolverError(f"the Lyapunov matrix has the eigenvalue {P_min:.3g}; positive ones are wanted")
    least_alpha = _proved_alpha(closed_loop, P)
    # room for the rounding of the check, far below what any figure shown resolves
    alpha = least_alpha + 1e-9 * abs(least_alpha)
    inequality = closed_loop.T @ P + P @ closed_loop - alpha * P
    inequality_max = float(np.linalg.eigvalsh(inequality)[-1])
    if not (inequality_max <= 0 and alpha < 0):
        raise SolverError(
            f"the proof of alpha = {alpha:.6g} (wanted < 0) fails its check: the largest eigenvalue of the "
            f"inequality is {inequality_max:.3g} (wanted <= 0); ask for a little faster decay"
        )
    return DecayProof(P=P, alpha=alpha, P_eigenvalue_min=P_min, inequality_eigenvalue_max=inequality_max)


def _check_numbers(
    plant: Plant, decay_rate_1_s: float, gain_bound: float, lyapunov_bound: float, perturbation: float
) -> None:
    if plant.states > LARGEST_STATES:
        raise BadModelError(
            f"the plant has {plant.states} states; at most {LARGEST_STATES} are wanted for the D-K iteration: use "
            "gains.design.structured_lqr"
        )
    for name, value, least in (
        ("decay_rate_1_s", decay_rate_1_s, 0.0),
        ("gain_bound", gain_bound, 1e-6),
        ("lyapunov_bound", lyapunov_bound, 1.0 + 1e-6),
        ("perturbation", perturbation, 0.0),
    ):
        if not (np.isfinite(value) and value >= least):
            raise BadModelError(f"{name} = {value}; a number of at least {least} is wanted")
